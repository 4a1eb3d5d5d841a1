//! Group normalisation of sequences, with a gradient.

use crate::error::{ModelError, Result};
use crate::params::{Init, Params};
use crate::rng::Rng;
use candle_core::Tensor;

/// `(x - mean) / sqrt(var + 1e-5) * weight + bias`, mean and variance over the steps and the channels of a group.
#[derive(Debug, Clone)]
pub struct GroupNorm {
    /// (channels)
    pub weight: Tensor,
    /// (channels)
    pub bias: Tensor,
    pub(crate) groups: usize,
}

impl GroupNorm {
    /// torch's default.
    pub const EPS: f64 = 1e-5;

    /// Creates `{prefix}.weight` (ones) and `{prefix}.bias` (zeros).
    ///
    /// # Errors
    /// Channels that do not fall into so many groups.
    pub fn new(params: &mut Params, prefix: &str, channels: usize, groups: usize, rng: &mut Rng) -> Result<Self> {
        if groups == 0 || !channels.is_multiple_of(groups) {
            return Err(ModelError::Config {
                model: "group norm",
                field: "n_groups",
                found: groups.to_string(),
                expected: format!("a divisor of {channels}"),
            });
        }
        Ok(Self {
            weight: params.create(&format!("{prefix}.weight"), &[channels], Init::Ones, rng)?,
            bias: params.create(&format!("{prefix}.bias"), &[channels], Init::Zeros, rng)?,
            groups,
        })
    }

    /// x: (b, steps, channels) -> the same
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let (b, steps, channels) = x.dims3()?;
        let grouped = x.reshape((b, steps, self.groups, channels / self.groups))?;
        let centred = grouped.broadcast_sub(&grouped.mean_keepdim((1, 3))?)?;
        let var = centred.sqr()?.mean_keepdim((1, 3))?;
        let normed = centred.broadcast_div(&(var + Self::EPS)?.sqrt()?)?.reshape((b, steps, channels))?;
        Ok(normed.broadcast_mul(&self.weight)?.broadcast_add(&self.bias)?)
    }
}
