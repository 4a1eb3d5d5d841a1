//! The messages of worker protocol version 2, as the harness speaks it.
//!
//! A worker greets with [`Ready`] (or an error) unasked; every request after that carries an `id`
//! that its reply repeats.

use std::collections::BTreeMap;

use serde::{Deserialize, Deserializer, Serialize};

/// The protocol version that this program speaks.
pub const PROTOCOL: u32 = 2;

/// Which loop runs a control step inside the simulator.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Control {
    /// robosuite's own Python loop.
    Robosuite,
    /// The compiled loop of `crates/control`.
    Compiled,
    /// The loop of a simulator that has one only.
    Own,
}

impl Control {
    /// The word that names it on command lines and in results.
    pub fn as_str(self) -> &'static str {
        match self {
            Control::Robosuite => "robosuite",
            Control::Compiled => "compiled",
            Control::Own => "own",
        }
    }
}

impl std::fmt::Display for Control {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.as_str())
    }
}

impl std::str::FromStr for Control {
    type Err = String;
    fn from_str(word: &str) -> Result<Self, String> {
        match word {
            "robosuite" => Ok(Control::Robosuite),
            "compiled" => Ok(Control::Compiled),
            // what a simulator with one loop says of itself is nothing to ask for
            other => Err(format!("control {other:?}: expected \"robosuite\" or \"compiled\"")),
        }
    }
}

/// How able whoever shows demonstrations is.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Skill {
    /// The scripted expert as it is.
    #[default]
    Good,
    /// Every episode draws whether somebody good, middling or poor shows it.
    Mixed,
    /// Slow, hesitating, with detours and grasps that miss.
    Poor,
}

impl Skill {
    /// The word that names it on command lines, in files and to workers.
    pub fn as_str(self) -> &'static str {
        match self {
            Skill::Good => "good",
            Skill::Mixed => "mixed",
            Skill::Poor => "poor",
        }
    }

    /// Whether it is the usual one, which is left out of what is written.
    pub fn is_good(&self) -> bool {
        *self == Skill::Good
    }
}

impl std::fmt::Display for Skill {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.as_str())
    }
}

impl std::str::FromStr for Skill {
    type Err = String;
    fn from_str(word: &str) -> Result<Self, String> {
        match word {
            "good" => Ok(Skill::Good),
            "mixed" => Ok(Skill::Mixed),
            "poor" => Ok(Skill::Poor),
            other => Err(format!("skill {other:?}: expected \"good\", \"mixed\" or \"poor\"")),
        }
    }
}

/// The greeting of a worker: what it runs and what its environment looks like.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Ready {
    /// Protocol version; must be [`PROTOCOL`].
    pub protocol: u32,
    /// The simulator, by its name.
    pub simulator: String,
    /// The simulator's version under its name, and those of what it stands on: what a result depends on.
    pub versions: BTreeMap<String, String>,
    /// The task, as asked for.
    pub task: String,
    /// sha256 of the environment module's source, where one was named.
    #[serde(default)]
    pub module_sha256: Option<String>,
    /// sha256 of the environment's arguments, where they are not the task's usual ones.
    #[serde(default)]
    pub env_args_sha256: Option<String>,
    /// The environment's class name.
    pub env_name: String,
    /// The loop really used, which may differ from the one asked for.
    pub control: Control,
    /// Control steps per simulated second.
    pub control_freq: f64,
    /// The task's usual cap on an episode, in control steps.
    pub max_steps: usize,
    /// Number of action values.
    pub action_dim: usize,
    /// Smallest action, per value; minus infinity, null on the wire, where it has no limit.
    #[serde(deserialize_with = "lower")]
    pub action_low: Vec<f64>,
    /// Largest action, per value; infinity, null on the wire, where it has no limit.
    #[serde(deserialize_with = "upper")]
    pub action_high: Vec<f64>,
    /// Observation keys with their shapes.
    pub observations: BTreeMap<String, Vec<usize>>,
    /// What an episode passes before the task is solved, in order, where that is known.
    #[serde(default)]
    pub stages: Vec<String>,
    /// Which kernels the worker's linear algebra runs, such as `openblas Haswell`, where that can be told: the last bits of
    /// what is computed depend on them.
    #[serde(default)]
    pub kernels: Option<String>,
    /// What draws the worker's pictures, where it draws any: another device or driver draws others.
    #[serde(default)]
    pub renderer: Option<String>,
    /// robomimic's `env_args` of this environment.
    #[serde(default)]
    pub env_args: serde_json::Value,
    /// SHA-256 by package of the sources that were imported to simulate: the simulator, what it stands on, the harness.
    #[serde(default)]
    pub sources: BTreeMap<String, String>,
}

