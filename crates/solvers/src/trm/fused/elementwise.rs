//! The element-wise halves of the fused network, written for the vectoriser: `vectorised` compiles each
//! body for the machine's best instructions and picks one at run time. Sums run over lanes in a
//! fixed order, so that results do not depend on which was picked more than rounding does.

use nn::simd::vectorised;

/// Lanes that sums are kept in: one AVX-512 register, two AVX2 ones.
const LANES: usize = 16;
/// Rows that a norm takes at a time.
const ROWS: usize = 16;

/// The sum of the lanes, in pairs: short chains instead of one long one.
#[inline(always)]
fn fold(mut lanes: [f32; LANES]) -> f32 {
    let mut half = LANES / 2;
    while half > 0 {
        for i in 0..half {
            lanes[i] += lanes[i + half];
        }
        half /= 2;
    }
    lanes[0]
}

#[inline(always)]
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut lanes = [0f32; LANES];
    let (a_body, b_body) = (a.chunks_exact(LANES), b.chunks_exact(LANES));
    let tail: f32 = a_body.remainder().iter().zip(b_body.remainder()).map(|(x, y)| x * y).sum();
    for (x, y) in a_body.zip(b_body) {
        for i in 0..LANES {
            lanes[i] += x[i] * y[i];
        }
    }
    fold(lanes) + tail
}

#[inline(always)]
fn sum(a: &[f32]) -> f32 {
    let mut lanes = [0f32; LANES];
    let body = a.chunks_exact(LANES);
    let tail: f32 = body.remainder().iter().sum();
    for x in body {
        for i in 0..LANES {
            lanes[i] += x[i];
        }
    }
    fold(lanes) + tail
}

#[inline(always)]
fn max(a: &[f32]) -> f32 {
    let mut lanes = [f32::NEG_INFINITY; LANES];
    let body = a.chunks_exact(LANES);
    let mut most = f32::NEG_INFINITY;
    for &x in body.remainder() {
        most = if x > most { x } else { most };
    }
    for x in body {
        for i in 0..LANES {
            lanes[i] = if x[i] > lanes[i] { x[i] } else { lanes[i] };
        }
    }
    lanes.iter().fold(most, |m, &x| if x > m { x } else { m })
}

/// `exp(x)` to about 2 units in the last place, without a branch: Cody and Waite's reduction and a
/// polynomial of degree 6. Below -87 the result is the smallest normal number, above 88 it
/// saturates. NaN stays NaN.
#[inline(always)]
fn exp(x: f32) -> f32 {
    let x = if x < -87.0 { -87.0 } else { x };
    let x = if x > 88.0 { 88.0 } else { x };
    // adding 1.5 * 2^23 rounds to the nearest integer and leaves it in the low bits; a conversion
    // to an integer would saturate lane by lane
    let shifted = x * std::f32::consts::LOG2_E + 12_582_912.0;
    let n = shifted - 12_582_912.0;
    let r = x - n * 0.693_359_4;
    let r = r - n * -2.121_944_4e-4;
    let p = 1.987_569_1e-4;
    let p = p * r + 1.398_199_9e-3;
    let p = p * r + 8.333_452e-3;
    let p = p * r + 4.166_579_6e-2;
    let p = p * r + 1.666_666_5e-1;
    let p = p * r + 5e-1;
    let p = p * r * r + r + 1.0;
    let scale = f32::from_bits(shifted.to_bits().wrapping_sub(0x4b40_0000 - 127) << 23);
    p * scale
}

#[inline(always)]
fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

/// `y += x`
pub(super) fn add(y: &mut [f32], x: &[f32]) {
    vectorised(
        #[inline(always)]
        || {
            for (y, x) in y.iter_mut().zip(x) {
                *y += x;
            }
        },
    );
}

/// `out = a + b`
pub(super) fn sum_into(out: &mut [f32], a: &[f32], b: &[f32]) {
    vectorised(
        #[inline(always)]
        || {
            for ((o, a), b) in out.iter_mut().zip(a).zip(b) {
                *o = a + b;
            }
        },
    );
}

/// Rows of `2 * inner` (gate, up) -> rows of `inner`: `silu(gate) * up`.
pub(super) fn swiglu(both: &[f32], inner: usize, out: &mut [f32]) {
    vectorised(
        #[inline(always)]
        || {
            for (both, out) in both.chunks_exact(2 * inner).zip(out.chunks_exact_mut(inner)) {
                let (gate, up) = both.split_at(inner);
                for ((o, &g), &u) in out.iter_mut().zip(gate).zip(up) {
                    *o = g * sigmoid(g) * u;
                }
            }
        },
    );
}

/// The backward of [`swiglu`]: `grad` of its output -> gradient of `both`, and its output again.
pub(super) fn swiglu_backward(both: &[f32], inner: usize, grad: &[f32], into: &mut [f32], again: &mut [f32]) {
    vectorised(
        #[inline(always)]
        || {
            let rows = both.chunks_exact(2 * inner).zip(grad.chunks_exact(inner));
            let outs = into.chunks_exact_mut(2 * inner).zip(again.chunks_exact_mut(inner));
            for ((both, grad), (into, again)) in rows.zip(outs) {
                let (gate, up) = both.split_at(inner);
                let (d_gate, d_up) = into.split_at_mut(inner);
                for i in 0..inner {
                    let (g, u, d) = (gate[i], up[i], grad[i]);
                    let s = sigmoid(g);
                    let silu = g * s;
                    again[i] = silu * u;
                    d_up[i] = d * silu;
                    d_gate[i] = d * u * (s + silu * (1.0 - s));
                }
            }
        },
    );
}

