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
//! loss either way. Images become the cells of `[policy.vision]`'s feature map behind a step's numbers (robomimic: keypoints). No goals, no open loop. The means lie in -1 to 1, so that actions have to be normalised by their
//! range (`normalisation.action = "min_max"`).
//!
//! What it costs: one product a step and layer for the recurrence, one a layer for all that comes from below.

mod config;

pub use config::Config;

use crate::batch::Batch;
use crate::checks::{check_batch, check_observation};
use crate::encoders::VisionConfig;
use crate::features::{FeatureKind, Features, Observation, Signature};
use crate::layers::{Mixture, MixtureHead, MixtureParts, Recurrent, RecurrentState, Steps};
use crate::model::PolicyModel;
use crate::policy::{ActionChunk, Clock, Policy};
use crate::preprocess::Preprocess;
use candle_core::Tensor;
use nn::ops::{mixture_likelihood, select_tokens};
use nn::{Backend, Cache, Context, Loss, ModelError, Params, Result, Rng, Value};
use std::borrow::Cow;
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
    cache: Cache,
}

impl BcRnn {
    /// Initial weights are torch's defaults.
    ///
    /// # Errors
    /// A configuration or a signature that describes no possible model.
    pub fn new(config: &Config, signature: &Signature, seed: u64, backend: &Backend) -> Result<Self> {
        config.validate()?;
        signature.check("bc_rnn", READS)?;
        if config.action_horizon != signature.n_obs_steps {
            let (found, expected) =
                (config.action_horizon.to_string(), format!("n_obs_steps, {}", signature.n_obs_steps));
            return Err(ModelError::Config { model: "bc_rnn", field: "action_horizon", found, expected });
        }
        let rng = &mut Rng::new(seed, "init");
        let mut p = Params::new(backend);
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
            cache: Cache::default(),
        })
    }

    /// x: (T, b, D), step by step -> T*b mixtures. A prediction may go on from a state.
    fn forward(&self, cx: &mut Context<'_>, x: &Value, state: Option<&mut RecurrentState>) -> Result<MixtureParts> {
        let (steps, b, _) = x.dims3()?;
        let y = self.rnn.apply(cx, x, state)?;
        self.head.apply(cx, &y.reshape((steps * b, self.config.hidden_dim))?)
    }

    /// The signature's features, (b, T, …) each, images as the network reads them, in this order of all steps of all rows -> as
    /// many mixtures. The order is step by step.
    fn in_order(
        &self,
        cx: &mut Context<'_>,
        rows: usize,
        observation: &Features<Tensor>,
        order: &[usize],
    ) -> Result<MixtureParts> {
        let (steps, width) = (self.config.action_horizon, self.steps.width());
        let x = self.steps.apply(cx, rows, observation)?.reshape((1, rows * steps, width))?;
        let x = select_tokens(cx, &x, order)?.reshape((steps, rows, width))?;
        self.forward(cx, &x, None)
    }

    /// The mixtures of the signature's features, (b, T, …) each -> b*T mixtures
    ///
    /// # Errors
    /// An observation that does not fit.
    pub fn mixtures(&self, observation: &Features<Tensor>) -> Result<Mixture> {
        let rows = check_observation("bc_rnn", &self.signature, observation)?;
        let observation = self.steps.prepare(observation, None)?;
        let steps = self.config.action_horizon;
        let by_step: Vec<usize> = (0..steps).flat_map(|step| (0..rows).map(move |row| row * steps + step)).collect();
        let mixtures = self
            .cache
            .predict(&self.params, &mut || {}, |cx| self.in_order(cx, rows, &observation, &by_step)?.mixture())?;
        // row by row again
        let by_row = |x: &Tensor| -> Result<Tensor> {
            let rest = x.dims()[1..].to_vec();
            let (apart, together) = ([&[steps, rows], &rest[..]].concat(), [&[rows * steps], &rest[..]].concat());
            Ok(x.reshape(apart)?.transpose(0, 1)?.contiguous()?.reshape(together)?)
        };
        Ok(Mixture {
            means: by_row(&mixtures.means)?,
            scales: by_row(&mixtures.scales)?,
            logits: by_row(&mixtures.logits)?,
        })
    }
}

