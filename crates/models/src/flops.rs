//! Floating-point operations of a query, counted from the sizes of its matrix products, two for a multiplication and its
//! addition. Norms, activations and softmax are left out: at these widths they are a few in a hundred.

use crate::layers::{Shape, TokenLayout};

/// x: (rows, from) -> (rows, to)
pub(crate) fn linear(rows: usize, from: usize, to: usize) -> f64 {
    2.0 * (rows * from * to) as f64
}

/// What tokens and latent cost on their way to the width of `shape`; images are not counted.
pub(crate) fn tokens(layout: &TokenLayout, latent: usize, dim: usize) -> f64 {
    let widths: usize = layout.tokens.iter().map(|token| token.width).sum();
    linear(1, latent + widths, dim)
}

/// Scores and mixing of `queries` tokens that attend to `keys`.
pub(crate) fn mixing(queries: usize, keys: usize, dim: usize) -> f64 {
    2.0 * linear(queries, dim, keys)
}

/// The dense part of a layer over `rows` tokens.
pub(crate) fn dense(shape: Shape, rows: usize) -> f64 {
    linear(rows, shape.dim, shape.hidden) + linear(rows, shape.hidden, shape.dim)
}

/// A layer in which `rows` tokens attend to one another.
pub(crate) fn encoder_layer(shape: Shape, rows: usize) -> f64 {
    linear(rows, shape.dim, 4 * shape.dim) + mixing(rows, rows, shape.dim) + dense(shape, rows)
}

/// A layer in which `rows` tokens attend to one another, and then to a memory.
pub(crate) fn decoder_layer(shape: Shape, rows: usize, memory: usize) -> f64 {
    let crossed = linear(rows, shape.dim, 2 * shape.dim) + linear(memory, shape.dim, 2 * shape.dim);
    encoder_layer(shape, rows) + crossed + mixing(rows, memory, shape.dim)
}
