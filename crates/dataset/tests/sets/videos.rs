//! Videos of data sets: LeRobot's own read, ours written, read and checked.

#![allow(clippy::unwrap_used)]

use crate::common::{copy, files};
use dataset::{
    Array, ConvertOptions, Dataset, Demo, RobomimicWriter, STATE, Source, VideoOptions, WindowBatch, WindowSpec,
    WriteOptions, convert, export, verify,
};
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};
use std::sync::Arc;

const CAMERA: &str = "observation.images.agentview";

fn lerobot() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/lerobot_video_av1")
}

fn quiet(_: u64, _: u64) {}

#[test]
fn lerobots_pictures_are_lerobots_bytes() {
    let set = Dataset::open(&lerobot()).unwrap();
    assert_eq!(set.cameras().collect::<Vec<_>>(), [CAMERA, "observation.images.robot0_eye_in_hand"]);
    for camera in set.cameras() {
        let pictures = set.pictures(camera).unwrap();
        assert_eq!((pictures.height, pictures.width, pictures.data.len()), (84, 84, 36 * 84 * 84 * 3));
        let short = camera.trim_start_matches("observation.images.");
        let hashes = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("../video/tests/fixtures/av1_{short}.sha256"));
        for (frame, expected) in std::fs::read_to_string(hashes).unwrap().lines().enumerate() {
            let found: String = Sha256::digest(pictures.frame(frame)).iter().map(|b| format!("{b:02x}")).collect();
            assert_eq!(found, expected, "{camera} frame {frame}");
        }
        let [file] = set.video_files(camera).unwrap().try_into().unwrap();
        assert_eq!(
            (file.info.codec.as_str(), file.info.width, file.info.height, file.info.frames),
            ("av1", 84, 84, 36)
        );
        assert_eq!(file.path, lerobot().join(format!("videos/{camera}/chunk-000/file-000.mp4")));
    }
    for check in verify(&lerobot(), &mut quiet).unwrap() {
        assert_eq!(check.problem, None, "{}", check.name);
    }
    let refused = set.pictures("observation.images.wrist").unwrap_err().to_string();
    assert!(
        refused.contains("no camera observation.images.wrist; there is observation.images.agentview, "),
        "{refused}"
    );
}

#[test]
fn a_camera_that_is_not_as_the_set_says_is_told() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join("set");
    copy(&lerobot(), &root);
    let video = root.join(format!("videos/{CAMERA}/chunk-000/file-000.mp4"));
    let whole = std::fs::read(&video).unwrap();
    let info = std::fs::read_to_string(root.join("meta/info.json")).unwrap();
    let told = || Dataset::open(&root).and_then(|set| set.pictures(CAMERA).map(drop)).unwrap_err().to_string();
    let edited = |from: &str, to: &str| {
        assert!(info.contains(from));
        std::fs::write(root.join("meta/info.json"), info.replace(from, to)).unwrap();
        let text = told();
        std::fs::write(root.join("meta/info.json"), &info).unwrap();
        text
    };
    std::fs::write(&video, &whole[..5000]).unwrap();
    assert!(told().contains("file-000.mp4: truncated: box mdat ends at byte 10027, the file has 5000"), "{}", told());
    std::fs::remove_file(&video).unwrap();
    assert!(told().contains("file-000.mp4: no such file"), "{}", told());
    let other = Path::new(env!("CARGO_MANIFEST_DIR")).join("../video/tests/fixtures/refused/two_tracks.mp4");
    std::fs::copy(other, &video).unwrap();
    assert!(told().contains("a file with 2 video tracks is not read"), "{}", told());
    // another camera's file of another length
    let short = Path::new(env!("CARGO_MANIFEST_DIR")).join("../video/tests/fixtures/refused/fragmented.mp4");
    std::fs::copy(short, &video).unwrap();
    assert!(told().contains("a fragmented MP4 file"), "{}", told());
    std::fs::write(&video, &whole).unwrap();
    let text = edited("\"fps\": 20,", "\"fps\": 21,");
    assert!(text.contains("21") || text.contains("frame 1 of episode 0: expected a frame within 0.0001 s"), "{text}");
    let text = edited("                84,\n                84,", "                84,\n                96,");
    assert!(text.contains("images: expected 84 x 96, as info.json says, found 84 x 84"), "{text}");
    let text = edited("videos/{video_key}/chunk", "../{video_key}/chunk");
    assert!(text.contains("video_path: expected a path inside the data set"), "{text}");
}

