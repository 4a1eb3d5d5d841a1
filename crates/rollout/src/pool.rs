//! N workers, one list of jobs: results come back in the jobs' order, whatever the number of workers
//! and whoever finished first. A worker that fails is replaced and its job run again from the start.

use std::collections::BTreeMap;
use std::ops::{ControlFlow, Range};
use std::path::PathBuf;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError, mpsc};
use std::time::Duration;

use serde_json::Value;

use crate::error::{FaultKind, RolloutError, WorkerFault};
use crate::logs::LogFolder;
use crate::message::Ready;
use crate::spec::WorkerSpec;
use crate::stop::Stop;
use crate::worker::{StartFailure, Worker};

/// How far workers may run ahead of the next result to deliver, in jobs.
const LOOK_AHEAD: u64 = 64;

/// Seeds that hang in the same way, none of which a fresh worker has done, after which no more are tried.
const HANGS: usize = 3;

/// What a pool is made of.
#[derive(Clone)]
pub struct PoolOptions {
    /// What each worker runs.
    pub spec: WorkerSpec,
    /// How many workers.
    pub workers: usize,
    /// How many workers may try a job, and how often a worker's start is tried: 3 means "again, at most
    /// twice".
    pub attempts: u32,
    /// Where workers' stderr goes; a temporary folder if none is named.
    pub logs: Option<PathBuf>,
    /// Says whether to stop: workers that are starting at once, jobs that are under way within a second.
    pub stop: Arc<dyn Fn() -> bool + Send + Sync>,
}

impl PoolOptions {
    /// `workers` workers with the usual patience.
    pub fn new(spec: WorkerSpec, workers: usize) -> Self {
        Self { spec, workers: workers.max(1), attempts: 3, logs: None, stop: Arc::new(|| false) }
    }
}

/// Why a job ended without a result.
#[derive(Debug)]
pub enum JobError {
    /// The worker failed: the job is run again on a fresh one.
    Worker(WorkerFault),
    /// Our side failed: no worker can help, the run ends.
    Final(RolloutError),
}

impl From<WorkerFault> for JobError {
    fn from(fault: WorkerFault) -> Self {
        JobError::Worker(fault)
    }
}

impl From<RolloutError> for JobError {
    fn from(error: RolloutError) -> Self {
        JobError::Final(error)
    }
}

/// One failure that a fresh worker made good, or tried to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Incident {
    /// The job, or none while starting ahead of the first.
    pub job: Option<u64>,
    /// What happened.
    pub text: String,
}

/// How a run over jobs ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RunEnd {
    /// Every job has been delivered, or the receiver had enough.
    Complete,
    /// It was asked to stop first.
    Stopped,
}

/// A set of workers for one environment.
pub struct Pool {
    options: PoolOptions,
    logs: PathBuf,
    _temporary: Option<LogFolder>,
    stop: Stop,
    ready: Ready,
    fallback: Option<String>,
    slots: Vec<Slot>,
    incidents: Vec<Incident>,
}

#[derive(Default)]
struct Slot {
    worker: Option<Worker>,
    generation: u32,
}

struct Shared<'a> {
    options: &'a PoolOptions,
    logs: &'a std::path::Path,
    stop: &'a Stop,
    ready: Option<&'a Ready>,
    incidents: Mutex<&'a mut Vec<Incident>>,
    /// Seeds whose episodes hung and have no result, in which request, and on how many workers one after the other.
    hung: Mutex<BTreeMap<u64, (&'static str, u32)>>,
}

struct Progress {
    next: u64,
    delivered: u64,
    halted: bool,
}

