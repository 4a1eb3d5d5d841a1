//! Single-threaded matrix product with a start value and an epilogue.
//!
//! The scheme is BLIS' (Van Zee and van de Geijn, 2015): blocks of both matrices are copied into panels as wide as the
//! register tile, B's panel stays in the first-level cache, A's block in the second. Plain safe Rust; `pulp` picks
//! AVX-512, AVX2 or scalar code at run time. The order of additions depends on the shape alone.

use crate::simd::{dispatch, prefetch, vectorised};
use pulp::{Simd, WithSimd};

/// A view: element (i, j) is `data[i * row + j * col]`.
#[derive(Debug, Clone, Copy)]
pub struct Mat<'a> {
    pub data: &'a [f32],
    pub row: usize,
    pub col: usize,
}

impl<'a> Mat<'a> {
    /// Row-major with rows of `width`.
    pub fn rows(data: &'a [f32], width: usize) -> Self {
        Self { data, row: width, col: 1 }
    }

    /// The transpose.
    pub fn t(self) -> Self {
        Self { data: self.data, row: self.col, col: self.row }
    }
}

/// What the product is added to.
#[derive(Debug, Clone, Copy)]
pub enum Start<'a> {
    /// nothing
    Zero,
    /// what is in the output
    Add,
    /// this row, in every row
    Bias(&'a [f32]),
}

/// Depth of a block: a panel of 32 columns is 32 KiB.
const KC: usize = 256;
/// Rows of a block of A.
const MC: usize = 240;
/// Columns of a block of B.
const NC: usize = 1024;

/// Numbers by which a stream of weights is asked for ahead.
const AHEAD: usize = 512;

/// Panels, kept between calls.
#[derive(Debug, Default)]
pub struct Pack {
    a: Vec<f32>,
    b: Vec<f32>,
}

/// A matrix (k, n) in panels, for many products with it on the right.
#[derive(Debug)]
pub struct Packed {
    panels: Vec<f32>,
    /// width of a panel: that of the machine's vectors
    nr: usize,
}

impl Pack {
    /// Room for so many numbers of A and of B.
    pub fn panels(&mut self, a: usize, b: usize) -> (&mut [f32], &mut [f32]) {
        if self.a.len() < a {
            self.a.resize(a, 0.0);
        }
        if self.b.len() < b {
            self.b.resize(b, 0.0);
        }
        (&mut self.a[..a], &mut self.b[..b])
    }
}

struct PanelWidth;

impl WithSimd for PanelWidth {
    type Output = usize;
    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> usize {
        2 * S::F32_LANES
    }
}

impl Packed {
    pub fn new(b: Mat<'_>, (n, k): (usize, usize)) -> Self {
        let nr = dispatch(PanelWidth);
        let mut panels = vec![0.0; k * n.next_multiple_of(nr)];
        vectorised(
            #[inline(always)]
            || {
                for jc in (0..n).step_by(NC) {
                    let nc = NC.min(n - jc);
                    for pc in (0..k).step_by(KC) {
                        let kc = KC.min(k - pc);
                        pack_b(&mut panels[Self::at((jc, nc), pc, k, nr)..], b, (pc, kc), (jc, nc), nr);
                    }
                }
            },
        );
        Self { panels, nr }
    }

    /// Where the block of `nc` columns from `jc` and of rows from `pc` begins; only the last columns are padded.
    #[inline(always)]
    fn at((jc, nc): (usize, usize), pc: usize, k: usize, nr: usize) -> usize {
        jc * k + pc * nc.next_multiple_of(nr)
    }
}

/// `c = start + a b` for a: (m, k), b: (k, n), c: (m, n) with rows `ldc` apart.
pub fn gemm(
    (m, n, k): (usize, usize, usize),
    a: Mat<'_>,
    b: Mat<'_>,
    start: Start<'_>,
    c: &mut [f32],
    ldc: usize,
    pack: &mut Pack,
) {
    gemm_with((m, n, k), a, (b, None), start, c, ldc, pack, |_, _, _| ());
}

