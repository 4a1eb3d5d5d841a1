//! Numbers asked for in training alone: the maths of `layers/auxiliary.rs`, written out forwards and backwards.

use super::{Grads, Pass};
use crate::layers::{AUXILIARY_HEAD, Told};
use nn::kernels::add;

/// Asks for what a shard tells.
///
/// encoded: (b, M, D), the latent's token first. Returns the loss, and the gradient, `weight` times, of the first tokens,
/// (b, D); that of the layer is added to `grads`.
pub(crate) fn ask(
    pass: &mut Pass<'_>,
    (told, weight): (&Told, f64),
    encoded: &[f32],
    rows: usize,
    grads: &mut Grads<'_>,
) -> (f64, Vec<f32>) {
    let dim = pass.shape.dim;
    let mut first = pass.take(rows * dim);
    for (first, sequence) in first.chunks_exact_mut(dim).zip(encoded.chunks_exact(encoded.len() / rows)) {
        first.copy_from_slice(&sequence[..dim]);
    }
    let mut found = pass.linear(AUXILIARY_HEAD, &first);
    let loss = told.gradient(&mut found, weight);
    pass.linear_backward(AUXILIARY_HEAD, &first, &found, dim, grads);
    let grad = pass.linear_input(AUXILIARY_HEAD, &found, dim);
    pass.give(first);
    pass.give(found);
    (loss, grad)
}

/// Adds the gradient of the first tokens, (b, D), to that of all, (b, M, D).
pub(crate) fn add_to_first(grad: &mut [f32], first: &[f32], rows: usize) {
    let dim = first.len() / rows;
    let sequence = grad.len() / rows;
    for (grad, first) in grad.chunks_exact_mut(sequence).zip(first.chunks_exact(dim)) {
        add(&mut grad[..dim], first);
    }
}
