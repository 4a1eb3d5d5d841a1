use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Context;
use cli::{Table, shown};
use report::column::{Align, Column};
use report::{
    ACROSS_COLUMNS, Beside, COLUMNS, Curve, DEPTH_COLUMNS, EntryFacts, LeaderboardRow, Places, Reading, across_tasks,
    csv, json, markdown, rank, to_html,
};
use study::puzzle::{PUZZLE_COLUMNS, audit_puzzles, puzzle_section, rank_puzzles};
use zoo::audit::{KnownEntries, audit};
use zoo::entry::Entry;
use zoo::{ZooError, write_together};

use super::depth::{WORK, depths};
use crate::films;
use crate::places::{ProtocolArgs, ResultsArgs, ZooArgs};

/// Rank all evaluations: tables here, leaderboard.csv and its like for puzzles and across tasks, and report.html in the zoo
///
/// A family (trainings that differ in their seed alone, as `train --seeds` makes them) is one row, with an interval that
/// holds the chance of training. Ranks go by the lower end of the 95% interval; a row of fewer than 20 episodes has none.
/// Rows of a task and protocol that share a letter cannot be told apart: exact McNemar tests on equal seeds (Barnard's where
/// seeds differ, a bootstrap between families), Holm's correction over the whole table. Results that are not as they
/// were sealed, without a seal, in a folder of another name, or of an entry that is not in the zoo or says otherwise, are
/// named and left out; the others are ranked, and the exit code is 1. Where policies were evaluated on several tasks under
/// one protocol, leaderboard_across.csv has their interquartile means over those tasks.
///
/// The page is one file that loads nothing: beside the tables it shows rows pair by pair, success over control steps, over
/// demonstrations and over reasoning depth, films of failed episodes (`eval --video`, `--video-failed`; 20 MB of them, the
/// others by their paths), and the commands that run a row again.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo leaderboard
  actrm-zoo leaderboard --zoo my-zoo --out public
  actrm-zoo leaderboard --trainings
  actrm-zoo leaderboard --json
  actrm-zoo leaderboard --markdown RESULTS.md")]
pub struct Args {
    #[command(flatten)]
    results: ResultsArgs,
    /// Folder for leaderboard.csv and report.html (the zoo)
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Also write the table as Markdown
    #[arg(long, value_name = "FILE")]
    markdown: Option<PathBuf>,
    /// Folder of what `depth` counted; it stands in a section of its own
    #[arg(long, value_name = "DIR", default_value = WORK)]
    depths: PathBuf,
    /// Show each training of a family below it
    #[arg(long)]
    trainings: bool,
    /// Print the rows as JSON instead of tables, with the names of the CSV's columns
    #[arg(long)]
    json: bool,
    /// Show all columns, however narrow the terminal is
    #[arg(long)]
    wide: bool,
    #[command(flatten)]
    protocols: ProtocolArgs,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let results = args.results.folder(&args.zoo);
    let entries = KnownEntries::open(&args.zoo.registry())?;
    let (robots, solvers) = (audit(&results, &entries)?, audit_puzzles(&results, &entries)?);
    let mut failures: Vec<String> = entries.bad().map(|(id, error)| failure(&format!("entry {id}"), error)).collect();
    let left_out = robots.left_out.iter().chain(&solvers.left_out);
    let (depths, damaged) = depths(&args.depths, &entries)?;
    let left_out = left_out.chain(&damaged);
    failures.extend(left_out.map(|left| failure(&format!("left out: {}", shown(&left.folder)), &left.reason)));
    let end = || {
        failures.iter().for_each(|failure| cli::note(failure));
        if failures.is_empty() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
    };
    let (evaluations, puzzles) = (robots.standing, rank_puzzles(&solvers.standing));
    let nothing = evaluations.is_empty() && puzzles.is_empty() && depths.is_empty();
    if nothing && failures.is_empty() && !args.json {
        cli::note(&format!("no evaluations in {}; make one with: actrm-zoo eval --all", shown(&results)));
        return Ok(ExitCode::SUCCESS);
    }
    let reading = Reading::of(&entries, args.protocols.protocols()?);
    let rows = rank(&evaluations, &reading);
    let across = across_tasks(&rows);

