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
//! hand-written backward passes (`act_fused.rs`); tests hold the two together.

use crate::batch::{Batch, Dims};
use crate::error::{ModelError, Result};
use crate::fused::Workspaces;
use crate::gradients::Gradients;
use crate::layers::{
    Activation, Dropout, Embedding, FeedForward, LayerNorm, Linear, Mode, MultiHeadAttention, sinusoid_table,
};
use crate::model::{LossParts, LossValues, PolicyModel};
use crate::params::{Init, Params};
use crate::rng::Rng;
use candle_core::{DType, Tensor};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// ACT's options; defaults are LeRobot's.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// actions predicted at once (LeRobot: `chunk_size`)
    pub action_horizon: usize,
    /// normalise before each branch instead of after it
    pub pre_norm: bool,
    /// width
    pub dim_model: usize,
    /// attention heads
    pub n_heads: usize,
    /// hidden width of the feed-forward layers
    pub dim_feedforward: usize,
    /// activation of the feed-forward layers
    pub feedforward_activation: Activation,
    /// encoder layers
    pub n_encoder_layers: usize,
    /// decoder layers
    pub n_decoder_layers: usize,
    /// train with a latent
    pub use_vae: bool,
    /// width of the latent
    pub latent_dim: usize,
    /// layers of the VAE encoder
    pub n_vae_encoder_layers: usize,
    /// dropout probability
    pub dropout: f64,
    /// weight of the KL term
    pub kl_weight: f64,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            action_horizon: 100,
            pre_norm: false,
            dim_model: 512,
            n_heads: 8,
            dim_feedforward: 3200,
            feedforward_activation: Activation::Relu,
            n_encoder_layers: 4,
            n_decoder_layers: 1,
            use_vae: true,
            latent_dim: 32,
            n_vae_encoder_layers: 4,
            dropout: 0.1,
            kl_weight: 10.0,
        }
    }
}

impl Config {
    /// Checks that a model with this configuration can exist.
    ///
    /// # Errors
    /// The first field that makes it impossible.
    pub fn validate(&self) -> Result<()> {
        let refuse = |field: &'static str, found: String, expected: &str| {
            Err(ModelError::Config { model: "act", field, found, expected: expected.to_string() })
        };
        for (field, value) in [
            ("action_horizon", self.action_horizon),
            ("dim_model", self.dim_model),
            ("n_heads", self.n_heads),
            ("dim_feedforward", self.dim_feedforward),
            ("n_encoder_layers", self.n_encoder_layers),
            ("n_decoder_layers", self.n_decoder_layers),
            ("latent_dim", self.latent_dim),
        ] {
            if value == 0 {
                return refuse(field, value.to_string(), "at least 1");
            }
        }
        if self.use_vae && self.n_vae_encoder_layers == 0 {
            return refuse("n_vae_encoder_layers", "0".to_string(), "at least 1 with use_vae");
        }
        if !self.dim_model.is_multiple_of(self.n_heads) {
            return refuse("n_heads", self.n_heads.to_string(), &format!("a divisor of dim_model, {}", self.dim_model));
        }
        if !(0.0..1.0).contains(&self.dropout) {
            return refuse("dropout", self.dropout.to_string(), "at least 0 and below 1");
        }
        if !self.kl_weight.is_finite() {
            return refuse("kl_weight", self.kl_weight.to_string(), "a finite number");
        }
        if self.feedforward_activation == Activation::Glu {
            return refuse(
                "feedforward_activation",
                "glu".to_string(),
                "relu or gelu (glu halves the width that linear2 expects)",
            );
        }
        Ok(())
    }
}

/// One encoder layer: self-attention and feed-forward, each with a residual.
#[derive(Debug)]
pub(crate) struct EncoderLayer {
    pub(crate) self_attn: MultiHeadAttention,
    pub(crate) ff: FeedForward,
    pub(crate) norm1: LayerNorm,
    pub(crate) norm2: LayerNorm,
    dropout: Dropout,
    pre_norm: bool,
}

impl EncoderLayer {
    pub(crate) fn new(
        params: &mut Params,
        prefix: &str,
        config: &Config,
        init: LayerInit,
        rng: &mut Rng,
    ) -> Result<Self> {
        let (dim, p) = (config.dim_model, config.dropout);
        let attn = format!("{prefix}.self_attn");
        let hidden = (dim, config.dim_feedforward);
        let ff = config.feedforward_activation;
        Ok(Self {
            self_attn: MultiHeadAttention::new(params, &attn, dim, config.n_heads, p, init.weight(), rng)?,
            ff: FeedForward::new(params, &format!("{prefix}."), hidden, ff, p, init.weight(), rng)?,
            norm1: LayerNorm::new(params, &format!("{prefix}.norm1"), dim, rng)?,
            norm2: LayerNorm::new(params, &format!("{prefix}.norm2"), dim, rng)?,
            dropout: Dropout { p },
            pre_norm: config.pre_norm,
        })
    }

