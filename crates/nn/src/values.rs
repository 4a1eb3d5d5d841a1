//! Tensors as slices.

use crate::context::read;
use crate::error::Result;
use candle_core::{DType, Device, Tensor};

/// Calls `f` with the values of a tensor: without a copy where it is contiguous f32 on the CPU.
pub fn with_values<R>(tensor: &Tensor, f: impl FnOnce(&[f32]) -> R) -> Result<R> {
    let tensor = tensor.to_device(&Device::Cpu)?.to_dtype(DType::F32)?.contiguous()?;
    read("values", [&tensor], |[values]| Ok(f(values)))
}
