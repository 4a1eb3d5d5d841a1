//! Auxiliary supervision: numbers that demonstrations know and the policy must find in what it sees.
//!
//! A policy that sees images learns where things are only by what its actions have to do with it, from few demonstrations
//! slowly. So the encoder's output at the latent's token, the first one, is asked for those numbers as well, and the squared error is a part of the loss (Levine et al., "End-to-End Training of Deep Visuomotor Policies",
//! arXiv 1504.00702, begin their convolutions so). When it acts a policy neither gets these numbers nor is asked for them.

use super::Linear;
use crate::batch::Batch;
use crate::checks::check_weight;
use crate::features::Signature;
use candle_core::Tensor;
use nn::Params;
use nn::Rng;
use nn::ops::{linear, narrow_tokens, term_of};
use nn::values::with_values;
use nn::{Context, Term, Value};
use nn::{ModelError, Result};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// The layer's name.
pub(crate) const AUXILIARY_HEAD: &str = "auxiliary_head";

/// `[policy.auxiliary]`: ask in training for numbers that the policy does not see.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AuxiliaryConfig {
    /// weight of the squared error
    pub weight: f64,
}

impl Default for AuxiliaryConfig {
    fn default() -> Self {
        Self { weight: 1.0 }
    }
}

impl AuxiliaryConfig {
    /// # Errors
    /// A weight that is none.
    pub(crate) fn validate(&self, model: &'static str) -> Result<()> {
        check_weight(model, "auxiliary.weight", self.weight)
    }
}

/// The layer.
#[derive(Debug)]
pub(crate) struct Auxiliary {
    head: Linear,
    pub(crate) weight: f64,
}

impl Auxiliary {
    /// # Errors
    /// A signature that tells nothing.
    pub(crate) fn new(
        p: &mut Params,
        config: &AuxiliaryConfig,
        (model, signature): (&'static str, &Signature),
        dim: usize,
        rng: &mut Rng,
    ) -> Result<Self> {
        if signature.auxiliary_dim == 0 {
            let (found, expected) = ("0".to_string(), "at least 1 with policy.auxiliary".to_string());
            return Err(ModelError::Config { model, field: "auxiliary_dim", found, expected });
        }
        Ok(Self { head: Linear::new(p, AUXILIARY_HEAD, dim, signature.auxiliary_dim, rng)?, weight: config.weight })
    }

    /// encoded: (b, M, D), the latent's token first -> the squared error of what a batch tells
    pub(crate) fn term(
        &self,
        cx: &mut Context<'_>,
        encoded: &Value,
        (model, batch): (&'static str, &Batch),
    ) -> Result<Term> {
        let targets = Arc::new(self.targets(model, batch)?);
        let first = narrow_tokens(cx, encoded, 0, 1)?;
        let found = linear(cx, &first, &self.head)?.reshape((batch.rows(), self.head.weight.dim(0)?))?;
        let on_slices = Arc::clone(&targets);
        let on_slices = move |found: &[f32], grad: Option<(&mut [f32], f64)>| match grad {
            Some((grad, weight)) => {
                grad.copy_from_slice(found);
                on_slices.gradient(grad, weight)
            }
            None => on_slices.gradient(&mut found.to_vec(), 0.0),
        };
        term_of(cx, &found, on_slices, |found| targets.loss(found))
    }

    /// Targets of a batch.
    ///
    /// # Errors
    /// A batch that tells nothing, or something else.
    fn targets(&self, model: &'static str, batch: &Batch) -> Result<AuxiliaryTargets> {
        let expected = [batch.rows(), self.head.weight.dim(0)?];
        match &batch.auxiliary {
            Some(targets) if targets.dims() == expected => {
                let values = with_values(targets, <[f32]>::to_vec)?;
                Ok(AuxiliaryTargets { values, entries: (batch.total_rows * expected[1]).max(1) })
            }
            other => Err(ModelError::Input {
                operation: model,
                object: "auxiliary numbers",
                found: other.as_ref().map_or_else(|| "nothing".to_string(), |targets| format!("{:?}", targets.dims())),
                expected: format!("{expected:?}"),
            }),
        }
    }
}

/// Targets of a shard.
#[derive(Debug)]
struct AuxiliaryTargets {
    /// (b, K), normalised
    values: Vec<f32>,
    /// numbers that the whole batch tells
    entries: usize,
}

impl AuxiliaryTargets {
    /// found: (b, K) -> the squared error, a share of the mean over the whole batch
    fn loss(&self, found: &Tensor) -> Result<Tensor> {
        let targets = Tensor::from_slice(&self.values, found.dims(), found.device())?;
        Ok(((found - targets)?.sqr()?.sum_all()? / self.entries as f64)?)
    }

    /// The same on a slice; what was found becomes `weight` times the gradient of the loss.
    fn gradient(&self, found: &mut [f32], weight: f64) -> f64 {
        let (mut loss, share) = (0.0, weight * 2.0 / self.entries as f64);
        for (found, targets) in found.iter_mut().zip(&self.values) {
            let off = f64::from(*found) - f64::from(*targets);
            loss += off * off;
            *found = (off * share) as f32;
        }
        loss / self.entries as f64
    }
}
