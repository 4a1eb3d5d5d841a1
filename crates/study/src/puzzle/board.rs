//! The puzzles' part of the leaderboard: one row an evaluation, ranked inside its task by right answers.

use std::cmp::Ordering;
use std::collections::BTreeMap;
use std::fmt::Write as _;

use report::column::{Column, number, text};
use report::html::{self, escape};
use report::{count_text, wilson_interval};

use super::evaluation::PuzzleEvaluation;
use super::grade::Counts;

/// Best first inside each task; ties by what does not change.
pub fn rank_puzzles(evaluations: &[PuzzleEvaluation]) -> Vec<PuzzleEvaluation> {
    let mut rows = evaluations.to_vec();
    rows.sort_by(order);
    rows
}

fn order(one: &PuzzleEvaluation, two: &PuzzleEvaluation) -> Ordering {
    let group = |row: &PuzzleEvaluation| (row.task.clone(), row.givens);
    let share = |row: &PuzzleEvaluation, other: &PuzzleEvaluation| {
        u128::from(row.answers.valid) * u128::from(other.answers.puzzles.max(1))
    };
    group(one)
        .cmp(&group(two))
        .then_with(|| share(two, one).cmp(&share(one, two)))
        .then_with(|| two.answers.exact.cmp(&one.answers.exact))
        .then_with(|| one.training.parameters.cmp(&two.training.parameters))
        .then_with(|| one.entry.cmp(&two.entry))
        .then_with(|| (one.depth, one.answers.puzzles).cmp(&(two.depth, two.answers.puzzles)))
}

/// `open8`, `sudoku9, 36 givens`.
fn task_text(row: &PuzzleEvaluation) -> String {
    match row.givens {
        0 => row.task.clone(),
        givens => format!("{}, {givens} givens", row.task),
    }
}

fn percent(share: f64) -> String {
    format!("{:.1}%", 100.0 * share)
}

/// `98.3% [97.1-99.1]`
fn rate(part: u64, of: u64) -> String {
    if of == 0 {
        return "-".to_owned();
    }
    let (low, high) = wilson_interval(part, of);
    format!("{} [{:.1}-{:.1}]", percent(part as f64 / of as f64), 100.0 * low, 100.0 * high)
}

/// The baseline that gets most answers right, and most cells: what a row's numbers have to be compared with.
fn best_baseline(row: &PuzzleEvaluation, of: fn(&Counts) -> u64) -> String {
    let best = row.baselines.iter().max_by_key(|(name, counts)| (of(counts), std::cmp::Reverse(**name)));
    best.map_or_else(
        || "-".to_owned(),
        |(name, counts)| {
            let all = if of(counts) == counts.cells_right { counts.cells } else { counts.puzzles };
            format!("{} ({})", percent(of(counts) as f64 / all.max(1) as f64), name.name())
        },
    )
}

