//! The report's pictures, each a pure function from numbers to SVG.

use std::fmt::Write as _;

use zoo::results::StoredEvaluation;

use crate::html::escape;
use crate::leaderboard::LeaderboardRow;
use crate::page::{COLOURS, Curve, Palette};

const WIDTH: f64 = 1040.0;

/// Success rates with their 95% intervals, one line a row.
pub(super) fn intervals(rows: &[&LeaderboardRow], palette: &Palette) -> String {
    let (left, right, step) = (250.0, 130.0, 30.0);
    let scale = |rate: f64| left + rate * (WIDTH - left - right);
    let height = 16.0 + step * rows.len() as f64 + 26.0;
    let bottom = height - 26.0;
    let mut svg = open(height, "Success rate of each entry with its 95% interval");
    for percent in (0..=100).step_by(20) {
        let x = scale(f64::from(percent) / 100.0);
        let _ = write!(
            svg,
            r#"<line class="grid" x1="{x:.1}" x2="{x:.1}" y1="8" y2="{bottom:.1}"/><text x="{x:.1}" y="{:.1}" text-anchor="middle">{percent}%</text>"#,
            height - 8.0
        );
    }
    for (index, row) in rows.iter().enumerate() {
        let y = 16.0 + step * (index as f64 + 0.5);
        let (low, high) = row.interval;
        let (low_x, high_x, rate_x) = (scale(low), scale(high), scale(row.counts.rate()));
        let (name, colour) = (escape(&row.name()), palette.colour(row));
        let _ = write!(
            svg,
            r##"<g><title>{name}: {}/{}, 95% interval {:.1}% to {:.1}%</title><text class="label" x="0" y="{:.1}">{name}</text><line x1="{low_x:.1}" x2="{high_x:.1}" y1="{y:.1}" y2="{y:.1}" stroke="{colour}" stroke-opacity=".3" stroke-width="12" stroke-linecap="round"/><circle cx="{rate_x:.1}" cy="{y:.1}" r="5.5" fill="{colour}"/><text x="{:.1}" y="{:.1}" text-anchor="end">{}/{} · {}</text></g>"##,
            row.counts.successes,
            row.counts.episodes,
            low * 1e2,
            high * 1e2,
            y + 4.0,
            WIDTH,
            y + 4.0,
            row.counts.successes,
            row.counts.episodes,
            row.counts.percent(0),
        );
    }
    svg.push_str("</svg>");
    svg
}

/// Success against a query's duration, the number of weights and the minutes of training: three pictures, each with a line
/// through the rows that no other one beats at no higher cost.
pub(super) fn costs(rows: &[&LeaderboardRow], palette: &Palette) -> String {
    type Cost = fn(&LeaderboardRow) -> f64;
    let measures: [(&str, Cost); 3] = [
        ("median query, ms", |row| row.inference_ms().map_or(0.0, |(median, _)| median)),
        ("weights", |row| row.record().training.parameters as f64),
        ("minutes of training", LeaderboardRow::minutes),
    ];
    let drawn: String = measures.iter().map(|(name, cost)| cost_chart(rows, palette, name, cost)).collect();
    let trained = rows.iter().filter(|row| row.is_trained());
    let mut policies: Vec<(&str, &str)> = trained.map(|row| (row.policy(), palette.colour(row))).collect();
    policies.sort_unstable();
    policies.dedup();
    let legend: String = policies
        .iter()
        .map(|(policy, colour)| {
            let dot = format!(
                r#"<svg width="12" height="12" aria-hidden="true"><circle cx="6" cy="6" r="5" fill="{colour}"/></svg>"#
            );
            format!("<li>{dot}{}</li>", escape(policy))
        })
        .collect();
    format!("<div class=\"costs\">{drawn}</div>\n<ul class=\"legend\">{legend}</ul>")
}

/// Values between two costs where a logarithmic axis is labelled: 1, 2 and 5 times powers of ten, or the powers alone where
/// those are many; the ends where there would be fewer than two.
fn log_ticks(low: f64, high: f64) -> Vec<f64> {
    let decades = low.log10().floor() as i32..=high.log10().ceil() as i32;
    let within = |digits: &'static [f64]| -> Vec<f64> {
        let all = decades.clone().flat_map(|decade| digits.iter().map(move |digit| digit * 10f64.powi(decade)));
        all.filter(|value| (low..=high).contains(value)).collect()
    };
    let fine = within(&[1.0, 2.0, 5.0]);
    let ticks = if fine.len() > 5 { within(&[1.0]) } else { fine };
    match ticks.len() {
        0 | 1 if high / low < 1.05 => vec![low],
        0 | 1 => vec![low, high],
        _ => ticks,
    }
}

