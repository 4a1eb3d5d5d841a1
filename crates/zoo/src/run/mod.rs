//! Training runs: a folder, checkpoints, metrics, and the loop that makes an entry.

mod checkpoint;
mod folder;
mod metrics;
mod tensorboard;

pub use checkpoint::Checkpoint;
pub use folder::RunFolder;
pub use metrics::{Metrics, MetricsRow};
pub use tensorboard::EventWriter;
