//! Number by number.

use crate::composed;
use crate::context::{Context, read};
use crate::error::Result;
use crate::kernels::{Rows, activate, activate_backward, mish_backward};
use crate::layers::Activation;
use crate::simd::vectorised;
use crate::value::Value;

/// a: (b or 1, t, D), b: (b, t, D) -> their sum
///
/// # Errors
/// Shapes that do not go together.
pub fn add(cx: &mut Context<'_>, a: &Value, b: &Value) -> Result<Value> {
    let [_, all, _] = super::sizes("add", &b.tensor)?;
    super::residual(cx, a, b, (0.0, all), None)
}

/// An activation, number by number.
///
/// # Errors
/// If the tensor library fails.
pub fn activation(cx: &mut Context<'_>, x: &Value, activation: Activation) -> Result<Value> {
    if cx.composed("activation", [&x.tensor])? {
        return Ok(Value::constant(activation.forward(&x.tensor)?));
    }
    let mut out = read("activation", [&x.tensor], |[x]| Ok(x.to_vec()))?;
    vectorised(
        #[inline(always)]
        || activate(&mut out, activation, None, 0),
    );
    let (node, shape) = (x.node, x.dims().to_vec());
    let x = x.tensor.clone();
    cx.result(out, &shape, node.is_some(), move |mut grad, back| {
        read("activation", [&x], |[x]| {
            vectorised(
                #[inline(always)]
                || activate_backward(&mut grad, x, activation, None, 0),
            );
            Ok(())
        })?;
        back.add(node, grad);
        Ok(())
    })
}

/// The same value. Its gradient is summed by itself before it is added to that of x: where the order of sums matters.
pub fn alias(cx: &mut Context<'_>, x: &Value) -> Value {
    let of = x.node;
    let node = cx.tape.as_mut().filter(|_| of.is_some()).map(|tape| {
        tape.push(move |grad, back| {
            back.add(of, grad);
            Ok(())
        })
    });
    Value { tensor: x.tensor.clone(), node }
}

/// Mish, number by number.
///
/// # Errors
/// If the tensor library fails.
pub fn mish(cx: &mut Context<'_>, x: &Value) -> Result<Value> {
    if cx.composed("mish", [&x.tensor])? {
        return Ok(Value::constant(crate::layers::mish(&x.tensor)?));
    }
    let mut out = read("mish", [&x.tensor], |[x]| Ok(x.to_vec()))?;
    crate::kernels::mish(&mut out);
    let (node, shape, x) = (x.node, x.dims().to_vec(), x.tensor.clone());
    cx.result(out, &shape, node.is_some(), move |mut grad, back| {
        read("mish", [&x], |[x]| {
            mish_backward(&mut grad, x);
            Ok(())
        })?;
        back.add(node, grad);
        Ok(())
    })
}

/// Dropout of a whole tensor.
///
/// # Errors
/// If the tensor library fails.
pub fn dropout(cx: &mut Context<'_>, x: &Value, p: f64) -> Result<Value> {
    let Some(mask) = cx.dropout(p) else { return Ok(x.clone()) };
    if cx.composed("dropout", [&x.tensor])? {
        return Ok(Value::constant(composed::masked(&x.tensor, mask.tensor(x.dims(), cx.device())?)?));
    }
    let rows = Rows { computed: 1, all: 1 };
    let width = x.len();
    let mut out = vec![0.0; width];
    read("dropout", [&x.tensor], |[x]| {
        crate::kernels::dropped(&mut out, x, Some(mask), rows, width);
        Ok(())
    })?;
    let (node, shape) = (x.node, x.dims().to_vec());
    cx.result(out, &shape, node.is_some(), move |grad, back| {
        let mut of = back.space.pool.take(width);
        crate::kernels::dropped(&mut of, &grad, Some(mask), rows, width);
        back.space.pool.give(grad);
        back.add(node, of);
        Ok(())
    })
}

/// Rows side by side: (n, a), (n, b) -> (n, a + b)
///
/// # Errors
/// Another number of rows.
pub fn cat_rows(cx: &mut Context<'_>, a: &Value, b: &Value) -> Result<Value> {
    let [n, wide_a] = super::sizes("cat rows", &a.tensor)?;
    let [_, wide_b] = super::sizes("cat rows", &b.tensor)?;
    super::check_shape("cat rows", "input", &b.tensor, &[n, wide_b])?;
    // a row of numbers is a sequence of tokens that are one wide
    let (a, b) = (a.reshape((n, wide_a, 1))?, b.reshape((n, wide_b, 1))?);
    super::cat_tokens(cx, n, &[&a, &b])?.reshape((n, wide_a + wide_b))
}

/// The mean over the tokens of each sequence: (b, t, D) -> (b, D), of a value whose gradient goes no further.
///
/// # Errors
/// If the tensor library fails.
pub fn detached_mean(cx: &mut Context<'_>, x: &Value) -> Result<Value> {
    let [b, t, dim] = super::sizes("mean", &x.tensor)?;
    if cx.composed("mean", [&x.tensor])? {
        return Ok(Value::constant(x.tensor.detach().mean(1)?));
    }
    let mut out = vec![0.0; b * dim];
    read("mean", [&x.tensor], |[x]| {
        for (out, x) in out.chunks_exact_mut(dim).zip(x.chunks_exact(t * dim)) {
            for token in x.chunks_exact(dim) {
                out.iter_mut().zip(token).for_each(|(m, x)| *m += x);
            }
            out.iter_mut().for_each(|m| *m /= t as f32);
        }
        Ok(())
    })?;
    cx.result(out, &[b, dim], false, |_, _| Ok(()))
}
