//! `entry.json`: where an entry comes from and what its files are.

use std::collections::BTreeMap;

use models::{FeatureKind, Signature};
use serde::{Deserialize, Serialize};

use crate::config::is_built_in_task;
use crate::experiment::IMAGE_SUFFIX;
use crate::external::EXTERNAL;
use crate::results::Seeds;
use crate::{FeatureKeys, ZooError, sha256_hex};

use super::EntryId;

/// Everything recorded about an entry.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EntryMeta {
    /// Form of this file.
    pub format: u32,
    /// The entry's name.
    pub name: String,
    /// The entry's version.
    pub version: u32,
    /// One sentence on what it is.
    pub description: String,
    /// The experiment it was trained by, or where it was imported from.
    pub experiment: String,
    /// Kind of policy: `act`, `actrm`, …
    pub policy: String,
    /// Task it was trained for, by the name the worker knows.
    pub task: String,
    /// Environment of the demonstrations, as the data set names it.
    pub env_name: Option<String>,
    /// Version of the simulator that recorded the demonstrations.
    pub env_version: Option<String>,
    /// The user's module that registers the environment, as the demonstrations were recorded with it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub env_module: Option<ModuleMeta>,
    /// robomimic's arguments of the demonstrations' environment: its robots and controllers.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub env_args: Option<serde_json::Value>,
    /// Number of weights.
    pub parameters: u64,
    /// The features that it reads, and the length of its actions.
    pub signature: Signature,
    /// Observation keys that make the features, in order.
    pub keys: FeatureKeys,
    /// The demonstrations; `None` for an imported entry.
    pub data: Option<DataMeta>,
    /// What it is, if no robot policy.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub kind: Option<String>,
    /// What only entries of its kind record; whoever makes that kind reads it.
    #[serde(default, alias = "puzzle", skip_serializing_if = "Option::is_none")]
    pub section: Option<serde_json::Value>,
    /// How it was trained; `None` for an imported entry.
    pub training: Option<TrainingMeta>,
    /// The entry that it was made of, where it went out to another library and came back.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub parent: Option<ParentMeta>,
    /// Its licence, by the name that the Hugging Face Hub knows; of an imported entry none is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub license: Option<String>,
    /// Versions of the software that made it.
    pub versions: BTreeMap<String, String>,
    /// Every other file of the entry.
    pub files: BTreeMap<String, FileMeta>,
}

/// A Python module that registers environments.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct ModuleMeta {
    /// Its name, as Python imports it.
    pub name: String,
    /// SHA-256 of its source.
    pub sha256: String,
}

impl ModuleMeta {
    /// The module that `env_args` name, if they do.
    pub fn of(env_args: &serde_json::Value) -> Option<Self> {
        serde_json::from_value(env_args.get("env_module")?.clone()).ok()
    }
}

/// Cameras that a policy sees through.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CamerasMeta {
    /// The simulator's names of them, in order.
    pub names: Vec<String>,
    /// Side of their pictures, in pixels.
    pub size: usize,
    /// Whether they were drawn without reflections and multisampling.
    pub fast_render: bool,
}

/// Key in `env_args` that says so.
const FAST_RENDER: &str = "fast_render";

impl CamerasMeta {
    /// What `env_args` say of an environment that draws without reflections and multisampling, if they say nothing else.
    pub fn fast() -> serde_json::Value {
        serde_json::json!({ FAST_RENDER: true })
    }

    /// Whether the environment with these arguments draws without reflections and multisampling.
    pub fn draws_fast(env_args: &serde_json::Value) -> bool {
        env_args.get(FAST_RENDER).and_then(serde_json::Value::as_bool).unwrap_or(false)
    }
}

/// The licence of what is trained here.
pub const LICENSE: &str = "apache-2.0";

/// An entry that another one was made of.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ParentMeta {
    /// `name@version`.
    pub entry: String,
    /// Its hash, as [`EntryMeta::content_sha256`] gives it.
    pub content_sha256: String,
}

/// The demonstrations behind an entry.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DataMeta {
    /// File or folder name, without the path.
    pub name: String,
    /// SHA-256 of the data set's content.
    pub fingerprint: String,
    /// SHA-256 of the episodes trained on alone, as [`dataset::Dataset::fingerprint_of`] gives it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub train_fingerprint: Option<String>,
    /// Episodes trained on.
    pub train_episodes: u64,
    /// Frames trained on.
    pub train_frames: u64,
    /// Episodes held out for validation.
    pub valid_episodes: u64,
    /// The simulator's seeds that the demonstrations were recorded with, where the data set says.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seeds: Option<Seeds>,
    /// Which of the task's experts recorded them, where it is not the usual one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub expert: Option<String>,
    /// How able whoever showed them is, where that is not as usual.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub skill: Option<String>,
    /// What the data set calls the numbers of a feature, in its order, where those are not the keys that make it; an empty list
    /// where it does not name them.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub names: BTreeMap<String, Vec<String>>,
}

