//! The puzzles' part of the leaderboard: one row an evaluation, ranked inside its task by right answers.

use std::cmp::Ordering;
use std::collections::BTreeMap;
use std::fmt::Write as _;

use report::column::{Column, count, number, text};
use report::html::{self, escape};
use report::{count_text, wilson_interval};

use super::evaluation::{Judge, PuzzleEvaluation, Starts, TEST_SEED};
use super::grade::Counts;

/// Best first inside each task, by the lower end of the interval; ties by what does not change.
pub fn rank_puzzles(evaluations: &[PuzzleEvaluation]) -> Vec<PuzzleEvaluation> {
    let mut rows = evaluations.to_vec();
    rows.sort_by(order);
    rows
}

fn order(one: &PuzzleEvaluation, two: &PuzzleEvaluation) -> Ordering {
    let group = |row: &PuzzleEvaluation| {
        (row.task.clone(), row.givens, row.seed, row.starts.most, row.views, row.judge == Judge::Cells)
    };
    // so that 1 of 1 does not come before 599 of 600
    let least = |row: &PuzzleEvaluation| wilson_interval(row.answers.valid, row.answers.puzzles).0;
    group(one)
        .cmp(&group(two))
        .then_with(|| least(two).total_cmp(&least(one)))
        .then_with(|| two.answers.exact.cmp(&one.answers.exact))
        .then_with(|| one.training.parameters.cmp(&two.training.parameters))
        .then_with(|| one.entry.cmp(&two.entry))
        .then_with(|| (one.depth, one.answers.puzzles).cmp(&(two.depth, two.answers.puzzles)))
}

/// `open8`, `sudoku9, 36 givens`; of other puzzles than those that every solver answers, `open8, seed 7`;
/// where thoughts may begin again, `dfs20, 8 starts`.
fn task_text(row: &PuzzleEvaluation) -> String {
    let mut text = match row.givens {
        0 => row.task.clone(),
        givens => format!("{}, {givens} givens", row.task),
    };
    if row.seed != TEST_SEED {
        text.push_str(&format!(", seed {}", row.seed));
    }
    if row.starts != Starts::ONE {
        text.push_str(&format!(", {} starts", row.starts.most));
    }
    if row.views != 1 {
        text.push_str(&format!(", {} views", row.views));
    }
    if row.judge == Judge::Cells {
        text.push_str(" weighed by cells");
    }
    text
}

/// `98.3%`; of some but not all never `0.0%` or `100.0%`.
fn percent(part: u64, of: u64) -> String {
    report::percent(part, of, 1) + "%"
}

/// `98.3% [97.1-99.1]`
fn rate(part: u64, of: u64) -> String {
    if of == 0 {
        return "-".to_owned();
    }
    let (low, high) = wilson_interval(part, of);
    format!("{} [{:.1}-{:.1}]", percent(part, of), 100.0 * low, 100.0 * high)
}

/// The baseline that gets most answers right, and most cells: what a row's numbers have to be compared with.
fn best_baseline(row: &PuzzleEvaluation, of: fn(&Counts) -> u64) -> String {
    let best = row.baselines.iter().max_by_key(|(name, counts)| (of(counts), std::cmp::Reverse(**name)));
    best.map_or_else(
        || "-".to_owned(),
        |(name, counts)| {
            let all = if of(counts) == counts.cells_right { counts.cells } else { counts.puzzles };
            format!("{} ({})", percent(of(counts), all), name.name())
        },
    )
}