    /// x: (b, t, D), pos: (1, t, D) -> (b, t, D)
    pub(crate) fn forward(
        &self,
        x: &Tensor,
        pos: &Tensor,
        key_pad: Option<&Tensor>,
        mode: &mut Mode<'_>,
    ) -> Result<Tensor> {
        let y = if self.pre_norm { self.norm1.forward(x)? } else { x.clone() };
        let qk = y.broadcast_add(pos)?;
        let branch = self.self_attn.forward(&qk, &qk, &y, key_pad, mode)?;
        let x = (x + self.dropout.forward(&branch, mode)?)?;
        let (x, y) = if self.pre_norm {
            let y = self.norm2.forward(&x)?;
            (x, y)
        } else {
            let x = self.norm1.forward(&x)?;
            (x.clone(), x)
        };
        let branch = self.ff.forward(&y, mode)?;
        let x = (x + self.dropout.forward(&branch, mode)?)?;
        if self.pre_norm { Ok(x) } else { self.norm2.forward(&x) }
    }
}

/// Encoder layers, and a final norm if they are pre-norm.
#[derive(Debug)]
pub(crate) struct Encoder {
    pub(crate) layers: Vec<EncoderLayer>,
    pub(crate) norm: Option<LayerNorm>,
}

impl Encoder {
    pub(crate) fn new(
        params: &mut Params,
        prefix: &str,
        n_layers: usize,
        config: &Config,
        init: LayerInit,
        rng: &mut Rng,
    ) -> Result<Self> {
        let layers = (0..n_layers)
            .map(|i| EncoderLayer::new(params, &format!("{prefix}.layers.{i}"), config, init, rng))
            .collect::<Result<_>>()?;
        let norm = match config.pre_norm {
            true => Some(LayerNorm::new(params, &format!("{prefix}.norm"), config.dim_model, rng)?),
            false => None,
        };
        Ok(Self { layers, norm })
    }

    /// x: (b, t, D), pos: (1, t, D) -> (b, t, D)
    pub(crate) fn forward(
        &self,
        x: &Tensor,
        pos: &Tensor,
        key_pad: Option<&Tensor>,
        mode: &mut Mode<'_>,
    ) -> Result<Tensor> {
        let mut x = x.clone();
        for layer in &self.layers {
            x = layer.forward(&x, pos, key_pad, mode)?;
        }
        match &self.norm {
            Some(norm) => norm.forward(&x),
            None => Ok(x),
        }
    }
}

/// One decoder layer: self-attention, attention to the encoder's output, feed-forward.
#[derive(Debug)]
pub(crate) struct DecoderLayer {
    pub(crate) self_attn: MultiHeadAttention,
    pub(crate) multihead_attn: MultiHeadAttention,
    pub(crate) ff: FeedForward,
    pub(crate) norm1: LayerNorm,
    pub(crate) norm2: LayerNorm,
    pub(crate) norm3: LayerNorm,
    dropout: Dropout,
    pre_norm: bool,
}

impl DecoderLayer {
    pub(crate) fn new(params: &mut Params, prefix: &str, config: &Config, rng: &mut Rng) -> Result<Self> {
        let (dim, p, init) = (config.dim_model, config.dropout, LayerInit::Xavier.weight());
        let hidden = (dim, config.dim_feedforward);
        let act = config.feedforward_activation;
        let mut attention = |name: &str| {
            MultiHeadAttention::new(params, &format!("{prefix}.{name}"), dim, config.n_heads, p, init, rng)
        };
        let (self_attn, multihead_attn) = (attention("self_attn")?, attention("multihead_attn")?);
        let ff = FeedForward::new(params, &format!("{prefix}."), hidden, act, p, init, rng)?;
        let mut norm = |name: &str| LayerNorm::new(params, &format!("{prefix}.{name}"), dim, rng);
        let (norm1, norm2, norm3) = (norm("norm1")?, norm("norm2")?, norm("norm3")?);
        let dropout = Dropout { p };
        Ok(Self { self_attn, multihead_attn, ff, norm1, norm2, norm3, dropout, pre_norm: config.pre_norm })
    }

