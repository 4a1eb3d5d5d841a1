//! What can go wrong between us and a worker.

use std::path::PathBuf;
use std::time::Duration;

use crate::frame::FrameError;

/// Why a rollout could not be run, or could not be run to its end.
#[derive(Debug, thiserror::Error)]
pub enum RolloutError {
    /// A file or folder of the harness, its cache or a worker's log.
    #[error("{operation} {}", path.display())]
    File {
        /// What was being done.
        operation: &'static str,
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// `ACTRM_HARNESS` does not hold the harness.
    #[error("harness: no actrm_harness/worker.py under {} (from ACTRM_HARNESS)", path.display())]
    NoHarness {
        /// The folder that was named.
        path: PathBuf,
    },
    /// No Python interpreter was found.
    #[error("python: none found (looked at {searched}); name one with --python or ACTRM_PYTHON")]
    NoPython {
        /// The places, in order.
        searched: String,
    },
    /// The interpreter that was named is not there.
    #[error("python: {} (from {origin}) is not there", path.display())]
    PythonMissing {
        /// The file that was named.
        path: PathBuf,
        /// Which option named it.
        origin: String,
    },
    /// The interpreter cannot run the harness.
    #[error(
        "python {} (from {origin}): {problem}; run `make venv` in the repository, or name another by --python or ACTRM_PYTHON",
        path.display()
    )]
    PythonUnusable {
        /// The interpreter.
        path: PathBuf,
        /// How it was found.
        origin: String,
        /// What it lacks.
        problem: String,
    },
    /// A worker's process could not be started.
    #[error("worker: starting {}", program.display())]
    Spawn {
        /// The program.
        program: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A checkpoint of other people's could not be read.
    #[error("checkpoint {}: {problem}", path.display())]
    Checkpoint {
        /// The file.
        path: PathBuf,
        /// What the harness says of it.
        problem: String,
    },
    /// A worker said at once that it cannot do what was asked.
    #[error("worker for task {task:?}: {message} ({kind})")]
    Refused {
        /// The task.
        task: String,
        /// The worker's word for it.
        kind: String,
        /// The worker's explanation.
        message: String,
    },
    /// A worker greets with something else than expected.
    #[error("worker handshake: {what}: expected {expected}, found {found}")]
    Handshake {
        /// The item.
        what: &'static str,
        /// What we need.
        expected: String,
        /// What it said.
        found: String,
    },
    /// The user wanted an end while a worker was awaited.
    #[error("stopped while waiting for the simulator of task {task:?}")]
    Stopped {
        /// The task.
        task: String,
    },
    /// No worker could be started, after several tries.
    #[error("worker for task {task:?} did not start in {attempts} tries: {fault}")]
    Start {
        /// The task.
        task: String,
        /// How many tries.
        attempts: u32,
        /// The last failure.
        fault: Box<WorkerFault>,
    },
    /// An episode failed on every worker that tried it; it has no result.
    #[error("episode with seed {seed}: no result after {attempts} workers: {fault}")]
    Episode {
        /// The episode's seed.
        seed: u64,
        /// How many workers tried.
        attempts: u32,
        /// The last failure.
        fault: Box<WorkerFault>,
    },
    /// Several episodes hang, each on its own worker.
    #[error(
        "task {task:?}: episodes of {} seeds ({}) hang, the last one: {fault}; see what the environment does then{}",
        seeds.len(),
        seeds.iter().map(u64::to_string).collect::<Vec<_>>().join(", "),
        if fault.phase == "step" { ", or allow it more time (--step-timeout)" } else { "" }
    )]
    Hangs {
        /// The task.
        task: String,
        /// The seeds.
        seeds: Vec<u64>,
        /// The last failure.
        fault: Box<WorkerFault>,
    },
    /// The policy or another part on our side failed during an episode.
    #[error("episode with seed {seed}, step {step}: {operation}")]
    Policy {
        /// The episode's seed.
        seed: u64,
        /// Control steps done so far.
        step: usize,
        /// What was being done.
        operation: &'static str,
        /// What it said.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// The policy's action is not a usable one.
    #[error("episode with seed {seed}, step {step}: action: expected {expected}, found {found}")]
    Action {
        /// The episode's seed.
        seed: u64,
        /// Control steps done so far.
        step: usize,
        /// What the environment takes.
        expected: String,
        /// What the policy gave.
        found: String,
    },
    /// The policy reads an observation that the environment does not give.
    #[error("observation key {key:?}: the environment of task {task:?} has {available}")]
    ObservationKey {
        /// The missing key.
        key: String,
        /// The task.
        task: String,
        /// The keys that are there.
        available: String,
    },
    /// The thread pool of one worker could not be made.
    #[error("starting the inference thread of worker {slot}")]
    Thread {
        /// The worker's place in the pool.
        slot: usize,
        /// What the thread library said.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// A stored attempt of a collection is not one that was written.
    #[error("{}: not an attempt: {problem}", path.display())]
    Attempt {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        problem: FrameError,
    },
    /// Another process collects demonstrations into the same folder.
    #[error("folder {} is in use by another collection", folder.display())]
    CollectionBusy {
        /// The collection's folder.
        folder: PathBuf,
    },
    /// A folder holds attempts of another collection.
    #[error(
        "{} holds attempts of another collection: {what}: expected {expected}, found {found}; \
         remove it, or collect into another file",
        folder.display()
    )]
    CollectionDiffers {
        /// The collection's folder.
        folder: PathBuf,
        /// The field that differs.
        what: String,
        /// As it is now.
        expected: String,
        /// As it is in the folder.
        found: String,
    },
}

