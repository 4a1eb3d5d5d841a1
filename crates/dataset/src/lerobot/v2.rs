//! LeRobot v2.0 and v2.1 folders, which have a file an episode: shown as the v3.0 set that they become, by links to their files
//! beside tables of v3.0. Conversion composes its result from that view, as `edit` does.

use super::check;
use super::convert::ConvertReport;
use super::edit;
use super::features::{ConvertOptions, ImageForm};
use super::info::{ActionKind, CODEBASE_VERSION, DATA_PATH, FILES_PER_FOLDER, Info, RotationForm};
use super::meta::{self, EpisodeRow, parse_stats, python_json};
use super::open::{Dataset, read_file, read_info};
use super::read;
use super::shards::Place;
use super::staging::own;
use super::totals::EpisodeStats;
use super::verify::not_finite;
use super::videos::{Stretch, VIDEO_PATH};
use crate::error::{DatasetError, InputError, Result};
use crate::source::{NonFinite, list};
use crate::stats::FeatureStats;
use arrow_array::{Array, ArrayRef, BooleanArray, Float64Array, Int64Array, ListArray, StringArray};
use arrow_buffer::OffsetBuffer;
use arrow_schema::Field;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::ops::ControlFlow;
use std::os::unix::fs::symlink;
use std::path::{Component, Path, PathBuf};
use std::sync::Arc;

/// How the names of the folders of views begin.
pub(super) const VIEW: &str = "actrm-view-";

/// Name of the view of an episode's file, in a folder of so many.
fn numbered(number: usize, extension: &str) -> String {
    format!("chunk-{:03}/file-{:03}.{extension}", number / FILES_PER_FOLDER, number % FILES_PER_FOLDER)
}

/// The version that the folder states, if it is 2.x.
pub(crate) fn version(root: &Path) -> Option<String> {
    let text = std::fs::read(root.join("meta/info.json")).ok()?;
    let value: Value = serde_json::from_slice(&text).ok()?;
    let version = value.get("codebase_version")?.as_str()?;
    version.starts_with("v2.").then(|| version.to_owned())
}

/// A LeRobot v2.0 or v2.1 folder, opened as the v3.0 set that it becomes.
pub struct OldSet {
    root: PathBuf,
    version: String,
    view: tempfile::TempDir,
    set: Dataset,
    notes: Vec<String>,
}

#[derive(Deserialize)]
struct TaskLine {
    task_index: usize,
    task: String,
}

#[derive(Deserialize)]
struct EpisodeLine {
    episode_index: usize,
    #[serde(default)]
    tasks: Vec<String>,
    length: usize,
    /// What another program added.
    #[serde(flatten)]
    added: BTreeMap<String, Value>,
}

#[derive(Deserialize)]
struct StatsLine {
    episode_index: usize,
    stats: Value,
}

/// The lines of `meta/<name>`, each of which is JSON, as Python writes it.
fn lines<T: DeserializeOwned>(root: &Path, name: &str, expected: &str) -> Result<Vec<T>> {
    let path = root.join("meta").join(name);
    let text = read_file(&path)?;
    let full = text.split(|&byte| byte == b'\n').enumerate().filter(|(_, line)| !line.trim_ascii().is_empty());
    full.map(|(number, line)| {
        python_json(line).and_then(serde_json::from_value).map_err(|error| DatasetError::BadDataset {
            path: path.clone(),
            object: format!("line {}", number + 1),
            expected: format!("JSON with {expected}"),
            found: error.to_string(),
        })
    })
    .collect()
}

/// Lines in the order of their numbers, which are 0, 1, 2, ...
fn in_order<T>(root: &Path, name: &str, mut all: Vec<T>, number: impl Fn(&T) -> usize) -> Result<Vec<T>> {
    all.sort_by_key(&number);
    match all.iter().enumerate().find(|(i, line)| number(line) != *i) {
        None => Ok(all),
        Some((i, line)) => Err(DatasetError::BadDataset {
            path: root.join("meta").join(name),
            object: "numbers".to_owned(),
            expected: format!("a line for {i}"),
            found: format!("{} after {} lines", number(line), i),
        }),
    }
}

