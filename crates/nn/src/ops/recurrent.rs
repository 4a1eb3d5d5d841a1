//! A layer of a recurrent network. Sequences lie step by step, (T, b, …): what a step of the recurrence reads and writes is then one
//! stretch of memory, and the gradients of the weights are one product over all steps instead of one a step.

use super::linear::{UNPACKED_ROWS, times};
use crate::context::{Context, read};
use crate::error::{ModelError, Result};
use crate::kernels::elementwise::{sigmoid, tanh};
use crate::kernels::{Mat, Pack, Packed, Start, add, add_bias, column_sums, gemm_with, product};
use crate::layers::Linear;
use crate::simd::vectorised;
use crate::tape::Backward;
use crate::value::Value;
use candle_core::{DType, Device, Tensor};
use std::sync::Arc;

/// From what comes from below and from the state.
type Layer<'a> = (&'a Linear, &'a Linear);

/// Steps, rows, numbers that a step reads, numbers of a state; and the layers' biases.
struct Sizes<'a> {
    steps: usize,
    rows: usize,
    width: usize,
    hidden: usize,
    biases: [&'a Tensor; 2],
}

impl<'a> Sizes<'a> {
    fn of(
        cx: &Context<'_>,
        operation: &'static str,
        x: &Value,
        (input, recurrent): Layer<'a>,
        gates: usize,
        states: usize,
        before: Option<&[Tensor]>,
    ) -> Result<Self> {
        let ([steps, rows, width], hidden) = (super::sizes(operation, &x.tensor)?, recurrent.weight.dim(1)?);
        super::check_shape(operation, "weight of the input", &input.weight, &[gates * hidden, width])?;
        super::check_shape(operation, "weight of the state", &recurrent.weight, &[gates * hidden, hidden])?;
        let refuse = |object: &'static str, found: &str, expected: &str| ModelError::Input {
            operation,
            object,
            found: found.to_string(),
            expected: expected.to_string(),
        };
        let (Some(of_input), Some(of_state)) = (&input.bias, &recurrent.bias) else {
            return Err(refuse("layer", "without a bias", "with one"));
        };
        if before.is_some() && cx.records() {
            return Err(refuse("state", "given in training", "zero there"));
        }
        if before.is_some_and(|before| before.len() != states) {
            return Err(refuse("state", "of another cell", "of this one"));
        }
        for state in before.into_iter().flatten() {
            super::check_shape(operation, "state", state, &[rows, hidden])?;
        }
        Ok(Self { steps, rows, width, hidden, biases: [of_input, of_state] })
    }

    /// Panels of the state's weights, where several products read them.
    fn panels(&self, cx: &Context<'_>, w: &[f32]) -> Option<Arc<Packed>> {
        match &cx.prepared {
            Some(prepared) => (self.rows > UNPACKED_ROWS).then(|| prepared.panels(w, self.hidden)),
            None => {
                let size = (w.len() / self.hidden, self.hidden);
                (self.steps > 1).then(|| Arc::new(Packed::new(Mat::rows(w, self.hidden).t(), size)))
            }
        }
    }
}

/// `c += a b`, with b in panels.
fn add_product(a: &[f32], b: Mat<'_>, panels: Option<&Packed>, (n, k): (usize, usize), c: &mut [f32], pack: &mut Pack) {
    gemm_with((a.len() / k, n, k), Mat::rows(a, k), (b, panels), Start::Add, c, n, pack, |_, _, _| ());
}

/// A state as numbers.
fn numbers(before: Option<&[Tensor]>, at: usize) -> Result<Option<Vec<f32>>> {
    before.map(|before| read("recurrent layer", [&before[at]], |[x]| Ok(x.to_vec()))).transpose()
}

