use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Context;
use cli::{Table, shown};
use report::column::{Align, Column};
use report::{COLUMNS, Curve, csv, markdown, rank, to_html};
use study::puzzle::{PUZZLE_COLUMNS, audit_puzzles, puzzle_section, rank_puzzles};
use zoo::audit::{KnownEntries, audit};
use zoo::entry::Entry;
use zoo::{ZooError, write_together};

use crate::places::{ResultsArgs, ZooArgs};

/// Rank all evaluations: tables here, leaderboard.csv, leaderboard_puzzles.csv and report.html in the zoo
///
/// Ranks go by the lower end of the 95% interval; a row of fewer than 20 episodes has none. Results that are not as they
/// were sealed, without a seal, in a folder of another name, or of an entry that is not in the zoo or says otherwise, are
/// named and left out; the others are ranked, and the exit code is 1.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo leaderboard
  actrm-zoo leaderboard --zoo my-zoo --out public
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
    /// Show all columns, however narrow the terminal is
    #[arg(long)]
    wide: bool,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let results = args.results.folder(&args.zoo);
    let entries = KnownEntries::open(&args.zoo.registry())?;
    let (robots, solvers) = (audit(&results, &entries)?, audit_puzzles(&results, &entries)?);
    let mut failures: Vec<String> = entries.bad().map(|(id, error)| failure(&format!("entry {id}"), error)).collect();
    let left_out = robots.left_out.iter().chain(&solvers.left_out);
    failures.extend(left_out.map(|left| failure(&format!("left out: {}", shown(&left.folder)), &left.reason)));
    let end = || {
        failures.iter().for_each(|failure| cli::note(failure));
        if failures.is_empty() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
    };
    let (evaluations, puzzles) = (robots.standing, rank_puzzles(&solvers.standing));
    if evaluations.is_empty() && puzzles.is_empty() && failures.is_empty() {
        cli::note(&format!("no evaluations in {}; make one with: actrm-zoo eval --all", shown(&results)));
        return Ok(ExitCode::SUCCESS);
    }
    let rows = rank(&evaluations);

    // first the files: whoever reads the tables may go away before their end
    let out = args.out.as_ref().unwrap_or(&args.zoo.zoo);
    std::fs::create_dir_all(out).with_context(|| format!("creating {}", shown(out)))?;
    let mut files = vec![
        (out.join("leaderboard.csv"), csv::table(COLUMNS, &rows).into_bytes()),
        (
            out.join("report.html"),
            to_html(&evaluations, &curves(&entries), &puzzle_section(&puzzles)).into_bytes(),
        ),
    ];
    if !puzzles.is_empty() {
        files.push((out.join("leaderboard_puzzles.csv"), csv::table(PUZZLE_COLUMNS, &puzzles).into_bytes()));
    }
    if let Some(file) = &args.markdown {
        files.push((file.clone(), markdown::table(COLUMNS, &rows).into_bytes()));
    }
    // all of them or none: a table beside a report of other results would be worse than an old pair
    write_together(&files)?;

    let written: String = files.iter().map(|(path, _)| shown(path) + "\n").collect();
    let text = table(COLUMNS, &rows, args.wide) + &table(PUZZLE_COLUMNS, &puzzles, args.wide);
    cli::print(&(text + &written))?;
    Ok(end())
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
