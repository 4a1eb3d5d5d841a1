//! The page of a study: made of its committed results and of nothing else.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::path::Path;

use report::statistics::{Estimate, difference, hierarchical, holm};
use zoo::ZooError;

use super::cells::cells;
use super::file::{Comparison, Study};
use super::result::CellResult;

/// Seed of the bootstrap: the same results give the same page.
const BOOTSTRAP_SEED: u64 = 1;

/// Results of one arm on one test, by the training's seed.
type Trainings = BTreeMap<u64, CellResult>;

/// The page of `study` from the results in its folder, as Markdown.
///
/// # Errors
/// A result that cannot be read.
pub fn robot_page(study: &Study, file: &Path) -> Result<String, ZooError> {
    let mut results: BTreeMap<(String, String, String), Trainings> = BTreeMap::new();
    let mut missing = Vec::new();
    for cell in cells(study) {
        for test in &cell.tests {
            match CellResult::read(&study.results.join(cell.file_name(test)))? {
                Some(result) => {
                    let key = (test.clone(), cell.data.clone(), cell.arm.clone());
                    results.entry(key).or_default().insert(cell.seed, result);
                }
                None => missing.push(format!("{} on {test}", cell.name())),
            }
        }
    }
    let mut text = format!("# {}\n\n", study.title);
    let _ = writeln!(
        text,
        "Written by `actrm-zoo study {} --page-only` from the files in `{}`; without `--page-only` the same command runs \
         what is missing.\n",
        file.display(),
        study.results.display()
    );
    if !study.introduction.is_empty() {
        let _ = writeln!(text, "{}\n", study.introduction.trim());
    }
    for (name, test) in &study.tests {
        for data in study.data.keys() {
            let of_test: Vec<(&String, &Trainings)> = study
                .arms
                .keys()
                .filter_map(|arm| Some((arm, results.get(&(name.clone(), data.clone(), arm.clone()))?)))
                .collect();
            if of_test.is_empty() {
                continue;
            }
            let source = &study.data[data];
            let _ = writeln!(
                text,
                "## {} after {} demonstrations of {}\n\nSeeds {} to {}, {} episodes a training. Success with its 95% \
                 interval over trainings and episodes; below it each training's.\n",
                test.task,
                source.episodes,
                source.task,
                test.seed_start,
                test.seed_start + test.episodes - 1,
                test.episodes
            );
            table(&mut text, study, &of_test);
        }
    }
    comparisons(&mut text, study, &results);
    costs(&mut text, study, &results);
    if !missing.is_empty() {
        let _ = writeln!(text, "## Not run\n");
        missing.iter().for_each(|cell| {
            let _ = writeln!(text, "- {cell}");
        });
    }
    Ok(text)
}

/// Whether the episode counts for `group`; `None` is all of them.
fn outcomes(trainings: &Trainings, groups: &[String]) -> Vec<Vec<f64>> {
    trainings
        .values()
        .map(|result| {
            let chosen = result.episodes.iter().filter(|episode| {
                groups.is_empty() || episode.group.as_ref().is_some_and(|group| groups.contains(group))
            });
            chosen.map(|episode| f64::from(u8::from(episode.success))).collect()
        })
        .collect()
}

fn table(text: &mut String, study: &Study, rows: &[(&String, &Trainings)]) {
    let groups: BTreeSet<String> = rows
        .iter()
        .flat_map(|(_, trainings)| trainings.values())
        .flat_map(|result| result.episodes.iter().filter_map(|episode| episode.group.clone()))
        .collect();
    let mut columns: Vec<Option<String>> = vec![None];
    columns.extend(groups.into_iter().map(Some));
    let heads: Vec<String> = columns.iter().map(|c| c.clone().unwrap_or_else(|| "all".to_owned())).collect();
    let _ = writeln!(text, "| arm | {} |", heads.join(" | "));
    let _ = writeln!(text, "|---|{}", "---|".repeat(heads.len()));
    for (arm, trainings) in rows {
        let cells: Vec<String> = columns.iter().map(|group| cell_text(trainings, group.as_slice())).collect();
        let _ = writeln!(text, "| {} | {} |", study.arms[*arm].label, cells.join(" | "));
    }
    text.push('\n');
}

