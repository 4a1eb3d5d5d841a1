//! A data set as one HTML page with everything in it, for a reader who has nothing but a browser.
//!
//! Numbers are embedded as little-endian `f32` in base64 and drawn when an episode is opened; without scripts the summary,
//! the histograms and the list of episodes are there.

mod read;

pub use read::{Drawn, Episode, Opened, pictures};

use crate::svg::{self, Content, escape};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use std::fmt::Write as _;

/// What every page begins with, by which it is known again.
pub const BEGINNING: &str = "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n<meta name=\"generator\" content=\"actrm-data view\">\n";

/// What the page says above its episodes.
#[derive(Default)]
pub struct Head {
    pub title: String,
    /// A line each: what, and how much of it.
    pub facts: Vec<(String, String)>,
    /// Name, type, shape, range or codec.
    pub features: Vec<[String; 4]>,
    pub notes: Vec<String>,
    pub problems: Vec<String>,
}

/// The page while its episodes come in.
pub struct Page {
    columns: Vec<Drawn>,
    cameras: Vec<String>,
    /// Points of a curve at most.
    points: usize,
    /// Bytes of the page at most, as far as curves and pictures decide.
    limit: usize,
    rows: String,
    data: String,
    lengths: Vec<f32>,
    /// Every value of each dimension of the first column, the actions.
    actions: Vec<Vec<f32>>,
    /// The smallest and the largest value of each column.
    ranges: Vec<Option<(f32, f32)>>,
    /// Episodes that were told of.
    count: usize,
    /// The first episode without curves, once the page is full.
    full: Option<usize>,
    thinned: bool,
}

impl Page {
    pub fn new(columns: Vec<Drawn>, cameras: Vec<String>, points: usize, limit: usize) -> Self {
        let actions = columns.first().map_or(0, |column| column.names.len());
        Self {
            ranges: vec![None; columns.len()],
            columns,
            cameras,
            points: points.max(2),
            limit,
            rows: String::new(),
            data: String::new(),
            lengths: Vec::new(),
            actions: vec![Vec::new(); actions],
            count: 0,
            full: None,
            thinned: false,
        }
    }

    /// The columns that are drawn.
    pub fn columns(&self) -> &[Drawn] {
        &self.columns
    }

    /// Whether another episode's curves and pictures have a place.
    pub fn has_room(&self) -> bool {
        self.full.is_none()
    }

    /// The next episode; `pictures` are the frames chosen and, for each camera, a PNG file of each.
    pub fn push(&mut self, episode: &Episode, frames: &[usize], pictures: &[Vec<Vec<u8>>]) {
        let number = self.count;
        self.count += 1;
        self.lengths.push(episode.length as f32);
        let dim = self.actions.len();
        if let Some(values) = episode.columns.first().filter(|_| dim > 0) {
            for (d, all) in self.actions.iter_mut().enumerate() {
                all.extend(values.iter().skip(d).step_by(dim));
            }
        }
        for (range, values) in self.ranges.iter_mut().zip(&episode.columns) {
            for &value in values.iter().filter(|value| value.is_finite()) {
                let (low, high) = range.unwrap_or((value, value));
                *range = Some((low.min(value), high.max(value)));
            }
        }
        let stride = episode.length.div_ceil(self.points).max(1);
        self.thinned |= stride > 1;
        let mut data =
            format!("<script type=\"application/json\" id=\"data-{number}\">{{\"stride\":{stride},\"curves\":[");
        for (at, (column, values)) in self.columns.iter().zip(&episode.columns).enumerate() {
            let rows = values.chunks_exact(column.names.len().max(1)).step_by(stride);
            let bytes: Vec<u8> = rows.flatten().flat_map(|v| v.to_le_bytes()).collect();
            let _ = write!(data, "{}\"{}\"", if at > 0 { "," } else { "" }, STANDARD.encode(&bytes));
        }
        let _ = write!(data, "],\"frames\":{frames:?},\"pictures\":[");
        for (at, camera) in pictures.iter().enumerate() {
            let files: Vec<String> = camera.iter().map(|file| format!("\"{}\"", STANDARD.encode(file))).collect();
            let _ = write!(data, "{}[{}]", if at > 0 { "," } else { "" }, files.join(","));
        }
        data.push_str("]}</script>\n");
        if self.full.is_none() && self.data.len() + self.rows.len() + data.len() > self.limit {
            self.full = Some(number);
        }
        let inside = match self.full {
            None => {
                self.data.push_str(&data);
                "<p class=\"wait\">Curves and images are drawn by a script.</p>"
            }
            Some(_) => "<p class=\"wait\">Left out: the page would be larger than its limit.</p>",
        };
        self.rows.push_str(&row(number, episode, inside));
    }

