//! What all of LeRobot's policies state alike in `config.json`, and how their tensors are named: inputs, outputs, normalisation.
//! What only one of them has stands beside that policy; files are read and written in `interchange`.

use crate::features::{FeatureKind, FeatureSpec, Signature};
use crate::normaliser::{ACTION, ENVIRONMENT_STATE, NormMode, STATE};
use candle_core::Tensor;
use nn::{ModelError, Params, Result, some_names};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;

/// Normalisation by feature.
type Modes = BTreeMap<String, NormMode>;

/// LeRobot's kinds of features that are numbers, with our names of them.
const NUMBERS: [(&str, &str); 3] = [(STATE, "STATE"), (ENVIRONMENT_STATE, "ENV"), (ACTION, "ACTION")];

/// Keys that LeRobot knows and that do not matter to a policy at rest.
const OF_NO_MATTER: [&str; 14] = [
    "type",
    "device",
    "use_amp",
    "use_peft",
    "push_to_hub",
    "repo_id",
    "private",
    "tags",
    "license",
    "pretrained_path",
    "pretrained_revision",
    // whose weights it began with; those in the file are what counts
    "pretrained_backbone_weights",
    "optimizer_lr",
    "optimizer_weight_decay",
];

/// A feature as `config.json` states it.
#[derive(Debug, Deserialize)]
pub(crate) struct FeatureKeys {
    #[serde(rename = "type")]
    kind: String,
    shape: Vec<usize>,
}

/// One of LeRobot's types of policies.
pub(crate) struct PolicyFile {
    /// `type` in `config.json`
    pub kind: &'static str,
    /// it in messages
    pub model: &'static str,
    /// what the name of every tensor begins with
    pub prefix: &'static str,
    /// whether images are among its inputs
    pub images: bool,
}

impl PolicyFile {
    pub fn refuse(&self, field: &'static str, found: impl Into<String>, expected: &str) -> ModelError {
        ModelError::Config { model: self.model, field, found: found.into(), expected: expected.to_string() }
    }

    /// The keys of a `config.json` of this type, but for those of no matter, to this policy or to any.
    ///
    /// # Errors
    /// Another type, an unknown key, a value of another type.
    pub fn keys<T: DeserializeOwned>(&self, config: &Value, of_no_matter: &[&str]) -> Result<T> {
        let kind = config.get("type").and_then(Value::as_str).unwrap_or("absent");
        if kind != self.kind {
            return Err(self.refuse("type", kind, self.kind));
        }
        let mut given: Map<String, Value> = config.as_object().cloned().unwrap_or_default();
        let matters = |key: &str| !OF_NO_MATTER.contains(&key) && !of_no_matter.contains(&key);
        // LeRobot writes `null` for absent options
        given.retain(|key, value| !value.is_null() && matters(key));
        serde_json::from_value(Value::Object(given))
            .map_err(|e| self.refuse("config.json", e.to_string(), "LeRobot's keys and types"))
    }

    /// Inputs, output and normalisation.
    ///
    /// # Errors
    /// A feature that the policy does not read, a missing one, a mode that we do not have.
    pub fn read_features(
        &self,
        inputs: &BTreeMap<String, FeatureKeys>,
        outputs: &BTreeMap<String, FeatureKeys>,
        mapping: &BTreeMap<String, String>,
    ) -> Result<(Signature, Modes)> {
        let (mut state, mut env, mut images) = (0, 0, Vec::new());
        for (name, feature) in inputs {
            match (feature.kind.as_str(), name.as_str(), &feature.shape[..]) {
                ("STATE", STATE, &[n]) => state = n,
                ("ENV", ENVIRONMENT_STATE, &[n]) => env = n,
                ("VISUAL", name, &[3, height, width]) if self.images => {
                    images.push(FeatureSpec::image(name, height, width));
                }
                (kind, _, shape) => {
                    let found = format!("{name} of type {kind} and shape {shape:?}");
                    let images = if self.images { ", images of type VISUAL and shape [3, height, width]" } else { "" };
                    let numbers = "observation.state of type STATE, observation.environment_state of type ENV";
                    return Err(self.refuse("input_features", found, &format!("{numbers}, of one dimension{images}")));
                }
            }
        }
        let action = match outputs.get(ACTION).map(|f| &f.shape[..]) {
            Some([n]) => *n,
            other => return Err(self.refuse("output_features", format!("action of shape {other:?}"), "one dimension")),
        };
        if state == 0 {
            return Err(self.refuse("input_features", "no observation.state", "observation.state"));
        }
        let mut modes = Modes::new();
        for (feature, kind) in NUMBERS {
            let mode = mode_of(mapping, kind)?;
            if feature != ENVIRONMENT_STATE || env > 0 {
                modes.insert(feature.to_string(), mode);
            }
        }
        let mut signature = Signature::low_dimensional(state, env, action);
        signature.observation.extend(images);
        Ok((signature, modes))
    }

