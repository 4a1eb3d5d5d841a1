//! Training runs: a folder, checkpoints, metrics, the loop that makes an entry, and what it trains on demonstrations.

mod agreement;
mod checkpoint;
mod data;
mod extend;
mod feed;
mod folder;
mod image_encoder;
mod initial_weights;
mod list;
mod memory;
mod metrics;
mod names;
mod preflight;
mod score;
mod section;
mod session;
mod tensorboard;
mod training;
mod validation;

pub(crate) use agreement::is_whole;
pub use checkpoint::Checkpoint;
pub use data::{demonstrations, first_windows, locate, short_hash};
pub use extend::{Extended, extend};
pub use folder::{COMMAND_FILE, RunFolder};
pub use list::{FoundRun, RunState, list_runs};
pub use metrics::{Metrics, MetricsRow};
pub use models::DeviceChoice;
pub use score::{Score, ScoreRequest, score, score_folder};
pub use section::{OptimiserKind, TrainSection, WeightsFormat};
pub use session::{
    Place, Settings, TrainEvent, TrainOutcome, Training, finished_entry, finished_in, run, same_settings,
};
pub use tensorboard::EventWriter;
pub use training::{TrainRequest, train};
