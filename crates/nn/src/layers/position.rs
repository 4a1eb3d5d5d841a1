//! Fixed sinusoidal positions.

use crate::error::Result;
use candle_core::{Device, Tensor};

/// () -> (1, positions, dim): angle `pos / 10000^(2⌊i/2⌋/dim)`, sine on even and cosine on odd dimensions
/// (as LeRobot's `create_sinusoidal_pos_embedding`, computed in f64).
pub fn sinusoid_table(positions: usize, dim: usize, device: &Device) -> Result<Tensor> {
    let mut values = Vec::with_capacity(positions * dim);
    for pos in 0..positions {
        for i in 0..dim {
            let angle = pos as f64 / 10_000f64.powf((2 * (i / 2)) as f64 / dim as f64);
            values.push(if i % 2 == 0 { angle.sin() } else { angle.cos() } as f32);
        }
    }
    Ok(Tensor::from_vec(values, (1, positions, dim), device)?)
}
