//! The report: one HTML file with everything in it, for a reader who has nothing but a browser.
//!
//! First one table over all tasks, a policy a row; then every row with its details. A pure function of results and
//! training curves: no clock, no network, the same bytes for the same input. Without scripts everything is there; the
//! script sorts, filters and copies.

mod commands;
mod demonstrations;
mod depth;
mod films;
mod others;
mod pairs;
mod plot;
mod solving;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;

pub use self::commands::{Places, shell_quoted};
pub use self::depth::{DEPTH_COLUMNS, Depth};
pub use self::films::{Film, MOST_FILM_BYTES};
pub use self::others::OTHERS_COLUMNS;
pub(crate) use self::plot::{COLOURS, Palette};
use crate::across::{ACROSS_COLUMNS, across_tasks, speaking};
use crate::charts;
use crate::html::{self, escape};
use crate::leaderboard::{COLUMNS, Group, LeaderboardRow, group, interval_text};
use crate::others::Run;
use zoo::results::EntryIdentity;

/// An entry's training loss over optimiser steps.
#[derive(Debug, Clone, PartialEq)]
pub struct Curve {
    /// The entry, `name@version`.
    pub entry: String,
    /// Step and loss, ascending by step.
    pub points: Vec<(u64, f64)>,
}

/// What is known of an entry besides its results.
#[derive(Debug, Clone, PartialEq)]
pub struct EntryFacts {
    /// The task that it was trained for.
    pub task: String,
    /// Control steps a second of its environment.
    pub hertz: f64,
    /// How its numbers are meant: names and values.
    pub conventions: Vec<(String, String)>,
}

/// What a page shows beside its rows. Nothing of it has to be there.
#[derive(Debug, Clone, Default)]
pub struct Beside {
    /// Training curves.
    pub curves: Vec<Curve>,
    /// HTML of other evaluations.
    pub section: String,
    /// Facts of entries, by `name@version`.
    pub entries: BTreeMap<String, EntryFacts>,
    /// Evaluations at other depths of reasoning.
    pub depths: Vec<Depth>,
    /// Results that other programs measured.
    pub others: Vec<Run>,
    /// Films of episodes.
    pub films: Vec<Film>,
    /// Folders that its commands name.
    pub places: Places,
}

impl Beside {
    fn entry(&self, row: &LeaderboardRow) -> Option<&EntryFacts> {
        self.entries.get(&row.record().entry.to_string())
    }

    /// The task of a row's entry, if it is known.
    fn task(&self, row: &LeaderboardRow) -> Option<&str> {
        self.entry(row).map(|entry| entry.task.as_str())
    }
}

/// Rows whose episodes, curves and origin are drawn; a page with ten thousand of them would be of no use.
const MOST_DETAILED: usize = 200;

/// Rows of a task that stand in its charts.
const MOST_DRAWN: usize = 60;

/// Rows in the charts of all tasks together: where there are many tasks, each has fewer, and the last may have none.
const MOST_DRAWN_IN_ALL: usize = 1500;

/// Rows that the table shows at once. Those after them are data in the script, and become elements when they are shown.
const ROWS_AT_ONCE: usize = 500;

/// Cells of all tables of pairs together.
const MOST_PAIR_CELLS: usize = 3000;

