//! The recursion over actions.
//!
//! Keys and values are projected part by part: the memory's once per observation, the answer's once per round; a thought that begins at
//! zero begins with the same tokens in every row, which one sequence stands for. Where weights or states are used several times,
//! operations stand in the order in which their gradients have always been added.

use super::{Carry, Config, Observed};
use crate::layers::{Embedding, Encoder, FeedForward, LayerInit, LayerNorm, MultiHeadAttention, Shape};
use nn::ops::{add, alias, cat_tokens, feed_forward, residual};
use nn::{Context, Params, Result, Rng, Value};

/// The shared layer: attention to a context, then a dense part.
#[derive(Debug)]
pub(super) struct BlockLayer {
    pub(super) attn: MultiHeadAttention,
    ff: FeedForward,
    norm1: LayerNorm,
    norm2: LayerNorm,
}

impl BlockLayer {
    fn new(params: &mut Params, prefix: &str, config: &Config, rng: &mut Rng) -> Result<Self> {
        let dim = config.dim_model;
        let init = LayerInit::Xavier.weight();
        let hidden = (dim, config.block_feedforward());
        let act = config.feedforward_activation;
        Ok(Self {
            attn: MultiHeadAttention::new(params, &format!("{prefix}.attn"), dim, config.n_heads, 0.0, init, rng)?,
            ff: FeedForward::new(params, &format!("{prefix}."), hidden, act, 0.0, init, rng)?,
            norm1: LayerNorm::new(params, &format!("{prefix}.norm1"), dim, rng)?,
            norm2: LayerNorm::new(params, &format!("{prefix}.norm2"), dim, rng)?,
        })
    }

    /// x and its queries q: (b or 1, t, D), keys and values of the context: (b, s, 2D) -> (b, t, D)
    fn apply(&self, cx: &mut Context<'_>, x: &Value, q: &Value, kv: &Value) -> Result<Value> {
        let t = x.dim(1)?;
        let seen = self.attn.attend(cx, q, kv, kv.dim(0)?)?;
        let x = residual(cx, x, &seen, (0.0, t), Some(&self.norm1))?;
        let branch = feed_forward(cx, &x, &self.ff, t)?;
        residual(cx, &x, &branch, (0.0, t), Some(&self.norm2))
    }
}

/// The design.
#[derive(Debug)]
pub(super) struct OverActions {
    pub(super) memory_encoder: Option<Encoder>,
    /// (R, D), added to z before every update
    pub(super) latent_pos: Embedding,
    /// (H, D), added to y before every update
    pub(super) action_pos: Embedding,
    /// of the shared block, or of every supervision step's block one after the other
    pub(super) layers: Vec<BlockLayer>,
}

/// What updates read of an observation.
pub(super) struct Read {
    /// the memory's keys and values for each layer of every block, (b, M, 2D)
    memory: Vec<Value>,
    /// of the answer's tokens, (1, H, D), and of the reasoning's, (1, R, D)
    positions: [Value; 2],
}

/// A state with its positions.
struct Placed {
    x: Value,
    /// the name of one that is positions alone: what is made of it predictions make once
    fixed: Option<&'static str>,
}

impl Placed {
    /// A state of zeros is its positions.
    fn new(cx: &mut Context<'_>, state: Option<&Value>, positions: &Value, name: &'static str) -> Result<Self> {
        Ok(match state {
            Some(state) => Self { x: add(cx, positions, state)?, fixed: None },
            None => Self { x: alias(cx, positions), fixed: Some(name) },
        })
    }

