//! From simulators to files of demonstrations: collecting a task's scripted expert, and extracting what raw recordings
//! leave out.
//!
//! It joins `rollout`, which runs the simulator, and `dataset`, which writes robomimic's HDF5. What this crate is not: it
//! contains no policy, and neither reads the command line nor prints.

mod collect;
mod demo;
mod error;
mod extract;

pub use collect::{CollectEnd, CollectOptions, CollectProgress, Collected, collect, refuse_existing};
pub use demo::{Recording, demo};
pub use error::{RecordingError, Result};
pub use extract::{ExtractEnd, ExtractOptions, Extracted, extract, recorded_task, replay_error};
