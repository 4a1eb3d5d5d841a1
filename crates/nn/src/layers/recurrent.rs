//! Layers that carry a state from step to step, of either cell, with torch's weights and gates and without dropout: long
//! short-term memory (Hochreiter and Schmidhuber 1997) and gated recurrent units (Cho et al. 2014).

use super::Linear;
use crate::context::Context;
use crate::error::Result;
use crate::ops::{gru, lstm};
use crate::params::{Init, Params};
use crate::rng::Rng;
use crate::value::Value;
use candle_core::Tensor;
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
}

/// Of each layer the tensors that go from step to step, (b, hidden) each: an LSTM's h and c, a GRU's h.
pub type RecurrentState = Vec<Vec<Tensor>>;

/// Layers of one kind of cell.
#[derive(Debug, Clone)]
pub struct Recurrent {
    /// from what comes from below, (gates * hidden, in), and from the state, (gates * hidden, hidden)
    layers: Vec<(Linear, Linear)>,
    cell: Cell,
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
        (input, hidden, layers): (usize, usize, usize),
        rng: &mut Rng,
    ) -> Result<Self> {
        let init = Init::Uniform { bound: 1.0 / (hidden as f64).sqrt() };
        let wide = cell.gates() * hidden;
        let mut linear = |side: &str, layer: usize, input: usize| -> Result<Linear> {
            let weight = params.create(&format!("{prefix}.weight_{side}_l{layer}"), &[wide, input], init, rng)?;
            let bias = params.create(&format!("{prefix}.bias_{side}_l{layer}"), &[wide], init, rng)?;
            Ok(Linear { weight, bias: Some(bias) })
        };
        let layers =
            (0..layers).map(|l| Ok((linear("ih", l, if l == 0 { input } else { hidden })?, linear("hh", l, hidden)?)));
        Ok(Self { layers: layers.collect::<Result<_>>()?, cell })
    }

    /// x: (steps, b, in) -> (steps, b, hidden). A prediction may go on from a state, which becomes that after the last step;
    /// without one it begins at zero.
    ///
    /// # Errors
    /// Shapes that do not go together, a state in a pass that trains.
    pub fn apply(&self, cx: &mut Context<'_>, x: &Value, mut state: Option<&mut RecurrentState>) -> Result<Value> {
        let (mut x, mut after) = (x.clone(), Vec::with_capacity(self.layers.len()));
        for (i, layer) in self.layers.iter().enumerate() {
            let before = state.as_ref().and_then(|state| state.get(i)).map(Vec::as_slice);
            let (out, last) = match self.cell {
                Cell::Lstm => lstm(cx, &x, (&layer.0, &layer.1), before)?,
                Cell::Gru => gru(cx, &x, (&layer.0, &layer.1), before)?,
            };
            x = out;
            after.push(last);
        }
        if let Some(state) = &mut state {
            **state = after;
        }
        Ok(x)
    }
}
