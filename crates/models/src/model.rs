//! What the trainer, the zoo and the policies need of a model.

use crate::batch::Batch;
use crate::encoders::VisionConfig;
use crate::error::{ModelError, Result};
use crate::features::{Features, Signature};
use crate::gradients::Gradients;
use crate::params::Params;
use crate::policy::{Clock, Policy};
use crate::preprocess::Preprocess;
use crate::rng::Rng;
use candle_core::Tensor;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::Arc;

/// A loss and the parts it is made of, each averaged over the whole batch.
#[derive(Debug, Clone)]
pub struct LossParts {
    /// scalar, differentiable
    pub total: Tensor,
    /// scalars for the metrics, for example `l1_loss`
    pub parts: BTreeMap<String, Tensor>,
}

/// A loss as numbers.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct LossValues {
    /// what is minimised
    pub total: f32,
    /// the parts
    pub parts: BTreeMap<String, f32>,
}

impl LossValues {
    /// Reads the scalars.
    pub fn from_parts(parts: &LossParts) -> Result<Self> {
        let mut values = BTreeMap::new();
        for (name, tensor) in &parts.parts {
            values.insert(name.clone(), tensor.to_scalar::<f32>()?);
        }
        Ok(Self { total: parts.total.to_scalar::<f32>()?, parts: values })
    }

    /// Adds another shard's.
    pub fn add(&mut self, other: &Self) {
        self.total += other.total;
        for (name, value) in &other.parts {
            *self.parts.entry(name.clone()).or_default() += value;
        }
    }

    /// Divides by `n`.
    pub fn scale(&mut self, factor: f32) {
        self.total *= factor;
        self.parts.values_mut().for_each(|v| *v *= factor);
    }
}

/// A model that maps observations to action chunks and can be trained on windows.
pub trait PolicyModel: Send + Sync {
    /// Its parameters.
    fn params(&self) -> &Params;

    /// What it is fed and what it gives.
    fn signature(&self) -> &Signature;

    /// Why its training step runs on candle's autograd; `None` where a step by hand covers it.
    fn composed_because(&self) -> Option<String>;

    /// Training forward pass. Sums over the rows of `batch` are divided by `batch.total_rows` or
    /// `batch.total_valid_steps`, so that the losses of shards add up.
    fn loss(&self, batch: &Batch, rng: &mut Rng) -> Result<LossParts>;

    /// Loss, and its gradient added to `into`. The default runs candle's backward pass over `loss`.
    ///
    /// # Errors
    /// `NoGradient` if the loss does not reach a parameter.
    fn accumulate_gradients(&self, batch: &Batch, rng: &mut Rng, into: &mut Gradients) -> Result<LossValues> {
        autograd(self, batch, rng, into)
    }

    /// The signature's features, (b, …) each -> (b, action_horizon, A), all in network units
    fn predict(&self, observation: &Features<Tensor>) -> Result<Tensor>;

    /// [`Self::predict`] with a generator, for models that draw their actions; the others predict.
    ///
    /// # Errors
    /// As [`Self::predict`].
    fn sample(&self, observation: &Features<Tensor>, _rng: &mut Rng) -> Result<Tensor> {
        self.predict(observation)
    }

    /// [`Self::sample`], and `on_seen` is called when pictures have become tokens, by a model that can tell.
    ///
    /// # Errors
    /// As [`Self::predict`].
    fn sample_seen(&self, observation: &Features<Tensor>, rng: &mut Rng, _on_seen: &mut dyn FnMut()) -> Result<Tensor> {
        self.sample(observation, rng)
    }

    /// A policy for one environment: it shares the weights, its episode's state is its own.
    fn policy(self: Arc<Self>, preprocess: Arc<Preprocess>, clock: Box<dyn Clock>) -> Box<dyn Policy>;

    /// Whether what its policies do depends on how long they take: the same episode may then end otherwise next time.
    fn depends_on_time(&self) -> bool {
        false
    }

    /// Floating-point operations of the matrix products of one query, thinking for as long as it may; `None` where nobody
    /// counts them.
    fn query_flops(&self) -> Option<f64> {
        None
    }

    /// Number of actions in a predicted chunk.
    fn action_horizon(&self) -> usize;

    /// What it keeps of the demonstrations themselves, if it keeps any.
    fn memory(&self) -> Option<&dyn Memory> {
        None
    }

    /// Whether the simulator's own scripted expert acts in its place: then nothing that it predicts is executed.
    fn is_scripted(&self) -> bool {
        false
    }

    /// How it sees pictures, if it does.
    fn vision(&self) -> Option<&VisionConfig> {
        None
    }
}

/// A model that keeps demonstrations, not only what it learned from them.
pub trait Memory {
    /// Takes them in before the training begins: of each episode a batch with all its windows in order of time.
    ///
    /// # Errors
    /// Demonstrations that it cannot do without.
    fn remember(&self, train: &[Batch], held_out: &[Batch]) -> Result<()>;
}

/// Loss, and its gradient from candle's backward pass added to `into`.
pub(crate) fn autograd<M: PolicyModel + ?Sized>(
    model: &M,
    batch: &Batch,
    rng: &mut Rng,
    into: &mut Gradients,
) -> Result<LossValues> {
    let loss = model.loss(batch, rng)?;
    let grads = loss.total.backward()?;
    for (name, var) in model.params().iter() {
        let grad = grads.get(var).ok_or_else(|| ModelError::NoGradient { name: name.to_string() })?;
        into.add_tensor(name, grad)?;
    }
    LossValues::from_parts(&loss)
}

/// Words for a feature that no step by hand covers.
pub(crate) fn not_by_hand(signature: &Signature) -> Option<String> {
    let spec = crate::fused::uncovered(signature)?;
    Some(format!("the step by hand does not cover feature {} of kind {}", spec.name, spec.kind))
}
