//! A table of learned rows.

use crate::error::Result;
use crate::params::{Init, Params};
use crate::rng::Rng;
use candle_core::Tensor;

/// Learned rows, as `torch.nn.Embedding`.
#[derive(Debug, Clone)]
pub struct Embedding {
    /// (rows, dim)
    pub weight: Tensor,
}

impl Embedding {
    /// Creates `{prefix}.weight`, standard normal as torch does.
    pub fn new(params: &mut Params, prefix: &str, rows: usize, dim: usize, rng: &mut Rng) -> Result<Self> {
        let init = Init::Normal { std: 1.0 };
        let weight = params.create(&format!("{prefix}.weight"), &[rows, dim], init, rng)?;
        Ok(Self { weight })
    }
}
