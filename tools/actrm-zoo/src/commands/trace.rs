use std::path::PathBuf;
use std::process::ExitCode;

use cli::shown;
use study::puzzle::{SolverEntry, trace};
use zoo::write_atomic;

use crate::places::{ZooArgs, entry_names};
use crate::puzzles::family;

/// Show what a puzzle solver believed after each step: its grid, how sure it was, whether it would stop
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo trace trm-dfs10
  actrm-zoo trace trm-open8@1 --index 7 --svg trace.svg
  actrm-zoo trace trm-dfs10 --task dfs16 --depth 24
  actrm-zoo trace trm-sudoku4 --json")]
pub struct Args {
    /// Entry: `name` (its newest version) or `name@version`
    #[arg(add = entry_names())]
    entry: String,
    /// Number of the puzzle in the test split
    #[arg(long, default_value_t = 0)]
    index: u64,
    /// Most supervision steps
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u64).range(1..=1000))]
    depth: u64,
    /// Another family of puzzles than the entry's
    #[arg(long)]
    task: Option<String>,
    /// Givens of a Sudoku (the fewest that the solver was trained on)
    #[arg(long, value_name = "N")]
    givens: Option<usize>,
    /// Print JSON instead of text
    #[arg(long)]
    json: bool,
    /// Write a strip of pictures to this file instead
    #[arg(long, value_name = "FILE", conflicts_with = "json")]
    svg: Option<PathBuf>,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let entry = args.zoo.registry().entry(&args.entry)?;
    let other = args.task.as_deref().map(family).transpose()?;
    let solver = SolverEntry::load(&entry, other)?;
    let task = match other {
        Some(task) => task,
        None => solver.experiment().task.family()?,
    };
    let givens = args.givens.unwrap_or(solver.experiment().task.givens().0);
    let trace = trace(&solver, task, givens, args.index, usize::try_from(args.depth)?)?;
    match &args.svg {
        Some(path) => {
            write_atomic(path, trace.to_svg().as_bytes())?;
            cli::print(&(shown(path) + "\n"))?;
        }
        None if args.json => cli::print_json(&trace)?,
        None => cli::print(&trace.to_text())?,
    }
    Ok(ExitCode::SUCCESS)
}
