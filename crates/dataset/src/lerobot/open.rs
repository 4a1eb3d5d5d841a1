//! An opened data set: everything but pictures in memory, ready for training.

use super::check;
use super::features::MISTAKE;
use super::fingerprint::{Fingerprint, INDEX_COLUMNS};
use super::info::{Feature, Info, Provenance};
use super::meta::parse_stats;
use super::read;
use super::schema::hex;
use super::values::Values;
use crate::error::{DatasetError, InputError, Result};
use crate::shuffle::SplitMix64;
use crate::source::is_lfs_pointer;
use crate::stats::FeatureStats;
use crate::windows::{Resident, WindowSpec, Windows, unmarked};
use arrow::buffer::ScalarBuffer;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Column of a policy's proprioceptive input.
pub const STATE: &str = "observation.state";
/// Column of a policy's input about the environment.
pub const ENVIRONMENT_STATE: &str = "observation.environment_state";
/// Column of actions.
pub const ACTION: &str = "action";

/// A LeRobotDataset v3.0 directory, written by us or by LeRobot, with its numeric columns in memory.
#[derive(Debug, Clone)]
pub struct Dataset {
    root: PathBuf,
    info: Info,
    episodes: Vec<EpisodeMeta>,
    tasks: Vec<String>,
    columns: BTreeMap<String, Resident>,
    stats: BTreeMap<String, FeatureStats>,
    fingerprint: String,
    env: Option<EnvMeta>,
}

/// One episode of a data set.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EpisodeMeta {
    /// Its number, from 0.
    pub index: usize,
    /// Frames.
    pub length: usize,
    /// Its first frame in the columns.
    pub from: usize,
    /// The frame after its last.
    pub to: usize,
    /// Instructions in words.
    pub tasks: Vec<String>,
    /// Id of the demo that it was converted from.
    pub demo: Option<String>,
}

/// The environment that the demonstrations come from.
#[derive(Debug, Clone, PartialEq)]
pub struct EnvMeta {
    /// Its name.
    pub env_name: String,
    /// Simulator generation, where it is known.
    pub env_version: Option<String>,
    /// Its arguments; null where the source has none.
    pub env_args: serde_json::Value,
    /// The seeds that the demonstrations were recorded with, `FIRST-LAST`, where the source states them.
    pub seeds: Option<String>,
    /// Which of the task's experts recorded them, where it is not the usual one and the source states it.
    pub expert: Option<String>,
    /// How able whoever showed them is (`mixed`, `poor`), where that is not as usual and the source states it.
    pub skill: Option<String>,
}

/// A numeric column in memory.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Column<'a> {
    /// Row-major values.
    pub data: &'a [f32],
    /// Values a frame.
    pub dim: usize,
}

impl Dataset {
    /// Opens the directory `root` and reads its numeric columns. A data set of ours without pictures is checked
    /// against the fingerprint that was recorded when it was made.
    pub fn open(root: &Path) -> Result<Self> {
        let info = read_info(root)?;
        let tasks = read_tasks(root, &info)?;
        let episodes = read_episodes(root, &info)?;
        let columns = read_columns(root, &info, &episodes)?;
        let stats = read_stats(root)?;
        let provenance = info.actrm.as_ref();
        let env = provenance.and_then(|p| {
            p.env_name.clone().map(|env_name| EnvMeta {
                env_name,
                env_version: p.env_version.clone(),
                env_args: p.env_args.clone().unwrap_or(serde_json::Value::Null),
                seeds: p.seeds.clone(),
                expert: p.expert.clone(),
                skill: p.skill.clone(),
            })
        });
        let mut dataset =
            Self { root: root.to_path_buf(), info, episodes, tasks, columns, stats, fingerprint: String::new(), env };
        dataset.fingerprint = dataset.checked_fingerprint()?;
        Ok(dataset)
    }

