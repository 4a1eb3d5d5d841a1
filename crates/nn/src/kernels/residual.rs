//! A norm of a sum whose backward pass computes the normed rows again instead of keeping them.

use super::elementwise::{dot, drop_scale, sum};
use crate::layers::DropoutMask;
use crate::simd::vectorised;

const EPS: f32 = 1e-5;

/// What is summed: rows of x, over and over if there are fewer of them, and of a branch under its mask.
#[derive(Clone, Copy)]
pub struct Summed<'a> {
    pub x: &'a [f32],
    pub branch: Option<&'a [f32]>,
    pub mask: Option<DropoutMask>,
    pub rows: Rows,
    pub width: usize,
}

/// Row `r` of a computed tensor is row `r / computed * all + r % computed` of the one that a mask was drawn for.
#[derive(Debug, Clone, Copy)]
pub struct Rows {
    pub computed: usize,
    pub all: usize,
}

impl Rows {
    #[inline(always)]
    pub fn full(self, r: usize) -> usize {
        if self.computed == self.all { r } else { r / self.computed * self.all + r % self.computed }
    }
}

impl Summed<'_> {
    #[inline(always)]
    fn row(&self, r: usize, into: &mut [f32]) {
        let Self { width, .. } = *self;
        let own = self.x.len() / width;
        let x = &self.x[r % own * width..][..width];
        match self.branch {
            Some(branch) => {
                into.copy_from_slice(&branch[r * width..][..width]);
                drop_scale(into, self.mask, self.rows.full(r) * width);
                into.iter_mut().zip(x).for_each(|(z, x)| *z += x);
            }
            None => into.copy_from_slice(x),
        }
    }

    /// Writes the sums alone.
    pub fn sums(self, out: &mut [f32]) {
        vectorised(
            #[inline(always)]
            || out.chunks_exact_mut(self.width).enumerate().for_each(|(r, out)| self.row(r, out)),
        );
    }

    /// `out = normed * weight + bias`; `stats` takes each row's mean and 1/std.
    pub fn norm(self, weight: &[f32], bias: &[f32], out: &mut [f32], stats: &mut [f32]) {
        let width = self.width;
        vectorised(
            #[inline(always)]
            || {
                for (r, (out, stats)) in out.chunks_exact_mut(width).zip(stats.chunks_exact_mut(2)).enumerate() {
                    self.row(r, out);
                    let mean = sum(out) / width as f32;
                    out.iter_mut().for_each(|z| *z -= mean);
                    let inverse = 1.0 / (dot(out, out) / width as f32 + EPS).sqrt();
                    (stats[0], stats[1]) = (mean, inverse);
                    for ((out, w), b) in out.iter_mut().zip(weight).zip(bias) {
                        *out = *out * inverse * w + b;
                    }
                }
            },
        );
    }

    /// Turns the gradient of `out` into that of the sums, in place, and adds those of weight and bias.
    pub fn norm_backward(
        self,
        grad: &mut [f32],
        stats: &[f32],
        weight: &[f32],
        weight_grad: &mut [f32],
        bias_grad: &mut [f32],
        normed: &mut [f32],
    ) {
        let width = self.width;
        vectorised(
            #[inline(always)]
            || {
                for (r, (g, stats)) in grad.chunks_exact_mut(width).zip(stats.chunks_exact(2)).enumerate() {
                    self.row(r, normed);
                    let (mean, inverse) = (stats[0], stats[1]);
                    normed.iter_mut().for_each(|z| *z = (*z - mean) * inverse);
                    let n = &*normed;
                    for ((((g, n), w), wg), bg) in
                        g.iter_mut().zip(n).zip(weight).zip(weight_grad.iter_mut()).zip(bias_grad.iter_mut())
                    {
                        *wg += *g * n;
                        *bg += *g;
                        *g *= w;
                    }
                    let mean = sum(g) / width as f32;
                    let along = dot(g, n) / width as f32;
                    for (g, n) in g.iter_mut().zip(n) {
                        *g = (*g - mean - n * along) * inverse;
                    }
                }
            },
        );
    }
}

/// `out = mask * grad`, row by row.
pub fn dropped(out: &mut [f32], grad: &[f32], mask: Option<DropoutMask>, rows: Rows, width: usize) {
    out.copy_from_slice(grad);
    if mask.is_some() {
        vectorised(
            #[inline(always)]
            || {
                for (r, row) in out.chunks_exact_mut(width).enumerate() {
                    drop_scale(row, mask, rows.full(r) * width);
                }
            },
        );
    }
}

/// Sums the first `width` columns of rows `stride` wide over all sequences of `out.len() / width` rows.
pub fn sum_over_sequences(out: &mut [f32], x: &[f32], stride: usize, width: usize) {
    let per = out.len() / width;
    out.fill(0.0);
    vectorised(
        #[inline(always)]
        || {
            for sequence in x.chunks_exact(per * stride) {
                for (out, x) in out.chunks_exact_mut(width).zip(sequence.chunks_exact(stride)) {
                    out.iter_mut().zip(x).for_each(|(o, x)| *o += x);
                }
            }
        },
    );
}
