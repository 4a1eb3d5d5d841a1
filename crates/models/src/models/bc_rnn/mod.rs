//! BC-RNN: an LSTM, or gated recurrent units, over the observations and a mixture of Gaussians over the action, of each step its own.
//!
//! Paper: Mandlekar et al., "What Matters in Learning from Offline Human Demonstrations for Robot Manipulation" (arXiv
//! 2108.03298). Reference implementation: robomimic 0.3's `BC_RNN_GMM` with the options of that study (two layers of 400, no
//! layers between LSTM and head, 5 Gaussians, tanh on their means, hardly any noise at test time); on fixtures made with it
//! this has its outputs, its loss and its gradients.
//!
//! At test time the state goes from step to step and begins anew every `action_horizon` steps, as robomimic's does every
//! `rnn.horizon`.
//!
//! Deviations: a sequence of training ends with a window's frame and is shorter at the beginning of an episode, where
//! robomimic's begins with a frame and repeats the last of the episode, both in the loss; a step has the same share in the
//! loss either way. Pictures become the cells of `[policy.vision]`'s feature map behind a step's numbers (robomimic: keypoints). No goals, no open loop. The means lie in -1 to 1, so that actions have to be normalised by their
//! range (`normalisation.action = "min_max"`).
//!
//! What it costs: one product a step and layer for the recurrence, one a layer for all that comes from below; the cell is by
//! hand (`layers/lstm.rs`; `layers/gru.rs` is composed).
//!
//! This file is the model as one reads it, on candle's autograd. Training steps run the same maths with hand-written backward
//! passes (`fused.rs`); tests hold the two together.

mod config;
mod fused;

pub use config::Config;

use crate::batch::Batch;
use crate::checks::{check_batch, check_observation};
use crate::encoders::VisionConfig;
use crate::features::{FeatureKind, Features, Observation, Signature};
use crate::fused::Workspaces;
use crate::layers::{Mixture, MixtureHead, Recurrent, RecurrentState, Steps};
use crate::model::{PolicyModel, autograd, not_by_hand};
use crate::policy::{ActionChunk, Clock, Policy};
use crate::preprocess::Preprocess;
use candle_core::Tensor;
use nn::Gradients;
use nn::Params;
use nn::Rng;
use nn::device::HERE;
use nn::losses::absolute;
use nn::{LossParts, LossValues};
use nn::{ModelError, Result};
use std::collections::BTreeMap;
use std::sync::Arc;

/// The kinds of features that it reads.
pub const READS: &[FeatureKind] =
    &[FeatureKind::State, FeatureKind::EnvironmentState, FeatureKind::Entity, FeatureKind::Image];

/// The model.
#[derive(Debug)]
pub struct BcRnn {
    config: Config,
    signature: Signature,
    params: Params,
    steps: Steps,
    rnn: Recurrent,
    head: MixtureHead,
    workspaces: Workspaces,
}

impl BcRnn {
    /// Initial weights are torch's defaults.
    ///
    /// # Errors
    /// A configuration or a signature that describes no possible model.
    pub fn new(config: &Config, signature: &Signature, seed: u64) -> Result<Self> {
        config.validate()?;
        signature.check("bc_rnn", READS)?;
        if config.action_horizon != signature.n_obs_steps {
            let (found, expected) =
                (config.action_horizon.to_string(), format!("n_obs_steps, {}", signature.n_obs_steps));
            return Err(ModelError::Config { model: "bc_rnn", field: "action_horizon", found, expected });
        }
        let rng = &mut Rng::new(seed, "init");
        let mut p = Params::new();
        let steps = Steps::new(&mut p, "bc_rnn", signature, config.vision.as_ref(), rng)?;
        let sizes = (steps.width(), config.hidden_dim, config.n_layers);
        let rnn = Recurrent::new(&mut p, "rnn", config.cell, sizes, rng)?;
        let sizes = (config.hidden_dim, config.n_modes, signature.action_dim);
        let head = MixtureHead::new(&mut p, "decoder", sizes, config.min_std, rng)?;
        Ok(Self {
            config: config.clone(),
            signature: signature.clone(),
            params: p,
            steps,
            rnn,
            head,
            workspaces: Workspaces::default(),
        })
    }

    /// x: (b, T, D), from the state before it -> b*T mixtures
    fn forward(&self, x: &Tensor, state: &mut RecurrentState) -> Result<Mixture> {
        let (b, steps, _) = x.dims3()?;
        let y = self.rnn.forward(x, state)?;
        self.head.forward(&y.reshape((b * steps, self.config.hidden_dim))?)
    }

    /// The mixtures of the signature's features, (b, T, …) each -> b*T mixtures
    ///
    /// # Errors
    /// An observation that does not fit.
    pub fn mixtures(&self, observation: &Features<Tensor>) -> Result<Mixture> {
        let rows = check_observation("bc_rnn", &self.signature, observation)?;
        self.forward(&self.steps.forward(rows, observation)?, &mut self.rnn.zero_state(rows)?)
    }
}

/// Which step of a row stands at place `step` once the padding that the row begins with is moved to its end, and 1 if it is real,
/// else 0. is_pad: (T)
fn beginnings(is_pad: &[f32], step: usize) -> (usize, f32) {
    let before = is_pad.iter().take_while(|&&p| p != 0.0).count();
    let at = (step + before).min(is_pad.len() - 1);
    (at, if step + before < is_pad.len() { 1.0 - is_pad[at] } else { 0.0 })
}

