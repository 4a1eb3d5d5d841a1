//! A statistic of a table: one value, and the forms of the table that show it.
//!
//! A table is a list of columns. Whatever writes one (terminal, CSV, Markdown, HTML) walks the same list, so that a
//! statistic is added in one place.

/// Which side of its column a value stands on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Align {
    /// Words.
    Left,
    /// Numbers.
    Right,
}

/// How a row gives a column's value.
enum Value<R: 'static> {
    /// As it is to be written. In tables for people, lines after the first say something beside it.
    Text(fn(&R) -> String),
    /// A number, where there is one, with its decimal places in CSV and in tables for people.
    Number(fn(&R) -> Option<f64>, usize, usize),
    /// A whole number, where there is one.
    Count(fn(&R) -> Option<u64>),
}

/// A value for machines that tell numbers from words.
#[derive(Debug, Clone, PartialEq)]
pub enum Datum {
    /// Words.
    Text(String),
    /// A number as CSV has it, rounded alike.
    Number(f64),
    /// A whole number.
    Count(u64),
    /// No value.
    None,
}

/// One statistic of rows of type `R`.
pub struct Column<R: 'static> {
    value: Value<R>,
    align: Align,
    kept: bool,
    more: bool,
    csv: Option<&'static str>,
    table: Option<&'static str>,
    page: Option<&'static str>,
}

/// A column in no form yet.
const fn column<R>(value: Value<R>) -> Column<R> {
    Column { value, align: Align::Right, kept: false, more: false, csv: None, table: None, page: None }
}

/// A column of words.
pub const fn text<R>(value: fn(&R) -> String) -> Column<R> {
    column(Value::Text(value))
}

/// A column of numbers: `exact` decimal places in CSV, `shown` in tables for people.
pub const fn number<R>(value: fn(&R) -> Option<f64>, exact: usize, shown: usize) -> Column<R> {
    column(Value::Number(value, exact, shown))
}

/// A column of whole numbers.
pub const fn count<R>(value: fn(&R) -> Option<u64>) -> Column<R> {
    column(Value::Count(value))
}

impl<R> Column<R> {
    /// In CSV, under this name.
    pub const fn csv(self, name: &'static str) -> Self {
        Self { csv: Some(name), ..self }
    }

    /// In the terminal and in Markdown, under this heading.
    pub const fn table(self, heading: &'static str) -> Self {
        Self { table: Some(heading), ..self }
    }

    /// In HTML, under this heading.
    pub const fn page(self, heading: &'static str) -> Self {
        Self { page: Some(heading), ..self }
    }

    /// Aligned to the left.
    pub const fn left(self) -> Self {
        Self { align: Align::Left, ..self }
    }

    /// Shown however narrow the terminal is.
    pub const fn kept(self) -> Self {
        Self { kept: true, ..self }
    }

    /// On a page behind the choice of columns, not shown at first.
    pub const fn more(self) -> Self {
        Self { more: true, ..self }
    }

    /// Whether a page shows it only where it is chosen.
    pub fn is_more(&self) -> bool {
        self.more
    }

    /// Whether it is shown however narrow the terminal is.
    pub fn is_kept(&self) -> bool {
        self.kept
    }

    /// The side that its values stand on.
    pub fn align(&self) -> Align {
        self.align
    }

    /// Its name in CSV, if it is there.
    pub fn csv_name(&self) -> Option<&'static str> {
        self.csv
    }

    /// Its heading in the terminal and in Markdown, if it is there.
    pub fn table_heading(&self) -> Option<&'static str> {
        self.table
    }

    /// Its heading in HTML, if it is there.
    pub fn page_heading(&self) -> Option<&'static str> {
        self.page
    }

    /// The row's value for machines; empty where there is none.
    pub fn exact(&self, row: &R) -> String {
        match self.value {
            Value::Text(of) => of(row),
            Value::Number(of, digits, _) => of(row).map_or(String::new(), |value| format!("{value:.digits$}")),
            Value::Count(of) => of(row).map_or(String::new(), |value| value.to_string()),
        }
    }

    /// The same as a number where it is one.
    pub fn datum(&self, row: &R) -> Datum {
        match self.value {
            Value::Text(of) => Datum::Text(of(row)),
            Value::Number(..) => self.exact(row).parse().map_or(Datum::None, Datum::Number),
            Value::Count(of) => of(row).map_or(Datum::None, Datum::Count),
        }
    }

    /// The row's value for people; `-` where there is none.
    pub fn shown(&self, row: &R) -> String {
        match self.value {
            Value::Text(of) => of(row),
            Value::Number(of, _, digits) => of(row).map_or("-".to_owned(), |value| format!("{value:.digits$}")),
            Value::Count(of) => of(row).map_or("-".to_owned(), |value| value.to_string()),
        }
    }
}

/// A table for a terminal: its headings with their sides, and its cells row by row.
pub struct Cells {
    /// The headings.
    pub headings: Vec<(&'static str, Align)>,
    /// The cells of each row.
    pub rows: Vec<Vec<String>>,
}

/// What a terminal shows of `rows`.
pub fn cells<'r, R: 'static>(columns: &[Column<R>], rows: impl IntoIterator<Item = &'r R>) -> Cells {
    let shown = || columns.iter().filter_map(|column| Some((column, column.table_heading()?)));
    Cells {
        headings: shown().map(|(column, heading)| (heading, column.align())).collect(),
        rows: rows.into_iter().map(|row| shown().map(|(column, _)| column.shown(row)).collect()).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{csv, html, json, markdown};

    const COLUMNS: &[Column<(&str, Option<f64>)>] = &[
        text(|row: &(&str, Option<f64>)| row.0.to_owned()).csv("name").table("who").page("who").left(),
        number(|row: &(&str, Option<f64>)| row.1, 3, 1).csv("value").table("value").page("value"),
        count(|row: &(&str, Option<f64>)| row.1.map(|_| 7)).csv("whole"),
        text(|_| "inner".to_owned()),
    ];

    /// One list, every form: nothing but the list says what there is.
    #[test]
    fn each_form_shows_what_the_list_says() {
        let rows = [("a|b", Some(1.25)), ("<c>, \"d\"\nmore", None)];
        assert_eq!(csv::table(COLUMNS, &rows), "name,value,whole\na|b,1.250,7\n\"<c>, \"\"d\"\"\nmore\",,\n");
        assert_eq!(
            markdown::table(COLUMNS, &rows),
            "| who | value |\n| --- | ---: |\n| a\\|b | 1.2 |\n| &lt;c>, \"d\"<br>more | - |\n"
        );
        let page = html::table(COLUMNS, &rows);
        assert!(
            page.contains("<tr><th scope=\"col\" class=\"words\">who</th><th scope=\"col\">value</th></tr>"),
            "{page}"
        );
        assert!(
            page.contains("<td class=\"words\">&lt;c&gt;, &quot;d&quot;<br><small>more</small></td><td>-</td>"),
            "{page}"
        );
        let json = json::rows(COLUMNS, &rows);
        assert_eq!(json[0], serde_json::json!({"name": "a|b", "value": 1.25, "whole": 7}));
        assert_eq!((&json[1]["value"], &json[1]["whole"]), (&serde_json::Value::Null, &serde_json::Value::Null));
        let cells = cells(COLUMNS, &rows);
        assert_eq!(cells.headings, [("who", Align::Left), ("value", Align::Right)]);
        assert_eq!(cells.rows[0], ["a|b", "1.2"]);
    }
}
