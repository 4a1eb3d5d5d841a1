//! What charts of all studies share: colours, and success rates with their intervals.

use std::fmt::Write as _;

use report::statistics::Estimate;

/// Colours of lines, which differ to the colour-blind as well.
pub(crate) const COLORS: [&str; 8] =
    ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#8a7f00"];

/// Points with their intervals, shares of one from left to right, under a head for each group of rows.
pub(crate) fn intervals(title: &str, groups: &[(String, Vec<(String, Estimate)>)]) -> String {
    let (left, width, line) = (430.0, 390.0, 19.0);
    let x = |share: f64| left + width * share;
    let lines = groups.iter().map(|(_, rows)| rows.len() + 1).sum::<usize>() as f64;
    let (bottom, title) = (40.0 + line * lines, escaped(title));
    let height = bottom + 30.0;
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 900 {height}\" width=\"900\" height=\"{height}\" role=\"img\" \
         aria-label=\"{title}\" font-family=\"sans-serif\" font-size=\"13\">\n<rect width=\"900\" height=\"{height}\" \
         fill=\"#ffffff\"/>\n<text x=\"12\" y=\"20\" font-weight=\"bold\">{title}</text>\n"
    );
    for share in [0.0, 0.25, 0.5, 0.75, 1.0] {
        let (at, below) = (x(share), bottom + 18.0);
        let _ = writeln!(
            svg,
            "<line x1=\"{at}\" x2=\"{at}\" y1=\"30\" y2=\"{bottom}\" stroke=\"#d8d8d8\"/><text x=\"{at}\" y=\"{below}\" \
             text-anchor=\"middle\">{:.0}%</text>",
            100.0 * share
        );
    }
    let mut at = 40.0;
    for (head, rows) in groups {
        let _ = writeln!(svg, "<text x=\"12\" y=\"{}\" font-weight=\"bold\">{}</text>", at + 4.0, escaped(head));
        at += line;
        for (label, Estimate { value, low, high }) in rows {
            let (color, text) = (COLORS[0], at + 4.0);
            let _ = writeln!(
                svg,
                "<text x=\"28\" y=\"{text}\">{}</text><line x1=\"{:.1}\" x2=\"{:.1}\" y1=\"{at}\" y2=\"{at}\" stroke=\"{color}\" \
                 stroke-width=\"3\"/><circle cx=\"{:.1}\" cy=\"{at}\" r=\"4.5\" fill=\"{color}\"/><text x=\"886\" y=\"{text}\" \
                 text-anchor=\"end\">{:.1}%</text>",
                escaped(label),
                x(*low),
                x(*high),
                x(*value),
                100.0 * value
            );
            at += line;
        }
    }
    svg.push_str("</svg>\n");
    svg
}

pub(crate) fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}
