//! ACT, Action Chunking with Transformers: a conditional VAE whose decoder predicts a chunk of actions at once.
//!
//! Paper: Zhao et al., "Learning Fine-Grained Bimanual Manipulation with Low-Cost Hardware", arXiv 2304.13705.
//! Reference: `ACTPolicy` of LeRobot 0.6.1; tensor names are its own, less the prefix
//! `model.`, which belongs to its file format.
//!
//! Training: the VAE encoder reads `[cls, state, actions…]` and gives the mean and log-variance of a latent. The encoder
//! reads `[latent, state, environment state, entities…, images…]`; the decoder's queries are learned positions, one per action of the chunk.
//! Loss: L1 over the steps that are not padding, plus `kl_weight` times KL(latent ‖ N(0, 1)). Inference: latent = 0.
//!
//! Entities are ours: a token each, through a projection that entities of one group share, without a position unless one
//! was asked for; without positions the chunk does not depend on the order of a group. Of a history (`n_obs_steps`) each
//! token reads all steps side by side.
//!
//! Images are tokens after all others, one a cell of a feature map (`encoders`), in the order of the cameras; as in
//! LeRobot nothing tells cameras apart.
//!
//! `pointer` (ours): a classification head over the entity tokens after the encoder, trained with cross-entropy on the entity that
//! the demonstration took. The decoder also attends to the softmax-weighted mean of those entities' input tokens. `auxiliary` (ours): a regression
//! head on the first encoder token, trained on `data.auxiliary_keys`, which the policy does not observe.
//!
//! Shapes: b rows of a batch, C actions of a chunk (`action_horizon`), A dimensions of an action, L width of the latent, M tokens
//! of the encoder, D width of a token (`dim_model`).
//!
//! Deviations: without entities, `pointer` and `auxiliary` none in the maths. There is no `feedforward_activation = "glu"`: LeRobot
//! accepts it in its configuration, but its layer then cannot run (`glu` halves the width that `linear2` expects).
//!
//! Exact savings over LeRobot: of the VAE encoder's last layer only the first token is computed, because nothing else is read;
//! the first decoder layer's queries, keys and values are computed once for the whole batch, because its input is zero for
//! every sample.

mod config;
pub mod lerobot;
#[cfg(test)]
mod tests;

pub use config::Config;

use crate::batch::Batch;
use crate::checks::{check_batch, check_observation, check_signature};
use crate::chunk_policy::ChunkPolicy;
use crate::encoders::VisionConfig;
use crate::features::{FeatureKind, Features, Signature};
use crate::flops;
use crate::layers::{
    Auxiliary, Decoder, DecoderLayer, Embedding, Encoder, InputTokens, LayerInit, LayerNorm, Linear, Pointer,
    TokenLayout, Vae, ask, environment_state, sinusoid_table,
};
use crate::model::PolicyModel;
use crate::policy::{Clock, Policy};
use crate::preprocess::Preprocess;
use candle_core::Tensor;
use nn::ops::{Error, chunk_error, kl_divergence, linear, sample_latent};
use nn::{Backend, Cache, Context, Gradients, Loss, LossNumbers, LossParts, Params, Result, Rng, Value};
use std::sync::Arc;

/// The kinds of features that it reads.
pub const READS: &[FeatureKind] =
    &[FeatureKind::State, FeatureKind::EnvironmentState, FeatureKind::Entity, FeatureKind::Image];

/// The model.
#[derive(Debug)]
pub struct Act {
    config: Config,
    signature: Signature,
    params: Params,
    vae: Option<Vae>,
    encoder: Encoder,
    decoder: Decoder,
    tokens: InputTokens,
    action_head: Linear,
    pointer: Option<Pointer>,
    auxiliary: Option<Auxiliary>,
    cache: Cache,
    /// (1, action_horizon + 2, D), fixed
    vae_encoder_pos_enc: Tensor,
}

