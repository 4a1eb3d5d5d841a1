use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Context;
use cli::{Column, Table, shown};
use report::{Curve, TABLE_COLUMNS, rank, to_csv, to_html, to_markdown, to_table};
use study::puzzle::{PUZZLE_COLUMNS, list_puzzle_evaluations, puzzle_csv, puzzle_section, puzzle_table, rank_puzzles};
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
    write(out.join("leaderboard.csv"), to_csv(&rows))?;
    write(out.join("report.html"), to_html(&evaluations, &curves(args)?, &puzzle_section(&puzzles)))?;
    if !puzzles.is_empty() {
        write(out.join("leaderboard_puzzles.csv"), puzzle_csv(&puzzles))?;
    }
    if let Some(file) = &args.markdown {
        write(file.clone(), to_markdown(&rows))?;
    }

    let mut text = String::new();
    if !rows.is_empty() {
        let mut columns = TABLE_COLUMNS.to_vec();
        columns.insert(2, "protocol");
        let cells = to_table(&rows).into_iter().zip(&rows).map(|(cells, row)| {
            let mut cells = Vec::from(cells);
            cells.insert(2, row.protocol.clone());
            cells
        });
        text.push_str(&table(&columns, cells, args.wide));
    }
    if !puzzles.is_empty() {
        text.push_str(&table(&PUZZLE_COLUMNS, puzzle_table(&puzzles).into_iter().map(Vec::from), args.wide));
    }
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

/// What says most stays longest where the terminal is narrow.
fn table(columns: &[&str], rows: impl Iterator<Item = Vec<String>>, wide: bool) -> String {
    const KEPT: [&str; 5] = ["entry", "task", "success", "rate [95%]", "right"];
    let column = |(place, name): (usize, &&str)| match KEPT.contains(name) {
        true => Column::new(*name),
        false => Column::new(*name).dispensable(u8::try_from(place).unwrap_or(u8::MAX)),
    };
    let mut table = Table::new(columns.iter().enumerate().map(column).collect());
    rows.for_each(|row| table.push(row));
    table.text(wide)
}
