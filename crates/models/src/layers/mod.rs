//! Layers that know what observations and batches are, beside those of [`nn::layers`].

mod auxiliary;
mod grid;
mod image_features;
mod pointer;
mod steps;
mod tokens;
mod vae;

pub use auxiliary::AuxiliaryConfig;
pub(crate) use auxiliary::{AUXILIARY_HEAD, Auxiliary};
pub use grid::GridConfig;
pub(crate) use grid::{Cells, GridLayer, NEIGHBOURS};
pub(crate) use image_features::ImageFeatures;
pub use nn::layers::*;
pub use pointer::PointerConfig;
pub(crate) use pointer::{Pointer, Question, ask};
pub(crate) use steps::Steps;
pub(crate) use tokens::{Cameras, InputTokens, TokenLayout, environment_state};
pub(crate) use vae::Vae;