/// The statistics of the puzzles' board, in their order: everything that writes it walks this list.
pub const PUZZLE_COLUMNS: &[Column<PuzzleEvaluation>] = &[
    text(|row: &PuzzleEvaluation| row.entry.to_string()).table("entry").page("entry").left().kept(),
    text(|row: &PuzzleEvaluation| row.entry.name.clone()).csv("entry"),
    count(|row: &PuzzleEvaluation| Some(u64::from(row.entry.version))).csv("version"),
    text(|row: &PuzzleEvaluation| row.training.policy.clone()).csv("policy").page("model"),
    text(|row: &PuzzleEvaluation| row.task.clone()).csv("task"),
    text(task_text).table("task").left().kept(),
    count(|row: &PuzzleEvaluation| Some(row.givens as u64)).csv("givens"),
    count(|row: &PuzzleEvaluation| Some(row.answers.puzzles)).csv("puzzles"),
    count(|row: &PuzzleEvaluation| Some(row.answers.valid)).csv("right"),
    text(|row: &PuzzleEvaluation| format!("{}/{}", row.answers.valid, row.answers.puzzles)).page("right"),
    text(|row: &PuzzleEvaluation| rate(row.answers.valid, row.answers.puzzles)).table("right [95%]").kept(),
    number(|row: &PuzzleEvaluation| Some(interval(row).0), 4, 4).csv("ci95_low"),
    number(|row: &PuzzleEvaluation| Some(interval(row).1), 4, 4).csv("ci95_high"),
    text(|row: &PuzzleEvaluation| format!("{:.1}–{:.1}%", interval(row).0 * 1e2, interval(row).1 * 1e2))
        .page("95% interval"),
    count(|row: &PuzzleEvaluation| Some(row.answers.exact)).csv("exact").page("exact"),
    text(|row: &PuzzleEvaluation| percent(row.answers.exact, row.answers.puzzles)).table("exact"),
    count(|row: &PuzzleEvaluation| Some(row.answers.walk)).csv("walk").page("walk"),
    text(walk_text).table("walk"),
    count(|row: &PuzzleEvaluation| Some(row.answers.detours)).csv("detours"),
    count(|row: &PuzzleEvaluation| Some(row.answers.detours_valid)).csv("detours_right"),
    text(detours_text).table("detours right").page("detours right"),
    text(|row: &PuzzleEvaluation| best_baseline(row, |counts| counts.valid))
        .table("no thought: right")
        .page("without thought"),
    text(cells_text).table("cells / no thought"),
    count(|row: &PuzzleEvaluation| Some(row.answers.cells)).csv("cells"),
    count(|row: &PuzzleEvaluation| Some(row.answers.cells_right)).csv("cells_right"),
    count(|row: &PuzzleEvaluation| Some(row.steps)).csv("steps"),
    number(|row: &PuzzleEvaluation| Some(row.mean_steps()), 1, 1).table("steps").page("steps"),
    count(|row: &PuzzleEvaluation| Some(row.depth as u64)).csv("depth"),
    count(|row: &PuzzleEvaluation| Some(row.training.parameters)).csv("parameters"),
    text(|row: &PuzzleEvaluation| count_text(row.training.parameters)).table("params").page("parameters"),
    count(|row: &PuzzleEvaluation| Some(row.training.steps)).csv("training_steps"),
    number(|row: &PuzzleEvaluation| Some(row.cpu_seconds), 1, 1).csv("training_cpu_seconds"),
    text(|row: &PuzzleEvaluation| format!("{} steps, {:.0} cpu s", row.training.steps, row.cpu_seconds))
        .table("trained"),
    text(|row: &PuzzleEvaluation| format!("{} steps\n{:.0} cpu s", row.training.steps, row.cpu_seconds))
        .page("training"),
    count(|row: &PuzzleEvaluation| Some(row.training.seed)).csv("training_seed").table("seed"),
    text(|row: &PuzzleEvaluation| most_of_baselines(row, |counts| counts.valid)).csv("best_baseline_right"),
    text(|row: &PuzzleEvaluation| most_of_baselines(row, |counts| counts.cells_right)).csv("best_baseline_cells_right"),
    text(|row: &PuzzleEvaluation| row.entry.hash.clone()).csv("entry_hash"),
    count(|row: &PuzzleEvaluation| Some(row.seed)).csv("seed"),
    text(depths_text).page("right after steps"),
    count(|row: &PuzzleEvaluation| Some(row.starts.most)).csv("starts"),
    count(|row: &PuzzleEvaluation| Some(row.views)).csv("views"),
    text(|row: &PuzzleEvaluation| row.judge.name().to_owned()).csv("judge"),
    number(|row: &PuzzleEvaluation| Some(row.starts.noise), 4, 4).csv("noise"),
];

