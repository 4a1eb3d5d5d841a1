//! The first table of a study's page, and what its demonstrations are called.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;

use report::statistics::over_trainings;

use super::super::file::{Data, Study};
use super::{Results, outcomes, percent};

/// What follows the heading of each of these demonstrations: nothing, or where others have the same heading whether they have
/// images and the seed of their collection. Their name, where these are the same as well.
pub(super) fn apart(study: &Study, headed: &[(&str, String)]) -> Vec<String> {
    let of = |(data, head): &(&str, String)| {
        let facts = |data: &str| (study.data[data].cameras.is_some(), study.data[data].seed);
        let (images, seed) = facts(data);
        let others = headed.iter().filter(|(other, its)| other != data && its == head);
        let others: Vec<(bool, u64)> = others.map(|(other, _)| facts(other)).collect();
        if others.contains(&(images, seed)) {
            return format!(", {data}");
        }
        let mut mark = String::new();
        if images && others.iter().any(|(images, _)| !images) {
            mark.push_str(", images");
        }
        if seed != 1 && others.iter().any(|(_, other)| *other != seed) {
            let _ = write!(mark, ", collection seed {seed}");
        }
        mark
    };
    headed.iter().map(of).collect()
}

/// Arms against demonstrations, where an arm was meant for several: success on the first test of each.
pub(super) fn overview(text: &mut String, study: &Study, results: &Results) {
    let mut columns: Vec<(&str, &str)> = Vec::new();
    let mut rows: Vec<&str> = Vec::new();
    let mut planned: BTreeMap<(&str, &str), BTreeSet<u64>> = BTreeMap::new();
    for row in &study.cells {
        let Some(test) = row.tests.iter().find(|test| study.tests[*test].is_plain()) else { continue };
        if !columns.iter().any(|(data, _)| *data == row.data) {
            columns.push((&row.data, test));
        }
        for arm in &row.arms {
            if !rows.contains(&arm.as_str()) {
                rows.push(arm);
            }
            planned.entry((arm, &row.data)).or_default().extend(row.first_seed..=row.seeds);
        }
    }
    columns.retain(|(data, test)| results.keys().any(|(of, its, _)| of == test && its == data));
    let several = rows.iter().any(|arm| planned.keys().filter(|(planned, _)| planned == arm).count() > 1);
    if !several {
        return;
    }
    let head = |data: &str| {
        let Data { task, episodes, expert, skill, .. } = &study.data[data];
        let alone = columns.iter().filter(|(other, _)| study.data[*other].task == *task).count() == 1;
        let expert = expert.as_ref().map(|expert| format!(", {expert}")).unwrap_or_default();
        let skill = if skill.is_good() { String::new() } else { format!(", {skill}") };
        let many = if alone { String::new() } else { format!(", {episodes}") };
        format!("{task}{many}{expert}{skill}")
    };
    let headed: Vec<(&str, String)> = columns.iter().map(|(data, _)| (*data, head(data))).collect();
    let marks = apart(study, &headed);
    let heads: Vec<String> = headed.into_iter().zip(marks).map(|((_, head), mark)| head + &mark).collect();
    let _ = writeln!(
        text,
        "## Success\n\nSuccess with its 95% interval over trainings and episodes, and the number of trainings.\n\n| | {} |\n|---|{}",
        heads.join(" | "),
        "---|".repeat(heads.len())
    );
    let ran = |arm: &&str| results.keys().any(|(_, _, of)| of == arm);
    let mut lines: Vec<(&str, Vec<Option<String>>)> = Vec::new();
    for arm in rows.into_iter().filter(ran) {
        let cell = |(data, test): &(&str, &str)| {
            let seeds = planned.get(&(arm, *data))?.len();
            let trainings = results.get(&((*test).to_owned(), (*data).to_owned(), arm.to_owned()))?;
            let estimate = over_trainings(&outcomes(trainings, &[]));
            let estimate = estimate.as_ref().map_or_else(|| "-".to_owned(), percent);
            Some(match trainings.len() {
                there if there == seeds => format!("{estimate}, {seeds}"),
                there => format!("{estimate}, {there} of {seeds}"),
            })
        };
        let (label, cells): (&str, Vec<_>) = (&study.arms[arm].label, columns.iter().map(cell).collect());
        // arms of one label are one row where no column has two of them
        let fits = |its: &[Option<String>]| its.iter().zip(&cells).all(|(a, b)| a.is_none() || b.is_none());
        match lines.iter_mut().find(|(name, its)| *name == label && fits(its)) {
            Some((_, its)) => its.iter_mut().zip(cells).for_each(|(cell, other)| *cell = cell.take().or(other)),
            None => lines.push((label, cells)),
        }
    }
    for (label, cells) in lines {
        let cells: Vec<String> = cells.into_iter().map(|cell| cell.unwrap_or_else(|| "-".to_owned())).collect();
        let _ = writeln!(text, "| {label} | {} |", cells.join(" | "));
    }
    text.push('\n');
}