    fn make(
        &self,
        cx: &mut Context<'_>,
        (layer, what): (usize, &str),
        make: impl FnOnce(&mut Context<'_>) -> Result<Value>,
    ) -> Result<Value> {
        match self.fixed {
            Some(name) => cx.fixed(|| format!("layer {layer}: {what} of {name}"), make),
            None => make(cx),
        }
    }
}

impl OverActions {
    pub(super) fn new(p: &mut Params, config: &Config, shape: Shape, rng: &mut Rng) -> Result<Self> {
        let (dim, r) = (config.dim_model, &config.reasoning);
        Ok(Self {
            memory_encoder: match config.n_memory_layers {
                0 => None,
                n => Some(Encoder::new(p, "encoder", n, shape, LayerInit::Xavier, rng)?),
            },
            latent_pos: Embedding::new(p, "reasoning.latent_pos_embed", r.tokens, dim, rng)?,
            action_pos: Embedding::new(p, "reasoning.action_pos_embed", config.action_horizon, dim, rng)?,
            layers: (0..r.blocks() * r.n_layers)
                .map(|i| BlockLayer::new(p, &format!("reasoning.layers.{i}"), config, rng))
                .collect::<Result<_>>()?,
        })
    }

    /// memory: (b, M, D)
    pub(super) fn read(&self, cx: &mut Context<'_>, memory: &Value) -> Result<Read> {
        let mut positions = |of: &Embedding| -> Result<Value> {
            let (t, dim) = of.weight.dims2()?;
            cx.parameter(&of.weight)?.reshape((1, t, dim))
        };
        let positions = [positions(&self.action_pos)?, positions(&self.latent_pos)?];
        let of_layers = self.layers.iter().rev().map(|layer| layer.attn.keys_and_values(cx, memory, None));
        let mut memory = of_layers.collect::<Result<Vec<_>>>()?;
        memory.reverse();
        Ok(Read { memory, positions })
    }

    /// `l_cycles` updates of the reasoning, one of the answer, by the layers of supervision step `at`. `between` gets the reasoning
    /// before the answer reads it.
    pub(super) fn round(
        &self,
        cx: &mut Context<'_>,
        config: &Config,
        observed: &Observed,
        (carry, at): (&Carry, usize),
        between: &mut dyn FnMut(&mut Value) -> Result<()>,
    ) -> Result<Carry> {
        let read = observed.read.as_ref().expect("an observation is read over actions");
        let [action_pos, latent_pos] = &read.positions;
        let of_step = config.reasoning.layers_of(at);
        let y = Placed::new(cx, carry.answer.as_ref(), action_pos, "the action positions")?;
        let mut y_kv = Vec::with_capacity(of_step.len());
        for i in of_step.clone().rev() {
            let keys_and_values = |cx: &mut Context<'_>| self.layers[i].attn.keys_and_values(cx, &y.x, None);
            y_kv.push(y.make(cx, (i, "keys and values"), keys_and_values)?);
        }
        y_kv.reverse();
        let update = |cx: &mut Context<'_>, own: &Placed, z: &Placed| -> Result<Value> {
            let mut own = Placed { x: alias(cx, &own.x), fixed: own.fixed };
            for (i, y_kv) in of_step.clone().zip(&y_kv) {
                let (layer, memory) = (&self.layers[i], &read.memory[i]);
                let z_kv = z.make(cx, (i, "keys and values"), |cx| layer.attn.keys_and_values(cx, &z.x, None))?;
                let kv = cat_tokens(cx, memory.dim(0)?, &[&z_kv, y_kv, memory])?;
                let q = own.make(cx, (i, "queries"), |cx| layer.attn.queries(cx, &own.x, None))?;
                own = Placed { x: layer.apply(cx, &own.x, &q, &kv)?, fixed: None };
            }
            Ok(own.x)
        };
        let mut reasoning = carry.reasoning.clone();
        for _ in 0..config.reasoning.l_cycles {
            let z = Placed::new(cx, reasoning.as_ref(), latent_pos, "the latent positions")?;
            reasoning = Some(update(cx, &z, &z)?);
        }
        if let Some(reasoning) = &mut reasoning {
            between(reasoning)?;
        }
        let z = Placed::new(cx, reasoning.as_ref(), latent_pos, "the latent positions")?;
        Ok(Carry { answer: Some(update(cx, &y, &z)?), reasoning })
    }
}
