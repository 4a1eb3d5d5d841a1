//! Layers of LSTM cells: the maths of `layers/lstm.rs`, written out forwards and backwards.
//!
//! Sequences lie step by step, (T, b, …): what a step of the recurrence reads and writes is then one stretch of memory, and the
//! gradients of the weights are one product over all steps instead of one a step.

use super::{Grads, Pass, slot, weight_gradient};
use crate::layers::{sigmoid, tanh};
use nn::kernels::{Mat, Packed, Start, add, column_sums, gemm_with, product};
use nn::simd::vectorised;

/// What the backward pass of a layer needs.
#[derive(Debug)]
struct Layer {
    /// what it reads, (T, b, in)
    input: Vec<f32>,
    /// i, f, g and o after their activations, (T, b, 4 H)
    gates: Vec<f32>,
    /// c after every step, (T, b, H)
    cells: Vec<f32>,
}

/// What the backward pass of all layers needs.
#[derive(Debug)]
pub(crate) struct Lstm {
    prefix: &'static str,
    rows: usize,
    hidden: usize,
    layers: Vec<Layer>,
    /// h of the last layer after every step, (T, b, H)
    pub(crate) output: Vec<f32>,
}

/// `c += a bᵀ` or `c += a b`, with b in panels.
pub(super) fn add_product(
    pass: &mut Pass<'_>,
    a: &[f32],
    b: Mat<'_>,
    panels: &Packed,
    (n, k): (usize, usize),
    c: &mut [f32],
) {
    let pack = &mut pass.space.pack;
    gemm_with((a.len() / k, n, k), Mat::rows(a, k), (b, Some(panels)), Start::Add, c, n, pack, |_, _, _| ());
}

impl Lstm {
    /// `n` layers under `prefix`, each from a state of zeros. x: (T, b, in), `rows` is b
    pub(crate) fn forward(
        pass: &mut Pass<'_>,
        prefix: &'static str,
        (n, hidden): (usize, usize),
        x: Vec<f32>,
        rows: usize,
    ) -> Self {
        let (mut layers, mut output) = (Vec::with_capacity(n), x);
        for l in 0..n {
            let name = |part: &str| format!("{prefix}.{part}_l{l}");
            let (of_input, of_state) = (pass.weight(&name("weight_ih"), ""), pass.weight(&name("weight_hh"), ""));
            let mut bias = pass.space.pool.copy(pass.weight(&name("bias_ih"), ""));
            add(&mut bias, pass.weight(&name("bias_hh"), ""));
            let input = output;
            let width = of_input.len() / (4 * hidden);
            let all = input.len() / width;
            let mut gates = pass.take(all * 4 * hidden);
            let (a, w) = (Mat::rows(&input, width), Mat::rows(of_input, width).t());
            product((all, 4 * hidden, width), a, w, Start::Bias(&bias), &mut gates, &mut pass.space.pack);
            pass.give(bias);
            let recurrent = Mat::rows(of_state, hidden).t();
            let panels = Packed::new(recurrent, (4 * hidden, hidden));
            let (mut cells, mut h) = (pass.take(all * hidden), pass.take(all * hidden));
            for t in 0..all / rows {
                let (here, size) = (t * rows * hidden, rows * hidden);
                let gates = &mut gates[4 * here..][..4 * size];
                let (cells_before, cells) = cells.split_at_mut(here);
                let (h_before, h) = h.split_at_mut(here);
                if t > 0 {
                    let before = &h_before[here - size..];
                    add_product(pass, before, recurrent, &panels, (4 * hidden, hidden), gates);
                }
                for row in 0..rows {
                    let before = (t > 0).then(|| &cells_before[here - size + row * hidden..][..hidden]);
                    let here = row * hidden..(row + 1) * hidden;
                    cell(&mut gates[4 * here.start..][..4 * hidden], before, &mut cells[here.clone()], &mut h[here]);
                }
            }
            layers.push(Layer { input, gates, cells });
            output = h;
        }
        Self { prefix, rows, hidden, layers, output }
    }

