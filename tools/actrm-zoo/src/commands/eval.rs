//! `actrm-zoo eval`

use std::collections::BTreeMap;
use std::fs;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::{Context, bail};
use clap::Args;
use indicatif::ProgressBar;
use report::{LeaderboardRow, wilson_interval};
use rollout::{Control, Pool, PoolOptions, RolloutError, WorkerSpec, find_python, harness_folder, video};
use zoo::entry::LoadedEntry;
use zoo::evaluation::{EvaluationEnd, EvaluationOptions, FIRST_SEED, Progress, Subject, View, evaluate, film};
use zoo::registry::Registry;
use zoo::results::{Execution, ResultsFolder, Seeds, Shard, StoredEvaluation};

use super::puzzles::{PuzzleArgs, evaluate_solver};
use super::{ZooArgs, shown};
use crate::{stop, terminal};

/// Evaluate entries: policies in simulation, one episode a seed; puzzle solvers here, on test puzzles
///
/// Finished episodes are on disk: an interrupted evaluation goes on where it was, a finished one is shown again. The
/// outcome of an episode does not depend on the number of workers, on their failures or on what ran before.
#[derive(Args)]
#[command(after_help = "Examples:
  actrm-zoo eval lift-act --episodes 50
  actrm-zoo eval lift-act@1 stack-act --episodes 100 --workers 2
  actrm-zoo eval --all --episodes 20
  actrm-zoo eval trm-dfs10 --puzzles 600
  actrm-zoo eval trm-dfs10 --task dfs16 --depth 32
  actrm-zoo eval lift-act --episodes 3 --video 3
  actrm-zoo eval lift-act --episodes 50 --again
  actrm-zoo eval lift-act --episodes 200 --shard 2/8")]
pub struct EvalArgs {
    /// Entries: `name` (its newest version) or `name@version`
    #[arg(required_unless_present_any = ["all", "all_versions"])]
    entries: Vec<String>,
    /// The newest version of every entry of the zoo
    #[arg(long, conflicts_with = "entries")]
    all: bool,
    /// Every version of every entry of the zoo
    #[arg(long, conflicts_with = "entries")]
    all_versions: bool,
    /// Episodes an entry
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u64).range(1..))]
    episodes: u64,
    /// Seed of the first episode; the others count up from it
    #[arg(long = "seed-start", alias = "seed", value_name = "SEED", default_value_t = FIRST_SEED)]
    seed: u64,
    /// Control steps after which an episode has failed (the entry's or the task's own cap)
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    max_steps: Option<u64>,
    /// Actions that are executed before the policy is asked again (the entry's)
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    n_action_steps: Option<u64>,
    /// Ask at every step and average all predictions for it, with this coefficient (ACT's paper: 0.01)
    #[arg(long, value_name = "C", conflicts_with = "n_action_steps")]
    temporal_ensemble: Option<f64>,
    /// Simulators at once (as many as cores)
    #[arg(long, value_name = "N")]
    workers: Option<usize>,
    /// Another task than the entry's
    #[arg(long)]
    task: Option<String>,
    /// Control loop inside the simulator: `compiled` or `robosuite`
    #[arg(long, default_value_t = Control::Compiled)]
    control: Control,
    /// Python module that registers environments of your own
    #[arg(long, value_name = "MODULE")]
    env_module: Option<String>,
    /// Python with robosuite
    #[arg(long, value_name = "PATH", env = "ACTRM_PYTHON")]
    python: Option<PathBuf>,
    /// Only this part of the episodes, for several machines
    #[arg(long, value_name = "I/N")]
    shard: Option<Shard>,
    /// Evaluate although the demonstrations were recorded in another simulator generation
    #[arg(long)]
    force: bool,
    /// Run finished evaluations again, and fail where an outcome is not the same
    #[arg(long)]
    again: bool,
    /// Then write videos of the first N episodes into `videos` in the zoo
    #[arg(long, value_name = "N", default_value_t = 0)]
    video: u64,
    /// Camera of the videos
    #[arg(long, value_name = "NAME", default_value = "agentview")]
    camera: String,
    /// Side of the videos in pixels
    #[arg(long, value_name = "PIXELS", default_value_t = 256, value_parser = clap::value_parser!(u16).range(16..=2048))]
    video_size: u16,
    /// Seconds without an answer after which a worker counts as hung
    #[arg(long, value_name = "S", default_value_t = 30, value_parser = clap::value_parser!(u64).range(1..))]
    step_timeout: u64,
    /// Keep what workers say on standard error in this folder
    #[arg(long, value_name = "DIR")]
    worker_logs: Option<PathBuf>,
    /// Folder of results (`results` in the zoo)
    #[arg(long, value_name = "DIR")]
    results: Option<PathBuf>,
    #[command(flatten)]
    puzzles: PuzzleArgs,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn cmd_eval(args: &EvalArgs) -> anyhow::Result<ExitCode> {
    let registry = Registry::open(&args.zoo.zoo);
    let ids = match (args.all_versions, args.all) {
        (true, _) => registry.ids()?,
        (false, true) => registry.newest()?,
        (false, false) => args.entries.iter().map(|name| registry.resolve(name)).collect::<Result<_, _>>()?,
    };
    if ids.is_empty() {
        bail!("no entries in {}; make one with: actrm-zoo train act_lift", shown(&args.zoo.zoo));
    }
    // one set of simulators serves all entries of a task
    let mut by_task: BTreeMap<String, Vec<LoadedEntry>> = BTreeMap::new();
    for id in ids {
        let entry = registry.entry(&id.to_string())?;
        if !entry.meta().is_robot_policy() {
            let results = args.results.clone().unwrap_or_else(|| args.zoo.zoo.join("results"));
            let evaluated = evaluate_solver(&entry, args.task.as_deref(), &args.puzzles, &results);
            println!("{}", evaluated.with_context(|| format!("entry {id}"))?);
            continue;
        }
        let loaded = entry.load().with_context(|| format!("entry {id}"))?;
        let task = args.task.clone().unwrap_or_else(|| loaded.entry().meta().task.clone());
        by_task.entry(task).or_default().push(loaded);
    }
    let asked = stop::install()?;
    for (task, entries) in &by_task {
        let mut pool = start(args, task, &asked)?;
        let ends = entries.iter().map(|entry| evaluate_entry(args, entry, &mut pool, &asked));
        let stopped = ends.collect::<anyhow::Result<Vec<bool>>>();
        let incidents = pool.incidents().len();
        pool.close();
        if incidents > 0 {
            eprintln!("note: {incidents} worker failures on {task}; the episodes were run again");
        }
        if stopped?.contains(&true) || asked.load(Ordering::SeqCst) {
            eprintln!("stopped; the same command goes on where it was");
            return Ok(ExitCode::from(stop::INTERRUPTED));
        }
    }
    Ok(ExitCode::SUCCESS)
}