/// `x (rows, n)` += `branch`, then each row divided by its root mean square; `inverse` keeps one
/// over it per row.
pub(super) fn add_and_norm(x: &[f32], branch: &[f32], n: usize, eps: f32, out: &mut [f32], inverse: &mut [f32]) {
    vectorised(
        #[inline(always)]
        || {
            // some rows at a time, so that their roots and quotients are taken together
            let blocks = x.chunks(ROWS * n).zip(branch.chunks(ROWS * n));
            let outs = out.chunks_mut(ROWS * n).zip(inverse.chunks_mut(ROWS));
            for ((x, b), (out, inverse)) in blocks.zip(outs) {
                for ((o, x), b) in out.iter_mut().zip(x).zip(b) {
                    *o = x + b;
                }
                for (o, inv) in out.chunks_exact(n).zip(inverse.iter_mut()) {
                    *inv = dot(o, o);
                }
                for inv in inverse.iter_mut() {
                    *inv = 1.0 / (*inv / n as f32 + eps).sqrt();
                }
                for (o, &inv) in out.chunks_exact_mut(n).zip(inverse.iter()) {
                    for o in o {
                        *o *= inv;
                    }
                }
            }
        },
    );
}

/// The backward of the norm in [`add_and_norm`], in place: gradient of `out` -> gradient of the
/// sum before it.
pub(super) fn norm_backward(out: &[f32], inverse: &[f32], n: usize, grad: &mut [f32]) {
    vectorised(
        #[inline(always)]
        || {
            let rows = out.chunks_exact(n).zip(inverse);
            for ((o, &inv), g) in rows.zip(grad.chunks_exact_mut(n)) {
                let along = dot(g, o) / n as f32;
                for i in 0..n {
                    g[i] = inv * (g[i] - o[i] * along);
                }
            }
        },
    );
}

/// Each row of `x (rows, n)` -> `softmax(scale * row)`.
pub(super) fn softmax(x: &mut [f32], n: usize, scale: f32) {
    vectorised(
        #[inline(always)]
        || {
            for row in x.chunks_exact_mut(n) {
                let most = max(row);
                for x in row.iter_mut() {
                    *x = exp((*x - most) * scale);
                }
                let inverse = 1.0 / sum(row);
                for x in row.iter_mut() {
                    *x *= inverse;
                }
            }
        },
    );
}

/// The backward of [`softmax`] in place: gradient of the weights -> gradient of the scores.
pub(super) fn softmax_backward(weights: &[f32], n: usize, scale: f32, grad: &mut [f32]) {
    vectorised(
        #[inline(always)]
        || {
            for (w, g) in weights.chunks_exact(n).zip(grad.chunks_exact_mut(n)) {
                let along = dot(w, g);
                for i in 0..n {
                    g[i] = w[i] * (g[i] - along) * scale;
                }
            }
        },
    );
}

/// Rotates the first two of three parts (queries, keys, values) of every row by its position's
/// angles; `direction` -1 turns back. `table` is `(positions, size / 2)` of cosines and sines.
pub(super) fn rotate(qkv: &mut [f32], heads: usize, size: usize, table: (&[f32], &[f32]), direction: f32) {
    let (half, width) = (size / 2, heads * size);
    let positions = table.0.len() / half;
    vectorised(
        #[inline(always)]
        || {
            for (row, qkv) in qkv.chunks_exact_mut(3 * width).enumerate() {
                let at = (row % positions) * half;
                let (cos, sin) = (&table.0[at..at + half], &table.1[at..at + half]);
                for head in qkv[..2 * width].chunks_exact_mut(size) {
                    let (a, b) = head.split_at_mut(half);
                    for i in 0..half {
                        let (x, y, s) = (a[i], b[i], direction * sin[i]);
                        a[i] = x * cos[i] - y * s;
                        b[i] = y * cos[i] + x * s;
                    }
                }
            }
        },
    );
}

/// `(rows, columns) -> (columns, rows)`
pub(super) fn transpose(x: &[f32], rows: usize, columns: usize, out: &mut [f32]) {
    for (i, row) in x.chunks_exact(columns).enumerate().take(rows) {
        for (j, &x) in row.iter().enumerate() {
            out[j * rows + i] = x;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_exponential_is_good_to_two_units_in_the_last_place() {
        let mut worst = 0f64;
        for i in -8700..8800 {
            let x = i as f32 / 100.0;
            let (got, exact) = (f64::from(exp(x)), f64::from(x).exp());
            worst = worst.max(((got - exact) / exact).abs());
        }
        assert!(worst < 2.5e-7, "{worst:e}");
        assert!(exp(-1e9) < 1e-37 && exp(1e9).is_finite() && exp(f32::NAN).is_nan());
    }

    #[test]
    fn a_rotation_undoes_itself() {
        let (heads, size, positions) = (2, 6, 5);
        let angles: Vec<f32> = (0..positions * size / 2).map(|i| i as f32 * 0.37).collect();
        let cos: Vec<f32> = angles.iter().map(|x| x.cos()).collect();
        let sin: Vec<f32> = angles.iter().map(|x| x.sin()).collect();
        let before: Vec<f32> = (0..2 * positions * 3 * heads * size).map(|i| (i as f32 * 0.7).sin()).collect();
        let mut x = before.clone();
        rotate(&mut x, heads, size, (&cos, &sin), 1.0);
        assert!(x.iter().zip(&before).any(|(a, b)| (a - b).abs() > 0.1));
        rotate(&mut x, heads, size, (&cos, &sin), -1.0);
        assert!(x.iter().zip(&before).all(|(a, b)| (a - b).abs() < 1e-5));
    }
}
