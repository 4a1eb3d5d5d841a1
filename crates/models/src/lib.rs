//! Models of actrm: what a policy is, the layers, ACT and its relatives, their losses, the optimisers and the training
//! step, on candle and on plain slices.
//!
//! This crate knows tensors and numbers only. It opens no file, starts no process and prints nothing: data comes in as
//! slices (`Batch`), weights come in and go out as named tensors (`Params`), progress is returned as numbers. All
//! randomness is drawn from `Rng`.

pub mod baselines;
mod batch;
mod checks;
mod chunk_policy;
pub mod classification;
mod device;
pub mod encoders;
mod error;
mod features;
mod flops;
mod fused;
mod gradients;
mod history;
mod kernels;
pub mod layers;
pub mod lerobot;
mod losses;
mod model;
mod models;
mod normaliser;
mod optim;
mod params;
mod policy;
mod preprocess;
mod registry;
pub mod rl;
mod rng;
pub mod robomimic;
mod simd;
mod size;
mod train;
mod values;

pub use batch::{Batch, Taken};
pub use chunk_policy::ChunkPolicy;
pub use error::{ModelError, Result};
pub use features::{ENTITY_PREFIX, FeatureKind, FeatureSpec, Features, Observation, Signature, Values, ValuesRef};
pub use gradients::{Gradients, ParamLayout};
pub use history::History;
pub use model::{LossParts, LossValues, Memory, PolicyModel};
pub use models::*;
pub use normaliser::{ACTION, ENVIRONMENT_STATE, Guarded, NormMode, Normaliser, STATE};
pub use optim::{Optimiser, OptimiserConfig};
pub use params::{Init, Params};
pub use policy::{ActionChunk, Actor, Clock, Policy, RecedingHorizon, TemporalEnsemble, ThoughtStep};
pub use preprocess::Preprocess;
pub use registry::{PolicyConfig, PolicyType};
pub use rng::Rng;
pub use simd::vectors;
pub use size::Size;
pub use train::{Learner, LearnerMetrics, Schedule, StepMetrics, TrainConfig, Trainer, TrainerState};
