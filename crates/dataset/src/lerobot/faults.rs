//! The tables of a data set (totals, tasks, episodes, the columns that number frames) held against its frames: every fault by
//! name, and the set as its frames say it is.
//!
//! Several things say where an episode begins: `episode_index` and `frame_index` of the frames, their times, lengths and ranges
//! of the table of episodes. What most of them say is taken as right.

use super::check::{self, seal};
use super::fingerprint::INDEX_COLUMNS;
use super::info::{Feature, Info};
use super::open::{Dataset, EpisodeMeta, TaskTable, parse_info};
use super::pictures;
use super::read;
use super::values::{Values, stats_of};
use crate::error::{DatasetError, Result};
use crate::stats::FeatureStats;
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::{Path, PathBuf};

/// Faults of one kind that a check names.
const NAMED: usize = 20;

/// What a fault is about: a check has this name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Area {
    Info,
    Tasks,
    Episodes,
    Videos,
    Indices,
    Times,
    Statistics,
}

impl Area {
    pub(super) const ALL: [(Self, &str); 7] = [
        (Self::Info, "totals and splits are those of the frames"),
        (Self::Tasks, "tasks are numbered in order, and episodes name those of their frames"),
        (Self::Episodes, "episodes name their frames and the files that hold them"),
        (Self::Videos, "episodes name their part of the videos"),
        (Self::Indices, "index, frame_index, episode_index and task_index number the frames"),
        (Self::Times, "timestamps are frame_index / fps"),
        (Self::Statistics, "statistics follow from the frames"),
    ];
}

/// Something that is not as the frames say.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Fault {
    pub area: Area,
    /// Path in the data set.
    pub file: String,
    pub what: String,
    pub episode: Option<usize>,
    /// Row of the file.
    pub row: Option<usize>,
    pub expected: String,
    pub found: String,
    /// Further rows with the same fault.
    pub more: usize,
    /// Whether it can be derived from the frames.
    pub repairable: bool,
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.file, self.what)?;
        if let Some(episode) = self.episode {
            write!(f, ", episode {episode}")?;
        }
        if let Some(row) = self.row {
            write!(f, ", row {row}")?;
        }
        write!(f, ": expected {}, found {}", self.expected, self.found)?;
        if self.more > 0 {
            write!(f, " ({} more rows of it)", self.more)?;
        }
        Ok(())
    }
}

impl Fault {
    fn new(area: Area, file: &str, what: &str, expected: impl ToString, found: impl ToString) -> Self {
        let (expected, found) = (expected.to_string(), found.to_string());
        let (file, what) = (file.to_owned(), what.to_owned());
        Self { area, file, what, episode: None, row: None, expected, found, more: 0, repairable: true }
    }

    fn of(self, episode: usize, row: usize) -> Self {
        Self { episode: Some(episode), row: Some(row), ..self }
    }
}

