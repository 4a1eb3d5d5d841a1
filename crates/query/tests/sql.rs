//! Queries over a converted file.

#![allow(clippy::unwrap_used)]

use arrow_array::{ArrayRef, Float32Array, Int64Array, RecordBatch, StringArray};
use dataset::{ConvertOptions, Dataset, convert};
use parquet::arrow::ArrowWriter;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use serde_json::json;
use std::fs::File;
use std::path::Path;
use std::sync::Arc;

fn set(dir: &Path) -> Dataset {
    let fixture = Path::new(env!("CARGO_MANIFEST_DIR")).join("../dataset/tests/fixtures/lift_low_dim_3_demos.hdf5");
    convert(&fixture, &dir.join("set"), &ConvertOptions::default(), &mut |_, _| {}).unwrap();
    Dataset::open(&dir.join("set")).unwrap()
}

#[test]
fn sums_counts_and_joins_agree_with_the_columns() {
    let dir = tempfile::tempdir().unwrap();
    let set = set(dir.path());
    let one = |sql: &str| query::query(&set, sql).unwrap().rows[0][0].clone();
    assert_eq!(one("SELECT COUNT(*) FROM frames"), json!(166));
    assert_eq!(one("SELECT SUM(length) FROM episodes"), json!(166));
    assert_eq!(one("SELECT demo FROM episodes WHERE episode_index = 1"), json!("demo_2"));
    assert_eq!(one("SELECT COUNT(*) FROM episodes WHERE success AND in_train"), json!(3));
    let action = set.column("action").unwrap();
    let most = action.data.iter().skip(2).step_by(7).copied().fold(f32::MIN, f32::max);
    let found = one("SELECT MAX(action_2) FROM frames").as_f64().unwrap();
    assert!((found - f64::from(most)).abs() < 1e-6, "{found} {most}");
    let longest = query::query(
        &set,
        "SELECT e.demo, COUNT(*) AS n FROM frames f JOIN episodes e ON f.episode_index = e.episode_index GROUP BY e.demo ORDER BY n DESC",
    )
    .unwrap();
    assert_eq!(longest.columns, ["demo", "n"]);
    let lengths: Vec<i64> = longest.rows.iter().map(|r| r[1].as_i64().unwrap()).collect();
    let mut expected: Vec<i64> = set.episodes().iter().map(|e| e.length as i64).collect();
    expected.sort_unstable_by(|a, b| b.cmp(a));
    assert_eq!(lengths, expected);
}

#[test]
fn no_number_takes_the_name_of_a_feature() {
    let dir = tempfile::tempdir().unwrap();
    drop(set(dir.path()));
    let path = dir.path().join("set/meta/info.json");
    std::fs::remove_dir_all(dir.path().join("set/actrm")).unwrap();
    let mut info: serde_json::Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    info["features"]["observation.state"]["names"][1] = json!("next_reward");
    info["features"]["observation.state"]["names"][2] = json!("action_0");
    std::fs::write(&path, info.to_string()).unwrap();
    let set = Dataset::open(&dir.path().join("set")).unwrap();
    let sum =
        |column: &str| query::query(&set, &format!("SELECT SUM({column}) FROM frames")).unwrap().rows[0][0].as_f64();
    let expected = |name: &str, d: usize| {
        let column = set.column(name).unwrap();
        column.data.iter().skip(d).step_by(column.dim).sum::<f32>()
    };
    for (column, name, d) in
        [("next_reward", "next.reward", 0), ("action_0", "action", 0), ("observation_state_1", "observation.state", 1)]
    {
        assert!((sum(column).unwrap() - f64::from(expected(name, d))).abs() < 1e-3, "{column}");
    }
}

/// LeRobot calls joints the same in actions and in states.
#[test]
fn a_name_of_two_features_is_the_name_of_neither() {
    let dir = tempfile::tempdir().unwrap();
    drop(set(dir.path()));
    let path = dir.path().join("set/meta/info.json");
    std::fs::remove_dir_all(dir.path().join("set/actrm")).unwrap();
    let mut info: serde_json::Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    for feature in ["action", "observation.state"] {
        info["features"][feature]["names"][0] = json!("joint_0_pos");
    }
    std::fs::write(&path, info.to_string()).unwrap();
    let tables = query::tables(&Dataset::open(&dir.path().join("set")).unwrap()).unwrap();
    let has = |name: &str| tables.iter().any(|(_, column, _)| column == name);
    assert!(has("action_0") && has("observation_state_0") && !has("joint_0_pos"), "{tables:?}");
}

#[test]
fn texts_are_columns_and_what_is_no_number_is_not_missing() {
    let fixture = Path::new(env!("CARGO_MANIFEST_DIR")).join("../dataset/tests/fixtures/lerobot_texts");
    let set = Dataset::open(&fixture).unwrap();
    let rows = |sql: &str| query::query(&set, sql).unwrap().rows;
    assert_eq!(rows("SELECT note FROM frames WHERE index = 3"), [[json!("step 0 of 1")]]);
    let odd = "/* numbers */ SELECT 0.0 / 0.0 AS nan, 1.0 / 0.0 AS more, -1.0 / 0.0 AS less -- of floats";
    assert_eq!(rows(odd), [[json!("NaN"), json!("inf"), json!("-inf")]]);
    let single = "-- float32\nSELECT CAST(-1.0 / 0.0 AS REAL) AS less";
    assert_eq!(rows(single), [[json!("-inf")]]);
}

