//! `meta/info.json`: what a LeRobotDataset v3.0 says about itself, and the provenance that we add to it.

use serde::de::{MapAccess, Visitor};
use serde::ser::SerializeMap;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::Value;
use std::collections::BTreeMap;
use std::fmt;

/// The version of the format that is written.
pub const CODEBASE_VERSION: &str = "v3.0";
/// Where frames lie, in Python's format language, as the format wants it.
pub const DATA_PATH: &str = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet";
/// Files in one folder before the next begins.
pub const FILES_PER_FOLDER: usize = 1000;

/// The whole of `meta/info.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Info {
    /// `v3.0`; another major version is refused.
    pub codebase_version: String,
    /// The robot, where it is known.
    #[serde(default)]
    pub robot_type: Option<String>,
    /// Number of episodes.
    #[serde(default)]
    pub total_episodes: usize,
    /// Number of frames over all episodes.
    #[serde(default)]
    pub total_frames: usize,
    /// Number of task texts.
    #[serde(default)]
    pub total_tasks: usize,
    /// Files in one folder before the next begins.
    #[serde(default = "files_per_folder")]
    pub chunks_size: usize,
    /// Size at which a data file is closed, in MiB.
    #[serde(default = "data_files_size")]
    pub data_files_size_in_mb: f64,
    /// Size at which a video file is closed, in MiB.
    #[serde(default = "video_files_size")]
    pub video_files_size_in_mb: f64,
    /// Frames a second.
    #[serde(serialize_with = "integral_if_possible")]
    pub fps: f64,
    /// Named ranges of episodes, `"0:50"`.
    #[serde(default)]
    pub splits: BTreeMap<String, String>,
    /// Where frames lie.
    #[serde(default = "data_path")]
    pub data_path: String,
    /// Where videos lie; null without any.
    #[serde(default)]
    pub video_path: Option<String>,
    /// The columns, in their order in the data files.
    pub features: Features,
    /// What we add: where the data came from, in `actrm/info.json` (in this file in sets of earlier versions). Absent in data
    /// sets that LeRobot wrote.
    #[serde(default, skip_serializing)]
    pub actrm: Option<Provenance>,
    /// Keys that nothing here reads: those that LeRobot has besides, or may add later.
    #[serde(flatten)]
    pub other: BTreeMap<String, Value>,
}

fn files_per_folder() -> usize {
    FILES_PER_FOLDER
}

fn data_files_size() -> f64 {
    100.0
}

fn video_files_size() -> f64 {
    200.0
}

fn data_path() -> String {
    DATA_PATH.to_owned()
}

fn integral_if_possible<S: Serializer>(value: &f64, serializer: S) -> Result<S::Ok, S::Error> {
    if value.fract() == 0.0 && value.abs() < 1e15 {
        serializer.serialize_i64(*value as i64)
    } else {
        serializer.serialize_f64(*value)
    }
}

/// One column.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Feature {
    /// `float32`, `int64`, `bool`, `string`, `image`, `video` or another numpy name.
    pub dtype: String,
    /// Extent of one frame's value; `[1]` is stored as a scalar.
    pub shape: Vec<usize>,
    /// Names of the entries: a list, a dictionary or null.
    #[serde(default)]
    pub names: Value,
    /// What LeRobot says about a video feature: codec, rate, size.
    #[serde(default, alias = "video_info", skip_serializing_if = "Option::is_none")]
    pub info: Option<Value>,
}

/// Largest side of a picture, and most pixels: as of videos.
pub(crate) const MAX_SIDE: usize = 8192;
pub(crate) const MAX_PIXELS: usize = 1 << 24;

/// Whether a picture can have this size.
pub(crate) fn is_picture(height: usize, width: usize) -> bool {
    let sides = 1..=MAX_SIDE;
    sides.contains(&height) && sides.contains(&width) && height * width <= MAX_PIXELS
}

impl Feature {
    /// Number of values in one frame.
    pub fn dim(&self) -> usize {
        self.shape.iter().product()
    }

    /// A name for each of its numbers; empty where it does not name them. LeRobot's sets hold a list, a list in a list, lists by
    /// the name of an axis (`{"motors": [...]}`), or places by name (`{"x": 0}`).
    pub fn number_names(&self) -> Vec<String> {
        let mut names = Vec::new();
        match &self.names {
            Value::Object(places) if !places.is_empty() && places.values().all(Value::is_u64) => {
                let mut places: Vec<_> = places.iter().map(|(name, place)| (place.as_u64(), name.clone())).collect();
                places.sort();
                if places.iter().map(|(place, _)| *place).eq((0..self.dim() as u64).map(Some)) {
                    names.extend(places.into_iter().map(|(_, name)| name));
                }
            }
            Value::Object(axes) => axes.values().for_each(|axis| gather_names(axis, &mut names)),
            other => gather_names(other, &mut names),
        }
        if names.len() == self.dim() { names } else { Vec::new() }
    }

    /// Whether the column holds pictures.
    pub fn is_visual(&self) -> bool {
        self.dtype == "image" || self.dtype == "video"
    }

