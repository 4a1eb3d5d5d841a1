use std::collections::BTreeSet;
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, bail};
use audit::{KnownEntries, audit};
use cli::{Table, shown};
use report::column::{Align, Column};
use report::{
    ACROSS_COLUMNS, Beside, COLUMNS, Curve, DEPTH_COLUMNS, EntryFacts, LeaderboardRow, OTHERS_COLUMNS, Places, Reading,
    across_tasks, csv, json, markdown, rank, to_html,
};
use study::puzzle::{PUZZLE_COLUMNS, audit_puzzles, puzzle_section, rank_puzzles};
use zoo::entry::Entry;
use zoo::{ZooError, write_together};

use super::depth::{WORK, depths};
use crate::places::{ProtocolArgs, ResultsArgs, ZooArgs};
use crate::videos;

/// Rank all evaluations on screen, as leaderboard.csv and as report.html in the zoo
///
/// Trainings that differ only in their seed (`train --seeds`) share one row, whose interval includes the variance between seeds.
/// Rows are ranked by the lower end of their 95% interval. A row with fewer than 20 episodes has no rank. Rows of a task and
/// protocol that share a letter are not significantly different. The tests are McNemar's on equal seeds, Barnard's on different
/// seeds and a bootstrap between families, with Holm's correction over the whole table.
///
/// A result without a valid seal or a matching entry is named and left out, and the exit code is 1. Policies that were evaluated
/// on several tasks are also compared across tasks, in leaderboard_across.csv: compare only rows with the same tasks.
///
/// The report is one file that needs no network. It has the tables, pairwise comparisons, and success over control steps,
/// demonstrations and refinement steps. It also has films (`eval --video`, `--video-failed`, at most 20 MB) and the commands
/// that reproduce each row.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo leaderboard
  actrm-zoo leaderboard --zoo my-zoo --out public
  actrm-zoo leaderboard --task Lift
  actrm-zoo leaderboard --trainings
  actrm-zoo leaderboard --others outputs/eval/eval_info.json
  actrm-zoo leaderboard --json
  actrm-zoo leaderboard --markdown RESULTS.md")]
pub struct Args {
    #[command(flatten)]
    results: ResultsArgs,
    /// Show only rows of this task on screen and in JSON; the files have all rows
    #[arg(long)]
    task: Option<String>,
    /// Folder for leaderboard.csv and report.html [default: the zoo]
    #[arg(long, short, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Also write the table to this Markdown file; one that is there is replaced
    #[arg(long, value_name = "FILE")]
    markdown: Option<PathBuf>,
    /// Folder of the results of `actrm-zoo depth`, which are shown in a section of their own
    #[arg(long, value_name = "DIR", default_value = WORK)]
    depths: PathBuf,
    /// Also show the results in this file of LeRobot, vla-eval or CSV, in a table of their own and without a rank; may be
    /// given several times
    #[arg(long, value_name = "FILE")]
    others: Vec<PathBuf>,
    /// Also show each training of a family
    #[arg(long)]
    trainings: bool,
    /// Print the rows as JSON, with the names of the columns of the CSV
    #[arg(long)]
    json: bool,
    /// Show all columns, even in a narrow terminal
    #[arg(long)]
    wide: bool,
    #[command(flatten)]
    protocols: ProtocolArgs,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    args.zoo.check()?;
    args.results.check()?;
    let results = args.results.folder(&args.zoo);
    let entries = KnownEntries::open(&args.zoo.registry())?;
    let (robots, solvers) = (audit(&results, &entries)?, audit_puzzles(&results, &entries)?);
    let mut failures: Vec<String> = entries.bad().map(|(id, error)| failure(&format!("entry {id}"), error)).collect();
    let left_out = robots.left_out.iter().chain(&solvers.left_out);
    let (depths, damaged) = depths(&args.depths, &entries)?;
    let left_out = left_out.chain(&damaged);
    failures.extend(left_out.map(|left| failure(&format!("left out: {}", shown(&left.folder)), &left.reason)));
    let under_way = robots.under_way.iter().map(|found| format!("note: {}: {found}", shown(&found.folder)));
    let doubts = robots.doubts.iter().map(|(folder, doubt)| format!("note: {}: {doubt}", shown(folder)));
    let notes: Vec<String> = under_way.chain(doubts).collect();
    let end = || {
        notes.iter().for_each(|note| cli::note(note));
        failures.iter().for_each(|failure| cli::note(failure));
        if failures.is_empty() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
    };
    let (evaluations, puzzles) = (robots.standing, rank_puzzles(&solvers.standing));
    let mut others = Vec::new();
    for path in &args.others {
        let file = shown(path);
        let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {file}"))?;
        others.extend(report::others::parse(&file, &text)?);
    }
    let nothing = evaluations.is_empty() && puzzles.is_empty() && depths.is_empty() && others.is_empty();
    if nothing && failures.is_empty() && !args.json {
        cli::note(&format!("no evaluations in {}; make one with: actrm-zoo eval --all", shown(&results)));
        return Ok(end());
    }
    let reading = Reading::of(&entries, args.protocols.protocols()?);
    let rows = rank(&evaluations, &reading);
    let there: BTreeSet<&str> = rows.iter().map(LeaderboardRow::task).collect();
    if let Some(task) = args.task.as_deref().filter(|task| !there.contains(task)) {
        bail!("--task {task}: no results of this task; there are results of {}", Vec::from_iter(there).join(", "));
    }
    let across = across_tasks(&rows);

