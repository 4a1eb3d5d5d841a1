//! Which dataset of a demo becomes which column: resolved once from the plan, before anything is read.

use super::depth::{self, DepthKind};
use super::encoded::may_hold_files;
use super::info::{ActionKind, ActionProvenance, Feature, Features, RotationForm};
use super::to_robomimic::{Stated, stated};
use crate::error::{DatasetError, InputError, Result};
use crate::keys::KeyItem;
use crate::plan::{DemoPlan, KeyPlan, Plan};
use crate::source::NonFinite;
use crate::tree::Dtype;
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet};

/// Default keys of `observation.state`: the first set that is there whole wins. Robots after the first
/// (`robot1_...`) are added to robomimic's. If a file has none of these keys, all its vectors are used.
const STATE_DEFAULTS: [&[&str]; 7] = [
    &["robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos"],
    // UMI
    &["robot0_eef_pos", "robot0_eef_rot_axis_angle", "robot0_gripper_width"],
    // LIBERO, ALOHA and others, D4RL, Isaac Lab, DROID
    &["ee_pos", "ee_ori", "gripper_states"],
    &["qpos"],
    &["flat"],
    &["eef_pos", "eef_quat", "gripper_pos"],
    &["joint_positions", "gripper_position"],
];

/// What the names of columns of entities begin with.
pub const ENTITY_PREFIX: &str = "observation.entity.";

/// The column that says of every step whether its action is a mistake, for data that marks them.
pub const MISTAKE: &str = "mistake";

/// Default key of `observation.environment_state`.
const ENV_DEFAULT: &str = "object";

/// The longest row that is a vector and no image or cloud of points.
const VECTOR: usize = 4096;

/// Control frequency of robosuite environments whose arguments state none, in Hz.
const ROBOSUITE_CONTROL_FREQ: f64 = 20.0;

/// How images are stored in the data files.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ImageForm {
    /// PNG: small, slower to write and read.
    #[default]
    Png,
    /// PPM, uncompressed: fast, larger.
    Ppm,
}

/// How pictures become videos.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct VideoOptions {
    /// 0 (slow, small) to 10.
    pub speed: u8,
    /// 1 (large, nearly exact) to 255.
    pub quantizer: u8,
    /// Frames from a key frame to the next.
    pub key_interval: u16,
    /// Keep the exact pictures in the side folder.
    pub side_pictures: bool,
}

impl Default for VideoOptions {
    fn default() -> Self {
        let video::EncodeOptions { speed, quantizer, key_interval } = video::EncodeOptions::default();
        Self { speed, quantizer, key_interval, side_pictures: true }
    }
}

/// What a conversion may be told; the defaults are robomimic's.
#[derive(Debug, Clone)]
pub struct ConvertOptions {
    /// Observation keys of `observation.state`; `None` takes the defaults of the layout, an empty list makes no such
    /// column.
    pub state_keys: Option<Vec<String>>,
    /// Observation keys of `observation.environment_state`; `None` takes `object` where it is there, an empty list makes
    /// no such column.
    pub env_keys: Option<Vec<String>>,
    /// Observation keys of `observation.entity.<name>`, by name: vectors of one thing each, as a model that reads
    /// entities wants them. They may overlap the others.
    pub entities: BTreeMap<String, Vec<String>>,
    /// Frames a second; `None` takes the control frequency that the source states.
    pub fps: Option<f64>,
    /// How images are stored.
    pub images: ImageForm,
    /// Store pictures as AV1 videos, which are not exact, instead of images.
    pub video: Option<VideoOptions>,
    /// Make columns of depth; otherwise it is kept in the side folder alone.
    pub depth: bool,
    /// Which actions to take.
    pub actions: ActionKind,
    /// How to write the rotation part of actions.
    pub rotation: RotationForm,
    /// What is done with values that are NaN or infinite.
    pub nonfinite: NonFinite,
    /// Leave out demos that cannot be converted, instead of refusing the source.
    pub skip_bad: bool,
    /// Keep everything that the format has no place for in the side folder.
    pub lossless: bool,
    /// Threads that encode, besides the one that reads; 0 takes the number of cores.
    pub jobs: usize,
    /// Size at which a data file is closed, in MiB.
    pub data_file_mb: f64,
    /// Size at which a video file is closed, in MiB.
    pub video_file_mb: f64,
}

