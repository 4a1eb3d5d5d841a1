//! The tables of a data set (totals, tasks, episodes, the columns that number frames) as they are, and as its frames say that they
//! should be.
//!
//! Several things say where an episode begins: `episode_index` and `frame_index` of the frames, their times, lengths and ranges
//! of the table of episodes. What most of them say is taken as right.

mod faults;

pub(super) use faults::{Area, listed};

use super::check::{self, seal};
use super::info::Info;
use super::open::{Dataset, EpisodeMeta, TaskTable, parse_info};
use super::read;
use crate::error::{DatasetError, Result};
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::path::{Path, PathBuf};

/// A row of `meta/episodes`.
struct Row {
    file: String,
    at: usize,
    /// By column.
    numbers: BTreeMap<String, i64>,
    tasks: Option<Vec<String>>,
    /// Seconds from and to, by camera.
    seconds: BTreeMap<String, (f64, f64)>,
}

/// A file of frames.
struct DataFile {
    relative: String,
    first: usize,
    rows: usize,
}

/// An episode as the frames say it is.
struct Derived {
    first: usize,
    length: usize,
    /// Its row of the table, where it has one.
    row: Option<usize>,
    tasks: Vec<String>,
}

/// The tables of a data set as they are, and as its frames say that they should be.
pub(super) struct Tables {
    root: PathBuf,
    info: Info,
    value: Value,
    tasks: Option<TaskTable>,
    /// Numbers and texts of the tasks, as frames count them.
    meant: (Vec<i64>, Vec<String>),
    /// Task texts in order, each once, and their numbers.
    texts: Vec<String>,
    number_of: BTreeMap<String, i64>,
    rows: Vec<Row>,
    files: Vec<DataFile>,
    /// Columns of the files that are no features, each with the first file that has it.
    unstated: BTreeMap<String, String>,
    /// Features that a file has no column of, each with the first such file.
    lacking: BTreeMap<String, String>,
    frames: usize,
    /// The columns that number frames, as far as the files have them.
    numbers: BTreeMap<String, Vec<i64>>,
    times: Option<Vec<f64>>,
    episodes: Vec<Derived>,
}

const NUMBERS: [&str; 4] = ["index", "frame_index", "episode_index", "task_index"];

impl Tables {
    /// Reads the tables.
    ///
    /// # Errors
    /// Files that cannot be read; frames of which nothing says where an episode begins.
    pub(super) fn read(root: &Path) -> Result<Self> {
        let (info, value) = parse_info(root)?;
        if !(info.fps.is_finite() && info.fps > 0.0) {
            return Err(bad(&root.join("meta/info.json"), "fps", "a number above 0", info.fps));
        }
        let tasks = match root.join("meta/tasks.parquet").exists() {
            true => Some(TaskTable::read(root)?),
            false => None,
        };
        let mut tables = Self {
            rows: read_rows(root, &info)?,
            root: root.to_path_buf(),
            info,
            value,
            tasks,
            meant: Default::default(),
            texts: Vec::new(),
            number_of: BTreeMap::new(),
            files: Vec::new(),
            unstated: BTreeMap::new(),
            lacking: BTreeMap::new(),
            frames: 0,
            numbers: BTreeMap::new(),
            times: None,
            episodes: Vec::new(),
        };
        tables.read_frames()?;
        let (order, lengths) = tables.lengths()?;
        tables.derive(&order, &lengths)?;
        Ok(tables)
    }

    fn read_frames(&mut self) -> Result<()> {
        let wanted: Vec<&str> = NUMBERS.into_iter().chain(["timestamp"]).collect();
        let mut times = Some(Vec::new());
        let mut numbers: BTreeMap<&str, Vec<i64>> = NUMBERS.into_iter().map(|name| (name, Vec::new())).collect();
        for path in read::files(&self.root, "data")? {
            let (rows, arrays) = read::columns_there(&path, &wanted)?;
            let file = relative(&self.root, &path);
            let builder = read::open(&path)?;
            for field in builder.schema().fields() {
                if self.info.features.get(field.name()).is_none() {
                    self.unstated.entry(field.name().clone()).or_insert_with(|| file.clone());
                }
            }
            for name in self.info.features.in_data().filter(|name| builder.schema().index_of(name).is_err()) {
                self.lacking.entry(name.to_owned()).or_insert_with(|| file.clone());
            }
            for name in NUMBERS {
                match (arrays.get(name), numbers.get_mut(name)) {
                    (Some(array), Some(all)) => all.extend_from_slice(&read::integers(&path, name, array)?),
                    _ => drop(numbers.remove(name)),
                }
            }
            times = match (times, arrays.get("timestamp")) {
                (Some(mut all), Some(array)) => {
                    all.extend_from_slice(&read::doubles(&path, "timestamp", array)?);
                    Some(all)
                }
                _ => None,
            };
            self.files.push(DataFile { relative: file, first: self.frames, rows });
            self.frames += rows;
        }
        self.numbers = numbers.into_iter().map(|(name, all)| (name.to_owned(), all)).collect();
        self.times = times;
        Ok(())
    }

