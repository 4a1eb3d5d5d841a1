//! Running again what was evaluated before, to see that every outcome is the same.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use rollout::{Pool, RolloutError};

use super::{EvaluationOptions, Subject, run_episodes};
use crate::ZooError;
use crate::results::{
    EpisodeRecord, EvaluationRecord, ResultsError, ResultsFolder, StoredEvaluation, differing, evaluation_folders,
};

/// How running again ended.
#[derive(Debug)]
pub struct Again {
    /// Episodes that were run again.
    pub episodes: u64,
    /// Episodes that were asked for.
    pub wanted: u64,
    /// Episodes that are stored there.
    pub stored: u64,
    /// Outcomes that are not the same: stored and now.
    pub different: Vec<(EpisodeRecord, EpisodeRecord)>,
    /// Versions that are not the same: name, stored and now.
    pub versions: Vec<(String, String, String)>,
    /// Episodes that no worker could run.
    pub errors: Vec<RolloutError>,
    /// Whether the stored evaluation had no seal and has one now: all of its episodes were run, every outcome the same.
    pub sealed: bool,
    /// Whether it had no progress, being from before there were stages, and has it now: likewise.
    pub progress: bool,
}

/// Runs the first of a stored evaluation's episodes again, as many as are asked for, and compares. Where every episode was
/// run and found to be the same, what the stored evaluation lacks, being older, is added: a seal, the episodes' progress.
/// Nothing else is written.
///
/// The same entry, protocol, execution and seeds decide which evaluation is meant; one under other versions of the
/// simulator will do where there is none under these.
///
/// # Errors
/// [`ZooError::NothingToCompare`] where no finished evaluation holds these seeds, [`ResultsError::Differ`] where it is
/// of another entry under the same name; as an evaluation otherwise.
pub fn evaluate_again(
    subject: &Subject<'_>,
    pool: &mut Pool,
    results: &Path,
    options: &EvaluationOptions,
    progress: &mut dyn FnMut(u64, u64),
) -> Result<Again, ZooError> {
    let record = subject.record(pool.ready(), options)?;
    let stored = find(results, &record)?;
    if !stored.record.training.is_same(&record.training) {
        let text = |record: &EvaluationRecord| serde_json::to_string(&record.training).unwrap_or_default();
        return Err(ResultsError::Differ {
            folder: stored.folder,
            what: "evaluation.json: training".to_owned(),
            expected: text(&stored.record),
            found: text(&record),
        }
        .into());
    }
    let before: BTreeMap<u64, EpisodeRecord> = stored.episodes.iter().cloned().map(|e| (e.seed, e)).collect();
    let seeds = record.own_seeds();
    let wanted = seeds.len() as u64;
    let mut again = Again {
        episodes: 0,
        wanted,
        stored: before.len() as u64,
        different: Vec::new(),
        versions: differing(&stored.record, &record),
        errors: Vec::new(),
        sealed: false,
        progress: false,
    };
    let mut ran = Vec::new();
    progress(0, wanted);
    run_episodes(subject, pool, record.protocol.max_steps, &seeds, &|_, _| Ok(()), &mut |result| match result {
        Ok(now) => {
            again.episodes += 1;
            progress(again.episodes, wanted);
            if let Some(before) = before.get(&now.seed).filter(|before| !before.is_same(&now)) {
                again.different.push((before.clone(), now.clone()));
            }
            ran.push(now);
        }
        Err(error) => again.errors.push(error),
    })?;
    let every = again.episodes == again.stored && again.different.is_empty() && again.errors.is_empty();
    if every && !stored.sealed {
        stored.seal()?;
        again.sealed = true;
    }
    let lacks = |episodes: &[EpisodeRecord]| episodes.iter().any(|episode| episode.progress.is_none());
    if every && stored.record.is_same(&record) && lacks(&stored.episodes) && !lacks(&ran) {
        ResultsFolder::open(results, &stored.record)?.rewrite(ran)?;
        again.progress = true;
    }
    Ok(again)
}

/// The finished evaluation that holds the seeds of `record`.
fn find(results: &Path, record: &EvaluationRecord) -> Result<StoredEvaluation, ZooError> {
    // the one of exactly this record is read first, so that damage there is told
    if let Some(stored) = StoredEvaluation::read_if_there(&record.folder_in(results))? {
        return Ok(stored);
    }
    let seeds = record.own_seeds();
    let same = |other: &EvaluationRecord| {
        (&other.entry, &other.protocol, &other.execution) == (&record.entry, &record.protocol, &record.execution)
    };
    // whoever lists evaluations names the ones that cannot be read
    let read = |folder: PathBuf| StoredEvaluation::read(&folder).ok().flatten().filter(|stored| same(&stored.record));
    let all: Vec<StoredEvaluation> = evaluation_folders(results)?.into_iter().filter_map(read).collect();
    let holds = |stored: &StoredEvaluation| {
        let own = stored.record.own_seeds();
        seeds.iter().all(|seed| own.binary_search(seed).is_ok())
    };
    let found = all.iter().filter(|stored| holds(stored)).max_by_key(|stored| {
        let stored = &stored.record;
        (stored.versions == record.versions, stored.sources == record.sources, stored.sources.is_empty())
    });
    found.cloned().ok_or_else(|| ZooError::NothingToCompare {
        entry: record.entry.to_string(),
        seeds: record.seeds.to_string(),
        results: results.to_owned(),
        stored: all.iter().map(|stored| stored.record.seeds.to_string()).collect(),
    })
}
