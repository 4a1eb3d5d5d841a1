//! What the trainer, the zoo and the policies need of a model.

use crate::batch::Batch;
use crate::encoders::VisionConfig;
use crate::features::{Features, Signature};
use crate::policy::{Clock, Policy};
use crate::preprocess::Preprocess;
use candle_core::Tensor;
use nn::{Cache, Context, Gradients, Loss, LossNumbers, LossParts, ModelError, Params, Result, Rng};
use std::sync::Arc;

/// A model that maps observations to action chunks and can be trained on windows.
pub trait PolicyModel: Send + Sync {
    /// Its parameters.
    fn params(&self) -> &Params;

    /// What it is fed and what it gives.
    fn signature(&self) -> &Signature;

    /// Buffers of its passes and weights prepared for predictions, of a model that states its loss as [`Self::forward_loss`].
    fn cache(&self) -> Option<&Cache> {
        None
    }

    /// Training forward pass. Sums over the rows of `batch` are divided by `batch.total_rows` or `batch.total_valid_steps`, so
    /// that the losses of shards add up.
    ///
    /// # Errors
    /// A batch that does not fit.
    fn forward_loss(&self, _cx: &mut Context<'_>, _batch: &Batch) -> Result<Loss> {
        let (found, expected) = ("none".to_string(), "one on the operations of `nn`".to_string());
        Err(ModelError::Input { operation: "train", object: "loss", found, expected })
    }

    /// The loss on candle's operations, with their graph.
    ///
    /// # Errors
    /// As [`Self::forward_loss`].
    fn loss(&self, batch: &Batch, rng: &mut Rng) -> Result<LossParts> {
        let cache = Cache::default();
        let cache = self.cache().unwrap_or(&cache);
        cache.composed_loss(self.params(), Some(rng), |cx| self.forward_loss(cx, batch))
    }

    /// Loss, and its gradient added to `into`.
    ///
    /// # Errors
    /// `NoGradient` if the loss does not reach a parameter.
    fn accumulate_gradients(&self, batch: &Batch, rng: &mut Rng, into: &mut Gradients) -> Result<LossNumbers> {
        match self.cache() {
            Some(cache) => cache.step(self.params(), Some(rng), into, |cx| self.forward_loss(cx, batch)),
            None => autograd(self, batch, rng, into),
        }
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

    /// [`Self::sample`], and `on_seen` is called when images have become tokens, by a model that can tell.
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

    /// How it sees images, if it does.
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
) -> Result<LossNumbers> {
    let loss = model.loss(batch, rng)?;
    into.add_graph(model.params(), &loss.total.backward()?)?;
    Ok(LossNumbers::from(&loss))
}
