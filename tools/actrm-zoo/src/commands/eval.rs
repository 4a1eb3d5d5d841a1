use std::collections::BTreeMap;
use std::fs;
use std::ops::ControlFlow;
use std::path::Path;
use std::process::ExitCode;

use anyhow::{Context, bail};
use cli::{INTERRUPTED, Screen, Stop, limits, shown};
use models::{DeviceChoice, FeatureKind};
use recording::CollectOptions;
use report::{COLUMNS, LeaderboardRow, json};
use rollout::{Pool, Ready, remembered_greeting};
use serde_json::{Value, json};
use zoo::entry::{EntryId, EntryMeta, LoadedEntry};
use zoo::evaluation::{
    Environment, EvaluationOptions, FIRST_SEED, Perturbation, Subject, View, evaluate_again, finished, record_videos,
};
use zoo::protocols::NamedProtocol;
use zoo::registry::Registry;
use zoo::results::{Execution, Seeds, Shard, StoredEvaluation};

use crate::places::{BlockArg, ProtocolArgs, ResultsArgs, ZooArgs, entry_names, of_entry};
use crate::puzzles::{self, PuzzleArgs};
use crate::remote::{Remote, RemoteArgs};
use crate::simulation::{Evaluated, RunArgs, environment, limited_worker, run_missing, start};
use crate::videos;

/// Headings of its help.
const EPISODES: &str = "Episodes";
const EXECUTION: &str = "Execution";
const VIDEO: &str = "Videos";
const OUTPUT: &str = "Output";

const GOES_ON: &str = "stopped; run the same command again to resume";
/// Behind the line of an evaluation for which nothing was run.
const THERE: &str = " (evaluated before; --again runs it again)";
/// The same for one without a seal.
const UNSEALED: &str = " (evaluated before there were seals: the leaderboard leaves it out until --again seals it)";

fn there(evaluation: &StoredEvaluation) -> &'static str {
    if evaluation.sealed { THERE } else { UNSEALED }
}

/// Evaluate entries: robot policies in the simulator, puzzle solvers on test puzzles
///
/// Every finished episode is saved. The same command resumes an interrupted evaluation and shows a finished one. The outcome
/// of an episode does not depend on the number of workers, on their failures or on earlier episodes.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo eval lift-act --episodes 50
  actrm-zoo eval lift-act@1 stack-act --episodes 100 --workers 2
  actrm-zoo eval 'lift-act-s*' --protocol lift-v1
  actrm-zoo eval --all --episodes 20
  actrm-zoo eval trm-dfs10 --puzzles 600
  actrm-zoo eval trm-dfs10 --task dfs16 --depth 32
  actrm-zoo eval trm-dfs10 --task dfs20 --depth 64 --views 8 --starts 2 --judge cells
  actrm-zoo eval lift-act --episodes 3 --video 3
  actrm-zoo eval lift-act-image-s1 --episodes 100 --video-failed 3
  actrm-zoo eval lift-act-image-s1 --episodes 100 --perturb black-agentview
  actrm-zoo eval lift-act --episodes 50 --again
  actrm-zoo eval lift-act --episodes 50 --robots Sawyer
  actrm-zoo eval lift-act --episodes 200 --shard 2/8
  actrm-zoo eval --policy ws://127.0.0.1:8000 --name mine --protocol lift-v1")]
