//! The VAE encoder of an action chunk.

use super::tokens::TokenLayout;
use super::{Embedding, Encoder, LayerInit, Linear, Shape};
use crate::batch::Batch;
use candle_core::{DType, Tensor};
use nn::Params;
use nn::Result;
use nn::Rng;
use nn::ops::{cat_tokens, linear};
use nn::{Context, Value};

/// The part that encodes an action chunk into a latent; training only.
#[derive(Debug)]
pub(crate) struct Vae {
    /// the feature that it reads
    state: String,
    encoder: Encoder,
    cls_embed: Embedding,
    robot_state_input_proj: Linear,
    action_input_proj: Linear,
    latent_output_proj: Linear,
}

impl Vae {
    /// `n_layers` encoder layers and a latent `latent_dim` wide.
    pub(crate) fn new(
        p: &mut Params,
        shape: Shape,
        (n_layers, latent_dim): (usize, usize),
        (layout, action_dim): (&TokenLayout, usize),
        rng: &mut Rng,
    ) -> Result<Self> {
        let (dim, state) = (shape.dim, layout.state());
        Ok(Self {
            state: state.feature.clone(),
            encoder: Encoder::new(p, "vae_encoder", n_layers, shape, LayerInit::TorchDefault, rng)?,
            cls_embed: Embedding::new(p, "vae_encoder_cls_embed", 1, dim, rng)?,
            robot_state_input_proj: Linear::new(p, "vae_encoder_robot_state_input_proj", state.width, dim, rng)?,
            action_input_proj: Linear::new(p, "vae_encoder_action_input_proj", action_dim, dim, rng)?,
            latent_output_proj: Linear::new(p, "vae_encoder_latent_output_proj", dim, 2 * latent_dim, rng)?,
        })
    }

    /// actions: (b, C, A), is_pad: (b, C), pos: (1, C + 2, D) -> mean and log-variance of the latent, (b, 2L)
    pub(crate) fn apply(&self, cx: &mut Context<'_>, batch: &Batch, pos: &Tensor) -> Result<Value> {
        let (b, dim) = (batch.rows(), self.cls_embed.weight.dim(1)?);
        let cls = cx.parameter(&self.cls_embed.weight)?.reshape((1, 1, dim))?;
        let state = batch.observation.require("latent", &self.state)?.flatten_from(1)?.unsqueeze(1)?;
        let state = linear(cx, &Value::from(&state.contiguous()?), &self.robot_state_input_proj)?;
        let actions = linear(cx, &Value::from(&batch.actions), &self.action_input_proj)?;
        let tokens = cat_tokens(cx, b, &[&cls, &state, &actions])?;
        let always = Tensor::zeros((b, 2), DType::F32, cx.device())?;
        let key_pad = Tensor::cat(&[&always, &batch.is_pad], 1)?;
        let x = self.encoder.apply(cx, &tokens, &Value::from(pos), Some(&key_pad), 1)?;
        linear(cx, &x.reshape((b, dim))?, &self.latent_output_proj)
    }
}