/// A layer of long short-term memory: x: (T, b, in) -> (T, b, H), and h and c after the last step, (b, H) each, of a pass that does
/// not train. Gates are i, f, g, o.
///
/// # Errors
/// Shapes that do not go together, a state in a pass that trains.
pub fn lstm(
    cx: &mut Context<'_>,
    x: &Value,
    layer: Layer<'_>,
    before: Option<&[Tensor]>,
) -> Result<(Value, Vec<Tensor>)> {
    let sizes = Sizes::of(cx, "lstm", x, layer, 4, 2, before)?;
    if cx.composed("lstm", [&x.tensor, &layer.0.weight].into_iter().chain(before.into_iter().flatten()))? {
        return lstm_composed(cx, &sizes, x, layer, before);
    }
    let (input, recurrent) = layer;
    let Sizes { steps, rows, width, hidden, biases: [bias_ih, bias_hh] } = sizes;
    let (wide, size) = (4 * hidden, rows * hidden);
    let (h_before, c_before) = (numbers(before, 0)?, numbers(before, 1)?);
    let mut gates = cx.space.pool.take(steps * rows * wide);
    let mut cells = cx.space.pool.take(steps * size);
    let mut out = vec![0.0; steps * size];
    let tensors = [&x.tensor, &input.weight, &recurrent.weight, bias_ih, bias_hh];
    read("lstm", tensors, |[x, of_input, of_state, bias_ih, bias_hh]| {
        let mut bias = cx.space.pool.copy(bias_ih);
        add(&mut bias, bias_hh);
        times(cx, x, (of_input, width), Start::Bias(&bias), None, &mut gates);
        cx.space.pool.give(bias);
        let (panels, of_state) = (sizes.panels(cx, of_state), Mat::rows(of_state, hidden).t());
        for t in 0..steps {
            let gates = &mut gates[t * rows * wide..][..rows * wide];
            let (earlier_cells, cells) = cells.split_at_mut(t * size);
            let (earlier, h) = out.split_at_mut(t * size);
            let before = if t > 0 { Some(&earlier[(t - 1) * size..]) } else { h_before.as_deref() };
            let cells_before = if t > 0 { Some(&earlier_cells[(t - 1) * size..]) } else { c_before.as_deref() };
            if let Some(before) = before {
                add_product(before, of_state, panels.as_deref(), (wide, hidden), gates, &mut cx.space.pack);
            }
            for row in 0..rows {
                let own = row * hidden..(row + 1) * hidden;
                let before = cells_before.map(|cells| &cells[own.clone()]);
                lstm_cell(&mut gates[row * wide..][..wide], before, &mut cells[own.clone()], &mut h[own]);
            }
        }
        Ok(())
    })?;
    let shape = [steps, rows, hidden];
    if !cx.records() {
        let last = |x: &[f32]| Tensor::from_slice(&x[x.len() - size..], (rows, hidden), &Device::Cpu);
        let state = vec![last(&out)?, last(&cells)?];
        [gates, cells].into_iter().for_each(|buffer| cx.space.pool.give(buffer));
        return Ok((cx.result(out, &shape, false, |_, _| Ok(()))?, state));
    }
    let out = Tensor::from_vec(out, &shape, &Device::Cpu)?;
    let (node, x, output) = (x.node, x.tensor.clone(), out.clone());
    let (input, recurrent) = (input.clone(), recurrent.clone());
    let value = cx.result_of(out, true, move |mut grad, back| {
        read("lstm", [&recurrent.weight], |[of_state]| {
            let of_state = Mat::rows(of_state, hidden);
            let panels = (steps > 1).then(|| Packed::new(of_state, (hidden, wide)));
            let mut of_cell = back.space.pool.zeros(size);
            for t in (0..steps).rev() {
                let of_gates = &mut gates[t * rows * wide..][..rows * wide];
                let (earlier, of_h) = grad.split_at_mut(t * size);
                for row in 0..rows {
                    let here = t * size + row * hidden;
                    let before = (t > 0).then(|| &cells[here - size..][..hidden]);
                    let (cell, of_cell) = (&cells[here..][..hidden], &mut of_cell[row * hidden..][..hidden]);
                    let of_gates = &mut of_gates[row * wide..][..wide];
                    lstm_cell_backward(of_gates, before, cell, &of_h[row * hidden..][..hidden], of_cell);
                }
                if t > 0 {
                    let into = &mut earlier[(t - 1) * size..];
                    add_product(of_gates, of_state, panels.as_ref(), (hidden, wide), into, &mut back.space.pack);
                }
            }
            back.space.pool.give(of_cell);
            Ok(())
        })?;
        weights_backward(back, (&x, &output), (&input, &recurrent), (&gates, &gates), rows)?;
        below_backward(back, &x, node, &input, &gates)?;
        [gates, cells, grad].into_iter().for_each(|buffer| back.space.pool.give(buffer));
        Ok(())
    })?;
    Ok((value, Vec::new()))
}

