//! Episodes and timings as Parquet.

use std::path::Path;
use std::sync::Arc;

use arrow_array::builder::{Float64Builder, ListBuilder};
use arrow_array::cast::AsArray;
use arrow_array::types::{Float64Type, UInt32Type, UInt64Type};
use arrow_array::{Array, ArrayRef, BooleanArray, Float64Array, RecordBatch, StringArray, UInt32Array, UInt64Array};
use arrow_schema::{DataType, Field};
use parquet::arrow::ArrowWriter;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use parquet::basic::{Compression, ZstdLevel};
use parquet::file::properties::WriterProperties;

use super::record::{EpisodeRecord, EpisodeTiming};
use crate::ResultsError;
use crate::files::{open_file, write_atomic};

fn table_error<E: std::error::Error + Send + Sync + 'static>(
    operation: &'static str,
    path: &Path,
) -> impl FnOnce(E) -> ResultsError {
    let path = path.to_owned();
    move |source| ResultsError::Table { operation, path, source: Box::new(source) }
}

/// Writes whole columns as a table; those with values missing may have none.
///
/// # Errors
/// A file that cannot be written.
pub fn write_table(path: &Path, columns: Vec<(&str, ArrayRef)>) -> Result<(), ResultsError> {
    let columns = columns.into_iter().map(|(name, array)| {
        let nullable = array.null_count() > 0;
        (name, array, nullable)
    });
    let batch = RecordBatch::try_from_iter_with_nullable(columns).map_err(table_error("build table", path))?;
    let level = ZstdLevel::try_new(3).map_err(table_error("set up compression of", path))?;
    let properties = WriterProperties::builder().set_compression(Compression::ZSTD(level)).build();
    let mut bytes = Vec::new();
    let mut writer =
        ArrowWriter::try_new(&mut bytes, batch.schema(), Some(properties)).map_err(table_error("write table", path))?;
    writer.write(&batch).map_err(table_error("write table", path))?;
    writer.close().map_err(table_error("write table", path))?;
    write_atomic(path, &bytes)
}

/// Episodes that a table may hold.
const MOST_ROWS: usize = 1_000_000;

/// The columns of a table, each whole, checked for name and type.
struct Columns<'a> {
    path: &'a Path,
    batches: Vec<RecordBatch>,
}

impl<'a> Columns<'a> {
    fn read(path: &'a Path) -> Result<Self, ResultsError> {
        let file = open_file(path).map_err(ResultsError::io("read", path))?;
        let reader = ParquetRecordBatchReaderBuilder::try_new(file)
            .and_then(ParquetRecordBatchReaderBuilder::build)
            .map_err(table_error("read table", path))?;
        let (mut batches, mut rows) = (Vec::<RecordBatch>::new(), 0);
        for batch in reader {
            let batch = batch.map_err(table_error("read table", path))?;
            rows += batch.num_rows();
            // equal rows take no room in a file
            if rows > MOST_ROWS {
                let reason = format!("expected at most {MOST_ROWS} rows, found more");
                return Err(ResultsError::Malformed { path: path.to_owned(), reason });
            }
            batches.push(batch);
        }
        Ok(Self { path, batches })
    }

    fn get<T>(
        &self,
        name: &str,
        kind: &DataType,
        values: impl Fn(&dyn Array, &mut Vec<T>),
    ) -> Result<Vec<T>, ResultsError> {
        let malformed = |reason| ResultsError::Malformed { path: self.path.to_owned(), reason };
        let mut all = Vec::new();
        for batch in &self.batches {
            let column = batch.column_by_name(name).ok_or_else(|| malformed(format!("column `{name}` is missing")))?;
            let (found, nulls) = (column.data_type(), column.null_count());
            if found != kind || nulls > 0 {
                return Err(malformed(format!(
                    "column `{name}`: expected {kind} without nulls, found {found}, {nulls} nulls"
                )));
            }
            values(column, &mut all);
        }
        Ok(all)
    }

    fn has(&self, name: &str) -> bool {
        self.batches.iter().any(|batch| batch.column_by_name(name).is_some())
    }

    fn text(&self, name: &str) -> Result<Vec<String>, ResultsError> {
        self.get(name, &DataType::Utf8, |a, out| {
            out.extend(a.as_string::<i32>().iter().map(|v| v.unwrap_or_default().to_owned()));
        })
    }

    fn u64(&self, name: &str) -> Result<Vec<u64>, ResultsError> {
        self.get(name, &DataType::UInt64, |a, out| {
            out.extend_from_slice(a.as_primitive::<UInt64Type>().values());
        })
    }

