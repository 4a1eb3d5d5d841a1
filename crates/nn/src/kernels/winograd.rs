//! Convolutions of 3x3 weights with a third of the products (Winograd, 1980; Lavin and Gray, CVPR 2016).
//!
//! Nine outputs side by side see a tile of 5x5 inputs. Seen as polynomials, they are fixed by what inputs and weights are at
//! five points a direction (0, 1, -1, 2 and infinity): 25 products instead of 81, and sums over channels are taken at each
//! point alone, as matrix products. Forward pass, gradient of the input and gradient of the weights are all of this kind.
//! Rounding grows to about three times that of the plain sum. Predictions stay with the plain sum (`conv.rs`); with many
//! images, as in training, what is saved is far more than what the transformations cost.

use super::conv::{Conv, Frame, TAIL, add_products, multiply, panel_width};
use super::gemm::Pack;
use crate::simd::dispatch;
use pulp::{Simd, WithSimd};

/// Outputs of a tile, a direction.
const MADE: usize = 3;
/// Inputs of a tile, a direction; as many points.
const SEEN: usize = 5;
/// Points of a tile.
const POINTS: usize = SEEN * SEEN;
/// Weights of a window.
const TAPS: usize = MADE * MADE;
/// Numbers at all points that a block of tiles should not have many more of: they stay in the nearer caches.
const NEAR: usize = 192 << 10;
/// Numbers between two points beyond what they hold: powers of two apart they would push each other out of the cache.
const APART: usize = 32;

/// Rows of a panel that are made together.
const TOGETHER: usize = 4;

/// A convolution in tiles.
#[derive(Debug, Clone, Copy)]
pub struct Winograd {
    conv: Conv,
    /// rows and columns of tiles, an image
    grid: (usize, usize),
}

impl Winograd {
    /// The convolution in tiles; `None` where that is impossible or saves too little.
    pub fn of(conv: &Conv) -> Option<Self> {
        let Frame { images, height, width, channels, border } = conv.input;
        let grid = (height.div_ceil(MADE), width.div_ceil(MADE));
        let possible = conv.kernel == (3, 3)
            && conv.stride == (1, 1)
            && border.0 > 0
            && border.1 > 0
            && channels.is_multiple_of(16)
            && conv.output.is_multiple_of(16);
        // few channels leave the products short beside the transformations, few tiles the weights'
        let wide = channels.min(conv.output) >= 32;
        let many = images * grid.0 * grid.1 >= 32;
        let saves = 9 * height * width >= 40 * grid.0 * grid.1;
        (possible && wide && many && saves).then_some(Self { conv: *conv, grid })
    }

    fn tiles(&self) -> usize {
        self.conv.input.images * self.grid.0 * self.grid.1
    }

    /// Tiles at a time. The weights are read once for them, so there are more of them where weights are many.
    fn block(&self) -> usize {
        let channels = self.conv.input.channels + self.conv.output;
        let least = (channels / 8).max(48);
        (NEAR / (POINTS * channels)).clamp(least, 240.max(least)).min(self.tiles())
    }

    /// Numbers of scratch that any of the three directions needs.
    pub fn scratch(&self) -> usize {
        let count = self.block();
        POINTS * (plane(count, self.conv.input.channels) + plane(count, self.conv.output)) + TAIL
    }

    /// Numbers of the weights at all points.
    pub fn weights(&self) -> usize {
        POINTS * (self.conv.input.channels * self.conv.output + APART)
    }

    /// Numbers of the panels of both directions.
    pub fn panel_len(&self) -> (usize, usize) {
        let (c, o) = (self.conv.input.channels, self.conv.output);
        let wide = |n: usize| n.next_multiple_of(panel_width(n));
        (POINTS * (c * wide(o) + APART), POINTS * (o * wide(c) + APART))
    }

