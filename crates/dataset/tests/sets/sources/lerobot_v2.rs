//! LeRobot v2.0 and v2.1 folders.

use super::{fixture, quiet};
use crate::common::{copy, going};
use arrow_array::cast::AsArray;
use arrow_array::types::{Float32Type, Int64Type};
use arrow_array::{Array, ArrayRef, FixedSizeListArray, Float32Array, RecordBatch};
use dataset::edit::{Destination, Selection, keep};
use dataset::{ConvertOptions, Dataset, NonFinite, OldSet, Source, VideoFile, convert, verify};
use parquet::arrow::ArrowWriter;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use std::fs::File;
use std::path::Path;
use std::sync::Arc;

const TOP: &str = "observation.images.top";

fn rgb(path: &Path, frames: usize) -> Vec<u8> {
    let file = VideoFile::open(path).unwrap();
    let mut all = Vec::new();
    file.read(0..frames, &mut |_, picture| all.extend_from_slice(picture)).unwrap();
    all
}

#[test]
fn every_frame_is_kept_and_videos_are_joined_without_encoding() {
    let (dir, old) = (tempfile::tempdir().unwrap(), fixture("lerobot_v21"));
    let out = dir.path().join("set");
    let report = convert(&old, &out, &ConvertOptions::default(), &mut quiet).unwrap();
    assert_eq!((report.dialect, report.episodes, report.frames), ("LeRobot v2.1", 3, 15));
    assert_eq!(report.notes, ["not copied: README.md"]);
    let set = Dataset::open(&out).unwrap();
    assert_eq!(set.tasks(), ["pick the cube", "place the cube"]);
    assert_eq!(set.episodes().iter().map(|e| e.length).collect::<Vec<_>>(), [5, 4, 6]);
    assert_eq!(set.notes(), [""; 0]);
    let actions = set.column("action").unwrap();
    let mut row = 0;
    for (episode, meta) in set.episodes().iter().enumerate() {
        let file = File::open(old.join(format!("data/chunk-000/episode_{episode:06}.parquet"))).unwrap();
        for batch in ParquetRecordBatchReaderBuilder::try_new(file).unwrap().build().unwrap() {
            let batch = batch.unwrap();
            let action = batch.column_by_name("action").unwrap().as_fixed_size_list();
            let expected = action.values().as_primitive::<Float32Type>().values();
            assert_eq!(&actions.data[row * 3..(row + batch.num_rows()) * 3], &expected[..]);
            let task = batch.column_by_name("task_index").unwrap().as_primitive::<Int64Type>().value(0);
            assert_eq!(meta.tasks, [set.tasks()[task as usize].clone()]);
            row += batch.num_rows();
        }
        let video = old.join(format!("videos/chunk-000/{TOP}/episode_{episode:06}.mp4"));
        let shown = set.episode_pictures(TOP, episode).unwrap();
        assert!(shown.data == rgb(&video, meta.length), "episode {episode}");
    }
    assert_eq!(set.video_files(TOP).unwrap().len(), 1);
    // images are looked at, videos keep what was stated of them
    assert_ne!(set.stats()["observation.images.wrist"].max[0], 0.7);
    assert!((set.stats()[TOP].max[0] - 0.7).abs() < 1e-9);
    for check in verify(&out, &mut quiet).unwrap() {
        assert_eq!(check.problem, None, "{}", check.name);
    }
}

