//! A zero-padded 3x3 convolution over tokens that are the cells of a grid.

use super::linear::times;
use crate::context::{Context, read};
use crate::error::{ModelError, Result};
use crate::kernels::{Mat, Pool, Start, add, column_sums, product};
use crate::layers::Linear;
use crate::value::Value;
use candle_core::Tensor;

/// Cells that the convolution reads: a cell and those around it.
const NEIGHBOURS: usize = 9;

/// The cells that the convolution reads at `cell`, row by row; `None` beyond the edge.
fn neighbours((rows, columns): (usize, usize), cell: usize) -> impl Iterator<Item = Option<usize>> {
    let (row, column) = (cell / columns, cell % columns);
    (0..NEIGHBOURS).map(move |tap| {
        let (down, right) = (row + tap / 3, column + tap % 3);
        let inside = (1..=rows).contains(&down) && (1..=columns).contains(&right);
        inside.then(|| (down - 1) * columns + right - 1)
    })
}

/// x: (b, cells, D) -> every cell's neighbours side by side, (b, cells, 9 D), zeros beyond the edge
fn patches(pool: &mut Pool, size: (usize, usize), dim: usize, x: &[f32]) -> Vec<f32> {
    let cells = size.0 * size.1;
    let mut out = pool.take(x.len() * NEIGHBOURS);
    for (out, x) in out.chunks_exact_mut(cells * NEIGHBOURS * dim).zip(x.chunks_exact(cells * dim)) {
        for (cell, out) in out.chunks_exact_mut(NEIGHBOURS * dim).enumerate() {
            for (out, at) in out.chunks_exact_mut(dim).zip(neighbours(size, cell)) {
                match at {
                    Some(at) => out.copy_from_slice(&x[at * dim..][..dim]),
                    None => out.fill(0.0),
                }
            }
        }
    }
    out
}

/// x: (b, rows * columns, D), cells row by row; layer: (O, 9 D), of every channel the nine cells' channels, row by row
/// -> (b, rows * columns, O)
///
/// # Errors
/// Another number of cells, another width, a layer without a bias.
pub fn grid_convolution(
    cx: &mut Context<'_>,
    x: &Value,
    (rows, columns): (usize, usize),
    layer: &Linear,
) -> Result<Value> {
    let [b, cells, dim] = super::sizes("grid convolution", &x.tensor)?;
    let (out_dim, width) = layer.weight.dims2()?;
    if cells != rows * columns || width != NEIGHBOURS * dim {
        let (expected, found) = (vec![b, rows * columns, width / NEIGHBOURS], x.dims().to_vec());
        return Err(ModelError::Shape { operation: "grid convolution", object: "cells", expected, found });
    }
    if cx.composed("grid convolution", [&x.tensor, &layer.weight])? {
        let padded = x.tensor.reshape((b, rows, columns, dim))?.pad_with_zeros(1, 1, 1)?.pad_with_zeros(2, 1, 1)?;
        let tap = |tap: usize| padded.narrow(1, tap / 3, rows)?.narrow(2, tap % 3, columns);
        let patches = Tensor::cat(&(0..NEIGHBOURS).map(tap).collect::<candle_core::Result<Vec<_>>>()?, 3)?;
        return Ok(Value::constant(layer.forward_in(&patches.reshape((b, cells, width))?, cx.precision())?));
    }
    let Some(bias) = &layer.bias else {
        let (found, expected) = ("without a bias".to_string(), "with one".to_string());
        return Err(ModelError::Input { operation: "grid convolution", object: "layer", found, expected });
    };
    let mut out = vec![0.0; b * cells * out_dim];
    read("grid convolution", [&x.tensor, &layer.weight, bias], |[x, w, bias]| {
        let patches = patches(&mut cx.space.pool, (rows, columns), dim, x);
        times(cx, &patches, (w, width), Start::Bias(bias), None, &mut out);
        cx.space.pool.give(patches);
        Ok(())
    })?;
    let (node, x, weight, bias) = (x.node, x.tensor.clone(), layer.weight.clone(), bias.clone());
    cx.result(out, &[b, cells, out_dim], true, move |grad, back| {
        let n = b * cells;
        read("grid convolution", [&x, &weight], |[x, w]| {
            // recomputed, not stored: the columns are nine times as large as the input
            let mut patches = patches(&mut back.space.pool, (rows, columns), dim, x);
            if let Some((into, space)) = back.parameter(&weight) {
                let (g, x) = (Mat::rows(&grad, out_dim).t(), Mat::rows(&patches, width));
                product((out_dim, width, n), g, x, Start::Add, into, &mut space.pack);
            }
            if let Some((into, _)) = back.parameter(&bias) {
                column_sums(into, &grad);
            }
            if node.is_some() {
                let (g, w) = (Mat::rows(&grad, out_dim), Mat::rows(w, width));
                product((n, width, out_dim), g, w, Start::Zero, &mut patches, &mut back.space.pack);
                let mut of = back.space.pool.zeros(n * dim);
                for (of, grad) in of.chunks_exact_mut(cells * dim).zip(patches.chunks_exact(cells * width)) {
                    for (cell, grad) in grad.chunks_exact(width).enumerate() {
                        for (grad, at) in grad.chunks_exact(dim).zip(neighbours((rows, columns), cell)) {
                            if let Some(at) = at {
                                add(&mut of[at * dim..][..dim], grad);
                            }
                        }
                    }
                }
                back.add(node, of);
            }
            back.space.pool.give(patches);
            Ok(())
        })?;
        back.space.pool.give(grad);
        Ok(())
    })
}
