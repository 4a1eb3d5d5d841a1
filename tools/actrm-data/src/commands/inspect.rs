use anyhow::Result;
use dataset::{Dataset, NonFinite, OldSet, Source};
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// Show what is in a file of demonstrations or in a data set.
///
/// For HDF5: layout, environment and version, demos and their lengths, every dataset with type, shape and range,
/// masks, and everything that is wrong. For a data set directory: the same from its columns.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-data inspect data/lift.hdf5
  actrm-data inspect lift --json
  actrm-data inspect image.hdf5 --quick --demos")]
pub struct Args {
    /// Anything that `convert` takes, or a data set directory
    path: PathBuf,
    /// Do not read a file's data: no ranges. Those of a data set are stored
    #[arg(long)]
    quick: bool,
    /// List every demo
    #[arg(long)]
    demos: bool,
    /// As JSON
    #[arg(long)]
    json: bool,
}

/// What is shown, whatever it was read from.
#[derive(Serialize)]
pub(super) struct Summary {
    path: String,
    pub(super) layout: String,
    pub(super) bytes: u64,
    pub(super) env_name: Option<String>,
    pub(super) env_version: Option<String>,
    pub(super) demos: usize,
    pub(super) frames: usize,
    pub(super) length_min: usize,
    pub(super) length_mean: f64,
    pub(super) length_max: usize,
    keys: Vec<KeyRow>,
    pub(super) masks: BTreeMap<String, usize>,
    pub(super) tasks: Vec<String>,
    pub(super) notes: Vec<String>,
    pub(super) problems: Vec<String>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    each: Vec<DemoRow>,
}

#[derive(Serialize)]
struct KeyRow {
    key: String,
    dtype: String,
    shapes: Vec<Vec<usize>>,
    demos: usize,
    min: Option<f64>,
    max: Option<f64>,
    /// Unit of a feature that is depth, where it is stated.
    #[serde(skip_serializing_if = "Option::is_none")]
    depth: Option<String>,
    /// Codec, rate and files of a feature that is video.
    #[serde(skip_serializing_if = "Option::is_none")]
    video: Option<VideoRow>,
}

#[derive(Serialize)]
struct VideoRow {
    codecs: Vec<String>,
    /// Width and height as the files have them.
    sizes: Vec<(usize, usize)>,
    fps: Vec<f64>,
    frames: usize,
    files: usize,
    bytes: u64,
}

#[derive(Serialize)]
struct DemoRow {
    id: String,
    length: usize,
    task: Option<String>,
}

/// What is in a file or a data set, without its demos and without reading a file's data.
pub(super) fn summary(path: &Path) -> Result<Summary> {
    of(&Args { path: path.to_owned(), quick: true, demos: false, json: false })
}

fn of(args: &Args) -> Result<Summary> {
    if let Some(old) = OldSet::open(&args.path)? {
        let mut summary = of_dataset(args, old.set())?;
        summary.layout = format!("LeRobotDataset {}", old.version());
        summary.notes.push("`actrm-data convert` makes a LeRobotDataset v3.0 of it".to_owned());
        summary.notes.extend(old.notes().iter().cloned());
        return Ok(summary);
    }
    match args.path.join("meta/info.json").exists() {
        true => of_dataset(args, &Dataset::open(&args.path)?),
        false => of_source(args),
    }
}

impl KeyRow {
    /// Its type, for people.
    fn shown_type(&self) -> String {
        match &self.depth {
            Some(unit) => format!("{}, depth in {unit}", self.dtype),
            None => self.dtype.clone(),
        }
    }
}

impl Summary {
    /// Name, type, shape of a step, and range or codec of each feature.
    pub(super) fn features(&self) -> Vec<[String; 4]> {
        let row = |key: &KeyRow| {
            let shapes: Vec<String> = key.shapes.iter().map(|shape| cli::shape(shape)).collect();
            let video = key.video.as_ref().map(|video| {
                let sizes: Vec<String> =
                    video.sizes.iter().map(|(width, height)| format!("{width} x {height}")).collect();
                let (codecs, files) = (video.codecs.join(" or "), video.files);
                format!("{codecs}, {}, {files} files, {}", sizes.join(" or "), cli::bytes(video.bytes))
            });
            let range =
                key.min.zip(key.max).map(|(low, high)| format!("{} to {}", cli::number(low), cli::number(high)));
            [key.key.clone(), key.shown_type(), shapes.join(" or "), video.or(range).unwrap_or_default()]
        };
        self.keys.iter().map(row).collect()
    }
}

pub fn run(args: &Args) -> Result<ExitCode> {
    let summary = of(args)?;
    if args.json {
        cli::print_json(&summary)?;
    } else {
        cli::print(&show(&summary))?;
    }
    Ok(ExitCode::SUCCESS)
}