impl Default for ConvertOptions {
    fn default() -> Self {
        Self {
            state_keys: None,
            env_keys: None,
            entities: BTreeMap::new(),
            fps: None,
            images: ImageForm::default(),
            video: None,
            depth: true,
            actions: ActionKind::default(),
            rotation: RotationForm::default(),
            nonfinite: NonFinite::default(),
            skip_bad: false,
            lossless: true,
            jobs: 0,
            data_file_mb: 100.0,
            video_file_mb: 200.0,
        }
    }
}

impl ConvertOptions {
    /// Threads that encode.
    pub(crate) fn threads(&self) -> usize {
        match self.jobs {
            0 => std::thread::available_parallelism().map_or(1, usize::from),
            n => n,
        }
    }
}

/// Where the values of a column come from.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Origin {
    /// Observations side by side, each with the widths of the datasets that it reads, by key.
    Concat(Vec<(KeyItem, BTreeMap<String, usize>)>),
    /// The action dataset.
    Action { key: String, width: usize, rotation: RotationForm },
    /// `rewards` as float.
    Reward,
    /// `rewards` at its maximum of 1: the task is solved at this step.
    Success,
    /// A dataset of one truth value a step.
    Flag(String),
    /// A dataset as it is, in the type of the column.
    Stored(String),
    /// A dataset of 8-bit images, or of their JPEG files.
    Image { key: String, height: usize, width: usize, jpeg: bool },
    /// A dataset of depth, `dtype` a pixel.
    Depth { key: String, height: usize, width: usize, dtype: Dtype, kind: DepthKind },
    /// One of the five columns that every data set has.
    Index(IndexColumn),
}

/// The columns that follow from an episode's number and length.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum IndexColumn {
    Timestamp,
    FrameIndex,
    EpisodeIndex,
    Index,
    TaskIndex,
}

/// One column of the output.
#[derive(Debug, Clone)]
pub(crate) struct Column {
    pub name: String,
    pub feature: Feature,
    pub origin: Origin,
}

impl Column {
    /// The datasets that its numbers are taken from.
    pub(crate) fn keys(&self) -> Vec<String> {
        match &self.origin {
            Origin::Concat(parts) => {
                parts.iter().flat_map(|(_, widths)| widths.keys()).map(|key| format!("obs/{key}")).collect()
            }
            Origin::Action { key, .. } => vec![key.clone()],
            Origin::Reward | Origin::Success => vec!["rewards".to_owned()],
            Origin::Flag(key) | Origin::Stored(key) => vec![key.clone()],
            Origin::Image { .. } | Origin::Depth { .. } | Origin::Index(_) => Vec::new(),
        }
    }

    /// Number of values a frame.
    pub(crate) fn dim(&self) -> usize {
        self.feature.dim()
    }
}

/// The columns, and what was chosen on the way.
#[derive(Debug, Clone)]
pub(crate) struct Mapping {
    pub columns: Vec<Column>,
    pub fps: f64,
    pub state_keys: Vec<String>,
    pub env_keys: Vec<String>,
    pub entities: BTreeMap<String, Vec<String>>,
    pub action: ActionProvenance,
    /// What was taken for granted.
    pub notes: Vec<String>,
}

