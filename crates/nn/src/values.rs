//! Tensors as slices.

use crate::error::{ModelError, Result};
use candle_core::{DType, Tensor};

/// Calls `f` with the values of a contiguous f32 tensor, without a copy.
pub fn with_values<R>(tensor: &Tensor, f: impl FnOnce(&[f32]) -> R) -> Result<R> {
    let tensor = tensor.to_dtype(DType::F32)?.contiguous()?;
    let (storage, layout) = tensor.storage_and_layout();
    let candle_core::Storage::Cpu(storage) = &*storage else {
        let found = "on another device".to_string();
        return Err(ModelError::Input {
            operation: "read",
            object: "tensor",
            found,
            expected: "on the CPU".to_string(),
        });
    };
    let values = storage.as_slice::<f32>()?;
    let from = layout.start_offset();
    Ok(f(&values[from..from + layout.shape().elem_count()]))
}