impl RolloutError {
    /// Builds the closure that `map_err` wants around a file operation.
    pub(crate) fn file(operation: &'static str, path: impl Into<PathBuf>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.into();
        move |source| Self::File { operation, path, source }
    }
}

/// A worker's failure: never an outcome of an episode, always a reason to take a fresh worker.
#[derive(Debug, thiserror::Error)]
#[error("worker {worker} during {phase}: {kind}{}", tail(.stderr, .log))]
pub struct WorkerFault {
    /// Which worker, as `slot.generation`.
    pub worker: String,
    /// What it was doing.
    pub phase: &'static str,
    /// What happened.
    pub kind: FaultKind,
    /// The last lines of its stderr.
    pub stderr: String,
    /// The file with all of its stderr.
    pub log: PathBuf,
}

fn tail(stderr: &str, log: &std::path::Path) -> String {
    if stderr.is_empty() {
        return String::new();
    }
    format!("; its stderr ({}) ends: {stderr}", log.display())
}

/// How a worker failed.
#[derive(Debug, thiserror::Error)]
pub enum FaultKind {
    /// The process ended or closed its pipe.
    #[error("it ended ({0})")]
    Died(String),
    /// It did not answer in time.
    #[error("no answer within {:.1} s", .0.as_secs_f64())]
    TimedOut(Duration),
    /// The user wanted an end, and it was not waited for any longer.
    #[error("stopped by request")]
    Stopped,
    /// It wrote bytes that are not a frame.
    #[error("nonsense in the pipe: {0}")]
    Nonsense(FrameError),
    /// It wrote bytes that nobody asked for.
    #[error("bytes in the pipe that nobody asked for")]
    Unasked,
    /// It answered another question.
    #[error("answer: expected {expected}, found {found}")]
    Unexpected {
        /// The answer that the protocol wants.
        expected: String,
        /// The one that came.
        found: String,
    },
    /// It answered with values that cannot be.
    #[error("answer: {0}")]
    Values(String),
    /// Its environment gave what is no number: a fresh worker would give the same.
    #[error("{0}")]
    Environment(String),
    /// It is a worker of the process that this one was forked from.
    #[error("it belongs to the process that this one was forked from; start a simulator of its own here")]
    Foreign,
    /// It reported an error of its own.
    #[error("it reports {kind}: {message}")]
    Reported {
        /// Its word for it.
        kind: String,
        /// Its explanation.
        message: String,
    },
    /// The pipe itself failed.
    #[error("pipe: {0}")]
    Pipe(std::io::Error),
}

/// A worker's words for what cannot be done, whichever worker is asked.
const OF_THE_REQUEST: [&str; 6] = ["bad_action", "bad_request", "model", "mujoco", "no_renderer", "unknown_camera"];

impl FaultKind {
    /// Whether what was asked cannot be done: the worker is well, and another one would say the same.
    pub(crate) fn is_of_the_request(&self) -> bool {
        matches!(self, Self::Reported { kind, .. } if OF_THE_REQUEST.contains(&kind.as_str()))
    }
}
