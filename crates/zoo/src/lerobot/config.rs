//! `config.json` of LeRobot's ACT, and the processors' JSON.

use std::collections::BTreeMap;
use std::path::Path;

use models::{NormMode, act};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::ZooError;

/// One input or output.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Feature {
    #[serde(rename = "type")]
    pub kind: String,
    pub shape: Vec<usize>,
}

/// Features by name.
pub(super) type Features = BTreeMap<String, Feature>;

/// The keys of LeRobot 0.6.1's `ACTConfig`; another key is an error, as it is there.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(dead_code, reason = "keys that LeRobot knows and whose values do not matter here are accepted by name")]
pub(super) struct ActConfig {
    #[serde(rename = "type")]
    pub kind: String,
    #[serde(default = "one")]
    pub n_obs_steps: usize,
    pub input_features: Features,
    pub output_features: Features,
    #[serde(default = "hundred")]
    pub chunk_size: usize,
    #[serde(default = "hundred")]
    pub n_action_steps: usize,
    #[serde(default)]
    pub normalization_mapping: BTreeMap<String, String>,
    #[serde(default)]
    pub pre_norm: Option<bool>,
    #[serde(default)]
    pub dim_model: Option<usize>,
    #[serde(default)]
    pub n_heads: Option<usize>,
    #[serde(default)]
    pub dim_feedforward: Option<usize>,
    #[serde(default)]
    pub feedforward_activation: Option<Value>,
    #[serde(default)]
    pub n_encoder_layers: Option<usize>,
    #[serde(default)]
    pub n_decoder_layers: Option<usize>,
    #[serde(default)]
    pub use_vae: Option<bool>,
    #[serde(default)]
    pub latent_dim: Option<usize>,
    #[serde(default)]
    pub n_vae_encoder_layers: Option<usize>,
    #[serde(default)]
    pub temporal_ensemble_coeff: Option<f64>,
    #[serde(default)]
    pub dropout: Option<f64>,
    #[serde(default)]
    pub kl_weight: Option<f64>,
    /// Known keys that do not matter to a low-dimensional policy at rest.
    #[serde(default, skip_serializing)]
    device: Value,
    #[serde(default, skip_serializing)]
    use_amp: Value,
    #[serde(default, skip_serializing)]
    use_peft: Value,
    #[serde(default, skip_serializing)]
    push_to_hub: Value,
    #[serde(default, skip_serializing)]
    repo_id: Value,
    #[serde(default, skip_serializing)]
    private: Value,
    #[serde(default, skip_serializing)]
    tags: Value,
    #[serde(default, skip_serializing)]
    license: Value,
    #[serde(default, skip_serializing)]
    pretrained_path: Value,
    #[serde(default, skip_serializing)]
    pretrained_revision: Value,
    #[serde(default, skip_serializing)]
    vision_backbone: Value,
    #[serde(default, skip_serializing)]
    pretrained_backbone_weights: Value,
    #[serde(default, skip_serializing)]
    replace_final_stride_with_dilation: Value,
    #[serde(default, skip_serializing)]
    optimizer_lr: Value,
    #[serde(default, skip_serializing)]
    optimizer_weight_decay: Value,
    #[serde(default, skip_serializing)]
    optimizer_lr_backbone: Value,
}

fn one() -> usize {
    1
}

fn hundred() -> usize {
    100
}

impl ActConfig {
    /// The config of our ACT as LeRobot writes it.
    pub fn new(config: &act::Config, n_action_steps: usize, temporal_ensemble: Option<f64>) -> Self {
        let activation = serde_json::to_value(config.feedforward_activation).expect("a name becomes JSON");
        Self {
            kind: "act".to_owned(),
            n_obs_steps: 1,
            input_features: Features::new(),
            output_features: Features::new(),
            chunk_size: config.action_horizon,
            n_action_steps,
            normalization_mapping: BTreeMap::new(),
            pre_norm: Some(config.pre_norm),
            dim_model: Some(config.dim_model),
            n_heads: Some(config.n_heads),
            dim_feedforward: Some(config.dim_feedforward),
            feedforward_activation: Some(activation),
            n_encoder_layers: Some(config.n_encoder_layers),
            n_decoder_layers: Some(config.n_decoder_layers),
            use_vae: Some(config.use_vae),
            latent_dim: Some(config.latent_dim),
            n_vae_encoder_layers: Some(config.n_vae_encoder_layers),
            temporal_ensemble_coeff: temporal_ensemble,
            dropout: Some(config.dropout),
            kl_weight: Some(config.kl_weight),
            device: Value::Null,
            use_amp: Value::Null,
            use_peft: Value::Null,
            push_to_hub: Value::Null,
            repo_id: Value::Null,
            private: Value::Null,
            tags: Value::Null,
            license: Value::Null,
            pretrained_path: Value::Null,
            pretrained_revision: Value::Null,
            vision_backbone: Value::Null,
            pretrained_backbone_weights: Value::Null,
            replace_final_stride_with_dilation: Value::Null,
            optimizer_lr: Value::Null,
            optimizer_weight_decay: Value::Null,
            optimizer_lr_backbone: Value::Null,
        }
    }