/// Which step of a row stands at place `step` once the padding that the row begins with is moved to its end, and 1 if it is real,
/// else 0. is_pad: (T)
fn beginnings(is_pad: &[f32], step: usize) -> (usize, f32) {
    let before = is_pad.iter().take_while(|&&p| p != 0.0).count();
    let at = (step + before).min(is_pad.len() - 1);
    (at, if step + before < is_pad.len() { 1.0 - is_pad[at] } else { 0.0 })
}

/// For every step of every row, step by step, the one that takes its place once the padding that a row begins with is moved to its
/// end, counted row by row, and 1 if it is real, else 0.
fn real_first(batch: &Batch) -> Result<(Vec<usize>, Vec<f32>)> {
    let pads = match &batch.padding {
        Some(pads) => Cow::Borrowed(pads),
        None => Cow::Owned(batch.is_pad.flatten_all()?.to_vec1::<f32>()?),
    };
    let steps = batch.is_pad.dim(1)?;
    let rows = || pads.chunks_exact(steps).enumerate();
    let each = (0..steps).flat_map(|step| rows().map(move |(row, pad)| (row, beginnings(pad, step))));
    Ok(each.map(|(row, (at, real))| (row * steps + at, real)).unzip())
}

impl PolicyModel for BcRnn {
    fn params(&self) -> &Params {
        &self.params
    }

    fn signature(&self) -> &Signature {
        &self.signature
    }

    fn cache(&self) -> Option<&Cache> {
        Some(&self.cache)
    }

    fn forward_loss(&self, cx: &mut Context<'_>, batch: &Batch) -> Result<Loss> {
        check_batch("bc_rnn", &self.signature, self.config.action_horizon, batch)?;
        let observation = self.steps.prepare(&batch.observation, Some(cx.rng()?))?;
        let (from, real) = real_first(batch)?;
        let mixtures = self.in_order(cx, batch.rows(), &observation, &from)?;
        let count = from.len();
        let from = from.into_iter().map(|at| at as u32).collect::<Vec<_>>();
        let from = Tensor::from_vec(from, count, batch.device())?;
        let actions = batch.actions.flatten(0, 1)?.index_select(&from, 0)?;
        let real = Tensor::from_vec(real, count, batch.device())?;
        let (nll, l1) = mixture_likelihood(cx, &mixtures, (&actions, &real), batch.total_valid_steps)?;
        let mut loss = Loss::default();
        loss.add("nll", nll, 1.0);
        loss.report("l1_loss", l1);
        Ok(loss)
    }

    /// The mean of the likeliest Gaussian at every step.
    fn predict(&self, observation: &Features<Tensor>) -> Result<Tensor> {
        let actions = self.mixtures(observation)?.likeliest()?;
        Ok(actions.reshape(((), self.config.action_horizon, self.signature.action_dim))?)
    }

    fn sample(&self, observation: &Features<Tensor>, rng: &mut Rng) -> Result<Tensor> {
        let actions = self.mixtures(observation)?.sample(rng)?;
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
    /// until the last query's images were numbers, in milliseconds
    encoding: Option<f64>,
}

fn generator(seed: u64) -> Rng {
    Rng::new(seed, "policy")
}

impl Policy for Carrying {
    /// One action.
    fn predict(&mut self, observation: &Observation) -> Result<ActionChunk> {
        let (model, clock) = (&self.model, &mut self.clock);
        let (begun, mut encoding) = (clock.milliseconds(), None);
        let seen = self.preprocess.observation(std::slice::from_ref(observation))?;
        let mut state = match self.state.take() {
            Some(state) if !self.steps.is_multiple_of(model.config.action_horizon) => state,
            _ => RecurrentState::new(),
        };
        let mut on_seen = || encoding = Some(clock.milliseconds() - begun);
        let mixture = model.cache.predict(&model.params, &mut on_seen, |cx| {
            // the same observation as often as a history is long: its last
            let now = model.steps.apply_to_last(cx, &seen)?;
            model.forward(cx, &now, Some(&mut state))?.mixture()
        })?;
        (self.state, self.steps, self.encoding) = (Some(state), self.steps + 1, encoding);
        self.preprocess.chunk(&mixture.sample(&mut self.rng)?.unsqueeze(1)?)
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