    /// w: (O, I, 3, 3) -> panels of the forward pass, a point after the other
    pub fn pack(&self, w: &[f32], panels: &mut [f32]) {
        let (c, o) = (self.conv.input.channels, self.conv.output);
        dispatch(Weights { w, panels, depth: c, columns: o, at: (TAPS, c * TAPS), turned: false });
    }

    /// w: (O, I, 3, 3) -> panels of the input's gradient, a point after the other
    pub fn pack_backward(&self, w: &[f32], panels: &mut [f32]) {
        let (c, o) = (self.conv.input.channels, self.conv.output);
        dispatch(Weights { w, panels, depth: o, columns: c, at: (c * TAPS, TAPS), turned: true });
    }

    /// x: the input's frame, panels of `pack` -> out: (pixels, O); with `add` added to what is there
    pub fn forward(&self, x: &[f32], panels: &[f32], add: bool, out: &mut [f32], scratch: &mut [f32]) {
        self.run((x, &self.conv.input), panels, self.conv.output, (add, out), scratch);
    }

    /// grad: the output's gradient in a frame with a border of one, panels of `pack_backward` -> that of the input,
    /// (pixels, I); with `add` added to what is there
    pub fn backward(&self, grad: &[f32], panels: &[f32], add: bool, out: &mut [f32], scratch: &mut [f32]) {
        self.run((grad, &self.conv.made((1, 1))), panels, self.conv.input.channels, (add, out), scratch);
    }

    fn run(
        &self,
        (x, frame): (&[f32], &Frame),
        panels: &[f32],
        output: usize,
        (add, out): (bool, &mut [f32]),
        scratch: &mut [f32],
    ) {
        let depth = frame.channels;
        for first in (0..self.tiles()).step_by(self.block()) {
            let count = self.block().min(self.tiles() - first);
            let (of_seen, of_made) = (plane(count, depth), plane(count, output));
            let (seen, made) = scratch.split_at_mut(POINTS * of_seen);
            let made = &mut made[..POINTS * of_made];
            dispatch(Seen::<SEEN> { tiles: self, block: (first, count), x, frame, into: seen });
            let points = seen.chunks_exact(of_seen).zip(panels.chunks_exact(panels.len() / POINTS));
            for ((seen, panels), made) in points.zip(made.chunks_exact_mut(of_made)) {
                multiply(count, (seen, depth), &panels[..panels.len() - APART], (made, output));
            }
            dispatch(Made { tiles: self, block: (first, count), from: made, output, add, out: &mut *out });
        }
    }

    /// x: the input's frame, grad: as in `backward`; adds the gradient of the weights to `into`: (O, I, 3, 3). `points` is
    /// scratch of `weights` numbers.
    pub fn weight_gradient(
        &self,
        (x, grad): (&[f32], &[f32]),
        into: &mut [f32],
        points: &mut [f32],
        scratch: &mut [f32],
        pack: &mut Pack,
    ) {
        let (c, o) = (self.conv.input.channels, self.conv.output);
        points.fill(0.0);
        for first in (0..self.tiles()).step_by(self.block()) {
            let count = self.block().min(self.tiles() - first);
            let (of_seen, of_grad) = (plane(count, c), plane(count, o));
            // gradients first: what follows the inputs may be read and is not used
            let (grads, seen) = scratch.split_at_mut(POINTS * of_grad);
            let frame = &self.conv.made((1, 1));
            dispatch(Seen::<MADE> { tiles: self, block: (first, count), x: grad, frame, into: grads });
            let into = &mut seen[..POINTS * of_seen];
            dispatch(Seen::<SEEN> { tiles: self, block: (first, count), x, frame: &self.conv.input, into });
            for (point, into) in points.chunks_exact_mut(o * c + APART).enumerate() {
                let (seen, grads) = (&seen[point * of_seen..], &grads[point * of_grad..]);
                add_products(count, (seen, c), (grads, o), &mut into[..o * c], pack);
            }
        }
        dispatch(WeightsMade { from: points, into });
    }