pub struct Args {
    /// Entries: `name` (its newest version), `name@version`, or a pattern with `*`
    #[arg(required_unless_present_any = ["all", "all_versions", "policy"], add = entry_names())]
    entries: Vec<String>,
    /// The newest version of every entry of the zoo
    #[arg(long, conflicts_with = "entries")]
    all: bool,
    /// Every version of every entry of the zoo
    #[arg(long, conflicts_with = "entries")]
    all_versions: bool,
    /// Use the seeds, step limit and control loop of a named protocol, such as lift-v1
    #[arg(long, help_heading = EPISODES, value_name = "NAME", conflicts_with_all = ["episodes", "seed", "max_steps", "control", "robots", "shard"])]
    protocol: Option<String>,
    /// Seeds of the protocol: `test` to report results, `dev` to choose between policies
    #[arg(long, help_heading = EPISODES, value_name = "BLOCK", default_value = "test", requires = "protocol")]
    block: BlockArg,
    #[command(flatten, next_help_heading = EPISODES)]
    protocols: ProtocolArgs,
    /// Episodes per entry [default: 20]
    #[arg(long, short = 'n', help_heading = EPISODES, value_name = "N", value_parser = limits::episodes)]
    episodes: Option<u64>,
    /// Seed of the first episode; the seeds after it count up [default: 10000]. Of a puzzle solver, the seed of its test puzzles
    /// [default: 20000]
    #[arg(long = "seed-start", help_heading = EPISODES, alias = "seed", value_name = "SEED")]
    seed: Option<u64>,
    /// Actions that are executed before the next query of the policy [default: the entry's]
    #[arg(long, help_heading = EXECUTION, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    n_action_steps: Option<u64>,
    /// Query at every step and average the predictions for it with this coefficient (ACT's paper: 0.01)
    #[arg(long, help_heading = EXECUTION, value_name = "C", conflicts_with = "n_action_steps", allow_negative_numbers = true)]
    temporal_ensemble: Option<f64>,
    /// Where policies predict: `cpu`, `auto` (the first GPU, else the CPU), `cuda` or `cuda:N`; results name the GPU
    #[arg(long, help_heading = EXECUTION, value_name = "DEVICE", default_value_t = DeviceChoice::Cpu)]
    device: DeviceChoice,
    #[command(flatten, next_help_heading = EXECUTION)]
    run: RunArgs,
    /// Run only this part of the episodes, so that several machines can share them
    #[arg(long, help_heading = EPISODES, value_name = "I/N")]
    shard: Option<Shard>,
    /// Run finished evaluations again and fail if an outcome differs
    #[arg(long, help_heading = EPISODES)]
    again: bool,
    /// Write videos of the first N episodes into `videos` in the zoo
    #[arg(long, help_heading = VIDEO, value_name = "N", default_value_t = 0)]
    video: u64,
    /// Write videos of the first N failed episodes, with the policy's cameras side by side
    #[arg(long, help_heading = VIDEO, value_name = "N", default_value_t = 0, conflicts_with_all = ["shard", "again"])]
    video_failed: u64,
    /// Perturb the images that the policy gets: swap-cameras, black-CAMERA, hue[=TURN] or light[=FACTOR]
    #[arg(long, help_heading = EXECUTION, value_name = "HOW", conflicts_with = "protocol")]
    perturb: Option<Perturbation>,
    /// Camera of the videos
    #[arg(long, help_heading = VIDEO, value_name = "NAME", default_value = "agentview")]
    camera: String,
    /// Width and height of the videos in pixels, an even number
    #[arg(long, help_heading = VIDEO, value_name = "PIXELS", default_value_t = 256, value_parser = limits::video_side::<2048>)]
    video_size: u16,
    /// Print the results as JSON, with the names of the leaderboard's columns
    #[arg(long, help_heading = OUTPUT)]
    json: bool,
    #[command(flatten, next_help_heading = OUTPUT)]
    results: ResultsArgs,
    #[command(flatten, next_help_heading = "Policies of others")]
    remote: RemoteArgs,
    #[command(flatten, next_help_heading = "Puzzle solvers")]
    puzzles: PuzzleArgs,
    #[command(flatten, next_help_heading = OUTPUT)]
    zoo: ZooArgs,
}

/// What is said of each evaluation: a line at once, or all of it as JSON at the end.
struct Says {
    as_json: bool,
    all: Vec<Value>,
}

impl Says {
    fn say(&mut self, line: &str, value: Value) -> anyhow::Result<()> {
        match self.as_json {
            true => self.all.push(value),
            false => cli::print(line)?,
        }
        Ok(())
    }

    fn evaluation(&mut self, evaluation: &StoredEvaluation, was_there: bool) -> anyhow::Result<()> {
        let row = LeaderboardRow::new(evaluation);
        let mut value = json::object(COLUMNS, &row);
        value.insert("evaluated_before".to_owned(), was_there.into());
        value.insert("sealed".to_owned(), evaluation.sealed.into());
        value.insert("folder".to_owned(), cli::lossy(&evaluation.folder).into());
        let there = if was_there { there(evaluation) } else { "" };
        self.say(&(row.summary() + there + "\n"), value.into())
    }
}