#[test]
fn version_2_0_has_statistics_of_the_whole_alone() {
    let dir = tempfile::tempdir().unwrap();
    let old = dir.path().join("old");
    copy(&fixture("lerobot_v21"), &old);
    std::fs::remove_file(old.join("meta/episodes_stats.jsonl")).unwrap();
    let stats = format!(r#"{{"{TOP}": {{"min": [[[0.0]]], "max": [[[0.5]]], "mean": [[[0.25]]], "std": [[[NaN]]]}}}}"#);
    std::fs::write(old.join("meta/stats.json"), stats.replace("NaN", "0.1")).unwrap();
    let info = std::fs::read_to_string(old.join("meta/info.json")).unwrap();
    std::fs::write(old.join("meta/info.json"), info.replace("v2.1", "v2.0")).unwrap();
    let out = dir.path().join("set");
    assert_eq!(convert(&old, &out, &ConvertOptions::default(), &mut quiet).unwrap().dialect, "LeRobot v2.0");
    assert_eq!(Dataset::open(&out).unwrap().stats()[TOP].mean, [0.25]);
}

#[test]
fn what_is_missing_is_named_as_the_folder_has_it() {
    let dir = tempfile::tempdir().unwrap();
    let broken = |name: &str, change: &dyn Fn(&Path)| {
        let old = dir.path().join(name);
        copy(&fixture("lerobot_v21"), &old);
        change(&old);
        let out = dir.path().join(format!("{name}.out"));
        let text = convert(&old, &out, &ConvertOptions::default(), &mut quiet).unwrap_err().to_string();
        assert!(!out.exists() && !text.contains('\n'), "{text}");
        text
    };
    let second = "data/chunk-000/episode_000001.parquet";
    let pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 4000\n";
    let text = broken("pointer", &|old| std::fs::write(old.join(second), pointer).unwrap());
    assert!(text.contains(&format!("pointer/{second}: a git-lfs pointer")), "{text}");
    let text = broken("cut", &|old| std::fs::write(old.join(second), b"PAR1").unwrap());
    assert!(text.contains(&format!("cut/{second}")), "{text}");
    let video = format!("videos/chunk-000/{TOP}/episode_000002.mp4");
    let text = broken("no_video", &|old| std::fs::remove_file(old.join(&video)).unwrap());
    assert!(text.contains(&format!("no_video/{video}")), "{text}");
    let text = broken("bad_video", &|old| std::fs::write(old.join(&video), b"nothing").unwrap());
    assert!(text.contains(&format!("bad_video/{video}")), "{text}");
    let text = broken("gap", &|old| {
        let lines = std::fs::read_to_string(old.join("meta/episodes.jsonl")).unwrap();
        std::fs::write(old.join("meta/episodes.jsonl"), lines.split_inclusive('\n').take(1).collect::<String>() + "{")
            .unwrap();
    });
    assert!(text.contains("gap/meta/episodes.jsonl: line 2"), "{text}");
    let text = broken("outside", &|old| {
        let info = std::fs::read_to_string(old.join("meta/info.json")).unwrap();
        std::fs::write(old.join("meta/info.json"), info.replace("data/chunk-{", "../chunk-{")).unwrap();
    });
    assert!(text.contains("data_path"), "{text}");
    let edited = |old: &Path, from: &str, to: &str| {
        let info = std::fs::read_to_string(old.join("meta/info.json")).unwrap();
        std::fs::write(old.join("meta/info.json"), info.replace(from, to)).unwrap();
    };
    let planted = dir.path().join("planted");
    for name in [planted.to_str().unwrap(), "../../planted"] {
        let text = broken(&format!("escape_{}", name.len()), &|old| {
            edited(old, TOP, name);
            edited(old, "{video_key}", TOP);
        });
        assert!(text.contains("meta/info.json: features: expected names that stay inside the folder"), "{text}");
        assert!(!planted.exists());
    }
    let text = broken("one_video", &|old| edited(old, "{video_key}", TOP));
    assert!(text.contains("meta/info.json: video_path: expected") && text.contains("with video_key"), "{text}");
    let whole = dir.path().join("whole");
    copy(&fixture("lerobot_v21"), &whole);
    let refused = convert(&whole, &whole.join("inside"), &ConvertOptions::default(), &mut quiet).unwrap_err();
    assert!(refused.to_string().contains("inside: output: expected a place outside of "), "{refused}");
}

#[test]
fn a_count_that_is_wrong_is_noted_and_other_doors_say_what_to_do() {
    let dir = tempfile::tempdir().unwrap();
    let old = dir.path().join("old");
    copy(&fixture("lerobot_v21"), &old);
    let path = old.join("meta/episodes.jsonl");
    let lines = std::fs::read_to_string(&path).unwrap().replace("\"length\": 4", "\"length\": 9");
    let lines = lines.replacen("\"length\"", "\"operator\": \"Ada\", \"scores\": [1, null], \"length\"", 1);
    std::fs::write(&path, lines).unwrap();
    let info = std::fs::read_to_string(old.join("meta/info.json")).unwrap();
    std::fs::write(old.join("meta/info.json"), info.replace("\"total_episodes\": 3", "\"total_episodes\": 4")).unwrap();
    let data = old.join("data/chunk-000");
    std::fs::copy(data.join("episode_000001.parquet"), data.join("episode_000003.parquet")).unwrap();
    let opened = OldSet::open(&old).unwrap().unwrap();
    let [total, length, files] = opened.notes() else { panic!("{:?}", opened.notes()) };
    assert!(total.contains("total_episodes: expected 3, as meta/episodes.jsonl lists, found 4"), "{total}");
    assert!(length.contains("episode 1: expected 4 frames"), "{length}");
    assert!(files.contains("1 files, which are left out: data/chunk-000/episode_000003.parquet"), "{files}");
    assert_eq!(opened.set().frames(), 15);
    drop(opened);
    // what another program says of an episode is kept
    let made = dir.path().join("made");
    convert(&old, &made, &ConvertOptions::default(), &mut quiet).unwrap();
    let file = File::open(made.join("meta/episodes/chunk-000/file-000.parquet")).unwrap();
    let table = ParquetRecordBatchReaderBuilder::try_new(file).unwrap().build().unwrap().next().unwrap().unwrap();
    let operators = table.column_by_name("operator").unwrap().as_string::<i32>();
    assert_eq!(operators.iter().collect::<Vec<_>>(), [Some("Ada"), None, None]);
    let scores = table.column_by_name("scores").unwrap().as_list::<i32>();
    assert_eq!((scores.null_count(), scores.value(0).as_primitive::<Int64Type>().value(0)), (2, 1));
    let chosen = Selection { episodes: vec![0], ..Selection::default() };
    let kept = keep(&old, &Destination::New(dir.path().join("kept")), &chosen, &mut going).map(drop);
    let opened = Dataset::open(&old).map(drop);
    for text in [kept, opened, Source::open(&old).map(drop)].map(|r| r.unwrap_err().to_string()) {
        assert!(text.contains("`actrm-data convert` makes a") && !text.contains('\n'), "{text}");
    }
    let fps = ConvertOptions { fps: Some(5.0), ..ConvertOptions::default() };
    let text = convert(&old, &dir.path().join("out"), &fps, &mut quiet).unwrap_err().to_string();
    assert!(text.contains("--fps is not supported"), "{text}");
}

/// Changes the times of an episode.
fn with_times(path: &Path, change: impl Fn(&ArrayRef) -> ArrayRef) {
    let reader = ParquetRecordBatchReaderBuilder::try_new(File::open(path).unwrap()).unwrap().build().unwrap();
    for batch in reader.collect::<Vec<_>>() {
        let batch = batch.unwrap();
        let schema = batch.schema();
        let column = |(field, column): (&Arc<arrow_schema::Field>, &ArrayRef)| match field.name().as_str() {
            "timestamp" => ("timestamp".to_owned(), change(column)),
            name => (name.to_owned(), Arc::clone(column)),
        };
        let changed = schema.fields().iter().zip(batch.columns()).map(column);
        let changed = RecordBatch::try_from_iter(changed).unwrap();
        let mut writer = ArrowWriter::try_new(File::create(path).unwrap(), changed.schema(), None).unwrap();
        writer.write(&changed).unwrap();
        writer.close().unwrap();
    }
}

#[test]
fn times_may_be_lists_of_one() {
    let dir = tempfile::tempdir().unwrap();
    let (old, out) = (dir.path().join("old"), dir.path().join("set"));
    copy(&fixture("lerobot_v21"), &old);
    let made = |out: &Path| convert(&old, out, &ConvertOptions::default(), &mut quiet).unwrap().fingerprint;
    let expected = made(&out);
    for episode in 0..2 {
        with_times(&old.join(format!("data/chunk-000/episode_00000{episode}.parquet")), |times| {
            let kind = Arc::new(arrow_schema::Field::new("element", times.data_type().clone(), false));
            Arc::new(FixedSizeListArray::new(kind, 1, Arc::clone(times), None))
        });
    }
    assert_eq!(made(&dir.path().join("again")), expected);
    let data = "data/chunk-000/file-000.parquet";
    let same = [out.join(data), dir.path().join("again").join(data)].map(|file| {
        let file = ParquetRecordBatchReaderBuilder::try_new(File::open(file).unwrap()).unwrap();
        file.schema().field_with_name("timestamp").unwrap().data_type().clone()
    });
    assert_eq!(same[0], same[1]);
}

#[test]
fn a_column_that_is_not_stated_is_left_out_and_times_are_finite() {
    let dir = tempfile::tempdir().unwrap();
    let old = dir.path().join("old");
    copy(&fixture("lerobot_v21"), &old);
    let path = old.join("data/chunk-000/episode_000001.parquet");
    with_times(&path, |times| Arc::new(Float32Array::from(vec![f32::NAN; times.len()])));
    let info = std::fs::read(old.join("meta/info.json")).unwrap();
    let mut info: serde_json::Value = serde_json::from_slice(&info).unwrap();
    info["features"].as_object_mut().unwrap().remove("next.done").unwrap();
    std::fs::write(old.join("meta/info.json"), info.to_string()).unwrap();
    let out = dir.path().join("set");
    let text = convert(&old, &out, &ConvertOptions::default(), &mut quiet).unwrap_err().to_string();
    assert!(text.contains("timestamp: episode 1, frame 0: NaN") && text.contains("--nonfinite keep"), "{text}");
    let keep = ConvertOptions { nonfinite: NonFinite::Keep, ..ConvertOptions::default() };
    let notes = convert(&old, &out, &keep, &mut quiet).unwrap().notes;
    let [column, times, _] = notes.as_slice() else { panic!("{notes:?}") };
    assert!(
        column.starts_with("column next.done: ") && column.ends_with("it is left out, with its values"),
        "{column}"
    );
    assert!(times.contains("by up to NaN s"), "{times}");
    let file = File::open(out.join("data/chunk-000/file-000.parquet")).unwrap();
    let file = ParquetRecordBatchReaderBuilder::try_new(file).unwrap();
    assert!(file.schema().index_of("next.done").is_err() && file.schema().index_of("action").is_ok());
    // LeRobot's robomimic twin has what is lacking
    let again = dir.path().join("again.hdf5");
    let report = dataset::export(&out, &again, &dataset::WriteOptions::default(), &mut quiet).unwrap();
    let named = |text: &str| report.notes.iter().any(|note| note.contains(text));
    assert!(named("timestamp is left out") && named("the data set has no rewards and no dones"), "{:?}", report.notes);
}
