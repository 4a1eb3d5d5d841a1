//! What `info.json` says, held against itself and against the frames whenever a data set is opened.
//!
//! Each check is cheap: a hash of one small file, the types of columns, the times of frames. An edited number is refused or noted, or
//! nothing that is trained on depends on it (the sizes at which a writer closes files).

use super::fingerprint::INDEX_COLUMNS;
use super::info::{Features, Info, Provenance};
use super::schema::hex;
use crate::error::{DatasetError, Result};
use arrow_schema::DataType;
use serde_json::Value;
use sha2::{Digest, Sha256};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Records in `info` the hash of everything else in it.
pub(super) fn sealed(mut info: Info, root: &Path) -> Result<Info> {
    let failed = |source| DatasetError::Json { path: root.join("meta/info.json"), source };
    // hashed as it will be read: numbers pass through text
    let reread = |text: Vec<u8>| serde_json::from_slice::<Value>(&text);
    let mut value = serde_json::to_vec(&info).and_then(reread).map_err(failed)?;
    if let Some(provenance) = &mut info.actrm {
        value["actrm"] = serde_json::to_vec(provenance).and_then(reread).map_err(failed)?;
        provenance.seal = Some(seal(&value));
    }
    Ok(info)
}

/// sha256 of a JSON value whatever its spaces and the order of its keys, but for `/actrm/seal`.
pub(super) fn seal(value: &Value) -> String {
    let mut text = String::new();
    canonical(value, "", &mut text);
    hex(&Sha256::digest(text))
}

fn canonical(value: &Value, path: &str, out: &mut String) {
    match value {
        Value::Object(entries) => {
            let mut sorted: Vec<_> = entries.iter().collect();
            sorted.sort_by_key(|(key, _)| *key);
            for (key, value) in sorted {
                canonical(value, &format!("{path}/{}", Value::from(key.as_str())), out);
            }
            // an empty object is not a missing one
            out.push_str(&format!("{path} {{}}\n"));
        }
        Value::Array(items) => {
            for (i, item) in items.iter().enumerate() {
                canonical(item, &format!("{path}/{i}"), out);
            }
            out.push_str(&format!("{path} []\n"));
        }
        _ if path == r#"/"actrm"/"seal""# => {}
        other => out.push_str(&format!("{path} {other}\n")),
    }
}

/// Checks what a set says of itself: `info`, and `value`, the JSON that it was read from, with the provenance at `actrm`.
pub(super) fn info(root: &Path, value: &Value, info: &Info) -> Result<()> {
    let path = root.join("meta/info.json");
    let bad = |object: &str, expected: String, found: String| {
        Err(DatasetError::BadDataset { path: path.clone(), object: object.to_owned(), expected, found })
    };
    if let Some(provenance) = &info.actrm {
        if provenance.format != 1 {
            return bad("actrm.format", "1".to_owned(), provenance.format.to_string());
        }
        if let Some(expected) = &provenance.seal {
            let found = seal(value);
            if found != *expected {
                let expected = format!("sha256 {expected}, recorded when it was made (actrm.seal)");
                let found = format!(
                    "{found}: something in it was changed; `actrm-data validate` says what, `actrm-data edit repair` corrects it"
                );
                return bad("content", expected, found);
            }
        }
    }
    if !(info.fps.is_finite() && info.fps > 0.0) {
        return bad("fps", "a number above 0".to_owned(), info.fps.to_string());
    }
    Ok(())
}

/// Refuses features that the file `path` states and no set can have. Paths are made of their names.
pub(super) fn names(path: &Path, features: &Features) -> Result<()> {
    let bad = |object: String, expected: &str, found: String| {
        Err(DatasetError::BadDataset { path: path.to_path_buf(), object, expected: expected.to_owned(), found })
    };
    let mut known = BTreeSet::new();
    for (name, feature) in &features.0 {
        if name.is_empty() || name.split('/').any(|part| part == "..") || name.starts_with('/') {
            return bad("features".to_owned(), "names that stay inside the folder", format!("{name:?}"));
        }
        if !known.insert(name) {
            return bad("features".to_owned(), "each name once", format!("{name} twice"));
        }
        if INDEX_COLUMNS.contains(&name.as_str()) && feature.dim() != 1 {
            return bad(format!("features.{name}.shape"), "[1]", format!("{:?}", feature.shape));
        }
    }
    Ok(())
}

