//! Scaled dot-product attention over all heads of a batch.

use super::elementwise::{dot, drop_scale, exp, sum};
use super::gemm::{Mat, Pack, Start, gemm};
use super::pool::Pool;
use crate::layers::DropoutMask;
use crate::simd::vectorised;

/// Sizes of one attention.
#[derive(Debug, Clone, Copy)]
pub struct Heads {
    pub batch: usize,
    pub heads: usize,
    /// queries of a sequence that are computed (the first of all)
    pub queries: usize,
    /// queries of a sequence in the tensor that the dropout mask was drawn for
    pub all_queries: usize,
    pub keys: usize,
    /// width of all heads together
    pub dim: usize,
    /// queries are those of one sequence, the same for the whole batch
    pub shared_queries: bool,
    /// so are keys and values
    pub shared_keys: bool,
    /// a query sees the keys of its own step and of those before
    pub causal: bool,
}

impl Heads {
    fn head(&self) -> usize {
        self.dim / self.heads
    }

    /// Number of attention weights.
    pub fn weights(&self) -> usize {
        self.batch * self.heads * self.queries * self.keys
    }

    /// First row of the queries of sequence `b`, and of its keys.
    fn sequence(&self, b: usize) -> (usize, usize) {
        let start = |shared: bool, len: usize| if shared { 0 } else { b * len };
        (start(self.shared_queries, self.queries), start(self.shared_keys, self.keys))
    }

    /// Where row `t` of head `h` of sequence `b` starts in the mask.
    fn mask_at(&self, b: usize, h: usize, t: usize) -> usize {
        ((b * self.heads + h) * self.all_queries + t) * self.keys
    }
}

/// q: (b, t, D), kv: (b, s, 2D) with keys in the first half -> out: (b, t, D); `weights`: (b, h, t, s) takes the
/// softmax before dropout. Keys with `key_pad` 1 (b, s) are not attended to.
#[allow(clippy::too_many_arguments)] // inputs, outputs, workspace
pub fn attend(
    heads: Heads,
    q: &[f32],
    kv: &[f32],
    key_pad: Option<&[f32]>,
    mask: Option<DropoutMask>,
    weights: &mut [f32],
    out: &mut [f32],
    pool: &mut Pool,
    pack: &mut Pack,
) {
    let Heads { batch, queries: t, keys: s, dim, .. } = heads;
    let head = heads.head();
    let scale = 1.0 / (head as f32).sqrt();
    let mut dropped = pool.take(t * s);
    for b in 0..batch {
        let pad = key_pad.map(|p| &p[b * s..(b + 1) * s]);
        let (q_row, kv_row) = heads.sequence(b);
        for h in 0..heads.heads {
            let q = Mat::rows(&q[q_row * dim + h * head..], dim);
            let kv = &kv[kv_row * 2 * dim + h * head..];
            let at = (b * heads.heads + h) * t * s;
            let p = &mut weights[at..at + t * s];
            gemm((t, s, head), q, Mat::rows(kv, 2 * dim).t(), Start::Zero, p, s, pack);
            vectorised(
                #[inline(always)]
                || {
                    for (i, row) in p.chunks_exact_mut(s).enumerate() {
                        if let Some(pad) = pad {
                            row.iter_mut()
                                .zip(pad)
                                .for_each(|(x, &pad)| *x = if pad > 0.0 { f32::NEG_INFINITY } else { *x });
                        }
                        if heads.causal {
                            row[i + 1..].fill(f32::NEG_INFINITY);
                        }
                        let max = row.iter().fold(f32::NEG_INFINITY, |m, &x| if x > m { x } else { m });
                        row.iter_mut()
                            .for_each(|x| *x = if *x == f32::NEG_INFINITY { 0.0 } else { exp((*x - max) * scale) });
                        let inverse = 1.0 / sum(row);
                        row.iter_mut().for_each(|x| *x *= inverse);
                        let line = &mut dropped[i * s..(i + 1) * s];
                        line.copy_from_slice(row);
                        drop_scale(line, mask, heads.mask_at(b, h, i));
                    }
                },
            );
            let out = &mut out[b * t * dim + h * head..];
            gemm((t, head, s), Mat::rows(&dropped, s), Mat::rows(&kv[dim..], 2 * dim), Start::Zero, out, dim, pack);
        }
    }
    pool.give(dropped);
}

/// Adds the gradients of q and kv, given that of `out`.
#[allow(clippy::too_many_arguments)] // inputs, outputs, workspace
pub fn attend_backward(
    heads: Heads,
    q: &[f32],
    kv: &[f32],
    mask: Option<DropoutMask>,
    weights: &[f32],
    out_grad: &[f32],
    q_grad: &mut [f32],
    kv_grad: &mut [f32],
    pool: &mut Pool,
    pack: &mut Pack,
) {
    let Heads { batch, queries: t, keys: s, dim, .. } = heads;
    let head = heads.head();
    let scale = 1.0 / (head as f32).sqrt();
    let (mut dropped, mut grad) = (pool.take(t * s), pool.take(t * s));
    for b in 0..batch {
        let (q_row, kv_row) = heads.sequence(b);
        for h in 0..heads.heads {
            let (q_at, kv_at) = (q_row * dim + h * head, kv_row * 2 * dim + h * head);
            let at = (b * heads.heads + h) * t * s;
            let p = &weights[at..at + t * s];
            let out_grad = Mat::rows(&out_grad[b * t * dim + h * head..], dim);
            let values = Mat::rows(&kv[kv_at + dim..], 2 * dim);
            gemm((t, s, head), out_grad, values.t(), Start::Zero, &mut grad, s, pack);
            vectorised(
                #[inline(always)]
                || {
                    for (i, row) in grad.chunks_exact_mut(s).enumerate() {
                        let p = &p[i * s..(i + 1) * s];
                        let line = &mut dropped[i * s..(i + 1) * s];
                        line.copy_from_slice(p);
                        drop_scale(line, mask, heads.mask_at(b, h, i));
                        drop_scale(row, mask, heads.mask_at(b, h, i));
                        let along = dot(row, p);
                        row.iter_mut().zip(p).for_each(|(g, p)| *g = (*g - along) * p * scale);
                    }
                },
            );
            let (grad, dropped) = (Mat::rows(&grad, s), Mat::rows(&dropped, s));
            let keys = Mat::rows(&kv[kv_at..], 2 * dim);
            let queries = Mat::rows(&q[q_at..], dim);
            gemm((t, head, s), grad, keys, Start::Add, &mut q_grad[q_at..], dim, pack);
            gemm((s, head, t), grad.t(), queries, Start::Add, &mut kv_grad[kv_at..], 2 * dim, pack);
            gemm((s, head, t), dropped.t(), out_grad, Start::Add, &mut kv_grad[kv_at + dim..], 2 * dim, pack);
        }
    }
    pool.give(dropped);
    pool.give(grad);
}
