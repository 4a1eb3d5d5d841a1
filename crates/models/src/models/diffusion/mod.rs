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
//! The network is LeRobot's UNet or, with `[policy.transformer]`, Chi et al.'s transformer (`transformer.rs`), which LeRobot
//! does not have; it is held to their own code.
//!
//! `unet.rs` and `transformer.rs` are the readable forms; training steps and predictions run on `fused.rs` and
//! `transformer_fused.rs`, the same maths written out. `bench_policies` puts the UNet's beside LeRobot's. One step of DDIM starts at the least noisy timestep, as diffusers' spacing
//! `leading` has it: it is there for parity, not to act by.

pub(crate) mod condition;
mod config;
pub(crate) mod fused;
pub mod lerobot;
mod schedule;
mod transformer;
mod transformer_fused;
pub mod unet;

pub use config::{Config, Prediction, Sampler};
pub use schedule::NoiseSchedule;
pub use transformer::TransformerConfig;

use crate::batch::Batch;
use crate::checks::{check_batch, check_observation};
use crate::chunk_policy::ChunkPolicy;
use crate::encoders::VisionConfig;
use crate::features::{FeatureKind, Features, Signature};
use crate::layers::Mode;
use crate::model::PolicyModel;
use crate::policy::{Clock, Policy};
use crate::preprocess::Preprocess;
use candle_core::Tensor;
use condition::{Condition, Told};
use fused::{Asked, FusedUnet, Wanted};
use nn::Gradients;
use nn::Params;
use nn::Rng;
use nn::device::HERE;
use nn::values::with_values;
use nn::{LossParts, LossValues};
use nn::{ModelError, Result};
use std::collections::BTreeMap;
use std::sync::Arc;
use transformer::{Around, Transformer};
use transformer_fused::FusedTransformer;
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
    network: Network,
}

/// What takes the noise out, as one reads it and by hand.
#[allow(clippy::large_enum_variant)] // a model has one
#[derive(Debug)]
enum Network {
    Unet(Unet, FusedUnet),
    Transformer(Transformer, FusedTransformer),
}

impl Network {
    fn new(
        p: &mut Params,
        config: &Config,
        signature: &Signature,
        condition: &Condition,
        rng: &mut Rng,
    ) -> Result<Self> {
        let (horizon, action_dim, n_obs_steps) = (config.action_horizon, signature.action_dim, signature.n_obs_steps);
        if let Some(transformer) = &config.transformer {
            let around = Around { horizon, action_dim, n_obs_steps, width: condition.width() / n_obs_steps };
            let network = Transformer::new(p, around, transformer, rng)?;
            return Ok(Self::Transformer(network, FusedTransformer::new(transformer, around)));
        }
        let unet = Unet::new(p, "unet", (action_dim, condition.width()), &config.network, rng)?;
        Ok(Self::Unet(unet, FusedUnet::new(&config.network, "unet", (horizon, action_dim))))
    }

    /// x: (b, T, A), the step of each row, cond: (b, C) -> (b, T, A), with a gradient
    fn forward(&self, x: &Tensor, steps: &[f32], cond: &Tensor, mode: &mut Mode<'_>) -> Result<Tensor> {
        match self {
            Self::Unet(network, _) => network.forward(x, steps, cond),
            Self::Transformer(network, _) => network.forward(x, steps, cond, mode),
        }
    }

    /// The condition, (b, C), with what the cameras see.
    fn seen(&self, params: &Params, rows: usize, told: Told<'_>) -> Result<Vec<f32>> {
        match self {
            Self::Unet(_, fused) => fused.seen(params, rows, told),
            Self::Transformer(..) => Ok(told.numbers),
        }
    }

    /// The answer without a gradient, (b, T, A) -> (b, T, A)
    fn answered(&self, params: &Params, x: &Tensor, steps: &[f32], cond: &[f32]) -> Result<Tensor> {
        match self {
            Self::Unet(_, fused) => fused.answered(params, x, steps, cond),
            Self::Transformer(_, fused) => fused.answered(params, x, steps, cond),
        }
    }

