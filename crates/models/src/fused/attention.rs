//! The attention branch: projections, positions, attention, output projection.

use super::{Grads, Pass, Workspace, slot, weight_gradient};
use crate::layers::DropoutMask;
use nn::kernels::{Heads, Mat, Start, attend, attend_backward, column_sums, product, sum_over_sequences};

/// What attention's backward pass needs.
#[derive(Debug)]
pub(super) struct Attention {
    pub(super) heads: Heads,
    mask: Option<DropoutMask>,
    q: Vec<f32>,
    kv: Vec<f32>,
    weights: Vec<f32>,
    mixed: Vec<f32>,
}

/// Inputs of an attention: x (rows, D) and the positions (one sequence, D) added to it for queries or keys.
#[derive(Clone, Copy)]
pub(super) struct Side<'a> {
    pub(super) x: &'a [f32],
    pub(super) pos: &'a [f32],
}

/// `x w + bias`, and `pos` through the first D columns of w, which are queries or keys: values have no positions.
fn project(pass: &mut Pass<'_>, side: Side<'_>, w: &[f32], bias: &[f32]) -> Vec<f32> {
    let dim = pass.shape.dim;
    let steps = side.pos.len() / dim;
    let pos = pass.times(side.pos, &w[..dim * dim], Start::Zero, |_, _, _| ());
    let y = pass.times(side.x, w, Start::Bias(bias), |i, from, row| {
        let to = dim.min(from + row.len());
        if from < to {
            let pos = &pos[i % steps * dim..][from..to];
            row.iter_mut().zip(pos).for_each(|(y, p)| *y += p);
        }
    });
    pass.give(pos);
    y
}

impl Attention {
    /// The queries, (rows, D)
    pub(super) fn queries(pass: &mut Pass<'_>, prefix: &str, query: Side<'_>) -> Vec<f32> {
        let dim = pass.shape.dim;
        let (w, bias) = (pass.weight(prefix, ".in_proj_weight"), pass.weight(prefix, ".in_proj_bias"));
        project(pass, query, &w[..dim * dim], &bias[..dim])
    }

    /// -> (b * queries, D)
    pub(super) fn forward(
        pass: &mut Pass<'_>,
        prefix: &str,
        heads: Heads,
        query: Side<'_>,
        key: Side<'_>,
        key_pad: Option<&[f32]>,
    ) -> (Vec<f32>, Self) {
        let q = Self::queries(pass, prefix, query);
        Self::of_queries(pass, prefix, heads, q, key, key_pad)
    }

    /// `forward` with the queries at hand.
    pub(super) fn of_queries(
        pass: &mut Pass<'_>,
        prefix: &str,
        heads: Heads,
        q: Vec<f32>,
        key: Side<'_>,
        key_pad: Option<&[f32]>,
    ) -> (Vec<f32>, Self) {
        let dim = heads.dim;
        let (w, bias) = (pass.weight(prefix, ".in_proj_weight"), pass.weight(prefix, ".in_proj_bias"));
        let kv = project(pass, key, &w[dim * dim..], &bias[dim..]);
        let mask = pass.mask();
        let (mut weights, mut mixed) = (pass.take(heads.weights()), pass.take(heads.batch * heads.queries * dim));
        let Workspace { pool, pack } = &mut *pass.space;
        attend(heads, &q, &kv, key_pad, mask, &mut weights, &mut mixed, pool, pack);
        let branch = pass.linear(&format!("{prefix}.out_proj"), &mixed);
        (branch, Self { heads, mask, q, kv, weights, mixed })
    }

    /// Adds the parameters' and positions' gradients; returns those of queries and of keys with values.
    #[allow(clippy::too_many_arguments)] // inputs and gradients of both sides
    pub(super) fn backward(
        self,
        pass: &mut Pass<'_>,
        prefix: &str,
        branch_grad: &[f32],
        query: Side<'_>,
        key: Side<'_>,
        query_pos_grad: Option<&mut [f32]>,
        key_pos_grad: Option<&mut [f32]>,
        grads: &mut Grads<'_>,
    ) -> (Vec<f32>, Vec<f32>) {
        let dim = self.heads.dim;
        let out = format!("{prefix}.out_proj");
        pass.linear_backward(&out, &self.mixed, branch_grad, dim, grads);
        let mixed_grad = pass.linear_input(&out, branch_grad, dim);
        let (mut dq, mut dkv) = (pass.space.pool.zeros(self.q.len()), pass.space.pool.zeros(self.kv.len()));
        let Workspace { pool, pack } = &mut *pass.space;
        attend_backward(
            self.heads,
            &self.q,
            &self.kv,
            self.mask,
            &self.weights,
            &mixed_grad,
            &mut dq,
            &mut dkv,
            pool,
            pack,
        );
        pass.give(mixed_grad);

        let w = pass.weight(prefix, ".in_proj_weight");
        let (wq, wk) = (&w[..dim * dim], &w[dim * dim..2 * dim * dim]);
        let into = slot(grads, prefix, ".in_proj_weight");
        let (into_q, into_kv) = into.split_at_mut(dim * dim);
        weight_gradient((dim, dim), &dq, dim, query.x, into_q, &mut pass.space.pack);
        weight_gradient((2 * dim, dim), &dkv, 2 * dim, key.x, into_kv, &mut pass.space.pack);
        let sides = [
            (&dq, dim, query.pos, wq, into_q, query_pos_grad),
            (&dkv, 2 * dim, key.pos, wk, &mut into_kv[..dim * dim], key_pos_grad),
        ];
        for (grad, stride, pos, w, into, pos_grad) in sides {
            let mut sums = pass.take(pos.len());
            sum_over_sequences(&mut sums, grad, stride, dim);
            weight_gradient((dim, dim), &sums, dim, pos, into, &mut pass.space.pack);
            if let Some(pos_grad) = pos_grad {
                let steps = pos.len() / dim;
                product(
                    (steps, dim, dim),
                    Mat::rows(&sums, dim),
                    Mat::rows(w, dim),
                    Start::Add,
                    pos_grad,
                    &mut pass.space.pack,
                );
            }
            pass.give(sums);
        }
        let (bias_q, bias_kv) = slot(grads, prefix, ".in_proj_bias").split_at_mut(dim);
        column_sums(bias_q, &dq);
        column_sums(bias_kv, &dkv);
        self.free(pass);
        (dq, dkv)
    }

    /// Adds to the gradients of the inputs.
    pub(super) fn query_input(pass: &mut Pass<'_>, prefix: &str, dq: &[f32], start: Start<'_>, into: &mut [f32]) {
        let dim = pass.shape.dim;
        let w = Mat::rows(&pass.weight(prefix, ".in_proj_weight")[..dim * dim], dim);
        product((dq.len() / dim, dim, dim), Mat::rows(dq, dim), w, start, into, &mut pass.space.pack);
    }

    pub(super) fn key_input(pass: &mut Pass<'_>, prefix: &str, dkv: &[f32], start: Start<'_>, into: &mut [f32]) {
        let dim = pass.shape.dim;
        let w = Mat::rows(&pass.weight(prefix, ".in_proj_weight")[dim * dim..], dim);
        product((dkv.len() / (2 * dim), dim, 2 * dim), Mat::rows(dkv, 2 * dim), w, start, into, &mut pass.space.pack);
    }

    pub(super) fn free(self, pass: &mut Pass<'_>) {
        for buffer in [self.q, self.kv, self.weights, self.mixed] {
            pass.give(buffer);
        }
    }
}
