use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, bail};
use cli::{INTERRUPTED, SimulatorArgs, Stop, shown};
use rollout::Control;
use zoo::entry::Entry;
use zoo::evaluation::FIRST_SEED;
use zoo::write_atomic;

use crate::places::{ZooArgs, entry_names};
use crate::puzzles::{self, TraceOptions};
use crate::simulation::{drawn, worker};

/// Show the refinement steps of a puzzle solver on a puzzle, or of a robot policy in an episode
///
/// For a puzzle the output has the grid, the confidence of each cell, and the halting decision. For an episode it has every
/// query and every refinement step, with the change of the prediction, the halting probability and the time. JSON, Parquet and
/// SVG also hold the attention of the actions, or the path that a policy on a grid predicts.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo trace trm-dfs10
  actrm-zoo trace trm-open8@1 --index 7 --svg trace.svg
  actrm-zoo trace trm-dfs10 --task dfs16 --depth 24
  actrm-zoo trace trm-sudoku4 --json
  actrm-zoo trace lift-actrm-s1 --seed 10003
  actrm-zoo trace lift-actrm-s1 --seed 10003 --parquet trace.parquet
  actrm-zoo trace pickchain-actrm --seed 30000 --svg attention.svg
  actrm-zoo trace tablemaze-actrm --seed 30000 --svg way.svg")]
pub struct Args {
    /// Entry: `name` (its newest version) or `name@version`
    #[arg(add = entry_names())]
    entry: String,
    /// Number of the puzzle in the test split [default: 0]
    #[arg(long)]
    index: Option<u64>,
    /// Most supervision steps on a puzzle [default: 8]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=1000))]
    depth: Option<u64>,
    /// Task or family of puzzles, if not the entry's
    #[arg(long)]
    task: Option<String>,
    /// Givens of a Sudoku [default: the fewest that the solver was trained on]
    #[arg(long, value_name = "N")]
    givens: Option<usize>,
    /// Seed of the episode [default: the first that evaluations use]
    #[arg(long, value_name = "SEED")]
    seed: Option<u64>,
    /// Also write all predicted actions of the episode to this Parquet file
    #[arg(long, value_name = "FILE")]
    parquet: Option<PathBuf>,
    /// Control loop inside the simulator: `compiled` or `robosuite`
    #[arg(long, default_value_t = Control::Compiled)]
    control: Control,
    #[command(flatten)]
    simulator: SimulatorArgs,
    /// Print JSON instead of text
    #[arg(long)]
    json: bool,
    /// Draw to this SVG file: the steps on a puzzle, or the attention or path in an episode
    #[arg(long, value_name = "FILE", conflicts_with = "json")]
    svg: Option<PathBuf>,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let entry = args.zoo.registry().entry(&args.entry)?;
    let of_episodes = [
        ("--seed", args.seed.is_some()),
        ("--parquet", args.parquet.is_some()),
        ("--control", args.control != Control::Compiled),
        ("--workers", args.simulator.workers.is_some()),
        ("--env-module", args.simulator.env_module.is_some()),
    ];
    let files = [&args.parquet, &args.svg].into_iter().flatten();
    let _parents: Vec<cli::Parents> = files.map(|path| cli::new_file(path)).collect::<anyhow::Result<_>>()?;
    let options = TraceOptions {
        index: args.index,
        depth: args.depth,
        task: args.task.as_deref(),
        givens: args.givens,
        json: args.json,
        svg: args.svg.as_deref(),
    };
    match puzzles::trace(&entry, &options, given(&of_episodes))? {
        true => Ok(ExitCode::SUCCESS),
        false => trace_policy(args, &entry),
    }
}

/// The first of the options that is given.
fn given<'o>(options: &[(&'o str, bool)]) -> Option<&'o str> {
    options.iter().find(|(_, given)| *given).map(|(option, _)| *option)
}

fn trace_policy(args: &Args, entry: &Entry) -> anyhow::Result<ExitCode> {
    let of_puzzles = [
        ("--index", args.index.is_some()),
        ("--depth", args.depth.is_some()),
        ("--givens", args.givens.is_some()),
        ("--workers", args.simulator.workers.is_some()),
    ];
    if let Some(option) = given(&of_puzzles) {
        bail!("{option} means nothing for {}, a robot policy of which one episode is shown", entry.id());
    }
    let loaded = entry.load()?;
    let (subject, examiner) = (loaded.subject(), analysis::Examiner::of(&loaded)?);
    if args.svg.is_some() && examiner.is_none() {
        bail!(
            "--svg means nothing for {}: it does not think step by step about its actions from one start, nor over a grid",
            entry.id()
        );
    }
    let environment = drawn(&args.simulator, args.task.as_deref(), entry.meta())?;
    let stop = Stop::install("stopped")?;
    let SimulatorArgs { env_module, python, .. } = &args.simulator;
    let one = SimulatorArgs { workers: Some(1), env_module: env_module.clone(), python: python.clone() };
    let spec = worker(&environment, &one, args.control)?;
    let Some(mut pool) = one.start(spec, None, &stop)? else { return Ok(ExitCode::from(INTERRUPTED)) };
    let traced = analysis::trace(&subject, &mut pool, args.seed.unwrap_or(FIRST_SEED), examiner.as_ref());
    cli::close(pool);
    let Some(traced) = traced.with_context(|| format!("entry {}", entry.id()))? else {
        return Ok(ExitCode::from(INTERRUPTED));
    };
    match args.json {
        true => cli::print_json(&traced)?,
        false => cli::print(&traced.to_text())?,
    }
    if let Some(path) = &args.parquet {
        traced.write_parquet(path)?;
    }
    if let (Some(path), Some(svg)) = (&args.svg, traced.way_svg().or_else(|| traced.attention_svg())) {
        write_atomic(path, svg.as_bytes())?;
        cli::note(&shown(path));
    }
    Ok(ExitCode::SUCCESS)
}
