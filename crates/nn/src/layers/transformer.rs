//! Transformer encoder and decoder as ACT has them: positions are added to queries and keys, and a norm stands before or
//! after each branch.

use super::{Activation, Embedding, FeedForward, LayerNorm, MultiHeadAttention};
use crate::context::Context;
use crate::error::Result;
use crate::ops::{feed_forward, layer_norm, narrow_tokens, residual};
use crate::params::{Init, Params};
use crate::rng::Rng;
use crate::size::Size;
use crate::value::Value;
use candle_core::Tensor;

/// What all transformer layers of a model share.
#[derive(Debug, Clone, Copy)]
pub struct Shape {
    /// width
    pub dim: usize,
    /// attention heads
    pub heads: usize,
    /// width of the feed-forward part
    pub hidden: usize,
    /// of the feed-forward part
    pub activation: Activation,
    /// probability
    pub dropout: f64,
    /// whether a norm comes before its branch, not after the sum
    pub pre_norm: bool,
}

impl Shape {
    /// Of one layer with `attentions` attentions, run over `tokens` tokens.
    pub fn size(&self, attentions: usize, tokens: usize) -> Size {
        let (dim, hidden, attentions) = (self.dim as f64, self.hidden as f64, attentions as f64);
        let (tokens, heads) = (tokens as f64, self.heads as f64);
        Size {
            weights: 4.0 * attentions * dim * dim + 2.0 * dim * hidden,
            activations: tokens * (4.0 * attentions * dim + hidden) + heads * tokens * tokens,
        }
    }
}

/// One encoder layer: self-attention and feed-forward, each with a residual.
#[derive(Debug)]
pub struct EncoderLayer {
    self_attn: MultiHeadAttention,
    ff: FeedForward,
    norm1: LayerNorm,
    norm2: LayerNorm,
    dropout: f64,
    pre_norm: bool,
}

impl EncoderLayer {
    /// Creates the parameters below `prefix`.
    ///
    /// # Errors
    /// If a name is taken.
    pub fn new(params: &mut Params, prefix: &str, shape: Shape, init: LayerInit, rng: &mut Rng) -> Result<Self> {
        let (dim, p) = (shape.dim, shape.dropout);
        let attn = format!("{prefix}.self_attn");
        let hidden = (dim, shape.hidden);
        let ff = shape.activation;
        Ok(Self {
            self_attn: MultiHeadAttention::new(params, &attn, dim, shape.heads, p, init.weight(), rng)?,
            ff: FeedForward::new(params, &format!("{prefix}."), hidden, ff, p, init.dense(), rng)?,
            norm1: LayerNorm::new(params, &format!("{prefix}.norm1"), dim, rng)?,
            norm2: LayerNorm::new(params, &format!("{prefix}.norm2"), dim, rng)?,
            dropout: p,
            pre_norm: shape.pre_norm,
        })
    }
}

/// What a branch reads: its norm comes first in a pre-norm layer.
fn enter(cx: &mut Context<'_>, x: &Value, norm: &LayerNorm, pre_norm: bool) -> Result<Value> {
    if pre_norm { layer_norm(cx, x, norm) } else { Ok(x.clone()) }
}

/// The sum around a branch, and its norm unless that came first.
fn leave(
    cx: &mut Context<'_>,
    x: &Value,
    branch: &Value,
    dropout: (f64, usize),
    norm: &LayerNorm,
    pre_norm: bool,
) -> Result<Value> {
    residual(cx, x, branch, dropout, (!pre_norm).then_some(norm))
}

impl EncoderLayer {
    /// x: (b, t, D), pos: (1, t, D) -> the first `read` tokens of each sequence, (b, read, D)
    ///
    /// # Errors
    /// Shapes that do not go together.
    pub fn apply(
        &self,
        cx: &mut Context<'_>,
        x: &Value,
        pos: &Value,
        key_pad: Option<&Tensor>,
        read: usize,
    ) -> Result<Value> {
        let all = x.dim(1)?;
        let (dropout, pre_norm) = ((self.dropout, all), self.pre_norm);
        let y = enter(cx, x, &self.norm1, pre_norm)?;
        let branch = self.self_attn.self_attention(cx, &y, pos, x.dim(0)?, read, key_pad)?;
        let x = narrow_tokens(cx, if pre_norm { x } else { &y }, 0, read)?;
        let x = leave(cx, &x, &branch, dropout, &self.norm1, pre_norm)?;
        let y = enter(cx, &x, &self.norm2, pre_norm)?;
        let branch = feed_forward(cx, &y, &self.ff, all)?;
        leave(cx, &x, &branch, dropout, &self.norm2, pre_norm)
    }
}

