//! Checkpoints of LeRobot 0.3 and before: their statistics are buffers among the weights, `normalize_inputs.buffer_<feature>.<statistic>`
//! with the dots of the feature's name as underscores. LeRobot's own `migrate_policy_normalization` makes the later form of them.

use std::collections::BTreeMap;

use candle_core::Tensor;
use models::{ACTION, Signature};
use serde_json::{Value, json};

use super::config::NormaliserStep;

/// Where such a checkpoint holds statistics: of what goes in, of actions in training, of actions as they come out.
const PREFIXES: [&str; 3] = ["normalize_inputs.buffer_", "normalize_targets.buffer_", "unnormalize_outputs.buffer_"];

/// The statistics of what goes in and of what comes out, each `<feature>.<statistic>`.
pub(super) struct Statistics {
    pub before: BTreeMap<String, Tensor>,
    pub after: BTreeMap<String, Tensor>,
}

/// Takes the statistics out of `weights`; `None` where there are none among them. A buffer of a feature that `signature` lacks
/// stays, so that it is named as an extra tensor.
pub(super) fn take(weights: &mut BTreeMap<String, Tensor>, signature: &Signature) -> Option<Statistics> {
    let features = signature.observation.iter().map(|spec| spec.name.as_str()).chain([ACTION]);
    let features: BTreeMap<String, &str> = features.map(|name| (name.replace('.', "_"), name)).collect();
    let mut found = PREFIXES.map(|_| BTreeMap::new());
    let named: Vec<String> = weights.keys().cloned().collect();
    for name in named {
        let Some((place, rest)) =
            PREFIXES.iter().enumerate().find_map(|(place, prefix)| Some((place, name.strip_prefix(prefix)?)))
        else {
            continue;
        };
        let Some((buffer, statistic)) = rest.rsplit_once('.') else { continue };
        let Some(feature) = features.get(buffer) else { continue };
        if let Some(tensor) = weights.remove(&name) {
            found[place].insert(format!("{feature}.{statistic}"), tensor);
        }
    }
    let [before, _, after] = found;
    (!before.is_empty() || !after.is_empty()).then_some(Statistics { before, after })
}

/// The normalising step that such a checkpoint's `config.json` stands for.
///
/// # Errors
/// A `normalization_mapping` that is none.
pub(super) fn step(config: &Value) -> Result<NormaliserStep, serde_json::Error> {
    let mapping = config.get("normalization_mapping").filter(|mapping| !mapping.is_null()).cloned();
    // LeRobot's defaults
    let default = match config.get("type").and_then(Value::as_str) {
        Some("diffusion") => json!({"VISUAL": "MEAN_STD", "STATE": "MIN_MAX", "ACTION": "MIN_MAX"}),
        _ => json!({"VISUAL": "MEAN_STD", "STATE": "MEAN_STD", "ACTION": "MEAN_STD"}),
    };
    let norm_map = serde_json::from_value(mapping.unwrap_or(default))?;
    Ok(NormaliserStep { eps: 1e-8, features: Value::Null, norm_map, normalize_observation_keys: None })
}
