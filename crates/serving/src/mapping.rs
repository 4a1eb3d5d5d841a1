//! How features become the observations that a server knows.

use std::time::Duration;

use models::{FeatureKind, FeatureSpec, Observation, Signature, Values};
use serde::Deserialize;

use crate::codec::{Array, Dtype, Value};
use crate::error::{Result, ServingError};
use crate::resize::resize_with_pad;
use crate::session::{EXECUTED, RESET, SEED};

/// Names of mappings that are built in, and their files.
const PRESETS: [(&str, &str); 2] = [("actrm", ""), ("openpi-libero", include_str!("presets/openpi-libero.toml"))];

/// What a server is sent and how its chunks are executed.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Mapping {
    /// Text under the key `prompt`. `{instruction}` is what the episode's environment says that is to be done, or the task's
    /// name where it says nothing; `{task}` is the task's name.
    pub prompt: Option<String>,
    /// The task's name.
    #[serde(skip)]
    pub task: String,
    /// Actions of a chunk that are executed before the next query [default: as the server says, or 1].
    pub n_action_steps: Option<usize>,
    /// Seconds that a query may take.
    pub timeout_s: u64,
    /// Side of the images that the simulator draws, in pixels.
    pub image_size: usize,
    /// The keys; none for every feature under its own name.
    pub observation: Vec<Item>,
}

impl Default for Mapping {
    fn default() -> Self {
        let (prompt, task, observation) = (None, String::new(), Vec::new());
        Self { prompt, task, n_action_steps: None, timeout_s: 60, image_size: 84, observation }
    }
}

/// One key of an observation.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Item {
    /// The server's name of it.
    pub key: String,
    /// Our feature.
    pub feature: String,
    /// Side of an image in pixels, after resizing with padding.
    pub size: Option<usize>,
    /// How an image is flipped.
    pub flip: Option<Flip>,
    /// Where in a vector a quaternion (x, y, z, w) begins that becomes an axis-angle (3 numbers).
    pub axis_angle_at: Option<usize>,
}

/// Axes along which an image is flipped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Flip {
    /// left and right
    Horizontal,
    /// top and bottom
    Vertical,
    /// both: half a turn
    Both,
}

impl Flip {
    /// The flipped image of these pixels, whose rows have this width.
    pub(crate) fn of(self, pixels: &[u8], width: usize) -> Vec<u8> {
        let rows = pixels.chunks_exact(3 * width);
        match self {
            Self::Vertical => rows.rev().flatten().copied().collect(),
            Self::Horizontal => rows.flat_map(|row| row.chunks_exact(3).rev().flatten()).copied().collect(),
            Self::Both => pixels.chunks_exact(3).rev().flatten().copied().collect(),
        }
    }
}

/// What stands for an episode's instruction in a prompt.
pub(crate) const INSTRUCTION: &str = "{instruction}";

/// Side of an image at most.
const MOST_SIZE: usize = 4096;

impl Mapping {
    /// The mapping of this name that is built in: `actrm` (each feature under its own name) or `openpi-libero`.
    pub fn preset(name: &str) -> Option<Self> {
        let (_, text) = PRESETS.iter().find(|(preset, _)| *preset == name)?;
        Self::parse(name, text).ok()
    }

