//! Convolutions as products over windows, without copies of the windows.
//!
//! Images lie pixel after pixel with all channels of a pixel side by side, in a frame of zeros as wide as the padding; a
//! sequence is an image of one row, convolved by kernels of one row, and upsampling is the way back of a convolution.
//! A window is then a few stretches of memory that follow each other at equal distances, and a product can read the
//! stretches of a dozen windows where they are. Forward pass, gradient of the input and gradient of the weights are all
//! such products. Sums run in an order that depends on the sizes alone.

use super::gemm::{Pack, Start, tile_of};
use crate::simd::{dispatch, lanes};
use pulp::{Simd, WithSimd};

/// Numbers behind an image that may be read and are not used.
pub const TAIL: usize = 64;
/// Windows of a block: what it reads stays in the second-level cache while all outputs are made of it.
const BLOCK: usize = 240;

/// Images in frames of zeros.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Frame {
    pub images: usize,
    pub height: usize,
    pub width: usize,
    pub channels: usize,
    /// rows of zeros above and below, columns of zeros to the left and right
    pub border: (usize, usize),
}

impl Frame {
    /// Numbers of a row with its borders.
    pub fn row(&self) -> usize {
        (self.width + 2 * self.border.1) * self.channels
    }

    /// Numbers of an image with its borders.
    pub fn image(&self) -> usize {
        (self.height + 2 * self.border.0) * self.row()
    }

    /// Numbers of all images, and some that are never used.
    pub fn buffer_len(&self) -> usize {
        self.images * self.image() + TAIL
    }

    /// Numbers of all images without borders.
    pub fn inside(&self) -> usize {
        self.pixels() * self.channels
    }

    /// Pixels of all images.
    pub fn pixels(&self) -> usize {
        self.images * self.height * self.width
    }

    /// Where row `y` of image `n` begins inside the border.
    #[inline(always)]
    pub fn at(&self, n: usize, y: usize) -> usize {
        n * self.image() + (y + self.border.0) * self.row() + self.border.1 * self.channels
    }

    /// Writes the zeros of the border and of the tail.
    pub fn clear_border(&self, x: &mut [f32]) {
        let (row, side) = (self.row(), self.border.1 * self.channels);
        let end = self.images * self.image();
        for image in x[..end].chunks_exact_mut(self.image().max(1)) {
            image[..self.border.0 * row].fill(0.0);
            let below = (self.border.0 + self.height) * row;
            image[below..].fill(0.0);
            for line in image[self.border.0 * row..below].chunks_exact_mut(row) {
                line[..side].fill(0.0);
                line[row - side..].fill(0.0);
            }
        }
        x[end..].fill(0.0);
    }
}

/// A convolution without bias, padded by half of what its kernel is wider than one pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Conv {
    /// what it reads
    pub input: Frame,
    /// channels that it makes
    pub output: usize,
    /// rows and columns of a window
    pub kernel: (usize, usize),
    /// rows and columns from window to window: 1 or 2
    pub stride: (usize, usize),
}

/// Places of a grid of windows: `start + image * n + row * y + column * x`.
#[derive(Debug, Clone, Copy)]
struct Places {
    start: usize,
    image: usize,
    row: usize,
    column: usize,
}

/// A product over windows: where they are, what they are made of, where results go.
#[derive(Debug, Clone, Copy)]
struct Grid {
    images: usize,
    rows: usize,
    columns: usize,
    from: Places,
    to: Places,
    /// stretches of a window, how far apart they begin, how long they are
    stretches: usize,
    apart: usize,
    length: usize,
}

/// Places of a block of windows and of their results.
type Block = [(usize, usize); BLOCK];

impl Grid {
    fn windows(&self) -> usize {
        self.images * self.rows * self.columns
    }

    fn depth(&self) -> usize {
        self.stretches * self.length
    }