/// Adds the gradients of weights and biases, given those of the gates and of what the state brought to them, (T, b, …).
fn weights_backward(
    back: &mut Backward<'_>,
    (x, output): (&Tensor, &Tensor),
    (input, recurrent): Layer<'_>,
    (of_gates, of_brought): (&[f32], &[f32]),
    rows: usize,
) -> Result<()> {
    let ((wide, width), hidden) = (input.weight.dims2()?, recurrent.weight.dim(1)?);
    read("recurrent layer", [x, output], |[x, output]| {
        if let Some((into, space)) = back.parameter(&input.weight) {
            let (g, x) = (Mat::rows(of_gates, wide).t(), Mat::rows(x, width));
            product((wide, width, of_gates.len() / wide), g, x, Start::Add, into, &mut space.pack);
        }
        let steps_after = of_brought.len() / wide - rows;
        if steps_after > 0
            && let Some((into, space)) = back.parameter(&recurrent.weight)
        {
            // of a step and the state that it began with
            let (later, earlier) = (Mat::rows(&of_brought[wide * rows..], wide).t(), Mat::rows(output, hidden));
            product((wide, hidden, steps_after), later, earlier, Start::Add, into, &mut space.pack);
        }
        for (layer, of) in [(input, of_gates), (recurrent, of_brought)] {
            if let Some((into, _)) = layer.bias.as_ref().and_then(|bias| back.parameter(bias)) {
                column_sums(into, of);
            }
        }
        Ok(())
    })
}

/// Adds the gradient of what comes from below, if it has one.
fn below_backward(
    back: &mut Backward<'_>,
    x: &Tensor,
    node: Option<usize>,
    input: &Linear,
    of_gates: &[f32],
) -> Result<()> {
    if node.is_none() {
        return Ok(());
    }
    let (wide, width) = input.weight.dims2()?;
    let mut below = back.space.pool.take(x.elem_count());
    read("recurrent layer", [&input.weight], |[w]| {
        let (g, w) = (Mat::rows(of_gates, wide), Mat::rows(w, width));
        product((of_gates.len() / wide, width, wide), g, w, Start::Zero, &mut below, &mut back.space.pack);
        Ok(())
    })?;
    back.add(node, below);
    Ok(())
}

fn sigmoid_composed(x: &Tensor) -> Result<Tensor> {
    Ok((((x * 0.5)?.tanh()? * 0.5)? + 0.5)?)
}