    /// The page.
    pub fn html(&self, head: &Head) -> String {
        let mut notes = head.notes.clone();
        if let Some(first) = self.full {
            notes.push(format!(
                "episodes from {first} on are listed without curves and images: the page would be larger than {} (--limit)",
                cli::bytes(self.limit as u64)
            ));
        }
        if self.thinned {
            notes.push(format!(
                "curves of episodes longer than {} steps show every n-th step only (--points)",
                self.points
            ));
        }
        let mut html = String::from(BEGINNING);
        html.push_str(
            "<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n<link rel=\"icon\" href=\"data:,\">\n",
        );
        let title = escape(&head.title);
        let style = [include_str!("../../../../crates/report/src/style.css"), include_str!("page.css")].concat();
        let _ = write!(
            html,
            "<title>{title}</title>\n<style>\n{style}</style>\n</head>\n<body>\n<main>\n<h1>{title}</h1>\n"
        );
        html.push_str("<div class=\"card\"><dl>");
        for (what, value) in &head.facts {
            let _ = write!(html, "<dt>{}</dt><dd>{}</dd>", escape(what), escape(value));
        }
        html.push_str("</dl></div>\n");
        html.push_str(&list("Problems", "problems", &head.problems));
        html.push_str(&list("Notes", "notes", &notes));
        html.push_str("<h2>Features</h2>\n<div class=\"card\" role=\"region\" aria-label=\"Features\" tabindex=\"0\"><table id=\"features\"><thead><tr>");
        for heading in ["feature", "type", "shape of a step", "range or codec"] {
            let _ = write!(html, "<th scope=\"col\">{heading}</th>");
        }
        html.push_str("</tr></thead><tbody>\n");
        for feature in &head.features {
            let [name, kind, shape, range] = feature;
            let range = match self.columns.iter().position(|column| column.name == *name).and_then(|at| self.ranges[at])
            {
                Some((low, high)) if range.is_empty() => {
                    format!("{} to {}", cli::number(f64::from(low)), cli::number(f64::from(high)))
                }
                _ => range.clone(),
            };
            let cells: String =
                [name, kind, shape, &range].iter().map(|cell| format!("<td>{}</td>", escape(cell))).collect();
            let _ = writeln!(html, "<tr>{cells}</tr>");
        }
        html.push_str("</tbody></table></div>\n<h2>Distributions</h2>\n<p class=\"lead\">Lengths of the episodes, and every dimension of the actions over all readable frames. The dimensions share an axis.</p>\n<div class=\"card charts\">");
        html.push_str(&histogram("length of an episode, steps", &Content::Histogram(&self.lengths)));
        if let Some(column) = self.columns.first() {
            for (name, values) in column.names.iter().zip(&self.actions) {
                let content = match self.ranges[0] {
                    Some(range) => Content::HistogramWithin(values, range),
                    None => Content::Histogram(values),
                };
                html.push_str(&histogram(&format!("{}: {name}", column.name), &content));
            }
        }
        html.push_str("</div>\n");
        let _ = write!(
            html,
            "<h2>Episodes</h2>\n<form class=\"tools\" role=\"search\"><label>find <input id=\"find\" type=\"search\" placeholder=\"demo, task\"></label>\
             <label>order <select id=\"order\"><option value=\"number\">number</option><option value=\"length\">length</option>\
             <option value=\"reward\">return</option></select></label><label><input id=\"own\" type=\"checkbox\"> an axis for each \
             curve</label><span id=\"shown\" aria-live=\"polite\">{} episodes</span></form>\n\
             <div id=\"episodes\">\n{}</div>\n",
            self.count, self.rows
        );
        let columns: Vec<_> = self
            .columns
            .iter()
            .zip(&self.ranges)
            .map(|(c, range)| serde_json::json!({"name": c.name, "names": c.names, "range": range}))
            .collect();
        let described = serde_json::json!({
            "columns": columns, "cameras": self.cameras, "width": svg::WIDTH, "height": svg::HEIGHT, "margin": svg::MARGIN,
        });
        let described = described.to_string().replace('<', "\\u003c");
        let _ = write!(
            html,
            "<footer>Made by <code>actrm-data view</code> {}; nothing here is loaded from elsewhere.</footer>\n</main>\n\
             <script type=\"application/json\" id=\"described\">{described}</script>\n{}<script>\n{}</script>\n</body>\n</html>\n",
            env!("CARGO_PKG_VERSION"),
            self.data,
            include_str!("page.js")
        );
        html
    }
}

