//! Where in a feature map something is: expected positions under a softmax over the map, one a keypoint.
//!
//! Finn et al., "Deep Spatial Autoencoders for Visuomotor Learning", arXiv 1509.06113, as robomimic 0.3.0 has it: a 1x1
//! convolution makes one channel a keypoint, temperature 1, no noise.

use super::Linear;
use crate::context::Context;
use crate::ops::{linear, spatial_softmax};
use crate::value::Value;
use crate::{Init, Params, Result, Rng};
use candle_core::Tensor;

/// Keypoints of a feature map; tensors are robomimic's `nets.weight` and `nets.bias`.
#[derive(Debug)]
pub struct SpatialSoftmax {
    weight: Tensor,
    bias: Tensor,
}

/// `n` numbers from -1 to 1, numpy's `linspace`.
fn line(n: usize) -> Vec<f32> {
    let step = if n > 1 { 2.0 / (n - 1) as f64 } else { 0.0 };
    (0..n).map(|i| if i > 0 && i + 1 == n { 1.0 } else { (i as f64 * step - 1.0) as f32 }).collect()
}

impl SpatialSoftmax {
    /// Creates `{prefix}.nets.weight` and `.bias` as torch's convolution does.
    ///
    /// # Errors
    /// If a name is taken.
    pub fn new(params: &mut Params, prefix: &str, channels: usize, keypoints: usize, rng: &mut Rng) -> Result<Self> {
        let uniform = Init::Uniform { bound: 1.0 / (channels as f64).sqrt() };
        Ok(Self {
            weight: params.create(&format!("{prefix}.nets.weight"), &[keypoints, channels, 1, 1], uniform, rng)?,
            bias: params.create(&format!("{prefix}.nets.bias"), &[keypoints], uniform, rng)?,
        })
    }

    /// map: (b, h, w, C) -> x and y of every keypoint in turn, (b, 2 K)
    ///
    /// # Errors
    /// A map of another number of channels.
    pub fn forward(&self, cx: &mut Context<'_>, map: &Value) -> Result<Value> {
        let &[b, h, w, c] = map.dims() else { return Ok(map.clone()) };
        let layer = Linear { weight: self.weight.clone(), bias: Some(self.bias.clone()) };
        let scores = linear(cx, &map.reshape((b, h * w, c))?, &layer)?;
        spatial_softmax(cx, &scores, (h, w))
    }
}

/// x and y of every cell of a map, row by row.
pub fn cell_places((h, w): (usize, usize)) -> Vec<[f32; 2]> {
    let (xs, ys) = (line(w), line(h));
    (0..h * w).map(|i| [xs[i % w], ys[i / w]]).collect()
}
