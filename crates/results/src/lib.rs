//! What evaluations leave on disk: one folder each, under the zoo's `results/`; and files that are either whole or not
//! there ([`files`]).
//!
//! - `evaluation.json`: the entry, the task, the protocol, the seeds and the simulator's versions.
//! - `outcomes.parquet`: the outcome of every episode, sorted by seed. Depends on nothing but what
//!   `evaluation.json` says: two evaluations of the same entry give the same bytes.
//! - `timings.parquet`: how long things took. Never the same twice.
//! - `seal.json`: written last: the entry's hash, the protocol and the hash of each of these files.
//! - `journal.jsonl`: episodes as they finish, while an evaluation is under way; an interrupted one goes
//!   on from it.

mod error;
pub mod files;
mod folder;
mod merge;
mod record;
mod seal;
mod tables;
#[doc(hidden)]
pub mod testing;

pub use error::ResultsError;
pub use files::{sha256_file, sha256_hex, write_atomic, write_together};
pub use folder::{
    OUTCOMES, OtherSimulator, RECORD, ResultsFolder, StoredEvaluation, UnderWay, entries_named, evaluation_folders,
    list_evaluations, read_record, result_folders,
};
pub use merge::merge_shards;
pub use record::{
    EntryIdentity, EpisodeRecord, EpisodeTiming, EvaluationRecord, Execution, Protocol, Seeds, Shard, TrainingFacts,
    differing,
};
pub use seal::{SEAL_FILE, Seal};
pub use tables::write_table;