/// The seeds and rules that were asked for.
struct Asked<'a> {
    seeds: Seeds,
    protocol: Option<&'a NamedProtocol>,
}

impl Asked<'_> {
    fn check_task(&self, task: &str) -> anyhow::Result<()> {
        match self.protocol.filter(|protocol| protocol.task != task) {
            Some(protocol) => bail!("protocol {}: task: expected {}, found {task}", protocol.name, protocol.task),
            None => Ok(()),
        }
    }

    /// Says so where an evaluation does not count as the protocol's.
    fn note_doubt(&self, evaluation: &StoredEvaluation) {
        if let Some(doubt) = self.protocol.and_then(|protocol| protocol.doubt(&evaluation.record)) {
            cli::note(&format!("note: {doubt}"));
        }
    }
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let protocols = args.protocols.protocols()?;
    let protocol = args.protocol.as_deref().map(|name| protocols.get(name)).transpose()?;
    let seeds = match protocol {
        Some(protocol) => protocol.seeds(args.block.into()),
        None => Seeds { start: args.seed.unwrap_or(FIRST_SEED), count: args.episodes.unwrap_or(20) },
    };
    let asked = Asked { seeds, protocol };
    limits::check_seeds(seeds.start, seeds.count)?;
    limits::workers(args.run.simulator.workers)?;
    let registry = args.zoo.registry();
    let mut says = Says { as_json: args.json, all: Vec::new() };
    let task = args.run.task.as_deref();
    if let Some(remote) = args.remote.policy(task.or(protocol.map(|protocol| protocol.task.as_str())))? {
        let stop = Stop::install(GOES_ON)?;
        evaluate_remote(args, &asked, &remote, &stop, &mut says)?;
        if says.as_json {
            cli::print_json(&says.all)?;
        }
        return Ok(if stop.asked() { ExitCode::from(INTERRUPTED) } else { ExitCode::SUCCESS });
    }
    let ids: Vec<EntryId> = match (args.all_versions, args.all) {
        (true, _) => registry.ids()?,
        (false, true) => registry.newest()?,
        (false, false) => {
            let each = args.entries.iter().map(|name| registry.matching(name));
            each.collect::<Result<Vec<_>, _>>()?.concat()
        }
    };
    if ids.is_empty() {
        bail!("no entries in {}; make one with: actrm-zoo train act_lift", shown(&args.zoo.zoo));
    }
    let stop = Stop::install(GOES_ON)?;
    // one bad entry must not keep the others from being evaluated
    let mut failures: Vec<anyhow::Error> = Vec::new();
    // one set of simulators serves all entries of an environment
    let mut by_environment: BTreeMap<Environment, Vec<LoadedEntry>> = BTreeMap::new();
    for id in ids {
        match open(args, &asked, &registry, &id, &mut says).map_err(|error| of_entry(&id, error)) {
            Ok(Some(loaded)) => match environment(&args.run, loaded.entry().meta()) {
                Ok(environment) => by_environment.entry(environment).or_default().push(loaded),
                Err(error) => failures.push(error.into()),
            },
            Ok(None) => {}
            Err(error) => failures.push(error),
        }
    }
    for (environment, entries) in &by_environment {
        if stop.asked() {
            break;
        }
        if let Err(error) = evaluate_on(args, &asked, environment, entries, &stop, (&mut says, &mut failures)) {
            failures.push(error);
        }
    }
    if says.as_json {
        cli::print_json(&says.all)?;
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

/// Says so where the demonstrations were recorded by other rules than the evaluation will play by.
fn note_other_module(meta: &EntryMeta, running: Option<&str>) {
    if let (Some(module), Some(running)) = (&meta.env_module, running)
        && module.sha256 != running
    {
        let (id, name) = (meta.id(), &module.name);
        cli::note(&format!("note: {id}: {name} is not as it was when its demonstrations were recorded"));
    }
}

/// Says so where nobody wrote down which simulator the demonstrations were recorded in.
fn note_unrecorded(meta: &EntryMeta, ready: &Ready) {
    if meta.env_version.is_none() {
        let (id, simulator, rate) = (meta.id(), &ready.simulator, ready.control_freq);
        let version = ready.simulator_version().unwrap_or("of an unknown version");
        cli::note(&format!(
            "note: {id}: version and control frequency of its demonstrations' simulator are not recorded; this is \
             {simulator} {version} at {rate} Hz"
        ));
    }
}

/// Says so where the seeds are those of a collection of ours, and nobody wrote down which the demonstrations had.
fn note_seeds(meta: &EntryMeta, seeds: Seeds) {
    if meta.data.as_ref().is_some_and(|data| data.seeds.is_none()) && seeds.iter().end > CollectOptions::SEED_STRIDE {
        let id = meta.id();
        cli::note(&format!(
            "note: {id}: the seeds of its demonstrations are not recorded; it may have been trained on these episodes"
        ));
    }
}

/// An entry whose policy is to be evaluated; one that solves puzzles is evaluated at once.
fn open(
    args: &Args,
    asked: &Asked<'_>,
    registry: &Registry,
    id: &EntryId,
    says: &mut Says,
) -> anyhow::Result<Option<LoadedEntry>> {
    let entry = registry.entry(&id.to_string())?;
    if entry.meta().is_external() && (args.all || args.all_versions) {
        cli::note(&format!("note: {id}: not evaluated: its weights are not in this zoo"));
        return Ok(None);
    }
    // what says how robots are run; with --all it is meant for the others
    let named = !args.all && !args.all_versions;
    let of_robots = [
        ("--protocol", args.protocol.is_some()),
        ("--episodes", args.episodes.is_some()),
        ("--max-steps", args.run.max_steps.is_some()),
        ("--n-action-steps", args.n_action_steps.is_some()),
        ("--temporal-ensemble", args.temporal_ensemble.is_some()),
        ("--shard", args.shard.is_some()),
        ("--video", args.video > 0),
        ("--video-failed", args.video_failed > 0),
        ("--perturb", args.perturb.is_some()),
    ];
    let of_robots = of_robots.into_iter().find(|(_, given)| *given && named).map(|(option, _)| option);
    let (task, results) = (args.run.task.as_deref(), args.results.folder(&args.zoo));
    // seeds of episodes are no seeds of puzzles where both kinds are evaluated
    let seed = args.seed.filter(|_| named);
    let of_puzzles = puzzles::Asked { of_robots, task, args: &args.puzzles, seed, again: args.again, named };
    if let Some((line, value)) = puzzles::evaluate(&entry, &of_puzzles, &results)? {
        says.say(&(line + "\n"), value)?;
        return Ok(None);
    }
    asked.check_task(task.unwrap_or(&entry.meta().task))?;
    Ok(Some(entry.load_on(&args.device.open()?.backend)?))
}

/// Evaluates the entries of an environment on one set of simulators.
fn evaluate_on(
    args: &Args,
    asked: &Asked<'_>,
    environment: &Environment,
    entries: &[LoadedEntry],
    stop: &Stop,
    (says, failures): (&mut Says, &mut Vec<anyhow::Error>),
) -> anyhow::Result<()> {
    let spec =
        limited_worker(environment, &args.run, asked.protocol.map_or(args.run.control, |protocol| protocol.control))?;
    let (results, options) = (args.results.folder(&args.zoo), options(args, asked, environment));
    // a finished evaluation is shown without starting a simulator
    let remembered =
        (!args.again && args.video == 0 && args.video_failed == 0).then(|| remembered_greeting(&spec)).flatten();
    let mut subjects = Vec::new();
    for loaded in entries {
        let id = loaded.entry().id();
        let done = subject(args, asked, loaded).and_then(|subject| match &remembered {
            Some(ready) => Ok((finished(&subject, ready, &results, &options)?, subject)),
            None => Ok((None, subject)),
        });
        match done.map_err(|error| of_entry(&id, error)) {
            Ok((Some(evaluation), _)) => {
                asked.note_doubt(&evaluation);
                says.evaluation(&evaluation, true)?;
            }
            Ok((None, subject)) => subjects.push(subject),
            Err(error) => failures.push(error),
        }
    }
    if subjects.is_empty() {
        return Ok(());
    }
    let Some(mut pool) = start(&args.run, spec, stop)? else { return Ok(()) };
    for entry in entries {
        note_other_module(entry.entry().meta(), pool.ready().module_sha256.as_deref());
        note_unrecorded(entry.entry().meta(), pool.ready());
        note_seeds(entry.entry().meta(), options.seeds);
    }
    for subject in &subjects {
        if let Err(error) = evaluate_entry((args, asked), &options, subject, &mut pool, stop, says) {
            failures.push(error);
        }
        if stop.asked() {
            break;
        }
    }
    let incidents = pool.incidents().len();
    pool.close();
    if incidents > 0 {
        cli::note(&format!("note: {incidents} worker failures on {}; the episodes were run again", environment.task));
    }
    Ok(())
}

/// The entry as the command line wants it to act.
fn subject(args: &Args, asked: &Asked<'_>, loaded: &LoadedEntry) -> anyhow::Result<Subject<'static>> {
    adjusted(args, asked, loaded.subject(), Some(loaded.experiment().policy.action_horizon()))
}

/// The same of what has chunks of `action_horizon` actions, where that is known.
fn adjusted<'a>(
    args: &Args,
    asked: &Asked<'_>,
    mut subject: Subject<'a>,
    action_horizon: Option<usize>,
) -> anyhow::Result<Subject<'a>> {
    let action_horizon = action_horizon.unwrap_or(usize::MAX);
    subject.perturbation.clone_from(&args.perturb);
    if let Some(protocol) = asked.protocol {
        subject.max_steps = Some(protocol.max_steps);
        subject.execution = protocol.execution.unwrap_or(subject.execution);
    }
    if let Some(max_steps) = args.run.max_steps {
        subject.max_steps = Some(usize::try_from(max_steps)?);
    }
    if let Some(n_action_steps) = args.n_action_steps {
        subject.execution = Execution::RecedingHorizon { n_action_steps: usize::try_from(n_action_steps)? };
        subject.execution.check(action_horizon).context("--n-action-steps")?;
    }
    if let Some(coefficient) = args.temporal_ensemble {
        subject.execution = Execution::TemporalEnsemble { coefficient };
        subject.execution.check(action_horizon).context("--temporal-ensemble")?;
    }
    if let Some((protocol, fixed)) = asked.protocol.and_then(|protocol| Some((protocol, protocol.execution?)))
        && fixed != subject.execution
    {
        bail!("protocol {}: execution: expected {fixed:?}, found {:?}", protocol.name, subject.execution);
    }
    Ok(subject)
}

