//! Layers shared by the models. The Rust field is the checkpoint key.
//!
//! Everything here has a gradient: candle-nn's `LayerNorm` and `softmax_last_dim` drop it in silence and are not used.

mod attention;
mod auxiliary;
mod conv1d;
mod dropout;
mod embedding;
mod feed_forward;
mod grid;
mod group_norm;
mod gru;
mod layer_norm;
mod linear;
mod lstm;
mod mish;
mod mixture;
mod pointer;
mod position;
mod recurrent;
mod sight;
mod steps;
mod tokens;
mod transformer;
mod vae;

pub use attention::{MultiHeadAttention, masked_softmax};
pub use auxiliary::AuxiliaryConfig;
pub(crate) use auxiliary::{AUXILIARY_HEAD, Auxiliary, Told};
pub use conv1d::{Conv1d, Upsample1d};
pub use dropout::{Dropout, DropoutMask, Mode};
pub use embedding::Embedding;
pub use feed_forward::{Activation, FeedForward};
pub use grid::GridConfig;
pub(crate) use grid::{Cells, Grid, GridLayer, NEIGHBOURS, Visited, WAY};
pub use group_norm::GroupNorm;
pub use gru::Gru;
pub use layer_norm::LayerNorm;
pub use linear::Linear;
pub use lstm::Lstm;
pub(crate) use lstm::{sigmoid, tanh};
pub use mish::mish;
pub use mixture::{Mixture, MixtureHead};
pub use pointer::PointerConfig;
pub(crate) use pointer::{Answers, Asked, Pointed, Pointer};
pub use position::sinusoid_table;
pub use recurrent::{Cell, Recurrent, RecurrentState};
pub(crate) use sight::Sight;
pub(crate) use steps::Steps;
pub(crate) use tokens::{
    Cameras, ENTITY_POSITIONS, FEATURE_POSITIONS, InputTokens, LATENT, Position, TokenLayout, environment_state,
};
pub(crate) use transformer::{Decoder, DecoderLayer, Encoder, EncoderLayer, LayerInit, Shape};
pub(crate) use vae::{Vae, kl_divergence, sample};
