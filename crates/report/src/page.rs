//! The report: one HTML file with everything in it, for a reader who has nothing but a browser.
//!
//! A pure function of results and training curves: no clock, no network, the same bytes for the same
//! input.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use zoo::results::StoredEvaluation;

use crate::charts;
use crate::html::{self, escape};
use crate::leaderboard::{COLUMNS, LeaderboardRow, rank};

/// An entry's training loss over optimiser steps.
#[derive(Debug, Clone, PartialEq)]
pub struct Curve {
    /// The entry, `name@version`.
    pub entry: String,
    /// Step and loss, ascending by step.
    pub points: Vec<(u64, f64)>,
}

/// The report over all whole evaluations as HTML, and after them `section`: HTML of other evaluations, or nothing.
pub fn to_html(evaluations: &[StoredEvaluation], curves: &[Curve], section: &str) -> String {
    let rows = rank(evaluations);
    let mut groups: BTreeMap<(String, String), Vec<&LeaderboardRow>> = BTreeMap::new();
    for row in &rows {
        groups.entry((row.task().to_owned(), row.record().protocol.id())).or_default().push(row);
    }
    let mut html = String::new();
    html.push_str("<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n");
    html.push_str("<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n");
    let _ = writeln!(html, "<title>actrm leaderboard</title>\n<style>\n{}</style>\n</head>", include_str!("style.css"));
    let _ = writeln!(html, "<body>\n{}\n<main>\n<h1>Leaderboard</h1>", charts::patterns());
    let episodes: u64 = rows.iter().map(|row| row.counts.episodes).sum();
    let _ = writeln!(
        html,
        "<p class=\"lead\">{} evaluations, {} episodes. Entries are ranked inside a task and protocol by what their \
         success rate is at least, the lower end of its interval; bars are 95% Wilson intervals. Where intervals overlap widely, these \
         episodes do not decide between the entries.</p>",
        rows.len(),
        episodes
    );
    if rows.is_empty() && section.is_empty() {
        html.push_str("<p>No finished evaluation yet.</p>\n");
    }
    for ((task, protocol), rows) in &groups {
        let _ = writeln!(
            html,
            "<h2>{}</h2>\n<p class=\"lead\">Protocol <code>{}</code></p>",
            escape(task),
            escape(protocol)
        );
        let _ = writeln!(html, "<div class=\"card\">{}</div>", charts::intervals(rows));
        let _ = writeln!(html, "<div class=\"card\">{}</div>", html::table(COLUMNS, rows.iter().copied()));
        html.push_str("<div class=\"card\">\n<h3 style=\"margin-top:0\">Episodes by seed: bar height is steps taken, hatched bars failed</h3>\n");
        for row in rows {
            let _ = writeln!(
                html,
                "<div class=\"strip\"><p><b>{}</b> {} · seeds {}</p>{}</div>",
                escape(&row.record().entry.to_string()),
                row.counts,
                row.record().seeds,
                charts::strip(&row.evaluation)
            );
        }
        html.push_str("</div>\n");
        let names: Vec<String> = rows.iter().map(|row| row.record().entry.to_string()).collect();
        let mut shown: Vec<&Curve> = curves.iter().filter(|curve| names.contains(&curve.entry)).collect();
        shown.sort_by(|a, b| a.entry.cmp(&b.entry));
        let drawn = charts::curves(&shown);
        if !drawn.is_empty() {
            let _ = writeln!(
                html,
                "<div class=\"card\">\n<h3 style=\"margin-top:0\">Training loss over optimiser steps</h3>\n{drawn}</div>"
            );
        }
        html.push_str("<div class=\"card\">\n<h3 style=\"margin-top:0\">Where these numbers come from</h3>\n");
        for row in rows {
            html.push_str(&provenance(row));
        }
        html.push_str("</div>\n");
    }
    html.push_str(section);
    let _ = writeln!(
        html,
        "<footer>Made by <code>actrm-zoo leaderboard</code> {} from the results in the zoo; nothing here is loaded \
         from elsewhere.</footer>\n</main>\n</body>\n</html>",
        env!("CARGO_PKG_VERSION")
    );
    html
}

fn provenance(row: &LeaderboardRow) -> String {
    let t = &row.record().training;
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
            format!("{} steps in {:.1} min, seed {}, {} parameters", t.steps, t.minutes, t.seed, t.parameters),
        ),
        ("execution", escape(&row.execution_text())),
        ("seeds", row.record().seeds.to_string()),
        ("versions", escape(&row.versions_text())),
    ];
    let mut html = format!("<details><summary>{}</summary><dl>", escape(&row.record().entry.to_string()));
    for (name, value) in facts {
        let _ = write!(html, "<dt>{name}</dt><dd>{value}</dd>");
    }
    html.push_str("</dl></details>\n");
    html
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::testing::{finished, sample};
    use zoo::results::list_evaluations;

    fn page() -> String {
        let dir = tempfile::tempdir().unwrap();
        finished(dir.path(), &sample("lift-act", 1, 20));
        finished(dir.path(), &sample("<b>&\"", 2, 5));
        let mut stack = sample("stack-act", 1, 10);
        stack.protocol.task = "Stack".into();
        finished(dir.path(), &stack);
        let points = (0..=500).step_by(10).map(|step| (step, 2.0 * (-(step as f64) / 120.0).exp() + 0.03)).collect();
        let curves = [Curve { entry: "lift-act@1".into(), points }];
        to_html(&list_evaluations(dir.path()).unwrap(), &curves, "")
    }

    #[test]
    fn the_page_reads_like_this() {
        insta::assert_snapshot!("report_html", page());
    }

    #[test]
    fn the_page_is_self_contained_and_escapes_names() {
        let html = page();
        for outside in ["http://", "https://", "<script", "<link", "@import", " src="] {
            assert!(!html.contains(outside), "{outside}");
        }
        assert!(!html.contains("<b>&\""));
        assert!(html.contains("&lt;b&gt;&amp;&quot;@2"));
        assert_eq!(html, page());
    }

    #[test]
    fn groups_of_episodes_are_shown_apart() {
        let dir = tempfile::tempdir().unwrap();
        let mut evaluation = finished(dir.path(), &sample("color", 1, 20));
        for (k, episode) in evaluation.episodes.iter_mut().enumerate() {
            episode.group = Some(if k < 15 { "seen" } else { "unseen" }.to_owned());
        }
        let html = to_html(&[evaluation], &[], "");
        assert!(html.contains("16/20<br><small>seen 12/15 (55–93%)</small><br><small>unseen 4/5 (38–96%)</small>"));
    }

    #[test]
    fn no_result_is_a_page_that_says_so() {
        assert!(to_html(&[], &[], "").contains("No finished evaluation yet"));
    }
}
