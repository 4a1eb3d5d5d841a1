//! A long short-term memory (Hochreiter and Schmidhuber 1997) with torch's weights and gates and a hand-written cell.

use super::Linear;
use super::recurrent::{RecurrentState, gate_layers};
use crate::device::HERE;
use crate::error::Result;
use crate::kernels::elementwise::exp;
use crate::params::Params;
use crate::rng::Rng;
use crate::simd::vectorised;
use candle_core::{CpuStorage, CustomOp2, Layout, Result as CandleResult, Shape, Tensor};

/// Layers of LSTM cells, as `torch.nn.LSTM` without dropout.
#[derive(Debug, Clone)]
pub struct Lstm {
    /// from what comes from below, (4 hidden, in), and from the state, (4 hidden, hidden): gates i, f, g, o
    layers: Vec<(Linear, Linear)>,
    hidden: usize,
}

impl Lstm {
    /// Creates `{prefix}.weight_ih_l0` and so on, all uniform in ±1/sqrt(hidden).
    pub fn new(params: &mut Params, prefix: &str, sizes: (usize, usize, usize), rng: &mut Rng) -> Result<Self> {
        Ok(Self { layers: gate_layers(params, prefix, sizes, 4, rng)?, hidden: sizes.1 })
    }

    /// x: (b, steps, in) -> (b, steps, hidden); `state`, h and c of each layer, becomes that after the last step.
    pub fn forward(&self, x: &Tensor, state: &mut RecurrentState) -> Result<Tensor> {
        let mut x = x.clone();
        for ((input, recurrent), state) in self.layers.iter().zip(state) {
            // what comes from below does not wait for the steps before
            let from_below = input.forward(&x)?;
            let mut outputs = Vec::with_capacity(x.dim(1)?);
            let [h, c] = state.as_mut_slice() else { unreachable!("an LSTM's state is h and c") };
            for step in 0..x.dim(1)? {
                let gates = (from_below.narrow(1, step, 1)?.squeeze(1)? + recurrent.forward(h)?)?;
                let both = gates.apply_op2(&c.contiguous()?, Cell)?;
                *h = both.narrow(1, 0, self.hidden)?;
                *c = both.narrow(1, self.hidden, self.hidden)?;
                outputs.push(h.clone());
            }
            x = Tensor::stack(&outputs, 1)?;
        }
        Ok(x)
    }
}

/// gates before their activations (b, 4 hidden), c (b, hidden) -> h and c of the next step, (b, 2 hidden)
struct Cell;

/// From one exponential that cannot overflow.
#[inline(always)]
pub fn sigmoid(x: f32) -> f32 {
    let w = exp(-x.abs());
    if x < 0.0 { w / (1.0 + w) } else { 1.0 / (1.0 + w) }
}

/// Likewise.
#[inline(always)]
pub fn tanh(x: f32) -> f32 {
    let w = exp(-2.0 * x.abs());
    let t = (1.0 - w) / (1.0 + w);
    if x < 0.0 { -t } else { t }
}

fn contiguous<'a>(storage: &'a CpuStorage, layout: &Layout) -> CandleResult<&'a [f32]> {
    let Some((from, to)) = layout.contiguous_offsets() else {
        candle_core::bail!("lstm-cell: an input is not contiguous");
    };
    Ok(&storage.as_slice::<f32>()?[from..to])
}

impl CustomOp2 for Cell {
    fn name(&self) -> &'static str {
        "lstm-cell"
    }

    fn cpu_fwd(
        &self,
        gates: &CpuStorage,
        of_gates: &Layout,
        cell: &CpuStorage,
        of_cell: &Layout,
    ) -> CandleResult<(CpuStorage, Shape)> {
        let (rows, hidden) = of_cell.shape().dims2()?;
        let (gates, cell) = (contiguous(gates, of_gates)?, contiguous(cell, of_cell)?);
        let mut out = vec![0.0; rows * 2 * hidden];
        for ((gates, cell), out) in
            gates.chunks_exact(4 * hidden).zip(cell.chunks_exact(hidden)).zip(out.chunks_exact_mut(2 * hidden))
        {
            let (i, rest) = gates.split_at(hidden);
            let (f, rest) = rest.split_at(hidden);
            let (g, o) = rest.split_at(hidden);
            let (h, c) = out.split_at_mut(hidden);
            vectorised(
                #[inline(always)]
                || {
                    for j in 0..hidden {
                        c[j] = sigmoid(f[j]) * cell[j] + sigmoid(i[j]) * tanh(g[j]);
                        h[j] = sigmoid(o[j]) * tanh(c[j]);
                    }
                },
            );
        }
        Ok((CpuStorage::F32(out), Shape::from((rows, 2 * hidden))))
    }

    fn bwd(
        &self,
        gates: &Tensor,
        cell: &Tensor,
        out: &Tensor,
        grad: &Tensor,
    ) -> CandleResult<(Option<Tensor>, Option<Tensor>)> {
        let (rows, hidden) = cell.dims2()?;
        let values = |t: &Tensor| t.flatten_all()?.to_vec1::<f32>();
        let (gates, cells, outs, grads) = (values(gates)?, values(cell)?, values(out)?, values(grad)?);
        let (mut of_gates, mut of_cell) = (vec![0.0; gates.len()], vec![0.0; cells.len()]);
        for row in 0..rows {
            let gates = &gates[row * 4 * hidden..][..4 * hidden];
            let (i, rest) = gates.split_at(hidden);
            let (f, rest) = rest.split_at(hidden);
            let (g, o) = rest.split_at(hidden);
            let before = &cells[row * hidden..][..hidden];
            let after = &outs[row * 2 * hidden + hidden..][..hidden];
            let (of_h, of_c) = grads[row * 2 * hidden..][..2 * hidden].split_at(hidden);
            let (di, rest) = of_gates[row * 4 * hidden..][..4 * hidden].split_at_mut(hidden);
            let (df, rest) = rest.split_at_mut(hidden);
            let (dg, d_o) = rest.split_at_mut(hidden);
            let dc = &mut of_cell[row * hidden..][..hidden];
            vectorised(
                #[inline(always)]
                || {
                    for j in 0..hidden {
                        let (i, f, g, o) = (sigmoid(i[j]), sigmoid(f[j]), tanh(g[j]), sigmoid(o[j]));
                        let t = tanh(after[j]);
                        let d = of_c[j] + of_h[j] * o * (1.0 - t * t);
                        di[j] = d * g * i * (1.0 - i);
                        df[j] = d * before[j] * f * (1.0 - f);
                        dg[j] = d * i * (1.0 - g * g);
                        d_o[j] = of_h[j] * t * o * (1.0 - o);
                        dc[j] = d * f;
                    }
                },
            );
        }
        let of_gates = Tensor::from_vec(of_gates, (rows, 4 * hidden), &HERE)?;
        Ok((Some(of_gates), Some(Tensor::from_vec(of_cell, (rows, hidden), &HERE)?)))
    }
}
