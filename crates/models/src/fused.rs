//! Transformer layers with hand-written backward passes, on slices.
//!
//! The same layers as `layers` and `act` build from candle operations, for training steps and predictions that must be
//! fast. A layer's forward pass consumes its input and returns what its backward pass needs; gradients are added into
//! buffers found by the parameter's name. Position embeddings are added to queries and keys only, so their projections
//! are computed once for the batch: `(x + pos) Wᵀ = x Wᵀ + pos Wᵀ`.

use crate::kernels::{
    Heads, Mat, Pack, Pool, Start, activate, activate_backward, add, attend, attend_backward, column_sums, drop_scale,
    gemm_with, layer_norm, layer_norm_backward, product,
};
use crate::layers::{Activation, DropoutMask};
use crate::rng::Rng;
use crate::simd::vectorised;
use std::collections::BTreeMap;

/// Parameters by name.
pub(crate) type Weights<'a> = BTreeMap<&'a str, &'a [f32]>;
/// Gradients by name.
pub(crate) type Grads<'a> = BTreeMap<&'a str, &'a mut [f32]>;

/// Buffers of one shard, reused from step to step.
#[derive(Debug, Default)]
pub(crate) struct Workspace {
    pub(crate) pool: Pool,
    pub(crate) pack: Pack,
}

/// What all layers of a model share.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Shape {
    pub(crate) dim: usize,
    pub(crate) heads: usize,
    pub(crate) hidden: usize,
    pub(crate) activation: Activation,
    pub(crate) dropout: f64,
    pub(crate) pre_norm: bool,
}

/// Parameters, shape and workspace of one pass.
pub(crate) struct Pass<'a> {
    pub(crate) weights: &'a Weights<'a>,
    pub(crate) shape: Shape,
    pub(crate) space: &'a mut Workspace,
    /// draws dropout masks, in the order in which the composed layers draw them; `None` for no dropout
    pub(crate) rng: Option<&'a mut Rng>,
}

/// Row `r` of a computed tensor is row `r / computed * all + r % computed` of the whole one.
#[derive(Debug, Clone, Copy)]
struct Rows {
    computed: usize,
    all: usize,
}

impl Rows {
    #[inline(always)]
    fn full(self, r: usize) -> usize {
        if self.computed == self.all { r } else { r / self.computed * self.all + r % self.computed }
    }
}

impl<'a> Pass<'a> {
    pub(crate) fn weight(&self, prefix: &str, name: &str) -> &'a [f32] {
        let name = format!("{prefix}{name}");
        self.weights.get(name.as_str()).copied().expect("the model was built with this parameter")
    }

    fn mask(&mut self) -> Option<DropoutMask> {
        match &mut self.rng {
            Some(rng) if self.shape.dropout > 0.0 => Some(DropoutMask::draw(self.shape.dropout, rng)),
            _ => None,
        }
    }

    pub(crate) fn take(&mut self, len: usize) -> Vec<f32> {
        self.space.pool.take(len)
    }

    pub(crate) fn give(&mut self, buffer: Vec<f32>) {
        self.space.pool.give(buffer);
    }

    /// x: (rows, in) -> (rows, out), `y = x Wᵀ + b`
    pub(crate) fn linear(&mut self, prefix: &str, x: &[f32], input: usize) -> Vec<f32> {
        let (w, b) = (self.weight(prefix, ".weight"), self.weight(prefix, ".bias"));
        let (rows, output) = (x.len() / input, b.len());
        let mut y = self.take(rows * output);
        let (x, w) = (Mat::rows(x, input), Mat::rows(w, input).t());
        product((rows, output, input), x, w, Start::Bias(b), &mut y, &mut self.space.pack);
        y
    }

    /// Adds the gradients of weight and bias.
    pub(crate) fn linear_backward(
        &mut self,
        prefix: &str,
        x: &[f32],
        grad: &[f32],
        input: usize,
        grads: &mut Grads<'_>,
    ) {
        let output = self.weight(prefix, ".bias").len();
        weight_gradient((output, input), grad, output, x, slot(grads, prefix, ".weight"), &mut self.space.pack);
        column_sums(slot(grads, prefix, ".bias"), grad);
    }

    /// The gradient of a linear layer's input.
    pub(crate) fn linear_input(&mut self, prefix: &str, grad: &[f32], input: usize) -> Vec<f32> {
        let output = self.weight(prefix, ".bias").len();
        let rows = grad.len() / output;
        let mut into = self.take(rows * input);
        let (g, w) = (Mat::rows(grad, output), Mat::rows(self.weight(prefix, ".weight"), input));
        product((rows, input, output), g, w, Start::Zero, &mut into, &mut self.space.pack);
        into
    }
}

