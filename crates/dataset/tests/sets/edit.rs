//! Data sets made of data sets: what is derived is as conversion would have it, and nothing of the rest is lost.

#![allow(clippy::unwrap_used)]

#[path = "sharded.rs"]
mod sharded;

use crate::common::{files, going};
use arrow_array::cast::AsArray;
use arrow_array::types::Float64Type;
use arrow_array::{ArrayRef, Float64Array, RecordBatch};
use dataset::edit::{Destination, EditReport, Parts, Renames, Selection, keep, merge, rename, split, without};
use dataset::{
    Array, ConvertOptions, Dataset, Demo, ImageForm, RobomimicWriter, Source, VideoOptions, WriteOptions, convert,
    export, verify,
};
use parquet::arrow::ArrowWriter;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use std::collections::BTreeMap;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Arc;

const CAMERA: &str = "observation.images.agentview";

fn quiet(_: u64, _: u64) {}

fn fixture() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/lift_low_dim_3_demos.hdf5")
}

fn lerobot() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/lerobot_video_av1")
}

/// Everything in a file, in order.
fn content(path: &Path) -> (Demo, Vec<Demo>) {
    let source = Source::open(path).unwrap();
    let demos = (0..source.plan().demos.len()).map(|i| source.read_demo(i).unwrap()).collect();
    (source.root().unwrap(), demos)
}

fn sound(root: &Path) {
    for check in verify(root, &mut quiet).unwrap() {
        assert_eq!(check.problem, None, "{}: {}", root.display(), check.name);
    }
}

fn numbers(episodes: &[usize]) -> Selection {
    Selection { episodes: episodes.to_vec(), ..Selection::default() }
}

/// A demo whose values depend on its number; pictures of a smooth pattern.
fn synthetic(number: usize, length: usize, side: Option<usize>) -> Demo {
    let mut demo = Demo { id: format!("demo_{number}"), ..Demo::default() };
    demo.attrs.insert("num_samples".to_owned(), Array::from_i64(vec![], &[length as i64]));
    demo.attrs.insert("ep_meta".to_owned(), Array::from_str(&format!("{{\"lang\": \"task {}\"}}", number % 3)));
    for (key, width) in [("robot0_eef_pos", 3), ("robot0_eef_quat", 4), ("robot0_gripper_qpos", 2), ("object", 10)] {
        let value = |i: usize| ((i + 31 * number) as f64 * 0.37).sin();
        let values: Vec<f64> = (0..length * width).map(value).collect();
        let next: Vec<f64> = (width..(length + 1) * width).map(value).collect();
        demo.datasets.insert(format!("obs/{key}"), Array::from_f64(vec![length, width], &values));
        demo.datasets.insert(format!("next_obs/{key}"), Array::from_f64(vec![length, width], &next));
    }
    let actions: Vec<f64> = (0..length * 7).map(|i| ((i * i + number) as f64).cos()).collect();
    demo.datasets.insert("actions".to_owned(), Array::from_f64(vec![length, 7], &actions));
    demo.datasets.insert("rewards".to_owned(), Array::from_f64(vec![length], &vec![number as f64; length]));
    // of another type in every fourth demo, and only in some
    match number % 4 {
        0 => drop(demo.datasets.insert("states".to_owned(), Array::from_f32(vec![length, 2], &vec![0.5; length * 2]))),
        1 => {}
        _ => drop(demo.datasets.insert("states".to_owned(), Array::from_f64(vec![length, 2], &vec![1.5; length * 2]))),
    }
    if let Some(side) = side {
        let picture = |frame: usize| {
            (0..side * side * 3).map(move |i| {
                let (x, y) = ((i / 3 % side) as f64 / 20.0, (i / 3 / side) as f64 / 25.0);
                let t = (frame + 5 * number) as f64 * 0.2 + (i % 3) as f64;
                (127.5 + 90.0 * (x + t).sin() * (y - 0.5 * t).cos()) as u8
            })
        };
        let bytes: Vec<u8> = (0..length).flat_map(picture).collect();
        let next: Vec<u8> = (1..=length).flat_map(picture).collect();
        let shape = vec![length, side, side, 3];
        demo.datasets.insert("obs/agentview_image".to_owned(), Array::from_u8(shape.clone(), &bytes));
        demo.datasets.insert("next_obs/agentview_image".to_owned(), Array::from_u8(shape, &next));
    }
    demo
}

