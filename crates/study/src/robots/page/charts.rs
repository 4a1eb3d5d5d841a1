//! Charts of a study's page, drawn from its committed results: success of every arm, by group of episodes, and by the number of
//! refinement steps.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use models::actrm::Thinking;
use report::statistics::{Estimate, over_trainings};
use zoo::ZooError;

use super::super::file::Study;
use super::{Results, Trainings, apart, outcomes, read_results};
use crate::charts::{COLORS, escaped, intervals};

/// Groups of episodes that make a line worth drawing.
const FEWEST_GROUPS: usize = 4;

/// A chart: where it lies in the results' folder, what it shows, and the drawing.
pub(super) struct Chart {
    pub name: String,
    pub shows: String,
    pub svg: String,
}

/// The charts of `study`: where each is written, and the drawing.
///
/// # Errors
/// A result that cannot be read.
pub fn robot_charts(study: &Study) -> Result<Vec<(PathBuf, String)>, ZooError> {
    let results = read_results(study)?;
    let by_arm = by_arm(study, &results).into_iter().map(|(_, chart)| chart);
    let all = all_arms(study, &results)
        .into_iter()
        .chain(by_arm)
        .chain(by_steps(study, &results).into_iter().map(|(_, chart)| chart))
        .chain(by_cost(study, &results));
    Ok(all.map(|chart| (study.results.join(chart.name), chart.svg)).collect())
}

/// The line of Markdown that shows `chart` on the study's page.
pub(super) fn shown(study: &Study, chart: &Chart) -> String {
    let beside = study.page.parent().unwrap_or(Path::new(""));
    let folder = study.results.strip_prefix(beside).unwrap_or(&study.results);
    format!("![{}]({})\n", chart.shows, folder.join(&chart.name).display())
}

/// Success of every arm on every plain test, with its 95% interval: a row each.
pub(super) fn all_arms(study: &Study, results: &Results) -> Option<Chart> {
    let mut rows: Vec<(String, Vec<(String, Estimate)>)> = Vec::new();
    let plain: Vec<_> = results.iter().filter(|((test, _, _), _)| study.tests[test].is_plain()).collect();
    let head = |test: &str, data: &str| {
        let of = &study.data[data];
        let expert = of.expert.as_ref().map(|expert| format!(", {expert}")).unwrap_or_default();
        let skill = if of.skill.is_good() { String::new() } else { format!(", {}", of.skill) };
        format!("{} ({} demonstrations{expert}{skill}", study.tests[test].task, of.episodes)
    };
    let headed: Vec<(&str, String)> =
        plain.iter().map(|((test, data, _), _)| (data.as_str(), head(test, data))).collect();
    let marks = apart(study, &headed);
    for (((_, _, arm), trainings), ((_, head), mark)) in plain.into_iter().zip(headed.into_iter().zip(marks)) {
        let Some(estimate) = over_trainings(&outcomes(trainings, &[])) else { continue };
        let head = format!("{head}{mark})");
        match rows.last_mut().filter(|(last, _)| *last == head) {
            Some((_, arms)) => arms.push((study.arms[arm].label.clone(), estimate)),
            None => rows.push((head, vec![(study.arms[arm].label.clone(), estimate)])),
        }
    }
    let shows = format!("{}: success with 95% intervals", study.title);
    (!rows.is_empty()).then(|| Chart { name: "success.svg".to_owned(), svg: intervals(&shows, &rows), shows })
}

/// Success by group, a line an arm, of every plain test and its demonstrations; arms with most trainings where there are
/// more than colours.
pub(super) fn by_arm(study: &Study, results: &Results) -> Vec<((String, String), Chart)> {
    let mut tests: BTreeMap<(&str, &str), Vec<(&str, &Trainings)>> = BTreeMap::new();
    for ((test, data, arm), trainings) in results.iter().filter(|((test, _, _), _)| study.tests[test].is_plain()) {
        tests.entry((test, data)).or_default().push((arm, trainings));
    }
    let mut charts = Vec::new();
    for ((test, data), mut arms) in tests {
        let groups = groups(arms.iter().map(|(_, trainings)| *trainings));
        if groups.len() < FEWEST_GROUPS || arms.len() < 2 {
            continue;
        }
        arms.sort_by_key(|(_, trainings)| std::cmp::Reverse(trainings.len()));
        arms.truncate(COLORS.len());
        let lines: Vec<(String, Vec<Option<f64>>)> = arms
            .iter()
            .map(|(arm, trainings)| {
                let values = groups.iter().map(|group| mean(trainings, std::slice::from_ref(group))).collect();
                (format!("{} ({})", study.arms[*arm].label, trainings.len()), values)
            })
            .collect();
        let shows = format!("{} after {}: success by group (number of trainings)", study.tests[test].task, data);
        let name = format!("{test}_{data}_by-arm.svg");
        charts.push(((test.to_owned(), data.to_owned()), Chart { name, svg: drawn(&shows, &groups, &lines), shows }));
    }
    charts
}