/// Fills in a path of v2.x, which is in Python's format language; it has to stay in the folder.
fn fill(template: &str, camera: &str, chunk: usize, episode: usize) -> Option<PathBuf> {
    let text = template
        .replace("{video_key}", camera)
        .replace("{episode_chunk:03d}", &format!("{chunk:03}"))
        .replace("{episode_index:06d}", &format!("{episode:06}"));
    let path = PathBuf::from(&text);
    let inside = path.components().all(|c| matches!(c, Component::Normal(_)));
    (inside && !text.contains('{')).then_some(path)
}

impl OldSet {
    /// Opens the folder `root`; `None` if it is no LeRobot v2.x folder.
    ///
    /// # Errors
    /// A table, a file of frames or a video that is missing or cannot be read, by its name in the folder.
    pub fn open(root: &Path) -> Result<Option<Self>> {
        let Some(version) = version(root) else { return Ok(None) };
        let failed = |source| DatasetError::Io { path: root.to_path_buf(), operation: "look at it", source };
        let root = std::fs::canonicalize(root).map_err(failed)?;
        let view = tempfile::Builder::new().prefix(&own(VIEW)).tempdir().map_err(|source| DatasetError::Io {
            path: std::env::temp_dir(),
            operation: "create a folder in it",
            source,
        })?;
        let mut notes = Vec::new();
        let set = show(&root, view.path(), &mut notes)
            .and_then(|()| Dataset::open(view.path()))
            .map_err(|error| named(error, view.path(), &root))?;
        Ok(Some(Self { root, version, view, set, notes }))
    }

    /// The version that it states.
    pub fn version(&self) -> &str {
        &self.version
    }

    /// The v3.0 set that it becomes.
    pub fn set(&self) -> &Dataset {
        &self.set
    }

    /// What is not as it should be, and how it was read.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// Makes the set.
    pub(super) fn convert(
        self,
        out: &Path,
        options: &ConvertOptions,
        progress: &mut dyn FnMut(u64, u64) -> ControlFlow<()>,
    ) -> Result<ConvertReport> {
        refuse_choices(&self.root, options)?;
        if options.nonfinite == NonFinite::Refuse {
            let found = match not_finite(&self.set) {
                Some(found) => Some(found),
                None => no_time(self.view.path()).map_err(|error| named(error, self.view.path(), &self.root))?,
            };
            if let Some(found) = found {
                return Err(DatasetError::BadDataset {
                    path: self.root,
                    object: "frames".to_owned(),
                    expected: "finite numbers (--nonfinite keep stores others)".to_owned(),
                    found: found.lines().next().unwrap_or_default().to_owned(),
                });
            }
        }
        let Self { root, version, view, mut set, notes } = self;
        set.limit_files(options.data_file_mb, options.video_file_mb);
        let report = edit::gather(set, &root, out, progress).map_err(|error| named(error, view.path(), &root))?;
        let features = read_info(out)?.features.0;
        Ok(ConvertReport {
            dialect: if version == "v2.0" { "LeRobot v2.0" } else { "LeRobot v2.1" },
            episodes: report.episodes,
            frames: report.frames,
            tasks: report.tasks,
            features: features.into_iter().map(|(name, f)| (name, f.dtype, f.shape)).collect(),
            files: report.files,
            bytes: report.bytes,
            fingerprint: report.fingerprint,
            skipped: Vec::new(),
            notes: notes.into_iter().chain(report.notes).collect(),
        })
    }
}

/// Columns are taken over as they are: what chooses or changes them is refused.
fn refuse_choices(root: &Path, options: &ConvertOptions) -> Result<()> {
    let given = [
        (options.state_keys.is_some(), "--state-keys"),
        (options.env_keys.is_some(), "--env-keys"),
        (!options.entities.is_empty(), "--entity"),
        (options.fps.is_some(), "--fps"),
        (options.images != ImageForm::default(), "--images"),
        (options.video.is_some(), "--video"),
        (!options.depth, "--no-depth"),
        (options.actions != ActionKind::default(), "--actions"),
        (options.rotation != RotationForm::default(), "--rotation"),
        (options.skip_bad, "--skip-bad"),
    ];
    match given.into_iter().find(|(given, _)| *given) {
        None => Ok(()),
        Some((_, option)) => Err(InputError::Unsupported {
            path: root.to_path_buf(),
            object: "a LeRobot v2.x folder, whose columns are kept as they are".to_owned(),
            what: option.to_owned(),
        }
        .into()),
    }
}