/// How an entry was trained.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct TrainingMeta {
    /// Optimiser steps.
    pub steps: u64,
    /// Windows a step.
    pub batch_size: u64,
    /// Seed of weights, latents, dropout and batch order.
    pub seed: u64,
    /// Minutes of training, over all sessions of the run.
    pub minutes: f64,
    /// Threads it ran on.
    pub threads: u64,
    /// The machine that it ended on: processor, cores and kernel.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub machine: Option<String>,
    /// The GPU and CUDA's version; `None` on the CPU. Another training on it may end in other bytes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gpu: Option<String>,
    /// The loss on the way, thinned; in `entry.json` of entries without `train.parquet` alone.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub curve: Vec<CurvePoint>,
}

/// One point of a training curve.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CurvePoint {
    /// Optimiser steps done.
    pub step: u64,
    /// Training loss.
    pub loss: f64,
    /// Validation loss, where it was computed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub valid_loss: Option<f64>,
}

/// One file of an entry.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FileMeta {
    /// Length in bytes.
    pub bytes: u64,
    /// SHA-256, lower-case hexadecimal.
    pub sha256: String,
}

impl EntryMeta {
    /// The cameras that it sees through, by their names; none if it sees no pictures.
    pub fn camera_names(&self) -> Vec<String> {
        let name = |feature: &str| {
            let key = self.keys.of(feature).concat();
            key.strip_suffix(IMAGE_SUFFIX).unwrap_or(&key).to_owned()
        };
        self.signature.of_kind(FeatureKind::Image).map(|spec| name(&spec.name)).collect()
    }

    /// The cameras that it sees through; `None` if it sees no pictures.
    ///
    /// # Errors
    /// Pictures that no worker draws: of several sizes, or not square.
    pub fn cameras(&self) -> Result<Option<CamerasMeta>, ZooError> {
        let names = self.camera_names();
        let sizes: Vec<usize> =
            self.signature.of_kind(FeatureKind::Image).flat_map(|spec| spec.shape.iter().take(2).copied()).collect();
        let Some(&size) = sizes.first() else { return Ok(None) };
        if sizes.iter().any(|other| *other != size) {
            return Err(ZooError::UnfitEntry {
                entry: self.id().to_string(),
                task: self.task.clone(),
                what: "images".to_owned(),
                expected: "square and all of one size".to_owned(),
                found: format!("{sizes:?}"),
            });
        }
        let fast_render = self.env_args.as_ref().is_some_and(CamerasMeta::draws_fast);
        Ok(Some(CamerasMeta { names, size, fast_render }))
    }

    /// Whether no simulator is known to have its task: it was trained here on demonstrations that name no environment.
    pub fn is_of_data_alone(&self) -> bool {
        let trained_on_data = self.training.is_some() && self.data.is_some();
        trained_on_data && self.env_name.is_none() && !is_built_in_task(&self.task)
    }

    /// Whether its weights are not in the zoo: whoever has the policy runs it.
    pub fn is_external(&self) -> bool {
        self.policy == EXTERNAL
    }

    /// Its licence, by the name that the Hugging Face Hub knows.
    pub fn license(&self) -> &str {
        // older entries do not say it; all that were trained here have this one
        let usual = if self.training.is_some() { LICENSE } else { "unknown" };
        self.license.as_deref().unwrap_or(usual)
    }

    /// `name@version`.
    pub fn id(&self) -> EntryId {
        EntryId { name: self.name.clone(), version: self.version }
    }

    /// One hash for what an evaluation depends on: weights, config and normaliser.
    ///
    /// Two trainings with the same seed have the same; minutes and model card do not enter.
    pub fn content_sha256(&self) -> String {
        let mut text = String::new();
        for name in [super::CONFIG_FILE, super::MODEL_FILE, super::NORMALISER_FILE] {
            let sha256 = self.files.get(name).map_or("", |f| f.sha256.as_str());
            text.push_str(&format!("{sha256}  {name}\n"));
        }
        sha256_hex(text.as_bytes())
    }
}

/// Key in `entry.json` of the hash of the file itself.
const SELF_KEY: &str = "\"sha256_of_this_file_with_zeros_here\": \"";

/// The text of `entry.json`: the metadata and, last, the hash of the text itself.
pub(super) fn seal_text(meta: &EntryMeta) -> String {
    let body = serde_json::to_string_pretty(meta).expect("strings and numbers become JSON");
    let body = body.strip_suffix("\n}").expect("a pretty-printed object ends so");
    let zeros = "0".repeat(64);
    let text = format!("{body},\n  {SELF_KEY}{zeros}\"\n}}\n");
    let digest = sha256_hex(text.as_bytes());
    text.replace(&format!("{SELF_KEY}{zeros}"), &format!("{SELF_KEY}{digest}"))
}

/// The hash that `entry.json` records of itself and the one it has; `None` where none is recorded.
pub(super) fn self_hashes(text: &[u8]) -> Option<(String, String)> {
    let key = SELF_KEY.as_bytes();
    let start = text.windows(key.len()).rposition(|w| w == key)? + key.len();
    let recorded = text.get(start..start + 64)?;
    let mut zeroed = text.to_vec();
    zeroed[start..start + 64].fill(b'0');
    Some((String::from_utf8_lossy(recorded).into_owned(), sha256_hex(&zeroed)))
}
