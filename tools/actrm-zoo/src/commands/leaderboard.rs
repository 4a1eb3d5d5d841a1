use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Context;
use cli::{Table, shown};
use report::column::{Align, Column};
use report::{COLUMNS, Curve, csv, markdown, rank, to_html};
use study::puzzle::{PUZZLE_COLUMNS, list_puzzle_evaluations, puzzle_section, rank_puzzles};
use zoo::results::list_evaluations;
use zoo::write_atomic;

use crate::places::{ResultsArgs, ZooArgs};

/// Rank all evaluations: tables here, leaderboard.csv, leaderboard_puzzles.csv and report.html in the zoo
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
    let evaluations = list_evaluations(&results)?;
    let puzzles = rank_puzzles(&list_puzzle_evaluations(&results)?);
    if evaluations.is_empty() && puzzles.is_empty() {
        cli::note(&format!("no evaluations in {}; make one with: actrm-zoo eval --all", shown(&results)));
        return Ok(ExitCode::SUCCESS);
    }
    let rows = rank(&evaluations);

    // first the files: whoever reads the tables may go away before their end
    let out = args.out.as_ref().unwrap_or(&args.zoo.zoo);
    std::fs::create_dir_all(out).with_context(|| format!("creating {}", shown(out)))?;
    let mut written = Vec::new();
    let mut write = |path: PathBuf, text: String| -> anyhow::Result<()> {
        write_atomic(&path, text.as_bytes())?;
        written.push(shown(&path) + "\n");
        Ok(())
    };
    write(out.join("leaderboard.csv"), csv::table(COLUMNS, &rows))?;
    write(out.join("report.html"), to_html(&evaluations, &curves(args)?, &puzzle_section(&puzzles)))?;
    if !puzzles.is_empty() {
        write(out.join("leaderboard_puzzles.csv"), csv::table(PUZZLE_COLUMNS, &puzzles))?;
    }
    if let Some(file) = &args.markdown {
        write(file.clone(), markdown::table(COLUMNS, &rows))?;
    }

    let text = table(COLUMNS, &rows, args.wide) + &table(PUZZLE_COLUMNS, &puzzles, args.wide);
    cli::print(&(text + &written.concat()))?;
    Ok(ExitCode::SUCCESS)
}

/// Training curves of the entries that are in this zoo.
fn curves(args: &Args) -> anyhow::Result<Vec<Curve>> {
    let registry = args.zoo.registry();
    let mut curves = Vec::new();
    for id in registry.ids()? {
        let entry = registry.entry(&id.to_string())?;
        if let Some(training) = &entry.meta().training {
            let points = training.curve.iter().map(|p| (p.step, p.loss)).collect();
            curves.push(Curve { entry: id.to_string(), points });
        }
    }
    Ok(curves)
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
