//! Mish, `x tanh(ln(1 + exp(x)))` (Misra, arXiv 1908.08681).

use crate::error::Result;
use candle_core::Tensor;

/// x: any shape -> the same
pub fn mish(x: &Tensor) -> Result<Tensor> {
    // with u = exp(x) the tangent is 1 - 2 / (u² + 2u + 2), and 1 from 15 on
    let u = x.minimum(15.0)?.exp()?;
    let under = (u.mul(&(&u + 2.0)?)? + 2.0)?;
    Ok(x.mul(&(1.0 - (under.recip()? * 2.0)?)?)?)
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
