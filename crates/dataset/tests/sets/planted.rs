//! Faults planted in sound data sets, one at a time: `verify` names each, and `edit repair` corrects those that follow from the
//! frames.

#![allow(clippy::unwrap_used)]

use crate::common::{copy, files, going};
use crate::planting::*;
use arrow_array::cast::AsArray;
use arrow_array::types::Float64Type;
use arrow_array::{Array as _, Float64Array};
use dataset::edit::{Destination, Repair, keep, repair};
use dataset::{Check, Dataset, WriteOptions, export, verify, verify_within};
use serde_json::json;
use std::path::Path;
use std::sync::Arc;

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
    ("a quantile", |s| edit_json(s, STATS, |i| i["action"]["q90"][3] = json!(-0.9)), &["action: q90", "no less than"]),
    (
        "quantiles too few",
        |s| edit_json(s, STATS, |i| i["action"]["q10"] = json!([0.0])),
        &["action: q10", "7 numbers"],
    ),
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
        let report = repair(whole, &Destination::New(out.clone()), Repair::default(), &mut going).unwrap();
        assert!(report.corrected.is_empty() && report.left.is_empty() && report.made.is_none() && !out.exists());
        let as_it_was = files(whole);
        for (name, plant, words) in REPAIRABLE {
            let set = dir.path().join("set");
            copy(whole, &set);
            plant(&set);
            named(&verify(&set, &mut quiet).unwrap(), name, words);
            let report = repair(&set, &Destination::InPlace, Repair::default(), &mut going);
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
        let report = repair(&set, &Destination::InPlace, Repair::default(), &mut going).unwrap();
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
    let report = repair(&set, &Destination::InPlace, Repair::default(), &mut going).unwrap();
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
    let report = repair(&set, &Destination::InPlace, Repair { timestamps: true }, &mut going).unwrap();
    assert!(report.left.is_empty() && report.corrected.iter().any(|l| l.contains("timestamp")), "{report:?}");
    assert_eq!(problems(&verify(&set, &mut quiet).unwrap()), Vec::<String>::new());
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
    keep(&set, &Destination::New(out.clone()), &numbers(10..DEMOS + 1), &mut going).unwrap();
    let (before, after) = (read_table(&set.join(EPISODES)), read_table(&out.join(EPISODES)));
    for name in ["stats/action/mean", "stats/action/count"] {
        let (before, after) = (before.column_by_name(name).unwrap(), after.column_by_name(name).unwrap());
        assert_eq!((before.slice(10, 2).as_ref(), after.is_null(2)), (after.slice(0, 2).as_ref(), true), "{name}");
    }
    // nothing can be made of it alone
    let alone = dir.path().join("alone");
    let refused = keep(&set, &Destination::New(alone.clone()), &numbers(DEMOS..DEMOS + 1), &mut going).unwrap_err();
    assert!(refused.to_string().contains("no frame in the episodes that were chosen"), "{refused}");
    let notes = export(&out, &dir.path().join("out.hdf5"), &WriteOptions::default(), &mut quiet).unwrap().notes;
    assert!(notes.contains(&"episodes without frames become demos without steps: demo_2".to_owned()), "{notes:?}");
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
        assert!(repair(&set, &Destination::InPlace, Repair::default(), &mut going).is_err());
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
fn a_feature_that_no_file_has_is_refused_and_named() {
    let dir = tempfile::tempdir().unwrap();
    let whole = dir.path().join("whole");
    sound(&whole);
    std::fs::remove_dir_all(whole.join("actrm")).unwrap();
    for (dtype, shape) in [("string", vec![1]), ("image", vec![8, 8, 3])] {
        let (set, out) = (dir.path().join(dtype), dir.path().join("out"));
        copy(&whole, &set);
        edit_json(&set, INFO, |info| {
            info["features"]["more"] = json!({"dtype": dtype, "shape": shape, "names": null});
        });
        named(
            &verify(&set, &mut quiet).unwrap(),
            dtype,
            &[
                "no column more, which meta/info.json states",
                "meta/info.json: features.more: expected a column of that name in data/chunk-000/file-000.parquet",
            ],
        );
        for refused in [
            Dataset::open(&set).map(drop),
            keep(&set, &Destination::New(out.clone()), &numbers(0..1), &mut going).map(drop),
            repair(&set, &Destination::New(out.clone()), Repair::default(), &mut going).map(drop),
            export(&set, &out, &WriteOptions::default(), &mut quiet).map(drop),
        ] {
            let text = refused.unwrap_err().to_string();
            assert!(text.contains(&format!("{DATA}: no column more, which meta/info.json states")), "{text}");
        }
        assert!(!out.exists());
    }
}

#[test]
fn masks_and_demos_are_held_against_the_episodes_that_there_are() {
    const ORIGIN: &str = "actrm/info.json";
    let dir = tempfile::tempdir().unwrap();
    let set = dir.path().join("set");
    sound(&set);
    std::fs::remove_file(set.join("actrm/manifest.json")).unwrap();
    edit_json(&set, INFO, |info| info["total_episodes"] = json!(DEMOS + 1));
    edit_json(&set, ORIGIN, |origin| {
        origin.as_object_mut().unwrap().remove("seal").unwrap();
        (origin["lossless"], origin["masks"]) = (json!(false), json!({"train": [0, DEMOS]}));
    });
    let told = |words: &str| {
        let chosen = dataset::edit::Selection { masks: vec!["train".to_owned()], ..Default::default() };
        let refused = keep(&set, &Destination::New(dir.path().join("out")), &chosen, &mut going).unwrap_err();
        assert!(refused.to_string().contains(words), "{refused}");
    };
    told("actrm.masks.train: expected episodes below 12, found 12");
    edit_json(&set, ORIGIN, |origin| origin["demos"].as_array_mut().unwrap().push(json!("demo_99")));
    told("actrm.demos: expected an id for each of 12 episodes, found 13");
}
