//! Tables as CSV: RFC 4180, with `\n` at the end of a line.

use csv_core::{Terminator, Writer, WriterBuilder};

use crate::column::Column;

/// Every column that has a name in CSV.
pub fn table<'r, R: 'static>(columns: &[Column<R>], rows: impl IntoIterator<Item = &'r R>) -> String {
    let named: Vec<(&Column<R>, &str)> = columns.iter().filter_map(|c| Some((c, c.csv_name()?))).collect();
    let mut writer = WriterBuilder::new().terminator(Terminator::Any(b'\n')).build();
    let mut out = Vec::new();
    line(&mut writer, named.iter().map(|(_, name)| (*name).to_owned()), &mut out);
    for row in rows {
        line(&mut writer, named.iter().map(|(column, _)| column.exact(row)), &mut out);
    }
    String::from_utf8(out).expect("text in, text out")
}

fn line(writer: &mut Writer, cells: impl Iterator<Item = String>, out: &mut Vec<u8>) {
    for (index, cell) in cells.enumerate() {
        // a cell of nothing but quotes is doubled and quoted; a delimiter closes the cell before it
        let mut buffer = vec![0; 2 * cell.len() + 4];
        let mut end = 0;
        if index > 0 {
            end = writer.delimiter(&mut buffer).1;
        }
        end += writer.field(cell.as_bytes(), &mut buffer[end..]).2;
        out.extend_from_slice(&buffer[..end]);
    }
    let mut buffer = [0; 4];
    let end = writer.terminator(&mut buffer).1;
    out.extend_from_slice(&buffer[..end]);
}