/// Lines that name the faults, so many at most.
pub(super) fn listed<T: ToString>(faults: &[T]) -> Option<String> {
    let mut lines: Vec<String> = faults.iter().take(NAMED).map(T::to_string).collect();
    if faults.len() > NAMED {
        lines.push(format!("and {} more", faults.len() - NAMED));
    }
    (!lines.is_empty()).then(|| lines.join("\n"))
}

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
            self.files.push(DataFile { relative: relative(&self.root, &path), first: self.frames, rows });
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
        let text = |number: i64| meant.0.iter().position(|&n| n == number).map(|at| &meant.1[at]);
        let mut episodes = Vec::with_capacity(lengths.len());
        for (number, ((&first, &length), &row)) in each.enumerate() {
            let said = said(row);
            let mut counted: Vec<i64> = Vec::new();
            for &number in numbers(first, length) {
                if counted.last() != Some(&number) && !counted.contains(&number) {
                    counted.push(number);
                }
            }
            let of_frames: Option<Vec<&String>> = counted.iter().map(|&number| text(number)).collect();
            let of_frames = of_frames.unwrap_or_default();
            let frames_know = of_frames.len() > 1 || said.is_empty() || said.iter().any(|text| !meant.1.contains(text));
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

    /// The faults of the tables.
    pub(super) fn faults(&self, tolerance: f64) -> Vec<Fault> {
        let mut faults = self.info_faults();
        self.task_faults(&mut faults);
        self.episode_faults(&mut faults);
        self.number_faults(&mut faults);
        self.time_faults(tolerance, &mut faults);
        faults
    }

    fn info_faults(&self) -> Vec<Fault> {
        const FILE: &str = "meta/info.json";
        let info = &self.info;
        let mut faults = Vec::new();
        for (name, stated, there) in [
            ("total_episodes", info.total_episodes, self.episodes.len()),
            ("total_frames", info.total_frames, self.frames),
            ("total_tasks", info.total_tasks, self.texts.len()),
        ] {
            if stated != there {
                faults.push(Fault::new(Area::Info, FILE, name, there, stated));
            }
        }
        if let Err((expected, found)) = check::splits(&info.splits, self.episodes.len()) {
            faults.push(Fault::new(Area::Info, FILE, "splits", expected, found));
        }
        for file in &self.files {
            let Some((chunk, number)) = place_of(&file.relative) else { continue };
            let named = filled(&info.data_path, chunk, number);
            if named != file.relative {
                faults.push(Fault::new(
                    Area::Info,
                    FILE,
                    "data_path",
                    format!("a path that is {}", file.relative),
                    named,
                ));
                break;
            }
        }
        if info.actrm.is_some() && !self.provenance_holds() {
            let found = "something that was changed since; `edit repair` leaves out where the set came from";
            faults.push(Fault::new(
                Area::Info,
                FILE,
                "content",
                "what was recorded when it was made (actrm.seal)",
                found,
            ));
        }
        faults
    }

    fn task_faults(&self, faults: &mut Vec<Fault>) {
        const FILE: &str = "meta/tasks.parquet";
        let texts = &self.texts;
        match &self.tasks {
            None if texts.is_empty() => {}
            None => faults.push(Fault::new(Area::Tasks, FILE, "file", "a table of the tasks", "no such file")),
            Some(table) => {
                let wrong = |(i, number): &(usize, &i64)| **number != *i as i64;
                if let Some((row, number)) = table.numbers.iter().enumerate().find(wrong) {
                    let fault = Fault::new(Area::Tasks, FILE, "task_index", row, number);
                    faults.push(Fault { row: Some(row), ..fault });
                }
                for text in texts.iter().filter(|text| !table.texts.contains(text)) {
                    faults.push(Fault::new(Area::Tasks, FILE, "task", format!("a row for {text:?}"), "none"));
                }
                for (row, text) in table.texts.iter().enumerate().filter(|(i, t)| table.texts[..*i].contains(t)) {
                    let fault = Fault::new(Area::Tasks, FILE, "task", "each task once", format!("{text:?} again"));
                    faults.push(Fault { row: Some(row), ..fault });
                }
            }
        }
    }

    fn episode_faults(&self, faults: &mut Vec<Fault>) {
        const FOLDER: &str = "meta/episodes";
        let expected = self.episodes.len();
        if self.rows.len() != expected {
            let found = format!("{} rows", self.rows.len());
            faults.push(Fault::new(Area::Episodes, FOLDER, "rows", format!("{expected} episodes"), found));
        }
        let mut of_row: BTreeMap<usize, usize> = BTreeMap::new();
        for (number, episode) in self.episodes.iter().enumerate() {
            let Some(at) = episode.row else { continue };
            of_row.insert(at, number);
            let row = &self.rows[at];
            if at != number && self.rows.len() == expected {
                let fault = Fault::new(Area::Episodes, &row.file, "order of rows", format!("episode {at}"), number);
                faults.push(fault.of(number, row.at));
            }
            let last = (episode.first + episode.length).saturating_sub(1).max(episode.first);
            let file = self.file_of(episode.first);
            let place = file.and_then(|file| place_of(&file.relative));
            let own = place_of(&row.file);
            let numbers = [
                ("episode_index", Some(number)),
                ("length", Some(episode.length)),
                ("dataset_from_index", Some(episode.first)),
                ("dataset_to_index", Some(episode.first + episode.length)),
                ("data/chunk_index", place.map(|p| p.0).filter(|_| episode.length > 0)),
                ("data/file_index", place.map(|p| p.1).filter(|_| episode.length > 0)),
                ("meta/episodes/chunk_index", own.map(|p| p.0)),
                ("meta/episodes/file_index", own.map(|p| p.1)),
            ];
            for (name, expected) in numbers {
                let (Some(expected), found) = (expected, row.numbers.get(name)) else { continue };
                // only the first four are in every set
                let found = match found {
                    Some(&found) if found == expected as i64 => continue,
                    Some(found) => found.to_string(),
                    None if name.contains('/') => continue,
                    None => "no such column".to_owned(),
                };
                faults.push(Fault::new(Area::Episodes, &row.file, name, expected, found).of(number, row.at));
            }
            if let (Some(begins), Some(ends)) = (file, self.file_of(last))
                && begins.relative != ends.relative
            {
                let found = format!("frames in {} and {}", begins.relative, ends.relative);
                faults
                    .push(Fault::new(Area::Episodes, &row.file, "frames", "all in one file", found).of(number, row.at));
            }
            let said = row.tasks.as_deref().unwrap_or_default();
            if !same(&episode.tasks.iter().collect::<Vec<_>>(), said) {
                let (expected, found) = (format!("{:?}", episode.tasks), format!("{said:?}"));
                faults.push(Fault::new(Area::Tasks, &row.file, "tasks", expected, found).of(number, row.at));
            }
            for (name, _) in self.videos() {
                self.video_faults(name, number, episode, row, faults);
            }
        }
        for (name, _) in self.videos() {
            self.overlaps(name, faults);
        }
    }

    fn videos(&self) -> impl Iterator<Item = &(String, Feature)> {
        // depth as video is not read: it is refused by name
        self.info.features.0.iter().filter(|(_, feature)| feature.dtype == "video" && !feature.is_depth())
    }

    /// The file that a row names for a camera.
    fn film(&self, row: &Row, name: &str) -> Option<(PathBuf, (f64, f64))> {
        let number = |what: &str| row.numbers.get(&format!("videos/{name}/{what}")).copied();
        let path = pictures::relative(&self.info, name, number("chunk_index")?, number("file_index")?)?;
        Some((path, *row.seconds.get(name)?))
    }

    fn video_faults(&self, name: &str, number: usize, episode: &Derived, row: &Row, faults: &mut Vec<Fault>) {
        let mut add = |what: &str, expected: String, found: String| {
            let fault = Fault::new(Area::Videos, &row.file, &format!("videos/{name}/{what}"), expected, found);
            faults.push(Fault { repairable: false, ..fault.of(number, row.at) });
        };
        let Some((path, (from, to))) = self.film(row, name) else {
            return add("file_index", "a file and seconds in it".to_owned(), "none".to_owned());
        };
        if !self.root.join(&path).is_file() {
            return add("file_index", "a file that is there".to_owned(), path.display().to_string());
        }
        let seconds = episode.length as f64 / self.info.fps;
        // half a frame
        if !((to - from - seconds).abs() <= 0.5 / self.info.fps && from >= 0.0) {
            add("to_timestamp", format!("{seconds} s after from_timestamp {from}"), to.to_string());
        }
    }

    /// Episodes of which a camera's stretches lie over each other.
    fn overlaps(&self, name: &str, faults: &mut Vec<Fault>) {
        let mut stretches = Vec::new();
        for (number, episode) in self.episodes.iter().enumerate().filter(|(_, e)| e.length > 0) {
            let Some(row) = episode.row.map(|row| &self.rows[row]) else { continue };
            stretches.extend(self.film(row, name).map(|(path, (from, to))| (path, from, to, number, row)));
        }
        stretches.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)).then(a.3.cmp(&b.3)));
        for two in stretches.windows(2) {
            let [(path, _, end, before, _), (other, from, _, number, row)] = two else { continue };
            if path == other && *from < end - 0.5 / self.info.fps {
                let expected = format!("{end} s or more, where episode {before} ends");
                let what = format!("videos/{name}/from_timestamp");
                let fault = Fault::new(Area::Videos, &row.file, &what, expected, from);
                faults.push(Fault { repairable: false, ..fault.of(*number, row.at) });
            }
        }
    }

    fn number_faults(&self, faults: &mut Vec<Fault>) {
        for name in NUMBERS {
            if !self.numbers.contains_key(name) {
                let fault = Fault::new(Area::Indices, "data", name, "a column of numbers", "none in some file");
                faults.push(Fault { repairable: false, ..fault });
            }
        }
        for (number, episode) in self.episodes.iter().enumerate() {
            let tasks: Vec<i64> = episode.tasks.iter().filter_map(|text| self.number_of.get(text).copied()).collect();
            for (name, all) in NUMBERS.into_iter().filter_map(|name| Some((name, self.numbers.get(name)?))) {
                let expected = |row: usize| match name {
                    "index" => row as i64,
                    "frame_index" => (row - episode.first) as i64,
                    "episode_index" => number as i64,
                    _ => match tasks.as_slice() {
                        [task] => *task,
                        // several tasks: each frame has one of them
                        _ if tasks.contains(&all[row]) => all[row],
                        _ => tasks.first().copied().unwrap_or(0),
                    },
                };
                let mut wrong =
                    (episode.first..episode.first + episode.length).filter(|&row| all[row] != expected(row));
                let Some(row) = wrong.next() else { continue };
                let more = wrong.count();
                let (file, at) = self.row(row);
                let fault = Fault::new(Area::Indices, file, name, expected(row), all[row]).of(number, at);
                faults.push(Fault { more, ..fault });
            }
        }
    }

    fn time_faults(&self, tolerance: f64, faults: &mut Vec<Fault>) {
        let Some(all) = &self.times else { return };
        for (number, episode) in self.episodes.iter().enumerate() {
            let off = |row: &usize| check::time_off(all[*row], row - episode.first, self.info.fps, tolerance);
            let mut late = (episode.first..episode.first + episode.length).filter(|row| off(row).is_some());
            let Some(row) = late.next() else { continue };
            let (more, most) =
                late.fold((0, off(&row)), |(n, most), row| (n + 1, most.into_iter().chain(off(&row)).reduce(f64::max)));
            let (file, at) = self.row(row);
            let expected = format!("{} s", (row - episode.first) as f64 / self.info.fps);
            let found = format!("{} s, up to {:.6} s off in this episode", all[row], most.unwrap_or(0.0));
            let fault = Fault::new(Area::Times, file, "timestamp", expected, found).of(number, at);
            faults.push(Fault { more, repairable: false, ..fault });
        }
    }

    fn file_of(&self, row: usize) -> Option<&DataFile> {
        let at = self.files.partition_point(|file| file.first + file.rows <= row);
        self.files.get(at).filter(|file| file.first <= row)
    }

    /// The file of a frame and its row in it.
    fn row(&self, frame: usize) -> (&str, usize) {
        self.file_of(frame).map_or(("data", frame), |file| (file.relative.as_str(), frame - file.first))
    }

    /// Statistics that do not follow from the frames, of the set and of its episodes.
    pub(super) fn statistics_faults(&self, set: &Dataset) -> Result<Vec<Fault>> {
        const FILE: &str = "meta/stats.json";
        let mut faults = Vec::new();
        let all: Vec<usize> = (0..set.episodes().len()).collect();
        if set.stats().is_empty() {
            faults.push(Fault::new(Area::Statistics, FILE, "file", "statistics of every feature", "none"));
        }
        let columns: Vec<String> = set.column_names().map(str::to_owned).collect();
        let finite: BTreeMap<&String, Vec<bool>> = columns.iter().map(|name| (name, finite(set, name))).collect();
        for (name, computed) in set.statistics_of(&all)?.into_iter().filter(|_| !set.stats().is_empty()) {
            match set.stats().get(&name) {
                None => faults.push(Fault::new(Area::Statistics, FILE, &name, "statistics", "none")),
                Some(stored) => {
                    let found = differing(&computed, stored, &finite[&name], TOLERANCE);
                    faults.extend(found.map(|(what, expected, found)| {
                        Fault::new(Area::Statistics, FILE, &format!("{name}: {what}"), expected, found)
                    }));
                }
            }
        }
        for name in INDEX_COLUMNS.into_iter().filter(|name| self.info.features.get(name).is_some()) {
            let each: Vec<Values> = (0..self.episodes.len()).filter_map(|number| self.expected(name, number)).collect();
            let (Some(stored), Some(computed)) = (set.stats().get(name), stats_of(&each.iter().collect::<Vec<_>>(), 1))
            else {
                continue;
            };
            let found = differing(&computed, stored, &[true], INDEX_TOLERANCE);
            faults.extend(found.map(|(what, expected, found)| {
                Fault::new(Area::Statistics, FILE, &format!("{name}: {what}"), expected, found)
            }));
        }
        for (name, _) in self.info.features.0.iter().filter(|(_, f)| !f.is_visual() && !f.is_text()) {
            let mut stored: Vec<FeatureStats> = Vec::new();
            for path in read::files(&self.root, "meta/episodes")? {
                stored.extend(super::edit::statistics_in(&path, name)?);
            }
            let index = INDEX_COLUMNS.contains(&name.as_str());
            for (number, episode) in self.episodes.iter().enumerate().filter(|(_, e)| e.length > 0) {
                let Some((at, stored)) = episode.row.and_then(|at| Some((at, stored.get(at)?))) else { continue };
                let computed = match index {
                    true => self.expected(name, number).and_then(|values| values.stats(1)),
                    false => set.column(name).and_then(|column| {
                        let range = episode.first * column.dim..(episode.first + episode.length) * column.dim;
                        FeatureStats::of(column.data.get(range)?, column.dim)
                    }),
                };
                let Some(computed) = computed else { continue };
                let usable = if index { vec![true] } else { finite.get(name).cloned().unwrap_or_default() };
                let tolerance = if index { INDEX_TOLERANCE } else { TOLERANCE };
                let row = &self.rows[at];
                faults.extend(differing(&computed, stored, &usable, tolerance).map(|(what, expected, found)| {
                    let what = format!("stats/{name}/{what}");
                    Fault::new(Area::Statistics, &row.file, &what, expected, found).of(number, row.at)
                }));
            }
        }
        Ok(faults)
    }

    /// The values of an index column in an episode.
    fn expected(&self, name: &str, number: usize) -> Option<Values> {
        let episode = &self.episodes[number];
        let (first, length) = (episode.first as i64, episode.length);
        Some(match name {
            "timestamp" => Values::F64(self.times.as_ref()?[episode.first..episode.first + length].to_vec()),
            "index" => Values::I64((first..first + length as i64).collect()),
            "frame_index" => Values::I64((0..length as i64).collect()),
            "episode_index" => Values::I64(vec![number as i64; length]),
            _ => match episode.tasks.as_slice() {
                [task] => Values::I64(vec![*self.number_of.get(task)?; length]),
                _ => Values::I64(self.numbers.get(name)?[episode.first..episode.first + length].to_vec()),
            },
        })
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
        for text in self.texts.iter().filter(|text| !self.meant.1.contains(text)) {
            numbers.push(i64::MIN);
            kept.push(text.clone());
        }
        Dataset::derived(&self.root, info, episodes, (numbers, kept), rows)
    }
}

