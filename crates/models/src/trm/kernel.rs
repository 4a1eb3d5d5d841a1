//! The network of the TRM on plain slices, forward and backward, several puzzles at a time.
//!
//! The recursion treats every puzzle by itself, so a few puzzles are taken through a whole layer
//! while its activations stay in the cache, and groups of puzzles are shared out over threads. A
//! pass with gradient writes its activations to a tape that the backward pass reads; one without
//! uses a tape of a single layer again and again.

use super::elementwise as ew;
use super::gemm::{Matrix, multiply};
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
struct Spans {
    mix: [Range<usize>; 2],
    gate_up: Range<usize>,
    down: Range<usize>,
}

/// Where a layer's activations lie in its tape, for a number of puzzles.
struct Marks {
    /// Input, `(rows, dim)`.
    x: Range<usize>,
    /// Attention: queries, keys, values after rotation. `mlp_t`: the transposed input.
    a: Range<usize>,
    /// Attention: its weights. `mlp_t`: gate and up.
    b: Range<usize>,
    /// Attention: mixed values before the last product. `mlp_t`: its output, still transposed.
    c: Range<usize>,
    /// One over the first norm's root mean square.
    inverse1: Range<usize>,
    /// After the first norm, `(rows, dim)`.
    middle: Range<usize>,
    /// Gate and up, `(rows, 2 inner)`.
    both: Range<usize>,
    inverse2: Range<usize>,
    /// Output, `(rows, dim)`.
    out: Range<usize>,
    len: usize,
}

/// Buffers that a thread uses again and again.
#[derive(Default)]
pub(super) struct Scratch {
    wide: Vec<f32>,
    wide2: Vec<f32>,
    wide3: Vec<f32>,
    row: Vec<f32>,
    row2: Vec<f32>,
}

/// A slice of at least `len`, zero or left over.
fn sized(buffer: &mut Vec<f32>, len: usize) -> &mut [f32] {
    if buffer.len() < len {
        buffer.resize(len, 0.0);
    }
    &mut buffer[..len]
}

