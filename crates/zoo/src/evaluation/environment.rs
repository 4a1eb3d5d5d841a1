//! The environment that an entry's policy acts in: what simulators are started for.

use std::path::PathBuf;

use rollout::{Python, WorkerSpec};
use serde_json::Value;

use crate::ZooError;
use crate::entry::{CamerasMeta, EntryMeta};

/// An environment. Entries of equal ones share simulators.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Environment {
    /// The task.
    pub task: String,
    /// The module of the user's that registers it.
    pub env_module: Option<String>,
    /// robomimic's arguments of it, as JSON text.
    env_args: Option<String>,
    /// The cameras that are looked through.
    pub cameras: Option<CamerasMeta>,
}

impl Environment {
    /// The environment of an entry's demonstrations, unless another task or another module is named.
    ///
    /// # Errors
    /// As [`EntryMeta::cameras`].
    pub fn of(meta: &EntryMeta, task: Option<&str>, env_module: Option<&str>) -> Result<Self, ZooError> {
        let recorded = || meta.env_module.as_ref().map(|module| module.name.clone());
        let env_module = env_module.map(str::to_owned).or_else(recorded);
        // another task's environment has arguments of its own
        let other = task.filter(|task| *task != meta.task);
        let env_args = match other {
            Some(_) => None,
            None => meta.env_args.as_ref().map(serde_json::Value::to_string),
        };
        Ok(Self { task: other.unwrap_or(&meta.task).to_owned(), env_module, env_args, cameras: meta.cameras()? })
    }

    /// A task's usual environment, seen through `cameras`.
    pub fn usual(task: &str, env_module: Option<&str>, cameras: Option<CamerasMeta>) -> Self {
        Self { task: task.to_owned(), env_module: env_module.map(str::to_owned), env_args: None, cameras }
    }

    /// The same with other robots, each with its usual controller: `UR5e`, or a name for each arm.
    #[must_use]
    pub fn with_robots(mut self, robots: &[String]) -> Self {
        self.env_args = Some(with_robots(&self.task, self.env_args.as_deref(), robots).to_string());
        self
    }

    /// What a worker for it is to be.
    pub fn worker(&self, python: Python, harness: PathBuf) -> WorkerSpec {
        let mut spec = WorkerSpec::new(python, harness, &self.task);
        spec.env_module.clone_from(&self.env_module);
        let env_args = self.env_args.as_deref().map(|text| serde_json::from_str(text).expect("it was a JSON value"));
        let mut spec = spec.recorded(env_args.as_ref());
        if let Some(cameras) = &self.cameras {
            spec.cameras.clone_from(&cameras.names);
            (spec.image_size, spec.fast_render) = (cameras.size, cameras.fast_render);
        }
        spec
    }
}

/// robomimic's arguments of the environment of `task` with other robots; `env_args` are those that it has otherwise, as JSON.
fn with_robots(task: &str, env_args: Option<&str>, robots: &[String]) -> Value {
    let recorded = env_args.and_then(|text| serde_json::from_str(text).ok());
    let recorded = recorded.filter(|args: &Value| args.get("env_kwargs").is_some_and(Value::is_object));
    let mut args = recorded.unwrap_or_else(|| rollout::robots_of(task, robots));
    args["env_kwargs"]["robots"] = rollout::robots_of(task, robots)["env_kwargs"]["robots"].clone();
    if let Some(kwargs) = args["env_kwargs"].as_object_mut() {
        // those of the robot that it had
        kwargs.remove("controller_configs");
    }
    args
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn other_robots_have_their_own_controllers() {
        let names = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect::<Vec<_>>();
        let usual = with_robots("Lift", None, &names(&["UR5e"]));
        assert_eq!(usual["env_kwargs"], serde_json::json!({"robots": "UR5e"}));
        let recorded =
            r#"{"type": 1, "env_kwargs": {"robots": "Panda", "controller_configs": {}, "control_freq": 10}}"#;
        let found = with_robots("TwoArmLift", Some(recorded), &names(&["UR5e", "Panda"]));
        assert_eq!(found["env_kwargs"], serde_json::json!({"robots": ["UR5e", "Panda"], "control_freq": 10}));
    }
}