impl Act {
    /// Initial weights are LeRobot's distributions: xavier-uniform matrices in encoder and decoder, torch's defaults
    /// elsewhere.
    ///
    /// # Errors
    /// A configuration or a signature that describes no possible model.
    pub fn new(config: &Config, signature: &Signature, seed: u64, backend: &Backend) -> Result<Self> {
        config.validate()?;
        check_signature("act", signature, READS)?;
        let layout = TokenLayout::new(signature, config.vision.as_ref(), config.dim_model)?;
        let rng = &mut Rng::new(seed, "init");
        let mut p = Params::new(backend);
        let (dim, shape) = (config.dim_model, config.shape());
        let vae = match config.use_vae {
            true => {
                let (of_vae, io) = ((config.n_vae_encoder_layers, config.latent_dim), (&layout, signature.action_dim));
                Some(Vae::new(&mut p, shape, of_vae, io, rng)?)
            }
            false => None,
        };
        let encoder = Encoder::new(&mut p, "encoder", config.n_encoder_layers, shape, LayerInit::Xavier, rng)?;
        // in the order in which initial weights are drawn
        let layers = (0..config.n_decoder_layers)
            .map(|i| DecoderLayer::new(&mut p, &format!("decoder.layers.{i}"), shape, rng))
            .collect::<Result<_>>()?;
        let env_state = environment_state(&mut p, &layout, dim, rng)?;
        let norm = LayerNorm::new(&mut p, "decoder.norm", dim, rng)?;
        let tokens = InputTokens::new(&mut p, layout, config.latent_dim, dim, env_state, rng)?;
        let pos_embed = Embedding::new(&mut p, "decoder_pos_embed", config.action_horizon, dim, rng)?;
        let table = sinusoid_table(config.action_horizon + 2, dim, backend.device())?;
        let action_head = Linear::new(&mut p, "action_head", dim, signature.action_dim, rng)?;
        let layout = tokens.layout();
        let pointer = config.pointer.as_ref();
        let pointer =
            pointer.map(|pointer| Pointer::new(&mut p, pointer, ("act", signature, layout), dim, rng)).transpose()?;
        let auxiliary = config.auxiliary.as_ref();
        let auxiliary =
            auxiliary.map(|asked| Auxiliary::new(&mut p, asked, ("act", signature), dim, rng)).transpose()?;
        Ok(Self {
            vae,
            encoder,
            decoder: Decoder { layers, norm, pos_embed },
            tokens,
            action_head,
            pointer,
            auxiliary,
            cache: Cache::default(),
            vae_encoder_pos_enc: table,
            params: p,
            config: config.clone(),
            signature: signature.clone(),
        })
    }

    /// Its configuration.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// Mean and log-variance of the latent of a batch's actions, (b, 2L); `None` without VAE.
    fn encode(&self, cx: &mut Context<'_>, batch: &Batch) -> Result<Option<Value>> {
        self.vae.as_ref().map(|vae| vae.apply(cx, batch, &self.vae_encoder_pos_enc)).transpose()
    }

    /// latent (b, L), and the features of the observation -> actions (b, C, A), the encoder's output (b, M, D), and the
    /// pointer's scores (b, candidates)
    fn decode(
        &self,
        cx: &mut Context<'_>,
        latent: &Value,
        observation: &Features<Tensor>,
    ) -> Result<(Value, Value, Option<Value>)> {
        let tokens = self.tokens.apply(cx, latent, observation)?;
        let mut pos = self.tokens.apply_positions(cx)?;
        let candidates = self.pointer.as_ref().map(|pointer| pointer.candidates(cx, &tokens)).transpose()?;
        let mut memory = self.encoder.apply(cx, &tokens, &pos, None, tokens.dim(1)?)?;
        let mut scores = None;
        if let (Some(pointer), Some(candidates)) = (&self.pointer, &candidates) {
            let found;
            (memory, pos, found) = pointer.apply(cx, (&memory, candidates), &pos)?;
            scores = Some(found);
        }
        let decoded = self.decoder.apply(cx, &memory, &pos)?;
        Ok((linear(cx, &decoded, &self.action_head)?, memory, scores))
    }

    /// L1 over valid steps plus weighted KL; with a pointer its cross-entropy, with `auxiliary` its regression loss. `noise` of
    /// the latent's sample: (b, L).
    fn loss_with(&self, cx: &mut Context<'_>, batch: &Batch, noise: &Value) -> Result<Loss> {
        let latent = self.encode(cx, batch)?;
        let sample = match &latent {
            Some(latent) => sample_latent(cx, latent, noise)?,
            None => Value::zeros(noise.dims(), batch.device())?,
        };
        let (actions, memory, scores) = self.decode(cx, &sample, &batch.observation)?;

        let mut loss = Loss::default();
        let entries = batch.total_valid_steps * self.signature.action_dim;
        let (l1, _) = chunk_error(cx, (&actions, &batch.actions), &batch.is_pad, Error::Absolute, entries)?;
        loss.add("l1_loss", l1, 1.0);
        if let (Some(pointer), Some(scores)) = (&self.pointer, &scores) {
            let (term, right) = ask(cx, &pointer.asked("act", batch)?, scores)?;
            loss.add("pointer_loss", term, pointer.weight);
            loss.report("pointer_right", right);
        }
        if let Some(auxiliary) = &self.auxiliary {
            loss.add("auxiliary_loss", auxiliary.term(cx, &memory, ("act", batch))?, auxiliary.weight);
        }
        if let Some(latent) = &latent {
            loss.add("kld_loss", kl_divergence(cx, latent, batch.total_rows)?, self.config.kl_weight);
        }
        Ok(loss)
    }

