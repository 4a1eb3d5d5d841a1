//! The matrix products of the fused network.
//!
//! General products copy both factors into panels on every call. Here the weights stay the same for all rounds of a
//! supervision step, so they are packed once ([`Packed`]), and activations are read where they lie: a register tile of
//! rows is short enough for the first-level cache. Rows may be read in several stretches ([`Taps`]), which makes a 3x3
//! convolution over a padded grid the same product as a dense layer, without gathering neighbours.
//!
//! Plain safe Rust; `pulp` picks AVX-512, AVX2 or scalar code at run time. The order of additions depends on the shape
//! and the width of the vectors alone.

use nn::simd::{dispatch, lanes};
use pulp::{Simd, WithSimd};

/// A factor `(k, n)` in panels of two vectors' width, depth first; missing columns are zero.
#[derive(Debug, Clone, Default)]
pub(super) struct Packed {
    panels: Vec<f32>,
    k: usize,
    n: usize,
}

impl Packed {
    /// Packs the matrix whose element `(p, j)` is `at(p, j)`, in place of what was packed before.
    pub(super) fn fill(&mut self, (k, n): (usize, usize), at: impl Fn(usize, usize) -> f32) {
        let width = 2 * lanes();
        (self.k, self.n) = (k, n);
        self.panels.clear();
        self.panels.resize(n.div_ceil(width) * width * k, 0.0);
        for (panel, out) in self.panels.chunks_exact_mut(width * k).enumerate() {
            let first = panel * width;
            for (p, line) in out.chunks_exact_mut(width).enumerate() {
                for (j, to) in line.iter_mut().enumerate().take(n - first) {
                    *to = at(p, first + j);
                }
            }
        }
    }

    /// The transpose of a weight `(n, k)`, as a layer that computes `x W^T` needs it.
    pub(super) fn transposed(weight: &[f32], (n, k): (usize, usize)) -> Self {
        assert_eq!(weight.len(), n * k, "a weight of n rows");
        let mut packed = Self::default();
        packed.fill((k, n), |p, j| weight[j * k + p]);
        packed
    }

    /// A weight `(k, n)` as it is, for the gradient of such a layer's input.
    pub(super) fn plain(weight: &[f32], (k, n): (usize, usize)) -> Self {
        assert_eq!(weight.len(), n * k, "a weight of k rows");
        let mut packed = Self::default();
        packed.fill((k, n), |p, j| weight[p * n + j]);
        packed
    }
}

/// How the `k` numbers of a row lie: `count` stretches of `len`, `stride` apart.
#[derive(Debug, Clone, Copy)]
pub(super) struct Taps {
    pub(super) count: usize,
    pub(super) stride: usize,
    pub(super) len: usize,
}

impl Taps {
    /// All in one.
    pub(super) fn one(len: usize) -> Self {
        Self { count: 1, stride: 0, len }
    }
}

/// Rows of the left factor: row `i` begins at `at(i)`.
#[derive(Clone, Copy)]
pub(super) struct Rows<'a, F> {
    pub(super) data: &'a [f32],
    pub(super) count: usize,
    pub(super) at: F,
    pub(super) taps: Taps,
}

/// `out = a b`, or `out += a b`, with rows of `out` that lie `row_stride` apart.
pub(super) fn product<F: Fn(usize) -> usize + Copy>(
    out: &mut [f32],
    row_stride: usize,
    a: Rows<'_, F>,
    b: &Packed,
    accumulate: bool,
) {
    assert_eq!(a.taps.count * a.taps.len, b.k, "inner sizes of a product");
    assert!(b.n <= row_stride && b.k > 0, "a product inside its rows");
    dispatch(Product { out, row_stride, a, b, accumulate });
}

/// `out = a b`, or `out += a b`, for rows without gaps.
pub(super) fn dense(out: &mut [f32], a: &[f32], b: &Packed, accumulate: bool) {
    let k = b.k;
    let rows = Rows { data: a, count: a.len() / k, at: |i| i * k, taps: Taps::one(k) };
    product(out, b.n, rows, b, accumulate);
}

struct Product<'a, F> {
    out: &'a mut [f32],
    row_stride: usize,
    a: Rows<'a, F>,
    b: &'a Packed,
    accumulate: bool,
}

