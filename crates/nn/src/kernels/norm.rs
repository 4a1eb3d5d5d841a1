//! Layer norm, optionally of a sum with a dropped-out branch.

use super::elementwise::{dot, drop_scale, sum};
use crate::layers::DropoutMask;
use crate::simd::vectorised;

/// As torch.
const EPS: f32 = 1e-5;

/// For each row `z = x + mask * branch` (without `branch`: `z = x`): `normed = (z - mean) / std`,
/// `out = normed * weight + bias`. `branch` becomes `normed`; `inverse` takes 1/std of each row.
/// `full_row(r)` is the number of row `r` in the tensor that the mask was drawn for.
#[allow(clippy::too_many_arguments, clippy::type_complexity)] // inputs, parameters, outputs
pub fn layer_norm(
    x: &[f32],
    branch: &mut [f32],
    mask: Option<(Option<DropoutMask>, &dyn Fn(usize) -> usize)>,
    weight: &[f32],
    bias: &[f32],
    out: &mut [f32],
    inverse: &mut [f32],
) {
    let width = weight.len();
    vectorised(
        #[inline(always)]
        || {
            let rows = branch.chunks_exact_mut(width).zip(out.chunks_exact_mut(width)).zip(inverse.iter_mut());
            for (r, (((z, out), inverse), x)) in rows.zip(x.chunks_exact(width).cycle()).enumerate() {
                match mask {
                    Some((mask, full_row)) => {
                        drop_scale(z, mask, full_row(r) * width);
                        z.iter_mut().zip(x).for_each(|(z, x)| *z += x);
                    }
                    None => z.copy_from_slice(x),
                }
                let mean = sum(z) / width as f32;
                z.iter_mut().for_each(|z| *z -= mean);
                *inverse = 1.0 / (dot(z, z) / width as f32 + EPS).sqrt();
                for (((z, out), w), b) in z.iter_mut().zip(out).zip(weight).zip(bias) {
                    *z *= *inverse;
                    *out = *z * w + b;
                }
            }
        },
    );
}

/// Turns the gradient of `out` into that of `z`, in place, and adds those of weight and bias.
pub fn layer_norm_backward(
    grad: &mut [f32],
    normed: &[f32],
    inverse: &[f32],
    weight: &[f32],
    weight_grad: &mut [f32],
    bias_grad: &mut [f32],
) {
    let width = weight.len();
    vectorised(
        #[inline(always)]
        || {
            let rows = grad.chunks_exact_mut(width).zip(normed.chunks_exact(width)).zip(inverse);
            for ((g, n), inverse) in rows {
                for ((((g, n), w), wg), bg) in
                    g.iter_mut().zip(n).zip(weight).zip(weight_grad.iter_mut()).zip(bias_grad.iter_mut())
                {
                    *wg += *g * n;
                    *bg += *g;
                    *g *= w;
                }
                let mean = sum(g) / width as f32;
                let along = dot(g, n) / width as f32;
                for (g, n) in g.iter_mut().zip(n) {
                    *g = (*g - mean - n * along) * inverse;
                }
            }
        },
    );
}
