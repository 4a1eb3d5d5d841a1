//! Queries over a converted file.

#![allow(clippy::unwrap_used)]

use dataset::{ConvertOptions, Dataset, convert};
use serde_json::json;
use std::path::Path;

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

#[test]
fn a_wrong_query_names_what_is_wrong() {
    let dir = tempfile::tempdir().unwrap();
    let set = set(dir.path());
    for (sql, word) in [("SELECT nothing FROM frames", "nothing"), ("SELECT * FROM steps", "steps")] {
        let error = query::query(&set, sql).unwrap_err();
        let source = std::error::Error::source(&error).unwrap().to_string();
        assert!(error.to_string().contains(sql), "{error}");
        assert!(source.contains(word), "{source}");
    }
    for (sql, found) in [("hello", "\"hello\""), ("DROP TABLE frames", "\"DROP\""), ("", "\"\"")] {
        let error = query::query(&set, sql).unwrap_err().to_string();
        assert!(error.contains("SELECT") && error.contains(found), "{error}");
    }
    assert!(query::tables(&set).unwrap().iter().any(|(t, c, _)| *t == "frames" && c == "object_3"));
}