/// Holds what is recorded of where a set came from against the episodes that there are.
pub(super) fn origin(root: &Path, provenance: &Provenance, episodes: usize) -> Result<()> {
    let bad = |object: &str, expected: String, found: usize| {
        let (path, found) = (root.join("meta/info.json"), found.to_string());
        Err(DatasetError::BadDataset { path, object: format!("actrm.{object}"), expected, found })
    };
    if provenance.demos.len() != episodes {
        return bad("demos", format!("an id for each of {episodes} episodes"), provenance.demos.len());
    }
    for (name, named) in &provenance.masks {
        if let Some(&episode) = named.iter().find(|&&episode| episode >= episodes) {
            return bad(&format!("masks.{name}"), format!("episodes below {episodes}"), episode);
        }
    }
    Ok(())
}

/// Leaves out splits that cannot be right for the episodes that there are, with a note.
pub(super) fn leave_out_stale_splits(info: &mut Info, notes: &mut Vec<String>) {
    if let Err((expected, found)) = splits(&info.splits, info.total_episodes) {
        notes.push(format!("meta/info.json: splits: expected {expected}, found {found}: they are not used"));
        info.splits.clear();
    }
}

/// Named ranges lie side by side and leave no episode out.
pub(super) fn splits(splits: &BTreeMap<String, String>, total: usize) -> Result<(), (String, String)> {
    let mut ranges = Vec::with_capacity(splits.len());
    for (name, text) in splits {
        let number = |text: &str| text.trim().parse::<usize>().ok();
        match text.split_once(':').and_then(|(from, to)| Some((number(from)?, number(to)?))) {
            Some((from, to)) if from <= to && to <= total => ranges.push((from, to)),
            _ => return Err((format!("ranges of {total} episodes, as \"0:{total}\""), format!("{name}: {text:?}"))),
        }
    }
    ranges.sort_unstable();
    let mut end = 0;
    for &(from, to) in ranges.iter().filter(|(from, to)| from < to) {
        if from != end {
            break;
        }
        end = to;
    }
    let covered: usize = ranges.iter().map(|(from, to)| to - from).sum();
    if ranges.is_empty() || (end, covered) == (total, total) {
        return Ok(());
    }
    let found = splits.iter().map(|(name, text)| format!("{name} {text}")).collect::<Vec<_>>().join(", ");
    Err((format!("each of {total} episodes in one of them"), found))
}

/// Whether a column of this type can be read as `dtype`, as LeRobot casts it: `None` if it has that type, its own type's name
/// otherwise.
pub(super) fn stored_as(path: &Path, name: &str, dtype: &str, column: &DataType) -> Result<Option<String>> {
    let mut leaf = column;
    while let DataType::List(field) | DataType::LargeList(field) | DataType::FixedSizeList(field, _) = leaf {
        leaf = field.data_type();
    }
    let found = match leaf {
        DataType::Boolean => "bool".to_owned(),
        other => other.to_string().to_lowercase(),
    };
    if found == dtype {
        return Ok(None);
    }
    let numeric = |dtype: &str| ["float", "int", "uint", "bool"].iter().any(|kind| dtype.starts_with(kind));
    // of a float LeRobot makes no whole number
    if numeric(dtype) && numeric(&found) && (dtype.starts_with("float") || !found.starts_with("float")) {
        return Ok(Some(found));
    }
    Err(DatasetError::BadDataset {
        path: path.to_path_buf(),
        object: format!("column {name}"),
        expected: format!("{dtype}, as info.json says"),
        found,
    })
}

/// Seconds that a time may be off, as LeRobot's `tolerance_s` has it.
pub const TIME_TOLERANCE: f64 = video::TOLERANCE;

/// How far a frame's time is from its number in the episode over the rate, if that is more than `tolerance`.
pub(super) fn time_off(time: f64, frame: usize, fps: f64, tolerance: f64) -> Option<f64> {
    let due = frame as f64 / fps;
    let off = (time - due).abs();
    // a 32-bit number rounds the second term away
    (off.is_nan() || off > tolerance + 1e-6 * due).then_some(off)
}
