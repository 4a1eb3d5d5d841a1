//! Joining the shards of one evaluation.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::folder::{ResultsFolder, StoredEvaluation};
use super::record::EvaluationRecord;
use crate::ResultsError;

/// Joins finished shards into one evaluation under `results`.
///
/// The shards must agree on everything, entry hash, protocol, seeds and versions included, and must
/// together be all of `1/N .. N/N`. A shard given twice is refused even if it says the same.
///
/// # Errors
/// [`ResultsError::Merge`] naming the shard and what differs; shards that are unfinished or damaged.
pub fn merge_shards(shards: &[PathBuf], results: &Path) -> Result<StoredEvaluation, ResultsError> {
    let refuse = |folder: &Path, what: &str, expected: String, found: String| ResultsError::Merge {
        folder: folder.to_owned(),
        what: what.to_owned(),
        expected,
        found,
    };
    let mut parts: BTreeMap<u64, StoredEvaluation> = BTreeMap::new();
    let mut first: Option<(EvaluationRecord, u64)> = None;
    for folder in shards {
        let part = StoredEvaluation::read(folder)?
            .ok_or_else(|| refuse(folder, "state", "a finished evaluation".into(), "one under way".into()))?;
        if !part.sealed {
            return Err(ResultsError::Unsealed { folder: folder.clone() });
        }
        let Some(shard) = part.record.shard else {
            return Err(refuse(folder, "shard", "a part, such as 1/2".into(), "the whole".into()));
        };
        let whole = EvaluationRecord { shard: None, ..part.record.clone() };
        let (expected, count) = first.get_or_insert_with(|| (whole.clone(), shard.count));
        if let Some((what, expected, found)) = expected.difference(&whole) {
            return Err(refuse(folder, &what, expected, found));
        }
        if *count != shard.count {
            let parts = |count| format!("one of {count} parts");
            return Err(refuse(folder, "shard", parts(*count), parts(shard.count)));
        }
        if let Some(other) = parts.insert(shard.index, part) {
            let found = format!("the same as in {}", other.folder.display());
            return Err(refuse(folder, "shard", format!("shard {shard} once"), found));
        }
    }
    let Some((whole, count)) = first else {
        return Err(refuse(results, "shards", "at least one".into(), "none".into()));
    };
    if let Some(absent) = (1..=count).find(|index| !parts.contains_key(index)) {
        let expected = format!("shards 1/{count} to {count}/{count}");
        return Err(refuse(results, "shards", expected, format!("no {absent}/{count}")));
    }
    let mut joined = ResultsFolder::open(results, &whole)?;
    for part in parts.into_values() {
        for (episode, timing) in part.episodes.into_iter().zip(part.timings) {
            joined.add(episode, timing)?;
        }
    }
    joined.finish()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::Shard;
    use crate::testing::{finished, sample};

    fn shards(folder: &Path, count: u64) -> Vec<PathBuf> {
        (1..=count)
            .map(|index| {
                let mut record = sample("a", 1, 11);
                record.shard = Some(Shard { index, count });
                finished(folder, &record).folder
            })
            .collect()
    }

    #[test]
    fn merged_shards_are_the_unsharded_evaluation_byte_for_byte() {
        let dir = tempfile::tempdir().unwrap();
        let whole = finished(&dir.path().join("whole"), &sample("a", 1, 11));
        let mut parts = shards(dir.path(), 3);
        parts.reverse();
        let joined = merge_shards(&parts, &dir.path().join("joined")).unwrap();
        for name in ["evaluation.json", "outcomes.parquet", "timings.parquet"] {
            let read = |folder: &Path| std::fs::read(folder.join(name)).unwrap();
            assert_eq!(read(&whole.folder), read(&joined.folder), "{name}");
        }
    }

    #[test]
    fn parts_that_do_not_belong_together_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let parts = shards(dir.path(), 2);
        let out = dir.path().join("joined");
        let merge = |parts: &[PathBuf]| merge_shards(parts, &out).unwrap_err().to_string();
        assert!(merge(&parts[..1]).contains("no 2/2"));
        assert!(merge(&[parts[0].clone(), parts[0].clone()]).contains("once"));
        assert!(merge(&[]).contains("at least one"));
        let mut other = sample("a", 1, 11);
        other.shard = Some(Shard { index: 2, count: 2 });
        #[allow(clippy::type_complexity)]
        let changes: [(&str, fn(&mut EvaluationRecord)); 3] = [
            ("entry", |r| r.entry.hash = "f".repeat(64)),
            ("protocol", |r| r.protocol.max_steps = 401),
            ("versions", |r| drop(r.versions.insert("mujoco".into(), "4.0".into()))),
        ];
        for (what, change) in changes {
            let mut changed = other.clone();
            change(&mut changed);
            let part = finished(&dir.path().join(what), &changed).folder;
            let error = merge(&[parts[0].clone(), part]);
            assert!(error.contains(&format!("{what}: expected")), "{error}");
        }
        let whole = finished(&dir.path().join("whole"), &sample("a", 1, 11)).folder;
        assert!(merge(&[parts[0].clone(), whole]).contains("the whole"));
        assert!(!out.exists(), "a refused merge writes nothing");
    }
}
