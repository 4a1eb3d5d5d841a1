//! Tables as HTML, and text made safe for it.

use crate::column::{Align, Column};

/// Every column that pages show; the lines of a cell after its first are small.
pub fn table<'r, R: 'static>(columns: &[Column<R>], rows: impl IntoIterator<Item = &'r R>) -> String {
    table_of(columns, rows, "", &|_| String::new())
}

/// The same with a name, and with attributes for each row's element, which are HTML already.
pub fn table_of<'r, R: 'static>(
    columns: &[Column<R>],
    rows: impl IntoIterator<Item = &'r R>,
    id: &str,
    attributes: &dyn Fn(&R) -> String,
) -> String {
    let shown: Vec<(&Column<R>, &str)> = columns.iter().filter_map(|c| Some((c, c.page_heading()?))).collect();
    let id = if id.is_empty() { String::new() } else { format!(" id=\"{}\"", escape(id)) };
    let mut html = format!("<table{id}><thead><tr>");
    let words = |column: &Column<R>| if column.align() == Align::Left { " class=\"words\"" } else { "" };
    shown.iter().for_each(|(column, heading)| {
        let more = if column.is_more() { " data-more" } else { "" };
        let heading = escape(heading).replace('\n', "<br>");
        html.push_str(&format!("<th scope=\"col\"{}{more}>{heading}</th>", words(column)));
    });
    html.push_str("</tr></thead><tbody>\n");
    for row in rows {
        html.push_str(&format!("<tr{}>", attributes(row)));
        shown.iter().for_each(|(column, _)| {
            html.push_str(&format!("<td{}>{}</td>", words(column), cell(&column.shown(row))));
        });
        html.push_str("</tr>\n");
    }
    html.push_str("</tbody></table>");
    html
}

fn cell(text: &str) -> String {
    let mut lines = text.lines();
    let mut html = escape(lines.next().unwrap_or_default());
    lines.for_each(|line| html.push_str(&format!("<br><small>{}</small>", escape(line))));
    html
}

/// Text as HTML.
pub fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            other => out.push(other),
        }
    }
    out
}
