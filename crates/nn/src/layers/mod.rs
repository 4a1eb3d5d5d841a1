//! Layers shared by the models. The Rust field is the checkpoint key.
//!
//! Everything here has a gradient: candle-nn's `LayerNorm` and `softmax_last_dim` drop it silently and are not used.

mod attention;
mod conv1d;
mod dropout;
mod embedding;
mod feed_forward;
mod group_norm;
mod layer_norm;
mod linear;
mod mish;
mod mixture;
mod position;
mod recurrent;
mod resnet;
mod spatial_softmax;
mod transformer;

pub(crate) use attention::UNSEEN;
pub use attention::{MultiHeadAttention, masked_softmax};
pub use conv1d::{Conv1d, Upsample1d};
pub use dropout::DropoutMask;
pub use embedding::Embedding;
pub use feed_forward::{Activation, FeedForward};
pub use group_norm::GroupNorm;
pub use layer_norm::LayerNorm;
pub use linear::Linear;
pub use mish::mish;
pub use mixture::{Mixture, MixtureHead, MixtureParts};
pub use position::sinusoid_table;
pub use recurrent::{Cell, Recurrent, RecurrentState};
#[doc(hidden)]
pub use resnet::CONV_NORM_EPS;
pub(crate) use resnet::conv2d_composed;
pub use resnet::{ImageNorm, ResNet, ResNetShape};
pub use spatial_softmax::SpatialSoftmax;
#[doc(hidden)]
pub use spatial_softmax::cell_places;
pub use transformer::{Decoder, DecoderLayer, Encoder, EncoderLayer, LayerInit, Shape};