/// Writes these demos with masks (the even ones, the others, none) and counts, as robomimic would.
fn write(path: &Path, demos: &[Demo]) {
    let mut root = Demo::default();
    let ids = |parity: u64| -> Vec<String> {
        let number = |d: &&Demo| d.id.trim_start_matches("demo_").parse::<u64>().unwrap() % 2 == parity;
        demos.iter().filter(number).map(|d| d.id.clone()).collect()
    };
    // wide enough for every id that a test has
    let fixed = |ids: &[String]| {
        let mut bytes = Vec::new();
        for id in ids {
            bytes.extend_from_slice(id.as_bytes());
            bytes.resize(bytes.len() + 9 - id.len(), 0);
        }
        Array { dtype: dataset::Dtype::FixedStr(9), shape: vec![ids.len()], bytes }
    };
    root.datasets.insert("mask/even".to_owned(), fixed(&ids(0)));
    root.datasets.insert("mask/odd".to_owned(), Array::from_strings(vec![ids(1).len()], &ids(1)));
    root.datasets.insert("extra/calibration".to_owned(), Array::from_f32(vec![2], &[1.0, 2.0]));
    let data = root.inner_attrs.entry("data".to_owned()).or_default();
    let total: usize = demos.iter().map(|d| d.datasets["actions"].shape[0]).sum();
    data.insert("total".to_owned(), Array::from_i64(vec![], &[total as i64]));
    data.insert("date".to_owned(), Array::from_str("2024-01-01"));
    let mut writer = RobomimicWriter::create(path, &WriteOptions::default()).unwrap();
    writer.set_root(&root).unwrap();
    demos.iter().for_each(|demo| writer.add_demo(demo).unwrap());
    writer.finish().unwrap();
}

fn converted(demos: &[Demo], folder: &Path, name: &str, options: &ConvertOptions) -> PathBuf {
    let (file, out) = (folder.join(format!("{name}.hdf5")), folder.join(name));
    write(&file, demos);
    convert(&file, &out, options, &mut quiet).unwrap();
    out
}

/// How sets are stored: numbers only, pictures in both forms, videos with and without the exact pictures, small files.
fn kinds() -> Vec<(&'static str, Option<usize>, ConvertOptions)> {
    let plain = ConvertOptions { fps: Some(20.0), ..ConvertOptions::default() };
    let video = |side_pictures| ConvertOptions {
        video: Some(VideoOptions { side_pictures, speed: 10, ..VideoOptions::default() }),
        ..plain.clone()
    };
    vec![
        ("numbers", None, plain.clone()),
        ("png", Some(24), plain.clone()),
        ("ppm", Some(24), ConvertOptions { images: ImageForm::Ppm, data_file_mb: 0.05, ..plain.clone() }),
        ("bare", Some(24), ConvertOptions { lossless: false, ..plain.clone() }),
        ("video", Some(32), video(true)),
        ("films", Some(32), ConvertOptions { video_file_mb: 0.001, ..video(false) }),
    ]
}

/// The same but for videos' statistics, which are those of pictures that may not be there any more.
fn assert_same_set(made: &Path, expected: &Path) {
    let (a, b) = (Dataset::open(made).unwrap(), Dataset::open(expected).unwrap());
    assert_eq!(a.fingerprint(), b.fingerprint());
    assert_eq!(a.episodes(), b.episodes());
    assert_eq!(a.tasks(), b.tasks());
    assert_eq!(a.provenance().unwrap().masks, b.provenance().unwrap().masks);
    assert_eq!(a.column_names().collect::<Vec<_>>(), b.column_names().collect::<Vec<_>>());
    for name in a.column_names() {
        assert_eq!(a.column(name), b.column(name), "{name}");
    }
    for (name, feature) in &a.info().features.0 {
        let (mine, theirs) = (&a.stats()[name], &b.stats()[name]);
        match feature.dtype.as_str() {
            "video" => {
                assert_eq!((mine.count, &mine.min, &mine.max), (theirs.count, &theirs.min, &theirs.max), "{name}");
                for (x, y) in mine.mean.iter().chain(&mine.std).zip(theirs.mean.iter().chain(&theirs.std)) {
                    assert!((x - y).abs() < 1e-9, "{name}: {mine:?} {theirs:?}");
                }
            }
            _ => assert_eq!(mine, theirs, "{name}"),
        }
    }
    for camera in a.cameras() {
        assert!(a.pictures(camera).unwrap() == b.pictures(camera).unwrap(), "{camera}");
    }
}

