//! One number of a data set's metadata edited at a time: opening refuses it or says so, or what is trained on stays as it was.

#![allow(clippy::unwrap_used)]

use crate::common::going;
use arrow_array::cast::AsArray;
use arrow_array::types::{Float64Type, Int64Type};
use arrow_array::{Array, ArrayRef, Float64Array, Int64Array, ListArray, RecordBatch};
use arrow_schema::DataType;
use dataset::{ConvertOptions, Dataset, convert};
use parquet::arrow::ArrowWriter;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use serde_json::{Value, json};
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A data set of robomimic's own demonstrations.
fn converted() -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("set");
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/lift_low_dim_3_demos.hdf5");
    // without the side folder, whose manifest only `validate` reads
    convert(&source, &out, &ConvertOptions { lossless: false, ..ConvertOptions::default() }, &mut |_, _| {}).unwrap();
    (dir, out)
}

/// Everything that training takes from a data set, or `None` where it is refused or opens with a note.
fn trained_on(root: &Path) -> Option<String> {
    let set = Dataset::open(root).ok().filter(|set| set.notes().is_empty())?;
    let columns: Vec<_> = set.column_names().map(|name| (name, set.column(name))).collect();
    let splits: Vec<_> = set.split_names().into_iter().map(|name| (name, set.split(name))).collect();
    let origin = set.provenance().map(|p| (&p.state_keys, &p.env_keys, &p.action, &p.source_sha256));
    Some(format!(
        "{columns:?} {splits:?} {:?} {:?} {} {:?} {origin:?}",
        set.episodes(),
        set.tasks(),
        set.fingerprint(),
        set.env()
    ))
}

/// Paths of the numbers in a JSON value, those that a text is made of (`0:3`) included.
fn numbers(value: &Value, path: String, found: &mut Vec<String>) {
    match value {
        Value::Number(_) => found.push(path),
        Value::String(text) if text.chars().any(|c| c.is_ascii_digit()) => found.push(path),
        Value::Array(items) => {
            items.iter().enumerate().for_each(|(i, item)| numbers(item, format!("{path}/{i}"), found));
        }
        Value::Object(entries) => {
            let escaped = |key: &str| key.replace('~', "~0").replace('/', "~1");
            // names of a vector's entries are words
            let others = entries.iter().filter(|(key, _)| *key != "names");
            others.for_each(|(key, item)| numbers(item, format!("{path}/{}", escaped(key)), found));
        }
        _ => {}
    }
}

/// Other numbers in the place of one.
fn edits(value: &Value) -> Vec<Value> {
    match value {
        Value::Number(number) => {
            let number = number.as_f64().unwrap();
            let others = [number + 1.0, number - 1.0, number * 2.0, 0.0, number + 1e-3];
            let mut all: Vec<Value> = others.into_iter().filter(|n| *n != number).map(|n| json!(n)).collect();
            all.extend(others.into_iter().filter(|n| n.fract() == 0.0 && *n != number).map(|n| json!(n as i64)));
            all
        }
        Value::String(text) => {
            let digits = text.char_indices().filter(|(_, c)| c.is_ascii_digit());
            let edited = digits.map(|(at, c)| {
                let other = (c as u8 - b'0' + 1) % 10;
                format!("{}{other}{}", &text[..at], &text[at + 1..])
            });
            edited.map(Value::from).collect()
        }
        _ => unreachable!("only numbers and texts are found"),
    }
}

/// Edits every number of a JSON file in turn; returns those that may have any value without being refused.
fn without_influence(root: &Path, file: &str) -> Vec<String> {
    let path = root.join(file);
    let text = std::fs::read(&path).unwrap();
    let whole: Value = serde_json::from_slice(&text).unwrap();
    let as_it_was = trained_on(root).expect("the data set opens");
    let mut places = Vec::new();
    numbers(&whole, String::new(), &mut places);
    let mut free = Vec::new();
    for place in &places {
        let mut taken = 0;
        for edit in edits(whole.pointer(place).unwrap()) {
            let mut edited = whole.clone();
            *edited.pointer_mut(place).unwrap() = edit.clone();
            std::fs::write(&path, serde_json::to_vec(&edited).unwrap()).unwrap();
            if let Some(now) = trained_on(root) {
                assert!(now == as_it_was, "{file}: {place} = {edit} changes what is trained on");
                taken += 1;
            }
        }
        if taken > 0 {
            free.push(place.clone());
        }
    }
    std::fs::write(&path, text).unwrap();
    free
}

#[test]
fn no_number_of_our_info_can_be_edited() {
    let (_dir, set) = converted();
    for (file, expected) in [("meta/info.json", "/total_frames"), ("actrm/info.json", "/masks/train/1")] {
        let mut places = Vec::new();
        let info: Value = serde_json::from_slice(&std::fs::read(set.join(file)).unwrap()).unwrap();
        numbers(&info, String::new(), &mut places);
        assert!(places.len() > 15 && places.iter().any(|p| p == expected), "{places:?}");
        assert_eq!(without_influence(&set, file), Vec::<String>::new());
        // spaces and the order of keys say nothing
        std::fs::write(set.join(file), serde_json::to_vec(&info).unwrap()).unwrap();
        Dataset::open(&set).unwrap();
    }
}

