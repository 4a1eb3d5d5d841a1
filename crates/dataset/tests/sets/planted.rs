//! Faults planted in sound data sets, one at a time: `verify` names each, and `edit repair` corrects those that follow from the
//! frames.

#![allow(clippy::unwrap_used)]

use crate::common::{copy, files};
use arrow_array::builder::{ListBuilder, StringBuilder};
use arrow_array::cast::AsArray;
use arrow_array::types::{Float32Type, Float64Type, Int64Type};
use arrow_array::{
    Array as _, ArrayRef, BinaryArray, FixedSizeListArray, Float32Array, Float64Array, Int64Array, RecordBatch,
    StringArray, StructArray,
};
use arrow_cast::cast;
use arrow_schema::{DataType, Field};
use arrow_select::concat::concat_batches;
use arrow_select::take::take_record_batch;
use dataset::edit::{Destination, Repair, Selection, keep, repair};
use dataset::{
    Array, Check, ConvertOptions, Dataset, Demo, RobomimicWriter, WriteOptions, convert, export, verify, verify_within,
};
use parquet::arrow::ArrowWriter;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use parquet::file::properties::WriterProperties;
use serde_json::{Value, json};
use std::fs::File;
use std::path::Path;
use std::sync::Arc;

const DATA: &str = "data/chunk-000/file-000.parquet";
const LATER: &str = "data/chunk-000/file-001.parquet";
const EPISODES: &str = "meta/episodes/chunk-000/file-000.parquet";
const TASKS: &str = "meta/tasks.parquet";
const INFO: &str = "meta/info.json";
const STATS: &str = "meta/stats.json";
const DEMOS: usize = 12;
const FRAMES: usize = 40;

fn quiet(_: u64, _: u64) {}

