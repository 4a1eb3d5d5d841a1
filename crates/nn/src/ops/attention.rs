//! Scaled dot-product attention.

use super::linear::{linear_rows, times};
use super::tokens::narrow_tokens;
use crate::composed::{self, Among};
use crate::context::{Context, Workspace, read};
use crate::error::{ModelError, Result};
use crate::kernels::{Heads, Mat, Start, attend, attend_backward, column_sums, product, sum_over_sequences};
use crate::layers::{DropoutMask, UNSEEN};
use crate::value::Value;
use candle_core::Tensor;

/// What an attention is like.
#[derive(Debug, Clone, Copy)]
pub struct Attention<'a> {
    /// heads
    pub heads: usize,
    /// sequences of the result; queries or keys of one stand for all of them
    pub batch: usize,
    /// queries of a sequence for which dropout is drawn; the first of them are computed
    pub all_queries: usize,
    /// a query sees the keys of its own step and of those before
    pub causal: bool,
    /// (b, s) of 0/1: 1 is not attended to
    pub key_pad: Option<&'a Tensor>,
    /// dropout of the attention weights
    pub dropout: f64,
}

fn check_pad(pad: Option<&Tensor>, batch: usize, keys: usize) -> Result<()> {
    pad.map_or(Ok(()), |pad| super::check_shape("attention", "padding", pad, &[batch, keys]))
}

fn with_pad<R>(pad: Option<&Tensor>, f: impl FnOnce(Option<&[f32]>) -> Result<R>) -> Result<R> {
    match pad {
        Some(pad) => read("attention", [pad], |[pad]| f(Some(pad))),
        None => f(None),
    }
}

/// q: (b or 1, t, D), kv: (b or 1, s, 2D) with keys in the first half -> (b, t, D)
///
/// # Errors
/// Shapes that do not go together.
pub fn attention(cx: &mut Context<'_>, q: &Value, kv: &Value, how: Attention<'_>) -> Result<Value> {
    let mask = cx.dropout(how.dropout);
    let [q_batch, queries, dim] = super::sizes("attention", &q.tensor)?;
    let [kv_batch, keys, width] = super::sizes("attention", &kv.tensor)?;
    let Attention { heads, batch, all_queries, causal, key_pad, .. } = how;
    let fits = |n: usize| n == batch || n == 1;
    if width != 2 * dim || !fits(q_batch) || !fits(kv_batch) || !dim.is_multiple_of(heads) {
        let (found, expected) = (kv.dims().to_vec(), vec![batch, keys, 2 * dim]);
        return Err(ModelError::Shape { operation: "attention", object: "keys and values", expected, found });
    }
    check_pad(key_pad, batch, keys)?;
    if cx.composed("attention", [&q.tensor, &kv.tensor].into_iter().chain(key_pad))? {
        return composed(cx, q, kv, how, mask);
    }
    let (shared_queries, shared_keys) = (q_batch != batch, kv_batch != batch);
    let heads = Heads { batch, heads, queries, all_queries, keys, dim, shared_queries, shared_keys, causal };
    let mut out = vec![0.0; batch * queries * dim];
    let mut weights = cx.space.pool.take(heads.weights());
    read("attention", [&q.tensor, &kv.tensor], |[q, kv]| {
        with_pad(key_pad, |pad| {
            let Workspace { pool, pack } = &mut *cx.space;
            attend(heads, q, kv, pad, mask, &mut weights, &mut out, pool, pack);
            Ok(())
        })
    })?;
    let shape = [batch, queries, dim];
    if !cx.records() {
        cx.space.pool.give(weights);
        return cx.result(out, &shape, false, |_, _| Ok(()));
    }
    let nodes = (q.node, kv.node);
    let (q, kv) = (q.tensor.clone(), kv.tensor.clone());
    cx.result(out, &shape, nodes.0.is_some() || nodes.1.is_some(), move |grad, back| {
        let pool = &mut back.space.pool;
        let (mut dq, mut dkv) = (pool.zeros(q.elem_count()), pool.zeros(kv.elem_count()));
        read("attention", [&q, &kv], |[q, kv]| {
            let Workspace { pool, pack } = &mut *back.space;
            attend_backward(heads, q, kv, mask, &weights, &grad, &mut dq, &mut dkv, pool, pack);
            Ok(())
        })?;
        [weights, grad].into_iter().for_each(|buffer| back.space.pool.give(buffer));
        back.add(nodes.0, dq);
        back.add(nodes.1, dkv);
        Ok(())
    })
}