    /// The fingerprint recorded, after comparing it with the content where the content is in memory.
    fn checked_fingerprint(&self) -> Result<String> {
        let recorded = self.info.actrm.as_ref().map(|p| &p.fingerprint);
        let pictures = self.has_pictures();
        if let (Some(recorded), true) = (recorded, pictures) {
            return Ok(recorded.clone());
        }
        let computed = self.numeric_fingerprint(&self.episodes);
        match recorded {
            Some(recorded) if *recorded != computed => Err(DatasetError::BadDataset {
                path: self.root.clone(),
                object: "content".to_owned(),
                expected: format!("fingerprint {recorded}, recorded when it was made"),
                found: format!("{computed}: the data were changed or damaged"),
            }),
            _ => Ok(computed),
        }
    }

    /// The fingerprint of these episodes alone: of a set of the same features that holds them and no other. Of pictures,
    /// which are not in memory, the whole set's fingerprint enters beside it.
    ///
    /// # Panics
    /// When an episode is not below the number of [`Dataset::episodes`].
    pub fn fingerprint_of(&self, episodes: &[usize]) -> String {
        let numbers = self.numeric_fingerprint(episodes.iter().map(|&episode| &self.episodes[episode]));
        match self.has_pictures() {
            true => hex(&Sha256::digest(format!("{}\n{numbers}\n", self.fingerprint))),
            false => numbers,
        }
    }

