//! The page of a study: made of its committed results and of nothing else.

mod charts;
mod overview;
mod probes;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::path::Path;

use report::share_percent;
use report::statistics::{Estimate, difference, holm, over_trainings};
use zoo::ZooError;

pub use self::charts::robot_charts;
use self::charts::{all_arms, by_arm, by_cost, by_steps, shown};
use self::overview::{apart, overview};
use self::probes::probes;
use super::cells::cells;
use super::file::{Comparison, Data, Study};
use super::result::CellResult;

/// Results of one arm on one test, by the training's seed.
type Trainings = BTreeMap<u64, CellResult>;

/// What there is of a study, by test, demonstrations and arm.
type Results = BTreeMap<(String, String, String), Trainings>;

/// What there is in the folder of `study`. A result of another definition of its demonstrations or its test, from before the
/// study's file was changed, is none of this study's.
fn read_results(study: &Study) -> Result<Results, ZooError> {
    let mut results = Results::new();
    for cell in cells(study) {
        for test in &cell.tests {
            let found = CellResult::read(&study.results.join(cell.file_name(test)))?;
            if let Some(result) = found.filter(|result| result.answers(study, &cell, test)) {
                let key = (test.clone(), cell.data.clone(), cell.arm.clone());
                let trainings: &mut Trainings = results.entry(key).or_default();
                let twin = |other: &&CellResult| {
                    other.seed != result.seed && other.weights.is_some() && other.weights == result.weights
                };
                if let Some(other) = trainings.values().find(twin) {
                    return Err(ZooError::Malformed {
                        path: study.results.join(cell.file_name(test)),
                        reason: format!("weights: those of seed {}; each training has its own", other.seed),
                    });
                }
                trainings.insert(cell.seed, result);
            }
        }
    }
    Ok(results)
}

/// Refuses a comparison of groups that no stored episode of its test has.
fn check_groups(study: &Study, results: &Results) -> Result<(), ZooError> {
    for (i, comparison) in study.comparisons.iter().enumerate() {
        let of_test = results.iter().filter(|((test, ..), _)| *test == comparison.test);
        let episodes: Vec<_> =
            of_test.flat_map(|(_, trainings)| trainings.values()).flat_map(|r| &r.episodes).collect();
        let there: BTreeSet<&str> = episodes.iter().filter_map(|episode| episode.group.as_deref()).collect();
        let unknown = comparison.groups.iter().find(|group| !there.contains(group.as_str()));
        if let Some(group) = unknown.filter(|_| !episodes.is_empty()) {
            let names: Vec<&str> = there.into_iter().collect();
            return Err(ZooError::InvalidValue {
                key: format!("comparisons[{i}].groups"),
                expected: if names.is_empty() { "none".to_owned() } else { format!("some of {}", names.join(", ")) },
                found: group.clone(),
            });
        }
    }
    Ok(())
}

/// Part of a page that is shown when its title is clicked.
fn folded(text: &mut String, title: &str, part: &str) {
    // HTML shows no Markdown
    let title = title.replace('`', "");
    let _ =
        writeln!(text, "<details markdown=\"1\">\n<summary>{title}</summary>\n\n{}\n\n</details>\n", part.trim_end());
}