/// The gradient buffer of a parameter.
pub(crate) fn slot<'g>(grads: &'g mut Grads<'_>, prefix: &str, name: &str) -> &'g mut [f32] {
    grads.get_mut(format!("{prefix}{name}").as_str()).expect("gradients have the model's layout")
}

/// `into (out, in) += gradᵀ (out, rows) x (rows, in)`; rows of `grad` are `stride` apart.
fn weight_gradient(
    (out, input): (usize, usize),
    grad: &[f32],
    stride: usize,
    x: &[f32],
    into: &mut [f32],
    pack: &mut Pack,
) {
    let rows = x.len() / input;
    let (g, x) = (Mat::rows(grad, stride).t(), Mat::rows(x, input));
    product((out, input, rows), g, x, Start::Add, into, pack);
}

/// Sums the first `width` columns of rows `stride` wide over all sequences of `out.len() / width` rows.
fn sum_over_sequences(out: &mut [f32], x: &[f32], stride: usize, width: usize) {
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

/// What a norm's backward pass needs.
#[derive(Debug)]
pub(crate) struct Norm {
    normed: Vec<f32>,
    inverse: Vec<f32>,
}

impl Norm {
    /// x: (rows, D) -> (rows, D)
    pub(crate) fn forward(pass: &mut Pass<'_>, prefix: &str, x: &[f32]) -> (Vec<f32>, Self) {
        let normed = pass.take(x.len());
        Self::of_sum(pass, prefix, x, normed, None)
    }

    /// The norm of `x + mask * branch`.
    fn of_sum(
        pass: &mut Pass<'_>,
        prefix: &str,
        x: &[f32],
        mut branch: Vec<f32>,
        mask: Option<(Option<DropoutMask>, Rows)>,
    ) -> (Vec<f32>, Self) {
        let (w, b) = (pass.weight(prefix, ".weight"), pass.weight(prefix, ".bias"));
        let (mut out, mut inverse) = (pass.take(branch.len()), pass.take(branch.len() / w.len()));
        let full = |r: usize| mask.map_or(r, |(_, rows)| rows.full(r));
        let mask = mask.map(|(mask, _)| (mask, &full as &dyn Fn(usize) -> usize));
        layer_norm(x, &mut branch, mask, w, b, &mut out, &mut inverse);
        (out, Self { normed: branch, inverse })
    }

    /// Turns the gradient of the output into that of the input.
    pub(crate) fn backward(self, pass: &mut Pass<'_>, prefix: &str, grad: &mut [f32], grads: &mut Grads<'_>) {
        let w = pass.weight(prefix, ".weight");
        // two buffers of the same map at once: the small one goes through the pool
        let mut bias = pass.space.pool.zeros(w.len());
        layer_norm_backward(grad, &self.normed, &self.inverse, w, slot(grads, prefix, ".weight"), &mut bias);
        add(slot(grads, prefix, ".bias"), &bias);
        pass.give(bias);
        self.free(pass);
    }

    pub(crate) fn free(self, pass: &mut Pass<'_>) {
        pass.give(self.normed);
        pass.give(self.inverse);
    }
}

/// A branch around which the input is added again, with the norm before the branch or after the sum.
#[derive(Debug)]
struct Residual {
    norm: Norm,
    mask: Option<DropoutMask>,
    rows: Rows,
}

/// What a residual branch reads: with the norm first, `y = norm(x)` and x is kept for the sum; otherwise y is x.
struct Entry {
    y: Vec<f32>,
    x: Option<Vec<f32>>,
    norm: Option<Norm>,
}

fn enter(pass: &mut Pass<'_>, norm: &str, x: Vec<f32>) -> Entry {
    if !pass.shape.pre_norm {
        return Entry { y: x, x: None, norm: None };
    }
    let (y, norm) = Norm::forward(pass, norm, &x);
    Entry { y, x: Some(x), norm: Some(norm) }
}

impl Residual {
    /// `x`: (rows or one sequence, D) and `branch`: (rows, D) -> (rows, D)
    fn leave(
        pass: &mut Pass<'_>,
        norm: &str,
        before: Option<Norm>,
        x: &[f32],
        mut branch: Vec<f32>,
        rows: Rows,
    ) -> (Vec<f32>, Self) {
        let mask = pass.mask();
        match before {
            None => {
                let (out, norm) = Norm::of_sum(pass, norm, x, branch, Some((mask, rows)));
                (out, Self { norm, mask, rows })
            }
            Some(norm) => {
                let width = pass.shape.dim;
                vectorised(
                    #[inline(always)]
                    || {
                        let sums = branch.chunks_exact_mut(width).zip(x.chunks_exact(width).cycle());
                        for (r, (z, x)) in sums.enumerate() {
                            drop_scale(z, mask, rows.full(r) * width);
                            z.iter_mut().zip(x).for_each(|(z, x)| *z += x);
                        }
                    },
                );
                (branch, Self { norm, mask, rows })
            }
        }
    }

    /// Turns the gradient of the output into that of x through the sum, and returns that of the branch's output, and
    /// the norm if it still has to be passed (`Entry`'s).
    fn leave_backward(
        self,
        pass: &mut Pass<'_>,
        prefix: &str,
        grad: &mut [f32],
        grads: &mut Grads<'_>,
    ) -> (Vec<f32>, Option<Norm>) {
        let Self { norm, mask, rows } = self;
        let norm = if pass.shape.pre_norm {
            Some(norm)
        } else {
            norm.backward(pass, prefix, grad, grads);
            None
        };
        let width = pass.shape.dim;
        let mut branch = pass.space.pool.copy(grad);
        vectorised(
            #[inline(always)]
            || {
                for (r, row) in branch.chunks_exact_mut(width).enumerate() {
                    drop_scale(row, mask, rows.full(r) * width);
                }
            },
        );
        (branch, norm)
    }
}

/// Passes the gradient of the branch's input through the norm before it, if there is one.
fn enter_backward(pass: &mut Pass<'_>, prefix: &str, norm: Option<Norm>, y_grad: &mut [f32], grads: &mut Grads<'_>) {
    if let Some(norm) = norm {
        norm.backward(pass, prefix, y_grad, grads);
    }
}

/// What attention's backward pass needs.
#[derive(Debug)]
struct Attention {
    heads: Heads,
    mask: Option<DropoutMask>,
    q: Vec<f32>,
    kv: Vec<f32>,
    weights: Vec<f32>,
    mixed: Vec<f32>,
}

/// Inputs of an attention: x (rows, D) and the positions (one sequence, D) added to it for queries or keys.
#[derive(Clone, Copy)]
struct Side<'a> {
    x: &'a [f32],
    pos: &'a [f32],
}

