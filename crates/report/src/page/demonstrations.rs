//! Sample efficiency: success over the number of demonstrations that a training had.

use std::collections::{BTreeMap, BTreeSet};

use super::plot::{COLOURS, Palette, Plot};
use crate::leaderboard::LeaderboardRow;

/// A line a kind of policy whose rows had different numbers of demonstrations; nothing where there is no such kind.
///
/// A line leads through the row of each number that stands first; every row is a point.
pub(super) fn chart(rows: &[&LeaderboardRow], palette: &Palette) -> String {
    let mut policies: BTreeMap<&str, Vec<(u64, &LeaderboardRow)>> = BTreeMap::new();
    for row in rows.iter().filter(|row| row.bound().is_none() && row.record().training.demos > 0) {
        policies.entry(row.policy()).or_default().push((row.record().training.demos, row));
    }
    policies.retain(|_, points| points.iter().any(|(demos, _)| *demos != points[0].0));
    let numbers: BTreeSet<u64> = policies.values().flatten().map(|(demos, _)| *demos).collect();
    let (Some(&least), Some(&most)) = (numbers.first(), numbers.last()) else { return String::new() };
    // some room on either side
    let (from, to) = ((least as f64).ln(), (most as f64).ln());
    let share = |demos: u64| 0.06 + 0.88 * ((demos as f64).ln() - from) / (to - from);
    let mut plot = Plot::new("Success against the number of demonstrations, with 95% intervals");
    let mut named: Option<f64> = None;
    for &demos in &numbers {
        // the last is always named; of the others those that do not stand in each other's way
        let free = named.is_none_or(|before| share(demos) - before > 0.09) && share(most) - share(demos) > 0.09;
        if free || demos == most {
            plot.tick(share(demos), [&demos.to_string(), ""]);
            named = Some(share(demos));
        }
    }
    plot.axis("demonstrations trained on (logarithmic)");
    let mut legend = Vec::new();
    for (index, (policy, points)) in policies.iter().take(COLOURS.len()).enumerate() {
        let mut firsts: BTreeMap<u64, &LeaderboardRow> = BTreeMap::new();
        points.iter().for_each(|(demos, row)| {
            firsts.entry(*demos).or_insert(row);
        });
        // beside each other where they have the same number
        let x = |demos: u64| Plot::x(share(demos)) + 5.0 * (index as f64 - (policies.len() - 1) as f64 / 2.0);
        let corners: Vec<String> =
            firsts.iter().map(|(&demos, row)| format!("{:.1} {:.1}", x(demos), Plot::y(row.counts.rate()))).collect();
        let colour = palette.index(points[0].1);
        plot.line(colour, index, &format!("M{}", corners.join("L")), policy);
        for (demos, row) in points {
            let title = format!("{} ({policy}): {demos} demonstrations, {}", row.name(), rate(row));
            plot.point(colour, x(*demos), row.counts.rate(), row.interval, &title);
        }
        let said: Vec<String> = firsts.iter().map(|(demos, row)| format!("{demos}: {}", rate(row))).collect();
        legend.push((colour, (*policy).to_owned(), said.join(" · ")));
    }
    plot.finish(&legend)
}

/// `95.0% [88–98]`.
fn rate(row: &LeaderboardRow) -> String {
    format!("{} [{}]", row.counts.percent(1), crate::leaderboard::interval_text(row.interval, 0, '–'))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::{Reading, rank};
    use zoo::results::testing::{finished, sample};

    /// Rows: policy, demonstrations, successes of 40.
    fn rows(of: &[(&str, u64, usize)]) -> Vec<LeaderboardRow> {
        let dir = tempfile::tempdir().unwrap();
        let stored = |(k, (policy, demos, won)): (usize, &(&str, u64, usize))| {
            let mut record = sample(&format!("e{k}"), 1, 40);
            (record.training.policy, record.training.demos) = ((*policy).to_owned(), *demos);
            let mut stored = finished(dir.path(), &record);
            stored.episodes.iter_mut().enumerate().for_each(|(k, episode)| episode.success = k < *won);
            stored
        };
        rank(&of.iter().enumerate().map(stored).collect::<Vec<_>>(), &Reading::default())
    }

    fn drawn(of: &[(&str, u64, usize)]) -> String {
        let rows = rows(of);
        chart(&rows.iter().collect::<Vec<_>>(), &Palette::of(&rows))
    }

    #[test]
    fn a_line_leads_through_the_first_row_of_each_number() {
        let html = drawn(&[("act", 25, 10), ("act", 100, 30), ("act", 100, 20), ("act", 400, 40), ("bc", 25, 4)]);
        // 25 and 400 at 6% and 94% of the width, 100 in the middle of their logarithms; 25%, 75% and 100% of the height
        assert!(html.contains("<path d=\"M86.9 164.0L299.0 64.0L511.1 14.0\""), "{html}");
        assert_eq!(html.matches("<circle").count(), 4, "{html}");
        assert!(html.contains("25: 25.0% [14–40] · 100: 75.0% [60–86] · 400: 100.0% [91–100]"), "{html}");
        for demos in [25, 100, 400] {
            assert!(html.contains(&format!(">{demos}</text>")), "{html}");
        }
        assert!(!html.contains("bc"), "one number of demonstrations is no curve: {html}");
    }

    #[test]
    fn one_number_of_demonstrations_is_no_curve() {
        assert_eq!(drawn(&[("act", 50, 10), ("act", 50, 30), ("bc", 100, 20)]), "");
        // what learns nothing, and what came from elsewhere
        assert_eq!(drawn(&[("random", 50, 10), ("random", 100, 30), ("act", 0, 4), ("act", 10, 5)]), "");
    }
}