    /// The fingerprint of the columns in memory, of these episodes.
    fn numeric_fingerprint<'a>(&self, episodes: impl IntoIterator<Item = &'a EpisodeMeta>) -> String {
        let mut fingerprint = Fingerprint::new(&self.info.features, self.info.fps);
        for episode in episodes {
            fingerprint.episode(episode.length, episode.tasks.first().map_or("", String::as_str));
            for (name, digest) in self.episode_digests(episode) {
                fingerprint.column(&name, digest);
            }
        }
        fingerprint.finish()
    }

    /// Digests of an episode's numeric columns, as the fingerprint wants them.
    pub(crate) fn episode_digests(&self, episode: &EpisodeMeta) -> Vec<(String, [u8; 32])> {
        let mut digests = Vec::new();
        for (name, column) in &self.columns {
            if INDEX_COLUMNS.contains(&name.as_str()) {
                continue;
            }
            let rows = column.data[episode.from * column.dim..episode.to * column.dim].to_vec();
            let boolean = self.info.features.get(name).is_some_and(|f| f.dtype == "bool");
            let values = match boolean {
                true => Values::Bool(rows.iter().map(|&v| v != 0.0).collect()),
                false => Values::F32(rows),
            };
            digests.push((name.clone(), values.digest()));
        }
        digests
    }

    /// Where it lies.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// What it says about itself.
    pub fn info(&self) -> &Info {
        &self.info
    }

    /// Where it came from, if we converted it.
    pub fn provenance(&self) -> Option<&Provenance> {
        self.info.actrm.as_ref()
    }

    /// Its episodes in order.
    pub fn episodes(&self) -> &[EpisodeMeta] {
        &self.episodes
    }

    /// Frames over all episodes.
    pub fn frames(&self) -> usize {
        self.episodes.last().map_or(0, |e| e.to)
    }

    /// Task texts; a frame's `task_index` counts them.
    pub fn tasks(&self) -> &[String] {
        &self.tasks
    }

    /// A numeric column, if there is one of this name.
    pub fn column(&self, name: &str) -> Option<Column<'_>> {
        self.columns.get(name).map(|c| Column { data: &c.data, dim: c.dim })
    }

    /// Names of the numeric columns, sorted.
    pub fn column_names(&self) -> impl Iterator<Item = &str> {
        self.columns.keys().map(String::as_str)
    }

    /// Names of a column's numbers; empty where it does not name each.
    pub fn names(&self, column: &str) -> Vec<String> {
        self.info.features.get(column).map(Feature::number_names).unwrap_or_default()
    }

    /// The same set in memory with the numbers of a column in another order and under other names: number `i` is the one that was
    /// at `order[i]`. The fingerprint stays that of the files.
    ///
    /// # Errors
    /// A column that is not there, or an order that is none of its numbers.
    pub fn reordered(&self, column: &str, order: &[usize], names: &[String]) -> Result<Self> {
        let old = self.required(column)?;
        let mut sorted = order.to_vec();
        sorted.sort_unstable();
        if !sorted.iter().copied().eq(0..old.dim) || names.len() != old.dim {
            return Err(DatasetError::NotInDataset {
                path: self.root.clone(),
                wanted: format!("the numbers {order:?} of column {column}"),
                found: format!("0 to {}", old.dim.saturating_sub(1)),
            });
        }
        let mut data = Vec::with_capacity(old.data.len());
        for row in old.data.chunks_exact(old.dim.max(1)) {
            data.extend(order.iter().map(|&from| row[from]));
        }
        let mut dataset = self.clone();
        dataset.columns.insert(column.to_owned(), Resident { data: data.into(), dim: old.dim });
        // those of all episodes, as they are stored, are of the other order
        dataset.stats.remove(column);
        if let Some((_, feature)) = dataset.info.features.0.iter_mut().find(|(name, _)| name == column) {
            feature.names = serde_json::Value::from(names.to_vec());
        }
        Ok(dataset)
    }

    /// Statistics over all episodes as they are stored; empty where the directory has none.
    pub fn stats(&self) -> &BTreeMap<String, FeatureStats> {
        &self.stats
    }

    /// Statistics of the numeric columns over some episodes, computed now.
    pub fn statistics_of(&self, episodes: &[usize]) -> Result<BTreeMap<String, FeatureStats>> {
        let ranges = self.ranges(episodes)?;
        let mut all = BTreeMap::new();
        for (name, column) in &self.columns {
            let pieces: Vec<&[f32]> =
                ranges.iter().map(|&(from, to)| &column.data[from * column.dim..to * column.dim]).collect();
            if let Some(stats) = FeatureStats::of_rows(&pieces, column.dim) {
                all.insert(name.clone(), stats);
            }
        }
        Ok(all)
    }

    /// Statistics over several columns of one length together, as if each frame of each were a frame; `None` over no
    /// frames.
    pub fn pooled_statistics(&self, columns: &[String], episodes: &[usize]) -> Result<Option<FeatureStats>> {
        let ranges = self.ranges(episodes)?;
        let residents = columns.iter().map(|name| self.required(name)).collect::<Result<Vec<_>>>()?;
        let Some(first) = residents.first() else { return Ok(None) };
        if let Some((name, other)) = columns.iter().zip(&residents).find(|(_, column)| column.dim != first.dim) {
            return Err(DatasetError::NotInDataset {
                path: self.root.clone(),
                wanted: format!("column {name} of {} numbers, as {}", first.dim, columns[0]),
                found: format!("{} numbers", other.dim),
            });
        }
        let pieces: Vec<&[f32]> = residents
            .iter()
            .flat_map(|column| ranges.iter().map(|&(from, to)| &column.data[from * column.dim..to * column.dim]))
            .collect();
        Ok(FeatureStats::of_rows(&pieces, first.dim))
    }

    /// sha256 of the content in hexadecimal: the same for the same demonstrations and choice of columns, however
    /// they are stored. For sets that LeRobot wrote it covers the numeric columns.
    pub fn fingerprint(&self) -> &str {
        &self.fingerprint
    }

    /// The environment that the demonstrations come from, where that is known.
    pub fn env(&self) -> Option<&EnvMeta> {
        self.env.as_ref()
    }

    /// Episodes of a mask (`train`, `valid`, ...), ascending; of a named range for sets that LeRobot wrote.
    pub fn split(&self, name: &str) -> Option<Vec<usize>> {
        if let Some(provenance) = &self.info.actrm {
            return provenance.masks.get(name).cloned();
        }
        let (from, to) = self.info.splits.get(name)?.split_once(':')?;
        let (from, to) = (from.trim().parse::<usize>().ok()?, to.trim().parse::<usize>().ok()?);
        (from <= to && to <= self.episodes.len()).then(|| (from..to).collect())
    }

    /// As [`Dataset::split`].
    ///
    /// # Errors
    /// [`DatasetError::NotInDataset`] with the names that there are.
    pub fn required_split(&self, name: &str) -> Result<Vec<usize>> {
        self.split(name).ok_or_else(|| DatasetError::NotInDataset {
            path: self.root.clone(),
            wanted: format!("split {name}"),
            found: match self.split_names().join(", ") {
                none if none.is_empty() => "none".to_owned(),
                names => names,
            },
        })
    }

    /// Names that [`Dataset::split`] knows.
    pub fn split_names(&self) -> Vec<&str> {
        match &self.info.actrm {
            Some(provenance) => provenance.masks.keys().map(String::as_str).collect(),
            None => self.info.splits.keys().map(String::as_str).collect(),
        }
    }

    /// `count` of `episodes`, chosen by `seed`, ascending. With one seed a smaller choice lies in every larger.
    pub fn subset(&self, episodes: &[usize], count: usize, seed: u64) -> Result<Vec<usize>> {
        if count == 0 || count > episodes.len() {
            return Err(DatasetError::NotInDataset {
                path: self.root.clone(),
                wanted: format!("{count} demos"),
                found: format!("{} to choose from", episodes.len()),
            });
        }
        self.ranges(episodes)?;
        let mut chosen = episodes.to_vec();
        SplitMix64::new(seed, 0).shuffle(&mut chosen);
        chosen.truncate(count);
        chosen.sort_unstable();
        Ok(chosen)
    }

    /// Windows over some episodes.
    pub fn windows(&self, spec: &WindowSpec) -> Result<Windows> {
        for (count, of) in [(spec.action_horizon, "actions"), (spec.n_obs_steps, "observations")] {
            if count == 0 {
                return Err(DatasetError::NotInDataset {
                    path: self.root.clone(),
                    wanted: format!("window of 0 {of}"),
                    found: "1 or more to ask for".to_owned(),
                });
            }
        }
        let mut ranges = self.ranges(&spec.episodes)?;
        if let Some(marks) = self.columns.get(MISTAKE).filter(|_| !spec.mistakes) {
            ranges = unmarked(&ranges, |frame| marks.data[frame] != 0.0);
        }
        let columns = spec.observation.iter().map(|name| Ok((name.clone(), self.required(name)?)));
        let observation = columns.collect::<Result<_>>()?;
        let lengths = (spec.n_obs_steps, spec.action_horizon);
        Ok(Windows::new(observation, self.required(ACTION)?, lengths, &ranges))
    }

    pub(crate) fn required(&self, name: &str) -> Result<Resident> {
        self.columns.get(name).cloned().ok_or_else(|| DatasetError::NotInDataset {
            path: self.root.clone(),
            wanted: format!("column {name}"),
            found: self.column_names().collect::<Vec<_>>().join(", "),
        })
    }

    pub(crate) fn ranges(&self, episodes: &[usize]) -> Result<Vec<(usize, usize)>> {
        let range = |&index: &usize| {
            let episode = self.episodes.get(index).ok_or_else(|| DatasetError::NotInDataset {
                path: self.root.clone(),
                wanted: format!("episode {index}"),
                found: format!("0 to {}", self.episodes.len().saturating_sub(1)),
            })?;
            Ok((episode.from, episode.to))
        };
        episodes.iter().map(range).collect()
    }
}