    /// Names of the mappings that are built in.
    pub fn presets() -> impl Iterator<Item = &'static str> {
        PRESETS.iter().map(|(name, _)| *name)
    }

    /// Reads a file's `text`; `name` is for messages.
    ///
    /// # Errors
    /// A key that does not exist, a value that cannot be.
    pub fn parse(name: &str, text: &str) -> Result<Self> {
        let failed = |detail: String| ServingError::Mapping { name: name.to_owned(), detail };
        let mapping: Self =
            toml::from_str(text).map_err(|error| failed(error.to_string().trim().replace('\n', " ")))?;
        let limits = [
            ("timeout_s", Some(mapping.timeout_s), 86_400),
            ("image_size", Some(mapping.image_size as u64), MOST_SIZE as u64),
            ("n_action_steps", mapping.n_action_steps.map(|steps| steps as u64), 10_000),
        ];
        let sizes =
            mapping.observation.iter().map(|item| ("size", item.size.map(|size| size as u64), MOST_SIZE as u64));
        for (key, value, most) in limits.into_iter().chain(sizes) {
            if let Some(value) = value.filter(|value| !(1..=most).contains(value)) {
                return Err(failed(format!("{key}: expected 1 to {most}, found {value}")));
            }
        }
        for (at, item) in mapping.observation.iter().enumerate() {
            if mapping.observation[..at].iter().any(|other| other.key == item.key) {
                return Err(failed(format!("key: expected each once, found {} again", item.key)));
            }
            if ["prompt", RESET, SEED, EXECUTED].contains(&item.key.as_str()) {
                return Err(failed(format!(
                    "key: expected another than prompt, reset, seed and executed, which every message may have, found {}",
                    item.key
                )));
            }
        }
        Ok(mapping)
    }

    /// The same with the task's name in its prompt.
    #[must_use]
    pub fn of_task(mut self, task: &str) -> Self {
        self.prompt = self.prompt.map(|prompt| prompt.replace("{task}", task));
        self.task = task.to_owned();
        self
    }

    pub(crate) fn timeout(&self) -> Duration {
        Duration::from_secs(self.timeout_s)
    }

    /// The keys that are sent for such features.
    ///
    /// # Errors
    /// A feature that is not there, or that cannot be changed so.
    pub(crate) fn items(&self, signature: &Signature) -> Result<Vec<Mapped>> {
        if self.observation.is_empty() {
            let all = signature.observation.iter();
            return Ok(all.map(|spec| Mapped { item: Item::of(&spec.name), spec: spec.clone() }).collect());
        }
        let one = |item: &Item| {
            let fault = |expected: String, found: String| ServingError::message(&item.feature, expected, found);
            let names = || signature.observation.iter().map(|spec| spec.name.clone()).collect::<Vec<_>>().join(", ");
            let spec =
                signature.get(&item.feature).ok_or_else(|| fault(format!("a feature for {}", item.key), names()))?;
            let image = spec.kind == FeatureKind::Image;
            if !image && (item.size.is_some() || item.flip.is_some()) {
                return Err(fault("an image for size and flip".to_owned(), format!("{} numbers", spec.width())));
            }
            if let Some(at) = item.axis_angle_at.filter(|at| image || at.saturating_add(4) > spec.width()) {
                let expected = format!("numbers with a quaternion from {at} on");
                let found = if image { "an image".to_owned() } else { format!("{} numbers", spec.width()) };
                return Err(fault(expected, found));
            }
            Ok(Mapped { item: item.clone(), spec: spec.clone() })
        };
        self.observation.iter().map(one).collect()
    }
}

impl Item {
    /// A feature under its own name.
    fn of(feature: &str) -> Self {
        Self { key: feature.to_owned(), feature: feature.to_owned(), size: None, flip: None, axis_angle_at: None }
    }
}

/// A key and the feature that it is made of.
#[derive(Debug, Clone)]
pub(crate) struct Mapped {
    pub item: Item,
    pub spec: FeatureSpec,
}

impl Mapped {
    /// The shape that is sent of one observation.
    pub fn shape(&self) -> Vec<usize> {
        match (self.item.size, self.item.axis_angle_at) {
            (Some(size), _) => vec![size, size, 3],
            (None, Some(_)) => vec![self.spec.width() - 1],
            (None, None) => self.spec.shape.clone(),
        }
    }

