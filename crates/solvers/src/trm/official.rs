//! The reference's own configuration, as its checkpoints store it.

use super::{Config, Mixing, Positions};
use nn::{ModelError, Result};
use serde::Deserialize;

/// The fields of `TinyRecursiveReasoningModel_ACTV1Config` that shape the model, with the
/// reference's defaults. Others (number format, batch size, the ignored `H_layers`) change
/// nothing here.
#[derive(Debug, Deserialize)]
#[allow(non_snake_case)] // the reference's spelling
struct Official {
    seq_len: usize,
    vocab_size: usize,
    hidden_size: usize,
    num_heads: usize,
    H_cycles: usize,
    L_cycles: usize,
    L_layers: usize,
    #[serde(default = "four")]
    expansion: f64,
    #[serde(default = "rope")]
    pos_encodings: String,
    #[serde(default)]
    mlp_t: bool,
    #[serde(default)]
    puzzle_emb_ndim: usize,
    #[serde(default)]
    num_puzzle_identifiers: usize,
    #[serde(default = "sixteen")]
    puzzle_emb_len: usize,
    #[serde(default = "theta")]
    rope_theta: f64,
    #[serde(default = "eps")]
    rms_norm_eps: f64,
    #[serde(default = "sixteen")]
    halt_max_steps: usize,
    #[serde(default = "tenth")]
    halt_exploration_prob: f64,
}

fn four() -> f64 {
    4.0
}
fn rope() -> String {
    "rope".into()
}
fn sixteen() -> usize {
    16
}
fn theta() -> f64 {
    1e4
}
fn eps() -> f64 {
    1e-5
}
fn tenth() -> f64 {
    0.1
}

impl Config {
    /// Reads the reference's configuration.
    ///
    /// # Errors
    /// When a field is missing, has the wrong type or describes no model.
    pub fn from_official(json: &serde_json::Value) -> Result<Self> {
        let official: Official = Deserialize::deserialize(json).map_err(|e| ModelError::Config {
            model: "trm",
            field: "official configuration",
            found: e.to_string(),
            expected: "the fields of TinyRecursiveReasoningModel_ACTV1Config".into(),
        })?;
        let positions = match official.pos_encodings.as_str() {
            "rope" => Positions::Rope,
            "learned" => Positions::Learned,
            "none" => Positions::None,
            other => {
                return Err(ModelError::Config {
                    model: "trm",
                    field: "pos_encodings",
                    found: other.into(),
                    expected: "rope, learned or none".into(),
                });
            }
        };
        let config = Self {
            num_heads: official.num_heads,
            layers: official.L_layers,
            h_cycles: official.H_cycles,
            l_cycles: official.L_cycles,
            mixing: if official.mlp_t { Mixing::MlpT } else { Mixing::Attention },
            positions,
            rope_theta: official.rope_theta,
            rms_norm_eps: official.rms_norm_eps,
            expansion: official.expansion,
            puzzle_emb_ndim: official.puzzle_emb_ndim,
            num_puzzle_identifiers: official.num_puzzle_identifiers,
            puzzle_emb_len: official.puzzle_emb_len,
            halt_max_steps: official.halt_max_steps,
            halt_exploration_prob: official.halt_exploration_prob,
            ..Self::new(official.vocab_size, official.seq_len, official.hidden_size)
        };
        config.check()?;
        Ok(config)
    }
}