/// A JSON file.
pub(crate) fn read_json<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T> {
    serde_json::from_slice(&read_file(path)?).map_err(|source| no_json(path, source))
}

/// The error of a JSON file that is none, or not the one that belongs there.
fn no_json(path: &Path, source: serde_json::Error) -> DatasetError {
    match is_lfs_pointer(path) {
        true => InputError::LfsPointer { path: path.to_path_buf() }.into(),
        false => DatasetError::Json { path: path.to_path_buf(), source },
    }
}

fn read_file(path: &Path) -> Result<Vec<u8>> {
    std::fs::read(path).map_err(|source| DatasetError::Io { path: path.to_path_buf(), operation: "read it", source })
}

/// `meta/info.json`, checked for a version that is understood.
pub(crate) fn read_info(root: &Path) -> Result<Info> {
    let path = root.join("meta/info.json");
    if !path.exists() {
        let found = if root.is_dir() {
            "a folder without it"
        } else if root.exists() {
            "a file"
        } else {
            "nothing at that path"
        };
        return Err(DatasetError::BadDataset {
            path: root.to_path_buf(),
            object: "data set".to_owned(),
            expected: "a LeRobotDataset v3.0 directory with meta/info.json".to_owned(),
            found: found.to_owned(),
        });
    }
    let text = read_file(&path)?;
    let info: Info = serde_json::from_slice(&text).map_err(|source| no_json(&path, source))?;
    if !info.codebase_version.starts_with("v3.") {
        return Err(DatasetError::BadDataset {
            path,
            object: "codebase_version".to_owned(),
            expected: "v3.0".to_owned(),
            found: info.codebase_version,
        });
    }
    check::info(&path, &text, &info)?;
    Ok(info)
}