fn start(args: &EvalArgs, task: &str, asked: &Arc<AtomicBool>) -> anyhow::Result<Pool> {
    let python = find_python(args.python.as_deref())?;
    let mut spec = WorkerSpec::new(python, harness_folder()?, task);
    spec.control = args.control;
    spec.env_module.clone_from(&args.env_module);
    spec.limits.step = Duration::from_secs(args.step_timeout);
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let mut options = PoolOptions::new(spec, args.workers.unwrap_or(cores));
    options.logs.clone_from(&args.worker_logs);
    let asked = Arc::clone(asked);
    options.stop = Arc::new(move || asked.load(Ordering::SeqCst));
    let bar = ProgressBar::new_spinner().with_message(format!("starting simulators for {task}"));
    bar.enable_steady_tick(Duration::from_millis(200));
    let pool = Pool::start(options);
    bar.finish_and_clear();
    let pool = pool?;
    if let Some(why) = pool.fallback() {
        eprintln!("note: {why}");
    }
    Ok(pool)
}

/// The entry as the command line wants it to act.
fn subject(args: &EvalArgs, loaded: &LoadedEntry) -> anyhow::Result<Subject<'static>> {
    let mut subject = loaded.subject();
    if let Some(max_steps) = args.max_steps {
        subject.max_steps = Some(usize::try_from(max_steps)?);
    }
    if let Some(n_action_steps) = args.n_action_steps {
        let (n_action_steps, most) = (usize::try_from(n_action_steps)?, loaded.experiment().policy.action_horizon());
        if n_action_steps > most {
            bail!("--n-action-steps: expected at most the action horizon, {most}, found {n_action_steps}");
        }
        subject.execution = Execution::RecedingHorizon { n_action_steps };
    }
    if let Some(coefficient) = args.temporal_ensemble {
        if !coefficient.is_finite() {
            bail!("--temporal-ensemble: expected a finite number, found {coefficient}");
        }
        subject.execution = Execution::TemporalEnsemble { coefficient };
    }
    Ok(subject)
}

/// Whether it was stopped before its end.
fn evaluate_entry(args: &EvalArgs, loaded: &LoadedEntry, pool: &mut Pool, asked: &AtomicBool) -> anyhow::Result<bool> {
    let id = loaded.entry().id();
    let subject = subject(args, loaded).with_context(|| format!("entry {id}"))?;
    let options = EvaluationOptions {
        seeds: Seeds { start: args.seed, count: args.episodes },
        shard: args.shard,
        env_module: args.env_module.clone(),
        force: args.force,
    };
    let results = args.results.clone().unwrap_or_else(|| args.zoo.zoo.join("results"));
    let stopped = match args.again {
        false => run(&subject, pool, &results, &options)?.is_none(),
        true => again(&subject, pool, &results, &options)?,
    };
    if !stopped && args.video > 0 && !asked.load(Ordering::SeqCst) {
        videos(args, &subject, pool)?;
    }
    Ok(stopped)
}

