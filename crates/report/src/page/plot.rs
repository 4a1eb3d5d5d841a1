//! What the charts of success rates share: a frame from 0 to 100%, marks with intervals, and a legend.
//!
//! They are as wide as there is room, down to a telephone; the style sheet keeps their text readable there.

use std::fmt::Write as _;

use crate::html::escape;
use crate::leaderboard::LeaderboardRow;

/// Colours of lines, in order, readable on light and dark ground.
pub(crate) const COLOURS: [&str; 8] =
    ["#2f62c8", "#d9772b", "#1f8f5f", "#a14fb8", "#c8452f", "#128c9c", "#8a7a1f", "#6b7480"];

/// Dashes of lines, in order: two lines that a reader sees in one colour differ in them.
const DASHES: [&str; 4] = ["", "8 4", "2 3", "10 3 2 3"];

const WIDTH: f64 = 560.0;
const LEFT: f64 = 58.0;
const RIGHT: f64 = 540.0;
const TOP: f64 = 14.0;
const BOTTOM: f64 = 214.0;

/// The colour of each kind of policy, the same in every chart of a page. Floors and ceilings are grey.
pub(crate) struct Palette(Vec<String>);

impl Palette {
    pub(crate) fn of(rows: &[LeaderboardRow]) -> Self {
        let learned = rows.iter().filter(|row| row.bound().is_none());
        let mut policies: Vec<String> = learned.map(|row| row.policy().to_owned()).collect();
        policies.sort();
        policies.dedup();
        Self(policies)
    }

    /// The place of a row's colour in [`COLOURS`].
    pub(crate) fn index(&self, row: &LeaderboardRow) -> usize {
        let grey = COLOURS.len() - 1;
        self.0.binary_search_by(|policy| policy.as_str().cmp(row.policy())).map_or(grey, |at| at % grey)
    }

    pub(crate) fn colour(&self, row: &LeaderboardRow) -> &'static str {
        COLOURS[self.index(row)]
    }
}

/// Colour and dash of a line, as attributes.
fn stroke(colour: usize, dash: usize) -> String {
    let dash = DASHES[dash % DASHES.len()];
    let dash = if dash.is_empty() { String::new() } else { format!(" stroke-dasharray=\"{dash}\"") };
    format!("stroke=\"{}\"{dash}", COLOURS[colour % COLOURS.len()])
}

/// A chart under way: success from bottom to top over something from left to right.
pub(super) struct Plot {
    svg: String,
}

impl Plot {
    /// An empty frame that says `title` to those who do not see it.
    pub(super) fn new(title: &str) -> Self {
        let height = BOTTOM + 62.0;
        let title = escape(title);
        let mut svg = format!("<svg viewBox=\"0 0 {WIDTH} {height}\" role=\"img\" aria-label=\"{title}\">");
        for percent in [0, 25, 50, 75, 100] {
            let y = Self::y(f64::from(percent) / 1e2);
            let _ = write!(svg, r#"<line class="grid" x1="{LEFT}" x2="{RIGHT}" y1="{y:.1}" y2="{y:.1}"/>"#);
            if percent % 50 == 0 {
                let at = LEFT - 8.0;
                let _ = write!(svg, r#"<text x="{at}" y="{:.1}" text-anchor="end">{percent}%</text>"#, y + 4.0);
            }
        }
        Self { svg }
    }

    /// Where a share of the width lies.
    pub(super) fn x(share: f64) -> f64 {
        LEFT + share * (RIGHT - LEFT)
    }

    /// Where a success rate lies.
    pub(super) fn y(rate: f64) -> f64 {
        BOTTOM - rate * (BOTTOM - TOP)
    }

    /// One or two lines of text below the frame.
    pub(super) fn tick(&mut self, share: f64, lines: [&str; 2]) {
        let x = Self::x(share);
        for (line, text) in lines.into_iter().enumerate().filter(|(_, text)| !text.is_empty()) {
            let y = BOTTOM + 20.0 + 20.0 * line as f64;
            let _ = write!(self.svg, r#"<text x="{x:.1}" y="{y}" text-anchor="middle">{}</text>"#, escape(text));
        }
    }

    /// What the ticks are of, below them.
    pub(super) fn axis(&mut self, text: &str) {
        let (x, y) = (Self::x(0.5), BOTTOM + 58.0);
        let _ = write!(self.svg, r#"<text class="label" x="{x}" y="{y}" text-anchor="middle">{}</text>"#, escape(text));
    }

    /// A line of a colour and a dash through points, as SVG's path has them.
    pub(super) fn line(&mut self, colour: usize, dash: usize, path: &str, title: &str) {
        let _ = write!(
            self.svg,
            r#"<path d="{path}" fill="none" {} stroke-width="2" stroke-linejoin="round"><title>{}</title></path>"#,
            stroke(colour, dash),
            escape(title)
        );
    }

    /// A point of a colour with its interval.
    pub(super) fn point(&mut self, colour: usize, x: f64, rate: f64, (low, high): (f64, f64), title: &str) {
        let colour = COLOURS[colour % COLOURS.len()];
        let (y, from, to) = (Self::y(rate), Self::y(low), Self::y(high));
        let _ = write!(
            self.svg,
            r#"<g><title>{}</title><line x1="{x:.1}" x2="{x:.1}" y1="{from:.1}" y2="{to:.1}" stroke="{colour}" stroke-width="1.5"/><circle cx="{x:.1}" cy="{y:.1}" r="4.5" fill="{colour}"/></g>"#,
            escape(title)
        );
    }

    /// The chart and its legend: the colour of each line in order, its name and what else is to be said of it.
    pub(super) fn finish(mut self, legend: &[(usize, String, String)]) -> String {
        self.svg.push_str("</svg>");
        let mut html = format!("<figure class=\"lines\">{}", self.svg);
        if !legend.is_empty() {
            html.push_str("<figcaption><ul class=\"legend\">");
        }
        for (dash, (colour, name, said)) in legend.iter().enumerate() {
            let _ = write!(
                html,
                "<li><svg width=\"28\" height=\"8\" aria-hidden=\"true\"><line x1=\"0\" x2=\"28\" y1=\"4\" y2=\"4\" {} \
                 stroke-width=\"3\"/></svg>{} <small>{}</small></li>",
                stroke(*colour, dash),
                escape(name),
                escape(said)
            );
        }
        if !legend.is_empty() {
            html.push_str("</ul></figcaption>");
        }
        html.push_str("</figure>\n");
        html
    }
}
