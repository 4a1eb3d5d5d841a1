//! ACT, Action Chunking with Transformers: a conditional VAE whose decoder predicts a chunk of actions at once.
//!
//! Paper: Zhao et al., "Learning Fine-Grained Bimanual Manipulation with Low-Cost Hardware", arXiv 2304.13705.
//! Reference: `ACTPolicy` of LeRobot 0.6.1; tensor names are its own, less the prefix
//! `model.`, which belongs to its file format.
//!
//! Training: the VAE encoder reads `[cls, state, actions…]` and gives the mean and log-variance of a latent. The encoder
//! reads `[latent, state, environment state, entities…, pictures…]`; the decoder's queries are learned positions, one per action of the chunk.
//! Loss: L1 over the steps that are not padding, plus `kl_weight` times KL(latent ‖ N(0, 1)). Inference: latent = 0.
//!
//! Entities are ours: a token each, through a projection that entities of one group share, without a position unless one
//! was asked for; without positions the chunk does not depend on the order of a group. Of a history (`n_obs_steps`) each
//! token reads all steps side by side.
//!
//! Pictures are tokens after all others, one a cell of a feature map (`encoders`), in the order of the cameras; as in
//! LeRobot nothing tells cameras apart.
//!
//! With `pointer` (ours) the encoder's output is asked which entity a demonstration took, and the decoder reads that entity's
//! token as one more; the answer has a loss of its own. With `auxiliary` (ours) training asks the encoder's output for numbers
//! that are not seen.
//!
//! Deviations: none in the maths. `feedforward_activation = "glu"` is refused: LeRobot accepts it in its configuration,
//! but its layer then cannot run (`glu` halves the width that `linear2` expects).
//!
//! This file is the model as one reads it, on candle's autograd. Training steps and predictions run the same maths with
//! hand-written backward passes (`fused.rs`); tests hold the two together.

mod config;
mod fused;

pub use config::Config;

use crate::batch::Batch;
use crate::checks::{check_batch, check_observation, check_signature};
use crate::chunk_policy::ChunkPolicy;
use crate::encoders::VisionConfig;
use crate::error::Result;
use crate::features::{FeatureKind, Features, Signature};
use crate::flops;
use crate::fused::Workspaces;
use crate::gradients::Gradients;
use crate::layers::{
    Auxiliary, Decoder, DecoderLayer, Embedding, Encoder, InputTokens, LayerInit, LayerNorm, Linear, Mode, Pointed,
    Pointer, TokenLayout, Vae, environment_state, kl_divergence, sample, sinusoid_table,
};
use crate::losses::absolute;
use crate::model::{LossParts, LossValues, PolicyModel, autograd, not_by_hand};
use crate::params::Params;
use crate::policy::{Clock, Policy};
use crate::preprocess::Preprocess;
use crate::rng::Rng;
use candle_core::{DType, Tensor};
use std::collections::BTreeMap;
use std::sync::Arc;

/// The kinds of features that it reads.
pub const READS: &[FeatureKind] =
    &[FeatureKind::State, FeatureKind::EnvironmentState, FeatureKind::Entity, FeatureKind::Image];

/// What the training forward pass gives.
#[derive(Debug)]
pub struct TrainOutput {
    /// (b, action_horizon, A)
    pub actions: Tensor,
    /// mean and log-variance of the latent, (b, latent_dim) each; `None` without VAE
    pub latent: Option<(Tensor, Tensor)>,
    /// what is asked beside them
    beside: Beside,
}

/// What is asked beside the actions.
#[derive(Debug)]
struct Beside {
    /// which entity is meant
    pointed: Option<Pointed>,
    /// numbers that are not seen, (b, K), from a training forward pass
    auxiliary: Option<Tensor>,
}

