//! BC-Transformer: a causal transformer over the last observations and a mixture of Gaussians over the present action.
//!
//! Reference: robomimic 0.3's `BC_Transformer_GMM` (`algo/bc.py`, `models/transformers.py`, after Karpathy's minGPT) with its
//! defaults: a token a step, learned positions, GELU, pre-norm blocks, the last step alone supervised, 5 Gaussians with tanh
//! on their means, hardly any noise at test time. On fixtures made with it this has its outputs, its loss and its gradients.
//! Before an episode has as many steps as the context, the first observation is repeated, there and here.
//!
//! Deviations: one dropout for tokens, attention and outputs; a window ends with its frame in the loss, where robomimic's may
//! end with repeats of an episode's last one. Pictures become the cells of `[policy.vision]`'s feature map behind a step's
//! numbers (robomimic: keypoints). No goals, no supervision of all steps, no sinusoidal positions. The means lie
//! in -1 to 1, so that actions have to be normalised by their range (`normalisation.action = "min_max"`).
//!
//! What it costs: of the last block only the last step is computed beyond keys and values, because nothing else is read
//! (robomimic computes all of it). This file is the readable form; training steps run on `fused.rs`, the same maths written
//! out, which `bench_policies` puts beside robomimic's.

mod config;
mod fused;

pub use config::Config;

use crate::batch::Batch;
use crate::checks::{check_batch, check_observation};
use crate::chunk_policy::ChunkPolicy;
use crate::encoders::VisionConfig;
use crate::features::{FeatureKind, Features, Signature};
use crate::fused::Workspaces;
use crate::layers::{Dropout, LayerNorm, Linear, Mixture, MixtureHead, Mode, Steps, masked_softmax};
use crate::model::PolicyModel;
use crate::policy::{Clock, Policy};
use crate::preprocess::Preprocess;
use candle_core::Tensor;
use nn::Gradients;
use nn::Result;
use nn::Rng;
use nn::device::HERE;
use nn::losses::absolute;
use nn::{Init, Params};
use nn::{LossParts, LossValues};
use std::collections::BTreeMap;
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
    dropout: Dropout,
    workspaces: Workspaces,
}

/// Attention to what was before, then two dense layers; each after a norm and added to what it came from.
#[derive(Debug)]
struct Block {
    ln1: LayerNorm,
    qkv: Linear,
    output: Linear,
    ln2: LayerNorm,
    mlp: [Linear; 2],
    n_heads: usize,
    dropout: Dropout,
}

impl Block {
    fn new(p: &mut Params, prefix: &str, config: &Config, rng: &mut Rng) -> Result<Self> {
        let dim = config.dim_model;
        let mut linear = |p: &mut Params, name: &str, shape: (usize, usize), bias: Option<Init>| {
            Linear::with_init(p, &format!("{prefix}.{name}"), shape, Init::Normal { std: 0.02 }, bias, rng)
        };
        let qkv = linear(p, "attention.nets.qkv", (dim, 3 * dim), None)?;
        let output = linear(p, "attention.nets.output", (dim, dim), Some(Init::Zeros))?;
        let mlp = [
            linear(p, "mlp.0", (dim, 4 * dim), Some(Init::Zeros))?,
            linear(p, "mlp.2", (4 * dim, dim), Some(Init::Zeros))?,
        ];
        Ok(Self {
            ln1: LayerNorm::new(p, &format!("{prefix}.ln1"), dim, rng)?,
            qkv,
            output,
            ln2: LayerNorm::new(p, &format!("{prefix}.ln2"), dim, rng)?,
            mlp,
            n_heads: config.n_heads,
            dropout: Dropout { p: config.dropout },
        })
    }

