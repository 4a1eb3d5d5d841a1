//! Where in a feature map something is: expected positions under a softmax over the map, one a keypoint.
//!
//! Finn et al., "Deep Spatial Autoencoders for Visuomotor Learning", arXiv 1509.06113, as robomimic 0.3.0 has it: a 1x1
//! convolution makes one channel a keypoint, temperature 1, no noise.

use crate::error::Result;
use crate::params::{Init, Params};
use crate::rng::Rng;
use candle_core::Tensor;

/// Keypoints of a feature map; tensors are robomimic's `nets.weight` and `nets.bias`.
#[derive(Debug)]
pub struct SpatialSoftmax {
    weight: Tensor,
    bias: Tensor,
}

/// `n` numbers from -1 to 1, numpy's `linspace`.
pub(crate) fn line(n: usize) -> Vec<f32> {
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

    /// map: (b, C, h, w) -> x and y of every keypoint in turn, (b, 2 K)
    ///
    /// # Errors
    /// A map of another number of channels.
    pub fn forward(&self, map: &Tensor) -> Result<Tensor> {
        let (b, c, h, w) = map.dims4()?;
        let k = self.weight.dim(0)?;
        let cells = map.reshape((b, c, h * w))?.transpose(1, 2)?.contiguous()?.reshape((b * h * w, c))?;
        let scores = cells.matmul(&self.weight.reshape((k, c))?.t()?)?.broadcast_add(&self.bias)?;
        let scores = scores.reshape((b, h * w, k))?.transpose(1, 2)?.contiguous()?;
        let shifted = scores.broadcast_sub(&scores.max_keepdim(2)?.detach())?.exp()?;
        let share = shifted.broadcast_div(&shifted.sum_keepdim(2)?)?;
        let (xs, ys) = (line(w), line(h));
        let places: Vec<f32> = (0..h * w).flat_map(|i| [xs[i % w], ys[i / w]]).collect();
        let places = Tensor::from_vec(places, (h * w, 2), map.device())?;
        Ok(share.reshape((b * k, h * w))?.matmul(&places)?.reshape((b, 2 * k))?)
    }
}
