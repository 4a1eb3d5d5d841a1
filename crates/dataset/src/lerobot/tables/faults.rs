//! Tables held against what the frames say: every fault by name.

use super::{DataFile, Derived, NUMBERS, Row, Tables, same};
use crate::error::Result;
use crate::lerobot::check;
use crate::lerobot::edit::is_looked_at;
use crate::lerobot::fingerprint::INDEX_COLUMNS;
use crate::lerobot::info::Feature;
use crate::lerobot::open::Dataset;
use crate::lerobot::values::{Values, stats_of};
use crate::lerobot::{pictures, read};
use crate::stats::FeatureStats;
use std::collections::{BTreeMap, HashSet};
use std::fmt;
use std::path::PathBuf;

/// Faults of one kind that a check names.
const NAMED: usize = 20;

/// What a fault is about: a check has this name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(in crate::lerobot) enum Area {
    Info,
    Tasks,
    Episodes,
    Videos,
    Indices,
    Times,
    Statistics,
}

impl Area {
    pub(in crate::lerobot) const ALL: [(Self, &str); 7] = [
        (Self::Info, "totals, splits and features are those of the frames"),
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
pub(in crate::lerobot) struct Fault {
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
pub(in crate::lerobot) fn listed<T: ToString>(faults: &[T]) -> Option<String> {
    let mut lines: Vec<String> = faults.iter().take(NAMED).map(T::to_string).collect();
    if faults.len() > NAMED {
        lines.push(format!("and {} more", faults.len() - NAMED));
    }
    (!lines.is_empty()).then(|| lines.join("\n"))
}

impl Tables {
    /// The faults of the tables.
    pub(in crate::lerobot) fn faults(&self, tolerance: f64) -> Vec<Fault> {
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
        for (column, file) in &self.unstated {
            // LeRobot refuses to open such a set
            let fault = Fault::new(Area::Info, FILE, "features", format!("{column}, a column of {file}"), "none");
            faults.push(Fault { repairable: false, ..fault });
        }
        for (column, file) in &self.lacking {
            let what = format!("features.{column}");
            let fault = Fault::new(Area::Info, FILE, &what, format!("a column of that name in {file}"), "none");
            faults.push(Fault { repairable: false, ..fault });
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
                let there: HashSet<&String> = table.texts.iter().collect();
                for text in texts.iter().filter(|text| !there.contains(text)) {
                    faults.push(Fault::new(Area::Tasks, FILE, "task", format!("a row for {text:?}"), "none"));
                }
                let mut known = HashSet::new();
                for (row, text) in table.texts.iter().enumerate().filter(|(_, text)| !known.insert(*text)) {
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
            if episode.length == 0 {
                let fault = Fault::new(Area::Episodes, &row.file, "length", "1 or more", 0).of(number, row.at);
                faults.push(Fault { repairable: false, ..fault });
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
    pub(in crate::lerobot) fn statistics_faults(&self, set: &Dataset) -> Result<Vec<Fault>> {
        const FILE: &str = "meta/stats.json";
        let mut faults = Vec::new();
        let all: Vec<usize> = (0..set.episodes().len()).collect();
        if set.stats().is_empty() {
            faults.push(Fault::new(Area::Statistics, FILE, "file", "statistics of every feature", "none"));
        }
        let wide = set.wide()?;
        let columns: Vec<String> = set.column_names().map(str::to_owned).collect();
        let finite: BTreeMap<&String, Vec<bool>> = columns.iter().map(|name| (name, finite(set, name))).collect();
        let ranges = set.ranges(&all)?;
        for (name, single) in set.statistics_of(&all)?.into_iter().filter(|_| !set.stats().is_empty()) {
            let dim = self.info.features.get(&name).map_or(1, Feature::dim);
            let exact = wide.get(&name).and_then(|numbers| numbers.stats(&ranges, dim));
            match set.stats().get(&name) {
                None => faults.push(Fault::new(Area::Statistics, FILE, &name, "statistics", "none")),
                Some(stored) => {
                    let found = wrong(exact.as_ref(), &single, stored, &finite[&name]);
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
            let found = differing(&computed, stored, &[true], TOLERANCE);
            faults.extend(found.map(|(what, expected, found)| {
                Fault::new(Area::Statistics, FILE, &format!("{name}: {what}"), expected, found)
            }));
        }
        self.picture_statistics_faults(set, &mut faults);
        for (name, feature) in self.info.features.0.iter().filter(|(_, f)| !f.is_visual() && !f.is_text()) {
            let mut stored: Vec<FeatureStats> = Vec::new();
            for path in read::files(&self.root, "meta/episodes")? {
                stored.extend(crate::lerobot::edit::statistics_in(&path, name)?);
            }
            let index = INDEX_COLUMNS.contains(&name.as_str());
            for (number, episode) in self.episodes.iter().enumerate().filter(|(_, e)| e.length > 0) {
                let Some((at, stored)) = episode.row.and_then(|at| Some((at, stored.get(at)?))) else { continue };
                let rows = (episode.first, episode.first + episode.length);
                let exact = wide.get(name).and_then(|numbers| numbers.stats(&[rows], feature.dim()));
                let single = match index {
                    true => self.expected(name, number).and_then(|values| values.stats(1)),
                    false => set.column(name).and_then(|column| {
                        let range = episode.first * column.dim..(episode.first + episode.length) * column.dim;
                        FeatureStats::of(column.data.get(range)?, column.dim)
                    }),
                };
                let Some(single) = single else { continue };
                let usable = if index { vec![true] } else { finite.get(name).cloned().unwrap_or_default() };
                let row = &self.rows[at];
                faults.extend(wrong(exact.as_ref(), &single, stored, &usable).map(|(what, expected, found)| {
                    let what = format!("stats/{name}/{what}");
                    Fault::new(Area::Statistics, &row.file, &what, expected, found).of(number, row.at)
                }));
            }
        }
        Ok(faults)
    }

    /// Of pictures, what can be said of statistics without looking at them. LeRobot trains on no camera without any.
    fn picture_statistics_faults(&self, set: &Dataset, faults: &mut Vec<Fault>) {
        const FILE: &str = "meta/stats.json";
        for (name, feature) in self.info.features.0.iter().filter(|(_, f)| f.is_visual() && !set.stats().is_empty()) {
            match set.stats().get(name) {
                None if feature.is_depth() => {}
                None => {
                    let fault = Fault::new(Area::Statistics, FILE, name, "statistics", "none");
                    faults.push(Fault { repairable: is_looked_at(feature), ..fault });
                }
                Some(stored) => faults.extend(in_disorder(stored, &[]).map(|(what, expected, found)| {
                    let fault = Fault::new(Area::Statistics, FILE, &format!("{name}: {what}"), expected, found);
                    Fault { repairable: is_looked_at(feature), ..fault }
                })),
            }
        }
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
}

/// Shares of the largest value.
#[derive(Clone, Copy)]
struct Tolerance {
    /// Of the smallest and the largest value, which nobody computes.
    extremes: f64,
    others: f64,
}

/// Difference up to which a stored statistic counts as right, as a share of the largest value: LeRobot adds in float32.
const TOLERANCE: Tolerance = Tolerance { extremes: 1e-4, others: 1e-4 };
/// The same of numbers that float32 does not hold, which it adds in float64.
const WIDE_TOLERANCE: Tolerance = Tolerance { extremes: 1e-10, others: 1e-10 };

/// The same of statistics of doubles that were read as float32, as some of LeRobot's scripts do.
const SINGLE_TOLERANCE: Tolerance = Tolerance { extremes: 1e-9, others: 1e-6 };

/// A statistic, what belongs there and what was found.
type Found = (&'static str, String, String);

type Get = fn(&FeatureStats) -> &Vec<f64>;

/// The first statistic that is wrong: of a column that float32 does not hold, one that is neither exact nor that of its float32.
fn wrong(exact: Option<&FeatureStats>, single: &FeatureStats, stored: &FeatureStats, usable: &[bool]) -> Option<Found> {
    let Some(exact) = exact else { return differing(single, stored, usable, TOLERANCE) };
    let found = differing(exact, stored, usable, WIDE_TOLERANCE)?;
    differing(single, stored, usable, SINGLE_TOLERANCE).map(|_| found)
}

/// The first statistic that differs, in the dimensions that are `usable`.
fn differing(computed: &FeatureStats, stored: &FeatureStats, usable: &[bool], tolerance: Tolerance) -> Option<Found> {
    if stored.count != computed.count {
        return Some(("count", computed.count.to_string(), stored.count.to_string()));
    }
    let vectors: [(&str, Get); 4] =
        [("min", |s| &s.min), ("max", |s| &s.max), ("mean", |s| &s.mean), ("std", |s| &s.std)];
    for (statistic, get) in vectors {
        let (a, b) = (get(computed), get(stored));
        let close = |i: usize| {
            let scale = scale(computed, i);
            let tolerance = if ["min", "max"].contains(&statistic) { tolerance.extremes } else { tolerance.others };
            // a variance is a difference of squares
            (a[i] - b[i]).abs() <= tolerance * scale
                || statistic == "std" && (a[i].powi(2) - b[i].powi(2)).abs() <= tolerance * scale.powi(2)
        };
        let same = |i: usize| usable.get(i) == Some(&false) || close(i);
        if a.len() != b.len() || !(0..a.len()).all(same) {
            return Some((statistic, format!("{a:?}"), format!("{b:?}")));
        }
    }
    in_disorder(stored, usable)
}

/// The largest value of a dimension.
fn scale(stats: &FeatureStats, dimension: usize) -> f64 {
    let size = |vector: &Vec<f64>| vector.get(dimension).map_or(0.0, |value| value.abs());
    size(&stats.min).max(size(&stats.max))
}

/// The first of the quantiles that is less than the one before it, or of another length. Old sets have none.
fn in_disorder(stored: &FeatureStats, usable: &[bool]) -> Option<Found> {
    let vectors: [(&str, Get); 7] = [
        ("min", |s| &s.min),
        ("q01", |s| &s.q01),
        ("q10", |s| &s.q10),
        ("q50", |s| &s.q50),
        ("q90", |s| &s.q90),
        ("q99", |s| &s.q99),
        ("max", |s| &s.max),
    ];
    let dim = stored.min.len();
    let there: Vec<_> = vectors.iter().map(|(name, get)| (*name, get(stored))).filter(|(_, v)| !v.is_empty()).collect();
    for two in there.windows(2) {
        let [(_, low), (name, high)] = two else { continue };
        if high.len() != dim || low.len() != dim {
            return Some((name, format!("{dim} numbers"), format!("{high:?}")));
        }
        // LeRobot counts quantiles in bins a little wider than the values
        let rises = |i: usize| high[i] >= low[i] - TOLERANCE.others * scale(stored, i) - 1e-9;
        if !(0..dim).all(|i| usable.get(i) == Some(&false) || rises(i)) {
            return Some((name, format!("no less than {low:?}"), format!("{high:?}")));
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