/// Numbers from -1 to 1 that do not compress.
fn noise(i: usize) -> f64 {
    let mut x = (i as u64 + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    (x >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
}

/// Twelve demos of three tasks, four in each of three files.
fn sound(out: &Path) {
    let file = out.with_extension("hdf5");
    let mut writer = RobomimicWriter::create(&file, &WriteOptions::default()).unwrap();
    writer.set_root(&Demo::default()).unwrap();
    for number in 0..DEMOS {
        let mut demo = Demo { id: format!("demo_{number}"), ..Demo::default() };
        demo.attrs.insert("num_samples".to_owned(), Array::from_i64(vec![], &[FRAMES as i64]));
        demo.attrs.insert("ep_meta".to_owned(), Array::from_str(&format!("{{\"lang\": \"task {}\"}}", number % 3)));
        for (key, width) in [("robot0_eef_pos", 3), ("robot0_eef_quat", 4), ("robot0_gripper_qpos", 2), ("object", 4)] {
            let values: Vec<f64> = (0..FRAMES * width).map(|i| noise(1000 * (number + 20 * width) + i)).collect();
            demo.datasets.insert(format!("obs/{key}"), Array::from_f64(vec![FRAMES, width], &values));
        }
        let actions: Vec<f64> = (0..FRAMES * 7).map(|i| noise(1000 * number + i)).collect();
        demo.datasets.insert("actions".to_owned(), Array::from_f64(vec![FRAMES, 7], &actions));
        let rewards: Vec<f64> = (0..FRAMES).map(|i| f64::from(i + 1 == FRAMES)).collect();
        demo.datasets.insert("rewards".to_owned(), Array::from_f64(vec![FRAMES], &rewards));
        demo.datasets.insert("dones".to_owned(), Array::from_f64(vec![FRAMES], &rewards));
        writer.add_demo(&demo).unwrap();
    }
    writer.finish().unwrap();
    // a file for each row group of four demos; of files as edits write them, so that repairs write the same bytes
    for thousandths in 15..40 {
        let data_file_mb = f64::from(thousandths) * 1e-3;
        let options = ConvertOptions { fps: Some(20.0), data_file_mb, ..ConvertOptions::default() };
        let whole = out.with_extension("converted");
        convert(&file, &whole, &options, &mut quiet).unwrap();
        keep(&whole, &Destination::New(out.to_owned()), &numbers(0..DEMOS), &mut quiet).unwrap();
        let episodes = read_table(&out.join(EPISODES));
        let files = episodes.column_by_name("data/file_index").unwrap().as_primitive::<Int64Type>().values().to_vec();
        std::fs::remove_dir_all(whole).unwrap();
        if files == [0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2] {
            return;
        }
        std::fs::remove_dir_all(out).unwrap();
    }
    panic!("no size of files has four demos in each");
}

fn numbers(episodes: std::ops::Range<usize>) -> Selection {
    Selection { episodes: episodes.collect(), ..Selection::default() }
}

fn edit_json(root: &Path, file: &str, edit: impl Fn(&mut Value)) {
    let path = root.join(file);
    let mut value: Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    edit(&mut value);
    std::fs::write(path, serde_json::to_vec_pretty(&value).unwrap()).unwrap();
}

/// Edits a JSON file whose keys keep their order.
fn edit_text(root: &Path, file: &str, old: &str, new: &str) {
    let text = std::fs::read_to_string(root.join(file)).unwrap();
    assert!(text.contains(old), "{text}");
    std::fs::write(root.join(file), text.replace(old, new)).unwrap();
}

fn read_table(path: &Path) -> RecordBatch {
    let reader = ParquetRecordBatchReaderBuilder::try_new(File::open(path).unwrap()).unwrap().build().unwrap();
    let batches: Vec<RecordBatch> = reader.map(Result::unwrap).collect();
    concat_batches(&batches[0].schema(), &batches).unwrap()
}

fn edit_table(root: &Path, file: &str, edit: impl Fn(RecordBatch) -> RecordBatch) {
    let path = root.join(file);
    let table = edit(read_table(&path));
    // what is said to Hugging Face's `datasets` stays
    let reader = ParquetRecordBatchReaderBuilder::try_new(File::open(&path).unwrap()).unwrap();
    let mut said = reader.metadata().file_metadata().key_value_metadata().cloned().unwrap_or_default();
    said.retain(|pair| pair.key != "ARROW:schema");
    let properties = WriterProperties::builder().set_key_value_metadata(Some(said)).build();
    let mut writer = ArrowWriter::try_new(File::create(&path).unwrap(), table.schema(), Some(properties)).unwrap();
    writer.write(&table).unwrap();
    writer.close().unwrap();
}

/// The table with a column of another type.
fn with_column(table: &RecordBatch, name: &str, edit: impl Fn(&ArrayRef) -> ArrayRef) -> RecordBatch {
    let schema = table.schema();
    let column = |(field, column): (&Arc<Field>, &ArrayRef)| match field.name() == name {
        true => (field.name().clone(), edit(column)),
        false => (field.name().clone(), Arc::clone(column)),
    };
    RecordBatch::try_from_iter(schema.fields().iter().zip(table.columns()).map(column)).unwrap()
}

fn edit_column(root: &Path, file: &str, name: &str, edit: impl Fn(&ArrayRef) -> ArrayRef) {
    edit_table(root, file, |table| {
        let at = table.schema().index_of(name).unwrap();
        let mut columns = table.columns().to_vec();
        columns[at] = edit(&columns[at]);
        RecordBatch::try_new(table.schema(), columns).unwrap()
    });
}

/// Edits the whole numbers of a column, by row.
fn edit_numbers(root: &Path, file: &str, name: &str, edit: impl Fn(usize, i64) -> i64) {
    edit_column(root, file, name, |column| {
        let numbers = column.as_primitive::<Int64Type>().values();
        Arc::new(Int64Array::from_iter_values(numbers.iter().enumerate().map(|(row, &number)| edit(row, number))))
    });
}

fn edit_times(root: &Path, edit: impl Fn(usize, f32) -> f32) {
    edit_column(root, DATA, "timestamp", |column| {
        let times = column.as_primitive::<Float32Type>().values();
        Arc::new(Float32Array::from_iter_values(times.iter().enumerate().map(|(row, &time)| edit(row, time))))
    });
}

/// Edits the numbers that lie in a column of lists, one after the other.
fn edit_list(root: &Path, file: &str, name: &str, edit: impl Fn(usize, f64) -> f64) {
    edit_column(root, file, name, |column| {
        let inner = match column.data_type() {
            DataType::FixedSizeList(..) => Arc::clone(column.as_fixed_size_list().values()),
            _ => Arc::clone(column.as_list::<i32>().values()),
        };
        let numbers = cast(&inner, &DataType::Float64).unwrap();
        let numbers = numbers.as_primitive::<Float64Type>().values();
        let edited = Float64Array::from_iter_values(numbers.iter().enumerate().map(|(i, &number)| edit(i, number)));
        let edited = cast(&edited, inner.data_type()).unwrap();
        arrow_array::make_array(column.to_data().into_builder().child_data(vec![edited.to_data()]).build().unwrap())
    });
}

/// The rows of a table in another order, or fewer or more of them.
fn edit_rows(root: &Path, file: &str, rows: &[u32]) {
    let rows = arrow_array::UInt32Array::from(rows.to_vec());
    edit_table(root, file, |table| take_record_batch(&table, &rows).unwrap());
}

fn set_tasks(root: &Path, episode: usize, texts: &[&str]) {
    edit_column(root, EPISODES, "tasks", |column| {
        let field = match column.data_type() {
            DataType::List(field) => Arc::clone(field),
            other => panic!("{other}"),
        };
        let mut lists = ListBuilder::new(StringBuilder::new()).with_field(field);
        for (row, list) in column.as_list::<i32>().iter().enumerate() {
            match row == episode {
                true => texts.iter().for_each(|text| lists.values().append_value(text)),
                false => list.unwrap().as_string::<i32>().iter().for_each(|text| lists.values().append_option(text)),
            }
            lists.append(true);
        }
        Arc::new(lists.finish())
    });
}

fn set_table_of_tasks(root: &Path, numbers: &[i64], texts: &[&str]) {
    edit_table(root, TASKS, |table| {
        let columns: Vec<ArrayRef> =
            vec![Arc::new(Int64Array::from(numbers.to_vec())), Arc::new(StringArray::from(texts.to_vec()))];
        RecordBatch::try_new(table.schema(), columns).unwrap()
    });
}

/// A fault: its name, how it is planted, what the checks say of it.
type Planted = (&'static str, fn(&Path), &'static [&'static str]);

/// Faults that the frames correct.
const REPAIRABLE: &[Planted] = &[
    (
        "episodes counted wrongly",
        |s| edit_text(s, INFO, "\"total_episodes\": 12", "\"total_episodes\": 9"),
        &["total_episodes", "expected 12, found 9"],
    ),
    (
        "frames counted wrongly",
        |s| edit_text(s, INFO, "\"total_frames\": 480", "\"total_frames\": 481"),
        &["total_frames", "expected 480, found 481"],
    ),
    (
        "tasks counted wrongly",
        |s| edit_text(s, INFO, "\"total_tasks\": 3", "\"total_tasks\": 4"),
        &["total_tasks", "expected 3, found 4"],
    ),
    ("no total", |s| edit_text(s, INFO, "\"total_frames\": 480,", ""), &["total_frames"]),
    ("splits of fewer episodes", |s| edit_text(s, INFO, "\"0:12\"", "\"0:10\""), &["splits", "train 0:10"]),
    ("splits of more episodes", |s| edit_text(s, INFO, "\"0:12\"", "\"0:13\""), &["splits", "0:13"]),
    (
        "a path of the data that is another",
        |s| {
            edit_text(
                s,
                INFO,
                "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
                "data/{chunk_index:03d}.parquet",
            )
        },
        &["data_path"],
    ),
    (
        "the table of tasks in another order",
        |s| edit_rows(s, TASKS, &[1, 0, 2]),
        &["tasks.parquet", "task_index", "row 0: expected 0, found 1"],
    ),
    (
        "tasks numbered from 1",
        |s| set_table_of_tasks(s, &[1, 2, 3], &["task 0", "task 1", "task 2"]),
        &["task_index", "expected 0, found 1"],
    ),
    ("a task that the table lacks", |s| edit_rows(s, TASKS, &[0, 1]), &["task 2", "none"]),
    (
        "a task twice",
        |s| set_table_of_tasks(s, &[0, 1, 2, 3], &["task 0", "task 1", "task 2", "task 1"]),
        &["task 1", "again"],
    ),
    ("no table of tasks", |s| std::fs::remove_file(s.join(TASKS)).unwrap(), &["tasks.parquet", "no such file"]),
    (
        "tasks of an episode that are another's",
        |s| set_tasks(s, 4, &["a task of nobody"]),
        &["tasks", "episode 4", "a task of nobody"],
    ),
    ("an episode without tasks", |s| set_tasks(s, 5, &[]), &["tasks", "episode 5", "[]"]),
    (
        "episodes numbered with gaps",
        |s| edit_numbers(s, EPISODES, "episode_index", |_, n| if n > 4 { n + 1 } else { n }),
        &["episode_index", "episode 5", "expected 5, found 6"],
    ),
    (
        "a length",
        |s| edit_numbers(s, EPISODES, "length", |row, n| if row == 3 { n + 1 } else { n }),
        &["length", "episode 3", "expected 40, found 41"],
    ),
    (
        "a first frame",
        |s| edit_numbers(s, EPISODES, "dataset_from_index", |row, n| if row == 3 { n - 1 } else { n }),
        &["dataset_from_index", "episode 3", "expected 120, found 119"],
    ),
    (
        "a last frame",
        |s| edit_numbers(s, EPISODES, "dataset_to_index", |row, n| if row == 3 { n + 1 } else { n }),
        &["dataset_to_index", "episode 3", "expected 160, found 161"],
    ),
    (
        "ranges that begin anew",
        |s| {
            edit_numbers(s, EPISODES, "dataset_from_index", |row, n| if row > 5 { n - 240 } else { n });
            edit_numbers(s, EPISODES, "dataset_to_index", |row, n| if row > 5 { n - 240 } else { n });
        },
        &["dataset_from_index", "episode 6", "expected 240, found 0"],
    ),
    (
        "episodes in the first file only",
        |s| edit_numbers(s, EPISODES, "data/file_index", |_, _| 0),
        &["data/file_index", "episode 4", "expected 1, found 0"],
    ),
    (
        "another folder",
        |s| edit_numbers(s, EPISODES, "data/chunk_index", |_, n| n + 1),
        &["data/chunk_index", "episode 0", "expected 0, found 1"],
    ),
    (
        "another file of episodes",
        |s| edit_numbers(s, EPISODES, "meta/episodes/file_index", |_, _| 2),
        &["meta/episodes/file_index", "expected 0, found 2"],
    ),
    (
        "rows of episodes in another order",
        |s| edit_rows(s, EPISODES, &[0, 1, 3, 2, 4, 5, 6, 7, 8, 9, 10, 11]),
        &["order of rows", "episode 2"],
    ),
    (
        "an episode that the table lacks",
        |s| edit_rows(s, EPISODES, &[0, 1, 2, 3, 4, 5, 6, 8, 9, 10, 11]),
        &["12 episodes", "11 rows"],
    ),
    (
        "an episode twice",
        |s| edit_rows(s, EPISODES, &[0, 1, 2, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11]),
        &["12 episodes", "13 rows"],
    ),
    (
        "frames that are counted anew in the second file",
        |s| edit_numbers(s, LATER, "index", |row, _| row as i64),
        &["file-001.parquet: index", "row 0", "expected 160, found 0"],
    ),
    (
        "one frame's number",
        |s| edit_numbers(s, DATA, "index", |row, n| if row == 7 { n + 1 } else { n }),
        &["index", "episode 0, row 7", "expected 7, found 8"],
    ),
    (
        "one frame's number in its episode",
        |s| edit_numbers(s, DATA, "frame_index", |row, n| if row == 47 { 0 } else { n }),
        &["frame_index", "episode 1, row 47", "expected 7, found 0"],
    ),
    (
        "frames of an episode from 1 on",
        |s| edit_numbers(s, DATA, "frame_index", |_, n| n + 1),
        &["frame_index", "row 0", "39 more"],
    ),
    (
        "frames' episodes with gaps",
        |s| edit_numbers(s, DATA, "episode_index", |_, n| if n > 2 { n + 4 } else { n }),
        &["episode_index", "episode 3, row 120", "expected 3, found 7"],
    ),
    (
        "a frame of another episode",
        |s| edit_numbers(s, DATA, "episode_index", |row, n| if row == 39 { n + 1 } else { n }),
        &["episode_index", "episode 0, row 39", "expected 0, found 1"],
    ),
    (
        "all frames of one episode",
        |s| edit_numbers(s, DATA, "episode_index", |_, _| 0),
        &["episode_index", "episode 1, row 40", "expected 1, found 0"],
    ),
    ("a task that is none", |s| edit_numbers(s, DATA, "task_index", |_, _| 7), &["task_index", "expected 0, found 7"]),
    (
        "a task that is another's",
        |s| edit_numbers(s, DATA, "task_index", |row, n| if row < 40 { 2 } else { n }),
        &["task_index", "episode 0", "expected 0, found 2"],
    ),
    ("a mean", |s| edit_json(s, STATS, |i| i["action"]["mean"][3] = json!(0.5)), &["stats.json", "action: mean"]),
    (
        "a count",
        |s| edit_json(s, STATS, |i| i["action"]["count"] = json!([479])),
        &["action: count", "expected 480, found 479"],
    ),
    ("statistics of index", |s| edit_json(s, STATS, |i| i["index"]["max"] = json!([39])), &["index: max", "479", "39"]),
    (
        "statistics that are no numbers",
        |s| {
            edit_json(s, STATS, |i| i["action"]["std"][0] = json!("here"));
            let text = std::fs::read_to_string(s.join(STATS)).unwrap();
            std::fs::write(s.join(STATS), text.replace("\"here\"", "NaN")).unwrap();
        },
        &["action: std", "NaN"],
    ),
    (
        "statistics of one feature missing",
        |s| edit_json(s, STATS, |i| drop(i.as_object_mut().unwrap().remove("observation.state"))),
        &["observation.state", "none"],
    ),
    ("no statistics", |s| std::fs::remove_file(s.join(STATS)).unwrap(), &["stats.json", "none"]),
    (
        "statistics of an episode",
        |s| edit_list(s, EPISODES, "stats/action/max", |i, n| if i == 15 { 3.0 } else { n }),
        &["stats/action/max", "episode 2"],
    ),
    (
        "statistics of an episode's index",
        |s| edit_list(s, EPISODES, "stats/index/min", |_, _| 0.0),
        &["stats/index/min", "episode 1", "40.0"],
    ),
];

/// Faults that they do not.
const OTHERS: &[Planted] = &[
    (
        "a number that is none",
        |s| edit_list(s, LATER, "action", |i, n| if i == 7 * 43 + 2 { f64::NAN } else { n }),
        &["action: episode 5", "frame 3, dimension 2: NaN"],
    ),
    (
        "infinite numbers",
        |s| edit_list(s, DATA, "observation.state", |i, n| if i % 90 == 4 { f64::INFINITY } else { n }),
        &["observation.state: episode 0, frame 0, dimension 4: inf", "3 more", "episode 3"],
    ),
    (
        "times of a clock",
        |s| edit_times(s, |row, time| time + (row % 7) as f32 * 1e-3),
        &["timestamp", "episode 0, row 1", "0.05", "0.006"],
    ),
    (
        "a column that is no feature",
        |s| edit_json(s, INFO, |i| drop(i["features"].as_object_mut().unwrap().remove("next.done"))),
        &["meta/info.json: features: expected next.done, a column of data/chunk-000/file-000.parquet, found none"],
    ),
    (
        "times that begin later",
        |s| edit_times(s, |_, time| time + 1.5),
        &["timestamp", "row 0: expected 0 s, found 1.5 s"],
    ),
];

fn problems(checks: &[Check]) -> Vec<String> {
    checks.iter().filter_map(|c| Some(format!("{}: {}", c.name, c.problem.as_ref()?))).collect()
}

fn named(checks: &[Check], name: &str, words: &[&str]) {
    let problems = problems(checks);
    let lines: Vec<&str> = problems.iter().flat_map(|p| p.lines()).collect();
    // hashes of files are no names of what is wrong in them
    let found = |word: &&&str| lines.iter().any(|line| line.contains(**word) && !line.contains("sha256"));
    let missing: Vec<&&str> = words.iter().filter(|word| !found(word)).collect();
    assert!(missing.is_empty(), "{name}: {missing:?} not in {problems:#?}");
}

#[test]
fn each_fault_is_named_and_what_follows_from_the_frames_is_corrected() {
    let dir = tempfile::tempdir().unwrap();
    let (ours, theirs) = (dir.path().join("ours"), dir.path().join("theirs"));
    sound(&ours);
    copy(&ours, &theirs);
    std::fs::remove_dir_all(theirs.join("actrm")).unwrap();
    for whole in [&ours, &theirs] {
        // a sound set gives no false alarm, and is left alone
        assert_eq!(problems(&verify(whole, &mut quiet).unwrap()), Vec::<String>::new());
        assert_eq!(Dataset::open(whole).unwrap().notes(), Vec::<String>::new());
        let out = dir.path().join("out");
        let report = repair(whole, &Destination::New(out.clone()), Repair::default(), &mut quiet).unwrap();
        assert!(report.corrected.is_empty() && report.left.is_empty() && report.made.is_none() && !out.exists());
        let as_it_was = files(whole);
        for (name, plant, words) in REPAIRABLE {
            let set = dir.path().join("set");
            copy(whole, &set);
            plant(&set);
            named(&verify(&set, &mut quiet).unwrap(), name, words);
            let report = repair(&set, &Destination::InPlace, Repair::default(), &mut quiet);
            let report = report.unwrap_or_else(|e| panic!("{name}: {e}"));
            assert!(report.made.is_some() && report.left.is_empty(), "{name}: {report:?}");
            assert!(words.iter().all(|word| report.corrected.iter().any(|l| l.contains(word))), "{name}: {report:#?}");
            let now = files(&set);
            let changed: Vec<_> = as_it_was.iter().filter(|(k, v)| now.get(*k) != Some(v)).map(|(k, _)| k).collect();
            assert!(changed.is_empty() && now.len() == as_it_was.len(), "{name}: {changed:?} differ: {report:#?}");
            std::fs::remove_dir_all(&set).unwrap();
        }
    }
    for (name, plant, words) in OTHERS {
        let set = dir.path().join("set");
        copy(&theirs, &set);
        plant(&set);
        named(&verify(&set, &mut quiet).unwrap(), name, words);
        let report = repair(&set, &Destination::InPlace, Repair::default(), &mut quiet).unwrap();
        assert!(!report.left.is_empty(), "{name}: {report:?}");
        named(&verify(&set, &mut quiet).unwrap(), name, words);
        std::fs::remove_dir_all(&set).unwrap();
    }
}

#[test]
fn frames_that_were_changed_are_no_longer_those_that_were_converted() {
    let dir = tempfile::tempdir().unwrap();
    let set = dir.path().join("set");
    sound(&set);
    edit_list(&set, DATA, "action", |i, n| if i == 9 { n + 0.5 } else { n });
    assert!(Dataset::open(&set).is_err());
    let report = repair(&set, &Destination::InPlace, Repair::default(), &mut quiet).unwrap();
    let notes = report.made.unwrap().notes;
    assert!(notes.iter().any(|n| n.contains("not those that were converted")), "{notes:?}");
    assert!(Dataset::open(&set).unwrap().provenance().is_none() && !set.join("actrm").exists());
    assert_eq!(problems(&verify(&set, &mut quiet).unwrap()), Vec::<String>::new());
}

#[test]
fn times_of_a_clock_open_with_a_note_and_are_rewritten_when_asked_for() {
    let dir = tempfile::tempdir().unwrap();
    let set = dir.path().join("set");
    sound(&set);
    std::fs::remove_dir_all(set.join("actrm")).unwrap();
    edit_times(&set, |row, time| time + (row % 7) as f32 * 1e-3);
    let notes = Dataset::open(&set).unwrap().notes().to_vec();
    assert!(matches!(notes.as_slice(), [note] if note.contains("timestamp") && note.contains("0.006")), "{notes:?}");
    let times = |checks: Vec<Check>| problems(&checks).iter().filter(|p| p.starts_with("timestamps")).count();
    assert_eq!(times(verify(&set, &mut quiet).unwrap()), 1);
    assert_eq!(times(verify_within(&set, 0.007, &mut quiet).unwrap()), 0);
    let report = repair(&set, &Destination::InPlace, Repair { timestamps: true }, &mut quiet).unwrap();
    assert!(report.left.is_empty() && report.corrected.iter().any(|l| l.contains("timestamp")), "{report:?}");
    assert_eq!(problems(&verify(&set, &mut quiet).unwrap()), Vec::<String>::new());
}

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
    keep(&set, &Destination::New(out.clone()), &numbers(0..DEMOS), &mut quiet).unwrap();
    let stats = Dataset::open(&out).unwrap().stats().clone();
    assert!(stats["timestamp"].std[0] > 0.01, "{:?}", stats["timestamp"]);
    assert_eq!(stats["next.reward"].max, [u64::MAX as f64]);
    let problems = problems(&verify(&out, &mut quiet).unwrap());
    assert!(matches!(problems.as_slice(), [times] if times.starts_with("timestamps are")), "{problems:?}");
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
    keep(&again, &Destination::New(out.clone()), &numbers(0..DEMOS), &mut quiet).unwrap();
    assert_eq!(Dataset::open(&out).unwrap().fingerprint(), Dataset::open(&again).unwrap().fingerprint());
}

#[test]
fn an_episode_without_frames_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let set = dir.path().join("set");
    sound(&set);
    std::fs::remove_dir_all(set.join("actrm")).unwrap();
    edit_rows(&set, EPISODES, &(0..DEMOS as u32).chain([DEMOS as u32 - 1]).collect::<Vec<_>>());
    let last = DEMOS;
    edit_numbers(&set, EPISODES, "episode_index", |row, number| if row == last { last as i64 } else { number });
    edit_numbers(&set, EPISODES, "length", |row, number| if row == last { 0 } else { number });
    let frames = (DEMOS * FRAMES) as i64;
    edit_numbers(&set, EPISODES, "dataset_from_index", |row, number| if row == last { frames } else { number });
    edit_json(&set, INFO, |info| info["total_episodes"] = json!(DEMOS + 1));
    named(&verify(&set, &mut quiet).unwrap(), "empty", &["length, episode 12, row 12: expected 1 or more, found 0"]);
    // the others keep their statistics
    let out = dir.path().join("out");
    keep(&set, &Destination::New(out.clone()), &numbers(10..DEMOS + 1), &mut quiet).unwrap();
    let (before, after) = (read_table(&set.join(EPISODES)), read_table(&out.join(EPISODES)));
    for name in ["stats/action/mean", "stats/action/count"] {
        let (before, after) = (before.column_by_name(name).unwrap(), after.column_by_name(name).unwrap());
        assert_eq!((before.slice(10, 2).as_ref(), after.is_null(2)), (after.slice(0, 2).as_ref(), true), "{name}");
    }
    let notes = export(&out, &dir.path().join("out.hdf5"), &WriteOptions::default(), &mut quiet).unwrap().notes;
    assert!(notes.contains(&"episodes without frames become demos without steps: demo_2".to_owned()), "{notes:?}");
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
    let report = keep(&set, &Destination::New(out.clone()), &numbers(0..DEMOS), &mut quiet).unwrap();
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
fn parts_of_videos_that_cannot_be_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let fixture = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/lerobot_video_av1");
    assert_eq!(problems(&verify(&fixture, &mut quiet).unwrap()), Vec::<String>::new());
    const CAMERA: &str = "observation.images.agentview";
    let seconds = |set: &Path, what: &str, edit: &dyn Fn(usize, f64) -> f64| {
        edit_column(set, EPISODES, &format!("videos/{CAMERA}/{what}"), |column| {
            let numbers = column.as_primitive::<Float64Type>().values();
            Arc::new(Float64Array::from_iter_values(numbers.iter().enumerate().map(|(row, &n)| edit(row, n))))
        });
    };
    type Planted<'a> = (&'a str, &'a dyn Fn(&Path), &'a [&'a str]);
    let planted: [Planted<'_>; 3] = [
        (
            "an end",
            &|set| seconds(set, "to_timestamp", &|row, n| if row == 1 { n + 1.0 } else { n }),
            &["to_timestamp", "episode 1"],
        ),
        (
            "another's part",
            &|set| {
                let from = |row, n: f64| if row == 2 { n - 0.6 } else { n };
                seconds(set, "from_timestamp", &from);
                seconds(set, "to_timestamp", &from);
            },
            &["from_timestamp", "episode 2"],
        ),
        (
            "a file that is not there",
            &|set| edit_numbers(set, EPISODES, &format!("videos/{CAMERA}/file_index"), |_, _| 4),
            &["file_index", "file-004.mp4"],
        ),
    ];
    for (name, plant, words) in planted {
        let set = dir.path().join("set");
        copy(&fixture, &set);
        plant(&set);
        named(&verify(&set, &mut quiet).unwrap(), name, words);
        std::fs::remove_dir_all(&set).unwrap();
    }
}

#[test]
fn a_git_lfs_pointer_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let whole = dir.path().join("whole");
    sound(&whole);
    std::fs::remove_dir_all(whole.join("actrm")).unwrap();
    let pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n";
    for file in [DATA, LATER, EPISODES, TASKS, INFO, STATS] {
        let set = dir.path().join("set");
        copy(&whole, &set);
        std::fs::write(set.join(file), pointer).unwrap();
        let refused = Dataset::open(&set).unwrap_err().to_string();
        assert!(refused.contains(file) && refused.contains("git lfs pull"), "{refused}");
        named(&verify(&set, &mut quiet).unwrap(), file, &[file, "git lfs pull"]);
        assert!(repair(&set, &Destination::InPlace, Repair::default(), &mut quiet).is_err());
        std::fs::remove_dir_all(&set).unwrap();
    }
}

/// A set whose table of tasks is in disorder, in either way: numbers as LeRobot looks them up, and as the table has them.
#[test]
fn tasks_in_disorder_are_those_of_the_episodes() {
    let dir = tempfile::tempdir().unwrap();
    let whole = dir.path().join("whole");
    sound(&whole);
    std::fs::remove_dir_all(whole.join("actrm")).unwrap();
    let before = Dataset::open(&whole).unwrap();
    for by_row in [true, false] {
        let set = dir.path().join(format!("by_row_{by_row}"));
        copy(&whole, &set);
        match by_row {
            true => set_table_of_tasks(&set, &[2, 0, 1], &["task 0", "task 1", "task 2"]),
            false => edit_rows(&set, TASKS, &[2, 0, 1]),
        }
        let after = Dataset::open(&set).unwrap();
        assert_eq!(after.tasks(), before.tasks(), "by row: {by_row}");
        assert!(after.notes()[0].contains("task_index: expected 0, 1, 2, ... in order"), "{:?}", after.notes());
        assert_eq!(after.fingerprint(), before.fingerprint());
        let tasks = after.frame_tasks().unwrap().unwrap();
        assert_eq!(tasks, before.frame_tasks().unwrap().unwrap());
        for episode in after.episodes() {
            let texts: Vec<_> = tasks[episode.from..episode.to].iter().map(|&task| &after.tasks()[task]).collect();
            assert!(texts.len() == episode.length && texts.iter().all(|text| episode.tasks.contains(text)));
        }
    }
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
    keep(&set, &Destination::New(out.clone()), &numbers(0..3), &mut quiet).unwrap();
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
    keep(&fixture, &Destination::New(out.clone()), &numbers(1..3), &mut quiet).unwrap();
    assert_eq!(problems(&verify(&out, &mut quiet).unwrap()), Vec::<String>::new());
    let (before, after) = (read_table(&fixture.join(DATA)), read_table(&out.join(DATA)));
    let from = before.num_rows() - after.num_rows();
    for name in ["language_persistent", "language_events"] {
        let whole = before.column_by_name(name).unwrap();
        assert_eq!(&whole.slice(from, after.num_rows()), after.column_by_name(name).unwrap(), "{name}");
    }
}
