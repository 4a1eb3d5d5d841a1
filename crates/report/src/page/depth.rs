//! Reasoning depth: what an entry solves, and what a query takes, when it thinks more or fewer steps than it was trained to.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use zoo::results::StoredEvaluation;

use super::plot::{COLOURS, Plot};
use crate::column::{Column, count, number, text};
use crate::html::{self, escape};
use crate::leaderboard::{Counts, LeaderboardRow, interval_text};

/// Entries and tasks whose depths are drawn.
const MOST_DRAWN: usize = 40;

/// An entry's episodes at one number of supervision steps.
#[derive(Debug, Clone, PartialEq)]
pub struct Depth {
    /// Supervision steps of a query; the most where it may halt.
    pub steps: u64,
    /// How it thought: `whole`, `halting`, or under which intervention.
    pub how: String,
    row: LeaderboardRow,
}

/// The numbers of the depths of an entry, in their order.
pub const DEPTH_COLUMNS: &[Column<Depth>] = &[
    text(|depth: &Depth| depth.row.name()).csv("entry"),
    text(|depth: &Depth| depth.row.task().to_owned()).csv("task"),
    text(|depth: &Depth| depth.row.record().protocol.id()).csv("protocol"),
    text(|depth: &Depth| depth.row.seeds_text()).csv("seeds"),
    text(|depth: &Depth| depth.how.clone()).csv("thinking"),
    text(|depth: &Depth| words(&depth.how).to_owned()).page("thinking"),
    count(|depth: &Depth| Some(depth.steps)).csv("steps").page("steps"),
    count(|depth: &Depth| Some(depth.row.counts.successes)).csv("successes"),
    count(|depth: &Depth| Some(depth.row.counts.episodes)).csv("episodes"),
    text(|depth: &Depth| depth.counts().to_string()).page("success"),
    text(|depth: &Depth| depth.counts().percent(1)).page("rate"),
    number(|depth: &Depth| Some(depth.row.interval.0), 4, 4).csv("ci95_low"),
    number(|depth: &Depth| Some(depth.row.interval.1), 4, 4).csv("ci95_high"),
    text(|depth: &Depth| format!("{}%", interval_text(depth.row.interval, 1, '–'))).page("95% interval"),
    number(|depth: &Depth| Some(depth.row.inference_ms()?.0), 3, 2)
        .csv("inference_ms_median")
        .page("a query, ms\nmedian"),
    number(|depth: &Depth| Some(depth.row.inference_ms()?.1), 3, 2).csv("inference_ms_p95").page("95% below"),
];

impl Depth {
    /// What an evaluation at `steps` supervision steps came to.
    pub fn new(steps: u64, how: &str, evaluation: &StoredEvaluation) -> Self {
        Self { steps, how: how.to_owned(), row: LeaderboardRow::new(evaluation) }
    }

    /// Successes and episodes.
    pub fn counts(&self) -> Counts {
        self.row.counts
    }

    /// The median duration of a query, `1.2 ms`.
    fn query_text(&self, digits: usize) -> String {
        self.row.inference_ms().map_or_else(|| "-".to_owned(), |(median, _)| format!("{median:.digits$} ms"))
    }

    /// Depths are compared where nothing but the thinking differs.
    fn group(&self) -> (String, String, String) {
        let row = &self.row;
        let rules = format!("{}, seeds {}, {}", row.record().protocol.id(), row.seeds_text(), row.execution_text());
        (row.task().to_owned(), row.record().entry.to_string(), rules)
    }
}

/// A chart and a table for every entry that was evaluated at several depths; nothing where none was.
pub(super) fn section(depths: &[Depth]) -> String {
    let mut groups: BTreeMap<_, BTreeMap<(Place, u64), &Depth>> = BTreeMap::new();
    for depth in depths {
        groups.entry(depth.group()).or_default().entry((Place::of(&depth.how), depth.steps)).or_insert(depth);
    }
    groups.retain(|_, of| of.len() > 1);
    if groups.is_empty() {
        return String::new();
    }
    let mut html = String::from(
        "<section>\n<h2 id=\"depth\">Reasoning depth</h2>\n<p class=\"lead\">The same weights, applied more or fewer times \
         before the action is read (<code>actrm-zoo depth</code>). No row above: an entry is ranked as it was trained.</p>\n",
    );
    for ((task, entry, rules), of) in groups.iter().take(MOST_DRAWN) {
        let of: Vec<&Depth> = of.values().copied().collect();
        let title = format!("{entry} on {task}");
        let _ = writeln!(
            html,
            "<div class=\"card\" role=\"region\" aria-label=\"{0}: reasoning depth\" tabindex=\"0\">\n<h3>{0}</h3>\n{1}{2}\n\
             <p><small>{3}</small></p></div>",
            escape(&title),
            chart(&of),
            html::table(DEPTH_COLUMNS, of.iter().copied()),
            escape(rules)
        );
    }
    if groups.len() > MOST_DRAWN {
        let _ = writeln!(html, "<p class=\"lead\">and {} more</p>", groups.len() - MOST_DRAWN);
    }
    html.push_str("</section>\n");
    html
}