/// `97% [95-99]` and, below, every training's count.
fn cell_text(trainings: &Trainings, groups: &[String]) -> String {
    let outcomes = outcomes(trainings, groups);
    let Some(estimate) = hierarchical(&outcomes, BOOTSTRAP_SEED) else { return "-".to_owned() };
    let each: Vec<String> = outcomes.iter().map(|o| format!("{:.0}", o.iter().sum::<f64>())).collect();
    let n = outcomes.first().map_or(0, Vec::len);
    format!("{}<br>{} of {n}", percent(&estimate), each.join(", "))
}

fn percent(estimate: &Estimate) -> String {
    let Estimate { value, low, high } = estimate;
    format!("{:.1}% [{:.0}-{:.0}]", 100.0 * value, 100.0 * low, 100.0 * high)
}

fn comparisons(text: &mut String, study: &Study, results: &BTreeMap<(String, String, String), Trainings>) {
    if study.comparisons.is_empty() {
        return;
    }
    let _ = writeln!(
        text,
        "## Comparisons\n\nDifference of success, first less second, with its 95% interval (trainings drawn on both \
         sides, episodes for both alike; Student's t for the number of trainings); p after Holm's correction over the \
         rows of this table.\n\n| question | first | second | episodes | trainings | difference | p | answer |\n\
         |---|---|---|---|---|---|---|---|"
    );
    let found: Vec<(&Comparison, Option<_>)> = study
        .comparisons
        .iter()
        .map(|c| {
            let side = |arm: &String| {
                let key = (c.test.clone(), c.data.clone(), arm.clone());
                results.get(&key).map(|trainings| outcomes(trainings, &c.groups))
            };
            let sides = side(&c.first).zip(side(&c.second));
            let counted = sides.and_then(|(a, b)| {
                let trainings = (a.len(), b.len());
                difference(&a, &b, BOOTSTRAP_SEED).map(|d| (d, trainings))
            });
            (c, counted)
        })
        .collect();
    let p_values: Vec<f64> = found.iter().filter_map(|(_, d)| d.as_ref().map(|(d, _)| d.p_value)).collect();
    let mut adjusted = holm(&p_values).into_iter();
    for (comparison, counted) in found {
        let (first, second) = (&study.arms[&comparison.first].label, &study.arms[&comparison.second].label);
        let episodes = match comparison.groups.is_empty() {
            true => "all".to_owned(),
            false => comparison.groups.join(", "),
        };
        let rest = match counted {
            None => "| not run | - | - | not run".to_owned(),
            Some((d, (m, n))) => {
                let p = adjusted.next().unwrap_or(1.0);
                let Estimate { value, low, high } = d.estimate;
                let answer = match (p < 0.05, value > 0.0) {
                    (false, _) => "cannot tell",
                    (true, true) => "the first is better",
                    (true, false) => "the second is better",
                };
                let points = format!("{:+.1} points [{:+.0}, {:+.0}]", 100.0 * value, 100.0 * low, 100.0 * high);
                format!("| {m}, {n} | {points} | {} | {answer}", p_text(p))
            }
        };
        let _ = writeln!(text, "| {} | {first} | {second} | {episodes} {rest} |", comparison.question);
    }
    text.push('\n');
}

fn p_text(p: f64) -> String {
    if p < 0.001 { "< 0.001".to_owned() } else { format!("{p:.3}") }
}

fn costs(text: &mut String, study: &Study, results: &BTreeMap<(String, String, String), Trainings>) {
    let _ = writeln!(
        text,
        "## What each costs\n\nMedians over all trainings of an arm; minutes are of a machine that did other work beside.\n\n\
         | arm | experiment | settings | parameters | steps | minutes | a query, ms |\n|---|---|---|---|---|---|---|"
    );
    for (name, arm) in &study.arms {
        let of_arm: Vec<&CellResult> =
            results.iter().filter(|((_, _, a), _)| a == name).flat_map(|(_, t)| t.values()).collect();
        let Some(first) = of_arm.first() else { continue };
        let median = |value: fn(&CellResult) -> f64| {
            let mut values: Vec<f64> = of_arm.iter().map(|r| value(r)).collect();
            values.sort_by(f64::total_cmp);
            values[values.len() / 2]
        };
        let settings: Vec<String> = arm.set.iter().map(|s| format!("`{s}`")).collect();
        let _ = writeln!(
            text,
            "| {} | `{}` | {} | {} | {} | {:.1} | {:.2} |",
            arm.label,
            arm.experiment,
            settings.join(", "),
            first.training.parameters,
            first.training.steps,
            median(|r| r.training.minutes),
            median(|r| r.query_ms)
        );
    }
    text.push('\n');
}