impl Plan {
    fn spans(&self, layer: usize) -> Spans {
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

    fn marks(&self, puzzles: usize) -> Marks {
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
    fn layer_tape(&self, puzzles: usize) -> usize {
        self.marks(puzzles).len
    }

    /// Puzzles to take through the network together: as many as keep a layer's activations within
    /// about a megabyte.
    fn group(&self) -> usize {
        ((1 << 18) / self.layer_tape(1)).max(1)
    }

    /// One layer; its input lies in the tape already, its output is left there.
    fn layer_forward(&self, weights: &[f32], layer: usize, puzzles: usize, tape: &mut [f32], scratch: &mut Scratch) {
        let spans = self.spans(layer);
        let marks = self.marks(puzzles);
        let (d, len, rows) = (self.dim, self.len, puzzles * self.len);
        let [first, second] = spans.mix.map(|span| &weights[span]);
        let parts = Parts::cut(tape, &marks);
        match &self.mix {
            PlanMix::Attention { heads, angles } => {
                let size = d / heads;
                multiply(parts.a, 3 * d, Matrix::rows(parts.x, rows, d), Matrix::rows(first, 3 * d, d).t(), false);
                if let Some((cos, sin)) = angles {
                    ew::rotate(parts.a, *heads, size, (cos, sin), 1.0);
                }
                for puzzle in 0..puzzles {
                    let qkv = &parts.a[puzzle * len * 3 * d..];
                    for head in 0..*heads {
                        let part = |i: usize| Matrix::strided(&qkv[i * d + head * size..], len, size, 3 * d, 1);
                        let at = (puzzle * heads + head) * len * len;
                        let scores = &mut parts.b[at..at + len * len];
                        multiply(scores, len, part(0), part(1).t(), false);
                        ew::softmax(scores, len, 1.0 / (size as f32).sqrt());
                        let mixed = &mut parts.c[puzzle * len * d + head * size..];
                        multiply(mixed, d, Matrix::rows(scores, len, len), part(2), false);
                    }
                }
                let branch = sized(&mut scratch.row, rows * d);
                multiply(branch, d, Matrix::rows(parts.c, rows, d), Matrix::rows(second, d, d).t(), false);
                ew::add_and_norm(parts.x, branch, d, self.eps, parts.middle, parts.inverse1);
            }
            PlanMix::MlpT { inner } => {
                for puzzle in 0..puzzles {
                    let at = puzzle * len * d..(puzzle + 1) * len * d;
                    ew::transpose(&parts.x[at.clone()], len, d, &mut parts.a[at]);
                }
                swiglu_forward(parts.a, (len, *inner), (first, second), parts.b, scratch);
                let branch = &scratch.row[..rows * d];
                ew::add_and_norm(parts.a, branch, len, self.eps, parts.c, parts.inverse1);
                for puzzle in 0..puzzles {
                    let at = puzzle * len * d..(puzzle + 1) * len * d;
                    ew::transpose(&parts.c[at.clone()], d, len, &mut parts.middle[at]);
                }
            }
            &PlanMix::Conv { height, width } => {
                let around = sized(&mut scratch.wide, rows * 9 * d);
                gather_neighbours(parts.x, (height, width, d), around);
                let branch = sized(&mut scratch.row, rows * d);
                multiply(branch, d, Matrix::rows(around, rows, 9 * d), Matrix::rows(first, d, 9 * d).t(), false);
                ew::add_and_norm(parts.x, branch, d, self.eps, parts.middle, parts.inverse1);
            }
        }
        let dense = (&weights[spans.gate_up], &weights[spans.down]);
        swiglu_forward(parts.middle, (d, self.inner), dense, parts.both, scratch);
        let branch = &scratch.row[..rows * d];
        ew::add_and_norm(parts.middle, branch, d, self.eps, parts.out, parts.inverse2);
    }

    /// The backward of [`Self::layer_forward`]: `grad` of the output becomes that of the input,
    /// gradients of the weights are added to `into`.
    fn layer_backward(
        &self,
        (weights, into): (&[f32], &mut [f32]),
        layer: usize,
        puzzles: usize,
        tape: &mut [f32],
        grad: &mut [f32],
        scratch: &mut Scratch,
    ) {
        let spans = self.spans(layer);
        let marks = self.marks(puzzles);
        let (d, len, rows) = (self.dim, self.len, puzzles * self.len);
        let [first, second] = spans.mix.clone().map(|span| &weights[span]);
        let parts = Parts::cut(tape, &marks);

        ew::norm_backward(parts.out, parts.inverse2, d, grad);
        let dense = (&weights[spans.gate_up.clone()], &weights[spans.down.clone()]);
        let (head, tail) = into.split_at_mut(spans.down.start);
        let dense_into = (&mut head[spans.gate_up.clone()], &mut tail[..spans.down.len()]);
        swiglu_backward(parts.middle, (d, self.inner), dense, dense_into, parts.both, grad, scratch);

        let (head, tail) = into.split_at_mut(spans.mix[1].start);
        let (d_first, d_second) = (&mut head[spans.mix[0].clone()], &mut tail[..spans.mix[1].len()]);
        match &self.mix {
            PlanMix::Attention { heads, angles } => {
                ew::norm_backward(parts.middle, parts.inverse1, d, grad);
                let size = d / heads;
                multiply(d_second, d, Matrix::rows(grad, rows, d).t(), Matrix::rows(parts.c, rows, d), true);
                let d_mixed = sized(&mut scratch.row, rows * d);
                multiply(d_mixed, d, Matrix::rows(grad, rows, d), Matrix::rows(second, d, d), false);
                let d_qkv = sized(&mut scratch.wide, rows * 3 * d);
                let d_scores = sized(&mut scratch.row2, len * len);
                let scale = 1.0 / (size as f32).sqrt();
                for puzzle in 0..puzzles {
                    let qkv = &parts.a[puzzle * len * 3 * d..];
                    let d_qkv = &mut d_qkv[puzzle * len * 3 * d..(puzzle + 1) * len * 3 * d];
                    for head in 0..*heads {
                        let part = |i: usize| Matrix::strided(&qkv[i * d + head * size..], len, size, 3 * d, 1);
                        let at = (puzzle * heads + head) * len * len;
                        let attended = &parts.b[at..at + len * len];
                        let out = Matrix::strided(&d_mixed[puzzle * len * d + head * size..], len, size, d, 1);
                        multiply(d_scores, len, out, part(2).t(), false);
                        ew::softmax_backward(attended, len, scale, d_scores);
                        let scores = Matrix::rows(d_scores, len, len);
                        let attended = Matrix::rows(attended, len, len);
                        multiply(&mut d_qkv[head * size..], 3 * d, scores, part(1), false);
                        multiply(&mut d_qkv[d + head * size..], 3 * d, scores.t(), part(0), false);
                        multiply(&mut d_qkv[2 * d + head * size..], 3 * d, attended.t(), out, false);
                    }
                }
                if let Some((cos, sin)) = angles {
                    ew::rotate(d_qkv, *heads, size, (cos, sin), -1.0);
                }
                multiply(d_first, d, Matrix::rows(d_qkv, rows, 3 * d).t(), Matrix::rows(parts.x, rows, d), true);
                multiply(grad, d, Matrix::rows(d_qkv, rows, 3 * d), Matrix::rows(first, 3 * d, d), true);
            }
            PlanMix::MlpT { inner } => {
                let turned = sized(&mut scratch.row2, rows * d);
                for puzzle in 0..puzzles {
                    let at = puzzle * len * d..(puzzle + 1) * len * d;
                    ew::transpose(&grad[at.clone()], len, d, &mut turned[at]);
                }
                ew::norm_backward(parts.c, parts.inverse1, len, turned);
                let mut turned = std::mem::take(&mut scratch.row2);
                let both = (first, second);
                swiglu_backward(
                    parts.a,
                    (len, *inner),
                    both,
                    (d_first, d_second),
                    parts.b,
                    &mut turned[..rows * d],
                    scratch,
                );
                for puzzle in 0..puzzles {
                    let at = puzzle * len * d..(puzzle + 1) * len * d;
                    ew::transpose(&turned[at.clone()], d, len, &mut grad[at]);
                }
                scratch.row2 = turned;
            }
            &PlanMix::Conv { height, width } => {
                ew::norm_backward(parts.middle, parts.inverse1, d, grad);
                let around = sized(&mut scratch.wide, rows * 9 * d);
                gather_neighbours(parts.x, (height, width, d), around);
                multiply(d_first, 9 * d, Matrix::rows(grad, rows, d).t(), Matrix::rows(around, rows, 9 * d), true);
                multiply(around, 9 * d, Matrix::rows(grad, rows, d), Matrix::rows(first, d, 9 * d), false);
                scatter_neighbours(around, (height, width, d), grad);
            }
        }
    }
}

/// A layer's tape, cut at its marks.
struct Parts<'a> {
    x: &'a mut [f32],
    a: &'a mut [f32],
    b: &'a mut [f32],
    c: &'a mut [f32],
    inverse1: &'a mut [f32],
    middle: &'a mut [f32],
    both: &'a mut [f32],
    inverse2: &'a mut [f32],
    out: &'a mut [f32],
}

impl<'a> Parts<'a> {
    fn cut(tape: &'a mut [f32], marks: &Marks) -> Self {
        let mut rest = tape;
        let mut take = |span: &Range<usize>| {
            let (head, tail) = std::mem::take(&mut rest).split_at_mut(span.len());
            rest = tail;
            head
        };
        Self {
            x: take(&marks.x),
            a: take(&marks.a),
            b: take(&marks.b),
            c: take(&marks.c),
            inverse1: take(&marks.inverse1),
            middle: take(&marks.middle),
            both: take(&marks.both),
            inverse2: take(&marks.inverse2),
            out: take(&marks.out),
        }
    }
}

/// `x (rows, n)` -> `scratch.row (rows, n)`, keeping gate and up.
fn swiglu_forward(
    x: &[f32],
    (n, inner): (usize, usize),
    (gate_up, down): (&[f32], &[f32]),
    both: &mut [f32],
    scratch: &mut Scratch,
) {
    let rows = x.len() / n;
    multiply(both, 2 * inner, Matrix::rows(x, rows, n), Matrix::rows(gate_up, 2 * inner, n).t(), false);
    let product = sized(&mut scratch.wide, rows * inner);
    ew::swiglu(both, inner, product);
    let out = sized(&mut scratch.row, rows * n);
    multiply(out, n, Matrix::rows(product, rows, inner), Matrix::rows(down, n, inner).t(), false);
}

/// `grad` enters as the gradient of `x + swiglu(x)` and leaves as that of `x`.
fn swiglu_backward(
    x: &[f32],
    (n, inner): (usize, usize),
    (gate_up, down): (&[f32], &[f32]),
    (d_gate_up, d_down): (&mut [f32], &mut [f32]),
    both: &[f32],
    grad: &mut [f32],
    scratch: &mut Scratch,
) {
    let rows = x.len() / n;
    let d_product = sized(&mut scratch.wide, rows * inner);
    multiply(d_product, inner, Matrix::rows(grad, rows, n), Matrix::rows(down, n, inner), false);
    let d_both = sized(&mut scratch.wide2, rows * 2 * inner);
    let product = sized(&mut scratch.wide3, rows * inner);
    ew::swiglu_backward(both, inner, d_product, d_both, product);
    multiply(d_down, inner, Matrix::rows(grad, rows, n).t(), Matrix::rows(product, rows, inner), true);
    multiply(d_gate_up, n, Matrix::rows(d_both, rows, 2 * inner).t(), Matrix::rows(x, rows, n), true);
    multiply(grad, n, Matrix::rows(d_both, rows, 2 * inner), Matrix::rows(gate_up, 2 * inner, n), true);
}

/// Calls `f(cell, neighbour, k)` for each cell of each grid and its neighbours `k` in 0..9 that
/// lie inside.
fn each_neighbour(cells: usize, (height, width): (usize, usize), mut f: impl FnMut(usize, Option<usize>, usize)) {
    for cell in 0..cells {
        let (grid, at) = (cell / (height * width), cell % (height * width));
        let (row, column) = (at / width, at % width);
        for k in 0..9 {
            // one too many in both directions, so that no number is negative
            let (y, x) = (row + k / 3, column + k % 3);
            let inside = (1..=height).contains(&y) && (1..=width).contains(&x);
            let neighbour = inside.then(|| grid * height * width + (y - 1) * width + x - 1);
            f(cell, neighbour, k);
        }
    }
}

/// `(cells, d) -> (cells, 9 d)`, zeros outside the grid.
fn gather_neighbours(x: &[f32], (height, width, d): (usize, usize, usize), out: &mut [f32]) {
    each_neighbour(x.len() / d, (height, width), |cell, neighbour, k| {
        let to = &mut out[(cell * 9 + k) * d..(cell * 9 + k + 1) * d];
        match neighbour {
            Some(from) => to.copy_from_slice(&x[from * d..(from + 1) * d]),
            None => to.fill(0.0),
        }
    });
}

/// The transpose of [`gather_neighbours`], added to `into`.
fn scatter_neighbours(grad: &[f32], (height, width, d): (usize, usize, usize), into: &mut [f32]) {
    each_neighbour(into.len() / d, (height, width), |cell, neighbour, k| {
        if let Some(to) = neighbour {
            ew::add_short(&mut into[to * d..(to + 1) * d], &grad[(cell * 9 + k) * d..(cell * 9 + k + 1) * d]);
        }
    });
}

/// The states of some puzzles and what is injected, as plain slices.
pub(super) struct Round<'a> {
    pub(super) z_h: &'a mut [f32],
    pub(super) z_l: &'a mut [f32],
    pub(super) embedded: &'a [f32],
}

