//! Diffusion policy: actions are drawn by taking the noise out of noise, step by step, looking at the observation.
//!
//! Paper: Chi et al., "Diffusion Policy: Visuomotor Policy Learning via Action Diffusion" (arXiv 2303.04137). Reference
//! implementation: LeRobot 0.6.1's `DiffusionPolicy`, of which this has the tensors' names and, on fixtures made with it, the
//! outputs, the loss and the gradients. As there a sequence of actions begins with that of the first observation seen; what
//! lies before the present one is not executed.
//!
//! Deviations: numbers are joined in the signature's order, entities among them, and before what the cameras see; pictures go
//! through `[policy.vision]`'s network and become its map's cells (Chi et al. and LeRobot: keypoints), of every step seen;
//! betas are those of the squared cosine only; actions are drawn with DDIM in 10 steps unless the configuration says otherwise (LeRobot: DDPM
//! in as many as were trained); every frame starts a window (LeRobot leaves out the last 7 of an episode). The moving average
//! of the weights is the trainer's (`train.ema_decay`), with one decay; Chi et al.'s grows, LeRobot has none.
//!
//! `unet.rs` is the readable form; training steps and predictions run on `fused.rs`, the same maths written out, which
//! `bench_policies` puts beside LeRobot's. One step of DDIM starts at the least noisy timestep, as diffusers' spacing
//! `leading` has it: it is there for parity, not to act by.

pub(crate) mod condition;
mod config;
pub(crate) mod fused;
pub mod lerobot;
mod schedule;
pub mod unet;

pub use config::{Config, Prediction, Sampler};
pub use schedule::NoiseSchedule;

use crate::batch::Batch;
use crate::checks::{check_batch, check_observation};
use crate::chunk_policy::ChunkPolicy;
use crate::device::HERE;
use crate::encoders::VisionConfig;
use crate::error::{ModelError, Result};
use crate::features::{FeatureKind, Features, Signature};
use crate::gradients::Gradients;
use crate::model::{LossParts, LossValues, PolicyModel};
use crate::params::Params;
use crate::policy::{Clock, Policy};
use crate::preprocess::Preprocess;
use crate::rng::Rng;
use crate::values::with_values;
use candle_core::Tensor;
use condition::Condition;
use fused::{FusedUnet, Wanted};
use std::collections::BTreeMap;
use std::sync::Arc;
use unet::Unet;

/// The kinds of features that it reads.
pub const READS: &[FeatureKind] =
    &[FeatureKind::State, FeatureKind::EnvironmentState, FeatureKind::Entity, FeatureKind::Image];

/// The model.
#[derive(Debug)]
pub struct Diffusion {
    config: Config,
    signature: Signature,
    params: Params,
    condition: Condition,
    schedule: NoiseSchedule,
    unet: Unet,
    fused: FusedUnet,
}

/// A tensor's numbers in order.
pub(crate) fn values(t: &Tensor) -> Result<Vec<f32>> {
    with_values(t, <[f32]>::to_vec)
}

impl Wanted {
    /// What [`squared_error`] holds an answer to. wanted: (b, H, A)
    pub(crate) fn of(wanted: &Tensor, batch: &Batch, masked: bool, share: f64) -> Result<Self> {
        let (_, horizon, width) = wanted.dims3()?;
        let counted = if masked { batch.total_valid_steps * width } else { batch.total_rows * horizon * width };
        let valid: Option<Vec<f32>> =
            masked.then(|| values(&batch.is_pad)).transpose()?.map(|pad| pad.iter().map(|pad| 1.0 - pad).collect());
        Ok(Self { values: values(wanted)?, valid, entries: counted.max(1) as f64, share })
    }
}

/// Checks that a sequence of actions reaches the present.
pub(crate) fn check_reaches(model: &'static str, signature: &Signature, action_horizon: usize) -> Result<()> {
    if action_horizon >= signature.n_obs_steps {
        return Ok(());
    }
    let (found, expected) = (action_horizon.to_string(), format!("at least n_obs_steps, {}", signature.n_obs_steps));
    Err(ModelError::Config { model, field: "action_horizon", found, expected })
}

