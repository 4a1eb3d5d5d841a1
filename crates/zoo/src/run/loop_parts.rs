//! What every kind of training shares: its folder, the comparison of its settings on resuming, its thinned curve.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::SystemTime;

use crate::ZooError;
use crate::entry::CurvePoint;

use super::folder::RunFolder;
use super::metrics::MetricsRow;

/// Points kept of a training curve.
const CURVE_POINTS: usize = 50;

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

/// At most 50 rows, evenly thinned; the last always stays.
pub(super) fn curve(rows: &[MetricsRow]) -> Vec<CurvePoint> {
    let stride = rows.len().div_ceil(CURVE_POINTS).max(1);
    let point = |row: &MetricsRow| {
        let loss = *row.values.get("loss")?;
        Some(CurvePoint { step: row.step, loss, valid_loss: row.values.get("valid_loss").copied() })
    };
    rows.iter().rev().step_by(stride).filter_map(point).collect::<Vec<_>>().into_iter().rev().collect()
}

/// Seconds since 1970.
pub(super) fn wall_time() -> f64 {
    SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).map_or(0.0, |d| d.as_secs_f64())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn curves_are_thinned_to_their_end() {
        let rows: Vec<MetricsRow> =
            (1..=1003).map(|step| MetricsRow { step, values: [("loss".to_owned(), step as f64)].into() }).collect();
        let points = curve(&rows);
        assert!(points.len() <= CURVE_POINTS && points.len() > CURVE_POINTS / 2);
        assert_eq!(points.last().map(|p| p.step), Some(1003));
        assert!(points.windows(2).all(|p| p[0].step < p[1].step));
        assert_eq!(curve(&rows[..3]).len(), 3);
    }
}
