//! Shards put together.

use super::super::assembly::{Assembly, Encoders};
use super::super::check::names;
use super::super::convert::ConvertReport;
use super::super::doubts::Doubts;
use super::super::shards::StoredGroups;
use super::super::staging::Staging;
use super::super::verify::{hash_file, joint_hash};
use super::{
    MOST_SHARDS, RECORDS_FILE, REST_FILE, ROWS, SIDE, STATE_FILE, State, StoredHead, groups_file, read_state, record,
};
use crate::error::{DatasetError, Result};
use crate::source::codec::Taker;
use crate::source::list;
use crate::tree::Demo;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

/// Puts all shards of a conversion together in the directory `out`, which must not exist, to the bytes of a conversion in one
/// run. The shards may come in any order.
///
/// # Errors
/// A shard that is missing, that comes twice, that is one of another conversion or that is not as it was written, by its
/// folder. [`DatasetError::Stopped`] where `progress` says that it is enough; nothing stays behind.
pub fn merge_shards(
    out: &Path,
    shards: &[PathBuf],
    progress: &mut dyn FnMut(u64, u64) -> ControlFlow<()>,
) -> Result<ConvertReport> {
    let mut shards = in_order(shards)?;
    let source_sha256 = source_hash(&shards)?;
    let (first, state) = &mut shards[0];
    let stored = std::mem::take(&mut state.head);
    let path = first.join(STATE_FILE);
    let head = stored.head().map_err(|source| DatasetError::Json { path: path.clone(), source })?;
    names(&path, &head.info.features)?;
    let rest = match head.layout {
        Some(_) => Some(read_rest(first, state)?),
        None => None,
    };
    let staging = Staging::create(out)?;
    let encoders = Encoders::new(staging.path(), &head)?;
    let mut assembly = Assembly::new(staging.path(), &head, &encoders, rest.as_ref())?;
    let total = shards.iter().map(|(_, state)| state.frames as u64).sum();
    let (mut done, mut doubts) = (0, Doubts::default());
    let mut tell = |done| match progress(done, total) {
        ControlFlow::Continue(()) => Ok(()),
        ControlFlow::Break(()) => Err(DatasetError::Stopped { path: out.to_owned() }),
    };
    tell(0)?;
    for (folder, state) in &shards {
        doubts.extend(&state.doubts);
        for name in state.files.keys() {
            check(folder, state, name)?;
        }
        if state.groups == 0 {
            continue;
        }
        let mut rows = StoredGroups::open(&groups_file(folder, ROWS))?;
        let side_path = groups_file(folder, SIDE);
        let mut side = if side_path.exists() { Some(StoredGroups::open(&side_path)?) } else { None };
        let path = folder.join(RECORDS_FILE);
        let mut records = BufReader::new(File::open(&path).map_err(failed(&path, "open it"))?);
        let mut record = Vec::new();
        for number in 0..state.groups {
            let mut length = [0; 8];
            records.read_exact(&mut length).map_err(failed(&path, "read it"))?;
            record.clear();
            let length = u64::from_le_bytes(length);
            records.by_ref().take(length).read_to_end(&mut record).map_err(failed(&path, "read it"))?;
            let taken = record::take(&record, &mut rows, side.as_mut(), head.layout.is_some());
            let (output, beside) = taken.ok_or_else(|| DatasetError::BadDataset {
                path: path.clone(),
                object: format!("record {number}"),
                expected: "what the shard's episodes say of themselves".to_owned(),
                found: "other bytes".to_owned(),
            })?;
            done += output.group.rows as u64;
            assembly.take(output, beside)?;
            tell(done)?;
        }
    }
    let mut report = assembly.finish(source_sha256)?;
    report.notes.extend(doubts.notes());
    staging.publish()?;
    Ok(report)
}