/// The mean over what counts of squared differences. predicted, wanted: (b, H, A); with `masked` steps beyond an episode's
/// ends do not count.
pub(crate) fn squared_error(predicted: &Tensor, wanted: &Tensor, batch: &Batch, masked: bool) -> Result<Tensor> {
    let squares = (predicted - wanted)?.sqr()?;
    let (_, horizon, width) = squares.dims3()?;
    if masked {
        let valid = (1.0 - batch.is_pad.unsqueeze(2)?)?;
        let entries = (batch.total_valid_steps * width).max(1) as f64;
        return Ok((squares.broadcast_mul(&valid)?.sum_all()? / entries)?);
    }
    Ok((squares.sum_all()? / (batch.total_rows * horizon * width).max(1) as f64)?)
}

impl Diffusion {
    /// Initial weights are torch's defaults.
    ///
    /// # Errors
    /// A configuration or a signature that describes no possible model.
    pub fn new(config: &Config, signature: &Signature, seed: u64) -> Result<Self> {
        config.validate()?;
        signature.check("diffusion", READS)?;
        check_reaches("diffusion", signature, config.action_horizon)?;
        let (mut p, rng) = (Params::new(), &mut Rng::new(seed, "init"));
        let condition = Condition::new(&mut p, "diffusion", signature, config.vision.as_ref(), rng)?;
        let dims = (signature.action_dim, condition.width());
        let unet = Unet::new(&mut p, "unet", dims, &config.network, rng)?;
        let fused = FusedUnet::new(&config.network, "unet", (config.action_horizon, signature.action_dim));
        let schedule = NoiseSchedule::new(config.num_train_timesteps);
        Ok(Self { config: config.clone(), signature: signature.clone(), params: p, condition, schedule, unet, fused })
    }

    /// The same model drawing its actions otherwise.
    ///
    /// # Errors
    /// More steps than there are.
    pub fn sampling(mut self, sampler: Sampler, inference_steps: usize) -> Result<Self> {
        (self.config.sampler, self.config.inference_steps) = (sampler, inference_steps);
        self.config.validate()?;
        Ok(self)
    }

    /// What the network gives, in operations of candle, with a gradient. x: (b, H, A), the step of each row -> (b, H, A)
    ///
    /// # Errors
    /// An observation that does not fit.
    pub fn denoise(&self, observation: &Features<Tensor>, x: &Tensor, steps: &[u32]) -> Result<Tensor> {
        let rows = check_observation("diffusion", &self.signature, observation)?;
        let cond = self.condition.forward(rows, observation)?;
        let steps: Vec<f32> = steps.iter().map(|&t| t as f32).collect();
        self.unet.forward(x, &steps, &cond)
    }

    /// The loss with this noise, (b, H, A), and these steps, one a row.
    ///
    /// # Errors
    /// A batch that does not fit.
    pub fn loss_with(&self, batch: &Batch, noise: &Tensor, steps: &[u32]) -> Result<Tensor> {
        check_batch("diffusion", &self.signature, self.config.action_horizon, batch)?;
        let noisy = self.schedule.add_noise(&batch.actions, noise, steps)?;
        let output = self.denoise(&batch.observation, &noisy, steps)?;
        let wanted = match self.config.prediction {
            Prediction::Epsilon => noise,
            Prediction::Sample => &batch.actions,
        };
        squared_error(&output, wanted, batch, self.config.mask_padding)
    }

    /// Actions from this noise, (b, H, A) -> (b, H, A); `drawn` gives more of it, which only DDPM asks for.
    ///
    /// # Errors
    /// An observation that does not fit.
    pub fn sample_from(
        &self,
        observation: &Features<Tensor>,
        noise: &Tensor,
        drawn: &mut dyn FnMut() -> Result<Tensor>,
    ) -> Result<Tensor> {
        self.sample_and_tell(observation, noise, drawn, &mut || {})
    }

    /// [`Self::sample_from`], and `on_seen` is called when the observation was seen.
    fn sample_and_tell(
        &self,
        observation: &Features<Tensor>,
        noise: &Tensor,
        drawn: &mut dyn FnMut() -> Result<Tensor>,
        on_seen: &mut dyn FnMut(),
    ) -> Result<Tensor> {
        let rows = check_observation("diffusion", &self.signature, observation)?;
        let cond = self.fused.seen(&self.params, rows, self.condition.told(rows, observation)?)?;
        if self.condition.vision().is_some() {
            on_seen();
        }
        let mut x = noise.clone();
        for step in self.schedule.visited(self.config.inference_steps) {
            let steps = vec![step as f32; rows];
            let output = self.fused.answered(&self.params, &x, &steps, &cond)?;
            x = self.schedule.back(&self.config, &x, &output, step, drawn)?;
        }
        Ok(x)
    }

