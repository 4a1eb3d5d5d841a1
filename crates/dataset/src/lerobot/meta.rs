//! `meta/`: tasks, episodes and statistics.

use super::info::Info;
use super::schema::{element, writer_properties};
use super::shards::{GroupEncoder, HashingFile, Place, WrittenFile, write_parquet};
use super::totals::EpisodeStats;
use super::videos::Stretch;
use crate::error::{DatasetError, Result};
use crate::stats::FeatureStats;
use arrow_array::builder::{Float64Builder, Int64Builder, ListBuilder, StringBuilder};
use arrow_array::{ArrayRef, Float64Array, Int64Array, ListArray, StringArray};
use arrow_buffer::OffsetBuffer;
use arrow_schema::{DataType, Field, Schema};
use parquet::errors::ParquetError;
use parquet::file::metadata::KeyValue;
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

/// Where the episodes lie; one file holds them all.
pub(crate) const EPISODES_FILE: &str = "meta/episodes/chunk-000/file-000.parquet";

/// One row of the episodes file.
#[derive(Debug, Clone)]
pub(crate) struct EpisodeRow {
    pub length: usize,
    pub from: usize,
    /// Tasks of its frames, in order of first use: one, unless LeRobot wrote it.
    pub tasks: Vec<usize>,
    pub place: Place,
    /// Where the video of each camera is that has one, by name.
    pub videos: BTreeMap<String, Stretch>,
}

fn write(
    root: &Path,
    relative: &str,
    schema: Schema,
    metadata: Vec<KeyValue>,
    groups: impl IntoIterator<Item = Result<Vec<ArrayRef>>>,
) -> Result<WrittenFile> {
    let failed =
        |source: ParquetError| DatasetError::Parquet { path: root.join(relative), operation: "write it", source };
    let properties = writer_properties(&schema, metadata).map_err(failed)?;
    let encoder = GroupEncoder::new(Arc::new(schema), properties).map_err(failed)?;
    write_parquet(root, relative, &encoder, groups)
}