impl Plan {
    /// The network on `state + injected`, result in `state`; layers write to successive stretches
    /// of `tape`, or all to the same if it holds only one.
    fn network(
        &self,
        weights: &[f32],
        state: &mut [f32],
        injected: &[f32],
        tape: &mut [f32],
        keep: bool,
        scratch: &mut Scratch,
    ) {
        let puzzles = state.len() / (self.len * self.dim);
        let size = self.layer_tape(puzzles);
        let marks = self.marks(puzzles);
        ew::sum_into(&mut tape[..state.len()], state, injected);
        for layer in 0..self.layers {
            let at = if keep { layer * size } else { 0 };
            self.layer_forward(weights, layer, puzzles, &mut tape[at..at + size], scratch);
            let last = layer + 1 == self.layers;
            if last {
                state.copy_from_slice(&tape[at..at + size][marks.out.clone()]);
            } else {
                let to = if keep { at + size } else { 0 };
                tape.copy_within(at + marks.out.start..at + marks.out.end, to);
            }
        }
    }

    /// `cycles` rounds of `l_cycles` updates of `z_l` and one of `z_h` on one group of puzzles.
    /// With `keep` there is one round, and everything goes to the tape.
    fn rounds(
        &self,
        weights: &[f32],
        round: &mut Round<'_>,
        (cycles, l_cycles): (usize, usize),
        tape: &mut [f32],
        keep: bool,
        scratch: &mut Scratch,
    ) {
        let puzzles = round.z_h.len() / (self.len * self.dim);
        let size = self.layers * self.layer_tape(puzzles);
        let mut injected = vec![0.0; round.z_h.len()];
        for _ in 0..cycles {
            ew::sum_into(&mut injected, round.z_h, round.embedded);
            for cycle in 0..l_cycles {
                let tape = if keep { &mut tape[cycle * size..(cycle + 1) * size] } else { &mut *tape };
                self.network(weights, round.z_l, &injected, tape, keep, scratch);
            }
            let tape = if keep { &mut tape[l_cycles * size..(l_cycles + 1) * size] } else { &mut *tape };
            self.network(weights, round.z_h, round.z_l, tape, keep, scratch);
        }
    }