/// The model.
#[derive(Debug)]
pub struct Act {
    config: Config,
    signature: Signature,
    params: Params,
    pub(crate) vae: Option<Vae>,
    pub(crate) encoder: Encoder,
    pub(crate) decoder: Decoder,
    pub(crate) tokens: InputTokens,
    pub(crate) action_head: Linear,
    pointer: Option<Pointer>,
    auxiliary: Option<Auxiliary>,
    pub(crate) workspaces: Workspaces,
    /// (1, action_horizon + 2, D), fixed
    pub(crate) vae_encoder_pos_enc: Tensor,
    /// the same as a slice
    position_table: Vec<f32>,
}

impl Act {
    /// Initial weights are LeRobot's distributions: xavier-uniform matrices in encoder and decoder, torch's defaults
    /// elsewhere.
    ///
    /// # Errors
    /// A configuration or a signature that describes no possible model.
    pub fn new(config: &Config, signature: &Signature, seed: u64) -> Result<Self> {
        config.validate()?;
        check_signature("act", signature, READS)?;
        let layout = TokenLayout::new(signature, config.vision.as_ref(), config.dim_model)?;
        let rng = &mut Rng::new(seed, "init");
        let mut p = Params::new();
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
        let table = sinusoid_table(config.action_horizon + 2, dim)?;
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
            workspaces: Workspaces::default(),
            position_table: table.flatten_all()?.to_vec1()?,
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

    /// (action_horizon + 2, D)
    pub(crate) fn position_table(&self) -> &[f32] {
        &self.position_table
    }

    /// latent: (b, L), the features of the observation -> (b, C, A), and what is asked beside them
    fn decode(&self, latent: &Tensor, observation: &Features<Tensor>, mode: &mut Mode<'_>) -> Result<(Tensor, Beside)> {
        let tokens = self.tokens.forward(latent, observation)?;
        let mut pos = self.tokens.positions()?;
        let mut memory = self.encoder.forward(&tokens, &pos, None, mode)?;
        let pointed = self.pointer.as_ref().map(|pointer| pointer.forward(&memory, &tokens)).transpose()?;
        if let (Some(pointer), Some(pointed)) = (&self.pointer, &pointed) {
            (memory, pos) = pointer.beside(&memory, &pos, pointed)?;
        }
        let auxiliary = match mode {
            Mode::Train(_) => self.auxiliary.as_ref().map(|asked| asked.forward(&memory)).transpose()?,
            Mode::Eval => None,
        };
        let actions = self.action_head.forward(&self.decoder.forward(&memory, &pos, mode)?)?;
        Ok((actions, Beside { pointed, auxiliary }))
    }

    /// The training forward pass with dropout from `mode` and the latent's noise `eps`: (b, L).
    ///
    /// # Errors
    /// Inputs of the wrong shape.
    pub fn train_forward(&self, batch: &Batch, eps: &Tensor, mode: &mut Mode<'_>) -> Result<TrainOutput> {
        self.check_batch(batch)?;
        let observation = self.tokens.look(&batch.observation, None)?;
        let latent = match &self.vae {
            Some(vae) => Some(vae.encode(batch, &self.vae_encoder_pos_enc, mode)?),
            None => None,
        };
        let sample = match &latent {
            Some(latent) => sample(latent, eps)?,
            None => eps.zeros_like()?,
        };
        let (actions, beside) = self.decode(&sample, &observation, mode)?;
        Ok(TrainOutput { actions, latent, beside })
    }

    /// L1 over valid steps plus weighted KL, with a pointer cross-entropy, and what `auxiliary` asks, from a training forward
    /// pass.
    pub fn loss_of(&self, output: &TrainOutput, batch: &Batch) -> Result<LossParts> {
        let (b, c, a) = batch.actions.dims3()?;
        let valid = (1.0 - batch.is_pad.reshape((b, c, 1))?)?;
        let difference = absolute(&(&output.actions - &batch.actions)?)?;
        let entries = (batch.total_valid_steps * a).max(1) as f64;
        let l1 = (difference.broadcast_mul(&valid)?.sum_all()? / entries)?;
        let mut parts = BTreeMap::from([("l1_loss".to_string(), l1.detach())]);
        let mut total = l1;
        if let Some((mu, log_variance)) = &output.latent {
            let kld = kl_divergence(mu, log_variance, batch.total_rows)?;
            parts.insert("kld_loss".to_string(), kld.detach());
            total = (total + (kld * self.config.kl_weight)?)?;
        }
        if let (Some(pointer), Some(pointed)) = (&self.pointer, &output.beside.pointed) {
            let asked = pointer.asked("act", batch)?;
            let loss = asked.loss(&pointed.scores)?;
            parts.insert("pointer_loss".to_string(), loss.detach());
            parts.insert("pointer_right".to_string(), asked.right(&pointed.scores)?);
            total = (total + (loss * pointer.weight)?)?;
        }
        if let (Some(asked), Some(found)) = (&self.auxiliary, &output.beside.auxiliary) {
            let loss = asked.told("act", batch)?.loss(found)?;
            parts.insert("auxiliary_loss".to_string(), loss.detach());
            total = (total + (loss * asked.weight)?)?;
        }
        Ok(LossParts { total, parts })
    }

    pub(crate) fn check_batch(&self, batch: &Batch) -> Result<()> {
        check_batch("act", &self.signature, self.config.action_horizon, batch)
    }

    pub(crate) fn check_inputs(&self, observation: &Features<Tensor>) -> Result<usize> {
        check_observation("act", &self.signature, observation)
    }

    /// The prediction on candle's autograd; `predict` runs the same maths faster.
    pub fn predict_composed(&self, observation: &Features<Tensor>) -> Result<Tensor> {
        let rows = self.check_inputs(observation)?;
        let latent = Tensor::zeros((rows, self.config.latent_dim), DType::F32, self.action_head.weight.device())?;
        Ok(self.decode(&latent, &self.tokens.look(observation, None)?, &mut Mode::Eval)?.0)
    }

    /// The batch with pictures as the network reads them in training.
    fn looked_at(&self, batch: &Batch, rng: &mut Rng) -> Result<Batch> {
        self.check_batch(batch)?;
        Ok(Batch { observation: self.tokens.look(&batch.observation, Some(rng))?, ..batch.clone() })
    }
}

impl PolicyModel for Act {
    fn params(&self) -> &Params {
        &self.params
    }

