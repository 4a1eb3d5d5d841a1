//! One layer of the network, forward and backward, on a few puzzles.

use super::elementwise as ew;
use super::plan::{Marks, Plan, PlanMix, Spans};
use super::product::{Factors, Packed, Rows, Taps, dense, dense_outer, outer, product};
use std::ops::Range;

/// A layer's weights as the products read them.
#[derive(Debug)]
pub(super) struct LayerPacks {
    mix: [Packed; 2],
    gate_up: Packed,
    down: Packed,
}

/// What packed weights are for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Direction {
    Forward,
    Backward,
}

/// Buffers that a thread uses again and again.
#[derive(Default)]
pub(super) struct Scratch {
    wide: Vec<f32>,
    wide2: Vec<f32>,
    wide3: Vec<f32>,
    row: Vec<f32>,
    row2: Vec<f32>,
    /// Grids with a border of zeros, which stays zero.
    padded: Vec<f32>,
    /// Where each cell's neighbourhood begins in `padded`.
    corners: Vec<usize>,
    /// The right factor of one attention head's product.
    head: Packed,
}

/// A slice of at least `len`, zero or left over.
pub(super) fn sized(buffer: &mut Vec<f32>, len: usize) -> &mut [f32] {
    if buffer.len() < len {
        buffer.resize(len, 0.0);
    }
    &mut buffer[..len]
}

impl Plan {
    /// The flat weights, packed for one direction.
    pub(super) fn pack(&self, weights: &[f32], direction: Direction) -> Vec<LayerPacks> {
        let (d, len) = (self.dim, self.len);
        // rows and columns of a weight as it is stored, `(out, in)`
        let pack = |span: &Range<usize>, (out, input): (usize, usize)| match direction {
            Direction::Forward => Packed::transposed(&weights[span.clone()], (out, input)),
            Direction::Backward => Packed::plain(&weights[span.clone()], (out, input)),
        };
        (0..self.layers)
            .map(|layer| {
                let spans = self.spans(layer);
                let [first, second] = &spans.mix;
                let mix = match &self.mix {
                    PlanMix::Attention { .. } => [pack(first, (3 * d, d)), pack(second, (d, d))],
                    PlanMix::MlpT { inner } => [pack(first, (2 * inner, len)), pack(second, (len, *inner))],
                    PlanMix::Conv { .. } => [convolution(&weights[first.clone()], d, direction), Packed::default()],
                };
                LayerPacks {
                    mix,
                    gate_up: pack(&spans.gate_up, (2 * self.inner, d)),
                    down: pack(&spans.down, (d, self.inner)),
                }
            })
            .collect()
    }

    /// One layer; its input lies in the tape already, its output is left there.
    pub(super) fn layer_forward(&self, packs: &LayerPacks, puzzles: usize, tape: &mut [f32], scratch: &mut Scratch) {
        let marks = self.marks(puzzles);
        let (d, len, rows) = (self.dim, self.len, puzzles * self.len);
        let parts = Parts::cut(tape, &marks);
        let [first, second] = &packs.mix;
        match &self.mix {
            PlanMix::Attention { heads, angles } => {
                let size = d / heads;
                dense(parts.a, parts.x, first, false);
                if let Some((cos, sin)) = angles {
                    ew::rotate(parts.a, *heads, size, (cos, sin), 1.0);
                }
                let scale = 1.0 / (size as f32).sqrt();
                for puzzle in 0..puzzles {
                    let qkv = &parts.a[puzzle * len * 3 * d..];
                    for head in 0..*heads {
                        let at = (puzzle * heads + head) * len * len;
                        let scores = &mut parts.b[at..at + len * len];
                        let part = |i: usize| &qkv[i * d + head * size..];
                        let packed = &mut scratch.head;
                        packed.fill((size, len), |p, j| part(1)[j * 3 * d + p]);
                        product(scores, len, strided(part(0), (len, size), 3 * d), packed, false);
                        ew::softmax(scores, len, scale);
                        packed.fill((len, size), |p, j| part(2)[p * 3 * d + j]);
                        let mixed = &mut parts.c[puzzle * len * d + head * size..];
                        product(mixed, d, strided(scores, (len, len), len), packed, false);
                    }
                }
                let branch = sized(&mut scratch.row, rows * d);
                dense(branch, parts.c, second, false);
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
                let branch = sized(&mut scratch.row, rows * d);
                let around = pad(parts.x, (height, width, d), &mut scratch.padded, &mut scratch.corners);
                product(branch, d, around, first, false);
                ew::add_and_norm(parts.x, branch, d, self.eps, parts.middle, parts.inverse1);
            }
        }
        swiglu_forward(parts.middle, (d, self.inner), (&packs.gate_up, &packs.down), parts.both, scratch);
        let branch = &scratch.row[..rows * d];
        ew::add_and_norm(parts.middle, branch, d, self.eps, parts.out, parts.inverse2);
    }