    /// Numbers in the tape of one round for `puzzles`.
    fn round_tape(&self, puzzles: usize, l_cycles: usize) -> usize {
        (l_cycles + 1) * self.layers * self.layer_tape(puzzles)
    }

    /// Cuts `batch` puzzles into groups.
    fn groups(&self, batch: usize) -> impl Iterator<Item = Range<usize>> {
        let size = self.group().min(batch.max(1));
        (0..batch.div_ceil(size)).map(move |i| i * size..((i + 1) * size).min(batch))
    }

    /// Rounds without gradient over the whole batch, in place, on `threads` threads.
    pub(super) fn run(
        &self,
        weights: &[f32],
        (z_h, z_l, embedded): (&mut [f32], &mut [f32], &[f32]),
        cycles: (usize, usize),
        threads: usize,
    ) {
        let jobs = self.jobs(z_h, z_l, embedded);
        share(jobs, threads, |jobs| {
            let (mut scratch, mut tape) = (Scratch::default(), Vec::new());
            for (puzzles, mut round) in jobs {
                let tape = sized(&mut tape, self.layer_tape(puzzles.len()));
                self.rounds(weights, &mut round, cycles, tape, false, &mut scratch);
            }
        });
    }

    /// One round with gradient over the whole batch, in place; `tape` must have
    /// [`Self::tape_len`] numbers.
    pub(super) fn record(
        &self,
        weights: &[f32],
        (z_h, z_l, embedded): (&mut [f32], &mut [f32], &[f32]),
        l_cycles: usize,
        tape: &mut [f32],
        threads: usize,
    ) {
        let mut rest = tape;
        let jobs: Vec<_> = self
            .jobs(z_h, z_l, embedded)
            .into_iter()
            .map(|(puzzles, round)| {
                let size = self.round_tape(puzzles.len(), l_cycles);
                let (mine, others) = std::mem::take(&mut rest).split_at_mut(size);
                rest = others;
                (round, mine)
            })
            .collect();
        share(jobs, threads, |jobs| {
            let mut scratch = Scratch::default();
            for (mut round, tape) in jobs {
                self.rounds(weights, &mut round, (1, l_cycles), tape, true, &mut scratch);
            }
        });
    }

