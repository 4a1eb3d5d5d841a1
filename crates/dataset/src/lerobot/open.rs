//! An opened data set: everything but pictures in memory, ready for training.

use super::check;
use super::columns::{Passing, SCANNED, read_columns, resident};
use super::features::MISTAKE;
use super::fingerprint::{Fingerprint, INDEX_COLUMNS};
use super::info::{Feature, Info, Provenance};
use super::meta::{PROVENANCE_FILE, are_finite, parse_stats, python_json};
use super::read;
use super::schema::hex;
use super::sharded::refuse as refuse_shard;
use super::values::Values;
use crate::error::{DatasetError, Result};
use crate::stats::FeatureStats;
use crate::windows::{Resident, WindowSpec, Windows, unmarked};
use serde_json::Value;
use sha2::{Digest, Sha256};
use std::collections::{BTreeMap, HashMap};
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
    /// The number that frames have of each task: from 0 on, unless the table is in disorder.
    task_numbers: Vec<i64>,
    /// The row of each episode in the table of episodes, where that is not its number.
    table_rows: Option<Vec<usize>>,
    notes: Vec<String>,
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

/// A column of texts, each of which is kept once.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Texts {
    /// The different texts, in order of first use.
    pub texts: Vec<String>,
    /// Each frame's place in `texts`; [`Texts::NONE`] where it has no text.
    pub frames: Vec<u32>,
}

impl Texts {
    /// The number of a frame without a text.
    pub const NONE: u32 = u32::MAX;

    /// The text of a frame, if it has one.
    pub fn get(&self, frame: usize) -> Option<&str> {
        let number = *self.frames.get(frame)?;
        self.texts.get(number as usize).map(String::as_str)
    }

    /// Takes the next frame's; `numbers` are those of the texts so far.
    fn push(&mut self, text: Option<&str>, numbers: &mut HashMap<String, u32>) {
        let number = match text {
            None => Self::NONE,
            Some(text) => numbers.get(text).copied().unwrap_or_else(|| {
                let number = self.texts.len() as u32;
                self.texts.push(text.to_owned());
                numbers.insert(text.to_owned(), number);
                number
            }),
        };
        self.frames.push(number);
    }
}

impl Dataset {
    /// Opens the directory `root` and reads its numeric columns. A data set of ours without pictures is checked
    /// against the fingerprint that was recorded when it was made. What LeRobot accepts and is not as it should be is read as
    /// LeRobot reads it and named in [`Dataset::notes`].
    pub fn open(root: &Path) -> Result<Self> {
        let (mut dataset, mut notes) = Self::open_tables(root)?;
        dataset.columns = resident(root, &dataset.info, &dataset.episodes, true, &mut notes)?;
        dataset.complete(notes, |set| set.content_fingerprint())
    }

    /// [`Dataset::open`], with its checks, for what copies a set: the numeric columns pass and are not kept.
    pub(super) fn open_scanned(root: &Path) -> Result<Self> {
        let (dataset, mut notes) = Self::open_tables(root)?;
        let mut passing = Passing::new(&dataset.info, &dataset.episodes);
        read_columns(root, &dataset.info, &dataset.episodes, true, Some(SCANNED), &mut notes, &mut |numbers| {
            passing.take(&numbers);
        })?;
        let computed = passing.finish();
        dataset.complete(notes, |_| computed)
    }

    /// [`Self::open_scanned`] of what was just written of rows that were looked at: their content hashes to `fingerprint`.
    pub(super) fn open_written(root: &Path, fingerprint: &str) -> Result<Self> {
        let (dataset, notes) = Self::open_tables(root)?;
        dataset.complete(notes, |_| fingerprint.to_owned())
    }

    /// Everything but the frames.
    fn open_tables(root: &Path) -> Result<(Self, Vec<String>)> {
        let mut notes = Vec::new();
        let mut info = read_info(root)?;
        let table = read_tasks(root, &info)?;
        let episodes = read_episodes(root, &info)?;
        correct_totals(&mut info, &episodes, table.texts.len(), &mut notes);
        if let Some(provenance) = &info.actrm {
            check::origin(root, provenance, episodes.len())?;
        }
        check::leave_out_stale_splits(&mut info, &mut notes);
        let (task_numbers, tasks) = table.read_as(root, &episodes, &mut notes)?;
        let dataset = Self::of(root, info, episodes, (task_numbers, tasks), BTreeMap::new(), Vec::new())?;
        Ok((dataset, notes))
    }

    /// Once its columns have passed: their content hashes to `computed`.
    fn complete(mut self, mut notes: Vec<String>, computed: impl FnOnce(&Self) -> String) -> Result<Self> {
        notes.append(&mut self.notes);
        self.notes = notes;
        self.fingerprint = self.checked_fingerprint(computed)?;
        Ok(self)
    }

