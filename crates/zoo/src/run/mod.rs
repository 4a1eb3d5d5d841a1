//! Training runs: a folder, checkpoints, metrics, the loop that makes an entry, and what it trains on demonstrations.

mod agreement;
mod auxiliary;
mod beginning;
mod checkpoint;
mod data;
mod exchange;
mod eyes;
mod feed;
mod folder;
mod list;
mod loop_parts;
mod memory;
mod metrics;
mod mirror;
mod names;
mod places;
mod preflight;
mod section;
mod session;
mod symmetry;
mod tensorboard;
mod training;
mod validation;
mod way;

pub(crate) use agreement::is_whole;
pub use checkpoint::Checkpoint;
pub use data::locate;
pub(crate) use data::{demonstrations, first_windows};
pub use folder::{COMMAND_FILE, RunFolder};
pub use list::{FoundRun, RunState, list_runs};
pub(crate) use loop_parts::same_settings;
pub use metrics::{Metrics, MetricsRow};
pub use section::{OptimiserKind, TrainSection, WeightsFormat};
pub use session::{Place, Settings, TrainEvent, TrainOutcome, Training, finished_entry, run};
pub use tensorboard::EventWriter;
pub use training::{TrainRequest, train};