/// The page of `study` from the results in its folder, as Markdown.
///
/// # Errors
/// A result that cannot be read.
pub fn robot_page(study: &Study, file: &Path) -> Result<String, ZooError> {
    let results = read_results(study)?;
    check_groups(study, &results)?;
    let charts = by_arm(study, &results);
    let mut text = format!("# {}\n\n", study.title);
    if !study.verdict.is_empty() {
        let _ = writeln!(text, "{}\n", study.verdict.trim());
    }
    let stages: BTreeSet<u8> = study.comparisons.iter().map(|comparison| comparison.stage).collect();
    let compared: Vec<_> = stages.iter().map(|stage| compare(study, &results, *stage)).collect();
    if study.verdict.is_empty() {
        verdict(&mut text, study, &compared);
    }
    if let Some(chart) = all_arms(study, &results) {
        let _ = writeln!(text, "{}", shown(study, &chart));
    }
    // a verdict in words comes before what it is made of
    if !study.verdict.is_empty() {
        verdict(&mut text, study, &compared);
    }
    if !study.introduction.is_empty() {
        let _ = writeln!(text, "{}\n", study.introduction.trim());
    }
    overview(&mut text, study, &results);
    let tests: Vec<_> = study.tests.iter().filter(|(_, test)| test.is_plain()).collect();
    if !results.is_empty() {
        text.push_str(
            "## Trainings\n\nSuccess with its 95% interval over trainings and episodes; below it the successes of each training.\n\n",
        );
    }
    for (name, test) in tests {
        let of_data = |data: &String| -> Vec<(&String, &Trainings)> {
            let of_arm = |arm| Some((arm, results.get(&(name.clone(), data.clone(), String::clone(arm)))?));
            study.arms.keys().filter_map(of_arm).collect()
        };
        let head = |source: &Data| format!("{} demonstrations of {}{}", source.episodes, source.task, source.words());
        let there = study.data.iter().filter(|(data, _)| !of_data(data).is_empty());
        let headed: Vec<(&str, String)> = there.map(|(data, source)| (data.as_str(), head(source))).collect();
        for ((data, head), mark) in headed.iter().zip(apart(study, &headed)) {
            let of_test = of_data(&(*data).to_owned());
            for (_, chart) in charts.iter().filter(|((test, of), _)| test == name && of == data) {
                let _ = writeln!(text, "{}", shown(study, chart));
            }
            let last = test.seed_start + test.episodes - 1;
            let title = format!("{}: {head}{mark}; seeds {} to {last}", test.task, test.seed_start);
            let mut part = String::new();
            table(&mut part, study, &of_test);
            folded(&mut text, &title, &part);
        }
    }
    for (stage, found) in stages.iter().zip(&compared) {
        let title = match stage {
            1 => "Planned comparisons".to_owned(),
            2 => "Comparisons that were added later".to_owned(),
            later => format!("Comparisons of stage {later}"),
        };
        comparisons(&mut text, study, found, &title);
    }
    for chart in by_cost(study, &results) {
        let _ = writeln!(text, "{}", shown(study, &chart));
    }
    images_changed(&mut text, study, &results);
    other_refinement(&mut text, study, &results);
    probes(&mut text, study)?;
    costs(&mut text, study, &results);
    trained_twice(&mut text, &results);
    let from = match results.is_empty() {
        // a folder without a result may not be there
        true => String::new(),
        false => format!(" from the files in `{}`", study.results.display()),
    };
    let file = file.display();
    let _ = writeln!(
        text,
        "## How to repeat it\n\n`actrm-zoo study {file} --page-only` writes this page{from}. Without `--page-only` it first runs what \
         is missing, and `--list` prints which trainings and tests those are.\n"
    );
    while text.ends_with("\n\n") {
        text.pop();
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
    // by which words episodes were lost before their end, where results say so
    let words: BTreeSet<&str> = rows
        .iter()
        .flat_map(|(_, trainings)| trainings.values())
        .flat_map(|result| result.episodes.iter().filter_map(|episode| episode.failure.as_deref()))
        .collect();
    let lost: String = words.iter().map(|word| format!(" {word} |")).collect();
    let ways: Vec<Option<f64>> = rows.iter().map(|(_, trainings)| mean_progress(trainings)).collect();
    // a column where any arm has it
    let staged = ways.iter().any(Option::is_some);
    let way = if staged { " progress |" } else { "" };
    let _ = writeln!(text, "| arm | {} |{way}{lost}", heads.join(" | "));
    let _ = writeln!(text, "|---|{}", "---|".repeat(heads.len() + words.len() + usize::from(staged)));
    for ((arm, trainings), way) in rows.iter().zip(ways) {
        let cells: Vec<String> = columns.iter().map(|group| cell_text(trainings, group.as_slice())).collect();
        let way = way.map_or(if staged { " - |" } else { "" }.to_owned(), |way| format!(" {way:.3} |"));
        let share = |word: &str| -> String {
            let all = trainings.values().flat_map(|result| &result.episodes);
            let (lost, n) = all.fold((0.0, 0.0), |(lost, n), episode| {
                (lost + f64::from(u8::from(episode.failure.as_deref() == Some(word))), n + 1.0)
            });
            format!(" {:.1}% |", 100.0 * lost / n)
        };
        let lost: String = words.iter().map(|word| share(word)).collect();
        let _ = writeln!(text, "| {} | {} |{way}{lost}", study.arms[*arm].label, cells.join(" | "));
    }
    text.push('\n');
    if staged {
        let _ = writeln!(
            text,
            "Progress: mean share of the task's stages that an episode passed in order; success is the last stage.\n"
        );
    }
}

/// Mean share of their way that the episodes came; none unless every one has it.
fn mean_progress(trainings: &Trainings) -> Option<f64> {
    let all = trainings.values().flat_map(|result| &result.episodes);
    let ways: Option<Vec<f64>> = all.map(|episode| episode.progress).collect();
    ways.filter(|ways| !ways.is_empty()).map(|ways| ways.iter().sum::<f64>() / ways.len() as f64)
}

/// An arm, how it refines in words, and its results.
type Otherwise<'a> = (&'a str, String, &'a Trainings);

/// What the same weights do with other refinement settings than in training.
fn other_refinement(text: &mut String, study: &Study, results: &Results) {
    let mut rows: BTreeMap<(&str, &str), Vec<Otherwise<'_>>> = BTreeMap::new();
    for ((test, data, arm), trainings) in results {
        let definition = &study.tests[test];
        let Some(words) = definition.thinking_words() else { continue };
        rows.entry((definition.task.as_str(), data.as_str())).or_default().push((arm.as_str(), words, trainings));
    }
    if rows.is_empty() {
        return;
    }
    let _ = writeln!(
        text,
        "## Other refinement settings\n\nThe weights of the policies above, tested with another number of refinement steps, with or without \
         early stopping, or with their latent reasoning frozen or taken from another episode. Where several thoughts begin from noise, the \
         halting head chooses one.\n"
    );
    let head = |task: &str, data: &str| format!("{task} after {} demonstrations", study.data[data].episodes);
    let headed: Vec<(&str, String)> = rows.keys().map(|(task, data)| (*data, head(task, data))).collect();
    let marks = apart(study, &headed);
    for (((task, data), mut rows), ((_, head), mark)) in rows.into_iter().zip(headed.into_iter().zip(marks)) {
        rows.sort_by_key(|(arm, _, trainings)| {
            let thinking = trainings.values().next().map(|result| result.test_definition.thinking).unwrap_or_default();
            (*arm, thinking.intervene.map(|i| i.name()), thinking.starts.map(|starts| starts.count), thinking.steps)
        });
        let groups: BTreeSet<String> = rows
            .iter()
            .flat_map(|(_, _, trainings)| trainings.values())
            .flat_map(|result| result.episodes.iter().filter_map(|episode| episode.group.clone()))
            .collect();
        let mut columns: Vec<Option<String>> = vec![None];
        columns.extend(groups.into_iter().map(Some));
        let heads: Vec<String> = columns.iter().map(|c| c.clone().unwrap_or_else(|| "all".to_owned())).collect();
        let mut part = String::new();
        let _ = writeln!(
            part,
            "| arm | refinement | {} | query, ms | MFLOP |\n|---|---|{}",
            heads.join(" | "),
            "---|".repeat(heads.len() + 2)
        );
        for (arm, words, trainings) in rows {
            let cells: Vec<String> = columns.iter().map(|group| cell_text(trainings, group.as_slice())).collect();
            let of_arm: Vec<&CellResult> = trainings.values().collect();
            let (label, cells) = (&study.arms[arm].label, cells.join(" | "));
            let halts = of_arm.iter().any(|result| result.test_definition.thinking.halting == Some(true));
            let most = if halts { "at most " } else { "" };
            let _ = writeln!(
                part,
                "| {label} | {words} | {cells} | {:.2} | {most}{} |",
                median(&of_arm, |result| result.query_ms),
                megaflops(&of_arm)
            );
        }
        for (_, chart) in by_steps(study, results).iter().filter(|((of, its), _)| of == task && its == data) {
            let _ = writeln!(text, "{}", shown(study, chart));
        }
        folded(text, &(head + &mark), &part);
    }
}

/// What was changed in the images, in which test, and its results.
type Changed<'a> = Vec<(&'a str, &'a str, &'a Trainings)>;