/// Runs what has no outcome yet and says how it went; nothing if it was stopped.
fn run(
    subject: &Subject<'_>,
    pool: &mut Pool,
    results: &Path,
    options: &EvaluationOptions,
) -> anyhow::Result<Option<Box<StoredEvaluation>>> {
    let id = subject.entry.to_string();
    let mut bar = ProgressBar::hidden();
    let mut successes = 0_u64;
    let end = evaluate(subject, pool, results, options, &mut |progress| match progress {
        Progress::Begin { done, total, .. } => {
            bar = terminal::bar("eval", total);
            bar.set_position(done);
            bar.set_message(id.clone());
        }
        Progress::Episode(episode) => {
            successes += u64::from(episode.success);
            bar.inc(1);
            bar.set_message(format!("{id}: {successes} successes"));
        }
    });
    bar.finish_and_clear();
    match end.with_context(|| format!("entry {id}"))? {
        EvaluationEnd::Complete(evaluation) => {
            println!("{}", summary(&evaluation));
            Ok(Some(evaluation))
        }
        EvaluationEnd::Stopped { done, total } => {
            eprintln!("{id}: {done} of {total} episodes done");
            Ok(None)
        }
        EvaluationEnd::Failed { done, errors } => {
            let first = errors.into_iter().next().context("an evaluation failed without saying why")?;
            Err(anyhow::Error::new(first).context(format!("entry {id}: {done} episodes done, others could not be run")))
        }
    }
}

/// Runs a finished evaluation once more beside itself and compares; whether it was stopped.
fn again(subject: &Subject<'_>, pool: &mut Pool, results: &Path, options: &EvaluationOptions) -> anyhow::Result<bool> {
    let record = subject.record(pool.ready(), options)?;
    let folder = results.join(record.folder_name());
    if StoredEvaluation::read(&folder).ok().flatten().is_none() {
        bail!("entry {}: nothing to run again: no finished evaluation {}", subject.entry, shown(&folder));
    }
    let beside = results.join(format!(".again-{}", std::process::id()));
    let now = run(subject, pool, &beside, options);
    fs::remove_dir_all(&beside).with_context(|| format!("removing {}", shown(&beside)))?;
    let Some(now) = now? else { return Ok(true) };
    let mut before = ResultsFolder::open(results, &record)?;
    for (episode, timing) in now.episodes.iter().zip(&now.timings) {
        before.add(episode.clone(), timing.clone())?;
    }
    println!("{}: {} episodes run again, every outcome the same", subject.entry, now.episodes.len());
    Ok(false)
}

/// Films the first episodes; the path of each video is printed.
fn videos(args: &EvalArgs, subject: &Subject<'_>, pool: &mut Pool) -> anyhow::Result<()> {
    let folder = args.zoo.zoo.join("videos").join(subject.entry.to_string());
    fs::create_dir_all(&folder).with_context(|| format!("creating {}", shown(&folder)))?;
    let count = args.video.min(args.episodes);
    let seeds: Vec<u64> = (args.seed..args.seed.saturating_add(count)).collect();
    let (side, rate) = (usize::from(args.video_size), pool.ready().control_freq);
    let view = View { camera: args.camera.clone(), height: side, width: side };
    let python = find_python(args.python.as_deref())?;
    let task = pool.ready().task.clone();
    let bar = terminal::bar("film", count);
    let mut failure: Option<RolloutError> = None;
    film(subject, pool, &seeds, &view, &mut |seed, images, success| {
        let word = if success { "success" } else { "failure" };
        let path = folder.join(format!("{task}-{seed}-{word}.mp4"));
        bar.inc(1);
        match video::write(&python, &path, &images, rate) {
            Ok(()) => {
                bar.suspend(|| println!("{}", shown(&path)));
                ControlFlow::Continue(())
            }
            Err(error) => {
                failure = Some(error);
                ControlFlow::Break(())
            }
        }
    })?;
    bar.finish_and_clear();
    failure.map_or(Ok(()), |error| Err(error.into()))
}

/// `lift-act@1 on Lift: 20 of 20 (100.0%, 95% interval 83.9-100.0), mean 44.7 steps to success`, and a line for each
/// group of episodes.
fn summary(evaluation: &StoredEvaluation) -> String {
    let row = LeaderboardRow::new(evaluation);
    let rate = |successes: u64, episodes: u64| {
        let (low, high) = wilson_interval(successes, episodes);
        let (rate, low, high) = (100.0 * successes as f64 / episodes.max(1) as f64, 100.0 * low, 100.0 * high);
        format!("{successes} of {episodes} ({rate:.1}%, 95% interval {low:.1}-{high:.1})")
    };
    let mut text = format!("{} on {}: {}", row.entry, row.task, rate(row.successes, row.episodes));
    if let Some(steps) = row.mean_steps_to_success() {
        text.push_str(&format!(", mean {steps:.1} steps to success"));
    }
    for (group, counts) in &row.groups {
        text.push_str(&format!("\n  {group}: {}", rate(counts.successes, counts.episodes)));
    }
    text
}
