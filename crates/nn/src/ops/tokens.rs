//! Tokens of sequences, (b, t, D): side by side, some of them, their weighted mean.

use crate::context::{Context, read};
use crate::error::{ModelError, Result};
use crate::kernels::{add, dot};
use crate::value::Value;
use candle_core::{D, Tensor};

/// Parts of sequences, (b or 1, t, D) each, one after the other: (b, sum of t, D)
///
/// # Errors
/// Parts of different widths.
pub fn cat_tokens(cx: &mut Context<'_>, batch: usize, parts: &[&Value]) -> Result<Value> {
    let dim = parts.first().map_or(0, |part| part.width());
    let mut nodes = Vec::with_capacity(parts.len());
    for part in parts {
        let [b, t, width] = super::sizes("cat", &part.tensor)?;
        if width != dim || (b != batch && b != 1) {
            let (expected, found) = (vec![batch, t, dim], part.dims().to_vec());
            return Err(ModelError::Shape { operation: "cat", object: "tokens", expected, found });
        }
        nodes.push((part.node, t * dim, b != batch));
    }
    if cx.composed("cat", parts.iter().map(|part| &part.tensor))? {
        let whole = |part: &&Value| part.tensor.broadcast_as((batch, part.dims()[1], dim))?.contiguous();
        let parts = parts.iter().map(whole).collect::<candle_core::Result<Vec<_>>>()?;
        return Ok(Value::constant(Tensor::cat(&parts, 1)?));
    }
    let all: usize = nodes.iter().map(|(_, len, _)| len).sum();
    let mut out = vec![0.0; batch * all];
    let mut from = 0;
    for (part, &(_, len, shared)) in parts.iter().zip(&nodes) {
        read("cat", [&part.tensor], |[x]| {
            for (b, out) in out.chunks_exact_mut(all).enumerate() {
                let at = if shared { 0 } else { b * len };
                out[from..from + len].copy_from_slice(&x[at..at + len]);
            }
            Ok(())
        })?;
        from += len;
    }
    let has_gradient = nodes.iter().any(|(node, ..)| node.is_some());
    cx.result(out, &[batch, all / dim.max(1), dim], has_gradient, move |grad, back| {
        let mut from = 0;
        for (node, len, shared) in nodes {
            let place = from..from + len;
            let rows = grad.chunks_exact(all).map(|row| &row[place.clone()]);
            from += len;
            if node.is_none() {
                continue;
            }
            let of = match (back.take(node), shared) {
                (Some(mut of), false) => {
                    of.chunks_exact_mut(len).zip(rows).for_each(|(of, row)| add(of, row));
                    of
                }
                (None, false) => {
                    let mut of = back.space.pool.take(batch * len);
                    of.chunks_exact_mut(len).zip(rows).for_each(|(of, row)| of.copy_from_slice(row));
                    of
                }
                (sum, true) => {
                    let mut of = sum.unwrap_or_else(|| back.space.pool.zeros(len));
                    rows.for_each(|row| add(&mut of, row));
                    of
                }
            };
            back.add(node, of);
        }
        back.space.pool.give(grad);
        Ok(())
    })
}

/// `count` tokens of each sequence from `first` on: (b, t, D) -> (b, count, D)
///
/// # Errors
/// Fewer tokens.
pub fn narrow_tokens(cx: &mut Context<'_>, x: &Value, first: usize, count: usize) -> Result<Value> {
    let [_, t, _] = super::sizes("narrow", &x.tensor)?;
    if first == 0 && count == t {
        return Ok(x.clone());
    }
    if first + count > t {
        let (found, expected) = (format!("{first} to {}", first + count), format!("up to {t}"));
        return Err(ModelError::Input { operation: "narrow", object: "tokens", found, expected });
    }
    if cx.composed("narrow", [&x.tensor])? {
        return Ok(Value::constant(x.tensor.narrow(1, first, count)?.contiguous()?));
    }
    select_tokens(cx, x, &(first..first + count).collect::<Vec<_>>())
}

