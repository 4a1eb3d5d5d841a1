//! `y = x Wᵀ + b`, by all rows of a weight or some, with positions added to what the first rows give.

use crate::context::{Context, read};
use crate::error::Result;
use crate::kernels::{Mat, Start, column_sums, gemm_with, product, sum_over_sequences};
use crate::layers::Linear;
use crate::value::Value;
use candle_core::{D, Tensor};
use std::ops::Range;

/// Rows up to which a product reads the weights as they are.
pub(super) const UNPACKED_ROWS: usize = 4;

/// x: (…, in) -> (…, out)
///
/// # Errors
/// An input of another width.
pub fn linear(cx: &mut Context<'_>, x: &Value, layer: &Linear) -> Result<Value> {
    let rows = 0..layer.weight.dim(0)?;
    super::check_width("linear", x, layer.weight.elem_count() / rows.len().max(1))?;
    if cx.composed("linear", [&x.tensor, &layer.weight].into_iter().chain(&layer.bias))? {
        // a convolution of one pixel is a dense layer
        let layer = Linear { weight: layer.weight.flatten_from(1)?, bias: layer.bias.clone() };
        return Ok(Value::constant(layer.forward_in(&x.tensor, cx.precision())?));
    }
    by_rows(cx, x, None, (&layer.weight, layer.bias.as_ref()), rows, false)
}

/// x: (b, t, D) by these rows of a weight (n, D), and of its bias; positions, (1, t, D), go through the first D of the rows and are
/// added. Without positions the gradient of x is added in place to what later operations made of it.
///
/// # Errors
/// An input of another width.
pub fn linear_rows(
    cx: &mut Context<'_>,
    x: &Value,
    positions: Option<&Value>,
    (weight, bias): (&Tensor, Option<&Tensor>),
    rows: Range<usize>,
) -> Result<Value> {
    let dim = x.width();
    super::check_width("linear", x, weight.elem_count() / weight.dim(0)?.max(1))?;
    if let Some(positions) = positions {
        super::check_width("linear", positions, dim)?;
    }
    let tensors = [&x.tensor, weight].into_iter().chain(bias).chain(positions.map(|positions| &positions.tensor));
    if cx.composed("linear", tensors)? {
        let part = |rows: &Range<usize>| -> Result<Linear> {
            let weight = weight.narrow(0, rows.start, rows.len())?;
            Ok(Linear { weight, bias: bias.map(|bias| bias.narrow(0, rows.start, rows.len())).transpose()? })
        };
        let y = part(&rows)?.forward_in(&x.tensor, cx.precision())?;
        let Some(positions) = positions else { return Ok(Value::constant(y)) };
        let first = Linear { bias: None, ..part(&(rows.start..rows.start + dim))? };
        let first =
            first.forward_in(&positions.tensor, cx.precision())?.pad_with_zeros(D::Minus1, 0, rows.len() - dim)?;
        return Ok(Value::constant(y.broadcast_add(&first)?));
    }
    let first = rows.start..rows.start + dim;
    let positions =
        positions.map(|positions| by_rows(cx, positions, None, (weight, None), first, false)).transpose()?;
    by_rows(cx, x, positions.as_ref(), (weight, bias), rows, positions.is_none())
}

/// `y = start + x wᵀ`, w: (out, in), and rows of `first`, (t, D), over and over, added to the first D columns.
pub(super) fn times(
    cx: &mut Context<'_>,
    x: &[f32],
    (w, input): (&[f32], usize),
    start: Start<'_>,
    first: Option<(&[f32], usize)>,
    y: &mut [f32],
) {
    let (n, out) = (x.len() / input, w.len() / input);
    let epilogue = |i: usize, from: usize, row: &mut [f32]| {
        let Some((first, dim)) = first else { return };
        let to = dim.min(from + row.len());
        if from < to {
            let first = &first[i % (first.len() / dim) * dim..][from..to];
            row.iter_mut().zip(first).for_each(|(y, p)| *y += p);
        }
    };
    let packed = cx.prepared.as_ref().filter(|_| n > UNPACKED_ROWS).map(|prepared| prepared.panels(w, input));
    let b = (Mat::rows(w, input).t(), packed.as_deref());
    gemm_with((n, out, input), Mat::rows(x, input), b, start, y, out, &mut cx.space.pack, epilogue);
}

fn by_rows(
    cx: &mut Context<'_>,
    x: &Value,
    first: Option<&Value>,
    (weight, bias): (&Tensor, Option<&Tensor>),
    rows: Range<usize>,
    in_place: bool,
) -> Result<Value> {
    let (out, input) = (rows.len(), weight.elem_count() / weight.dim(0)?);
    let (n, part) = (x.len() / input, rows.start * input..rows.end * input);
    let mut y = vec![0.0; n * out];
    read("linear", [&x.tensor, weight], |[x, w]| {
        let w = (&w[part.clone()], input);
        let mut run = |first: Option<(&[f32], usize)>, y: &mut [f32]| match bias {
            Some(bias) => read("linear", [bias], |[bias]| {
                times(cx, x, w, Start::Bias(&bias[rows.clone()]), first, y);
                Ok(())
            }),
            None => {
                times(cx, x, w, Start::Zero, first, y);
                Ok(())
            }
        };
        match first {
            Some(first) => read("linear", [&first.tensor], |[values]| run(Some((values, first.width())), &mut y)),
            None => run(None, &mut y),
        }
    })?;
    let mut shape = x.dims().to_vec();
    if let Some(last) = shape.last_mut() {
        *last = out;
    }
    let (of_x, of_first) = (x.node, first.map(|first| (first.node, first.len(), first.width())));
    let (x, weight, bias) = (x.tensor.clone(), weight.clone(), bias.cloned());
    cx.result(y, &shape, true, move |grad, back| {
        read("linear", [&x, &weight], |[x, w]| {
            if let Some((into, space)) = back.parameter(&weight) {
                let (g, x) = (Mat::rows(&grad, out).t(), Mat::rows(x, input));
                product((out, input, n), g, x, Start::Add, &mut into[part.clone()], &mut space.pack);
            }
            if let Some((into, _)) = bias.as_ref().and_then(|bias| back.parameter(bias)) {
                column_sums(&mut into[rows], &grad);
            }
            if of_x.is_some() {
                let (mut of, start) = match if in_place { back.take(of_x) } else { None } {
                    Some(sum) => (sum, Start::Add),
                    None => (back.space.pool.take(n * input), Start::Zero),
                };
                let (g, w) = (Mat::rows(&grad, out), Mat::rows(&w[part], input));
                product((n, input, out), g, w, start, &mut of, &mut back.space.pack);
                back.add(of_x, of);
            }
            Ok(())
        })?;
        if let Some((node, len, width)) = of_first {
            let mut sums = back.space.pool.take(len);
            sum_over_sequences(&mut sums, &grad, out, width);
            back.add(node, sums);
        }
        back.space.pool.give(grad);
        Ok(())
    })
}