    /// The mean squared error of the answer to x, (b, T, A), at these steps; gradients are added to `into`.
    fn squared_error(
        &self,
        params: &Params,
        told: Told<'_>,
        (x, steps, wanted): (&[f32], &[f32], Wanted),
        rng: &mut Rng,
        into: &mut Gradients,
    ) -> Result<f64> {
        match self {
            Self::Unet(_, fused) => {
                let [error] = fused.squared_errors(params, told, [(x, steps, wanted)], into)?;
                Ok(error)
            }
            Self::Transformer(_, fused) => {
                fused.squared_error(params, Asked { x, steps, cond: &told.numbers }, &wanted, rng, into)
            }
        }
    }
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
        let pictures: Vec<&str> = signature.of_kind(FeatureKind::Image).map(|spec| spec.name.as_str()).collect();
        if config.transformer.is_some() && !pictures.is_empty() {
            return Err(ModelError::Config {
                model: "diffusion",
                field: "transformer",
                found: format!("one beside {}", pictures.join(", ")),
                expected: "none where there are pictures, which it does not see".to_string(),
            });
        }
        check_reaches("diffusion", signature, config.action_horizon)?;
        let (mut p, rng) = (Params::new(), &mut Rng::new(seed, "init"));
        let condition = Condition::new(&mut p, "diffusion", signature, config.vision.as_ref(), rng)?;
        let network = Network::new(&mut p, config, signature, &condition, rng)?;
        let schedule = NoiseSchedule::new(config.num_train_timesteps);
        Ok(Self { config: config.clone(), signature: signature.clone(), params: p, condition, schedule, network })
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
        self.denoised(observation, x, steps, &mut Mode::Eval)
    }

    fn denoised(
        &self,
        observation: &Features<Tensor>,
        x: &Tensor,
        steps: &[u32],
        mode: &mut Mode<'_>,
    ) -> Result<Tensor> {
        let rows = check_observation("diffusion", &self.signature, observation)?;
        let cond = self.condition.forward(rows, observation)?;
        let steps: Vec<f32> = steps.iter().map(|&t| t as f32).collect();
        self.network.forward(x, &steps, &cond, mode)
    }

    /// The loss with this noise, (b, H, A), and these steps, one a row, without dropout.
    ///
    /// # Errors
    /// A batch that does not fit.
    pub fn loss_with(&self, batch: &Batch, noise: &Tensor, steps: &[u32]) -> Result<Tensor> {
        self.loss_in(batch, (noise, steps), &mut Mode::Eval)
    }

    fn loss_in(&self, batch: &Batch, (noise, steps): (&Tensor, &[u32]), mode: &mut Mode<'_>) -> Result<Tensor> {
        check_batch("diffusion", &self.signature, self.config.action_horizon, batch)?;
        let noisy = self.schedule.add_noise(&batch.actions, noise, steps)?;
        let output = self.denoised(&batch.observation, &noisy, steps, mode)?;
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
        let cond = self.network.seen(&self.params, rows, self.condition.told(rows, observation)?)?;
        if self.condition.vision().is_some() {
            on_seen();
        }
        let mut x = noise.clone();
        for step in self.schedule.visited(self.config.inference_steps) {
            let steps = vec![step as f32; rows];
            let output = self.network.answered(&self.params, &x, &steps, &cond)?;
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
        let loss = self.network.squared_error(&self.params, told, (&noisy, &steps, wanted), rng, into)?;
        Ok(LossValues { total: loss as f32, parts: BTreeMap::from([("l2_loss".to_string(), loss as f32)]) })
    }

    fn loss(&self, batch: &Batch, rng: &mut Rng) -> Result<LossParts> {
        let batch = &self.condition.looked_at(batch, rng)?;
        let (noise, steps) = self.drawn(batch.rows(), rng)?;
        let total = self.loss_in(batch, (&noise, &steps), &mut Mode::Train(rng))?;
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
