//! What stands between convolutions over the steps of sequences: GroupNorm's weights, Mish, FiLM, sums. A sequence lies step
//! after step with its channels side by side.

use super::elementwise::exp;
use crate::simd::vectorised;

/// `tanh(ln(1 + exp(x)))` and the sigmoid, from one exponential that cannot overflow.
#[inline(always)]
pub fn mish_parts(x: f32) -> (f32, f32) {
    let w = exp(-x.abs());
    let square = w * w;
    let (over, under) = if x < 0.0 { (square + 2.0 * w, 2.0) } else { (1.0 + 2.0 * w, 2.0 * square) };
    let sigmoid = if x < 0.0 { w } else { 1.0 } / (1.0 + w);
    (over / (over + under), sigmoid)
}

/// Mish and its slope.
#[inline(always)]
fn mish_and_slope(x: f32) -> (f32, f32) {
    let (t, sigmoid) = mish_parts(x);
    (x * t, t + x * (1.0 - t * t) * sigmoid)
}

/// Mish in place.
pub fn mish(x: &mut [f32]) {
    vectorised(
        #[inline(always)]
        || x.iter_mut().for_each(|x| *x *= mish_parts(*x).0),
    );
}

/// Turns the gradient after Mish into that before; `x` is what went in.
pub fn mish_backward(grad: &mut [f32], x: &[f32]) {
    vectorised(
        #[inline(always)]
        || grad.iter_mut().zip(x).for_each(|(g, &x)| *g *= mish_and_slope(x).1),
    );
}

/// Fills y, (rows, C), with `bias`: what a convolution is added to.
pub fn add_bias(y: &mut [f32], bias: &[f32]) {
    y.chunks_exact_mut(bias.len()).for_each(|row| row.copy_from_slice(bias));
}

/// What a condition does to the channels of a sequence.
#[derive(Clone, Copy)]
pub struct Film<'a> {
    /// (n, 2C), scales before shifts, or (n, C), shifts
    pub values: &'a [f32],
    /// whether there are scales
    pub scales: bool,
}

impl<'a> Film<'a> {
    /// Scales, of which there may be none, and shifts of sequence `n`.
    #[inline(always)]
    fn of(self, n: usize, c: usize) -> (Option<&'a [f32]>, &'a [f32]) {
        match self.scales {
            true => {
                let (scale, shift) = self.values[2 * n * c..2 * (n + 1) * c].split_at(c);
                (Some(scale), shift)
            }
            false => (None, &self.values[n * c..(n + 1) * c]),
        }
    }
}

/// What follows the activation.
#[derive(Clone, Copy)]
pub enum After<'a> {
    /// nothing
    Nothing,
    /// channels scaled and shifted
    Film(Film<'a>),
    /// (n, steps, C), added
    Plain(&'a [f32]),
}

/// `mish(y * weight + bias)`, then `after`. y: (n, steps, C).
pub fn norm_mish(y: &[f32], (weight, bias): (&[f32], &[f32]), after: After<'_>, steps: usize, out: &mut [f32]) {
    let c = weight.len();
    let row = steps * c;
    vectorised(
        #[inline(always)]
        || {
            for (n, (out, y)) in out.chunks_exact_mut(row).zip(y.chunks_exact(row)).enumerate() {
                for (out, y) in out.chunks_exact_mut(c).zip(y.chunks_exact(c)) {
                    for (((out, y), w), b) in out.iter_mut().zip(y).zip(weight).zip(bias) {
                        let z = y * w + b;
                        *out = z * mish_parts(z).0;
                    }
                }
                match after {
                    After::Nothing => {}
                    After::Film(film) => {
                        let (scale, shift) = film.of(n, c);
                        for out in out.chunks_exact_mut(c) {
                            if let Some(scale) = scale {
                                out.iter_mut().zip(scale).for_each(|(out, scale)| *out *= scale);
                            }
                            out.iter_mut().zip(shift).for_each(|(out, shift)| *out += shift);
                        }
                    }
                    After::Plain(x) => out.iter_mut().zip(&x[n * row..]).for_each(|(out, x)| *out += x),
                }
            }
        },
    );
}

/// Turns the gradient of [`norm_mish`]'s output, (n, steps, C), into that of the normed values times weight plus bias; with
/// `film` the gradient of its values goes into the buffer beside it.
pub fn norm_mish_backward(
    grad: &mut [f32],
    y: &[f32],
    (weight, bias): (&[f32], &[f32]),
    film: Option<(Film<'_>, &mut [f32])>,
    steps: usize,
) {
    let c = weight.len();
    let row = steps * c;
    let (film, mut into) = film.map_or((None, None), |(film, into)| (Some(film), Some(into)));
    let per = if film.is_some_and(|film| film.scales) { 2 * c } else { c };
    vectorised(
        #[inline(always)]
        || {
            for (n, (grad, y)) in grad.chunks_exact_mut(row).zip(y.chunks_exact(row)).enumerate() {
                let (Some(film), Some(into)) = (film, into.as_deref_mut()) else {
                    for (g, y) in grad.chunks_exact_mut(c).zip(y.chunks_exact(c)) {
                        for (((g, y), w), b) in g.iter_mut().zip(y).zip(weight).zip(bias) {
                            *g *= mish_and_slope(y * w + b).1;
                        }
                    }
                    continue;
                };
                let into = &mut into[n * per..(n + 1) * per];
                into.fill(0.0);
                let (of_scale, of_shift) = into.split_at_mut(per - c);
                let (scale, _) = film.of(n, c);
                for (g, y) in grad.chunks_exact_mut(c).zip(y.chunks_exact(c)) {
                    of_shift.iter_mut().zip(&*g).for_each(|(sum, g)| *sum += g);
                    match scale {
                        Some(scale) => {
                            let each =
                                g.iter_mut().zip(y).zip(weight.iter().zip(bias)).zip(scale.iter().zip(&mut *of_scale));
                            for (((g, y), (w, b)), (scale, sum)) in each {
                                let (value, slope) = mish_and_slope(y * w + b);
                                *sum += *g * value;
                                *g *= scale * slope;
                            }
                        }
                        None => {
                            for (((g, y), w), b) in g.iter_mut().zip(y).zip(weight).zip(bias) {
                                *g *= mish_and_slope(y * w + b).1;
                            }
                        }
                    }
                }
            }
        },
    );
}