    fn u32(&self, name: &str) -> Result<Vec<u32>, ResultsError> {
        self.get(name, &DataType::UInt32, |a, out| {
            out.extend_from_slice(a.as_primitive::<UInt32Type>().values());
        })
    }

    /// A column that may be missing, and may lack values.
    fn f64_if_any(&self, name: &str, rows: usize) -> Result<Vec<Option<f64>>, ResultsError> {
        if !self.has(name) {
            return Ok(vec![None; rows]);
        }
        let mut all = Vec::with_capacity(rows);
        for batch in &self.batches {
            let column = batch.column_by_name(name).and_then(|column| column.as_primitive_opt::<Float64Type>());
            let malformed = || ResultsError::Malformed {
                path: self.path.to_owned(),
                reason: format!("column `{name}`: expected {}", DataType::Float64),
            };
            all.extend(column.ok_or_else(malformed)?.iter());
        }
        Ok(all)
    }

    fn f64(&self, name: &str) -> Result<Vec<f64>, ResultsError> {
        self.get(name, &DataType::Float64, |a, out| {
            out.extend_from_slice(a.as_primitive::<Float64Type>().values());
        })
    }
}

/// Writes the outcomes. The columns `group` and `failure` are there only where a task has them; empty text is none. So is
/// `progress`, whose missing values are none.
pub fn write_episodes(path: &Path, all: &[EpisodeRecord]) -> Result<(), ResultsError> {
    let fingerprints = all.iter().map(|e| &e.fingerprint);
    let mut columns: Vec<(&str, ArrayRef)> = vec![
        ("seed", Arc::new(UInt64Array::from_iter_values(all.iter().map(|e| e.seed)))),
        ("success", Arc::new(all.iter().map(|e| Some(e.success)).collect::<BooleanArray>())),
        ("steps", Arc::new(UInt32Array::from_iter_values(all.iter().map(|e| e.steps)))),
        ("return", Arc::new(Float64Array::from_iter_values(all.iter().map(|e| e.total_reward)))),
        ("fingerprint", Arc::new(StringArray::from_iter_values(fingerprints))),
    ];
    type Word = fn(&EpisodeRecord) -> Option<&str>;
    let words: [(&str, Word); 2] = [("group", |e| e.group.as_deref()), ("failure", |e| e.failure.as_deref())];
    for (name, word) in words {
        if all.iter().any(|e| word(e).is_some()) {
            let texts = all.iter().map(|e| word(e).unwrap_or_default());
            columns.push((name, Arc::new(StringArray::from_iter_values(texts))));
        }
    }
    if all.iter().any(|e| e.progress.is_some()) {
        columns.push(("progress", Arc::new(all.iter().map(|e| e.progress).collect::<Float64Array>())));
    }
    write_table(path, columns)
}

/// Reads the outcomes.
pub(super) fn read_episodes(path: &Path) -> Result<Vec<EpisodeRecord>, ResultsError> {
    let columns = Columns::read(path)?;
    let success = columns.get("success", &DataType::Boolean, |a, out| {
        out.extend(a.as_boolean().iter().map(|v| v == Some(true)));
    })?;
    let fingerprint = columns.text("fingerprint")?;
    let (steps, returns) = (columns.u32("steps")?, columns.f64("return")?);
    let seeds = columns.u64("seed")?;
    let words = |name: &str| -> Result<Vec<Option<String>>, ResultsError> {
        if !columns.has(name) {
            return Ok(vec![None; seeds.len()]);
        }
        Ok(columns.text(name)?.into_iter().map(|word| Some(word).filter(|word| !word.is_empty())).collect())
    };
    let progress = columns.f64_if_any("progress", seeds.len())?;
    let words = words("group")?.into_iter().zip(words("failure")?).zip(progress);
    let rows = seeds.into_iter().zip(success).zip(steps).zip(returns).zip(fingerprint).zip(words);
    Ok(rows
        .map(|(((((seed, success), steps), total_reward), fingerprint), ((group, failure), progress))| EpisodeRecord {
            seed,
            success,
            steps,
            total_reward,
            fingerprint,
            group,
            failure,
            progress,
        })
        .collect())
}

