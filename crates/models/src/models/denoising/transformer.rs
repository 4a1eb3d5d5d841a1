//! The transformer that takes noise out of an action sequence, in the UNet's place: Chi et al.'s `TransformerForDiffusion`
//! (github.com/real-stanford/diffusion_policy) with its tensor names and its initial weights. The step and what is observed at
//! every step are tokens, which a small network reads one by one; the decoder's tokens are the actions.
//!
//! Deviations: every action attends to all observations (there, with `causal_attn`, the first ones not to the last ones);
//! no dropout of tokens (0 in their experiments on low-dimensional observations) and no encoder over the observations
//! (`n_cond_layers`, 0 there); no images.
//!
//! With `n_encoder_layers` it reads one encoded token a feature in place of those steps, as ACT's decoder does.

use super::unet::embedding;
use crate::flops;
use crate::layers::{Activation, DecoderLayer, LayerNorm, Linear, PointerConfig, Shape};
use candle_core::Tensor;
use nn::ops::{add, cat_tokens, layer_norm, linear, mish};
use nn::{Context, Init, ModelError, Params, Result, Rng, Size, Value};
use serde::{Deserialize, Serialize};

/// What the names of its parameters begin with.
const PREFIX: &str = "transformer";
/// Deviation of initial matrices and positions.
const STD: f64 = 0.02;

/// Options of the network, with the values of Chi et al.'s experiments on low-dimensional observations.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TransformerConfig {
    /// width of a token (Chi et al.: `n_emb`)
    pub dim_model: usize,
    /// attention heads
    pub n_heads: usize,
    /// decoder layers
    pub n_layers: usize,
    /// dropout of attention weights and branches (Chi et al.: `p_drop_attn`)
    pub dropout: f64,
    /// whether an action attends only to itself and earlier ones (Chi et al.: `causal_attn`)
    pub causal: bool,
    /// pre-norm encoder layers over one token for each feature of the observation, as ACT's; 0: a token for each step of it (Chi et al.)
    #[serde(skip_serializing_if = "is_zero")]
    pub n_encoder_layers: usize,
    /// auxiliary loss on which entity was taken (with `n_encoder_layers`)
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pointer: Option<PointerConfig>,
}

#[allow(clippy::trivially_copy_pass_by_ref)] // serde's
fn is_zero(layers: &usize) -> bool {
    *layers == 0
}

impl Default for TransformerConfig {
    fn default() -> Self {
        Self { dim_model: 256, n_heads: 4, n_layers: 8, dropout: 0.3, causal: true, n_encoder_layers: 0, pointer: None }
    }
}

impl TransformerConfig {
    /// Checks that a network over `action_horizon` steps can exist.
    ///
    /// # Errors
    /// The first field that makes it impossible.
    pub fn validate(&self, model: &'static str, action_horizon: usize) -> Result<()> {
        let refuse = |field, found: String, expected: String| Err(ModelError::Config { model, field, found, expected });
        if action_horizon == 0 {
            return refuse("action_horizon", "0".to_string(), "at least 1".to_string());
        }
        if self.dim_model < 4 || !self.dim_model.is_multiple_of(2) {
            let found = self.dim_model.to_string();
            return refuse("transformer.dim_model", found, "an even number from 4".to_string());
        }
        if self.n_heads == 0 || !self.dim_model.is_multiple_of(self.n_heads) {
            let expected = format!("a divisor of dim_model, {}", self.dim_model);
            return refuse("transformer.n_heads", self.n_heads.to_string(), expected);
        }
        if self.n_layers == 0 {
            return refuse("transformer.n_layers", "0".to_string(), "at least 1".to_string());
        }
        if !(0.0..1.0).contains(&self.dropout) {
            return refuse("transformer.dropout", self.dropout.to_string(), "at least 0 and below 1".to_string());
        }
        if let Some(pointer) = &self.pointer {
            if self.n_encoder_layers == 0 {
                let found = format!("among {}", pointer.among);
                return refuse("transformer.pointer", found, "absent without n_encoder_layers".to_string());
            }
            pointer.validate(model)?;
        }
        Ok(())
    }

    /// How large the network will be over `action_horizon` steps, without what depends on observation and action.
    pub fn size(&self, action_horizon: usize) -> Size {
        let (dim, steps) = (self.dim_model as f64, action_horizon as f64);
        let before = Size { weights: 8.0 * dim * dim + steps * dim, activations: 8.0 * dim };
        let encoder = self.shape().size(1, action_horizon) * self.n_encoder_layers;
        before + encoder + self.shape().size(2, action_horizon) * self.n_layers
    }

    /// What its layers share.
    pub(super) fn shape(&self) -> Shape {
        Shape {
            dim: self.dim_model,
            heads: self.n_heads,
            hidden: 4 * self.dim_model,
            activation: Activation::Gelu,
            dropout: self.dropout,
            pre_norm: true,
        }
    }
}