/// The report over ranked rows as HTML, with what is known beside them.
pub fn to_html(rows: &[LeaderboardRow], beside: &Beside) -> String {
    let section = beside.section.as_str();
    let mut groups: BTreeMap<Group, Vec<&LeaderboardRow>> = BTreeMap::new();
    for row in rows {
        groups.entry(group(row)).or_default().push(row);
    }
    let mut html = String::new();
    html.push_str("<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n");
    html.push_str("<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n");
    html.push_str("<link rel=\"icon\" href=\"data:,\">\n");
    let _ = writeln!(html, "<title>actrm leaderboard</title>\n<style>\n{}</style>\n</head>", include_str!("style.css"));
    let _ = writeln!(html, "<body>\n{}\n<main>\n<h1>Leaderboard</h1>", charts::patterns());
    let episodes: u64 = rows.iter().map(|row| row.counts.episodes).sum();
    let evaluations: usize = rows.iter().map(LeaderboardRow::n_trainings).sum();
    let trained = rows.iter().filter(|row| row.is_trained()).flat_map(LeaderboardRow::evaluations);
    let trained: BTreeSet<&EntryIdentity> = trained.map(|one| &one.record.entry).collect();
    let (thinking, others) = (depth::section(&beside.depths), others::section(&beside.others));
    if rows.is_empty() {
        html.push_str(if section.is_empty() && thinking.is_empty() && others.is_empty() {
            "<p>No finished evaluation yet.</p>\n"
        } else {
            ""
        });
    } else {
        let _ = writeln!(
            html,
            "<p class=\"lead\">{} rows: {evaluations} evaluations, {} trained policies, {episodes} episodes. Rows of a task and \
             protocol that share a letter are not significantly different.</p>",
            rows.len(),
            trained.len(),
        );
        contents(
            &groups,
            [
                ("depth", "Reasoning depth", &thinking),
                ("others", "Results of others", &others),
                ("puzzles", "Puzzles", section),
            ],
            &mut html,
        );
        html.push_str(&overview(rows));
        html.push_str(&all_rows(rows));
    }
    let mut room = Room::for_groups(groups.len());
    if groups.len() > 1 {
        html.push_str("<h2 id=\"tasks\">Tasks</h2>\n");
    }
    let palette = Palette::of(rows);
    for rows in groups.values() {
        task(rows, beside, groups.len() == 1, &palette, &mut room, &mut html);
    }
    html.push_str(&thinking);
    html.push_str(&others);
    html.push_str(section);
    let _ = writeln!(
        html,
        "<footer>All intervals are 95% intervals: Wilson's for one training, Student's t over trainings and episodes for several. \
         Rows are ranked by the lower end of their interval. Letters and ranges of ranks come from exact McNemar tests on \
         equal seeds (Barnard's on different seeds, a bootstrap between families) with Holm's correction over the whole \
         table. Made by <code>actrm-zoo leaderboard</code> {} from the results in the zoo. The page loads nothing from \
         elsewhere.</footer>\n</main>\n{}<script>\n{}</script>\n</body>\n</html>",
        env!("CARGO_PKG_VERSION"),
        rows_after(rows),
        include_str!("page.js")
    );
    html
}

/// The first screen: a policy a row, a task a column, in each cell the rate, its interval and the group.
fn overview(rows: &[LeaderboardRow]) -> String {
    let table = speaking(rows);
    let tasks: BTreeMap<&str, String> =
        table.values().flatten().map(|(task, row)| (task.as_str(), row.protocol_words())).collect();
    let mut html = String::from(
        "<h2 id=\"policies\">Policies by task</h2>\n<p class=\"lead\">Success, 95% interval and letter of each \
         policy's row of most trainings in each task. The best of several such rows is slightly optimistic.</p>\n<div class=\"card \
         scroll\" role=\"region\" aria-label=\"Policies by task\" tabindex=\"0\"><table id=\"overview\"><thead><tr><th \
         scope=\"col\" class=\"words\">policy</th>",
    );
    for (task, protocol) in &tasks {
        let _ = write!(html, "<th scope=\"col\">{}<br><small>{}</small></th>", escape(task), escape(protocol));
    }
    html.push_str("</tr></thead><tbody>\n");
    for (policy, of) in &table {
        let _ = write!(html, "<tr><th scope=\"row\">{}</th>", escape(policy));
        for task in tasks.keys() {
            let Some(row) = of.get(*task) else {
                html.push_str("<td>–</td>");
                continue;
            };
            let place = row.standing.as_ref().map_or(row.unranked_text(), |standing| standing.letters.as_str());
            let _ = write!(
                html,
                "<td><a href=\"#{}\">{}</a> <span class=\"group\">{}</span><br><small>{}%{}</small></td>",
                anchor(row),
                row.counts.percent(1),
                escape(place),
                interval_text(row.interval, 0, '–'),
                if row.n_trainings() > 1 { format!(", {} trainings", row.n_trainings()) } else { String::new() }
            );
        }
        html.push_str("</tr>\n");
    }
    html.push_str("</tbody></table></div>\n");
    let across = across_tasks(rows);
    if !across.is_empty() {
        let _ = writeln!(
            html,
            "<h2 id=\"across\">Across tasks</h2>\n<p class=\"lead\">The interquartile mean of the success rates, with a \
             bootstrap that draws trainings within each task. Compare only policies of the same tasks.</p>\n<div class=\"card scroll\" role=\"region\" aria-label=\"Across \
             tasks\" tabindex=\"0\">{}</div>",
            html::table(ACROSS_COLUMNS, &across)
        );
    }
    html
}

