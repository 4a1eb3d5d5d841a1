//! The shared layer of ACTRM's recursion: attention from x to a context, then the dense part, each with a norm after
//! the sum. The context's keys and values come ready, because most of them serve several updates.

use super::feed_forward::FeedForward;
use super::{Grads, Pass, Residual, Rows, Workspace, slot, weight_gradient};
use nn::kernels::{Heads, Mat, Start, add, attend, attend_backward, column_sums, product, sum_over_sequences};
use std::ops::Range;

/// What a layer's backward pass needs.
#[derive(Debug)]
pub(crate) struct BlockLayer {
    prefix: String,
    heads: Heads,
    q: Vec<f32>,
    kv: Vec<f32>,
    weights: Vec<f32>,
    mixed: Vec<f32>,
    residual1: Residual,
    y: Vec<f32>,
    ff: FeedForward,
    residual2: Residual,
}

/// Tokens of a context: of every sequence, (b, t, width), or of one that stands for all, (t, width).
#[derive(Clone, Copy)]
pub(crate) struct Part<'a> {
    pub(crate) values: &'a [f32],
    pub(crate) tokens: usize,
}

/// (b, s, width): the parts one after the other in every sequence.
pub(crate) fn gather(pass: &mut Pass<'_>, batch: usize, width: usize, parts: &[Part<'_>]) -> Vec<f32> {
    let all: usize = parts.iter().map(|p| p.tokens).sum();
    let mut out = pass.take(batch * all * width);
    for (b, sequence) in out.chunks_exact_mut(all * width).enumerate() {
        let mut rest = sequence;
        for part in parts {
            let len = part.tokens * width;
            let (head, tail) = rest.split_at_mut(len);
            let from = if part.values.len() == len { 0 } else { b * len };
            head.copy_from_slice(&part.values[from..from + len]);
            rest = tail;
        }
    }
    out
}

/// The reverse of `gather`: adds each part of (b, s, width) to its buffer, given with its tokens.
pub(crate) fn scatter(x: &[f32], width: usize, parts: &mut [(&mut [f32], usize)]) {
    let all: usize = parts.iter().map(|(_, tokens)| tokens).sum();
    for (b, sequence) in x.chunks_exact(all * width).enumerate() {
        let mut rest = sequence;
        for (into, tokens) in parts.iter_mut() {
            let len = *tokens * width;
            let (head, tail) = rest.split_at(len);
            let from = if into.len() == len { 0 } else { b * len };
            add(&mut into[from..from + len], head);
            rest = tail;
        }
    }
}

/// A layer's input.
#[derive(Clone, Copy)]
pub(crate) struct Input<'a> {
    pub(crate) x: &'a [f32],
    /// the name of an x that is a parameter, so that predictions project it once
    pub(crate) parameter: Option<&'static str>,
}

/// x: (rows, D) -> keys and values (rows, 2D) of the attention below `prefix`
pub(crate) fn keys_and_values(pass: &mut Pass<'_>, prefix: &str, input: Input<'_>) -> Vec<f32> {
    let dim = pass.shape.dim;
    project(pass, prefix, input, "keys and values", dim..3 * dim)
}

/// x: (rows, D) -> (rows, n) by these n rows of the attention's projections
fn project(pass: &mut Pass<'_>, prefix: &str, input: Input<'_>, what: &str, rows: Range<usize>) -> Vec<f32> {
    let dim = pass.shape.dim;
    let (w, bias) = (pass.weight(prefix, ".in_proj_weight"), pass.weight(prefix, ".in_proj_bias"));
    let (w, bias) = (&w[rows.start * dim..rows.end * dim], &bias[rows]);
    let make = |pass: &mut Pass<'_>| pass.times(input.x, w, Start::Bias(bias), |_, _, _| ());
    match input.parameter {
        Some(parameter) => pass.fixed(|| format!("{prefix}: {what} of {parameter}"), make),
        None => make(pass),
    }
}

/// Adds the parameters' gradients, given that of keys and values, and adds that of x to `into`.
pub(crate) fn keys_and_values_backward(
    pass: &mut Pass<'_>,
    prefix: &str,
    x: &[f32],
    grad: &[f32],
    into: &mut [f32],
    grads: &mut Grads<'_>,
) {
    let dim = pass.shape.dim;
    let w = &pass.weight(prefix, ".in_proj_weight")[dim * dim..];
    project_backward(pass, (x, grad), w, Some(into), &mut slot(grads, prefix, ".in_proj_weight")[dim * dim..]);
    column_sums(&mut slot(grads, prefix, ".in_proj_bias")[dim..], grad);
}

