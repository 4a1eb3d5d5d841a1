//! Data sets whose columns are of other types or forms than ours.

#![allow(clippy::unwrap_used)]

use crate::common::{copy, going};
use crate::planting::*;
use arrow_array::cast::AsArray;
use arrow_array::types::Float32Type;
use arrow_array::{
    Array as _, ArrayRef, BinaryArray, FixedSizeListArray, Float64Array, Int64Array, RecordBatch, StringArray,
    StructArray,
};
use arrow_cast::cast;
use arrow_schema::{DataType, Field};
use dataset::edit::{Destination, Repair, keep, merge, repair};
use dataset::{Array, ConvertOptions, Dataset, Demo, RobomimicWriter, WriteOptions, convert, export, verify};
use serde_json::json;
use std::path::Path;
use std::sync::Arc;

#[test]
fn statistics_of_times_of_a_clock_and_of_large_numbers_follow_from_them() {
    let dir = tempfile::tempdir().unwrap();
    let (set, out) = (dir.path().join("set"), dir.path().join("out"));
    sound(&set);
    std::fs::remove_dir_all(set.join("actrm")).unwrap();
    edit_json(&set, INFO, |info| info["features"]["next.reward"]["dtype"] = json!("uint64"));
    for file in
        ["data/chunk-000/file-000.parquet", "data/chunk-000/file-001.parquet", "data/chunk-000/file-002.parquet"]
    {
        edit_table(&set, file, |table| {
            let times = |column: &ArrayRef| -> ArrayRef {
                let times = column.as_primitive::<Float32Type>().values();
                Arc::new(Float64Array::from_iter_values(times.iter().map(|&time| 1.7e9 + f64::from(time))))
            };
            let table = with_column(&table, "timestamp", times);
            let rows = table.num_rows() as u64;
            let large = |_: &ArrayRef| -> ArrayRef {
                Arc::new(arrow_array::UInt64Array::from_iter_values((0..rows).map(|row| u64::MAX - (row << 50))))
            };
            with_column(&table, "next.reward", large)
        });
    }
    keep(&set, &Destination::New(out.clone()), &numbers(0..DEMOS), &mut going).unwrap();
    let stats = Dataset::open(&out).unwrap().stats().clone();
    assert!(stats["timestamp"].std[0] > 0.01, "{:?}", stats["timestamp"]);
    assert_eq!(stats["next.reward"].max, [u64::MAX as f64]);
    let file = dir.path().join("through.hdf5");
    export(&out, &file, &WriteOptions::default(), &mut quiet).unwrap();
    let refused = convert(&file, &dir.path().join("again"), &ConvertOptions::default(), &mut quiet).unwrap_err();
    assert!(refused.to_string().contains("rewards: expected whole numbers below 2^63"), "{refused}");
    let problems = problems(&verify(&out, &mut quiet).unwrap());
    assert!(matches!(problems.as_slice(), [times] if times.starts_with("timestamps are")), "{problems:?}");
}

#[test]
fn large_numbers_close_together_are_sound_and_stay_as_they_are() {
    let dir = tempfile::tempdir().unwrap();
    let set = dir.path().join("set");
    sound(&set);
    std::fs::remove_dir_all(set.join("actrm")).unwrap();
    for dtype in ["float64", "int64"] {
        edit_json(&set, INFO, |info| info["features"]["next.reward"]["dtype"] = json!(dtype));
        for (number, first) in [0.0, 8.0, 16.0].into_iter().enumerate() {
            edit_table(&set, &format!("data/chunk-000/file-00{number}.parquet"), |table| {
                let seconds = |row: usize| 1.7e9 + first + row as f64 * 0.05;
                let rows = 0..table.num_rows();
                with_column(&table, "next.reward", |_| match dtype {
                    "float64" => Arc::new(Float64Array::from_iter_values(rows.clone().map(seconds))),
                    _ => Arc::new(Int64Array::from_iter_values(rows.clone().map(|row| (seconds(row) * 1e9) as i64))),
                })
            });
        }
        // statistics as whoever wrote the numbers has them
        let out = dir.path().join(dtype);
        keep(&set, &Destination::New(out.clone()), &numbers(0..DEMOS), &mut going).unwrap();
        assert_eq!(problems(&verify(&out, &mut quiet).unwrap()), Vec::<String>::new());
        let report = repair(&out, &Destination::InPlace, Repair::default(), &mut going).unwrap();
        assert!(report.made.is_none(), "{report:?}");
        let found = &Dataset::open(&out).unwrap().exact_statistics_of(&[0, 1]).unwrap()["next.reward"];
        let unit = if dtype == "float64" { 1.0 } else { 1e9 };
        assert!((found.std[0] / unit - 1.1543).abs() < 1e-3, "{found:?}");
        edit_json(&out, STATS, |stats| stats["next.reward"]["max"] = json!([(1.7e9 + 90.0) * unit]));
        assert!(problems(&verify(&out, &mut quiet).unwrap())[0].contains("next.reward: max"));
    }
}

