//! Parquet files as plain vectors: columns of numbers of any width, lists of any kind.

use crate::error::{DatasetError, InputError, Result};
use crate::source::is_lfs_pointer;
use crate::windows::Resident;
use arrow_array::cast::AsArray;
use arrow_array::types::{Float32Type, Float64Type, Int64Type};
use arrow_array::{Array, ArrayRef, FixedSizeListArray, LargeListArray, ListArray, StringArray};
use arrow_buffer::ScalarBuffer;
use arrow_cast::{CastOptions, cast_with_options};
use arrow_schema::{ArrowError, DataType};
use arrow_select::concat::concat;
use parquet::arrow::ProjectionMask;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use std::collections::BTreeMap;
use std::fs::File;
use std::path::{Path, PathBuf};

/// The files `<root>/<prefix>/*/*.parquet` in order of their paths, as LeRobot lists them.
pub(crate) fn files(root: &Path, prefix: &str) -> Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    let top = root.join(prefix);
    for folder in list(&top)? {
        if folder.is_dir() {
            found.extend(list(&folder)?.into_iter().filter(|f| f.extension().is_some_and(|e| e == "parquet")));
        }
    }
    found.sort();
    if found.is_empty() {
        return Err(DatasetError::BadDataset {
            path: root.to_path_buf(),
            object: prefix.to_owned(),
            expected: format!("{prefix}/chunk-000/file-000.parquet"),
            found: "no Parquet file".to_owned(),
        });
    }
    Ok(found)
}

fn list(folder: &Path) -> Result<Vec<PathBuf>> {
    let failed = |source| DatasetError::Io { path: folder.to_path_buf(), operation: "list it", source };
    let entries = std::fs::read_dir(folder).map_err(failed)?;
    entries.map(|entry| entry.map(|e| e.path()).map_err(failed)).collect()
}

/// Refuses a git-lfs pointer that stands in for the file `path`.
pub(crate) fn refuse_pointer(path: &Path) -> Result<()> {
    match is_lfs_pointer(path) {
        true => Err(InputError::LfsPointer { path: path.to_path_buf() }.into()),
        // whoever opens it says what else may be wrong
        false => Ok(()),
    }
}

/// Opens a Parquet file.
pub(crate) fn open(path: &Path) -> Result<ParquetRecordBatchReaderBuilder<File>> {
    refuse_pointer(path)?;
    let file = File::open(path).map_err(|source| DatasetError::Io {
        path: path.to_path_buf(),
        operation: "open it",
        source,
    })?;
    ParquetRecordBatchReaderBuilder::try_new(file).map_err(|source| DatasetError::Parquet {
        path: path.to_path_buf(),
        operation: "read it",
        source,
    })
}

/// Reads those of `wanted` that a file has, by name, and the number of its rows.
pub(crate) fn columns_there(path: &Path, wanted: &[&str]) -> Result<(usize, BTreeMap<String, ArrayRef>)> {
    let builder = open(path)?;
    let there: Vec<&str> = wanted.iter().copied().filter(|name| builder.schema().index_of(name).is_ok()).collect();
    let rows = builder.metadata().file_metadata().num_rows();
    if there.is_empty() {
        return Ok((usize::try_from(rows).ok().ok_or_else(|| bad_count(path, rows))?, BTreeMap::new()));
    }
    let (rows, arrays) = columns(path, &there)?;
    Ok((rows, there.into_iter().map(str::to_owned).zip(arrays).collect()))
}