/// The set as earlier versions wrote it: provenance in `meta/info.json`.
fn with_provenance_inside(set: &Path) {
    let (path, beside) = (set.join("meta/info.json"), set.join("actrm/info.json"));
    let mut info: Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    info["actrm"] = serde_json::from_slice(&std::fs::read(&beside).unwrap()).unwrap();
    std::fs::write(&path, serde_json::to_vec_pretty(&info).unwrap()).unwrap();
    std::fs::remove_file(beside).unwrap();
}

#[test]
fn sets_with_their_provenance_in_info_json_open_as_before() {
    let (dir, set) = converted();
    let info: Value = serde_json::from_slice(&std::fs::read(set.join("meta/info.json")).unwrap()).unwrap();
    assert_eq!(info.get("actrm"), None);
    let as_it_was = trained_on(&set).unwrap();
    with_provenance_inside(&set);
    assert_eq!(trained_on(&set).unwrap(), as_it_was);
    assert_eq!(without_influence(&set, "meta/info.json"), Vec::<String>::new());
    // an edit moves it
    let (out, all) =
        (dir.path().join("out"), dataset::edit::Selection { episodes: vec![0, 1, 2], ..Default::default() });
    dataset::edit::keep(&set, &dataset::edit::Destination::New(out.clone()), &all, &mut going).unwrap();
    assert_eq!(trained_on(&out).unwrap(), as_it_was);
    assert!(out.join("actrm/info.json").exists());
}

#[test]
fn of_a_set_that_lerobot_wrote_the_sizes_of_files_can_be_edited_only() {
    let (_dir, set) = converted();
    let path = set.join("meta/info.json");
    let mut info: Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    std::fs::remove_file(set.join("actrm/info.json")).unwrap();
    for splits in [json!({"train": "0:3"}), json!({"train": "0:2", "valid": "2:3"})] {
        info["splits"] = splits;
        std::fs::write(&path, serde_json::to_vec(&info).unwrap()).unwrap();
        let mut free = without_influence(&set, "meta/info.json");
        // the type of a column that follows from the episodes and is not read
        free.retain(|place| !place.ends_with("/dtype"));
        // where files would lie: they are found by looking
        let expected =
            ["/chunks_size", "/codebase_version", "/data_files_size_in_mb", "/data_path", "/video_files_size_in_mb"];
        assert_eq!(free, expected);
    }
}

#[test]
fn numbers_of_the_statistics_are_not_trained_on() {
    let (_dir, set) = converted();
    assert!(without_influence(&set, "meta/stats.json").len() > 100);
}

/// The same array with `edit` done to its numbers; `None` where it has none.
fn edited(array: &ArrayRef, edit: i64) -> Option<ArrayRef> {
    Some(match array.data_type() {
        DataType::Int64 => {
            let values = array.as_primitive::<Int64Type>().values();
            // one row, the last
            let last = values.len() - 1;
            Arc::new(Int64Array::from_iter_values(
                values.iter().enumerate().map(|(i, v)| if i == last { v + edit } else { *v }),
            ))
        }
        DataType::Float64 => {
            let values = array.as_primitive::<Float64Type>().values();
            Arc::new(Float64Array::from_iter_values(values.iter().map(|v| v + edit as f64)))
        }
        DataType::List(field) => {
            let list = array.as_list::<i32>();
            let values = edited(list.values(), edit)?;
            Arc::new(ListArray::new(Arc::clone(field), list.offsets().clone(), values, None))
        }
        _ => return None,
    })
}

#[test]
fn numbers_of_the_episodes() {
    for ours in [true, false] {
        let (_dir, set) = converted();
        if !ours {
            std::fs::remove_file(set.join("actrm/info.json")).unwrap();
        }
        let as_it_was = trained_on(&set).unwrap();
        let path = set.join("meta/episodes/chunk-000/file-000.parquet");
        let mut reader = ParquetRecordBatchReaderBuilder::try_new(File::open(&path).unwrap()).unwrap().build().unwrap();
        let batch = reader.next().unwrap().unwrap();
        let mut refused = Vec::new();
        for (at, field) in batch.schema().fields().iter().enumerate() {
            for edit in [-1, 1, 100] {
                let Some(column) = edited(batch.column(at), edit) else { continue };
                let mut columns = batch.columns().to_vec();
                columns[at] = column;
                let changed = RecordBatch::try_new(batch.schema(), columns).unwrap();
                let mut writer = ArrowWriter::try_new(File::create(&path).unwrap(), batch.schema(), None).unwrap();
                writer.write(&changed).unwrap();
                writer.close().unwrap();
                match trained_on(&set) {
                    Some(now) => assert!(now == as_it_was, "{}: changes what is trained on", field.name()),
                    None => refused.push(field.name().clone()),
                }
            }
        }
        refused.dedup();
        assert_eq!(refused, ["episode_index", "length", "dataset_from_index", "dataset_to_index"], "ours: {ours}");
    }
}