/// Evaluates the policy of a server.
fn evaluate_remote(
    args: &Args,
    asked: &Asked<'_>,
    remote: &Remote,
    stop: &Stop,
    says: &mut Says,
) -> anyhow::Result<()> {
    asked.check_task(&remote.task)?;
    let mut environment = Environment::usual(&remote.task, args.run.simulator.env_module.as_deref(), remote.cameras()?);
    if !args.run.robots.is_empty() {
        environment = environment.with_robots(&args.run.robots);
    }
    let spec =
        limited_worker(&environment, &args.run, asked.protocol.map_or(args.run.control, |protocol| protocol.control))?;
    let (results, options) = (args.results.folder(&args.zoo), options(args, asked, &environment));
    let subject = |ready: &Ready| adjusted(args, asked, remote.subject(&args.zoo.zoo, ready)?, None);
    let remembered =
        (!args.again && args.video == 0 && args.video_failed == 0).then(|| remembered_greeting(&spec)).flatten();
    if let Some(ready) = remembered
        && let Some(evaluation) = finished(&subject(&ready)?, &ready, &results, &options)?
    {
        asked.note_doubt(&evaluation);
        return says.evaluation(&evaluation, true);
    }
    let Some(mut pool) = start(&args.run, spec, stop)? else { return Ok(()) };
    let subject = subject(pool.ready())?;
    let ended = evaluate_entry((args, asked), &options, &subject, &mut pool, stop, says);
    cli::close(pool);
    ended
}

