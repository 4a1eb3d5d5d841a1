//! The processors' JSON: what LeRobot does before and after the network. `config.json` is `models::lerobot`'s.

use std::collections::BTreeMap;
use std::path::Path;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use results::files::read_file;
use zoo::ZooError;

/// More bytes than such a file has.
pub(super) const MOST_TEXT: u64 = 1 << 26;

/// A processor pipeline: what LeRobot does before or after the network.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Pipeline {
    pub name: String,
    pub steps: Vec<Step>,
}

#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Step {
    pub registry_name: String,
    #[serde(default)]
    pub config: Value,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub state_file: Option<String>,
}

/// The normalising step.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct NormaliserStep {
    pub eps: f64,
    /// Type and shape by name.
    pub features: Value,
    pub norm_map: BTreeMap<String, String>,
    /// The only observations that are normalised; all where none are named.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub normalize_observation_keys: Option<Vec<String>>,
}

/// Reads JSON or says which file is not what it should be.
pub(super) fn read<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T, ZooError> {
    let text = read_file(path, MOST_TEXT).map_err(ZooError::io("read", path))?;
    serde_json::from_slice(&text)
        .map_err(|e| ZooError::Malformed { path: path.to_owned(), reason: format!("not LeRobot's: {e}") })
}

/// An error of `models` about a file of LeRobot's.
pub(super) fn misfit(path: &Path) -> impl Fn(models::ModelError) -> ZooError {
    let path = path.to_owned();
    move |error| ZooError::Malformed { path: path.clone(), reason: error.to_string() }
}
