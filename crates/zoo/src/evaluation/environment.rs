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
    /// The environment of an entry's demonstrations, unless another task is named. `env_module` is what the user names.
    ///
    /// # Errors
    /// As [`EntryMeta::cameras`] and [`Environment::expecting`].
    pub fn of(meta: &EntryMeta, task: Option<&str>, env_module: Option<&str>) -> Result<Self, ZooError> {
        // another task's environment has arguments of its own
        let other = task.filter(|task| *task != meta.task);
        let env_args = match other {
            Some(_) => None,
            None => meta.env_args.as_ref().map(serde_json::Value::to_string),
        };
        let task = other.unwrap_or(&meta.task).to_owned();
        let environment = Self { task, env_module: env_module.map(str::to_owned), env_args, cameras: meta.cameras()? };
        let recorded = meta.env_module.as_ref().map(|module| module.name.as_str());
        let recorded = recorded.or_else(|| meta.env_args.as_ref().and_then(rollout::recorded_module));
        environment.expecting(&format!("entry {}", meta.id()), recorded)
    }

    /// The same where `what` was recorded with the module `recorded`.
    ///
    /// # Errors
    /// [`ZooError::NotPossible`]: the user named no module.
    pub fn expecting(self, what: &str, recorded: Option<&str>) -> Result<Self, ZooError> {
        match rollout::check_module(recorded, self.env_module.as_deref()) {
            Ok(()) => Ok(self),
            Err(reason) => Err(ZooError::NotPossible { what: what.to_owned(), reason }),
        }
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
    use crate::entry::{ModuleMeta, testing};

    #[test]
    fn a_module_is_the_users_and_never_the_files() {
        let module = ModuleMeta { name: "theirs".to_owned(), sha256: "0".repeat(64) };
        let env_args = serde_json::json!({"env_kwargs": {"robots": "Panda"}, "env_module": module});
        let mut named = testing::draft("lift-act").meta;
        named.env_module = Some(module);
        // an entry that somebody edited
        let mut hidden = testing::draft("lift-act").meta;
        hidden.env_args = Some(env_args);
        for meta in [named, hidden] {
            for task in [None, Some("Lift"), Some("Stack")] {
                let refused = Environment::of(&meta, task, None).unwrap_err().to_string();
                assert!(refused.contains("entry lift-act@0") && refused.contains("\"theirs\""), "{refused}");
            }
            let environment = Environment::of(&meta, None, Some("mine")).unwrap();
            let python = Python { path: "python".into(), origin: "--python".into() };
            let spec = environment.worker(python, PathBuf::from("harness"));
            assert_eq!(spec.env_module.as_deref(), Some("mine"));
        }
    }

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
