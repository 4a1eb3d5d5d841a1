use std::collections::BTreeMap;
use std::fs;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use anyhow::{Context, bail};
use cli::{INTERRUPTED, Screen, SimulatorArgs, Stop, limits, shown};
use report::LeaderboardRow;
use rollout::{Control, Pool, remembered_greeting, video};
use zoo::ZooError;
use zoo::entry::{CamerasMeta, EntryId, EntryMeta, LoadedEntry};
use zoo::evaluation::{
    EvaluationEnd, EvaluationOptions, FIRST_SEED, Progress, Subject, View, evaluate, evaluate_again, film, finished,
};
use zoo::registry::Registry;
use zoo::results::{Execution, Seeds, Shard, StoredEvaluation};

use crate::places::{ResultsArgs, ZooArgs, entry_names};
use crate::puzzles::{PuzzleArgs, evaluate_solver};

const GOES_ON: &str = "stopped; the same command goes on where it was";
/// Behind the line of an evaluation for which nothing was run.
const THERE: &str = " (evaluated before; --again runs it again)";
/// The same for one without a seal.
const UNSEALED: &str = " (evaluated before there were seals: the leaderboard leaves it out until --again seals it)";

fn there(evaluation: &StoredEvaluation) -> &'static str {
    if evaluation.sealed { THERE } else { UNSEALED }
}

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
    /// Evaluate although the demonstrations were recorded in another simulator generation, or with these seeds
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
    // one set of simulators serves all entries of an environment
    let mut by_environment: BTreeMap<EnvironmentKey, Vec<LoadedEntry>> = BTreeMap::new();
    for id in ids {
        match open(args, &registry, &id).with_context(|| format!("entry {id}")) {
            Ok(Some(loaded)) => {
                match EnvironmentKey::of(args, loaded.entry().meta()) {
                    Ok(environment) => by_environment.entry(environment).or_default().push(loaded),
                    Err(error) => failures.push(error.into()),
                }
            }
            Ok(None) => {}
            Err(error) => failures.push(error),
        }
    }
    for (environment, entries) in &by_environment {
        if stop.asked() {
            break;
        }
        if let Err(error) = evaluate_on(args, environment, entries, &stop, &mut failures) {
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

/// What simulators are started for.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord)]
struct EnvironmentKey {
    task: String,
    env_module: Option<String>,
    /// As JSON text.
    env_args: Option<String>,
    cameras: Option<CamerasMeta>,
}

impl EnvironmentKey {
    /// The environment of an entry's demonstrations, unless the command line says otherwise.
    fn of(args: &Args, meta: &EntryMeta) -> Result<Self, ZooError> {
        let recorded = || meta.env_module.as_ref().map(|module| module.name.clone());
        let env_module = args.simulator.env_module.clone().or_else(recorded);
        let cameras = meta.cameras()?;
        Ok(match args.task.clone().filter(|task| *task != meta.task) {
            // another task's environment has arguments of its own
            Some(task) => Self { task, env_module, env_args: None, cameras },
            None => {
                let env_args = meta.env_args.as_ref().map(serde_json::Value::to_string);
                Self { task: meta.task.clone(), env_module, env_args, cameras }
            }
        })
    }
}

/// Says so where the demonstrations were recorded by other rules than the evaluation will play by.
fn note_other_module(meta: &EntryMeta, running: Option<&str>) {
    if let (Some(module), Some(running)) = (&meta.env_module, running)
        && module.sha256 != running
    {
        let (id, name) = (meta.id(), &module.name);
        cli::note(&format!("note: {id}: {name} is not as it was when its demonstrations were recorded"));
    }
}

/// An entry whose policy is to be evaluated; one that solves puzzles is evaluated at once.
fn open(args: &Args, registry: &Registry, id: &EntryId) -> anyhow::Result<Option<LoadedEntry>> {
    let entry = registry.entry(&id.to_string())?;
    if !entry.meta().is_robot_policy() {
        let line = evaluate_solver(&entry, args.task.as_deref(), &args.puzzles, &args.results.folder(&args.zoo))?;
        cli::print(&(line + "\n"))?;
        return Ok(None);
    }
    Ok(Some(entry.load()?))
}

/// Evaluates the entries of an environment on one set of simulators.
fn evaluate_on(
    args: &Args,
    environment: &EnvironmentKey,
    entries: &[LoadedEntry],
    stop: &Stop,
    failures: &mut Vec<anyhow::Error>,
) -> anyhow::Result<()> {
    let task = &environment.task;
    let env_args = environment.env_args.as_deref().map(serde_json::from_str).transpose()?;
    let mut spec = args.simulator.recorded_spec(task, env_args.as_ref())?;
    spec.env_module.clone_from(&environment.env_module);
    if let Some(cameras) = &environment.cameras {
        spec.cameras.clone_from(&cameras.names);
        (spec.image_size, spec.fast_render) = (cameras.size, cameras.fast_render);
    }
    spec.control = args.control;
    spec.limits.step = Duration::from_secs(args.step_timeout);
    let (results, options) = (args.results.folder(&args.zoo), options(args, environment));
    // a finished evaluation is shown without starting a simulator
    let remembered = (!args.again && args.video == 0).then(|| remembered_greeting(&spec)).flatten();
    let mut subjects = Vec::new();
    for loaded in entries {
        let id = loaded.entry().id();
        let done = subject(args, loaded).and_then(|subject| match &remembered {
            Some(ready) => Ok((finished(&subject, ready, &results, &options)?, subject)),
            None => Ok((None, subject)),
        });
        match done.with_context(|| format!("entry {id}")) {
            Ok((Some(evaluation), _)) => cli::print(&(LeaderboardRow::new(&evaluation).summary() + there(&evaluation) + "\n"))?,
            Ok((None, subject)) => subjects.push(subject),
            Err(error) => failures.push(error),
        }
    }
    if subjects.is_empty() {
        return Ok(());
    }
    let Some(mut pool) = args.simulator.start(spec, args.worker_logs.clone(), stop)? else { return Ok(()) };
    for entry in entries {
        note_other_module(entry.entry().meta(), pool.ready().module_sha256.as_deref());
    }
    for subject in &subjects {
        if let Err(error) = evaluate_entry(args, &options, subject, &mut pool, stop) {
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

fn options(args: &Args, environment: &EnvironmentKey) -> EvaluationOptions {
    EvaluationOptions {
        seeds: Seeds { start: args.seed, count: args.episodes },
        shard: args.shard,
        env_module: environment.env_module.clone(),
        force: args.force,
    }
}

/// Evaluates one entry and films it, as far as nobody asks to stop.
fn evaluate_entry(
    args: &Args,
    options: &EvaluationOptions,
    subject: &Subject<'_>,
    pool: &mut Pool,
    stop: &Stop,
) -> anyhow::Result<()> {
    let results = args.results.folder(&args.zoo);
    let stopped = match args.again {
        false => run_missing(subject, pool, &results, options)?.is_none(),
        true => again(subject, pool, &results, options)?,
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
    let mut before = false;
    let end = evaluate(subject, pool, results, options, &mut |progress| match progress {
        Progress::Begin { done, total, .. } => {
            before = done == total;
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
            let there = if before { there(&evaluation) } else { "" };
            cli::print(&(LeaderboardRow::new(&evaluation).summary() + there + "\n"))?;
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

/// Runs episodes of a finished evaluation once more and compares; whether it was stopped.
fn again(subject: &Subject<'_>, pool: &mut Pool, results: &Path, options: &EvaluationOptions) -> anyhow::Result<bool> {
    if subject.time_decides {
        bail!("entry {}: it thinks by the clock, so its episodes may end otherwise: nothing to compare", subject.entry);
    }
    let id = subject.entry.to_string();
    let mut screen = Screen::new();
    let mut advance = screen.advance("again");
    let end = evaluate_again(subject, pool, results, options, &mut advance);
    drop(advance);
    drop(screen);
    let again = end?;
    if let Some(error) = again.errors.into_iter().next() {
        return Err(anyhow::Error::new(error).context(format!("entry {id}: an episode could not be run again")));
    }
    for (name, stored, now) in &again.versions {
        cli::note(&format!("note: {id}: evaluated with {name} {stored}, run again with {name} {now}"));
    }
    if let Some((stored, now)) = again.different.first() {
        let (count, of, seed) = (again.different.len(), again.episodes, stored.seed);
        bail!("entry {id}: {count} of {of} outcomes differ, the first of seed {seed}: stored {stored:?}, now {now:?}");
    }
    if again.sealed {
        cli::note(&format!("{id}: its results had no seal, and have one now"));
    }
    if again.episodes < again.wanted {
        cli::note(&format!("{id}: {} of {} episodes run again, every outcome the same", again.episodes, again.wanted));
        return Ok(true);
    }
    let of = if again.stored > again.wanted { format!(" of {}", again.stored) } else { String::new() };
    cli::print(&format!("{id}: {}{of} episodes run again, every outcome the same\n", again.episodes))?;
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
