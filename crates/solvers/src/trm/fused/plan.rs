//! Sizes of the network, and where weights and activations lie in their flat vectors.

use std::ops::Range;

/// How a layer mixes positions, with what the kernel needs to know.
#[derive(Debug, Clone)]
pub(super) enum PlanMix {
    /// `angles`: cosines and sines, `(positions, size / 2)` each.
    Attention {
        heads: usize,
        angles: Option<(Vec<f32>, Vec<f32>)>,
    },
    MlpT {
        inner: usize,
    },
    Conv {
        height: usize,
        width: usize,
    },
}

/// Sizes of the network, and where each weight lies in the flat vector.
#[derive(Debug, Clone)]
pub(super) struct Plan {
    pub(super) mix: PlanMix,
    pub(super) layers: usize,
    /// Positions.
    pub(super) len: usize,
    /// Channels.
    pub(super) dim: usize,
    /// Width of the SwiGLU over channels.
    pub(super) inner: usize,
    pub(super) eps: f32,
}

/// Where a layer's weights lie in the flat vector.
pub(super) struct Spans {
    pub(super) mix: [Range<usize>; 2],
    pub(super) gate_up: Range<usize>,
    pub(super) down: Range<usize>,
}

/// Where a layer's activations lie in its tape, for a number of puzzles.
pub(super) struct Marks {
    /// Input, `(rows, dim)`.
    pub(super) x: Range<usize>,
    /// Attention: queries, keys, values after rotation. `mlp_t`: the transposed input.
    pub(super) a: Range<usize>,
    /// Attention: its weights. `mlp_t`: gate and up.
    pub(super) b: Range<usize>,
    /// Attention: mixed values before the last product. `mlp_t`: its output, still transposed.
    pub(super) c: Range<usize>,
    /// One over the first norm's root mean square.
    pub(super) inverse1: Range<usize>,
    /// After the first norm, `(rows, dim)`.
    pub(super) middle: Range<usize>,
    /// Gate and up, `(rows, 2 inner)`.
    pub(super) both: Range<usize>,
    pub(super) inverse2: Range<usize>,
    /// Output, `(rows, dim)`.
    pub(super) out: Range<usize>,
    pub(super) len: usize,
}

impl Plan {
    pub(super) fn spans(&self, layer: usize) -> Spans {
        let d = self.dim;
        let (first, second) = match &self.mix {
            PlanMix::Attention { .. } => (3 * d * d, d * d),
            PlanMix::MlpT { inner } => (2 * inner * self.len, self.len * inner),
            PlanMix::Conv { .. } => (9 * d * d, 0),
        };
        let per_layer = first + second + 3 * self.inner * d;
        let mut at = layer * per_layer;
        let mut take = |n: usize| {
            at += n;
            at - n..at
        };
        Spans { mix: [take(first), take(second)], gate_up: take(2 * self.inner * d), down: take(self.inner * d) }
    }

    /// Numbers in the flat vector of weights.
    pub(super) fn weights_len(&self) -> usize {
        self.spans(self.layers - 1).down.end
    }

    pub(super) fn marks(&self, puzzles: usize) -> Marks {
        let rows = puzzles * self.len;
        let d = self.dim;
        let (a, b, c, inverse1) = match &self.mix {
            PlanMix::Attention { heads, .. } => (rows * 3 * d, puzzles * heads * self.len * self.len, rows * d, rows),
            PlanMix::MlpT { inner } => (rows * d, puzzles * d * 2 * inner, rows * d, puzzles * d),
            PlanMix::Conv { .. } => (0, 0, 0, rows),
        };
        let mut at = 0;
        let mut take = |n: usize| {
            at += n;
            at - n..at
        };
        Marks {
            x: take(rows * d),
            a: take(a),
            b: take(b),
            c: take(c),
            inverse1: take(inverse1),
            middle: take(rows * d),
            both: take(rows * 2 * self.inner),
            inverse2: take(rows),
            out: take(rows * d),
            len: at,
        }
    }

    /// Numbers in one layer's tape for `puzzles`.
    pub(super) fn layer_tape(&self, puzzles: usize) -> usize {
        self.marks(puzzles).len
    }

    /// Puzzles to take through the network together: as many as keep a layer's activations within
    /// about a megabyte.
    pub(super) fn group(&self) -> usize {
        ((1 << 18) / self.layer_tape(1)).max(1)
    }
}