/// These tokens of each sequence: (b, t, D) -> (b, n, D)
///
/// # Errors
/// A token that is not there.
pub fn select_tokens(cx: &mut Context<'_>, x: &Value, tokens: &[usize]) -> Result<Value> {
    let [b, t, dim] = super::sizes("select", &x.tensor)?;
    if let Some(token) = tokens.iter().find(|token| **token >= t) {
        let (found, expected) = (token.to_string(), format!("below {t}"));
        return Err(ModelError::Input { operation: "select", object: "token", found, expected });
    }
    if cx.composed("select", [&x.tensor])? {
        let tokens: Vec<u32> = tokens.iter().map(|token| *token as u32).collect();
        let tokens = Tensor::new(tokens, cx.device())?;
        return Ok(Value::constant(x.tensor.index_select(&tokens, 1)?.contiguous()?));
    }
    let n = tokens.len();
    let mut out = vec![0.0; b * n * dim];
    read("select", [&x.tensor], |[x]| {
        for (out, x) in out.chunks_exact_mut((n * dim).max(1)).zip(x.chunks_exact(t * dim)) {
            for (out, token) in out.chunks_exact_mut(dim).zip(tokens) {
                out.copy_from_slice(&x[token * dim..(token + 1) * dim]);
            }
        }
        Ok(())
    })?;
    let (node, tokens) = (x.node, tokens.to_vec());
    cx.result(out, &[b, n, dim], node.is_some(), move |grad, back| {
        let mut of = back.take(node).unwrap_or_else(|| back.space.pool.zeros(b * t * dim));
        for (of, grad) in of.chunks_exact_mut(t * dim).zip(grad.chunks_exact(n * dim)) {
            for (token, grad) in tokens.iter().zip(grad.chunks_exact(dim)) {
                add(&mut of[token * dim..(token + 1) * dim], grad);
            }
        }
        back.space.pool.give(grad);
        back.add(node, of);
        Ok(())
    })
}

/// The mean of tokens, (b, n, D), by the softmax of scores, (b, n) -> (b, 1, D)
///
/// # Errors
/// Another number of scores.
pub fn weighted_mean(cx: &mut Context<'_>, scores: &Value, tokens: &Value) -> Result<Value> {
    let [b, n, dim] = super::sizes("weighted mean", &tokens.tensor)?;
    super::check_shape("weighted mean", "scores", &scores.tensor, &[b, n])?;
    if cx.composed("weighted mean", [&scores.tensor, &tokens.tensor])? {
        let shares = scores.tensor.broadcast_sub(&scores.tensor.max_keepdim(D::Minus1)?.detach())?.exp()?;
        let shares = shares.broadcast_div(&shares.sum_keepdim(D::Minus1)?)?;
        return Ok(Value::constant(shares.unsqueeze(1)?.matmul(&tokens.tensor.contiguous()?)?));
    }
    let mut out = vec![0.0; b * dim];
    let mut shares = cx.space.pool.take(b * n);
    read("weighted mean", [&scores.tensor, &tokens.tensor], |[scores, tokens]| {
        shares.copy_from_slice(scores);
        let each = shares.chunks_exact_mut(n).zip(tokens.chunks_exact(n * dim)).zip(out.chunks_exact_mut(dim));
        for ((shares, tokens), out) in each {
            let max = shares.iter().fold(f32::NEG_INFINITY, |max, x| max.max(*x));
            shares.iter_mut().for_each(|x| *x = (*x - max).exp());
            let sum: f32 = shares.iter().sum();
            shares.iter_mut().for_each(|x| *x /= sum);
            for (share, token) in shares.iter().zip(tokens.chunks_exact(dim)) {
                out.iter_mut().zip(token).for_each(|(x, token)| *x += share * token);
            }
        }
        Ok(())
    })?;
    let (of_scores, of_tokens, tokens) = (scores.node, tokens.node, tokens.tensor.clone());
    cx.result(out, &[b, 1, dim], of_scores.is_some() || of_tokens.is_some(), move |grad, back| {
        let (mut to_scores, mut to_tokens) = (back.space.pool.take(b * n), back.space.pool.take(b * n * dim));
        read("weighted mean", [&tokens], |[tokens]| {
            let into = to_scores.chunks_exact_mut(n).zip(to_tokens.chunks_exact_mut(n * dim));
            let rows = grad.chunks_exact(dim).zip(tokens.chunks_exact(n * dim)).zip(shares.chunks_exact(n));
            for ((to_scores, to_tokens), ((grad, tokens), shares)) in into.zip(rows) {
                let each = tokens.chunks_exact(dim).zip(to_tokens.chunks_exact_mut(dim)).zip(shares);
                for (of_share, ((token, to_token), share)) in to_scores.iter_mut().zip(each) {
                    *of_share = dot(grad, token);
                    to_token.iter_mut().zip(grad).for_each(|(x, grad)| *x = share * grad);
                }
                let mean = dot(shares, to_scores);
                to_scores.iter_mut().zip(shares).for_each(|(x, share)| *x = share * (*x - mean));
            }
            Ok(())
        })?;
        [grad, shares].into_iter().for_each(|buffer| back.space.pool.give(buffer));
        back.add(of_scores, to_scores);
        back.add(of_tokens, to_tokens);
        Ok(())
    })
}
