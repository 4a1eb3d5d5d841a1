//! BC-Transformer: a causal transformer over the last observations and a mixture of Gaussians over the present action.
//!
//! Reference: robomimic 0.3's `BC_Transformer_GMM` (`algo/bc.py`, `models/transformers.py`, after Karpathy's minGPT) with its
//! defaults: a token a step, learned positions, GELU, pre-norm blocks, the last step alone supervised, 5 Gaussians with tanh
//! on their means, hardly any noise at test time. On fixtures made with it this has its outputs, its loss and its gradients.
//! Before an episode has as many steps as the context, the first observation is repeated, there and here.
//!
//! Deviations: one dropout for tokens, attention and outputs; a window ends with its frame in the loss, where robomimic's may
//! end with repeats of an episode's last one. Images become the cells of `[policy.vision]`'s feature map behind a step's
//! numbers (robomimic: keypoints). No goals, no supervision of all steps, no sinusoidal positions. The means lie
//! in -1 to 1, so that actions have to be normalised by their range (`normalisation.action = "min_max"`).
//!
//! What it costs: of the last block only the last step is computed beyond keys and values, because nothing else is read
//! (robomimic computes all of it).

mod config;

pub use config::Config;

use crate::batch::Batch;
use crate::checks::{check_batch, check_observation};
use crate::chunk_policy::ChunkPolicy;
use crate::encoders::VisionConfig;
use crate::features::{FeatureKind, Features, Signature};
use crate::layers::{Activation, FeedForward, LayerNorm, Linear, Mixture, MixtureHead, MixtureParts, Steps};
use crate::model::PolicyModel;
use crate::policy::{Clock, Policy};
use crate::preprocess::Preprocess;
use candle_core::{DType, Tensor};
use nn::ops::{
    Attention, attention, dropout, feed_forward, layer_norm, linear, linear_rows, mixture_likelihood, narrow_tokens,
    residual,
};
use nn::{Backend, Cache, Context, Init, Loss, Params, Result, Rng, Value};
use std::sync::Arc;

/// The kinds of features that it reads.
pub const READS: &[FeatureKind] =
    &[FeatureKind::State, FeatureKind::EnvironmentState, FeatureKind::Entity, FeatureKind::Image];

/// The model.
#[derive(Debug)]
pub struct BcTransformer {
    config: Config,
    signature: Signature,
    params: Params,
    steps: Steps,
    embed_encoder: Linear,
    /// (1, T, D)
    embed_timestep: Tensor,
    embed_ln: LayerNorm,
    blocks: Vec<Block>,
    output_ln: LayerNorm,
    head: MixtureHead,
    cache: Cache,
}

/// Attention to what was before, then two dense layers; each after a norm and added to what it came from.
#[derive(Debug)]
struct Block {
    ln1: LayerNorm,
    qkv: Linear,
    output: Linear,
    ln2: LayerNorm,
    mlp: FeedForward,
    n_heads: usize,
    dropout: f64,
}

impl Block {
    fn new(p: &mut Params, prefix: &str, config: &Config, rng: &mut Rng) -> Result<Self> {
        let dim = config.dim_model;
        let mut linear = |p: &mut Params, name: &str, shape: (usize, usize), bias: Option<Init>| {
            Linear::with_init(p, &format!("{prefix}.{name}"), shape, Init::Normal { std: 0.02 }, bias, rng)
        };
        let qkv = linear(p, "attention.nets.qkv", (dim, 3 * dim), None)?;
        let output = linear(p, "attention.nets.output", (dim, dim), Some(Init::Zeros))?;
        let mlp = FeedForward {
            linear1: linear(p, "mlp.0", (dim, 4 * dim), Some(Init::Zeros))?,
            linear2: linear(p, "mlp.2", (4 * dim, dim), Some(Init::Zeros))?,
            activation: Activation::Gelu,
            dropout: 0.0,
        };
        Ok(Self {
            ln1: LayerNorm::new(p, &format!("{prefix}.ln1"), dim, rng)?,
            qkv,
            output,
            ln2: LayerNorm::new(p, &format!("{prefix}.ln2"), dim, rng)?,
            mlp,
            n_heads: config.n_heads,
            dropout: config.dropout,
        })
    }