impl Attention {
    /// -> (b * queries, D)
    fn forward(
        pass: &mut Pass<'_>,
        prefix: &str,
        heads: Heads,
        query: Side<'_>,
        key: Side<'_>,
        key_pad: Option<&[f32]>,
    ) -> (Vec<f32>, Self) {
        let dim = heads.dim;
        let (w, bias) = (pass.weight(prefix, ".in_proj_weight"), pass.weight(prefix, ".in_proj_bias"));
        let mut project = |side: Side<'_>, w: &[f32], bias: &[f32]| {
            let (rows, out) = (side.x.len() / dim, bias.len());
            let steps = side.pos.len() / dim;
            let mut pos = pass.take(steps * dim);
            let mut y = pass.take(rows * out);
            let weight = Mat::rows(w, dim).t();
            product((steps, dim, dim), Mat::rows(side.pos, dim), weight, Start::Zero, &mut pos, &mut pass.space.pack);
            let epilogue = |i: usize, from: usize, row: &mut [f32]| {
                let to = dim.min(from + row.len());
                if from < to {
                    let pos = &pos[i % steps * dim..][from..to];
                    row.iter_mut().zip(pos).for_each(|(y, p)| *y += p);
                }
            };
            gemm_with(
                (rows, out, dim),
                Mat::rows(side.x, dim),
                weight,
                Start::Bias(bias),
                &mut y,
                out,
                &mut pass.space.pack,
                epilogue,
            );
            pass.give(pos);
            y
        };
        let (wq, wkv) = w.split_at(dim * dim);
        let (bq, bkv) = bias.split_at(dim);
        let (q, kv) = (project(query, wq, bq), project(key, wkv, bkv));
        let mask = pass.mask();
        let (mut weights, mut mixed) = (pass.take(heads.weights()), pass.take(heads.batch * heads.queries * dim));
        let Workspace { pool, pack } = &mut *pass.space;
        attend(heads, &q, &kv, key_pad, mask, &mut weights, &mut mixed, pool, pack);
        let branch = pass.linear(&format!("{prefix}.out_proj"), &mixed, dim);
        (branch, Self { heads, mask, q, kv, weights, mixed })
    }

    /// Adds the parameters' and positions' gradients; returns those of queries and of keys with values.
    #[allow(clippy::too_many_arguments)] // inputs and gradients of both sides
    fn backward(
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
    fn query_input(pass: &mut Pass<'_>, prefix: &str, dq: &[f32], start: Start<'_>, into: &mut [f32]) {
        let dim = pass.shape.dim;
        let w = Mat::rows(&pass.weight(prefix, ".in_proj_weight")[..dim * dim], dim);
        product((dq.len() / dim, dim, dim), Mat::rows(dq, dim), w, start, into, &mut pass.space.pack);
    }

    fn key_input(pass: &mut Pass<'_>, prefix: &str, dkv: &[f32], start: Start<'_>, into: &mut [f32]) {
        let dim = pass.shape.dim;
        let w = Mat::rows(&pass.weight(prefix, ".in_proj_weight")[dim * dim..], dim);
        product((dkv.len() / (2 * dim), dim, 2 * dim), Mat::rows(dkv, 2 * dim), w, start, into, &mut pass.space.pack);
    }

    fn free(self, pass: &mut Pass<'_>) {
        for buffer in [self.q, self.kv, self.weights, self.mixed] {
            pass.give(buffer);
        }
    }
}

