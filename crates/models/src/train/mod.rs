//! Training: [`Trainer`] for policies, which cuts batches and runs their parts on threads; [`Learner`] for whoever makes
//! the loss, puzzles and reinforcement learning. Both take their steps with one core.

mod config;
mod core;
mod learner;
#[cfg(test)]
mod tests;
mod trainer;

pub use config::{Schedule, TrainConfig};
pub use learner::{Learner, LearnerMetrics};
pub use trainer::{StepMetrics, StepNumbers, Trainer, TrainerState};
