//! Diffusion policy: actions are drawn by taking the noise out of noise, step by step, looking at the observation.
//!
//! Paper: Chi et al., "Diffusion Policy: Visuomotor Policy Learning via Action Diffusion" (arXiv 2303.04137). Reference
//! implementation: LeRobot 0.6.1's `DiffusionPolicy`, of which this has the tensors' names and, on fixtures made with it, the
//! outputs, the loss and the gradients.
//!
//! Deviations: numbers are joined in the signature's order, entities among them, and before what the cameras see; images go
//! through `[policy.vision]`'s network and become its map's cells (Chi et al. and LeRobot: keypoints), of every step seen;
//! betas are those of the squared cosine only; actions are drawn with DDIM in 10 steps unless the configuration says otherwise (LeRobot: DDPM
//! in as many as were trained); every frame starts a window (LeRobot leaves out the last 7 of an episode). The moving average
//! of the weights is the trainer's (`train.ema_decay`), with one decay; Chi et al.'s grows, LeRobot has none.
//!
//! The network is LeRobot's UNet or, with `[policy.transformer]`, Chi et al.'s transformer (`denoising/transformer.rs`), which LeRobot
//! does not have; it is held to their own code.
//!
//! `bench_policies` puts the UNet's speed beside LeRobot's. One step of DDIM starts at the least noisy timestep, as diffusers'
//! spacing `leading` has it: it is there for parity, not to act by.

mod config;
pub mod lerobot;
mod schedule;

pub use super::denoising::{NetworkConfig, READS, TransformerConfig};
pub use config::{Config, Prediction, Sampler};
pub use schedule::NoiseSchedule;

use super::denoising::{Denoising, Method, Target, normals_like};
use crate::batch::Batch;
use crate::features::{Features, Signature};
use candle_core::Tensor;
use nn::{Backend, Result, Rng};

/// The model.
pub type Diffusion = Denoising<Noising>;

/// Noise is added in steps, and the network learns to take it out.
#[derive(Debug)]
pub struct Noising {
    config: Config,
    schedule: NoiseSchedule,
}

impl Noising {
    /// What the network is asked about actions with this noise, at the step of each row.
    fn target(&self, actions: &Tensor, noise: &Tensor, steps: &[u32]) -> Result<Target> {
        let wanted = match self.config.prediction {
            Prediction::Epsilon => noise.clone(),
            Prediction::Sample => actions.clone(),
        };
        let x = self.schedule.add_noise(actions, noise, steps)?;
        let steps = steps.iter().map(|&t| t as f32).collect();
        Ok(Target { name: "l2_loss", weight: 1.0, x, steps, wanted })
    }
}

impl Method for Noising {
    const NAME: &'static str = "diffusion";

    fn answers(&self) -> usize {
        self.config.inference_steps
    }

    fn targets(&self, rng: &mut Rng, actions: &Tensor) -> Result<Vec<Target>> {
        let noise = normals_like(actions, rng)?;
        let of = self.schedule.steps() as u64;
        let steps: Vec<u32> = (0..actions.dim(0)?).map(|_| rng.below(of) as u32).collect();
        Ok(vec![self.target(actions, &noise, &steps)?])
    }

    fn sample(
        &self,
        _: &Tensor,
        noise: &mut dyn FnMut() -> Result<Tensor>,
        answer: &mut dyn FnMut(&Tensor, f32) -> Result<Tensor>,
    ) -> Result<Tensor> {
        let mut x = noise()?;
        for step in self.schedule.visited(self.config.inference_steps) {
            let output = answer(&x, step as f32)?;
            x = self.schedule.back(&self.config, &x, &output, step, noise)?;
        }
        Ok(x)
    }
}

impl Diffusion {
    /// Initial weights are torch's defaults.
    ///
    /// # Errors
    /// A configuration or a signature that describes no possible model.
    pub fn new(config: &Config, signature: &Signature, seed: u64, backend: &Backend) -> Result<Self> {
        config.validate()?;
        let schedule = NoiseSchedule::new(config.num_train_timesteps);
        Self::build(Noising { config: config.clone(), schedule }, &config.setup(), signature, seed, backend)
    }

    /// The same model drawing its actions otherwise.
    ///
    /// # Errors
    /// More steps than there are.
    pub fn sampling(mut self, sampler: Sampler, inference_steps: usize) -> Result<Self> {
        let config = &mut self.method.config;
        (config.sampler, config.inference_steps) = (sampler, inference_steps);
        config.validate()?;
        Ok(self)
    }

    /// The loss with this noise, (b, H, A), and these steps, one a row, in operations of candle, without dropout.
    ///
    /// # Errors
    /// A batch that does not fit.
    pub fn loss_with(&self, batch: &Batch, noise: &Tensor, steps: &[u32]) -> Result<Tensor> {
        self.composed_loss_with(batch, &[self.method.target(&batch.actions, noise, steps)?])
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
        let mut first = Some(noise.clone());
        self.drawn_with(observation, &mut |_| first.take().map_or_else(&mut *drawn, Ok), &mut || {})
    }
}

#[cfg(test)]
mod tests;
