//! Policies that draw a sequence of actions with a network that looks at the observation and at actions that are not finished:
//! diffusion, flow matching and MIP. They differ in what the network learns and in how it is used ([`Method`]).
//!
//! A sequence of actions begins with that of the first observation seen; what lies before the present one is not executed.

mod condition;
mod transformer;
mod unet;

pub use transformer::TransformerConfig;
pub use unet::NetworkConfig;

use crate::batch::Batch;
use crate::checks::{check_batch, check_observation};
use crate::chunk_policy::ChunkPolicy;
use crate::encoders::VisionConfig;
use crate::features::{FeatureKind, Features, Signature};
use crate::layers::ask;
use crate::model::PolicyModel;
use crate::policy::{Clock, Policy};
use crate::preprocess::Preprocess;
use candle_core::{DType, Tensor};
use condition::Condition;
use nn::ops::{Error, chunk_error};
use nn::{Backend, Cache, Context, Loss, ModelError, Params, Result, Rng, Size, Value};
use std::fmt::Debug;
use std::sync::Arc;
use transformer::{Around, Transformer};
use unet::Unet;

/// The kinds of features that they read.
pub const READS: &[FeatureKind] =
    &[FeatureKind::State, FeatureKind::EnvironmentState, FeatureKind::Entity, FeatureKind::Image];

/// What the network learns, and how actions are drawn with it.
pub trait Method: Debug + Send + Sync + 'static {
    /// Name of the policy.
    const NAME: &'static str;

    /// Answers of the network that an action sequence takes.
    fn answers(&self) -> usize;

    /// What a training step asks of the network. actions: (b, H, A)
    ///
    /// # Errors
    /// If the tensor library fails.
    fn targets(&self, rng: &mut Rng, actions: &Tensor) -> Result<Vec<Target>>;

    /// Actions, (b, H, A). `zeros` has their shape, `noise` draws normal numbers of that shape; `answer` is the network's at a
    /// step.
    ///
    /// # Errors
    /// Those of the functions.
    fn sample(
        &self,
        zeros: &Tensor,
        noise: &mut dyn FnMut() -> Result<Tensor>,
        answer: &mut dyn FnMut(&Tensor, f32) -> Result<Tensor>,
    ) -> Result<Tensor>;
}

/// A question to the network, and what its answer is held to by the mean squared error.
#[derive(Debug)]
pub struct Target {
    /// of the part of the loss
    pub name: &'static str,
    /// of the part in the loss
    pub weight: f64,
    /// what the network looks at, (b, H, A)
    pub x: Tensor,
    /// the step of each row
    pub steps: Vec<f32>,
    /// (b, H, A)
    pub wanted: Tensor,
}

/// Normal numbers of a tensor's shape.
///
/// # Errors
/// If the tensor library fails.
pub(crate) fn normals_like(tensor: &Tensor, rng: &mut Rng) -> Result<Tensor> {
    Ok(Tensor::from_vec(rng.normals(tensor.elem_count()), tensor.shape(), tensor.device())?)
}

/// From noise z at time 0 to actions a at time 1. z, a: (b, H, A), the time of each row -> (b, H, A)
pub(crate) fn between(z: &Tensor, a: &Tensor, times: &[f32]) -> Result<Tensor> {
    let t = Tensor::from_slice(times, (times.len(), 1, 1), z.device())?;
    Ok((z.broadcast_mul(&(1.0 - &t)?)? + a.broadcast_mul(&t)?)?)
}

/// What a configuration says of the network.
#[derive(Debug)]
pub(crate) struct Setup<'a> {
    pub(crate) action_horizon: usize,
    pub(crate) network: &'a NetworkConfig,
    /// in the place of the UNet
    pub(crate) transformer: Option<&'a TransformerConfig>,
    pub(crate) mask_padding: bool,
    pub(crate) vision: Option<&'a VisionConfig>,
}

impl Setup<'_> {
    /// How large the network will be, without what depends on observation and action.
    pub(crate) fn size(&self) -> Size {
        match self.transformer {
            Some(transformer) => transformer.size(self.action_horizon),
            None => self.network.size(self.action_horizon),
        }
    }

    /// # Errors
    /// The first field that makes it impossible.
    pub(crate) fn validate(&self, model: &'static str) -> Result<()> {
        match self.transformer {
            Some(_) if self.vision.is_some() => {
                let (found, expected) =
                    ("given".to_string(), "none with a transformer, which sees no images".to_string());
                Err(ModelError::Config { model, field: "vision", found, expected })
            }
            Some(transformer) => transformer.validate(model, self.action_horizon),
            None => self.network.validate(model, self.action_horizon),
        }
    }
}

