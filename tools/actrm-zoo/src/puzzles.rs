//! Puzzles on the command line: their families, and what commands do with an entry that solves them.

use std::path::Path;

use anyhow::bail;
use clap::{Args, ValueEnum};
use cli::shown;
use puzzles::Task;
use report::wilson_interval;
use serde_json::{Value, json};
use study::puzzle::{
    DEPTH, EvaluatedPuzzles, Judge, MOST_VIEWS, PUZZLE_COLUMNS, PuzzleEvaluationOptions, SolverEntry, Starts,
    TEST_SEED, evaluate_puzzles, evaluate_puzzles_again, is_solver,
};
use zoo::entry::Entry;
use zoo::write_atomic;

/// How solvers are evaluated.
#[derive(Args)]
pub struct PuzzleArgs {
    /// Number of test puzzles
    #[arg(long, value_name = "N", default_value_t = 600, value_parser = clap::value_parser!(u64).range(1..))]
    puzzles: u64,
    /// Largest number of supervision steps on a puzzle
    #[arg(long, value_name = "N", default_value_t = DEPTH as u64, value_parser = clap::value_parser!(u64).range(1..=1000))]
    depth: u64,
    /// Givens of a Sudoku [default: the fewest that the solver was trained on]
    #[arg(long, value_name = "N")]
    givens: Option<usize>,
    /// Largest number of starts on a puzzle: without a stable answer the solver starts again from noise. With --views it is
    /// the number of starts of every view, and all of them vote
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=1000))]
    starts: u64,
    /// Standard deviation of the noise of --starts
    #[arg(long, value_name = "STD", default_value_t = 1.0, requires = "starts")]
    noise: f64,
    /// Number of views of a puzzle, rotated or mirrored, a Sudoku with its digits renamed. The answer of each view is
    /// weighted by the probability that --judge gives it
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=MOST_VIEWS))]
    views: u64,
    /// Weight of a view's answer: the halting head or the cell probabilities
    #[arg(long, value_name = "JUDGE", default_value = "halting", requires = "views")]
    judge: JudgeArg,
}

/// Who weighs the answers of several views, on the command line.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum JudgeArg {
    Halting,
    Cells,
}

impl From<JudgeArg> for Judge {
    fn from(judge: JudgeArg) -> Self {
        match judge {
            JudgeArg::Halting => Self::Halting,
            JudgeArg::Cells => Self::Cells,
        }
    }
}

/// The family of that name, or an error that lists them.
pub fn family(name: &str) -> anyhow::Result<Task> {
    match Task::by_name(name) {
        Some(task) => Ok(task),
        None => {
            let names: Vec<&str> = Task::all().into_iter().map(|(name, _)| name).collect();
            bail!("unknown puzzle task `{name}`; tasks: {}", names.join(", "))
        }
    }
}

/// What is asked for.
pub struct Asked<'a> {
    /// An option that a solver does not take.
    pub of_robots: Option<&'a str>,
    pub task: Option<&'a str>,
    pub args: &'a PuzzleArgs,
    /// Another seed than that of the puzzles that every solver answers.
    pub seed: Option<u64>,
    pub again: bool,
    /// Of an entry that was not named (`--all`), options count as far as it takes them.
    pub named: bool,
}

