//! `linear2(dropout(activation(linear1(x))))` in one: the wide rows in the middle are nobody else's.

use super::linear::{UNPACKED_ROWS, times};
use crate::composed;
use crate::context::{Context, read};
use crate::error::{ModelError, Result};
use crate::kernels::{Mat, Rows, Start, activate, activate_backward, column_sums, gemm_with, product};
use crate::layers::{Activation, FeedForward};
use crate::simd::vectorised;
use crate::value::Value;

/// x: (b, t, D) -> (b, t, D), the first of `all` tokens of each sequence, for which dropout is drawn.
///
/// # Errors
/// An input of another width, layers without a bias.
pub fn feed_forward(cx: &mut Context<'_>, x: &Value, layer: &FeedForward, all: usize) -> Result<Value> {
    let mask = cx.dropout(layer.dropout);
    let [b, t, dim] = super::sizes("feed forward", &x.tensor)?;
    let activation = layer.activation;
    let (one, two) = (&layer.linear1, &layer.linear2);
    super::check_width("feed forward", x, one.weight.dim(1)?)?;
    if cx.composed("feed forward", [&x.tensor, &one.weight, &two.weight])? {
        let hidden = activation.forward(&layer.linear1.forward_in(&x.tensor, cx.precision())?)?;
        let hidden = match mask {
            Some(mask) => {
                let mask = mask.tensor(&[b, all, layer.linear1.weight.dim(0)?], cx.device())?;
                composed::masked(&hidden, mask.narrow(1, 0, t)?)?
            }
            None => hidden,
        };
        return Ok(Value::constant(layer.linear2.forward_in(&hidden, cx.precision())?));
    }
    let (Some(b1), Some(b2)) = (&one.bias, &two.bias) else {
        let (found, expected) = ("without a bias".to_string(), "with one".to_string());
        return Err(ModelError::Input { operation: "feed forward", object: "layer", found, expected });
    };
    let (rows, n, width) = (Rows { computed: t, all }, b * t, one.weight.dim(0)?);
    let mut out = vec![0.0; n * dim];
    let (hidden, before) =
        read("feed forward", [&x.tensor, &one.weight, b1, &two.weight, b2], |[x, w1, b1, w2, b2]| {
            let mut hidden = cx.space.pool.take(n * width);
            let mut before = None;
            if activation == Activation::Relu {
                let packed = cx.prepared.as_ref().filter(|_| n > UNPACKED_ROWS).map(|p| p.panels(w1, dim));
                let (a, w) = (Mat::rows(x, dim), (Mat::rows(w1, dim).t(), packed.as_deref()));
                let epilogue =
                    |i: usize, j: usize, row: &mut [f32]| activate(row, activation, mask, rows.full(i) * width + j);
                let (size, pack) = ((n, width, dim), &mut cx.space.pack);
                gemm_with(size, a, w, Start::Bias(b1), &mut hidden, width, pack, epilogue);
            } else {
                times(cx, x, (w1, dim), Start::Bias(b1), None, &mut hidden);
                before = Some(cx.space.pool.copy(&hidden));
                vectorised(
                    #[inline(always)]
                    || {
                        for (i, row) in hidden.chunks_exact_mut(width).enumerate() {
                            activate(row, activation, mask, rows.full(i) * width);
                        }
                    },
                );
            }
            times(cx, &hidden, (w2, width), Start::Bias(b2), None, &mut out);
            Ok((hidden, before))
        })?;
    if !cx.records() {
        [hidden].into_iter().chain(before).for_each(|buffer| cx.space.pool.give(buffer));
        return cx.result(out, &[b, t, dim], false, |_, _| Ok(()));
    }
    let (node, x, layer) = (x.node, x.tensor.clone(), layer.clone());
    cx.result(out, &[b, t, dim], true, move |grad, back| {
        let FeedForward { linear1: one, linear2: two, .. } = &layer;
        let mut middle = back.space.pool.take(n * width);
        read("feed forward", [&x, &one.weight, &two.weight], |[x, w1, w2]| {
            if let Some((into, space)) = back.parameter(&two.weight) {
                let (g, h) = (Mat::rows(&grad, dim).t(), Mat::rows(&hidden, width));
                product((dim, width, n), g, h, Start::Add, into, &mut space.pack);
            }
            if let Some((into, _)) = two.bias.as_ref().and_then(|bias| back.parameter(bias)) {
                column_sums(into, &grad);
            }
            let before = before.as_ref().unwrap_or(&hidden);
            let (g, w, size) = (Mat::rows(&grad, dim), Mat::rows(w2, width), (n, width, dim));
            let pack = &mut back.space.pack;
            if activation == Activation::Relu {
                let epilogue = |i: usize, j: usize, row: &mut [f32]| {
                    let before = &before[i * width + j..][..row.len()];
                    activate_backward(row, before, activation, mask, rows.full(i) * width + j);
                };
                gemm_with(size, g, (w, None), Start::Zero, &mut middle, width, pack, epilogue);
            } else {
                // an epilogue is compiled for any CPU, which is too slow for anything but a comparison
                product(size, g, w, Start::Zero, &mut middle, pack);
                vectorised(
                    #[inline(always)]
                    || {
                        for (i, row) in middle.chunks_exact_mut(width).enumerate() {
                            activate_backward(
                                row,
                                &before[i * width..][..width],
                                activation,
                                mask,
                                rows.full(i) * width,
                            );
                        }
                    },
                );
            }
            if let Some((into, space)) = back.parameter(&one.weight) {
                let (g, x) = (Mat::rows(&middle, width).t(), Mat::rows(x, dim));
                product((width, dim, n), g, x, Start::Add, into, &mut space.pack);
            }
            if let Some((into, _)) = one.bias.as_ref().and_then(|bias| back.parameter(bias)) {
                column_sums(into, &middle);
            }
            if node.is_some() {
                let mut of_x = back.space.pool.take(n * dim);
                let (g, w) = (Mat::rows(&middle, width), Mat::rows(w1, dim));
                product((n, dim, width), g, w, Start::Zero, &mut of_x, &mut back.space.pack);
                back.add(node, of_x);
            }
            Ok(())
        })?;
        [hidden, middle, grad].into_iter().chain(before).for_each(|buffer| back.space.pool.give(buffer));
        Ok(())
    })
}
