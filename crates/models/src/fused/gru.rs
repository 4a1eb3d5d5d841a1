//! Layers of gated recurrent units: the maths of `layers/gru.rs`, written out forwards and backwards. Sequences lie step by
//! step, as an LSTM's do (`lstm.rs`).

use super::lstm::add_product;
use super::{Grads, Pass, slot, weight_gradient};
use crate::layers::{sigmoid, tanh};
use nn::kernels::{Mat, Packed, Start, add_bias, column_sums, product};
use nn::simd::vectorised;

/// What the backward pass of a layer needs.
#[derive(Debug)]
struct Layer {
    /// what it reads, (T, b, in)
    input: Vec<f32>,
    /// r, z and n after their activations, (T, b, 3 H)
    gates: Vec<f32>,
    /// what the state brings to r, z and n, (T, b, 3 H); of it the last third is needed again
    brought: Vec<f32>,
}

/// What the backward pass of all layers needs.
#[derive(Debug)]
pub(crate) struct Gru {
    prefix: &'static str,
    rows: usize,
    hidden: usize,
    layers: Vec<Layer>,
    /// h of the last layer after every step, (T, b, H)
    pub(crate) output: Vec<f32>,
}

impl Gru {
    /// `n` layers under `prefix`, each from a state of zeros. x: (T, b, in), `rows` is b
    pub(crate) fn forward(
        pass: &mut Pass<'_>,
        prefix: &'static str,
        (n, hidden): (usize, usize),
        x: Vec<f32>,
        rows: usize,
    ) -> Self {
        let (mut layers, mut output) = (Vec::with_capacity(n), x);
        let (wide, size) = (3 * hidden, rows * hidden);
        for l in 0..n {
            let name = |part: &str| format!("{prefix}.{part}_l{l}");
            let (of_input, of_state) = (pass.weight(&name("weight_ih"), ""), pass.weight(&name("weight_hh"), ""));
            let (bias, of_state_bias) = (pass.weight(&name("bias_ih"), ""), pass.weight(&name("bias_hh"), ""));
            let input = output;
            let width = of_input.len() / wide;
            let all = input.len() / width;
            let mut gates = pass.take(all * wide);
            let (a, w) = (Mat::rows(&input, width), Mat::rows(of_input, width).t());
            product((all, wide, width), a, w, Start::Bias(bias), &mut gates, &mut pass.space.pack);
            let recurrent = Mat::rows(of_state, hidden).t();
            let panels = Packed::new(recurrent, (wide, hidden));
            let (mut brought, mut h) = (pass.take(all * wide), pass.take(all * hidden));
            add_bias(&mut brought, of_state_bias);
            for t in 0..all / rows {
                let (h_before, h) = h.split_at_mut(t * size);
                let before = h_before.len().checked_sub(size).map(|from| &h_before[from..]);
                let (gates, brought) =
                    (&mut gates[3 * t * size..][..3 * size], &mut brought[3 * t * size..][..3 * size]);
                if let Some(before) = before {
                    add_product(pass, before, recurrent, &panels, (wide, hidden), brought);
                }
                for row in 0..rows {
                    let own = row * hidden..(row + 1) * hidden;
                    let (gates, brought) = (&mut gates[3 * own.start..][..wide], &brought[3 * own.start..][..wide]);
                    cell(gates, brought, before.map(|h| &h[own.clone()]), &mut h[own.clone()]);
                }
            }
            layers.push(Layer { input, gates, brought });
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
        let (wide, size) = (3 * hidden, rows * hidden);
        for (l, Layer { input, gates: mut of_gates, brought: mut of_brought }) in layers.into_iter().enumerate().rev() {
            let name = |part: &str| format!("{prefix}.{part}_l{l}");
            let (of_input, of_state) = (pass.weight(&name("weight_ih"), ""), pass.weight(&name("weight_hh"), ""));
            let recurrent = Mat::rows(of_state, hidden);
            let panels = Packed::new(recurrent, (hidden, wide));
            let steps = output.len() / size;
            for t in (0..steps).rev() {
                let (earlier, of_h) = grad.split_at_mut(t * size);
                let before = (t > 0).then(|| &output[(t - 1) * size..][..size]);
                let mut of_before = earlier.len().checked_sub(size).map(|from| &mut earlier[from..]);
                let (of_gates, of_brought) =
                    (&mut of_gates[3 * t * size..][..3 * size], &mut of_brought[3 * t * size..][..3 * size]);
                for row in 0..rows {
                    let own = row * hidden..(row + 1) * hidden;
                    let three = 3 * own.start..3 * own.end;
                    cell_backward(
                        (&mut of_gates[three.clone()], &mut of_brought[three]),
                        before.map(|h| &h[own.clone()]),
                        &of_h[own.clone()],
                        of_before.as_deref_mut().map(|of_before| &mut of_before[own]),
                    );
                }
                if let Some(of_before) = of_before {
                    add_product(pass, of_brought, recurrent, &panels, (hidden, wide), of_before);
                }
            }
            let width = input.len() / (steps * rows);
            let pack = &mut pass.space.pack;
            weight_gradient((wide, width), &of_gates, wide, &input, slot(grads, &name("weight_ih"), ""), pack);
            if steps > 1 {
                // of a step and the state that it began with
                let (later, earlier) = (&of_brought[wide * rows..], &output[..output.len() - size]);
                weight_gradient((wide, hidden), later, wide, earlier, slot(grads, &name("weight_hh"), ""), pack);
            }
            column_sums(slot(grads, &name("bias_ih"), ""), &of_gates);
            column_sums(slot(grads, &name("bias_hh"), ""), &of_brought);
            if l > 0 || wanted {
                let mut below = pass.take(input.len());
                let (a, w) = (Mat::rows(&of_gates, wide), Mat::rows(of_input, width));
                product((steps * rows, width, wide), a, w, Start::Zero, &mut below, &mut pass.space.pack);
                pass.give(std::mem::replace(&mut grad, below));
            }
            for buffer in [of_gates, of_brought] {
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

/// One row of a step: what comes from below to the gates, (3 H), becomes the gates; `brought` is what the state brings to
/// them; `before` is h, or zeros -> h, (H).
fn cell(gates: &mut [f32], brought: &[f32], before: Option<&[f32]>, h: &mut [f32]) {
    let hidden = h.len();
    let (r, rest) = gates.split_at_mut(hidden);
    let (z, n) = rest.split_at_mut(hidden);
    let (of_r, rest) = brought.split_at(hidden);
    let (of_z, of_n) = rest.split_at(hidden);
    vectorised(
        #[inline(always)]
        || {
            for j in 0..hidden {
                r[j] = sigmoid(r[j] + of_r[j]);
                z[j] = sigmoid(z[j] + of_z[j]);
                n[j] = tanh(n[j] + r[j] * of_n[j]);
                h[j] = n[j] - z[j] * n[j];
            }
            if let Some(before) = before {
                for j in 0..hidden {
                    h[j] += z[j] * before[j];
                }
            }
        },
    );
}

/// Turns the gates of one row into their gradients before the activations, and what the state brought to them into its
/// gradient; what goes to the state before it past the weights is added to `of_before`.
fn cell_backward(
    (gates, brought): (&mut [f32], &mut [f32]),
    before: Option<&[f32]>,
    of_h: &[f32],
    of_before: Option<&mut [f32]>,
) {
    let hidden = of_h.len();
    let (r, rest) = gates.split_at_mut(hidden);
    let (z, n) = rest.split_at_mut(hidden);
    let (of_r, rest) = brought.split_at_mut(hidden);
    let (of_z, of_n) = rest.split_at_mut(hidden);
    vectorised(
        #[inline(always)]
        || {
            if let Some(of_before) = of_before {
                for j in 0..hidden {
                    of_before[j] += of_h[j] * z[j];
                }
            }
            for j in 0..hidden {
                let before = before.map_or(0.0, |before| before[j]);
                let new = of_h[j] * (1.0 - z[j]) * (1.0 - n[j] * n[j]);
                let keep = of_h[j] * (before - n[j]) * z[j] * (1.0 - z[j]);
                let reset = new * of_n[j] * r[j] * (1.0 - r[j]);
                (of_r[j], of_z[j], of_n[j]) = (reset, keep, new * r[j]);
                (r[j], z[j], n[j]) = (reset, keep, new);
            }
        },
    );
}