    /// x: (b, T, D) -> (b, T, D), each step after those before it, or (b, 1, D): the last step alone, which sees all of them
    fn apply(&self, cx: &mut Context<'_>, x: &Value, all: bool) -> Result<Value> {
        let (batch, steps, dim) = x.dims3()?;
        let computed = if all { steps } else { 1 };
        let y = layer_norm(cx, x, &self.ln1)?;
        let asking = narrow_tokens(cx, &y, steps - computed, computed)?;
        let q = linear_rows(cx, &asking, None, (&self.qkv.weight, None), 0..dim)?;
        let kv = linear_rows(cx, &y, None, (&self.qkv.weight, None), dim..3 * dim)?;
        let (heads, dropout) = (self.n_heads, self.dropout);
        let how = Attention { heads, batch, all_queries: computed, causal: all, key_pad: None, dropout };
        let mixed = attention(cx, &q, &kv, how)?;
        let branch = linear(cx, &mixed, &self.output)?;
        let x = narrow_tokens(cx, x, steps - computed, computed)?;
        let x = residual(cx, &x, &branch, (dropout, computed), None)?;
        let z = layer_norm(cx, &x, &self.ln2)?;
        let branch = feed_forward(cx, &z, &self.mlp, computed)?;
        residual(cx, &x, &branch, (dropout, computed), None)
    }
}

impl BcTransformer {
    /// Initial weights as robomimic draws them.
    ///
    /// # Errors
    /// A configuration or a signature that describes no possible model.
    pub fn new(config: &Config, signature: &Signature, seed: u64, backend: &Backend) -> Result<Self> {
        config.validate()?;
        signature.check("bc_transformer", READS)?;
        let rng = &mut Rng::new(seed, "init");
        let mut p = Params::new(backend);
        let dim = config.dim_model;
        let steps = Steps::new(&mut p, "bc_transformer", signature, config.vision.as_ref(), rng)?;
        let embed_encoder = Linear::new(&mut p, "embed_encoder", steps.width(), dim, rng)?;
        let embed_timestep = p.create("embed_timestep", &[1, signature.n_obs_steps, dim], Init::Zeros, rng)?;
        let embed_ln = LayerNorm::new(&mut p, "embed_ln", dim, rng)?;
        let mut blocks = Vec::with_capacity(config.n_layers);
        for i in 0..config.n_layers {
            blocks.push(Block::new(&mut p, &format!("transformer.{i}"), config, rng)?);
        }
        let output_ln = LayerNorm::new(&mut p, "output_ln", dim, rng)?;
        let sizes = (dim, config.n_modes, signature.action_dim);
        let head = MixtureHead::new(&mut p, "decoder", sizes, config.min_std, rng)?;
        let (config, signature) = (config.clone(), signature.clone());
        Ok(Self {
            config,
            signature,
            params: p,
            steps,
            embed_encoder,
            embed_timestep,
            embed_ln,
            blocks,
            output_ln,
            head,
            cache: Cache::default(),
        })
    }

    /// The signature's features, (b, T, …) each, images as the network reads them -> b mixtures, of the last step
    fn forward(&self, cx: &mut Context<'_>, rows: usize, observation: &Features<Tensor>) -> Result<MixtureParts> {
        let (steps, dim) = (self.signature.n_obs_steps, self.config.dim_model);
        let seen = self.steps.apply(cx, rows, observation)?;
        let x = linear(cx, &seen, &self.embed_encoder)?;
        let positions = cx.parameter(&self.embed_timestep)?;
        let x = residual(cx, &positions, &x, (0.0, steps), Some(&self.embed_ln))?;
        let mut x = dropout(cx, &x, self.config.dropout)?;
        for (i, block) in self.blocks.iter().enumerate() {
            x = block.apply(cx, &x, i + 1 < self.blocks.len())?;
        }
        let read = layer_norm(cx, &x, &self.output_ln)?;
        self.head.apply(cx, &read.reshape((rows, dim))?)
    }

    /// The signature's features, (b, T, …) each -> b mixtures, of the last step; `on_seen` is called when images have been
    /// encoded.
    fn mixtures_seen(&self, observation: &Features<Tensor>, on_seen: &mut dyn FnMut()) -> Result<Mixture> {
        let rows = check_observation("bc_transformer", &self.signature, observation)?;
        let observation = self.steps.prepare(observation, None)?;
        self.cache.predict(&self.params, on_seen, |cx| self.forward(cx, rows, &observation)?.mixture())
    }

    /// The same without being told.
    ///
    /// # Errors
    /// An observation that does not fit.
    pub fn mixtures(&self, observation: &Features<Tensor>) -> Result<Mixture> {
        self.mixtures_seen(observation, &mut || {})
    }
}