/// Limits with `unlimited` for null: JSON has no infinity.
fn limits<'de, D: Deserializer<'de>>(deserializer: D, unlimited: f64) -> Result<Vec<f64>, D::Error> {
    let found = Vec::<Option<f64>>::deserialize(deserializer)?;
    Ok(found.into_iter().map(|limit| limit.unwrap_or(unlimited)).collect())
}

fn lower<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<f64>, D::Error> {
    limits(deserializer, f64::NEG_INFINITY)
}

fn upper<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<f64>, D::Error> {
    limits(deserializer, f64::INFINITY)
}

impl Ready {
    /// The simulator's own version.
    pub fn simulator_version(&self) -> Option<&str> {
        self.versions.get(&self.simulator).map(String::as_str)
    }
}

/// What we ask of a worker.
#[derive(Debug, Clone, Serialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub(crate) enum Request<'a> {
    Reset {
        id: u64,
        seed: u64,
    },
    Step {
        id: u64,
    },
    Expert {
        id: u64,
        seed: u64,
        split: &'a str,
        #[serde(skip_serializing_if = "Option::is_none")]
        expert: Option<&'a str>,
        #[serde(skip_serializing_if = "Skill::is_good")]
        skill: Skill,
    },
    Extract {
        id: u64,
        model_file: &'a str,
        #[serde(skip_serializing_if = "is_empty")]
        ep_meta: &'a serde_json::Value,
    },
    Render {
        id: u64,
        camera: &'a str,
        size: [usize; 2],
    },
    Close {
        id: u64,
    },
}

impl Request<'_> {
    /// The request's name, for messages about it.
    pub(crate) fn name(&self) -> &'static str {
        match self {
            Request::Reset { .. } => "reset",
            Request::Step { .. } => "step",
            Request::Expert { .. } => "expert",
            Request::Extract { .. } => "extract",
            Request::Render { .. } => "render",
            Request::Close { .. } => "close",
        }
    }
}

/// Whether an environment has nothing to read from it.
fn is_empty(ep_meta: &serde_json::Value) -> bool {
    ep_meta.as_object().is_none_or(serde_json::Map::is_empty)
}

/// What a worker answers.
#[derive(Debug, Clone, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub(crate) enum Reply {
    Ready(Box<Ready>),
    Reset {
        id: u64,
        fingerprint: String,
        /// The group of episodes that this one belongs to, where the task has groups.
        #[serde(default)]
        group: Option<String>,
        /// What an environment says of the episode: `lang` is the instruction, in words.
        #[serde(default)]
        ep_meta: serde_json::Value,
        /// How long the observation's pictures took, in milliseconds.
        #[serde(default)]
        drawing_ms: f64,
    },
    Step {
        id: u64,
        success: bool,
        /// In a word why the task can no longer be solved, where the environment says so.
        #[serde(default)]
        failure: Option<String>,
        #[serde(default)]
        drawing_ms: f64,
        /// Which share of its way the episode has come, where stages are known.
        #[serde(default)]
        progress: Option<f64>,
    },
    Expert(EpisodeReply),
    Extract(EpisodeReply),
    Render {
        id: u64,
    },
    Closed {
        #[serde(default)]
        id: Option<u64>,
    },
    Error {
        #[serde(default)]
        id: Option<u64>,
        kind: String,
        message: String,
    },
}