/// For every step of every row the one that takes its place once the padding that a row begins with is moved to its end,
/// and 1 if it is real, else 0. is_pad: (b, T) -> b*T indices, b*T weights
fn real_first(is_pad: &Tensor) -> Result<(Tensor, Tensor)> {
    let (rows, steps) = is_pad.dims2()?;
    let (mut from, mut real) = (Vec::with_capacity(rows * steps), Vec::with_capacity(rows * steps));
    for (row, pad) in is_pad.to_vec2::<f32>()?.iter().enumerate() {
        for step in 0..steps {
            let (at, is_real) = beginnings(pad, step);
            from.push((row * steps + at) as u32);
            real.push(is_real);
        }
    }
    let count = rows * steps;
    Ok((Tensor::from_vec(from, count, &HERE)?, Tensor::from_vec(real, count, &HERE)?))
}

impl PolicyModel for BcRnn {
    fn params(&self) -> &Params {
        &self.params
    }

    fn signature(&self) -> &Signature {
        &self.signature
    }

    fn composed_because(&self) -> Option<String> {
        not_by_hand(&self.signature)
    }

    fn accumulate_gradients(&self, batch: &Batch, rng: &mut Rng, into: &mut Gradients) -> Result<LossValues> {
        check_batch("bc_rnn", &self.signature, self.config.action_horizon, batch)?;
        match self.composed_because() {
            Some(_) => autograd(self, batch, rng, into),
            None => self.fused_gradients(&self.steps.looked_at(batch, rng)?, into),
        }
    }

    fn loss(&self, batch: &Batch, rng: &mut Rng) -> Result<LossParts> {
        check_batch("bc_rnn", &self.signature, self.config.action_horizon, batch)?;
        let batch = &self.steps.looked_at(batch, rng)?;
        let (rows, steps) = (batch.rows(), self.config.action_horizon);
        let (from, real) = real_first(&batch.is_pad)?;
        let moved = |x: &Tensor| -> Result<Tensor> {
            let width = x.dim(2)?;
            Ok(x.reshape((rows * steps, width))?.index_select(&from, 0)?)
        };
        let x = moved(&self.steps.forward(rows, &batch.observation)?)?;
        let actions = moved(&batch.actions)?;
        let mixtures = self.forward(&x.reshape((rows, steps, ()))?, &mut self.rnn.zero_state(rows)?)?;
        let valid = batch.total_valid_steps.max(1) as f64;
        let total = ((mixtures.log_prob(&actions)?.mul(&real)?.sum_all()? / valid)? * -1.0)?;
        // of the likeliest Gaussian's mean, beside what other policies report
        let away = absolute(&(mixtures.likeliest()?.detach() - &actions)?)?.broadcast_mul(&real.unsqueeze(1)?)?;
        let l1 = (away.sum_all()? / (valid * self.signature.action_dim as f64))?;
        let parts = BTreeMap::from([("nll".to_string(), total.detach()), ("l1_loss".to_string(), l1)]);
        Ok(LossParts { total, parts })
    }

    /// The mean of the likeliest Gaussian at every step.
    fn predict(&self, observation: &Features<Tensor>) -> Result<Tensor> {
        let actions = self.mixtures(observation)?.likeliest()?.detach();
        Ok(actions.reshape(((), self.config.action_horizon, self.signature.action_dim))?)
    }

    fn sample(&self, observation: &Features<Tensor>, rng: &mut Rng) -> Result<Tensor> {
        let actions = self.mixtures(observation)?.sample(rng)?.detach();
        Ok(actions.reshape(((), self.config.action_horizon, self.signature.action_dim))?)
    }

    fn policy(self: Arc<Self>, preprocess: Arc<Preprocess>, clock: Box<dyn Clock>) -> Box<dyn Policy> {
        Box::new(Carrying { model: self, preprocess, state: None, steps: 0, rng: generator(0), clock, encoding: None })
    }

    fn vision(&self) -> Option<&VisionConfig> {
        self.steps.vision()
    }

    fn action_horizon(&self) -> usize {
        self.config.action_horizon
    }
}

/// One episode of the policy: the state and how many steps it has seen.
struct Carrying {
    model: Arc<BcRnn>,
    preprocess: Arc<Preprocess>,
    state: Option<RecurrentState>,
    steps: usize,
    rng: Rng,
    clock: Box<dyn Clock>,
    /// until the last query's pictures were numbers, in milliseconds
    encoding: Option<f64>,
}

fn generator(seed: u64) -> Rng {
    Rng::new(seed, "policy")
}

impl Policy for Carrying {
    /// One action.
    fn predict(&mut self, observation: &Observation) -> Result<ActionChunk> {
        let (model, begun) = (&self.model, self.clock.milliseconds());
        let seen = self.preprocess.observation(std::slice::from_ref(observation))?;
        // the same observation as often as a history is long: its last
        let now = model.steps.last(&seen)?;
        self.encoding = model.vision().map(|_| self.clock.milliseconds() - begun);
        let mut state = match self.state.take() {
            Some(state) if !self.steps.is_multiple_of(model.config.action_horizon) => state,
            _ => model.rnn.zero_state(1)?,
        };
        let mixture = model.forward(&now, &mut state)?;
        state.iter_mut().flatten().for_each(|tensor| *tensor = tensor.detach());
        (self.state, self.steps) = (Some(state), self.steps + 1);
        self.preprocess.chunk(&mixture.sample(&mut self.rng)?.detach().unsqueeze(1)?)
    }

    fn encoding(&self) -> Option<f64> {
        self.encoding
    }

    fn reset(&mut self, seed: u64) {
        (self.state, self.steps, self.rng) = (None, 0, generator(seed));
    }
}

#[cfg(test)]
mod tests;
