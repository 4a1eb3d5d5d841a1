//! ACTRM's options.

use crate::encoders::VisionConfig;
use crate::layers::{Activation, AuxiliaryConfig, GridConfig, PointerConfig, Shape};
use crate::models::act;
use nn::Size;
use nn::{ModelError, Result};
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// What the recursion refines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Over {
    /// The action chunk.
    #[default]
    Actions,
    /// The encoded observation.
    Memory,
    /// The observation's tokens.
    Tokens,
}

impl Over {
    /// Its name in configurations.
    pub fn name(self) -> &'static str {
        match self {
            Self::Actions => "actions",
            Self::Memory => "memory",
            Self::Tokens => "tokens",
        }
    }
}

/// Starting the answer from the previous query's, moved on by the actions executed since.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WarmStart {
    /// Standard deviation of the noise on the observation from whose answer half of each batch starts in training (normalised units).
    #[serde(default = "default_noise")]
    pub noise: f64,
}

fn default_noise() -> f64 {
    0.1
}

/// Options of the recursion.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ReasoningConfig {
    /// what is refined
    pub over: Over,
    /// latent reasoning tokens (`over = "actions"`)
    pub tokens: usize,
    /// layers of the shared block
    pub n_layers: usize,
    /// hidden width of the shared block's feed-forward part; absent: half of `dim_feedforward`, with `over = "memory"` all of it
    pub dim_feedforward: Option<usize>,
    /// rounds per supervision step; the last one has gradients (`over = "tokens"`: 1)
    pub h_cycles: usize,
    /// updates of the reasoning, or of the tokens, per round
    pub l_cycles: usize,
    /// refinement steps in training, each with a loss (`over = "memory"`: the largest number that is sampled)
    pub supervision_steps: usize,
    /// largest number of refinement steps at inference; absent: as in training
    pub max_steps: Option<usize>,
    /// stop once the halting head's probability exceeds this; 1 never stops
    pub halt_threshold: f64,
    /// stop once the chunk's mean absolute change falls below this (normalised units); 0 never stops
    pub change_threshold: f64,
    /// stop after this many milliseconds
    pub budget_ms: Option<f64>,
    /// weight of the halting head's loss
    pub halt_weight: f64,
    /// the halting head's target: a step helps if it lowers the error by at least this share
    pub halt_margin: f64,
    /// start from the previous query's answer (`over = "actions"`)
    pub warm_start: Option<WarmStart>,
    /// a block with its own weights for every refinement step instead of a shared one (not `over = "memory"`); further steps at
    /// inference apply the last block
    #[serde(skip_serializing_if = "is_default")]
    pub untied: bool,
    /// standard deviation of the noise from which refinement starts in training; at inference it starts from zero
    /// (`over = "tokens"`: the noise is added to the observation's tokens)
    #[serde(skip_serializing_if = "is_default")]
    pub start_noise: f64,
    /// whether every refinement step has a loss; otherwise only the last one has
    #[serde(skip_serializing_if = "is_true")]
    pub deep_supervision: bool,
    /// recursion by 3x3 convolutions over a grid of cells instead of attention among all tokens (`over = "tokens"`)
    #[serde(skip_serializing_if = "Option::is_none")]
    pub grid: Option<GridConfig>,
}

// settings that came later are left out where they change nothing, so that a configuration keeps its text

fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

fn is_true(value: &bool) -> bool {
    *value
}

impl Default for ReasoningConfig {
    fn default() -> Self {
        Self {
            over: Over::Actions,
            tokens: 4,
            n_layers: 1,
            dim_feedforward: None,
            h_cycles: 1,
            l_cycles: 1,
            supervision_steps: 3,
            max_steps: None,
            halt_threshold: 0.9,
            change_threshold: 0.005,
            budget_ms: None,
            halt_weight: 0.1,
            halt_margin: 0.02,
            warm_start: None,
            untied: false,
            start_noise: 0.0,
            deep_supervision: true,
            grid: None,
        }
    }
}

impl ReasoningConfig {
    /// The original's recursion over the memory: 3 x 6 cycles of 4 layers, 16 supervision steps.
    pub fn original() -> Self {
        Self {
            over: Over::Memory,
            n_layers: 4,
            h_cycles: 3,
            l_cycles: 6,
            supervision_steps: 16,
            halt_threshold: 1.0,
            change_threshold: 0.0,
            ..Self::default()
        }
    }

    /// Most steps at inference.
    pub fn max_steps(&self) -> usize {
        self.max_steps.unwrap_or(self.supervision_steps)
    }