/// What the feed-forward branch's backward pass needs.
#[derive(Debug)]
struct FeedForward {
    mask: Option<DropoutMask>,
    rows: Rows,
    /// before the activation; `None` if the output tells (ReLU)
    before: Option<Vec<f32>>,
    hidden: Vec<f32>,
}

impl FeedForward {
    /// x: (rows, D) -> (rows, D)
    fn forward(pass: &mut Pass<'_>, prefix: &str, x: &[f32], rows: Rows) -> (Vec<f32>, Self) {
        let Shape { dim, hidden: width, activation, .. } = pass.shape;
        let mask = pass.mask();
        let (w, bias) = (pass.weight(prefix, ".linear1.weight"), pass.weight(prefix, ".linear1.bias"));
        let n = x.len() / dim;
        let mut hidden = pass.take(n * width);
        let (x, w) = (Mat::rows(x, dim), Mat::rows(w, dim).t());
        let shape = (n, width, dim);
        let mut before = None;
        if activation == Activation::Relu {
            let epilogue =
                |i: usize, j: usize, row: &mut [f32]| activate(row, activation, mask, rows.full(i) * width + j);
            gemm_with(shape, x, w, Start::Bias(bias), &mut hidden, width, &mut pass.space.pack, epilogue);
        } else {
            let mut linear = pass.take(n * width);
            product(shape, x, w, Start::Bias(bias), &mut linear, &mut pass.space.pack);
            for (i, (row, from)) in hidden.chunks_exact_mut(width).zip(linear.chunks_exact(width)).enumerate() {
                row.copy_from_slice(from);
                activate(row, activation, mask, rows.full(i) * width);
            }
            before = Some(linear);
        }
        let branch = pass.linear(&format!("{prefix}.linear2"), &hidden, width);
        (branch, Self { mask, rows, before, hidden })
    }