/// `gemm` into a compact output.
pub fn product(
    (m, n, k): (usize, usize, usize),
    a: Mat<'_>,
    b: Mat<'_>,
    start: Start<'_>,
    c: &mut [f32],
    pack: &mut Pack,
) {
    gemm((m, n, k), a, b, start, c, n, pack);
}

/// `gemm`, then `epilogue(row, first column, values)` on every stretch of a finished row while it is in the cache.
/// With `b` may come its panels.
#[allow(clippy::too_many_arguments)] // the signature of a BLAS
pub fn gemm_with<E: Fn(usize, usize, &mut [f32])>(
    (m, n, k): (usize, usize, usize),
    a: Mat<'_>,
    (b, packed): (Mat<'_>, Option<&Packed>),
    start: Start<'_>,
    c: &mut [f32],
    ldc: usize,
    pack: &mut Pack,
    epilogue: E,
) {
    if m == 0 || n == 0 {
        return;
    }
    assert!(ldc >= n && c.len() >= (m - 1) * ldc + n, "the output holds m rows of n");
    assert!(k > 0, "a product over nothing");
    assert!(a.data.len() > (m - 1) * a.row + (k - 1) * a.col, "A holds (m, k)");
    assert!(b.data.len() > (k - 1) * b.row + (n - 1) * b.col, "B holds (k, n)");
    dispatch(Gemm { m, n, k, a, b, packed, start, c, ldc, pack, epilogue });
}

struct Gemm<'a, E> {
    m: usize,
    n: usize,
    k: usize,
    a: Mat<'a>,
    b: Mat<'a>,
    packed: Option<&'a Packed>,
    start: Start<'a>,
    c: &'a mut [f32],
    ldc: usize,
    pack: &'a mut Pack,
    epilogue: E,
}

impl<E: Fn(usize, usize, &mut [f32])> WithSimd for Gemm<'_, E> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        // a few rows against rows of weights: reading the weights once is all there is to do, packing would double it
        if self.a.col == 1 && self.b.row == 1 {
            // sums and one weight fill the registers: 24 of 32, 12 of 16
            let wide = S::F32_LANES >= 16;
            match (self.m, wide) {
                (1, true) => return few_rows::<S, 1, 8, E>(simd, self),
                (2, true) => return few_rows::<S, 2, 8, E>(simd, self),
                (3, true) => return few_rows::<S, 3, 8, E>(simd, self),
                (4, true) => return few_rows::<S, 4, 6, E>(simd, self),
                (1, false) => return few_rows::<S, 1, 4, E>(simd, self),
                (2, false) => return few_rows::<S, 2, 4, E>(simd, self),
                (3, false) => return few_rows::<S, 3, 4, E>(simd, self),
                (4, false) => return few_rows::<S, 4, 3, E>(simd, self),
                _ => {}
            }
        }
        // the tile fills the registers: 12 x 2 of 32, 6 x 2 of 16
        if S::F32_LANES >= 16 { blocks::<S, 12, E>(simd, self) } else { blocks::<S, 6, E>(simd, self) }
    }
}

