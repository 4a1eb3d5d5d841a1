//! `actrm-zoo leaderboard`

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Args;
use comfy_table::{Table, presets};
use report::{Curve, TABLE_COLUMNS, rank, to_csv, to_html, to_markdown, to_table};
use study::puzzle::{PUZZLE_COLUMNS, list_puzzle_evaluations, puzzle_csv, puzzle_section, puzzle_table, rank_puzzles};
use zoo::registry::Registry;
use zoo::results::list_evaluations;
use zoo::write_atomic;

use super::{ZooArgs, shown};

/// Rank all evaluations: tables here, leaderboard.csv, leaderboard_puzzles.csv and report.html in the zoo
#[derive(Args)]
#[command(after_help = "Examples:
  actrm-zoo leaderboard
  actrm-zoo leaderboard --zoo my-zoo --out public
  actrm-zoo leaderboard --markdown RESULTS.md")]
pub struct LeaderboardArgs {
    /// Folder of results (`results` in the zoo)
    #[arg(long, value_name = "DIR")]
    results: Option<PathBuf>,
    /// Folder for leaderboard.csv and report.html (the zoo)
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Also write the table as Markdown
    #[arg(long, value_name = "FILE")]
    markdown: Option<PathBuf>,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn cmd_leaderboard(args: &LeaderboardArgs) -> anyhow::Result<ExitCode> {
    let results = args.results.clone().unwrap_or_else(|| args.zoo.zoo.join("results"));
    let evaluations = list_evaluations(&results)?;
    let puzzles = rank_puzzles(&list_puzzle_evaluations(&results)?);
    if evaluations.is_empty() && puzzles.is_empty() {
        eprintln!("no evaluations in {}; make one with: actrm-zoo eval --all", shown(&results));
        return Ok(ExitCode::SUCCESS);
    }
    let rows = rank(&evaluations);
    if !rows.is_empty() {
        let mut table = Table::new();
        table.load_style(presets::UTF8_HORIZONTAL_ONLY).set_header(TABLE_COLUMNS);
        for row in to_table(&rows) {
            table.add_row(row);
        }
        println!("{}", table.trim_fmt());
    }
    if !puzzles.is_empty() {
        let mut table = Table::new();
        table.load_style(presets::UTF8_HORIZONTAL_ONLY).set_header(PUZZLE_COLUMNS);
        for row in puzzle_table(&puzzles) {
            table.add_row(row);
        }
        println!("{}", table.trim_fmt());
    }

    let out = args.out.as_ref().unwrap_or(&args.zoo.zoo);
    let (csv, html) = (out.join("leaderboard.csv"), out.join("report.html"));
    write_atomic(&csv, to_csv(&rows).as_bytes())?;
    write_atomic(&html, to_html(&evaluations, &curves(args)?, &puzzle_section(&puzzles)).as_bytes())?;
    println!("{}\n{}", shown(&csv), shown(&html));
    if !puzzles.is_empty() {
        let csv = out.join("leaderboard_puzzles.csv");
        write_atomic(&csv, puzzle_csv(&puzzles).as_bytes())?;
        println!("{}", shown(&csv));
    }
    if let Some(file) = &args.markdown {
        write_atomic(file, to_markdown(&rows).as_bytes())?;
        println!("{}", shown(file));
    }
    Ok(ExitCode::SUCCESS)
}

/// Training curves of the entries that are in this zoo.
fn curves(args: &LeaderboardArgs) -> anyhow::Result<Vec<Curve>> {
    let registry = Registry::open(&args.zoo.zoo);
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
