//! What the commands that run entries in simulators share.

use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::Context;
use clap::Args;
use cli::{Screen, SimulatorArgs, Stop, limits};
use rollout::{Control, Pool, RolloutError, WorkerSpec, harness_folder};
use zoo::ZooError;
use zoo::config::nearest;
use zoo::entry::EntryMeta;
use zoo::evaluation::{Environment, EvaluationEnd, EvaluationOptions, Progress, Subject, evaluate};
use zoo::results::StoredEvaluation;

use crate::places::of_entry;

/// Seconds that a worker may take for a step.
const STEP_TIMEOUT: u64 = 30;
/// Seconds that a worker may take to start.
const START_TIMEOUT: u64 = 300;

/// How entries are run.
#[derive(Args)]
pub struct RunArgs {
    /// Control steps after which an episode counts as failed [default: the entry's or the task's]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=limits::MOST_STEPS))]
    pub max_steps: Option<u64>,
    #[command(flatten)]
    pub simulator: SimulatorArgs,
    /// Task, if not the entry's
    #[arg(long)]
    pub task: Option<String>,
    /// Robot in place of the task's own, with its usual controller, such as UR5e; two names with a comma for two arms
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    pub robots: Vec<String>,
    /// Control loop inside the simulator: `compiled` or `robosuite`
    #[arg(long, default_value_t = Control::Compiled)]
    pub control: Control,
    /// Evaluate even if the demonstrations were recorded in another simulator version or with these seeds
    #[arg(long)]
    pub force: bool,
    /// Seconds without an answer to a step after which a worker is restarted
    #[arg(long, value_name = "S", default_value_t = STEP_TIMEOUT, value_parser = clap::value_parser!(u64).range(1..=86_400))]
    step_timeout: u64,
    /// Seconds that a worker may take to start, with imports and compilation
    #[arg(long, value_name = "S", default_value_t = START_TIMEOUT, value_parser = clap::value_parser!(u64).range(1..=86_400))]
    start_timeout: u64,
    /// Folder for the standard error output of the workers
    #[arg(long, value_name = "DIR")]
    pub worker_logs: Option<PathBuf>,
}

impl RunArgs {
    /// The first option that only means something where episodes are run, if one is given.
    pub fn given(&self) -> Option<&'static str> {
        let SimulatorArgs { workers, env_module, python } = &self.simulator;
        let options = [
            ("--max-steps", self.max_steps.is_some()),
            ("--workers", workers.is_some()),
            ("--env-module", env_module.is_some()),
            ("--python", python.is_some()),
            ("--robots", !self.robots.is_empty()),
            ("--control", self.control != Control::Compiled),
            ("--force", self.force),
            ("--step-timeout", self.step_timeout != STEP_TIMEOUT),
            ("--start-timeout", self.start_timeout != START_TIMEOUT),
            ("--worker-logs", self.worker_logs.is_some()),
        ];
        options.into_iter().find(|(_, given)| *given).map(|(option, _)| option)
    }
}

/// The environment of an entry's demonstrations, unless the command line says otherwise: what simulators are started for.
///
/// # Errors
/// As [`Environment::of`].
pub fn environment(args: &RunArgs, meta: &EntryMeta) -> Result<Environment, ZooError> {
    let environment = drawn(&args.simulator, args.task.as_deref(), meta)?;
    Ok(if args.robots.is_empty() { environment } else { environment.with_robots(&args.robots) })
}

/// The same for commands that show one episode: as its demonstrations, drawn as they were.
///
/// # Errors
/// As [`Environment::of`].
pub fn drawn(simulator: &SimulatorArgs, task: Option<&str>, meta: &EntryMeta) -> Result<Environment, ZooError> {
    Environment::of(meta, task, simulator.env_module.as_deref())
}

/// The worker that such a simulator is.
///
/// # Errors
/// No Python, no harness.
pub fn worker(environment: &Environment, simulator: &SimulatorArgs, control: Control) -> anyhow::Result<WorkerSpec> {
    let mut spec = environment.worker(simulator.python()?, harness_folder()?);
    spec.control = control;
    Ok(spec)
}

/// The same with the limits that the command line sets.
///
/// # Errors
/// As [`worker`].
pub fn limited_worker(environment: &Environment, args: &RunArgs, control: Control) -> anyhow::Result<WorkerSpec> {
    let mut spec = worker(environment, &args.simulator, control)?;
    spec.limits.step = Duration::from_secs(args.step_timeout);
    spec.limits.start = Duration::from_secs(args.start_timeout);
    Ok(spec)
}

/// Starts simulators; nothing if it was stopped.
///
/// # Errors
/// No worker could be started. A task that none has comes with the name most like it.
pub fn start(args: &RunArgs, spec: WorkerSpec, stop: &Stop) -> anyhow::Result<Option<Pool>> {
    let started = args.simulator.start(spec, args.worker_logs.clone(), stop);
    started.map_err(|error| match error.downcast_ref().and_then(meant) {
        Some(task) => error.context(format!("did you mean `--task {task}`?")),
        None => error,
    })
}

/// The task that was meant where the simulator knows none of that name.
fn meant(error: &RolloutError) -> Option<String> {
    let RolloutError::Refused { task, kind, message } = error else { return None };
    let known = message.split_once("known: ").filter(|_| kind == "unknown_task")?.1;
    nearest(task, &known.split(", ").map(str::to_owned).collect::<Vec<_>>())
}

/// An evaluation that was run to its end, and whether nothing had to be run.
pub struct Evaluated {
    pub evaluation: Box<StoredEvaluation>,
    pub was_there: bool,
}

/// Runs what has no outcome yet; nothing if it was stopped.
pub fn run_missing(
    subject: &Subject<'_>,
    pool: &mut Pool,
    results: &Path,
    options: &EvaluationOptions,
) -> anyhow::Result<Option<Evaluated>> {
    let id = subject.entry.to_string();
    let mut screen = Screen::new();
    let mut successes = 0_u64;
    let mut was_there = false;
    let end = evaluate(subject, pool, results, options, &mut |progress| match progress {
        Progress::Apart(other) => screen.note(&format!("note: {id}: {other}")),
        Progress::Begin { done, total, .. } => {
            was_there = done == total;
            screen.begin_at("eval", done, total);
            screen.message(&id);
        }
        Progress::Episode(episode) => {
            successes += u64::from(episode.success);
            screen.step();
            screen.message(&format!("{id}: {successes} successes"));
        }
    });
    drop(screen);
    match end.map_err(|error| of_entry(&id, error.into()))? {
        EvaluationEnd::Complete(evaluation) => Ok(Some(Evaluated { evaluation, was_there })),
        EvaluationEnd::Stopped { done, total } => {
            cli::note(&format!("{id}: {done} of {total} episodes done"));
            Ok(None)
        }
        EvaluationEnd::Failed { done, errors } => {
            let first = errors.into_iter().next().context("an evaluation failed without saying why")?;
            Err(anyhow::Error::new(first).context(format!("entry {id}: {done} episodes done, others could not be run")))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_an_unknown_task_the_name_most_like_it_is_told() {
        let hint = |task: &str, kind: &str| {
            let message = format!("unknown task '{task}'; known: Door, Lift, Stack");
            meant(&RolloutError::Refused { task: task.to_owned(), kind: kind.to_owned(), message })
        };
        assert_eq!(hint("Lfit", "unknown_task").as_deref(), Some("Lift"));
        assert_eq!((hint("Transport", "unknown_task"), hint("Lfit", "bad_config")), (None, None));
    }
}
