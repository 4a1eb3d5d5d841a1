//! Dropout whose mask is a pure function of a drawn key and the element's index.
//!
//! Nothing is stored: the backward pass computes the same mask again, and any slice of a tensor can be masked alone.

use crate::error::Result;
use crate::rng::Rng;
use candle_core::{DType, Device, Tensor};

/// One drawn mask.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DropoutMask {
    key: u64,
    threshold: u32,
}

impl DropoutMask {
    /// Draws the key of a mask that drops elements with probability `p` in [0, 1).
    pub fn draw(p: f64, rng: &mut Rng) -> Self {
        Self { key: rng.next_u64(), threshold: (p * f64::from(u32::MAX)) as u32 }
    }

    /// Whether element `index` of the tensor survives. Two rounds of a 32-bit integer hash with half a key each.
    #[inline(always)]
    pub fn keeps(self, index: u32) -> bool {
        let mut x = index ^ self.key as u32;
        x = (x ^ (x >> 16)).wrapping_mul(0x7feb_352d);
        x = (x ^ (x >> 15)).wrapping_mul(0x846c_a68b) ^ (self.key >> 32) as u32;
        x = (x ^ (x >> 16)).wrapping_mul(0x2c1b_3c6d);
        (x ^ (x >> 15)) >= self.threshold
    }

    /// What a surviving element is multiplied with.
    #[inline(always)]
    pub fn scale(self) -> f32 {
        1.0 / (1.0 - self.threshold as f32 / u32::MAX as f32)
    }

    /// The mask of a whole tensor: 0 or `scale()`. A device other than the CPU draws its own.
    pub fn tensor(self, shape: &[usize], device: &Device) -> Result<Tensor> {
        let scale = self.scale();
        if !device.is_cpu() {
            let dropped = f64::from(self.threshold) / f64::from(u32::MAX);
            let kept = Tensor::rand(0f32, 1f32, shape, device)?.ge(dropped)?;
            return Ok((kept.to_dtype(DType::F32)? * f64::from(scale))?);
        }
        let values: Vec<f32> =
            (0..shape.iter().product::<usize>()).map(|i| if self.keeps(i as u32) { scale } else { 0.0 }).collect();
        Ok(Tensor::from_vec(values, shape, device)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn masks_drop_the_asked_share_and_differ_by_key() {
        let mut rng = Rng::new(5, "dropout");
        let (a, b) = (DropoutMask::draw(0.1, &mut rng), DropoutMask::draw(0.1, &mut rng));
        let n = 200_000u32;
        let count = |f: &dyn Fn(u32) -> bool| (0..n).filter(|&i| f(i)).count() as f64 / f64::from(n);
        assert!((count(&|i| !a.keeps(i)) - 0.1).abs() < 0.003);
        // independent masks: both drop 1% of the elements; neighbours are independent too
        assert!((count(&|i| !a.keeps(i) && !b.keeps(i)) - 0.01).abs() < 0.001);
        assert!((count(&|i| !a.keeps(i) && !a.keeps(i + 1)) - 0.01).abs() < 0.001);
        assert!((a.scale() - 1.0 / 0.9).abs() < 1e-6);
    }
}