    /// What a training step draws: noise, (b, H, A), and the step of each row.
    fn drawn(&self, rows: usize, rng: &mut Rng) -> Result<(Tensor, Vec<u32>)> {
        let noise = self.noise(rows, rng)?;
        Ok((noise, (0..rows).map(|_| rng.below(self.schedule.steps() as u64) as u32).collect()))
    }

    fn noise(&self, rows: usize, rng: &mut Rng) -> Result<Tensor> {
        let shape = (rows, self.config.action_horizon, self.signature.action_dim);
        Ok(Tensor::from_vec(rng.normals(shape.0 * shape.1 * shape.2), shape, &HERE)?)
    }
}

impl PolicyModel for Diffusion {
    fn params(&self) -> &Params {
        &self.params
    }

    fn signature(&self) -> &Signature {
        &self.signature
    }

    fn composed_because(&self) -> Option<String> {
        None
    }

    fn accumulate_gradients(&self, batch: &Batch, rng: &mut Rng, into: &mut Gradients) -> Result<LossValues> {
        check_batch("diffusion", &self.signature, self.config.action_horizon, batch)?;
        let batch = &self.condition.looked_at(batch, rng)?;
        let rows = batch.rows();
        let (noise, steps) = self.drawn(rows, rng)?;
        let noisy = values(&self.schedule.add_noise(&batch.actions, &noise, &steps)?)?;
        let told = self.condition.told(rows, &batch.observation)?;
        let steps: Vec<f32> = steps.iter().map(|&t| t as f32).collect();
        let wanted = match self.config.prediction {
            Prediction::Epsilon => &noise,
            Prediction::Sample => &batch.actions,
        };
        let wanted = Wanted::of(wanted, batch, self.config.mask_padding, 1.0)?;
        let [loss] = self.fused.squared_errors(&self.params, told, [(&noisy, &steps, wanted)], into)?;
        Ok(LossValues { total: loss as f32, parts: BTreeMap::from([("l2_loss".to_string(), loss as f32)]) })
    }

    fn loss(&self, batch: &Batch, rng: &mut Rng) -> Result<LossParts> {
        let batch = &self.condition.looked_at(batch, rng)?;
        let (noise, steps) = self.drawn(batch.rows(), rng)?;
        let total = self.loss_with(batch, &noise, &steps)?;
        Ok(LossParts { parts: BTreeMap::from([("l2_loss".to_string(), total.detach())]), total })
    }

    /// Drawn with a generator that is always the same.
    fn predict(&self, observation: &Features<Tensor>) -> Result<Tensor> {
        self.sample(observation, &mut Rng::new(0, "predict"))
    }

    fn sample(&self, observation: &Features<Tensor>, rng: &mut Rng) -> Result<Tensor> {
        let rows = check_observation("diffusion", &self.signature, observation)?;
        let noise = self.noise(rows, rng)?;
        self.sample_from(observation, &noise, &mut || self.noise(rows, rng))
    }

    fn sample_seen(&self, observation: &Features<Tensor>, rng: &mut Rng, on_seen: &mut dyn FnMut()) -> Result<Tensor> {
        let rows = check_observation("diffusion", &self.signature, observation)?;
        let noise = self.noise(rows, rng)?;
        self.sample_and_tell(observation, &noise, &mut || self.noise(rows, rng), on_seen)
    }

    fn policy(self: Arc<Self>, preprocess: Arc<Preprocess>, clock: Box<dyn Clock>) -> Box<dyn Policy> {
        let past = self.signature.n_obs_steps - 1;
        Box::new(ChunkPolicy::new(self, preprocess).without_past(past).with_clock(clock))
    }

    fn vision(&self) -> Option<&VisionConfig> {
        self.condition.vision()
    }

    fn action_horizon(&self) -> usize {
        self.config.action_horizon
    }
}

#[cfg(test)]
mod tests;