/// Scalar products of M rows of A with C columns of B at a time, all contiguous. The C columns are a C-th of the matrix
/// apart: each runs on where its last one ended, so the machine sees C long streams and fetches all of them ahead.
#[allow(clippy::needless_range_loop)] // plain indices keep the tile in registers
#[inline(always)]
fn few_rows<S: Simd, const M: usize, const C: usize, E: Fn(usize, usize, &mut [f32])>(simd: S, g: Gemm<'_, E>) {
    let Gemm { n, k, a, b, start, c, ldc, epilogue, .. } = g;
    let whole = k / S::F32_LANES;
    let split = |data: &'_ [f32], from: usize| -> (usize, usize) {
        debug_assert!(from + k <= data.len());
        (from, from + whole * S::F32_LANES)
    };
    let rows: [(&[S::f32s], &[f32]); M] = std::array::from_fn(|i| {
        let (from, tail) = split(a.data, i * a.row);
        (S::as_simd_f32s(&a.data[from..tail]).0, &a.data[tail..from + k])
    });
    let apart = n.div_ceil(C);
    for j0 in 0..apart {
        let starts: [usize; C] = std::array::from_fn(|j| (j0 + j * apart).min(n - 1) * b.col + AHEAD);
        // beyond the last column the last one is computed again
        let columns: [(&[S::f32s], &[f32]); C] = std::array::from_fn(|j| {
            let (from, tail) = split(b.data, (j0 + j * apart).min(n - 1) * b.col);
            (S::as_simd_f32s(&b.data[from..tail]).0, &b.data[tail..from + k])
        });
        let mut acc = [[simd.splat_f32s(0.0); C]; M];
        for p in 0..whole {
            for j in 0..C {
                prefetch(b.data, starts[j] + p * S::F32_LANES);
                let w = columns[j].0[p];
                for i in 0..M {
                    acc[i][j] = simd.mul_add_e_f32s(rows[i].0[p], w, acc[i][j]);
                }
            }
        }
        for i in 0..M {
            for j in 0..C {
                let column = j0 + j * apart;
                if column >= n {
                    break;
                }
                let tail: f32 = rows[i].1.iter().zip(columns[j].1).map(|(x, y)| x * y).sum();
                let to = &mut c[i * ldc + column];
                let before = match start {
                    Start::Zero => 0.0,
                    Start::Add => *to,
                    Start::Bias(bias) => bias[column],
                };
                *to = simd.reduce_sum_f32s(acc[i][j]) + tail + before;
            }
        }
    }
    for i in 0..M {
        epilogue(i, 0, &mut c[i * ldc..i * ldc + n]);
    }
}

#[inline(always)]
fn blocks<S: Simd, const MR: usize, E: Fn(usize, usize, &mut [f32])>(simd: S, g: Gemm<'_, E>) {
    let Gemm { m, n, k, a, b, packed, start, c, ldc, pack, epilogue } = g;
    let nr = 2 * S::F32_LANES;
    let (depth, wide) = (k.min(KC), n.min(NC).next_multiple_of(nr));
    let tall = m.min(MC).next_multiple_of(MR);
    let packed = packed.filter(|packed| packed.nr == nr);
    pack.panels(depth * tall, if packed.is_none() { depth * wide } else { 0 });
    for jc in (0..n).step_by(NC) {
        let nc = NC.min(n - jc);
        let mut pc = 0;
        loop {
            let kc = KC.min(k - pc);
            let last = pc + kc == k;
            let panels = match packed {
                Some(packed) => &packed.panels[Packed::at((jc, nc), pc, k, nr)..],
                None => {
                    pack_b(&mut pack.b, b, (pc, kc), (jc, nc), nr);
                    &pack.b
                }
            };
            for ic in (0..m).step_by(MC) {
                let mc = MC.min(m - ic);
                pack_a::<MR>(&mut pack.a, a, (ic, mc), (pc, kc));
                for (jp, panel_b) in panels.chunks_exact(nr * kc).take(nc.div_ceil(nr)).enumerate() {
                    let j = jc + jp * nr;
                    let cols = nr.min(n - j);
                    // panels that wait in memory are fetched while the one before is used, a piece by each tile
                    let next = packed.map_or(&[][..], |_| &panels[panels.len().min((jp + 1) * nr * kc)..]);
                    let tiles = mc.div_ceil(MR);
                    for (ip, panel_a) in pack.a.chunks_exact(MR * kc).take(tiles).enumerate() {
                        let i = ic + ip * MR;
                        let rows = MR.min(m - i);
                        let start = if pc > 0 { Start::Add } else { start };
                        let at = &mut c[i * ldc + j..];
                        let bias = match start {
                            Start::Bias(bias) => Start::Bias(&bias[j..j + cols]),
                            other => other,
                        };
                        let ahead = (&next[next.len().min(ip * kc * nr / tiles)..], nr.div_ceil(tiles));
                        tile_of::<S, MR>(simd, (panel_a, panel_b), bias, at, ldc, (rows, cols), ahead);
                    }
                }
                if last {
                    for i in ic..ic + mc {
                        epilogue(i, jc, &mut c[i * ldc + jc..i * ldc + jc + nc]);
                    }
                }
            }
            pc += kc;
            if last {
                break;
            }
        }
    }
}