    /// The backward of [`Self::layer_forward`]: `grad` of the output becomes that of the input,
    /// gradients of the weights are added to `into`.
    pub(super) fn layer_backward(
        &self,
        packs: &LayerPacks,
        (spans, into): (&Spans, &mut [f32]),
        puzzles: usize,
        tape: &mut [f32],
        grad: &mut [f32],
        scratch: &mut Scratch,
    ) {
        let marks = self.marks(puzzles);
        let (d, len, rows) = (self.dim, self.len, puzzles * self.len);
        let parts = Parts::cut(tape, &marks);
        let (d_mix, d_dense) = into.split_at_mut(spans.gate_up.start);
        let (d_first, d_second) = d_mix[spans.mix[0].start..].split_at_mut(spans.mix[0].len());
        let (d_gate_up, d_down) = d_dense[..spans.down.end - spans.gate_up.start].split_at_mut(spans.gate_up.len());

        ew::norm_backward(parts.out, parts.inverse2, d, grad);
        let dense_packs = (&packs.gate_up, &packs.down);
        swiglu_backward(parts.middle, (d, self.inner), dense_packs, (d_gate_up, d_down), parts.both, grad, scratch);

        let [first, second] = &packs.mix;
        match &self.mix {
            PlanMix::Attention { heads, angles } => {
                ew::norm_backward(parts.middle, parts.inverse1, d, grad);
                let size = d / heads;
                dense_outer(d_second, (grad, d), (parts.c, d));
                let d_mixed = sized(&mut scratch.row, rows * d);
                dense(d_mixed, grad, second, false);
                let d_qkv = sized(&mut scratch.wide, rows * 3 * d);
                d_qkv.fill(0.0);
                let d_scores = sized(&mut scratch.row2, len * len);
                let scale = 1.0 / (size as f32).sqrt();
                for puzzle in 0..puzzles {
                    let qkv = &parts.a[puzzle * len * 3 * d..];
                    let d_qkv = &mut d_qkv[puzzle * len * 3 * d..(puzzle + 1) * len * 3 * d];
                    for head in 0..*heads {
                        let part = |i: usize| &qkv[i * d + head * size..];
                        let at = (puzzle * heads + head) * len * len;
                        let attended = &parts.b[at..at + len * len];
                        let out = &d_mixed[puzzle * len * d + head * size..];
                        let packed = &mut scratch.head;
                        packed.fill((size, len), |p, j| part(2)[j * 3 * d + p]);
                        product(d_scores, len, strided(out, (len, size), d), packed, false);
                        ew::softmax_backward(attended, len, scale, d_scores);
                        packed.fill((len, size), |p, j| part(1)[p * 3 * d + j]);
                        let d_q = &mut d_qkv[head * size..];
                        product(d_q, 3 * d, strided(d_scores, (len, len), len), packed, false);
                        let turned = |a: &'_ [f32], b: &'_ [f32], stride: usize, to: &mut [f32]| {
                            let at = |i: usize| i * stride;
                            outer(to, 3 * d, Factors { a, a_stride: len, m: len, b, at, n: size, count: len });
                        };
                        turned(d_scores, part(0), 3 * d, &mut d_qkv[d + head * size..]);
                        turned(attended, out, d, &mut d_qkv[2 * d + head * size..]);
                    }
                }
                if let Some((cos, sin)) = angles {
                    ew::rotate(d_qkv, *heads, size, (cos, sin), -1.0);
                }
                dense_outer(d_first, (d_qkv, 3 * d), (parts.x, d));
                dense(grad, d_qkv, first, true);
            }
            PlanMix::MlpT { inner } => {
                let mut turned = std::mem::take(&mut scratch.row2);
                for puzzle in 0..puzzles {
                    let at = puzzle * len * d..(puzzle + 1) * len * d;
                    ew::transpose(&grad[at.clone()], len, d, &mut sized(&mut turned, rows * d)[at]);
                }
                let grads = &mut turned[..rows * d];
                ew::norm_backward(parts.c, parts.inverse1, len, grads);
                let into = (d_first, d_second);
                swiglu_backward(parts.a, (len, *inner), (first, second), into, parts.b, grads, scratch);
                for puzzle in 0..puzzles {
                    let at = puzzle * len * d..(puzzle + 1) * len * d;
                    ew::transpose(&turned[at.clone()], d, len, &mut grad[at]);
                }
                scratch.row2 = turned;
            }
            &PlanMix::Conv { height, width } => {
                ew::norm_backward(parts.middle, parts.inverse1, d, grad);
                let shape = (height, width, d);
                let around = pad(parts.x, shape, &mut scratch.padded, &mut scratch.corners);
                for row in 0..3 {
                    // the three columns of a row lie side by side
                    let (data, n) = (&around.data[row * around.taps.stride..], around.taps.len);
                    let factors = Factors { a: grad, a_stride: d, m: d, b: data, at: around.at, n, count: rows };
                    outer(&mut d_first[row * n..], 9 * d, factors);
                }
                let around = pad(grad, shape, &mut scratch.padded, &mut scratch.corners);
                product(grad, d, around, first, true);
            }
        }
    }
}