#[allow(clippy::large_enum_variant)] // a model has one
#[derive(Debug)]
enum Network {
    Unet(Unet),
    Transformer(Transformer),
}

/// A policy that draws its actions so.
#[derive(Debug)]
pub struct Denoising<M> {
    pub(crate) method: M,
    action_horizon: usize,
    mask_padding: bool,
    signature: Signature,
    params: Params,
    condition: Condition,
    network: Network,
    cache: Cache,
}

impl<M: Method> Denoising<M> {
    /// Initial weights are torch's defaults; the configuration was validated.
    pub(crate) fn build(
        method: M,
        setup: &Setup<'_>,
        signature: &Signature,
        seed: u64,
        backend: &Backend,
    ) -> Result<Self> {
        signature.check(M::NAME, READS)?;
        let refuse = |field, found, expected| Err(ModelError::Config { model: M::NAME, field, found, expected });
        let images: Vec<&str> = signature.of_kind(FeatureKind::Image).map(|spec| spec.name.as_str()).collect();
        if setup.transformer.is_some() && !images.is_empty() {
            let expected = "none where there are images, which it does not see".to_string();
            return refuse("transformer", format!("one beside {}", images.join(", ")), expected);
        }
        let (horizon, n_obs_steps, action_dim) = (setup.action_horizon, signature.n_obs_steps, signature.action_dim);
        if horizon < n_obs_steps {
            return refuse("action_horizon", horizon.to_string(), format!("at least n_obs_steps, {n_obs_steps}"));
        }
        let (mut p, rng) = (Params::new(backend), &mut Rng::new(seed, "init"));
        let condition = Condition::new(&mut p, (M::NAME, signature), setup.vision, setup.transformer, rng)?;
        let (parts, width) = condition.parts();
        let network = match setup.transformer {
            Some(transformer) => {
                let around = Around { horizon, action_dim, parts, width };
                Network::Transformer(Transformer::new(&mut p, around, transformer, rng)?)
            }
            None => Network::Unet(Unet::new(&mut p, "unet", (action_dim, parts * width), setup.network, rng)?),
        };
        Ok(Self {
            method,
            action_horizon: horizon,
            mask_padding: setup.mask_padding,
            signature: signature.clone(),
            params: p,
            condition,
            network,
            cache: Cache::default(),
        })
    }

    /// x: (b, H, A), the step of each row, cond: (b, C) -> (b, H, A)
    fn answer(&self, cx: &mut Context<'_>, x: &Tensor, steps: &[f32], cond: &Value) -> Result<Value> {
        let x = Value::from(&x.contiguous()?);
        match &self.network {
            Network::Unet(network) => network.apply(cx, &x, steps, cond),
            Network::Transformer(network) => network.apply(cx, &x, steps, cond),
        }
    }

    /// What the network gives, in operations of candle, with a gradient. x: (b, H, A), the step of each row -> (b, H, A)
    ///
    /// # Errors
    /// An observation that does not fit.
    pub fn denoise(&self, observation: &Features<Tensor>, x: &Tensor, steps: &[u32]) -> Result<Tensor> {
        let rows = check_observation(M::NAME, &self.signature, observation)?;
        let steps: Vec<f32> = steps.iter().map(|&t| t as f32).collect();
        self.cache.composed_predict(&self.params, |cx| {
            let (cond, _) = self.condition.apply(cx, rows, observation)?;
            Ok(self.answer(cx, x, &steps, &cond)?.into_graph())
        })
    }

    /// The mean squared errors of a batch whose images are as the network reads them. With `mask_padding` steps beyond an
    /// episode's ends do not count.
    fn loss_of(&self, cx: &mut Context<'_>, batch: &Batch, targets: &[Target]) -> Result<Loss> {
        let (rows, horizon, width) = batch.actions.dims3()?;
        let (is_pad, steps) = match self.mask_padding {
            true => (batch.is_pad.clone(), batch.total_valid_steps),
            false => (batch.is_pad.zeros_like()?, batch.total_rows * horizon),
        };
        let (cond, scores) = self.condition.apply(cx, rows, &batch.observation)?;
        let mut loss = Loss::default();
        for target in targets {
            let answer = self.answer(cx, &target.x, &target.steps, &cond)?;
            let (term, _) = chunk_error(cx, (&answer, &target.wanted), &is_pad, Error::Squared, steps * width)?;
            loss.add(target.name, term, target.weight);
        }
        if let (Condition::Tokens(encoded), Some(scores)) = (&self.condition, &scores)
            && let Some(pointer) = &encoded.pointer
        {
            let (term, right) = ask(cx, &pointer.asked(M::NAME, batch)?, scores)?;
            loss.add("pointer_loss", term, pointer.weight);
            loss.report("pointer_right", right);
        }
        Ok(loss)
    }