/// A tile of two panels for as many rows as there are: the last ones of a block may be few. `size` is rows and columns.
#[inline(always)]
pub fn tile_of<S: Simd, const MR: usize>(
    simd: S,
    (a, b): (&[f32], &[f32]),
    start: Start<'_>,
    c: &mut [f32],
    ldc: usize,
    size: (usize, usize),
    ahead: (&[f32], usize),
) {
    match size.0 {
        0..=4 => tile::<S, MR, 4>(simd, a, b, start, c, ldc, size, ahead),
        5..=8 if MR > 8 => tile::<S, MR, 8>(simd, a, b, start, c, ldc, size, ahead),
        _ => tile::<S, MR, MR>(simd, a, b, start, c, ldc, size, ahead),
    }
}

/// Panels of `nr` columns, depth first; missing columns are zero.
#[inline(always)]
fn pack_b(out: &mut [f32], b: Mat<'_>, (pc, kc): (usize, usize), (jc, nc): (usize, usize), nr: usize) {
    for (jp, panel) in out.chunks_exact_mut(nr * kc).take(nc.div_ceil(nr)).enumerate() {
        let j0 = jc + jp * nr;
        let cols = nr.min(jc + nc - j0);
        if cols < nr {
            panel.fill(0.0);
        }
        if b.col == 1 {
            for (p, line) in panel.chunks_exact_mut(nr).enumerate() {
                let from = (pc + p) * b.row + j0;
                line[..cols].copy_from_slice(&b.data[from..from + cols]);
            }
        } else {
            transpose(panel, nr, &b.data[pc * b.row + j0 * b.col..], (kc, cols), (b.row, b.col));
        }
    }
}

/// Panels of `MR` rows, depth first; missing rows are zero.
#[inline(always)]
fn pack_a<const MR: usize>(out: &mut [f32], a: Mat<'_>, (ic, mc): (usize, usize), (pc, kc): (usize, usize)) {
    for (ip, panel) in out.chunks_exact_mut(MR * kc).take(mc.div_ceil(MR)).enumerate() {
        let i0 = ic + ip * MR;
        let rows = MR.min(ic + mc - i0);
        if rows < MR {
            panel.fill(0.0);
        }
        if a.row == 1 {
            for (p, line) in panel.chunks_exact_mut(MR).enumerate() {
                let from = i0 + (pc + p) * a.col;
                line[..rows].copy_from_slice(&a.data[from..from + rows]);
            }
        } else {
            transpose(panel, MR, &a.data[i0 * a.row + pc * a.col..], (kc, rows), (a.col, a.row));
        }
    }
}

/// `out[p * width + i] = data[p * deep + i * across]`, in small squares so that both sides stay in the cache.
#[inline(always)]
fn transpose(out: &mut [f32], width: usize, data: &[f32], (kc, lanes): (usize, usize), (deep, across): (usize, usize)) {
    const SQUARE: usize = 16;
    for p0 in (0..kc).step_by(SQUARE) {
        let to = SQUARE.min(kc - p0);
        for i in 0..lanes {
            let source = &data[i * across + p0 * deep..];
            let target = &mut out[p0 * width..(p0 + to) * width];
            if deep == 1 {
                for (line, &x) in target.chunks_exact_mut(width).zip(&source[..to]) {
                    line[i] = x;
                }
            } else {
                for (p, line) in target.chunks_exact_mut(width).enumerate() {
                    line[i] = source[p * deep];
                }
            }
        }
    }
}