/// The statistics of the puzzles' board, in their order: everything that writes it walks this list.
pub const PUZZLE_COLUMNS: &[Column<PuzzleEvaluation>] = &[
    text(|row: &PuzzleEvaluation| row.entry.to_string()).table("entry").page("entry").left().kept(),
    text(|row: &PuzzleEvaluation| row.entry.name.clone()).csv("entry"),
    text(|row: &PuzzleEvaluation| row.entry.version.to_string()).csv("version"),
    text(|row: &PuzzleEvaluation| row.training.policy.clone()).csv("policy").page("model"),
    text(|row: &PuzzleEvaluation| row.task.clone()).csv("task"),
    text(task_text).table("task").left().kept(),
    text(|row: &PuzzleEvaluation| row.givens.to_string()).csv("givens"),
    text(|row: &PuzzleEvaluation| row.answers.puzzles.to_string()).csv("puzzles"),
    text(|row: &PuzzleEvaluation| row.answers.valid.to_string()).csv("right"),
    text(|row: &PuzzleEvaluation| format!("{}/{}", row.answers.valid, row.answers.puzzles)).page("right"),
    text(|row: &PuzzleEvaluation| rate(row.answers.valid, row.answers.puzzles)).table("right [95%]").kept(),
    number(|row: &PuzzleEvaluation| Some(interval(row).0), 4, 4).csv("ci95_low"),
    number(|row: &PuzzleEvaluation| Some(interval(row).1), 4, 4).csv("ci95_high"),
    text(|row: &PuzzleEvaluation| format!("{:.1}–{:.1}%", interval(row).0 * 1e2, interval(row).1 * 1e2))
        .page("95% interval"),
    text(|row: &PuzzleEvaluation| row.answers.exact.to_string()).csv("exact").page("exact"),
    text(|row: &PuzzleEvaluation| percent(row.answers.share(row.answers.exact))).table("exact"),
    text(|row: &PuzzleEvaluation| row.answers.walk.to_string()).csv("walk").page("walk"),
    text(walk_text).table("walk"),
    text(|row: &PuzzleEvaluation| row.answers.detours.to_string()).csv("detours"),
    text(|row: &PuzzleEvaluation| row.answers.detours_valid.to_string()).csv("detours_right"),
    text(detours_text).table("detours right").page("detours right"),
    text(|row: &PuzzleEvaluation| best_baseline(row, |counts| counts.valid))
        .table("no thought: right")
        .page("without thought"),
    text(cells_text).table("cells / no thought"),
    text(|row: &PuzzleEvaluation| row.answers.cells.to_string()).csv("cells"),
    text(|row: &PuzzleEvaluation| row.answers.cells_right.to_string()).csv("cells_right"),
    text(|row: &PuzzleEvaluation| row.steps.to_string()).csv("steps"),
    number(|row: &PuzzleEvaluation| Some(row.mean_steps()), 1, 1).table("steps").page("steps"),
    text(|row: &PuzzleEvaluation| row.depth.to_string()).csv("depth"),
    text(|row: &PuzzleEvaluation| row.training.parameters.to_string()).csv("parameters"),
    text(|row: &PuzzleEvaluation| count_text(row.training.parameters)).table("params").page("parameters"),
    text(|row: &PuzzleEvaluation| row.training.steps.to_string()).csv("training_steps"),
    number(|row: &PuzzleEvaluation| Some(row.cpu_seconds), 1, 1).csv("training_cpu_seconds"),
    text(|row: &PuzzleEvaluation| format!("{} steps, {:.0} cpu s", row.training.steps, row.cpu_seconds))
        .table("trained"),
    text(|row: &PuzzleEvaluation| format!("{} steps\n{:.0} cpu s", row.training.steps, row.cpu_seconds))
        .page("training"),
    text(|row: &PuzzleEvaluation| row.training.seed.to_string()).csv("training_seed").table("seed"),
    text(|row: &PuzzleEvaluation| most_of_baselines(row, |counts| counts.valid)).csv("best_baseline_right"),
    text(|row: &PuzzleEvaluation| most_of_baselines(row, |counts| counts.cells_right)).csv("best_baseline_cells_right"),
    text(|row: &PuzzleEvaluation| row.entry.hash.clone()).csv("entry_hash"),
    text(depths_text).page("right after steps"),
];

fn interval(row: &PuzzleEvaluation) -> (f64, f64) {
    wilson_interval(row.answers.valid, row.answers.puzzles)
}

fn walk_text(row: &PuzzleEvaluation) -> String {
    let answers = &row.answers;
    if answers.walk > 0 || answers.detours > 0 { percent(answers.share(answers.walk)) } else { "-".to_owned() }
}

/// `47/50 (94.0%)`
fn detours_text(row: &PuzzleEvaluation) -> String {
    let (right, of) = (row.answers.detours_valid, row.answers.detours);
    if of == 0 { "-".to_owned() } else { format!("{right}/{of} ({})", percent(right as f64 / of as f64)) }
}

/// Cells that are right, and the most that an answer without thought has.
fn cells_text(row: &PuzzleEvaluation) -> String {
    if row.answers.cells == 0 {
        return "-".to_owned();
    }
    format!("{} / {}", percent(row.answers.cell_accuracy()), best_baseline(row, |counts| counts.cells_right))
}

fn most_of_baselines(row: &PuzzleEvaluation, of: fn(&Counts) -> u64) -> String {
    row.baselines.values().map(of).max().unwrap_or(0).to_string()
}