    /// Blocks with weights of their own.
    pub fn blocks(&self) -> usize {
        if self.untied { self.supervision_steps } else { 1 }
    }

    /// The layers of the block that supervision step `step`, from 0, applies.
    pub(super) fn layers_of(&self, step: usize) -> Range<usize> {
        let first = step.min(self.blocks() - 1) * self.n_layers;
        first..first + self.n_layers
    }
}

/// Options of ACTRM; names shared with ACT mean the same.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// actions predicted at once
    pub action_horizon: usize,
    /// width
    pub dim_model: usize,
    /// attention heads
    pub n_heads: usize,
    /// hidden width of the feed-forward layers outside the shared block
    pub dim_feedforward: usize,
    /// activation of the feed-forward layers
    pub feedforward_activation: Activation,
    /// layers that encode the memory before the recursion (`over = "actions"`)
    pub n_memory_layers: usize,
    /// layers of the decoder (not `over = "actions"`)
    pub n_decoder_layers: usize,
    /// train with the VAE's latent
    pub use_vae: bool,
    /// width of the latent
    pub latent_dim: usize,
    /// layers of the VAE encoder
    pub n_vae_encoder_layers: usize,
    /// dropout probability outside the recursion
    pub dropout: f64,
    /// weight of the KL term
    pub kl_weight: f64,
    /// the recursion
    pub reasoning: ReasoningConfig,
    /// image encoder; absent without cameras
    #[serde(skip_serializing_if = "Option::is_none")]
    pub vision: Option<VisionConfig>,
    /// auxiliary loss of every refinement step on which entity was taken (`over = "tokens"`)
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pointer: Option<PointerConfig>,
    /// auxiliary loss on `data.auxiliary_keys` (`over = "actions"` with `n_memory_layers` of 1 or more)
    #[serde(skip_serializing_if = "Option::is_none")]
    pub auxiliary: Option<AuxiliaryConfig>,
}

impl Default for Config {
    fn default() -> Self {
        let act = act::Config::default();
        Self {
            action_horizon: act.action_horizon,
            dim_model: act.dim_model,
            n_heads: act.n_heads,
            dim_feedforward: act.dim_feedforward,
            feedforward_activation: act.feedforward_activation,
            n_memory_layers: 1,
            n_decoder_layers: 1,
            use_vae: act.use_vae,
            latent_dim: act.latent_dim,
            n_vae_encoder_layers: 1,
            dropout: act.dropout,
            kl_weight: act.kl_weight,
            reasoning: ReasoningConfig::default(),
            vision: None,
            pointer: None,
            auxiliary: None,
        }
    }
}

impl Config {
    /// Of the layers outside the recursion.
    pub(super) fn shape(&self) -> Shape {
        Shape {
            dim: self.dim_model,
            heads: self.n_heads,
            hidden: self.dim_feedforward,
            activation: self.feedforward_activation,
            dropout: self.dropout,
            pre_norm: false,
        }
    }

    /// Of the shared block over tokens: pre-norm, without dropout.
    pub(super) fn block_shape(&self) -> Shape {
        Shape { hidden: self.block_feedforward(), dropout: 0.0, pre_norm: true, ..self.shape() }
    }

    /// The layers outside the shared block, as ACT's: what is checked there is checked here.
    fn layers(&self) -> act::Config {
        act::Config {
            action_horizon: self.action_horizon,
            pre_norm: false,
            dim_model: self.dim_model,
            n_heads: self.n_heads,
            dim_feedforward: self.dim_feedforward,
            feedforward_activation: self.feedforward_activation,
            n_encoder_layers: self.n_memory_layers.max(1),
            n_decoder_layers: self.n_decoder_layers.max(1),
            use_vae: self.use_vae,
            latent_dim: self.latent_dim,
            n_vae_encoder_layers: self.n_vae_encoder_layers,
            dropout: self.dropout,
            kl_weight: self.kl_weight,
            vision: self.vision.clone(),
            pointer: self.pointer.clone(),
            auxiliary: self.auxiliary.clone(),
        }
    }

    /// How large the model will be.
    pub fn size(&self) -> Size {
        let block = Shape { hidden: self.block_feedforward(), ..self.shape() };
        // over the memory as many as there are inputs, which are not known here: two at least
        let tokens = if self.reasoning.over == Over::Memory { 2 } else { self.action_horizon };
        let block = block.size(1, tokens) * self.reasoning.n_layers;
        // weights are shared by all steps unless untied, the last round of each keeps its activations
        let weights = block.weights * self.reasoning.blocks() as f64;
        let steps = Size { weights, ..block * self.reasoning.supervision_steps };
        // over actions there is no decoder, over the memory no encoder beside the block
        let (encoder, decoder) = match self.reasoning.over {
            Over::Actions => (self.n_memory_layers, 0),
            Over::Memory | Over::Tokens => (0, self.n_decoder_layers),
        };
        let around = act::Config { n_encoder_layers: encoder, n_decoder_layers: decoder, ..self.layers() };
        around.size() + steps
    }

