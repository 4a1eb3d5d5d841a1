//! The recursion over the observation's tokens, and ACT's decoder.

use super::{Carry, Config, Observed, decoder};
use crate::features::Signature;
use crate::layers::{Cells, Decoder, EncoderLayer, GridLayer, LayerInit, LayerNorm, Pointer, TokenLayout};
use nn::ops::{add, alias, layer_norm};
use nn::{Context, Params, Result, Rng, Value};

/// The design.
#[derive(Debug)]
pub(super) struct OverTokens {
    /// of the tokens before the first step
    pub(super) first_norm: LayerNorm,
    pub(super) layers: TokenLayers,
    /// before tokens are read
    norm: LayerNorm,
    decoder: Decoder,
    pub(super) pointer: Option<Pointer>,
}

/// Pre-norm; of the shared block, or of every supervision step's block one after the other.
#[derive(Debug)]
pub(super) enum TokenLayers {
    /// among all tokens
    Attention(Vec<EncoderLayer>),
    /// from cell to cell of a grid
    Grid(Cells, Vec<GridLayer>),
}

impl OverTokens {
    pub(super) fn new(
        p: &mut Params,
        config: &Config,
        (signature, layout): (&Signature, &TokenLayout),
        rng: &mut Rng,
    ) -> Result<Self> {
        let (dim, r, block) = (config.dim_model, &config.reasoning, config.block_shape());
        let layer = |i: usize| format!("reasoning.layers.{i}");
        let blocks = 0..r.blocks() * r.n_layers;
        Ok(Self {
            first_norm: LayerNorm::new(p, "reasoning.first_norm", dim, rng)?,
            // a step begins as a small change of what tokens say: after six large ones nothing of it was left
            layers: match &r.grid {
                None => TokenLayers::Attention(
                    blocks
                        .map(|i| EncoderLayer::new(p, &layer(i), block, LayerInit::Recursive, rng))
                        .collect::<Result<_>>()?,
                ),
                Some(grid) => TokenLayers::Grid(
                    Cells::new(p, grid, ("actrm", layout), dim, rng)?,
                    blocks.map(|i| GridLayer::new(p, &layer(i), block, rng)).collect::<Result<_>>()?,
                ),
            },
            norm: LayerNorm::new(p, "reasoning.norm", dim, rng)?,
            decoder: decoder(p, config, rng)?,
            pointer: match &config.pointer {
                Some(pointer) => Some(Pointer::new(p, pointer, ("actrm", signature, layout), dim, rng)?),
                None => None,
            },
        })
    }

    /// Tokens have brought their positions along: zeros, (1, M, D).
    fn nowhere(observed: &Observed) -> Result<Value> {
        let (_, tokens, dim) = observed.memory.dims3()?;
        Value::zeros((1, tokens, dim), observed.memory.device())
    }

    /// `l_cycles` times the layers of supervision step `at`.
    pub(super) fn round(
        &self,
        cx: &mut Context<'_>,
        config: &Config,
        observed: &Observed,
        (carry, at): (&Carry, usize),
    ) -> Result<Carry> {
        let of_step = config.reasoning.layers_of(at);
        let mut x = carry.answer.clone().unwrap_or_else(|| observed.begun.clone());
        match &self.layers {
            TokenLayers::Attention(layers) => {
                let (nowhere, all) = (Self::nowhere(observed)?, x.dim(1)?);
                for layer in (0..config.reasoning.l_cycles).flat_map(|_| &layers[of_step.clone()]) {
                    x = layer.apply(cx, &x, &nowhere, None, all)?;
                }
            }
            TokenLayers::Grid(cells, layers) => {
                if at > 0 {
                    x = add(cx, &x, &observed.memory)?;
                }
                let mut own = cells.of(cx, &x)?;
                for layer in (0..config.reasoning.l_cycles).flat_map(|_| &layers[of_step.clone()]) {
                    own = layer.apply(cx, cells.grid, &own)?;
                }
                x = cells.put(cx, &x, &own)?;
            }
        }
        Ok(Carry { answer: Some(x), reasoning: None })
    }

    /// What the states go on as, what they are read as, (b, M, D), what the action head reads, (b, H, D), and the scores of what is
    /// asked beside the actions.
    pub(super) fn answer(
        &self,
        cx: &mut Context<'_>,
        observed: &Observed,
        left: &Value,
    ) -> Result<(Value, Value, Value, Option<Value>)> {
        let read = layer_norm(cx, left, &self.norm)?;
        let (mut on, mut scores) = (left.clone(), None);
        if let TokenLayers::Grid(cells, _) = &self.layers {
            on = alias(cx, &read);
            scores = cells.way(cx, &read)?;
        }
        let (mut memory, mut pos) = (read.clone(), Self::nowhere(observed)?);
        if let Some(pointer) = &self.pointer {
            let candidates = pointer.candidates(cx, &observed.memory)?;
            let found;
            (memory, pos, found) = pointer.apply(cx, (&read, &candidates), &pos)?;
            scores = Some(found);
        }
        let decoded = self.decoder.apply(cx, &memory, &pos)?;
        Ok((on, read, decoded, scores))
    }
}
