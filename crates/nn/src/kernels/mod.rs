//! Arithmetic on plain slices, single-threaded: matrix products, layer norm, attention, activations.
//!
//! What candle's autograd would do in several passes with a new tensor each is done here in one, into buffers that are
//! reused. Every function with a backward pass is compared with candle's composed operations by the tests of `ops`.

mod attention;
mod conv;
pub mod elementwise;
mod gemm;
mod image;
mod pool;
mod residual;
mod sequence;
mod winograd;

pub use attention::{Heads, attend, attend_backward};
pub use conv::{Conv, Frame};
pub use elementwise::{activate, activate_backward, add, column_sums, dot, drop_scale, exp};
pub use gemm::{Mat, Pack, Packed, Start, gemm, gemm_with, product};
pub use image::{
    group_norm, group_norm_backward, max_pool, max_pool_backward, relu_backward, scale_backward, scale_relu,
};
pub use pool::Pool;
pub use residual::{Rows, Summed, dropped, sum_over_sequences};
pub use sequence::{After, Film, add_bias, mish, mish_backward, mish_parts, norm_mish, norm_mish_backward};
pub use winograd::Winograd;