    /// x: (b, T, D), mask: (T, T), 0 where a step may look and very negative elsewhere -> (b, T, D), or (b, 1, D) without
    /// a mask: the last step alone, which may look everywhere
    fn forward(&self, x: &Tensor, mask: Option<&Tensor>, mode: &mut Mode<'_>) -> Result<Tensor> {
        let (b, steps, dim) = x.dims3()?;
        let head = dim / self.n_heads;
        let qkv = self.qkv.forward(&self.ln1.forward(x)?)?;
        let part = |i: usize, of: &Tensor| -> Result<Tensor> {
            let part = of.narrow(2, i * dim, dim)?.reshape((b, (), self.n_heads, head))?;
            Ok(part.transpose(1, 2)?.contiguous()?)
        };
        let computed = if mask.is_some() { steps } else { 1 };
        let last = |x: &Tensor| -> Result<Tensor> { Ok(x.narrow(1, steps - computed, computed)?) };
        let (q, k, v) = (part(0, &last(&qkv)?)?, part(1, &qkv)?, part(2, &qkv)?);
        let mut scores = (q.matmul(&k.transpose(2, 3)?)? * (1.0 / (head as f64).sqrt()))?;
        if let Some(mask) = mask {
            scores = scores.broadcast_add(mask)?;
        }
        let weights = self.dropout.forward(&masked_softmax(&scores, None)?, mode)?;
        let mixed = weights.matmul(&v)?.transpose(1, 2)?.reshape((b, computed, dim))?;
        let x = (last(x)? + self.dropout.forward(&self.output.forward(&mixed)?, mode)?)?;
        let inner = self.mlp[0].forward(&self.ln2.forward(&x)?)?.gelu_erf()?;
        let outer = self.dropout.forward(&self.mlp[1].forward(&inner)?, mode)?;
        Ok((x + outer)?)
    }
}

impl BcTransformer {
    /// Initial weights as robomimic draws them.
    ///
    /// # Errors
    /// A configuration or a signature that describes no possible model.
    pub fn new(config: &Config, signature: &Signature, seed: u64) -> Result<Self> {
        config.validate()?;
        signature.check("bc_transformer", READS)?;
        let rng = &mut Rng::new(seed, "init");
        let mut p = Params::new();
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
        let dropout = Dropout { p: config.dropout };
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
            dropout,
            workspaces: Workspaces::default(),
        })
    }

    /// The signature's features, (b, T, …) each -> b mixtures, of the last step
    ///
    /// # Errors
    /// An observation that does not fit.
    pub fn mixtures(&self, observation: &Features<Tensor>, mode: &mut Mode<'_>) -> Result<Mixture> {
        let rows = check_observation("bc_transformer", &self.signature, observation)?;
        self.mixtures_of(&self.steps.forward(rows, observation)?, mode)
    }

    /// The same of sequences, (b, T, everything of a step)
    fn mixtures_of(&self, seen: &Tensor, mode: &mut Mode<'_>) -> Result<Mixture> {
        let steps = self.signature.n_obs_steps;
        let x = self.embed_encoder.forward(seen)?.broadcast_add(&self.embed_timestep)?;
        let mut x = self.dropout.forward(&self.embed_ln.forward(&x)?, mode)?;
        let mask: Vec<f32> = (0..steps * steps).map(|i| if i % steps > i / steps { -1e30 } else { 0.0 }).collect();
        let mask = Tensor::from_vec(mask, (steps, steps), &HERE)?;
        for (i, block) in self.blocks.iter().enumerate() {
            x = block.forward(&x, Some(&mask).filter(|_| i + 1 < self.blocks.len()), mode)?;
        }
        self.head.forward(&self.output_ln.forward(&x.squeeze(1)?)?)
    }

    /// The loss of these mixtures, one a row of the batch.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn loss_of(&self, mixtures: &Mixture, batch: &Batch) -> Result<LossParts> {
        let actions = batch.actions.squeeze(1)?;
        let rows = batch.total_rows.max(1) as f64;
        let total = ((mixtures.log_prob(&actions)?.sum_all()? / rows)? * -1.0)?;
        // of the likeliest Gaussian's mean, beside what other policies report
        let away = absolute(&(mixtures.likeliest()?.detach() - &actions)?)?;
        let l1 = (away.sum_all()? / (rows * self.signature.action_dim as f64))?;
        let parts = BTreeMap::from([("nll".to_string(), total.detach()), ("l1_loss".to_string(), l1)]);
        Ok(LossParts { total, parts })
    }
}

