//! Rows of a task beside each other: how far their success rates differ, and whether that can be told from chance.

use std::fmt::Write as _;

use crate::comparison::{ALPHA, Pair};
use crate::html::escape;
use crate::leaderboard::LeaderboardRow;

/// A table of the first rows that were compared with each other; nothing where there are fewer than two, or more pairs
/// than there is `room` for, which becomes less by those that are shown.
pub(super) fn table(rows: &[&LeaderboardRow], room: &mut usize) -> String {
    let compared: Vec<(&LeaderboardRow, &[Option<Pair>])> = rows
        .iter()
        .filter_map(|row| Some((*row, row.standing.as_ref()?.beside.as_slice())))
        .filter(|(_, beside)| !beside.is_empty())
        .collect();
    let n = compared.len();
    if n < 2 || n * n > *room {
        return String::new();
    }
    *room -= n * n;
    let ranked = rows.iter().filter(|row| row.standing.is_some()).count();
    let first = if ranked > n { format!("The first {n} of {ranked} rows. ") } else { String::new() };
    let mut html = format!(
        "<table class=\"pairs\"><caption>{first}Success of the row less that of the column, in percentage points, and the \
         p-value after Holm's correction over all comparisons of this page. ▲: the row is better, ▼: it is worse, \
         significant at {:.0}%. Without a mark the difference is not significant.</caption><thead><tr><th scope=\"col\">row less column</th>",
        ALPHA * 1e2
    );
    for (place, (row, _)) in compared.iter().enumerate() {
        let _ = write!(html, "<th scope=\"col\"><abbr title=\"{}\">{}</abbr></th>", escape(&name(row)), place + 1);
    }
    html.push_str("</tr></thead><tbody>\n");
    for (place, (row, beside)) in compared.iter().enumerate() {
        let _ = write!(html, "<tr><th scope=\"row\">{} {}</th>", place + 1, escape(&name(row)));
        beside.iter().for_each(|pair| html.push_str(&pair.map_or_else(|| "<td>·</td>".to_owned(), |pair| cell(&pair))));
        html.push_str("</tr>\n");
    }
    html.push_str("</tbody></table>");
    html
}

/// A row's name, and what tells it from others of its entry.
fn name(row: &LeaderboardRow) -> String {
    if row.apart.is_empty() { row.name() } else { format!("{} ({})", row.name(), row.apart) }
}

fn cell(pair: &Pair) -> String {
    let Pair { comparison, adjusted, distinct } = pair;
    let points = comparison.difference * 1e2;
    // a difference that rounds to nothing has no sign
    let difference = format!("{points:+.1}");
    let difference = if difference.ends_with("0.0") && difference.len() == 4 { "0.0".to_owned() } else { difference };
    let (class, mark) = match (distinct, comparison.difference > 0.0) {
        (false, _) => ("", ""),
        (true, true) => (" class=\"better\"", " ▲"),
        (true, false) => (" class=\"worse\"", " ▼"),
    };
    let interval = comparison
        .interval
        .map_or(String::new(), |(low, high)| format!(", 95% interval {:+.1} to {:+.1}", low * 1e2, high * 1e2));
    format!(
        "<td{class} title=\"{}, {} seeds in common{interval}\">{difference}{mark}<br><small>p {}</small></td>",
        comparison.test.name(),
        comparison.shared,
        p_text(*adjusted)
    )
}

/// `0.012`, `<0.001`, `1`.
fn p_text(p: f64) -> String {
    match p {
        p if p < 0.001 => "&lt;0.001".to_owned(),
        // not rounded to the level that it is below
        p if p < ALPHA && format!("{p:.3}").parse().is_ok_and(|shown: f64| shown >= ALPHA) => format!("{p:.5}"),
        p if p >= 0.9995 => "1".to_owned(),
        p => format!("{p:.3}"),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::comparison::{MOST_PAIRED, compare};
    use crate::{Reading, rank};
    use zoo::results::testing::{finished, sample};

    /// Rows of 40 episodes each, of which the first ones succeed.
    fn rows(won: &[usize]) -> Vec<LeaderboardRow> {
        let dir = tempfile::tempdir().unwrap();
        let stored = |(k, won): (usize, &usize)| {
            let mut stored = finished(dir.path(), &sample(&format!("e{k:02}"), 1, 40));
            stored.episodes.iter_mut().enumerate().for_each(|(k, episode)| episode.success = k < *won);
            stored
        };
        rank(&won.iter().enumerate().map(stored).collect::<Vec<_>>(), &Reading::default())
    }

    #[test]
    fn the_table_says_what_the_letters_say() {
        let rows = rows(&[40, 38, 20]);
        let rows: Vec<&LeaderboardRow> = rows.iter().collect();
        let mut room = 100;
        let html = table(&rows, &mut room);
        assert_eq!(room, 91);
        // two flips one way: 2 / 2^2, not corrected below 1; twenty flips: 2 / 2^20, eighteen: 2 / 2^18
        let beside = &rows[0].standing.as_ref().unwrap().beside;
        let (second, third) = (beside[1].unwrap(), beside[2].unwrap());
        assert!((second.adjusted - 0.5).abs() < 1e-12 && !second.distinct, "{second:?}");
        assert!((third.adjusted - 3.0 * 2.0_f64.powi(-19)).abs() < 1e-15 && third.distinct, "{third:?}");
        assert_eq!(third.comparison, compare(rows[0], rows[2]));
        let turned = rows[2].standing.as_ref().unwrap().beside[1].unwrap();
        assert!((turned.adjusted - 2.0 * 2.0_f64.powi(-17)).abs() < 1e-15, "{turned:?}");
        assert_eq!(turned.comparison.difference, -0.45);
        assert_eq!(rows[2].standing.as_ref().unwrap().letters, "b");
        for cell in [
            "<th scope=\"row\">1 e00@1</th><td>·</td>",
            "seeds in common, 95% interval",
            ">+5.0<br><small>p 0.500</small></td>",
            "<td class=\"better\" title=\"McNemar, 40 seeds in common",
            ">+50.0 ▲<br><small>p &lt;0.001</small></td>",
            ">-45.0 ▼<br><small>p &lt;0.001</small></td>",
        ] {
            assert!(html.contains(cell), "no {cell} in {html}");
        }
    }

    #[test]
    fn the_table_is_bounded_and_one_row_is_compared_with_nothing() {
        let all = rows(&(0..20).map(|k| 2 * k).collect::<Vec<_>>());
        let all: Vec<&LeaderboardRow> = all.iter().collect();
        let mut room = MOST_PAIRED * MOST_PAIRED;
        let html = table(&all, &mut room);
        assert_eq!((html.matches("<td").count(), room), (MOST_PAIRED * MOST_PAIRED, 0));
        assert!(html.contains("The first 12 of 20 rows."), "{html}");
        assert_eq!(table(&all, &mut room), "");
        assert_eq!(table(&all[..1], &mut 100), "");
    }

    #[test]
    fn a_p_value_is_not_rounded_across_the_level() {
        let texts = [(0.0004, "&lt;0.001"), (0.0123, "0.012"), (0.04996, "0.04996"), (0.05, "0.050"), (1.0, "1")];
        for (p, text) in texts {
            assert_eq!(p_text(p), text);
        }
    }
}