/// Success with changed images: on the plain test, then on each of the others of the same task and demonstrations.
fn images_changed(text: &mut String, study: &Study, results: &Results) {
    let mut tables: BTreeMap<&str, BTreeMap<&str, Changed<'_>>> = BTreeMap::new();
    for ((test, data, arm), trainings) in results {
        if let Some(perturb) = &study.tests[test].perturb {
            tables.entry(data).or_default().entry(arm).or_default().push((perturb, test, trainings));
        }
    }
    if tables.is_empty() {
        return;
    }
    let _ = writeln!(
        text,
        "## Changed images\n\nThe weights of the policies above, tested with perturbed images (`actrm-zoo eval --perturb`): cameras \
         swapped, one camera black, hues rotated, less light. The episodes are the first of those above.\n"
    );
    for (data, arms) in tables {
        let changes: BTreeSet<&str> = arms.values().flatten().map(|(perturb, ..)| *perturb).collect();
        let heads: Vec<&str> = changes.iter().copied().collect();
        let task = &study.data[data].task;
        let _ =
            writeln!(text, "| {task} | unchanged | {} |\n|---|---|{}", heads.join(" | "), "---|".repeat(heads.len()));
        for (arm, changed) in arms {
            let plain = results.iter().find(|((test, of, its), _)| {
                study.tests[test].is_plain() && study.tests[test].task == *task && of == data && its == arm
            });
            let plain = plain.map_or("-".to_owned(), |(_, trainings)| cell_text(trainings, &[]));
            let cells: Vec<String> = changes.iter().map(|change| changed_text(&changed, change)).collect();
            let _ = writeln!(text, "| {} | {plain} | {} |", study.arms[arm].label, cells.join(" | "));
        }
        text.push('\n');
    }
}

