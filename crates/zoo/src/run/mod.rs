//! Training runs: a folder, checkpoints, metrics, and the loop that makes an entry.

mod checkpoint;
mod data;
mod folder;
mod list;
pub mod loop_parts;
mod metrics;
mod sampler;
mod section;
mod symmetry;
mod tensorboard;
mod training;
mod validation;

pub use checkpoint::Checkpoint;
pub use data::locate;
pub use folder::{COMMAND_FILE, RunFolder};
pub use list::{FoundRun, RunState, list_runs};
pub use metrics::{Metrics, MetricsRow};
pub use section::{OptimiserKind, TrainSection};
pub use tensorboard::EventWriter;
pub use training::{TrainEvent, TrainOutcome, TrainRequest, train};
