use std::collections::BTreeMap;
use std::fs;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use anyhow::{Context, bail};
use cli::{INTERRUPTED, Screen, SimulatorArgs, Stop, limits, shown};
use report::LeaderboardRow;
use rollout::{Control, Pool, video};
use zoo::entry::{EntryId, LoadedEntry};
use zoo::evaluation::{EvaluationEnd, EvaluationOptions, FIRST_SEED, Progress, Subject, View, evaluate, film};
use zoo::registry::Registry;
use zoo::results::{Execution, ResultsFolder, Seeds, Shard, StoredEvaluation};

use crate::places::{ResultsArgs, ZooArgs, entry_names};
use crate::puzzles::{PuzzleArgs, evaluate_solver};

const GOES_ON: &str = "stopped; the same command goes on where it was";

/// Evaluate entries: policies in simulation, one episode a seed; puzzle solvers here, on test puzzles
///
/// Finished episodes are on disk: an interrupted evaluation goes on where it was, a finished one is shown again. The
/// outcome of an episode does not depend on the number of workers, on their failures or on what ran before.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo eval lift-act --episodes 50
  actrm-zoo eval lift-act@1 stack-act --episodes 100 --workers 2
  actrm-zoo eval --all --episodes 20
  actrm-zoo eval trm-dfs10 --puzzles 600
  actrm-zoo eval trm-dfs10 --task dfs16 --depth 32
  actrm-zoo eval lift-act --episodes 3 --video 3
  actrm-zoo eval lift-act --episodes 50 --again
  actrm-zoo eval lift-act --episodes 200 --shard 2/8")]