    /// Hidden width of the shared block's dense part.
    pub fn block_feedforward(&self) -> usize {
        let usual = match self.reasoning.over {
            Over::Memory => self.dim_feedforward,
            Over::Actions | Over::Tokens => self.dim_feedforward.div_ceil(2),
        };
        self.reasoning.dim_feedforward.unwrap_or(usual)
    }

    /// Checks that a model with this configuration can exist.
    ///
    /// # Errors
    /// The first field that makes it impossible.
    pub fn validate(&self) -> Result<()> {
        self.layers().validate()?;
        let refuse = |field: &'static str, found: String, expected: &str| {
            let expected = expected.to_string();
            Err(ModelError::Config { model: "actrm", field, found, expected })
        };
        let r = &self.reasoning;
        let decoder = if r.over == Over::Actions { 1 } else { self.n_decoder_layers };
        for (field, value) in [
            ("n_decoder_layers", decoder),
            ("reasoning.tokens", r.tokens),
            ("reasoning.n_layers", r.n_layers),
            ("reasoning.dim_feedforward", self.block_feedforward()),
            ("reasoning.h_cycles", r.h_cycles),
            ("reasoning.l_cycles", r.l_cycles),
            ("reasoning.supervision_steps", r.supervision_steps),
            ("reasoning.max_steps", r.max_steps()),
        ] {
            if value == 0 {
                return refuse(field, value.to_string(), "at least 1");
            }
        }
        if !(0.0..=1.0).contains(&r.halt_threshold) {
            return refuse("reasoning.halt_threshold", r.halt_threshold.to_string(), "0 to 1");
        }
        for (field, value) in [
            ("reasoning.change_threshold", r.change_threshold),
            ("reasoning.halt_weight", r.halt_weight),
            ("reasoning.halt_margin", r.halt_margin),
            ("reasoning.budget_ms", r.budget_ms.unwrap_or(0.0)),
            ("reasoning.start_noise", r.start_noise),
            ("reasoning.warm_start.noise", r.warm_start.map_or(0.0, |w| w.noise)),
        ] {
            if !(value.is_finite() && value >= 0.0) {
                return refuse(field, value.to_string(), "a finite number, at least 0");
            }
        }
        if r.warm_start.is_some() && r.over != Over::Actions {
            let expected = format!("absent with over = \"{}\"", r.over.name());
            return refuse("reasoning.warm_start", "present".into(), &expected);
        }
        if r.h_cycles > 1 && r.over == Over::Tokens {
            return refuse("reasoning.h_cycles", r.h_cycles.to_string(), "1 with over = \"tokens\"");
        }
        if let Some(pointer) = self.pointer.as_ref().filter(|_| r.over != Over::Tokens) {
            return refuse("pointer", format!("among {}", pointer.among), "absent but for reasoning.over = \"tokens\"");
        }
        if let Some(auxiliary) =
            self.auxiliary.as_ref().filter(|_| r.over != Over::Actions || self.n_memory_layers == 0)
        {
            let expected = "absent but for reasoning.over = \"actions\" with n_memory_layers";
            return refuse("auxiliary", format!("weight {}", auxiliary.weight), expected);
        }
        if let Some(grid) = &r.grid {
            grid.validate("actrm")?;
            if r.over != Over::Tokens || self.pointer.is_some() {
                let expected = "absent but for over = \"tokens\" without a pointer";
                return refuse("reasoning.grid", format!("among {}", grid.among), expected);
            }
        }
        if r.untied && r.over == Over::Memory {
            return refuse("reasoning.untied", "true".into(), "false with over = \"memory\"");
        }
        if r.untied && r.h_cycles > 1 && !r.deep_supervision {
            // a round before the last has no gradient, so that only the last block would learn
            let expected = "false with h_cycles above 1 and without deep supervision";
            return refuse("reasoning.untied", "true".into(), expected);
        }
        if r.start_noise > 0.0 && (r.over == Over::Memory || r.warm_start.is_some()) {
            let expected = "0 with over = \"memory\" or a warm start";
            return refuse("reasoning.start_noise", r.start_noise.to_string(), expected);
        }
        Ok(())
    }
}