    /// Image, row and column of a tile's first output.
    #[inline(always)]
    fn place(&self, tile: usize) -> (usize, usize, usize) {
        let (x, rest) = (tile % self.grid.1, tile / self.grid.1);
        (rest / self.grid.0, MADE * (rest % self.grid.0), MADE * x)
    }
}

/// Numbers of a point: so many tiles of so many channels.
fn plane(tiles: usize, channels: usize) -> usize {
    tiles * channels + APART
}

/// A sum of F vectors for each of T.
trait Sums<const F: usize, const T: usize> {
    fn of<S: Simd>(simd: S, from: [S::f32s; F]) -> [S::f32s; T];
}

/// Five inputs at the five points.
struct Inputs;

impl Sums<SEEN, SEEN> for Inputs {
    #[inline(always)]
    fn of<S: Simd>(simd: S, d: [S::f32s; SEEN]) -> [S::f32s; SEEN] {
        let two = simd.splat_f32s(2.0);
        let (last, below) = (simd.sub_f32s(d[3], d[1]), simd.sub_f32s(d[1], d[2]));
        [
            simd.mul_add_e_f32s(two, simd.sub_f32s(d[0], d[2]), last),
            simd.sub_f32s(last, simd.add_f32s(d[1], d[2])),
            simd.mul_add_e_f32s(two, below, simd.sub_f32s(d[3], d[2])),
            last,
            simd.sub_f32s(simd.sub_f32s(d[4], d[2]), simd.add_f32s(last, last)),
        ]
    }
}

/// Three weights, or three gradients of outputs, at the five points.
struct Factors;

impl Sums<MADE, SEEN> for Factors {
    #[inline(always)]
    fn of<S: Simd>(simd: S, g: [S::f32s; MADE]) -> [S::f32s; SEEN] {
        let (two, four) = (simd.splat_f32s(2.0), simd.splat_f32s(4.0));
        let sixth = simd.splat_f32s(1.0 / 6.0);
        let ends = simd.add_f32s(g[0], g[2]);
        let far = simd.mul_add_e_f32s(four, g[2], simd.mul_add_e_f32s(two, g[1], g[0]));
        [
            simd.mul_f32s(simd.splat_f32s(0.5), g[0]),
            simd.mul_f32s(simd.splat_f32s(-0.5), simd.add_f32s(ends, g[1])),
            simd.mul_f32s(sixth, simd.sub_f32s(g[1], ends)),
            simd.mul_f32s(sixth, far),
            g[2],
        ]
    }
}

/// Three outputs, or three gradients of weights, from their products at the five points.
struct Results;

impl Sums<SEEN, MADE> for Results {
    #[inline(always)]
    fn of<S: Simd>(simd: S, m: [S::f32s; SEEN]) -> [S::f32s; MADE] {
        let near = simd.add_f32s(m[1], m[2]);
        [
            simd.add_f32s(simd.add_f32s(m[0], near), m[3]),
            simd.mul_add_e_f32s(simd.splat_f32s(2.0), m[3], simd.sub_f32s(m[1], m[2])),
            simd.mul_add_e_f32s(simd.splat_f32s(4.0), m[3], simd.add_f32s(near, m[4])),
        ]
    }
}

/// Sums along the rows of a square, then along its columns: a column after the other.
#[inline(always)]
fn both<S: Simd, O: Sums<F, T>, const F: usize, const T: usize>(
    simd: S,
    square: [[S::f32s; F]; F],
) -> [[S::f32s; T]; T] {
    let mut half = [[simd.splat_f32s(0.0); F]; T];
    for row in 0..F {
        let line = O::of(simd, square[row]);
        for column in 0..T {
            half[column][row] = line[column];
        }
    }
    let mut whole = [[simd.splat_f32s(0.0); T]; T];
    for column in 0..T {
        whole[column] = O::of(simd, half[column]);
    }
    whole
}