/// Columns of one file in the order of `columns`, so many rows at a time; a missing one is an error.
pub(crate) fn batches<'p>(
    path: &'p Path,
    columns: &[&str],
    rows: usize,
) -> Result<impl Iterator<Item = Result<Vec<ArrayRef>>> + 'p> {
    let failed = move |source| DatasetError::Parquet { path: path.to_path_buf(), operation: "read it", source };
    let builder = open(path)?;
    let mut indices = Vec::with_capacity(columns.len());
    for name in columns {
        indices.push(builder.schema().index_of(name).ok().ok_or_else(|| missing_column(path, name, &builder))?);
    }
    let mask = ProjectionMask::roots(builder.parquet_schema(), indices.iter().copied());
    let mut sorted = indices.clone();
    sorted.sort_unstable();
    sorted.dedup();
    let order: Vec<usize> = indices.iter().map(|index| sorted.partition_point(|known| known < index)).collect();
    let reader = builder.with_projection(mask).with_batch_size(rows.max(1)).build().map_err(failed)?;
    Ok(reader.map(move |batch| {
        let batch = batch.map_err(|e| failed(e.into()))?;
        Ok(order.iter().map(|&at| ArrayRef::clone(batch.column(at))).collect())
    }))
}

/// Reads columns of one file whole, each as one array, in the order of `columns`; a missing one is an error.
pub(crate) fn columns(path: &Path, columns: &[&str]) -> Result<(usize, Vec<ArrayRef>)> {
    let rows = open(path)?.metadata().file_metadata().num_rows();
    let rows = usize::try_from(rows).ok().ok_or_else(|| bad_count(path, rows))?;
    // one batch for the whole file: its buffers become the resident columns without another copy
    let batches = batches(path, columns, rows)?.collect::<Result<Vec<_>>>()?;
    let mut arrays = Vec::with_capacity(columns.len());
    for (at, name) in columns.iter().enumerate() {
        let pieces: Vec<&dyn Array> = batches.iter().map(|batch| batch[at].as_ref()).collect();
        arrays.push(match batches.as_slice() {
            [] => return Err(BadColumn { path, name }.because("rows", "none")),
            [one] => ArrayRef::clone(&one[at]),
            _ => concat(&pieces).map_err(|e| DatasetError::Parquet {
                path: path.to_path_buf(),
                operation: "read it",
                source: e.into(),
            })?,
        });
    }
    Ok((rows, arrays))
}

fn bad_count(path: &Path, rows: i64) -> DatasetError {
    DatasetError::BadDataset {
        path: path.to_path_buf(),
        object: "number of rows".to_owned(),
        expected: "0 or more".to_owned(),
        found: rows.to_string(),
    }
}

pub(crate) fn missing_column(path: &Path, name: &str, builder: &ParquetRecordBatchReaderBuilder<File>) -> DatasetError {
    let names: Vec<&str> = builder.schema().fields().iter().map(|f| f.name().as_str()).collect();
    DatasetError::NotInDataset { path: path.to_path_buf(), wanted: format!("column {name}"), found: names.join(", ") }
}

/// A column of a file, for error messages.
pub(crate) struct BadColumn<'a> {
    pub path: &'a Path,
    pub name: &'a str,
}

impl BadColumn<'_> {
    pub(crate) fn because(&self, expected: impl Into<String>, found: impl Into<String>) -> DatasetError {
        DatasetError::BadDataset {
            path: self.path.to_path_buf(),
            object: format!("column {}", self.name),
            expected: expected.into(),
            found: found.into(),
        }
    }
}

/// Numbers of a column as `dim` f32 a row, whatever the stored type and kind of list.
pub(crate) fn numbers(path: &Path, name: &str, array: &ArrayRef, dim: usize) -> Result<Resident> {
    let column = BadColumn { path, name };
    floats(&column, leaf(&column, array, array.len(), dim)?, dim)
}