    /// The loss of these targets on candle's operations, with a gradient, without dropout.
    pub(crate) fn composed_loss_with(&self, batch: &Batch, targets: &[Target]) -> Result<Tensor> {
        check_batch(M::NAME, &self.signature, self.action_horizon, batch)?;
        Ok(self.cache.composed_loss(&self.params, None, |cx| self.loss_of(cx, batch, targets))?.total)
    }

    /// Actions, (b, H, A), with this noise; `on_seen` is called when the images were seen.
    pub(crate) fn drawn_with(
        &self,
        observation: &Features<Tensor>,
        noise: &mut dyn FnMut(&Tensor) -> Result<Tensor>,
        on_seen: &mut dyn FnMut(),
    ) -> Result<Tensor> {
        let rows = check_observation(M::NAME, &self.signature, observation)?;
        self.cache.predict(&self.params, on_seen, |cx| self.drawn(cx, rows, observation, noise))
    }

    fn drawn(
        &self,
        cx: &mut Context<'_>,
        rows: usize,
        observation: &Features<Tensor>,
        noise: &mut dyn FnMut(&Tensor) -> Result<Tensor>,
    ) -> Result<Tensor> {
        let shape = (rows, self.action_horizon, self.signature.action_dim);
        let zeros = Tensor::zeros(shape, DType::F32, self.params.device())?;
        let (cond, _) = self.condition.apply(cx, rows, observation)?;
        let mut answer = |x: &Tensor, step: f32| Ok(self.answer(cx, x, &vec![step; rows], &cond)?.detached());
        self.method.sample(&zeros, &mut || noise(&zeros), &mut answer)
    }

    /// What the network gives in a prediction.
    #[cfg(test)]
    pub(crate) fn answered(&self, observation: &Features<Tensor>, x: &Tensor, steps: &[f32]) -> Result<Tensor> {
        let rows = check_observation(M::NAME, &self.signature, observation)?;
        self.cache.predict(&self.params, &mut || {}, |cx| {
            let (cond, _) = self.condition.apply(cx, rows, observation)?;
            Ok(self.answer(cx, x, steps, &cond)?.detached())
        })
    }
}

impl<M: Method> PolicyModel for Denoising<M> {
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
        check_batch(M::NAME, &self.signature, self.action_horizon, batch)?;
        let batch = &self.condition.with_images(batch, cx.rng()?)?;
        let targets = self.method.targets(cx.rng()?, &batch.actions)?;
        self.loss_of(cx, batch, &targets)
    }

    /// Drawn with a generator that is always the same.
    fn predict(&self, observation: &Features<Tensor>) -> Result<Tensor> {
        self.sample(observation, &mut Rng::new(0, "predict"))
    }

    fn sample(&self, observation: &Features<Tensor>, rng: &mut Rng) -> Result<Tensor> {
        self.sample_seen(observation, rng, &mut || {})
    }

    fn sample_seen(&self, observation: &Features<Tensor>, rng: &mut Rng, on_seen: &mut dyn FnMut()) -> Result<Tensor> {
        self.drawn_with(observation, &mut |zeros| normals_like(zeros, rng), on_seen)
    }

    fn policy(self: Arc<Self>, preprocess: Arc<Preprocess>, clock: Box<dyn Clock>) -> Box<dyn Policy> {
        let past = self.signature.n_obs_steps - 1;
        Box::new(ChunkPolicy::new(self, preprocess).without_past(past).with_clock(clock))
    }

    fn query_flops(&self) -> Option<f64> {
        let Network::Transformer(network) = &self.network else { return None };
        Some(self.condition.flops()? + network.flops() * self.method.answers() as f64)
    }

    fn vision(&self) -> Option<&VisionConfig> {
        self.condition.vision()
    }

    fn action_horizon(&self) -> usize {
        self.action_horizon
    }
}