    /// Loss of a training forward pass with the latent's noise `eps`: (b, L), and its gradients added to `into`.
    /// Dropout masks are drawn from `rng`; without it nothing is dropped.
    ///
    /// # Errors
    /// Inputs of the wrong shape.
    pub fn gradients_with(
        &self,
        batch: &Batch,
        eps: &Tensor,
        rng: Option<&mut Rng>,
        into: &mut Gradients,
    ) -> Result<LossNumbers> {
        let batch = &self.with_images(batch, None)?;
        self.cache.step(&self.params, rng, into, |cx| self.loss_with(cx, batch, &Value::from(eps)))
    }

    /// The same loss on candle's operations, with its graph and without dropout.
    ///
    /// # Errors
    /// Inputs of the wrong shape.
    pub fn composed_loss_with(&self, batch: &Batch, eps: &Tensor) -> Result<LossParts> {
        let batch = &self.with_images(batch, None)?;
        self.cache.composed_loss(&self.params, None, |cx| self.loss_with(cx, batch, &Value::from(eps)))
    }

    /// Actions, (b, C, A), and mean and log-variance of the latent, (b, 2L), of a training forward pass without dropout.
    ///
    /// # Errors
    /// Inputs of the wrong shape.
    pub fn training_output(&self, batch: &Batch, eps: &Tensor) -> Result<(Tensor, Option<Tensor>)> {
        let batch = &self.with_images(batch, None)?;
        self.cache.predict(&self.params, &mut || {}, |cx| {
            let latent = self.encode(cx, batch)?;
            let sample = match &latent {
                Some(latent) => sample_latent(cx, latent, &Value::from(eps))?,
                None => Value::zeros(eps.dims(), batch.device())?,
            };
            let actions = self.decode(cx, &sample, &batch.observation)?.0.detached();
            Ok((actions, latent.map(|latent| latent.detached())))
        })
    }

    /// The prediction on candle's operations; `predict` runs the same statement on hand-written kernels.
    ///
    /// # Errors
    /// Inputs of the wrong shape.
    pub fn predict_composed(&self, observation: &Features<Tensor>) -> Result<Tensor> {
        let (latent, observation) = self.mean_latent(observation)?;
        self.cache.composed_predict(&self.params, |cx| Ok(self.decode(cx, &latent, &observation)?.0.detached()))
    }

    /// Without a sample the latent is its mean under the prior, zero; and images as the network reads them.
    fn mean_latent(&self, observation: &Features<Tensor>) -> Result<(Value, Features<Tensor>)> {
        let rows = check_observation("act", &self.signature, observation)?;
        let latent = Value::zeros((rows, self.config.latent_dim), self.params.device())?;
        Ok((latent, self.tokens.prepare(observation, None)?))
    }

    /// The batch with images as the network reads them: random parts in training, with `rng`.
    fn with_images(&self, batch: &Batch, rng: Option<&mut Rng>) -> Result<Batch> {
        check_batch("act", &self.signature, self.config.action_horizon, batch)?;
        Ok(Batch { observation: self.tokens.prepare(&batch.observation, rng)?, ..batch.clone() })
    }
}

impl PolicyModel for Act {
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
        let batch = &self.with_images(batch, Some(cx.rng()?))?;
        let noise = cx.normals(&[batch.rows(), self.config.latent_dim])?;
        self.loss_with(cx, batch, &noise)
    }

    fn predict(&self, observation: &Features<Tensor>) -> Result<Tensor> {
        self.sample_seen(observation, &mut Rng::new(0, "predict"), &mut || {})
    }

    /// Nothing is drawn.
    fn sample_seen(&self, observation: &Features<Tensor>, _: &mut Rng, on_seen: &mut dyn FnMut()) -> Result<Tensor> {
        let (latent, observation) = self.mean_latent(observation)?;
        self.cache.predict(&self.params, on_seen, |cx| Ok(self.decode(cx, &latent, &observation)?.0.detached()))
    }

    fn policy(self: Arc<Self>, preprocess: Arc<Preprocess>, clock: Box<dyn Clock>) -> Box<dyn Policy> {
        Box::new(ChunkPolicy::new(self, preprocess).with_clock(clock))
    }

    fn query_flops(&self) -> Option<f64> {
        let (shape, layout) = (self.config.shape(), self.tokens.layout());
        if layout.cameras.is_some() {
            return None;
        }
        let (memory, horizon) = (layout.len(), self.config.action_horizon);
        let encoder = flops::encoder_layer(shape, memory) * self.config.n_encoder_layers as f64;
        let read = memory + usize::from(self.pointer.is_some());
        let decoder = flops::decoder_layer(shape, horizon, read) * self.config.n_decoder_layers as f64;
        let head = flops::linear(horizon, shape.dim, self.signature.action_dim);
        Some(flops::tokens(layout, self.config.latent_dim, shape.dim) + encoder + decoder + head)
    }

    fn action_horizon(&self) -> usize {
        self.config.action_horizon
    }

    fn vision(&self) -> Option<&VisionConfig> {
        self.tokens.vision()
    }
}
