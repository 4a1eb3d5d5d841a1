//! Time to success: the share of a row's episodes that are solved by a control step.

use std::fmt::Write as _;

use super::plot::{COLOURS, Palette, Plot};
use crate::leaderboard::LeaderboardRow;

/// Lines of a chart: as many as have colours of their own.
const MOST_LINES: usize = COLOURS.len();

/// Corners of a line; a reader cannot see more.
const MOST_CORNERS: usize = 160;

/// A line a row, for the first ones; nothing where none solved an episode. `hertz`: control steps a second, if that is known.
pub(super) fn chart(rows: &[&LeaderboardRow], hertz: Option<f64>, palette: &Palette) -> String {
    let drawn = &rows[..rows.len().min(MOST_LINES)];
    let steps: Vec<Vec<f64>> = drawn.iter().map(|row| row.steps_to_success()).collect();
    let Some(last) = steps.iter().filter_map(|steps| steps.last().copied()).max_by(f64::total_cmp) else {
        return String::new();
    };
    let pitch = round_pitch(last / 4.0);
    let end = (last / pitch).ceil() * pitch;
    let seconds = |step: f64| hertz.map_or(String::new(), |hertz| format!("{} s", short(step / hertz)));
    let mut plot = Plot::new("Share of episodes solved by each control step");
    let mut at = 0.0;
    while at <= end {
        plot.tick(at / end, [&short(at), &seconds(at)]);
        at += pitch;
    }
    plot.axis(match hertz {
        Some(_) => "solved by control step, and second",
        None => "solved by control step",
    });
    let mut legend = Vec::new();
    for (index, (row, steps)) in drawn.iter().zip(&steps).enumerate() {
        let curve = solved(steps, row.counts.episodes);
        let mut path = format!("M{:.1} {:.1}", Plot::x(0.0), Plot::y(0.0));
        for (step, share) in &thin(&curve) {
            let _ = write!(path, "H{:.1}V{:.1}", Plot::x(step / end), Plot::y(*share));
        }
        let _ = write!(path, "H{:.1}", Plot::x(1.0));
        let half = by(&curve, 0.5).map_or_else(
            || "half never".to_owned(),
            |step| match seconds(step).as_str() {
                "" => format!("half by step {step:.0}"),
                seconds => format!("half by step {step:.0} ({seconds})"),
            },
        );
        plot.line(palette.index(row), index, &path, &format!("{}: {}, {half}", row.name(), row.counts.percent(1)));
        legend.push((palette.index(row), row.name(), format!("{} in the end, {half}", row.counts.percent(1))));
    }
    plot.finish(&legend)
}

/// Steps, ascending, and the share of all `episodes` that are solved by each; those that failed never are.
fn solved(steps: &[f64], episodes: u64) -> Vec<(f64, f64)> {
    let mut curve: Vec<(f64, f64)> = Vec::new();
    for (before, &step) in steps.iter().enumerate() {
        let share = (before + 1) as f64 / episodes.max(1) as f64;
        match curve.last_mut().filter(|(last, _)| *last == step) {
            Some((_, known)) => *known = share,
            None => curve.push((step, share)),
        }
    }
    curve
}

/// The first step by which that share is solved.
fn by(curve: &[(f64, f64)], share: f64) -> Option<f64> {
    curve.iter().find(|(_, solved)| *solved >= share).map(|(step, _)| *step)
}

/// At most as many corners as can be seen: of each stretch the last, so that no share is shown before it is reached.
fn thin(curve: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let stretch = curve.len().div_ceil(MOST_CORNERS).max(1);
    curve.chunks(stretch).filter_map(|part| part.last().copied()).collect()
}

/// 1, 2, 2.5 or 5 times a power of ten, whole, and at least as much as asked for.
fn round_pitch(least: f64) -> f64 {
    let decade = 10f64.powf(least.max(1.0).log10().floor());
    let found = [1.0, 2.0, 2.5, 5.0, 10.0].map(|times| times * decade).into_iter();
    found.filter(|pitch| pitch.fract() == 0.0).find(|pitch| *pitch >= least).unwrap_or(least.ceil())
}

/// A number without zeros behind the point.
fn short(value: f64) -> String {
    let text = format!("{value:.1}");
    text.strip_suffix(".0").map_or(text.clone(), str::to_owned)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::{Reading, rank};
    use zoo::results::testing::{finished, sample};

    #[test]
    fn failures_never_get_there() {
        // 5 episodes, 4 solved: at 10, twice at 20, at 40
        let curve = solved(&[10.0, 20.0, 20.0, 40.0], 5);
        assert_eq!(curve, [(10.0, 0.2), (20.0, 0.6), (40.0, 0.8)]);
        assert_eq!((by(&curve, 0.5), by(&curve, 0.8), by(&curve, 0.9)), (Some(20.0), Some(40.0), None));
        assert_eq!(solved(&[], 5), []);
    }

    #[test]
    fn a_long_curve_keeps_its_end() {
        let curve: Vec<(f64, f64)> = (1..=1000).map(|k| (f64::from(k), f64::from(k) / 2000.0)).collect();
        let thinned = thin(&curve);
        assert!(thinned.len() <= MOST_CORNERS && thinned.last() == Some(&(1000.0, 0.5)), "{}", thinned.len());
        assert_eq!(thin(&curve[..9]), &curve[..9]);
    }

    #[test]
    fn ticks_are_round() {
        let found = [0.3, 1.0, 11.5, 21.0, 26.0, 99.0].map(round_pitch);
        assert_eq!(found, [1.0, 1.0, 20.0, 25.0, 50.0, 100.0]);
        assert_eq!([short(2.0), short(0.05), short(12.5)], ["2", "0.1", "12.5"]);
    }

    #[test]
    fn the_chart_says_steps_and_seconds() {
        let dir = tempfile::tempdir().unwrap();
        let mut fails = finished(dir.path(), &sample("fails", 1, 20));
        fails.episodes.iter_mut().for_each(|episode| episode.success = false);
        let half = finished(dir.path(), &sample("half", 1, 20));
        let rows = rank(&[fails.clone(), half], &Reading::default());
        let palette = Palette::of(&rows);
        let rows: Vec<&LeaderboardRow> = rows.iter().collect();
        // the sample: seeds 10,000 to 10,019, every fifth fails, the others take 40 + seed % 7 steps
        let mut steps: Vec<u64> = (10_000..10_020).filter(|seed| seed % 5 != 0).map(|seed| 40 + seed % 7).collect();
        steps.sort_unstable();
        let median = steps[9];
        let html = chart(&rows, Some(20.0), &palette);
        let seconds = short(median as f64 / 20.0);
        assert!(html.contains(&format!("80.0% in the end, half by step {median} ({seconds} s)")), "{html}");
        assert!(html.contains("0.0% in the end, half never"), "{html}");
        assert!(html.contains(">60</text>") && html.contains(">3 s</text>"), "{html}");
        // the line that never rises: from left to right along the bottom
        assert!(html.contains("<path d=\"M58.0 214.0H540.0\""), "{html}");
        assert!(!chart(&rows, None, &palette).contains(" s</text>"));
        let none = LeaderboardRow::new(&fails);
        assert_eq!(chart(&[&none], None, &palette), "");
    }
}
