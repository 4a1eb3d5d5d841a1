//! What evaluations leave on disk: one folder each, under the zoo's `results/`.
//!
//! - `evaluation.json`: the entry, the task, the protocol, the seeds and the simulator's versions.
//! - `outcomes.parquet`: the outcome of every episode, sorted by seed. Depends on nothing but what
//!   `evaluation.json` says: two evaluations of the same entry give the same bytes.
//! - `timings.parquet`: how long things took. Never the same twice.
//! - `seal.json`: written last: the entry's hash, the protocol and the hash of each of these files.
//! - `journal.jsonl`: episodes as they finish, while an evaluation is under way; an interrupted one goes
//!   on from it.

mod folder;
mod merge;
mod record;
mod seal;
mod tables;

pub(crate) use folder::{OUTCOMES, RECORD, evaluation_folders, read_record};
pub use folder::{OtherSimulator, ResultsFolder, StoredEvaluation, list_evaluations, result_folders};
pub use merge::merge_shards;
pub(crate) use record::differing;
pub use record::{
    EntryIdentity, EpisodeRecord, EpisodeTiming, EvaluationRecord, Execution, Protocol, Seeds, Shard, TrainingFacts,
};
pub use seal::{SEAL_FILE, Seal};
pub use tables::write_table;

/// What tests elsewhere in this crate build on.
#[cfg(test)]
pub(crate) mod testing {
    pub(crate) use super::folder::tests::finished;
    pub(crate) use super::record::tests::sample;
    pub(crate) use super::tables::write_episodes;
}