    /// What `config.json` says of these, with `own`, the keys that only this policy has.
    ///
    /// # Errors
    /// A feature that LeRobot's policy does not read.
    pub fn write_config(&self, signature: &Signature, modes: &Modes, own: Value) -> Result<Value> {
        let mut inputs = json!({});
        for spec in &signature.observation {
            let (kind, shape) = match (spec.kind, &spec.shape[..]) {
                (FeatureKind::State, shape) => ("STATE", shape.to_vec()),
                (FeatureKind::EnvironmentState, shape) => ("ENV", shape.to_vec()),
                (FeatureKind::Image, &[height, width, colours]) if self.images => {
                    ("VISUAL", vec![colours, height, width])
                }
                (FeatureKind::Entity | FeatureKind::Image, _) => {
                    let images = if self.images { ", image" } else { "" };
                    let expected = format!("features that are written for LeRobot: state, environment_state{images}");
                    return Err(self.refuse(
                        "input_features",
                        format!("{} of kind {}", spec.name, spec.kind),
                        &expected,
                    ));
                }
            };
            inputs[&spec.name] = json!({ "type": kind, "shape": shape });
        }
        let mut mapping = Map::from_iter([("VISUAL".to_string(), json!("MEAN_STD"))]);
        for (feature, kind) in NUMBERS {
            if let Some(mode) = modes.get(feature) {
                mapping.insert(kind.to_string(), json!(mode_name(*mode)));
            }
        }
        let mut config = json!({
            "type": self.kind,
            "n_obs_steps": signature.n_obs_steps,
            "input_features": inputs,
            "output_features": { ACTION: { "type": "ACTION", "shape": [signature.action_dim] } },
            "device": "cpu",
            "normalization_mapping": mapping,
        });
        if let (Some(config), Value::Object(own)) = (config.as_object_mut(), own) {
            config.extend(own);
        }
        Ok(config)
    }

    /// Tensors under our names, without the prefix.
    ///
    /// # Errors
    /// A tensor without it.
    pub fn own_names(&self, params: &Params, tensors: &BTreeMap<String, Tensor>) -> Result<BTreeMap<String, Tensor>> {
        let named = |(name, tensor): (&String, &Tensor)| {
            let known = || params.names().map(|name| self.prefixed(name)).collect::<Vec<_>>();
            let short = name
                .strip_prefix(self.prefix)
                .ok_or_else(|| ModelError::ExtraTensor { name: name.clone(), known: some_names(&known()) })?;
            Ok((short.to_string(), tensor.clone()))
        };
        tensors.iter().map(named).collect()
    }

    /// LeRobot's name of a tensor.
    pub fn prefixed(&self, name: &str) -> String {
        format!("{}{name}", self.prefix)
    }
}

/// LeRobot's name of a mode.
pub fn mode_name(mode: NormMode) -> &'static str {
    match mode {
        NormMode::MeanStd => "MEAN_STD",
        NormMode::MinMax => "MIN_MAX",
        NormMode::Identity => "IDENTITY",
    }
}

/// The mode of a kind of feature (`STATE`, `ENV`, `ACTION`) in a mapping of LeRobot's; what it leaves out passes as it is.
///
/// # Errors
/// A mode that we do not have.
pub fn mode_of(mapping: &BTreeMap<String, String>, kind: &str) -> Result<NormMode> {
    match mapping.get(kind).map(String::as_str) {
        None | Some("IDENTITY") => Ok(NormMode::Identity),
        Some("MEAN_STD") => Ok(NormMode::MeanStd),
        Some("MIN_MAX") => Ok(NormMode::MinMax),
        Some(other) => Err(ModelError::Config {
            model: "LeRobot",
            field: "normalization mapping",
            found: other.to_string(),
            expected: "MEAN_STD, MIN_MAX or IDENTITY".to_string(),
        }),
    }
}