    // first the files: whoever reads the tables may go away before their end
    let out = args.out.as_ref().unwrap_or(&args.zoo.zoo);
    std::fs::create_dir_all(out).with_context(|| format!("creating {}", shown(out)))?;
    let beside = Beside {
        curves: curves(&entries),
        section: puzzle_section(&puzzles),
        entries: entries.good().map(facts).collect(),
        depths,
        films: films::of_failures(&rows, &args.zoo.zoo),
        places: Places { zoo: args.zoo.named(), results: args.results.named(), protocols: args.protocols.named() },
    };
    let page = to_html(&rows, &beside);
    let mut files = vec![
        (out.join("leaderboard.csv"), csv::table(COLUMNS, &rows).into_bytes()),
        (out.join("report.html"), page.into_bytes()),
    ];
    let details: Vec<LeaderboardRow> = rows.iter().flat_map(LeaderboardRow::details).collect();
    if details.len() > rows.len() {
        files.push((out.join("leaderboard_trainings.csv"), csv::table(COLUMNS, &details).into_bytes()));
    }
    if !across.is_empty() {
        files.push((out.join("leaderboard_across.csv"), csv::table(ACROSS_COLUMNS, &across).into_bytes()));
    }
    if !puzzles.is_empty() {
        files.push((out.join("leaderboard_puzzles.csv"), csv::table(PUZZLE_COLUMNS, &puzzles).into_bytes()));
    }
    if let Some(file) = &args.markdown {
        files.push((file.clone(), markdown::table(COLUMNS, &rows).into_bytes()));
    }
    // all of them or none: a table beside a report of other results would be worse than an old pair
    write_together(&files)?;

    if args.json {
        cli::print_json(&serde_json::json!({
            "rows": json::rows(COLUMNS, &rows),
            "trainings": json::rows(COLUMNS, &details),
            "across_tasks": json::rows(ACROSS_COLUMNS, &across),
            "puzzles": json::rows(PUZZLE_COLUMNS, &puzzles),
            "depths": json::rows(DEPTH_COLUMNS, &beside.depths),
            "left_out": failures,
        }))?;
        return Ok(end());
    }
    let written: String = files.iter().map(|(path, _)| shown(path) + "\n").collect();
    let told = if args.trainings { with_trainings(&rows) } else { rows };
    let mut tables = vec![
        table(COLUMNS, &told, args.wide),
        table(ACROSS_COLUMNS, &across, args.wide),
        table(PUZZLE_COLUMNS, &puzzles, args.wide),
        written,
    ];
    tables.retain(|table| !table.is_empty());
    cli::print(&tables.join("\n"))?;
    Ok(end())
}

/// The rows, each family followed by its trainings.
fn with_trainings(rows: &[LeaderboardRow]) -> Vec<LeaderboardRow> {
    let with = |row: &LeaderboardRow| {
        let details = if row.n_trainings() > 1 { row.details() } else { Vec::new() };
        std::iter::once(row.clone()).chain(details).collect::<Vec<_>>()
    };
    rows.iter().flat_map(with).collect()
}

/// One line for what is wrong with `object`.
fn failure(object: &str, error: &ZooError) -> String {
    let mut text = format!("error: {object}: {error}");
    let mut cause = std::error::Error::source(error);
    while let Some(error) = cause {
        text.push_str(&format!(": {error}"));
        cause = error.source();
    }
    text
}

/// Training curves of the entries that are in this zoo.
fn curves(entries: &KnownEntries) -> Vec<Curve> {
    let curve = |entry: &Entry| {
        let points = entry.meta().training.as_ref()?.curve.iter().map(|p| (p.step, p.loss)).collect();
        Some(Curve { entry: entry.id().to_string(), points })
    };
    entries.good().filter_map(curve).collect()
}

/// What the page has to know of an entry besides its results.
fn facts(entry: &Entry) -> (String, EntryFacts) {
    /// Of environments whose arguments say nothing of it.
    const USUAL: f64 = 20.0;
    let meta = entry.meta();
    let stated = meta.env_args.as_ref().and_then(|args| args.get("env_kwargs")?.get("control_freq")?.as_f64());
    let hertz = stated.filter(|hertz| hertz.is_finite() && *hertz > 0.0).unwrap_or(USUAL);
    (entry.id().to_string(), EntryFacts { task: meta.task.clone(), hertz })
}

/// What says most stays longest where the terminal is narrow; nothing without rows.
fn table<R: 'static>(columns: &[Column<R>], rows: &[R], wide: bool) -> String {
    if rows.is_empty() {
        return String::new();
    }
    let shown: Vec<(&Column<R>, &str)> = columns.iter().filter_map(|c| Some((c, c.table_heading()?))).collect();
    let column = |(place, (column, heading)): (usize, &(&Column<R>, &str))| {
        let made = match column.align() {
            Align::Left => cli::Column::new(*heading),
            Align::Right => cli::Column::new(*heading).right(),
        };
        if column.is_kept() { made } else { made.dispensable(u8::try_from(place).unwrap_or(u8::MAX)) }
    };
    let mut table = Table::new(shown.iter().enumerate().map(column).collect());
    rows.iter().for_each(|row| table.push(shown.iter().map(|(column, _)| column.shown(row)).collect()));
    table.text(wide)
}