/// Demos with two cameras that show something smooth that moves.
fn demos(path: &Path, lengths: &[usize]) {
    demos_of(path, lengths, (48, 48));
}

/// The same with a hand's camera of another height and width.
fn demos_of(path: &Path, lengths: &[usize], hand: (usize, usize)) {
    let mut writer = RobomimicWriter::create(path, &WriteOptions::default()).unwrap();
    for (number, &length) in lengths.iter().enumerate() {
        let mut demo = Demo { id: format!("demo_{number}"), ..Demo::default() };
        demo.attrs.insert("num_samples".to_owned(), Array::from_i64(vec![], &[length as i64]));
        for (key, width) in [("robot0_eef_pos", 3), ("robot0_eef_quat", 4), ("robot0_gripper_qpos", 2)] {
            let values: Vec<f64> = (0..length * width).map(|i| (i as f64 * 0.1).sin()).collect();
            demo.datasets.insert(format!("obs/{key}"), Array::from_f64(vec![length, width], &values));
        }
        demo.datasets.insert("actions".to_owned(), Array::from_f64(vec![length, 7], &vec![0.5; length * 7]));
        for (camera, (height, width)) in [("agentview", (84, 84)), ("robot0_eye_in_hand", hand)] {
            let picture = |frame: usize| {
                (0..height * width * 3).map(move |i| {
                    let (x, y) = ((i / 3 % width) as f64 / 20.0, (i / 3 / width) as f64 / 25.0);
                    let t = (frame + 5 * number) as f64 * 0.2 + (i % 3) as f64;
                    (127.5 + 90.0 * (x + t).sin() * (y - 0.5 * t).cos()) as u8
                })
            };
            let shape = vec![length, height, width, 3];
            let bytes: Vec<u8> = (0..length).flat_map(picture).collect();
            let next: Vec<u8> = (1..=length).flat_map(picture).collect();
            demo.datasets.insert(format!("obs/{camera}_image"), Array::from_u8(shape.clone(), &bytes));
            demo.datasets.insert(format!("next_obs/{camera}_image"), Array::from_u8(shape, &next));
        }
        writer.add_demo(&demo).unwrap();
    }
    writer.set_data_attr("total", &Array::from_i64(vec![], &[lengths.iter().sum::<usize>() as i64])).unwrap();
    writer.finish().unwrap();
}

fn content(path: &Path) -> (Demo, Vec<Demo>) {
    let source = Source::open(path).unwrap();
    let demos = (0..source.plan().demos.len()).map(|i| source.read_demo(i).unwrap()).collect();
    (source.root().unwrap(), demos)
}

fn options(video: Option<VideoOptions>) -> ConvertOptions {
    ConvertOptions { fps: Some(20.0), video, ..ConvertOptions::default() }
}

