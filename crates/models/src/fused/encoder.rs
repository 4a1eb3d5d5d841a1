//! The encoder: its layer, and the stack with its final norm.

use super::attention::{Attention, Side};
use super::feed_forward::FeedForward;
use super::{Entry, Grads, Norm, Pass, Residual, Rows, enter, enter_backward};
use crate::layers::Shape;
use nn::kernels::{Heads, Start, add};

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
        let heads = Heads {
            batch,
            heads,
            queries,
            all_queries: tokens,
            keys: tokens,
            dim,
            shared_queries: false,
            shared_keys: false,
            causal: false,
        };

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

/// What an encoder's backward pass needs.
#[derive(Debug)]
pub(crate) struct Encoder {
    layers: Vec<EncoderLayer>,
    /// after the last layer and under this prefix, if layers norm before their branches
    norm: Option<(String, Norm)>,
}

impl Encoder {
    /// Layers `{prefix}.layers.0..n` and, if they are pre-norm, `{prefix}.norm`. x: (b, t, D), pos: (t, D),
    /// key_pad: (b, t) -> (b, t, D), or (b, 1, D) with `only_first`.
    pub(crate) fn forward(
        pass: &mut Pass<'_>,
        prefix: &str,
        n: usize,
        mut x: Vec<f32>,
        pos: &[f32],
        key_pad: Option<&[f32]>,
        only_first: bool,
    ) -> (Vec<f32>, Self) {
        let mut layers = Vec::with_capacity(n);
        for i in 0..n {
            let only_first = only_first && i + 1 == n;
            let (out, layer) = EncoderLayer::forward(pass, format!("{prefix}.layers.{i}"), x, pos, key_pad, only_first);
            x = out;
            layers.push(layer);
        }
        if !pass.shape.pre_norm {
            return (x, Self { layers, norm: None });
        }
        let name = format!("{prefix}.norm");
        let (out, norm) = Norm::forward(pass, &name, &x);
        pass.give(x);
        (out, Self { layers, norm: Some((name, norm)) })
    }

    /// grad: that of the output -> that of x; adds to `pos_grad`.
    pub(crate) fn backward(
        self,
        pass: &mut Pass<'_>,
        mut grad: Vec<f32>,
        pos: &[f32],
        mut pos_grad: Option<&mut [f32]>,
        grads: &mut Grads<'_>,
    ) -> Vec<f32> {
        if let Some((name, norm)) = self.norm {
            norm.backward(pass, &name, &mut grad, grads);
        }
        for layer in self.layers.into_iter().rev() {
            grad = layer.backward(pass, grad, pos, pos_grad.as_deref_mut(), grads);
        }
        grad
    }

    /// Gives the buffers back without a backward pass.
    pub(crate) fn free(self, pass: &mut Pass<'_>) {
        self.layers.into_iter().for_each(|layer| layer.free(pass));
        if let Some((_, norm)) = self.norm {
            norm.free(pass);
        }
    }
}