pub struct Args {
    /// Entries: `name` (its newest version) or `name@version`
    #[arg(required_unless_present_any = ["all", "all_versions"], add = entry_names())]
    entries: Vec<String>,
    /// The newest version of every entry of the zoo
    #[arg(long, conflicts_with = "entries")]
    all: bool,
    /// Every version of every entry of the zoo
    #[arg(long, conflicts_with = "entries")]
    all_versions: bool,
    /// Episodes an entry
    #[arg(long, default_value_t = 20,
        value_parser = clap::value_parser!(u64).range(1..=limits::MOST_EPISODES))]
    episodes: u64,
    /// Seed of the first episode; the others count up from it
    #[arg(long = "seed-start", alias = "seed", value_name = "SEED", default_value_t = FIRST_SEED)]
    seed: u64,
    /// Control steps after which an episode has failed (the entry's or the task's own cap)
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=limits::MOST_STEPS))]
    max_steps: Option<u64>,
    /// Actions that are executed before the policy is asked again (the entry's)
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    n_action_steps: Option<u64>,
    /// Ask at every step and average all predictions for it, with this coefficient (ACT's paper: 0.01)
    #[arg(long, value_name = "C", conflicts_with = "n_action_steps", allow_negative_numbers = true)]
    temporal_ensemble: Option<f64>,
    #[command(flatten)]
    simulator: SimulatorArgs,
    /// Another task than the entry's
    #[arg(long)]
    task: Option<String>,
    /// Control loop inside the simulator: `compiled` or `robosuite`
    #[arg(long, default_value_t = Control::Compiled)]
    control: Control,
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
    #[arg(long, value_name = "S", default_value_t = 30, value_parser = clap::value_parser!(u64).range(1..=86_400))]
    step_timeout: u64,
    /// Keep what workers say on standard error in this folder
    #[arg(long, value_name = "DIR")]
    worker_logs: Option<PathBuf>,
    #[command(flatten)]
    results: ResultsArgs,
    #[command(flatten)]
    puzzles: PuzzleArgs,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    limits::check_seeds(args.seed, args.episodes)?;
    limits::workers(args.simulator.workers)?;
    let registry = args.zoo.registry();
    let ids = match (args.all_versions, args.all) {
        (true, _) => registry.ids()?,
        (false, true) => registry.newest()?,
        (false, false) => args.entries.iter().map(|name| registry.resolve(name)).collect::<Result<_, _>>()?,
    };
    if ids.is_empty() {
        bail!("no entries in {}; make one with: actrm-zoo train act_lift", shown(&args.zoo.zoo));
    }
    let stop = Stop::install(GOES_ON)?;
    // one bad entry must not keep the others from being evaluated
    let mut failures: Vec<anyhow::Error> = Vec::new();
    // one set of simulators serves all entries of a task
    let mut by_task: BTreeMap<String, Vec<LoadedEntry>> = BTreeMap::new();
    for id in ids {
        match open(args, &registry, &id).with_context(|| format!("entry {id}")) {
            Ok(Some((task, loaded))) => by_task.entry(task).or_default().push(loaded),
            Ok(None) => {}
            Err(error) => failures.push(error),
        }
    }
    for (task, entries) in &by_task {
        if stop.asked() {
            break;
        }
        if let Err(error) = evaluate_task(args, task, entries, &stop, &mut failures) {
            failures.push(error);
        }
    }
    if stop.asked() {
        cli::note(GOES_ON);
        return Ok(ExitCode::from(INTERRUPTED));
    }
    for failure in &failures {
        cli::note(&format!("error: {failure:#}"));
    }
    Ok(if failures.is_empty() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// An entry with the task that its policy is to be evaluated on; one that solves puzzles is evaluated at once.
fn open(args: &Args, registry: &Registry, id: &EntryId) -> anyhow::Result<Option<(String, LoadedEntry)>> {
    let entry = registry.entry(&id.to_string())?;
    if !entry.meta().is_robot_policy() {
        let line = evaluate_solver(&entry, args.task.as_deref(), &args.puzzles, &args.results.folder(&args.zoo))?;
        cli::print(&(line + "\n"))?;
        return Ok(None);
    }
    let loaded = entry.load()?;
    let task = args.task.clone().unwrap_or_else(|| loaded.entry().meta().task.clone());
    Ok(Some((task, loaded)))
}

/// Evaluates the entries of a task on one set of simulators.
fn evaluate_task(
    args: &Args,
    task: &str,
    entries: &[LoadedEntry],
    stop: &Stop,
    failures: &mut Vec<anyhow::Error>,
) -> anyhow::Result<()> {
    let mut subjects = Vec::new();
    for loaded in entries {
        let id = loaded.entry().id();
        match subject(args, loaded).with_context(|| format!("entry {id}")) {
            Ok(subject) => subjects.push(subject),
            Err(error) => failures.push(error),
        }
    }
    if subjects.is_empty() {
        return Ok(());
    }
    let mut spec = args.simulator.spec(task)?;
    spec.control = args.control;
    spec.limits.step = Duration::from_secs(args.step_timeout);
    let Some(mut pool) = args.simulator.start(spec, args.worker_logs.clone(), stop)? else { return Ok(()) };
    for subject in &subjects {
        if let Err(error) = evaluate_entry(args, subject, &mut pool, stop) {
            failures.push(error);
        }
        if stop.asked() {
            break;
        }
    }
    let incidents = pool.incidents().len();
    pool.close();
    if incidents > 0 {
        cli::note(&format!("note: {incidents} worker failures on {task}; the episodes were run again"));
    }
    Ok(())
}

/// The entry as the command line wants it to act.
fn subject(args: &Args, loaded: &LoadedEntry) -> anyhow::Result<Subject<'static>> {
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
        limits::check_coefficient(coefficient, loaded.experiment().policy.action_horizon())?;
        subject.execution = Execution::TemporalEnsemble { coefficient };
    }
    Ok(subject)
}