/// Writes the tables of v3.0 into `view`, with links to the files of the v2.x folder `root`.
fn show(root: &Path, view: &Path, notes: &mut Vec<String>) -> Result<()> {
    let path = root.join("meta/info.json");
    let mut info: Info = serde_json::from_slice(&read_file(&path)?)
        .map_err(|source| DatasetError::Json { path: path.clone(), source })?;
    check::names(&path, &info.features)?;
    let tasks =
        in_order(root, "tasks.jsonl", lines(root, "tasks.jsonl", "task_index and task")?, |line: &TaskLine| {
            line.task_index
        })?;
    let mut texts: Vec<String> = tasks.into_iter().map(|line| line.task).collect();
    let episodes = lines(root, "episodes.jsonl", "episode_index, tasks and length")?;
    let episodes = in_order(root, "episodes.jsonl", episodes, |line: &EpisodeLine| line.episode_index)?;
    if episodes.is_empty() {
        return Err(InputError::NoDemos { path: root.join("meta/episodes.jsonl"), found: "no line".to_owned() }.into());
    }
    let added = added_columns(&episodes);
    let visual: Vec<(String, bool)> =
        info.features.0.iter().filter(|(_, f)| f.is_visual()).map(|(name, _)| (name.clone(), true)).collect();
    let mut stats = statistics(root, &visual)?;
    let cameras: Vec<String> =
        info.features.0.iter().filter(|(_, f)| f.dtype == "video").map(|(name, _)| name.clone()).collect();
    let bad_path = |object: &str, found: String| DatasetError::BadDataset {
        path: path.clone(),
        object: object.to_owned(),
        expected: "a path inside the folder with episode_chunk and episode_index, of videos with video_key".to_owned(),
        found,
    };
    let mut rows = Vec::with_capacity(episodes.len());
    let mut each = EpisodeStats::new(view);
    let mut others = data_files(root, &info.data_path);
    if info.total_episodes != episodes.len() {
        let (there, stated) = (episodes.len(), info.total_episodes);
        notes.push(format!(
            "meta/info.json: total_episodes: expected {there}, as meta/episodes.jsonl lists, found {stated}: read as {there}"
        ));
    }
    let mut from = 0;
    for (number, line) in episodes.into_iter().enumerate() {
        let chunk = number / info.chunks_size.max(1);
        let relative = fill(&info.data_path, "", chunk, number);
        let file = root.join(relative.ok_or_else(|| bad_path("data_path", info.data_path.clone()))?);
        others.remove(&file);
        let found = read::open(&file)?.metadata().file_metadata().num_rows();
        let length = usize::try_from(found).unwrap_or(0);
        if length != line.length {
            notes.push(format!(
                "meta/episodes.jsonl: episode {number}: expected {length} frames, as its file has, found {}: read as {length}",
                line.length
            ));
        }
        link(&file, &view.join("data").join(numbered(number, "parquet")))?;
        let mut videos = BTreeMap::new();
        for camera in &cameras {
            let template = info.video_path.clone().unwrap_or_default();
            let relative = fill(&template, camera, chunk, number).filter(|_| template.contains("{video_key}"));
            let relative = relative.ok_or_else(|| bad_path("video_path", template))?;
            let file = root.join(relative);
            read::refuse_pointer(&file)?;
            link(&file, &view.join("videos").join(camera).join(numbered(number, "mp4")))?;
            let (folder, file) = (number / FILES_PER_FOLDER, number % FILES_PER_FOLDER);
            videos.insert(camera.clone(), Stretch { folder, file, from: 0.0, to: length as f64 / info.fps });
        }
        let tasks = line.tasks.iter().map(|text| {
            texts.iter().position(|known| known == text).unwrap_or_else(|| {
                notes.push(format!("meta/tasks.jsonl: task {text:?} of episode {number} is not there: it is added"));
                texts.push(text.clone());
                texts.len() - 1
            })
        });
        rows.push(EpisodeRow {
            length,
            from,
            tasks: tasks.collect(),
            place: Place { folder: number / FILES_PER_FOLDER, file: number % FILES_PER_FOLDER },
            videos,
        });
        each.add(&stats.remove(&number).unwrap_or_default(), length)?;
        from += length;
    }
    if !others.is_empty() {
        let names: Vec<String> =
            others.iter().map(|file| file.strip_prefix(root).unwrap_or(file).display().to_string()).collect();
        let of = list(names.iter().map(String::as_str));
        notes.push(format!("meta/episodes.jsonl lists no episode of {} files, which are left out: {of}", names.len()));
    }
    let images = root.join("images");
    if images.is_dir() {
        // images that frames name by path
        link(&images, &view.join("images"))?;
    }
    meta::write_tasks(view, &texts)?;
    meta::write_episodes(view, &texts, &visual, &rows, &each, &added)?;
    let totals = totals(root, &visual, from)?;
    let of_totals: Vec<(String, bool)> = totals.keys().map(|name| (name.clone(), true)).collect();
    meta::write_stats(view, &of_totals, &totals)?;
    info.codebase_version = CODEBASE_VERSION.to_owned();
    (info.total_episodes, info.total_frames, info.total_tasks) = (rows.len(), from, texts.len());
    info.chunks_size = FILES_PER_FOLDER;
    info.data_path = DATA_PATH.to_owned();
    info.video_path = (!cameras.is_empty()).then(|| VIDEO_PATH.to_owned());
    for gone in ["total_chunks", "total_videos"] {
        info.other.remove(gone);
    }
    info.actrm = None;
    meta::write_info(view, &info).map(drop)
}