    /// Fills `block` with the windows from number `first` on; returns how many there are.
    #[inline(always)]
    fn block(&self, first: usize, block: &mut Block) -> usize {
        let count = BLOCK.min(self.windows() - first);
        let (mut x, rest) = (first % self.columns, first / self.columns);
        let (mut y, mut n) = (rest % self.rows, rest / self.rows);
        for place in &mut block[..count] {
            let at = |p: &Places| p.start + p.image * n + p.row * y + p.column * x;
            *place = (at(&self.from), at(&self.to));
            x += 1;
            if x == self.columns {
                (x, y) = (0, y + 1);
            }
            if y == self.rows {
                (y, n) = (0, n + 1);
            }
        }
        count
    }
}

impl Conv {
    fn padding(&self) -> (usize, usize) {
        ((self.kernel.0 - 1) / 2, (self.kernel.1 - 1) / 2)
    }

    /// Weights between two channels.
    fn taps(&self) -> usize {
        self.kernel.0 * self.kernel.1
    }

    /// What it makes, in a frame of `border`.
    pub fn made(&self, border: (usize, usize)) -> Frame {
        let Frame { images, height, width, .. } = self.input;
        let (height, width) = (height.div_ceil(self.stride.0), width.div_ceil(self.stride.1));
        Frame { images, height, width, channels: self.output, border }
    }

    /// Numbers of its weights.
    pub fn weights(&self) -> usize {
        self.output * self.input.channels * self.taps()
    }

    /// Windows of the input, results one after the other.
    fn forward_grid(&self) -> Grid {
        let (x, made) = (self.input, self.made((0, 0)));
        let c = x.channels;
        let pad = self.padding();
        Grid {
            images: x.images,
            rows: made.height,
            columns: made.width,
            from: Places {
                start: (x.border.0 - pad.0) * x.row() + (x.border.1 - pad.1) * c,
                image: x.image(),
                row: self.stride.0 * x.row(),
                column: self.stride.1 * c,
            },
            to: Places { start: 0, image: made.image(), row: made.row(), column: made.channels },
            stretches: self.kernel.0,
            apart: x.row(),
            length: self.kernel.1 * c,
        }
    }

    /// The input's gradient as products over windows of the output's, which lies in `grad`: with a stride of two, pixels of
    /// even and odd rows and columns are reached by different weights. With each grid come the kernel's rows and columns that
    /// meet the window's stretches and pixels, in this order.
    fn backward_grids(&self, grad: Frame) -> Vec<(Grid, Vec<usize>, Vec<usize>)> {
        let (x, g) = (self.input, grad);
        let (pad, s) = (self.padding(), self.stride);
        // an input row 2 i + parity meets the kernel's rows `ky` of the outputs `first + 0..`; columns likewise
        let taps = |parity: usize, (kernel, pad, s, border): (usize, usize, usize, usize)| -> (Vec<usize>, usize) {
            let taps: Vec<usize> =
                (0..kernel).rev().filter(|ky| (parity + pad + s - ky % s).is_multiple_of(s)).collect();
            // the output of the first tap, counted with the border: (parity + pad - ky) / s, which may be negative
            let first = taps.first().map_or(0, |&ky| border * s + parity + pad - ky) / s;
            (taps, first)
        };
        let mut grids = Vec::new();
        for py in 0..s.0.min(x.height) {
            for px in 0..s.1.min(x.width) {
                let (ys, y0) = taps(py, (self.kernel.0, pad.0, s.0, g.border.0));
                let (xs, x0) = taps(px, (self.kernel.1, pad.1, s.1, g.border.1));
                if ys.is_empty() || xs.is_empty() {
                    continue;
                }
                let grid = Grid {
                    images: x.images,
                    rows: (x.height - py).div_ceil(s.0),
                    columns: (x.width - px).div_ceil(s.1),
                    from: Places {
                        start: y0 * g.row() + x0 * g.channels,
                        image: g.image(),
                        row: g.row(),
                        column: g.channels,
                    },
                    to: Places {
                        start: (py * x.width + px) * x.channels,
                        image: x.height * x.width * x.channels,
                        row: s.0 * x.width * x.channels,
                        column: s.1 * x.channels,
                    },
                    stretches: ys.len(),
                    apart: g.row(),
                    length: xs.len() * g.channels,
                };
                grids.push((grid, ys, xs));
            }
        }
        grids
    }

