//! The metrics of a run: one row a logged step, as CSV while it runs and Parquet when it is saved.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs::OpenOptions;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use arrow_array::{ArrayRef, Float64Array, RecordBatch, UInt64Array};
use parquet::arrow::ArrowWriter;
use serde::{Deserialize, Serialize};

use crate::{ZooError, write_atomic};

/// One logged step: `step` counts optimiser steps from 1, `values` is sorted by name.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MetricsRow {
    /// Optimiser steps done.
    pub step: u64,
    /// `loss`, its parts, `grad_norm`, `lr`, `samples_per_s`, `valid_loss` where it was computed.
    pub values: BTreeMap<String, f64>,
}

/// The metrics files of one run.
#[derive(Debug)]
pub struct Metrics {
    csv: PathBuf,
    columns: Vec<String>,
    rows: Vec<MetricsRow>,
}

impl Metrics {
    /// Goes on with `csv`, of which rows after step `keep` are dropped: they will be computed again.
    ///
    /// # Errors
    /// When the file is not one of ours.
    pub fn open(csv: PathBuf, keep: u64) -> Result<Self, ZooError> {
        let mut metrics = Self { csv, columns: Vec::new(), rows: Vec::new() };
        if keep > 0 && metrics.csv.exists() {
            metrics.rows = read_csv(&metrics.csv)?;
            metrics.rows.retain(|row| row.step <= keep);
            metrics.columns = columns_of(&metrics.rows);
        }
        metrics.rewrite()?;
        Ok(metrics)
    }

    /// The rows so far.
    pub fn rows(&self) -> &[MetricsRow] {
        &self.rows
    }

    /// Adds a row to memory and to the CSV.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn push(&mut self, row: MetricsRow) -> Result<(), ZooError> {
        let new_column = row.values.keys().any(|name| !self.columns.contains(name));
        self.rows.push(row);
        if new_column {
            self.columns = columns_of(&self.rows);
            return self.rewrite();
        }
        let line = self.line(&self.rows[self.rows.len() - 1]);
        OpenOptions::new()
            .append(true)
            .open(&self.csv)
            .and_then(|mut file| file.write_all(line.as_bytes()))
            .map_err(ZooError::io("write", &self.csv))
    }

    fn line(&self, row: &MetricsRow) -> String {
        let mut line = row.step.to_string();
        for name in &self.columns {
            line.push(',');
            if let Some(value) = row.values.get(name) {
                write!(line, "{value}").expect("writing into a String cannot fail");
            }
        }
        line.push('\n');
        line
    }

    fn rewrite(&self) -> Result<(), ZooError> {
        let mut text = "step".to_owned();
        for name in &self.columns {
            text.push(',');
            text.push_str(name);
        }
        text.push('\n');
        for row in &self.rows {
            text.push_str(&self.line(row));
        }
        Ok(write_atomic(&self.csv, text.as_bytes())?)
    }

    /// Writes all rows as Parquet: `step` (u64) and one f64 column a metric, null where not computed.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write_parquet(&self, path: &Path) -> Result<(), ZooError> {
        Ok(write_atomic(path, &self.to_parquet(path)?)?)
    }

    /// The same as bytes, for the file at `path`.
    ///
    /// # Errors
    /// Rows that are no table.
    pub fn to_parquet(&self, path: &Path) -> Result<Vec<u8>, ZooError> {
        let failed = |reason: String| ZooError::Malformed { path: path.to_owned(), reason };
        let steps = UInt64Array::from_iter_values(self.rows.iter().map(|r| r.step));
        let mut columns: Vec<(&str, ArrayRef)> = vec![("step", Arc::new(steps))];
        for name in &self.columns {
            let values: Float64Array = self.rows.iter().map(|r| r.values.get(name)).map(|v| v.copied()).collect();
            columns.push((name, Arc::new(values)));
        }
        let batch = RecordBatch::try_from_iter_with_nullable(
            columns.into_iter().map(|(name, array)| (name, array, name != "step")),
        )
        .map_err(|e| failed(e.to_string()))?;
        let mut bytes = Vec::new();
        let mut writer = ArrowWriter::try_new(&mut bytes, batch.schema(), None).map_err(|e| failed(e.to_string()))?;
        writer.write(&batch).map_err(|e| failed(e.to_string()))?;
        writer.close().map_err(|e| failed(e.to_string()))?;
        Ok(bytes)
    }
}