fn read_stats(root: &Path) -> Result<BTreeMap<String, FeatureStats>> {
    let path = root.join("meta/stats.json");
    if !path.exists() {
        return Ok(BTreeMap::new());
    }
    let value = read_json(&path)?;
    parse_stats(&value).map_err(|found| DatasetError::BadDataset {
        path,
        object: "statistics".to_owned(),
        expected: "min, max, mean, std and count of every feature".to_owned(),
        found,
    })
}

fn read_tasks(root: &Path, info: &Info) -> Result<Vec<String>> {
    let path = root.join("meta/tasks.parquet");
    if info.total_tasks == 0 && !path.exists() {
        return Ok(Vec::new());
    }
    // pandas calls an index without a name `__index_level_0__`
    let (rows, arrays) = match read::columns(&path, &["task_index", "task"]) {
        Err(DatasetError::NotInDataset { .. }) => read::columns(&path, &["task_index", "__index_level_0__"])?,
        other => other?,
    };
    let indices = read::integers(&path, "task_index", &arrays[0])?;
    let texts = read::texts(&path, "task", &arrays[1])?;
    if rows != info.total_tasks || indices.iter().enumerate().any(|(i, &index)| index != i as i64) {
        return Err(DatasetError::BadDataset {
            path,
            object: "column task_index".to_owned(),
            expected: format!("{} tasks from 0 on, in order, as info.json says", info.total_tasks),
            found: format!("{rows}: {:?}", &indices[..indices.len().min(10)]),
        });
    }
    Ok(texts)
}