    /// Border that the output's gradient needs around it.
    pub fn grad_border(&self) -> (usize, usize) {
        // outputs beyond the ends that an input would meet if they were there
        let beyond = |kernel: usize, pad: usize, stride: usize| (kernel - 1 - pad).div_ceil(stride);
        let pad = self.padding();
        (beyond(self.kernel.0, pad.0, self.stride.0), beyond(self.kernel.1, pad.1, self.stride.1))
    }

    /// Columns of a panel, of the forward pass and of the input's gradient.
    pub fn panel_widths(&self) -> (usize, usize) {
        (panel_width(self.output), panel_width(self.input.channels))
    }

    /// Numbers of the panels of both directions.
    pub fn panel_len(&self) -> (usize, usize) {
        let per = self.taps();
        let wide = |n: usize| n.next_multiple_of(panel_width(n));
        (per * self.input.channels * wide(self.output), per * self.output * wide(self.input.channels))
    }

    /// w: (O, I, k, k) -> panels of the forward pass
    pub fn pack(&self, w: &[f32], panels: &mut [f32]) {
        let (c, per) = (self.input.channels, self.taps());
        let nr = panel_width(self.output);
        for (j0, panel) in (0..self.output).step_by(nr).zip(panels.chunks_exact_mut(per * c * nr)) {
            let columns = nr.min(self.output - j0);
            for i in 0..c {
                for tap in 0..per {
                    let line = &mut panel[(tap * c + i) * nr..][..nr];
                    let from = (j0 * c + i) * per + tap;
                    for (to, w) in line[..columns].iter_mut().zip(w[from..].iter().step_by(c * per)) {
                        *to = *w;
                    }
                    line[columns..].fill(0.0);
                }
            }
        }
    }

    /// w: (O, I, k, k) -> panels of the input's gradient, one after the other for each of its grids
    pub fn pack_backward(&self, w: &[f32], panels: &mut [f32]) {
        let (c, o, per) = (self.input.channels, self.output, self.taps());
        let nr = panel_width(c);
        let mut rest = panels;
        for (grid, ys, xs) in self.backward_grids(self.made(self.grad_border())) {
            let depth = grid.depth();
            let (mine, others) = rest.split_at_mut(depth * c.next_multiple_of(nr));
            rest = others;
            for (j0, panel) in (0..c).step_by(nr).zip(mine.chunks_exact_mut(depth * nr)) {
                let columns = nr.min(c - j0);
                let taps = ys.iter().flat_map(|y| xs.iter().map(move |x| y * self.kernel.1 + x));
                for (tap, lines) in taps.zip(panel.chunks_exact_mut(o * nr)) {
                    for (from, line) in lines.chunks_exact_mut(nr).enumerate() {
                        let from = (from * c + j0) * per + tap;
                        for (to, w) in line[..columns].iter_mut().zip(w[from..].iter().step_by(per)) {
                            *to = *w;
                        }
                        line[columns..].fill(0.0);
                    }
                }
            }
        }
    }

    /// x: the input's frame -> out: (pixels, O); with `add` added to what is there
    pub fn forward(&self, x: &[f32], panels: &[f32], add: bool, out: &mut [f32]) {
        self.run(self.forward_grid(), x, panels, self.output, add, out);
    }

    /// grad: the output's gradient in a frame of `grad_border`, `panels` of `pack_backward` -> that of the input, (pixels, I);
    /// with `add` added to what is there. Pixels that no output sees are written only without `add`.
    pub fn backward(&self, grad: &[f32], panels: &[f32], add: bool, out: &mut [f32]) {
        let grids = self.backward_grids(self.made(self.grad_border()));
        if !add && grids.len() < self.stride.0.min(self.input.height) * self.stride.1.min(self.input.width) {
            out.fill(0.0);
        }
        let c = self.input.channels;
        let mut rest = panels;
        for (grid, _, _) in grids {
            let (mine, others) = rest.split_at(grid.depth() * c.next_multiple_of(panel_width(c)));
            rest = others;
            self.run(grid, grad, mine, c, add, out);
        }
    }

