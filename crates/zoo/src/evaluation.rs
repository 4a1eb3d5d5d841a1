//! Evaluating an entry: its policy in a task's environment, once per seed, results to disk as they come.
//!
//! An episode's outcome depends on task, seed, entry and protocol. It does not depend on the worker, the
//! number of workers, the order, what ran before, or what had to be run again.

mod again;
mod agent;
mod clock;
mod environment;
mod perturbation;
mod subject;

use std::ops::ControlFlow;
use std::path::Path;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use rollout::{EpisodePlan, FaultKind, Image, JobError, Observations, Pool, Ready, RolloutError, Worker, WorkerFault};

pub use self::again::{Again, evaluate_again};
pub use self::agent::{PolicyAgent, QueryTime, QueryTimes};
pub use self::clock::WallClock;
pub use self::environment::Environment;
pub use self::perturbation::Perturbation;
pub use self::subject::{Subject, acting, image};
use crate::ZooError;
use crate::results::{EpisodeRecord, EpisodeTiming, OtherSimulator, ResultsFolder, Seeds, Shard, StoredEvaluation};

/// The first seed of an evaluation unless another is asked for: demonstrations never use these.
pub const FIRST_SEED: u64 = 10_000;

/// What to evaluate and where to put it.
#[derive(Debug, Clone)]
pub struct EvaluationOptions {
    /// The episodes' seeds.
    pub seeds: Seeds,
    /// The part of them to run here.
    pub shard: Option<Shard>,
    /// The module of the user's that registers the environment.
    pub env_module: Option<String>,
    /// Evaluate although the demonstrations are of another simulator generation, or used the same seeds.
    pub force: bool,
}

/// How an evaluation ended.
#[derive(Debug)]
pub enum EvaluationEnd {
    /// Every episode has an outcome.
    Complete(Box<StoredEvaluation>),
    /// It was stopped; what is done is on disk.
    Stopped {
        /// Episodes on disk.
        done: u64,
        /// Episodes asked for.
        total: u64,
    },
    /// Some episodes have no outcome because no worker could run them.
    Failed {
        /// Episodes on disk.
        done: u64,
        /// What went wrong, by seed.
        errors: Vec<RolloutError>,
    },
}