/// Writes the timings. The columns `rendering_ms` and `encoding_ms` are there only where pictures were seen.
pub(super) fn write_timings(path: &Path, timings: &[EpisodeTiming]) -> Result<(), ResultsError> {
    let floats =
        |f: fn(&EpisodeTiming) -> f64| -> ArrayRef { Arc::new(Float64Array::from_iter_values(timings.iter().map(f))) };
    let lists = |f: fn(&EpisodeTiming) -> &[f64]| -> ArrayRef {
        let item = Arc::new(Field::new("item", DataType::Float64, false));
        let mut queries = ListBuilder::new(Float64Builder::new()).with_field(item);
        for timing in timings {
            queries.values().append_slice(f(timing));
            queries.append(true);
        }
        Arc::new(queries.finish())
    };
    let mut columns: Vec<(&str, ArrayRef)> = vec![
        ("seed", Arc::new(UInt64Array::from_iter_values(timings.iter().map(|t| t.seed)))),
        ("wall_ms", floats(|t| t.wall_ms)),
        ("simulator_ms", floats(|t| t.simulator_ms)),
        ("inference_ms", lists(|t| &t.inference_ms)),
    ];
    type Times = fn(&EpisodeTiming) -> &[f64];
    let seen: [(&str, Times); 2] = [("rendering_ms", |t| &t.rendering_ms), ("encoding_ms", |t| &t.encoding_ms)];
    for (name, of) in seen {
        if timings.iter().any(|t| !of(t).is_empty()) {
            columns.push((name, lists(of)));
        }
    }
    write_table(path, columns)
}

/// Reads the timings.
pub(super) fn read_timings(path: &Path) -> Result<Vec<EpisodeTiming>, ResultsError> {
    let columns = Columns::read(path)?;
    let (seeds, wall) = (columns.u64("seed")?, columns.f64("wall_ms")?);
    let simulator = columns.f64("simulator_ms")?;
    let list = DataType::List(Arc::new(Field::new("item", DataType::Float64, false)));
    let lists = |name: &str| {
        columns.get(name, &list, |a, out| {
            let rows = a.as_list::<i32>().iter().flatten();
            out.extend(rows.map(|row| row.as_primitive::<Float64Type>().values().to_vec()));
        })
    };
    let queries = lists("inference_ms")?;
    let optional = |name: &str| if columns.has(name) { lists(name) } else { Ok(vec![Vec::new(); seeds.len()]) };
    let seen = optional("rendering_ms")?.into_iter().zip(optional("encoding_ms")?);
    let rows = seeds.into_iter().zip(wall).zip(simulator).zip(queries).zip(seen);
    Ok(rows
        .map(|((((seed, wall_ms), simulator_ms), inference_ms), (rendering_ms, encoding_ms))| EpisodeTiming {
            seed,
            wall_ms,
            simulator_ms,
            rendering_ms,
            encoding_ms,
            inference_ms,
        })
        .collect())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn episodes(count: u64) -> Vec<EpisodeRecord> {
        (0..count)
            .map(|k| EpisodeRecord {
                seed: 10_000 + k,
                success: k % 3 != 0,
                steps: 40 + k as u32,
                total_reward: 0.1 * k as f64,
                fingerprint: format!("{k:064x}"),
                group: None,
                failure: None,
                progress: None,
            })
            .collect()
    }

    #[test]
    fn tables_come_back_as_written_and_bytes_are_the_same_twice() {
        let dir = tempfile::tempdir().unwrap();
        let (a, b, t) = (dir.path().join("a"), dir.path().join("b"), dir.path().join("t"));
        for count in [0, 1, 3000] {
            let mut all = episodes(count);
            if count == 3000 {
                for (k, episode) in all.iter_mut().enumerate() {
                    episode.group = [None, Some("seen".to_owned()), Some("unseen".to_owned())][k % 3].clone();
                    episode.failure = [None, Some("wrong".to_owned())][k % 2].clone();
                    episode.progress = [None, Some(0.2), Some(1.0 / 3.0)][k % 3];
                }
            }
            write_episodes(&a, &all).unwrap();
            write_episodes(&b, &all).unwrap();
            assert_eq!(read_episodes(&a).unwrap(), all);
            assert_eq!(std::fs::read(&a).unwrap(), std::fs::read(&b).unwrap());
        }
        for rendering_ms in [Vec::new(), vec![8.5, 9.0]] {
            let timings = [Vec::new(), vec![0.5, 0.75]].map(|inference_ms| EpisodeTiming {
                seed: 3,
                wall_ms: 1.5,
                simulator_ms: 1.0,
                encoding_ms: rendering_ms.clone(),
                rendering_ms: rendering_ms.clone(),
                inference_ms,
            });
            write_timings(&t, &timings).unwrap();
            assert_eq!(read_timings(&t).unwrap(), timings);
        }
        let error = read_episodes(&t).unwrap_err().to_string();
        assert!(error.contains("column `success` is missing"), "{error}");
    }

    #[test]
    fn a_damaged_table_is_an_error_that_names_the_file() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("outcomes.parquet");
        write_episodes(&path, &episodes(5)).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
        let error = read_episodes(&path).unwrap_err().to_string();
        assert!(error.contains("outcomes.parquet"), "{error}");
    }
}