    /// grad: that of the output, (T, b, H) -> that of x, (T, b, in), if it is `wanted`.
    pub(crate) fn backward(
        self,
        pass: &mut Pass<'_>,
        mut grad: Vec<f32>,
        wanted: bool,
        grads: &mut Grads<'_>,
    ) -> Option<Vec<f32>> {
        let Self { prefix, rows, hidden, layers, mut output } = self;
        let size = rows * hidden;
        for (l, Layer { input, gates: mut of_gates, cells }) in layers.into_iter().enumerate().rev() {
            let name = |part: &str| format!("{prefix}.{part}_l{l}");
            let (of_input, of_state) = (pass.weight(&name("weight_ih"), ""), pass.weight(&name("weight_hh"), ""));
            let recurrent = Mat::rows(of_state, hidden);
            let panels = Packed::new(recurrent, (hidden, 4 * hidden));
            let mut of_cell = pass.space.pool.zeros(size);
            for t in (0..cells.len() / size).rev() {
                let of_h = &grad[t * size..][..size];
                let of_gates = &mut of_gates[4 * t * size..][..4 * size];
                for row in 0..rows {
                    let here = t * size + row * hidden;
                    let before = (t > 0).then(|| &cells[here - size..][..hidden]);
                    let (cell, of_cell) = (&cells[here..][..hidden], &mut of_cell[row * hidden..][..hidden]);
                    let of_gates = &mut of_gates[4 * row * hidden..][..4 * hidden];
                    cell_backward(of_gates, before, cell, &of_h[row * hidden..][..hidden], of_cell);
                }
                if t > 0 {
                    let into = &mut grad[(t - 1) * size..][..size];
                    add_product(pass, of_gates, recurrent, &panels, (hidden, 4 * hidden), into);
                }
            }
            let width = input.len() / (cells.len() / hidden);
            let (pack, wide) = (&mut pass.space.pack, 4 * hidden);
            weight_gradient((wide, width), &of_gates, wide, &input, slot(grads, &name("weight_ih"), ""), pack);
            if cells.len() > size {
                // of a step and the state that it began with
                let (later, earlier) = (&of_gates[4 * size..], &output[..cells.len() - size]);
                weight_gradient((wide, hidden), later, wide, earlier, slot(grads, &name("weight_hh"), ""), pack);
            }
            column_sums(slot(grads, &name("bias_ih"), ""), &of_gates);
            column_sums(slot(grads, &name("bias_hh"), ""), &of_gates);
            if l > 0 || wanted {
                let mut below = pass.take(input.len());
                let (a, w) = (Mat::rows(&of_gates, wide), Mat::rows(of_input, width));
                product((cells.len() / hidden, width, wide), a, w, Start::Zero, &mut below, &mut pass.space.pack);
                pass.give(std::mem::replace(&mut grad, below));
            }
            for buffer in [of_gates, cells, of_cell] {
                pass.give(buffer);
            }
            // what this layer read is what the one below gave
            pass.give(std::mem::replace(&mut output, input));
        }
        pass.give(output);
        if wanted {
            return Some(grad);
        }
        pass.give(grad);
        None
    }
}

/// One row of a step: gates before their activations become those after, (4 H); `before` is c, or zeros -> c and h, (H).
fn cell(gates: &mut [f32], before: Option<&[f32]>, c: &mut [f32], h: &mut [f32]) {
    let hidden = c.len();
    let (i, rest) = gates.split_at_mut(hidden);
    let (f, rest) = rest.split_at_mut(hidden);
    let (g, o) = rest.split_at_mut(hidden);
    vectorised(
        #[inline(always)]
        || {
            for j in 0..hidden {
                (i[j], f[j], g[j], o[j]) = (sigmoid(i[j]), sigmoid(f[j]), tanh(g[j]), sigmoid(o[j]));
                c[j] = i[j] * g[j];
            }
            if let Some(before) = before {
                for j in 0..hidden {
                    c[j] += f[j] * before[j];
                }
            }
            for j in 0..hidden {
                h[j] = o[j] * tanh(c[j]);
            }
        },
    );
}

/// Turns the gates of one row into their gradients before the activations, and the gradient of c after the step into that
/// of c before it.
fn cell_backward(gates: &mut [f32], before: Option<&[f32]>, c: &[f32], of_h: &[f32], of_cell: &mut [f32]) {
    let hidden = c.len();
    let (i, rest) = gates.split_at_mut(hidden);
    let (f, rest) = rest.split_at_mut(hidden);
    let (g, o) = rest.split_at_mut(hidden);
    vectorised(
        #[inline(always)]
        || {
            for j in 0..hidden {
                let t = tanh(c[j]);
                let d = of_cell[j] + of_h[j] * o[j] * (1.0 - t * t);
                let of_forget = before.map_or(0.0, |before| d * before[j] * f[j] * (1.0 - f[j]));
                of_cell[j] = d * f[j];
                (i[j], g[j]) = (d * g[j] * i[j] * (1.0 - i[j]), d * i[j] * (1.0 - g[j] * g[j]));
                (f[j], o[j]) = (of_forget, of_h[j] * t * o[j] * (1.0 - o[j]));
            }
        },
    );
}
