//! Which dataset of a demo becomes which column: resolved once from the plan, before anything is read.

use super::chooser::{Chooser, index_columns, usual};
use super::depth::DepthKind;
use super::encoded::Files;
use super::info::{ActionKind, ActionProvenance, Feature, Features, RotationForm};
use crate::error::{InputError, Result};
use crate::ffmpeg;
use crate::keys::KeyItem;
use crate::plan::Plan;
use crate::source::NonFinite;
use crate::tree::Dtype;
use serde_json::json;
use std::collections::{BTreeMap, BTreeSet};

/// What the names of columns of entities begin with.
pub const ENTITY_PREFIX: &str = "observation.entity.";

/// The column that says of every step whether its action is a mistake, for data that marks them.
pub const MISTAKE: &str = "mistake";

/// How images are stored in the data files.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ImageForm {
    /// PNG: small, slower to write and read.
    #[default]
    Png,
    /// PPM, uncompressed: fast, larger.
    Ppm,
}

/// What makes videos of pictures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum VideoEncoder {
    /// FFmpeg where there is one with SVT-AV1, the built-in encoder otherwise.
    #[default]
    Auto,
    /// AV1 by SVT-AV1 in FFmpeg.
    SvtAv1,
    /// H.264 by x264 in FFmpeg.
    H264,
    /// AV1 by the built-in encoder.
    Builtin,
}

/// How pictures become videos.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct VideoOptions {
    /// What encodes.
    pub encoder: VideoEncoder,
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
        Self { encoder: VideoEncoder::default(), speed, quantizer, key_interval, side_pictures: true }
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

/// Numbers pictures whose datasets give one name, so that none takes the place of another.
fn number_equal(columns: &mut [Column], notes: &mut Vec<String>) {
    let mut taken: BTreeSet<String> = columns.iter().map(|column| column.name.clone()).collect();
    let mut seen = BTreeSet::new();
    for column in columns {
        if seen.insert(column.name.clone()) {
            continue;
        }
        let name = (2..).map(|n| format!("{}_{n}", column.name)).find(|name| !taken.contains(name));
        let name = name.expect("some number is free");
        if let Origin::Image { key, .. } | Origin::Depth { key, .. } = &column.origin {
            notes.push(format!("{key} becomes {name}: another dataset has the name {}", column.name));
        }
        taken.insert(name.clone());
        column.name = name;
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
    /// JPEG files.
    pub(crate) fn resolve(plan: &Plan, options: &ConvertOptions, files: &Files) -> Result<Self> {
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
        number_equal(&mut pictures, &mut notes);
        columns.extend(pictures);
        notes.extend(chooser.pictures_left_out(&columns, left_out, options));
        let (action, provenance) = chooser.action(options)?;
        columns.push(action);
        columns.extend(chooser.outcomes(&mut notes)?);
        columns.extend(index_columns());
        let fps = chooser.fps(options, &mut notes)?;
        let entities = options.entities.clone();
        let mut mapping = Self { columns, fps, state_keys, env_keys, entities, action: provenance, notes };
        chooser.filmed(&mut mapping, options)?;
        Ok(mapping)
    }

    /// Makes videos of the columns of colour images.
    pub(super) fn film(&mut self, options: &VideoOptions, lossless: bool) -> Result<()> {
        let (codec, backend, settings) = match ffmpeg::chosen(options.encoder)? {
            Some(chosen) => (chosen.codec(), "ffmpeg", chosen.settings(options)),
            None => ("av1", "rav1e", json!({"speed": options.speed, "quantizer": options.quantizer})),
        };
        let shown = if codec == "av1" { "AV1" } else { "H.264" };
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
                "video.height": height, "video.width": width, "video.codec": codec, "video.pix_fmt": "yuv420p",
                "video.fps": fps, "video.channels": 3, "has_audio": false, "video.g": options.key_interval,
                "video.video_backend": backend, "video.extra_options": settings,
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
                format!("{} is {shown} video: its images are close to the recording's, not equal; {fate}", column.name);
            self.notes.push(note);
        }
        Ok(())
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