    fn run(&self, grid: Grid, x: &[f32], panels: &[f32], output: usize, add: bool, out: &mut [f32]) {
        dispatch(Windows { grid, x, panels, output, add, out });
    }

    /// x: the input's frame, grad: as in `backward`; adds the gradient of the weights to `into`: (O, I, k, k). `turned` is
    /// scratch of as many numbers.
    pub fn weight_gradient(&self, x: &[f32], grad: &[f32], turned: &mut [f32], into: &mut [f32], pack: &mut Pack) {
        let mut grid = self.forward_grid();
        let g = self.made(self.grad_border());
        grid.to = Places { start: g.at(0, 0), image: g.image(), row: g.row(), column: g.channels };
        turned.fill(0.0);
        dispatch(WeightGradient { grid, x, grad, output: self.output, into: turned, pack });
        let (c, per) = (self.input.channels, self.taps());
        for (to, from) in into.chunks_exact_mut(c * per).zip(turned.chunks_exact(c * per)) {
            for (i, to) in to.chunks_exact_mut(per).enumerate() {
                to.iter_mut().zip(from[i..].iter().step_by(c)).for_each(|(to, x)| *to += x);
            }
        }
    }
}

/// Columns of a panel for `n` columns in all: one vector if that is enough, else two.
pub fn panel_width(n: usize) -> usize {
    let lanes = lanes();
    if n <= lanes { lanes } else { 2 * lanes }
}

impl Grid {
    /// Rows of a matrix, one after the other, and of what is made of them.
    fn rows(count: usize, depth: usize, output: usize) -> Self {
        let places = |column: usize| Places { start: 0, image: 0, row: 0, column };
        let (from, to) = (places(depth), places(output));
        Self { images: 1, rows: 1, columns: count, from, to, stretches: 1, apart: 0, length: depth }
    }
}

/// x: (`rows`, depth) times a matrix in panels of `panel_width` -> out: (`rows`, output)
pub fn multiply(rows: usize, (x, depth): (&[f32], usize), panels: &[f32], (out, output): (&mut [f32], usize)) {
    dispatch(Windows { grid: Grid::rows(rows, depth, output), x, panels, output, add: false, out });
}

/// Adds grad: (`rows`, O), turned, times x: (`rows`, depth) to `into`: (O, depth).
pub fn add_products(
    rows: usize,
    (x, depth): (&[f32], usize),
    (grad, output): (&[f32], usize),
    into: &mut [f32],
    pack: &mut Pack,
) {
    dispatch(WeightGradient { grid: Grid::rows(rows, depth, output), x, grad, output, into, pack });
}

/// `out[to] = sum over the window of x times panels`
struct Windows<'a> {
    grid: Grid,
    x: &'a [f32],
    panels: &'a [f32],
    output: usize,
    add: bool,
    out: &'a mut [f32],
}

impl WithSimd for Windows<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        // sums fill the registers: 24 of 32, 12 of 16; twelve hide the time of an addition
        match (S::F32_LANES >= 16, self.output <= S::F32_LANES) {
            (_, true) => windows::<S, 12, 1>(simd, self),
            (true, false) => windows::<S, 12, 2>(simd, self),
            (false, false) => windows::<S, 6, 2>(simd, self),
        }
    }
}

