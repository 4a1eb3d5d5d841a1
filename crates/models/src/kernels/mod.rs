//! Arithmetic on plain slices, single-threaded: matrix products, layer norm, attention, activations.
//!
//! What candle's autograd would do in several passes with a new tensor each is done here in one, into buffers that are
//! reused. Every function with a backward pass is held against candle's composed operations by the tests of `fused`.

mod attention;
mod conv;
pub(crate) mod elementwise;
mod gemm;
mod image;
mod norm;
mod pool;
mod sequence;
mod winograd;

pub(crate) use attention::{Heads, attend, attend_backward};
pub(crate) use conv::{Conv, Frame};
pub(crate) use elementwise::{activate, activate_backward, add, column_sums, dot, drop_scale, exp};
pub(crate) use gemm::{Mat, Pack, Packed, Start, gemm, gemm_with, product};
pub(crate) use image::{
    Shortcut, group_norm, group_norm_backward, max_pool, max_pool_backward, relu_backward, scale_backward, scale_relu,
};
pub(crate) use norm::{layer_norm, layer_norm_backward};
pub(crate) use pool::Pool;
pub(crate) use sequence::{After, Film, add_bias, mish, mish_backward, mish_parts, norm_mish, norm_mish_backward};
pub(crate) use winograd::Winograd;