fn of_source(args: &Args) -> Result<Summary> {
    let source = Source::open_guarded(&args.path)?.nonfinite(NonFinite::Keep);
    let plan = source.plan();
    let mut problems: Vec<String> = plan.problems.iter().map(|p| p.message.clone()).collect();
    let mut ranges: BTreeMap<String, (f64, f64)> = BTreeMap::new();
    if !args.quick {
        let mut screen = cli::Screen::new();
        let mut advance = screen.advance("reading");
        let known: BTreeSet<&str> =
            plan.problems.iter().filter(|p| p.fatal).filter_map(|p| p.demo.as_deref()).collect();
        for (index, demo) in plan.demos.iter().enumerate() {
            let small = |key: &str| demo.keys.get(key).is_some_and(|k| !k.is_image() && k.dtype.is_numeric());
            match source.read_demo_where(index, &small) {
                Ok(read) => {
                    for (key, array) in &read.datasets {
                        problems.extend(source.not_finite(&demo.id, key, array, 0).map(|e| e.to_string()));
                        for value in array.to_f64().unwrap_or_default() {
                            let range = ranges.entry(key.clone()).or_insert((f64::INFINITY, f64::NEG_INFINITY));
                            *range = (range.0.min(value), range.1.max(value));
                        }
                    }
                }
                Err(_) if known.contains(demo.id.as_str()) => {}
                Err(e) => problems.push(e.to_string()),
            }
            advance(index as u64 + 1, plan.demos.len() as u64);
        }
    }
    let mut keys: BTreeMap<&str, KeyRow> = BTreeMap::new();
    for demo in &plan.demos {
        for (path, key) in &demo.keys {
            let row = keys.entry(path).or_insert_with(|| KeyRow {
                key: path.to_owned(),
                dtype: key.dtype.to_string(),
                shapes: Vec::new(),
                demos: 0,
                min: ranges.get(path).map(|r| r.0),
                max: ranges.get(path).map(|r| r.1),
                depth: None,
                video: None,
            });
            row.demos += 1;
            // a step's shape where there is one row a step, the whole shape otherwise
            let shape = match key.shape.split_first() {
                Some((&rows, rest)) if rows == demo.length => rest.to_vec(),
                _ => key.shape.to_vec(),
            };
            if !row.shapes.contains(&shape) {
                row.shapes.push(shape);
            }
        }
    }
    let lengths: Vec<usize> = plan.demos.iter().map(|d| d.length).collect();
    let mut tasks: Vec<String> = plan.demos.iter().filter_map(|d| d.task.clone()).collect();
    tasks.sort();
    tasks.dedup();
    let each = plan.demos.iter().map(|d| DemoRow { id: d.id.clone(), length: d.length, task: d.task.clone() });
    Ok(Summary {
        path: cli::lossy(&args.path),
        layout: format!("{} {}", plan.dialect.name(), plan.dialect.format()),
        bytes: plan.files.iter().map(|(_, size)| size).sum(),
        env_name: plan.env_name.clone(),
        env_version: plan.env_version.clone(),
        demos: lengths.len(),
        frames: plan.frames(),
        length_min: lengths.iter().copied().min().unwrap_or(0),
        length_mean: plan.frames() as f64 / lengths.len().max(1) as f64,
        length_max: lengths.iter().copied().max().unwrap_or(0),
        keys: keys.into_values().collect(),
        masks: plan.masks.iter().map(|(name, demos)| (name.clone(), demos.len())).collect(),
        tasks,
        notes: plan.notes.clone(),
        problems,
        each: if args.demos { each.collect() } else { Vec::new() },
    })
}

fn of_dataset(args: &Args, set: &Dataset) -> Result<Summary> {
    let lengths: Vec<usize> = set.episodes().iter().map(|e| e.length).collect();
    let ranges = |name: &str| {
        let stats = set.stats().get(name)?;
        let least = stats.min.iter().copied().fold(f64::INFINITY, f64::min);
        Some((least, stats.max.iter().copied().fold(f64::NEG_INFINITY, f64::max)))
    };
    let mut problems = Vec::new();
    let mut keys = Vec::new();
    for (name, feature) in &set.info().features.0 {
        let video = match feature.dtype.as_str() {
            "video" => videos(set, name).map_err(|e| problems.push(format!("{name}: {e}"))).ok(),
            _ => None,
        };
        keys.push(KeyRow {
            key: name.clone(),
            dtype: feature.dtype.clone(),
            shapes: vec![feature.shape.clone()],
            demos: lengths.len(),
            min: ranges(name).map(|r| r.0),
            max: ranges(name).map(|r| r.1),
            depth: feature.is_depth().then(|| feature.depth_unit().unwrap_or("an unstated unit").to_owned()),
            video,
        });
    }
    let each = set.episodes().iter().map(|e| DemoRow {
        id: e.demo.clone().unwrap_or_else(|| format!("episode {}", e.index)),
        length: e.length,
        task: e.tasks.first().cloned(),
    });
    let lossless = set.provenance().map(|p| match p.lossless {
        true => format!("converted from {} ({}); the side folder keeps the rest of it", p.source, p.dialect),
        false => format!("converted from {} ({}) without the side folder", p.source, p.dialect),
    });
    Ok(Summary {
        path: cli::lossy(&args.path),
        layout: format!("LeRobotDataset {}", set.info().codebase_version),
        bytes: folder_bytes(&args.path),
        env_name: set.env().map(|e| e.env_name.clone()),
        env_version: set.env().and_then(|e| e.env_version.clone()),
        demos: lengths.len(),
        frames: set.frames(),
        length_min: lengths.iter().copied().min().unwrap_or(0),
        length_mean: set.frames() as f64 / lengths.len().max(1) as f64,
        length_max: lengths.iter().copied().max().unwrap_or(0),
        keys,
        masks: set
            .split_names()
            .into_iter()
            .filter_map(|name| Some((name.to_owned(), set.split(name)?.len())))
            .collect(),
        tasks: set.tasks().to_vec(),
        notes: lossless
            .into_iter()
            .chain([format!("fingerprint {}", set.fingerprint())])
            .chain(set.provenance().map_or_else(Vec::new, |provenance| provenance.notes()))
            .chain(set.notes().iter().cloned())
            .collect(),
        problems,
        each: if args.demos { each.collect() } else { Vec::new() },
    })
}