/// Squares of F x F pixels of a frame, one a tile, at all points: (point, tile, channel).
struct Seen<'a, const F: usize> {
    tiles: &'a Winograd,
    /// the first one, and how many
    block: (usize, usize),
    x: &'a [f32],
    frame: &'a Frame,
    into: &'a mut [f32],
}

impl<const F: usize> Seen<'_, F> {
    #[inline(always)]
    fn run<S: Simd, O: Sums<F, SEEN>>(self, simd: S) {
        let Self { tiles, block, x, frame, into } = self;
        let c = frame.channels;
        let zeros = vec![0f32; c];
        // inputs begin a pixel before the outputs that see them
        let before = (F - MADE) / 2;
        let first = (frame.border.0 - before, frame.border.1 - before);
        let all = (frame.height + 2 * frame.border.0, frame.width + 2 * frame.border.1);
        for t in 0..block.1 {
            let (image, row, column) = tiles.place(block.0 + t);
            let mut pixels = [[&zeros[..]; F]; F];
            for (k, pixel) in pixels.as_flattened_mut().iter_mut().enumerate() {
                let (row, column) = (row + first.0 + k / F, column + first.1 + k % F);
                if row < all.0 && column < all.1 {
                    *pixel = &x[image * frame.image() + row * frame.row() + column * c..][..c];
                }
            }
            at_points::<S, O, F>(simd, pixels.as_flattened(), (&mut *into, t));
        }
    }
}

/// Inputs.
impl WithSimd for Seen<'_, SEEN> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        self.run::<S, Inputs>(simd);
    }
}

/// Gradients of outputs.
impl WithSimd for Seen<'_, MADE> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        self.run::<S, Factors>(simd);
    }
}

/// Writes a tile's channels, a slice a pixel, at all points.
#[inline(always)]
fn at_points<S: Simd, O: Sums<F, SEEN>, const F: usize>(simd: S, pixels: &[&[f32]], (into, tile): (&mut [f32], usize)) {
    let vectors = pixels[0].len() / S::F32_LANES;
    let apart = into.len() / POINTS;
    let mut points = into.chunks_exact_mut(apart);
    let points: [&mut [S::f32s]; POINTS] = std::array::from_fn(
        #[inline(always)]
        |_| match points.next() {
            Some(plane) => &mut S::as_mut_simd_f32s(plane).0[tile * vectors..][..vectors],
            None => &mut [],
        },
    );
    let pixels: [[&[S::f32s]; F]; F] = std::array::from_fn(
        #[inline(always)]
        |y| {
            std::array::from_fn(
                #[inline(always)]
                |x| &S::as_simd_f32s(pixels[y * F + x]).0[..vectors],
            )
        },
    );
    for l in 0..vectors {
        let mut square = [[simd.splat_f32s(0.0); F]; F];
        for y in 0..F {
            for x in 0..F {
                square[y][x] = pixels[y][x][l];
            }
        }
        let whole = both::<S, O, F, SEEN>(simd, square);
        for x in 0..SEEN {
            for y in 0..SEEN {
                points[y * SEEN + x][l] = whole[x][y];
            }
        }
    }
}

/// Outputs from their products at all points, (point, tile, channel), into (pixels, channels).
struct Made<'a> {
    tiles: &'a Winograd,
    /// the first one, and how many
    block: (usize, usize),
    from: &'a [f32],
    output: usize,
    add: bool,
    out: &'a mut [f32],
}

impl WithSimd for Made<'_> {
    type Output = ();

    #[allow(clippy::needless_range_loop)] // rows and columns of a square
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { tiles, block, from, output, add, out } = self;
        let Frame { height, width, .. } = tiles.conv.input;
        let vectors = output / S::F32_LANES;
        let (from, _) = S::as_simd_f32s(from);
        let apart = from.len() / POINTS;
        for t in 0..block.1 {
            let (image, row, column) = tiles.place(block.0 + t);
            let here = (MADE.min(height - row), MADE.min(width - column));
            for l in 0..vectors {
                let whole = both::<S, Results, SEEN, MADE>(simd, products::<S>(simd, from, apart, t * vectors + l));
                for y in 0..here.0 {
                    let at = ((image * height + row + y) * width + column) * output;
                    let (line, _) = S::as_mut_simd_f32s(&mut out[at..at + here.1 * output]);
                    for x in 0..here.1 {
                        let to = &mut line[x * vectors + l];
                        *to = if add { simd.add_f32s(*to, whole[x][y]) } else { whole[x][y] };
                    }
                }
            }
        }
    }
}