/// [`numbers`] of a column that is stored as another type than `dtype`, which the feature states and must hold its values.
pub(crate) fn numbers_as(path: &Path, name: &str, array: &ArrayRef, dim: usize, dtype: &str) -> Result<Resident> {
    let column = BadColumn { path, name };
    let leaf = leaf(&column, array, array.len(), dim)?;
    let to = match dtype {
        "bool" => DataType::Boolean,
        "int8" => DataType::Int8,
        "int16" => DataType::Int16,
        "int32" => DataType::Int32,
        "int64" => DataType::Int64,
        "uint8" => DataType::UInt8,
        "uint16" => DataType::UInt16,
        "uint32" => DataType::UInt32,
        "uint64" => DataType::UInt64,
        _ => return floats(&column, leaf, dim),
    };
    let expected = || format!("values of {dtype}, as info.json says");
    floats(&column, cast_all(&leaf, &to).map_err(|e| column.because(expected(), e.to_string()))?, dim)
}

fn floats(column: &BadColumn<'_>, leaf: ArrayRef, dim: usize) -> Result<Resident> {
    let floats = match leaf.data_type() {
        DataType::Float32 => leaf,
        DataType::Boolean => {
            let values: Vec<f32> = leaf.as_boolean().values().iter().map(|b| f32::from(u8::from(b))).collect();
            return Ok(Resident { data: values.into(), dim });
        }
        t if t.is_numeric() => {
            cast_all(&leaf, &DataType::Float32).map_err(|e| column.because("numbers", e.to_string()))?
        }
        t => return Err(column.because("numbers", t.to_string())),
    };
    Ok(Resident { data: floats.as_primitive::<Float32Type>().values().clone(), dim })
}

/// Unwraps lists down to values: every row must hold exactly `dim` of them, none may be null.
pub(crate) fn leaf(column: &BadColumn<'_>, array: &ArrayRef, rows: usize, dim: usize) -> Result<ArrayRef> {
    if array.null_count() > 0 {
        return Err(column.because("a value in every row", format!("{} nulls", array.null_count())));
    }
    let any = array.as_any();
    let inner = match array.data_type() {
        DataType::FixedSizeList(_, _) => any.downcast_ref::<FixedSizeListArray>().map(|a| ArrayRef::clone(a.values())),
        DataType::List(_) => any.downcast_ref::<ListArray>().and_then(|a| {
            let offsets = a.value_offsets();
            even(offsets.iter().map(|&o| o as usize))
                .then(|| a.values().slice(offsets[0] as usize, (offsets[offsets.len() - 1] - offsets[0]) as usize))
        }),
        DataType::LargeList(_) => any.downcast_ref::<LargeListArray>().and_then(|a| {
            let offsets = a.value_offsets();
            even(offsets.iter().map(|&o| o as usize))
                .then(|| a.values().slice(offsets[0] as usize, (offsets[offsets.len() - 1] - offsets[0]) as usize))
        }),
        _ => {
            if array.len() != rows * dim {
                return Err(
                    column.because(format!("{dim} values a row"), format!("{} values in {rows} rows", array.len()))
                );
            }
            return Ok(ArrayRef::clone(array));
        }
    };
    let inner = inner.ok_or_else(|| column.because(format!("{dim} values a row"), "rows of different lengths"))?;
    leaf(column, &inner, rows, dim)
}

/// Whether all differences are the same.
fn even(mut offsets: impl Iterator<Item = usize>) -> bool {
    let (Some(first), Some(second)) = (offsets.next(), offsets.next()) else { return true };
    let step = second - first;
    let mut last = second;
    offsets.all(|o| {
        let same = o - last == step;
        last = o;
        same
    })
}

/// A cast that fails at what the type cannot hold, instead of leaving it out.
pub(crate) fn cast_all(array: &ArrayRef, to: &DataType) -> std::result::Result<ArrayRef, ArrowError> {
    cast_with_options(array, to, &CastOptions { safe: false, ..CastOptions::default() })
}

/// A column of one whole number a row.
pub(crate) fn integers(path: &Path, name: &str, array: &ArrayRef) -> Result<ScalarBuffer<i64>> {
    let column = BadColumn { path, name };
    let leaf = leaf(&column, array, array.len(), 1)?;
    if !leaf.data_type().is_integer() {
        return Err(column.because("whole numbers", leaf.data_type().to_string()));
    }
    let longs = cast_all(&leaf, &DataType::Int64).map_err(|e| column.because("64-bit numbers", e.to_string()))?;
    Ok(longs.as_primitive::<Int64Type>().values().clone())
}