impl Mapping {
    /// Chooses columns for `plan`. Every demo must have every chosen dataset in the same shape. `files` are the datasets of
    /// JPEG files with height and width of their pictures.
    pub(crate) fn resolve(
        plan: &Plan,
        options: &ConvertOptions,
        files: &BTreeMap<String, (usize, usize)>,
    ) -> Result<Self> {
        let first = match options.skip_bad {
            true => usual(plan),
            false => plan.demos.first(),
        };
        let first = first.ok_or_else(|| InputError::NoDemos { path: plan.path.clone(), found: "none".to_owned() })?;
        let least = if options.skip_bad { plan.demos.len().div_ceil(2) } else { 1 };
        let chooser = Chooser { plan, first, files, least };
        if let Some(stated) = chooser.stated(options) {
            return chooser.as_stated(&stated, options);
        }
        let mut notes = Vec::new();
        let state_keys = chooser.state_keys(options, &mut notes)?;
        let env_keys = chooser.env_keys(options)?;
        let mut columns = Vec::new();
        for (name, keys) in [("observation.state", &state_keys), ("observation.environment_state", &env_keys)] {
            if !keys.is_empty() {
                columns.push(chooser.concat(name, keys)?);
            }
        }
        for (name, keys) in &options.entities {
            let column = format!("{ENTITY_PREFIX}{name}");
            let good = !name.is_empty() && name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_');
            let reason = match (good, keys.is_empty()) {
                (false, _) => "a name of letters, digits and _ is expected",
                (true, true) => "no keys",
                (true, false) => {
                    columns.push(chooser.concat(&column, keys)?);
                    continue;
                }
            };
            let (path, reason) = (plan.path.clone(), reason.to_owned());
            return Err(InputError::ObservationKeys { path, column, reason }.into());
        }
        let (mut pictures, mut left_out) = (chooser.images()?, BTreeMap::new());
        chooser.depth(options, &mut pictures, &mut left_out);
        notes.extend(chooser.pictures_left_out(&pictures, left_out, options));
        columns.extend(pictures);
        let (action, provenance) = chooser.action(options)?;
        columns.push(action);
        columns.extend(chooser.outcomes()?);
        columns.extend(index_columns());
        let fps = chooser.fps(options, &mut notes)?;
        let entities = options.entities.clone();
        let mut mapping = Self { columns, fps, state_keys, env_keys, entities, action: provenance, notes };
        chooser.filmed(&mut mapping, options)?;
        Ok(mapping)
    }

    /// Makes videos of the columns of colour images.
    fn film(&mut self, options: &VideoOptions, lossless: bool) {
        let exact = lossless && options.side_pictures;
        for column in &mut self.columns {
            if column.feature.is_depth() {
                self.notes.push(format!(
                    "{} stays exact, a TIFF file a frame: LeRobot's depth videos are 12-bit HEVC, which is not written here",
                    column.name
                ));
            }
            let Origin::Image { height, width, .. } = column.origin else { continue };
            column.feature.dtype = "video".to_owned();
            let fps = if self.fps.fract() == 0.0 { json!(self.fps as i64) } else { json!(self.fps) };
            column.feature.info = Some(json!({
                "video.height": height, "video.width": width, "video.codec": "av1", "video.pix_fmt": "yuv420p",
                "video.fps": fps, "video.channels": 3, "has_audio": false, "video.g": options.key_interval,
                "video.video_backend": "rav1e",
                "video.extra_options": {"speed": options.speed, "quantizer": options.quantizer},
                "is_depth_map": false,
            }));
            let fate = match exact {
                true => "the side folder keeps the exact ones",
                false if lossless => {
                    "the exact ones are left out (--no-side-pictures), so the source cannot be rebuilt"
                }
                false => "the exact ones are left out (--no-lossless)",
            };
            let note =
                format!("{} is AV1 video: its images are close to the recording's, not equal; {fate}", column.name);
            self.notes.push(note);
        }
    }

    /// The columns as `info.json` lists them.
    pub(crate) fn features(&self) -> Features {
        Features(self.columns.iter().map(|c| (c.name.clone(), c.feature.clone())).collect())
    }

    /// Datasets of depth that become columns: those are looked at picture by picture.
    pub(crate) fn depth_keys(&self) -> Vec<String> {
        let key = |column: &Column| match &column.origin {
            Origin::Depth { key, .. } => Some(key.clone()),
            _ => None,
        };
        self.columns.iter().filter_map(key).collect()
    }

    /// Bytes of image data in a frame.
    pub(crate) fn image_bytes_per_frame(&self) -> usize {
        self.columns.iter().filter(|c| c.feature.is_visual()).map(|c| c.feature.picture_bytes()).sum()
    }
}

/// The first of the demos whose datasets most demos have, by type and shape of a step.
fn usual(plan: &Plan) -> Option<&DemoPlan> {
    type Kind<'a> = Vec<(&'a str, &'a Dtype, &'a [usize])>;
    let mut kinds: BTreeMap<Kind<'_>, (usize, usize)> = BTreeMap::new();
    for (index, demo) in plan.demos.iter().enumerate() {
        let step = |key: &'_ KeyPlan| key.shape.len().min(1);
        let keys = demo.keys.iter().map(|(path, key)| (path.as_str(), &key.dtype, &key.shape[step(key)..])).collect();
        kinds.entry(keys).or_insert((0, index)).0 += 1;
    }
    let most = kinds.into_values().max_by_key(|&(count, index)| (count, std::cmp::Reverse(index)));
    most.map(|(_, index)| &plan.demos[index])
}

