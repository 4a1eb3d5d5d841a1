//! Activations, dropout and sums.

use crate::layers::{Activation, DropoutMask};
use crate::simd::vectorised;

/// `a += b`
pub fn add(a: &mut [f32], b: &[f32]) {
    vectorised(
        #[inline(always)]
        || a.iter_mut().zip(b).for_each(|(a, b)| *a += b),
    );
}

/// `out += ` the sum over the rows of `x`
pub fn column_sums(out: &mut [f32], x: &[f32]) {
    let width = out.len();
    vectorised(
        #[inline(always)]
        || {
            for row in x.chunks_exact(width) {
                out.iter_mut().zip(row).for_each(|(o, x)| *o += x);
            }
        },
    );
}

/// Multiplies element `i` with the mask at `first + i`.
#[inline(always)]
pub fn drop_scale(x: &mut [f32], mask: Option<DropoutMask>, first: usize) {
    if let Some(mask) = mask {
        let scale = mask.scale();
        for (i, x) in x.iter_mut().enumerate() {
            *x *= if mask.keeps((first + i) as u32) { scale } else { 0.0 };
        }
    }
}

/// Φ(x) and exp(-x²/2): the normal distribution function to 1.5e-7, in operations that vectorise (Abramowitz and Stegun 7.1.26).
#[inline(always)]
fn normal_cdf(x: f32) -> (f32, f32) {
    let density = exp(-0.5 * x * x);
    let t = 1.0 / (1.0 + 0.327_591_1 * std::f32::consts::FRAC_1_SQRT_2 * x.abs());
    let poly = 1.061_405_4f32;
    let poly = poly * t - 1.453_152;
    let poly = poly * t + 1.421_413_8;
    let poly = poly * t - 0.284_496_74;
    let poly = poly * t + 0.254_829_6;
    let tail = 0.5 * poly * t * density;
    (if x > 0.0 { 1.0 - tail } else { tail }, density)
}

/// The positive part. NaN stays NaN, and adding 0 makes -0 into 0.
#[inline(always)]
pub fn relu(x: f32) -> f32 {
    (if x < 0.0 { 0.0 } else { x }) + 0.0
}

/// Activation, then dropout, of a stretch of a row.
#[inline(always)]
pub fn activate(x: &mut [f32], activation: Activation, mask: Option<DropoutMask>, first: usize) {
    match activation {
        Activation::Relu => x.iter_mut().for_each(|x| *x = relu(*x)),
        Activation::Gelu => x.iter_mut().for_each(|x| *x *= normal_cdf(*x).0),
    }
    drop_scale(x, mask, first);
}

/// Turns the gradient after activation and dropout into that before; `before` is the input, or for ReLU the output.
#[inline(always)]
pub fn activate_backward(
    grad: &mut [f32],
    before: &[f32],
    activation: Activation,
    mask: Option<DropoutMask>,
    first: usize,
) {
    match activation {
        // kept and positive is what is positive after dropout: the mask need not be drawn again
        Activation::Relu => {
            let scale = mask.map_or(1.0, DropoutMask::scale);
            for (g, &y) in grad.iter_mut().zip(before) {
                *g = if y > 0.0 { *g * scale } else { 0.0 };
            }
        }
        Activation::Gelu => {
            drop_scale(grad, mask, first);
            for (g, &x) in grad.iter_mut().zip(before) {
                let (share, density) = normal_cdf(x);
                *g *= share + x * density * 0.398_942_3;
            }
        }
    }
}

/// exp(x) to 2 ulp, for x <= 0, in operations that vectorise (Cephes' polynomial). NaN stays NaN.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    const MAGIC: f32 = 12_582_912.0; // 1.5 * 2^23: adding it rounds to an integer in the low bits
    let x = if x < -87.0 { -87.0 } else { x };
    let shifted = x * std::f32::consts::LOG2_E + MAGIC;
    let n = shifted - MAGIC;
    let r = x - n * 0.693_359_4 + n * 2.121_944_4e-4;
    let poly = 1.987_569_1e-4f32;
    let poly = poly * r + 1.398_199_9e-3;
    let poly = poly * r + 8.333_452e-3;
    let poly = poly * r + 4.166_579_6e-2;
    let poly = poly * r + 1.666_666_5e-1;
    let poly = poly * r + 5e-1;
    let y = poly * r * r + r + 1.0;
    y * f32::from_bits((shifted.to_bits() << 23).wrapping_add(127 << 23))
}

/// From one exponential that cannot overflow.
#[inline(always)]
pub fn sigmoid(x: f32) -> f32 {
    let w = exp(-x.abs());
    if x < 0.0 { w / (1.0 + w) } else { 1.0 / (1.0 + w) }
}

/// Likewise.
#[inline(always)]
pub fn tanh(x: f32) -> f32 {
    let w = exp(-2.0 * x.abs());
    let t = (1.0 - w) / (1.0 + w);
    if x < 0.0 { -t } else { t }
}

/// The sum in a fixed order that vectorises.
#[inline(always)]
pub fn sum(x: &[f32]) -> f32 {
    let mut lanes = [0f32; 16];
    let groups = x.chunks_exact(16);
    let rest: f32 = groups.remainder().iter().sum();
    for group in groups {
        for (lane, x) in lanes.iter_mut().zip(group) {
            *lane += x;
        }
    }
    lanes.iter().sum::<f32>() + rest
}

/// The scalar product in a fixed order that vectorises.
#[inline(always)]
pub fn dot(x: &[f32], y: &[f32]) -> f32 {
    let mut lanes = [0f32; 16];
    let (xs, ys) = (x.chunks_exact(16), y.chunks_exact(16));
    let rest: f32 = xs.remainder().iter().zip(ys.remainder()).map(|(a, b)| a * b).sum();
    for (x, y) in xs.zip(ys) {
        for ((lane, x), y) in lanes.iter_mut().zip(x).zip(y) {
            *lane += x * y;
        }
    }
    lanes.iter().sum::<f32>() + rest
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_normal_distribution_function_is_exact_to_a_few_parts_in_ten_million() {
        for i in -9_000..=9_000 {
            let x = i as f32 * 1e-3;
            let want = 0.5 * (1.0 + candle_core::cpu::erf::erf_f64(f64::from(x) * std::f64::consts::FRAC_1_SQRT_2));
            let got = f64::from(normal_cdf(x).0);
            assert!((got - want).abs() < 3e-7, "{x}: {got} {want}");
        }
    }

    #[test]
    fn exp_is_exact_to_a_few_ulp() {
        for i in 0..87_000 {
            let x = -(i as f32) * 1e-3;
            let (got, want) = (f64::from(exp(x)), f64::from(x).exp());
            assert!((got - want).abs() <= 3e-7 * want, "{x}: {got} {want}");
        }
        assert!(exp(-1e30) < 1e-37);
    }

    #[test]
    fn nan_is_not_swallowed() {
        assert!([exp, relu, sigmoid, tanh].iter().all(|of| of(f32::NAN).is_nan()));
        assert_eq!([relu(-1.0), relu(-0.0), relu(2.0)].map(f32::to_bits), [0.0, 0.0, 2.0_f32].map(f32::to_bits));
    }
}
