//! MIP, the minimal iterative policy: two steps of regression, the second of which looks at a first answer and learned to
//! correct a noisy one. Nothing is drawn at test time.
//!
//! Paper: Pan et al., "Much Ado About Noising: Dispelling the Myths of Generative Robotic Control" (arXiv 2512.01809). With
//! demonstrated actions a, noise z and t = `second_time` the network π is trained on
//! |π(o, 0, 0) - a|² + |π(o, t a + (1-t) z, t) - a|²; its answer is π(o, t a0, t) with a0 = π(o, 0, 0).
//!
//! The network is diffusion's (`models/diffusion/unet.rs`), which is shown 100 t as its step, and so is what a sequence
//! begins with. Deviations: written from the paper's equations, without its code to hold it to; the two steps are held to an
//! oracle in NumPy, the network to LeRobot's with diffusion. The loss is half the sum, so that it compares with one step's.

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
use crate::models::flow::between;
use crate::policy::{Clock, Policy};
use crate::preprocess::Preprocess;
use candle_core::{DType, Tensor};
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
pub struct Mip {
    config: Config,
    signature: Signature,
    params: Params,
    condition: Condition,
    unet: Unet,
    fused: FusedUnet,
}

/// A first answer from nothing and a second one that looks at it; `answer` is given what it looks at and the time.
pub(crate) fn two_steps(
    nothing: &Tensor,
    second_time: f32,
    answer: impl Fn(&Tensor, f32) -> Result<Tensor>,
) -> Result<Tensor> {
    let first = answer(nothing, 0.0)?;
    answer(&(first * f64::from(second_time))?, second_time)
}

impl Mip {
    /// Initial weights are torch's defaults.
    ///
    /// # Errors
    /// A configuration or a signature that describes no possible model.
    pub fn new(config: &Config, signature: &Signature, seed: u64) -> Result<Self> {
        config.validate()?;
        signature.check("mip", READS)?;
        check_reaches("mip", signature, config.action_horizon)?;
        let (mut p, rng) = (Params::new(), &mut Rng::new(seed, "init"));
        let condition = Condition::new(&mut p, "mip", signature, config.vision.as_ref(), rng)?;
        let dims = (signature.action_dim, condition.width());
        let unet = Unet::new(&mut p, "unet", dims, &config.network, rng)?;
        let fused = FusedUnet::new(&config.network, "unet", (config.action_horizon, signature.action_dim));
        Ok(Self { config: config.clone(), signature: signature.clone(), params: p, condition, unet, fused })
    }

    /// x: (b, H, A) -> the answer at this time, with a gradient
    fn answer(&self, cond: &Tensor, x: &Tensor, time: f32) -> Result<Tensor> {
        self.unet.forward(x, &vec![time * LAST_STEP; x.dim(0)?], cond)
    }

    /// The actions with the noise that the second step learns to take away.
    fn noisy(&self, batch: &Batch, rng: &mut Rng) -> Result<Tensor> {
        let noise = Tensor::from_vec(rng.normals(batch.actions.elem_count()), batch.actions.shape(), &HERE)?;
        between(&noise, &batch.actions, &vec![self.config.second_time as f32; batch.rows()])
    }

    fn nothing(&self, rows: usize) -> Result<Tensor> {
        let shape = (rows, self.config.action_horizon, self.signature.action_dim);
        Ok(Tensor::zeros(shape, DType::F32, &HERE)?)
    }
}

impl PolicyModel for Mip {
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
        check_batch("mip", &self.signature, self.config.action_horizon, batch)?;
        let batch = &self.condition.looked_at(batch, rng)?;
        let rows = batch.rows();
        let noisy = values(&self.noisy(batch, rng)?)?;
        let nothing = vec![0.0; noisy.len()];
        let [begun, later] = [0.0, self.config.second_time as f32].map(|time| vec![time * LAST_STEP; rows]);
        let wanted = || Wanted::of(&batch.actions, batch, self.config.mask_padding, 0.5);
        let parts = [(&nothing[..], &begun[..], wanted()?), (&noisy[..], &later[..], wanted()?)];
        let told = self.condition.told(rows, &batch.observation)?;
        let [first, second] = self.fused.squared_errors(&self.params, told, parts, into)?;
        let parts = [("first_l2_loss", first), ("second_l2_loss", second)];
        let parts = parts.map(|(name, value)| (name.to_string(), value as f32));
        Ok(LossValues { total: (0.5 * (first + second)) as f32, parts: BTreeMap::from(parts) })
    }

    fn loss(&self, batch: &Batch, rng: &mut Rng) -> Result<LossParts> {
        check_batch("mip", &self.signature, self.config.action_horizon, batch)?;
        let batch = &self.condition.looked_at(batch, rng)?;
        let rows = batch.rows();
        let cond = self.condition.forward(rows, &batch.observation)?;
        let (time, noisy) = (self.config.second_time as f32, self.noisy(batch, rng)?);
        let error = |answer: Tensor| squared_error(&answer, &batch.actions, batch, self.config.mask_padding);
        let first = error(self.answer(&cond, &self.nothing(rows)?, 0.0)?)?;
        let second = error(self.answer(&cond, &noisy, time)?)?;
        let parts = [("first_l2_loss", &first), ("second_l2_loss", &second)];
        let parts = parts.into_iter().map(|(name, part)| (name.to_string(), part.detach()));
        Ok(LossParts { parts: BTreeMap::from_iter(parts), total: ((first + second)? * 0.5)? })
    }

    fn predict(&self, observation: &Features<Tensor>) -> Result<Tensor> {
        self.sample_seen(observation, &mut Rng::new(0, "predict"), &mut || {})
    }

    /// Nothing is drawn.
    fn sample_seen(&self, observation: &Features<Tensor>, _rng: &mut Rng, on_seen: &mut dyn FnMut()) -> Result<Tensor> {
        let rows = check_observation("mip", &self.signature, observation)?;
        let cond = self.fused.seen(&self.params, rows, self.condition.told(rows, observation)?)?;
        if self.condition.vision().is_some() {
            on_seen();
        }
        two_steps(&self.nothing(rows)?, self.config.second_time as f32, |x, t| {
            self.fused.answered(&self.params, x, &vec![t * LAST_STEP; rows], &cond)
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
