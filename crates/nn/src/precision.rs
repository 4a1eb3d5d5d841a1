//! In which precision a GPU multiplies.

use crate::error::Result;
use candle_core::{DType, Tensor};
use serde::{Deserialize, Serialize};

/// Precision of matrix products and convolutions on a GPU. Weights, sums and everything else are f32.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Precision {
    /// f32
    #[default]
    F32,
    /// f32 numbers rounded to 10 bits of mantissa, as PyTorch's `allow_tf32`
    Tf32,
    /// bfloat16, as PyTorch's `autocast`
    Bf16,
}

impl Precision {
    /// Rounded to it, if it is another type.
    pub(crate) fn cast(self, x: &Tensor) -> Result<Tensor> {
        Ok(match self {
            Self::F32 | Self::Tf32 => x.clone(),
            Self::Bf16 => x.to_dtype(DType::BF16)?,
        })
    }
}