/// A column of one number a row, in full precision.
pub(crate) fn doubles(path: &Path, name: &str, array: &ArrayRef) -> Result<ScalarBuffer<f64>> {
    let column = BadColumn { path, name };
    let leaf = leaf(&column, array, array.len(), 1)?;
    if !leaf.data_type().is_numeric() {
        return Err(column.because("numbers", leaf.data_type().to_string()));
    }
    let doubles = cast_all(&leaf, &DataType::Float64).map_err(|e| column.because("numbers", e.to_string()))?;
    Ok(doubles.as_primitive::<Float64Type>().values().clone())
}

/// A column of texts, any of which may be missing.
pub(crate) fn maybe_texts(path: &Path, name: &str, array: &ArrayRef) -> Result<StringArray> {
    let column = BadColumn { path, name };
    let plain = cast_all(array, &DataType::Utf8).map_err(|e| column.because("texts", e.to_string()))?;
    Ok(plain.as_string().clone())
}

/// A column of texts.
pub(crate) fn texts(path: &Path, name: &str, array: &ArrayRef) -> Result<Vec<String>> {
    let plain = maybe_texts(path, name, array)?;
    if plain.null_count() > 0 {
        let found = format!("{} nulls", plain.null_count());
        return Err(BadColumn { path, name }.because("a text in every row", found));
    }
    Ok(plain.iter().flatten().map(str::to_owned).collect())
}

/// A column of lists of texts.
pub(crate) fn text_lists(path: &Path, name: &str, array: &ArrayRef) -> Result<Vec<Vec<String>>> {
    let column = BadColumn { path, name };
    let lists: Vec<ArrayRef> = match array.data_type() {
        DataType::List(_) => {
            let list = array.as_any().downcast_ref::<ListArray>().expect("a list column");
            list.iter().flatten().collect()
        }
        DataType::LargeList(_) => {
            let list = array.as_any().downcast_ref::<LargeListArray>().expect("a list column");
            list.iter().flatten().collect()
        }
        t => return Err(column.because("lists of texts", t.to_string())),
    };
    if lists.len() != array.len() {
        return Err(column.because("a list in every row", "nulls"));
    }
    lists.iter().map(|list| texts(path, name, list)).collect()
}

/// A column of numbers, or of lists of them of any depth: those of each row, one after the other.
pub(crate) fn number_lists(path: &Path, name: &str, array: &ArrayRef) -> Result<Vec<Vec<f64>>> {
    let column = BadColumn { path, name };
    let row = |row: usize| {
        let mut inner = array.slice(row, 1);
        loop {
            let any = inner.as_any();
            let below = match inner.data_type() {
                DataType::FixedSizeList(_, _) => {
                    any.downcast_ref::<FixedSizeListArray>().map(|a| ArrayRef::clone(a.values()))
                }
                DataType::List(_) => any.downcast_ref::<ListArray>().map(|a| {
                    let offsets = a.value_offsets();
                    let (from, to) = (offsets[0] as usize, offsets[offsets.len() - 1] as usize);
                    a.values().slice(from, to - from)
                }),
                DataType::LargeList(_) => any.downcast_ref::<LargeListArray>().map(|a| {
                    let offsets = a.value_offsets();
                    let (from, to) = (offsets[0] as usize, offsets[offsets.len() - 1] as usize);
                    a.values().slice(from, to - from)
                }),
                _ => return Ok(doubles(path, name, &inner)?.to_vec()),
            };
            inner = below.ok_or_else(|| column.because("lists of numbers", inner.data_type().to_string()))?;
        }
    };
    (0..array.len()).map(row).collect()
}