/// News from an evaluation under way.
#[derive(Debug)]
pub enum Progress<'a> {
    /// Before it begins: episodes of another simulator are there, and stay apart.
    Apart(&'a OtherSimulator),
    /// It begins, or goes on.
    Begin {
        /// Episodes that were on disk already.
        done: u64,
        /// Episodes asked for.
        total: u64,
        /// The results' folder.
        folder: &'a Path,
    },
    /// An episode has its outcome.
    Episode(&'a EpisodeRecord),
}

/// The evaluation that `subject` would get from workers that greet like this, if it is finished already.
///
/// # Errors
/// As [`evaluate`].
pub fn finished(
    subject: &Subject<'_>,
    ready: &Ready,
    results: &Path,
    options: &EvaluationOptions,
) -> Result<Option<StoredEvaluation>, ZooError> {
    let record = subject.record(ready, options)?;
    let stored = StoredEvaluation::read_if_there(&record.folder_in(results))?;
    Ok(stored.filter(|stored| stored.record.is_same(&record)))
}

/// Runs the episodes that have no outcome yet on `pool` and puts each on disk when it is done.
///
/// # Errors
/// An entry that does not fit, files that cannot be written, a policy that fails. A worker's failure is
/// made good on a fresh worker; where that fails too, the end is [`EvaluationEnd::Failed`].
pub fn evaluate(
    subject: &Subject<'_>,
    pool: &mut Pool,
    results: &Path,
    options: &EvaluationOptions,
    progress: &mut dyn FnMut(Progress<'_>),
) -> Result<EvaluationEnd, ZooError> {
    let record = subject.record(pool.ready(), options)?;
    let mut folder = ResultsFolder::open(results, &record)?;
    folder.adopt(results)?;
    let missing = folder.missing();
    if !missing.is_empty() {
        folder.others(results).iter().for_each(|other| progress(Progress::Apart(other)));
    }
    let total = record.own_seeds().len() as u64;
    progress(Progress::Begin { done: total - missing.len() as u64, total, folder: folder.path() });
    if folder.is_finished() {
        return Ok(EvaluationEnd::Complete(Box::new(folder.finish()?)));
    }
    // written by the workers' threads, so that an episode is on disk even while an earlier one runs on
    let folder = Mutex::new(folder);
    let failure = Mutex::new(None);
    let mut errors = Vec::new();
    run_episodes(
        subject,
        pool,
        record.protocol.max_steps,
        &missing,
        &|episode, timing| {
            let mut folder = folder.lock().unwrap_or_else(PoisonError::into_inner);
            folder.add(episode, timing).map_err(|error| {
                failure.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
            })
        },
        &mut |result| match result {
            Ok(episode) => progress(Progress::Episode(&episode)),
            Err(error) => errors.push(error),
        },
    )
    .map_err(|error| match failure.lock().unwrap_or_else(PoisonError::into_inner).take() {
        Some(cause) => ZooError::from(cause),
        None => error.into(),
    })?;
    let folder = folder.into_inner().unwrap_or_else(PoisonError::into_inner);
    let done = folder.done().len() as u64;
    if !errors.is_empty() {
        return Ok(EvaluationEnd::Failed { done, errors });
    }
    if done < total {
        return Ok(EvaluationEnd::Stopped { done, total });
    }
    Ok(EvaluationEnd::Complete(Box::new(folder.finish()?)))
}

/// Runs the episodes of `seeds` without touching any file; the outcomes come in the order of `seeds`.
///
/// # Errors
/// A failure on our side; a worker's failure that could not be made good is handed to `deliver`.
pub fn run_episodes(
    subject: &Subject<'_>,
    pool: &mut Pool,
    max_steps: usize,
    seeds: &[u64],
    store: &(dyn Fn(EpisodeRecord, EpisodeTiming) -> Result<(), ()> + Sync),
    deliver: &mut dyn FnMut(Result<EpisodeRecord, RolloutError>),
) -> Result<(), RolloutError> {
    let plan = EpisodePlan::new(pool.ready(), subject.keys.keys(), max_steps)?;
    let seed_of = |job: u64| seeds[usize::try_from(job).expect("a job is an index of seeds")];
    let failed = |seed, operation, source| RolloutError::Policy { seed, step: 0, operation, source };
    let state = || {
        let made = subject.agent();
        made.map_err(|source| failed(seeds[0], "building the policy", Box::new(source)))
    };
    let work = |(agent, times): &mut (PolicyAgent, QueryTimes), worker: &mut Worker, job| {
        let seed = seed_of(job);
        times.take();
        let outcome = match subject.is_scripted {
            true => plan.run_expert(worker, seed)?,
            false => plan.run(worker, agent, seed, None)?,
        };
        let episode = EpisodeRecord {
            seed,
            success: outcome.success,
            steps: u32::try_from(outcome.steps).unwrap_or(u32::MAX),
            total_reward: outcome.total_reward,
            fingerprint: outcome.fingerprint,
            group: outcome.group,
            failure: outcome.failure,
            progress: outcome.progress,
        };
        let milliseconds = |duration: Duration| (duration.as_secs_f64() * 1e6).round() / 1e3;
        let queries = times.take();
        let timing = EpisodeTiming {
            seed,
            wall_ms: milliseconds(outcome.wall),
            simulator_ms: milliseconds(outcome.simulator),
            rendering_ms: outcome.drawing.into_iter().map(milliseconds).collect(),
            encoding_ms: queries.iter().filter_map(|query| query.encoding).map(|ms| (ms * 1e3).round() / 1e3).collect(),
            inference_ms: queries.iter().map(|query| milliseconds(query.whole)).collect(),
        };
        store(episode.clone(), timing)
            .map_err(|()| JobError::Final(failed(seed, "storing the outcome", "see the file error".into())))?;
        Ok(episode)
    };
    pool.run(0..seeds.len() as u64, &seed_of, &state, &work, &mut |_, result| {
        deliver(result);
        ControlFlow::Continue(())
    })?;
    Ok(())
}

/// Episodes with an image of the start and of every step each; the images of one episode are kept at a time by each
/// worker, and handed to `deliver` with the episode's seed and success. [`View::Seen`] of a policy without cameras gives
/// no images.
///
/// # Errors
/// As for an evaluation; a machine that cannot render.
pub fn record_videos(
    subject: &Subject<'_>,
    pool: &mut Pool,
    seeds: &[u64],
    view: &View,
    deliver: &mut dyn FnMut(u64, Vec<Image>, bool) -> ControlFlow<()>,
) -> Result<(), RolloutError> {
    subject.check_watched()?;
    let max_steps = subject.max_steps.unwrap_or(pool.ready().max_steps);
    let task = &pool.ready().task.clone();
    let plan = EpisodePlan::new(pool.ready(), subject.keys.keys(), max_steps)?;
    let seed_of = |job: u64| seeds[usize::try_from(job).expect("a job is an index of seeds")];
    let state = || {
        subject.agent().map_err(|source| {
            let operation = "building the policy";
            RolloutError::Policy { seed: seeds[0], step: 0, operation, source: Box::new(source) }
        })
    };
    let work = |(agent, _): &mut (PolicyAgent, QueryTimes), worker: &mut Worker, job| {
        let mut images = Vec::new();
        let mut shoot = |worker: &mut Worker, observations: &Observations| -> Result<(), JobError> {
            match view {
                View::Camera { name, height, width } => {
                    images.push(worker.render(name, *height, *width).map_err(|fault| unhelpable(task, fault))?);
                }
                View::Seen { scale } => images.extend(subject.seen(observations, *scale)),
            }
            Ok(())
        };
        let outcome = plan.run(worker, agent, seed_of(job), Some(&mut shoot))?;
        Ok((images, outcome.success))
    };
    let mut failure = None;
    pool.run(0..seeds.len() as u64, &seed_of, &state, &work, &mut |job, result| match result {
        Ok((images, success)) => deliver(seed_of(job), images, success),
        Err(error) => {
            failure = Some(error);
            ControlFlow::Break(())
        }
    })?;
    failure.map_or(Ok(()), Err)
}

/// A machine that cannot draw, and a camera that is not there, are the same for a fresh worker.
fn unhelpable(task: &str, fault: WorkerFault) -> JobError {
    match fault.kind {
        FaultKind::Reported { kind, message } if kind == "no_renderer" || kind == "unknown_camera" => {
            RolloutError::Refused { task: task.to_owned(), kind, message }.into()
        }
        _ => fault.into(),
    }
}

/// What a video shows.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum View {
    /// What a camera sees.
    Camera {
        /// robosuite's name of the camera.
        name: String,
        /// Rows.
        height: usize,
        /// Columns.
        width: usize,
    },
    /// What the policy sees: its cameras side by side.
    Seen {
        /// Pixels of the image for one of the policy's, in each direction.
        scale: usize,
    },
}
