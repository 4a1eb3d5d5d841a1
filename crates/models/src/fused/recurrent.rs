//! Layers that carry a state from step to step, of either cell.

use super::gru::Gru;
use super::lstm::Lstm;
use super::{Grads, Pass};
use crate::layers::Cell;

/// What the backward pass of all layers needs.
#[derive(Debug)]
pub(crate) enum Recurrent {
    Lstm(Lstm),
    Gru(Gru),
}

impl Recurrent {
    /// `sizes`: layers and hidden, under `prefix`, each from a state of zeros. x: (T, b, in), `rows` is b
    pub(crate) fn forward(
        pass: &mut Pass<'_>,
        prefix: &'static str,
        cell: Cell,
        sizes: (usize, usize),
        x: Vec<f32>,
        rows: usize,
    ) -> Self {
        match cell {
            Cell::Lstm => Self::Lstm(Lstm::forward(pass, prefix, sizes, x, rows)),
            Cell::Gru => Self::Gru(Gru::forward(pass, prefix, sizes, x, rows)),
        }
    }

    /// h of the last layer after every step, (T, b, H)
    pub(crate) fn output(&self) -> &[f32] {
        match self {
            Self::Lstm(lstm) => &lstm.output,
            Self::Gru(gru) => &gru.output,
        }
    }

    /// grad: that of the output, (T, b, H) -> that of x, (T, b, in), if it is `wanted`.
    pub(crate) fn backward(
        self,
        pass: &mut Pass<'_>,
        grad: Vec<f32>,
        wanted: bool,
        grads: &mut Grads<'_>,
    ) -> Option<Vec<f32>> {
        match self {
            Self::Lstm(lstm) => lstm.backward(pass, grad, wanted, grads),
            Self::Gru(gru) => gru.backward(pass, grad, wanted, grads),
        }
    }
}