    /// The rows of the table in the order of their episodes, and the length of each episode.
    fn lengths(&self) -> Result<(Vec<usize>, Vec<usize>)> {
        let number = |row: usize, name: &str| self.rows[row].numbers.get(name).copied();
        let mut order: Vec<usize> = (0..self.rows.len()).collect();
        let numbered: BTreeSet<Option<i64>> = order.iter().map(|&row| number(row, "episode_index")).collect();
        if numbered.iter().copied().eq((0..self.rows.len() as i64).map(Some)) {
            order.sort_by_key(|&row| number(row, "episode_index"));
        }
        let table = |length: &dyn Fn(usize) -> Option<i64>| -> Option<Vec<usize>> {
            let lengths = order.iter().map(|&row| usize::try_from(length(row)?).ok()).collect::<Option<Vec<_>>>()?;
            let sum = lengths.iter().try_fold(0_usize, |sum, &length| sum.checked_add(length))?;
            (sum == self.frames).then_some(lengths)
        };
        let stated = table(&|row| number(row, "length"));
        let ranges = table(&|row| number(row, "dataset_to_index")?.checked_sub(number(row, "dataset_from_index")?));
        let begins = |is: &dyn Fn(usize) -> bool| (0..self.frames).filter(|&row| row == 0 || is(row)).collect();
        let starts = |lengths: &Vec<usize>| -> Vec<usize> {
            let first = lengths.iter().scan(0, |next, &length| Some((std::mem::replace(next, *next + length), length)));
            first.filter(|(_, length)| *length > 0).map(|(first, _)| first).collect()
        };
        let mut said: Vec<(&str, Vec<usize>)> = Vec::new();
        if let Some(all) = self.numbers.get("episode_index") {
            said.push(("episode_index", begins(&|row| all[row] != all[row - 1])));
        }
        if let Some(all) = self.numbers.get("frame_index") {
            said.push(("frame_index", begins(&|row| Some(all[row]) != all[row - 1].checked_add(1))));
        }
        said.extend(stated.iter().map(|lengths| ("length of the episodes", starts(lengths))));
        said.extend(ranges.iter().map(|lengths| ("dataset_from_index and dataset_to_index", starts(lengths))));
        if let Some(all) = &self.times {
            said.push(("timestamp", begins(&|row| all[row] <= all[row - 1])));
        }
        let votes = |starts: &Vec<usize>| said.iter().filter(|(_, other)| other == starts).count();
        // of equals the first
        let best = said.iter().rev().max_by_key(|(_, starts)| votes(starts));
        let Some((_, best)) = best.filter(|(_, starts)| votes(starts) > 1 || said.len() == 1) else {
            let found = said.iter().map(|(name, starts)| format!("{} by {name}", starts.len())).collect::<Vec<_>>();
            let expected =
                "frame and episode numbers, times and the table of episodes of which two agree where episodes begin";
            return Err(bad(&self.root, "episodes", expected, format!("{} episodes", found.join(", "))));
        };
        // episodes without frames are in the table alone
        let lengths = stated.into_iter().chain(ranges).find(|lengths| starts(lengths) == *best).unwrap_or_else(|| {
            let ends = best.iter().skip(1).chain([&self.frames]);
            best.iter().zip(ends).map(|(from, to)| to - from).collect()
        });
        Ok((order, lengths))
    }