/// Vector `l` of all points, which begin `apart` vectors from each other.
#[inline(always)]
fn products<S: Simd>(simd: S, from: &[S::f32s], apart: usize, l: usize) -> [[S::f32s; SEEN]; SEEN] {
    let mut square = [[simd.splat_f32s(0.0); SEEN]; SEEN];
    for y in 0..SEEN {
        for x in 0..SEEN {
            square[y][x] = from[(y * SEEN + x) * apart + l];
        }
    }
    square
}

/// Weights at all points, in panels.
struct Weights<'a> {
    w: &'a [f32],
    panels: &'a mut [f32],
    depth: usize,
    columns: usize,
    /// from a weight to that of the next depth, and of the next column
    at: (usize, usize),
    /// the kernel's last row and column come first
    turned: bool,
}

impl WithSimd for Weights<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { w, panels, depth, columns, at, turned } = self;
        let nr = panel_width(columns);
        let plane = panels.len() / POINTS;
        let mut taps = [[[0f32; 32]; TAPS]; TOGETHER];
        for j0 in (0..columns).step_by(nr) {
            let here = nr.min(columns - j0);
            for p0 in (0..depth).step_by(TOGETHER) {
                for j in 0..here {
                    for (p, taps) in taps.iter_mut().enumerate() {
                        let Some(from) = w[(p0 + p) * at.0 + (j0 + j) * at.1..].first_chunk::<TAPS>() else { break };
                        for tap in 0..TAPS {
                            taps[tap][j] = from[if turned { TAPS - 1 - tap } else { tap }];
                        }
                    }
                }
                for (p, taps) in taps.iter().enumerate().take(depth - p0) {
                    for l in 0..nr / S::F32_LANES {
                        let mut square = [[simd.splat_f32s(0.0); MADE]; MADE];
                        for tap in 0..TAPS {
                            square[tap / MADE][tap % MADE] = S::as_simd_f32s(&taps[tap]).0[l];
                        }
                        let whole = both::<S, Factors, MADE, SEEN>(simd, square);
                        let line = j0 * depth + (p0 + p) * nr + l * S::F32_LANES;
                        for x in 0..SEEN {
                            for y in 0..SEEN {
                                let to = &mut panels[(y * SEEN + x) * plane + line..][..S::F32_LANES];
                                S::as_mut_simd_f32s(to).0[0] = whole[x][y];
                            }
                        }
                    }
                }
            }
        }
    }
}

/// Gradients of weights from their products at all points, (point, O, I), added to (O, I, 3, 3).
struct WeightsMade<'a> {
    from: &'a [f32],
    into: &'a mut [f32],
}

impl WithSimd for WeightsMade<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { from, into } = self;
        let lanes = S::F32_LANES;
        let (from, _) = S::as_simd_f32s(from);
        let apart = from.len() / POINTS;
        for (l, into) in into.chunks_exact_mut(lanes * TAPS).enumerate() {
            let whole = both::<S, Results, SEEN, MADE>(simd, products::<S>(simd, from, apart, l));
            let mut taps = [[0f32; 16]; TAPS];
            for tap in 0..TAPS {
                S::as_mut_simd_f32s(&mut taps[tap][..lanes]).0[0] = whole[tap % MADE][tap / MADE];
            }
            for (i, into) in into.chunks_exact_mut(TAPS).enumerate() {
                for (to, tap) in into.iter_mut().zip(&taps) {
                    *to += tap[i];
                }
            }
        }
    }
}