impl Pool {
    /// Starts all workers at once and waits for their greetings.
    ///
    /// # Errors
    /// Any reason why a worker cannot start; [`RolloutError::Stopped`] if the options ask for an end meanwhile.
    pub fn start(options: PoolOptions) -> Result<Self, RolloutError> {
        let file = |path: PathBuf| move |source| RolloutError::File { operation: "creating log folder", path, source };
        let (logs, temporary) = match &options.logs {
            Some(path) => {
                std::fs::create_dir_all(path).map_err(file(path.clone()))?;
                (path.clone(), None)
            }
            None => {
                let folder = LogFolder::make()?;
                (folder.path(), Some(folder))
            }
        };
        let mut incidents = Vec::new();
        let mut slots: Vec<Slot> = (0..options.workers).map(|_| Slot::default()).collect();
        let stop = Stop::new(Arc::clone(&options.stop));
        let (failed, hung) = (Mutex::new(&mut incidents), Mutex::default());
        let shared = Shared { options: &options, logs: &logs, stop: &stop, ready: None, incidents: failed, hung };
        let results: Vec<Result<(), RolloutError>> = std::thread::scope(|scope| {
            let threads: Vec<_> = slots
                .iter_mut()
                .enumerate()
                .map(|(index, slot)| {
                    let shared = &shared;
                    scope.spawn(move || slot.ensure(index, shared, None).map(|_| ()))
                })
                .collect();
            threads.into_iter().map(|t| t.join().expect("starting does not panic")).collect()
        });
        for result in results {
            result?;
        }
        let greetings: Vec<Ready> = slots.iter().filter_map(|s| s.worker.as_ref()).map(|w| w.ready().clone()).collect();
        let ready = greetings[0].clone();
        for other in &greetings {
            same_greeting(&ready, other)?;
        }
        let first = slots[0].worker.as_ref();
        let fallback = first.and_then(|worker| worker.fallback(options.spec.control));
        crate::greeting::remember(&options.spec, &ready);
        Ok(Self { options, logs, _temporary: temporary, stop, ready, fallback, slots, incidents })
    }

    /// What every worker of this pool said of itself.
    pub fn ready(&self) -> &Ready {
        &self.ready
    }

    /// Why robosuite's own control loop runs although the compiled one was asked for, if so: to be said
    /// once.
    pub fn fallback(&self) -> Option<&str> {
        self.fallback.as_deref()
    }

    /// The failures so far that fresh workers made good, or tried to.
    pub fn incidents(&self) -> &[Incident] {
        &self.incidents
    }

    /// The first worker, to be spoken to directly, step by step; `None` once it is known to have failed.
    pub fn first_worker(&mut self) -> Option<&mut Worker> {
        self.slots.first_mut()?.worker.as_mut()
    }

    /// The ids of the workers' processes that are running now.
    pub fn process_ids(&self) -> Vec<u32> {
        self.slots.iter().filter_map(|s| s.worker.as_ref()).map(Worker::process_id).collect()
    }

    /// Runs `work` for every job on some worker and hands the results to `deliver` in the jobs' order.
    ///
    /// `state` makes what one worker's thread keeps between jobs, such as a policy. All of a thread's
    /// numeric work stays on that thread. `seed_of` names a job's seed in errors.
    ///
    /// # Errors
    /// A failure on our side; a job that no worker could do is delivered as an error instead.
    pub fn run<S, T: Send>(
        &mut self,
        jobs: Range<u64>,
        seed_of: &(dyn Fn(u64) -> u64 + Sync),
        state: &(dyn Fn() -> Result<S, RolloutError> + Sync),
        work: &(dyn Fn(&mut S, &mut Worker, u64) -> Result<T, JobError> + Sync),
        deliver: &mut dyn FnMut(u64, Result<T, RolloutError>) -> ControlFlow<()>,
    ) -> Result<RunEnd, RolloutError> {
        let Self { options, logs, stop, ready, slots, incidents, .. } = self;
        let (incidents, hung) = (Mutex::new(incidents), Mutex::default());
        let shared = Shared { options, logs, stop, ready: Some(ready), incidents, hung };
        let progress = Mutex::new(Progress { next: jobs.start, delivered: jobs.start, halted: false });
        let moved = Condvar::new();
        let (sender, receiver) = mpsc::channel::<(u64, Result<T, JobError>)>();
        let mut failure = None;
        std::thread::scope(|scope| {
            for (index, slot) in slots.iter_mut().enumerate() {
                let (shared, progress, moved) = (&shared, &progress, &moved);
                let (jobs, sender) = (jobs.clone(), sender.clone());
                scope.spawn(move || {
                    let inside = || {
                        let mut kept = None;
                        while let Some(job) = claim(progress, moved, shared.stop, &jobs) {
                            let seed = seed_of(job);
                            let result = slot.attempt(index, shared, job, seed, &mut kept, state, work);
                            if sender.send((job, result)).is_err() {
                                break;
                            }
                        }
                    };
                    // a pool of one thread: matrix products inside do not spread over the cores
                    match rayon::ThreadPoolBuilder::new().num_threads(1).build() {
                        Ok(pool) => pool.install(inside),
                        Err(source) => {
                            let error = RolloutError::Thread { slot: index, source: Box::new(source) };
                            let _ = sender.send((jobs.start, Err(JobError::Final(error))));
                        }
                    }
                });
            }
            drop(sender);
            let mut waiting = BTreeMap::new();
            let mut due = jobs.start;
            let mut open = true;
            for (job, result) in receiver {
                match result {
                    Ok(value) => drop(waiting.insert(job, Ok(value))),
                    Err(JobError::Final(error @ RolloutError::Episode { .. })) => {
                        waiting.insert(job, Err(error));
                    }
                    // what was under way is not done, and nothing has failed
                    Err(JobError::Final(RolloutError::Stopped { .. })) => {}
                    // nobody needs what was still under way
                    Err(JobError::Final(_)) if !open => {}
                    Err(JobError::Final(error)) => {
                        failure = Some(error);
                        open = false;
                    }
                    Err(JobError::Worker(_)) => unreachable!("attempt turns faults into errors"),
                }
                while let Some(result) = open.then(|| waiting.remove(&due)).flatten() {
                    open = deliver(due, result).is_continue();
                    due += 1;
                }
                let mut progress = lock(&progress);
                progress.delivered = due;
                progress.halted = !open;
                moved.notify_all();
            }
        });
        if let Some(error) = failure {
            return Err(error);
        }
        let progress = progress.into_inner().unwrap_or_else(PoisonError::into_inner);
        let complete = progress.halted || progress.delivered >= jobs.end;
        Ok(if complete { RunEnd::Complete } else { RunEnd::Stopped })
    }