#[inline(always)]
fn windows<S: Simd, const R: usize, const V: usize>(simd: S, w: Windows<'_>) {
    let Windows { grid, x, panels, output, add, out } = w;
    let nr = V * S::F32_LANES;
    let mut block: Block = [(0, 0); BLOCK];
    for first in (0..grid.windows()).step_by(BLOCK) {
        let count = grid.block(first, &mut block);
        for (j0, panel) in (0..output).step_by(nr).zip(panels.chunks_exact(grid.depth() * nr)) {
            let columns = nr.min(output - j0);
            for places in block[..count].chunks(R) {
                // the last windows of a block may be few
                match places.len() {
                    0..=4 if R == 12 => tile::<S, 4, V>(simd, &grid, x, panel, places, (j0, columns), add, out),
                    5..=8 if R == 12 => tile::<S, 8, V>(simd, &grid, x, panel, places, (j0, columns), add, out),
                    _ => tile::<S, R, V>(simd, &grid, x, panel, places, (j0, columns), add, out),
                }
            }
        }
    }
}

/// Steps that run without a check between them.
const STRIDE: usize = 16;

/// Nothing here may panic: sums would have to be in memory at every step, for whoever looks at them then.
#[allow(clippy::too_many_arguments)] // where from, where to
#[allow(clippy::needless_range_loop)] // plain indices keep the tile in registers
#[inline(always)]
fn tile<S: Simd, const R: usize, const V: usize>(
    simd: S,
    grid: &Grid,
    x: &[f32],
    panel: &[f32],
    places: &[(usize, usize)],
    (j0, columns): (usize, usize),
    add: bool,
    out: &mut [f32],
) {
    let lanes = S::F32_LANES;
    let mut sums = [[simd.splat_f32s(0.0); V]; R];
    // beyond the last window it is read again
    let starts: [usize; R] = std::array::from_fn(|r| places[r.min(places.len() - 1)].0);
    for (s, part) in panel.chunks_exact(grid.length * V * lanes).enumerate() {
        let line = |r: usize| x.get(starts[r] + s * grid.apart..).and_then(|line| line.get(..grid.length));
        let mut lines: [&[f32]; R] = std::array::from_fn(|r| line(r).unwrap_or(&[]));
        let (part, _) = S::as_simd_f32s(part);
        let mut blocks = part.chunks_exact(STRIDE * V);
        for block in &mut blocks {
            let steps: [&[f32; STRIDE]; R] = std::array::from_fn(|r| {
                let (head, tail) = lines[r].split_first_chunk().unwrap_or((&[0.0; STRIDE], &[]));
                lines[r] = tail;
                head
            });
            // sums of its own for every block: these stay in registers
            let mut own = sums;
            for (p, b) in (0..STRIDE).zip(block.chunks_exact(V)) {
                for r in 0..R {
                    let a = simd.splat_f32s(steps[r][p]);
                    for v in 0..V {
                        own[r][v] = simd.mul_add_e_f32s(a, b[v], own[r][v]);
                    }
                }
            }
            sums = own;
        }
        let mut own = sums;
        for (p, b) in blocks.remainder().chunks_exact(V).enumerate() {
            for r in 0..R {
                let a = simd.splat_f32s(lines[r].get(p).copied().unwrap_or(0.0));
                for v in 0..V {
                    own[r][v] = simd.mul_add_e_f32s(a, b[v], own[r][v]);
                }
            }
        }
        sums = own;
    }
    let mut buffer = [0f32; 64];
    for (&(_, to), sums) in places.iter().zip(&sums) {
        let line = &mut out[to + j0..][..columns];
        if columns == V * lanes {
            let (line, _) = S::as_mut_simd_f32s(line);
            for v in 0..V {
                line[v] = if add { simd.add_f32s(line[v], sums[v]) } else { sums[v] };
            }
        } else {
            let (whole, _) = S::as_mut_simd_f32s(&mut buffer[..V * lanes]);
            whole.copy_from_slice(sums);
            for (to, &sum) in line.iter_mut().zip(&buffer) {
                *to = if add { *to + sum } else { sum };
            }
        }
    }
}

