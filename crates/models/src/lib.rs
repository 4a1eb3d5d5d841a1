//! Models of actrm: what a policy is, the layers, ACT and its relatives, their losses, the optimisers and the training
//! step, on candle and on plain slices.
//!
//! This crate knows tensors and numbers only. It opens no file, starts no process and prints nothing: data comes in as
//! slices (`Batch`), weights come in and go out as named tensors (`Params`), progress is returned as numbers. All
//! randomness is drawn from `Rng`.

mod batch;
#[doc(hidden)]
pub mod cases;
mod checks;
mod chunk_policy;
pub mod classification;
pub mod encoders;
mod features;
mod flops;
mod history;
pub mod layers;
pub mod lerobot;
mod model;
mod models;
mod normaliser;
mod policy;
mod preprocess;
mod registry;
pub mod robomimic;
#[cfg(test)]
mod size;
#[cfg(test)]
mod testing;
mod train;

pub use batch::{Batch, Taken};
pub use chunk_policy::ChunkPolicy;
pub use features::{ENTITY_PREFIX, FeatureKind, FeatureSpec, Features, Observation, Signature, Values, ValuesRef};
pub use history::History;
pub use model::{Memory, PolicyModel};
pub use models::*;
pub use nn::{
    Backend, Context, DeviceChoice, Gradients, Init, Loss, LossNumbers, LossParts, LossValues, ModelError, Number,
    Optimiser, OptimiserConfig, ParamLayout, Params, Precision, Result, Rng, Size, Value, vectors,
};
pub use normaliser::{ACTION, ENVIRONMENT_STATE, Guarded, NormMode, Normaliser, STATE};
pub use policy::{ActionChunk, Actor, Clock, Policy, RecedingHorizon, TemporalEnsemble, ThoughtStep};
pub use preprocess::Preprocess;
pub use registry::{PolicyConfig, PolicyType};
pub use train::{Learner, LearnerMetrics, Schedule, StepMetrics, StepNumbers, TrainConfig, Trainer, TrainerState};
