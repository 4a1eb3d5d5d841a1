//! What stands between convolutions: GroupNorm or a fixed scale, ReLU, sums, maximum over windows. Images lie pixel after
//! pixel; convolutions read them from frames of zeros and write them without.

use super::conv::Frame;
use super::elementwise::relu;
use crate::simd::vectorised;

/// Added to variances, torch's.
const EPS: f64 = 1e-5;

/// y: (n, pixels, C), made to have mean 0 and variance 1 in every group of channels of every image; `inverse` takes
/// 1/std, (n, groups).
pub fn group_norm(y: &mut [f32], frame: &Frame, groups: usize, inverse: &mut [f32]) {
    let (c, pixels) = (frame.channels, frame.height * frame.width);
    let each = c / groups;
    let count = (pixels * each) as f64;
    let mut sums = vec![0f32; c];
    vectorised(
        #[inline(always)]
        || {
            for (image, inverse) in y.chunks_exact_mut(pixels * c).zip(inverse.chunks_exact_mut(groups)) {
                let spread = |sums: &mut [f32], of: &mut dyn FnMut(f64) -> f32| {
                    for group in sums.chunks_exact_mut(each) {
                        let value = of(group.iter().map(|&x| f64::from(x)).sum::<f64>() / count);
                        group.fill(value);
                    }
                };
                channel_sums(image, &mut sums, |x, _| x);
                spread(&mut sums, &mut |mean| mean as f32);
                for pixel in image.chunks_exact_mut(c) {
                    pixel.iter_mut().zip(&sums).for_each(|(x, mean)| *x -= mean);
                }
                channel_sums(image, &mut sums, |x, _| x * x);
                let mut at = inverse.iter_mut();
                spread(&mut sums, &mut |variance| {
                    let value = (1.0 / (variance + EPS).sqrt()) as f32;
                    if let Some(at) = at.next() {
                        *at = value;
                    }
                    value
                });
                for pixel in image.chunks_exact_mut(c) {
                    pixel.iter_mut().zip(&sums).for_each(|(x, inverse)| *x *= inverse);
                }
            }
        },
    );
}

/// Sums of `of(x, channel)` over the pixels of an image, a channel, in a fixed order.
#[inline(always)]
fn channel_sums(image: &[f32], sums: &mut [f32], of: impl Fn(f32, usize) -> f32) {
    sums.fill(0.0);
    let c = sums.len();
    if c == 16 {
        // the narrowest layers have the most pixels: sums that stay in a register
        let mut few = [0f32; 16];
        for pixel in image.chunks_exact(16) {
            for i in 0..16 {
                few[i] += of(pixel[i], i);
            }
        }
        sums.copy_from_slice(&few);
        return;
    }
    for pixel in image.chunks_exact(c) {
        for (i, (sum, &x)) in sums.iter_mut().zip(pixel).enumerate() {
            *sum += of(x, i);
        }
    }
}

/// `out = relu(y * scale + shift + shortcut)` into a frame, whose border is not touched; the shortcut is in the same frame.
pub fn scale_relu(y: &[f32], scale: &[f32], shift: &[f32], shortcut: Option<&[f32]>, frame: &Frame, out: &mut [f32]) {
    let row = frame.width * frame.channels;
    let c = frame.channels;
    vectorised(
        #[inline(always)]
        || {
            for (r, y) in y.chunks_exact(row).enumerate() {
                let at = frame.at(r / frame.height, r % frame.height);
                let out = &mut out[at..at + row];
                for (out, y) in out.chunks_exact_mut(c).zip(y.chunks_exact(c)) {
                    for (((out, y), scale), shift) in out.iter_mut().zip(y).zip(scale).zip(shift) {
                        *out = y * scale + shift;
                    }
                }
                if let Some(x) = shortcut {
                    out.iter_mut().zip(&x[at..at + row]).for_each(|(out, x)| *out += x);
                }
                out.iter_mut().for_each(|x| *x = relu(*x));
            }
        },
    );
}

/// Sets the gradient, (n, pixels, C), to 0 where the framed output is 0.
pub fn relu_backward(grad: &mut [f32], frame: &Frame, out: &[f32]) {
    let row = frame.width * frame.channels;
    vectorised(
        #[inline(always)]
        || {
            for (r, grad) in grad.chunks_exact_mut(row).enumerate() {
                let at = frame.at(r / frame.height, r % frame.height);
                for (g, &x) in grad.iter_mut().zip(&out[at..at + row]) {
                    *g = if x > 0.0 { *g } else { 0.0 };
                }
            }
        },
    );
}