fn composed(cx: &Context<'_>, q: &Value, kv: &Value, how: Attention<'_>, mask: Option<DropoutMask>) -> Result<Value> {
    let ((_, queries, _), (_, keys, _)) = (q.dims3()?, kv.dims3()?);
    let Attention { heads, batch, all_queries, causal, key_pad, .. } = how;
    let later = |i: usize| if i % keys > i / keys { UNSEEN } else { 0.0 };
    let bias = causal.then(|| {
        let later: Vec<f32> = (0..queries * keys).map(later).collect();
        Tensor::from_vec(later, (1, 1, queries, keys), cx.device())
    });
    let dropout = mask.map(|mask| {
        let mask = mask.tensor(&[batch, heads, all_queries, keys], cx.device())?;
        Ok::<_, ModelError>(mask.narrow(2, 0, queries)?.contiguous()?)
    });
    let among = Among { heads, batch, bias: bias.transpose()?, key_pad, dropout: dropout.transpose()? };
    Ok(Value::constant(composed::attention(&q.tensor, &kv.tensor, among, cx.precision())?))
}

/// Attention among tokens, (b or 1, t, D), with positions, (1, t, D), added to what queries and keys are made of: the first
/// `queries` tokens of each sequence ask all of them -> (b, queries, D). With the rows of `torch.nn.MultiheadAttention`'s
/// weight, (3D, D).
///
/// # Errors
/// Shapes that do not go together.
pub fn self_attention(
    cx: &mut Context<'_>,
    x: &Value,
    positions: &Value,
    queries: usize,
    (weight, bias): (&Tensor, &Tensor),
    how: Attention<'_>,
) -> Result<Value> {
    let [x_batch, keys, dim] = super::sizes("self attention", &x.tensor)?;
    let Attention { heads, batch, all_queries, causal, key_pad, dropout } = how;
    super::check_width("self attention", x, weight.dim(1)?)?;
    if positions.len() != keys * dim || !dim.is_multiple_of(heads) || (x_batch != batch && x_batch != 1) {
        let (found, expected) = (positions.dims().to_vec(), vec![1, keys, dim]);
        return Err(ModelError::Shape { operation: "self attention", object: "positions", expected, found });
    }
    check_pad(key_pad, batch, keys)?;
    let tensors = [&x.tensor, &positions.tensor, weight, bias].into_iter().chain(key_pad);
    if cx.composed("self attention", tensors)? {
        let kv = linear_rows(cx, x, Some(positions), (weight, Some(bias)), dim..3 * dim)?;
        let (first, first_positions) = (narrow_tokens(cx, x, 0, queries)?, narrow_tokens(cx, positions, 0, queries)?);
        let q = linear_rows(cx, &first, Some(&first_positions), (weight, Some(bias)), 0..dim)?;
        return attention(cx, &q, &kv, how);
    }
    let shared = x_batch != batch;
    let heads =
        Heads { batch, heads, queries, all_queries, keys, dim, shared_queries: shared, shared_keys: shared, causal };
    // the first rows of every sequence, unless all tokens ask
    let asking = move |x: &[f32], pool: &mut crate::kernels::Pool| {
        (queries < keys).then(|| {
            let mut out = pool.take(x.len() / keys * queries);
            for (to, from) in out.chunks_exact_mut(queries * dim).zip(x.chunks_exact(keys * dim)) {
                to.copy_from_slice(&from[..queries * dim]);
            }
            out
        })
    };
    let (mut q, mut kv) = (cx.space.pool.take(x.len() / keys * queries), cx.space.pool.take(2 * x.len()));
    let mut out = vec![0.0; batch * queries * dim];
    read("self attention", [&x.tensor, &positions.tensor, weight, bias], |[x, positions, w, bias]| {
        let first = asking(x, &mut cx.space.pool);
        let sides = [
            (first.as_deref().unwrap_or(x), &positions[..queries * dim], 0..dim, &mut q),
            (x, positions, dim..3 * dim, &mut kv),
        ];
        for (x, positions, rows, into) in sides {
            let mut projected = cx.space.pool.take(positions.len());
            let w = &w[rows.start * dim..rows.end * dim];
            times(cx, positions, (&w[..dim * dim], dim), Start::Zero, None, &mut projected);
            times(cx, x, (w, dim), Start::Bias(&bias[rows]), Some((&projected, dim)), into);
            cx.space.pool.give(projected);
        }
        first.into_iter().for_each(|buffer| cx.space.pool.give(buffer));
        Ok(())
    })?;
    let mask = cx.dropout(dropout);
    let mut weights = cx.space.pool.take(heads.weights());
    with_pad(key_pad, |pad| {
        let Workspace { pool, pack } = &mut *cx.space;
        attend(heads, &q, &kv, pad, mask, &mut weights, &mut out, pool, pack);
        Ok(())
    })?;
    let shape = [batch, queries, dim];
    if !cx.records() {
        [q, kv, weights].into_iter().for_each(|buffer| cx.space.pool.give(buffer));
        return cx.result(out, &shape, false, |_, _| Ok(()));
    }
    let (of_x, of_positions) = (x.node, positions.node);
    let (x, positions) = (x.tensor.clone(), positions.tensor.clone());
    let (weight, bias) = (weight.clone(), bias.clone());
    cx.result(out, &shape, true, move |grad, back| {
        let (mut dq, mut dkv) = (back.space.pool.zeros(q.len()), back.space.pool.zeros(kv.len()));
        {
            let Workspace { pool, pack } = &mut *back.space;
            attend_backward(heads, &q, &kv, mask, &weights, &grad, &mut dq, &mut dkv, pool, pack);
        }
        read("self attention", [&x, &positions, &weight], |[x, place, w]| {
            let first = asking(x, &mut back.space.pool);
            let sides =
                [(&dq, first.as_deref().unwrap_or(x), &place[..queries * dim], 0..dim), (&dkv, x, place, dim..3 * dim)];
            for (grad, x, place, rows) in sides {
                let (out, part) = (rows.len(), rows.start * dim..rows.end * dim);
                let mut sums = back.space.pool.take(place.len());
                sum_over_sequences(&mut sums, grad, out, dim);
                if let Some((into, space)) = back.parameter(&weight) {
                    let (g, x) = (Mat::rows(grad, out).t(), Mat::rows(x, dim));
                    product((out, dim, grad.len() / out), g, x, Start::Add, &mut into[part.clone()], &mut space.pack);
                    let (g, place) = (Mat::rows(&sums, dim).t(), Mat::rows(place, dim));
                    let into = &mut into[part.start..part.start + dim * dim];
                    product((dim, dim, sums.len() / dim), g, place, Start::Add, into, &mut space.pack);
                }
                if let Some((into, _)) = back.parameter(&bias) {
                    column_sums(&mut into[rows], grad);
                }
                if of_positions.is_some() {
                    // of a few queries the rest stays zero
                    let mut of = back.space.pool.zeros(keys * dim);
                    let (g, w) = (Mat::rows(&sums, dim), Mat::rows(&w[part.start..part.start + dim * dim], dim));
                    let (size, into) = ((sums.len() / dim, dim, dim), &mut of[..sums.len()]);
                    product(size, g, w, Start::Zero, into, &mut back.space.pack);
                    back.add(of_positions, of);
                }
                back.space.pool.give(sums);
            }
            first.into_iter().for_each(|buffer| back.space.pool.give(buffer));
            if of_x.is_none() {
                return Ok(());
            }
            let (n, mut of) = (x.len() / dim, back.space.pool.take(x.len()));
            let Workspace { pool, pack } = &mut *back.space;
            let (g, wkv) = (Mat::rows(&dkv, 2 * dim), Mat::rows(&w[dim * dim..], dim));
            product((n, dim, 2 * dim), g, wkv, Start::Zero, &mut of, pack);
            let (g, wq) = (Mat::rows(&dq, dim), Mat::rows(&w[..dim * dim], dim));
            if queries == keys {
                product((n, dim, dim), g, wq, Start::Add, &mut of, pack);
            } else {
                let mut first = pool.take(dq.len());
                product((dq.len() / dim, dim, dim), g, wq, Start::Zero, &mut first, pack);
                for (of, first) in of.chunks_exact_mut(keys * dim).zip(first.chunks_exact(queries * dim)) {
                    crate::kernels::add(&mut of[..queries * dim], first);
                }
                pool.give(first);
            }
            back.add(of_x, of);
            Ok(())
        })?;
        [q, kv, weights, dq, dkv, grad].into_iter().for_each(|buffer| back.space.pool.give(buffer));
        Ok(())
    })
}