    /// Whether the column holds words: texts, or LeRobot's `language`.
    pub(crate) fn is_text(&self) -> bool {
        self.dtype == "string" || self.dtype == "language"
    }

    /// Height and width of colour pictures: shape `[height, width, 3]`, or `[3, height, width]` where the first name says that
    /// channels come first. None of anything else, and of what no picture is as large as.
    pub fn picture_size(&self) -> Option<(usize, usize)> {
        let channels_first = self.names.get(0).and_then(Value::as_str).is_some_and(|name| name.starts_with("channel"));
        let (height, width) = match *self.shape.as_slice() {
            [3, height, width] if channels_first => (height, width),
            [height, width, 3] if !channels_first => (height, width),
            _ => return None,
        };
        is_picture(height, width).then_some((height, width))
    }

    /// Whether the pictures are depth: one number a pixel, no colours.
    pub fn is_depth(&self) -> bool {
        // the second name is LeRobot's older one
        let says = |key: &str| self.info.as_ref().and_then(|info| info.get(key)).and_then(Value::as_bool);
        self.is_visual() && (says("is_depth_map") == Some(true) || says("video.is_depth_map") == Some(true))
    }

    /// The unit of depth, `m` or `mm`, where it is stated.
    pub fn depth_unit(&self) -> Option<&str> {
        self.info.as_ref()?.get("depth_unit")?.as_str().filter(|_| self.is_depth())
    }

    /// Bytes of one picture once it is decoded; of depth, at most.
    pub(crate) fn picture_bytes(&self) -> usize {
        self.dim() * if self.is_depth() { 4 } else { 1 }
    }
}

fn gather_names(value: &Value, names: &mut Vec<String>) {
    match value {
        Value::Array(values) => values.iter().for_each(|value| gather_names(value, names)),
        Value::String(name) => names.push(name.clone()),
        Value::Number(number) => names.push(number.to_string()),
        _ => {}
    }
}

/// Columns in order. JSON objects keep the order in which they were written, maps of `serde_json` do not.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Features(pub Vec<(String, Feature)>);

impl Features {
    /// The column of this name.
    pub fn get(&self, name: &str) -> Option<&Feature> {
        self.0.iter().find(|(n, _)| n == name).map(|(_, f)| f)
    }

    /// Names in order.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.0.iter().map(|(n, _)| n.as_str())
    }

    /// Names of those that the data files have columns of: all but videos.
    pub(crate) fn in_data(&self) -> impl Iterator<Item = &str> {
        self.0.iter().filter(|(_, f)| f.dtype != "video").map(|(name, _)| name.as_str())
    }
}

impl Serialize for Features {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(Some(self.0.len()))?;
        for (name, feature) in &self.0 {
            map.serialize_entry(name, feature)?;
        }
        map.end()
    }
}

impl<'de> Deserialize<'de> for Features {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct InOrder;
        impl<'de> Visitor<'de> for InOrder {
            type Value = Features;
            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("an object of features")
            }
            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Features, A::Error> {
                let mut features = Vec::new();
                while let Some(entry) = map.next_entry()? {
                    features.push(entry);
                }
                Ok(Features(features))
            }
        }
        deserializer.deserialize_map(InOrder)
    }
}

/// Where a converted data set came from and what it holds: `actrm/info.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Provenance {
    /// Version of this object.
    pub format: u32,
    /// Program and version that wrote it.
    pub writer: String,
    /// Name of the source file or folder, without its path.
    pub source: String,
    /// sha256 of the source file; for a folder, of its files' hashes in order of name.
    pub source_sha256: String,
    /// Layout of the source.
    pub dialect: String,
    /// sha256 of the frames' content: names, shapes and values of every feature, episode lengths, tasks.
    pub fingerprint: String,
    /// Environment name, where the source states it.
    pub env_name: Option<String>,
    /// Simulator generation, where the source states it.
    pub env_version: Option<String>,
    /// The environment's arguments as the source has them.
    pub env_args: Option<Value>,
    /// The simulator's seeds that the demos were recorded with, `FIRST-LAST`, where the source states them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seeds: Option<String>,
    /// Which of the task's experts recorded them, where it is not the usual one and the source states it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub expert: Option<String>,
    /// How able whoever showed them is (`mixed`, `poor`), where that is not as usual and the source states it. Who showed
    /// which, the demos' own attribute says.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub skill: Option<String>,
    /// Observation keys that make up `observation.state`, in order.
    pub state_keys: Vec<String>,
    /// Observation keys that make up `observation.environment_state`, in order.
    pub env_keys: Vec<String>,
    /// Observation keys that make up `observation.entity.<name>`, in order, by name.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub entities: BTreeMap<String, Vec<String>>,
    /// Where `action` came from: `actions`, `actions_abs`, and its rotation representation.
    pub action: ActionProvenance,
    /// Demo id of each episode.
    pub demos: Vec<String>,
    /// Masks of the source as episode indices.
    pub masks: BTreeMap<String, Vec<usize>>,
    /// Demos that masks of the source name and that it has not, by mask.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub masks_absent: BTreeMap<String, Vec<String>>,
    /// Demos of the source that were left out, and why (`--skip-bad`).
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub skipped: Vec<SkippedDemo>,
    /// Datasets of the source that could not be read in some demos, and are left out there.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub left_out: Vec<String>,
    /// Whether the side folder is there.
    pub lossless: bool,
    /// sha256 of everything else in it and of `meta/info.json`, so that an edited number does not train other weights silently.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seal: Option<String>,
    /// How pictures were encoded, where they are videos.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub video: Option<VideoProvenance>,
}

