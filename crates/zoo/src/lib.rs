//! From an experiment file to a leaderboard.
//!
//! An experiment says what to train on what; a run trains it, with checkpoints that resume to the same
//! bytes; an entry seals the result as `name@version` with a hash of every file; the registry finds
//! entries again; evaluations run them in simulators and the leaderboard ranks them.
//!
//! What this crate is not: it reads no HDF5 (that is `dataset`), contains no model and no optimiser
//! (`models`), and neither reads the command line nor prints (`tools`).

pub mod config;
pub mod entry;
mod error;
mod files;
pub mod registry;
pub mod run;
mod tensors;

// rollouts, evaluations, leaderboard
pub mod evaluation;
pub mod leaderboard;
pub mod report;
pub mod results;
pub mod rollout;

pub use error::ZooError;
pub use files::{sha256_file, sha256_hex, write_atomic};