/// Encoder layers, and a final norm if they are pre-norm.
#[derive(Debug)]
pub struct Encoder {
    layers: Vec<EncoderLayer>,
    norm: Option<LayerNorm>,
}

impl Encoder {
    /// Creates `n_layers` layers below `prefix`.
    ///
    /// # Errors
    /// If a name is taken.
    pub fn new(
        params: &mut Params,
        prefix: &str,
        n_layers: usize,
        shape: Shape,
        init: LayerInit,
        rng: &mut Rng,
    ) -> Result<Self> {
        let layers = (0..n_layers)
            .map(|i| EncoderLayer::new(params, &format!("{prefix}.layers.{i}"), shape, init, rng))
            .collect::<Result<_>>()?;
        let norm = match shape.pre_norm {
            true => Some(LayerNorm::new(params, &format!("{prefix}.norm"), shape.dim, rng)?),
            false => None,
        };
        Ok(Self { layers, norm })
    }

    /// x: (b, t, D), pos: (1, t, D) -> the first `read` tokens of each sequence, (b, read, D); of the last layer nothing else
    /// is computed.
    ///
    /// # Errors
    /// Shapes that do not go together.
    pub fn apply(
        &self,
        cx: &mut Context<'_>,
        x: &Value,
        pos: &Value,
        key_pad: Option<&Tensor>,
        read: usize,
    ) -> Result<Value> {
        let (mut x, all) = (x.clone(), x.dim(1)?);
        for (i, layer) in self.layers.iter().enumerate() {
            x = layer.apply(cx, &x, pos, key_pad, if i + 1 == self.layers.len() { read } else { all })?;
        }
        match &self.norm {
            Some(norm) => layer_norm(cx, &x, norm),
            None => Ok(x),
        }
    }
}

/// One decoder layer: self-attention, attention to the encoder's output, feed-forward.
#[derive(Debug)]
pub struct DecoderLayer {
    /// among the tokens
    pub self_attn: MultiHeadAttention,
    multihead_attn: MultiHeadAttention,
    ff: FeedForward,
    norm1: LayerNorm,
    norm2: LayerNorm,
    norm3: LayerNorm,
    dropout: f64,
    pre_norm: bool,
}

impl DecoderLayer {
    /// Creates the parameters below `prefix`.
    ///
    /// # Errors
    /// If a name is taken.
    pub fn new(params: &mut Params, prefix: &str, shape: Shape, rng: &mut Rng) -> Result<Self> {
        let (dim, p, init) = (shape.dim, shape.dropout, LayerInit::Xavier.weight());
        let hidden = (dim, shape.hidden);
        let act = shape.activation;
        let mut attention =
            |name: &str| MultiHeadAttention::new(params, &format!("{prefix}.{name}"), dim, shape.heads, p, init, rng);
        let (self_attn, multihead_attn) = (attention("self_attn")?, attention("multihead_attn")?);
        let ff = FeedForward::new(params, &format!("{prefix}."), hidden, act, p, init, rng)?;
        let mut norm = |name: &str| LayerNorm::new(params, &format!("{prefix}.{name}"), dim, rng);
        let (norm1, norm2, norm3) = (norm("norm1")?, norm("norm2")?, norm("norm3")?);
        Ok(Self { self_attn, multihead_attn, ff, norm1, norm2, norm3, dropout: p, pre_norm: shape.pre_norm })
    }

