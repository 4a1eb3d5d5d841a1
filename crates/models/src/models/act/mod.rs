//! ACT, Action Chunking with Transformers: a conditional VAE whose decoder predicts a chunk of actions at once.
//!
//! Paper: Zhao et al., "Learning Fine-Grained Bimanual Manipulation with Low-Cost Hardware", arXiv 2304.13705.
//! Reference: `ACTPolicy` of LeRobot 0.6.1 on low-dimensional observations; tensor names are its own, less the prefix
//! `model.`, which belongs to its file format.
//!
//! Training: the VAE encoder reads `[cls, state, actions…]` and gives the mean and log-variance of a latent. The encoder
//! reads `[latent, state, environment state]`; the decoder's queries are learned positions, one per action of the chunk.
//! Loss: L1 over the steps that are not padding, plus `kl_weight` times KL(latent ‖ N(0, 1)). Inference: latent = 0.
//!
//! Deviations: none in the maths. `feedforward_activation = "glu"` is refused: LeRobot accepts it in its configuration,
//! but its layer then cannot run (`glu` halves the width that `linear2` expects). Images are not supported.
//!
//! This file is the model as one reads it, on candle's autograd. Training steps and predictions run the same maths with
//! hand-written backward passes (`fused.rs`); tests hold the two together.

mod config;
mod fused;

pub use config::Config;

use crate::batch::{Batch, Dims};
use crate::checks::{check_batch, check_dims, check_observation};
use crate::error::Result;
use crate::fused::Workspaces;
use crate::gradients::Gradients;
use crate::layers::{
    Decoder, DecoderLayer, Embedding, Encoder, InputTokens, LayerInit, LayerNorm, Linear, Mode, Vae, kl_divergence,
    sample, sinusoid_table,
};
use crate::losses::absolute;
use crate::model::{LossParts, LossValues, PolicyModel};
use crate::params::Params;
use crate::rng::Rng;
use candle_core::{DType, Tensor};
use std::collections::BTreeMap;

/// What the training forward pass gives.
#[derive(Debug)]
pub struct TrainOutput {
    /// (b, action_horizon, A)
    pub actions: Tensor,
    /// mean and log-variance of the latent, (b, latent_dim) each; `None` without VAE
    pub latent: Option<(Tensor, Tensor)>,
}

