//! Charts as SVG text: lines over steps and histograms. No script, no font, no colour that print would lose.

use std::fmt::Write;

/// Inner size of a chart in pixels.
pub const WIDTH: f64 = 420.0;
pub const HEIGHT: f64 = 120.0;
/// Room for labels: left, top, right, bottom.
pub const MARGIN: (f64, f64, f64, f64) = (58.0, 22.0, 10.0, 26.0);

/// Room that one chart takes.
pub const SIZE: (f64, f64) = (WIDTH + MARGIN.0 + MARGIN.2, HEIGHT + MARGIN.1 + MARGIN.3);

/// What a chart shows.
pub enum Content<'a> {
    /// A value a step.
    Line(&'a [f32]),
    /// How often values occur, in even bins between the extremes.
    Histogram(&'a [f32]),
    /// The same between two bounds that hold every value.
    HistogramWithin(&'a [f32], (f32, f32)),
}

/// A chart in a group at `(x, y)`.
pub fn chart(x: f64, y: f64, title: &str, content: &Content<'_>) -> String {
    let mut out = format!("<g transform=\"translate({:.1},{:.1})\">\n", x + MARGIN.0, y + MARGIN.1);
    let _ = writeln!(out, "<text x=\"0\" y=\"-8\" class=\"title\">{}</text>", escape(title));
    let _ = writeln!(out, "<rect width=\"{WIDTH}\" height=\"{HEIGHT}\" class=\"frame\"/>");
    match content {
        Content::Line(values) => line(&mut out, values),
        Content::Histogram(values) => histogram(&mut out, values, extremes(values)),
        Content::HistogramWithin(values, (low, high)) => {
            histogram(&mut out, values, (f64::from(*low), f64::from(*high)));
        }
    }
    out.push_str("</g>\n");
    out
}

/// A whole picture of charts in `columns` columns, with a heading.
pub fn page(heading: &str, charts: &[(String, Content<'_>)], columns: usize) -> String {
    let rows = charts.len().div_ceil(columns);
    let (width, height) = (SIZE.0 * columns as f64, SIZE.1 * rows as f64 + 30.0);
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width:.0} {height:.0}\" width=\"{width:.0}\" height=\"{height:.0}\">\n{STYLE}"
    );
    let _ = writeln!(out, "<rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>");
    let _ = writeln!(out, "<text x=\"8\" y=\"20\" class=\"heading\">{}</text>", escape(heading));
    for (i, (title, content)) in charts.iter().enumerate() {
        let (column, row) = (i % columns, i / columns);
        out.push_str(&chart(column as f64 * SIZE.0, row as f64 * SIZE.1 + 30.0, title, content));
    }
    out.push_str("</svg>\n");
    out
}

const STYLE: &str = "<style>
text { font: 11px sans-serif; fill: #333 }
.title { font-weight: bold }
.heading { font-size: 15px; font-weight: bold }
.frame { fill: none; stroke: #bbb }
.line { fill: none; stroke: #1f5fa8; stroke-width: 1.2 }
.bar { fill: #1f5fa8; fill-opacity: 0.75 }
</style>
";

fn extremes(values: &[f32]) -> (f64, f64) {
    let finite = || values.iter().filter(|v| v.is_finite()).map(|&v| f64::from(v));
    let low = finite().fold(f64::INFINITY, f64::min);
    let high = finite().fold(f64::NEG_INFINITY, f64::max);
    if low > high { (0.0, 1.0) } else { (low, high) }
}

fn label(out: &mut String, x: f64, y: f64, anchor: &str, text: &str) {
    let _ = writeln!(out, "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\">{}</text>", escape(text));
}

fn line(out: &mut String, values: &[f32]) {
    let (low, high) = extremes(values);
    let span = if high > low { high - low } else { 1.0 };
    let step = WIDTH / (values.len().max(2) - 1) as f64;
    let mut path = String::new();
    let mut pen_down = false;
    for (i, &v) in values.iter().enumerate() {
        // a value that is no number leaves a gap
        if v.is_finite() {
            let y = if high > low { HEIGHT - (f64::from(v) - low) / span * HEIGHT } else { HEIGHT / 2.0 };
            let _ = write!(path, "{}{:.1},{y:.1}", if pen_down { "L" } else { "M" }, i as f64 * step);
        }
        pen_down = v.is_finite();
    }
    let _ = writeln!(out, "<path class=\"line\" d=\"{path}\"/>");
    label(out, -4.0, 9.0, "end", &cli::number(high));
    label(out, -4.0, HEIGHT, "end", &cli::number(low));
    label(out, 0.0, HEIGHT + 14.0, "start", "0");
    label(out, WIDTH, HEIGHT + 14.0, "end", &values.len().saturating_sub(1).to_string());
}

fn histogram(out: &mut String, values: &[f32], (low, high): (f64, f64)) {
    const BINS: usize = 60;
    let span = if high > low { high - low } else { 1.0 };
    let mut counts = [0_usize; BINS];
    for v in values.iter().filter(|v| v.is_finite()) {
        let bin = ((f64::from(*v) - low) / span * BINS as f64) as usize;
        counts[bin.min(BINS - 1)] += 1;
    }
    let most = counts.iter().copied().max().unwrap_or(1).max(1);
    let width = WIDTH / BINS as f64;
    for (i, &count) in counts.iter().enumerate().filter(|(_, c)| **c > 0) {
        let height = count as f64 / most as f64 * HEIGHT;
        let (x, y) = (i as f64 * width, HEIGHT - height);
        let _ = writeln!(
            out,
            "<rect class=\"bar\" x=\"{x:.1}\" y=\"{y:.1}\" width=\"{width:.1}\" height=\"{height:.1}\"/>"
        );
    }
    label(out, -4.0, 9.0, "end", &most.to_string());
    label(out, 0.0, HEIGHT + 14.0, "start", &cli::number(low));
    label(out, WIDTH, HEIGHT + 14.0, "end", &cli::number(high));
}

/// Text inside markup.
pub fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn charts_hold_every_value_and_survive_odd_ones() {
        let values = [0.0, 1.0, f32::NAN, 0.5, f32::INFINITY];
        let text = chart(0.0, 0.0, "a < b", &Content::Line(&values));
        assert!(text.contains("a &lt; b"));
        assert_eq!(text.matches('M').count(), 2, "a gap where there is no number: {text}");
        let bars = chart(0.0, 0.0, "h", &Content::Histogram(&[1.0, 1.0, 2.0]));
        assert_eq!(bars.matches("class=\"bar\"").count(), 2);
        let within = chart(0.0, 0.0, "h", &Content::HistogramWithin(&[1.0, 1.0, 2.0], (0.0, 4.0)));
        assert!(
            within.contains("x=\"105.0\"") && within.contains("x=\"210.0\"") && within.contains(">4</text>"),
            "{within}"
        );
        for empty in [&[][..], &[f32::NAN][..], &[3.0][..]] {
            let page = page("x", &[("l".into(), Content::Line(empty)), ("h".into(), Content::Histogram(empty))], 2);
            assert!(!page.contains("NaN") && !page.contains("inf\""), "{page}");
        }
    }
}
