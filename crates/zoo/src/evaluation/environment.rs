//! The environment that an entry's policy acts in: what simulators are started for.

use std::path::PathBuf;

use rollout::{Python, WorkerSpec};

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
