//! Networks from grids to a class per cell.
//!
//! Sizes follow the study's code (acharyaanusha/Tiny-Recursive-Model,
//! `experiments/simple_maze_comparison.py` and `maze_comparison.py`), so that the parameter
//! counts agree: CNN 74,850, Transformer 616,514, small TRM 9,922 and 28,258. Initial weights
//! come from our own generator. The Transformer's positions have a standard deviation of 0.02, there 1, and it has no
//! dropout, there 0.1. What differs in the small TRM is in `small_trm`.

use candle_core::Tensor;
use models::layers::{Activation, FeedForward, LayerNorm, Linear, MultiHeadAttention};
use nn::Backend;
use nn::Rng;
use nn::{Init, Params};
use nn::{ModelError, Result};
use serde::{Deserialize, Serialize};

/// A network that classifies the cells of a grid.
pub trait GridModel: Send + Sync {
    /// Its parameters.
    fn params(&self) -> &Params;

    /// `grid: (batch, channels, height, width)` -> scores `(batch, cells, classes)`, one tensor
    /// per supervision step with the weight of its loss; a network that does not recur has one.
    ///
    /// # Errors
    /// When the grid's shape does not fit.
    fn forward(&self, grid: &Tensor) -> Result<Vec<(f64, Tensor)>>;
}

/// The grid a model is made for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GridDims {
    /// Input channels.
    pub channels: usize,
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// Classes per cell.
    pub classes: usize,
}

impl GridDims {
    /// Number of cells.
    pub fn cells(self) -> usize {
        self.height * self.width
    }

    /// The batch size of `grid`, if its shape fits.
    pub(super) fn batch(self, grid: &Tensor) -> Result<usize> {
        let wanted = [self.channels, self.height, self.width];
        match grid.dims() {
            [batch, rest @ ..] if rest == wanted => Ok(*batch),
            found => Err(ModelError::Shape {
                operation: "grid model",
                object: "grid without its batch axis",
                expected: wanted.to_vec(),
                found: found.to_vec(),
            }),
        }
    }
}

/// A 3x3 convolution with padding 1, on `(batch, height, width, channels)`.
///
/// Written as one product over the nine neighbours: candle's own convolution spends most of a
/// small grid's time in its transposed backward.
#[derive(Debug, Clone)]
pub(crate) struct Conv3x3 {
    linear: Linear,
}

impl Conv3x3 {
    pub(crate) fn new(
        params: &mut Params,
        prefix: &str,
        (input, output): (usize, usize),
        rng: &mut Rng,
    ) -> Result<Self> {
        let linear = Linear::new(params, prefix, 9 * input, output, rng)?;
        Ok(Self { linear })
    }

    /// `(batch, h, w, in) -> (batch, h, w, out)`
    pub(crate) fn forward(&self, x: &Tensor) -> Result<Tensor> {
        self.linear.forward(&neighbours(x)?)
    }
}

/// `(batch, h, w, c) -> (batch, h, w, 9 c)`: each cell's 3x3 neighbourhood row by row, zeros
/// outside the grid.
pub(crate) fn neighbours(x: &Tensor) -> Result<Tensor> {
    let (_, h, w, _) = x.dims4()?;
    let padded = x.pad_with_zeros(1, 1, 1)?.pad_with_zeros(2, 1, 1)?;
    let mut parts = Vec::with_capacity(9);
    for row in 0..3 {
        for column in 0..3 {
            parts.push(padded.narrow(1, row, h)?.narrow(2, column, w)?);
        }
    }
    Ok(Tensor::cat(&parts, 3)?)
}

/// `(batch, c, h, w) -> (batch, h, w, c)`
pub(super) fn channels_last(grid: &Tensor) -> Result<Tensor> {
    Ok(grid.permute((0, 2, 3, 1))?.contiguous()?)
}

/// Convolutions, then a score per class and cell.
#[derive(Debug)]
pub(super) struct Cnn {
    params: Params,
    dims: GridDims,
    convolutions: Vec<Conv3x3>,
    head: Linear,
}

impl Cnn {
    pub(super) fn new(dims: GridDims, channels: &[usize], rng: &mut Rng) -> Result<Self> {
        let mut params = Params::new(&Backend::CPU);
        let mut width = dims.channels;
        let mut convolutions = Vec::new();
        for (i, &next) in channels.iter().enumerate() {
            let name = format!("conv.{i}");
            convolutions.push(Conv3x3::new(&mut params, &name, (width, next), rng)?);
            width = next;
        }
        let head = Linear::new(&mut params, "head", width, dims.classes, rng)?;
        Ok(Self { params, dims, convolutions, head })
    }
}

impl GridModel for Cnn {
    fn params(&self) -> &Params {
        &self.params
    }