/// What other programs say of each episode, as columns.
fn added_columns(episodes: &[EpisodeLine]) -> Vec<(Field, ArrayRef)> {
    let names: BTreeSet<&String> = episodes.iter().flat_map(|line| line.added.keys()).collect();
    let column = |name: &String| {
        let array = column_of(&episodes.iter().map(|line| line.added.get(name)).collect::<Vec<_>>());
        (Field::new(name, array.data_type().clone(), true), array)
    };
    names.into_iter().filter(|name| !edit::is_own(name)).map(column).collect()
}

/// JSON values as a column of the type that all have, or of JSON texts.
fn column_of(values: &[Option<&Value>]) -> ArrayRef {
    let each = || values.iter().map(|value| value.filter(|value| !value.is_null()));
    let all = |is: fn(&Value) -> bool| each().flatten().all(is);
    if all(Value::is_boolean) {
        return Arc::new(each().map(|value| value?.as_bool()).collect::<BooleanArray>());
    } else if all(Value::is_i64) {
        return Arc::new(each().map(|value| value?.as_i64()).collect::<Int64Array>());
    } else if all(Value::is_number) {
        return Arc::new(each().map(|value| value?.as_f64()).collect::<Float64Array>());
    } else if all(Value::is_string) {
        return Arc::new(each().map(|value| value?.as_str()).collect::<StringArray>());
    } else if all(Value::is_array) {
        let list = each().map(|value| value.and_then(Value::as_array).map_or(&[][..], Vec::as_slice));
        let lists: Vec<&[Value]> = list.collect();
        let inner = column_of(&lists.iter().copied().flatten().map(Some).collect::<Vec<_>>());
        let offsets = OffsetBuffer::from_lengths(lists.iter().map(|list| list.len()));
        let nulls = each().map(|value| value.is_some()).collect();
        let element = Arc::new(Field::new("element", inner.data_type().clone(), true));
        return Arc::new(ListArray::new(element, offsets, inner, Some(nulls)));
    }
    Arc::new(each().map(|value| value.map(Value::to_string)).collect::<StringArray>())
}

/// The first time that is NaN or infinite, in a view, which has a file an episode.
fn no_time(view: &Path) -> Result<Option<String>> {
    for (episode, path) in read::files(view, "data")?.iter().enumerate() {
        let (_, arrays) = read::columns_there(path, &["timestamp"])?;
        let Some(array) = arrays.get("timestamp") else { continue };
        let times = read::doubles(path, "timestamp", array)?;
        if let Some(frame) = times.iter().position(|time| !time.is_finite()) {
            return Ok(Some(format!("timestamp: episode {episode}, frame {frame}: {}", times[frame])));
        }
    }
    Ok(None)
}