    fn signature(&self) -> &Signature {
        &self.signature
    }

    fn composed_because(&self) -> Option<String> {
        not_by_hand(&self.signature)
    }

    fn loss(&self, batch: &Batch, rng: &mut Rng) -> Result<LossParts> {
        let batch = &self.looked_at(batch, rng)?;
        let shape = (batch.rows(), self.config.latent_dim);
        let eps = Tensor::from_vec(rng.normals(shape.0 * shape.1), shape, batch.device())?;
        let output = self.train_forward(batch, &eps, &mut Mode::Train(rng))?;
        self.loss_of(&output, batch)
    }

    fn accumulate_gradients(&self, batch: &Batch, rng: &mut Rng, into: &mut Gradients) -> Result<LossValues> {
        if self.composed_because().is_some() {
            return autograd(self, batch, rng, into);
        }
        let batch = &self.looked_at(batch, rng)?;
        let shape = (batch.rows(), self.config.latent_dim);
        let eps = Tensor::from_vec(rng.normals(shape.0 * shape.1), shape, batch.device())?;
        self.fused_gradients(batch, &eps, Some(rng), into)
    }

    fn predict(&self, observation: &Features<Tensor>) -> Result<Tensor> {
        match self.composed_because() {
            Some(_) => self.predict_composed(observation),
            None => self.fused_predict(observation, &mut || {}),
        }
    }

    fn sample_seen(&self, observation: &Features<Tensor>, _: &mut Rng, on_seen: &mut dyn FnMut()) -> Result<Tensor> {
        match self.composed_because() {
            Some(_) => self.predict_composed(observation),
            None => self.fused_predict(observation, on_seen),
        }
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