    /// What the layer makes of its tokens before it reads the memory: their sum, and queries. x: (b or 1, c, D); attention of
    /// one sequence stands for `batch` where dropout makes them differ.
    fn begin(&self, cx: &mut Context<'_>, x: &Value, query_pos: &Value, batch: usize) -> Result<(Value, Value)> {
        let (c, pre_norm) = (x.dim(1)?, self.pre_norm);
        let y = enter(cx, x, &self.norm1, pre_norm)?;
        let branch = self.self_attn.self_attention(cx, &y, query_pos, batch, c, None)?;
        let x = leave(cx, x, &branch, (self.dropout, c), &self.norm1, pre_norm)?;
        let y = enter(cx, &x, &self.norm2, pre_norm)?;
        let q = self.multihead_attn.queries(cx, &y, Some(query_pos))?;
        Ok((x, q))
    }

    /// The rest of it: memory: (b, m, D), its positions: (1, m, D) -> (b, c, D)
    fn finish(&self, cx: &mut Context<'_>, (x, q): (Value, Value), memory: (&Value, &Value)) -> Result<Value> {
        let (batch, c, pre_norm) = (memory.0.dim(0)?, x.dim(1)?, self.pre_norm);
        let dropout = (self.dropout, c);
        let kv = self.multihead_attn.keys_and_values(cx, memory.0, Some(memory.1))?;
        let branch = self.multihead_attn.attend(cx, &q, &kv, batch)?;
        let x = leave(cx, &x, &branch, dropout, &self.norm2, pre_norm)?;
        let y = enter(cx, &x, &self.norm3, pre_norm)?;
        let branch = feed_forward(cx, &y, &self.ff, c)?;
        leave(cx, &x, &branch, dropout, &self.norm3, pre_norm)
    }

    /// x: (b, c, D), query_pos: (1, c, D), memory: (b, m, D), memory_pos: (1, m, D) -> (b, c, D)
    ///
    /// # Errors
    /// Shapes that do not go together.
    pub fn apply(
        &self,
        cx: &mut Context<'_>,
        x: &Value,
        query_pos: &Value,
        memory: &Value,
        memory_pos: &Value,
    ) -> Result<Value> {
        let begun = self.begin(cx, x, query_pos, memory.dim(0)?)?;
        self.finish(cx, begun, (memory, memory_pos))
    }
}

/// Decoder layers over learned queries, and their final norm.
#[derive(Debug)]
pub struct Decoder {
    /// one after the other
    pub layers: Vec<DecoderLayer>,
    /// of their result
    pub norm: LayerNorm,
    /// of the queries, (C, D)
    pub pos_embed: Embedding,
}

impl Decoder {
    /// memory: (b, M, D), pos: (1, M, D) -> (b, C, D)
    ///
    /// # Errors
    /// Shapes that do not go together.
    pub fn apply(&self, cx: &mut Context<'_>, memory: &Value, pos: &Value) -> Result<Value> {
        let (c, dim) = self.pos_embed.weight.dims2()?;
        let query_pos = cx.parameter(&self.pos_embed.weight)?.reshape((1, c, dim))?;
        // zero in every sequence: one stands for all of them, and what follows from it alone predictions make once
        let mut x = Value::zeros((1, c, dim), &cx.device().clone())?;
        let batch = memory.dim(0)?;
        for (i, layer) in self.layers.iter().enumerate() {
            let begun = match i {
                0 if cx.is_prepared() => {
                    cx.fixed(|| "decoder begun".to_string(), |cx| layer.begin(cx, &x, &query_pos, 1))?
                }
                _ => layer.begin(cx, &x, &query_pos, batch)?,
            };
            x = layer.finish(cx, begun, (memory, pos))?;
        }
        layer_norm(cx, &x, &self.norm)
    }
}

/// How the matrices of a transformer layer start.
#[derive(Debug, Clone, Copy)]
pub enum LayerInit {
    /// encoder and decoder
    Xavier,
    /// VAE encoder
    TorchDefault,
    /// a layer that is applied again and again: as encoder and decoder, with a weaker dense part
    Recursive,
}

impl LayerInit {
    /// Of the matrices of attention.
    pub fn weight(self) -> Init {
        match self {
            Self::Xavier | Self::Recursive => Init::XavierUniform,
            Self::TorchDefault => Init::KaimingUniform,
        }
    }

    /// Of the dense part of an encoder layer.
    pub fn dense(self) -> Init {
        match self {
            Self::Xavier => Init::XavierUniform,
            Self::TorchDefault | Self::Recursive => Init::KaimingUniform,
        }
    }
}