#[test]
fn what_is_kept_is_as_if_it_alone_had_been_converted() {
    let dir = tempfile::tempdir().unwrap();
    for (kind, side, options) in kinds() {
        let folder = dir.path().join(kind);
        std::fs::create_dir(&folder).unwrap();
        let demos: Vec<Demo> = [7, 12, 1, 9, 5].iter().enumerate().map(|(i, &n)| synthetic(i, n, side)).collect();
        let left: Vec<Demo> = [1, 3, 4].iter().map(|&i| demos[i].clone()).collect();
        let (whole, expected) =
            (converted(&demos, &folder, "whole", &options), converted(&left, &folder, "left", &options));
        let before = files(&whole);
        let mut told = (0, 0);
        let kept = folder.join("kept");
        let chosen = Selection { episodes: vec![1], demos: vec!["demo_4".to_owned()], masks: vec!["odd".to_owned()] };
        let mut tell = |done, all| {
            told = (done, all);
            going(done, all)
        };
        let report = keep(&whole, &Destination::New(kept.clone()), &chosen, &mut tell).unwrap();
        assert_eq!((report.episodes, report.frames, told.0), (3, 26, told.1), "{kind}");
        assert!(told.1 >= 26 && report.notes.is_empty(), "{kind}: {told:?} {:?}", report.notes);
        sound(&kept);
        assert_same_set(&kept, &expected);
        let dropped = folder.join("dropped");
        without(&whole, &Destination::New(dropped.clone()), &numbers(&[0, 2]), &mut going).unwrap();
        assert!(files(&dropped) == files(&kept), "{kind}: to drop some is to keep the others");
        assert!(files(&whole) == before, "{kind}: the source is as it was");
        let back = folder.join("back.hdf5");
        if options.lossless && options.video.is_none_or(|v| v.side_pictures) {
            export(&kept, &back, &WriteOptions::default(), &mut quiet).unwrap();
            assert!(content(&back) == content(&folder.join("left.hdf5")), "{kind}");
        } else {
            // no source to rebuild: a file of the columns
            let report = export(&kept, &back, &WriteOptions::default(), &mut quiet).unwrap();
            assert_eq!((report.demos, report.frames), (3, 26), "{kind}");
        }
    }
}

#[test]
fn everything_kept_is_the_same_set_and_parts_put_together_are_the_whole() {
    let dir = tempfile::tempdir().unwrap();
    for (kind, side, options) in kinds() {
        let folder = dir.path().join(kind);
        std::fs::create_dir(&folder).unwrap();
        let demos: Vec<Demo> = [6, 3, 8, 4].iter().enumerate().map(|(i, &n)| synthetic(2 * i, n, side)).collect();
        let whole = converted(&demos, &folder, "whole", &options);
        let all = folder.join("all");
        keep(&whole, &Destination::New(all.clone()), &numbers(&[0, 1, 2, 3]), &mut going).unwrap();
        assert_same_set(&all, &whole);
        assert_eq!(Dataset::open(&all).unwrap().stats(), Dataset::open(&whole).unwrap().stats(), "{kind}");
        let parts = folder.join("parts");
        let shares = Parts::Fractions(vec![("a".to_owned(), 0.5), ("b".to_owned(), 0.25), ("c".to_owned(), 0.25)]);
        let made = split(&whole, &parts, &shares, None, &mut going).unwrap();
        let sizes: Vec<(&str, usize)> =
            made.iter().map(|(name, r): &(String, EditReport)| (name.as_str(), r.episodes)).collect();
        assert_eq!(sizes, [("a", 2), ("b", 1), ("c", 1)], "{kind}");
        let again = folder.join("again");
        let each: Vec<PathBuf> = ["a", "b", "c"].iter().map(|name| parts.join(name)).collect();
        each.iter().for_each(|part| sound(part));
        let report = merge(&each, &again, &mut going).unwrap();
        assert_eq!(report.notes, [""; 0], "{kind}");
        sound(&again);
        assert_same_set(&again, &whole);
        let (a, b) = (Dataset::open(&again).unwrap(), Dataset::open(&whole).unwrap());
        let (a, b) = (a.provenance().unwrap(), b.provenance().unwrap());
        assert_eq!((&a.source, &a.source_sha256, &a.demos), (&b.source, &b.source_sha256, &b.demos));
        if options.lossless && options.video.is_none_or(|v| v.side_pictures) {
            let back = folder.join("back.hdf5");
            export(&again, &back, &WriteOptions::default(), &mut quiet).unwrap();
            assert!(content(&back) == content(&folder.join("whole.hdf5")), "{kind}");
        }
    }
}