/// The gradient of a GroupNorm's input from that of its output, (n, pixels, C), into a frame; adds those of weight and bias.
#[allow(clippy::too_many_arguments)] // inputs, parameters, outputs
pub fn group_norm_backward(
    grad: &[f32],
    normed: &[f32],
    inverse: &[f32],
    weight: &[f32],
    frame: &Frame,
    weight_grad: &mut [f32],
    bias_grad: &mut [f32],
    out: &mut [f32],
) {
    let (c, pixels, row) = (frame.channels, frame.height * frame.width, frame.width * frame.channels);
    let groups = inverse.len() / frame.images;
    let each = c / groups;
    let count = (pixels * each) as f64;
    // sums of the gradient and of gradient times normed, then what is subtracted
    let (mut plain, mut along, mut factor) = (vec![0f32; c], vec![0f32; c], vec![0f32; c]);
    vectorised(
        #[inline(always)]
        || {
            for n in 0..frame.images {
                let part = n * pixels * c..(n + 1) * pixels * c;
                let (grad, normed) = (&grad[part.clone()], &normed[part]);
                channel_sums(grad, &mut plain, |x, _| x);
                pair_sums(grad, normed, &mut along);
                for i in 0..c {
                    weight_grad[i] += along[i];
                    bias_grad[i] += plain[i];
                }
                for g in 0..groups {
                    let span = g * each..(g + 1) * each;
                    let mean = |sums: &[f32]| {
                        let weighted = sums[span.clone()].iter().zip(&weight[span.clone()]);
                        weighted.map(|(&s, &w)| f64::from(s) * f64::from(w)).sum::<f64>() / count
                    };
                    let (first, second) = (mean(&plain), mean(&along));
                    let inverse = inverse[n * groups + g];
                    for i in span {
                        factor[i] = weight[i] * inverse;
                        plain[i] = first as f32 * inverse;
                        along[i] = second as f32 * inverse;
                    }
                }
                for y in 0..frame.height {
                    let at = frame.at(n, y);
                    let lines = out[at..at + row].chunks_exact_mut(c);
                    let here = y * row..(y + 1) * row;
                    let pairs = grad[here.clone()].chunks_exact(c).zip(normed[here].chunks_exact(c));
                    for (out, (grad, normed)) in lines.zip(pairs) {
                        for i in 0..c {
                            out[i] = grad[i] * factor[i] - plain[i] - normed[i] * along[i];
                        }
                    }
                }
            }
        },
    );
}

#[inline(always)]
fn pair_sums(x: &[f32], y: &[f32], sums: &mut [f32]) {
    sums.fill(0.0);
    let c = sums.len();
    if c == 16 {
        let mut few = [0f32; 16];
        for (x, y) in x.chunks_exact(16).zip(y.chunks_exact(16)) {
            for i in 0..16 {
                few[i] += x[i] * y[i];
            }
        }
        sums.copy_from_slice(&few);
        return;
    }
    for (x, y) in x.chunks_exact(c).zip(y.chunks_exact(c)) {
        for ((sum, x), y) in sums.iter_mut().zip(x).zip(y) {
            *sum += x * y;
        }
    }
}

/// `out = grad * scale` into a frame.
pub fn scale_backward(grad: &[f32], scale: &[f32], frame: &Frame, out: &mut [f32]) {
    let (c, row) = (frame.channels, frame.width * frame.channels);
    vectorised(
        #[inline(always)]
        || {
            for (r, grad) in grad.chunks_exact(row).enumerate() {
                let at = frame.at(r / frame.height, r % frame.height);
                for (out, grad) in out[at..at + row].chunks_exact_mut(c).zip(grad.chunks_exact(c)) {
                    for ((out, grad), scale) in out.iter_mut().zip(grad).zip(scale) {
                        *out = grad * scale;
                    }
                }
            }
        },
    );
}

/// The largest of 3x3 numbers, every second pixel, of numbers that are not negative: x in a frame with a border, `out` in
/// another. `winner` takes which of the nine it was, the first of several equal ones: (n, pixels, C).
pub fn max_pool(x: &[f32], from: &Frame, to: &Frame, out: &mut [f32], winner: &mut [f32]) {
    let c = from.channels;
    vectorised(
        #[inline(always)]
        || {
            for (r, winners) in winner.chunks_exact_mut(to.width * c).enumerate() {
                let (n, y) = (r / to.height, r % to.height);
                let at = to.at(n, y);
                // the frame's border takes part: zeros lose against every positive number
                let first = n * from.image() + (2 * y + from.border.0 - 1) * from.row() + (from.border.1 - 1) * c;
                let lines = out[at..at + to.width * c].chunks_exact_mut(c).zip(winners.chunks_exact_mut(c));
                for (column, (out, winner)) in lines.enumerate() {
                    for tap in 0..9 {
                        let from = first + tap / 3 * from.row() + (2 * column + tap % 3) * c;
                        let x = &x[from..from + c];
                        if tap == 0 {
                            out.copy_from_slice(x);
                            winner.fill(0.0);
                            continue;
                        }
                        let tap = tap as f32;
                        for ((out, winner), &x) in out.iter_mut().zip(winner.iter_mut()).zip(x) {
                            let better = x > *out;
                            *winner = if better { tap } else { *winner };
                            *out = if better { x } else { *out };
                        }
                    }
                }
            }
        },
    );
}

/// The gradient of `max_pool`'s input, (n, pixels, C), from that of its output, (n, pixels, C).
pub fn max_pool_backward(grad: &[f32], winner: &[f32], from: &Frame, to: &Frame, out: &mut [f32]) {
    let c = from.channels;
    out.fill(0.0);
    vectorised(
        #[inline(always)]
        || {
            let rows = grad.chunks_exact(to.width * c).zip(winner.chunks_exact(to.width * c));
            for (r, (grad, winner)) in rows.enumerate() {
                let (n, y) = (r / to.height, r % to.height);
                let pixels = grad.chunks_exact(c).zip(winner.chunks_exact(c));
                for (column, (grad, winner)) in pixels.enumerate() {
                    for tap in 0..9 {
                        let (row, line) = (2 * y + tap / 3, 2 * column + tap % 3);
                        // the border takes no gradient
                        if row == 0 || line == 0 || row > from.height || line > from.width {
                            continue;
                        }
                        let at = ((n * from.height + row - 1) * from.width + line - 1) * c;
                        let tap = tap as f32;
                        for ((out, &grad), &winner) in out[at..at + c].iter_mut().zip(grad).zip(winner) {
                            *out += if winner == tap { grad } else { 0.0 };
                        }
                    }
                }
            }
        },
    );
}
