//! Flow matching: actions are where a velocity field, looking at the observation, carries noise in a few Euler steps.
//!
//! Papers: Lipman et al., "Flow Matching for Generative Modeling" (arXiv 2210.02747), and the straight paths of Liu et al.,
//! "Flow Straight and Fast" (arXiv 2209.03003); in robotics Black et al., "π0" (arXiv 2410.24164). On the way from noise z at
//! time 0 to the demonstrated actions a at time 1, x = (1-t) z + t a, the network is trained to give the velocity a - z
//! (mean squared error, t even in 0 to 1). An action sequence is drawn by `inference_steps` Euler steps of the same length from
//! noise.
//!
//! The network is diffusion's (`models/diffusion/unet.rs`), which is shown 100 t as its step, and so is what a sequence
//! begins with. No implementation is taken for the reference: the sampler is held to an oracle in NumPy, the network to
//! LeRobot's with diffusion. Deviations: π0 draws t from a beta distribution and has a transformer.

mod config;

pub use crate::models::diffusion::READS;
pub use config::Config;

use crate::batch::Batch;
use crate::checks::{check_batch, check_observation};
use crate::chunk_policy::ChunkPolicy;
use crate::encoders::VisionConfig;
use crate::features::{Features, Signature};
use crate::model::PolicyModel;
use crate::models::diffusion::condition::Condition;
use crate::models::diffusion::fused::{FusedUnet, Wanted};
use crate::models::diffusion::unet::Unet;
use crate::models::diffusion::{check_reaches, squared_error, values};
use crate::policy::{Clock, Policy};
use crate::preprocess::Preprocess;
use candle_core::Tensor;
use nn::Gradients;
use nn::Params;
use nn::Result;
use nn::Rng;
use nn::device::HERE;
use nn::{LossParts, LossValues};
use std::collections::BTreeMap;
use std::sync::Arc;

/// What the network is shown at time 1.
const LAST_STEP: f32 = 100.0;

/// The model.
#[derive(Debug)]
pub struct Flow {
    config: Config,
    signature: Signature,
    params: Params,
    condition: Condition,
    unet: Unet,
    fused: FusedUnet,
}

/// What the network is shown of these times.
fn shown(times: &[f32]) -> Vec<f32> {
    times.iter().map(|t| t * LAST_STEP).collect()
}

/// From noise z at time 0 to actions a at time 1. z, a: (b, H, A), the time of each row -> (b, H, A)
pub(crate) fn between(z: &Tensor, a: &Tensor, times: &[f32]) -> Result<Tensor> {
    let t = Tensor::from_slice(times, (times.len(), 1, 1), &HERE)?;
    Ok((z.broadcast_mul(&(1.0 - &t)?)? + a.broadcast_mul(&t)?)?)
}

/// `steps` Euler steps along `velocity`, which is given x and the time.
pub(crate) fn euler(z: &Tensor, steps: usize, velocity: impl Fn(&Tensor, f32) -> Result<Tensor>) -> Result<Tensor> {
    let mut x = z.clone();
    for step in 0..steps {
        let v = velocity(&x, step as f32 / steps as f32)?;
        x = (x + (v / steps as f64)?)?;
    }
    Ok(x)
}

impl Flow {
    /// Initial weights are torch's defaults.
    ///
    /// # Errors
    /// A configuration or a signature that describes no possible model.
    pub fn new(config: &Config, signature: &Signature, seed: u64) -> Result<Self> {
        config.validate()?;
        signature.check("flow", READS)?;
        check_reaches("flow", signature, config.action_horizon)?;
        let (mut p, rng) = (Params::new(), &mut Rng::new(seed, "init"));
        let condition = Condition::new(&mut p, "flow", signature, config.vision.as_ref(), rng)?;
        let dims = (signature.action_dim, condition.width());
        let unet = Unet::new(&mut p, "unet", dims, &config.network, rng)?;
        let fused = FusedUnet::new(&config.network, "unet", (config.action_horizon, signature.action_dim));
        Ok(Self { config: config.clone(), signature: signature.clone(), params: p, condition, unet, fused })
    }

    /// x: (b, H, A), the time of each row -> the velocity there, with a gradient
    fn velocity(&self, cond: &Tensor, x: &Tensor, times: &[f32]) -> Result<Tensor> {
        self.unet.forward(x, &shown(times), cond)
    }

    /// What a training step draws: noise, (b, H, A), and the time of each row.
    fn drawn(&self, rows: usize, rng: &mut Rng) -> Result<(Tensor, Vec<f32>)> {
        let noise = self.noise(rows, rng)?;
        Ok((noise, (0..rows).map(|_| rng.uniform()).collect()))
    }

    fn noise(&self, rows: usize, rng: &mut Rng) -> Result<Tensor> {
        let shape = (rows, self.config.action_horizon, self.signature.action_dim);
        Ok(Tensor::from_vec(rng.normals(shape.0 * shape.1 * shape.2), shape, &HERE)?)
    }
}

impl PolicyModel for Flow {
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
        check_batch("flow", &self.signature, self.config.action_horizon, batch)?;
        let batch = &self.condition.looked_at(batch, rng)?;
        let rows = batch.rows();
        let (noise, times) = self.drawn(rows, rng)?;
        let x = values(&between(&noise, &batch.actions, &times)?)?;
        let wanted = Wanted::of(&(&batch.actions - &noise)?, batch, self.config.mask_padding, 1.0)?;
        let told = self.condition.told(rows, &batch.observation)?;
        let [loss] = self.fused.squared_errors(&self.params, told, [(&x, &shown(&times), wanted)], into)?;
        Ok(LossValues { total: loss as f32, parts: BTreeMap::from([("l2_loss".to_string(), loss as f32)]) })
    }

    fn loss(&self, batch: &Batch, rng: &mut Rng) -> Result<LossParts> {
        check_batch("flow", &self.signature, self.config.action_horizon, batch)?;
        let batch = &self.condition.looked_at(batch, rng)?;
        let rows = batch.rows();
        let cond = self.condition.forward(rows, &batch.observation)?;
        let (noise, times) = self.drawn(rows, rng)?;
        let velocity = self.velocity(&cond, &between(&noise, &batch.actions, &times)?, &times)?;
        let total = squared_error(&velocity, &(&batch.actions - &noise)?, batch, self.config.mask_padding)?;
        Ok(LossParts { parts: BTreeMap::from([("l2_loss".to_string(), total.detach())]), total })
    }

    /// Drawn with a generator that is always the same.
    fn predict(&self, observation: &Features<Tensor>) -> Result<Tensor> {
        self.sample(observation, &mut Rng::new(0, "predict"))
    }

    fn sample(&self, observation: &Features<Tensor>, rng: &mut Rng) -> Result<Tensor> {
        self.sample_seen(observation, rng, &mut || {})
    }

    fn sample_seen(&self, observation: &Features<Tensor>, rng: &mut Rng, on_seen: &mut dyn FnMut()) -> Result<Tensor> {
        let rows = check_observation("flow", &self.signature, observation)?;
        let cond = self.fused.seen(&self.params, rows, self.condition.told(rows, observation)?)?;
        if self.condition.vision().is_some() {
            on_seen();
        }
        euler(&self.noise(rows, rng)?, self.config.inference_steps, |x, t| {
            self.fused.answered(&self.params, x, &shown(&vec![t; rows]), &cond)
        })
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
