//! What losses are made of.

use crate::error::Result;
use candle_core::{DType, Tensor};

/// |x| whose gradient at 0 is 0, as torch's; candle's own is 1 there.
pub fn absolute(x: &Tensor) -> Result<Tensor> {
    let sign = (x.gt(0.0)?.to_dtype(DType::F32)? - x.lt(0.0)?.to_dtype(DType::F32)?)?;
    Ok(x.mul(&sign.detach())?)
}