#[test]
fn doubles_that_went_through_robomimic_are_edited() {
    let dir = tempfile::tempdir().unwrap();
    let (set, file) = (dir.path().join("set"), dir.path().join("through.hdf5"));
    let (again, out) = (dir.path().join("again"), dir.path().join("out"));
    sound(&set);
    std::fs::remove_dir_all(set.join("actrm")).unwrap();
    edit_json(&set, INFO, |info| info["features"]["next.reward"]["dtype"] = json!("float64"));
    for number in 0..3 {
        edit_table(&set, &format!("data/chunk-000/file-00{number}.parquet"), |table| {
            let rows = table.num_rows();
            with_column(&table, "next.reward", |_| Arc::new(Float64Array::from_iter_values((0..rows).map(noise))))
        });
    }
    export(&set, &file, &WriteOptions::default(), &mut quiet).unwrap();
    convert(&file, &again, &ConvertOptions::default(), &mut quiet).unwrap();
    keep(&again, &Destination::New(out.clone()), &numbers(0..DEMOS), &mut going).unwrap();
    assert_eq!(Dataset::open(&out).unwrap().fingerprint(), Dataset::open(&again).unwrap().fingerprint());
}

#[test]
fn other_types_are_cast_as_lerobot_casts_them() {
    let dir = tempfile::tempdir().unwrap();
    let set = dir.path().join("set");
    sound(&set);
    std::fs::remove_dir_all(set.join("actrm")).unwrap();
    let before = Dataset::open(&set).unwrap();
    for file in [DATA, LATER] {
        for (name, to) in [("next.done", DataType::Int64), ("next.reward", DataType::Float64)] {
            edit_table(&set, file, |table| with_column(&table, name, |column| cast(column, &to).unwrap()));
        }
    }
    let after = Dataset::open(&set).unwrap();
    assert_eq!(after.notes().len(), 2, "{:?}", after.notes());
    assert!(after.notes()[0].contains("next.done: expected bool, as info.json says, found int64"));
    assert_eq!(
        (before.column("next.done"), before.column("next.reward")),
        (after.column("next.done"), after.column("next.reward"))
    );
    assert_eq!(before.fingerprint(), after.fingerprint());
    // whole numbers that the stated type holds, and one that it does not
    let out = dir.path().join("out.hdf5");
    edit_json(&set, INFO, |info| info["features"]["next.reward"]["dtype"] = json!("int8"));
    for (most, file) in [(100, &out), (1000, &dir.path().join("no.hdf5"))] {
        for number in 0..3 {
            edit_table(&set, &format!("data/chunk-000/file-00{number}.parquet"), |table| {
                let rewards = Int64Array::from_iter_values((0..table.num_rows() as i64).map(|row| row.min(1) * most));
                with_column(&table, "next.reward", |_| Arc::new(rewards.clone()))
            });
        }
        for found in [Dataset::open(&set).map(drop), export(&set, file, &WriteOptions::default(), &mut quiet).map(drop)]
        {
            match most {
                100 => found.unwrap(),
                _ => {
                    let text = found.unwrap_err().to_string();
                    assert!(
                        text.contains("column next.reward") && text.contains("int8") && text.contains("1000"),
                        "{text}"
                    );
                }
            }
        }
    }
    // texts are no numbers
    edit_table(&set, DATA, |table| with_column(&table, "next.reward", |column| cast(column, &DataType::Utf8).unwrap()));
    let refused = Dataset::open(&set).unwrap_err().to_string();
    assert!(refused.contains("next.reward") && refused.contains("found utf8"), "{refused}");
}