    // first the files: whoever reads the tables may go away before their end
    let out = args.out.as_ref().unwrap_or(&args.zoo.zoo);
    std::fs::create_dir_all(out).with_context(|| format!("creating {}", shown(out)))?;
    let beside = Beside {
        curves: curves(&entries),
        section: puzzle_section(&puzzles),
        entries: entries.good().map(facts).collect(),
        depths,
        others,
        films: videos::of_episodes(&rows, &args.zoo.zoo),
        places: Places { zoo: args.zoo.named(), results: args.results.named(), protocols: args.protocols.named() },
    };
    let page = to_html(&rows, &beside);
    let mut files = vec![
        (out.join("leaderboard.csv"), csv::table(COLUMNS, &rows).into_bytes()),
        (out.join("report.html"), page.into_bytes()),
    ];
    let details: Vec<LeaderboardRow> = rows.iter().flat_map(LeaderboardRow::details).collect();
    let tables = [
        ("leaderboard_trainings.csv", details.len() > rows.len(), csv::table(COLUMNS, &details)),
        ("leaderboard_across.csv", !across.is_empty(), csv::table(ACROSS_COLUMNS, &across)),
        ("leaderboard_puzzles.csv", !puzzles.is_empty(), csv::table(PUZZLE_COLUMNS, &puzzles)),
    ];
    for (name, is_told, text) in tables {
        let path = out.join(name);
        // an empty table takes the place of an old one only
        if is_told || path.exists() {
            files.push((path, text.into_bytes()));
        }
    }
    let _parents = args.markdown.as_deref().map(cli::make_parent).transpose()?;
    if let Some(file) = &args.markdown {
        files.push((file.clone(), markdown::table(COLUMNS, &rows).into_bytes()));
    }
    // all of them or none: a table beside a report of other results would be worse than an old pair
    write_together(&files)?;
    let chosen = |row: &LeaderboardRow| args.task.as_deref().is_none_or(|task| row.task() == task);
    let told: Vec<LeaderboardRow> = rows.iter().filter(|row| chosen(row)).cloned().collect();

    if args.json {
        cli::print_json(&serde_json::json!({
            "rows": json::rows(COLUMNS, &told),
            "trainings": json::rows(COLUMNS, details.iter().filter(|row| chosen(row))),
            "across_tasks": json::rows(ACROSS_COLUMNS, &across),
            "puzzles": json::rows(PUZZLE_COLUMNS, &puzzles),
            "depths": json::rows(DEPTH_COLUMNS, &beside.depths),
            "others": json::rows(OTHERS_COLUMNS, &beside.others),
            "left_out": failures,
        }))?;
        return Ok(end());
    }
    let written: String = files.iter().map(|(path, _)| shown(path) + "\n").collect();
    let told = if args.trainings { with_trainings(&told) } else { told };
    let all = args.task.is_none();
    let mut tables = vec![
        table(COLUMNS, &told, args.wide),
        if all { table(ACROSS_COLUMNS, &across, args.wide) } else { String::new() },
        if all { table(PUZZLE_COLUMNS, &puzzles, args.wide) } else { String::new() },
        table(OTHERS_COLUMNS, &beside.others, args.wide),
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
    // what cannot be read is named elsewhere
    let said = entry.conventions().unwrap_or_default();
    let conventions = said.iter().map(|(name, value)| (name.to_owned(), value.to_owned())).collect();
    (entry.id().to_string(), EntryFacts { task: meta.task.clone(), hertz, conventions })
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
