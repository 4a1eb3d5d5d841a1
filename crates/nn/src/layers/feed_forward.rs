//! Two dense layers with an activation between them.

use super::Linear;
use crate::composed;
use crate::error::Result;
use crate::params::{Init, Params};
use crate::rng::Rng;
use candle_core::Tensor;
use serde::{Deserialize, Serialize};

/// An activation function.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, Default)]
#[serde(rename_all = "snake_case")]
pub enum Activation {
    /// max(x, 0)
    #[default]
    Relu,
    /// x Φ(x), exact
    Gelu,
}

impl Activation {
    /// x: (…, n) -> (…, n)
    pub fn forward(self, x: &Tensor) -> Result<Tensor> {
        match self {
            Self::Relu => composed::relu(x),
            Self::Gelu => Ok(x.gelu_erf()?),
        }
    }
}

/// `linear2(dropout(activation(linear1(x))))`.
#[derive(Debug, Clone)]
pub struct FeedForward {
    /// (hidden, dim)
    pub linear1: Linear,
    /// (dim, hidden)
    pub linear2: Linear,
    /// between the two
    pub activation: Activation,
    /// after the activation
    pub dropout: f64,
}

impl FeedForward {
    /// Creates `{prefix}linear1` and `{prefix}linear2` (the prefix brings its own dot) with the given weight init.
    pub fn new(
        params: &mut Params,
        prefix: &str,
        (dim, hidden): (usize, usize),
        activation: Activation,
        p: f64,
        weight: Init,
        rng: &mut Rng,
    ) -> Result<Self> {
        let mut layer = |name: &str, input: usize, output: usize| {
            let bias = Init::Uniform { bound: 1.0 / (input as f64).sqrt() };
            Linear::with_init(params, &format!("{prefix}{name}"), (input, output), weight, Some(bias), rng)
        };
        Ok(Self {
            linear1: layer("linear1", dim, hidden)?,
            linear2: layer("linear2", hidden, dim)?,
            activation,
            dropout: p,
        })
    }

    /// x: (…, dim) -> (…, dim), on candle's operations, without dropout
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        self.linear2.forward(&self.activation.forward(&self.linear1.forward(x)?)?)
    }
}