/// The rows after those that the table is written with, as data: their cells as text, and what links and filters ask for.
fn rows_after(rows: &[LeaderboardRow]) -> String {
    let Some(after) = rows.get(ROWS_AT_ONCE..).filter(|after| !after.is_empty()) else { return String::new() };
    let shown: Vec<_> = COLUMNS.iter().filter(|column| column.page_heading().is_some()).collect();
    let data: Vec<serde_json::Value> = after
        .iter()
        .map(|row| {
            let cells: Vec<String> = shown.iter().map(|column| column.shown(row)).collect();
            serde_json::json!({
                "id": anchor(row),
                "task": row.task(),
                "policy": row.policy(),
                "protocol": row.protocol_text(),
                "cells": cells,
            })
        })
        .collect();
    // nothing in a script may look like its end
    let data = serde_json::Value::from(data).to_string().replace('<', "\\u003c");
    format!("<script>\nconst rowsAfter = {data};\n</script>\n")
}

/// The rows that the table is written with, with what filters, sorts and turns to the others.
fn all_rows(rows: &[LeaderboardRow]) -> String {
    let choice = |name: &str, of: &dyn Fn(&LeaderboardRow) -> String| {
        let mut values: Vec<String> = rows.iter().map(of).collect();
        values.sort();
        values.dedup();
        let options: String = values.iter().map(|value| format!("<option>{}</option>", escape(value))).collect();
        format!(
            "<label>{name} <select data-filter=\"{name}\"><option value=\"\">all</option>{options}</select></label>\n"
        )
    };
    let attributes = |row: &LeaderboardRow| {
        format!(
            " id=\"{}\" data-task=\"{}\" data-policy=\"{}\" data-protocol=\"{}\"",
            anchor(row),
            escape(row.task()),
            escape(row.policy()),
            escape(&row.protocol_text())
        )
    };
    format!(
        "<h2 id=\"rows\">All rows</h2>\n<form class=\"tools\" role=\"search\" aria-label=\"Filter rows\">\n{}{}{}<label>entry \
         <input type=\"search\" data-filter=\"text\" placeholder=\"any\"></label>\n<button type=\"button\" id=\"copy\">Copy \
         as CSV</button>\n<output id=\"shown\" aria-live=\"polite\"></output>\n</form>\n<details class=\"choose\" \
         hidden><summary>Columns</summary><fieldset id=\"columns\"><legend>Columns that are shown</legend></fieldset></details>\n{}\
         <div class=\"card scroll\" role=\"region\" aria-label=\"All rows\" tabindex=\"0\">{}</div>\n",
        choice("task", &|row| row.task().to_owned()),
        choice("policy", &|row| row.policy().to_owned()),
        choice("protocol", &LeaderboardRow::protocol_text),
        turning(rows.len()),
        html::table_of(COLUMNS, &rows[..rows.len().min(ROWS_AT_ONCE)], "all", &attributes)
    )
}

/// What turns to the next rows of the table; nothing where it shows them all.
fn turning(rows: usize) -> String {
    if rows <= ROWS_AT_ONCE {
        return String::new();
    }
    format!(
        "<noscript><p class=\"lead\">The first {ROWS_AT_ONCE} of {rows} rows; leaderboard.csv has all.</p></noscript>\n\
         <div class=\"tools\" role=\"group\" aria-label=\"Turn to other rows\"><button type=\"button\" \
         id=\"previous\">Previous</button><button type=\"button\" id=\"next\">Next</button><output id=\"place\" \
         aria-live=\"polite\"></output></div>\n"
    )
}