    /// What is sent of these observations; with an axis of them if `stacked`.
    ///
    /// # Errors
    /// A feature that is missing, of another length or not finite.
    pub fn value(&self, observations: &[&Observation], stacked: bool) -> Result<Value<'static>> {
        let mut data = Vec::new();
        for observation in observations {
            let values = observation.require("query", &self.item.feature)?;
            let wrong =
                |found: String| ServingError::message(&self.item.feature, format!("{:?}", self.spec.shape), found);
            match values {
                Values::F32(numbers) if self.spec.kind != FeatureKind::Image => {
                    if numbers.len() != self.spec.width() {
                        return Err(wrong(format!("{} numbers", numbers.len())));
                    }
                    if let Some(at) = numbers.iter().position(|number| !number.is_finite()) {
                        return Err(wrong(format!("{} at {at}", numbers[at])));
                    }
                    data.extend(self.turned(numbers).iter().flat_map(|number| number.to_le_bytes()));
                }
                Values::U8(pixels) if self.spec.kind == FeatureKind::Image => {
                    if pixels.len() != self.spec.width() {
                        return Err(wrong(format!("{} bytes", pixels.len())));
                    }
                    data.extend(self.drawn(pixels));
                }
                Values::F32(_) => return Err(wrong("numbers".to_owned())),
                Values::U8(_) => return Err(wrong("an image".to_owned())),
            }
        }
        let dtype = if self.spec.kind == FeatureKind::Image { Dtype::U8 } else { Dtype::F32 };
        let shape = stacked.then_some(observations.len()).into_iter().chain(self.shape()).collect();
        Ok(Value::Array(Array::new(dtype, shape, data)?))
    }

    fn turned(&self, numbers: &[f32]) -> Vec<f32> {
        let Some(at) = self.item.axis_angle_at else { return numbers.to_vec() };
        let quaternion = [0, 1, 2, 3].map(|k| numbers[at + k]);
        [&numbers[..at], &axis_angle(quaternion), &numbers[at + 4..]].concat()
    }

    fn drawn(&self, pixels: &[u8]) -> Vec<u8> {
        let (height, width) = (self.spec.shape[0], self.spec.shape[1]);
        let flipped = self.item.flip.map_or_else(|| pixels.to_vec(), |flip| flip.of(pixels, width));
        match self.item.size {
            Some(size) => resize_with_pad(&flipped, height, width, size),
            None => flipped,
        }
    }
}