fn interval(row: &PuzzleEvaluation) -> (f64, f64) {
    wilson_interval(row.answers.valid, row.answers.puzzles)
}

fn walk_text(row: &PuzzleEvaluation) -> String {
    let answers = &row.answers;
    if answers.walk > 0 || answers.detours > 0 { percent(answers.walk, answers.puzzles) } else { "-".to_owned() }
}

/// `47/50 (94.0%)`
fn detours_text(row: &PuzzleEvaluation) -> String {
    let (right, of) = (row.answers.detours_valid, row.answers.detours);
    if of == 0 { "-".to_owned() } else { format!("{right}/{of} ({})", percent(right, of)) }
}

/// Cells that are right, and the most that an answer without thought has.
fn cells_text(row: &PuzzleEvaluation) -> String {
    if row.answers.cells == 0 {
        return "-".to_owned();
    }
    format!(
        "{} / {}",
        percent(row.answers.cells_right, row.answers.cells),
        best_baseline(row, |counts| counts.cells_right)
    )
}

fn most_of_baselines(row: &PuzzleEvaluation, of: fn(&Counts) -> u64) -> String {
    row.baselines.values().map(of).max().unwrap_or(0).to_string()
}

/// `1: 47.5%`, and so on line by line.
fn depths_text(row: &PuzzleEvaluation) -> String {
    let line = |(depth, counts): (&usize, &Counts)| format!("{depth}: {}", percent(counts.valid, counts.puzzles));
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
    if !groups.is_empty() {
        html.push_str("<h2 id=\"puzzles\">Puzzles</h2>\n");
    }
    for (task, rows) in groups {
        let _ = writeln!(
            html,
            "<h3>{}</h3>\n<p class=\"lead\">Puzzles of the test split, answered in this program. Right: any shortest path, \
             the solution, or the goal reached. Exact: cell by cell the stored answer. Without thought: the best of the answers that do not \
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
            starts: Starts::ONE,
            views: 1,
            judge: Judge::Halting,
            answers: counts(valid),
            steps: 500,
            sampled: None,
            progress: Vec::new(),
            by_effort: Vec::new(),
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
        let mut lucky = row("lucky", 1, "open8");
        (lucky.answers.puzzles, lucky.answers.exact) = (1, 1);
        assert_eq!(rank_puzzles(&[lucky, row("a", 190, "open8")])[0].entry.name, "a");
        // other puzzles and other rules are ranked by themselves
        let fresh = PuzzleEvaluation { seed: 21_000, ..row("a", 200, "open8") };
        let often = PuzzleEvaluation { starts: Starts { most: 8, noise: 1.0 }, ..row("a", 200, "open8") };
        assert_eq!([task_text(&fresh), task_text(&often)], ["open8, seed 21000", "open8, 8 starts"]);
        let names: Vec<String> = rank_puzzles(&[fresh, often, row("b", 150, "open8")]).iter().map(task_text).collect();
        assert_eq!(names, ["open8", "open8, 8 starts", "open8, seed 21000"]);
        let views = PuzzleEvaluation { views: 8, ..row("a", 200, "open8") };
        let cells = PuzzleEvaluation { judge: Judge::Cells, ..views.clone() };
        let rows = rank_puzzles(&[cells, views, row("b", 150, "open8")]);
        let names: Vec<String> = rows.iter().map(task_text).collect();
        assert_eq!(names, ["open8", "open8, 8 views", "open8, 8 views weighed by cells"]);
        let csv = csv::table(PUZZLE_COLUMNS, &rows);
        assert!(csv.lines().next().is_some_and(|head| head.ends_with(",starts,views,judge,noise")), "{csv}");
        assert!(csv.lines().any(|line| line.ends_with(",1,8,cells,0.0000")), "{csv}");
    }
}