struct Chooser<'a> {
    plan: &'a Plan,
    /// What the others are compared with.
    first: &'a DemoPlan,
    files: &'a BTreeMap<String, (usize, usize)>,
    /// So many demos that have a dataset make it one that all should have.
    least: usize,
}

impl Chooser<'_> {
    /// The columns that the file states, unless others are asked for.
    fn stated(&self, options: &ConvertOptions) -> Option<Stated> {
        let chosen = options.state_keys.is_some() || options.env_keys.is_some() || !options.entities.is_empty();
        let chosen = chosen || options.actions != ActionKind::Delta || options.rotation != RotationForm::AxisAngle;
        if chosen { None } else { stated(self.plan) }
    }

    fn as_stated(&self, stated: &Stated, options: &ConvertOptions) -> Result<Mapping> {
        let action =
            ActionProvenance { key: "actions".to_owned(), kind: ActionKind::Delta, rotation: RotationForm::AxisAngle };
        let mut mapping = Mapping {
            columns: Vec::new(),
            fps: 0.0,
            state_keys: Vec::new(),
            env_keys: Vec::new(),
            entities: BTreeMap::new(),
            action,
            notes: Vec::new(),
        };
        stated.mapping(self.plan, &mut mapping)?;
        mapping.columns.extend(index_columns());
        mapping.fps = options.fps.unwrap_or(mapping.fps);
        self.filmed(&mut mapping, options)?;
        Ok(mapping)
    }

    /// Makes videos of the cameras where they are asked for.
    fn filmed(&self, mapping: &mut Mapping, options: &ConvertOptions) -> Result<()> {
        if let Some(video) = &options.video {
            self.check_films(&mapping.columns)?;
            mapping.film(video, options.lossless);
        }
        Ok(())
    }

    /// Refuses pictures of a size that no video has.
    fn check_films(&self, columns: &[Column]) -> Result<()> {
        for column in columns {
            let Origin::Image { key, height, width, .. } = &column.origin else { continue };
            video::check_size(*width, *height).map_err(|reason| InputError::WrongShape {
                path: self.plan.path.clone(),
                demo: self.first.id.clone(),
                key: key.clone(),
                expected: "images that can become a video (without --video every size can be converted)".to_owned(),
                found: format!("{height} x {width}: {reason}"),
            })?;
        }
        Ok(())
    }

    /// Observations of floating-point numbers, a vector or a number a step, in order of their names. What follows from
    /// others is none: the environment's state, the action before, what Mimic notes for itself and what a text was embedded as.
    fn vectors(&self) -> Vec<String> {
        let fits = |key: &KeyPlan| {
            matches!(key.dtype, Dtype::F32 | Dtype::F64) && matches!(key.shape[..], [_] | [_, 1..=VECTOR])
        };
        let other = |name: &str| {
            matches!(name, ENV_DEFAULT | "actions") || name.starts_with("datagen_info/") || name.contains("embedding")
        };
        let keys = self.first.keys.iter().filter(|(path, key)| fits(key) && self.usual(path));
        let names = keys.filter_map(|(path, _)| path.strip_prefix("obs/"));
        names.filter(|name| !other(name)).map(str::to_owned).collect()
    }

    fn state_keys(&self, options: &ConvertOptions, notes: &mut Vec<String>) -> Result<Vec<String>> {
        if let Some(keys) = &options.state_keys {
            return Ok(keys.clone());
        }
        let has = |key: &str| self.usual(&format!("obs/{key}"));
        let chosen = STATE_DEFAULTS.iter().find(|set| set.iter().all(|key| has(key)));
        let Some(set) = chosen else {
            // a part of robomimic's set is a file that lost the others
            let lacking = STATE_DEFAULTS[0].iter().find(|key| !has(key)).expect("one is lacking");
            let vectors = if STATE_DEFAULTS[0].iter().any(|key| has(key)) { Vec::new() } else { self.vectors() };
            if vectors.is_empty() {
                return Err(self.missing(self.first, &format!("obs/{lacking}")).into());
            }
            notes.push(format!("observation.state is made of {} (--state-keys chooses others)", vectors.join(", ")));
            return Ok(vectors);
        };
        let mut keys: Vec<String> = set.iter().map(|&k| k.to_owned()).collect();
        for robot in 1.. {
            let more: Vec<String> = set.iter().map(|k| k.replace("robot0", &format!("robot{robot}"))).collect();
            if !set[0].starts_with("robot0") || !more.iter().all(|key| has(key)) {
                break;
            }
            keys.extend(more);
        }
        Ok(keys)
    }

    fn env_keys(&self, options: &ConvertOptions) -> Result<Vec<String>> {
        Ok(match &options.env_keys {
            Some(keys) => keys.clone(),
            None if self.usual(&format!("obs/{ENV_DEFAULT}")) => {
                vec![ENV_DEFAULT.to_owned()]
            }
            None => Vec::new(),
        })
    }

    fn concat(&self, name: &str, keys: &[String]) -> Result<Column> {
        let mut parts = Vec::with_capacity(keys.len());
        let mut names = Vec::new();
        for key in keys {
            let unfit = |reason: String| {
                DatasetError::from(InputError::ObservationKeys {
                    path: self.plan.path.clone(),
                    column: name.to_owned(),
                    reason,
                })
            };
            let item: KeyItem = key.parse().map_err(unfit)?;
            let mut widths = BTreeMap::new();
            for key in item.keys() {
                widths.insert(key.to_owned(), self.width_everywhere(&format!("obs/{key}"))?);
            }
            let width = item.width(|key| widths.get(key).copied()).map_err(unfit)?;
            names.extend(item.names(width));
            parts.push((item, widths));
        }
        Ok(Column {
            name: name.to_owned(),
            feature: Feature { dtype: "float32".to_owned(), shape: vec![names.len()], names: json!(names), info: None },
            origin: Origin::Concat(parts),
        })
    }

    fn action(&self, options: &ConvertOptions) -> Result<(Column, ActionProvenance)> {
        let key = match options.actions {
            ActionKind::Delta => "actions",
            ActionKind::Absolute => "actions_abs",
        };
        let stored = self.width_everywhere(key)?;
        let width = match options.rotation {
            RotationForm::AxisAngle => stored,
            RotationForm::SixD if stored % 7 == 0 => stored / 7 * 10,
            RotationForm::SixD => {
                return Err(self
                    .wrong_shape(self.first, key, "7 numbers an arm (position, axis-angle, gripper) for 6D rotations")
                    .into());
            }
        };
        let names: Vec<String> = (0..width).map(|i| format!("action_{i}")).collect();
        let column = Column {
            name: "action".to_owned(),
            feature: Feature { dtype: "float32".to_owned(), shape: vec![width], names: json!(names), info: None },
            origin: Origin::Action { key: key.to_owned(), width: stored, rotation: options.rotation },
        };
        let provenance = ActionProvenance { key: key.to_owned(), kind: options.actions, rotation: options.rotation };
        Ok((column, provenance))
    }

    /// Every dataset of colour images becomes `observation.images.<camera>`.
    fn images(&self) -> Result<Vec<Column>> {
        let mut columns = Vec::new();
        let mut taken = BTreeSet::new();
        let mut cameras: BTreeMap<&String, &KeyPlan> = BTreeMap::new();
        for (path, key) in std::iter::once(self.first).chain(&self.plan.demos).flat_map(|demo| &demo.keys) {
            if self.files.contains_key(path) || key.is_image() {
                cameras.entry(path).or_insert(key);
            }
        }
        for (path, key) in cameras.into_iter().filter(|(path, _)| self.usual(path)) {
            let Some(name) = path.strip_prefix("obs/") else { continue };
            let (jpeg, (height, width)) = match (self.files.get(path), key.is_image()) {
                (Some(&size), _) => (true, size),
                (None, true) if key.shape[3] == 3 => (false, (key.shape[1], key.shape[2])),
                _ => continue,
            };
            let camera = name
                .strip_suffix("_image")
                .or_else(|| name.strip_suffix("_rgb"))
                .unwrap_or(name)
                .trim_start_matches("images/")
                .replace('/', ".");
            // two datasets of one camera name keep their full names apart
            let camera = if taken.insert(camera.clone()) { camera } else { name.replace('/', ".") };
            for demo in &self.plan.demos {
                let other = self.key(demo, path)?;
                let (fits, expected) = match jpeg {
                    // their rows are as long as the longest file of the demo
                    true => (may_hold_files(path, other), "a row of bytes a step, a JPEG file in each".to_owned()),
                    false => (
                        other.is_image() && other.shape[1..] == key.shape[1..],
                        format!("uint8 images {height} x {width} x 3"),
                    ),
                };
                if !fits {
                    return Err(self.wrong_shape(demo, path, &expected).into());
                }
            }
            columns.push(Column {
                name: format!("observation.images.{camera}"),
                feature: Feature {
                    dtype: "image".to_owned(),
                    shape: vec![height, width, 3],
                    names: json!(["height", "width", "channels"]),
                    info: None,
                },
                origin: Origin::Image { key: path.clone(), height, width, jpeg },
            });
        }
        Ok(columns)
    }

    /// Every dataset of depth becomes `observation.images.<camera>_depth`, as LeRobot's recorder would store it; why one
    /// does not goes to `left_out`.
    fn depth(&self, options: &ConvertOptions, columns: &mut Vec<Column>, left_out: &mut BTreeMap<String, String>) {
        for (path, key) in &self.first.keys {
            let (Some((height, width)), Some(kind)) = (depth::size(path, key), DepthKind::of(&key.dtype)) else {
                continue;
            };
            let differs = self.plan.demos.iter().find(|demo| {
                let fits = |other: &KeyPlan| {
                    (&other.dtype, other.shape.split_first()) == (&key.dtype, Some((&demo.length, &key.shape[1..])))
                };
                !demo.keys.get(path).is_some_and(fits)
            });
            let reason = match (options.depth, differs) {
                (true, None) => {
                    let name = path.trim_start_matches("obs/");
                    // a colour camera keeps its name, and depth that has it already its whole path
                    let short = name.trim_start_matches("images/").replace('/', ".");
                    let taken = columns.iter().any(|c| c.name == format!("observation.images.{short}"));
                    let camera = if taken { format!("depth.{}", name.replace('/', ".")) } else { short };
                    columns.push(Column {
                        name: format!("observation.images.{camera}"),
                        feature: depth::feature(height, width, kind),
                        origin: Origin::Depth { key: path.clone(), height, width, dtype: key.dtype.clone(), kind },
                    });
                    continue;
                }
                (true, Some(demo)) => format!("{} has other depth than {} or none", demo.id, self.first.id),
                (false, _) => "no depth does (--no-depth)".to_owned(),
            };
            left_out.insert(path.clone(), reason);
        }
    }

    /// What looks like pictures and becomes no column, with the reason: that of `known`, or that LeRobot has no place for
    /// it. Its recorder takes pictures of three channels and depth alone; a made-up channel would not be the recording's.
    fn pictures_left_out(
        &self,
        columns: &[Column],
        known: BTreeMap<String, String>,
        options: &ConvertOptions,
    ) -> Vec<String> {
        const NO_COLOUR: &str = "only uint8 [height, width, 3] and JPEG files do";
        let mut found: BTreeMap<&str, (String, &str)> = BTreeMap::new();
        for (path, key) in self.plan.demos.iter().flat_map(|d| &d.keys) {
            let shape = key.shape.get(1..).unwrap_or_default();
            let is_column = |c: &Column| matches!(&c.origin, Origin::Depth { key, .. } if key == path);
            let reason = match (shape, &key.dtype) {
                _ if !path.starts_with("obs/") || self.files.contains_key(path) => continue,
                _ if columns.iter().any(is_column) => continue,
                ([_, _, 3], _) if key.is_image() => continue,
                ([_, _, 1], Dtype::U8) => "LeRobot records no grey images, and its ACT takes three channels",
                ([_, _, 4], Dtype::U8) => "LeRobot records no fourth channel, and its ACT takes three",
                _ if depth::size(path, key).is_some() => "not every demo has this depth",
                ([_, _, 1], Dtype::F32 | Dtype::F64 | Dtype::U16) => "nothing in its name says that it is depth",
                ([_, _, 1], _) => "LeRobot's depth is float or uint16",
                ([_, _, 3 | 4], _) => NO_COLOUR,
                // bytes for each step under the name of a camera that are no JPEG file
                ([_] | [], _) if path.starts_with("obs/images/") || path.ends_with("_image") => NO_COLOUR,
                ([], Dtype::VarBytes) => NO_COLOUR,
                _ => continue,
            };
            let reason = known.get(path).map_or(reason, String::as_str);
            let encoded = if shape.len() < 2 { "encoded images, " } else { "" };
            found.entry(path).or_insert((format!("{encoded}{} {shape:?}", key.dtype), reason));
        }
        let fate = match options.lossless {
            true => "the side folder keeps it as stored",
            false => "it is left out (--no-lossless)",
        };
        let note = |(path, (what, reason))| format!("{path} ({what}) becomes no column: {reason}; {fate}");
        found.into_iter().map(note).collect()
    }

    /// Rewards, dones and success, where the demos have them. A file that has none gets no such columns.
    fn outcomes(&self) -> Result<Vec<Column>> {
        let scalar = |name: &str, dtype: &str, origin| Column {
            name: name.to_owned(),
            feature: Feature { dtype: dtype.to_owned(), shape: vec![1], names: Value::Null, info: None },
            origin,
        };
        let mut columns = Vec::new();
        if self.usual("rewards") {
            self.one_a_step("rewards")?;
            columns.push(scalar("next.reward", "float32", Origin::Reward));
        }
        if self.usual("dones") {
            self.one_a_step("dones")?;
            columns.push(scalar("next.done", "bool", Origin::Flag("dones".to_owned())));
        }
        if self.usual("rewards") && self.rewards_tell_success() {
            columns.push(scalar("next.success", "bool", Origin::Success));
        } else if self.usual("success") {
            self.one_a_step("success")?;
            columns.push(scalar("next.success", "bool", Origin::Flag("success".to_owned())));
        }
        if self.usual("mistakes") {
            self.one_a_step("mistakes")?;
            columns.push(scalar(MISTAKE, "bool", Origin::Flag("mistakes".to_owned())));
        }
        Ok(columns)
    }

    /// robosuite's sparse reward, and that of everything built on it, is 1 exactly when the task is solved.
    fn rewards_tell_success(&self) -> bool {
        self.is_robosuite()
    }

    /// Whether `env_args` says so: robomimic numbers the kinds of environments.
    fn is_robosuite(&self) -> bool {
        const ROBOSUITE: i64 = 1;
        let kind = self.plan.env_args.as_ref().and_then(|args| args.get("type")?.as_i64());
        kind == Some(ROBOSUITE)
    }

    fn one_a_step(&self, path: &str) -> Result<()> {
        match self.width_everywhere(path)? {
            1 => Ok(()),
            _ => Err(self.wrong_shape(self.first, path, "one number a step").into()),
        }
    }

    fn fps(&self, options: &ConvertOptions, notes: &mut Vec<String>) -> Result<f64> {
        let kwargs = self.plan.env_args.as_ref().and_then(|args| args.get("env_kwargs"));
        let stated = kwargs.and_then(|kwargs| kwargs.get("control_freq")?.as_f64());
        // Isaac Lab states its steps
        let sim = self.plan.env_args.as_ref().and_then(|args| args.get("sim_args"));
        let step = sim.and_then(|sim| Some(sim.get("dt")?.as_f64()? * sim.get("decimation")?.as_f64()?));
        let stated = stated.or(step.filter(|&step| step > 0.0).map(|step| (1e6 / step).round() / 1e6));
        let mut default = || {
            if self.is_robosuite() {
                notes.push(format!(
                    "env_args state no control_freq; {ROBOSUITE_CONTROL_FREQ} Hz is taken, robosuite's default (--fps decides)"
                ));
                return Some(ROBOSUITE_CONTROL_FREQ);
            }
            let usual = self.plan.dialect.usual_fps()?;
            let name = self.plan.dialect.name();
            notes.push(format!("no rate is stated; {usual} Hz is taken, as is usual of {name} (--fps decides)"));
            Some(usual)
        };
        let fps = options.fps.or(stated).or_else(&mut default).ok_or_else(|| InputError::BadAttribute {
            path: self.plan.path.clone(),
            object: "data".to_owned(),
            attribute: "env_args".to_owned(),
            expected: "env_kwargs.control_freq, or a rate given by hand (--fps)".to_owned(),
            found: "neither".to_owned(),
        })?;
        if fps.is_finite() && fps > 0.0 {
            return Ok(fps);
        }
        Err(InputError::BadAttribute {
            path: self.plan.path.clone(),
            object: "data".to_owned(),
            attribute: "frames a second".to_owned(),
            expected: "a number above 0".to_owned(),
            found: fps.to_string(),
        }
        .into())
    }

    /// Values a step of dataset `path`, the same in every demo.
    fn width_everywhere(&self, path: &str) -> Result<usize> {
        let shape_of = |demo| -> Result<usize> {
            let key = self.key(demo, path)?;
            if !key.dtype.is_numeric() || key.shape.is_empty() {
                return Err(self.wrong_shape(demo, path, "one or more numbers a step").into());
            }
            Ok(key.shape[1..].iter().product())
        };
        let width = shape_of(self.first)?;
        if width == 0 {
            return Err(self.wrong_shape(self.first, path, "one or more numbers a step").into());
        }
        for demo in &self.plan.demos {
            if shape_of(demo)? != width {
                let expected = format!("{width} numbers a step, as in {}", self.first.id);
                return Err(self.wrong_shape(demo, path, &expected).into());
            }
        }
        Ok(width)
    }

    /// Whether enough demos have this dataset for all to need it.
    fn usual(&self, path: &str) -> bool {
        self.plan.demos.iter().filter(|demo| demo.keys.contains_key(path)).take(self.least).count() == self.least
    }

    fn key<'d>(&self, demo: &'d DemoPlan, path: &str) -> Result<&'d KeyPlan> {
        demo.keys.get(path).ok_or_else(|| DatasetError::from(self.missing(demo, path)))
    }

    fn missing(&self, demo: &DemoPlan, path: &str) -> InputError {
        if let Some(error) = self.plan.unreadable(demo, path) {
            return error.clone();
        }
        let folder = path.rsplit_once('/').map_or("", |(folder, _)| folder);
        let near: Vec<&str> = demo
            .keys
            .keys()
            .filter(|k| k.rsplit_once('/').map_or("", |(f, _)| f) == folder)
            .map(String::as_str)
            .collect();
        let found = if near.is_empty() { demo.keys.keys().map(String::as_str).collect::<Vec<_>>() } else { near };
        InputError::MissingKey {
            path: self.plan.path.clone(),
            demo: demo.id.clone(),
            key: path.to_owned(),
            found: match self.plan.demos.iter().filter(|demo| demo.keys.contains_key(path)).count() {
                0 => found.join(", "),
                n => format!(
                    "{}; {n} of {} demos have it (--skip-bad leaves out the others)",
                    found.join(", "),
                    self.plan.demos.len()
                ),
            },
        }
    }

    fn wrong_shape(&self, demo: &DemoPlan, path: &str, expected: &str) -> InputError {
        InputError::WrongShape {
            path: self.plan.path.clone(),
            demo: demo.id.clone(),
            key: path.to_owned(),
            expected: expected.to_owned(),
            found: demo.keys.get(path).map_or_else(|| "nothing".to_owned(), |k| format!("{} {:?}", k.dtype, k.shape)),
        }
    }
}

fn index_columns() -> Vec<Column> {
    [
        ("timestamp", "float32", IndexColumn::Timestamp),
        ("frame_index", "int64", IndexColumn::FrameIndex),
        ("episode_index", "int64", IndexColumn::EpisodeIndex),
        ("index", "int64", IndexColumn::Index),
        ("task_index", "int64", IndexColumn::TaskIndex),
    ]
    .into_iter()
    .map(|(name, dtype, index)| Column {
        name: name.to_owned(),
        feature: Feature { dtype: dtype.to_owned(), shape: vec![1], names: Value::Null, info: None },
        origin: Origin::Index(index),
    })
    .collect()
}