/// The shards by their numbers, if they are all of one conversion.
fn in_order(folders: &[PathBuf]) -> Result<Vec<(PathBuf, State)>> {
    let mut found: BTreeMap<usize, (PathBuf, State)> = BTreeMap::new();
    let mut reference: Option<(&PathBuf, String, String, usize)> = None;
    for folder in folders {
        let mut state = read_state(folder)?;
        let bad = |expected: String, found: String| DatasetError::BadDataset {
            path: folder.clone(),
            object: format!("shard {}", state.shard),
            expected,
            found,
        };
        if !state.shard.is_one() {
            return Err(bad(format!("one from 1/N to N/N, of {MOST_SHARDS} at most"), state.shard.to_string()));
        }
        let (first, conversion, source, of) =
            reference.get_or_insert_with(|| (folder, state.conversion.clone(), state.source.clone(), state.shard.of));
        if (&state.conversion, state.shard.of) != (&*conversion, *of) {
            let another = match (state.source == *source, state.shard.of == *of) {
                (false, _) => format!("one of {}", state.source),
                (true, false) => format!("one of {} shards", state.shard.of),
                (true, true) => "one of another source of that name, of other options or of another version".to_owned(),
            };
            return Err(bad(format!("one of the {of} of {source}, as {} is", first.display()), another));
        }
        if let Some((other, _)) = found.get(&state.shard.index) {
            return Err(bad("each shard once".to_owned(), format!("the same one in {}", other.display())));
        }
        if state.shard.index > 1 {
            // all have the same
            state.head = StoredHead::default();
        }
        found.insert(state.shard.index, (folder.clone(), state));
    }
    let Some((first, _, source, of)) = reference else {
        return Err(DatasetError::NotInDataset {
            path: PathBuf::new(),
            wanted: "shard".to_owned(),
            found: "nothing".to_owned(),
        });
    };
    let missing: Vec<String> = (1..=of).filter(|index| !found.contains_key(index)).map(|i| i.to_string()).collect();
    if !missing.is_empty() {
        return Err(DatasetError::BadDataset {
            path: first.clone(),
            object: format!("shards of {source}"),
            expected: format!("all {of}"),
            found: format!("{} of them; missing: {}", found.len(), list(missing.iter().map(String::as_str))),
        });
    }
    Ok(found.into_values().collect())
}

/// The hash of the source, of whose files each shard states some.
fn source_hash(shards: &[(PathBuf, State)]) -> Result<String> {
    let (first, state) = &shards[0];
    let mut files: Vec<(String, Option<String>)> = state.source_files.clone();
    for (_, state) in shards {
        for (known, (_, hash)) in files.iter_mut().zip(&state.source_files) {
            known.1 = known.1.take().or_else(|| hash.clone());
        }
    }
    let each = files.into_iter().map(|(name, hash)| {
        let hash = hash.ok_or_else(|| DatasetError::NotInDataset {
            path: first.clone(),
            wanted: format!("hash of {name}"),
            found: "those of other files of the source".to_owned(),
        })?;
        Ok((name, hash))
    });
    Ok(joint_hash(&each.collect::<Result<Vec<_>>>()?))
}

/// Makes sure that a file of a shard is what was written.
fn check(folder: &Path, state: &State, name: &str) -> Result<()> {
    let path = folder.join(name);
    let found = hash_file(&path)?;
    match state.files.get(name) {
        Some(expected) if *expected == found => Ok(()),
        expected => Err(DatasetError::BadDataset {
            path,
            object: format!("shard {}", state.shard),
            expected: expected.map_or("no such file".to_owned(), |sha256| format!("sha256 {sha256}")),
            found: format!("{found}; remove the folder and convert this shard again"),
        }),
    }
}

fn read_rest(folder: &Path, state: &State) -> Result<Demo> {
    check(folder, state, REST_FILE)?;
    let path = folder.join(REST_FILE);
    let bytes = std::fs::read(&path).map_err(failed(&path, "read it"))?;
    Taker(&bytes).demo().ok_or_else(|| DatasetError::BadDataset {
        path,
        object: "content".to_owned(),
        expected: "what the source holds beside its demos".to_owned(),
        found: "other bytes".to_owned(),
    })
}

fn failed(path: &Path, operation: &'static str) -> impl FnOnce(std::io::Error) -> DatasetError {
    let path = path.to_path_buf();
    move |source| DatasetError::Io { path, operation, source }
}