    /// Returns the gradient of x.
    fn backward(
        self,
        pass: &mut Pass<'_>,
        prefix: &str,
        branch_grad: &[f32],
        x: &[f32],
        grads: &mut Grads<'_>,
    ) -> Vec<f32> {
        let Shape { dim, hidden: width, activation, .. } = pass.shape;
        let (first, second) = (format!("{prefix}.linear1"), format!("{prefix}.linear2"));
        pass.linear_backward(&second, &self.hidden, branch_grad, width, grads);
        let n = x.len() / dim;
        let mut grad = pass.take(n * width);
        let before = self.before.as_ref().unwrap_or(&self.hidden);
        let (g, w) = (Mat::rows(branch_grad, dim), Mat::rows(pass.weight(&second, ".weight"), width));
        let epilogue = |i: usize, j: usize, row: &mut [f32]| {
            let before = &before[i * width + j..][..row.len()];
            activate_backward(row, before, activation, self.mask, self.rows.full(i) * width + j);
        };
        gemm_with((n, width, dim), g, w, Start::Zero, &mut grad, width, &mut pass.space.pack, epilogue);
        pass.linear_backward(&first, x, &grad, dim, grads);
        let x_grad = pass.linear_input(&first, &grad, dim);
        pass.give(grad);
        self.free(pass);
        x_grad
    }

    fn free(self, pass: &mut Pass<'_>) {
        pass.give(self.hidden);
        if let Some(before) = self.before {
            pass.give(before);
        }
    }
}

/// What an encoder layer's backward pass needs.
#[derive(Debug)]
pub(crate) struct EncoderLayer {
    prefix: String,
    /// input of the attention
    y1: Vec<f32>,
    /// its first tokens, if only those are computed
    y1_first: Option<Vec<f32>>,
    attention: Attention,
    residual1: Residual,
    y2: Vec<f32>,
    ff: FeedForward,
    residual2: Residual,
}

/// The first of every `tokens` rows.
fn first_rows(pass: &mut Pass<'_>, x: &[f32], tokens: usize) -> Vec<f32> {
    let dim = pass.shape.dim;
    let mut out = pass.take(x.len() / tokens);
    for (to, from) in out.chunks_exact_mut(dim).zip(x.chunks_exact(tokens * dim)) {
        to.copy_from_slice(&from[..dim]);
    }
    out
}