    /// x: (b, c, D), query_pos: (1, c, D), memory: (b, m, D), memory_pos: (1, m, D) -> (b, c, D)
    pub(crate) fn forward(
        &self,
        x: &Tensor,
        query_pos: &Tensor,
        memory: &Tensor,
        memory_pos: &Tensor,
        mode: &mut Mode<'_>,
    ) -> Result<Tensor> {
        // a branch reads norm(x) when pre-norm; otherwise the norm comes after the residual
        let before = |norm: &LayerNorm, x: &Tensor| if self.pre_norm { norm.forward(x) } else { Ok(x.clone()) };
        let after = |norm: &LayerNorm, x: Tensor| if self.pre_norm { Ok(x) } else { norm.forward(&x) };

        let y = before(&self.norm1, x)?;
        let qk = y.broadcast_add(query_pos)?;
        let branch = self.self_attn.forward(&qk, &qk, &y, None, mode)?;
        let x = after(&self.norm1, (x + self.dropout.forward(&branch, mode)?)?)?;

        let q = before(&self.norm2, &x)?.broadcast_add(query_pos)?;
        let k = memory.broadcast_add(memory_pos)?;
        let branch = self.multihead_attn.forward(&q, &k, memory, None, mode)?;
        let x = after(&self.norm2, (x + self.dropout.forward(&branch, mode)?)?)?;

        let branch = self.ff.forward(&before(&self.norm3, &x)?, mode)?;
        after(&self.norm3, (&x + self.dropout.forward(&branch, mode)?)?)
    }
}

/// How the matrices of a transformer layer start.
#[derive(Debug, Clone, Copy)]
pub(crate) enum LayerInit {
    /// encoder and decoder
    Xavier,
    /// VAE encoder
    TorchDefault,
}

impl LayerInit {
    pub(crate) fn weight(self) -> Init {
        match self {
            Self::Xavier => Init::XavierUniform,
            Self::TorchDefault => Init::KaimingUniform,
        }
    }
}

/// The part that encodes an action chunk into a latent; training only.
#[derive(Debug)]
pub(crate) struct Vae {
    pub(crate) encoder: Encoder,
    pub(crate) cls_embed: Embedding,
    pub(crate) robot_state_input_proj: Linear,
    pub(crate) action_input_proj: Linear,
    pub(crate) latent_output_proj: Linear,
}

impl Vae {
    pub(crate) fn new(p: &mut Params, config: &Config, dims: &Dims, rng: &mut Rng) -> Result<Self> {
        let (dim, layers) = (config.dim_model, config.n_vae_encoder_layers);
        Ok(Self {
            encoder: Encoder::new(p, "vae_encoder", layers, config, LayerInit::TorchDefault, rng)?,
            cls_embed: Embedding::new(p, "vae_encoder_cls_embed", 1, dim, rng)?,
            robot_state_input_proj: Linear::new(p, "vae_encoder_robot_state_input_proj", dims.state, dim, rng)?,
            action_input_proj: Linear::new(p, "vae_encoder_action_input_proj", dims.action, dim, rng)?,
            latent_output_proj: Linear::new(p, "vae_encoder_latent_output_proj", dim, 2 * config.latent_dim, rng)?,
        })
    }

    /// actions: (b, C, A), is_pad: (b, C), pos: (1, C + 2, D) -> mean and log-variance of the latent, (b, L) each
    pub(crate) fn encode(&self, batch: &Batch, pos: &Tensor, mode: &mut Mode<'_>) -> Result<(Tensor, Tensor)> {
        let (b, dim) = (batch.rows(), self.cls_embed.weight.dim(1)?);
        let latent = self.latent_output_proj.weight.dim(0)? / 2;
        let cls = self.cls_embed.weight.reshape((1, 1, dim))?.broadcast_as((b, 1, dim))?;
        let state = self.robot_state_input_proj.forward(&batch.state)?.unsqueeze(1)?;
        let actions = self.action_input_proj.forward(&batch.actions)?;
        let tokens = Tensor::cat(&[&cls.contiguous()?, &state, &actions], 1)?;
        let always = Tensor::zeros((b, 2), DType::F32, tokens.device())?;
        let key_pad = Tensor::cat(&[&always, &batch.is_pad], 1)?;
        let x = self.encoder.forward(&tokens, pos, Some(&key_pad), mode)?;
        let out = self.latent_output_proj.forward(&x.narrow(1, 0, 1)?.squeeze(1)?)?;
        Ok((out.narrow(1, 0, latent)?, out.narrow(1, latent, latent)?))
    }
}

/// A sample of the latent with noise `eps`: (b, L)
pub(crate) fn sample((mu, log_variance): &(Tensor, Tensor), eps: &Tensor) -> Result<Tensor> {
    Ok((mu + (log_variance / 2.0)?.exp()?.mul(eps)?)?)
}

/// Observations as tokens, a dense layer each.
#[derive(Debug)]
pub(crate) struct InputTokens {
    pub(crate) latent: Linear,
    pub(crate) robot_state: Linear,
    pub(crate) env_state: Option<Linear>,
}