#[test]
fn two_files_become_one_with_new_numbers_for_demos_that_both_have() {
    let dir = tempfile::tempdir().unwrap();
    let options = ConvertOptions { fps: Some(20.0), ..ConvertOptions::default() };
    // `states` are of another type in the second
    let one = converted(&[synthetic(0, 4, None), synthetic(1, 5, None)], dir.path(), "a_10", &options);
    let two = converted(&[synthetic(1, 3, None), synthetic(2, 6, None)], dir.path(), "b_2", &options);
    let all = dir.path().join("all");
    let report = merge(&[one.clone(), two.clone()], &all, &mut going).unwrap();
    assert_eq!(report.notes, ["1 demos have a new number: another set has a demo of theirs"]);
    sound(&all);
    let set = Dataset::open(&all).unwrap();
    let ids: Vec<&str> = set.episodes().iter().map(|e| e.demo.as_deref().unwrap()).collect();
    assert_eq!(ids, ["demo_0", "demo_1", "demo_3", "demo_2"]);
    assert_eq!((set.split("even").unwrap(), set.split("odd").unwrap()), (vec![0, 3], vec![1, 2]));
    let back = dir.path().join("back.hdf5");
    export(&all, &back, &WriteOptions::default(), &mut quiet).unwrap();
    let (root, demos) = content(&back);
    assert_eq!(root.inner_attrs["data"]["total"].to_i64(), Some(18));
    assert_eq!(root.datasets["mask/odd"].to_strings().unwrap(), ["demo_1", "demo_3"]);
    let renumbered = |number: usize, of: &Demo| Demo { id: format!("demo_{number}"), ..of.clone() };
    let (first, second) = (content(&dir.path().join("a_10.hdf5")).1, content(&dir.path().join("b_2.hdf5")).1);
    assert!(demos == [first[0].clone(), first[1].clone(), second[1].clone(), renumbered(3, &second[0])]);
    // the source is a folder of both files, in the order of their numbers
    let both = dir.path().join("both");
    std::fs::create_dir(&both).unwrap();
    for name in ["a_10.hdf5", "b_2.hdf5"] {
        std::fs::rename(dir.path().join(name), both.join(name)).unwrap();
    }
    assert_eq!(dataset::verify_source(&all, &both).unwrap().problem, None);
}

#[test]
fn what_only_some_of_the_sets_say_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let set = |name: &str, first: usize, root: &Demo| {
        let file = dir.path().join(format!("{name}.hdf5"));
        let mut writer = RobomimicWriter::create(&file, &WriteOptions::default()).unwrap();
        writer.set_root(root).unwrap();
        (first..first + 2).for_each(|number| writer.add_demo(&synthetic(number, 3, None)).unwrap());
        writer.finish().unwrap();
        let out = dir.path().join(name);
        convert(&file, &out, &ConvertOptions { fps: Some(20.0), ..ConvertOptions::default() }, &mut quiet).unwrap();
        out
    };
    let mut root = Demo::default();
    root.datasets.insert("mask/train".to_owned(), Array::from_strings(vec![1], &["demo_0".to_owned()]));
    root.inner_attrs.entry("data".to_owned()).or_default().insert("seeds".to_owned(), Array::from_str("10-19"));
    let (one, two, all) = (set("one", 0, &root), set("two", 2, &Demo::default()), dir.path().join("all"));
    let notes = merge(&[one, two.clone()], &all, &mut going).unwrap().notes;
    let masks = format!("{} has no mask train: its 2 episodes are in none of the result's", two.display());
    for note in ["1 of 2 sets state no seeds: 10-19 are those of the others", &masks] {
        assert!(notes.iter().any(|n| n == note), "{notes:?}");
    }
    assert_eq!(Dataset::open(&all).unwrap().split("train").unwrap(), [0]);
}