impl EncoderLayer {
    /// x: (b, t, D), pos: (t, D), key_pad: (b, t) -> (b, t, D), or (b, 1, D) with `only_first`: then only the first
    /// token's output is computed, for a last layer of which nothing else is used.
    pub(crate) fn forward(
        pass: &mut Pass<'_>,
        prefix: String,
        x: Vec<f32>,
        pos: &[f32],
        key_pad: Option<&[f32]>,
        only_first: bool,
    ) -> (Vec<f32>, Self) {
        let Shape { dim, heads, .. } = pass.shape;
        let tokens = pos.len() / dim;
        let only_first = only_first && tokens > 1;
        let queries = if only_first { 1 } else { tokens };
        let rows = Rows { computed: queries, all: tokens };
        let batch = x.len() / (tokens * dim);
        let heads = Heads { batch, heads, queries, all_queries: tokens, keys: tokens, dim, shared: false };

        let Entry { y: y1, x, norm } = enter(pass, &format!("{prefix}.norm1"), x);
        let y1_first = only_first.then(|| first_rows(pass, &y1, tokens));
        let query = Side { x: y1_first.as_ref().unwrap_or(&y1), pos: &pos[..queries * dim] };
        let (branch, attention) =
            Attention::forward(pass, &format!("{prefix}.self_attn"), heads, query, Side { x: &y1, pos }, key_pad);
        let x_first = x.as_ref().filter(|_| only_first).map(|x| first_rows(pass, x, tokens));
        // the residual's x: its own buffer if pre-norm, else what the branch read
        let sum = x_first.as_ref().or(x.as_ref()).unwrap_or(y1_first.as_ref().unwrap_or(&y1));
        let (x1, residual1) = Residual::leave(pass, &format!("{prefix}.norm1"), norm, sum, branch, rows);
        for buffer in [x, x_first].into_iter().flatten() {
            pass.give(buffer);
        }

        let Entry { y: y2, x, norm } = enter(pass, &format!("{prefix}.norm2"), x1);
        let (branch, ff) = FeedForward::forward(pass, &prefix, &y2, rows);
        let sum = x.as_ref().unwrap_or(&y2);
        let (out, residual2) = Residual::leave(pass, &format!("{prefix}.norm2"), norm, sum, branch, rows);
        if let Some(x) = x {
            pass.give(x);
        }
        (out, Self { prefix, y1, y1_first, attention, residual1, y2, ff, residual2 })
    }

    /// grad: that of the output -> that of x; adds to `pos_grad`.
    pub(crate) fn backward(
        self,
        pass: &mut Pass<'_>,
        mut grad: Vec<f32>,
        pos: &[f32],
        pos_grad: Option<&mut [f32]>,
        grads: &mut Grads<'_>,
    ) -> Vec<f32> {
        let Self { prefix, y1, y1_first, attention, residual1, y2, ff, residual2 } = self;
        let dim = pass.shape.dim;
        let (norm1, norm2, attn) =
            (format!("{prefix}.norm1"), format!("{prefix}.norm2"), format!("{prefix}.self_attn"));

        let (branch, norm) = residual2.leave_backward(pass, &norm2, &mut grad, grads);
        let mut y_grad = ff.backward(pass, &prefix, &branch, &y2, grads);
        enter_backward(pass, &norm2, norm, &mut y_grad, grads);
        add(&mut grad, &y_grad);
        for buffer in [branch, y_grad, y2] {
            pass.give(buffer);
        }

        let (branch, norm) = residual1.leave_backward(pass, &norm1, &mut grad, grads);
        let heads = attention.heads;
        let query = Side { x: y1_first.as_ref().unwrap_or(&y1), pos: &pos[..heads.queries * dim] };
        // both sides' positions are the same rows
        let mut both =
            pos_grad.is_some().then(|| (pass.space.pool.zeros(heads.queries * dim), pass.space.pool.zeros(pos.len())));
        let (for_query, for_key) = both.as_mut().map_or((None, None), |(q, k)| (Some(&mut q[..]), Some(&mut k[..])));
        let (dq, dkv) =
            attention.backward(pass, &attn, &branch, query, Side { x: &y1, pos }, for_query, for_key, grads);
        if let (Some(into), Some((q, k))) = (pos_grad, both) {
            add(&mut into[..q.len()], &q);
            add(into, &k);
            pass.give(q);
            pass.give(k);
        }
        pass.give(branch);
        let mut y_grad = pass.take(y1.len());
        Attention::key_input(pass, &attn, &dkv, Start::Zero, &mut y_grad);
        let out = if heads.queries == heads.keys {
            Attention::query_input(pass, &attn, &dq, Start::Add, &mut y_grad);
            enter_backward(pass, &norm1, norm, &mut y_grad, grads);
            add(&mut y_grad, &grad);
            pass.give(grad);
            y_grad
        } else {
            let mut first = pass.take(dq.len());
            Attention::query_input(pass, &attn, &dq, Start::Zero, &mut first);
            add_to_first_rows(&mut y_grad, &first, dim, heads.keys);
            pass.give(first);
            enter_backward(pass, &norm1, norm, &mut y_grad, grads);
            add_to_first_rows(&mut y_grad, &grad, dim, heads.keys);
            pass.give(grad);
            y_grad
        };
        for buffer in [dq, dkv, y1].into_iter().chain(y1_first) {
            pass.give(buffer);
        }
        out
    }