    /// Asks every worker to end.
    pub fn close(mut self) {
        std::thread::scope(|scope| {
            for slot in &mut self.slots {
                if let Some(worker) = slot.worker.take() {
                    scope.spawn(move || worker.close());
                }
            }
        });
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn claim(progress: &Mutex<Progress>, moved: &Condvar, stop: &Stop, jobs: &Range<u64>) -> Option<u64> {
    let mut progress = lock(progress);
    while progress.next >= progress.delivered.saturating_add(LOOK_AHEAD) && !progress.halted && !stop.asked() {
        // whoever asks to stop notifies nobody: look at it now and then
        let waited = moved.wait_timeout(progress, Duration::from_millis(100));
        progress = waited.unwrap_or_else(PoisonError::into_inner).0;
    }
    if progress.halted || stop.asked() || progress.next >= jobs.end {
        return None;
    }
    progress.next += 1;
    Some(progress.next - 1)
}

impl Shared<'_> {
    /// The seeds that hang as this one does, once they are enough to say that it is the environment and no accident.
    fn hang(&self, seed: u64, fault: &WorkerFault) -> Option<Vec<u64>> {
        if !matches!(fault.kind, FaultKind::TimedOut(_)) {
            return None;
        }
        let mut hung = lock(&self.hung);
        let (phase, times) = hung.entry(seed).or_insert((fault.phase, 0));
        *times = if *phase == fault.phase { *times + 1 } else { 1 };
        *phase = fault.phase;
        // once may be the machine, which stood still for all workers
        let alike =
            hung.iter().filter(|(_, (phase, times))| *phase == fault.phase && *times > 1).map(|(seed, _)| *seed);
        let alike: Vec<u64> = alike.collect();
        (alike.len() >= HANGS).then_some(alike)
    }
}

impl Slot {
    /// The slot's worker, started if there is none.
    fn ensure(&mut self, index: usize, shared: &Shared<'_>, job: Option<u64>) -> Result<&mut Worker, RolloutError> {
        let mut tries = 0;
        while self.worker.is_none() {
            let name = format!("{index}.{}", self.generation);
            self.generation += 1;
            tries += 1;
            match Worker::start(&shared.options.spec, &name, shared.logs, shared.stop) {
                Ok(worker) => {
                    if let Some(ready) = shared.ready {
                        same_greeting(ready, worker.ready())?;
                    }
                    self.worker = Some(worker);
                }
                Err(StartFailure::Final(error)) => return Err(error),
                Err(StartFailure::Fault(fault)) => {
                    lock(&shared.incidents).push(Incident { job, text: fault.to_string() });
                    if tries >= shared.options.attempts {
                        return Err(RolloutError::Start {
                            task: shared.options.spec.task.clone(),
                            attempts: tries,
                            fault: Box::new(fault),
                        });
                    }
                }
            }
        }
        Ok(self.worker.as_mut().expect("started above"))
    }

