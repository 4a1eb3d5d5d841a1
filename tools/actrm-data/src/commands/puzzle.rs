use anyhow::{Result, bail};
use dataset::{PuzzleSet, write_puzzles};
use puzzles::{Split, Task};
use std::path::PathBuf;
use std::process::ExitCode;

/// Generate puzzles and write them to a Parquet file, one row per puzzle.
///
/// A row has the grid as input and the answer as target, both as lists of numbers, row by row. It also has start, goal and
/// distance of a maze, givens of a Sudoku, the split and the seed. Mazes: 0 is free, 1 wall, 2 start, 3 goal; the target is 1 on
/// the shortest path. Sudoku: 0 is an empty cell. Puzzles of sudoku9-hard are generated for search effort, and their rows have
/// the number of guesses. Puzzles of different splits never share a maze or a solution.
#[derive(clap::Args)]
#[command(
    after_help = "Tasks: maze8-original, maze10-original, maze5-rl, open8, dfs10, dfs16, dfs20, maze5-walls, sudoku4, sudoku6,
sudoku9, sudoku9-hard

Examples:
  actrm-data puzzle open8 --count 10000 --seed 1 open8.parquet
  actrm-data puzzle dfs10 --count 500 --split test dfs10-test.parquet
  actrm-data puzzle sudoku9 --count 1000 --givens 30 sudoku9.parquet
  actrm-data puzzle sudoku9-hard --count 100 --givens 24 hard.parquet"
)]
pub struct Args {
    /// Family of puzzles
    task: String,
    /// File to create
    out: PathBuf,
    /// Number of puzzles
    #[arg(long, default_value_t = 1000, value_parser = clap::value_parser!(u64).range(1..))]
    count: u64,
    /// Seed; the same seed gives the same file
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Split: train, valid or test
    #[arg(long, default_value = "train", value_parser = split)]
    split: Split,
    /// Fewest givens of a Sudoku; 0 removes as many as keep the solution unique
    #[arg(long, default_value_t = 0)]
    givens: usize,
    /// Print the report as JSON
    #[arg(long)]
    json: bool,
}

fn split(text: &str) -> Result<Split, String> {
    Split::by_name(text).ok_or_else(|| "expected train, valid or test".to_owned())
}

pub fn run(args: &Args) -> Result<ExitCode> {
    let Some(task) = Task::by_name(&args.task) else {
        let names: Vec<&str> = Task::all().into_iter().map(|(name, _)| name).collect();
        bail!("unknown task `{}`; tasks: {}", args.task, names.join(", "));
    };
    if args.givens > 0 && !matches!(task, Task::Sudoku(_)) {
        bail!("--givens {}: {} has no givens", args.givens, args.task);
    }
    if args.givens > task.cells() {
        bail!("--givens {}: {} has {} cells", args.givens, args.task, task.cells());
    }
    let _parents = cli::new_file(&args.out)?;
    let mut screen = cli::Screen::new();
    screen.begin(args.task.clone(), args.count);
    let set = PuzzleSet { task, split: args.split, givens: args.givens, seed: args.seed, count: args.count };
    write_puzzles(&set, &args.out, &mut |done| screen.at(done))?;
    screen.clear();
    let size = std::fs::metadata(&args.out).map_or(0, |m| m.len());
    if args.json {
        cli::print_json(&serde_json::json!({
            "out": cli::lossy(&args.out), "task": args.task, "split": args.split.name(), "seed": args.seed, "count": args.count,
            "bytes": size,
        }))?;
    } else {
        cli::print(&format!(
            "{}: {} puzzles of {} ({}), {}\n",
            args.out.display(),
            cli::count(args.count as usize),
            args.task,
            args.split.name(),
            cli::bytes(size)
        ))?;
    }
    Ok(ExitCode::SUCCESS)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_help_lists_every_task() {
        use clap::Args as _;
        let help = Args::augment_args(clap::Command::new("puzzle")).render_long_help().to_string();
        for (name, _) in Task::all() {
            assert!(help.contains(name), "{name}");
        }
    }
}