/// The results under one change of images; several tests of it go by their names.
fn changed_text(changed: &Changed<'_>, change: &str) -> String {
    let of_change: Vec<_> = changed.iter().filter(|(perturb, ..)| *perturb == change).collect();
    match of_change.as_slice() {
        [] => "-".to_owned(),
        [(_, _, trainings)] => cell_text(trainings, &[]),
        several => {
            let cells: Vec<String> =
                several.iter().map(|(_, test, trainings)| format!("{test}: {}", cell_text(trainings, &[]))).collect();
            cells.join("<br>")
        }
    }
}

/// Cells whose tests are of two trainings, of which nobody can tell whether they are the same.
fn trained_twice(text: &mut String, results: &Results) {
    let mut by_training: BTreeMap<(&String, &String, u64), Vec<&CellResult>> = BTreeMap::new();
    for ((_, data, arm), trainings) in results {
        for (seed, result) in trainings {
            by_training.entry((data, arm, *seed)).or_default().push(result);
        }
    }
    by_training.retain(|_, tests| tests.iter().any(|test| test.may_differ_from(tests[0])));
    if by_training.is_empty() {
        return;
    }
    let mut part = "The tests of these cells come from more than one training with the same settings and seed. Whether the weights are \
                    identical was not recorded.\n\n"
        .to_owned();
    for ((data, arm, seed), tests) in by_training {
        let mut entries: BTreeMap<&String, Vec<&str>> = BTreeMap::new();
        tests.iter().for_each(|test| entries.entry(&test.entry.hash).or_default().push(&test.test));
        let groups: Vec<String> = entries.values().map(|tests| tests.join(", ")).collect();
        let _ = writeln!(part, "- {arm} on {data}, seed {seed}: {}", groups.join("; "));
    }
    folded(text, "Trained twice", &part);
}

/// The middle value, the upper one of two.
fn median(results: &[&CellResult], value: fn(&CellResult) -> f64) -> f64 {
    let mut values: Vec<f64> = results.iter().map(|result| value(result)).collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or_default()
}

