//! Results that other programs measured, apart from the rows of the zoo.

use std::fmt::Write as _;

use crate::column::{Column, count, number, text};
use crate::html;
use crate::leaderboard::{Counts, interval_text};
use crate::others::Run;

/// The columns of results of others.
pub const OTHERS_COLUMNS: &[Column<Run>] = &[
    text(|run: &Run| run.task.clone()).csv("task").page("task").table("task").left().kept(),
    text(|run: &Run| run.policy.clone()).csv("policy").page("policy").table("policy").left().kept(),
    count(|run: &Run| Some(counts(run).successes)).csv("successes"),
    count(|run: &Run| Some(counts(run).episodes)).csv("episodes"),
    text(|run: &Run| counts(run).to_string()).page("success").table("success"),
    text(|run: &Run| counts(run).percent(1)).page("rate").table("rate"),
    number(|run: &Run| Some(counts(run).interval().0), 4, 4).csv("ci95_low"),
    number(|run: &Run| Some(counts(run).interval().1), 4, 4).csv("ci95_high"),
    text(|run: &Run| format!("{}%", interval_text(counts(run).interval(), 1, '–')))
        .page("95% interval")
        .table("95% interval"),
    text(note).csv("note").page("note").table("note").left(),
];

fn counts(run: &Run) -> Counts {
    let successes = run.outcomes.values().filter(|success| **success).count() as u64;
    Counts { successes, episodes: run.outcomes.len() as u64 }
}

fn note(run: &Run) -> String {
    let mut notes = Vec::new();
    if run.errors > 0 {
        notes.push(format!("{} errors counted as failures", run.errors));
    }
    if run.partial {
        notes.push("episodes are missing".to_owned());
    }
    notes.join("; ")
}

/// A table of these results; nothing without any.
pub(super) fn section(runs: &[Run]) -> String {
    if runs.is_empty() {
        return String::new();
    }
    let mut html = String::new();
    let _ = writeln!(
        html,
        "<section>\n<h2 id=\"others\">Results of others</h2>\n<p class=\"lead\">Other programs measured these. They have no \
         seal and no rank: their environment, seeds and rules may be others than above.</p>\n<div class=\"card scroll\" \
         role=\"region\" aria-label=\"Results of others\" tabindex=\"0\">{}</div>\n</section>",
        html::table(OTHERS_COLUMNS, runs)
    );
    html
}
