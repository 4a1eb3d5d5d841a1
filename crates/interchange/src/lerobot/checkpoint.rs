//! The policies that LeRobot has too: what their checkpoints say, whichever of them it is.

use std::collections::BTreeMap;

use candle_core::Tensor;
use models::act::lerobot::{self as act, LerobotAct};
use models::diffusion::lerobot::{self as diffusion, LerobotDiffusion};
use models::{ModelError, NormMode, Params, PolicyConfig, Signature};
use serde_json::Value;

/// Tensors by name.
type Tensors = BTreeMap<String, Tensor>;

/// What a `config.json` says.
pub(super) struct Checkpoint {
    pub policy: PolicyConfig,
    pub signature: Signature,
    pub n_action_steps: usize,
    pub temporal_ensemble: Option<f64>,
    /// normalisation by feature
    pub modes: BTreeMap<String, NormMode>,
}

impl Checkpoint {
    /// Reads a `config.json` of any type that we have.
    pub fn read(config: &Value) -> Result<Self, ModelError> {
        let kind = config.get("type").and_then(Value::as_str).unwrap_or("absent");
        if !["act", "diffusion"].contains(&kind) {
            let (found, expected) = (kind.to_owned(), "act or diffusion".to_owned());
            return Err(ModelError::Config { model: "LeRobot", field: "type", found, expected });
        }
        if kind == "diffusion" {
            let LerobotDiffusion { config, signature, n_action_steps, modes } = diffusion::read_config(config)?;
            let policy = PolicyConfig::Diffusion(config);
            return Ok(Self { policy, signature, n_action_steps, temporal_ensemble: None, modes });
        }
        let LerobotAct { config, signature, n_action_steps, temporal_ensemble_coeff, modes } =
            act::read_config(config)?;
        let policy = PolicyConfig::Act(config);
        Ok(Self { policy, signature, n_action_steps, temporal_ensemble: temporal_ensemble_coeff, modes })
    }

    /// The `config.json` of it; nothing for a policy that LeRobot does not have.
    pub fn write(&self) -> Option<Result<Value, ModelError>> {
        let (signature, n_action_steps, modes) = (self.signature.clone(), self.n_action_steps, self.modes.clone());
        Some(match self.policy.clone() {
            PolicyConfig::Act(config) => act::write_config(&LerobotAct {
                config,
                signature,
                n_action_steps,
                temporal_ensemble_coeff: self.temporal_ensemble,
                modes,
            }),
            PolicyConfig::Diffusion(config) => {
                diffusion::write_config(&LerobotDiffusion { config, signature, n_action_steps, modes })
            }
            _ => return None,
        })
    }

    /// Loads LeRobot's tensors, and from its statistics what normalises pictures under the modes of `mapping`.
    pub fn load(
        &self,
        params: &Params,
        tensors: &Tensors,
        mapping: &BTreeMap<String, String>,
        statistics: &Tensors,
    ) -> Result<(), ModelError> {
        match &self.policy {
            PolicyConfig::Act(config) => {
                act::load_tensors(params, config, tensors)?;
                act::load_statistics(params, &self.signature, mapping, statistics)
            }
            _ => diffusion::load_tensors(params, tensors),
        }
    }

    /// The tensors under LeRobot's names, and the statistics that are not the normaliser's.
    pub fn tensors(&self, params: &Params) -> Result<(Tensors, Tensors), ModelError> {
        match &self.policy {
            PolicyConfig::Act(config) => {
                Ok((act::tensors_out(params, config)?, act::statistics_out(params, &self.signature)?))
            }
            _ => Ok((diffusion::tensors_out(params), BTreeMap::new())),
        }
    }
}