fn row(number: usize, episode: &Episode, inside: &str) -> String {
    let mut said = vec![format!("{} steps", episode.length)];
    said.extend(episode.total_reward.map(|total| format!("return {}", cli::number(total))));
    said.extend(episode.success.map(|yes| if yes { "success".to_owned() } else { "no success".to_owned() }));
    if !episode.problems.is_empty() {
        said.push(format!("problems: {}", episode.problems.len()));
    }
    let name = match episode.name.is_empty() {
        true => format!("episode {number}"),
        false => format!("{number} · {}", episode.name),
    };
    let task = if episode.task.is_empty() { String::new() } else { format!(" · {}", episode.task) };
    let problems: String = episode.problems.iter().map(|p| format!("<p class=\"bad\">{}</p>", escape(p))).collect();
    format!(
        "<details class=\"card episode\" id=\"episode-{number}\" data-length=\"{}\" data-reward=\"{}\"><summary>{} \
         <small>{}{}</small></summary>{problems}{inside}</details>\n",
        episode.length,
        episode.total_reward.map_or_else(String::new, |total| total.to_string()),
        escape(&name),
        escape(&said.join(" · ")),
        escape(&task)
    )
}

fn list(heading: &str, id: &str, items: &[String]) -> String {
    if items.is_empty() {
        return if id == "problems" { "<p id=\"problems\">No problems found.</p>\n".to_owned() } else { String::new() };
    }
    let items: String = items.iter().map(|item| format!("<li>{}</li>", escape(item))).collect();
    format!("<h2>{heading}</h2>\n<ul id=\"{id}\">{items}</ul>\n")
}

fn histogram(title: &str, content: &Content<'_>) -> String {
    let (width, height) = svg::SIZE;
    let chart = svg::chart(0.0, 0.0, title, content);
    format!(
        "<svg viewBox=\"0 0 {width} {height}\" width=\"{width}\" height=\"{height}\" role=\"img\" aria-label=\"{}\">{chart}</svg>\n",
        escape(title)
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn episode(name: &str, length: usize) -> Episode {
        let columns = vec![(0..2 * length).map(|i| i as f32).collect()];
        let (task, total_reward) = ("<lift>".to_owned(), Some(1.5));
        Episode {
            name: name.to_owned(),
            length,
            task,
            total_reward,
            success: Some(true),
            problems: Vec::new(),
            columns,
        }
    }

    fn page(points: usize, limit: usize) -> String {
        let drawn = Drawn { name: "action".to_owned(), names: vec!["x".to_owned(), "</script>".to_owned()] };
        let mut page = Page::new(vec![drawn], vec!["front".to_owned()], points, limit);
        page.push(&episode("demo_0", 10), &[0, 9], &[vec![b"one".to_vec(), b"two".to_vec()]]);
        page.push(&episode("demo_1", 3), &[], &[]);
        let features = ["action", "other"].map(|name| [name, "float32", "2", ""].map(str::to_owned)).to_vec();
        page.html(&Head { title: "a & b".to_owned(), features, ..Head::default() })
    }

    #[test]
    fn a_page_holds_its_episodes_and_nothing_from_elsewhere() {
        let html = page(100, 1 << 20);
        assert!(html.contains("<td>action</td><td>float32</td><td>2</td><td>0 to 19</td>"), "{html}");
        assert!(
            html.contains("<td>other</td><td>float32</td><td>2</td><td></td>") && html.contains("\"range\":[0.0,19.0]")
        );
        assert!(html.contains("<title>a &amp; b</title>") && html.contains("No problems found."));
        assert!(html.contains("0 · demo_0 <small>10 steps · return 1.5 · success · &lt;lift&gt;</small>"), "{html}");
        let floats: Vec<u8> = (0..6).flat_map(|i| (i as f32).to_le_bytes()).collect();
        assert!(html.contains(&format!(
            "{{\"stride\":1,\"curves\":[\"{}\"],\"frames\":[],\"pictures\":[]}}",
            STANDARD.encode(&floats)
        )));
        assert!(html.contains("\"frames\":[0, 9],\"pictures\":[[\"b25l\",\"dHdv\"]]"));
        assert_eq!(html.matches("</script>").count(), html.matches("<script").count());
        assert!(!html.contains("http://") && !html.contains("https://") && !html.contains("--points"));
    }

    #[test]
    fn what_is_thinned_or_left_out_is_said() {
        let html = page(4, 1 << 20);
        assert!(html.contains("\"stride\":3") && html.contains("longer than 4 steps show every n-th step only"));
        let html = page(100, 10);
        assert!(html.contains("episodes from 0 on are listed without curves") && !html.contains("id=\"data-0\""));
        assert_eq!(html.matches("<details").count(), 2);
    }
}