    #[expect(clippy::too_many_arguments, reason = "the one place where a job meets its worker")]
    fn attempt<S, T>(
        &mut self,
        index: usize,
        shared: &Shared<'_>,
        job: u64,
        seed: u64,
        kept: &mut Option<S>,
        state: &(dyn Fn() -> Result<S, RolloutError> + Sync),
        work: &(dyn Fn(&mut S, &mut Worker, u64) -> Result<T, JobError> + Sync),
    ) -> Result<T, JobError> {
        let mut attempts = 0;
        loop {
            attempts += 1;
            let worker = self.ensure(index, shared, Some(job))?;
            let kept = match kept {
                Some(kept) => kept,
                None => kept.insert(state()?),
            };
            let fault = match work(kept, worker, job) {
                Ok(value) => {
                    lock(&shared.hung).remove(&seed);
                    return Ok(value);
                }
                Err(JobError::Worker(fault)) => fault,
                Err(error) => return Err(error),
            };
            if matches!(fault.kind, FaultKind::Stopped) {
                self.worker = None;
                return Err(RolloutError::Stopped { task: shared.options.spec.task.clone() }.into());
            }
            // dropped, and with it the process and its children
            self.worker = None;
            if fault.kind.is_of_the_request() {
                return Err(RolloutError::Episode { seed, attempts, fault: Box::new(fault) }.into());
            }
            lock(&shared.incidents).push(Incident { job: Some(job), text: fault.to_string() });
            if let Some(seeds) = shared.hang(seed, &fault) {
                let (task, fault) = (shared.options.spec.task.clone(), Box::new(fault));
                return Err(RolloutError::Hangs { task, seeds, fault }.into());
            }
            let helpless = matches!(fault.kind, FaultKind::Environment(_) | FaultKind::Foreign);
            if helpless || attempts >= shared.options.attempts {
                let fault = Box::new(fault);
                return Err(RolloutError::Episode { seed, attempts, fault }.into());
            }
        }
    }
}

/// Every worker of a pool must describe the same environment of the same versions.
fn same_greeting(first: &Ready, other: &Ready) -> Result<(), RolloutError> {
    if first == other {
        return Ok(());
    }
    let fields = |ready: &Ready| serde_json::to_value(ready).unwrap_or_default();
    let (first, other) = (fields(first), fields(other));
    // the first field in which they differ, as deep as there are fields
    let (mut at, mut expected, mut found) = (String::new(), Some(&first), Some(&other));
    while let (Some(Value::Object(mine)), Some(Value::Object(theirs))) = (expected, found) {
        let mut names = mine.keys().chain(theirs.keys());
        let Some(name) = names.find(|name| mine.get(*name) != theirs.get(*name)) else { break };
        at = if at.is_empty() { name.clone() } else { format!("{at}.{name}") };
        (expected, found) = (mine.get(name), theirs.get(name));
    }
    let text = |value: Option<&Value>| value.map_or_else(|| "nothing".to_owned(), ToString::to_string);
    Err(RolloutError::Handshake {
        what: "greeting of another worker of the same pool",
        expected: format!("{at} {}", text(expected)),
        found: text(found),
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use serde_json::json;

    use super::*;

    #[test]
    fn a_greeting_that_differs_names_the_field() {
        let ready = |versions: Value| -> Ready {
            serde_json::from_value(json!({
                "protocol": 2, "simulator": "robosuite", "versions": versions, "task": "Lift", "env_name": "Lift",
                "control": "compiled", "control_freq": 20.0, "max_steps": 400, "action_dim": 1, "action_low": [-1.0],
                "action_high": [1.0], "observations": {"object": [10]}, "env_args": {"env_kwargs": {"robots": "Panda"}},
            }))
            .unwrap()
        };
        let first = ready(json!({"mujoco": "3.3.7", "numpy": "2.3.5"}));
        assert!(same_greeting(&first, &first.clone()).is_ok());
        for (other, text) in [
            (json!({"mujoco": "3.3.7", "numpy": "2.3.4"}), "expected versions.numpy \"2.3.5\", found \"2.3.4\""),
            (json!({"mujoco": "3.3.7"}), "expected versions.numpy \"2.3.5\", found nothing"),
            (json!({"a": "1", "mujoco": "3.3.7", "numpy": "2.3.5"}), "expected versions.a nothing, found \"1\""),
        ] {
            let error = same_greeting(&first, &ready(other)).unwrap_err().to_string();
            assert!(error.ends_with(text), "{error}");
        }
    }
}