/// The model.
#[derive(Debug)]
pub struct Act {
    config: Config,
    dims: Dims,
    params: Params,
    pub(crate) vae: Option<Vae>,
    pub(crate) encoder: Encoder,
    pub(crate) decoder: Decoder,
    pub(crate) tokens: InputTokens,
    pub(crate) encoder_1d_feature_pos_embed: Embedding,
    pub(crate) action_head: Linear,
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
    /// A configuration or dimensions that describe no possible model.
    pub fn new(config: &Config, dims: &Dims, seed: u64) -> Result<Self> {
        config.validate()?;
        check_dims("act", dims)?;
        let rng = &mut Rng::new(seed, "init");
        let mut p = Params::new();
        let (dim, shape) = (config.dim_model, config.shape());
        let vae = match config.use_vae {
            true => Some(Vae::new(&mut p, shape, (config.n_vae_encoder_layers, config.latent_dim), dims, rng)?),
            false => None,
        };
        let encoder = Encoder::new(&mut p, "encoder", config.n_encoder_layers, shape, LayerInit::Xavier, rng)?;
        // in the order in which initial weights are drawn
        let layers = (0..config.n_decoder_layers)
            .map(|i| DecoderLayer::new(&mut p, &format!("decoder.layers.{i}"), shape, rng))
            .collect::<Result<_>>()?;
        let env_state = match dims.environment_state {
            0 => None,
            e => Some(Linear::new(&mut p, "encoder_env_state_input_proj", e, dim, rng)?),
        };
        let n_tokens = 2 + usize::from(env_state.is_some());
        let norm = LayerNorm::new(&mut p, "decoder.norm", dim, rng)?;
        let latent = Linear::new(&mut p, "encoder_latent_input_proj", config.latent_dim, dim, rng)?;
        let robot_state = Linear::new(&mut p, "encoder_robot_state_input_proj", dims.state, dim, rng)?;
        let feature_pos = Embedding::new(&mut p, "encoder_1d_feature_pos_embed", n_tokens, dim, rng)?;
        let pos_embed = Embedding::new(&mut p, "decoder_pos_embed", config.action_horizon, dim, rng)?;
        let table = sinusoid_table(config.action_horizon + 2, dim)?;
        Ok(Self {
            vae,
            encoder,
            decoder: Decoder { layers, norm, pos_embed },
            tokens: InputTokens { latent, robot_state, env_state },
            encoder_1d_feature_pos_embed: feature_pos,
            action_head: Linear::new(&mut p, "action_head", dim, dims.action, rng)?,
            workspaces: Workspaces::default(),
            position_table: table.flatten_all()?.to_vec1()?,
            vae_encoder_pos_enc: table,
            params: p,
            config: config.clone(),
            dims: *dims,
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

    /// Sizes of its inputs and outputs.
    pub fn dims(&self) -> &Dims {
        &self.dims
    }

    /// latent: (b, L), state: (b, S), environment_state: (b, E) -> (b, C, A)
    fn decode(
        &self,
        latent: &Tensor,
        state: &Tensor,
        environment_state: Option<&Tensor>,
        mode: &mut Mode<'_>,
    ) -> Result<Tensor> {
        let tokens = self.tokens.forward(latent, state, environment_state)?;
        let pos = self.encoder_1d_feature_pos_embed.weight.unsqueeze(0)?;
        let memory = self.encoder.forward(&tokens, &pos, None, mode)?;
        self.action_head.forward(&self.decoder.forward(&memory, &pos, mode)?)
    }

    /// The training forward pass with dropout from `mode` and the latent's noise `eps`: (b, L).
    ///
    /// # Errors
    /// Inputs of the wrong shape.
    pub fn train_forward(&self, batch: &Batch, eps: &Tensor, mode: &mut Mode<'_>) -> Result<TrainOutput> {
        self.check_batch(batch)?;
        let latent = match &self.vae {
            Some(vae) => Some(vae.encode(batch, &self.vae_encoder_pos_enc, mode)?),
            None => None,
        };
        let sample = match &latent {
            Some(latent) => sample(latent, eps)?,
            None => eps.zeros_like()?,
        };
        let actions = self.decode(&sample, &batch.state, batch.environment_state.as_ref(), mode)?;
        Ok(TrainOutput { actions, latent })
    }

    /// L1 over valid steps plus weighted KL, from a training forward pass.
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
        Ok(LossParts { total, parts })
    }

    pub(crate) fn check_batch(&self, batch: &Batch) -> Result<()> {
        check_batch("act", &self.dims, self.config.action_horizon, batch)
    }

    pub(crate) fn check_inputs(&self, state: &Tensor, environment_state: Option<&Tensor>) -> Result<()> {
        check_observation("act", &self.dims, state, environment_state)
    }

    /// The prediction on candle's autograd; `predict` runs the same maths faster.
    pub fn predict_composed(&self, state: &Tensor, environment_state: Option<&Tensor>) -> Result<Tensor> {
        self.check_inputs(state, environment_state)?;
        let latent = Tensor::zeros((state.dim(0)?, self.config.latent_dim), DType::F32, state.device())?;
        self.decode(&latent, state, environment_state, &mut Mode::Eval)
    }
}

impl PolicyModel for Act {
    fn params(&self) -> &Params {
        &self.params
    }

    fn loss(&self, batch: &Batch, rng: &mut Rng) -> Result<LossParts> {
        let shape = (batch.rows(), self.config.latent_dim);
        let eps = Tensor::from_vec(rng.normals(shape.0 * shape.1), shape, batch.state.device())?;
        let output = self.train_forward(batch, &eps, &mut Mode::Train(rng))?;
        self.loss_of(&output, batch)
    }

    fn accumulate_gradients(&self, batch: &Batch, rng: &mut Rng, into: &mut Gradients) -> Result<LossValues> {
        let shape = (batch.rows(), self.config.latent_dim);
        let eps = Tensor::from_vec(rng.normals(shape.0 * shape.1), shape, batch.state.device())?;
        self.fused_gradients(batch, &eps, Some(rng), into)
    }

    fn predict(&self, state: &Tensor, environment_state: Option<&Tensor>) -> Result<Tensor> {
        self.fused_predict(state, environment_state)
    }

    fn action_horizon(&self) -> usize {
        self.config.action_horizon
    }
}