    /// A data set whose episodes and tasks were derived from its frames, with the row of each episode in the table of episodes.
    pub(super) fn derived(
        root: &Path,
        info: Info,
        episodes: Vec<EpisodeMeta>,
        tasks: (Vec<i64>, Vec<String>),
        table_rows: Option<Vec<usize>>,
    ) -> Result<Self> {
        let mut notes = Vec::new();
        let columns = resident(root, &info, &episodes, false, &mut notes)?;
        let mut dataset = Self::of(root, info, episodes, tasks, columns, notes)?;
        dataset.table_rows = table_rows;
        dataset.fingerprint = dataset.content_fingerprint();
        Ok(dataset)
    }

    fn of(
        root: &Path,
        info: Info,
        episodes: Vec<EpisodeMeta>,
        (task_numbers, tasks): (Vec<i64>, Vec<String>),
        columns: BTreeMap<String, Resident>,
        mut notes: Vec<String>,
    ) -> Result<Self> {
        let stats = read_stats(root, &mut notes)?;
        let env = info.actrm.as_ref().and_then(|p| {
            p.env_name.clone().map(|env_name| EnvMeta {
                env_name,
                env_version: p.env_version.clone(),
                env_args: p.env_args.clone().unwrap_or(serde_json::Value::Null),
                seeds: p.seeds.clone(),
                expert: p.expert.clone(),
                skill: p.skill.clone(),
            })
        });
        let (root, fingerprint, table_rows) = (root.to_path_buf(), String::new(), None);
        Ok(Self { root, info, episodes, tasks, columns, stats, fingerprint, env, task_numbers, table_rows, notes })
    }

    /// What is not as it should be and was read as LeRobot reads it.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// The text of the task that frames call `number`.
    pub(super) fn task(&self, number: i64) -> Option<&str> {
        self.task_numbers.iter().position(|&n| n == number).map(|at| self.tasks[at].as_str())
    }

    /// The row of an episode in the table of episodes, which may not be there.
    pub(super) fn table_row(&self, episode: usize) -> usize {
        self.table_rows.as_ref().map_or(episode, |rows| rows[episode])
    }

    /// What the table of episodes says in each row, in the order of the episodes.
    pub(super) fn in_order<T: Clone>(&self, rows: Vec<T>) -> Result<Vec<T>> {
        let Some(order) = &self.table_rows else { return Ok(rows) };
        let found = rows.len();
        order.iter().map(|&row| rows.get(row).cloned()).collect::<Option<_>>().ok_or_else(|| DatasetError::BadDataset {
            path: self.root.join("meta/episodes"),
            object: "rows".to_owned(),
            expected: format!(
                "one for each of {} episodes, for what it says of videos and images",
                self.episodes.len()
            ),
            found: found.to_string(),
        })
    }

    /// Says at what size files of a set that is made of this one are closed, in MiB.
    pub(super) fn limit_files(&mut self, data: f64, video: f64) {
        (self.info.data_files_size_in_mb, self.info.video_files_size_in_mb) = (data, video);
    }

    /// Leaves out where it came from: what follows is a set of its own.
    pub(super) fn forget_provenance(&mut self) {
        (self.info.actrm, self.env) = (None, None);
        self.episodes.iter_mut().for_each(|episode| episode.demo = None);
    }

    /// The fingerprint of the columns in memory.
    pub(super) fn content_fingerprint(&self) -> String {
        self.numeric_fingerprint(&self.episodes)
    }

