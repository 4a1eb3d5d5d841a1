//! ACT's options.

use crate::encoders::VisionConfig;
use crate::layers::{Activation, AuxiliaryConfig, PointerConfig, Shape};
use nn::Size;
use nn::{ModelError, Result};
use serde::{Deserialize, Serialize};

/// ACT's options. The defaults here are LeRobot's; `configs/policy/act.toml` has those of our experiments.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// actions predicted at once (LeRobot: `chunk_size`)
    pub action_horizon: usize,
    /// layer norm before each branch instead of after it
    pub pre_norm: bool,
    /// width
    pub dim_model: usize,
    /// attention heads
    pub n_heads: usize,
    /// hidden width of the feed-forward layers
    pub dim_feedforward: usize,
    /// activation of the feed-forward layers
    pub feedforward_activation: Activation,
    /// encoder layers
    pub n_encoder_layers: usize,
    /// decoder layers
    pub n_decoder_layers: usize,
    /// train with the VAE's latent
    pub use_vae: bool,
    /// width of the latent
    pub latent_dim: usize,
    /// layers of the VAE encoder
    pub n_vae_encoder_layers: usize,
    /// dropout probability
    pub dropout: f64,
    /// weight of the KL term
    pub kl_weight: f64,
    /// image encoder; absent without cameras
    #[serde(skip_serializing_if = "Option::is_none")]
    pub vision: Option<VisionConfig>,
    /// auxiliary loss on which entity was taken, from the encoder's output
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pointer: Option<PointerConfig>,
    /// auxiliary loss on `data.auxiliary_keys`
    #[serde(skip_serializing_if = "Option::is_none")]
    pub auxiliary: Option<AuxiliaryConfig>,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            action_horizon: 100,
            pre_norm: false,
            dim_model: 512,
            n_heads: 8,
            dim_feedforward: 3200,
            feedforward_activation: Activation::Relu,
            n_encoder_layers: 4,
            n_decoder_layers: 1,
            use_vae: true,
            latent_dim: 32,
            n_vae_encoder_layers: 4,
            dropout: 0.1,
            kl_weight: 10.0,
            vision: None,
            pointer: None,
            auxiliary: None,
        }
    }
}

impl Config {
    /// Of all transformer layers.
    pub(super) fn shape(&self) -> Shape {
        Shape {
            dim: self.dim_model,
            heads: self.n_heads,
            hidden: self.dim_feedforward,
            activation: self.feedforward_activation,
            dropout: self.dropout,
            pre_norm: self.pre_norm,
        }
    }

    /// How large the model will be.
    pub fn size(&self) -> Size {
        let (shape, horizon) = (self.shape(), self.action_horizon);
        let embeddings = Size { weights: horizon as f64 * self.dim_model as f64, activations: 0.0 };
        let vae = if self.use_vae { shape.size(1, horizon) * self.n_vae_encoder_layers } else { Size::default() };
        shape.size(1, 2) * self.n_encoder_layers + shape.size(2, horizon) * self.n_decoder_layers + vae + embeddings
    }

    /// Checks that a model with this configuration can exist.
    ///
    /// # Errors
    /// The first field that makes it impossible.
    pub fn validate(&self) -> Result<()> {
        let refuse = |field: &'static str, found: String, expected: &str| {
            Err(ModelError::Config { model: "act", field, found, expected: expected.to_string() })
        };
        for (field, value) in [
            ("action_horizon", self.action_horizon),
            ("dim_model", self.dim_model),
            ("n_heads", self.n_heads),
            ("dim_feedforward", self.dim_feedforward),
            ("n_encoder_layers", self.n_encoder_layers),
            ("n_decoder_layers", self.n_decoder_layers),
            ("latent_dim", self.latent_dim),
        ] {
            if value == 0 {
                return refuse(field, value.to_string(), "at least 1");
            }
        }
        if self.use_vae && self.n_vae_encoder_layers == 0 {
            return refuse("n_vae_encoder_layers", "0".to_string(), "at least 1 with use_vae");
        }
        if !self.dim_model.is_multiple_of(self.n_heads) {
            return refuse("n_heads", self.n_heads.to_string(), &format!("a divisor of dim_model, {}", self.dim_model));
        }
        if !(0.0..1.0).contains(&self.dropout) {
            return refuse("dropout", self.dropout.to_string(), "at least 0 and below 1");
        }
        if !self.kl_weight.is_finite() || self.kl_weight < 0.0 {
            return refuse("kl_weight", self.kl_weight.to_string(), "a number from 0");
        }
        self.pointer.as_ref().map_or(Ok(()), |pointer| pointer.validate("act"))?;
        self.auxiliary.as_ref().map_or(Ok(()), |auxiliary| auxiliary.validate("act"))?;
        self.vision.as_ref().map_or(Ok(()), VisionConfig::validate)
    }
}
