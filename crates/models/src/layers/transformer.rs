//! Transformer encoder and decoder as ACT has them: positions are added to queries and keys, and a norm stands before or
//! after each branch.

use super::{Activation, Dropout, Embedding, FeedForward, LayerNorm, Mode, MultiHeadAttention};
use crate::error::Result;
use crate::params::{Init, Params};
use crate::rng::Rng;
use crate::size::Size;
use candle_core::{DType, Tensor};

/// What all transformer layers of a model share.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Shape {
    pub(crate) dim: usize,
    pub(crate) heads: usize,
    pub(crate) hidden: usize,
    pub(crate) activation: Activation,
    pub(crate) dropout: f64,
    pub(crate) pre_norm: bool,
}

impl Shape {
    /// Of one layer with `attentions` attentions, run over `tokens` tokens.
    pub(crate) fn size(&self, attentions: usize, tokens: usize) -> Size {
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
pub(crate) struct EncoderLayer {
    pub(crate) self_attn: MultiHeadAttention,
    pub(crate) ff: FeedForward,
    pub(crate) norm1: LayerNorm,
    pub(crate) norm2: LayerNorm,
    dropout: Dropout,
    pre_norm: bool,
}

impl EncoderLayer {
    pub(crate) fn new(params: &mut Params, prefix: &str, shape: Shape, init: LayerInit, rng: &mut Rng) -> Result<Self> {
        let (dim, p) = (shape.dim, shape.dropout);
        let attn = format!("{prefix}.self_attn");
        let hidden = (dim, shape.hidden);
        let ff = shape.activation;
        Ok(Self {
            self_attn: MultiHeadAttention::new(params, &attn, dim, shape.heads, p, init.weight(), rng)?,
            ff: FeedForward::new(params, &format!("{prefix}."), hidden, ff, p, init.dense(), rng)?,
            norm1: LayerNorm::new(params, &format!("{prefix}.norm1"), dim, rng)?,
            norm2: LayerNorm::new(params, &format!("{prefix}.norm2"), dim, rng)?,
            dropout: Dropout { p },
            pre_norm: shape.pre_norm,
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
    pub(crate) fn new(params: &mut Params, prefix: &str, shape: Shape, rng: &mut Rng) -> Result<Self> {
        let (dim, p, init) = (shape.dim, shape.dropout, LayerInit::Xavier.weight());
        let hidden = (dim, shape.hidden);
        let act = shape.activation;
        let mut attention =
            |name: &str| MultiHeadAttention::new(params, &format!("{prefix}.{name}"), dim, shape.heads, p, init, rng);
        let (self_attn, multihead_attn) = (attention("self_attn")?, attention("multihead_attn")?);
        let ff = FeedForward::new(params, &format!("{prefix}."), hidden, act, p, init, rng)?;
        let mut norm = |name: &str| LayerNorm::new(params, &format!("{prefix}.{name}"), dim, rng);
        let (norm1, norm2, norm3) = (norm("norm1")?, norm("norm2")?, norm("norm3")?);
        let dropout = Dropout { p };
        Ok(Self { self_attn, multihead_attn, ff, norm1, norm2, norm3, dropout, pre_norm: shape.pre_norm })
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

/// How the matrices of a transformer layer start.
#[derive(Debug, Clone, Copy)]
pub(crate) enum LayerInit {
    /// encoder and decoder
    Xavier,
    /// VAE encoder
    TorchDefault,
    /// a layer that is applied again and again: as encoder and decoder, with a weaker dense part
    Recursive,
}

impl LayerInit {
    pub(crate) fn weight(self) -> Init {
        match self {
            Self::Xavier | Self::Recursive => Init::XavierUniform,
            Self::TorchDefault => Init::KaimingUniform,
        }
    }

    /// Of the dense part of an encoder layer.
    pub(crate) fn dense(self) -> Init {
        match self {
            Self::Xavier => Init::XavierUniform,
            Self::TorchDefault | Self::Recursive => Init::KaimingUniform,
        }
    }
}