    /// The fingerprint recorded, after comparing it with the content where the content is in memory.
    fn checked_fingerprint(&self, computed: impl FnOnce(&Self) -> String) -> Result<String> {
        let recorded = self.info.actrm.as_ref().map(|p| &p.fingerprint);
        let pictures = self.has_pictures();
        if let (Some(recorded), true) = (recorded, pictures) {
            return Ok(recorded.clone());
        }
        let computed = computed(self);
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

    /// Each frame's task, counted in [`Self::tasks`]; nothing where frames have no `task_index`.
    ///
    /// # Errors
    /// Files that cannot be read, and a number that no task has.
    pub fn frame_tasks(&self) -> Result<Option<Vec<usize>>> {
        let mut all = Vec::with_capacity(self.frames());
        // the first of two tasks of one number counts
        let places: HashMap<i64, usize> =
            self.task_numbers.iter().enumerate().rev().map(|(at, &number)| (number, at)).collect();
        for path in read::files(&self.root, "data")? {
            let (_, arrays) = match read::columns(&path, &["task_index"]) {
                Err(DatasetError::NotInDataset { .. }) => return Ok(None),
                columns => columns?,
            };
            for &number in read::integers(&path, "task_index", &arrays[0])?.iter() {
                let at = places.get(&number).copied();
                all.push(at.ok_or_else(|| DatasetError::BadDataset {
                    path: path.clone(),
                    object: "column task_index".to_owned(),
                    expected: format!("numbers of meta/tasks.parquet, which has {} tasks", self.tasks.len()),
                    found: number.to_string(),
                })?);
            }
        }
        Ok(Some(all))
    }

    /// The columns of texts, one a frame, by name. LeRobot's `language` columns, which hold lists, are none of them.
    ///
    /// # Errors
    /// Files that cannot be read.
    pub fn texts(&self) -> Result<BTreeMap<String, Texts>> {
        let is_text = |(_, feature): &&(String, Feature)| feature.dtype == "string" && feature.dim() == 1;
        let mut names: Vec<&str> = self.info.features.0.iter().filter(is_text).map(|(name, _)| name.as_str()).collect();
        names.sort_unstable();
        let mut all: BTreeMap<String, Texts> = names.iter().map(|&name| (name.to_owned(), Texts::default())).collect();
        if names.is_empty() {
            return Ok(all);
        }
        let mut numbers: Vec<HashMap<String, u32>> = vec![HashMap::new(); names.len()];
        for path in read::files(&self.root, "data")? {
            let (_, arrays) = read::columns(&path, &names)?;
            for (((name, array), texts), numbers) in names.iter().zip(&arrays).zip(all.values_mut()).zip(&mut numbers) {
                for text in &read::maybe_texts(&path, name, array)? {
                    texts.push(text, numbers);
                }
            }
        }
        Ok(all)
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
    serde_json::from_slice(&read_file(path)?).map_err(|source| DatasetError::Json { path: path.to_path_buf(), source })
}

pub(crate) fn read_file(path: &Path) -> Result<Vec<u8>> {
    read::refuse_pointer(path)?;
    std::fs::read(path).map_err(|source| DatasetError::Io { path: path.to_path_buf(), operation: "read it", source })
}

/// `meta/info.json` with `actrm/info.json`, checked for a version that is understood, and the JSON of both, the second one's at
/// `actrm`.
pub(crate) fn parse_info(root: &Path) -> Result<(Info, Value)> {
    let path = root.join("meta/info.json");
    if !path.exists() {
        refuse_shard(root)?;
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
    let failed = |path: &Path| {
        let path = path.to_path_buf();
        |source| DatasetError::Json { path, source }
    };
    let mut value: Value = serde_json::from_slice(&text).map_err(failed(&path))?;
    let version = value.get("codebase_version").and_then(Value::as_str).unwrap_or("v3.0");
    if !version.starts_with("v3.") {
        let found = match version.starts_with("v2.") {
            true => format!("{version}; `actrm-data convert` makes a v3.0 set of it"),
            false => version.to_owned(),
        };
        let (object, expected) = ("codebase_version".to_owned(), "v3.0".to_owned());
        return Err(DatasetError::BadDataset { path, object, expected, found });
    }
    let mut info: Info = serde_json::from_slice(&text).map_err(failed(&path))?;
    let beside = root.join(PROVENANCE_FILE);
    if info.actrm.is_none() && beside.exists() {
        let text = read_file(&beside)?;
        info.actrm = Some(serde_json::from_slice(&text).map_err(failed(&beside))?);
        value["actrm"] = serde_json::from_slice(&text).map_err(failed(&beside))?;
    }
    check::names(&path, &info.features)?;
    Ok((info, value))
}

/// [`parse_info`], checked to be as it was made.
pub(crate) fn read_info(root: &Path) -> Result<Info> {
    let (info, value) = parse_info(root)?;
    check::info(root, &value, &info)?;
    Ok(info)
}

/// The numbers of episodes, frames and tasks are those that there are.
fn correct_totals(info: &mut Info, episodes: &[EpisodeMeta], tasks: usize, notes: &mut Vec<String>) {
    let frames = episodes.last().map_or(0, |e| e.to);
    for (name, stated, there) in [
        ("total_episodes", &mut info.total_episodes, episodes.len()),
        ("total_frames", &mut info.total_frames, frames),
        ("total_tasks", &mut info.total_tasks, tasks),
    ] {
        if *stated != there {
            notes.push(format!("meta/info.json: {name}: expected {there}, found {stated}: read as {there}"));
            *stated = there;
        }
    }
}

fn read_stats(root: &Path, notes: &mut Vec<String>) -> Result<BTreeMap<String, FeatureStats>> {
    let path = root.join("meta/stats.json");
    if !path.exists() {
        return Ok(BTreeMap::new());
    }
    let value = python_json(&read_file(&path)?).map_err(|source| DatasetError::Json { path: path.clone(), source })?;
    let stats = parse_stats(&value).map_err(|found| DatasetError::BadDataset {
        path,
        object: "statistics".to_owned(),
        expected: "min, max, mean, std and count of every feature".to_owned(),
        found,
    })?;
    let unusable: Vec<&str> = stats.iter().filter(|(_, s)| !are_finite(s)).map(|(name, _)| name.as_str()).collect();
    if !unusable.is_empty() {
        let names = unusable.join(", ");
        notes.push(format!("meta/stats.json: statistics of {names} are not finite: used only where they are"));
    }
    Ok(stats)
}

/// `meta/tasks.parquet`: the number and text of each row.
pub(super) struct TaskTable {
    pub numbers: Vec<i64>,
    pub texts: Vec<String>,
}

impl TaskTable {
    pub(super) fn read(root: &Path) -> Result<Self> {
        let path = root.join("meta/tasks.parquet");
        // pandas calls an index without a name `__index_level_0__`
        let (_, arrays) = match read::columns(&path, &["task_index", "task"]) {
            Err(DatasetError::NotInDataset { .. }) => read::columns(&path, &["task_index", "__index_level_0__"])?,
            other => other?,
        };
        let numbers = read::integers(&path, "task_index", &arrays[0])?.to_vec();
        Ok(Self { numbers, texts: read::texts(&path, "task", &arrays[1])? })
    }

    /// Whether row i has the number i.
    pub(super) fn is_in_order(&self) -> bool {
        self.numbers.iter().enumerate().all(|(i, &number)| number == i as i64)
    }

    /// Numbers and texts as frames count them: by row, as LeRobot looks tasks up, unless only the numbers of the table agree
    /// with what episodes say of their tasks. `frames` are each episode's texts and the numbers of its frames.
    pub(super) fn meant<'a>(&self, frames: impl Iterator<Item = (&'a [String], &'a [i64])>) -> (Vec<i64>, Vec<String>) {
        let by_row: Vec<(i64, &String)> = (0..).zip(&self.texts).collect();
        let mut by_number: Vec<(i64, &String)> = self.numbers.iter().copied().zip(&self.texts).collect();
        by_number.sort_unstable();
        let (mut rows, mut numbers) = (0, 0);
        for (texts, frames) in frames {
            let mut distinct = frames.to_vec();
            distinct.sort_unstable();
            distinct.dedup();
            // both tables are in the order of their numbers
            let agree = |table: &[(i64, &String)]| {
                let row = |number: i64| table.get(table.partition_point(|(n, _)| *n < number));
                let text = |number: i64| row(number).filter(|(n, _)| *n == number).map(|(_, text)| *text);
                distinct.iter().all(|&number| text(number).is_some_and(|text| texts.contains(text)))
            };
            rows += usize::from(agree(&by_row));
            numbers += usize::from(agree(&by_number));
        }
        let meant = if numbers > rows { by_number } else { by_row };
        meant.into_iter().map(|(number, text)| (number, text.clone())).unzip()
    }

    /// [`TaskTable::meant`] for the frames of a set; they are looked at only where the table is in disorder.
    fn read_as(
        self,
        root: &Path,
        episodes: &[EpisodeMeta],
        notes: &mut Vec<String>,
    ) -> Result<(Vec<i64>, Vec<String>)> {
        if self.is_in_order() {
            return Ok((self.numbers, self.texts));
        }
        let mut frames = Vec::new();
        for path in read::files(root, "data")? {
            let (_, arrays) = read::columns(&path, &["task_index"])?;
            frames.extend_from_slice(&read::integers(&path, "task_index", &arrays[0])?);
        }
        let of_episode = |e: &'_ EpisodeMeta| frames.get(e.from..e.to).unwrap_or_default();
        let meant = self.meant(episodes.iter().map(|e| (e.tasks.as_slice(), of_episode(e))));
        let numbers = &self.numbers[..self.numbers.len().min(10)];
        notes.push(format!("meta/tasks.parquet: task_index: expected 0, 1, 2, ... in order, found {numbers:?}"));
        Ok(meant)
    }
}

fn read_tasks(root: &Path, info: &Info) -> Result<TaskTable> {
    if info.total_tasks == 0 && !root.join("meta/tasks.parquet").exists() {
        return Ok(TaskTable { numbers: Vec::new(), texts: Vec::new() });
    }
    TaskTable::read(root)
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
    Ok(episodes)
}
