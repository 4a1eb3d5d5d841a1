//! What every kind of training shares: its folder, the comparison of its settings on resuming, its thinned curve.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::SystemTime;

use crate::ZooError;
use crate::entry::{CurvePoint, thinned};

use super::folder::RunFolder;
use super::metrics::MetricsRow;

/// The folder of a training: `run` exactly, or the next or latest one of experiment `name` under `runs`.
pub(super) fn open_folder(name: &str, runs: &Path, run: Option<&Path>, resume: bool) -> Result<RunFolder, ZooError> {
    match (run, resume) {
        (Some(path), true) => RunFolder::resume(path),
        (Some(path), false) => RunFolder::fresh(path),
        (None, true) => RunFolder::resume_latest(runs, name),
        (None, false) => RunFolder::next(runs, name),
    }
}

/// Refuses to go on with other settings than the run began with, naming the first that differs.
pub(crate) fn same_settings(
    folder: &Path,
    saved: &BTreeMap<String, String>,
    asked: &BTreeMap<String, String>,
) -> Result<(), ZooError> {
    let absent = || "nothing".to_owned();
    for key in saved.keys().chain(asked.keys()) {
        let (expected, found) = (saved.get(key), asked.get(key));
        if expected != found {
            return Err(ZooError::ResumeMismatch {
                folder: folder.to_owned(),
                what: key.clone(),
                expected: expected.cloned().unwrap_or_else(absent),
                found: found.cloned().unwrap_or_else(absent),
            });
        }
    }
    Ok(())
}

/// The loss on the way, thinned.
pub(super) fn curve(rows: &[MetricsRow]) -> Vec<CurvePoint> {
    let value = |row: &MetricsRow, name: &str| row.values.get(name).copied();
    thinned(rows.iter().map(|row| (row.step, value(row, "loss"), value(row, "valid_loss"))))
}

/// Seconds since 1970.
pub(super) fn wall_time() -> f64 {
    SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).map_or(0.0, |d| d.as_secs_f64())
}
