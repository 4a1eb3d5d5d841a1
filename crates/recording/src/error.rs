//! Everything that can go wrong in this crate.

use std::path::PathBuf;

/// What this crate's functions return.
pub type Result<T> = std::result::Result<T, RecordingError>;

/// An operation of this crate that failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RecordingError {
    /// A file of demonstrations could not be read or written.
    #[error(transparent)]
    Dataset(#[from] dataset::DatasetError),
    /// The simulator could not do its part.
    #[error(transparent)]
    Rollout(#[from] rollout::RolloutError),
    /// A demo of a recording could not be replayed.
    #[error(
        "{}: {demo}: {simulator} cannot replay it: {reason} (where another version of the simulator recorded it, --python \
         names a Python that has that one)",
        path.display()
    )]
    Replay {
        /// The file.
        path: PathBuf,
        /// The demo.
        demo: String,
        /// The simulator that runs, with its version.
        simulator: String,
        /// What it says.
        reason: String,
    },
    /// The expert fails too often.
    #[error(
        "the expert succeeded in {successes} of {attempts} attempts at {task}: too few for {wanted} demos; the attempts are kept \
         in {}; the same command with fewer --episodes uses them", kept.display()
    )]
    TooFewSuccesses {
        /// The task.
        task: String,
        /// Attempts that succeeded.
        successes: usize,
        /// Attempts made.
        attempts: u64,
        /// Demonstrations wanted.
        wanted: u64,
        /// Where the attempts are.
        kept: PathBuf,
    },
    /// An attempt that was on disk is not there any more.
    #[error("attempt {attempt} of {task} is not on disk any more")]
    LostAttempt {
        /// The task.
        task: String,
        /// The attempt.
        attempt: u64,
    },
    /// A recording lacks what is needed, or holds it in another form.
    #[error("{}{}: {what}: expected {expected}, found {found}", path.display(), demo.as_ref().map_or(String::new(), |d| format!(": {d}")))]
    Unfit {
        /// The file; empty for what a worker sent.
        path: PathBuf,
        /// The demo, if it is about one.
        demo: Option<String>,
        /// What it is about.
        what: String,
        /// What is needed.
        expected: String,
        /// What is there.
        found: String,
    },
}