/// Depth up to which a panel stays in the first-level cache: 48 KiB on AVX-512, half of that on AVX2.
const DEEP: usize = 384;
/// Depth of a block beyond that.
const BLOCK: usize = 256;
/// Depth that a tile takes at a time.
const STEP: usize = 8;

impl<F: Fn(usize) -> usize + Copy> WithSimd for Product<'_, F> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        if S::F32_LANES >= 16 { panels::<S, F, 12>(simd, self) } else { panels::<S, F, 6>(simd, self) }
    }
}

#[inline(always)]
fn panels<S: Simd, F: Fn(usize) -> usize + Copy, const MR: usize>(simd: S, product: Product<'_, F>) {
    let Product { out, row_stride, a, b, accumulate } = product;
    let width = 2 * S::F32_LANES;
    let Taps { count, len, .. } = a.taps;
    for (panel, columns) in b.panels.chunks_exact(width * b.k).enumerate() {
        let first = panel * width;
        let cols = width.min(b.n - first);
        if b.k <= DEEP {
            let block = Block { taps: (0, count), depth: (0, len), panel: columns };
            rows::<S, F, MR>(simd, &mut out[first..], row_stride, a, &block, cols, accumulate);
            continue;
        }
        let mut add = accumulate;
        for tap in 0..count {
            for from in (0..len).step_by(BLOCK) {
                let to = len.min(from + BLOCK);
                let at = tap * len;
                let panel = &columns[(at + from) * width..(at + to) * width];
                let block = Block { taps: (tap, 1), depth: (from, to - from), panel };
                rows::<S, F, MR>(simd, &mut out[first..], row_stride, a, &block, cols, add);
                add = true;
            }
        }
    }
}

/// A stretch of a panel, with the taps and the part of each tap that it multiplies.
struct Block<'a> {
    /// First and number.
    taps: (usize, usize),
    /// First and number.
    depth: (usize, usize),
    panel: &'a [f32],
}

#[inline(always)]
fn rows<S: Simd, F: Fn(usize) -> usize + Copy, const MR: usize>(
    simd: S,
    out: &mut [f32],
    row_stride: usize,
    a: Rows<'_, F>,
    block: &Block<'_>,
    cols: usize,
    add: bool,
) {
    let mut row = 0;
    while row < a.count {
        let to = &mut out[row * row_stride..];
        let left = a.count - row;
        macro_rules! step {
            ($rows:expr) => {{
                match cols <= S::F32_LANES {
                    true => tile::<S, F, { $rows }, 1>(simd, to, row_stride, a, row, block, cols, add),
                    false => tile::<S, F, { $rows }, 2>(simd, to, row_stride, a, row, block, cols, add),
                }
                row += $rows;
            }};
        }
        if left >= MR {
            step!(MR)
        } else if left >= 4 {
            step!(4)
        } else {
            step!(1)
        }
    }
}

/// One register tile: MR rows of NV vectors.
#[allow(clippy::needless_range_loop, clippy::too_many_arguments)] // plain indices keep the tile in registers
#[inline(always)]
fn tile<S: Simd, F: Fn(usize) -> usize + Copy, const MR: usize, const NV: usize>(
    simd: S,
    out: &mut [f32],
    row_stride: usize,
    a: Rows<'_, F>,
    first: usize,
    block: &Block<'_>,
    cols: usize,
    add: bool,
) {
    let mut acc = [[simd.splat_f32s(0.0); NV]; MR];
    let (panel, _) = S::as_simd_f32s(block.panel);
    let (from, len) = block.depth;
    for tap in 0..block.taps.1 {
        let skip = (block.taps.0 + tap) * a.taps.stride + from;
        let mut at: [usize; MR] = std::array::from_fn(|r| (a.at)(first + r) + skip);
        let steps = panel[tap * 2 * len..][..2 * len].chunks_exact(2 * STEP);
        let rest = steps.remainder();
        for weights in steps {
            // arrays of a known length: no index below is checked
            let lines: [&[f32; STEP]; MR] =
                std::array::from_fn(|r| a.data[at[r]..].first_chunk().expect("a row inside its slice"));
            for p in 0..STEP {
                let w: [S::f32s; NV] = std::array::from_fn(|v| weights[2 * p + v]);
                for r in 0..MR {
                    let x = simd.splat_f32s(lines[r][p]);
                    for v in 0..NV {
                        acc[r][v] = simd.mul_add_e_f32s(x, w[v], acc[r][v]);
                    }
                }
            }
            at.iter_mut().for_each(|at| *at += STEP);
        }
        for (p, weights) in rest.chunks_exact(2).enumerate() {
            for r in 0..MR {
                let x = simd.splat_f32s(a.data[at[r] + p]);
                for v in 0..NV {
                    acc[r][v] = simd.mul_add_e_f32s(x, weights[v], acc[r][v]);
                }
            }
        }
    }
    for (r, sums) in acc.into_iter().enumerate() {
        store::<S, NV>(simd, &mut out[r * row_stride..][..cols], sums, add);
    }
}