/// Success by the number of refinement steps of the same weights, a line a group, of every arm tested with several numbers.
pub(super) fn by_steps(study: &Study, results: &Results) -> Vec<((String, String), Chart)> {
    let mut arms: BTreeMap<(&str, &str, &str), BTreeMap<usize, &Trainings>> = BTreeMap::new();
    for ((test, data, arm), trainings) in results {
        let test = &study.tests[test];
        let steps = test.thinking.steps;
        let alone = test.perturb.is_none() && test.thinking == Thinking { steps, ..Thinking::default() };
        if let Some(steps) = steps.filter(|_| alone) {
            arms.entry((&test.task, data, arm)).or_default().insert(steps, trainings);
        }
    }
    let mut charts = Vec::new();
    for ((task, data, arm), by_steps) in arms {
        let groups = groups(by_steps.values().copied());
        if by_steps.len() < 3 || groups.len() < FEWEST_GROUPS {
            continue;
        }
        let heads: Vec<String> = by_steps.keys().map(usize::to_string).collect();
        let lines: Vec<(String, Vec<Option<f64>>)> = groups
            .iter()
            .take(COLORS.len())
            .map(|group| {
                let group = std::slice::from_ref(group);
                (group[0].clone(), by_steps.values().map(|trainings| mean(trainings, group)).collect())
            })
            .collect();
        let shows = format!("{task}, {}: success by number of refinement steps in the test", study.arms[arm].label);
        let name = format!("{arm}_{data}_by-steps.svg");
        charts.push(((task.to_owned(), data.to_owned()), Chart { name, svg: drawn(&shows, &heads, &lines), shows }));
    }
    charts
}

/// An arm's label, MFLOP of its query, and its success.
type Costed<'a> = (&'a str, f64, f64);

/// Success against operations of a query, a numbered point an arm, of every plain test with several counted arms.
pub(super) fn by_cost(study: &Study, results: &Results) -> Vec<Chart> {
    let mut tests: BTreeMap<(&str, &str), Vec<Costed<'_>>> = BTreeMap::new();
    for ((test, data, arm), trainings) in results.iter().filter(|((test, _, _), _)| study.tests[test].is_plain()) {
        let flops = trainings.values().find_map(|result| result.query_flops).filter(|flops| *flops > 0.0);
        if let Some((flops, success)) = flops.zip(mean(trainings, &[])) {
            tests.entry((test, data)).or_default().push((&study.arms[arm].label, flops / 1e6, success));
        }
    }
    tests.retain(|_, arms| arms.len() >= FEWEST_GROUPS);
    let drawn = tests.into_iter().map(|((test, data), mut arms)| {
        arms.sort_by(|a, b| a.1.total_cmp(&b.1));
        let shows = format!("{} after {data}: success by MFLOP per query", study.tests[test].task);
        Chart { name: format!("{test}_{data}_by-cost.svg"), svg: points(&shows, &arms), shows }
    });
    drawn.collect()
}

fn groups<'a>(trainings: impl Iterator<Item = &'a Trainings>) -> Vec<String> {
    let episodes = trainings.flat_map(BTreeMap::values).flat_map(|result| &result.episodes);
    let found: BTreeSet<String> = episodes.filter_map(|episode| episode.group.clone()).collect();
    found.into_iter().collect()
}

/// Mean success over trainings and episodes of `groups`; none where there is no episode.
fn mean(trainings: &Trainings, groups: &[String]) -> Option<f64> {
    let all: Vec<f64> = outcomes(trainings, groups).concat();
    (!all.is_empty()).then(|| all.iter().sum::<f64>() / all.len() as f64)
}

/// Where a drawing begins, and its size.
const FRAME: (f64, f64, f64, f64) = (52.0, 34.0, 560.0, 240.0);

/// A drawing's title and its lines for shares of one, from bottom to top.
fn framed(title: &str) -> String {
    let (left, top, width, height) = FRAME;
    let y = |share: f64| top + height * (1.0 - share);
    let title = escaped(title);
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 900 330\" width=\"900\" height=\"330\" role=\"img\" \
         aria-label=\"{title}\" font-family=\"sans-serif\" font-size=\"13\">\n\
         <rect width=\"900\" height=\"330\" fill=\"#ffffff\"/>\n<text x=\"{left}\" y=\"20\" font-weight=\"bold\">{title}</text>\n"
    );
    for share in [0.0, 0.25, 0.5, 0.75, 1.0] {
        let (at, right) = (y(share), left + width);
        let _ = writeln!(
            svg,
            "<line x1=\"{left}\" x2=\"{right}\" y1=\"{at:.1}\" y2=\"{at:.1}\" stroke=\"#d8d8d8\"/><text x=\"{}\" \
             y=\"{:.1}\" text-anchor=\"end\">{:.0}%</text>",
            left - 6.0,
            at + 4.0,
            100.0 * share
        );
    }
    svg
}