/// The episodes, checked to follow each other.
pub(crate) fn read_episodes(root: &Path, info: &Info) -> Result<Vec<EpisodeMeta>> {
    let mut episodes: Vec<EpisodeMeta> = Vec::new();
    let demos = info.actrm.as_ref().map_or(&[][..], |p| &p.demos);
    for path in read::files(root, "meta/episodes")? {
        let names = ["episode_index", "tasks", "length", "dataset_from_index", "dataset_to_index"];
        let (rows, arrays) = read::columns(&path, &names)?;
        let tasks = read::text_lists(&path, names[1], &arrays[1])?;
        let index = read::integers(&path, names[0], &arrays[0])?;
        let length = read::integers(&path, names[2], &arrays[2])?;
        let from = read::integers(&path, names[3], &arrays[3])?;
        let to = read::integers(&path, names[4], &arrays[4])?;
        for (row, tasks) in (0..rows).zip(tasks) {
            let number = episodes.len();
            let start = episodes.last().map_or(0, |e| e.to);
            let good = index[row] == number as i64
                && from[row] == start as i64
                && length[row] >= 0
                && to[row].checked_sub(from[row]) == Some(length[row]);
            if !good {
                return Err(DatasetError::BadDataset {
                    path,
                    object: format!("row {number}"),
                    expected: format!("episode {number} from frame {start}, as long as it says"),
                    found: format!("episode {} from {} to {}, length {}", index[row], from[row], to[row], length[row]),
                });
            }
            episodes.push(EpisodeMeta {
                index: number,
                length: length[row] as usize,
                from: start,
                to: to[row] as usize,
                tasks,
                demo: demos.get(number).cloned(),
            });
        }
    }
    let frames = episodes.last().map_or(0, |e| e.to);
    if (episodes.len(), frames) != (info.total_episodes, info.total_frames) {
        return Err(DatasetError::BadDataset {
            path: root.to_path_buf(),
            object: "meta/episodes".to_owned(),
            expected: format!("{} episodes with {} frames, as info.json says", info.total_episodes, info.total_frames),
            found: format!("{} with {frames}", episodes.len()),
        });
    }
    Ok(episodes)
}

fn read_columns(root: &Path, info: &Info, episodes: &[EpisodeMeta]) -> Result<BTreeMap<String, Resident>> {
    // whole numbers do not fit f32; the index columns follow from the episodes
    let wanted: Vec<(&str, &Feature)> = info
        .features
        .0
        .iter()
        .filter(|(name, f)| !INDEX_COLUMNS.contains(&name.as_str()) && !f.is_visual() && f.dtype != "string")
        .map(|(name, f)| (name.as_str(), f))
        .collect();
    let mut names: Vec<&str> = wanted.iter().map(|(name, _)| *name).collect();
    names.push("episode_index");
    let timed = info.features.get("timestamp").is_some();
    if timed {
        names.push("timestamp");
    }
    let mut pieces: Vec<Vec<Resident>> = wanted.iter().map(|_| Vec::new()).collect();
    let mut row = 0;
    let mut episode = 0;
    for path in read::files(root, "data")? {
        let (rows, arrays) = read::columns(&path, &names)?;
        for ((name, feature), (array, out)) in wanted.iter().zip(arrays.iter().zip(&mut pieces)) {
            check::stored_as(&path, name, &feature.dtype, array.data_type())?;
            out.push(read::numbers(&path, name, array, feature.dim())?);
        }
        let owners = read::integers(&path, "episode_index", &arrays[wanted.len()])?;
        if timed {
            let times = read::numbers(&path, "timestamp", &arrays[wanted.len() + 1], 1)?;
            check::rate(&path, info.fps, episodes, row, &times.data)?;
        }
        for &owner in owners.iter() {
            while episodes.get(episode).is_some_and(|e| row >= e.to) {
                episode += 1;
            }
            if episodes.get(episode).is_none() || owner != episode as i64 {
                return Err(DatasetError::BadDataset {
                    path,
                    object: format!("frame {row}"),
                    expected: format!("episode {episode} of {}", episodes.len()),
                    found: format!("episode_index {owner}"),
                });
            }
            row += 1;
        }
        debug_assert!(rows == owners.len());
    }
    if row != info.total_frames {
        return Err(DatasetError::BadDataset {
            path: root.to_path_buf(),
            object: "data".to_owned(),
            expected: format!("{} frames", info.total_frames),
            found: row.to_string(),
        });
    }
    let mut columns = BTreeMap::new();
    for ((name, feature), mut files) in wanted.into_iter().zip(pieces) {
        let data = match files.len() {
            1 => files.swap_remove(0).data,
            _ => ScalarBuffer::from(files.iter().flat_map(|f| f.data.iter().copied()).collect::<Vec<f32>>()),
        };
        columns.insert(name.to_owned(), Resident { data, dim: feature.dim() });
    }
    Ok(columns)
}