/// Writes or adds vectors to a line that ends within the last of them.
#[inline(always)]
fn store<S: Simd, const NV: usize>(simd: S, line: &mut [f32], sums: [S::f32s; NV], add: bool) {
    for (sum, part) in sums.into_iter().zip(line.chunks_mut(S::F32_LANES)) {
        if part.len() == S::F32_LANES {
            let (to, _) = S::as_mut_simd_f32s(part);
            to[0] = if add { simd.add_f32s(to[0], sum) } else { sum };
        } else {
            let before = if add { simd.partial_load_f32s(part) } else { simd.splat_f32s(0.0) };
            simd.partial_store_f32s(part, simd.add_f32s(before, sum));
        }
    }
}

/// The factors of an outer product: rows of `a`, `m` numbers each and `a_stride` apart, and rows of `b`, `n` numbers that
/// begin at `at(i)`.
#[derive(Clone, Copy)]
pub(super) struct Factors<'a, F> {
    pub(super) a: &'a [f32],
    pub(super) a_stride: usize,
    pub(super) m: usize,
    pub(super) b: &'a [f32],
    pub(super) at: F,
    pub(super) n: usize,
    /// Rows of both.
    pub(super) count: usize,
}

/// `out += a^T b`, with rows of `out` that lie `row_stride` apart: what a weight's gradient is.
pub(super) fn outer<F: Fn(usize) -> usize + Copy>(out: &mut [f32], row_stride: usize, factors: Factors<'_, F>) {
    assert!(factors.n <= row_stride && factors.m <= factors.a_stride, "a product inside its rows");
    dispatch(Outer { out, row_stride, factors });
}

/// [`outer`] for rows without gaps: `a (rows, m)`, `b (rows, n)`.
pub(super) fn dense_outer(out: &mut [f32], (a, m): (&[f32], usize), (b, n): (&[f32], usize)) {
    let factors = Factors { a, a_stride: m, m, b, at: |i| i * n, n, count: a.len() / m };
    outer(out, n, factors);
}

struct Outer<'a, F> {
    out: &'a mut [f32],
    row_stride: usize,
    factors: Factors<'a, F>,
}

impl<F: Fn(usize) -> usize + Copy> WithSimd for Outer<'_, F> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { out, row_stride, factors } = self;
        let Factors { m, n, count, .. } = factors;
        let width = 2 * S::F32_LANES;
        // as many rows as keep both factors in the first-level cache while their tiles are visited
        let block = (8192 / (m + n)).clamp(16, 256);
        for from in (0..count).step_by(block) {
            let span = (from, block.min(count - from));
            for j in (0..n).step_by(width) {
                let cols = width.min(n - j);
                let mut i = 0;
                while i < m {
                    let to = &mut out[i * row_stride + j..];
                    match (m - i >= 8, cols <= S::F32_LANES) {
                        (true, false) => outer_tile::<S, F, 8, 2>(simd, to, row_stride, factors, (i, j), span, cols),
                        (true, true) => outer_tile::<S, F, 8, 1>(simd, to, row_stride, factors, (i, j), span, cols),
                        (false, false) => outer_tile::<S, F, 1, 2>(simd, to, row_stride, factors, (i, j), span, cols),
                        (false, true) => outer_tile::<S, F, 1, 1>(simd, to, row_stride, factors, (i, j), span, cols),
                    }
                    i += if m - i >= 8 { 8 } else { 1 };
                }
            }
        }
    }
}