#[test]
fn index_columns_are_written_flat_and_stated() {
    let dir = tempfile::tempdir().unwrap();
    let (set, out) = (dir.path().join("set"), dir.path().join("out"));
    sound(&set);
    std::fs::remove_dir_all(set.join("actrm")).unwrap();
    let expected = Dataset::open(&set).unwrap().frame_tasks().unwrap();
    let names = ["timestamp", "task_index", "index"];
    for number in 0..3 {
        for name in names {
            edit_table(&set, &format!("data/chunk-000/file-00{number}.parquet"), |table| {
                with_column(&table, name, |column| {
                    let kind = Arc::new(Field::new("element", column.data_type().clone(), false));
                    Arc::new(FixedSizeListArray::new(kind, 1, Arc::clone(column), None))
                })
            });
        }
    }
    edit_json(&set, INFO, |info| drop(info["features"].as_object_mut().unwrap().remove("index")));
    assert!(verify(&set, &mut quiet).is_ok());
    let report = keep(&set, &Destination::New(out.clone()), &numbers(0..DEMOS), &mut going).unwrap();
    assert!(report.notes.iter().any(|note| note.starts_with("column index: ") && note.ends_with("states it")));
    let table = read_table(&out.join(DATA));
    assert!(names.iter().all(|name| table.column_by_name(name).unwrap().data_type().is_numeric()), "{table:?}");
    let again = Dataset::open(&out).unwrap();
    assert_eq!((again.notes(), again.frame_tasks().unwrap()), (&[][..], expected));
    assert!(again.info().features.0.iter().any(|(name, _)| name == "index"));
}

#[test]
fn texts_are_kept_once_and_may_be_missing() {
    let dir = tempfile::tempdir().unwrap();
    let set = dir.path().join("set");
    sound(&set);
    std::fs::remove_dir_all(set.join("actrm")).unwrap();
    edit_json(&set, INFO, |info| info["features"]["note"] = json!({"dtype": "string", "shape": [1], "names": null}));
    for number in 0..3 {
        edit_table(&set, &format!("data/chunk-000/file-00{number}.parquet"), |table| {
            let text = |row| [Some("reach"), None, Some("grasp")][(row + number) % 3];
            let texts = StringArray::from_iter((0..table.num_rows()).map(text));
            let note: (String, ArrayRef) = ("note".to_owned(), Arc::new(texts));
            let schema = table.schema();
            let names = schema.fields().iter().map(|field| field.name().clone());
            let columns = names.zip(table.columns().to_vec()).chain([note]);
            RecordBatch::try_from_iter_with_nullable(columns.map(|(name, column)| (name, column, true))).unwrap()
        });
    }
    let texts = Dataset::open(&set).unwrap().texts().unwrap().remove("note").unwrap();
    assert_eq!((texts.texts.len(), texts.frames.len()), (2, DEMOS * FRAMES));
    let first = DEMOS * FRAMES / 3;
    let found: Vec<_> = [0, 1, 2, first, first + 2, DEMOS * FRAMES].map(|frame| texts.get(frame)).into();
    assert_eq!(found, [Some("reach"), None, Some("grasp"), None, Some("reach"), None]);
}