fn megaflops(results: &[&CellResult]) -> String {
    let counted = results.iter().find_map(|result| result.query_flops);
    counted.map_or("-".to_owned(), |flops| format!("{:.1}", flops / 1e6))
}

/// `97% [95-99]` and, below, every training's count.
fn cell_text(trainings: &Trainings, groups: &[String]) -> String {
    let outcomes = outcomes(trainings, groups);
    let Some(estimate) = over_trainings(&outcomes) else { return "-".to_owned() };
    let each: Vec<String> = outcomes.iter().map(|o| format!("{:.0}", o.iter().sum::<f64>())).collect();
    let n = outcomes.first().map_or(0, Vec::len);
    format!("{}<br>{} of {n}", percent(&estimate), each.join(", "))
}

fn percent(estimate: &Estimate) -> String {
    let Estimate { value, low, high } = estimate;
    format!("{}% [{:.0}-{:.0}]", share_percent(*value, 1), 100.0 * low, 100.0 * high)
}

/// A comparison, the number of trainings on each side, the success of each, and the difference with its adjusted p.
struct Compared<'a> {
    comparison: &'a Comparison,
    trainings: (usize, usize),
    success: [f64; 2],
    difference: Option<(Estimate, f64)>,
}

/// The comparisons of a stage whose sides both have results; p after Holm's correction over all of them.
fn compare<'a>(study: &'a Study, results: &Results, stage: u8) -> Vec<Compared<'a>> {
    let mut found: Vec<Compared<'_>> = Vec::new();
    for comparison in study.comparisons.iter().filter(|c| c.stage == stage) {
        let c = comparison;
        let [first, second] = c.sides().map(|(arm, data)| {
            results.get(&(c.test.clone(), data.clone(), arm.clone())).map(|trainings| outcomes(trainings, &c.groups))
        });
        let Some((a, b)) = first.zip(second) else { continue };
        let mean = |side: &[Vec<f64>]| {
            let all = side.concat();
            all.iter().sum::<f64>() / all.len().max(1) as f64
        };
        let counted = difference(&a, &b).map(|d| (d.estimate, d.p_value));
        let trainings = (a.len(), b.len());
        found.push(Compared { comparison, trainings, success: [mean(&a), mean(&b)], difference: counted });
    }
    let p_values: Vec<f64> = found.iter().filter_map(|c| c.difference.as_ref().map(|(_, p)| *p)).collect();
    let mut adjusted = holm(&p_values).into_iter();
    for (_, p) in found.iter_mut().filter_map(|c| c.difference.as_mut()) {
        *p = adjusted.next().unwrap_or(1.0);
    }
    found
}

impl Compared<'_> {
    /// The names of both sides.
    fn sides(&self, study: &Study) -> [String; 2] {
        self.comparison.sides().map(|(arm, data)| match &self.comparison.second_data {
            Some(_) => format!("{} ({data})", study.arms[arm].label),
            None => study.arms[arm].label.clone(),
        })
    }

    fn answer(&self, study: &Study) -> String {
        let [first, second] = self.sides(study);
        match &self.difference {
            // one training says nothing of how trainings differ
            None => "too few trainings".to_owned(),
            Some((_, p)) if *p >= 0.05 => "not significant".to_owned(),
            Some((estimate, _)) if estimate.value > 0.0 => format!("{first} is better"),
            Some(_) => format!("{second} is better"),
        }
    }

    fn points(&self) -> String {
        let Some((Estimate { value, low, high }, _)) = &self.difference else { return "-".to_owned() };
        format!("{:+.1} points [{:+.0}, {:+.0}]", 100.0 * value, 100.0 * low, 100.0 * high)
    }
}