    fn forward(&self, grid: &Tensor) -> Result<Vec<(f64, Tensor)>> {
        let batch = self.dims.batch(grid)?;
        let mut x = channels_last(grid)?;
        for convolution in &self.convolutions {
            x = convolution.forward(&x)?.relu()?;
        }
        let x = x.reshape((batch, self.dims.cells(), ()))?;
        Ok(vec![(1.0, self.head.forward(&x)?)])
    }
}

/// A post-norm encoder layer, as `torch.nn.TransformerEncoderLayer` without dropout.
#[derive(Debug)]
struct TransformerLayer {
    attention: MultiHeadAttention,
    feed_forward: FeedForward,
    norm1: LayerNorm,
    norm2: LayerNorm,
}

#[derive(Debug)]
pub(super) struct Transformer {
    params: Params,
    dims: GridDims,
    input: Linear,
    positions: Tensor,
    layers: Vec<TransformerLayer>,
    hidden: Linear,
    head: Linear,
}

impl Transformer {
    pub(super) fn new(
        dims: GridDims,
        (dim, heads, layers, feedforward): (usize, usize, usize, usize),
        rng: &mut Rng,
    ) -> Result<Self> {
        let mut params = Params::new(&Backend::CPU);
        let input = Linear::new(&mut params, "input", dims.channels, dim, rng)?;
        let normal = Init::Normal { std: 0.02 };
        let positions = params.create("positions", &[dims.cells(), dim], normal, rng)?;
        let layers = (0..layers)
            .map(|i| {
                let at = |name: &str| format!("layers.{i}.{name}");
                Ok(TransformerLayer {
                    attention: MultiHeadAttention::new(
                        &mut params,
                        &at("self_attn"),
                        dim,
                        heads,
                        0.0,
                        Init::KaimingUniform,
                        rng,
                    )?,
                    feed_forward: FeedForward::new(
                        &mut params,
                        &at(""),
                        (dim, feedforward),
                        Activation::Relu,
                        0.0,
                        Init::KaimingUniform,
                        rng,
                    )?,
                    norm1: LayerNorm::new(&mut params, &at("norm1"), dim, rng)?,
                    norm2: LayerNorm::new(&mut params, &at("norm2"), dim, rng)?,
                })
            })
            .collect::<Result<_>>()?;
        let hidden = Linear::new(&mut params, "hidden", dim, dim / 2, rng)?;
        let head = Linear::new(&mut params, "head", dim / 2, dims.classes, rng)?;
        Ok(Self { params, dims, input, positions, layers, hidden, head })
    }
}

impl GridModel for Transformer {
    fn params(&self) -> &Params {
        &self.params
    }

    fn forward(&self, grid: &Tensor) -> Result<Vec<(f64, Tensor)>> {
        let batch = self.dims.batch(grid)?;
        let cells = channels_last(grid)?.reshape((batch, self.dims.cells(), ()))?;
        let mut x = self.input.forward(&cells)?.broadcast_add(&self.positions)?;
        for layer in &self.layers {
            let mixed = layer.attention.forward(&x)?;
            x = layer.norm1.forward(&(x + mixed)?)?;
            let fed = layer.feed_forward.forward(&x)?;
            x = layer.norm2.forward(&(x + fed)?)?;
        }
        let x = self.hidden.forward(&x)?.relu()?;
        Ok(vec![(1.0, self.head.forward(&x)?)])
    }
}

#[derive(Debug)]
pub(super) struct Mlp {
    params: Params,
    dims: GridDims,
    layers: Vec<Linear>,
}

impl Mlp {
    pub(super) fn new(dims: GridDims, hidden: &[usize], rng: &mut Rng) -> Result<Self> {
        let mut params = Params::new(&Backend::CPU);
        let mut width = dims.channels * dims.cells();
        let mut layers = Vec::new();
        for (i, &next) in hidden.iter().chain([&(dims.cells() * dims.classes)]).enumerate() {
            layers.push(Linear::new(&mut params, &format!("layers.{i}"), width, next, rng)?);
            width = next;
        }
        Ok(Self { params, dims, layers })
    }
}

impl GridModel for Mlp {
    fn params(&self) -> &Params {
        &self.params
    }

    fn forward(&self, grid: &Tensor) -> Result<Vec<(f64, Tensor)>> {
        let batch = self.dims.batch(grid)?;
        let x = grid.reshape((batch, self.dims.channels * self.dims.cells()))?;
        let scores = dense(&self.layers, &x)?;
        Ok(vec![(1.0, scores.reshape((batch, self.dims.cells(), self.dims.classes))?)])
    }
}