/// Adds the gradients of w and x, given that of `x wᵀ`.
fn project_backward(
    pass: &mut Pass<'_>,
    (x, grad): (&[f32], &[f32]),
    w: &[f32],
    into: Option<&mut [f32]>,
    w_grad: &mut [f32],
) {
    let dim = pass.shape.dim;
    let out = w.len() / dim;
    weight_gradient((out, dim), grad, out, x, w_grad, &mut pass.space.pack);
    if let Some(into) = into {
        let (g, w) = (Mat::rows(grad, out), Mat::rows(w, dim));
        product((grad.len() / out, dim, out), g, w, Start::Add, into, &mut pass.space.pack);
    }
}

impl BlockLayer {
    /// x: (b, t, D), or (t, D) for all sequences alike, kv: (b, s, 2D) -> (b, t, D)
    pub(crate) fn forward(
        pass: &mut Pass<'_>,
        prefix: String,
        (batch, queries): (usize, usize),
        input: Input<'_>,
        kv: Vec<f32>,
    ) -> (Vec<f32>, Self) {
        let x = input.x;
        let (dim, heads) = (pass.shape.dim, pass.shape.heads);
        let keys = kv.len() / (batch * 2 * dim);
        let shared_queries = x.len() == queries * dim;
        let heads = Heads {
            batch,
            heads,
            queries,
            all_queries: queries,
            keys,
            dim,
            shared_queries,
            shared_keys: false,
            causal: false,
        };
        let rows = Rows { computed: queries, all: queries };
        let attn = format!("{prefix}.attn");
        let q = project(pass, &attn, input, "queries", 0..dim);
        let (mut weights, mut mixed) = (pass.take(heads.weights()), pass.take(batch * queries * dim));
        let Workspace { pool, pack } = &mut *pass.space;
        attend(heads, &q, &kv, None, None, &mut weights, &mut mixed, pool, pack);
        let branch = pass.linear(&format!("{attn}.out_proj"), &mixed);
        let (y, residual1) = Residual::leave(pass, &format!("{prefix}.norm1"), None, x, branch, rows);
        let (branch, ff) = FeedForward::forward(pass, &prefix, &y, rows);
        let (out, residual2) = Residual::leave(pass, &format!("{prefix}.norm2"), None, &y, branch, rows);
        (out, Self { prefix, heads, q, kv, weights, mixed, residual1, y, ff, residual2 })
    }

    /// grad: that of the output -> those of x, of x's own number of rows, and of kv
    pub(crate) fn backward(
        self,
        pass: &mut Pass<'_>,
        mut grad: Vec<f32>,
        x: &[f32],
        grads: &mut Grads<'_>,
    ) -> (Vec<f32>, Vec<f32>) {
        let Self { prefix, heads, q, kv, weights, mixed, residual1, y, ff, residual2 } = self;
        let dim = pass.shape.dim;
        let (branch, _) = residual2.leave_backward(pass, &format!("{prefix}.norm2"), &mut grad, grads);
        let y_grad = ff.backward(pass, &prefix, &branch, &y, grads);
        add(&mut grad, &y_grad);
        for buffer in [branch, y_grad, y] {
            pass.give(buffer);
        }

        let (branch, _) = residual1.leave_backward(pass, &format!("{prefix}.norm1"), &mut grad, grads);
        let (attn, out) = (format!("{prefix}.attn"), format!("{prefix}.attn.out_proj"));
        pass.linear_backward(&out, &mixed, &branch, dim, grads);
        let mixed_grad = pass.linear_input(&out, &branch, dim);
        let (mut dq, mut dkv) = (pass.space.pool.zeros(q.len()), pass.space.pool.zeros(kv.len()));
        let Workspace { pool, pack } = &mut *pass.space;
        attend_backward(heads, &q, &kv, None, &weights, &mixed_grad, &mut dq, &mut dkv, pool, pack);
        for buffer in [branch, mixed_grad, q, kv, weights, mixed] {
            pass.give(buffer);
        }

        // the sum around the branch, then the queries
        let mut x_grad = if x.len() == grad.len() {
            grad
        } else {
            let mut sums = pass.take(x.len());
            sum_over_sequences(&mut sums, &grad, dim, dim);
            pass.give(grad);
            sums
        };
        let w = &pass.weight(&attn, ".in_proj_weight")[..dim * dim];
        let w_grad = &mut slot(grads, &attn, ".in_proj_weight")[..dim * dim];
        project_backward(pass, (x, &dq), w, Some(&mut x_grad), w_grad);
        column_sums(&mut slot(grads, &attn, ".in_proj_bias")[..dim], &dq);
        pass.give(dq);
        (x_grad, dkv)
    }

    /// Gives the buffers back without a backward pass.
    pub(crate) fn free(self, pass: &mut Pass<'_>) {
        self.ff.free(pass);
        for residual in [self.residual1, self.residual2] {
            residual.norm.free(pass);
        }
        for buffer in [self.q, self.kv, self.weights, self.mixed, self.y] {
            pass.give(buffer);
        }
    }
}