/// A demo that a conversion left out.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SkippedDemo {
    /// Its id.
    pub demo: String,
    /// What is wrong with it.
    pub reason: String,
}

/// How the pictures of a data set were made videos.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct VideoProvenance {
    /// Name and version of the encoder.
    pub encoder: String,
    /// Its speed, 0 to 10.
    pub speed: u8,
    /// Its quantizer, 1 to 255.
    pub quantizer: u8,
    /// Frames from a key frame to the next.
    pub key_interval: u16,
    /// Whether the exact pictures are in the side folder.
    pub side_pictures: bool,
}

/// Which action a data set holds.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ActionProvenance {
    /// Dataset of the source.
    pub key: String,
    /// `delta` or `absolute`.
    pub kind: ActionKind,
    /// How the rotation part is written.
    pub rotation: RotationForm,
}

/// Whether actions are relative to the present pose or poses themselves.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ActionKind {
    /// As robosuite's controllers take them by default: changes, scaled to -1..1.
    #[default]
    Delta,
    /// Absolute end-effector poses (`actions_abs`).
    Absolute,
}

/// How the rotation part of an action is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RotationForm {
    /// As stored: three numbers, axis times angle.
    #[default]
    AxisAngle,
    /// Six numbers: the first two rows of the rotation matrix (Zhou et al. 2019, as pytorch3d writes them).
    #[serde(rename = "6d")]
    SixD,
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use serde_json::json;

    #[test]
    fn numbers_are_named_in_every_form_that_lerobot_writes() {
        let named = |names: Value| {
            Feature { dtype: "float32".to_owned(), shape: vec![3], names, info: None }.number_names().join(" ")
        };
        let json = |text: &str| serde_json::from_str::<Value>(text).unwrap();
        assert_eq!(named(json(r#"["a", "b", "c"]"#)), "a b c");
        assert_eq!(named(json(r#"[["a", "b", "c"]]"#)), "a b c");
        assert_eq!(named(json(r#"{"motors": ["a", "b", "c"]}"#)), "a b c");
        assert_eq!(named(json(r#"{"b": 1, "c": 2, "a": 0}"#)), "a b c");
        assert_eq!(named(json("[0, 1, 2]")), "0 1 2");
        // the name of the axis, too few, none
        for none in [r#"["state"]"#, r#"{"axes": ["x", "y"]}"#, r#"{"a": 0, "b": 1, "c": 5}"#, "null", "{}", "[]"] {
            assert_eq!(named(json(none)), "", "{none}");
        }
    }

    #[test]
    fn channels_come_first_where_the_names_say_so() {
        let feature = |shape: &[usize], names: Value| Feature {
            dtype: "video".to_owned(),
            shape: shape.to_vec(),
            names,
            info: None,
        };
        let (last, first) = (json!(["height", "width", "channels"]), json!(["channels", "height", "width"]));
        assert_eq!(feature(&[96, 128, 3], last.clone()).picture_size(), Some((96, 128)));
        assert_eq!(feature(&[96, 128, 3], Value::Null).picture_size(), Some((96, 128)));
        assert_eq!(feature(&[3, 96, 128], first.clone()).picture_size(), Some((96, 128)));
        for (shape, names) in [
            (&[3, 96, 128][..], &last),
            (&[96, 128, 3], &first),
            (&[96, 128, 4], &last),
            (&[0, 128, 3], &last),
            (&[8193, 1, 3], &last),
            (&[8192, 8192, 3], &last),
            (&[1 << 40, 1 << 40, 3], &last),
        ] {
            assert_eq!(feature(shape, names.clone()).picture_size(), None, "{shape:?} {names}");
        }
    }

    #[test]
    fn features_keep_their_order_and_whole_rates_are_integers() {
        let text = r#"{"codebase_version":"v3.0","robot_type":null,"total_episodes":1,"total_frames":2,"total_tasks":1,
            "fps":20,"splits":{"train":"0:1"},"features":{"z":{"dtype":"float32","shape":[3],"names":["a","b","c"]},
            "a":{"dtype":"bool","shape":[1],"names":null}},"some_new_key":5}"#;
        let info: Info = serde_json::from_str(text).unwrap();
        assert_eq!(info.features.names().collect::<Vec<_>>(), ["z", "a"]);
        assert_eq!(info.features.get("z").unwrap().dim(), 3);
        assert_eq!((info.chunks_size, info.data_files_size_in_mb), (1000, 100.0));
        let again = serde_json::to_string(&info).unwrap();
        assert!(again.contains("\"fps\":20,"), "{again}");
        assert!(again.find("\"z\"").unwrap() < again.find("\"a\":").unwrap());
        assert_eq!(serde_json::from_str::<Info>(&again).unwrap(), info);
    }
}