/// The ways to think in their order: undisturbed ones first.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Place(usize, String);

impl Place {
    fn of(how: &str) -> Self {
        let known = ["whole", "halting"].iter().position(|word| *word == how);
        Self(known.unwrap_or(2), how.to_owned())
    }
}

/// How an entry thought, in words.
fn words(how: &str) -> &str {
    match how {
        "whole" => "every step done",
        "halting" => "halting where it may",
        "freeze" => "reasoning frozen after the first step",
        "shuffle" => "reasoning of another episode",
        other => other,
    }
}

/// A line a way to think.
fn chart(depths: &[&Depth]) -> String {
    let mut ticks: BTreeMap<u64, &Depth> = BTreeMap::new();
    for depth in depths {
        ticks.entry(depth.steps).or_insert(depth);
    }
    let (Some((&least, _)), Some((&most, _))) = (ticks.first_key_value(), ticks.last_key_value()) else {
        return String::new();
    };
    let (from, to) = ((least as f64).ln(), (most as f64).ln());
    let share = |steps: u64| match least == most {
        true => 0.5,
        false => 0.06 + 0.88 * ((steps as f64).ln() - from) / (to - from),
    };
    let mut plot = Plot::new("Success against supervision steps, with 95% intervals");
    let mut named: Option<f64> = None;
    for (&steps, depth) in &ticks {
        let free = named.is_none_or(|before| share(steps) - before > 0.13) && share(most) - share(steps) > 0.13;
        if free || steps == most {
            plot.tick(share(steps), [&steps.to_string(), &depth.query_text(1)]);
            named = Some(share(steps));
        }
    }
    plot.axis("supervision steps (logarithmic), median of a query");
    let mut legend = Vec::new();
    let mut lines: Vec<&[&Depth]> = depths.chunk_by(|one, two| one.how == two.how).collect();
    lines.truncate(COLOURS.len());
    for (index, line) in lines.iter().enumerate() {
        let how = words(&line[0].how);
        let x = |depth: &Depth| Plot::x(share(depth.steps)) + 5.0 * (index as f64 - (lines.len() - 1) as f64 / 2.0);
        let corners: Vec<String> =
            line.iter().map(|depth| format!("{:.1} {:.1}", x(depth), Plot::y(depth.counts().rate()))).collect();
        plot.line(index, index, &format!("M{}", corners.join("L")), how);
        for depth in *line {
            let title = format!("{how}, {} steps: {}, {}", depth.steps, depth.counts(), depth.query_text(2));
            plot.point(index, x(depth), depth.counts().rate(), depth.row.interval, &title);
        }
        let steps: Vec<String> = line.iter().map(|depth| depth.steps.to_string()).collect();
        legend.push((index, how.to_owned(), format!("at {} steps", steps.join(", "))));
    }
    plot.finish(&legend)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use zoo::results::testing::{finished, sample};

    #[test]
    fn depths_of_one_entry_are_one_chart_and_one_table() {
        let dir = tempfile::tempdir().unwrap();
        let stored = finished(dir.path(), &sample("think", 1, 40));
        let at = |steps: u64, how: &str, won: usize| {
            let mut stored = stored.clone();
            stored.episodes.iter_mut().enumerate().for_each(|(k, episode)| episode.success = k < won);
            stored.timings.iter_mut().for_each(|timing| timing.inference_ms = vec![steps as f64 / 2.0]);
            Depth::new(steps, how, &stored)
        };
        let html = section(&[at(16, "whole", 40), at(1, "whole", 10), at(4, "whole", 20)]);
        // 1, 4 and 16 steps: 6%, 50% and 94% of the width; 25%, 50% and 100% of the height
        assert!(html.contains("<path d=\"M86.9 164.0L299.0 114.0L511.1 14.0\""), "{html}");
        assert_eq!((html.matches("<h3>").count(), html.matches("<circle").count()), (1, 3));
        let row = "<td>every step done</td><td>4</td><td>20/40</td><td>50.0%</td><td>35.2–64.8%</td><td>2.00</td>";
        assert!(html.contains(row), "{html}");
        assert!(html.contains(">16</text>") && html.contains(">8.0 ms</text>"), "{html}");
        // what is disturbed stands beside what is not, at one depth or several, and after it
        let html = section(&[at(4, "freeze", 1), at(4, "whole", 20), at(1, "whole", 10)]);
        assert_eq!((html.matches("<path").count(), html.matches("<circle").count()), (2, 3));
        let places: Vec<usize> = ["<td>1</td><td>10/40", "<td>4</td><td>20/40", "<td>4</td><td>1/40"]
            .map(|row| html.find(row).unwrap())
            .into();
        assert!(places.is_sorted(), "{html}");
        assert_eq!(section(&[at(4, "whole", 20)]), "");
        // other rules are no depth
        let mut other = at(8, "whole", 20);
        other.row = {
            let mut record = sample("think", 1, 40);
            record.protocol.max_steps = 500;
            LeaderboardRow::new(&finished(dir.path(), &record))
        };
        assert_eq!(section(&[at(4, "whole", 20), other]), "");
    }
}