/// What the comparisons answer, a line each.
fn verdict(text: &mut String, study: &Study, compared: &[Vec<Compared<'_>>]) {
    let counted: Vec<&Compared<'_>> = compared.iter().flatten().filter(|c| c.difference.is_some()).collect();
    for c in &counted {
        let ([first, second], [a, b]) = (c.sides(study), c.success.map(|share| 100.0 * share));
        let (question, answer, points) = (&c.comparison.question, c.answer(study), c.points());
        // the interval alone may leave out zero: only p is corrected for the number of questions
        let p = c.difference.as_ref().map_or(1.0, |(_, p)| *p);
        let p = if p < 0.001 { "p < 0.001".to_owned() } else { format!("corrected p {p:.3}") };
        let _ =
            writeln!(text, "- {question} **{answer}**: {a:.1}% ({first}) against {b:.1}% ({second}), {points}, {p}.");
    }
    if !counted.is_empty() {
        text.push('\n');
    }
}

fn comparisons(text: &mut String, study: &Study, compared: &[Compared<'_>], title: &str) {
    if compared.is_empty() {
        return;
    }
    let mut part = "Difference of success, first minus second, with its 95% interval. Trainings are resampled on both sides, episodes for both \
                    together; Student's t for the number of trainings. p is Holm-corrected over the rows of this table.\n\n\
                    | question | first | second | episodes | trainings | difference | p | answer |\n|---|---|---|---|---|---|---|---|\n"
        .to_owned();
    for c in compared {
        let ([first, second], (m, n)) = (c.sides(study), c.trainings);
        let episodes = match c.comparison.groups.is_empty() {
            true => "all".to_owned(),
            false => c.comparison.groups.join(", "),
        };
        let p = c.difference.as_ref().map_or("-".to_owned(), |(_, p)| p_text(*p));
        let (question, points, answer) = (&c.comparison.question, c.points(), c.answer(study));
        let _ =
            writeln!(part, "| {question} | {first} | {second} | {episodes} | {m}, {n} | {points} | {p} | {answer} |");
    }
    folded(text, title, &part);
}

fn p_text(p: f64) -> String {
    if p < 0.001 { "< 0.001".to_owned() } else { format!("{p:.3}") }
}

fn costs(text: &mut String, study: &Study, results: &Results) {
    let mut part = "Medians over all results of an arm on plain tests, on a machine that also did other work. MFLOP: millions of \
                    floating-point operations in the matrix products of a query with the largest number of refinement steps.\n\n\
                    | arm | experiment | settings | parameters | steps | minutes | query, ms | MFLOP |\n|---|---|---|---|---|---|---|---|\n"
        .to_owned();
    for (name, arm) in &study.arms {
        let mut data: Vec<&str> = Vec::new();
        for row in study.cells.iter().filter(|row| row.arms.contains(name)) {
            // an experiment of its own for each, or the same on all
            if study.experiment_on(name, &row.data) != arm.experiment && !data.contains(&row.data.as_str()) {
                data.push(&row.data);
            }
        }
        match data.is_empty() {
            true => cost(&mut part, study, results, (name, None)),
            false => data.into_iter().for_each(|data| cost(&mut part, study, results, (name, Some(data)))),
        }
    }
    if !results.is_empty() {
        folded(text, "Settings and costs", &part);
    }
}

/// The row of an arm, on some demonstrations or on all.
fn cost(text: &mut String, study: &Study, results: &Results, (name, data): (&String, Option<&str>)) {
    let arm = &study.arms[name];
    let experiment = data.map_or_else(|| arm.experiment.clone(), |data| study.experiment_on(name, data));
    let settings: Vec<String> = arm.set.iter().map(|s| format!("`{s}`")).collect();
    let settings = settings.join(", ");
    let as_trained = |test: &str| study.tests[test].is_plain();
    let of_arm: Vec<&CellResult> = results
        .iter()
        .filter(|((test, d, a), _)| a == name && data.is_none_or(|data| data == d) && as_trained(test))
        .flat_map(|(_, trainings)| trainings.values())
        .collect();
    let Some(first) = of_arm.first() else { return };
    let _ = writeln!(
        text,
        "| {} | `{experiment}` | {settings} | {} | {} | {:.1} | {:.2} | {} |",
        arm.label,
        first.training.parameters,
        first.training.steps,
        median(&of_arm, |r| r.training.minutes),
        median(&of_arm, |r| r.query_ms),
        megaflops(&of_arm)
    );
}