/// `meta/tasks.parquet`: a pandas frame whose index is the task's text; row `i` has `task_index` `i`.
pub(crate) fn write_tasks(root: &Path, tasks: &[String]) -> Result<WrittenFile> {
    let pandas = json!({
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [
            {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64", "metadata": null},
            {"name": "task", "field_name": "task", "pandas_type": "unicode", "numpy_type": "object", "metadata": null},
        ],
        "pandas_version": "2.3.3",
    });
    let schema =
        Schema::new(vec![Field::new("task_index", DataType::Int64, false), Field::new("task", DataType::Utf8, false)]);
    let arrays: Vec<ArrayRef> = vec![
        Arc::new(Int64Array::from_iter_values(0..tasks.len() as i64)),
        Arc::new(StringArray::from_iter_values(tasks)),
    ];
    let metadata = vec![KeyValue::new("pandas".to_owned(), pandas.to_string())];
    write(root, "meta/tasks.parquet", schema, metadata, [Ok(arrays)])
}

/// The file of episodes: one row each, with its statistics in flat columns named `stats/<feature>/<statistic>`.
///
/// `features` are the names that have statistics, and whether they are images. `others` are columns of other programs.
pub(crate) fn write_episodes(
    root: &Path,
    tasks: &[String],
    features: &[(String, bool)],
    rows: &[EpisodeRow],
    stats: &EpisodeStats,
    others: &[(Field, ArrayRef)],
) -> Result<WrittenFile> {
    // a camera has its places whether or not somebody counted its pictures
    let filmed = rows.first().into_iter().flat_map(|row| row.videos.keys());
    let filmed: Vec<&String> = filmed.filter(|&name| rows.iter().all(|row| row.videos.contains_key(name))).collect();
    // quantiles, which sets of earlier versions lack, are columns where every episode has them
    let stored = |name: &str| -> Vec<Getter> {
        STATISTICS.into_iter().zip(stats.lacks(name)).filter(|(_, lacks)| !lacks).map(|(one, _)| one).collect()
    };
    let counted: Vec<Stored<'_>> = features
        .iter()
        .filter(|(name, _)| stats.all_have(name))
        .map(|(name, is_image)| (name.as_str(), *is_image, stored(name)))
        .collect();
    let mut groups = rows.chunks(EpisodeStats::GROUP).enumerate().map(|(group, part)| {
        let start = group * EpisodeStats::GROUP;
        let mut columns = episode_columns(start, tasks, &filmed, &counted, part, &stats.group(group)?);
        columns.extend(others.iter().map(|(field, all)| (field.name().clone(), all.slice(start, part.len()))));
        Ok(columns)
    });
    let first = groups.next().expect("a data set has an episode")?;
    // an episode without frames has no statistics
    let maybe_null = |name: &str| {
        stats.some_lack() && name.starts_with("stats/") || others.iter().any(|(other, _)| other.name() == name)
    };
    let field = |(name, array): &(String, ArrayRef)| Field::new(name, array.data_type().clone(), maybe_null(name));
    let schema = Schema::new(first.iter().map(field).collect::<Vec<_>>());
    let arrays = |columns: Vec<(String, ArrayRef)>| columns.into_iter().map(|(_, array)| array).collect();
    let groups = std::iter::once(Ok(first)).chain(groups).map(|columns| columns.map(arrays));
    write(root, EPISODES_FILE, schema, Vec::new(), groups)
}

fn episode_columns(
    start: usize,
    tasks: &[String],
    filmed: &[&String],
    counted: &[Stored<'_>],
    rows: &[EpisodeRow],
    stats: &[BTreeMap<String, FeatureStats>],
) -> Vec<(String, ArrayRef)> {
    let ints = |f: &dyn Fn(usize, &EpisodeRow) -> usize| -> ArrayRef {
        let values = rows.iter().enumerate().map(|(i, row)| f(start + i, row) as i64);
        Arc::new(Int64Array::from_iter_values(values))
    };
    let mut texts = ListBuilder::new(StringBuilder::new()).with_field(element(DataType::Utf8));
    for row in rows {
        row.tasks.iter().for_each(|&task| texts.values().append_value(&tasks[task]));
        texts.append(true);
    }
    let mut columns: Vec<(String, ArrayRef)> = vec![
        ("episode_index".to_owned(), ints(&|i, _| i)),
        ("tasks".to_owned(), Arc::new(texts.finish())),
        ("length".to_owned(), ints(&|_, row| row.length)),
        ("data/chunk_index".to_owned(), ints(&|_, row| row.place.folder)),
        ("data/file_index".to_owned(), ints(&|_, row| row.place.file)),
        ("dataset_from_index".to_owned(), ints(&|_, row| row.from)),
        ("dataset_to_index".to_owned(), ints(&|_, row| row.from + row.length)),
    ];
    for &name in filmed {
        let seconds = |f: &dyn Fn(&Stretch) -> f64| -> ArrayRef {
            Arc::new(Float64Array::from_iter_values(rows.iter().map(|row| f(&row.videos[name]))))
        };
        columns.extend([
            (format!("videos/{name}/chunk_index"), ints(&|_, row| row.videos[name].folder)),
            (format!("videos/{name}/file_index"), ints(&|_, row| row.videos[name].file)),
            (format!("videos/{name}/from_timestamp"), seconds(&|s| s.from)),
            (format!("videos/{name}/to_timestamp"), seconds(&|s| s.to)),
        ]);
    }
    for (feature, is_image, stored) in counted {
        let each = || stats.iter().map(|of_episode| of_episode.get(*feature));
        for (name, get) in stored {
            let mut values = Float64Builder::new();
            let mut lengths = Vec::with_capacity(rows.len());
            for of_episode in each() {
                let of_row = of_episode.map_or(&[][..], |stats| get(stats));
                values.append_slice(of_row);
                lengths.push(of_row.len());
            }
            let list = nested(Arc::new(values.finish()), lengths, *is_image);
            columns.push((format!("stats/{feature}/{name}"), list));
        }
        let mut counts = ListBuilder::new(Int64Builder::new()).with_field(element(DataType::Int64));
        for of_episode in each() {
            if let Some(stats) = of_episode {
                counts.values().append_value(stats.count as i64);
            }
            counts.append(of_episode.is_some());
        }
        columns.push((format!("stats/{feature}/count"), Arc::new(counts.finish())));
    }
    columns.push(("meta/episodes/chunk_index".to_owned(), ints(&|_, _| 0)));
    columns.push(("meta/episodes/file_index".to_owned(), ints(&|_, _| 0)));
    columns
}

/// A statistic's name and where it is.
type Getter = (&'static str, fn(&FeatureStats) -> &Vec<f64>);

/// A feature, whether it is an image, and its statistics that are columns.
type Stored<'n> = (&'n str, bool, Vec<Getter>);

/// The statistics that are vectors, in the order of [`FeatureStats::vectors`].
const STATISTICS: [Getter; 9] = [
    ("min", |s| &s.min),
    ("max", |s| &s.max),
    ("mean", |s| &s.mean),
    ("std", |s| &s.std),
    ("q01", |s| &s.q01),
    ("q10", |s| &s.q10),
    ("q50", |s| &s.q50),
    ("q90", |s| &s.q90),
    ("q99", |s| &s.q99),
];

/// `list<double>` of the given lengths, or `list<list<list<double>>>` of shape (length, 1, 1) for images; null where there is
/// nothing.
fn nested(values: Arc<Float64Array>, lengths: Vec<usize>, is_image: bool) -> ArrayRef {
    let mut inner: ArrayRef = values;
    if is_image {
        for _ in 0..2 {
            let ones = OffsetBuffer::from_lengths(vec![1; inner.len()]);
            inner = Arc::new(ListArray::new(element(inner.data_type().clone()), ones, inner, None));
        }
    }
    let nulls = lengths.contains(&0).then(|| lengths.iter().map(|&length| length > 0).collect());
    let offsets = OffsetBuffer::from_lengths(lengths);
    Arc::new(ListArray::new(element(inner.data_type().clone()), offsets, inner, nulls))
}

/// `meta/stats.json`.
pub(crate) fn write_stats(
    root: &Path,
    features: &[(String, bool)],
    stats: &BTreeMap<String, FeatureStats>,
) -> Result<WrittenFile> {
    let mut all = Map::new();
    for (name, is_image) in features {
        let mut one = Map::new();
        let of_feature = stats.get(name).ok_or_else(|| DatasetError::BadDataset {
            path: root.join("meta/stats.json"),
            object: name.clone(),
            expected: "statistics of every column".to_owned(),
            found: "none".to_owned(),
        })?;
        for (statistic, get) in STATISTICS {
            let values = get(of_feature);
            if values.is_empty() {
                continue;
            }
            let value = match is_image {
                true => Value::from(values.iter().map(|v| json!([[v]])).collect::<Vec<_>>()),
                false => json!(values),
            };
            one.insert(statistic.to_owned(), value);
        }
        one.insert("count".to_owned(), json!([of_feature.count]));
        all.insert(name.clone(), Value::Object(one));
    }
    write_json(root, "meta/stats.json", &Value::Object(all))
}

/// Where provenance lies.
pub(crate) const PROVENANCE_FILE: &str = "actrm/info.json";

/// `meta/info.json`, and `actrm/info.json` where there is provenance.
pub(crate) fn write_info(root: &Path, info: &Info) -> Result<Vec<WrittenFile>> {
    let mut files = vec![write_json(root, "meta/info.json", info)?];
    if let Some(provenance) = &info.actrm {
        files.push(write_json(root, PROVENANCE_FILE, provenance)?);
    }
    Ok(files)
}

/// Indented JSON with a final newline.
pub(crate) fn write_json<T: serde::Serialize>(root: &Path, relative: &str, value: &T) -> Result<WrittenFile> {
    let mut text = serde_json::to_string_pretty(value)
        .map_err(|source| DatasetError::Json { path: root.join(relative), source })?;
    text.push('\n');
    HashingFile::write_whole(root, relative, text.as_bytes())
}

/// JSON in which Python wrote numbers that JSON does not have (`NaN`, `Infinity`, `-Infinity`): they become null.
pub(crate) fn python_json(text: &[u8]) -> serde_json::Result<Value> {
    let mut plain = Vec::with_capacity(text.len());
    let (mut at, mut quoted) = (0, false);
    while at < text.len() {
        let word = [&b"NaN"[..], b"Infinity", b"-Infinity"].into_iter().find(|word| text[at..].starts_with(word));
        match (text[at], word) {
            (_, Some(word)) if !quoted => {
                plain.extend_from_slice(b"null");
                at += word.len();
                continue;
            }
            (b'\\', _) if quoted => {
                plain.extend_from_slice(&text[at..(at + 2).min(text.len())]);
                at += 2;
                continue;
            }
            (b'"', _) => quoted = !quoted,
            _ => {}
        }
        plain.push(text[at]);
        at += 1;
    }
    serde_json::from_slice(&plain)
}

/// Reads statistics as LeRobot or we write them: vectors, or 3 x 1 x 1 for images.
pub(crate) fn parse_stats(value: &Value) -> Result<BTreeMap<String, FeatureStats>, String> {
    let object = value.as_object().ok_or("expected an object of features")?;
    let mut all = BTreeMap::new();
    for (name, entry) in object {
        let vector = |statistic: &str| -> Result<Vec<f64>, String> {
            let found = entry.get(statistic).ok_or_else(|| format!("{name}: no {statistic}"))?;
            let mut out = Vec::new();
            flatten(found, &mut out).map_err(|what| format!("{name}: {statistic}: {what}"))?;
            Ok(out)
        };
        // sets written before quantiles were stored have the first five only
        let quantile = |statistic: &str| match entry.get(statistic) {
            None => Ok(Vec::new()),
            Some(_) => vector(statistic),
        };
        let count = vector("count")?;
        let stats = FeatureStats {
            min: vector("min")?,
            max: vector("max")?,
            mean: vector("mean")?,
            std: vector("std")?,
            count: count.first().copied().unwrap_or(0.0) as u64,
            q01: quantile("q01")?,
            q10: quantile("q10")?,
            q50: quantile("q50")?,
            q90: quantile("q90")?,
            q99: quantile("q99")?,
        };
        all.insert(name.clone(), stats);
    }
    Ok(all)
}

/// Whether all of them are numbers.
pub(crate) fn are_finite(stats: &FeatureStats) -> bool {
    STATISTICS.iter().all(|(_, get)| get(stats).iter().all(|value| value.is_finite()))
}

fn flatten(value: &Value, out: &mut Vec<f64>) -> Result<(), String> {
    match value {
        Value::Array(items) => items.iter().try_for_each(|item| flatten(item, out)),
        // as JSON writes what is not finite
        Value::Null => {
            out.push(f64::NAN);
            Ok(())
        }
        Value::Bool(b) => {
            out.push(f64::from(u8::from(*b)));
            Ok(())
        }
        other => {
            out.push(other.as_f64().ok_or_else(|| format!("expected a number, found {other}"))?);
            Ok(())
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn quantiles_are_columns_where_every_episode_has_them() {
        let (episodes, place) = (EpisodeStats::GROUP + 1, Place { folder: 0, file: 0 });
        let row = |from| EpisodeRow { length: 1, from, tasks: vec![0], place, videos: BTreeMap::new() };
        let rows: Vec<EpisodeRow> = (0..episodes).map(row).collect();
        let whole = FeatureStats::of(&[0.5_f64], 1).unwrap();
        let bare = FeatureStats { q01: Vec::new(), ..whole.clone() };
        for lacking in [0, episodes - 1, episodes] {
            let folder = tempfile::tempdir().unwrap();
            let mut each = EpisodeStats::new(folder.path());
            for episode in 0..episodes {
                let stats = if episode == lacking { &bare } else { &whole };
                each.add(&BTreeMap::from([("x".to_owned(), stats.clone())]), 1).unwrap();
            }
            write_episodes(folder.path(), &["t".to_owned()], &[("x".to_owned(), true)], &rows, &each, &[]).unwrap();
            let file = crate::lerobot::read::open(&folder.path().join(EPISODES_FILE)).unwrap();
            let has = |name: &str| file.schema().index_of(&format!("stats/x/{name}")).is_ok();
            assert_eq!(["mean", "q01", "q99"].map(has), [true, lacking == episodes, true]);
        }
    }

    #[test]
    fn statistics_are_read_to_the_last_bit() {
        let mut rng = crate::shuffle::SplitMix64::new(3, 0);
        for _ in 0..1000 {
            let number = rng.below(1 << 53) as f64 / 2_f64.powi(rng.below(80) as i32);
            let value = python_json(format!("[{number:e}, NaN]").as_bytes()).unwrap();
            assert_eq!(value[0].as_f64().map(f64::to_bits), Some(number.to_bits()), "{number:e}");
        }
    }
}
