//! Floors and ceilings: policies that learn nothing, evaluated like any other, so that every table says what a number is
//! worth. What happens without moving (`zero`), by chance (`random`), by looking up what was done (`nearest`), by
//! playing back a demonstration blindly (`replay`), and what the scripted expert itself reaches (`expert`).
//!
//! Each is a [`Rule`]; a [`Floor`] makes a model of it, whose training is one step that changes nothing.

pub mod expert;
pub mod nearest;
pub mod random;
pub mod replay;
pub mod zero;

use crate::batch::Batch;
use crate::checks::{check_batch, check_observation};
use crate::chunk_policy::ChunkPolicy;
use crate::features::{FeatureKind, Features, Signature};
use crate::model::{Memory, PolicyModel};
use crate::policy::{Clock, Policy};
use crate::preprocess::Preprocess;
use candle_core::Tensor;
use nn::Backend;
use nn::Gradients;
use nn::Params;
use nn::Rng;
use nn::Size;
use nn::losses::absolute;
use nn::{LossNumbers, LossParts};
use nn::{ModelError, Result};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::Arc;

/// The kinds of features that a floor reads, or does not mind.
pub const READS: &[FeatureKind] = &[FeatureKind::State, FeatureKind::EnvironmentState, FeatureKind::Entity];

/// Options of a floor that has no others.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// actions predicted at once
    pub action_horizon: usize,
}

impl Default for Config {
    fn default() -> Self {
        Self { action_horizon: 1 }
    }
}

impl Config {
    /// It has no weights.
    pub fn size(&self) -> Size {
        Size::default()
    }

    /// Checks that a policy with this configuration can exist.
    ///
    /// # Errors
    /// The first field that makes it impossible.
    pub fn validate(&self) -> Result<()> {
        at_least_one("floor", "action_horizon", self.action_horizon)
    }
}

fn at_least_one(model: &'static str, field: &'static str, value: usize) -> Result<()> {
    if value > 0 {
        return Ok(());
    }
    Err(ModelError::Config { model, field, found: "0".to_string(), expected: "at least 1".to_string() })
}

/// What a floor does instead of learning.
pub trait Rule: Send + Sync + Sized + 'static {
    /// its name in the registry
    const NAME: &'static str;
    /// its options
    type Config;

    /// The rule; what it keeps of the demonstrations becomes tables of `params`.
    ///
    /// # Errors
    /// Options that describe no possible policy.
    fn new(config: &Self::Config, signature: &Signature, params: &mut Params) -> Result<Self>;

    /// Number of actions in a chunk.
    fn action_horizon(&self) -> usize;

    /// The signature's features of `rows` rows -> (rows, H, A) in network units; without a generator what is expected of it.
    ///
    /// # Errors
    /// A table that was never filled.
    fn chunk(
        &self,
        model: &Floor<Self>,
        rows: usize,
        observation: &Features<Tensor>,
        rng: Option<&mut Rng>,
    ) -> Result<Tensor>;

    /// Whether the simulator's own expert acts in its place.
    const SCRIPTED: bool = false;

    /// Takes in the demonstrations; nothing unless it remembers any.
    ///
    /// # Errors
    /// Demonstrations that it cannot do without.
    fn remember(&self, _model: &Floor<Self>, _train: &[Batch], _held_out: &[Batch]) -> Result<()> {
        Ok(())
    }

    /// A policy for one environment.
    fn policy(model: Arc<Floor<Self>>, preprocess: Arc<Preprocess>) -> Box<dyn Policy> {
        Box::new(ChunkPolicy::new(model, preprocess))
    }
}

/// A model of a rule.
#[derive(Debug)]
pub struct Floor<R> {
    rule: R,
    signature: Signature,
    params: Params,
}

impl<R: Rule> Floor<R> {
    /// # Errors
    /// A configuration or a signature that describes no possible policy.
    pub fn new(config: &R::Config, signature: &Signature, _seed: u64, backend: &Backend) -> Result<Self> {
        signature.check(R::NAME, READS)?;
        let mut params = Params::new(backend);
        let rule = R::new(config, signature, &mut params)?;
        Ok(Self { rule, signature: signature.clone(), params })
    }

    /// Chunks of one action repeated. action: rows*A values -> (rows, H, A)
    fn repeated(&self, rows: usize, action: Vec<f32>) -> Result<Tensor> {
        let (horizon, width) = (self.rule.action_horizon(), self.signature.action_dim);
        let action = Tensor::from_vec(action, (rows, 1, width), self.params.device())?;
        Ok(action.broadcast_as((rows, horizon, width))?.contiguous()?)
    }
}

impl<R: Rule> Memory for Floor<R> {
    fn remember(&self, train: &[Batch], held_out: &[Batch]) -> Result<()> {
        self.rule.remember(self, train, held_out)
    }
}

impl<R: Rule> PolicyModel for Floor<R> {
    fn params(&self) -> &Params {
        &self.params
    }

    fn signature(&self) -> &Signature {
        &self.signature
    }

    /// How far the demonstrations are from what it does; there is nothing to minimise.
    fn loss(&self, batch: &Batch, _rng: &mut Rng) -> Result<LossParts> {
        check_batch(R::NAME, &self.signature, self.action_horizon(), batch)?;
        let difference = (self.predict(&batch.observation)? - &batch.actions)?;
        let valid = (1.0 - batch.is_pad.unsqueeze(2)?)?;
        let entries = (batch.total_valid_steps * self.signature.action_dim).max(1) as f64;
        let l1 = (absolute(&difference)?.broadcast_mul(&valid)?.sum_all()? / entries)?;
        Ok(LossParts { total: l1.clone(), parts: BTreeMap::from([("l1_loss".to_string(), l1)]) })
    }

    fn accumulate_gradients(&self, batch: &Batch, rng: &mut Rng, _into: &mut Gradients) -> Result<LossNumbers> {
        Ok(LossNumbers::from(&self.loss(batch, rng)?))
    }

    fn predict(&self, observation: &Features<Tensor>) -> Result<Tensor> {
        let rows = check_observation(R::NAME, &self.signature, observation)?;
        self.rule.chunk(self, rows, observation, None)
    }

    fn sample(&self, observation: &Features<Tensor>, rng: &mut Rng) -> Result<Tensor> {
        let rows = check_observation(R::NAME, &self.signature, observation)?;
        self.rule.chunk(self, rows, observation, Some(rng))
    }

    fn policy(self: Arc<Self>, preprocess: Arc<Preprocess>, _clock: Box<dyn Clock>) -> Box<dyn Policy> {
        R::policy(self, preprocess)
    }

    fn memory(&self) -> Option<&dyn Memory> {
        Some(self)
    }

    fn is_scripted(&self) -> bool {
        R::SCRIPTED
    }

    fn action_horizon(&self) -> usize {
        self.rule.action_horizon()
    }
}

/// (n, …) each -> (n, everything of a row)
fn joined(rule: &'static str, signature: &Signature, rows: usize, observation: &Features<Tensor>) -> Result<Tensor> {
    let mut joined = Vec::with_capacity(signature.observation.len());
    for spec in &signature.observation {
        joined.push(observation.require(rule, &spec.name)?.reshape((rows, ()))?);
    }
    Ok(Tensor::cat(&joined, 1)?)
}

#[cfg(test)]
mod tests;