    /// The episodes and tasks, from the lengths of the episodes.
    fn derive(&mut self, order: &[usize], lengths: &[usize]) -> Result<()> {
        let mut firsts = Vec::with_capacity(lengths.len());
        let mut next = 0;
        for length in lengths {
            firsts.push(next);
            next += length;
        }
        let row_of: Vec<Option<usize>> = match self.numbers.get("episode_index") {
            _ if order.len() == lengths.len() => order.iter().copied().map(Some).collect(),
            Some(all) => {
                let mut rows: BTreeMap<i64, usize> = BTreeMap::new();
                for (at, row) in self.rows.iter().enumerate() {
                    rows.extend(row.numbers.get("episode_index").map(|&number| (number, at)));
                }
                firsts.iter().map(|&first| rows.remove(all.get(first)?)).collect()
            }
            None => vec![None; lengths.len()],
        };
        let nothing: Vec<String> = Vec::new();
        let said = |row: Option<usize>| row.and_then(|row| self.rows[row].tasks.as_ref()).unwrap_or(&nothing);
        let numbers = |first: usize, length: usize| -> &[i64] {
            self.numbers.get("task_index").map_or(&[], |all| &all[first..first + length])
        };
        let each = firsts.iter().zip(lengths).zip(&row_of);
        let meant = match &self.tasks {
            Some(table) => table
                .meant(each.clone().map(|((&first, &length), &row)| (said(row).as_slice(), numbers(first, length)))),
            None => Default::default(),
        };
        // the first of two tasks of one number counts
        let text_of: HashMap<i64, &String> = meant.0.iter().copied().zip(&meant.1).rev().collect();
        let known: HashSet<&String> = meant.1.iter().collect();
        let mut episodes = Vec::with_capacity(lengths.len());
        for (number, ((&first, &length), &row)) in each.enumerate() {
            let said = said(row);
            let mut counted: Vec<i64> = Vec::new();
            for &number in numbers(first, length) {
                if counted.last() != Some(&number) && !counted.contains(&number) {
                    counted.push(number);
                }
            }
            let of_frames: Option<Vec<&String>> = counted.iter().map(|number| text_of.get(number).copied()).collect();
            let of_frames = of_frames.unwrap_or_default();
            let frames_know = of_frames.len() > 1 || said.is_empty() || said.iter().any(|text| !known.contains(text));
            // what was written with the episode, unless its frames differ or the table does not know it
            let tasks = if same(&of_frames, said) || length == 0 {
                said.clone()
            } else if frames_know && !of_frames.is_empty() {
                of_frames.into_iter().cloned().collect()
            } else if said.len() == 1 {
                said.clone()
            } else if !of_frames.is_empty() {
                of_frames.into_iter().cloned().collect()
            } else {
                let found = format!("task_index {counted:?} and tasks {said:?}");
                let object = format!("tasks of episode {number}");
                return Err(bad(&self.root, &object, "a task that frames or episode name", found));
            };
            episodes.push(Derived { first, length, row, tasks });
        }
        for text in meant.1.iter().chain(episodes.iter().flat_map(|e: &Derived| &e.tasks)) {
            if !self.number_of.contains_key(text) {
                self.number_of.insert(text.clone(), self.texts.len() as i64);
                self.texts.push(text.clone());
            }
        }
        self.meant = meant;
        self.episodes = episodes;
        Ok(())
    }

    /// Whether the set is the one that was converted, once what follows from the frames is corrected.
    pub(super) fn provenance_holds(&self) -> bool {
        let Some(provenance) = &self.info.actrm else { return false };
        let mut value = self.value.clone();
        for (name, there) in
            [("total_episodes", self.episodes.len()), ("total_frames", self.frames), ("total_tasks", self.texts.len())]
        {
            value[name] = json!(there);
        }
        value["data_path"] = json!(super::info::DATA_PATH);
        if check::splits(&self.info.splits, self.episodes.len()).is_err() {
            value["splits"] = self.whole();
        }
        let known = provenance.demos.len() == self.episodes.len()
            && provenance.masks.values().flatten().all(|&episode| episode < self.episodes.len());
        known && provenance.seal.as_ref().is_none_or(|expected| seal(&value) == *expected)
    }

    /// The one split that LeRobot writes.
    fn whole(&self) -> Value {
        json!({ "train": format!("0:{}", self.episodes.len()) })
    }