#[test]
fn files_that_differ_beside_their_demos_are_joined_as_far_as_they_agree() {
    let dir = tempfile::tempdir().unwrap();
    let options = ConvertOptions { fps: Some(20.0), ..ConvertOptions::default() };
    let set = |name: &str, args: &str, date: &str, number: usize| {
        let file = dir.path().join(format!("{name}.hdf5"));
        let mut root = Demo::default();
        let data = root.inner_attrs.entry("data".to_owned()).or_default();
        data.insert("env_args".to_owned(), Array::from_str(args));
        data.insert("date".to_owned(), Array::from_str(date));
        data.insert("seeds".to_owned(), Array::from_str(&format!("{number}0-{number}9")));
        let mut writer = RobomimicWriter::create(&file, &WriteOptions::default()).unwrap();
        writer.set_root(&root).unwrap();
        writer.add_demo(&synthetic(number, 4, None)).unwrap();
        writer.finish().unwrap();
        let out = dir.path().join(name);
        convert(&file, &out, &options, &mut quiet).unwrap();
        out
    };
    let args = r#"{"env_name": "Lift", "env_kwargs": {"control_freq": 20}}"#;
    let (a, b) = (set("a", args, "monday", 1), set("b", args, "tuesday", 2));
    let all = dir.path().join("all");
    let report = merge(&[a.clone(), b], &all, &mut going).unwrap();
    assert_eq!(report.notes, ["the sets differ in data/date, which the side folder leaves out"]);
    sound(&all);
    assert_eq!(Dataset::open(&all).unwrap().env().unwrap().seeds.as_deref(), Some("10-29"));
    let back = dir.path().join("back.hdf5");
    export(&all, &back, &WriteOptions::default(), &mut quiet).unwrap();
    let data = content(&back).0.inner_attrs["data"].clone();
    assert_eq!(data["seeds"].to_text().as_deref(), Some("10-29"));
    assert!(data.contains_key("env_args") && !data.contains_key("date"));
    // other arguments: no file has both, the frames can be had all the same
    let c = set("c", r#"{"env_name": "Lift", "env_kwargs": {"control_freq": 20, "robots": "Sawyer"}}"#, "monday", 3);
    let told = merge(&[a.clone(), c], &dir.path().join("ac"), &mut going).unwrap_err().to_string();
    assert!(told.contains("robot_type: expected none, as in ") && told.ends_with("found Sawyer"), "{told}");
    let d = set("d", r#"{"env_name": "Lift", "env_kwargs": {"control_freq": 20, "horizon": 9}}"#, "monday", 4);
    let out = dir.path().join("ad");
    let report = merge(&[a.clone(), d], &out, &mut going).unwrap();
    assert!(report.notes.iter().any(|n| n.contains("env_args")), "{:?}", report.notes);
    assert!(report.notes.iter().any(|n| n.contains("no HDF5 file can be rebuilt")), "{:?}", report.notes);
    sound(&out);
    assert!(!out.join("actrm/frames").exists());
    let columns = dir.path().join("columns.hdf5");
    assert!(export(&out, &columns, &WriteOptions::default(), &mut quiet).is_ok(), "a file of the columns");
    let e = set("e", r#"{"env_name": "Stack", "env_kwargs": {"control_freq": 20}}"#, "monday", 5);
    let told = merge(&[a, e], &dir.path().join("ae"), &mut going).unwrap_err().to_string();
    assert!(told.contains("actrm.env_name: expected Some(\"Lift\"), as in"), "{told}");
}

#[test]
fn features_get_other_names_wherever_they_stand() {
    let dir = tempfile::tempdir().unwrap();
    for (kind, side, options) in kinds().into_iter().filter(|(_, side, _)| side.is_some()) {
        let folder = dir.path().join(kind);
        std::fs::create_dir(&folder).unwrap();
        let demos: Vec<Demo> = (0..3).map(|i| synthetic(i, 4 + i, side)).collect();
        let mut options = options;
        options.entities.insert("cube".to_owned(), vec!["object[0:3]".to_owned()]);
        let whole = converted(&demos, &folder, "whole", &options);
        let renames: Renames = [
            (CAMERA, "observation.images.front"),
            ("observation.entity.cube", "observation.entity.block"),
            ("observation.environment_state", "world"),
            ("next.reward", "observation.environment_state"),
        ]
        .map(|(old, new)| (old.to_owned(), new.to_owned()))
        .into();
        let out = folder.join("renamed");
        rename(&whole, &Destination::New(out.clone()), &renames, &mut going).unwrap();
        sound(&out);
        let (a, b) = (Dataset::open(&whole).unwrap(), Dataset::open(&out).unwrap());
        assert_eq!(b.cameras().collect::<Vec<_>>(), ["observation.images.front"]);
        assert!(a.pictures(CAMERA).unwrap() == b.pictures("observation.images.front").unwrap());
        assert_eq!(a.column("next.reward"), b.column("observation.environment_state"));
        assert_eq!(a.column("observation.environment_state"), b.column("world"));
        let away = [("observation.environment_state".to_owned(), "world".to_owned())].into();
        rename(&whole, &Destination::New(folder.join("away")), &away, &mut going).unwrap();
        let away = Dataset::open(&folder.join("away")).unwrap();
        assert!(away.provenance().unwrap().env_keys.is_empty(), "keys of a column that is not there");
        let origin = b.provenance().unwrap();
        assert_eq!((origin.state_keys.len(), origin.env_keys.len()), (3, 0));
        assert_eq!(origin.entities.keys().collect::<Vec<_>>(), ["block"]);
        if options.lossless && options.video.is_none_or(|v| v.side_pictures) {
            let back = folder.join("back.hdf5");
            export(&out, &back, &WriteOptions::default(), &mut quiet).unwrap();
            assert!(content(&back) == content(&folder.join("whole.hdf5")), "{kind}");
        }
        // and back again: the same bytes in every file of the format
        let back: Renames = renames.into_iter().map(|(old, new)| (new, old)).collect();
        rename(&out, &Destination::InPlace, &back, &mut going).unwrap();
        assert_same_set(&out, &whole);
        assert_eq!(Dataset::open(&out).unwrap().info().features, a.info().features);
    }
}

#[test]
fn in_place_is_the_same_result_and_what_was_there_goes() {
    let dir = tempfile::tempdir().unwrap();
    let (set, new) = (dir.path().join("set"), dir.path().join("new"));
    convert(&fixture(), &set, &ConvertOptions::default(), &mut quiet).unwrap();
    let own = [("README.md", "mine"), (".git/HEAD", "ref"), ("meta/proportions.json", "{}"), ("data/notes.txt", "x")];
    for (name, text) in own {
        std::fs::create_dir_all(set.join(name).parent().unwrap()).unwrap();
        std::fs::write(set.join(name), text).unwrap();
    }
    let notes = without(&set, &Destination::New(new.clone()), &numbers(&[1]), &mut going).unwrap().notes;
    assert_eq!(notes, ["not copied: .git, README.md, data/notes.txt, meta/proportions.json"]);
    let notes = without(&set, &Destination::InPlace, &numbers(&[1]), &mut going).unwrap().notes;
    assert_eq!(notes, ["kept as it was, not adapted to the edit: meta/proportions.json"]);
    let (mut now, before) = (files(&set), files(&set));
    for (name, text) in own {
        assert_eq!(now.remove(Path::new(name)).unwrap(), text.as_bytes(), "{name}");
    }
    assert!(now == files(&new));
    assert!(without(&set, &Destination::InPlace, &numbers(&[0, 1]), &mut going).is_err());
    assert!(files(&set) == before);
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 2);
}

#[test]
fn what_lerobot_wrote_is_edited_and_its_videos_are_cut_without_encoding() {
    let dir = tempfile::tempdir().unwrap();
    let (cut, parts, again) = (dir.path().join("cut"), dir.path().join("parts"), dir.path().join("again"));
    let theirs = Dataset::open(&lerobot()).unwrap();
    let lengths: Vec<usize> = theirs.episodes().iter().map(|e| e.length).collect();
    without(&lerobot(), &Destination::New(cut.clone()), &numbers(&[1]), &mut going).unwrap();
    sound(&cut);
    let set = Dataset::open(&cut).unwrap();
    assert_eq!(set.episodes().iter().map(|e| e.length).collect::<Vec<_>>(), [lengths[0], lengths[2]]);
    assert_eq!(set.info().splits, BTreeMap::from([("train".to_owned(), "0:2".to_owned())]));
    for camera in theirs.cameras() {
        let (a, b) = (theirs.pictures(camera).unwrap(), set.pictures(camera).unwrap());
        let size = a.picture_bytes();
        let expected = [&a.data[..lengths[0] * size], &a.data[(lengths[0] + lengths[1]) * size..]].concat();
        assert!(b.data == expected, "{camera}");
    }
    let counts = Parts::Counts(vec![("one".to_owned(), 1), ("two".to_owned(), 2)]);
    split(&lerobot(), &parts, &counts, None, &mut going).unwrap();
    merge(&[parts.join("one"), parts.join("two")], &again, &mut going).unwrap();
    sound(&again);
    let again = Dataset::open(&again).unwrap();
    assert_eq!((again.fingerprint(), again.tasks()), (theirs.fingerprint(), theirs.tasks()));
    assert!(theirs.cameras().all(|camera| again.pictures(camera).unwrap() == theirs.pictures(camera).unwrap()));
    // whole files stay what they were
    let all = dir.path().join("all");
    keep(&lerobot(), &Destination::New(all.clone()), &numbers(&[0, 1, 2]), &mut going).unwrap();
    let videos = |root: &Path| files(&root.join("videos"));
    assert!(videos(&all) == videos(&lerobot()));
    assert_eq!(Dataset::open(&all).unwrap().stats()[CAMERA], theirs.stats()[CAMERA]);
}

#[test]
fn h264_is_carried_over_in_whole_files_and_never_cut() {
    let dir = tempfile::tempdir().unwrap();
    let set = dir.path().join("set");
    keep(&lerobot(), &Destination::New(set.clone()), &numbers(&[0, 1, 2]), &mut going).unwrap();
    for camera in ["agentview", "robot0_eye_in_hand"] {
        let from = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("../video/tests/fixtures/h264_{camera}.mp4"));
        let to = set.join(format!("videos/observation.images.{camera}/chunk-000/file-000.mp4"));
        std::fs::copy(from, to).unwrap();
    }
    let all = dir.path().join("all");
    keep(&set, &Destination::New(all.clone()), &numbers(&[0, 1, 2]), &mut going).unwrap();
    sound(&all);
    assert!(files(&all.join("videos")) == files(&set.join("videos")));
    let part = dir.path().join("part");
    let told = keep(&set, &Destination::New(part.clone()), &numbers(&[0]), &mut going).unwrap_err().to_string();
    assert!(told.contains("file-000.mp4: frames 0 to ") && told.contains("expected av1, found h264"), "{told}");
    assert!(!part.exists());
}

/// Writes `meta/episodes` anew with the columns that `stays` says of, each as `changed` makes it.
fn rewrite_episodes(set: &Path, stays: impl Fn(&str) -> bool, changed: impl Fn(&str, &ArrayRef) -> ArrayRef) {
    let path = set.join("meta/episodes/chunk-000/file-000.parquet");
    let mut reader = ParquetRecordBatchReaderBuilder::try_new(File::open(&path).unwrap()).unwrap().build().unwrap();
    let batch = reader.next().unwrap().unwrap();
    let schema = batch.schema();
    let columns = schema.fields().iter().zip(batch.columns()).filter(|(field, _)| stays(field.name()));
    let columns: Vec<(&str, ArrayRef)> =
        columns.map(|(field, column)| (field.name().as_str(), changed(field.name(), column))).collect();
    let batch = RecordBatch::try_from_iter(columns).unwrap();
    let mut writer = ArrowWriter::try_new(File::create(&path).unwrap(), batch.schema(), None).unwrap();
    writer.write(&batch).unwrap();
    writer.close().unwrap();
}

#[test]
fn videos_whose_pictures_nobody_counted_keep_their_places() {
    let dir = tempfile::tempdir().unwrap();
    let (set, out) = (dir.path().join("set"), dir.path().join("out"));
    keep(&lerobot(), &Destination::New(set.clone()), &numbers(&[0, 1, 2]), &mut going).unwrap();
    let wanted = Dataset::open(&set).unwrap().pictures(CAMERA).unwrap();
    rewrite_episodes(&set, |name| !name.starts_with("stats/observation.images."), |_, column| Arc::clone(column));
    let notes = without(&set, &Destination::InPlace, &numbers(&[2]), &mut going).unwrap().notes;
    assert!(notes.iter().any(|note| note.starts_with(&format!("statistics of {CAMERA}"))), "{notes:?}");
    let part = Dataset::open(&set).unwrap();
    assert!(wanted.data.starts_with(&part.pictures(CAMERA).unwrap().data));
    // beside one that is counted
    merge(&[lerobot(), set.clone()], &out, &mut going).unwrap();
    let both = Dataset::open(&out).unwrap();
    assert_eq!(both.pictures(CAMERA).unwrap().data, [&wanted.data[..], &part.pictures(CAMERA).unwrap().data].concat());
}

#[test]
fn videos_that_are_not_their_sets_are_not_carried_over() {
    let dir = tempfile::tempdir().unwrap();
    let (set, out) = (dir.path().join("set"), dir.path().join("out"));
    keep(&lerobot(), &Destination::New(set.clone()), &numbers(&[0, 1, 2]), &mut going).unwrap();
    let later = |name: &str, column: &ArrayRef| match name == format!("videos/{CAMERA}/from_timestamp") {
        true => Arc::new(Float64Array::from_iter_values(
            column.as_primitive::<Float64Type>().values().iter().map(|seconds| seconds + 0.6),
        )),
        false => Arc::clone(column),
    };
    rewrite_episodes(&set, |_| true, later);
    for some in [&[0, 1, 2][..], &[1, 2]] {
        let told = keep(&set, &Destination::New(out.clone()), &numbers(some), &mut going).unwrap_err().to_string();
        assert!(
            told.contains("file-000.mp4: frame") && told.contains("of episode 2: expected a frame within"),
            "{told}"
        );
        assert!(!out.exists());
    }
}

#[test]
fn what_cannot_be_done_is_told_and_leaves_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let (set, out) = (dir.path().join("set"), dir.path().join("out"));
    convert(&fixture(), &set, &ConvertOptions::default(), &mut quiet).unwrap();
    let other = dir.path().join("other");
    let six = ConvertOptions { rotation: dataset::RotationForm::SixD, ..ConvertOptions::default() };
    convert(&fixture(), &other, &six, &mut quiet).unwrap();
    let fast = dir.path().join("fast");
    convert(&fixture(), &fast, &ConvertOptions { fps: Some(10.0), ..ConvertOptions::default() }, &mut quiet).unwrap();
    let fewer = dir.path().join("fewer");
    convert(&fixture(), &fewer, &ConvertOptions { env_keys: Some(vec![]), ..ConvertOptions::default() }, &mut quiet)
        .unwrap();
    let new = || Destination::New(out.clone());
    let told = |result: Result<EditReport, dataset::DatasetError>, words: &[&str]| {
        let text = result.unwrap_err().to_string();
        assert!(words.iter().all(|word| text.contains(word)), "{words:?} in {text}");
        let mut names: Vec<_> = std::fs::read_dir(dir.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
        names.sort();
        assert_eq!(names, ["fast", "fewer", "other", "set"], "{text}");
    };
    let of_demo = Selection { demos: vec!["demo_9".to_owned()], ..Selection::default() };
    let of_mask = |name: &str| Selection { masks: vec![name.to_owned()], ..Selection::default() };
    told(keep(&set, &new(), &numbers(&[0, 3]), &mut going), &["no episode 3; there is 0 to 2"]);
    told(keep(&set, &new(), &of_demo, &mut going), &["no demo demo_9; there is demo_1, demo_2, demo_3"]);
    told(keep(&set, &new(), &of_mask("test"), &mut going), &["no split test; there is", "train, valid"]);
    told(keep(&set, &new(), &of_mask("valid"), &mut going), &["no episode in valid; there is an empty mask"]);
    told(keep(&set, &new(), &Selection::default(), &mut going), &["no episode that was chosen; there is 3"]);
    told(without(&set, &new(), &numbers(&[0, 1, 2]), &mut going), &["no episode that would be left; there is 3"]);
    told(keep(&set, &Destination::New(other.clone()), &numbers(&[0]), &mut going), &["other: exists already"]);
    told(keep(&out, &Destination::InPlace, &numbers(&[0]), &mut going), &["nothing at that path"]);
    told(
        merge(&[set.clone(), other.clone()], &out, &mut going),
        &["other: features.action: expected float32 [7], as in ", "found float32 [10]"],
    );
    told(merge(&[set.clone(), fast.clone()], &out, &mut going), &["fast: fps: expected 20, as in ", "found 10"]);
    told(
        merge(&[set.clone(), fewer.clone()], &out, &mut going),
        &["fewer: features.observation.environment_state: expected float32 [10]", "found no such feature"],
    );
    told(
        merge(&[fewer.clone(), set.clone()], &out, &mut going),
        &["set: features.observation.environment_state: expected no such feature", "found one"],
    );
    told(merge(&[set.clone(), set.clone()], &other, &mut going), &["other: exists already"]);
    let inside = Destination::New(set.join("inside"));
    told(keep(&set, &inside, &numbers(&[0]), &mut going), &["inside: output: expected a place outside of "]);
    assert!(!set.join("inside").exists());
    let stops = &mut |_, _| std::ops::ControlFlow::Break(());
    told(keep(&set, &new(), &numbers(&[0]), stops), &["was stopped"]);
    for (old, name, words) in [
        ("reward", "x", &["no feature reward; there is ", "next.reward"][..]),
        ("next.reward", "action", &["new name of next.reward: expected a name that no feature has, found action"]),
        ("next.reward", "a/b", &["expected a name without slashes", "\"a/b\""]),
        ("next.reward", "index", &["not an index column's", "\"index\""]),
        ("timestamp", "time", &["expected timestamp, which keeps its name, found time"]),
        ("action", "act", &["expected action, which keeps its name, found act"]),
    ] {
        told(rename(&set, &new(), &Renames::from([(old.to_owned(), name.to_owned())]), &mut going), words);
    }
    let parts = |parts: Parts| split(&set, &out, &parts, None, &mut going).map(|mut made| made.remove(0).1);
    let two = |a: f64, b: f64| Parts::Fractions(vec![("a".to_owned(), a), ("b".to_owned(), b)]);
    told(parts(two(0.9, 0.2)), &["parts: expected shares above 0, together 1 at most, found a 0.9, b 0.2"]);
    told(parts(two(0.9, 0.1)), &["part b: expected 1 episode or more, found none"]);
    told(
        parts(Parts::Counts(vec![("a".to_owned(), 4)])),
        &["parts: expected 3 episodes at most, as there are, found 4"],
    );
    told(parts(Parts::Counts(vec![("../a".to_owned(), 1)])), &["part 1: expected a name for a folder", "\"../a\""]);
    told(parts(Parts::Masks(vec!["train".to_owned(), "valid".to_owned()])), &["part valid: expected 1 episode"]);
    told(
        parts(Parts::Masks(vec!["train".to_owned(), "train".to_owned()])),
        &["part 2: expected a name for a folder, another"],
    );
    // nor are pictures that were exchanged where no hash of a file tells
    let bare = ConvertOptions { lossless: false, fps: Some(20.0), ..ConvertOptions::default() };
    let folder = tempfile::tempdir().unwrap();
    let seen = synthetic(0, 4, Some(24));
    let mut painted = seen.clone();
    painted.datasets.get_mut("obs/agentview_image").unwrap().bytes[100] ^= 1;
    let (one, two) =
        (converted(&[seen], folder.path(), "one", &bare), converted(&[painted], folder.path(), "two", &bare));
    let data = "data/chunk-000/file-000.parquet";
    std::fs::copy(two.join(data), one.join(data)).unwrap();
    told(
        keep(&one, &new(), &numbers(&[0]), &mut going),
        &["one: images: expected the content that was recorded", "fingerprint"],
    );
    // what was changed since it was written is not carried on
    let path = set.join("actrm/layout.json");
    let mut text = std::fs::read_to_string(&path).unwrap();
    text.push(' ');
    std::fs::write(&path, text).unwrap();
    told(keep(&set, &new(), &numbers(&[0]), &mut going), &["layout.json: sha256: expected"]);
}