fn columns_of(rows: &[MetricsRow]) -> Vec<String> {
    let mut names: Vec<String> = rows.iter().flat_map(|r| r.values.keys().cloned()).collect();
    names.sort();
    names.dedup();
    names
}

/// Reads a metrics CSV. A last line without its end (the writer was killed) is left out.
fn read_csv(path: &Path) -> Result<Vec<MetricsRow>, ZooError> {
    let text = std::fs::read_to_string(path).map_err(ZooError::io("read", path))?;
    let malformed = |line: usize| ZooError::Malformed {
        path: path.to_owned(),
        reason: format!("line {} is not a row of metrics", line + 1),
    };
    let whole = text.rfind('\n').map_or("", |end| &text[..=end]);
    let mut lines = whole.lines().enumerate();
    let Some((_, header)) = lines.next() else {
        return Ok(Vec::new());
    };
    let names: Vec<&str> = header.split(',').skip(1).collect();
    lines
        .map(|(number, line)| {
            let mut cells = line.split(',');
            let step = cells.next().and_then(|c| c.parse().ok()).ok_or_else(|| malformed(number))?;
            let mut values = BTreeMap::new();
            for name in &names {
                match cells.next() {
                    None => return Err(malformed(number)),
                    Some("") => {}
                    Some(cell) => {
                        let value = cell.parse::<f64>().ok().ok_or_else(|| malformed(number))?;
                        values.insert((*name).to_owned(), value);
                    }
                }
            }
            Ok(MetricsRow { step, values })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn row(step: u64, values: &[(&str, f64)]) -> MetricsRow {
        MetricsRow { step, values: values.iter().map(|(n, v)| ((*n).to_owned(), *v)).collect() }
    }

    #[test]
    fn rows_survive_a_kill_and_later_ones_are_dropped() {
        let folder = tempfile::tempdir().unwrap();
        let csv = folder.path().join("metrics.csv");
        let mut metrics = Metrics::open(csv.clone(), 0).unwrap();
        let rows = [
            row(10, &[("loss", 0.1), ("lr", 1e-3)]),
            row(20, &[("loss", 1.0 / 3.0), ("lr", 1e-3), ("valid_loss", 0.25)]),
            row(30, &[("loss", 0.5), ("lr", 2e-3)]),
        ];
        for r in &rows {
            metrics.push(r.clone()).unwrap();
        }
        let text = std::fs::read_to_string(&csv).unwrap();
        assert_eq!(text.lines().next(), Some("step,loss,lr,valid_loss"));
        std::fs::write(&csv, format!("{text}40,0.")).unwrap();
        let metrics = Metrics::open(csv.clone(), 20).unwrap();
        assert_eq!(metrics.rows(), &rows[..2]);
        assert_eq!(read_csv(&csv).unwrap(), &rows[..2]);
    }

    #[test]
    fn parquet_holds_the_same_numbers() {
        use parquet::file::reader::{FileReader, SerializedFileReader};
        use parquet::record::RowAccessor;
        let folder = tempfile::tempdir().unwrap();
        let mut metrics = Metrics::open(folder.path().join("m.csv"), 0).unwrap();
        metrics.push(row(1, &[("loss", 0.1)])).unwrap();
        metrics.push(row(2, &[("loss", 0.2), ("valid_loss", 0.7)])).unwrap();
        let path = folder.path().join("m.parquet");
        metrics.write_parquet(&path).unwrap();
        let reader = SerializedFileReader::new(std::fs::File::open(path).unwrap()).unwrap();
        let rows: Vec<_> = reader.get_row_iter(None).unwrap().map(|r| r.unwrap()).collect();
        assert_eq!(rows.len(), 2);
        assert_eq!(rows[1].get_ulong(0).unwrap(), 2);
        assert_eq!(rows[1].get_double(1).unwrap(), 0.2);
        assert_eq!(rows[1].get_double(2).unwrap(), 0.7);
        assert!(rows[0].get_double(2).is_err());
    }

    #[test]
    fn a_foreign_csv_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let csv = folder.path().join("metrics.csv");
        std::fs::write(&csv, "step,loss\n10,0.5\nhello,1\n").unwrap();
        let error = Metrics::open(csv, 10).unwrap_err().to_string();
        assert!(error.ends_with("line 3 is not a row of metrics"), "{error}");
    }
}