#[test]
fn images_stored_by_path_are_read_and_embedded_by_edits() {
    const CAMERA: &str = "observation.images.agentview";
    let dir = tempfile::tempdir().unwrap();
    let (file, set) = (dir.path().join("a.hdf5"), dir.path().join("set"));
    let mut writer = RobomimicWriter::create(&file, &WriteOptions::default()).unwrap();
    writer.set_root(&Demo::default()).unwrap();
    for number in 0..3_u8 {
        let mut demo = Demo { id: format!("demo_{number}"), ..Demo::default() };
        for (key, width) in [("robot0_eef_pos", 3), ("robot0_eef_quat", 4), ("robot0_gripper_qpos", 2)] {
            demo.datasets.insert(format!("obs/{key}"), Array::from_f64(vec![5, width], &vec![0.5; 5 * width]));
        }
        demo.datasets.insert("actions".to_owned(), Array::from_f64(vec![5, 7], &[0.25; 35]));
        let pixels: Vec<u8> = (0..5 * 8 * 8 * 3).map(|i| (i % 251) as u8 ^ (number * 16)).collect();
        demo.datasets.insert("obs/agentview_image".to_owned(), Array::from_u8(vec![5, 8, 8, 3], &pixels));
        writer.add_demo(&demo).unwrap();
    }
    writer.finish().unwrap();
    convert(&file, &set, &ConvertOptions { fps: Some(20.0), ..ConvertOptions::default() }, &mut quiet).unwrap();
    std::fs::remove_dir_all(set.join("actrm")).unwrap();
    let before = Dataset::open(&set).unwrap().pictures(CAMERA).unwrap();
    std::fs::create_dir(set.join("images")).unwrap();
    let by_path = |column: &ArrayRef| -> ArrayRef {
        let images = column.as_struct().column(0).as_binary::<i32>();
        let path = |row: usize| format!("images/frame-{row:06}.png");
        (0..images.len()).for_each(|row| std::fs::write(set.join(path(row)), images.value(row)).unwrap());
        let bytes: ArrayRef = Arc::new(BinaryArray::from_iter((0..images.len()).map(|_| None::<&[u8]>)));
        let paths: ArrayRef = Arc::new(StringArray::from_iter_values((0..images.len()).map(path)));
        Arc::new(StructArray::try_from(vec![("bytes", bytes), ("path", paths)]).unwrap())
    };
    edit_table(&set, DATA, |table| with_column(&table, CAMERA, by_path));
    assert_eq!(Dataset::open(&set).unwrap().pictures(CAMERA).unwrap(), before);
    assert_eq!(problems(&verify(&set, &mut quiet).unwrap()), Vec::<String>::new());
    let out = dir.path().join("out");
    keep(&set, &Destination::New(out.clone()), &numbers(0..3), &mut going).unwrap();
    assert_eq!(Dataset::open(&out).unwrap().pictures(CAMERA).unwrap(), before);
    std::fs::remove_file(set.join("images/frame-000007.png")).unwrap();
    let refused = Dataset::open(&set).unwrap().pictures(CAMERA).unwrap_err().to_string();
    assert!(refused.contains(CAMERA) && refused.contains("images/frame-000007.png"), "{refused}");
}

#[test]
fn language_columns_are_carried_through_edits() {
    let dir = tempfile::tempdir().unwrap();
    let fixture = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/lerobot_language");
    assert_eq!(problems(&verify(&fixture, &mut quiet).unwrap()), Vec::<String>::new());
    let out = dir.path().join("out");
    keep(&fixture, &Destination::New(out.clone()), &numbers(1..3), &mut going).unwrap();
    assert_eq!(problems(&verify(&out, &mut quiet).unwrap()), Vec::<String>::new());
    let (before, after) = (read_table(&fixture.join(DATA)), read_table(&out.join(DATA)));
    let from = before.num_rows() - after.num_rows();
    for name in ["language_persistent", "language_events"] {
        let whole = before.column_by_name(name).unwrap();
        assert_eq!(&whole.slice(from, after.num_rows()), after.column_by_name(name).unwrap(), "{name}");
    }
}

