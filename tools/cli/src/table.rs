//! Tables that fit the terminal.

use comfy_table::{Cell, CellAlignment, ContentArrangement, presets};

use crate::text::plain;

/// A column of a [`Table`].
#[derive(Debug, Clone)]
pub struct Column {
    name: String,
    right: bool,
    /// 0 stays; of the others the lowest are the first for which room is sought.
    dispensable: u8,
}

impl Column {
    /// A column that is always shown, aligned to the left.
    pub fn new(name: impl Into<String>) -> Self {
        Self { name: name.into(), right: false, dispensable: 0 }
    }

    /// Aligned to the right, for numbers.
    #[must_use]
    pub fn right(self) -> Self {
        Self { right: true, ..self }
    }

    /// Left out where the terminal is too narrow: room is sought for the lowest `rank` first; 0 is never left out.
    #[must_use]
    pub fn dispensable(self, rank: u8) -> Self {
        Self { dispensable: rank, ..self }
    }
}

/// Rows under named columns. A cell may have several lines.
#[derive(Debug, Clone)]
pub struct Table {
    columns: Vec<Column>,
    rows: Vec<Vec<String>>,
}

impl Table {
    /// Without rows.
    pub fn new(columns: Vec<Column>) -> Self {
        Self { columns, rows: Vec::new() }
    }

    /// One more row: a cell for each column.
    pub fn push(&mut self, row: Vec<String>) {
        self.rows.push(row);
    }

    /// The text: all columns where standard output is no terminal or `wide` is asked for, else as many as fit, and a
    /// line that says which ones did not.
    pub fn text(&self, wide: bool) -> String {
        // comfy-table knows a terminal's width, and of anything else that it has none
        let width = comfy_table::Table::new().width().map(usize::from);
        self.within(if wide { None } else { width })
    }

    /// The text in at most `width` columns of characters; without a limit, all of it.
    pub fn within(&self, width: Option<usize>) -> String {
        let all: Vec<usize> = (0..self.columns.len()).collect();
        let text = self.render(&all, None);
        let Some(width) = width.filter(|width| widest(&text) > *width) else { return text };
        let (mut kept, mut rest): (Vec<usize>, Vec<usize>) =
            all.into_iter().partition(|&i| self.columns[i].dispensable == 0);
        rest.sort_by_key(|&i| self.columns[i].dispensable);
        let mut out = Vec::new();
        for next in rest {
            let with: Vec<usize> = (0..self.columns.len()).filter(|i| *i == next || kept.contains(i)).collect();
            if widest(&self.render(&with, None)) <= width {
                kept = with;
            } else {
                out.push(next);
            }
        }
        let mut text = self.render(&kept, None);
        if widest(&text) > width {
            text = self.render(&kept, Some(width));
        }
        if !out.is_empty() {
            out.sort_unstable();
            let names: Vec<&str> = out.iter().map(|&i| self.columns[i].name.as_str()).collect();
            text.push_str(&fold(&format!("left out: {} (--wide shows all)", names.join(", ")), width));
        }
        text
    }

    fn render(&self, kept: &[usize], width: Option<usize>) -> String {
        let mut table = comfy_table::Table::new();
        table.load_style(presets::NOTHING);
        table.set_content_arrangement(match width {
            Some(_) => ContentArrangement::Dynamic,
            None => ContentArrangement::Disabled,
        });
        if let Some(width) = width {
            table.set_width(u16::try_from(width).unwrap_or(u16::MAX));
        }
        let cell = |column: &Column, text: &str| match column.right {
            true => Cell::new(plain(text)).set_alignment(CellAlignment::Right),
            false => Cell::new(plain(text)),
        };
        table.set_header(kept.iter().map(|&i| cell(&self.columns[i], &self.columns[i].name)));
        for row in &self.rows {
            table.add_row(kept.iter().map(|&i| cell(&self.columns[i], row.get(i).map_or("", String::as_str))));
        }
        let text = table.to_string();
        let mut lines = text.lines().map(|line| line.strip_prefix(' ').unwrap_or(line).trim_end());
        let line = "─".repeat(lines.clone().map(|line| line.chars().count()).max().unwrap_or(0));
        let mut out = format!("{}\n{line}\n", lines.next().unwrap_or_default());
        for line in lines {
            out.push_str(line);
            out.push('\n');
        }
        out
    }
}

/// A table whose columns are all shown, those in `right` aligned to the right; wraps where the terminal is narrow.
pub fn table(header: &[&str], rows: &[Vec<String>], right: &[usize]) -> String {
    let column = |(i, name): (usize, &&str)| match right.contains(&i) {
        true => Column::new(*name).right(),
        false => Column::new(*name),
    };
    Table { columns: header.iter().enumerate().map(column).collect(), rows: rows.to_vec() }.text(false)
}

fn widest(text: &str) -> usize {
    text.lines().map(|line| line.chars().count()).max().unwrap_or(0)
}

/// Words in lines of at most `width`.
fn fold(text: &str, width: usize) -> String {
    let mut out = String::new();
    let mut column = 0;
    for word in text.split(' ') {
        let length = word.chars().count();
        if column > 0 && column + 1 + length > width {
            out.push('\n');
            column = 0;
        } else if column > 0 {
            out.push(' ');
            column += 1;
        }
        out.push_str(word);
        column += length;
    }
    out.push('\n');
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> Table {
        let mut table = Table::new(vec![
            Column::new("entry"),
            Column::new("rate").right(),
            Column::new("return").right().dispensable(1),
            Column::new("seeds").dispensable(2),
        ]);
        table.push(["lift-act@1", "80%\nseen 9/10", "0.80", "10000-10019"].map(str::to_owned).to_vec());
        table.push(["stack@12", "100%", "1.00", "40000-40199"].map(str::to_owned).to_vec());
        table
    }

    #[test]
    fn what_is_dispensable_goes_in_its_order_and_is_named() {
        let all = sample().within(None);
        assert!(all.starts_with("entry") && all.contains("10000-10019") && all.contains("seen 9/10"), "{all}");
        assert_eq!(sample().within(Some(80)), all);
        for (width, gone, left) in [(40, "seeds", "return"), (25, "return", "rate")] {
            let text = sample().within(Some(width));
            assert!(widest(&text) <= width, "{width}:\n{text}");
            let head = text.lines().next().unwrap_or_default();
            assert!(!head.contains(gone) && head.contains(left), "{width}:\n{text}");
            assert!(text.contains("left out: ") && text.replace('\n', " ").contains("--wide"), "{text}");
        }
    }

    #[test]
    fn the_narrowest_table_wraps() {
        let text = sample().within(Some(16));
        assert!(widest(&text) <= 16, "{text}");
        assert!(text.contains("100%"), "{text}");
    }

    #[test]
    fn a_name_does_not_command_the_terminal() {
        let mut table = Table::new(vec![Column::new("a")]);
        table.push(vec!["\u{1b}[2Jx".to_owned()]);
        assert!(!table.within(None).contains('\u{1b}'));
    }
}
