//! A data set whose tables say what its frames say.

use super::super::check::TIME_TOLERANCE;
use super::super::export::side_folder_of;
use super::super::meta::PROVENANCE_FILE;
use super::super::open::Dataset;
use super::super::tables::{Area, Tables};
use super::super::verify::{in_full, not_finite, picture_problem};
use super::{Destination, EditReport, Input, Progress, Renames, one, tell};
use crate::error::Result;
use std::path::Path;

/// What else a repair rewrites.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Repair {
    /// Timestamps, as `frame_index / fps`. Real-clock times are lost.
    pub timestamps: bool,
}

/// What a repair found and did.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RepairReport {
    /// What was corrected: file, place, what belongs there and what was there.
    pub corrected: Vec<String>,
    /// What is wrong and does not follow from the frames.
    pub left: Vec<String>,
    /// What was written; nothing where there was nothing to correct.
    pub made: Option<EditReport>,
}

/// `set` with everything that follows from its frames made anew: the columns that number them, tasks, the table of episodes,
/// statistics, totals and splits. Frames stay as they are. A set in which nothing is to be corrected is left alone, and nothing
/// is written.
///
/// Where the frames, or what is recorded of where they came from, are not what was converted, that record and the side folder
/// are left out.
///
/// # Errors
/// Frames of which nothing says where an episode begins, or which task it has; as [`super::keep`].
pub fn repair(set: &Path, to: &Destination, what: Repair, progress: &mut Progress<'_>) -> Result<RepairReport> {
    let tables = Tables::read(set)?;
    let mut derived = tables.derived()?;
    let mut faults = tables.faults(TIME_TOLERANCE);
    faults.extend(tables.statistics_faults(&derived)?);
    let (corrected, left): (Vec<_>, Vec<_>) =
        faults.iter().partition(|fault| fault.repairable || (what.timestamps && fault.area == Area::Times));
    let lines = |faults: Vec<_>| faults.into_iter().map(ToString::to_string).collect::<Vec<String>>();
    let (corrected, mut left) = (lines(corrected), lines(left));
    left.extend(not_finite(&derived).iter().flat_map(|text| text.lines()).map(str::to_owned));
    if corrected.is_empty() {
        return Ok(RepairReport { corrected, left, made: None });
    }
    let mut notes = Vec::new();
    if let Some(why) = lost(&tables, &derived, progress)? {
        derived.forget_provenance();
        notes.push(format!("{why}: where it came from and the side folder are left out"));
    }
    let layout = match derived.provenance().is_some_and(|p| p.lossless) {
        true => Some(side_folder_of(set, derived.info(), &|_| false)?),
        false => None,
    };
    let all = (0..derived.episodes().len()).collect();
    let mut made = one(Input { set: derived, layout, joins: false }, to, all, &Renames::new(), Some(what), progress)?;
    made.notes.splice(0..0, notes);
    Ok(RepairReport { corrected, left, made: Some(made) })
}

/// Why the set is not the one that was converted any more.
fn lost(tables: &Tables, set: &Dataset, progress: &mut Progress<'_>) -> Result<Option<String>> {
    let Some(provenance) = set.provenance() else { return Ok(None) };
    if !tables.provenance_holds() {
        return Ok(Some("what is recorded of the set was changed since it was made".to_owned()));
    }
    let problem = match set.has_pictures() {
        true => picture_problem(set, false, &mut |done, total| tell(progress, done, total, set.root()))?,
        false => (set.content_fingerprint() != provenance.fingerprint).then(|| "another fingerprint".to_owned()),
    };
    if let Some(problem) = problem {
        return Ok(Some(format!("the frames are not those that were converted ({problem})")));
    }
    let side = |name: &str| name.starts_with("actrm/") && name != PROVENANCE_FILE;
    let broken = provenance.lossless.then(|| side_folder_of(set.root(), set.info(), &side)).and_then(Result::err);
    Ok(broken.map(|e| format!("the side folder is not what was written ({})", in_full(&e))))
}