/// Evaluates one entry and films it, as far as nobody asks to stop.
fn evaluate_entry(args: &Args, subject: &Subject<'_>, pool: &mut Pool, stop: &Stop) -> anyhow::Result<()> {
    let options = EvaluationOptions {
        seeds: Seeds { start: args.seed, count: args.episodes },
        shard: args.shard,
        env_module: args.simulator.env_module.clone(),
        force: args.force,
    };
    let results = args.results.folder(&args.zoo);
    let stopped = match args.again {
        false => run_missing(subject, pool, &results, &options)?.is_none(),
        true => again(subject, pool, &results, &options)?,
    };
    if !stopped && args.video > 0 && !stop.asked() {
        videos(args, subject, pool)?;
    }
    Ok(())
}

/// Runs what has no outcome yet and says how it went; nothing if it was stopped.
fn run_missing(
    subject: &Subject<'_>,
    pool: &mut Pool,
    results: &Path,
    options: &EvaluationOptions,
) -> anyhow::Result<Option<Box<StoredEvaluation>>> {
    let id = subject.entry.to_string();
    let mut screen = Screen::new();
    let mut successes = 0_u64;
    let end = evaluate(subject, pool, results, options, &mut |progress| match progress {
        Progress::Begin { done, total, .. } => {
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
    match end.with_context(|| format!("entry {id}"))? {
        EvaluationEnd::Complete(evaluation) => {
            cli::print(&(LeaderboardRow::new(&evaluation).summary() + "\n"))?;
            Ok(Some(evaluation))
        }
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

/// Runs a finished evaluation once more beside itself and compares; whether it was stopped.
fn again(subject: &Subject<'_>, pool: &mut Pool, results: &Path, options: &EvaluationOptions) -> anyhow::Result<bool> {
    let record = subject.record(pool.ready(), options)?;
    let folder = results.join(record.folder_name());
    if StoredEvaluation::read(&folder).ok().flatten().is_none() {
        bail!("entry {}: nothing to run again: no finished evaluation {}", subject.entry, shown(&folder));
    }
    let beside = results.join(format!(".again-{}", std::process::id()));
    let now = run_missing(subject, pool, &beside, options);
    fs::remove_dir_all(&beside).with_context(|| format!("removing {}", shown(&beside)))?;
    let Some(now) = now? else { return Ok(true) };
    let mut before = ResultsFolder::open(results, &record)?;
    for (episode, timing) in now.episodes.iter().zip(&now.timings) {
        before.add(episode.clone(), timing.clone())?;
    }
    cli::print(&format!("{}: {} episodes run again, every outcome the same\n", subject.entry, now.episodes.len()))?;
    Ok(false)
}

/// Films the first episodes; the path of each video is printed.
fn videos(args: &Args, subject: &Subject<'_>, pool: &mut Pool) -> anyhow::Result<()> {
    let folder = args.zoo.zoo.join("videos").join(subject.entry.to_string());
    fs::create_dir_all(&folder).with_context(|| format!("creating {}", shown(&folder)))?;
    let count = args.video.min(args.episodes);
    let seeds: Vec<u64> = (args.seed..args.seed.saturating_add(count)).collect();
    let (side, rate) = (usize::from(args.video_size), pool.ready().control_freq);
    let view = View { camera: args.camera.clone(), height: side, width: side };
    let python = args.simulator.python()?;
    let task = pool.ready().task.clone();
    let mut screen = Screen::new();
    screen.begin("film", count);
    let mut failure: Option<anyhow::Error> = None;
    film(subject, pool, &seeds, &view, &mut |seed, images, success| {
        let word = if success { "success" } else { "failure" };
        let path = folder.join(format!("{task}-{seed}-{word}.mp4"));
        screen.step();
        let written = video::write(&python, &path, &images, rate).map_err(anyhow::Error::from);
        match written.and_then(|()| screen.print(&(shown(&path) + "\n"))) {
            Ok(()) => ControlFlow::Continue(()),
            Err(error) => {
                failure = Some(error);
                ControlFlow::Break(())
            }
        }
    })?;
    drop(screen);
    failure.map_or(Ok(()), Err)
}
