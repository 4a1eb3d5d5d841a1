//! Diffusion's options.

use crate::encoders::VisionConfig;
use crate::models::denoising::{NetworkConfig, Setup, TransformerConfig};
use nn::Size;
use nn::{ModelError, Result};
use serde::{Deserialize, Serialize};

/// What the network is trained to give.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Prediction {
    /// the noise that was added
    #[default]
    Epsilon,
    /// the actions without noise
    Sample,
}

/// How actions are drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Sampler {
    /// deterministic after the initial noise (Song et al.)
    #[default]
    Ddim,
    /// noise at every step (Ho et al.)
    Ddpm,
}

/// Options, with LeRobot's defaults but for the sampler (there DDPM with all steps) and the horizon (there 64).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// actions in a sequence, starting at the first observation of the history (LeRobot: `horizon`)
    pub action_horizon: usize,
    /// the network, a UNet
    pub network: NetworkConfig,
    /// a transformer instead of the UNet
    #[serde(skip_serializing_if = "Option::is_none")]
    pub transformer: Option<TransformerConfig>,
    /// diffusion steps in training
    pub num_train_timesteps: usize,
    /// output of the network
    pub prediction: Prediction,
    /// sampler of actions
    pub sampler: Sampler,
    /// denoising steps at inference
    pub inference_steps: usize,
    /// largest magnitude of a normalised action, also between steps; 0: no limit
    pub clip_sample: f64,
    /// whether padding beyond an episode's ends is left out of the loss (LeRobot: `do_mask_loss_for_padding`)
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
            num_train_timesteps: 100,
            prediction: Prediction::Epsilon,
            sampler: Sampler::Ddim,
            inference_steps: 10,
            clip_sample: 1.0,
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
        self.setup().size()
    }

    /// Checks that a model with this configuration can exist.
    ///
    /// # Errors
    /// The first field that makes it impossible.
    pub fn validate(&self) -> Result<()> {
        let refuse = |field, found: String, expected: String| {
            Err(ModelError::Config { model: "diffusion", field, found, expected })
        };
        self.setup().validate("diffusion")?;
        if !(1..=100_000).contains(&self.num_train_timesteps) {
            return refuse("num_train_timesteps", self.num_train_timesteps.to_string(), "1 to 100000".to_string());
        }
        if !(1..=self.num_train_timesteps).contains(&self.inference_steps) {
            let expected = format!("1 to num_train_timesteps, {}", self.num_train_timesteps);
            return refuse("inference_steps", self.inference_steps.to_string(), expected);
        }
        if !(self.clip_sample.is_finite() && self.clip_sample >= 0.0) {
            return refuse("clip_sample", self.clip_sample.to_string(), "0 or more".to_string());
        }
        self.vision.as_ref().map_or(Ok(()), VisionConfig::validate)
    }
}