/// `into[o][depth] += sum over windows of grad[to][o] * x[window][depth]`: the product of two matrices whose rows lie where
/// the windows are, packed block by block for `gemm`'s tile.
struct WeightGradient<'a> {
    grid: Grid,
    x: &'a [f32],
    grad: &'a [f32],
    output: usize,
    into: &'a mut [f32],
    pack: &'a mut Pack,
}

impl WithSimd for WeightGradient<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        if S::F32_LANES >= 16 { weights::<S, 12>(simd, self) } else { weights::<S, 6>(simd, self) }
    }
}

/// A vector's worth of a window: where it begins in the window and in a row of weights, how many of its numbers count.
#[derive(Clone, Copy, Default)]
struct Piece {
    from: usize,
    to: usize,
    count: usize,
}

impl Grid {
    /// A window in pieces of `lanes` numbers, each of one stretch.
    fn pieces(&self, lanes: usize) -> Vec<Piece> {
        let of_stretch = |s: usize| {
            (0..self.length).step_by(lanes).map(move |at| Piece {
                from: s * self.apart + at,
                to: s * self.length + at,
                count: lanes.min(self.length - at),
            })
        };
        (0..self.stretches).flat_map(of_stretch).collect()
    }
}

#[inline(always)]
fn weights<S: Simd, const MR: usize>(simd: S, w: WeightGradient<'_>) {
    let WeightGradient { grid, x, grad, output, into, pack } = w;
    let (lanes, depth) = (S::F32_LANES, grid.depth());
    let nr = 2 * lanes;
    let pieces = grid.pieces(lanes);
    let panels = pack.panels(BLOCK * output.next_multiple_of(MR), BLOCK * nr);
    let mut block: Block = [(0, 0); BLOCK];
    for first in (0..grid.windows()).step_by(BLOCK) {
        let count = grid.block(first, &mut block);
        for (panel, o0) in panels.0.chunks_exact_mut(MR * count).zip((0..output).step_by(MR)) {
            let channels = MR.min(output - o0);
            for (line, &(_, to)) in panel.chunks_exact_mut(MR).zip(&block[..count]) {
                match grad[to + o0..].first_chunk::<MR>() {
                    // beyond the last channel is something else, of which nothing is kept
                    Some(values) => line.copy_from_slice(values),
                    None => line[..channels].copy_from_slice(&grad[to + o0..][..channels]),
                }
            }
        }
        for pair in pieces.chunks(2) {
            let [one, other] = [pair[0], pair[pair.len() - 1]];
            let panel_b = &mut panels.1[..count * nr];
            let (lines, _) = S::as_mut_simd_f32s(panel_b);
            for (line, &(from, _)) in lines.chunks_exact_mut(2).zip(&block[..count]) {
                line[0] = S::as_simd_f32s(&x[from + one.from..][..lanes]).0[0];
                line[1] = S::as_simd_f32s(&x[from + other.from..][..lanes]).0[0];
            }
            let whole = pair.len() == 2 && one.count == lanes && other.count == lanes;
            for (panel_a, o0) in panels.0.chunks_exact(MR * count).zip((0..output).step_by(MR)) {
                let channels = MR.min(output - o0);
                if whole {
                    let at = &mut into[o0 * depth + one.to..];
                    tile_of::<S, MR>(simd, (panel_a, panel_b), Start::Add, at, depth, (channels, nr), (&[], 0));
                    continue;
                }
                let mut sums = [0f32; 12 * 64];
                tile_of::<S, MR>(simd, (panel_a, panel_b), Start::Zero, &mut sums, nr, (channels, nr), (&[], 0));
                for (o, sums) in sums.chunks_exact(nr).take(channels).enumerate() {
                    for (piece, sums) in pair.iter().zip(sums.chunks_exact(lanes)) {
                        let to = &mut into[(o0 + o) * depth + piece.to..][..piece.count];
                        to.iter_mut().zip(sums).for_each(|(to, sum)| *to += sum);
                    }
                }
            }
        }
    }
}

#[cfg(test)]
#[path = "conv_tests.rs"]
mod tests;
