//! A demo in robomimic's layout, from what a worker recorded and back to what a worker replays.

use std::path::Path;

use dataset::{Array, Demo, Dtype};
use rollout::{FrameTensor, RecordedEpisode};

use crate::error::{RecordingError, Result};

/// Begins the name of an attribute that is not the demo's but the group `data`'s.
const OF_THE_FILE: &str = "data/";

/// A recorded attribute as HDF5 holds it: a text, or JSON.
fn attribute(value: &serde_json::Value) -> Array {
    match value {
        serde_json::Value::String(text) => Array::from_str(text),
        other => Array::from_str(&other.to_string()),
    }
}

/// What a recorded episode says of all demonstrations of its task: attributes of the group `data`.
pub(crate) fn of_the_file(episode: &RecordedEpisode) -> impl Iterator<Item = (&str, Array)> {
    episode.attrs.iter().filter_map(|(name, value)| Some((name.strip_prefix(OF_THE_FILE)?, attribute(value))))
}

/// A demo in robomimic's layout from what a worker recorded; with or without `next_obs`.
///
/// # Errors
/// A tensor of a kind that files of demonstrations do not hold.
pub fn demo(id: &str, episode: RecordedEpisode, next_obs: bool) -> Result<Demo> {
    let mut demo = Demo { id: id.to_owned(), ..Demo::default() };
    for (name, value) in episode.attrs.iter().filter(|(name, _)| !name.starts_with(OF_THE_FILE)) {
        demo.attrs.insert(name.clone(), attribute(value));
    }
    let steps = i64::try_from(episode.steps).expect("an episode has fewer steps than 2^63");
    demo.attrs.insert("num_samples".to_owned(), Array::from_i64(Vec::new(), &[steps]));
    for (name, tensor) in episode.tensors {
        if next_obs || !name.starts_with("next_obs/") {
            let array = array(id, &name, tensor)?;
            demo.datasets.insert(name, array);
        }
    }
    Ok(demo)
}

fn array(demo: &str, name: &str, tensor: FrameTensor) -> Result<Array> {
    use safetensors::Dtype as Wire;
    let dtype = match tensor.dtype {
        Wire::F64 => Dtype::F64,
        Wire::F32 => Dtype::F32,
        Wire::I64 => Dtype::I64,
        Wire::U8 => Dtype::U8,
        Wire::BOOL => Dtype::Bool,
        other => {
            return Err(RecordingError::Unfit {
                path: Path::new("a worker's recording").to_owned(),
                demo: Some(demo.to_owned()),
                what: name.to_owned(),
                expected: "numbers that HDF5 files of demonstrations hold".to_owned(),
                found: format!("{other:?}"),
            });
        }
    };
    Ok(Array { dtype, shape: tensor.shape, bytes: tensor.bytes })
}

/// What a demo holds that a simulator can be put into: states, actions, the model and what else the episode needs.
#[derive(Debug, Clone)]
pub struct Recording {
    /// The model's XML; empty if the demo has none.
    pub model: String,
    /// What the episode needs beside it; null if nothing.
    pub ep_meta: serde_json::Value,
    /// (T, S)
    pub states: FrameTensor,
    /// (T, A)
    pub actions: FrameTensor,
}

impl Recording {
    /// Of a demo of the file `path` that was read with `states` and `actions`.
    ///
    /// # Errors
    /// One of them is missing or no numbers; an `ep_meta` that is not JSON.
    pub fn of(path: &Path, demo: &Demo) -> Result<Self> {
        let unfit = |what: &str, expected: &str, found: String| RecordingError::Unfit {
            path: path.to_owned(),
            demo: Some(demo.id.clone()),
            what: what.to_owned(),
            expected: expected.to_owned(),
            found,
        };
        let text = |name: &str| demo.attrs.get(name).and_then(Array::to_text);
        let ep_meta = match text("ep_meta") {
            Some(text) => serde_json::from_str(&text).map_err(|e| unfit("attribute ep_meta", "JSON", e.to_string()))?,
            None => serde_json::Value::Null,
        };
        let tensor = |key: &str| {
            let array = demo.datasets.get(key).ok_or_else(|| unfit(key, "a dataset", "none".to_owned()))?;
            let values = array.to_f64().ok_or_else(|| unfit(key, "numbers", format!("{:?}", array.dtype)))?;
            Ok::<_, RecordingError>(FrameTensor::from_f64(&array.shape, &values))
        };
        Ok(Self {
            model: text("model_file").unwrap_or_default(),
            ep_meta,
            states: tensor("states")?,
            actions: tensor("actions")?,
        })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn attributes_of_the_file_are_none_of_the_demos() {
        let attrs = [("model_file", "<mujoco/>"), ("data/tag", "libero-v1")];
        let attrs = attrs.map(|(name, text)| (name.to_owned(), serde_json::json!(text))).into();
        let episode = RecordedEpisode { success: true, steps: 2, attrs, tensors: std::collections::BTreeMap::new() };
        let said: Vec<_> = of_the_file(&episode).map(|(name, text)| (name.to_owned(), text.to_text())).collect();
        assert_eq!(said, [("tag".to_owned(), Some("libero-v1".to_owned()))]);
        let demo = demo("demo_0", episode, false).unwrap();
        assert_eq!(demo.attrs.keys().collect::<Vec<_>>(), ["model_file", "num_samples"]);
    }
}
