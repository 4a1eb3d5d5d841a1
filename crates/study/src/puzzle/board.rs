//! The puzzles' part of the leaderboard: one row an evaluation, ranked inside its task by right answers.

use std::cmp::Ordering;
use std::collections::BTreeMap;
use std::fmt::Write as _;

use report::{count_text, escape, wilson_interval};

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

/// The columns of [`puzzle_table`].
pub const PUZZLE_COLUMNS: [&str; 12] = [
    "entry",
    "task",
    "right [95%]",
    "exact",
    "walk",
    "detours right",
    "no thought: right",
    "cells / no thought",
    "steps",
    "params",
    "trained",
    "seed",
];

/// The rows in short, for a terminal: cells in the order of [`PUZZLE_COLUMNS`].
pub fn puzzle_table(rows: &[PuzzleEvaluation]) -> Vec<[String; PUZZLE_COLUMNS.len()]> {
    rows.iter()
        .map(|row| {
            let a = &row.answers;
            let cells = match a.cells {
                0 => "-".to_owned(),
                _ => format!("{} / {}", percent(a.cell_accuracy()), best_baseline(row, |counts| counts.cells_right)),
            };
            let maze = a.walk > 0 || a.detours > 0;
            [
                row.entry.to_string(),
                task_text(row),
                rate(a.valid, a.puzzles),
                percent(a.share(a.exact)),
                if maze { percent(a.share(a.walk)) } else { "-".to_owned() },
                if a.detours > 0 { percent(a.detours_valid as f64 / a.detours as f64) } else { "-".to_owned() },
                best_baseline(row, |counts| counts.valid),
                cells,
                format!("{:.1}", row.mean_steps()),
                count_text(row.training.parameters),
                format!("{} steps, {:.0} cpu s", row.training.steps, row.cpu_seconds),
                row.training.seed.to_string(),
            ]
        })
        .collect()
}

/// The columns of [`puzzle_csv`].
pub const PUZZLE_CSV_COLUMNS: [&str; 24] = [
    "entry",
    "version",
    "policy",
    "task",
    "givens",
    "puzzles",
    "right",
    "ci95_low",
    "ci95_high",
    "exact",
    "walk",
    "detours",
    "detours_right",
    "cells",
    "cells_right",
    "steps",
    "depth",
    "parameters",
    "training_steps",
    "training_cpu_seconds",
    "training_seed",
    "best_baseline_right",
    "best_baseline_cells_right",
    "entry_hash",
];

/// The rows as CSV: counts, and the 95% Wilson interval of the share of right answers.
pub fn puzzle_csv(rows: &[PuzzleEvaluation]) -> String {
    let mut text = PUZZLE_CSV_COLUMNS.join(",");
    text.push('\n');
    for row in rows {
        let a = &row.answers;
        let (low, high) = wilson_interval(a.valid, a.puzzles);
        let most = |of: fn(&Counts) -> u64| row.baselines.values().map(of).max().unwrap_or(0).to_string();
        let cells: [String; PUZZLE_CSV_COLUMNS.len()] = [
            row.entry.name.clone(),
            row.entry.version.to_string(),
            row.training.policy.clone(),
            row.task.clone(),
            row.givens.to_string(),
            a.puzzles.to_string(),
            a.valid.to_string(),
            format!("{low:.4}"),
            format!("{high:.4}"),
            a.exact.to_string(),
            a.walk.to_string(),
            a.detours.to_string(),
            a.detours_valid.to_string(),
            a.cells.to_string(),
            a.cells_right.to_string(),
            row.steps.to_string(),
            row.depth.to_string(),
            row.training.parameters.to_string(),
            row.training.steps.to_string(),
            format!("{:.1}", row.cpu_seconds),
            row.training.seed.to_string(),
            most(|counts| counts.valid),
            most(|counts| counts.cells_right),
            row.entry.hash.clone(),
        ];
        text.push_str(&cells.join(","));
        text.push('\n');
    }
    text
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
             look at the walls.</p>\n<div class=\"card\"><table><thead><tr><th>entry</th><th>model</th><th>right</th>\
             <th>95% interval</th><th>exact</th><th>walk</th><th>detours right</th><th>without thought</th>\
             <th>steps</th><th>parameters</th><th>training</th><th>right after steps</th></tr></thead><tbody>",
            escape(&task)
        );
        for row in rows {
            let a = &row.answers;
            let (low, high) = wilson_interval(a.valid, a.puzzles);
            let depths: Vec<String> = row
                .by_depth
                .iter()
                .map(|(depth, counts)| format!("{depth}: {}", percent(counts.share(counts.valid))))
                .collect();
            let detours = match a.detours {
                0 => "–".to_owned(),
                n => format!("{}/{n}", a.detours_valid),
            };
            let _ = writeln!(
                html,
                "<tr><td class=\"name\">{}</td><td>{}</td><td>{}/{}</td><td>{:.1}–{:.1}%</td><td>{}</td><td>{}</td>\
                 <td>{detours}</td><td>{}</td><td>{:.1}</td><td>{}</td><td>{} steps<br><small>{:.0} cpu s</small></td>\
                 <td><small>{}</small></td></tr>",
                escape(&row.entry.to_string()),
                escape(&row.training.policy),
                a.valid,
                a.puzzles,
                low * 1e2,
                high * 1e2,
                a.exact,
                a.walk,
                escape(&best_baseline(row, |counts| counts.valid)),
                row.mean_steps(),
                count_text(row.training.parameters),
                row.training.steps,
                row.cpu_seconds,
                depths.join(", ")
            );
        }
        html.push_str("</tbody></table></div>\n");
    }
    html
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::puzzle::grade::Baseline;
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
        let table = puzzle_table(&rows);
        assert_eq!(table[1][2], "95.0% [91.0-97.3]");
        assert_eq!(table[1][6], "46.0% (straight)");
        assert_eq!(table[1][8], "2.5");
        let csv = puzzle_csv(&rows);
        assert_eq!(csv.lines().count(), 4);
        assert!(csv.lines().all(|line| line.split(',').count() == PUZZLE_CSV_COLUMNS.len()));
        let html = puzzle_section(&rows);
        assert!(html.contains("<td>190/200</td>") && html.contains("1: 47.5%, 2: 95.0%"), "{html}");
        assert_eq!(puzzle_section(&[]), "");
    }
}
