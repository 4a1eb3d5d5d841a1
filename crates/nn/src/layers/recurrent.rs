//! Layers that carry a state from step to step, of either cell.

use super::{Gru, Linear, Lstm};
use crate::device::HERE;
use crate::error::Result;
use crate::params::{Init, Params};
use crate::rng::Rng;
use candle_core::{DType, Tensor};
use serde::{Deserialize, Serialize};

/// The cell of a recurrent network, with torch's weights and gates (robomimic: `rnn.rnn_type`).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Cell {
    /// long short-term memory: four gates, two states
    #[default]
    Lstm,
    /// gated recurrent unit: three gates, one state
    Gru,
}

impl Cell {
    /// Products with a state's width that a step needs.
    pub fn gates(self) -> usize {
        match self {
            Self::Lstm => 4,
            Self::Gru => 3,
        }
    }

    fn states(self) -> usize {
        match self {
            Self::Lstm => 2,
            Self::Gru => 1,
        }
    }
}

/// Of each layer the tensors that go from step to step, (b, hidden) each: an LSTM's h and c, a GRU's h.
pub type RecurrentState = Vec<Vec<Tensor>>;

/// Layers of one kind of cell.
#[derive(Debug, Clone)]
pub struct Recurrent {
    layers: Layers,
    cell: Cell,
    hidden: usize,
    count: usize,
}

#[derive(Debug, Clone)]
enum Layers {
    Lstm(Lstm),
    Gru(Gru),
}

impl Recurrent {
    /// Creates `{prefix}.weight_ih_l0` and so on, all uniform in ±1/sqrt(hidden). `sizes`: input, hidden, layers.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn new(
        params: &mut Params,
        prefix: &str,
        cell: Cell,
        sizes: (usize, usize, usize),
        rng: &mut Rng,
    ) -> Result<Self> {
        let layers = match cell {
            Cell::Lstm => Layers::Lstm(Lstm::new(params, prefix, sizes, rng)?),
            Cell::Gru => Layers::Gru(Gru::new(params, prefix, sizes, rng)?),
        };
        Ok(Self { layers, cell, hidden: sizes.1, count: sizes.2 })
    }

    /// The state before the first step of `rows` sequences.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn zero_state(&self, rows: usize) -> Result<RecurrentState> {
        let zeros = || Tensor::zeros((rows, self.hidden), DType::F32, &HERE);
        (0..self.count).map(|_| (0..self.cell.states()).map(|_| Ok(zeros()?)).collect()).collect()
    }

    /// x: (b, steps, in) -> (b, steps, hidden); `state` becomes that after the last step.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn forward(&self, x: &Tensor, state: &mut RecurrentState) -> Result<Tensor> {
        match &self.layers {
            Layers::Lstm(layers) => layers.forward(x, state),
            Layers::Gru(layers) => layers.forward(x, state),
        }
    }
}

/// The weights of layers with so many gates: from what comes from below and from the state.
pub fn gate_layers(
    params: &mut Params,
    prefix: &str,
    (input, hidden, layers): (usize, usize, usize),
    gates: usize,
    rng: &mut Rng,
) -> Result<Vec<(Linear, Linear)>> {
    let init = Init::Uniform { bound: 1.0 / (hidden as f64).sqrt() };
    let mut linear = |side: &str, layer: usize, input: usize| -> Result<Linear> {
        let weight = params.create(&format!("{prefix}.weight_{side}_l{layer}"), &[gates * hidden, input], init, rng)?;
        let bias = params.create(&format!("{prefix}.bias_{side}_l{layer}"), &[gates * hidden], init, rng)?;
        Ok(Linear { weight, bias: Some(bias) })
    };
    (0..layers).map(|l| Ok((linear("ih", l, if l == 0 { input } else { hidden })?, linear("hh", l, hidden)?))).collect()
}