fn contents(groups: &BTreeMap<Group, Vec<&LeaderboardRow>>, sections: [(&str, &str, &str); 3], html: &mut String) {
    html.push_str(
        "<nav aria-label=\"Contents\"><ul class=\"contents\"><li><a href=\"#policies\">Policies by task</a></li><li><a \
         href=\"#rows\">All rows</a></li>",
    );
    for rows in groups.values() {
        let (task, protocol) = (escape(&title(rows[0])), escape(&rows[0].protocol_words()));
        let _ = write!(html, "<li><a href=\"#{}\">{task}</a> <small>{protocol}</small></li>", heading(rows[0]));
    }
    for (id, title, _) in sections.iter().filter(|(_, _, content)| !content.is_empty()) {
        let _ = write!(html, "<li><a href=\"#{id}\">{title}</a></li>");
    }
    html.push_str("</ul></nav>\n");
}

/// What may still be drawn: a page with everything of ten thousand results would be of no use.
struct Room {
    /// Rows that a task's charts may have.
    each: usize,
    /// Rows that all charts to come may have.
    drawn: usize,
    /// Rows to come that may have details.
    detailed: usize,
    /// Cells that tables of pairs to come may have.
    pairs: usize,
    /// Characters that films to come may have.
    films: usize,
}

impl Room {
    fn for_groups(groups: usize) -> Self {
        let each = (MOST_DRAWN_IN_ALL / groups.max(1)).clamp(10, MOST_DRAWN);
        let (pairs, films) = (MOST_PAIR_CELLS, MOST_FILM_BYTES);
        Self { each, drawn: MOST_DRAWN_IN_ALL, detailed: MOST_DETAILED, pairs, films }
    }
}

/// A task under one protocol: its charts, its rows beside each other, and each row's details while there is room.
///
/// It is folded unless it is the only one.
fn task(rows: &[&LeaderboardRow], beside: &Beside, open: bool, palette: &Palette, room: &mut Room, html: &mut String) {
    let first = rows[0];
    let best = rows
        .iter()
        .find(|row| row.rank == Some(1))
        .map_or(String::new(), |row| format!(", best {} {}", escape(&row.name()), row.counts.percent(1)));
    let count = if rows.len() == 1 { "1 row".to_owned() } else { format!("{} rows", rows.len()) };
    let _ = writeln!(
        html,
        "<details class=\"task\" id=\"{}\"{}>\n<summary><h3>{}</h3> <small>{}, {count}{best}</small></summary>\n<p \
         class=\"lead\">Protocol <code>{}</code></p>",
        heading(first),
        if open { " open" } else { "" },
        escape(&title(first)),
        escape(&first.protocol_words()),
        escape(&first.protocol_text())
    );
    let drawn = &rows[..rows.len().min(room.each).min(room.drawn)];
    room.drawn -= drawn.len();
    let more = match rows.len() - drawn.len() {
        0 => String::new(),
        all if drawn.is_empty() => format!("<p class=\"lead\">{all} rows in the table above</p>"),
        more => format!("<p class=\"lead\">and {more} more rows in the table above</p>"),
    };
    if !drawn.is_empty() {
        html.push_str(&card("Success rates with their intervals", &charts::intervals(drawn, palette)));
    }
    let _ = writeln!(html, "{more}");
    if drawn.len() > 1 {
        let costs = charts::costs(drawn, palette);
        let _ = writeln!(html, "{}", card("Success against what it costs", &costs));
    }
    let hertz = rows.iter().find_map(|row| beside.entry(row)).map(|entry| entry.hertz);
    for (title, content) in [
        ("Rows beside each other", pairs::table(rows, &mut room.pairs)),
        ("Episodes solved by each control step", solving::chart(drawn, hertz, palette)),
        ("Success over demonstrations", demonstrations::chart(drawn, palette)),
    ] {
        if !content.is_empty() {
            let _ = writeln!(html, "{}", card(title, &content));
        }
    }
    for row in rows.iter().take(room.detailed) {
        details(row, beside, palette, &mut room.films, html);
    }
    room.detailed = room.detailed.saturating_sub(rows.len());
    html.push_str("</details>\n");
}

