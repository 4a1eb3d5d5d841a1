//! The numeric columns of a data set, as they pass from its files: checked on the way, and kept or only hashed.

use super::check::{self, TIME_TOLERANCE};
use super::fingerprint::{Fingerprint, INDEX_COLUMNS};
use super::info::{Feature, Info};
use super::open::EpisodeMeta;
use super::read;
use crate::error::{DatasetError, Result};
use crate::windows::Resident;
use arrow_array::{Array, ArrayRef};
use arrow_buffer::ScalarBuffer;
use sha2::{Digest, Sha256};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Rows that pass at a time where they are not kept.
pub(super) const SCANNED: usize = 4096;

/// The features whose numbers are kept: whole numbers do not fit f32, and the index columns follow from the episodes.
fn numeric(info: &Info) -> impl Iterator<Item = (&str, &Feature)> {
    let wanted = |(name, f): &(&str, &Feature)| !INDEX_COLUMNS.contains(name) && !f.is_visual() && !f.is_text();
    info.features.0.iter().map(|(name, f)| (name.as_str(), f)).filter(wanted)
}

/// Gives the numeric columns to `take`, a file or `rows` rows at a time; `owned`: each frame must be of the episode that it
/// lies in.
pub(super) fn read_columns(
    root: &Path,
    info: &Info,
    episodes: &[EpisodeMeta],
    owned: bool,
    rows_at_once: Option<usize>,
    notes: &mut Vec<String>,
    take: &mut dyn FnMut(Vec<Resident>),
) -> Result<()> {
    let wanted: Vec<(&str, &Feature)> = numeric(info).collect();
    let mut names: Vec<&str> = wanted.iter().map(|(name, _)| *name).collect();
    let timed = owned && info.features.get("timestamp").is_some();
    if owned {
        names.push("episode_index");
    }
    if timed {
        names.push("timestamp");
    }
    let mut casts: BTreeMap<&str, String> = BTreeMap::new();
    let (mut late, mut unstated) = (Late::default(), BTreeSet::new());
    let (mut row, mut episode) = (0, 0);
    for path in read::files(root, "data")? {
        let builder = read::open(&path)?;
        if let Some(name) = info.features.in_data().find(|name| builder.schema().index_of(name).is_err()) {
            return Err(read::missing_column(&path, &format!("{name}, which meta/info.json states"), &builder));
        }
        for field in builder.schema().fields().iter().filter(|_| owned) {
            if info.features.get(field.name()).is_none() {
                unstated.insert(field.name().clone());
            }
        }
        if names.is_empty() {
            row += read::columns_there(&path, &[])?.0;
            continue;
        }
        let mut pass = |arrays: Vec<ArrayRef>| -> Result<()> {
            let mut passing = Vec::with_capacity(wanted.len());
            for ((name, feature), array) in wanted.iter().zip(&arrays) {
                let other = check::stored_as(&path, name, &feature.dtype, array.data_type())?;
                let Some(other) = other else {
                    passing.push(read::numbers(&path, name, array, feature.dim())?);
                    continue;
                };
                passing.push(read::numbers_as(&path, name, array, feature.dim(), &feature.dtype)?);
                casts.entry(name).or_insert(other);
            }
            take(passing);
            let first = row;
            row += arrays[0].len();
            if !owned {
                return Ok(());
            }
            let owners = read::integers(&path, "episode_index", &arrays[wanted.len()])?;
            let times = match timed {
                true => Some(read::numbers(&path, "timestamp", &arrays[wanted.len() + 1], 1)?.data),
                false => None,
            };
            for (at, &owner) in owners.iter().enumerate() {
                let frame = first + at;
                while episodes.get(episode).is_some_and(|e| frame >= e.to) {
                    episode += 1;
                }
                let Some(mine) = episodes.get(episode).filter(|_| owner == episode as i64) else {
                    return Err(DatasetError::BadDataset {
                        path: path.clone(),
                        object: format!("frame {frame}"),
                        expected: format!("episode {episode} of {}", episodes.len()),
                        found: format!("episode_index {owner}"),
                    });
                };
                if let Some(times) = &times {
                    late.look(f64::from(times[at]), mine, frame - mine.from, info.fps);
                }
            }
            Ok(())
        };
        match rows_at_once {
            None => pass(read::columns(&path, &names)?.1)?,
            Some(rows) => {
                for arrays in read::batches(&path, &names, rows)? {
                    pass(arrays?)?;
                }
            }
        }
    }
    let frames = episodes.last().map_or(0, |e| e.to);
    if row != frames {
        return Err(DatasetError::BadDataset {
            path: root.to_path_buf(),
            object: "data".to_owned(),
            expected: format!("{frames} frames, as the episodes say"),
            found: row.to_string(),
        });
    }
    for (name, found) in casts {
        let dtype = info.features.get(name).map_or("", |feature| &feature.dtype);
        notes.push(format!("column {name}: expected {dtype}, as info.json says, found {found}: cast, as LeRobot does"));
    }
    notes.extend(unstated.into_iter().map(|name| {
        let fate = match INDEX_COLUMNS.contains(&name.as_str()) {
            true => "`edit` writes a set that states it",
            false => "it is left out, with its values",
        };
        format!(
            "column {name}: meta/info.json states no such feature, and LeRobot opens no set with such a column: {fate}"
        )
    }));
    notes.extend(late.note());
    Ok(())
}