/// A quaternion (x, y, z, w) as axis times angle, as robosuite's `quat2axisangle` gives it.
fn axis_angle([x, y, z, w]: [f32; 4]) -> [f32; 3] {
    let w = f64::from(w).clamp(-1.0, 1.0);
    let sine = (1.0 - w * w).sqrt();
    // `math.isclose` to zero holds for zero only
    if sine == 0.0 {
        return [0.0; 3];
    }
    let scale = 2.0 * w.acos() / sine;
    [x, y, z].map(|part| (f64::from(part) * scale) as f32)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::codec::decode;

    fn libero() -> Signature {
        let camera = |name| FeatureSpec::image(name, 12, 20);
        let observation = vec![
            FeatureSpec::state(9),
            camera("observation.images.agentview"),
            camera("observation.images.robot0_eye_in_hand"),
        ];
        Signature { observation, action_dim: 7, ..Signature::default() }
    }

    #[test]
    fn images_are_resized_as_openpi_does() {
        let message = decode(include_bytes!("../fixtures/openpi.msgpack")).unwrap();
        let image = message.get("image").unwrap().to_array().unwrap().into_owned();
        let Some(Value::Map(resized)) = message.get("resized") else { panic!("no images") };
        for (side, expected) in resized {
            let side: usize = side.parse().unwrap();
            let expected = expected.to_array().unwrap().into_owned();
            assert!(resize_with_pad(image.data(), 12, 20, side) == expected.data(), "side {side}");
        }
    }

    #[test]
    fn quaternions_become_the_axis_angles_of_robosuite() {
        let message = decode(include_bytes!("../fixtures/openpi.msgpack")).unwrap();
        let numbers = |key: &str| message.get(key).unwrap().to_array().unwrap().numbers();
        let (quats, expected) = (numbers("quats"), numbers("axis_angles"));
        for (quat, expected) in quats.chunks_exact(4).zip(expected.chunks_exact(3)) {
            for (found, expected) in axis_angle([quat[0], quat[1], quat[2], quat[3]]).iter().zip(expected) {
                assert!((found - expected).abs() < 1e-6, "{found} {expected}");
            }
        }
    }

    #[test]
    fn libero_observations_have_openpis_keys_and_shapes() {
        let mapping = Mapping::preset("openpi-libero").unwrap().of_task("Lift");
        assert_eq!((mapping.prompt.as_deref(), mapping.n_action_steps), (Some(INSTRUCTION), Some(5)));
        assert_eq!(
            Mapping::parse("m", "prompt = 'do {task}'").unwrap().of_task("Lift").prompt.as_deref(),
            Some("do Lift")
        );
        let items = mapping.items(&libero()).unwrap();
        let mut observation = Observation::of_state(vec![1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0, 4.0, 5.0], vec![]);
        // rows of 20 pixels, each with its column as red
        let pixels: Vec<u8> = (0..12 * 20).flat_map(|at| [(at % 20) as u8, 0, 0]).collect();
        observation.insert("observation.images.agentview", Values::U8(pixels.clone()));
        observation.insert("observation.images.robot0_eye_in_hand", Values::U8(pixels));
        let sent: Vec<(String, Vec<usize>)> =
            items.iter().map(|mapped| (mapped.item.key.clone(), mapped.shape())).collect();
        let image = vec![224, 224, 3];
        let expected =
            [("observation/image", image.clone()), ("observation/wrist_image", image), ("observation/state", vec![8])];
        assert_eq!(sent, expected.map(|(key, shape)| (key.to_owned(), shape)));
        for mapped in &items {
            let value = mapped.value(&[&observation], false).unwrap();
            let array = value.to_array().unwrap();
            assert_eq!(array.shape(), mapped.shape());
            if mapped.spec.kind != FeatureKind::Image {
                assert_eq!(array.numbers(), [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 4.0, 5.0]);
            } else {
                // black above, then mirrored: red falls from left to right
                let (top, middle) = (&array.data()[..3 * 224], &array.data()[3 * 224 * 112..][..3 * 224]);
                assert!(top.iter().all(|byte| *byte == 0) && middle[0] == 19 && middle[3 * 223] == 0, "{middle:?}");
            }
        }
        observation.insert("observation.state", Values::F32(vec![f32::NAN; 9]));
        let error = items[2].value(&[&observation], false).unwrap_err().to_string();
        assert_eq!(error, "observation.state: expected [9], found NaN at 0");
    }

    #[test]
    fn flips_are_of_rows_and_columns() {
        let spec = FeatureSpec::image("camera", 2, 2);
        let pixels: Vec<u8> = (0..12).collect();
        for (flip, expected) in [
            (Flip::Horizontal, [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8]),
            (Flip::Vertical, [6, 7, 8, 9, 10, 11, 0, 1, 2, 3, 4, 5]),
            (Flip::Both, [9, 10, 11, 6, 7, 8, 3, 4, 5, 0, 1, 2]),
        ] {
            let item = Item { flip: Some(flip), ..Item::of("camera") };
            assert_eq!(Mapped { item, spec: spec.clone() }.drawn(&pixels), expected, "{flip:?}");
        }
    }

    #[test]
    fn mappings_that_cannot_be_are_refused_by_name() {
        assert_eq!(Mapping::presets().filter_map(Mapping::preset).count(), 2);
        for (text, words) in [
            ("promt = 'x'", "mapping m.toml: "),
            ("promt = 'x'", "prompt"),
            ("timeout_s = 0", "timeout_s: expected 1 to 86400, found 0"),
            ("[[observation]]\nkey = 'a'\nfeature = 'b'\nsize = 5000", "size: expected 1 to 4096, found 5000"),
            ("[[observation]]\nkey = 'a'\nfeature = 'b'\n[[observation]]\nkey = 'a'\nfeature = 'c'", "found a again"),
            ("[[observation]]\nkey = 'seed'\nfeature = 'b'", "key: expected another than prompt, reset, seed"),
            ("[[observation]]\nkey = 'a'\nfeature = 'b'\nflip = 'sideways'", "horizontal"),
        ] {
            let error = Mapping::parse("m.toml", text).unwrap_err().to_string();
            assert!(error.contains(words) && !error.contains('\n'), "{error}");
        }
        let items = |feature: &str, more: &str| {
            let text = format!("[[observation]]\nkey = 'a'\nfeature = '{feature}'\n{more}");
            Mapping::parse("m", &text).unwrap().items(&libero()).unwrap_err().to_string()
        };
        assert!(items("observation.stat", "").contains("expected a feature for a, found observation.state, "));
        assert!(
            items("observation.state", "size = 8").contains("observation.state: expected an image for size and flip")
        );
        assert!(
            items("observation.state", "axis_angle_at = 6").contains("expected numbers with a quaternion from 6 on")
        );
        assert!(items("observation.images.agentview", "axis_angle_at = 0").contains("found an image"));
    }
}
