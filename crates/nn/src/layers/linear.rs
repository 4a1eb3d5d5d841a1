//! `y = x Wᵀ + b`.

use crate::composed;
use crate::error::Result;
use crate::params::{Init, Params};
use crate::precision::Precision;
use crate::rng::Rng;
use candle_core::Tensor;

/// A dense layer with torch's layout: weight `(out, in)`, bias `(out)`.
#[derive(Debug, Clone)]
pub struct Linear {
    /// (out, in)
    pub weight: Tensor,
    /// (out)
    pub bias: Option<Tensor>,
}

impl Linear {
    /// Creates `{prefix}.weight` and `{prefix}.bias` as `torch.nn.Linear` does: both uniform in ±1/sqrt(in).
    pub fn new(params: &mut Params, prefix: &str, input: usize, output: usize, rng: &mut Rng) -> Result<Self> {
        let bound = 1.0 / (input as f64).sqrt();
        let bias = Init::Uniform { bound };
        Self::with_init(params, prefix, (input, output), Init::KaimingUniform, Some(bias), rng)
    }

    /// Creates the layer with the given initial values; `bias: None` leaves it out. `shape` is (in, out).
    pub fn with_init(
        params: &mut Params,
        prefix: &str,
        (input, output): (usize, usize),
        weight: Init,
        bias: Option<Init>,
        rng: &mut Rng,
    ) -> Result<Self> {
        let weight = params.create(&format!("{prefix}.weight"), &[output, input], weight, rng)?;
        let bias = match bias {
            Some(init) => Some(params.create(&format!("{prefix}.bias"), &[output], init, rng)?),
            None => None,
        };
        Ok(Self { weight, bias })
    }

    /// x: (…, in) -> (…, out)
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        self.forward_in(x, Precision::F32)
    }

    /// The same with a product in this precision.
    pub(crate) fn forward_in(&self, x: &Tensor, precision: Precision) -> Result<Tensor> {
        composed::linear(x, &self.weight, self.bias.as_ref(), precision)
    }
}