impl PolicyModel for BcTransformer {
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
        check_batch("bc_transformer", &self.signature, self.config.action_horizon, batch)?;
        self.fused_gradients(&self.steps.looked_at(batch, rng)?, rng, into)
    }

    fn loss(&self, batch: &Batch, rng: &mut Rng) -> Result<LossParts> {
        check_batch("bc_transformer", &self.signature, self.config.action_horizon, batch)?;
        let batch = &self.steps.looked_at(batch, rng)?;
        self.loss_of(&self.mixtures(&batch.observation, &mut Mode::Train(rng))?, batch)
    }

    /// The mean of the likeliest Gaussian.
    fn predict(&self, observation: &Features<Tensor>) -> Result<Tensor> {
        Ok(self.mixtures(observation, &mut Mode::Eval)?.likeliest()?.detach().unsqueeze(1)?)
    }

    fn sample(&self, observation: &Features<Tensor>, rng: &mut Rng) -> Result<Tensor> {
        self.sample_seen(observation, rng, &mut || {})
    }

    fn sample_seen(&self, observation: &Features<Tensor>, rng: &mut Rng, on_seen: &mut dyn FnMut()) -> Result<Tensor> {
        let rows = check_observation("bc_transformer", &self.signature, observation)?;
        let seen = self.steps.forward(rows, observation)?;
        if self.steps.learns() {
            on_seen();
        }
        Ok(self.mixtures_of(&seen, &mut Mode::Eval)?.sample(rng)?.detach().unsqueeze(1)?)
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
    use crate::fused::testing::{
        assert_the_gradient_is_the_slope, assert_the_step_is_the_composed_one, batch, eyes, move_parameters, signatures,
    };
    use crate::train::{TrainConfig, Trainer};

    fn small() -> Config {
        Config { dim_model: 12, n_heads: 2, n_layers: 2, n_modes: 2, min_std: 0.05, ..Config::default() }
    }

    #[test]
    fn the_step_by_hand_is_the_composed_one() {
        let of = signatures();
        for (signature, n_layers, dropout) in
            [(&of.history, 1, 0.0), (&of.history, 3, 0.2), (&of.plain, 2, 0.2), (&of.entities, 2, 0.0)]
        {
            let config = Config { n_layers, dropout, dim_model: 24, ..small() };
            let model = BcTransformer::new(&config, signature, 1).unwrap();
            move_parameters(&model);
            let what = format!("{n_layers} layers, dropout {dropout}");
            assert_the_step_is_the_composed_one(&model, &batch(signature, 1, 7, 3), &what);
        }
    }

    #[test]
    fn from_pictures_the_step_by_hand_is_the_composed_one() {
        let of = signatures();
        for signature in [&of.pictures, &of.film] {
            let config = Config { vision: Some(eyes()), dropout: 0.2, ..small() };
            let model = BcTransformer::new(&config, signature, 1).unwrap();
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
            let model = BcTransformer::new(&Config { dropout, ..small() }, signature, 1).unwrap();
            move_parameters(&model);
            assert_the_gradient_is_the_slope(&model, &batch(signature, 1, 4, 3), &format!("dropout {dropout}"));
        }
    }

    #[test]
    fn training_lowers_the_loss_with_the_same_bits_every_time() {
        let signature = signatures().history;
        let run = || {
            let model = Box::new(BcTransformer::new(&small(), &signature, 1).unwrap());
            let settings = TrainConfig { steps: 60, lr: 5e-3, warmup_steps: 3, ..Default::default() };
            let mut trainer = Trainer::new(model, settings, 5).unwrap();
            let batch = batch(&signature, 1, 8, 0);
            let losses: Vec<f32> = (0..60).map(|_| trainer.step(&batch).unwrap().loss).collect();
            (losses[0], losses[59])
        };
        let (first, last) = run();
        assert!(last < first - 0.5, "{first} {last}");
        assert_eq!(run(), (first, last));
    }

    #[test]
    fn impossible_configurations_name_the_field() {
        let error = |config: Config| BcTransformer::new(&config, &signatures().history, 0).unwrap_err().to_string();
        assert!(error(Config { action_horizon: 2, ..small() }).contains("action_horizon is 2, expected 1"));
        assert!(error(Config { n_heads: 5, ..small() }).contains("n_heads is 5, expected a divisor of dim_model, 12"));
        assert!(error(Config { dropout: 1.0, ..small() }).contains("dropout"));
    }
}
