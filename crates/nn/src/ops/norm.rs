//! Layer norm, of a tensor or of a residual sum. What was normed is computed again for the backward pass, not kept.

use crate::composed;
use crate::context::{Context, read};
use crate::error::Result;
use crate::kernels::{Rows, Summed, dropped};
use crate::layers::{DropoutMask, LayerNorm};
use crate::value::Value;
use candle_core::Tensor;

/// x: (…, D) -> the same
///
/// # Errors
/// An input of another width.
pub fn layer_norm(cx: &mut Context<'_>, x: &Value, norm: &LayerNorm) -> Result<Value> {
    super::check_width("norm", x, norm.weight.elem_count())?;
    if cx.composed("norm", [&x.tensor, &norm.weight, &norm.bias])? {
        return Ok(Value::constant(norm.forward(&x.tensor)?));
    }
    let n = x.len() / x.width().max(1);
    sum(cx, (x, None), None, Rows { computed: n, all: n }, Some(norm))
}

/// `x + dropout(branch)`, and its norm if there is one. x: (b or 1, t, D), branch: (b, t, D), the first of `all` tokens of each
/// sequence, for which dropout is drawn.
///
/// # Errors
/// Inputs whose shapes do not go together.
pub fn residual(
    cx: &mut Context<'_>,
    x: &Value,
    branch: &Value,
    (p, all): (f64, usize),
    norm: Option<&LayerNorm>,
) -> Result<Value> {
    let mask = cx.dropout(p);
    let [b, computed, dim] = super::sizes("residual", &branch.tensor)?;
    super::check_broadcast("residual", x, branch)?;
    if let Some(norm) = norm {
        super::check_width("norm", x, norm.weight.elem_count())?;
    }
    let of_norm = norm.into_iter().flat_map(|norm| [&norm.weight, &norm.bias]);
    if cx.composed("residual", [&x.tensor, &branch.tensor].into_iter().chain(of_norm))? {
        let branch = match mask {
            Some(mask) => {
                let mask = mask.tensor(&[b, all, dim], cx.device())?.narrow(1, 0, computed)?;
                composed::masked(&branch.tensor, mask)?
            }
            None => branch.tensor.clone(),
        };
        let sum = branch.broadcast_add(&x.tensor)?;
        return Ok(Value::constant(norm.map_or(Ok(sum.clone()), |norm| norm.forward(&sum))?));
    }
    sum(cx, (x, Some(branch)), mask, Rows { computed, all }, norm)
}

fn sum(
    cx: &mut Context<'_>,
    (x, branch): (&Value, Option<&Value>),
    mask: Option<DropoutMask>,
    rows: Rows,
    norm: Option<&LayerNorm>,
) -> Result<Value> {
    let (shape, width) = (branch.unwrap_or(x).dims().to_vec(), x.width());
    let mut out = vec![0.0; shape.iter().product()];
    let mut stats = Vec::new();
    let summed = move |x: &Tensor, branch: Option<&Tensor>, f: &mut dyn FnMut(Summed<'_>) -> Result<()>| {
        read("norm", [x], |[x]| match branch {
            Some(branch) => read("norm", [branch], |[b]| f(Summed { x, branch: Some(b), mask, rows, width })),
            None => f(Summed { x, branch: None, mask, rows, width }),
        })
    };
    let tensors = (x.tensor.clone(), branch.map(|branch| branch.tensor.clone()));
    summed(&tensors.0, tensors.1.as_ref(), &mut |sum| match norm {
        None => {
            sum.sums(&mut out);
            Ok(())
        }
        Some(norm) => {
            stats = cx.space.pool.take(2 * out.len() / width);
            read("norm", [&norm.weight, &norm.bias], |[w, b]| {
                sum.norm(w, b, &mut out, &mut stats);
                Ok(())
            })
        }
    })?;
    let (node, shared) = (x.node, x.len() != out.len());
    let of_branch = branch.and_then(|branch| branch.node);
    let (norm, has_gradient) = (norm.cloned(), norm.is_some() || node.is_some() || of_branch.is_some());
    if !cx.records() {
        cx.space.pool.give(stats);
        return cx.result(out, &shape, false, |_, _| Ok(()));
    }
    let x_len = x.len();
    cx.result(out, &shape, has_gradient, move |mut grad, back| {
        if let Some(norm) = &norm {
            let (mut normed, mut bias) = (back.space.pool.take(width), back.space.pool.zeros(width));
            let mut untrained = Vec::new();
            summed(&tensors.0, tensors.1.as_ref(), &mut |sum| {
                read("norm", [&norm.weight], |[w]| {
                    let into = match back.parameter(&norm.weight) {
                        Some((into, _)) => into,
                        None => {
                            untrained.resize(width, 0.0);
                            &mut untrained[..]
                        }
                    };
                    sum.norm_backward(&mut grad, &stats, w, into, &mut bias, &mut normed);
                    Ok(())
                })
            })?;
            if let Some((into, _)) = back.parameter(&norm.bias) {
                crate::kernels::add(into, &bias);
            }
            [normed, bias, stats].into_iter().for_each(|buffer| back.space.pool.give(buffer));
        }
        if of_branch.is_some() {
            let mut of = back.space.pool.take(grad.len());
            dropped(&mut of, &grad, mask, rows, width);
            back.add(of_branch, of);
        }
        if shared && node.is_some() {
            // x stands for every sequence: so does its gradient
            let mut sums = back.take(node).unwrap_or_else(|| back.space.pool.zeros(x_len));
            grad.chunks_exact(x_len).for_each(|sequence| crate::kernels::add(&mut sums, sequence));
            back.space.pool.give(std::mem::replace(&mut grad, sums));
        }
        back.add(node, grad);
        Ok(())
    })
}
