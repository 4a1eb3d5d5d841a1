//! The operations of a forward pass. On the CPU each runs a hand-written kernel and records its backward pass on the tape.
//! On other devices, and where a pass asks for it, it is a composition of candle's operations under the same name.

mod attention;
mod conv1d;
mod conv2d;
mod elementwise;
mod feed_forward;
mod grid;
mod latent;
mod linear;
mod losses;
mod mixture;
mod norm;
mod recurrent;
mod tokens;

pub use attention::{Attention, attention, self_attention};
pub use conv1d::{Then, conv1d, conv1d_mish, upsample1d};
pub use conv2d::{ConvNorm, conv2d, max_pool, spatial_softmax};
pub use elementwise::{activation, add, alias, cat_rows, detached_mean, dropout, mish};
pub use feed_forward::feed_forward;
pub use grid::grid_convolution;
pub use latent::{kl_divergence, sample_latent};
pub use linear::{linear, linear_rows};
pub use losses::{Error, RowErrors, chunk_error, term_of};
pub use mixture::mixture_likelihood;
pub use norm::{layer_norm, residual};
pub use recurrent::{gru, lstm};
pub use tokens::{cat_tokens, narrow_tokens, select_tokens, weighted_mean};

use crate::error::{ModelError, Result};
use crate::value::Value;
use candle_core::Tensor;

/// The sizes of a tensor of `N` dimensions.
fn sizes<const N: usize>(operation: &'static str, x: &Tensor) -> Result<[usize; N]> {
    let Ok(sizes) = x.dims().try_into() else {
        let (found, expected) = (format!("of shape {:?}", x.dims()), format!("of {N} dimensions"));
        return Err(ModelError::Input { operation, object: "input", found, expected });
    };
    Ok(sizes)
}

fn check_width(operation: &'static str, x: &Value, width: usize) -> Result<()> {
    if x.width() == width {
        return Ok(());
    }
    let mut expected = x.dims().to_vec();
    if let Some(last) = expected.last_mut() {
        *last = width;
    }
    Err(ModelError::Shape { operation, object: "input", expected, found: x.dims().to_vec() })
}

/// x: (b or 1, t, D) beside (b, t, D)
fn check_broadcast(operation: &'static str, x: &Value, whole: &Value) -> Result<()> {
    let fits = x.dims() == whole.dims() || x.dims().first() == Some(&1) && x.dims()[1..] == whole.dims()[1..];
    if fits {
        return Ok(());
    }
    let (expected, found) = (whole.dims().to_vec(), x.dims().to_vec());
    Err(ModelError::Shape { operation, object: "input", expected, found })
}

fn check_shape(operation: &'static str, object: &'static str, tensor: &Tensor, expected: &[usize]) -> Result<()> {
    if tensor.dims() == expected {
        return Ok(());
    }
    let (expected, found) = (expected.to_vec(), tensor.dims().to_vec());
    Err(ModelError::Shape { operation, object, expected, found })
}

#[cfg(test)]
mod tests;
