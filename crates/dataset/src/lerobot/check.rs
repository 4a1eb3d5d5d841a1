//! What `info.json` says, held against itself and against the frames whenever a data set is opened.
//!
//! Each check is cheap: a hash of one small file, the types of columns, the times of frames. An edited number is refused, or nothing
//! that is trained on depends on it (the sizes at which a writer closes files).

use super::fingerprint::INDEX_COLUMNS;
use super::info::Info;
use super::open::EpisodeMeta;
use super::schema::hex;
use crate::error::{DatasetError, Result};
use arrow::datatypes::DataType;
use serde_json::Value;
use sha2::{Digest, Sha256};
use std::path::Path;

/// Seconds that a time may be off, as LeRobot has it, and the share of it that a 32-bit number may round away.
const TIME_TOLERANCE: (f64, f64) = (1e-4, 1e-6);

/// Records in `info` the hash of everything else in it.
pub(super) fn sealed(mut info: Info, root: &Path) -> Result<Info> {
    let failed = |source| DatasetError::Json { path: root.join("meta/info.json"), source };
    // hashed as it will be read: numbers pass through text
    let text = serde_json::to_vec(&info).map_err(failed)?;
    let seal = seal(&serde_json::from_slice(&text).map_err(failed)?);
    if let Some(provenance) = &mut info.actrm {
        provenance.seal = Some(seal);
    }
    Ok(info)
}

/// sha256 of a JSON value whatever its spaces and the order of its keys, but for `/actrm/seal`.
fn seal(value: &Value) -> String {
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

/// Checks `info` (of the file `path`, whose content is `text`) by itself.
pub(super) fn info(path: &Path, text: &[u8], info: &Info) -> Result<()> {
    let bad = |object: &str, expected: String, found: String| {
        Err(DatasetError::BadDataset { path: path.to_path_buf(), object: object.to_owned(), expected, found })
    };
    if let Some(provenance) = &info.actrm {
        if provenance.format != 1 {
            return bad("actrm.format", "1".to_owned(), provenance.format.to_string());
        }
        if let Some(expected) = &provenance.seal {
            let value = serde_json::from_slice(text)
                .map_err(|source| DatasetError::Json { path: path.to_path_buf(), source })?;
            let found = seal(&value);
            if found != *expected {
                let found = format!("{found}: something in it was changed");
                return bad("content", format!("sha256 {expected}, recorded when it was made (actrm.seal)"), found);
            }
        }
        if provenance.demos.len() != info.total_episodes {
            let expected = format!("an id for each of {} episodes", info.total_episodes);
            return bad("actrm.demos", expected, provenance.demos.len().to_string());
        }
        for (name, episodes) in &provenance.masks {
            if let Some(episode) = episodes.iter().find(|&&e| e >= info.total_episodes) {
                let expected = format!("episodes below {}", info.total_episodes);
                return bad(&format!("actrm.masks.{name}"), expected, episode.to_string());
            }
        }
    }
    if !(info.fps.is_finite() && info.fps > 0.0) {
        return bad("fps", "a number above 0".to_owned(), info.fps.to_string());
    }
    for (name, feature) in &info.features.0 {
        if INDEX_COLUMNS.contains(&name.as_str()) && feature.dim() != 1 {
            return bad(&format!("features.{name}.shape"), "[1]".to_owned(), format!("{:?}", feature.shape));
        }
    }
    splits(info).or_else(|(expected, found)| bad("splits", expected, found))
}

/// Named ranges lie side by side and leave no episode out.
fn splits(info: &Info) -> Result<(), (String, String)> {
    let total = info.total_episodes;
    let mut ranges = Vec::with_capacity(info.splits.len());
    for (name, text) in &info.splits {
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
    let found = info.splits.iter().map(|(name, text)| format!("{name} {text}")).collect::<Vec<_>>().join(", ");
    Err((format!("each of {total} episodes in one of them"), found))
}

/// A column's type in the file `path` is the one that `info.json` gives it.
pub(super) fn stored_as(path: &Path, name: &str, dtype: &str, column: &DataType) -> Result<()> {
    let mut leaf = column;
    while let DataType::List(field) | DataType::LargeList(field) | DataType::FixedSizeList(field, _) = leaf {
        leaf = field.data_type();
    }
    let found = match leaf {
        DataType::Boolean => "bool".to_owned(),
        other => other.to_string().to_lowercase(),
    };
    if found == dtype {
        return Ok(());
    }
    Err(DatasetError::BadDataset {
        path: path.to_path_buf(),
        object: format!("column {name}"),
        expected: format!("{dtype}, as info.json says"),
        found,
    })
}

/// The times of the frames from row `first` on follow from their number in the episode and the rate.
pub(super) fn rate(path: &Path, fps: f64, episodes: &[EpisodeMeta], first: usize, times: &[f32]) -> Result<()> {
    let mut episode = episodes.partition_point(|e| e.to <= first);
    for (row, &time) in (first..).zip(times) {
        while episodes.get(episode).is_some_and(|e| row >= e.to) {
            episode += 1;
        }
        // rows beyond the last episode are refused where they are counted
        let Some(start) = episodes.get(episode).map(|e| e.from) else { return Ok(()) };
        let (time, expected) = (f64::from(time), (row - start) as f64 / fps);
        let close = (time - expected).abs() <= TIME_TOLERANCE.0 + TIME_TOLERANCE.1 * expected;
        if !close {
            return Err(DatasetError::BadDataset {
                path: path.to_path_buf(),
                object: format!("timestamp of frame {row}"),
                expected: format!("{expected} s, frame {} of episode {episode} at {fps} a second", row - start),
                found: time.to_string(),
            });
        }
    }
    Ok(())
}