    /// Gives the buffers back without a backward pass.
    pub(crate) fn free(self, pass: &mut Pass<'_>) {
        self.attention.free(pass);
        self.ff.free(pass);
        self.residual1.norm.free(pass);
        self.residual2.norm.free(pass);
        for buffer in [self.y1, self.y2].into_iter().chain(self.y1_first) {
            pass.give(buffer);
        }
    }
}

fn add_to_first_rows(x: &mut [f32], first: &[f32], dim: usize, tokens: usize) {
    for (to, from) in x.chunks_exact_mut(tokens * dim).zip(first.chunks_exact(dim)) {
        to[..dim].iter_mut().zip(from).for_each(|(a, b)| *a += b);
    }
}

/// What a decoder layer's backward pass needs.
#[derive(Debug)]
pub(crate) struct DecoderLayer {
    prefix: String,
    y1: Vec<f32>,
    self_attn: Attention,
    residual1: Residual,
    y2: Vec<f32>,
    cross: Attention,
    residual2: Residual,
    y3: Vec<f32>,
    ff: FeedForward,
    residual3: Residual,
}

/// The encoder's output, its positions, and their number of rows in the batch.
#[derive(Clone, Copy)]
pub(crate) struct Memory<'a> {
    pub(crate) x: &'a [f32],
    pub(crate) pos: &'a [f32],
    pub(crate) batch: usize,
}

/// Gradients that decoder layers add to.
pub(crate) struct DecoderGrads<'a> {
    pub(crate) memory: &'a mut [f32],
    pub(crate) memory_pos: &'a mut [f32],
    pub(crate) query_pos: &'a mut [f32],
}

impl DecoderLayer {
    /// x: (b, c, D), or (c, D) if it is the same for the whole batch, as for the first layer, whose input is zero;
    /// query_pos: (c, D) -> (b, c, D)
    pub(crate) fn forward(
        pass: &mut Pass<'_>,
        prefix: String,
        x: Vec<f32>,
        query_pos: &[f32],
        memory: Memory<'_>,
    ) -> (Vec<f32>, Self) {
        let Shape { dim, heads, .. } = pass.shape;
        let (batch, queries) = (memory.batch, query_pos.len() / dim);
        let shared = x.len() == query_pos.len();
        let rows = Rows { computed: queries, all: queries };
        let heads = Heads { batch, heads, queries, all_queries: queries, keys: queries, dim, shared };
        let name = |part: &str| format!("{prefix}.{part}");

        let Entry { y: y1, x, norm } = enter(pass, &name("norm1"), x);
        let side = Side { x: &y1, pos: query_pos };
        let (branch, self_attn) = Attention::forward(pass, &name("self_attn"), heads, side, side, None);
        let (x1, residual1) = Residual::leave(pass, &name("norm1"), norm, x.as_ref().unwrap_or(&y1), branch, rows);
        if let Some(x) = x {
            pass.give(x);
        }

        let Entry { y: y2, x, norm } = enter(pass, &name("norm2"), x1);
        let key = Side { x: memory.x, pos: memory.pos };
        let heads = Heads { keys: memory.pos.len() / dim, shared: false, ..heads };
        let query = Side { x: &y2, pos: query_pos };
        let (branch, cross) = Attention::forward(pass, &name("multihead_attn"), heads, query, key, None);
        let (x2, residual2) = Residual::leave(pass, &name("norm2"), norm, x.as_ref().unwrap_or(&y2), branch, rows);
        if let Some(x) = x {
            pass.give(x);
        }

        let Entry { y: y3, x, norm } = enter(pass, &name("norm3"), x2);
        let (branch, ff) = FeedForward::forward(pass, &prefix, &y3, rows);
        let (out, residual3) = Residual::leave(pass, &name("norm3"), norm, x.as_ref().unwrap_or(&y3), branch, rows);
        if let Some(x) = x {
            pass.give(x);
        }
        (out, Self { prefix, y1, self_attn, residual1, y2, cross, residual2, y3, ff, residual3 })
    }

