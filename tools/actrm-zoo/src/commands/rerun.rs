use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, bail};
use audit::rerun::{EPISODES, Report, Rerun, Retrained, Retraining, find_row};
use cli::{Column, INTERRUPTED, Screen, SimulatorArgs, Stop, Table, limits, shown};
use recording::{CollectEnd, CollectOptions, CollectProgress, collect};
use rollout::{Control, Skill};
use serde_json::json;
use zoo::entry::Entry;
use zoo::evaluation::{Environment, EvaluationOptions, Subject};
use zoo::results::EvaluationRecord;

use crate::places::{BlockArg, ProtocolArgs, ResultsArgs, ZooArgs, entry_names};
use crate::remote::Served;
use crate::simulation::{run_missing, worker};
use crate::training::show;

const GOES_ON: &str = "stopped; run the same command again to resume";
/// Folder of the work, below it one for each entry.
const RERUNS: &str = "runs/rerun";
/// Demonstrations that were collected again, in the folder of the work.
const DEMONSTRATIONS: &str = "demonstrations.hdf5";

/// Reproduce a leaderboard row from its demonstrations and report the first step that differs
///
/// The command checks entry and result and finds the demonstrations by their fingerprint, or collects those of a scripted expert
/// again. It trains as the entry's experiment says and runs the row's episodes. Each step is compared with what is stored:
/// weights byte by byte, episodes outcome by outcome. Where something differs, versions that changed are named. The zoo and its
/// results are not changed. The work is done in its own folder, where an interrupted rerun resumes. The exit code is 0 if every
/// requested step is the same, and 1 otherwise. For puzzle solvers use `eval --again`.
///
/// Of a policy that a server runs, the episodes are run again against the server: the one that the entry names, or --policy.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo rerun lift-act-s1 --protocol lift-v1 --collect
  actrm-zoo rerun lift-act@1 --protocol lift-v1 --block dev --skip-training --episodes 10
  actrm-zoo rerun stack-act@1_Stack_40000-40199_c839488e
  actrm-zoo rerun stack-act-s1 --protocol stack-v1 --data stack.hdf5
  actrm-zoo rerun my-act --work /tmp/again --json
  actrm-zoo rerun pi0 --policy ws://gpu:8000")]
