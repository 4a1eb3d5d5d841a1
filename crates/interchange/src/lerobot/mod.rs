//! LeRobot's checkpoints of ACT and of diffusion in and out: `config.json`, `model.safetensors` and the two processors.
//! What stands in the first two is `models::act::lerobot`'s and `models::diffusion::lerobot`'s business; here are the files.
//!
//! LeRobot loads weights by name without complaint about missing or extra ones, and passes features through
//! whose statistics are missing. Here both are errors that name what is wrong.

mod checkpoint;
mod config;
mod export;
mod import;
mod older;
mod provenance;

pub use export::export;
pub use import::{ImportOptions, import};
pub use provenance::exported_task;

const MODEL_FILE: &str = "model.safetensors";
const CONFIG_FILE: &str = "config.json";
/// What `lerobot-train` was asked for; not read for anything but the description of an entry.
const TRAIN_CONFIG: &str = "train_config.json";
const PREPROCESSOR: &str = "policy_preprocessor";
const POSTPROCESSOR: &str = "policy_postprocessor";