/// One register tile: MR rows of NV vectors, summed over a stretch of the factors' rows and added to `out`.
#[allow(clippy::needless_range_loop, clippy::too_many_arguments)] // plain indices keep the tile in registers
#[inline(always)]
fn outer_tile<S: Simd, F: Fn(usize) -> usize + Copy, const MR: usize, const NV: usize>(
    simd: S,
    out: &mut [f32],
    row_stride: usize,
    factors: Factors<'_, F>,
    (i, j): (usize, usize),
    (from, count): (usize, usize),
    cols: usize,
) {
    let Factors { a, a_stride, b, at, .. } = factors;
    let mut acc = [[simd.splat_f32s(0.0); NV]; MR];
    let whole = cols == NV * S::F32_LANES;
    for row in from..from + count {
        let left: &[f32; MR] = a[row * a_stride + i..].first_chunk().expect("a row inside its slice");
        let right = &b[at(row) + j..][..cols];
        let x: [S::f32s; NV] = if whole {
            let (right, _) = S::as_simd_f32s(right);
            std::array::from_fn(|v| right[v])
        } else {
            let lanes = S::F32_LANES;
            std::array::from_fn(|v| simd.partial_load_f32s(&right[(v * lanes).min(cols)..((v + 1) * lanes).min(cols)]))
        };
        for r in 0..MR {
            let y = simd.splat_f32s(left[r]);
            for v in 0..NV {
                acc[r][v] = simd.mul_add_e_f32s(y, x[v], acc[r][v]);
            }
        }
    }
    for (r, sums) in acc.into_iter().enumerate() {
        store::<S, NV>(simd, &mut out[r * row_stride..][..cols], sums, true);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nn::Rng;
    use proptest::prelude::*;

    fn close(got: f32, expected: f64) -> bool {
        (f64::from(got) - expected).abs() < 1e-4 * expected.abs().max(10.0)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(60))]
        #[test]
        fn products_are_the_naive_sums(
            rows in 0usize..40, n in 1usize..75, len in 1usize..40, count in 1usize..4, deep: bool,
            gap in 0usize..5, extra in 0usize..3, accumulate: bool,
        ) {
            // beyond one block in depth
            let len = if deep { len + 380 } else { len };
            let mut rng = Rng::new(1, "product");
            let (k, taps) = (count * len, Taps { count, stride: len + gap, len });
            let step = taps.stride * count + gap;
            let (a, b) = (rng.normals(rows * step + k), rng.normals(k * n));
            let before = rng.normals(rows * (n + extra) + n);
            let left = Rows { data: &a, count: rows, at: |i| i * step, taps };
            for transposed in [false, true] {
                let element = |p: usize, j: usize| if transposed { b[j * k + p] } else { b[p * n + j] };
                let packed = if transposed { Packed::transposed(&b, (n, k)) } else { Packed::plain(&b, (k, n)) };
                let mut out = before.clone();
                product(&mut out, n + extra, left, &packed, accumulate);
                for (at, (&got, &old)) in out.iter().zip(&before).enumerate() {
                    let (i, j) = (at / (n + extra), at % (n + extra));
                    if i >= rows || j >= n {
                        prop_assert_eq!(got, old);
                        continue;
                    }
                    let value = |p: usize| a[i * step + p / len * taps.stride + p % len];
                    let sum: f64 = (0..k).map(|p| f64::from(value(p)) * f64::from(element(p, j))).sum();
                    let expected = sum + if accumulate { f64::from(old) } else { 0.0 };
                    prop_assert!(close(got, expected), "({}, {}): {} {}", i, j, got, expected);
                }
            }
        }

        #[test]
        fn outer_products_are_the_naive_sums(
            count in 0usize..400, m in 1usize..20, n in 1usize..75, gap in 0usize..3, extra in 0usize..3,
        ) {
            let mut rng = Rng::new(2, "outer");
            let (a, b) = (rng.normals(count * (m + gap)), rng.normals(count * (n + gap)));
            let before = rng.normals(m * (n + extra));
            let mut out = before.clone();
            let factors = Factors { a: &a, a_stride: m + gap, m, b: &b, at: |i| i * (n + gap), n, count };
            outer(&mut out, n + extra, factors);
            for (at, (&got, &old)) in out.iter().zip(&before).enumerate() {
                let (i, j) = (at / (n + extra), at % (n + extra));
                if j >= n {
                    prop_assert_eq!(got, old);
                    continue;
                }
                let term = |r: usize| f64::from(a[r * (m + gap) + i]) * f64::from(b[r * (n + gap) + j]);
                let expected = f64::from(old) + (0..count).map(term).sum::<f64>();
                prop_assert!(close(got, expected), "({}, {}): {} {}", i, j, got, expected);
            }
        }
    }
}