#[test]
fn what_other_programs_say_of_an_episode_goes_with_it() {
    let dir = tempfile::tempdir().unwrap();
    let [one, two, part, both] = ["one", "two", "part", "both"].map(|name| dir.path().join(name));
    let texts = |name: &str, rows: std::ops::Range<usize>| rows.map(|row| format!("{name} {row}")).collect::<Vec<_>>();
    for (set, names) in [(&one, &["operator", "scene"][..]), (&two, &["operator"])] {
        copy(&Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/lerobot_video_av1"), set);
        edit_table(set, EPISODES, |table| {
            let schema = table.schema();
            let own = schema.fields().iter().map(|field| field.name().as_str()).zip(table.columns().to_vec());
            let others = names.iter().map(|&name| -> (&str, ArrayRef) {
                (name, Arc::new(StringArray::from(texts(name, 0..table.num_rows()))))
            });
            RecordBatch::try_from_iter(own.chain(others)).unwrap()
        });
        edit_json(set, INFO, |info| {
            info["splits"] = json!({"train": "0:1", "val": "1:3"});
            (info["recorder"], info["site"]) = (json!("rig"), json!(names.len()));
        });
    }
    let column = |set: &Path, name: &str| read_table(&set.join(EPISODES)).column_by_name(name).unwrap().clone();
    keep(&one, &Destination::New(part.clone()), &numbers(1..3), &mut going).unwrap();
    for name in ["operator", "scene"] {
        assert_eq!(column(&part, name).as_string::<i32>(), &StringArray::from(texts(name, 1..3)));
    }
    let notes = export(&part, &dir.path().join("part.hdf5"), &WriteOptions::default(), &mut quiet).unwrap().notes;
    assert!(notes.iter().any(|note| note.ends_with("are left out: operator, scene")), "{notes:?}");
    // null where a set lacks the column
    let notes = merge(&[one, two], &both, &mut going).unwrap().notes;
    let twice = [texts("operator", 0..3), texts("operator", 0..3)].concat();
    assert_eq!(column(&both, "operator").as_string::<i32>(), &StringArray::from(twice));
    let scenes = texts("scene", 0..3).into_iter().map(Some).chain([None, None, None]);
    assert_eq!(column(&both, "scene").as_string::<i32>(), &scenes.collect::<StringArray>());
    let info: serde_json::Value = serde_json::from_slice(&std::fs::read(both.join(INFO)).unwrap()).unwrap();
    assert_eq!((&info["recorder"], info.get("site")), (&json!("rig"), None));
    assert!(notes.iter().any(|note| note.starts_with("the sets differ in site of meta/info.json")), "{notes:?}");
    // no range holds the splits of both
    assert!(notes.iter().any(|note| note.starts_with("splits (train, val) are left out")), "{notes:?}");
    assert_eq!(problems(&verify(&both, &mut quiet).unwrap()), Vec::<String>::new());
}

#[test]
fn a_file_states_no_columns_that_no_set_can_have() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("a.hdf5");
    let column = |name: &str, key: &str, shape: &[usize]| {
        let dtype = if shape.len() == 3 { "image" } else { "float32" };
        json!({"name": name, "key": key, "feature": {"dtype": dtype, "shape": shape, "names": null}})
    };
    let state = || column("observation.state", "obs/qpos", &[2]);
    for (more, said) in [
        (
            column("../../x", "obs/cam_image", &[8, 8, 3]),
            "expected names that stay inside the folder, found \"../../x\"",
        ),
        (column("/x", "obs/cam_image", &[8, 8, 3]), "expected names that stay inside the folder, found \"/x\""),
        (state(), "expected each name once, found observation.state twice"),
        (column("timestamp", "obs/qpos", &[2]), "features.timestamp.shape: expected [1], found [2]"),
        (column("index", "rewards", &[1]), "expected each name once, found index twice"),
    ] {
        let stated =
            json!({"fps": 10, "environment": true, "columns": [column("action", "actions", &[3]), state(), more]});
        let mut writer = RobomimicWriter::create(&file, &WriteOptions::default()).unwrap();
        let mut demo = Demo { id: "demo_0".to_owned(), ..Demo::default() };
        for (key, shape) in [("actions", vec![4, 3]), ("obs/qpos", vec![4, 2]), ("rewards", vec![4])] {
            let values = vec![0.5; shape.iter().product()];
            demo.datasets.insert(key.to_owned(), Array::from_f64(shape, &values));
        }
        let pixels = Array::from_u8(vec![4, 8, 8, 3], &[7; 4 * 8 * 8 * 3]);
        demo.datasets.insert("obs/cam_image".to_owned(), pixels);
        writer.set_data_attr("lerobot", &Array::from_str(&stated.to_string())).unwrap();
        writer.add_demo(&demo).unwrap();
        writer.finish().unwrap();
        let refused = convert(&file, &dir.path().join("out"), &ConvertOptions::default(), &mut quiet).unwrap_err();
        let text = refused.to_string();
        assert!(text.contains("a.hdf5: data: attribute lerobot: features") && text.contains(said), "{text}");
        std::fs::remove_file(&file).unwrap();
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
    }
}