    /// The config of our ACT; keys that are not there take LeRobot's defaults, which are ours too.
    pub fn model(&self, path: &Path) -> Result<act::Config, ZooError> {
        let refuse = |key: &str, expected: &str, found: String| {
            let reason = format!("{key}: expected {expected}, found {found}");
            Err(ZooError::Malformed { path: path.to_owned(), reason })
        };
        if self.kind != "act" {
            return refuse("type", "act", self.kind.clone());
        }
        if self.n_obs_steps != 1 {
            return refuse("n_obs_steps", "1", self.n_obs_steps.to_string());
        }
        if let Some((name, _)) = self.input_features.iter().find(|(_, f)| f.kind == "VISUAL") {
            return refuse("input_features", "low-dimensional observations", format!("images in `{name}`"));
        }
        let d = act::Config::default();
        let activation = match &self.feedforward_activation {
            None => d.feedforward_activation,
            Some(name) => match serde_json::from_value(name.clone()) {
                Ok(activation) => activation,
                Err(e) => return refuse("feedforward_activation", "an activation", e.to_string()),
            },
        };
        Ok(act::Config {
            action_horizon: self.chunk_size,
            pre_norm: self.pre_norm.unwrap_or(d.pre_norm),
            dim_model: self.dim_model.unwrap_or(d.dim_model),
            n_heads: self.n_heads.unwrap_or(d.n_heads),
            dim_feedforward: self.dim_feedforward.unwrap_or(d.dim_feedforward),
            feedforward_activation: activation,
            n_encoder_layers: self.n_encoder_layers.unwrap_or(d.n_encoder_layers),
            n_decoder_layers: self.n_decoder_layers.unwrap_or(d.n_decoder_layers),
            use_vae: self.use_vae.unwrap_or(d.use_vae),
            latent_dim: self.latent_dim.unwrap_or(d.latent_dim),
            n_vae_encoder_layers: self.n_vae_encoder_layers.unwrap_or(d.n_vae_encoder_layers),
            dropout: self.dropout.unwrap_or(d.dropout),
            kl_weight: self.kl_weight.unwrap_or(d.kl_weight),
        })
    }
}

/// A processor pipeline: what LeRobot does before or after the network.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Pipeline {
    pub name: String,
    pub steps: Vec<Step>,
}

#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Step {
    pub registry_name: String,
    #[serde(default)]
    pub config: Value,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub state_file: Option<String>,
}

/// The normalising step's part that matters.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct NormaliserStep {
    pub eps: f64,
    pub features: Features,
    pub norm_map: BTreeMap<String, String>,
}

/// Reads JSON or says which file is not what it should be.
pub(super) fn read<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T, ZooError> {
    let text = std::fs::read_to_string(path).map_err(ZooError::io("read", path))?;
    serde_json::from_str(&text)
        .map_err(|e| ZooError::Malformed { path: path.to_owned(), reason: format!("not LeRobot's: {e}") })
}

/// LeRobot's name of a mode.
pub(super) fn mode_name(mode: NormMode) -> &'static str {
    match mode {
        NormMode::MeanStd => "MEAN_STD",
        NormMode::MinMax => "MIN_MAX",
        NormMode::Identity => "IDENTITY",
    }
}

/// The mode of a kind of feature; a kind that the map leaves out passes as it is.
pub(super) fn mode(path: &Path, map: &BTreeMap<String, String>, kind: &str) -> Result<NormMode, ZooError> {
    match map.get(kind).map(String::as_str) {
        None | Some("IDENTITY") => Ok(NormMode::Identity),
        Some("MEAN_STD") => Ok(NormMode::MeanStd),
        Some("MIN_MAX") => Ok(NormMode::MinMax),
        Some(other) => Err(ZooError::Malformed {
            path: path.to_owned(),
            reason: format!("norm_map of {kind}: expected MEAN_STD, MIN_MAX or IDENTITY, found {other}"),
        }),
    }
}