/// One register tile: the first R of a panel's MR rows, two vectors of columns. Meanwhile `ahead` is fetched, at its pace
/// in numbers a step.
#[allow(clippy::too_many_arguments)] // two panels, the output, sizes
#[allow(clippy::needless_range_loop)] // plain indices keep the tile in registers
#[inline(always)]
fn tile<S: Simd, const MR: usize, const R: usize>(
    simd: S,
    a: &[f32],
    b: &[f32],
    start: Start<'_>,
    c: &mut [f32],
    ldc: usize,
    (rows, cols): (usize, usize),
    (ahead, pace): (&[f32], usize),
) {
    let lanes = S::F32_LANES;
    let nr = 2 * lanes;
    let zero = simd.splat_f32s(0.0);
    let mut acc = [[zero; 2]; R];
    let (b, _) = S::as_simd_f32s(b);
    for (p, (a, b)) in a.chunks_exact(MR).zip(b.chunks_exact(2)).enumerate() {
        if !ahead.is_empty() {
            prefetch(ahead, p * pace);
        }
        for r in 0..R {
            let x = simd.splat_f32s(a[r]);
            acc[r][0] = simd.mul_add_e_f32s(x, b[0], acc[r][0]);
            acc[r][1] = simd.mul_add_e_f32s(x, b[1], acc[r][1]);
        }
    }
    if cols == nr {
        let bias = match start {
            Start::Bias(bias) => {
                let (bias, _) = S::as_simd_f32s(bias);
                [bias[0], bias[1]]
            }
            _ => [zero; 2],
        };
        for (r, sums) in acc.iter().enumerate().take(rows) {
            let (line, _) = S::as_mut_simd_f32s(&mut c[r * ldc..r * ldc + nr]);
            for v in 0..2 {
                let before = if matches!(start, Start::Add) { line[v] } else { bias[v] };
                line[v] = simd.add_f32s(sums[v], before);
            }
        }
        return;
    }
    let mut buffer = [0f32; 64];
    for (r, sums) in acc.iter().enumerate().take(rows) {
        let (line, _) = S::as_mut_simd_f32s(&mut buffer[..nr]);
        line.copy_from_slice(sums);
        for (j, (to, &sum)) in c[r * ldc..r * ldc + cols].iter_mut().zip(&buffer).enumerate() {
            *to = sum
                + match start {
                    Start::Zero => 0.0,
                    Start::Add => *to,
                    Start::Bias(bias) => bias[j],
                };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Rng;
    use crate::simd::{Level, at_most};
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(90))]
        #[test]
        fn it_is_the_naive_product(
            m in 1usize..70, n in 1usize..70, k in 1usize..40, deep: bool, wide: bool,
            ta: bool, tb: bool, start in 0u8..3, extra in 0usize..3, level in 0usize..3, packed: bool,
        ) {
            // beyond one block in depth and in width
            let k = if deep { k + 250 } else { k };
            let n = if wide { n + 1000 } else { n };
            let (m, n) = if wide { (m.min(9), n) } else { (m, n) };
            let mut rng = Rng::new(1, "gemm");
            let (a, b, bias) = (rng.normals(m * k + 1), rng.normals(k * n + 1), rng.normals(n));
            let before = rng.normals(m * (n + extra));
            let mat = |data, t: bool, rows, cols| if t { Mat::rows(data, rows).t() } else { Mat::rows(data, cols) };
            let (am, bm) = (mat(&a[..], ta, m, k), mat(&b[..], tb, k, n));
            let mut c = before.clone();
            let kind = match start { 0 => Start::Zero, 1 => Start::Add, _ => Start::Bias(&bias) };
            at_most(Level::ALL[level], || {
                let panels = packed.then(|| Packed::new(bm, (n, k)));
                gemm_with((m, n, k), am, (bm, panels.as_ref()), kind, &mut c, n + extra, &mut Pack::default(), |i, j0, row| {
                    for (j, x) in row.iter_mut().enumerate() {
                        *x += (i * 2 + (j0 + j)) as f32;
                    }
                });
            });
            for i in 0..m {
                for j in 0..n {
                    let sum: f64 = (0..k).map(|p| {
                        f64::from(am.data[i * am.row + p * am.col]) * f64::from(bm.data[p * bm.row + j * bm.col])
                    }).sum();
                    let from = match start { 0 => 0.0, 1 => before[i * (n + extra) + j], _ => bias[j] };
                    let want = sum + f64::from(from) + (i * 2 + j) as f64;
                    let got = f64::from(c[i * (n + extra) + j]);
                    prop_assert!((got - want).abs() < 1e-4 * want.abs().max(10.0), "({}, {}): {} {}", i, j, got, want);
                }
                for j in n..n + extra {
                    prop_assert_eq!(c[i * (n + extra) + j], before[i * (n + extra) + j]);
                }
            }
        }
    }
}