/// A set that another program wrote: times of a clock, nanoseconds, two tasks in an episode.
#[test]
fn numbers_times_and_tasks_are_those_of_the_frames() {
    let dir = tempfile::tempdir().unwrap();
    drop(set(dir.path()));
    let root = dir.path().join("set");
    std::fs::remove_dir_all(root.join("actrm")).unwrap();
    let path = root.join("meta/info.json");
    let mut info: serde_json::Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    info["features"]["next.reward"]["dtype"] = json!("int64");
    std::fs::write(&path, info.to_string()).unwrap();
    let nanoseconds = |row: usize| 1_700_000_000_000_000_001 + row as i64;
    rewrite(&root.join("data/chunk-000/file-000.parquet"), &|name, rows| -> Option<ArrayRef> {
        match name {
            "next.reward" => Some(Arc::new(Int64Array::from_iter_values((0..rows).map(nanoseconds)))),
            "timestamp" => Some(Arc::new(Float32Array::from_iter_values((0..rows).map(|row| row as f32)))),
            "task_index" => Some(Arc::new(Int64Array::from_iter_values((0..rows as i64).map(|row| row % 2)))),
            _ => None,
        }
    });
    rewrite(&root.join("meta/tasks.parquet"), &|name, _| -> Option<ArrayRef> {
        match name {
            "task_index" => Some(Arc::new(Int64Array::from(vec![0, 1]))),
            _ => Some(Arc::new(StringArray::from(vec!["open", "close"]))),
        }
    });
    let set = Dataset::open(&root).unwrap();
    let rows = query::query(&set, "SELECT next_reward, timestamp, task FROM frames ORDER BY index LIMIT 2").unwrap();
    let expected = [json!([nanoseconds(0), 0.0, "open"]), json!([nanoseconds(1), 1.0, "close"])];
    assert_eq!(rows.rows.into_iter().map(serde_json::Value::from).collect::<Vec<_>>(), expected);
    let returns = query::query(&set, "SELECT \"return\" FROM episodes ORDER BY episode_index").unwrap();
    let sum = |e: &dataset::EpisodeMeta| (e.from..e.to).map(|row| nanoseconds(row) as f64).sum::<f64>();
    let sums: Vec<f64> = returns.rows.iter().map(|row| row[0].as_f64().unwrap()).collect();
    assert_eq!(sums, set.episodes().iter().map(sum).collect::<Vec<_>>());
    let lists = query::query(&set, "SELECT ARRAY_AGG(episode_index) AS all, COUNT(*) AS n FROM episodes").unwrap();
    assert_eq!(lists.rows, [[json!([0, 1, 2]), json!(3)]]);
}

/// A Parquet file with some of its columns in other values.
fn rewrite(path: &Path, column: &dyn Fn(&str, usize) -> Option<ArrayRef>) {
    let reader = ParquetRecordBatchReaderBuilder::try_new(File::open(path).unwrap()).unwrap().with_batch_size(1 << 20);
    let batch = reader.build().unwrap().next().unwrap().unwrap();
    let schema = batch.schema();
    let columns =
        schema.fields().iter().zip(batch.columns()).map(|(field, old)| {
            (field.name(), column(field.name(), batch.num_rows()).unwrap_or_else(|| Arc::clone(old)))
        });
    let batch = RecordBatch::try_from_iter(columns).unwrap();
    let mut writer = ArrowWriter::try_new(File::create(path).unwrap(), batch.schema(), None).unwrap();
    writer.write(&batch).unwrap();
    writer.close().unwrap();
}

#[test]
fn a_wrong_query_names_what_is_wrong() {
    let dir = tempfile::tempdir().unwrap();
    let set = set(dir.path());
    let cases = [
        ("SELECT nothing FROM frames", "nothing"),
        ("SELECT * FROM steps", "steps"),
        ("SELECT length, length FROM episodes", "length"),
    ];
    for (sql, word) in cases {
        let error = query::query(&set, sql).unwrap_err();
        let source = std::error::Error::source(&error).unwrap().to_string();
        assert!(error.to_string().contains(sql), "{error}");
        assert!(source.contains(word) && !source.contains('\n'), "{source}");
    }
    for (sql, found) in [("hello", "\"hello\""), ("DROP TABLE frames", "\"DROP\""), ("", "\"\"")] {
        let error = query::query(&set, sql).unwrap_err().to_string();
        assert!(error.contains("SELECT") && error.contains(found), "{error}");
    }
    assert!(query::tables(&set).unwrap().iter().any(|(t, c, _)| *t == "frames" && c == "object_3"));
}