fn card(title: &str, content: &str) -> String {
    format!(
        "<div class=\"card\" role=\"group\" aria-label=\"{0}\" tabindex=\"0\">\n<h4>{0}</h4>\n{content}</div>",
        escape(title)
    )
}

/// What lies behind a row: each training's episodes, its curve, and where it comes from.
fn details(row: &LeaderboardRow, beside: &Beside, palette: &Palette, films: &mut usize, html: &mut String) {
    let _ = writeln!(
        html,
        "<details class=\"row\" id=\"details-{}\"><summary>{} <small>{}, {} [{}%]</small></summary>",
        anchor(row),
        escape(&row.name()),
        row.counts,
        row.counts.percent(1),
        interval_text(row.interval, 1, '–')
    );
    let _ = writeln!(html, "<p><a href=\"#{}\">This row in the table</a></p>", anchor(row));
    let trainings = row.details();
    if trainings.len() > 1 {
        let _ = writeln!(html, "{}", card("Each training", &html::table(COLUMNS, &trainings)));
    }
    let mut episodes = String::new();
    for training in &trainings {
        let strips: String = training.evaluations().map(charts::strip).collect();
        let _ = writeln!(
            episodes,
            "<div class=\"strip\"><p><b>{}</b> {} · seeds {}</p>{strips}{}</div>",
            escape(&training.name()),
            training.counts,
            training.record().seeds,
            failed(training, beside)
        );
    }
    let _ = writeln!(html, "{}", card("Episodes by seed: bar height is steps taken, hatched bars failed", &episodes));
    let filmed: String = trainings.iter().map(|training| films::filmed(training, beside, films)).collect();
    if !filmed.is_empty() {
        let _ = writeln!(html, "{}", card("Films", &filmed));
    }
    let names: Vec<String> = trainings.iter().map(LeaderboardRow::name).collect();
    let mut shown: Vec<&Curve> =
        beside.curves.iter().filter(|curve| row.is_trained() && names.contains(&curve.entry)).collect();
    shown.sort_by(|a, b| a.entry.cmp(&b.entry));
    let drawn = charts::curves(&shown, palette.index(row));
    if !drawn.is_empty() {
        let _ = writeln!(html, "{}", card("Training loss over optimiser steps", &drawn));
    }
    let origins: String = trainings.iter().map(|training| provenance(training, beside)).collect();
    let _ = writeln!(html, "{}\n</details>", card("Where these numbers come from", &origins));
}

/// The first seeds that failed, with the command that shows one.
fn failed(row: &LeaderboardRow, beside: &Beside) -> String {
    const SHOWN: usize = 12;
    let seeds: Vec<u64> =
        row.evaluations().flat_map(|one| &one.episodes).filter(|e| !e.success).map(|e| e.seed).collect();
    let Some(first) = seeds.first() else { return String::new() };
    let listed: Vec<String> = seeds.iter().take(SHOWN).map(u64::to_string).collect();
    let more = seeds.len().saturating_sub(SHOWN);
    format!(
        "<p>Failed: {}{}. Watch one: {}</p>",
        listed.join(", "),
        if more > 0 { format!(" and {more} more") } else { String::new() },
        command(&commands::watch(row, *first, beside.task(row), &beside.places))
    )
}

/// A command, beside which the script puts a button that copies it.
fn command(line: &str) -> String {
    format!("<code class=\"command\">{}</code>", escape(line))
}

/// A name for links: letters, digits and hyphens of what tells a row from the others.
fn anchor(row: &LeaderboardRow) -> String {
    let parts = [&row.name(), &row.protocol_text(), &row.record().seeds.to_string(), &row.execution_text(), &row.apart];
    slug(parts.map(String::as_str).join(" ").trim_end())
}

/// What its rows have in common: `Lift`, `Lift from images`.
fn title(row: &LeaderboardRow) -> String {
    row.task().to_owned() + if row.sees_pictures() { " from images" } else { "" }
}

fn heading(row: &LeaderboardRow) -> String {
    slug(&format!("task {} {}", title(row), row.protocol_text()))
}

fn slug(text: &str) -> String {
    let word = |c: char| if c.is_ascii_alphanumeric() || "._@*".contains(c) { c.to_ascii_lowercase() } else { '-' };
    escape(&text.chars().map(word).collect::<String>())
}