/// Numbered points, shares of one over a logarithmic axis, with a legend at the right.
fn points(title: &str, arms: &[Costed<'_>]) -> String {
    let (left, top, width, height) = FRAME;
    let (first, last) = (arms.first().map_or(1.0, |arm| arm.1), arms.last().map_or(1.0, |arm| arm.1));
    let (low, high) = (first.log2().floor(), (last.log2() + 0.1).ceil());
    let x = |value: f64| left + width * (value.log2() - low) / (high - low);
    let mut svg = framed(title);
    for value in (low as i32..=high as i32).map(|power| 2.0_f64.powi(power)) {
        let (at, below) = (x(value), top + height + 20.0);
        let _ = writeln!(svg, "<text x=\"{at:.1}\" y=\"{below:.1}\" text-anchor=\"middle\">{value}</text>");
    }
    for (i, (label, value, share)) in arms.iter().enumerate() {
        let (at, up, color, number) = (x(*value), top + height * (1.0 - share), COLORS[i % COLORS.len()], i + 1);
        let (beside, line, label) = (at + 6.0, top + 12.0 + 17.0 * i as f64, escaped(label));
        let _ = writeln!(
            svg,
            "<circle cx=\"{at:.1}\" cy=\"{up:.1}\" r=\"3.5\" fill=\"{color}\"/><text x=\"{beside:.1}\" y=\"{up:.1}\" \
             font-size=\"11\">{number}</text><text x=\"622\" y=\"{line}\" font-size=\"11\">{number}: {label}, {:.0}%</text>",
            100.0 * share
        );
    }
    svg.push_str("</svg>\n");
    svg
}

/// Lines over `heads`, shares of one from bottom to top, with a legend at the right.
fn drawn(title: &str, heads: &[String], lines: &[(String, Vec<Option<f64>>)]) -> String {
    let (left, top, width, height) = FRAME;
    let x = |i: usize| left + width * (i as f64 + 0.5) / heads.len() as f64;
    let y = |share: f64| top + height * (1.0 - share);
    let mut svg = framed(title);
    for (i, head) in heads.iter().enumerate() {
        let (at, below, head) = (x(i), top + height + 20.0, escaped(head));
        let _ = writeln!(svg, "<text x=\"{at:.1}\" y=\"{below:.1}\" text-anchor=\"middle\">{head}</text>");
    }
    for (i, ((label, values), color)) in lines.iter().zip(COLORS).enumerate() {
        let points: Vec<(f64, f64)> =
            values.iter().enumerate().filter_map(|(i, value)| value.map(|share| (x(i), y(share)))).collect();
        let path: Vec<String> = points.iter().map(|(x, y)| format!("{x:.1},{y:.1}")).collect();
        let _ = writeln!(
            svg,
            "<polyline points=\"{}\" fill=\"none\" stroke=\"{color}\" stroke-width=\"2\"/>",
            path.join(" ")
        );
        for (x, y) in points {
            let _ = writeln!(svg, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"3.5\" fill=\"{color}\"/>");
        }
        let (at, label) = (top + 12.0 + 22.0 * i as f64, escaped(label));
        let _ = writeln!(
            svg,
            "<rect x=\"628\" y=\"{:.1}\" width=\"14\" height=\"4\" fill=\"{color}\"/><text x=\"648\" y=\"{:.1}\" \
             font-size=\"11\">{label}</text>",
            at - 5.0,
            at
        );
    }
    svg.push_str("</svg>\n");
    svg
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_chart_has_a_line_an_arm_and_a_point_a_value() {
        let heads = ["0 hops".to_owned(), "1 hops".to_owned(), "2 hops".to_owned()];
        let lines = vec![
            ("six & more".to_owned(), vec![Some(1.0), Some(0.5), Some(0.0)]),
            ("one".to_owned(), vec![Some(0.25), None, Some(1.0)]),
        ];
        let svg = drawn("a < b", &heads, &lines);
        assert!(svg.contains("aria-label=\"a &lt; b\"") && svg.contains(">six &amp; more</text>"), "{svg}");
        // 34 is all of them, 274 none, three columns of 560 / 3
        assert!(svg.contains("points=\"145.3,34.0 332.0,154.0 518.7,274.0\""), "{svg}");
        assert!(svg.contains("points=\"145.3,214.0 518.7,34.0\""), "{svg}");
        assert_eq!(svg.matches("<circle").count(), 5);
        // from 2 to 8 on a logarithmic axis of 560
        let svg = points("cost", &[("one", 2.0, 0.25), ("six", 4.0, 1.0), ("ten", 5.0, 0.5)]);
        assert!(svg.contains("<circle cx=\"52.0\" cy=\"214.0\"") && svg.contains("cx=\"332.0\" cy=\"34.0\""), "{svg}");
        assert!(svg.contains(">8</text>") && svg.contains(">2: six, 100%</text>"), "{svg}");
    }
}