impl PolicyModel for BcTransformer {
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
        check_batch("bc_transformer", &self.signature, self.config.action_horizon, batch)?;
        let observation = self.steps.prepare(&batch.observation, Some(cx.rng()?))?;
        let mixtures = self.forward(cx, batch.rows(), &observation)?;
        let real = Tensor::ones(batch.rows(), DType::F32, batch.device())?;
        let (nll, l1) = mixture_likelihood(cx, &mixtures, (&batch.actions.squeeze(1)?, &real), batch.total_rows)?;
        let mut loss = Loss::default();
        loss.add("nll", nll, 1.0);
        loss.report("l1_loss", l1);
        Ok(loss)
    }

    /// The mean of the likeliest Gaussian.
    fn predict(&self, observation: &Features<Tensor>) -> Result<Tensor> {
        Ok(self.mixtures(observation)?.likeliest()?.unsqueeze(1)?)
    }

    fn sample(&self, observation: &Features<Tensor>, rng: &mut Rng) -> Result<Tensor> {
        self.sample_seen(observation, rng, &mut || {})
    }

    fn sample_seen(&self, observation: &Features<Tensor>, rng: &mut Rng, on_seen: &mut dyn FnMut()) -> Result<Tensor> {
        Ok(self.mixtures_seen(observation, on_seen)?.sample(rng)?.unsqueeze(1)?)
    }

    fn policy(self: Arc<Self>, preprocess: Arc<Preprocess>, clock: Box<dyn Clock>) -> Box<dyn Policy> {
        Box::new(ChunkPolicy::new(self, preprocess).with_clock(clock))
    }

    fn vision(&self) -> Option<&VisionConfig> {
        self.steps.vision()
    }

    fn action_horizon(&self) -> usize {
        self.config.action_horizon
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::testing::{
        assert_the_gradient_is_the_slope, assert_the_step_is_the_composed_one, batch, losses_of_training,
        move_parameters, signatures, vision_config,
    };

    fn small() -> Config {
        Config { dim_model: 12, n_heads: 2, n_layers: 2, n_modes: 2, min_std: 0.05, ..Config::default() }
    }

    #[test]
    fn the_step_on_kernels_is_the_composed_one() {
        let of = signatures();
        for (signature, n_layers, dropout) in
            [(&of.history, 1, 0.0), (&of.history, 3, 0.2), (&of.plain, 2, 0.2), (&of.entities, 2, 0.0)]
        {
            let config = Config { n_layers, dropout, dim_model: 24, ..small() };
            let model = BcTransformer::new(&config, signature, 1, &Backend::CPU).unwrap();
            move_parameters(&model);
            let what = format!("{n_layers} layers, dropout {dropout}");
            assert_the_step_is_the_composed_one(&model, &batch(signature, 1, 7, 3), &what);
        }
    }

    #[test]
    fn from_images_the_step_on_kernels_is_the_composed_one() {
        let of = signatures();
        for signature in [&of.images, &of.image_history] {
            let config = Config { vision: Some(vision_config()), dropout: 0.2, ..small() };
            let model = BcTransformer::new(&config, signature, 1, &Backend::CPU).unwrap();
            move_parameters(&model);
            let batch = batch(signature, 1, 3, 3);
            assert_the_step_is_the_composed_one(&model, &batch, &format!("{} steps", signature.n_obs_steps));
            let (mut seen, rng) = (0, &mut Rng::new(0, "drawn"));
            let first = model.sample_seen(&batch.observation, rng, &mut || seen += 1).unwrap();
            let again = model.sample(&batch.observation, &mut Rng::new(0, "drawn")).unwrap();
            let off = (first - again).unwrap().abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
            assert_eq!((off, seen), (0.0, 1));
        }
    }

    #[test]
    fn the_gradient_is_the_slope_of_the_loss() {
        let of = signatures();
        for (signature, dropout) in [(&of.history, 0.0), (&of.plain, 0.0), (&of.history, 0.2)] {
            let model = BcTransformer::new(&Config { dropout, ..small() }, signature, 1, &Backend::CPU).unwrap();
            move_parameters(&model);
            assert_the_gradient_is_the_slope(&model, &batch(signature, 1, 4, 3), &format!("dropout {dropout}"));
        }
    }

    #[test]
    fn training_lowers_the_loss_with_the_same_bits_every_time() {
        let signature = signatures().history;
        let build = || BcTransformer::new(&small(), &signature, 1, &Backend::CPU);
        let losses = losses_of_training(build, &batch(&signature, 1, 8, 0), (60, 5e-3));
        assert!(losses[59].loss < losses[0].loss - 0.5, "{losses:?}");
    }

    #[test]
    fn impossible_configurations_name_the_field() {
        let error = |config: Config| {
            BcTransformer::new(&config, &signatures().history, 0, &Backend::CPU).unwrap_err().to_string()
        };
        assert!(error(Config { action_horizon: 2, ..small() }).contains("action_horizon is 2, expected 1"));
        assert!(error(Config { n_heads: 5, ..small() }).contains("n_heads is 5, expected a divisor of dim_model, 12"));
        assert!(error(Config { dropout: 1.0, ..small() }).contains("dropout"));
    }
}