/// Dense layers with ReLU between them.
pub(super) fn dense(layers: &[Linear], x: &Tensor) -> Result<Tensor> {
    let mut x = x.clone();
    for (i, layer) in layers.iter().enumerate() {
        x = layer.forward(&x)?;
        if i + 1 < layers.len() {
            x = x.relu()?;
        }
    }
    Ok(x)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::{GridConfig, SmallTrmConfig};
    use super::*;
    use candle_core::Device;

    const MAZE8: GridDims = GridDims { channels: 3, height: 8, width: 8, classes: 2 };
    const MAZE10: GridDims = GridDims { height: 10, width: 10, ..MAZE8 };

    fn all() -> Vec<(GridConfig, GridDims, usize)> {
        let cnn = GridConfig::Cnn { channels: vec![32, 64, 64, 32] };
        let transformer = GridConfig::Transformer { dim: 128, heads: 4, layers: 3, feedforward: 512 };
        let mlp = GridConfig::Mlp { hidden: vec![16] };
        let (simple, complex) = (SmallTrmConfig::simple(), SmallTrmConfig::complex());
        vec![
            (cnn, MAZE8, 74_850),
            (transformer, MAZE10, 616_514),
            (mlp, MAZE8, 192 * 16 + 16 + 16 * 128 + 128),
            (GridConfig::SmallTrm(simple), MAZE8, 9_922),
            (GridConfig::SmallTrm(complex), MAZE10, 28_258),
        ]
    }

    #[test]
    fn parameter_counts_are_the_studys() {
        for (config, dims, count) in all() {
            let model = config.build(dims, 1).unwrap();
            assert_eq!(model.params().count(), count, "{config:?}");
        }
    }

    #[test]
    fn every_parameter_gets_a_gradient() {
        for (config, dims, _) in all() {
            let model = config.build(dims, 1).unwrap();
            let mut rng = Rng::new(2, "grid");
            let shape = (2, dims.channels, dims.height, dims.width);
            let grid = rng.normals(2 * dims.channels * dims.cells());
            let grid = Tensor::from_vec(grid, shape, &Device::Cpu).unwrap();
            let mut loss = Tensor::zeros((), candle_core::DType::F32, &Device::Cpu).unwrap();
            for (weight, scores) in model.forward(&grid).unwrap() {
                assert_eq!(scores.dims(), [2, dims.cells(), dims.classes]);
                loss = (loss + (scores.sqr().unwrap().mean_all().unwrap() * weight).unwrap()).unwrap();
            }
            let grads = loss.backward().unwrap();
            for (name, var) in model.params().iter() {
                let grad = grads.get(var.as_tensor());
                let grad = grad.unwrap_or_else(|| panic!("{config:?}: {name} has no gradient"));
                let size = grad.abs().unwrap().sum_all().unwrap();
                assert!(size.to_scalar::<f32>().unwrap() > 0.0, "{config:?}: {name}");
            }
        }
    }

    #[test]
    fn a_convolution_is_the_naive_sum() {
        let mut rng = Rng::new(3, "conv");
        let (h, w, input, output) = (4, 5, 3, 2);
        let mut params = Params::new(&Backend::CPU);
        let conv = Conv3x3::new(&mut params, "conv", (input, output), &mut rng).unwrap();
        let x = rng.normals(h * w * input);
        let t = Tensor::from_slice(&x, (1, h, w, input), &Device::Cpu).unwrap();
        let got = conv.forward(&t).unwrap().flatten_all().unwrap();
        let got = got.to_vec1::<f32>().unwrap();
        let weight = conv.linear.weight.to_vec2::<f32>().unwrap();
        let bias = conv.linear.bias.as_ref().unwrap().to_vec1::<f32>().unwrap();
        for (row, column, o) in (0..h * w * output).map(|i| (i / (w * output), i / output % w, i % output)) {
            let mut sum = bias[o];
            for (dy, dx) in (0..9).map(|k| (k / 3, k % 3)) {
                let (y, z) = ((row + dy).wrapping_sub(1), (column + dx).wrapping_sub(1));
                if y < h && z < w {
                    for i in 0..input {
                        sum += weight[o][(dy * 3 + dx) * input + i] * x[(y * w + z) * input + i];
                    }
                }
            }
            assert!((sum - got[(row * w + column) * output + o]).abs() < 1e-5);
        }
    }

    #[test]
    fn a_grid_of_the_wrong_size_is_named() {
        let model = GridConfig::Mlp { hidden: vec![4] }.build(MAZE8, 0).unwrap();
        let grid = Tensor::zeros((1, 3, 8, 9), candle_core::DType::F32, &Device::Cpu).unwrap();
        let error = model.forward(&grid).unwrap_err().to_string();
        assert!(error.contains("[3, 8, 8]"), "{error}");
    }
}
