//! Gated recurrent units (Cho et al. 2014) with torch's weights and gates: the reset gate scales what the state adds to the new
//! one after its product with the weights, not before.

use super::Linear;
use super::recurrent::{RecurrentState, gate_layers};
use crate::error::Result;
use crate::params::Params;
use crate::rng::Rng;
use candle_core::Tensor;

/// Layers of gated recurrent units, as `torch.nn.GRU` without dropout.
#[derive(Debug, Clone)]
pub struct Gru {
    /// from what comes from below, (3 hidden, in), and from the state, (3 hidden, hidden): gates r, z, n
    layers: Vec<(Linear, Linear)>,
    hidden: usize,
}

impl Gru {
    /// Creates `{prefix}.weight_ih_l0` and so on, all uniform in ±1/sqrt(hidden).
    pub fn new(params: &mut Params, prefix: &str, sizes: (usize, usize, usize), rng: &mut Rng) -> Result<Self> {
        Ok(Self { layers: gate_layers(params, prefix, sizes, 3, rng)?, hidden: sizes.1 })
    }

    /// x: (b, steps, in) -> (b, steps, hidden); `state`, h of each layer, becomes that after the last step.
    pub fn forward(&self, x: &Tensor, state: &mut RecurrentState) -> Result<Tensor> {
        let sigmoid = |x: Tensor| -> Result<Tensor> { Ok((((x * 0.5)?.tanh()? * 0.5)? + 0.5)?) };
        let mut x = x.clone();
        for ((input, recurrent), state) in self.layers.iter().zip(state) {
            // what comes from below does not wait for the steps before
            let from_below = input.forward(&x)?;
            let mut outputs = Vec::with_capacity(x.dim(1)?);
            let [h] = state.as_mut_slice() else { unreachable!("a GRU's state is h") };
            for step in 0..x.dim(1)? {
                let below = from_below.narrow(1, step, 1)?.squeeze(1)?;
                let before = recurrent.forward(h)?;
                let part = |x: &Tensor, gate: usize| x.narrow(1, gate * self.hidden, self.hidden);
                let reset = sigmoid((part(&below, 0)? + part(&before, 0)?)?)?;
                let keep = sigmoid((part(&below, 1)? + part(&before, 1)?)?)?;
                let new = (part(&below, 2)? + (reset * part(&before, 2)?)?)?.tanh()?;
                // (1 - keep) new + keep h
                *h = (&new + (keep * (&*h - &new)?)?)?;
                outputs.push(h.clone());
            }
            x = Tensor::stack(&outputs, 1)?;
        }
        Ok(x)
    }
}