/// A convolution's weight `(d, 3, 3, d)` as a product over padded rows; backwards it is the convolution with the weight
/// turned by half a turn and transposed.
fn convolution(weight: &[f32], d: usize, direction: Direction) -> Packed {
    match direction {
        Direction::Forward => Packed::transposed(weight, (d, 9 * d)),
        Direction::Backward => {
            let mut packed = Packed::default();
            packed.fill((9 * d, d), |p, j| weight[(p % d) * 9 * d + (8 - p / d) * d + j]);
            packed
        }
    }
}

/// Copies grids into a border of zeros; the result's rows are the cells' 3x3 neighbourhoods.
fn pad<'a>(
    x: &[f32],
    (height, width, d): (usize, usize, usize),
    padded: &'a mut Vec<f32>,
    corners: &'a mut Vec<usize>,
) -> Rows<'a, impl Fn(usize) -> usize + Copy + 'a> {
    let (cells, wide) = (height * width, width + 2);
    let (grids, rows) = (x.len() / (cells * d), x.len() / d);
    let size = (height + 2) * wide * d;
    let padded = sized(padded, grids * size);
    for (x, padded) in x.chunks_exact(cells * d).zip(padded.chunks_exact_mut(size)) {
        for (row, x) in x.chunks_exact(width * d).enumerate() {
            let at = ((row + 1) * wide + 1) * d;
            padded[at..at + width * d].copy_from_slice(x);
        }
    }
    for cell in corners.len()..rows {
        let (grid, at) = (cell / cells, cell % cells);
        corners.push(grid * size + (at / width * wide + at % width) * d);
    }
    let corners = &corners[..rows];
    Rows { data: padded, count: rows, at: move |i| corners[i], taps: Taps { count: 3, stride: wide * d, len: 3 * d } }
}

/// Rows of `size` numbers that lie `stride` apart.
fn strided(data: &[f32], (count, size): (usize, usize), stride: usize) -> Rows<'_, impl Fn(usize) -> usize + Copy> {
    Rows { data, count, at: move |i| i * stride, taps: Taps::one(size) }
}

/// `x (rows, n)` -> `scratch.row (rows, n)`, keeping gate and up.
fn swiglu_forward(
    x: &[f32],
    (n, inner): (usize, usize),
    (gate_up, down): (&Packed, &Packed),
    both: &mut [f32],
    scratch: &mut Scratch,
) {
    let rows = x.len() / n;
    dense(both, x, gate_up, false);
    let middle = sized(&mut scratch.wide, rows * inner);
    ew::swiglu(both, inner, middle);
    dense(sized(&mut scratch.row, rows * n), middle, down, false);
}

/// `grad` enters as the gradient of `x + swiglu(x)` and leaves as that of `x`.
fn swiglu_backward(
    x: &[f32],
    (n, inner): (usize, usize),
    (gate_up, down): (&Packed, &Packed),
    (d_gate_up, d_down): (&mut [f32], &mut [f32]),
    both: &[f32],
    grad: &mut [f32],
    scratch: &mut Scratch,
) {
    let rows = x.len() / n;
    let d_middle = sized(&mut scratch.wide, rows * inner);
    dense(d_middle, grad, down, false);
    let d_both = sized(&mut scratch.wide2, rows * 2 * inner);
    let middle = sized(&mut scratch.wide3, rows * inner);
    ew::swiglu_backward(both, inner, d_middle, d_both, middle);
    dense_outer(d_down, (grad, n), (middle, inner));
    dense_outer(d_gate_up, (d_both, 2 * inner), (x, n));
    dense(grad, d_both, gate_up, true);
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
