//! BC-Transformer's options.

use crate::encoders::VisionConfig;
use nn::Size;
use nn::{ModelError, Result};
use serde::{Deserialize, Serialize};

/// Options with robomimic's defaults; the context is as long as `data.n_obs_steps`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// actions predicted at once: 1
    pub action_horizon: usize,
    /// width of a token (robomimic: `embed_dim`)
    pub dim_model: usize,
    /// attention heads
    pub n_heads: usize,
    /// transformer blocks
    pub n_layers: usize,
    /// dropout of tokens, attention weights and block outputs
    pub dropout: f64,
    /// components of the Gaussian mixture
    pub n_modes: usize,
    /// smallest standard deviation of a component in training
    pub min_std: f64,
    /// image encoder; absent without cameras
    #[serde(skip_serializing_if = "Option::is_none")]
    pub vision: Option<VisionConfig>,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            action_horizon: 1,
            dim_model: 512,
            n_heads: 8,
            n_layers: 6,
            dropout: 0.1,
            n_modes: 5,
            min_std: 1e-4,
            vision: None,
        }
    }
}

impl Config {
    /// How large the model will be, without what depends on observation and action.
    pub fn size(&self) -> Size {
        let (dim, layers) = (self.dim_model as f64, self.n_layers as f64);
        Size { weights: layers * dim * (12.0 * dim + 9.0), activations: layers * 16.0 * dim }
    }

    /// Checks that a model with this configuration can exist.
    ///
    /// # Errors
    /// The first field that makes it impossible.
    pub fn validate(&self) -> Result<()> {
        let refuse = |field: &'static str, found: String, expected: &str| {
            Err(ModelError::Config { model: "bc_transformer", field, found, expected: expected.to_string() })
        };
        if self.action_horizon != 1 {
            return refuse("action_horizon", self.action_horizon.to_string(), "1, the action of the last step");
        }
        for (field, value) in [("dim_model", self.dim_model), ("n_layers", self.n_layers), ("n_modes", self.n_modes)] {
            if value == 0 {
                return refuse(field, "0".to_string(), "at least 1");
            }
        }
        if self.n_heads == 0 || !self.dim_model.is_multiple_of(self.n_heads) {
            return refuse("n_heads", self.n_heads.to_string(), &format!("a divisor of dim_model, {}", self.dim_model));
        }
        if !(0.0..1.0).contains(&self.dropout) {
            return refuse("dropout", self.dropout.to_string(), "at least 0 and below 1");
        }
        if !(self.min_std.is_finite() && self.min_std > 0.0) {
            return refuse("min_std", self.min_std.to_string(), "a positive number");
        }
        self.vision.as_ref().map_or(Ok(()), VisionConfig::validate)
    }
}