/// What a camera's files say.
fn videos(set: &Dataset, name: &str) -> Result<VideoRow, dataset::DatasetError> {
    let files = set.video_files(name)?;
    let mut row =
        VideoRow { codecs: Vec::new(), sizes: Vec::new(), fps: Vec::new(), frames: 0, files: files.len(), bytes: 0 };
    for file in files {
        row.codecs.push(file.info.codec);
        row.sizes.push((file.info.width, file.info.height));
        row.fps.push(file.info.fps);
        row.frames += file.info.frames;
        row.bytes += std::fs::metadata(&file.path).map_or(0, |m| m.len());
    }
    row.codecs.dedup();
    row.sizes.dedup();
    row.fps.dedup();
    Ok(row)
}

fn folder_bytes(path: &Path) -> u64 {
    let Ok(entries) = std::fs::read_dir(path) else { return 0 };
    entries
        .flatten()
        .map(|e| match e.metadata() {
            Ok(m) if m.is_dir() => folder_bytes(&e.path()),
            Ok(m) => m.len(),
            Err(_) => 0,
        })
        .sum()
}

fn show(s: &Summary) -> String {
    let mut text = format!("{}: {}, {}\n", s.path, s.layout, cli::bytes(s.bytes));
    let env = s.env_name.as_deref().unwrap_or("not stated");
    let version = s.env_version.as_ref().map_or_else(|| "version not stated".to_owned(), |v| format!("version {v}"));
    text.push_str(&format!("environment: {env}, {version}\n"));
    text.push_str(&format!(
        "demos: {} with {} steps (shortest {}, mean {:.1}, longest {})\n",
        cli::count(s.demos),
        cli::count(s.frames),
        s.length_min,
        s.length_mean,
        s.length_max
    ));
    if !s.masks.is_empty() {
        let masks: Vec<String> = s.masks.iter().map(|(name, n)| format!("{name} {n}")).collect();
        text.push_str(&format!("masks: {}\n", masks.join(", ")));
    }
    if !s.tasks.is_empty() {
        text.push_str(&format!("tasks: {}\n", s.tasks.join("; ")));
    }
    let range = |v: Option<f64>| v.map_or_else(String::new, cli::number);
    let rows: Vec<Vec<String>> = s
        .keys
        .iter()
        .map(|k| {
            let shapes: Vec<String> = k.shapes.iter().map(|shape| cli::shape(shape)).collect();
            let demos = if k.demos == s.demos { "all".to_owned() } else { format!("{} of {}", k.demos, s.demos) };
            vec![k.key.clone(), k.shown_type(), shapes.join(" or "), demos, range(k.min), range(k.max)]
        })
        .collect();
    text.push_str(&cli::table(&["key", "type", "shape of a step", "demos", "min", "max"], &rows, &[4, 5]));
    if !s.each.is_empty() {
        let rows: Vec<Vec<String>> = s
            .each
            .iter()
            .map(|d| vec![d.id.clone(), d.length.to_string(), d.task.clone().unwrap_or_default()])
            .collect();
        text.push_str(&cli::table(&["demo", "steps", "task"], &rows, &[1]));
    }
    for (key, video) in s.keys.iter().filter_map(|k| Some((&k.key, k.video.as_ref()?))) {
        let sizes: Vec<String> = video.sizes.iter().map(|(width, height)| format!("{width} x {height}")).collect();
        let rates: Vec<String> = video.fps.iter().map(|&fps| cli::number(fps)).collect();
        text.push_str(&format!(
            "video: {key}: {}, {}, {} frames a second, {} frames in {} files, {}\n",
            video.codecs.join(" or "),
            sizes.join(" or "),
            rates.join(" or "),
            cli::count(video.frames),
            video.files,
            cli::bytes(video.bytes)
        ));
    }
    for note in &s.notes {
        text.push_str(&format!("note: {note}\n"));
    }
    match s.problems.as_slice() {
        [] => text.push_str("no problems found\n"),
        problems => {
            for problem in problems {
                text.push_str(&format!("problem: {problem}\n"));
            }
        }
    }
    text
}
