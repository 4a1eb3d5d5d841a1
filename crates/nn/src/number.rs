//! Numbers that a device may still be computing.

use crate::error::Result;
use candle_core::{DType, Device, Tensor};

/// A number. Reading it waits for the device that computes it.
#[derive(Debug, Clone)]
pub enum Number {
    /// known
    Here(f64),
    /// a scalar tensor
    There(Tensor),
}

impl Number {
    /// Its value.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn read(&self) -> Result<f64> {
        match self {
            Self::Here(value) => Ok(*value),
            Self::There(tensor) => Ok(f64::from(tensor.to_dtype(DType::F32)?.to_scalar::<f32>()?)),
        }
    }

    /// As a scalar tensor, f32.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn tensor(&self, device: &Device) -> Result<Tensor> {
        match self {
            Self::Here(value) => Ok(Tensor::new(*value as f32, device)?),
            Self::There(tensor) => Ok(tensor.clone()),
        }
    }

    /// The sum, in f32.
    pub(crate) fn plus(&self, other: &Self) -> Result<Self> {
        Ok(match (self, other) {
            (Self::Here(a), Self::Here(b)) => Self::Here(f64::from(*a as f32 + *b as f32)),
            (Self::There(a), Self::There(b)) => Self::There((a + b)?),
            (Self::Here(here), Self::There(there)) | (Self::There(there), Self::Here(here)) => {
                Self::There((there + *here)?)
            }
        })
    }
}

impl From<f32> for Number {
    fn from(value: f32) -> Self {
        Self::Here(f64::from(value))
    }
}
