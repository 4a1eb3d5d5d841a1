//! `actrm-zoo eval`

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, bail};
use clap::Args;
use indicatif::ProgressBar;
use zoo::entry::LoadedEntry;
use zoo::evaluation::{EvaluationEnd, EvaluationOptions, FIRST_SEED, Progress, evaluate};
use zoo::leaderboard::LeaderboardRow;
use zoo::registry::Registry;
use zoo::results::{Seeds, Shard, StoredEvaluation};
use zoo::rollout::{Control, Pool, PoolOptions, WorkerSpec, find_python, harness_folder};

use super::puzzles::{PuzzleArgs, evaluate_solver};
use super::{ZooArgs, shown};
use crate::{stop, terminal};

/// Evaluate entries: policies in simulation, one episode a seed; puzzle solvers here, on test puzzles
///
/// Finished episodes are on disk: an interrupted evaluation goes on where it was, a finished one is shown again.
#[derive(Args)]
#[command(after_help = "Examples:
  actrm-zoo eval lift-act --episodes 50
  actrm-zoo eval lift-act@1 stack-act --episodes 100 --workers 2
  actrm-zoo eval --all --episodes 20
  actrm-zoo eval trm-dfs10 --puzzles 600
  actrm-zoo eval trm-dfs10 --task dfs16 --depth 32
  actrm-zoo eval lift-act --episodes 200 --shard 2/8")]
pub struct EvalArgs {
    /// Entries: `name` (its newest version) or `name@version`
    #[arg(required_unless_present = "all")]
    entries: Vec<String>,
    /// Every entry of the zoo
    #[arg(long, conflicts_with = "entries")]
    all: bool,
    /// Episodes an entry
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u64).range(1..))]
    episodes: u64,
    /// Seed of the first episode; the others count up from it
    #[arg(long = "seed-start", alias = "seed", value_name = "SEED", default_value_t = FIRST_SEED)]
    seed: u64,
    /// Control steps after which an episode has failed (the entry's or the task's own cap)
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    max_steps: Option<u64>,
    /// Simulators at once (as many as cores)
    #[arg(long, value_name = "N")]
    workers: Option<usize>,
    /// Another task than the entry's
    #[arg(long)]
    task: Option<String>,
    /// Control loop inside the simulator: `compiled` or `robosuite`
    #[arg(long, default_value = "compiled", value_parser = control)]
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
    /// Folder of results (`results` in the zoo)
    #[arg(long, value_name = "DIR")]
    results: Option<PathBuf>,
    #[command(flatten)]
    puzzles: PuzzleArgs,
    #[command(flatten)]
    zoo: ZooArgs,
}

fn control(text: &str) -> Result<Control, String> {
    [Control::Compiled, Control::Robosuite]
        .into_iter()
        .find(|control| control.as_str() == text)
        .ok_or_else(|| "expected compiled or robosuite".to_owned())
}

pub fn cmd_eval(args: &EvalArgs) -> anyhow::Result<ExitCode> {
    let registry = Registry::open(&args.zoo.zoo);
    let ids = match args.all {
        true => registry.ids()?,
        false => args.entries.iter().map(|name| registry.resolve(name)).collect::<Result<_, _>>()?,
    };
    if ids.is_empty() {
        bail!("no entries in {}; make one with: actrm-zoo train act_lift", shown(&args.zoo.zoo));
    }
    // one set of simulators serves all entries of a task
    let mut by_task: BTreeMap<String, Vec<LoadedEntry>> = BTreeMap::new();
    for id in ids {
        let entry = registry.entry(&id.to_string())?;
        if entry.meta().puzzle.is_some() {
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
        let ends = entries.iter().map(|entry| evaluate_entry(args, entry, &mut pool));
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
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let mut options = PoolOptions::new(spec, args.workers.unwrap_or(cores));
    let asked = Arc::clone(asked);
    options.stop = Arc::new(move || asked.load(Ordering::SeqCst));
    let bar = ProgressBar::new_spinner().with_message(format!("starting simulators for {task}"));
    bar.enable_steady_tick(std::time::Duration::from_millis(200));
    let pool = Pool::start(options);
    bar.finish_and_clear();
    Ok(pool?)
}

/// Whether it was stopped before its end.
fn evaluate_entry(args: &EvalArgs, loaded: &LoadedEntry, pool: &mut Pool) -> anyhow::Result<bool> {
    let id = loaded.entry().id();
    let mut subject = loaded.subject();
    if let Some(max_steps) = args.max_steps {
        subject.max_steps = Some(usize::try_from(max_steps)?);
    }
    let options = EvaluationOptions {
        seeds: Seeds { start: args.seed, count: args.episodes },
        shard: args.shard,
        env_module: args.env_module.clone(),
        force: args.force,
    };
    let results = args.results.clone().unwrap_or_else(|| args.zoo.zoo.join("results"));
    let mut bar = ProgressBar::hidden();
    let mut successes = 0_u64;
    let end = evaluate(&subject, pool, &results, &options, &mut |progress| match progress {
        Progress::Begin { done, total, .. } => {
            bar = terminal::bar("eval", total);
            bar.set_position(done);
            bar.set_message(id.to_string());
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
            Ok(false)
        }
        EvaluationEnd::Stopped { done, total } => {
            eprintln!("{id}: {done} of {total} episodes done");
            Ok(true)
        }
        EvaluationEnd::Failed { done, errors } => {
            let first = errors.into_iter().next().context("an evaluation failed without saying why")?;
            Err(anyhow::Error::new(first).context(format!("entry {id}: {done} episodes done, others could not be run")))
        }
    }
}

/// `lift-act@1 on Lift: 20 of 20 (100.0%, 95% interval 83.9-100.0), mean 44.7 steps to success`
fn summary(evaluation: &StoredEvaluation) -> String {
    let row = LeaderboardRow::new(evaluation);
    let (low, high) = row.interval();
    let mut text = format!(
        "{} on {}: {} of {} ({:.1}%, 95% interval {:.1}-{:.1})",
        row.entry,
        row.task,
        row.successes,
        row.episodes,
        100.0 * row.success_rate(),
        100.0 * low,
        100.0 * high
    );
    if let Some(steps) = row.mean_steps_to_success() {
        text.push_str(&format!(", mean {steps:.1} steps to success"));
    }
    text
}
