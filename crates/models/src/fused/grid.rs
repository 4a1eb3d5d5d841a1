//! The layer over a grid of cells: the maths of `layers/grid.rs`, written out forwards and backwards.

use super::feed_forward::FeedForward;
use super::{Entry, Grads, Pass, Residual, Rows, enter, enter_backward};
use crate::layers::{Grid, NEIGHBOURS};
use nn::kernels::add;

/// What the layer's backward pass needs.
#[derive(Debug)]
pub(crate) struct GridLayer {
    prefix: String,
    /// input of the convolution, (b, cells, D)
    y1: Vec<f32>,
    residual1: Residual,
    y2: Vec<f32>,
    ff: FeedForward,
    residual2: Residual,
}

/// x: (b, cells, D) -> every cell's neighbours side by side, (b, cells, 9 D), zeros beyond the edge
fn patches(pass: &mut Pass<'_>, grid: Grid, x: &[f32]) -> Vec<f32> {
    let (dim, cells) = (pass.shape.dim, grid.cells());
    let mut out = pass.take(x.len() * NEIGHBOURS);
    for (out, x) in out.chunks_exact_mut(cells * NEIGHBOURS * dim).zip(x.chunks_exact(cells * dim)) {
        for (cell, out) in out.chunks_exact_mut(NEIGHBOURS * dim).enumerate() {
            for (out, at) in out.chunks_exact_mut(dim).zip(grid.neighbours(cell)) {
                match at {
                    Some(at) => out.copy_from_slice(&x[at * dim..][..dim]),
                    None => out.fill(0.0),
                }
            }
        }
    }
    out
}

/// The gradient of `patches` -> that of x.
fn patches_backward(pass: &mut Pass<'_>, grid: Grid, grad: &[f32]) -> Vec<f32> {
    let (dim, cells) = (pass.shape.dim, grid.cells());
    let mut out = pass.space.pool.zeros(grad.len() / NEIGHBOURS);
    for (out, grad) in out.chunks_exact_mut(cells * dim).zip(grad.chunks_exact(cells * NEIGHBOURS * dim)) {
        for (cell, grad) in grad.chunks_exact(NEIGHBOURS * dim).enumerate() {
            for (grad, at) in grad.chunks_exact(dim).zip(grid.neighbours(cell)) {
                if let Some(at) = at {
                    add(&mut out[at * dim..][..dim], grad);
                }
            }
        }
    }
    out
}

impl GridLayer {
    /// x: (b, cells, D) -> (b, cells, D)
    pub(crate) fn forward(pass: &mut Pass<'_>, prefix: String, grid: Grid, x: Vec<f32>) -> (Vec<f32>, Self) {
        let cells = grid.cells();
        let rows = Rows { computed: cells, all: cells };
        let Entry { y: y1, x, norm } = enter(pass, &format!("{prefix}.norm1"), x);
        let neighbours = patches(pass, grid, &y1);
        let branch = pass.linear(&format!("{prefix}.conv"), &neighbours);
        pass.give(neighbours);
        let before = x.expect("a layer over a grid has its norms first");
        let (x1, residual1) = Residual::leave(pass, &format!("{prefix}.norm1"), norm, &before, branch, rows);
        pass.give(before);

        let Entry { y: y2, x, norm } = enter(pass, &format!("{prefix}.norm2"), x1);
        let (branch, ff) = FeedForward::forward(pass, &prefix, &y2, rows);
        let before = x.expect("a layer over a grid has its norms first");
        let (out, residual2) = Residual::leave(pass, &format!("{prefix}.norm2"), norm, &before, branch, rows);
        pass.give(before);
        (out, Self { prefix, y1, residual1, y2, ff, residual2 })
    }

    /// grad: that of the output -> that of x
    pub(crate) fn backward(
        self,
        pass: &mut Pass<'_>,
        grid: Grid,
        mut grad: Vec<f32>,
        grads: &mut Grads<'_>,
    ) -> Vec<f32> {
        let Self { prefix, y1, residual1, y2, ff, residual2 } = self;
        let (norm1, norm2, conv) = (format!("{prefix}.norm1"), format!("{prefix}.norm2"), format!("{prefix}.conv"));

        let (branch, norm) = residual2.leave_backward(pass, &norm2, &mut grad, grads);
        let mut y_grad = ff.backward(pass, &prefix, &branch, &y2, grads);
        enter_backward(pass, &norm2, norm, &mut y_grad, grads);
        add(&mut grad, &y_grad);
        for buffer in [branch, y_grad, y2] {
            pass.give(buffer);
        }

        let (branch, norm) = residual1.leave_backward(pass, &norm1, &mut grad, grads);
        let width = NEIGHBOURS * pass.shape.dim;
        // made again rather than kept: nine times as large as what they are made of
        let neighbours = patches(pass, grid, &y1);
        pass.linear_backward(&conv, &neighbours, &branch, width, grads);
        pass.give(neighbours);
        let neighbours_grad = pass.linear_input(&conv, &branch, width);
        let mut y_grad = patches_backward(pass, grid, &neighbours_grad);
        enter_backward(pass, &norm1, norm, &mut y_grad, grads);
        add(&mut grad, &y_grad);
        for buffer in [branch, neighbours_grad, y_grad, y1] {
            pass.give(buffer);
        }
        grad
    }

    /// Gives the buffers back without a backward pass.
    pub(crate) fn free(self, pass: &mut Pass<'_>) {
        self.ff.free(pass);
        self.residual1.norm.free(pass);
        self.residual2.norm.free(pass);
        pass.give(self.y1);
        pass.give(self.y2);
    }
}

/// Of all tokens, (b, M, D), the cells, (b, cells, D).
pub(crate) fn cells_of(pass: &mut Pass<'_>, grid: Grid, tokens: &[f32], rows: usize) -> Vec<f32> {
    let (dim, len) = (pass.shape.dim, grid.cells() * pass.shape.dim);
    let mut out = pass.take(rows * len);
    for (out, tokens) in out.chunks_exact_mut(len).zip(tokens.chunks_exact(tokens.len() / rows)) {
        out.copy_from_slice(&tokens[grid.first * dim..][..len]);
    }
    out
}

/// Puts cells, (b, cells, D), in their places among all tokens, (b, M, D).
pub(crate) fn put_cells(dim: usize, grid: Grid, tokens: &mut [f32], cells: &[f32]) {
    let len = grid.cells() * dim;
    let sequence = tokens.len() / (cells.len() / len);
    for (tokens, cells) in tokens.chunks_exact_mut(sequence).zip(cells.chunks_exact(len)) {
        tokens[grid.first * dim..][..len].copy_from_slice(cells);
    }
}