    /// Numbers in the tape of [`Self::record`] for `batch` puzzles.
    pub(super) fn tape_len(&self, batch: usize, l_cycles: usize) -> usize {
        self.groups(batch).map(|puzzles| self.round_tape(puzzles.len(), l_cycles)).sum()
    }

    /// The backward of [`Self::record`]: `grad` of the new `z_h` is used up, the gradient of the
    /// embedded input is added to `d_embedded`, and that of the weights is returned.
    pub(super) fn backward(
        &self,
        weights: &[f32],
        l_cycles: usize,
        tape: &mut [f32],
        (grad, d_embedded): (&mut [f32], &mut [f32]),
        threads: usize,
    ) -> Vec<f32> {
        let per = self.len * self.dim;
        let (mut tapes, mut grads, mut outs) = (tape, grad, d_embedded);
        let batch = grads.len() / per;
        let jobs: Vec<_> = self
            .groups(batch)
            .map(|puzzles| {
                let (mine, others) = std::mem::take(&mut tapes).split_at_mut(self.round_tape(puzzles.len(), l_cycles));
                tapes = others;
                let (grad, others) = std::mem::take(&mut grads).split_at_mut(puzzles.len() * per);
                grads = others;
                let (out, others) = std::mem::take(&mut outs).split_at_mut(puzzles.len() * per);
                outs = others;
                (puzzles.len(), mine, grad, out)
            })
            .collect();
        let parts = share(jobs, threads, |jobs| {
            let mut scratch = Scratch::default();
            let mut into = vec![0.0; self.weights_len()];
            for (puzzles, tape, grad, out) in jobs {
                let size = self.layer_tape(puzzles);
                // the last call updated z_h, every one before it z_l; the gradient of each call's
                // input is that of the state before it, and of what was injected
                for call in (0..=l_cycles).rev() {
                    for layer in (0..self.layers).rev() {
                        let at = (call * self.layers + layer) * size;
                        let tape = &mut tape[at..at + size];
                        self.layer_backward((weights, &mut into), layer, puzzles, tape, grad, &mut scratch);
                    }
                    if call < l_cycles {
                        ew::add(out, grad);
                    }
                }
            }
            into
        });
        // in the order of the threads: the same numbers for the same number of them
        let mut parts = parts.into_iter();
        let mut total = parts.next().unwrap_or_default();
        for part in parts {
            ew::add(&mut total, &part);
        }
        total
    }

