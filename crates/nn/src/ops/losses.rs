//! Errors of predictions as terms of a loss.

use crate::context::{Context, read};
use crate::error::Result;
use crate::loss::Term;
use crate::losses::absolute;
use crate::value::Value;
use candle_core::Tensor;

/// How far each number is off.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Error {
    /// |x|, whose gradient at 0 is 0
    Absolute,
    /// x²
    Squared,
}

/// The sum of errors of each row, (b).
#[derive(Debug, Clone)]
pub enum RowErrors {
    /// known
    Here(Vec<f64>),
    /// a device may still be computing them
    There(Tensor),
}

/// The error of a chunk, (b, H, A), over steps that are not padding, is_pad: (b, H): the sum divided by `entries`, and the sum
/// of each row.
///
/// # Errors
/// Shapes that do not go together.
pub fn chunk_error(
    cx: &mut Context<'_>,
    (got, want): (&Value, &Tensor),
    is_pad: &Tensor,
    error: Error,
    entries: usize,
) -> Result<(Term, RowErrors)> {
    let [b, h, a] = super::sizes("loss", &got.tensor)?;
    super::check_shape("loss", "actions", want, &[b, h, a])?;
    super::check_shape("loss", "padding", is_pad, &[b, h])?;
    let entries = entries.max(1) as f64;
    if cx.composed("loss", [&got.tensor, want, is_pad])? {
        let valid = (1.0 - is_pad.reshape((b, h, 1))?)?;
        let difference = (&got.tensor - want)?;
        let each = match error {
            Error::Absolute => absolute(&difference)?,
            Error::Squared => difference.sqr()?,
        };
        let each = each.broadcast_mul(&valid)?;
        let rows = RowErrors::There(each.detach().sum((1, 2))?);
        return Ok((Term::composed((each.sum_all()? / entries)?), rows));
    }
    // the sign of each difference, or twice the difference itself
    let mut slopes = cx.space.pool.take(got.len());
    let mut rows = vec![0.0f64; b];
    read("loss", [&got.tensor, want, is_pad], |[got, want, pad]| {
        let steps = got.chunks_exact(a).zip(want.chunks_exact(a)).zip(slopes.chunks_exact_mut(a)).zip(pad);
        for (t, (((got, want), slopes), pad)) in steps.enumerate() {
            if *pad > 0.0 {
                slopes.fill(0.0);
                continue;
            }
            let mut sum = 0.0;
            for ((got, want), slope) in got.iter().zip(want).zip(slopes) {
                let difference = got - want;
                match error {
                    Error::Absolute => {
                        sum += f64::from(difference.abs());
                        *slope = if difference == 0.0 { 0.0 } else { difference.signum() };
                    }
                    Error::Squared => {
                        sum += f64::from(difference) * f64::from(difference);
                        *slope = 2.0 * difference;
                    }
                }
            }
            rows[t / h] += sum;
        }
        Ok(())
    })?;
    let total: f64 = rows.iter().sum();
    let node = got.node;
    if node.is_none() || !cx.records() {
        cx.space.pool.give(slopes);
        return Ok((cx.term(total / entries, false, |_, _| Ok(())), RowErrors::Here(rows)));
    }
    let term = cx.term(total / entries, true, move |weight, back| {
        let scale = weight / entries;
        slopes.iter_mut().for_each(|slope| *slope = (f64::from(*slope) * scale) as f32);
        back.add(node, slopes);
        Ok(())
    });
    Ok((term, RowErrors::Here(rows)))
}

/// A term by a function on numbers: `on_slices` gives its value and, where it is asked, writes so many times its gradient;
/// `composed` gives the same on candle's graph.
///
/// # Errors
/// Those of the functions.
pub fn term_of(
    cx: &mut Context<'_>,
    x: &Value,
    on_slices: impl Fn(&[f32], Option<(&mut [f32], f64)>) -> f64 + 'static,
    composed: impl FnOnce(&Tensor) -> Result<Tensor>,
) -> Result<Term> {
    if cx.composed("loss", [&x.tensor])? {
        return Ok(Term::composed(composed(&x.tensor)?));
    }
    let value = read("loss", [&x.tensor], |[x]| Ok(on_slices(x, None)))?;
    let (node, x) = (x.node, x.tensor.clone());
    Ok(cx.term(value, node.is_some(), move |weight, back| {
        let mut of = back.space.pool.take(x.elem_count());
        read("loss", [&x], |[x]| {
            on_slices(x, Some((&mut of, weight)));
            Ok(())
        })?;
        back.add(node, of);
        Ok(())
    }))
}