/// Relative difference up to which a stored statistic counts as right: LeRobot computes some in f32.
const TOLERANCE: f64 = 1e-5;
/// The same of columns that number frames, whose statistics it puts together from those of episodes.
const INDEX_TOLERANCE: f64 = 1e-4;

/// The first statistic that differs, with both values, in the dimensions that are `usable`.
fn differing(
    computed: &FeatureStats,
    stored: &FeatureStats,
    usable: &[bool],
    tolerance: f64,
) -> Option<(&'static str, String, String)> {
    if stored.count != computed.count {
        return Some(("count", computed.count.to_string(), stored.count.to_string()));
    }
    type Get = fn(&FeatureStats) -> &Vec<f64>;
    let vectors: [(&str, Get); 4] =
        [("min", |s| &s.min), ("max", |s| &s.max), ("mean", |s| &s.mean), ("std", |s| &s.std)];
    for (statistic, get) in vectors {
        let (a, b) = (get(computed), get(stored));
        let close = |x: f64, y: f64| (x - y).abs() <= tolerance * x.abs().max(1.0);
        let same = |i: usize| usable.get(i) == Some(&false) || close(a[i], b[i]);
        if a.len() != b.len() || !(0..a.len()).all(same) {
            return Some((statistic, format!("{a:?}"), format!("{b:?}")));
        }
    }
    None
}

/// Whether a column is finite throughout, by dimension.
fn finite(set: &Dataset, name: &str) -> Vec<bool> {
    let Some(column) = set.column(name) else { return Vec::new() };
    let mut finite = vec![true; column.dim];
    for (i, value) in column.data.iter().enumerate() {
        finite[i % column.dim] &= value.is_finite();
    }
    finite
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

/// Chunk and file of `.../chunk-000/file-000.parquet`.
fn place_of(relative: &str) -> Option<(usize, usize)> {
    let (folder, file) = relative.rsplit_once('/')?;
    let chunk = folder.rsplit('/').next()?.strip_prefix("chunk-")?.parse().ok()?;
    Some((chunk, file.strip_prefix("file-")?.strip_suffix(".parquet")?.parse().ok()?))
}

/// A path in Python's format language, filled in.
fn filled(template: &str, chunk: usize, file: usize) -> String {
    let text = template.replace("{chunk_index:03d}", &format!("{chunk:03}"));
    text.replace("{file_index:03d}", &format!("{file:03}"))
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