fn options(args: &Args, asked: &Asked<'_>, environment: &Environment) -> EvaluationOptions {
    EvaluationOptions {
        seeds: asked.seeds,
        shard: args.shard,
        env_module: environment.env_module.clone(),
        force: args.run.force,
    }
}

/// Evaluates one entry and records videos of it, as far as nobody asks to stop.
fn evaluate_entry(
    (args, asked): (&Args, &Asked<'_>),
    options: &EvaluationOptions,
    subject: &Subject<'_>,
    pool: &mut Pool,
    stop: &Stop,
    says: &mut Says,
) -> anyhow::Result<()> {
    let results = args.results.folder(&args.zoo);
    let mut failed = Vec::new();
    let stopped = match args.again {
        false => match run_missing(subject, pool, &results, options)? {
            None => true,
            Some(Evaluated { evaluation, was_there }) => {
                asked.note_doubt(&evaluation);
                says.evaluation(&evaluation, was_there)?;
                let lost = evaluation.episodes.iter().filter(|episode| !episode.success).map(|episode| episode.seed);
                failed.extend(lost.take(usize::try_from(args.video_failed)?));
                false
            }
        },
        true => again(subject, pool, &results, options, says)?,
    };
    if !stopped && args.video > 0 && !stop.asked() {
        let mut seeds = subject.record(pool.ready(), options)?.own_seeds();
        seeds.truncate(usize::try_from(args.video)?);
        videos((args, options), &seeds, &camera_view(args), subject, pool)?;
    }
    if !stopped && !failed.is_empty() && !stop.asked() {
        // about as large as the other videos
        let side = subject.signature.of_kind(FeatureKind::Image).next().and_then(|spec| spec.shape.first().copied());
        let seen = |side: usize| View::Seen { scale: (usize::from(args.video_size) / side).max(1).next_multiple_of(2) };
        videos((args, options), &failed, &side.map_or_else(|| camera_view(args), seen), subject, pool)?;
    }
    Ok(())
}

/// What `--camera` sees.
fn camera_view(args: &Args) -> View {
    let side = usize::from(args.video_size);
    View::Camera { name: args.camera.clone(), height: side, width: side }
}

/// Runs episodes of a finished evaluation once more and compares; whether it was stopped.
fn again(
    subject: &Subject<'_>,
    pool: &mut Pool,
    results: &Path,
    options: &EvaluationOptions,
    says: &mut Says,
) -> anyhow::Result<bool> {
    if subject.time_decides {
        bail!(
            "entry {}: it has a time budget, so its episodes may end differently and cannot be compared",
            subject.entry
        );
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
    if again.progress {
        cli::note(&format!("{id}: its results had no progress, and have it now"));
    }
    if again.episodes < again.wanted {
        cli::note(&format!("{id}: {} of {} episodes run again, every outcome the same", again.episodes, again.wanted));
        return Ok(true);
    }
    let of = if again.stored > again.wanted { format!(" of {}", again.stored) } else { String::new() };
    let versions: Vec<Value> =
        again.versions.iter().map(|(name, stored, now)| json!({"name": name, "stored": stored, "now": now})).collect();
    says.say(
        &format!("{id}: {}{of} episodes run again, every outcome the same\n", again.episodes),
        json!({
            "entry": id, "run_again": again.episodes, "stored": again.stored, "different": 0, "other_versions": versions,
            "sealed_now": again.sealed, "progress_now": again.progress,
        }),
    )?;
    Ok(false)
}

/// Records videos of episodes; the path of each video is printed.
fn videos(
    (args, options): (&Args, &EvaluationOptions),
    seeds: &[u64],
    view: &View,
    subject: &Subject<'_>,
    pool: &mut Pool,
) -> anyhow::Result<()> {
    let folder = videos::folder(&args.zoo.zoo, &subject.entry);
    let conditions = subject.record(pool.ready(), options)?.conditions();
    fs::create_dir_all(&folder).with_context(|| format!("creating {}", shown(&folder)))?;
    let rate = pool.ready().control_freq;
    let task = pool.ready().task.clone();
    let seen = matches!(view, View::Seen { .. });
    let mut screen = Screen::new();
    screen.begin("video", seeds.len() as u64);
    let mut failure: Option<anyhow::Error> = None;
    record_videos(subject, pool, seeds, view, &mut |seed, images, success| {
        let path = folder.join(videos::name(&task, seed, success, seen, &conditions));
        screen.step();
        let line = shown(&path);
        let written = cli::write_video(&path, &images, rate).and_then(|()| match args.json {
            // JSON alone is on standard output
            true => {
                screen.note(&line);
                Ok(())
            }
            false => screen.print(&(line + "\n")),
        });
        match written {
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
