//! Layer normalisation with a gradient.

use crate::composed;
use crate::error::Result;
use crate::params::{Init, Params};
use crate::rng::Rng;
use candle_core::Tensor;

/// `(x - mean) / sqrt(var + 1e-5) * weight + bias` over the last dimension.
#[derive(Debug, Clone)]
pub struct LayerNorm {
    /// (dim)
    pub weight: Tensor,
    /// (dim)
    pub bias: Tensor,
}

impl LayerNorm {
    /// torch's default.
    pub const EPS: f64 = 1e-5;

    /// Creates `{prefix}.weight` (ones) and `{prefix}.bias` (zeros).
    pub fn new(params: &mut Params, prefix: &str, dim: usize, rng: &mut Rng) -> Result<Self> {
        Ok(Self {
            weight: params.create(&format!("{prefix}.weight"), &[dim], Init::Ones, rng)?,
            bias: params.create(&format!("{prefix}.bias"), &[dim], Init::Zeros, rng)?,
        })
    }

    /// x: (…, dim) -> (…, dim)
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        composed::layer_norm(x, &self.weight, &self.bias, Self::EPS)
    }
}