#[test]
fn videos_are_written_read_and_checked_and_the_source_comes_back() {
    let dir = tempfile::tempdir().unwrap();
    let (source, out, back) = (dir.path().join("a.hdf5"), dir.path().join("set"), dir.path().join("b.hdf5"));
    demos(&source, &[7, 12, 1]);
    let report = convert(&source, &out, &options(Some(VideoOptions::default())), &mut quiet).unwrap();
    let note = report.notes.iter().find(|n| n.starts_with(CAMERA)).unwrap();
    assert!(
        note.contains("AV1 video") && note.contains("not equal") && note.contains("keeps the exact ones"),
        "{note}"
    );
    let exact = dir.path().join("exact");
    convert(&source, &exact, &options(None), &mut quiet).unwrap();
    let (set, exact) = (Dataset::open(&out).unwrap(), Dataset::open(&exact).unwrap());
    assert_eq!(
        set.info().video_path.as_deref(),
        Some("videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4")
    );
    let feature = set.info().features.get(CAMERA).unwrap();
    assert_eq!((feature.dtype.as_str(), &feature.shape[..]), ("video", &[84, 84, 3][..]));
    let said = feature.info.as_ref().unwrap();
    assert_eq!(
        (said["video.codec"].as_str(), said["video.fps"].as_i64(), said["has_audio"].as_bool()),
        (Some("av1"), Some(20), Some(false))
    );
    assert_eq!(set.column("action"), exact.column("action"));
    for set in [&set, &exact] {
        let (all, file) = (set.pictures(CAMERA).unwrap(), set.picture_file(CAMERA, dir.path()).unwrap());
        assert_eq!(set.decoded_bytes(CAMERA).unwrap(), all.data.len() as u64);
        let mut one = vec![0; all.picture_bytes()];
        for frame in [0, 6, 7, 19] {
            file.read(frame, &mut one).unwrap();
            assert_eq!(one, all.frame(frame), "frame {frame}");
        }
        let beyond = file.read(20, &mut one).unwrap_err().to_string();
        assert!(beyond.contains(&dir.path().display().to_string()) && beyond.contains("decoded images"), "{beyond}");
        let second = set.episode_pictures(CAMERA, 1).unwrap();
        assert_eq!(second.data, all.data[7 * one.len()..19 * one.len()]);
        let some = set.pictures_of(CAMERA, 1, &mut |frame| [3, 11].contains(&frame)).unwrap();
        assert_eq!(some.data, [second.frame(3), second.frame(11)].concat());
        let spec = WindowSpec {
            observation: vec![STATE.to_owned()],
            n_obs_steps: 2,
            action_horizon: 3,
            episodes: vec![0, 2],
            mistakes: false,
        };
        let windows = || set.windows(&spec).unwrap();
        let (memory, disk) = (windows().with_pictures(CAMERA, Arc::new(all)), windows().with_pictures(CAMERA, file));
        assert_eq!((memory.reads_files(), disk.reads_files()), (false, true));
        let (mut a, mut b) = (WindowBatch::default(), WindowBatch::default());
        memory.gather(&[7, 0, 3], &mut a);
        disk.try_gather(&[7, 0, 3], &mut b).unwrap();
        assert!(a == b);
    }
    for camera in [CAMERA, "observation.images.robot0_eye_in_hand"] {
        let (near, right) = (set.pictures(camera).unwrap(), exact.pictures(camera).unwrap());
        assert_eq!((near.height, near.width, near.data.len()), (right.height, right.width, right.data.len()));
        for frame in 0..20 {
            let error: f64 = near
                .frame(frame)
                .iter()
                .zip(right.frame(frame))
                .map(|(&a, &b)| (f64::from(a) - f64::from(b)).powi(2))
                .sum();
            let psnr = 10.0 * (255.0 * 255.0 * near.picture_bytes() as f64 / error).log10();
            assert!(psnr > 27.0, "{camera} frame {frame}: {psnr}");
        }
        // statistics are those of the recording, as LeRobot's are
        assert_eq!(set.stats()[camera], exact.stats()[camera]);
    }
    for check in verify(&out, &mut quiet).unwrap() {
        assert_eq!(check.problem, None, "{}", check.name);
    }
    export(&out, &back, &WriteOptions::default(), &mut quiet).unwrap();
    assert!(content(&back) == content(&source));
    // a changed picture is found, whatever hashes say
    let video = out.join(format!("videos/{CAMERA}/chunk-000/file-000.mp4"));
    let wrist = out.join("videos/observation.images.robot0_eye_in_hand/chunk-000/file-000.mp4");
    std::fs::copy(wrist, video).unwrap();
    let problems: Vec<String> = verify(&out, &mut quiet).unwrap().into_iter().filter_map(|c| c.problem).collect();
    assert!(problems.iter().any(|p| p.contains("expected 84 x 84, as info.json says, found 48 x 48")), "{problems:?}");
}

#[test]
fn the_same_bytes_whatever_the_number_of_threads_and_files_are_closed_by_size() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("a.hdf5");
    demos(&source, &[9, 4, 11, 6]);
    let video = Some(VideoOptions { quantizer: 120, ..VideoOptions::default() });
    for jobs in [1, 3] {
        let out = dir.path().join(jobs.to_string());
        convert(&source, &out, &ConvertOptions { jobs, ..options(video) }, &mut quiet).unwrap();
    }
    assert!(files(&dir.path().join("1")) == files(&dir.path().join("3")));
    let small = dir.path().join("small");
    convert(&source, &small, &ConvertOptions { video_file_mb: 0.0001, ..options(video) }, &mut quiet).unwrap();
    assert!(small.join(format!("videos/{CAMERA}/chunk-000/file-003.mp4")).exists());
    let (whole, cut) = (Dataset::open(&dir.path().join("1")).unwrap(), Dataset::open(&small).unwrap());
    assert_eq!(whole.pictures(CAMERA).unwrap(), cut.pictures(CAMERA).unwrap());
    assert_eq!(whole.fingerprint(), cut.fingerprint());
    assert_eq!(cut.video_files(CAMERA).unwrap().len(), 4);
}

