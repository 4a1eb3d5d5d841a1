//! Multi-head attention with torch's tensor names.

use super::Linear;
use crate::composed::softmax;
use crate::context::Context;
use crate::error::{ModelError, Result};
use crate::ops::{self, Attention, linear, linear_rows};
use crate::params::{Init, Params};
use crate::rng::Rng;
use crate::value::Value;
use candle_core::{D, Tensor};

/// Added to the scores of keys that are not attended to: it underflows to exactly 0 after the exponential; -inf would make
/// NaN gradients of (-inf) - (-inf).
pub(crate) const UNSEEN: f32 = -1e30;

/// `torch.nn.MultiheadAttention`: rows 0..D, D..2D and 2D..3D of `in_proj_weight` are the query, key and value
/// projections; scores are scaled by 1/sqrt(D/heads); dropout acts on the attention weights.
#[derive(Debug, Clone)]
pub struct MultiHeadAttention {
    /// (3D, D)
    pub in_proj_weight: Tensor,
    /// (3D)
    pub in_proj_bias: Tensor,
    /// (D, D)
    pub out_proj: Linear,
    /// number of heads
    pub n_heads: usize,
    /// of the attention weights
    pub dropout: f64,
    /// a query sees the keys of its own step and of those before
    pub causal: bool,
}

impl MultiHeadAttention {
    /// Creates the projections below `prefix`: xavier-uniform `in_proj`, `out_proj` as given, zero biases.
    ///
    /// # Errors
    /// If `n_heads` does not divide `dim`.
    pub fn new(
        params: &mut Params,
        prefix: &str,
        dim: usize,
        n_heads: usize,
        p: f64,
        out_proj: Init,
        rng: &mut Rng,
    ) -> Result<Self> {
        if n_heads == 0 || !dim.is_multiple_of(n_heads) {
            return Err(ModelError::Config {
                model: "attention",
                field: "n_heads",
                found: n_heads.to_string(),
                expected: format!("a divisor of {dim}"),
            });
        }
        let (weight, bias) = (format!("{prefix}.in_proj_weight"), format!("{prefix}.in_proj_bias"));
        let name = format!("{prefix}.out_proj");
        Ok(Self {
            in_proj_weight: params.create(&weight, &[3 * dim, dim], Init::XavierUniform, rng)?,
            in_proj_bias: params.create(&bias, &[3 * dim], Init::Zeros, rng)?,
            out_proj: Linear::with_init(params, &name, (dim, dim), out_proj, Some(Init::Zeros), rng)?,
            n_heads,
            dropout: p,
            causal: false,
        })
    }

    /// x: (b, t, D) -> (b, t, D), on candle's operations, without dropout
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let (b, t, dim) = x.dims3()?;
        let mixed = self.weights(x, x)?.matmul(&self.project(x, 2)?)?;
        self.out_proj.forward(&mixed.transpose(1, 2)?.reshape((b, t, dim))?)
    }

    /// How much each query attends to each key, without dropout: q: (b, t, D), k: (b, s, D) -> (b, n_heads, t, s)
    pub fn weights(&self, q: &Tensor, k: &Tensor) -> Result<Tensor> {
        let (q, k) = (self.project(q, 0)?, self.project(k, 1)?);
        let head = q.dim(D::Minus1)? as f64;
        let mut scores = (q.matmul(&k.transpose(2, 3)?)? * (1.0 / head.sqrt()))?;
        if self.causal {
            let (t, s) = (scores.dim(2)?, scores.dim(3)?);
            let later = (0..t * s).map(|i| if i % s > i / s { UNSEEN } else { 0.0 }).collect::<Vec<f32>>();
            scores = scores.broadcast_add(&Tensor::from_vec(later, (1, 1, t, s), scores.device())?)?;
        }
        masked_softmax(&scores, None)
    }

    /// x: (b, n, D) -> queries, keys or values (parts 0, 1, 2) by head, (b, n_heads, n, D / n_heads)
    fn project(&self, x: &Tensor, part: usize) -> Result<Tensor> {
        let (b, n, dim) = x.dims3()?;
        let layer = Linear {
            weight: self.in_proj_weight.narrow(0, part * dim, dim)?,
            bias: Some(self.in_proj_bias.narrow(0, part * dim, dim)?),
        };
        let y = layer.forward(x)?.reshape((b, n, self.n_heads, dim / self.n_heads))?;
        Ok(y.transpose(1, 2)?.contiguous()?)
    }
}

impl MultiHeadAttention {
    fn how<'a>(&self, batch: usize, all_queries: usize, key_pad: Option<&'a Tensor>) -> Attention<'a> {
        let (heads, causal, dropout) = (self.n_heads, self.causal, self.dropout);
        Attention { heads, batch, all_queries, causal, key_pad, dropout }
    }

    /// Queries of x, (b or 1, t, D), with positions, (1, t, D)
    ///
    /// # Errors
    /// Shapes that do not go together.
    pub fn queries(&self, cx: &mut Context<'_>, x: &Value, positions: Option<&Value>) -> Result<Value> {
        linear_rows(cx, x, positions, (&self.in_proj_weight, Some(&self.in_proj_bias)), 0..x.width())
    }

    /// Keys and values of x, (b or 1, s, 2D); values have no positions.
    ///
    /// # Errors
    /// Shapes that do not go together.
    pub fn keys_and_values(&self, cx: &mut Context<'_>, x: &Value, positions: Option<&Value>) -> Result<Value> {
        let dim = x.width();
        linear_rows(cx, x, positions, (&self.in_proj_weight, Some(&self.in_proj_bias)), dim..3 * dim)
    }

    /// Attention of queries, (b or 1, t, D), to keys and values, (b or 1, s, 2D) -> (b, t, D)
    ///
    /// # Errors
    /// Shapes that do not go together.
    pub fn attend(&self, cx: &mut Context<'_>, q: &Value, kv: &Value, batch: usize) -> Result<Value> {
        let how = self.how(batch, q.dim(1)?, None);
        let mixed = ops::attention(cx, q, kv, how)?;
        linear(cx, &mixed, &self.out_proj)
    }

    /// Attention among tokens, (b or 1, t, D), of which the first `queries` ask -> (b, queries, D)
    ///
    /// # Errors
    /// Shapes that do not go together.
    pub fn self_attention(
        &self,
        cx: &mut Context<'_>,
        x: &Value,
        positions: &Value,
        batch: usize,
        queries: usize,
        key_pad: Option<&Tensor>,
    ) -> Result<Value> {
        let (how, weights) = (self.how(batch, x.dim(1)?, key_pad), (&self.in_proj_weight, &self.in_proj_bias));
        let mixed = ops::self_attention(cx, x, positions, queries, weights, how)?;
        linear(cx, &mixed, &self.out_proj)
    }
}

/// scores: (b, h, t, s), key_pad: (b, s) of 0/1 -> softmax over s, padded keys exactly 0
pub fn masked_softmax(scores: &Tensor, key_pad: Option<&Tensor>) -> Result<Tensor> {
    let scores = match key_pad {
        Some(pad) => {
            let (b, s) = pad.dims2()?;
            scores.broadcast_add(&(pad.reshape((b, 1, 1, s))? * f64::from(UNSEEN))?)?
        }
        None => scores.clone(),
    };
    softmax(&scores)
}