/// The message part of a whole recorded episode.
#[derive(Debug, Clone, Deserialize)]
pub(crate) struct EpisodeReply {
    pub id: u64,
    #[serde(default)]
    pub success: bool,
    #[serde(default)]
    pub steps: Option<usize>,
    #[serde(default)]
    pub attrs: BTreeMap<String, serde_json::Value>,
    /// In a word why the task could no longer be solved, where that ended the episode.
    #[serde(default)]
    pub failure: Option<String>,
    /// Which share of its way it came, where stages are known.
    #[serde(default)]
    pub progress: Option<f64>,
}

impl Reply {
    /// The reply's name and the request that it answers.
    pub(crate) fn answers(&self) -> (&'static str, Option<u64>) {
        match self {
            Reply::Ready(_) => ("ready", None),
            Reply::Reset { id, .. } => ("reset", Some(*id)),
            Reply::Step { id, .. } => ("step", Some(*id)),
            Reply::Expert(EpisodeReply { id, .. }) => ("expert", Some(*id)),
            Reply::Extract(EpisodeReply { id, .. }) => ("extract", Some(*id)),
            Reply::Render { id } => ("render", Some(*id)),
            Reply::Closed { id } => ("closed", *id),
            Reply::Error { id, .. } => ("error", *id),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn requests_are_written_as_the_protocol_says() {
        let text = |request: &Request<'_>| serde_json::to_string(request).unwrap();
        assert_eq!(text(&Request::Reset { id: 1, seed: 10000 }), r#"{"type":"reset","id":1,"seed":10000}"#);
        assert_eq!(text(&Request::Step { id: 2 }), r#"{"type":"step","id":2}"#);
        assert_eq!(
            text(&Request::Expert { id: 6, seed: 7, split: "evaluation", expert: None, skill: Skill::Good }),
            r#"{"type":"expert","id":6,"seed":7,"split":"evaluation"}"#
        );
        assert_eq!(
            text(&Request::Expert { id: 7, seed: 8, split: "demonstration", expert: None, skill: Skill::Mixed }),
            r#"{"type":"expert","id":7,"seed":8,"split":"demonstration","skill":"mixed"}"#
        );
        assert_eq!(
            text(&Request::Render { id: 3, camera: "agentview", size: [84, 96] }),
            r#"{"type":"render","id":3,"camera":"agentview","size":[84,96]}"#
        );
        let (none, some) = (serde_json::Value::Null, serde_json::json!({"order": ["red"]}));
        assert_eq!(
            text(&Request::Extract { id: 5, model_file: "m", ep_meta: &none }),
            r#"{"type":"extract","id":5,"model_file":"m"}"#
        );
        assert_eq!(
            text(&Request::Extract { id: 6, model_file: "m", ep_meta: &some }),
            r#"{"type":"extract","id":6,"model_file":"m","ep_meta":{"order":["red"]}}"#
        );
        assert_eq!(text(&Request::Close { id: 4 }), r#"{"type":"close","id":4}"#);
    }

    #[test]
    fn replies_are_read_as_the_protocol_says() {
        let reply: Reply = serde_json::from_str(r#"{"type":"step","id":7,"success":false}"#).unwrap();
        assert_eq!(reply.answers(), ("step", Some(7)));
        let reply: Reply = serde_json::from_str(r#"{"type":"error","kind":"unknown_task","message":"no"}"#).unwrap();
        assert_eq!(reply.answers(), ("error", None));
        assert!(serde_json::from_str::<Reply>(r#"{"type":"stepp","id":7}"#).is_err());
        assert!(serde_json::from_str::<Reply>(r#"{"type":"step","id":7}"#).is_err());
    }

    #[test]
    fn control_words_round_trip() {
        for control in [Control::Robosuite, Control::Compiled] {
            assert_eq!(control.as_str().parse::<Control>().unwrap(), control);
        }
        for word in ["fast", Control::Own.as_str()] {
            assert!(word.parse::<Control>().unwrap_err().contains("expected"));
        }
    }
}