fn provenance(row: &LeaderboardRow, beside: &Beside) -> String {
    let t = &row.record().training;
    let again = commands::again(row, beside.task(row), &beside.places).map_or_else(
        || "It has a time budget, so its episodes may end differently next time.".to_owned(),
        |line| command(&line),
    );
    let said = beside.entry(row).map_or(&[][..], |entry| &entry.conventions);
    let said: Vec<String> = said.iter().map(|(name, value)| escape(&format!("{name}: {value}"))).collect();
    let conventions = if said.is_empty() { "unknown".to_owned() } else { said.join("<br>") };
    let facts = [
        ("entry hash", format!("<code>{}</code>", escape(&row.record().entry.hash))),
        (
            "data set",
            format!(
                "{}, {} demos, recorded in simulator {}, <code>{}</code>",
                escape(&t.data_set),
                t.demos,
                escape(t.data_simulator.as_deref().unwrap_or("unknown")),
                escape(&t.data_fingerprint)
            ),
        ),
        (
            "training",
            match row.is_trained() {
                true => {
                    format!("{} steps in {:.1} min, seed {}, {} parameters", t.steps, t.minutes, t.seed, t.parameters)
                }
                false => "not trained".to_owned(),
            },
        ),
        ("conventions", conventions),
        ("execution", escape(&row.execution_text())),
        ("rules", format!("<code>{}</code>", escape(&row.record().protocol.id()))),
        ("seeds", escape(&row.seeds_text())),
        ("versions", escape(&row.versions_text())),
        ("run its episodes again", again),
        ("reproduce it from its demonstrations", command(&commands::rerun(row, &beside.places))),
    ];
    let mut html = format!("<h5>{}</h5><dl>", escape(&row.name()));
    for (name, value) in facts {
        let _ = write!(html, "<dt>{name}</dt><dd>{value}</dd>");
    }
    html.push_str("</dl>\n");
    html
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;
    use crate::{Reading, rank};
    use zoo::results::list_evaluations;
    use zoo::results::testing::{finished, sample};

    fn page() -> String {
        let dir = tempfile::tempdir().unwrap();
        finished(dir.path(), &sample("lift-act", 1, 20));
        finished(dir.path(), &sample("<b>&\"", 2, 5));
        let mut stack = sample("stack-act", 1, 10);
        stack.protocol.task = "Stack".into();
        finished(dir.path(), &stack);
        let points = (0..=500).step_by(10).map(|step| (step, 2.0 * (-(step as f64) / 120.0).exp() + 0.03)).collect();
        let conventions = [("control_freq", "20"), ("gripper", "-1 opens, 1 closes")];
        let conventions = conventions.map(|(name, value)| (name.to_owned(), value.to_owned())).into();
        let facts = EntryFacts { task: "Lift".into(), hertz: 20.0, conventions };
        let beside = Beside {
            curves: vec![Curve { entry: "lift-act@1".into(), points }],
            entries: [("lift-act@1".to_owned(), facts)].into(),
            ..Beside::default()
        };
        to_html(&rank(&list_evaluations(dir.path()).unwrap(), &Reading::default()), &beside)
    }

    #[test]
    fn the_page_reads_like_this() {
        insta::assert_snapshot!("report_html", page());
    }

    #[test]
    fn the_page_is_self_contained_and_escapes_names() {
        let html = page();
        for outside in ["http://", "https://", "<script ", "@import", " src=", "fetch(", "XMLHttp"] {
            assert!(!html.contains(outside), "{outside}");
        }
        assert!(!html.contains("<b>&\""));
        assert!(html.contains("&lt;b&gt;&amp;&quot;@2"));
        assert_eq!(html, page());
    }

    #[test]
    fn every_link_of_the_page_leads_somewhere_and_no_name_is_given_twice() {
        // one entry, drawn by two renderers, and the page's other rows
        let dir = tempfile::tempdir().unwrap();
        let drawn = ["a GPU", "llvmpipe"].map(|renderer| {
            let mut record = sample("seeing", 1, 20);
            record.renderer = Some(renderer.to_owned());
            finished(dir.path(), &record)
        });
        for html in [page(), to_html(&rank(&drawn, &Reading::default()), &Beside::default())] {
            links_lead_somewhere(&html);
        }
    }

    fn links_lead_somewhere(html: &str) {
        let parts = |before: &str| -> Vec<String> {
            html.split(before).skip(1).map(|rest| rest.split('"').next().unwrap_or_default().to_owned()).collect()
        };
        let (links, mut names) = (parts("href=\"#"), parts(" id=\""));
        assert!(links.len() > 3, "{links:?}");
        for link in links {
            assert!(names.contains(&link), "{link} of {names:?}");
        }
        names.sort();
        let all = names.len();
        names.dedup();
        assert_eq!(names.len(), all, "{names:?}");
    }

    #[test]
    fn groups_of_episodes_are_shown_apart() {
        let dir = tempfile::tempdir().unwrap();
        let mut evaluation = finished(dir.path(), &sample("color", 1, 20));
        for (k, episode) in evaluation.episodes.iter_mut().enumerate() {
            episode.group = Some(if k < 15 { "seen" } else { "unseen" }.to_owned());
        }
        let html = to_html(&rank(&[evaluation], &Reading::default()), &Beside::default());
        assert!(html.contains("16/20<br><small>seen 12/15 (55–93%)</small><br><small>unseen 4/5 (38–96%)</small>"));
    }

    #[test]
    fn results_of_others_have_a_table_of_their_own_and_no_rank() {
        let csv = "task,policy,seed,success\nLift,theirs,1,1\nLift,theirs,2,0\n";
        let others = crate::others::parse("theirs.csv", csv).unwrap();
        let html = to_html(&[], &Beside { others, ..Beside::default() });
        let section = html.split("<h2 id=\"others\">").nth(1).unwrap();
        for part in ["theirs", "1/2", "50.0", "9.5–90.5%"] {
            assert!(section.contains(part), "{part} in {section}");
        }
        assert!(!html.contains("No finished evaluation"));
    }

    #[test]
    fn no_result_is_a_page_that_says_so() {
        let with = |section: &str| to_html(&[], &Beside { section: section.to_owned(), ..Beside::default() });
        assert!(with("").contains("No finished evaluation yet"));
        assert!(!with("<h2 id=\"puzzles\">x</h2>").contains("No finished"));
    }

    /// Ten thousand results over fifty tasks. The bound is for a machine that does other work beside.
    #[test]
    fn ten_thousand_results_are_a_page_in_seconds() {
        let dir = tempfile::tempdir().unwrap();
        let one = finished(dir.path(), &sample("a", 1, 40));
        let all: Vec<_> = (0..10_000_u32)
            .map(|k| {
                let mut other = one.clone();
                other.record.entry.name = format!("entry-{}", k / 50);
                other.record.protocol.task = format!("Task{}", k % 50);
                for episode in &mut other.episodes {
                    episode.success = (episode.seed * 7919 + u64::from(k / 50) * 104_729) % 200 < u64::from(k / 50);
                }
                other
            })
            .collect();
        let rows = rank(&all, &Reading::default());
        let html = to_html(&rows, &Beside::default());
        assert_eq!(rows.len(), 10_000);
        assert!(html.len() < 12_000_000, "{} bytes", html.len());
        // what a browser has to build, however many rows there are
        let elements = |html: &str| html.split('<').skip(1).filter(|tag| tag.starts_with(char::is_alphabetic)).count();
        let all = elements(&html);
        assert!(all < 80_000, "{all} elements");
        let table = html.split("<table id=\"all\">").nth(1).unwrap().split("</table>").next().unwrap();
        assert_eq!(table.matches("<tr").count(), 1 + ROWS_AT_ONCE);
        // and nothing is left out
        let names: Vec<String> = rows.iter().map(anchor).collect();
        assert!(names[..ROWS_AT_ONCE].iter().all(|name| html.contains(&format!("<tr id=\"{name}\""))));
        assert!(names[ROWS_AT_ONCE..].iter().step_by(97).all(|name| html.contains(&format!("\"id\":\"{name}\""))));
    }
}