/// `1: 47.5%`, and so on line by line.
fn depths_text(row: &PuzzleEvaluation) -> String {
    let line = |(depth, counts): (&usize, &Counts)| format!("{depth}: {}", percent(counts.share(counts.valid)));
    row.by_depth.iter().map(line).collect::<Vec<_>>().join(", ")
}

/// The puzzles' part of the report, as HTML; nothing where there are none.
pub fn puzzle_section(evaluations: &[PuzzleEvaluation]) -> String {
    let rows = rank_puzzles(evaluations);
    let mut groups: BTreeMap<String, Vec<&PuzzleEvaluation>> = BTreeMap::new();
    for row in &rows {
        groups.entry(task_text(row)).or_default().push(row);
    }
    let mut html = String::new();
    for (task, rows) in groups {
        let _ = writeln!(
            html,
            "<h2>{}</h2>\n<p class=\"lead\">Puzzles of the test split, answered in this program. Right: any shortest path, \
             or the solution. Exact: cell by cell the stored answer. Without thought: the best of the answers that do not \
             look at the walls.</p>\n<div class=\"card\">{}</div>",
            escape(&task),
            html::table(PUZZLE_COLUMNS, rows)
        );
    }
    html
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::puzzle::grade::Baseline;
    use report::column::cells;
    use report::csv;
    use zoo::results::{EntryIdentity, TrainingFacts};

    fn row(name: &str, valid: u64, task: &str) -> PuzzleEvaluation {
        let counts = |valid| Counts {
            puzzles: 200,
            exact: valid,
            valid,
            walk: valid,
            detours: 50,
            detours_valid: valid / 4,
            cells: 12_800,
            cells_right: 12_000,
        };
        PuzzleEvaluation {
            format: 1,
            entry: EntryIdentity { name: name.into(), version: 1, hash: zoo::sha256_hex(name.as_bytes()) },
            training: TrainingFacts {
                policy: "trm".into(),
                parameters: 9_922,
                steps: 500,
                minutes: 0.95,
                seed: 1,
                data_set: "puzzles of open8".into(),
                data_fingerprint: String::new(),
                data_simulator: None,
                demos: 0,
            },
            cpu_seconds: 61.3,
            experiment: "trm_open8".into(),
            config_sha256: String::new(),
            task: task.into(),
            givens: 0,
            seed: 20_000,
            depth: 16,
            answers: counts(valid),
            steps: 500,
            sampled: None,
            progress: Vec::new(),
            by_depth: [(1, counts(valid / 2)), (2, counts(valid))].into(),
            baselines: [(Baseline::AllOff, counts(0)), (Baseline::Straight, counts(92))].into(),
        }
    }

    #[test]
    fn rows_are_ranked_by_right_answers_beside_what_needs_no_thought() {
        let rows = rank_puzzles(&[row("b", 150, "open8"), row("a", 190, "open8"), row("c", 10, "dfs10")]);
        let names: Vec<&str> = rows.iter().map(|row| row.entry.name.as_str()).collect();
        assert_eq!(names, ["c", "a", "b"]);
        let table = cells(PUZZLE_COLUMNS, &rows);
        let cell = |heading: &str| {
            let at = table.headings.iter().position(|(found, _)| *found == heading).unwrap();
            table.rows[1][at].as_str()
        };
        assert_eq!(cell("right [95%]"), "95.0% [91.0-97.3]");
        assert_eq!(cell("no thought: right"), "46.0% (straight)");
        assert_eq!(cell("detours right"), "47/50 (94.0%)");
        assert_eq!(cell("steps"), "2.5");
        let csv = csv::table(PUZZLE_COLUMNS, &rows);
        assert_eq!(csv.lines().count(), 4);
        assert!(
            csv.starts_with("entry,version,policy,task,givens,puzzles,right,ci95_low,ci95_high,exact,walk,detours,")
        );
        assert!(
            csv.contains(
                "a,1,trm,open8,0,200,190,0.9104,0.9726,190,190,50,47,12800,12000,500,16,9922,500,61.3,1,92,12000,"
            ),
            "{csv}"
        );
        let html = puzzle_section(&rows);
        assert!(html.contains("<td>190/200</td>") && html.contains("1: 47.5%, 2: 95.0%"), "{html}");
        assert_eq!(puzzle_section(&[]), "");
    }
}
