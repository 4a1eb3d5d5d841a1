//! Neural networks on a CPU and on candle: layers, the operations that they are stated in, the tape of a training step,
//! parameters, gradients, optimisers.
//!
//! A model is stated once. Its forward pass runs in a [`Context`] on [`Value`]s: on the CPU every operation of [`ops`] runs a
//! kernel written by hand, forwards and backwards; elsewhere, and in tests, the same operation is a composition of candle's.
//!
//! This crate knows tensors and numbers only. It opens no file, starts no process and prints nothing.

mod backend;
mod composed;
mod context;
mod device;
mod error;
mod gradients;
#[doc(hidden)]
pub mod kernels;
pub mod layers;
mod loss;
#[doc(hidden)]
pub mod losses;
mod number;
pub mod ops;
mod optim;
mod params;
mod per_parameter;
mod precision;
mod rng;
#[doc(hidden)]
pub mod simd;
mod size;
mod tape;
mod value;
#[doc(hidden)]
pub mod values;

pub use backend::Backend;
pub use context::{Cache, Context, Workspace, compose};
pub use device::{DeviceChoice, Opened};
pub use error::{ModelError, Result, some_names};
pub use gradients::{Gradients, ParamLayout};
pub use loss::{Loss, LossNumbers, LossParts, LossValues, Term};
pub use number::Number;
pub use optim::{Optimiser, OptimiserConfig};
pub use params::{Init, Params};
pub use per_parameter::PerParameter;
pub use precision::Precision;
pub use rng::Rng;
pub use simd::vectors;
pub use size::Size;
pub use value::Value;
