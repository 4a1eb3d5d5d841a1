//! Mish, `x tanh(ln(1 + exp(x)))` (Misra, arXiv 1908.08681), with its derivative.

use crate::error::Result;
use crate::kernels::mish_parts;
use crate::simd::vectorised;
use crate::values::with_values;
use candle_core::{CpuStorage, CustomOp1, Layout, Result as CandleResult, Shape, Tensor};

/// x: any shape -> the same
pub fn mish(x: &Tensor) -> Result<Tensor> {
    Ok(x.contiguous()?.apply_op1(Mish)?)
}

struct Mish;

impl CustomOp1 for Mish {
    fn name(&self) -> &'static str {
        "mish"
    }

    fn cpu_fwd(&self, storage: &CpuStorage, layout: &Layout) -> CandleResult<(CpuStorage, Shape)> {
        let Some((from, to)) = layout.contiguous_offsets() else {
            candle_core::bail!("mish: the input is not contiguous");
        };
        let mut out = storage.as_slice::<f32>()?[from..to].to_vec();
        vectorised(
            #[inline(always)]
            || out.iter_mut().for_each(|x| *x *= mish_parts(*x).0),
        );
        Ok((CpuStorage::F32(out), layout.shape().clone()))
    }

    fn bwd(&self, arg: &Tensor, _: &Tensor, grad: &Tensor) -> CandleResult<Option<Tensor>> {
        let mut out = grad.flatten_all()?.to_vec1::<f32>()?;
        let slope = |x: &[f32]| {
            vectorised(
                #[inline(always)]
                || {
                    for (g, &x) in out.iter_mut().zip(x) {
                        let (t, sigmoid) = mish_parts(x);
                        *g *= t + x * (1.0 - t * t) * sigmoid;
                    }
                },
            );
        };
        with_values(arg, slope).map_err(candle_core::Error::wrap)?;
        Ok(Some(Tensor::from_vec(out, arg.shape(), arg.device())?))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use candle_core::{Device, Var};

    #[test]
    fn values_and_slopes_are_those_of_the_definition() {
        let xs: Vec<f32> = (-400..=400).map(|i| i as f32 * 0.05).chain([-90.0, 90.0]).collect();
        let exact = |x: f64| x * (x.exp().ln_1p()).tanh();
        let var = Var::from_vec(xs.clone(), xs.len(), &Device::Cpu).unwrap();
        let y = mish(var.as_tensor()).unwrap();
        let slopes = y.sum_all().unwrap().backward().unwrap().get(&var).unwrap().to_vec1::<f32>().unwrap();
        for ((&x, y), slope) in xs.iter().zip(y.to_vec1::<f32>().unwrap()).zip(slopes) {
            let x = f64::from(x);
            assert!((f64::from(y) - exact(x)).abs() < 2e-6 * x.abs().max(1.0), "{x}: {y} {}", exact(x));
            let h = 1e-5;
            let want = if x.abs() > 80.0 { f64::from(x > 0.0) } else { (exact(x + h) - exact(x - h)) / (2.0 * h) };
            assert!((f64::from(slope) - want).abs() < 2e-6, "{x}: {slope} {want}");
        }
    }
}