/// The Parquet files beside those that `template` names.
fn data_files(root: &Path, template: &str) -> BTreeSet<PathBuf> {
    let top = template.split('/').next().unwrap_or_default();
    // whoever reads the files says what is wrong with them
    read::files(root, top).into_iter().flatten().collect()
}

fn link(file: &Path, view: &Path) -> Result<()> {
    let failed = |operation| {
        let path = file.to_path_buf();
        move |source| DatasetError::Io { path, operation, source }
    };
    std::fs::metadata(file).map_err(failed("read it"))?;
    super::shards::create_parent(view)?;
    symlink(file, view).map_err(failed("link to it"))
}

/// What v2.1 states of each episode's images and videos.
fn statistics(root: &Path, visual: &[(String, bool)]) -> Result<BTreeMap<usize, BTreeMap<String, FeatureStats>>> {
    const NAME: &str = "episodes_stats.jsonl";
    if !root.join("meta").join(NAME).exists() {
        return Ok(BTreeMap::new());
    }
    let mut all = BTreeMap::new();
    for line in lines::<StatsLine>(root, NAME, "episode_index and stats")? {
        all.insert(line.episode_index, parsed(root, NAME, &line.stats, visual)?);
    }
    Ok(all)
}

/// What v2.0 states of all images and videos together; it does not say of how many.
fn totals(root: &Path, visual: &[(String, bool)], frames: usize) -> Result<BTreeMap<String, FeatureStats>> {
    const NAME: &str = "stats.json";
    let path = root.join("meta").join(NAME);
    if !path.exists() {
        return Ok(BTreeMap::new());
    }
    let mut value =
        python_json(&read_file(&path)?).map_err(|source| DatasetError::Json { path: path.clone(), source })?;
    for entry in value.as_object_mut().into_iter().flat_map(|features| features.values_mut()) {
        if let Some(entry) = entry.as_object_mut() {
            entry.entry("count").or_insert_with(|| json!([frames]));
        }
    }
    parsed(root, NAME, &value, visual)
}

fn parsed(root: &Path, name: &str, value: &Value, visual: &[(String, bool)]) -> Result<BTreeMap<String, FeatureStats>> {
    let of = |feature: &String| Some((feature.clone(), value.get(feature)?.clone()));
    let wanted = Value::Object(visual.iter().filter_map(|(feature, _)| of(feature)).collect());
    parse_stats(&wanted).map_err(|found| DatasetError::BadDataset {
        path: root.join("meta").join(name),
        object: "statistics".to_owned(),
        expected: "min, max, mean, std and count of every image and video".to_owned(),
        found,
    })
}

/// An error that names the folder's own file, where it named the view's.
fn named(error: DatasetError, view: &Path, root: &Path) -> DatasetError {
    let own = |path: PathBuf| match path.strip_prefix(view) {
        Err(_) => path,
        Ok(below) => std::fs::read_link(&path).unwrap_or_else(|_| root.join(below)),
    };
    match error {
        DatasetError::Io { path, operation, source } => DatasetError::Io { path: own(path), operation, source },
        DatasetError::Parquet { path, operation, source } => {
            DatasetError::Parquet { path: own(path), operation, source }
        }
        DatasetError::Json { path, source } => DatasetError::Json { path: own(path), source },
        DatasetError::BadDataset { path, object, expected, found } => {
            DatasetError::BadDataset { path: own(path), object, expected, found }
        }
        DatasetError::NotInDataset { path, wanted, found } => {
            DatasetError::NotInDataset { path: own(path), wanted, found }
        }
        DatasetError::Input(InputError::LfsPointer { path }) => InputError::LfsPointer { path: own(path) }.into(),
        DatasetError::Input(InputError::Video { path, text }) => {
            let real = own(path.clone());
            let text = text.replace(&path.display().to_string(), &real.display().to_string());
            InputError::Video { path: real, text }.into()
        }
        other => other,
    }
}