/// Sizes around the network.
#[derive(Debug, Clone, Copy)]
pub(super) struct Around {
    pub(super) horizon: usize,
    pub(super) action_dim: usize,
    /// parts of an observation: its steps, or its tokens
    pub(super) parts: usize,
    /// numbers of one of them
    pub(super) width: usize,
}

/// The network.
#[derive(Debug)]
pub(super) struct Transformer {
    dim: usize,
    shape: Shape,
    around: Around,
    input_emb: Linear,
    /// (1, T, D)
    pos_emb: Tensor,
    cond_obs_emb: Linear,
    /// (1, 1 + observations, D)
    cond_pos_emb: Tensor,
    encoder: [Linear; 2],
    layers: Vec<DecoderLayer>,
    ln_f: LayerNorm,
    head: Linear,
}

impl Transformer {
    /// `config` was validated.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub(super) fn new(p: &mut Params, around: Around, config: &TransformerConfig, rng: &mut Rng) -> Result<Self> {
        let (dim, shape) = (config.dim_model, config.shape());
        let Around { horizon, action_dim, parts, width } = around;
        let name = |last: &str| format!("{PREFIX}.{last}");
        let normal = Init::Normal { std: STD };
        let linear = |p: &mut Params, last: &str, sizes, rng: &mut Rng| {
            Linear::with_init(p, &name(last), sizes, normal, Some(Init::Zeros), rng)
        };
        let mut layers = Vec::with_capacity(config.n_layers);
        for i in 0..config.n_layers {
            let mut layer = DecoderLayer::new(p, &name(&format!("decoder.layers.{i}")), shape, rng)?;
            layer.self_attn.causal = config.causal;
            layers.push(layer);
        }
        // the layers' matrices begin as everything else
        let of_layers = name("decoder.");
        for (_, var) in p.iter().filter(|(name, var)| name.starts_with(&of_layers) && var.dims().len() == 2) {
            var.set(&Tensor::from_vec(normal.values(var.dims(), rng), var.dims(), var.device())?)?;
        }
        Ok(Self {
            dim,
            shape,
            around,
            input_emb: linear(p, "input_emb", (action_dim, dim), rng)?,
            pos_emb: p.create(&name("pos_emb"), &[1, horizon, dim], normal, rng)?,
            cond_obs_emb: linear(p, "cond_obs_emb", (width, dim), rng)?,
            cond_pos_emb: p.create(&name("cond_pos_emb"), &[1, 1 + parts, dim], normal, rng)?,
            encoder: [linear(p, "encoder.0", (dim, 4 * dim), rng)?, linear(p, "encoder.2", (4 * dim, dim), rng)?],
            layers,
            ln_f: LayerNorm::new(p, &name("ln_f"), dim, rng)?,
            head: linear(p, "head", (dim, action_dim), rng)?,
        })
    }

    /// x: (b, T, A), the step of each row, cond: (b, observations * width) -> (b, T, A)
    ///
    /// # Errors
    /// Shapes that do not go together.
    pub(super) fn apply(&self, cx: &mut Context<'_>, x: &Value, steps: &[f32], cond: &Value) -> Result<Value> {
        let (rows, dim, device) = (steps.len(), self.dim, cx.device().clone());
        let Around { horizon, parts, width, .. } = self.around;
        let time = Value::of(embedding(steps, dim), (rows, 1, dim), &device)?;
        let observed = linear(cx, &cond.reshape((rows, parts, width))?, &self.cond_obs_emb)?;
        let tokens = cat_tokens(cx, rows, &[&time, &observed])?;
        let positions = cx.parameter(&self.cond_pos_emb)?;
        let tokens = add(cx, &positions, &tokens)?;
        let [first, second] = &self.encoder;
        let hidden = linear(cx, &tokens, first)?;
        let hidden = mish(cx, &hidden)?;
        let memory = linear(cx, &hidden, second)?;
        // positions are in the tokens already
        let zeros = |tokens: usize| Value::zeros((1, tokens, dim), &device);
        let (none, none_of_memory) = (zeros(horizon)?, zeros(1 + parts)?);
        let x = linear(cx, x, &self.input_emb)?;
        let positions = cx.parameter(&self.pos_emb)?;
        let mut x = add(cx, &positions, &x)?;
        for layer in &self.layers {
            x = layer.apply(cx, &x, &none, &memory, &none_of_memory)?;
        }
        let x = layer_norm(cx, &x, &self.ln_f)?;
        linear(cx, &x, &self.head)
    }
    /// Floating-point operations of an answer.
    pub(super) fn flops(&self) -> f64 {
        let (dim, Around { horizon, action_dim, parts, width }) = (self.dim, self.around);
        let memory = flops::linear(parts, width, dim) + flops::linear(1 + parts, dim, 8 * dim);
        let layers = flops::decoder_layer(self.shape, horizon, 1 + parts) * self.layers.len() as f64;
        memory + layers + flops::linear(horizon, dim, 2 * action_dim)
    }
}
