//! A row of the leaderboard once more, from its demonstrations to its last episode: checked, trained again, run again, and
//! held against what is stored, step by step.
//!
//! Neither the zoo nor its results are written to. What a rerun makes lies in a folder of its own: the converted
//! demonstrations, the run, a zoo with the retrained entry and its results. One that was interrupted goes on from there.

mod episodes;
mod report;
mod row;
mod training;
mod weights;

use std::path::PathBuf;

use crate::{KnownEntries, standing};
use zoo::ZooError;
use zoo::entry::Entry;
use zoo::registry::Registry;
use zoo::results::StoredEvaluation;

pub use report::{ENTRY, EPISODES, Outcome, Reason, Report, Step};
pub use row::{Row, find_row};
pub use training::{Retrained, Retraining};

use report::RESULT;

/// A row that is as it was measured, and where it is run again.
#[derive(Debug)]
pub struct Rerun {
    entry: Entry,
    stored: StoredEvaluation,
    work: PathBuf,
}

impl Rerun {
    /// Checks entry and result as [`crate`] does, and says so in `report`; nothing where one of them is not sound.
    ///
    /// The work is done in `work`, or below `reruns` in a folder that is called after the entry and its content.
    ///
    /// # Errors
    /// [`ZooError::UnfitEntry`]: no robot policy.
    pub fn open(
        row: &Row,
        registry: &Registry,
        work: Option<PathBuf>,
        reruns: &std::path::Path,
        report: &mut Report,
    ) -> Result<Option<Self>, ZooError> {
        let known = KnownEntries::only(registry, [row.entry.clone()]);
        let Some(entry) = known.get(&row.entry) else {
            let reason = known.bad().next().map_or_else(String::new, |(_, error)| error.to_string());
            report.differs(ENTRY, reason);
            report.stop("the entry is not as it was sealed");
            return Ok(None);
        };
        entry.meta().require_policy("a robot policy (solvers of puzzles: eval --again)")?;
        report.same(ENTRY, format!("{}: {} files as they were sealed", entry.id(), entry.meta().files.len() + 1));
        let stored = match standing(&row.folder, &known) {
            Ok(Some(stored)) => stored,
            Ok(None) => {
                report.not_compared(RESULT, "the evaluation is still under way".to_owned());
                report.stop("there is no finished result");
                return Ok(None);
            }
            Err(reason) => {
                report.differs(RESULT, reason.to_string());
                report.stop("the result is not as it was sealed");
                return Ok(None);
            }
        };
        let (done, of) = (stored.successes(), stored.episodes.len());
        report.same(RESULT, format!("as it was sealed: {done} of {of} episodes succeeded"));
        let hash = entry.meta().content_sha256();
        let work = work.unwrap_or_else(|| reruns.join(format!("{}-{}", entry.id(), &hash[..8])));
        Ok(Some(Self { entry: entry.clone(), stored, work }))
    }

    /// The entry as it is stored.
    pub fn entry(&self) -> &Entry {
        &self.entry
    }

    /// The result as it is stored.
    pub fn stored(&self) -> &StoredEvaluation {
        &self.stored
    }

    /// The folder of the work.
    pub fn work(&self) -> &std::path::Path {
        &self.work
    }
}