    /// grad: that of the output -> that of x, of x's own number of rows
    pub(crate) fn backward(
        self,
        pass: &mut Pass<'_>,
        mut grad: Vec<f32>,
        query_pos: &[f32],
        memory: Memory<'_>,
        into: &mut DecoderGrads<'_>,
        grads: &mut Grads<'_>,
    ) -> Vec<f32> {
        let Self { prefix, y1, self_attn, residual1, y2, cross, residual2, y3, ff, residual3 } = self;
        let name = |part: &str| format!("{prefix}.{part}");
        let dim = pass.shape.dim;

        let (branch, norm) = residual3.leave_backward(pass, &name("norm3"), &mut grad, grads);
        let mut y_grad = ff.backward(pass, &prefix, &branch, &y3, grads);
        enter_backward(pass, &name("norm3"), norm, &mut y_grad, grads);
        add(&mut grad, &y_grad);
        for buffer in [branch, y_grad, y3] {
            pass.give(buffer);
        }

        let (branch, norm) = residual2.leave_backward(pass, &name("norm2"), &mut grad, grads);
        let (query, key) = (Side { x: &y2, pos: query_pos }, Side { x: memory.x, pos: memory.pos });
        let attn = name("multihead_attn");
        let (dq, dkv) =
            cross.backward(pass, &attn, &branch, query, key, Some(into.query_pos), Some(into.memory_pos), grads);
        Attention::key_input(pass, &attn, &dkv, Start::Add, into.memory);
        let mut y_grad = pass.take(dq.len());
        Attention::query_input(pass, &attn, &dq, Start::Zero, &mut y_grad);
        enter_backward(pass, &name("norm2"), norm, &mut y_grad, grads);
        add(&mut grad, &y_grad);
        for buffer in [branch, y_grad, y2, dq, dkv] {
            pass.give(buffer);
        }

        let (branch, norm) = residual1.leave_backward(pass, &name("norm1"), &mut grad, grads);
        let side = Side { x: &y1, pos: query_pos };
        let attn = name("self_attn");
        let mut key_pos = pass.space.pool.zeros(query_pos.len());
        let (dq, dkv) =
            self_attn.backward(pass, &attn, &branch, side, side, Some(into.query_pos), Some(&mut key_pos), grads);
        add(into.query_pos, &key_pos);
        let mut y_grad = pass.take(y1.len());
        Attention::query_input(pass, &attn, &dq, Start::Zero, &mut y_grad);
        Attention::key_input(pass, &attn, &dkv, Start::Add, &mut y_grad);
        enter_backward(pass, &name("norm1"), norm, &mut y_grad, grads);
        if grad.len() == y_grad.len() {
            add(&mut y_grad, &grad);
        } else {
            // x is shared by the batch: so is its gradient
            let mut sums = pass.take(y_grad.len());
            sum_over_sequences(&mut sums, &grad, dim, dim);
            add(&mut y_grad, &sums);
            pass.give(sums);
        }
        for buffer in [branch, key_pos, y1, dq, dkv, grad] {
            pass.give(buffer);
        }
        y_grad
    }

    /// Gives the buffers back without a backward pass.
    pub(crate) fn free(self, pass: &mut Pass<'_>) {
        self.self_attn.free(pass);
        self.cross.free(pass);
        self.ff.free(pass);
        for residual in [self.residual1, self.residual2, self.residual3] {
            residual.norm.free(pass);
        }
        for buffer in [self.y1, self.y2, self.y3] {
            pass.give(buffer);
        }
    }
}