fn lstm_composed(
    cx: &Context<'_>,
    sizes: &Sizes<'_>,
    x: &Value,
    (input, recurrent): Layer<'_>,
    before: Option<&[Tensor]>,
) -> Result<(Value, Vec<Tensor>)> {
    let hidden = sizes.hidden;
    let zeros = Tensor::zeros((sizes.rows, hidden), DType::F32, cx.device())?;
    let [mut h, mut c] = [0, 1].map(|at| before.map_or_else(|| zeros.clone(), |before| before[at].clone()));
    // what comes from below does not wait for the steps before
    let from_below = input.forward_in(&x.tensor, cx.precision())?;
    let mut outputs = Vec::with_capacity(sizes.steps);
    for step in 0..sizes.steps {
        let gates = (from_below.get(step)? + recurrent.forward_in(&h, cx.precision())?)?;
        let part = |gate: usize| gates.narrow(1, gate * hidden, hidden);
        let kept = sigmoid_composed(&part(1)?)?.mul(&c)?;
        c = (kept + sigmoid_composed(&part(0)?)?.mul(&part(2)?.tanh()?)?)?;
        h = sigmoid_composed(&part(3)?)?.mul(&c.tanh()?)?;
        outputs.push(h.clone());
    }
    Ok((Value::constant(Tensor::stack(&outputs, 0)?), vec![h.detach(), c.detach()]))
}

/// A layer of gated recurrent units: x: (T, b, in) -> (T, b, H), and h after the last step, (b, H), of a pass that does not train.
/// Gates are r, z, n; as torch's, the reset gate scales what the state adds to the new one after its product with the weights.
///
/// # Errors
/// Shapes that do not go together, a state in a pass that trains.
pub fn gru(
    cx: &mut Context<'_>,
    x: &Value,
    layer: Layer<'_>,
    before: Option<&[Tensor]>,
) -> Result<(Value, Vec<Tensor>)> {
    let sizes = Sizes::of(cx, "gru", x, layer, 3, 1, before)?;
    if cx.composed("gru", [&x.tensor, &layer.0.weight].into_iter().chain(before.into_iter().flatten()))? {
        return gru_composed(cx, &sizes, x, layer, before);
    }
    let (input, recurrent) = layer;
    let Sizes { steps, rows, width, hidden, biases: [bias_ih, bias_hh] } = sizes;
    let (wide, size) = (3 * hidden, rows * hidden);
    let h_before = numbers(before, 0)?;
    let mut gates = cx.space.pool.take(steps * rows * wide);
    let mut brought = cx.space.pool.take(steps * rows * wide);
    let mut out = vec![0.0; steps * size];
    let tensors = [&x.tensor, &input.weight, &recurrent.weight, bias_ih, bias_hh];
    read("gru", tensors, |[x, of_input, of_state, bias_ih, bias_hh]| {
        times(cx, x, (of_input, width), Start::Bias(bias_ih), None, &mut gates);
        add_bias(&mut brought, bias_hh);
        let (panels, of_state) = (sizes.panels(cx, of_state), Mat::rows(of_state, hidden).t());
        for t in 0..steps {
            let place = t * rows * wide..(t + 1) * rows * wide;
            let (gates, brought) = (&mut gates[place.clone()], &mut brought[place]);
            let (earlier, h) = out.split_at_mut(t * size);
            let before = if t > 0 { Some(&earlier[(t - 1) * size..]) } else { h_before.as_deref() };
            if let Some(before) = before {
                add_product(before, of_state, panels.as_deref(), (wide, hidden), brought, &mut cx.space.pack);
            }
            for row in 0..rows {
                let (own, three) = (row * hidden..(row + 1) * hidden, row * wide..(row + 1) * wide);
                let before = before.map(|before| &before[own.clone()]);
                gru_cell(&mut gates[three.clone()], &brought[three], before, &mut h[own]);
            }
        }
        Ok(())
    })?;
    let shape = [steps, rows, hidden];
    if !cx.records() {
        let state = vec![Tensor::from_slice(&out[out.len() - size..], (rows, hidden), &Device::Cpu)?];
        [gates, brought].into_iter().for_each(|buffer| cx.space.pool.give(buffer));
        return Ok((cx.result(out, &shape, false, |_, _| Ok(()))?, state));
    }
    let out = Tensor::from_vec(out, &shape, &Device::Cpu)?;
    let (node, x, output) = (x.node, x.tensor.clone(), out.clone());
    let (input, recurrent) = (input.clone(), recurrent.clone());
    let value = cx.result_of(out, true, move |mut grad, back| {
        read("gru", [&recurrent.weight, &output], |[of_state, output]| {
            let of_state = Mat::rows(of_state, hidden);
            let panels = (steps > 1).then(|| Packed::new(of_state, (hidden, wide)));
            for t in (0..steps).rev() {
                let place = t * rows * wide..(t + 1) * rows * wide;
                let (of_gates, of_brought) = (&mut gates[place.clone()], &mut brought[place]);
                let (earlier, of_h) = grad.split_at_mut(t * size);
                let before = (t > 0).then(|| &output[(t - 1) * size..]);
                let mut of_before = (t > 0).then(|| &mut earlier[(t - 1) * size..]);
                for row in 0..rows {
                    let (own, three) = (row * hidden..(row + 1) * hidden, row * wide..(row + 1) * wide);
                    gru_cell_backward(
                        (&mut of_gates[three.clone()], &mut of_brought[three]),
                        before.map(|before| &before[own.clone()]),
                        &of_h[own.clone()],
                        of_before.as_deref_mut().map(|of_before| &mut of_before[own]),
                    );
                }
                if let Some(into) = of_before {
                    add_product(of_brought, of_state, panels.as_ref(), (hidden, wide), into, &mut back.space.pack);
                }
            }
            Ok(())
        })?;
        weights_backward(back, (&x, &output), (&input, &recurrent), (&gates, &brought), rows)?;
        below_backward(back, &x, node, &input, &gates)?;
        [gates, brought, grad].into_iter().for_each(|buffer| back.space.pool.give(buffer));
        Ok(())
    })?;
    Ok((value, Vec::new()))
}

