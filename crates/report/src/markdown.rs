//! Tables as Markdown.

use crate::column::{Align, Column, cells};

/// Names come from files of anybody: what Markdown or HTML would take for its own is escaped, and control characters are left out.
fn escaped(cell: &str) -> String {
    let plain: String = cell.chars().filter(|c| *c == '\n' || !c.is_control()).collect();
    plain.replace('&', "&amp;").replace('<', "&lt;").replace('|', "\\|").replace('\n', "<br>")
}

/// Every column that terminals show.
pub fn table<'r, R: 'static>(columns: &[Column<R>], rows: impl IntoIterator<Item = &'r R>) -> String {
    let line = |cells: &[String]| {
        let escaped: Vec<String> = cells.iter().map(|cell| escaped(cell)).collect();
        format!("| {} |\n", escaped.join(" | "))
    };
    let cells = cells(columns, rows);
    let mut text = line(&cells.headings.iter().map(|(heading, _)| (*heading).to_owned()).collect::<Vec<_>>());
    let rules = cells.headings.iter().map(|(_, align)| if *align == Align::Left { "---" } else { "---:" });
    text.push_str(&format!("| {} |\n", rules.collect::<Vec<_>>().join(" | ")));
    cells.rows.iter().for_each(|row| text.push_str(&line(row)));
    text
}
