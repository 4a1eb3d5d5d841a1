//! BC's options.

use crate::encoders::VisionConfig;
use nn::Size;
use nn::{ModelError, Result};
use serde::{Deserialize, Serialize};

/// What is minimised over the steps that are not padding.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Loss {
    /// mean absolute error
    L1,
    /// mean squared error
    #[default]
    L2,
}

/// Options of BC; defaults are robomimic's, one action at a time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// actions predicted at once
    pub action_horizon: usize,
    /// widths of the hidden layers (robomimic: `actor_layer_dims`)
    pub hidden: Vec<usize>,
    /// loss
    pub loss: Loss,
    /// image encoder; absent without cameras
    #[serde(skip_serializing_if = "Option::is_none")]
    pub vision: Option<VisionConfig>,
}

impl Default for Config {
    fn default() -> Self {
        Self { action_horizon: 1, hidden: vec![1024, 1024], loss: Loss::L2, vision: None }
    }
}

impl Config {
    /// How large the model will be: its hidden layers, and at least one number in and one out.
    pub fn size(&self) -> Size {
        let widths: Vec<f64> = self.hidden.iter().map(|&width| width as f64).collect();
        let between: f64 = widths.windows(2).map(|pair| pair[0] * pair[1]).sum();
        let ends =
            widths.first().copied().unwrap_or(1.0) + widths.last().copied().unwrap_or(1.0) * self.action_horizon as f64;
        let outputs = self.action_horizon as f64;
        Size { weights: between + ends, activations: widths.iter().sum::<f64>() + outputs }
    }

    /// Checks that a model with this configuration can exist.
    ///
    /// # Errors
    /// The first field that makes it impossible.
    pub fn validate(&self) -> Result<()> {
        let refuse = |field: &'static str, expected: &str| {
            let expected = expected.to_string();
            Err(ModelError::Config { model: "bc", field, found: "0".to_string(), expected })
        };
        if self.action_horizon == 0 {
            return refuse("action_horizon", "at least 1");
        }
        if self.hidden.contains(&0) {
            return refuse("hidden", "widths of at least 1");
        }
        self.vision.as_ref().map_or(Ok(()), VisionConfig::validate)
    }
}