impl InputTokens {
    /// latent: (b, L), state: (b, S), environment_state: (b, E) -> (b, M, D)
    pub(crate) fn forward(
        &self,
        latent: &Tensor,
        state: &Tensor,
        environment_state: Option<&Tensor>,
    ) -> Result<Tensor> {
        let mut tokens =
            vec![self.latent.forward(latent)?.unsqueeze(1)?, self.robot_state.forward(state)?.unsqueeze(1)?];
        if let (Some(layer), Some(env)) = (&self.env_state, environment_state) {
            tokens.push(layer.forward(env)?.unsqueeze(1)?);
        }
        Ok(Tensor::cat(&tokens, 1)?)
    }
}

/// Decoder layers over learned queries, and their final norm.
#[derive(Debug)]
pub(crate) struct Decoder {
    pub(crate) layers: Vec<DecoderLayer>,
    pub(crate) norm: LayerNorm,
    /// (C, D)
    pub(crate) pos_embed: Embedding,
}

impl Decoder {
    /// memory: (b, M, D), pos: (1, M, D) -> (b, C, D)
    pub(crate) fn forward(&self, memory: &Tensor, pos: &Tensor, mode: &mut Mode<'_>) -> Result<Tensor> {
        let query_pos = self.pos_embed.weight.unsqueeze(0)?;
        let (c, dim) = self.pos_embed.weight.dims2()?;
        let mut x = Tensor::zeros((memory.dim(0)?, c, dim), DType::F32, memory.device())?;
        for layer in &self.layers {
            x = layer.forward(&x, &query_pos, memory, pos, mode)?;
        }
        self.norm.forward(&x)
    }
}

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
        let dim = config.dim_model;
        let vae = match config.use_vae {
            true => Some(Vae::new(&mut p, config, dims, rng)?),
            false => None,
        };
        let encoder = Encoder::new(&mut p, "encoder", config.n_encoder_layers, config, LayerInit::Xavier, rng)?;
        // in the order in which initial weights are drawn
        let layers = (0..config.n_decoder_layers)
            .map(|i| DecoderLayer::new(&mut p, &format!("decoder.layers.{i}"), config, rng))
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

/// |x| whose gradient at 0 is 0, as torch's; candle's own is 1 there.
pub(crate) fn absolute(x: &Tensor) -> Result<Tensor> {
    let sign = (x.gt(0.0)?.to_dtype(DType::F32)? - x.lt(0.0)?.to_dtype(DType::F32)?)?;
    Ok(x.mul(&sign.detach())?)
}

pub(crate) fn check_shape(
    operation: &'static str,
    object: &'static str,
    tensor: &Tensor,
    expected: &[usize],
) -> Result<()> {
    if tensor.dims() == expected {
        return Ok(());
    }
    let (expected, found) = (expected.to_vec(), tensor.dims().to_vec());
    Err(ModelError::Shape { operation, object, expected, found })
}

/// Checks that there is something to see and something to do.
pub(crate) fn check_dims(model: &'static str, dims: &Dims) -> Result<()> {
    for (field, size) in [("dims.state", dims.state), ("dims.action", dims.action)] {
        if size == 0 {
            let expected = "at least 1".to_string();
            return Err(ModelError::Config { model, field, found: "0".to_string(), expected });
        }
    }
    Ok(())
}

/// Checks a batch of windows against the model's sizes.
pub(crate) fn check_batch(operation: &'static str, dims: &Dims, action_horizon: usize, batch: &Batch) -> Result<()> {
    check_observation(operation, dims, &batch.state, batch.environment_state.as_ref())?;
    let expected = [batch.rows(), action_horizon, dims.action];
    check_shape(operation, "actions", &batch.actions, &expected)?;
    check_shape(operation, "is_pad", &batch.is_pad, &expected[..2])
}

/// Checks `state: (b, S)` and `environment_state: (b, E)` against the model's sizes.
pub(crate) fn check_observation(
    operation: &'static str,
    dims: &Dims,
    state: &Tensor,
    environment_state: Option<&Tensor>,
) -> Result<()> {
    let b = state.dims().first().copied().unwrap_or(0).max(1);
    check_shape(operation, "state", state, &[b, dims.state])?;
    match (environment_state, dims.environment_state) {
        (None, 0) => Ok(()),
        (Some(env), e) if e > 0 => check_shape(operation, "environment_state", env, &[b, e]),
        (given, e) => Err(ModelError::Input {
            operation,
            object: "environment_state",
            found: given.map_or("absent".to_string(), |t| format!("{:?}", t.dims())),
            expected: if e == 0 { "absent".to_string() } else { format!("[{b}, {e}]") },
        }),
    }
}

/// KL(latent ‖ N(0, 1)), summed over the latent and averaged over `total_rows`.
pub(crate) fn kl_divergence(mu: &Tensor, log_variance: &Tensor, total_rows: usize) -> Result<Tensor> {
    let terms = ((log_variance + 1.0)? - mu.sqr()? - log_variance.exp()?)?;
    Ok((terms.sum_all()? * (-0.5 / total_rows.max(1) as f64))?)
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