#[test]
fn what_is_left_out_is_said_and_not_made_up() {
    let dir = tempfile::tempdir().unwrap();
    let (source, out) = (dir.path().join("a.hdf5"), dir.path().join("set"));
    demos(&source, &[5]);
    let video = Some(VideoOptions { side_pictures: false, ..VideoOptions::default() });
    let report = convert(&source, &out, &options(video), &mut quiet).unwrap();
    assert!(report.notes.iter().any(|n| n.contains("--no-side-pictures") && n.contains("cannot be rebuilt")));
    // robomimic gets the images as the video has them, and they come back so
    let (file, again) = (dir.path().join("b.hdf5"), dir.path().join("again"));
    export(&out, &file, &WriteOptions::default(), &mut quiet).unwrap();
    convert(&file, &again, &options(None), &mut quiet).unwrap();
    let (first, second) = (Dataset::open(&out).unwrap(), Dataset::open(&again).unwrap());
    assert_eq!(first.pictures(CAMERA).unwrap(), second.pictures(CAMERA).unwrap());
    for check in verify(&out, &mut quiet).unwrap() {
        assert_eq!(check.problem, None, "{}", check.name);
    }
    let full = dir.path().join("full");
    convert(&source, &full, &options(Some(VideoOptions::default())), &mut quiet).unwrap();
    let side = |root: &Path| -> u64 { files(&root.join("actrm")).values().map(|b| b.len() as u64).sum() };
    assert!(side(&out) < side(&full) / 2, "{} {}", side(&out), side(&full));
    let odd = ConvertOptions { fps: Some(std::f64::consts::PI), ..options(Some(VideoOptions::default())) };
    let refused = convert(&source, &dir.path().join("pi"), &odd, &mut quiet).unwrap_err().to_string();
    assert!(refused.contains("84 x 84 at 3.14159") && refused.contains("no fraction"), "{refused}");
}

#[test]
fn a_size_that_no_video_has_is_told_before_any_work() {
    let dir = tempfile::tempdir().unwrap();
    let (source, out) = (dir.path().join("a.hdf5"), dir.path().join("set"));
    demos_of(&source, &[5], (47, 48));
    let mut begun = |_: u64, _: u64| panic!("work began");
    let refused = convert(&source, &out, &options(Some(VideoOptions::default())), &mut begun).unwrap_err().to_string();
    for part in ["a.hdf5: demo_0: obs/robot0_eye_in_hand_image: expected", "--video", "47 x 48", "odd"] {
        assert!(refused.contains(part), "{part}: {refused}");
    }
    assert!(!out.exists());
    convert(&source, &out, &options(None), &mut quiet).unwrap();
    assert_eq!(Dataset::open(&out).unwrap().frames(), 5);
}

#[test]
fn an_image_that_cannot_be_decoded_is_named_by_its_episode() {
    let dir = tempfile::tempdir().unwrap();
    let (source, out) = (dir.path().join("a.hdf5"), dir.path().join("set"));
    demos(&source, &[5, 3]);
    convert(&source, &out, &options(None), &mut quiet).unwrap();
    let path = out.join("meta/info.json");
    let mut info: serde_json::Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    info["features"][CAMERA]["shape"] = serde_json::json!([84, 80, 3]);
    std::fs::write(&path, info.to_string()).unwrap();
    let path = out.join("actrm/info.json");
    let mut origin: serde_json::Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    origin.as_object_mut().unwrap().remove("seal").unwrap();
    std::fs::write(&path, origin.to_string()).unwrap();
    let set = Dataset::open(&out).unwrap();
    let refused = set.pictures_of(CAMERA, 1, &mut |_| true).unwrap_err().to_string();
    assert!(refused.contains(CAMERA) && refused.contains("of episode 1: expected"), "{refused}");
}
