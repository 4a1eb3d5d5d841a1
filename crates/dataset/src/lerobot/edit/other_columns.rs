//! Columns of the table of episodes that other programs added: what they say of an episode goes with it.

use super::super::open::Dataset;
use super::super::read;
use super::Edit;
use crate::error::{DatasetError, Result};
use arrow_array::{Array, ArrayRef, UInt64Array, new_null_array};
use arrow_schema::{DataType, Field};
use arrow_select::concat::concat;
use arrow_select::take::take;
use std::path::Path;

/// Columns with their fields, and how many rows they have.
type Table = (usize, Vec<(Field, ArrayRef)>);

/// Whether a column of the table of episodes is the format's own.
pub(in crate::lerobot) fn is_own(name: &str) -> bool {
    ["episode_index", "tasks", "length", "dataset_from_index", "dataset_to_index"].contains(&name)
        || ["stats/", "videos/", "data/", "meta/"].iter().any(|prefix| name.starts_with(prefix))
}

/// Those that any input has, of the episodes taken; null where an input lacks them.
pub(super) fn columns(edit: &Edit<'_>, notes: &mut Vec<String>) -> Result<Vec<(Field, ArrayRef)>> {
    let of = edit.inputs.iter().zip(&edit.taken).map(|(input, taken)| of_episodes(&input.set, taken, notes));
    let each = of.collect::<Result<Vec<_>>>()?;
    Ok(joined(edit.root, &each, notes)?.1)
}

fn of_episodes(set: &Dataset, taken: &[usize], notes: &mut Vec<String>) -> Result<Table> {
    let files = read::files(set.root(), "meta/episodes")?;
    let each = files.iter().map(|path| of_file(path)).collect::<Result<Vec<_>>>()?;
    let (rows, columns) = joined(set.root(), &each, notes)?;
    let row = |&episode: &usize| Some(set.table_row(episode)).filter(|&row| row < rows).map(|row| row as u64);
    let chosen: UInt64Array = taken.iter().map(row).collect();
    let of_taken = columns.into_iter().map(|(field, array)| {
        let array = take(&array, &chosen, None).map_err(|source| failed(set.root(), source))?;
        Ok((field, array))
    });
    Ok((taken.len(), of_taken.collect::<Result<Vec<_>>>()?))
}

fn of_file(path: &Path) -> Result<Table> {
    let builder = read::open(path)?;
    let others = builder.schema().fields().iter().filter(|field| !is_own(field.name()));
    let fields: Vec<Field> = others.map(|f| Field::new(f.name(), f.data_type().clone(), true)).collect();
    let names: Vec<&str> = fields.iter().map(|field| field.name().as_str()).collect();
    let rows = read::columns_there(path, &[])?.0;
    let arrays = if rows == 0 { Vec::new() } else { read::columns(path, &names)?.1 };
    Ok((rows, fields.into_iter().zip(arrays).collect()))
}

/// Tables one after the other. A column that has another type in another table is left out and named.
fn joined(root: &Path, tables: &[Table], notes: &mut Vec<String>) -> Result<Table> {
    let mut fields: Vec<&Field> = Vec::new();
    for (field, _) in tables.iter().flat_map(|(_, columns)| columns) {
        match fields.iter_mut().find(|known| known.name() == field.name()) {
            None => fields.push(field),
            // a column that says nothing has no type of its own
            Some(known) if *known.data_type() == DataType::Null => *known = field,
            Some(_) => {}
        }
    }
    let mut columns = Vec::with_capacity(fields.len());
    for field in fields {
        let mut pieces = Vec::with_capacity(tables.len());
        let mut others: Vec<&DataType> = Vec::new();
        for (rows, columns) in tables {
            let own = columns.iter().find(|(own, _)| own.name() == field.name()).map(|(_, array)| array);
            pieces.push(match own {
                Some(array) if array.data_type() == field.data_type() => ArrayRef::clone(array),
                _ => new_null_array(field.data_type(), *rows),
            });
            others
                .extend(own.map(|array| array.data_type()).filter(|&t| *t != DataType::Null && t != field.data_type()));
        }
        if let Some(other) = others.first() {
            let (name, kind) = (field.name(), field.data_type());
            notes.push(format!("column {name} of meta/episodes is {kind} and {other}: it is left out"));
            continue;
        }
        let pieces: Vec<&dyn Array> = pieces.iter().map(AsRef::as_ref).collect();
        columns.push((field.clone(), concat(&pieces).map_err(|source| failed(root, source))?));
    }
    Ok((tables.iter().map(|(rows, _)| rows).sum(), columns))
}

fn failed(root: &Path, source: arrow_schema::ArrowError) -> DatasetError {
    let path = root.join("meta/episodes");
    DatasetError::Parquet { path, operation: "take over its columns", source: source.into() }
}
