//! MIP's options.

use crate::encoders::VisionConfig;
use crate::models::denoising::{NetworkConfig, Setup, TransformerConfig};
use nn::Size;
use nn::{ModelError, Result};
use serde::{Deserialize, Serialize};

/// Options.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// actions in a sequence, starting at the first observation of the history
    pub action_horizon: usize,
    /// the network
    pub network: NetworkConfig,
    /// a transformer instead of the UNet
    #[serde(skip_serializing_if = "Option::is_none")]
    pub transformer: Option<TransformerConfig>,
    /// share of the actions in the second step's input; the rest is noise in training
    pub second_time: f64,
    /// whether padding beyond an episode's ends is left out of the loss
    pub mask_padding: bool,
    /// image encoder; absent without cameras
    #[serde(skip_serializing_if = "Option::is_none")]
    pub vision: Option<VisionConfig>,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            action_horizon: 16,
            network: NetworkConfig::default(),
            transformer: None,
            second_time: 0.9,
            mask_padding: false,
            vision: None,
        }
    }
}

impl Config {
    pub(super) fn setup(&self) -> Setup<'_> {
        Setup {
            action_horizon: self.action_horizon,
            network: &self.network,
            transformer: self.transformer.as_ref(),
            mask_padding: self.mask_padding,
            vision: self.vision.as_ref(),
        }
    }

    /// How large the model will be.
    pub fn size(&self) -> Size {
        let once = self.setup().size();
        Size { activations: 2.0 * once.activations, ..once }
    }

    /// Checks that a model with this configuration can exist.
    ///
    /// # Errors
    /// The first field that makes it impossible.
    pub fn validate(&self) -> Result<()> {
        self.setup().validate("mip")?;
        if !(self.second_time > 0.0 && self.second_time < 1.0) {
            let (found, expected) = (self.second_time.to_string(), "between 0 and 1".to_string());
            return Err(ModelError::Config { model: "mip", field: "second_time", found, expected });
        }
        self.vision.as_ref().map_or(Ok(()), VisionConfig::validate)
    }
}
