//! What the network is told of an observation: all numbers of every step, then what the cameras see of every step; or tokens, one a
//! feature, encoded as ACT's.

use super::TransformerConfig;
use crate::batch::Batch;
use crate::encoders::VisionConfig;
use crate::features::{Features, Signature};
use crate::flops;
use crate::layers::{Encoder, InputTokens, LayerInit, Pointer, Steps, TokenLayout, environment_state};
use candle_core::Tensor;
use nn::ops::{add, cat_rows};
use nn::{Context, Params, Result, Rng, Value};

/// The condition of diffusion, flow matching and MIP.
#[allow(clippy::large_enum_variant)] // a model has one
#[derive(Debug)]
pub(crate) enum Condition {
    Steps(Steps),
    Tokens(Box<Encoded>),
}

/// Tokens of an observation, encoded, with the token that is pointed at after them.
#[derive(Debug)]
pub(crate) struct Encoded {
    tokens: InputTokens,
    encoder: Encoder,
    pub(crate) pointer: Option<Pointer>,
    config: TransformerConfig,
}

impl Condition {
    /// Of a signature that was checked. Without images nothing is drawn from `rng` for steps.
    pub(crate) fn new(
        p: &mut Params,
        (model, signature): (&'static str, &Signature),
        vision: Option<&VisionConfig>,
        transformer: Option<&TransformerConfig>,
        rng: &mut Rng,
    ) -> Result<Self> {
        let Some(config) = transformer.filter(|transformer| transformer.n_encoder_layers > 0) else {
            return Ok(Self::Steps(Steps::new(p, model, signature, vision, rng)?));
        };
        let (dim, shape) = (config.dim_model, config.shape());
        let layout = TokenLayout::new(signature, None, dim)?;
        let env_state = environment_state(p, &layout, dim, rng)?;
        let pointer = config.pointer.as_ref();
        Ok(Self::Tokens(Box::new(Encoded {
            encoder: Encoder::new(p, "encoder", config.n_encoder_layers, shape, LayerInit::Xavier, rng)?,
            pointer: pointer.map(|asked| Pointer::new(p, asked, (model, signature, &layout), dim, rng)).transpose()?,
            tokens: InputTokens::new(p, layout, 1, dim, env_state, rng)?,
            config: config.clone(),
        })))
    }

    /// Parts of a row, and the numbers of each.
    pub(crate) fn parts(&self) -> (usize, usize) {
        match self {
            Self::Steps(steps) => (steps.count(), steps.width()),
            Self::Tokens(of) => (of.tokens.layout().len() + usize::from(of.pointer.is_some()), of.config.dim_model),
        }
    }

    /// How images are seen, if there are any.
    pub(crate) fn vision(&self) -> Option<&VisionConfig> {
        match self {
            Self::Steps(steps) => steps.vision(),
            Self::Tokens(_) => None,
        }
    }

    /// The batch with images as the network reads them in training.
    pub(crate) fn with_images(&self, batch: &Batch, rng: &mut Rng) -> Result<Batch> {
        match self {
            Self::Steps(steps) => steps.with_images(batch, rng),
            Self::Tokens(_) => Ok(batch.clone()),
        }
    }

    /// The signature's features, (b, …) each -> (b, parts * numbers), of steps the features of each side by side; and the pointer's scores
    pub(crate) fn apply(
        &self,
        cx: &mut Context<'_>,
        rows: usize,
        observation: &Features<Tensor>,
    ) -> Result<(Value, Option<Value>)> {
        let steps = match self {
            Self::Steps(steps) => steps,
            Self::Tokens(encoded) => return encoded.apply(cx, rows, observation),
        };
        let numbers = Value::from(&steps.numbers(rows, observation)?.reshape((rows, ()))?.contiguous()?);
        let Some(image_features) = steps.image_features() else { return Ok((numbers, None)) };
        let seen = image_features.apply(cx, &image_features.prepare(observation, None)?)?;
        Ok((cat_rows(cx, &numbers, &seen)?, None))
    }

    /// Floating-point operations of encoding an observation, where they are counted.
    pub(crate) fn flops(&self) -> Option<f64> {
        let Self::Tokens(encoded) = self else { return None };
        let Encoded { tokens, config, .. } = &**encoded;
        let layers = flops::encoder_layer(config.shape(), tokens.layout().len()) * config.n_encoder_layers as f64;
        Some(flops::tokens(tokens.layout(), 1, config.dim_model) + layers)
    }
}

impl Encoded {
    fn apply(
        &self,
        cx: &mut Context<'_>,
        rows: usize,
        observation: &Features<Tensor>,
    ) -> Result<(Value, Option<Value>)> {
        let none = Value::zeros((rows, 1), &cx.device().clone())?;
        let (tokens, mut pos) = (self.tokens.apply(cx, &none, observation)?, self.tokens.apply_positions(cx)?);
        let candidates = self.pointer.as_ref().map(|pointer| pointer.candidates(cx, &tokens)).transpose()?;
        let (mut memory, mut scores) = (self.encoder.apply(cx, &tokens, &pos, None, tokens.dim(1)?)?, None);
        if let (Some(pointer), Some(candidates)) = (&self.pointer, &candidates) {
            let found;
            (memory, pos, found) = pointer.apply(cx, (&memory, candidates), &pos)?;
            scores = Some(found);
        }
        let memory = add(cx, &pos, &memory)?;
        let (_, tokens, dim) = memory.dims3()?;
        Ok((memory.reshape((rows, tokens * dim))?, scores))
    }
}