    /// The set as its frames say it is.
    pub(super) fn derived(&self) -> Result<Dataset> {
        let mut info = self.info.clone();
        info.total_episodes = self.episodes.len();
        info.total_frames = self.frames;
        info.total_tasks = self.texts.len();
        if check::splits(&info.splits, self.episodes.len()).is_err() {
            info.splits = BTreeMap::from([("train".to_owned(), format!("0:{}", self.episodes.len()))]);
        }
        let demo = |number: usize| info.actrm.as_ref().and_then(|p| p.demos.get(number).cloned());
        let episode = |(index, e): (usize, &Derived)| EpisodeMeta {
            index,
            length: e.length,
            from: e.first,
            to: e.first + e.length,
            tasks: e.tasks.clone(),
            demo: demo(index),
        };
        let episodes: Vec<EpisodeMeta> = self.episodes.iter().enumerate().map(episode).collect();
        // a row that is not there is asked for where something depends on it
        let order: Vec<usize> = self.episodes.iter().map(|e| e.row.unwrap_or(usize::MAX)).collect();
        let rows = (!order.iter().copied().eq(0..self.rows.len())).then_some(order);
        let mut numbers = self.meant.0.clone();
        let mut kept = self.meant.1.clone();
        // texts that the table lacks have no number in any frame
        let known: HashSet<&String> = self.meant.1.iter().collect();
        for text in self.texts.iter().filter(|text| !known.contains(text)) {
            numbers.push(i64::MIN);
            kept.push(text.clone());
        }
        Dataset::derived(&self.root, info, episodes, (numbers, kept), rows)
    }
}

/// Whether both have the same texts, in any order.
fn same(a: &[&String], b: &[String]) -> bool {
    a.iter().copied().collect::<BTreeSet<_>>() == b.iter().collect::<BTreeSet<_>>()
}

fn bad(path: &Path, object: &str, expected: impl ToString, found: impl ToString) -> DatasetError {
    DatasetError::BadDataset {
        path: path.to_path_buf(),
        object: object.to_owned(),
        expected: expected.to_string(),
        found: found.to_string(),
    }
}

fn relative(root: &Path, path: &Path) -> String {
    path.strip_prefix(root).unwrap_or(path).to_string_lossy().into_owned()
}

fn read_rows(root: &Path, info: &Info) -> Result<Vec<Row>> {
    const NUMBERS: [&str; 8] = [
        "episode_index",
        "length",
        "dataset_from_index",
        "dataset_to_index",
        "data/chunk_index",
        "data/file_index",
        "meta/episodes/chunk_index",
        "meta/episodes/file_index",
    ];
    let cameras: Vec<&String> =
        info.features.0.iter().filter(|(_, f)| f.dtype == "video").map(|(name, _)| name).collect();
    let of_camera = |what: &str| cameras.iter().map(|name| format!("videos/{name}/{what}")).collect::<Vec<_>>();
    let mut whole: Vec<String> = NUMBERS.into_iter().map(str::to_owned).collect();
    whole.extend(of_camera("chunk_index").into_iter().chain(of_camera("file_index")));
    let (from, to) = (of_camera("from_timestamp"), of_camera("to_timestamp"));
    let wanted: Vec<&str> = whole.iter().chain(&from).chain(&to).map(String::as_str).chain(["tasks"]).collect();
    let mut all = Vec::new();
    for path in read::files(root, "meta/episodes")? {
        let (rows, arrays) = read::columns_there(&path, &wanted)?;
        let mut numbers = BTreeMap::new();
        for name in &whole {
            if let Some(array) = arrays.get(name) {
                numbers.insert(name.clone(), read::integers(&path, name, array)?);
            }
        }
        let mut seconds = BTreeMap::new();
        for (camera, (from, to)) in cameras.iter().zip(from.iter().zip(&to)) {
            if let (Some(a), Some(b)) = (arrays.get(from), arrays.get(to)) {
                let both = (read::doubles(&path, from, a)?, read::doubles(&path, to, b)?);
                seconds.insert((*camera).clone(), both);
            }
        }
        let tasks = arrays.get("tasks").map(|array| read::text_lists(&path, "tasks", array)).transpose()?;
        let file = relative(root, &path);
        all.extend((0..rows).map(|at| Row {
            file: file.clone(),
            at,
            numbers: numbers.iter().map(|(name, all)| (name.clone(), all[at])).collect(),
            tasks: tasks.as_ref().map(|tasks| tasks[at].clone()),
            seconds: seconds.iter().map(|(name, (from, to))| (name.clone(), (from[at], to[at]))).collect(),
        }));
    }
    Ok(all)
}
