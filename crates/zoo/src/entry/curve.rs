//! `train.parquet`: the metrics of a training, and the curve that is read from them.

use std::path::Path;

use arrow_array::cast::AsArray;
use arrow_array::types::{Float64Type, UInt64Type};
use arrow_array::{Array, RecordBatch};
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;

use super::CurvePoint;
use crate::ZooError;

/// Points kept of a training curve.
const CURVE_POINTS: usize = 50;

/// Of rows of step, loss and validation loss at most 50, evenly thinned; the last always stays.
pub(crate) fn thinned(rows: impl ExactSizeIterator<Item = Row> + DoubleEndedIterator) -> Vec<CurvePoint> {
    let stride = rows.len().div_ceil(CURVE_POINTS).max(1);
    let point = |(step, loss, valid_loss): Row| Some(CurvePoint { step, loss: loss?, valid_loss });
    let mut points: Vec<CurvePoint> = rows.rev().step_by(stride).filter_map(point).collect();
    points.reverse();
    points
}

/// Rows that a curve may have.
const MOST_ROWS: usize = 2_000_000;

/// Step, loss and validation loss.
type Row = (u64, Option<f64>, Option<f64>);

/// The curve in the file at `path`, thinned.
///
/// # Errors
/// [`ZooError::Table`] for a file that cannot be read, [`ZooError::Malformed`] for one without steps.
pub(super) fn read(path: &Path) -> Result<Vec<CurvePoint>, ZooError> {
    Ok(thinned(rows(path)?.into_iter()))
}

/// Every point of it.
///
/// # Errors
/// As [`read`].
pub(super) fn whole(path: &Path) -> Result<Vec<CurvePoint>, ZooError> {
    let point = |(step, loss, valid_loss): Row| Some(CurvePoint { step, loss: loss?, valid_loss });
    Ok(rows(path)?.into_iter().filter_map(point).collect())
}

fn rows(path: &Path) -> Result<Vec<Row>, ZooError> {
    let table = |source: Box<dyn std::error::Error + Send + Sync>| ZooError::Table {
        operation: "read table",
        path: path.to_owned(),
        source,
    };
    let file = std::fs::File::open(path).map_err(ZooError::io("read", path))?;
    let reader = ParquetRecordBatchReaderBuilder::try_new(file).and_then(ParquetRecordBatchReaderBuilder::build);
    let mut rows: Vec<Row> = Vec::new();
    for batch in reader.map_err(|e| table(e.into()))? {
        let batch = batch.map_err(|e| table(e.into()))?;
        let steps = batch.column_by_name("step").and_then(|column| column.as_primitive_opt::<UInt64Type>());
        let reason = "expected a column `step` of unsigned integers".to_owned();
        let steps = steps.ok_or_else(|| ZooError::Malformed { path: path.to_owned(), reason })?;
        let (loss, valid) = (numbers(&batch, "loss"), numbers(&batch, "valid_loss"));
        // equal rows take no room in a file
        if rows.len() > MOST_ROWS {
            let reason = format!("expected at most {MOST_ROWS} rows, found more");
            return Err(ZooError::Malformed { path: path.to_owned(), reason });
        }
        rows.extend(steps.values().iter().zip(loss).zip(valid).map(|((step, loss), valid)| (*step, loss, valid)));
    }
    Ok(rows)
}

/// A column of numbers, none where it is not there or has no value.
fn numbers(batch: &RecordBatch, name: &str) -> Vec<Option<f64>> {
    match batch.column_by_name(name).and_then(|column| column.as_primitive_opt::<Float64Type>()) {
        Some(column) => (0..column.len()).map(|row| column.is_valid(row).then(|| column.value(row))).collect(),
        None => vec![None; batch.num_rows()],
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::run::{Metrics, MetricsRow};

    #[test]
    fn curves_are_thinned_to_their_end() {
        let rows: Vec<Row> = (1..=1003).map(|step| (step, Some(step as f64), None)).collect();
        let points = thinned(rows.iter().copied());
        assert!(points.len() <= CURVE_POINTS && points.len() > CURVE_POINTS / 2);
        assert_eq!(points.last().map(|p| p.step), Some(1003));
        assert!(points.windows(2).all(|p| p[0].step < p[1].step));
        assert_eq!(thinned(rows[..3].iter().copied()).len(), 3);
    }

    #[test]
    fn a_curve_comes_back_from_the_metrics() {
        let folder = tempfile::tempdir().unwrap();
        let mut metrics = Metrics::open(folder.path().join("metrics.csv"), 0).unwrap();
        for step in 1..=120 {
            let mut values = [("loss".to_owned(), 1.0 / f64::from(step)), ("lr".to_owned(), 0.1)];
            values[1].1 = f64::from(step);
            let mut values: std::collections::BTreeMap<String, f64> = values.into();
            if step % 10 == 0 {
                values.insert("valid_loss".to_owned(), 2.0 / f64::from(step));
            }
            metrics.push(MetricsRow { step: u64::try_from(step).unwrap(), values }).unwrap();
        }
        let path = folder.path().join("train.parquet");
        metrics.write_parquet(&path).unwrap();
        let curve = read(&path).unwrap();
        assert_eq!(curve.len(), 40);
        let last = CurvePoint { step: 120, loss: 1.0 / 120.0, valid_loss: Some(2.0 / 120.0) };
        assert_eq!((curve[39], curve[38].valid_loss), (last, None));
        let whole = whole(&path).unwrap();
        assert_eq!((whole.len(), whole[0].step, whole[119]), (120, 1, last));
        std::fs::write(&path, b"none").unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("train.parquet"));
    }
}