/// [`read_columns`] that keeps each numeric column, its files put together.
pub(super) fn resident(
    root: &Path,
    info: &Info,
    episodes: &[EpisodeMeta],
    owned: bool,
    notes: &mut Vec<String>,
) -> Result<BTreeMap<String, Resident>> {
    let mut pieces: Vec<Vec<Resident>> = Vec::new();
    read_columns(root, info, episodes, owned, None, notes, &mut |of_file| {
        pieces.resize_with(of_file.len(), Vec::new);
        pieces.iter_mut().zip(of_file).for_each(|(all, numbers)| all.push(numbers));
    })?;
    let mut columns = BTreeMap::new();
    for ((name, feature), mut files) in numeric(info).zip(pieces) {
        let data = match files.len() {
            1 => files.swap_remove(0).data,
            _ => ScalarBuffer::from(files.iter().flat_map(|f| f.data.iter().copied()).collect::<Vec<f32>>()),
        };
        columns.insert(name.to_owned(), Resident { data, dim: feature.dim() });
    }
    Ok(columns)
}

/// The fingerprint of numeric columns that pass.
pub(super) struct Passing<'a> {
    columns: Vec<(&'a str, bool, Sha256)>,
    episodes: &'a [EpisodeMeta],
    /// Frames that have passed.
    frames: usize,
    /// The episode of the next frame.
    episode: usize,
    fingerprint: Fingerprint,
}

impl<'a> Passing<'a> {
    pub(super) fn new(info: &'a Info, episodes: &'a [EpisodeMeta]) -> Self {
        let columns = numeric(info).map(|(name, feature)| (name, feature.dtype == "bool", Sha256::new())).collect();
        Self { columns, episodes, frames: 0, episode: 0, fingerprint: Fingerprint::new(&info.features, info.fps) }
    }

    pub(super) fn take(&mut self, numbers: &[Resident]) {
        let rows = numbers.first().map_or(0, |column| column.data.len() / column.dim.max(1));
        let mut from = 0;
        while from < rows {
            self.close_episodes();
            // frames of no episode are counted, and refused, by whoever reads them
            let Some(episode) = self.episodes.get(self.episode) else { return };
            let to = rows.min(from + episode.to - self.frames);
            for ((_, boolean, hash), column) in self.columns.iter_mut().zip(numbers) {
                let values = &column.data[from * column.dim..to * column.dim];
                match boolean {
                    true => hash.update(values.iter().map(|&v| u8::from(v != 0.0)).collect::<Vec<_>>()),
                    false => hash.update(values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<_>>()),
                }
            }
            self.frames += to - from;
            from = to;
        }
    }

    /// Closes the episodes whose last frame has passed.
    fn close_episodes(&mut self) {
        while let Some(episode) = self.episodes.get(self.episode).filter(|e| e.to == self.frames) {
            self.fingerprint.episode(episode.length, episode.tasks.first().map_or("", String::as_str));
            for (name, _, hash) in &mut self.columns {
                self.fingerprint.column(name, hash.finalize_reset().into());
            }
            self.episode += 1;
        }
    }

    pub(super) fn finish(mut self) -> String {
        self.close_episodes();
        self.fingerprint.finish()
    }
}

/// Frames whose times are not those of the rate.
#[derive(Default)]
struct Late {
    frames: usize,
    /// Seconds.
    most: f64,
    /// Episode and frame of the first.
    first: (usize, usize),
}

impl Late {
    fn look(&mut self, time: f64, episode: &EpisodeMeta, frame: usize, fps: f64) {
        if let Some(off) = check::time_off(time, frame, fps, TIME_TOLERANCE) {
            if self.frames == 0 {
                self.first = (episode.index, frame);
            }
            self.frames += 1;
            if off.is_nan() || off > self.most {
                self.most = off;
            }
        }
    }

    fn note(self) -> Option<String> {
        let Self { frames, most, first: (episode, frame) } = self;
        (frames > 0).then(|| {
            format!(
                "timestamp: {frames} frames are not at frame_index / fps, by up to {most:.6} s (LeRobot's tolerance_s is \
                 {TIME_TOLERANCE} s); the first is frame {frame} of episode {episode}"
            )
        })
    }
}
