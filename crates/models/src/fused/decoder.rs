//! The decoder: its layer, and the stack with its final norm.

use super::attention::{Attention, Side};
use super::feed_forward::FeedForward;
use super::{Entry, Grads, Pass, Residual, Rows, enter, enter_backward};
use crate::layers::Shape;
use nn::kernels::{Heads, Start, add, sum_over_sequences};

/// What a decoder layer's backward pass needs.
#[derive(Debug)]
struct DecoderLayer {
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

/// The decoder's own tokens: their positions, (c, D), and whether one sees those after it.
#[derive(Clone, Copy)]
pub(crate) struct Own<'a> {
    pub(crate) pos: &'a [f32],
    pub(crate) causal: bool,
}

/// Gradients that decoder layers add to.
pub(crate) struct DecoderGrads<'a> {
    pub(crate) memory: &'a mut [f32],
    pub(crate) memory_pos: &'a mut [f32],
    pub(crate) query_pos: &'a mut [f32],
}

impl DecoderLayer {
    /// x: (b, c, D), or (c, D) if it is the same for the whole batch, as for the first layer, whose input is zero
    /// -> (b, c, D)
    fn forward(pass: &mut Pass<'_>, prefix: String, x: Vec<f32>, own: Own<'_>, memory: Memory<'_>) -> (Vec<f32>, Self) {
        let Shape { dim, heads, .. } = pass.shape;
        let query_pos = own.pos;
        let (batch, queries) = (memory.batch, query_pos.len() / dim);
        let shared = x.len() == query_pos.len();
        let rows = Rows { computed: queries, all: queries };
        let heads = Heads {
            batch,
            heads,
            queries,
            all_queries: queries,
            keys: queries,
            dim,
            shared_queries: shared,
            shared_keys: shared,
            causal: own.causal,
        };
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
        let keys = memory.pos.len() / dim;
        let heads = Heads { keys, shared_queries: false, shared_keys: false, causal: false, ..heads };
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
    fn backward(
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
    fn free(self, pass: &mut Pass<'_>) {
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

/// Decoder layers over tokens that every sequence has its own of.
#[derive(Debug)]
pub(crate) struct DecoderLayers(Vec<DecoderLayer>);

impl DecoderLayers {
    /// Layers `{prefix}.0..n`. x: (b, c, D) -> (b, c, D)
    pub(crate) fn forward(
        pass: &mut Pass<'_>,
        (prefix, n): (&str, usize),
        mut x: Vec<f32>,
        own: Own<'_>,
        memory: Memory<'_>,
    ) -> (Vec<f32>, Self) {
        let mut layers = Vec::with_capacity(n);
        for i in 0..n {
            let (out, layer) = DecoderLayer::forward(pass, format!("{prefix}.{i}"), x, own, memory);
            x = out;
            layers.push(layer);
        }
        (x, Self(layers))
    }

    /// grad: that of the output, (b, c, D) -> that of x
    pub(crate) fn backward(
        self,
        pass: &mut Pass<'_>,
        mut grad: Vec<f32>,
        own: Own<'_>,
        memory: Memory<'_>,
        into: &mut DecoderGrads<'_>,
        grads: &mut Grads<'_>,
    ) -> Vec<f32> {
        for layer in self.0.into_iter().rev() {
            grad = layer.backward(pass, grad, own.pos, memory, into, grads);
        }
        grad
    }

    /// Gives the buffers back without a backward pass.
    pub(crate) fn free(self, pass: &mut Pass<'_>) {
        self.0.into_iter().for_each(|layer| layer.free(pass));
    }
}