/// Evaluates a solver, or `again` compares with what is stored; the line to show and the same as data, `None` of an entry that is
/// no solver.
pub fn evaluate(entry: &Entry, asked: &Asked<'_>, results: &Path) -> anyhow::Result<Option<(String, Value)>> {
    if !is_solver(entry) {
        return Ok(None);
    }
    let args = asked.args;
    if let Some(option) = asked.of_robots {
        bail!(
            "{option}: expected a robot policy, found a solver of puzzles, which takes --puzzles, --depth, --givens, --seed-start and --again"
        );
    }
    if !(args.noise.is_finite() && args.noise >= 0.0) {
        bail!("--noise: expected a number from 0, found {}", args.noise);
    }
    let task = asked.task.map(family).transpose()?;
    let solver = SolverEntry::load(entry, task)?;
    let mut options = PuzzleEvaluationOptions {
        task,
        givens: args.givens,
        puzzles: args.puzzles,
        depth: usize::try_from(args.depth)?,
        seed: asked.seed.unwrap_or(TEST_SEED),
        starts: if args.starts == 1 { Starts::ONE } else { Starts { most: args.starts, noise: args.noise } },
        views: args.views,
        judge: args.judge.into(),
    };
    if !asked.named {
        options = options.fitting(&solver)?;
    }
    if asked.again {
        let puzzles = evaluate_puzzles_again(&solver, results, &options)?.record.answers.puzzles;
        let line = format!("{}: {puzzles} puzzles answered again, every answer the same", entry.id());
        return Ok(Some((line, json!({"entry": entry.id().to_string(), "run_again": puzzles, "different": 0}))));
    }
    let EvaluatedPuzzles { folder, record, was_there } = evaluate_puzzles(&solver, results, &options)?;
    let counts = &record.answers;
    let (low, high) = wilson_interval(counts.valid, counts.puzzles);
    let mut text = format!(
        "{} on {}: {} of {} right ({}%, 95% interval {:.1}-{:.1}), {} exact",
        record.entry,
        record.task,
        counts.valid,
        counts.puzzles,
        report::percent(counts.valid, counts.puzzles, 1),
        100.0 * low,
        100.0 * high,
        counts.exact
    );
    if let Some((baseline, best)) = record.baselines.iter().max_by_key(|(_, counts)| counts.valid) {
        text.push_str(&format!(", without thought {} ({})", best.valid, baseline.name()));
    }
    text.push_str(&format!(", mean {:.1} steps", record.mean_steps()));
    if was_there {
        text.push_str(" (evaluated before; --again runs it again)");
    }
    let mut value = report::json::object(PUZZLE_COLUMNS, &record);
    value.insert("evaluated_before".to_owned(), was_there.into());
    value.insert("folder".to_owned(), cli::lossy(&folder).into());
    Ok(Some((text, value.into())))
}

/// What is shown of a solver.
pub struct TraceOptions<'a> {
    pub index: Option<u64>,
    pub depth: Option<u64>,
    pub task: Option<&'a str>,
    pub givens: Option<usize>,
    pub json: bool,
    /// A new file, in a folder that is there.
    pub svg: Option<&'a Path>,
}

/// Shows the steps of a solver on a puzzle; `false` of an entry that is no solver. `of_robots` is an option that a solver does
/// not take.
pub fn trace(entry: &Entry, options: &TraceOptions<'_>, of_robots: Option<&str>) -> anyhow::Result<bool> {
    if !is_solver(entry) {
        return Ok(false);
    }
    if let Some(option) = of_robots {
        bail!("{option} means nothing for {}, a puzzle solver", entry.id());
    }
    let other = options.task.map(family).transpose()?;
    let solver = SolverEntry::load(entry, other)?;
    let task = match other {
        Some(task) => task,
        None => solver.experiment().task.family()?,
    };
    let givens = options.givens.unwrap_or(solver.experiment().task.givens().0);
    let depth = usize::try_from(options.depth.unwrap_or(8))?;
    let trace = study::puzzle::trace(&solver, task, givens, options.index.unwrap_or(0), depth)?;
    match options.svg {
        Some(path) => {
            write_atomic(path, trace.to_svg().as_bytes())?;
            cli::print(&(shown(path) + "\n"))?;
        }
        None if options.json => cli::print_json(&trace)?,
        None => cli::print(&trace.to_text())?,
    }
    Ok(true)
}

/// Builds a solver's network with its weights; `false` of an entry that is none.
pub fn deep_check(entry: &Entry) -> anyhow::Result<bool> {
    if is_solver(entry) {
        SolverEntry::load(entry, None)?;
    }
    Ok(is_solver(entry))
}
