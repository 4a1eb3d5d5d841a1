//! Tables as JSON: an object a row, keyed by the names of CSV.

use serde_json::{Map, Value};

use crate::column::{Column, Datum};

/// Every column that has a name in CSV; numbers as numbers, `null` where there is none.
pub fn rows<'r, R: 'static>(columns: &[Column<R>], rows: impl IntoIterator<Item = &'r R>) -> Vec<Value> {
    rows.into_iter().map(|row| Value::Object(object(columns, row))).collect()
}

/// One row.
pub fn object<R>(columns: &[Column<R>], row: &R) -> Map<String, Value> {
    let value = |column: &Column<R>| match column.datum(row) {
        Datum::Text(text) => Value::from(text),
        Datum::Number(number) => Value::from(number),
        Datum::Count(count) => Value::from(count),
        Datum::None => Value::Null,
    };
    columns.iter().filter_map(|column| Some((column.csv_name()?.to_owned(), value(column)))).collect()
}