fn gru_composed(
    cx: &Context<'_>,
    sizes: &Sizes<'_>,
    x: &Value,
    (input, recurrent): Layer<'_>,
    before: Option<&[Tensor]>,
) -> Result<(Value, Vec<Tensor>)> {
    let hidden = sizes.hidden;
    let mut h = match before {
        Some(before) => before[0].clone(),
        None => Tensor::zeros((sizes.rows, hidden), DType::F32, cx.device())?,
    };
    let from_below = input.forward_in(&x.tensor, cx.precision())?;
    let mut outputs = Vec::with_capacity(sizes.steps);
    for step in 0..sizes.steps {
        let (below, brought) = (from_below.get(step)?, recurrent.forward_in(&h, cx.precision())?);
        let part = |x: &Tensor, gate: usize| x.narrow(1, gate * hidden, hidden);
        let reset = sigmoid_composed(&(part(&below, 0)? + part(&brought, 0)?)?)?;
        let keep = sigmoid_composed(&(part(&below, 1)? + part(&brought, 1)?)?)?;
        let new = (part(&below, 2)? + (reset * part(&brought, 2)?)?)?.tanh()?;
        // (1 - keep) new + keep h
        h = (&new + (keep * (&h - &new)?)?)?;
        outputs.push(h.clone());
    }
    Ok((Value::constant(Tensor::stack(&outputs, 0)?), vec![h.detach()]))
}

/// One row of a step: gates before their activations become those after, (4 H); `before` is c, or zeros -> c and h, (H).
fn lstm_cell(gates: &mut [f32], before: Option<&[f32]>, c: &mut [f32], h: &mut [f32]) {
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
fn lstm_cell_backward(gates: &mut [f32], before: Option<&[f32]>, c: &[f32], of_h: &[f32], of_cell: &mut [f32]) {
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

/// One row of a step: what comes from below to the gates, (3 H), becomes the gates; `brought` is what the state brings to
/// them; `before` is h, or zeros -> h, (H).
fn gru_cell(gates: &mut [f32], brought: &[f32], before: Option<&[f32]>, h: &mut [f32]) {
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
fn gru_cell_backward(
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