/// A cost with two significant digits, or in thousands and millions: `0.04`, `1.5`, `20`, `1.87M`.
fn cost_text(cost: f64) -> String {
    if cost >= 1e4 {
        return crate::count_text(cost as u64);
    }
    let digits = (1 - cost.log10().floor() as i32).clamp(0, 6) as usize;
    let text = format!("{cost:.digits$}");
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
}

fn cost_chart(
    rows: &[&LeaderboardRow],
    palette: &Palette,
    name: &str,
    cost: &dyn Fn(&LeaderboardRow) -> f64,
) -> String {
    let points: Vec<(f64, &LeaderboardRow)> = rows
        .iter()
        .filter(|row| row.is_trained())
        .map(|row| (cost(row), *row))
        .filter(|(x, _)| x.is_finite() && *x > 0.0)
        .collect();
    let low = points.iter().map(|(x, _)| *x).fold(f64::INFINITY, f64::min);
    let high = points.iter().map(|(x, _)| *x).fold(0.0, f64::max);
    if points.is_empty() {
        return String::new();
    }
    let (width, height, left, bottom) = (330.0, 230.0, 44.0, 190.0);
    // some room on either side, so that equal costs stand in the middle
    let (from, to) = (low.log10() - 0.15, high.log10() + 0.15);
    let x_of = |x: f64| left + (x.log10() - from) / (to - from) * (width - left - 14.0);
    let y_of = |rate: f64| 14.0 + (1.0 - rate) * (bottom - 14.0);
    let mut svg = format!(
        r#"<svg viewBox="0 0 {width} {height}" width="{width}" height="{height}" role="img" aria-label="Success against {}">"#,
        escape(name)
    );
    for percent in [0, 50, 100] {
        let y = y_of(f64::from(percent) / 1e2);
        let _ = write!(
            svg,
            r#"<line class="grid" x1="{left}" x2="{width}" y1="{y:.1}" y2="{y:.1}"/><text x="{:.1}" y="{:.1}" text-anchor="end">{percent}%</text>"#,
            left - 6.0,
            y + 4.0
        );
    }
    for x in log_ticks(10f64.powf(from), 10f64.powf(to)) {
        let (at, text) = (x_of(x), cost_text(x));
        let _ = write!(
            svg,
            r#"<line class="axis" x1="{at:.1}" x2="{at:.1}" y1="{bottom}" y2="{:.1}"/><text x="{at:.1}" y="{:.1}" text-anchor="middle">{text}</text>"#,
            bottom + 4.0,
            bottom + 17.0
        );
    }
    let _ =
        write!(svg, r#"<text class="label" x="{left}" y="{:.1}">{} (logarithmic)</text>"#, bottom + 36.0, escape(name));
    let mut sorted = points.clone();
    sorted.sort_by(|a, b| a.0.total_cmp(&b.0).then(b.1.counts.rate().total_cmp(&a.1.counts.rate())));
    let mut best = -1.0;
    let mut front = Vec::new();
    for (x, row) in sorted {
        if row.counts.rate() > best {
            best = row.counts.rate();
            front.push(format!("{:.1},{:.1}", x_of(x), y_of(best)));
        }
    }
    let _ = write!(
        svg,
        r#"<polyline points="{}" fill="none" stroke="var(--faint)" stroke-dasharray="3 3"/>"#,
        front.join(" ")
    );
    for (x, row) in points {
        let colour = palette.colour(row);
        let _ = write!(
            svg,
            r#"<circle cx="{:.1}" cy="{:.1}" r="5" fill="{colour}" fill-opacity=".75"><title>{} ({}): {}, {} {}</title></circle>"#,
            x_of(x),
            y_of(row.counts.rate()),
            escape(&row.name()),
            escape(row.policy()),
            row.counts.percent(1),
            cost_text(x),
            escape(name)
        );
    }
    svg.push_str("</svg>");
    svg
}

/// Every episode as a bar: as high as it took steps, failures at full height and hatched.
pub(super) fn strip(evaluation: &StoredEvaluation) -> String {
    let count = evaluation.episodes.len().max(1) as f64;
    let cap = evaluation.record.protocol.max_steps.max(1) as f64;
    let height = 56.0;
    let (baseline, full) = (height - 14.0, height - 18.0);
    let pitch = (WIDTH / count).min(18.0);
    let bar = (pitch - 2.0).max(pitch * 0.6);
    // the tallest success fills most of the strip, so that quick and slow ones differ visibly
    let slowest = evaluation.episodes.iter().filter(|e| e.success).map(|e| e.steps).max();
    let top = slowest.map_or(cap, |steps| f64::from(steps) * 1.25).min(cap).max(1.0);
    let mut svg = open(height, "Episodes in the order of their seeds");
    for (index, episode) in evaluation.episodes.iter().enumerate() {
        let x = pitch * index as f64;
        let share = if episode.success { (f64::from(episode.steps) / top).min(1.0) } else { 1.0 };
        let tall = (full * share).max(2.0);
        let (fill, word) = if episode.success { ("var(--good)", "success") } else { ("url(#failed)", "failure") };
        let _ = write!(
            svg,
            r#"<rect x="{x:.1}" y="{:.1}" width="{bar:.1}" height="{tall:.1}" rx="1.5" fill="{fill}"><title>seed {}: {word} after {} steps, return {:.2}</title></rect>"#,
            baseline - tall,
            episode.seed,
            episode.steps,
            episode.total_reward
        );
    }
    if let (Some(first), Some(last)) = (evaluation.episodes.first(), evaluation.episodes.last()) {
        let end = pitch * (count - 1.0) + bar;
        let _ = write!(svg, r#"<text x="0" y="{:.1}">{}</text>"#, height - 1.0, first.seed);
        if end > 120.0 {
            let y = height - 1.0;
            let _ = write!(svg, r#"<text x="{end:.1}" y="{y:.1}" text-anchor="end">{}</text>"#, last.seed);
        }
    }
    svg.push_str("</svg>");
    svg
}

/// The pattern of failed episodes; once a page.
pub(super) fn patterns() -> &'static str {
    r##"<svg width="0" height="0" aria-hidden="true" style="position:absolute"><defs><pattern id="failed" width="5" height="5" patternUnits="userSpaceOnUse" patternTransform="rotate(45)"><rect width="5" height="5" fill="var(--bad)" fill-opacity=".25"/><rect width="2.5" height="5" fill="var(--bad)"/></pattern></defs></svg>"##
}

/// Training curves as a picture of their own, which looks alike wherever it is shown.
pub fn curves_svg(of: &[Curve]) -> String {
    let style = "<style>text{font:12px sans-serif;fill:#5b6470}.grid{stroke:#e3e7ec}</style>";
    let drawn = curves(&of.iter().collect::<Vec<_>>(), 0);
    if drawn.is_empty() {
        return "<svg xmlns=\"http://www.w3.org/2000/svg\"></svg>\n".to_owned();
    }
    let drawn = drawn.replacen("<svg ", "<svg xmlns=\"http://www.w3.org/2000/svg\" ", 1);
    drawn.replacen('>', &format!(">{style}"), 1) + "\n"
}

/// Training loss over optimiser steps, logarithmic; the first curve has colour `first`.
pub(super) fn curves(curves: &[&Curve], first: usize) -> String {
    let points = || curves.iter().flat_map(|curve| &curve.points);
    let drawable = || points().filter(|(_, loss)| loss.is_finite() && *loss > 0.0);
    let last = drawable().map(|(step, _)| *step).max().unwrap_or(1).max(1) as f64;
    let low = drawable().map(|(_, loss)| *loss).fold(f64::INFINITY, f64::min);
    let high = drawable().map(|(_, loss)| *loss).fold(0.0, f64::max);
    if !low.is_finite() {
        return String::new();
    }
    // whole decades around the values, at least one
    let (bottom, mut top) = (low.log10().floor(), high.log10().ceil());
    if top <= bottom {
        top = bottom + 1.0;
    }
    let (left, plot_height, legend) = (56.0, 230.0, 22.0 * curves.len() as f64);
    let height = plot_height + 34.0 + legend;
    let x_of = |step: u64| left + step as f64 / last * (WIDTH - left - 10.0);
    let y_of = |loss: f64| 8.0 + (top - loss.log10()) / (top - bottom) * (plot_height - 8.0);
    let mut svg = open(height, "Training loss");
    for decade in bottom as i32..=top as i32 {
        let value = 10f64.powi(decade);
        let y = y_of(value);
        let _ = write!(
            svg,
            r#"<line class="grid" x1="{left}" x2="{WIDTH}" y1="{y:.1}" y2="{y:.1}"/><text x="{:.1}" y="{:.1}" text-anchor="end">{value}</text>"#,
            left - 8.0,
            y + 4.0
        );
    }
    for quarter in 0..=4u32 {
        let step = (last * f64::from(quarter) / 4.0).round() as u64;
        let anchor = if quarter == 4 { "end" } else { "middle" };
        let _ = write!(
            svg,
            r#"<text x="{:.1}" y="{:.1}" text-anchor="{anchor}">{step}</text>"#,
            x_of(step),
            plot_height + 18.0
        );
    }
    for (index, curve) in curves.iter().enumerate() {
        let colour = COLOURS[(first + index) % COLOURS.len()];
        let drawn: Vec<(f64, f64)> = curve
            .points
            .iter()
            .filter(|(_, loss)| loss.is_finite() && *loss > 0.0)
            .map(|&(step, loss)| (x_of(step), y_of(loss)))
            .collect();
        let path: Vec<String> = thin(&drawn).iter().map(|(x, y)| format!("{x:.1},{y:.1}")).collect();
        let y = plot_height + 34.0 + 22.0 * (index as f64 + 0.5);
        let end = curve.points.last().map_or(String::new(), |(_, loss)| format!(" — {loss:.4} at the end"));
        let _ = write!(
            svg,
            r#"<polyline points="{}" fill="none" stroke="{colour}" stroke-width="1.8" stroke-linejoin="round"/><rect x="{left}" y="{:.1}" width="18" height="3" fill="{colour}"/><text x="{:.1}" y="{:.1}">{}{end}</text>"#,
            path.join(" "),
            y - 4.0,
            left + 26.0,
            y,
            escape(&curve.entry)
        );
    }
    svg.push_str("</svg>");
    svg
}

/// At most about 800 of a curve's points: the smallest and the largest of each stretch, so that a
/// spike stays visible.
fn thin(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let stretch = points.len().div_ceil(400).max(1);
    if stretch == 1 {
        return points.to_vec();
    }
    let mut kept = Vec::new();
    for part in points.chunks(stretch) {
        let by_loss = |a: &&(f64, f64), b: &&(f64, f64)| a.1.total_cmp(&b.1);
        let ends = [part.iter().min_by(by_loss), part.iter().max_by(by_loss)];
        let mut ends: Vec<(f64, f64)> = ends.into_iter().flatten().copied().collect();
        ends.sort_by(|a, b| a.0.total_cmp(&b.0));
        ends.dedup();
        kept.extend(ends);
    }
    kept
}

fn open(height: f64, title: &str) -> String {
    format!(
        r#"<svg viewBox="0 0 {WIDTH} {height:.0}" width="{WIDTH}" height="{height:.0}" role="img" aria-label="{title}">"#
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logarithmic_axes_have_round_labels_and_no_zeros() {
        let texts = |low, high| log_ticks(low, high).into_iter().map(cost_text).collect::<Vec<_>>();
        assert_eq!(texts(0.03, 0.3), ["0.05", "0.1", "0.2"]);
        assert_eq!(texts(0.04, 90.0), ["0.1", "1", "10"]);
        assert_eq!(texts(1.06e6, 1.87e6), ["1.06M", "1.87M"]);
        assert_eq!(texts(0.042, 0.042), ["0.042"]);
    }

    #[test]
    fn thinning_keeps_order_and_extremes() {
        let points: Vec<(f64, f64)> =
            (0..10_000).map(|i| (f64::from(i), if i == 6_789 { 99.0 } else { f64::from(i % 7) })).collect();
        let kept = thin(&points);
        assert!(kept.len() <= 800, "{}", kept.len());
        assert!(kept.windows(2).all(|pair| pair[0].0 < pair[1].0));
        assert!(kept.contains(&(6_789.0, 99.0)));
        assert_eq!(thin(&points[..300]), &points[..300]);
    }

    #[test]
    fn a_curve_without_a_drawable_point_is_no_picture() {
        let curve = Curve { entry: "a@1".into(), points: vec![(1, f64::NAN), (2, 0.0)] };
        assert_eq!(curves(&[&curve], 0), "");
    }
}
