//! BC-RNN's options.

use crate::encoders::VisionConfig;
use crate::layers::Cell;
use nn::Size;
use nn::{ModelError, Result};
use serde::{Deserialize, Serialize};

/// Options with robomimic's names' meaning and its defaults.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// steps of a training sequence, after which the state is also reset at inference (robomimic: `rnn.horizon` and
    /// `train.seq_length`); must equal `data.n_obs_steps`
    pub action_horizon: usize,
    /// dimension of a layer's state (robomimic: `rnn.hidden_dim`)
    pub hidden_dim: usize,
    /// recurrent layers
    pub n_layers: usize,
    /// recurrent cell (robomimic: `rnn.rnn_type`)
    #[serde(skip_serializing_if = "is_lstm")]
    pub cell: Cell,
    /// components of the Gaussian mixture
    pub n_modes: usize,
    /// smallest standard deviation of a component in training
    pub min_std: f64,
    /// image encoder; absent without cameras
    #[serde(skip_serializing_if = "Option::is_none")]
    pub vision: Option<VisionConfig>,
}

// it came later: left out where it is as before, so that a configuration keeps its text
#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde hands over a reference")]
fn is_lstm(cell: &Cell) -> bool {
    *cell == Cell::Lstm
}

impl Default for Config {
    fn default() -> Self {
        Self {
            action_horizon: 10,
            hidden_dim: 400,
            n_layers: 2,
            cell: Cell::Lstm,
            n_modes: 5,
            min_std: 1e-4,
            vision: None,
        }
    }
}

impl Config {
    /// How large the model will be, without what depends on observation and action.
    pub fn size(&self) -> Size {
        let hidden = self.hidden_dim as f64;
        let gates = self.cell.gates() as f64;
        let recurrent = gates * hidden * hidden * (2.0 * self.n_layers as f64 - 1.0);
        let biases = 2.0 * gates * hidden * self.n_layers as f64;
        Size {
            weights: recurrent + biases,
            activations: self.action_horizon as f64 * self.n_layers as f64 * 10.0 * hidden,
        }
    }

    /// Checks that a model with this configuration can exist.
    ///
    /// # Errors
    /// The first field that makes it impossible.
    pub fn validate(&self) -> Result<()> {
        let refuse = |field: &'static str, found: String, expected: &str| {
            Err(ModelError::Config { model: "bc_rnn", field, found, expected: expected.to_string() })
        };
        for (field, value) in [
            ("action_horizon", self.action_horizon),
            ("hidden_dim", self.hidden_dim),
            ("n_layers", self.n_layers),
            ("n_modes", self.n_modes),
        ] {
            if value == 0 {
                return refuse(field, "0".to_string(), "at least 1");
            }
        }
        if !(self.min_std.is_finite() && self.min_std > 0.0) {
            return refuse("min_std", self.min_std.to_string(), "a positive number");
        }
        self.vision.as_ref().map_or(Ok(()), VisionConfig::validate)
    }
}
