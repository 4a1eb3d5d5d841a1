//! Where an exported entry comes from: a file of ours in LeRobot's folder, which LeRobot does not read.
//!
//! Taken back on import, so that an entry that went out and in again still says what it was trained on.

use std::path::Path;

use serde::{Deserialize, Serialize};

use zoo::entry::EntryMeta;
use zoo::{ZooError, sha256_file};

use super::MODEL_FILE;

/// The file.
pub(super) const PROVENANCE: &str = "actrm_provenance.json";

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Provenance {
    format: u32,
    /// `name@version` and hash of the entry that was exported.
    entry: String,
    content_sha256: String,
    /// Of the weights beside it: those of another training have another origin.
    model_sha256: String,
    meta: EntryMeta,
}

const FORMAT: u32 = 1;

/// What goes into the file beside weights of that hash.
pub(super) fn text(meta: &EntryMeta, model_sha256: &str) -> String {
    let provenance = Provenance {
        format: FORMAT,
        entry: meta.id().to_string(),
        content_sha256: meta.content_sha256(),
        model_sha256: model_sha256.to_owned(),
        meta: meta.clone(),
    };
    serde_json::to_string_pretty(&provenance).expect("strings and numbers become JSON") + "\n"
}

/// The task of the entry that was exported to `folder`, if it is an export.
///
/// # Errors
/// A file that is not what an export writes.
pub fn exported_task(folder: &Path) -> Result<Option<String>, ZooError> {
    Ok(read(folder)?.map(|meta| meta.task))
}

/// What the entry that was exported to `folder` said of itself; none where LeRobot trained the weights, from the start or
/// further.
///
/// # Errors
/// A file that is not what an export writes.
pub(super) fn read(folder: &Path) -> Result<Option<EntryMeta>, ZooError> {
    let path = folder.join(PROVENANCE);
    if !path.is_file() {
        return Ok(None);
    }
    let text = std::fs::read(&path).map_err(ZooError::io("read", &path))?;
    let malformed = |reason: String| ZooError::Malformed { path: path.clone(), reason };
    let found: Provenance =
        serde_json::from_slice(&text).map_err(|e| malformed(format!("not the origin of an exported entry: {e}")))?;
    if found.format != FORMAT {
        return Err(malformed(format!("format: expected {FORMAT}, found {}", found.format)));
    }
    let model = folder.join(MODEL_FILE);
    // an export is one file
    let same = model.is_file() && found.model_sha256 == sha256_file(&model)?;
    Ok(same.then_some(found.meta))
}