    fn jobs<'a>(&self, z_h: &'a mut [f32], z_l: &'a mut [f32], embedded: &'a [f32]) -> Vec<(Range<usize>, Round<'a>)> {
        let per = self.len * self.dim;
        let batch = z_h.len() / per;
        let (mut z_h, mut z_l) = (z_h, z_l);
        self.groups(batch)
            .map(|puzzles| {
                let (h, others) = std::mem::take(&mut z_h).split_at_mut(puzzles.len() * per);
                z_h = others;
                let (l, others) = std::mem::take(&mut z_l).split_at_mut(puzzles.len() * per);
                z_l = others;
                let embedded = &embedded[puzzles.start * per..puzzles.end * per];
                (puzzles, Round { z_h: h, z_l: l, embedded })
            })
            .collect()
    }
}

/// Shares `jobs` out over threads in consecutive stretches; results in the order of the jobs.
fn share<J: Send, R: Send>(jobs: Vec<J>, threads: usize, work: impl Fn(Vec<J>) -> R + Sync) -> Vec<R> {
    let threads = threads.clamp(1, jobs.len().max(1));
    let mut lists: Vec<Vec<J>> = (0..threads).map(|_| Vec::new()).collect();
    let total = jobs.len();
    for (i, job) in jobs.into_iter().enumerate() {
        lists[i * threads / total].push(job);
    }
    if threads == 1 {
        return lists.into_iter().map(work).collect();
    }
    std::thread::scope(|scope| {
        let handles: Vec<_> = lists.into_iter().map(|jobs| scope.spawn(|| work(jobs))).collect();
        handles.into_iter().map(|handle| handle.join().expect("a worker does not panic")).collect()
    })
}