pub struct Args {
    /// Result folder by name, or entry (`name`, `name@version`) whose only or chosen result is meant
    #[arg(add = entry_names())]
    row: String,
    /// Choose the result of this named protocol
    #[arg(long, value_name = "NAME")]
    protocol: Option<String>,
    /// Choose the result of this block of the protocol
    #[arg(long, value_name = "BLOCK", default_value = "test", requires = "protocol")]
    block: BlockArg,
    #[command(flatten)]
    protocols: ProtocolArgs,
    /// Choose the result on this task
    #[arg(long)]
    task: Option<String>,
    /// Demonstrations, an HDF5 file or a LeRobotDataset folder [default: the experiment's path]
    #[arg(long, value_name = "PATH")]
    data: Option<PathBuf>,
    /// Collect the demonstrations again with the recorded seeds, even if the experiment's path has some
    #[arg(long, conflicts_with_all = ["data", "skip_training"])]
    collect: bool,
    /// Folder of the intermediate files [default: runs/rerun/ENTRY@VERSION-HASH]
    #[arg(long, value_name = "DIR")]
    work: Option<PathBuf>,
    /// Run only the first N episodes of the row
    #[arg(long, short = 'n', value_name = "N", value_parser = limits::episodes)]
    episodes: Option<u64>,
    /// Do not train; run the episodes with the stored weights
    #[arg(long, conflicts_with_all = ["data", "image_memory"])]
    skip_training: bool,
    /// Server of a policy whose weights are not in the zoo [default: the address that its entry records]
    #[arg(long, value_name = "ws://HOST:PORT", conflicts_with_all = ["data", "collect"])]
    policy: Option<String>,
    /// Token of the server, sent as `Authorization: Api-Key TOKEN`
    #[arg(long, value_name = "TOKEN", env = "ACTRM_TOKEN", hide_env_values = true)]
    token: Option<String>,
    /// Memory for images, such as 2G or 500M; the rest is kept in a file [default: half of the free memory]
    #[arg(long, value_name = "SIZE", value_parser = limits::bytes)]
    image_memory: Option<u64>,
    #[command(flatten)]
    simulator: SimulatorArgs,
    /// Print JSON instead of text
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    results: ResultsArgs,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let registry = args.zoo.registry();
    let protocols = args.protocols.protocols()?;
    let protocol = args.protocol.as_deref().map(|name| protocols.get(name)).transpose()?;
    let wanted = |record: &EvaluationRecord| {
        let block = protocol.is_none_or(|protocol| protocol.block_of(record) == Some(args.block.into()));
        block && args.task.as_ref().is_none_or(|task| *task == record.protocol.task)
    };
    let row = find_row(&args.row, &registry, &args.results.folder(&args.zoo), &wanted)?;
    let mut report = Report::default();
    let rerun = Rerun::open(&row, &registry, args.work.clone(), Path::new(RERUNS), &mut report)?;
    if let Some(rerun) = &rerun {
        // before hours of work
        rerun.options(args.episodes)?;
        rerun.environment(args.simulator.env_module.as_deref())?;
        let stop = Stop::install(GOES_ON)?;
        if !again(args, rerun, &stop, &mut report)? {
            cli::note(GOES_ON);
            return Ok(ExitCode::from(INTERRUPTED));
        }
    }
    tell(args, &row.folder, rerun.as_ref(), &report)?;
    Ok(if report.is_same() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// Trains and runs; whether it came to its end.
fn again(args: &Args, rerun: &Rerun, stop: &Stop, report: &mut Report) -> anyhow::Result<bool> {
    if let Some(served) = Served::of(rerun.entry(), args.policy.as_deref(), args.token.as_deref())? {
        report.skip_training("its weights are not in this zoo: its server acts");
        rerun.compare_declared(served.declared_then(), served.declared(), report);
        let subject = rerun.as_measured(served.subject(rerun.entry()))?;
        return episodes(args, rerun, (rerun.entry(), &subject), stop, report);
    }
    if args.policy.is_some() {
        bail!("--policy: expected an entry whose weights are not in the zoo, found {}", rerun.entry().id());
    }
    let entry = match args.skip_training {
        true => {
            report.skip_training("--skip-training: the stored weights act");
            rerun.entry().clone()
        }
        false => match retrained(args, rerun, stop, report)? {
            Retrained::Entry(entry) => *entry,
            Retrained::Not => {
                report.stop("nothing was trained; --skip-training runs the episodes with the stored weights");
                return Ok(true);
            }
            Retrained::Stopped { step } => {
                cli::note(&format!("stopped after step {step}"));
                return Ok(false);
            }
        },
    };
    if stop.asked() {
        return Ok(false);
    }
    match rerun.time_decides(report) {
        true => Ok(true),
        false => episodes(args, rerun, (&entry, &rerun.subject(&entry)?), stop, report),
    }
}

fn retrained(args: &Args, rerun: &Rerun, stop: &Stop, report: &mut Report) -> anyhow::Result<Retrained> {
    let usual = rerun.usual_demonstrations()?.is_some_and(|path| path.exists());
    let data = match &args.data {
        Some(path) => Some(path.clone()),
        None if usual && !args.collect => None,
        None => match collected(args, rerun, stop)? {
            Collection::There(path) => Some(path),
            Collection::Unknown if args.collect => bail!(
                "--collect: {}: its demonstrations are not known to be a scripted expert's; --data names them",
                rerun.entry().id()
            ),
            Collection::Unknown => None,
            Collection::Stopped => return Ok(Retrained::Stopped { step: 0 }),
        },
    };
    let how = Retraining { data, image_memory: args.image_memory };
    let mut screen = Screen::new();
    let outcome = rerun.retrain(&how, &|| stop.asked(), &mut |event| show(&event, &mut screen, stop), report);
    drop(screen);
    outcome.with_context(|| format!("training {} again", rerun.entry().id()))
}

/// The demonstrations of an entry, collected again.
enum Collection {
    There(PathBuf),
    /// Nothing says that they came from a collection.
    Unknown,
    Stopped,
}

/// Collects what the entry was trained on once more: a collection is told by the seeds of its demonstrations, which begin at a
/// multiple of [`CollectOptions::SEED_STRIDE`]. Whether they are the same ones, their fingerprint says later.
fn collected(args: &Args, rerun: &Rerun, stop: &Stop) -> anyhow::Result<Collection> {
    let meta = rerun.entry().meta();
    let Some((data, seeds)) = meta.data.as_ref().and_then(|data| Some((data, data.seeds?))) else {
        return Ok(Collection::Unknown);
    };
    let seed = seeds.start / CollectOptions::SEED_STRIDE;
    if seed == 0 || seeds.start % CollectOptions::SEED_STRIDE + seeds.count > CollectOptions::SEED_STRIDE {
        return Ok(Collection::Unknown);
    }
    let out = rerun.work().join(DEMONSTRATIONS);
    if out.exists() {
        return Ok(Collection::There(out));
    }
    let episodes = data.train_episodes + data.valid_episodes;
    std::fs::create_dir_all(rerun.work()).with_context(|| format!("cannot create {}", shown(rerun.work())))?;
    // the row may have been measured with a module, and the demonstrations collected without one
    let module = args.simulator.env_module.as_deref().filter(|_| meta.env_module.is_some());
    let environment = Environment::of(meta, None, module)?;
    cli::note(&format!("collecting {episodes} demonstrations of {}'s expert, seed {seed}", environment.task));
    let skill = data.skill.as_deref().map_or(Ok(Skill::Good), str::parse::<Skill>).map_err(anyhow::Error::msg)?;
    let options = CollectOptions {
        out: out.clone(),
        episodes,
        seed,
        env_module: environment.env_module.clone(),
        expert: data.expert.clone(),
        skill,
        next_obs: false,
        gzip: None,
    };
    let spec = worker(&environment, &args.simulator, Control::Compiled)?;
    let Some(mut pool) = args.simulator.start(spec, None, stop)? else { return Ok(Collection::Stopped) };
    let mut screen = Screen::new();
    screen.begin(format!("collecting {}", environment.task), episodes);
    let end = collect(&mut pool, &options, &mut |progress| {
        if let CollectProgress::Demos(demos) = progress {
            screen.at(demos);
        }
    });
    drop(screen);
    cli::close(pool);
    match end.with_context(|| format!("collecting the demonstrations of {}", rerun.entry().id()))? {
        CollectEnd::Written(_) => Ok(Collection::There(out)),
        CollectEnd::Stopped(_) => Ok(Collection::Stopped),
    }
}

fn episodes(
    args: &Args,
    rerun: &Rerun,
    (entry, subject): (&Entry, &Subject<'_>),
    stop: &Stop,
    report: &mut Report,
) -> anyhow::Result<bool> {
    let environment = rerun.environment(args.simulator.env_module.as_deref())?;
    let env_module = environment.env_module.clone();
    let options = EvaluationOptions { env_module, ..rerun.options(args.episodes)? };
    let spec = worker(&environment, &args.simulator, rerun.stored().record.protocol.control)?;
    let Some(mut pool) = args.simulator.start(spec, None, stop)? else { return Ok(false) };
    let done = run_missing(subject, &mut pool, &rerun.results(entry), &options);
    cli::close(pool);
    let Some(done) = done? else { return Ok(false) };
    if done.was_there {
        cli::note(&format!("{EPISODES}: run by an earlier call: remove {} to run them again", shown(rerun.work())));
    }
    rerun.compare_episodes(&done.evaluation, report);
    Ok(true)
}

fn tell(args: &Args, folder: &Path, rerun: Option<&Rerun>, report: &Report) -> anyhow::Result<()> {
    let reasons: Vec<_> = report.reasons().collect();
    if args.json {
        return cli::print_json(&json!({
            "row": cli::lossy(folder), "same": report.is_same(), "steps": report.steps(), "reasons": reasons,
            "first_difference": report.first_difference().map(|step| step.step),
            "work": rerun.map(|rerun| cli::lossy(rerun.work())),
        }));
    }
    let mut table = Table::new(vec![Column::new("step"), Column::new("outcome"), Column::new("what")]);
    for step in report.steps() {
        table.push(vec![step.step.to_owned(), step.outcome.as_str().to_owned(), step.told.clone()]);
    }
    let mut text = table.text(false);
    if !reasons.is_empty() {
        let word = if report.is_same() { "the same although these differ" } else { "possible reasons" };
        text.push_str(&format!("\n{word}:\n"));
        for reason in reasons {
            let recorded = reason.recorded.as_deref().unwrap_or("not recorded");
            text.push_str(&format!("  {}: {recorded} then, {} now\n", reason.what, reason.now));
        }
    }
    let name = cli::lossy(Path::new(folder.file_name().unwrap_or_default()));
    let told = match (report.is_same(), report.first_difference()) {
        (true, _) => "every requested step is the same".to_owned(),
        (false, Some(step)) => format!("the first step that differs: {}", step.step),
        (false, None) => "not every requested step could be compared".to_owned(),
    };
    cli::print(&format!("{text}\n{name}: {told}\n"))
}
