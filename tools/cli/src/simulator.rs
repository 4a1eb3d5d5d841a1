//! What the commands that run the simulator share: their options, its start and its end.

use std::path::PathBuf;

use anyhow::{Result, anyhow};
use rollout::{Pool, PoolOptions, Python, WorkerSpec, find_python, harness_folder};
use serde_json::Value;

use crate::{Screen, Stop, limits, note};

/// Options of every command that runs the simulator.
#[derive(clap::Args)]
pub struct SimulatorArgs {
    /// Number of simulators at once [default: one per core]
    #[arg(long, short = 'j', value_name = "N")]
    pub workers: Option<usize>,
    /// Python module that registers your own environments
    #[arg(long, value_name = "MODULE")]
    pub env_module: Option<String>,
    /// Python with robosuite [default: $ACTRM_PYTHON, else .venv/bin/python here or above, else python3]
    #[arg(long, value_name = "PATH")]
    pub python: Option<PathBuf>,
}

impl SimulatorArgs {
    /// The Python to use.
    ///
    /// # Errors
    /// There is none, or not where it was said to be.
    pub fn python(&self) -> Result<Python> {
        Ok(find_python(self.python.as_deref())?)
    }

    /// What a worker for `task` is to be, as far as these options say.
    ///
    /// # Errors
    /// No Python, no harness.
    pub fn spec(&self, task: &str) -> Result<WorkerSpec> {
        let mut spec = WorkerSpec::new(self.python()?, harness_folder()?, task);
        spec.env_module.clone_from(&self.env_module);
        Ok(spec)
    }

    /// The same for an environment that was recorded with robomimic's `env_args`: its robots, its controllers.
    ///
    /// # Errors
    /// It was recorded with a module that the user does not name; no Python, no harness.
    pub fn recorded_spec(&self, task: &str, env_args: Option<&Value>) -> Result<WorkerSpec> {
        rollout::check_module(env_args.and_then(rollout::recorded_module), self.env_module.as_deref())
            .map_err(|reason| anyhow!("task {task}: {reason}"))?;
        Ok(self.spec(task)?.recorded(env_args))
    }

    /// Starts the workers and says where they fall back on robosuite's own loop; nothing if it was stopped meanwhile.
    ///
    /// # Errors
    /// Too many workers, or any reason why one cannot start.
    pub fn start(&self, spec: WorkerSpec, logs: Option<PathBuf>, stop: &Stop) -> Result<Option<Pool>> {
        let task = spec.task.clone();
        let options = PoolOptions { logs, stop: stop.flag(), ..PoolOptions::new(spec, limits::workers(self.workers)?) };
        let mut screen = Screen::new();
        screen.spin(format!("starting simulators for {task}"));
        let pool = Pool::start(options);
        drop(screen);
        match pool {
            _ if stop.asked() => Ok(None),
            Err(error) => Err(error.into()),
            Ok(pool) => {
                if let Some(why) = pool.fallback() {
                    note(&format!("note: {why}"));
                }
                Ok(Some(pool))
            }
        }
    }
}

/// Says what went wrong on the way, and ends the workers.
pub fn close(pool: Pool) {
    for incident in pool.incidents() {
        note(&format!("note: {}", incident.text));
    }
    pool.close();
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_recording_names_no_module_for_the_user() {
        let args = SimulatorArgs { workers: None, env_module: None, python: None };
        let env_args = serde_json::json!({"env_name": "Lift", "env_module": {"name": "theirs"}});
        let refused = args.recorded_spec("Lift", Some(&env_args)).map(drop).expect_err("nobody named it").to_string();
        assert!(refused.contains("task Lift") && refused.contains("\"theirs\""), "{refused}");
    }
}
