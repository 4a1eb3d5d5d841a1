//! Recordings of other layouts than robomimic's, those that keep their images as JPEG files, and robomimic files of data sets.

#![allow(clippy::unwrap_used)]

use crate::made::{jpeg, value};
use dataset::{
    ConvertOptions, ConvertReport, Dataset, Dialect, Dtype, ENVIRONMENT_STATE, INSTRUCTION_WORDS, NonFinite, Source,
    VideoOptions, WriteOptions, convert, export, instruction_words, rewrite, verify, verify_source,
};
use hdf5::File;
use std::path::Path;

const CAMERA: &str = "observation.images.top";
const KEY: &str = "obs/images/top";

/// A file of the fixtures: Pillow wrote the JPEG files and what it reads of them as PNG.
fn fixture(name: &str) -> Vec<u8> {
    std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/jpeg").join(name)).unwrap()
}

/// Pixels of a PNG file.
fn pixels(file: &[u8]) -> Vec<u8> {
    let mut reader = png::Decoder::new(std::io::Cursor::new(file)).read_info().unwrap();
    let mut out = vec![0; reader.output_buffer_size().unwrap()];
    reader.next_frame(&mut out).unwrap();
    out
}

/// An episode whose rows are as long as its longest file and `more`, filled up with zeros.
fn episode(path: &Path, pictures: &[Vec<u8>], more: usize) {
    let file = File::create(path).unwrap();
    let steps = pictures.len();
    let longest = pictures.iter().map(Vec::len).max().unwrap() + more;
    let numbers = |at: &hdf5::Group, name: &str| {
        let values: Vec<f32> = (0..steps * 14).map(|i| i as f32 / 10.0).collect();
        let set = at.new_dataset::<f32>().shape([steps, 14]).create(name).unwrap();
        set.write_raw(&values).unwrap();
    };
    numbers(&file, "action");
    let observations = file.create_group("observations").unwrap();
    numbers(&observations, "qpos");
    let rows: Vec<u8> = pictures.iter().flat_map(|p| p.iter().copied().chain(vec![0; longest - p.len()])).collect();
    let images = observations.create_group("images").unwrap();
    images.new_dataset::<u8>().shape([steps, longest]).create("top").unwrap().write_raw(&rows).unwrap();
    let lengths: Vec<f32> = pictures.iter().map(|p| p.len() as f32).collect();
    file.new_dataset::<f32>().shape([1, steps]).create("compress_len").unwrap().write_raw(&lengths).unwrap();
    file.close().unwrap();
}

fn recording(folder: &Path) {
    let (a, b) = (fixture("0.jpg"), fixture("1.jpg"));
    std::fs::create_dir(folder).unwrap();
    episode(&folder.join("episode_0.hdf5"), &[a.clone(), b.clone(), a.clone()], 0);
    episode(&folder.join("episode_1.hdf5"), &[a.clone(), a], 9);
}

fn options() -> ConvertOptions {
    ConvertOptions { fps: Some(50.0), ..ConvertOptions::default() }
}

fn quiet(_: u64, _: u64) {}

#[test]
fn jpeg_files_become_a_camera_and_come_back_as_they_were() {
    let dir = tempfile::tempdir().unwrap();
    let (source, out, back) = (dir.path().join("aloha"), dir.path().join("set"), dir.path().join("back"));
    recording(&source);
    let report = convert(&source, &out, &options(), &mut quiet).unwrap();
    assert_eq!((report.episodes, report.frames), (2, 5));
    assert!(report.notes.iter().all(|note| !note.contains("becomes no column")), "{:?}", report.notes);
    let set = Dataset::open(&out).unwrap();
    assert_eq!(set.cameras().collect::<Vec<_>>(), [CAMERA]);
    let seen = set.pictures(CAMERA).unwrap();
    assert_eq!((seen.height, seen.width), (18, 26));
    let expected = ["0.png", "1.png", "0.png", "0.png", "0.png"].map(|name| pixels(&fixture(name)));
    let (mut most, mut sum) = (0, 0);
    for (frame, expected) in expected.iter().enumerate() {
        assert_eq!(seen.frame(frame).len(), expected.len());
        for (a, b) in seen.frame(frame).iter().zip(expected) {
            most = most.max(a.abs_diff(*b));
            sum += u32::from(a.abs_diff(*b));
        }
    }
    // two decoders differ most where colours are stored at half the resolution
    let mean = f64::from(sum) / expected.concat().len() as f64;
    assert!(most <= 8 && mean < 1.0, "{most} levels from Pillow, {mean} on average");
    assert_eq!(seen.frame(0), seen.frame(4));
    verify_source(&out, &source).unwrap();
    export(&out, &back, &WriteOptions::default(), &mut quiet).unwrap();
    let (first, again) = (Source::open(&source).unwrap(), Source::open(&back).unwrap());
    for demo in 0..2 {
        assert_eq!(first.read_demo(demo).unwrap().datasets[KEY], again.read_demo(demo).unwrap().datasets[KEY]);
    }
}

#[test]
fn words_of_other_files_than_liberos_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    recording(&dir.path().join("aloha"));
    let words = ConvertOptions { env_keys: Some(vec![INSTRUCTION_WORDS.to_owned()]), ..options() };
    let error =
        convert(&dir.path().join("aloha"), &dir.path().join("set"), &words, &mut quiet).unwrap_err().to_string();
    assert!(
        error.contains("made from the instruction of LIBERO's own files alone, and demo_0 comes from another file"),
        "{error}"
    );
}

#[test]
fn they_can_be_films_too() {
    let dir = tempfile::tempdir().unwrap();
    let (source, out) = (dir.path().join("aloha"), dir.path().join("set"));
    recording(&source);
    let video = Some(VideoOptions::default());
    convert(&source, &out, &ConvertOptions { video, ..options() }, &mut quiet).unwrap();
    let seen = Dataset::open(&out).unwrap().pictures(CAMERA).unwrap();
    let expected = pixels(&fixture("1.png"));
    let off: f64 = seen.frame(1).iter().zip(&expected).map(|(a, b)| f64::from(a.abs_diff(*b))).sum();
    assert!(off / (expected.len() as f64) < 20.0, "{off}");
}

#[test]
fn a_file_that_is_broken_or_of_another_size_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let good = fixture("0.jpg");
    let error = |name: &str, second: Vec<u8>| {
        let (source, out) = (dir.path().join(name), dir.path().join(format!("{name}-set")));
        std::fs::create_dir(&source).unwrap();
        episode(&source.join("episode_0.hdf5"), &[good.clone(), second], 0);
        let error = convert(&source, &out, &options(), &mut quiet).unwrap_err().to_string();
        assert!(error.contains("demo_0 obs/images/top frame 1"), "{error}");
        assert!(error.contains("expected a JPEG file of 18 x 26"), "{error}");
        assert!(!out.exists());
        error
    };
    assert!(error("cut", good[..good.len() / 2].to_vec()).contains("broken JPEG"));
    assert!(error("other", b"no image".to_vec()).contains("other bytes"));
    let mut wide = good.clone();
    // width in the start of frame, behind its marker, length, precision and height
    let frame = wide.windows(2).position(|pair| pair == [0xFF, 0xC0]).unwrap();
    wide[frame + 8] += 1;
    assert!(error("wide", wide).contains("18 x 27"));
}

#[test]
fn liberos_rewards_are_sparse_whatever_its_files_say() {
    let dir = tempfile::tempdir().unwrap();
    let (source, out) = (dir.path().join("open_demo.hdf5"), dir.path().join("set"));
    crate::made::libero(&source, "open it");
    let file = hdf5::File::open_rw(&source).unwrap();
    let data = file.group("data").unwrap();
    data.delete_attr("env_args").unwrap();
    let args = r#"{"env_name": "Libero", "type": 1, "env_kwargs": {"control_freq": 20, "reward_shaping": true}}"#;
    crate::made::text(&data, "env_args", args);
    for (demo, rewards) in [("demo_0", vec![0.0_f32, 0.0, 1.0]), ("demo_1", vec![0.0, 1.0])] {
        data.dataset(&format!("{demo}/rewards")).unwrap().write_raw(&rewards).unwrap();
    }
    drop((data, file));
    let (set, _) = converted(&source, &out);
    assert_eq!(column(&set, "next.success"), [0.0, 0.0, 1.0, 0.0, 1.0]);
}

#[test]
fn rows_of_other_bytes_stay_what_they_are() {
    let dir = tempfile::tempdir().unwrap();
    let (source, out) = (dir.path().join("aloha"), dir.path().join("set"));
    std::fs::create_dir(&source).unwrap();
    episode(&source.join("episode_0.hdf5"), &[vec![7; 30], vec![8; 30]], 0);
    let report = convert(&source, &out, &options(), &mut quiet).unwrap();
    assert!(report.notes.iter().any(|note| note.contains("obs/images/top (encoded images")), "{:?}", report.notes);
    assert_eq!(Dataset::open(&out).unwrap().cameras().count(), 0);
    // the headers of a grey JPEG file of 8 x 8: start of frame with one component, start of scan
    let frame = [0xFF, 0xC0, 0, 11, 8, 0, 8, 0, 8, 1, 1, 0x11, 0];
    let scan = [0xFF, 0xDA, 0, 8, 1, 1, 0, 0, 63, 0, 1, 0xFF, 0xD9];
    let grey = [&[0xFF, 0xD8][..], &frame, &scan].concat();
    episode(&source.join("episode_0.hdf5"), &[grey.clone(), grey], 0);
    let notes = convert(&source, &dir.path().join("grey"), &options(), &mut quiet).unwrap().notes;
    assert!(
        notes.iter().any(|note| note.contains("becomes no column: its first step is a grey JPEG file")),
        "{notes:?}"
    );
}

/// Converts without any option; the result passes every check.
fn converted(source: &Path, out: &Path) -> (Dataset, ConvertReport) {
    let report = convert(source, out, &ConvertOptions::default(), &mut quiet).unwrap();
    let wrong: Vec<_> = verify(out, &mut quiet).unwrap().into_iter().filter_map(|check| check.problem).collect();
    assert_eq!(wrong, Vec::<String>::new());
    (Dataset::open(out).unwrap(), report)
}

/// Numbers of a dataset whose values begin at a row.
fn rows(seed: usize, width: usize, rows: std::ops::Range<usize>) -> Vec<f32> {
    (rows.start * width..rows.end * width).map(|at| value(seed, at)).collect()
}

fn column<'s>(set: &'s Dataset, name: &str) -> &'s [f32] {
    set.column(name).unwrap().data
}

#[test]
fn isaac_lab_converts_under_its_own_names_and_from_its_states() {
    let dir = tempfile::tempdir().unwrap();
    let (source, out) = (dir.path().join("own.hdf5"), dir.path().join("own"));
    crate::made::isaac_lab(&source, true);
    let plan = Source::open(&source).unwrap().plan().clone();
    assert_eq!((plan.dialect, plan.problems.as_slice()), (Dialect::IsaacLab, &[][..]));
    let (set, report) = converted(&source, &out);
    assert_eq!(set.names("observation.state"), ["finger", "policy/hand_0", "policy/hand_1", "policy/hand_2"]);
    assert_eq!(column(&set, "observation.state")[..4], [value(4, 0), value(3, 0), value(3, 1), value(3, 2)]);
    assert_eq!(set.cameras().collect::<Vec<_>>(), ["observation.images.table_cam"]);
    assert_eq!(set.info().fps, 25.0);
    let said =
        |words: &str| assert!(report.notes.iter().any(|note| note.contains(words)), "{words}: {:?}", report.notes);
    said("observation.state is made of finger, policy/hand");
    said("these demos failed: demo_1");

    let (source, out) = (dir.path().join("states.hdf5"), dir.path().join("states"));
    crate::made::isaac_lab(&source, false);
    let (set, _) = converted(&source, &out);
    let state = column(&set, "observation.state");
    // cube_root_pose, then robot_joint_position; the first is the initial one, the others those before the action
    let expected: Vec<f32> = (0..5)
        .flat_map(|step| match step {
            0 => [rows(21, 7, 0..1), rows(20, 9, 0..1)].concat(),
            _ => [rows(11, 7, step - 1..step), rows(10, 9, step - 1..step)].concat(),
        })
        .collect();
    assert_eq!(state[..5 * 16], expected);
    assert_eq!(state[5 * 16..6 * 16], expected[..16]);
}

#[test]
fn what_has_no_observations_is_refused_in_a_line() {
    let dir = tempfile::tempdir().unwrap();
    let (behavior, maniskill) = (dir.path().join("b.hdf5"), dir.path().join("trajectory.h5"));
    crate::made::behavior(&behavior);
    crate::made::maniskill(&maniskill, "none");
    for (source, words) in [(behavior, "DataPlaybackWrapper"), (maniskill, "replay_trajectory")] {
        let out = dir.path().join("out");
        let error = convert(&source, &out, &ConvertOptions::default(), &mut quiet).unwrap_err().to_string();
        assert!(error.starts_with(&format!("{}: no observations: ", source.display())), "{error}");
        assert!(error.contains(words) && error.len() < 250, "{error}");
        assert!(!out.exists());
        assert_eq!(Source::open(&source).unwrap().plan().problems, []);
    }
}

#[test]
fn jpeg_files_of_any_length_become_a_camera() {
    let dir = tempfile::tempdir().unwrap();
    let (source, out, back) = (dir.path().join("aloha"), dir.path().join("set"), dir.path().join("back.hdf5"));
    std::fs::create_dir(&source).unwrap();
    crate::made::aloha(&source.join("episode_0.hdf5"), &[jpeg(0), jpeg(1), jpeg(0)]);
    crate::made::aloha(&source.join("episode_1.hdf5"), &[jpeg(1)]);
    let (set, report) = converted(&source, &out);
    assert!(report.notes.iter().any(|note| note.contains("50 Hz is taken")), "{:?}", report.notes);
    let seen = set.pictures(CAMERA).unwrap();
    for (frame, which) in [0, 1, 0, 1].into_iter().enumerate() {
        let near = pixels(&fixture(&format!("{which}.png")));
        let off: f64 = seen.frame(frame).iter().zip(&near).map(|(a, b)| f64::from(a.abs_diff(*b))).sum();
        assert!(off / (near.len() as f64) < 1.0, "{off}");
    }
    export(&out, &back, &WriteOptions::default(), &mut quiet).unwrap();
    let again = Source::open(&back).unwrap().read_demo(0).unwrap();
    assert_eq!(again.datasets[KEY], Source::open(&source).unwrap().read_demo(0).unwrap().datasets[KEY]);
    assert_eq!(again.datasets[KEY].dtype, Dtype::VarBytes);
    // robomimic gets pixels
    let pixels = dir.path().join("pixels.hdf5");
    rewrite(&source, &pixels, NonFinite::Refuse, &WriteOptions::default(), &mut quiet).unwrap();
    let demo = Source::open(&pixels).unwrap().read_demo(0).unwrap();
    assert_eq!(demo.datasets[KEY].shape, [3, 18, 26, 3]);
    assert_eq!(demo.datasets[KEY].bytes[..18 * 26 * 3], *seen.frame(0));
}

#[test]
fn a_folder_of_libero_files_is_one_set_of_many_tasks() {
    let dir = tempfile::tempdir().unwrap();
    let (suite, out) = (dir.path().join("libero/spatial"), dir.path().join("set"));
    std::fs::create_dir_all(&suite).unwrap();
    crate::made::libero(&suite.join("open_demo.hdf5"), "open it");
    crate::made::libero(&suite.join("pick_demo.hdf5"), "pick the bowl up");
    for name in ["open", "pick"] {
        let file = hdf5::File::open_rw(suite.join(format!("{name}_demo.hdf5"))).unwrap();
        for (demo, steps) in [(0, 3), (1, 2)] {
            let seen = file.group(&format!("data/demo_{demo}/obs")).unwrap().new_dataset::<u8>();
            let seen = seen.shape([steps, 2, 2, 3]).create("eye_in_hand_rgb").unwrap();
            seen.write_raw(&vec![7_u8; steps * 12]).unwrap();
        }
    }
    let (set, report) = converted(&dir.path().join("libero"), &out);
    assert_eq!(report.tasks, ["open it", "pick the bowl up"]);
    let tasks: Vec<_> = set.episodes().iter().map(|e| e.tasks[0].as_str()).collect();
    assert_eq!(tasks, ["open it", "open it", "pick the bowl up", "pick the bowl up"]);
    assert_eq!(column(&set, "action")[5 * 7..][..14], rows(160, 7, 0..2));
    assert_eq!(set.split("valid").unwrap(), [1, 3]);
    assert!(
        report.notes.contains(&"demo_2 to demo_3 are the demos of pick_demo.hdf5".to_owned()),
        "{:?}",
        report.notes
    );
    // upside down, so it keeps its name
    assert!(set.info().features.0.iter().any(|(name, _)| name == "observation.images.eye_in_hand_rgb"));
    // what the files agree in, and no task of one of them
    let env = set.provenance().unwrap().env_args.clone().unwrap();
    assert_eq!((env.get("bddl_file"), &env["env_kwargs"]["x"]), (None, &serde_json::json!(1)));
    let back = dir.path().join("back.hdf5");
    export(&out, &back, &WriteOptions::default(), &mut quiet).unwrap();
    let root = Source::open(&back).unwrap().root().unwrap();
    let bddl = &root.inner_attrs["files/pick_demo.hdf5/data"]["bddl_file_name"];
    assert_eq!(bddl.to_text().unwrap(), "pick the bowl up.bddl");

    // what a policy of all tasks reads, which these files lack
    let words = ConvertOptions { env_keys: Some(vec![INSTRUCTION_WORDS.to_owned()]), ..ConvertOptions::default() };
    convert(&suite, &dir.path().join("words"), &words, &mut quiet).unwrap();
    let set = Dataset::open(&dir.path().join("words")).unwrap();
    let expected = ["open it", "pick the bowl up"].map(|text| instruction_words(text).repeat(5)).concat();
    assert_eq!(column(&set, ENVIRONMENT_STATE), expected);
    verify_source(&dir.path().join("words"), &suite).unwrap();

    // a pointer among them, and a file of something else
    std::fs::write(suite.join("close_demo.hdf5"), "version https://git-lfs.github.com/spec/v1\n").unwrap();
    crate::made::droid(&suite.join("zzz.hdf5"), 3);
    let error =
        convert(&suite, &dir.path().join("no"), &ConvertOptions::default(), &mut quiet).unwrap_err().to_string();
    assert!(error.contains("close_demo.hdf5") && error.contains("git lfs pull"), "{error}");
    let options = ConvertOptions { skip_bad: true, ..ConvertOptions::default() };
    let report = convert(&suite, &dir.path().join("some"), &options, &mut quiet).unwrap();
    let skipped: Vec<_> = report.skipped.iter().map(|demo| demo.demo.as_str()).collect();
    assert_eq!((report.episodes, skipped), (4, vec!["close_demo.hdf5", "zzz.hdf5"]));
}

#[test]
fn maniskill_observations_end_before_the_last_state() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("trajectory.h5");
    crate::made::maniskill(&source, "rgbd");
    let (set, report) = converted(&source, &dir.path().join("rgbd"));
    assert_eq!(set.episodes().iter().map(|e| e.length).collect::<Vec<_>>(), [4, 3, 2]);
    assert_eq!(set.cameras().collect::<Vec<_>>(), ["observation.images.base_camera", "observation.images.hand_camera"]);
    assert_eq!(column(&set, "observation.state")[..36], rows(3, 9, 0..4));
    assert_eq!(column(&set, "next.success")[..5], [0.0, 0.0, 0.0, 1.0, 0.0]);
    assert_eq!((set.env().unwrap().env_name.as_str(), set.info().fps), ("PickCube-v1", 20.0));
    assert!(report.notes.iter().any(|note| note.starts_with("obs/base_camera_depth (int16")), "{:?}", report.notes);
    let demo = Source::open(&source).unwrap().read_demo(0).unwrap();
    assert_eq!(demo.datasets["next_obs/qpos"].to_f32().unwrap(), rows(3, 9, 1..5));
    assert_eq!(demo.datasets["env_states/actors/cube"].shape, [5, 13]);

    crate::made::maniskill(&dir.path().join("state.h5"), "state");
    let (set, _) = converted(&dir.path().join("state.h5"), &dir.path().join("state"));
    assert_eq!(column(&set, "observation.state")[..42 * 4], rows(3, 42, 0..4));
    std::fs::write(dir.path().join("state.json"), "{").unwrap();
    let plan = Source::open(&dir.path().join("state.h5")).unwrap().plan().clone();
    assert!(plan.problems[0].message.contains("state.json: cannot read: no JSON"), "{:?}", plan.problems);
}

#[test]
fn robotwin_acts_with_the_joints_of_the_next_frame() {
    let dir = tempfile::tempdir().unwrap();
    let (task, out) = (dir.path().join("beat_block"), dir.path().join("set"));
    std::fs::create_dir_all(task.join("data")).unwrap();
    std::fs::create_dir(task.join("instructions")).unwrap();
    crate::made::robotwin(&task.join("data/episode0.hdf5"), 4);
    crate::made::robotwin(&task.join("data/episode1.hdf5"), 3);
    std::fs::write(task.join("instructions/episode0.json"), r#"{"seen": ["beat the block"], "unseen": []}"#).unwrap();
    let (set, report) = converted(&task, &out);
    assert_eq!(report.tasks, ["beat the block", "beat_block"]);
    assert_eq!(column(&set, "observation.state")[..42], rows(1, 14, 0..3));
    assert_eq!(column(&set, "action")[..42], rows(1, 14, 1..4));
    assert_eq!(set.cameras().collect::<Vec<_>>(), ["observation.images.head_camera", "observation.images.left_camera"]);
    let demo = Source::open(&task).unwrap().read_demo(0).unwrap();
    let padded = |which: usize| [jpeg(which), vec![0; 1500 - jpeg(which).len()]].concat();
    assert_eq!(demo.datasets["obs/head_camera_image"].bytes, [padded(0), padded(1), padded(0)].concat());
    assert_eq!(demo.datasets["next_obs/head_camera_image"].bytes, [padded(1), padded(0), padded(1)].concat());
}

#[test]
fn droid_actions_are_velocities_and_gripper() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().join("success/2023-07-07");
    for (name, steps) in [("a", 3), ("b", 2)] {
        std::fs::create_dir_all(folder.join(name).join("recordings/MP4")).unwrap();
        crate::made::droid(&folder.join(name).join("trajectory.h5"), steps);
    }
    let (set, report) = converted(dir.path(), &dir.path().join("set"));
    assert_eq!((report.episodes, report.tasks.as_slice()), (2, &["Put the cup on the shelf".to_owned()][..]));
    let expected = |step: usize| [rows(7, 7, step..step + 1), rows(2, 1, step..step + 1)].concat();
    assert_eq!(column(&set, "action")[..24], [expected(0), expected(1), expected(2)].concat());
    assert_eq!(column(&set, "observation.state")[..8], [rows(4, 7, 0..1), rows(5, 1, 0..1)].concat());
    assert_eq!(set.info().fps, 15.0);
    assert!(report.notes.iter().any(|note| note.contains("2 episodes have camera recordings")), "{:?}", report.notes);
}

#[test]
fn a_data_set_becomes_robomimic_and_comes_back_frame_by_frame() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name);
    crate::made::maniskill(&path("trajectory.h5"), "rgbd");
    let (first, file, second) = (path("first"), path("file.hdf5"), path("second"));
    let bare = ConvertOptions { lossless: false, ..ConvertOptions::default() };
    convert(&path("trajectory.h5"), &first, &bare, &mut quiet).unwrap();
    export(&first, &file, &WriteOptions::default(), &mut quiet).unwrap();
    let demo = Source::open(&file).unwrap().read_demo(0).unwrap();
    assert_eq!(demo.datasets["obs/base_camera_image"].shape, [4, 6, 8, 3]);
    assert_eq!(demo.attrs["num_samples"].to_i64(), Some(4));
    assert_eq!(demo.datasets["dones"].to_f64().unwrap(), [0.0, 0.0, 0.0, 1.0]);
    let (again, _) = converted(&file, &second);
    let first = Dataset::open(&first).unwrap();
    assert_eq!(first.column_names().collect::<Vec<_>>(), again.column_names().collect::<Vec<_>>());
    for name in first.column_names() {
        assert_eq!(column(&first, name), column(&again, name), "{name}");
        assert_eq!(first.names(name), again.names(name));
    }
    for camera in first.cameras() {
        assert_eq!(first.pictures(camera).unwrap(), again.pictures(camera).unwrap());
    }
    assert_eq!((first.tasks(), first.info().fps), (again.tasks(), again.info().fps));
    assert_eq!(first.fingerprint(), again.fingerprint());
}

/// A set of every layout becomes a file that passes every check as a robomimic one and converts again to the same actions.
#[test]
fn every_layout_goes_through_robomimic() {
    let dir = tempfile::tempdir().unwrap();
    for file in crate::made::each(dir.path()) {
        let name = file.file_stem().unwrap().to_string_lossy().into_owned();
        if name.starts_with("behavior") {
            continue;
        }
        let at = |end: &str| dir.path().join(format!("{name}{end}"));
        let (first, _) = converted(&file, &at(""));
        export(&at(""), &at(".hdf5"), &WriteOptions::default(), &mut quiet).unwrap();
        let plan = Source::open(&at(".hdf5")).unwrap().plan().clone();
        assert_eq!(plan.problems, [], "{name}");
        let (second, _) = converted(&at(".hdf5"), &at("-again"));
        assert_eq!(column(&first, "action"), column(&second, "action"), "{name}");
        assert_eq!(column(&first, "observation.state"), column(&second, "observation.state"), "{name}");
        assert_eq!((first.tasks(), first.info().fps), (second.tasks(), second.info().fps), "{name}");
        assert!(first.cameras().eq(second.cameras()), "{name}");
    }
}

/// Every layout without one dataset, and with one cut short, is told by file and key.
#[test]
fn a_dataset_that_is_missing_or_too_short_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let files = crate::made::each(dir.path());
    for (layout, path, short) in [
        ("isaac", "data/demo_0/actions", true),
        ("isaac", "data/demo_0/actions", false),
        ("states", "data/demo_1/states/rigid_object/cube/root_pose", true),
        ("maniskill", "traj_1/obs/agent/qpos", true),
        ("maniskill", "traj_1/actions", false),
        ("robotwin", "joint_action/vector", false),
        ("droid", "action/gripper_position", false),
        ("droid", "observation/robot_state/joint_positions", true),
        ("aloha", "observations/qpos", true),
        ("libero", "data/demo_1/obs/ee_pos", true),
    ] {
        let good = files.iter().find(|file| file.ends_with(format!("{layout}/{layout}_0.hdf5"))).unwrap();
        let bad = dir.path().join(format!("bad_{layout}_0.hdf5"));
        std::fs::copy(good, &bad).unwrap();
        let file = File::open_rw(&bad).unwrap();
        let shape = file.dataset(path).unwrap().shape();
        file.unlink(path).unwrap();
        if short {
            crate::made::floats(&file, path, &[&[1], &shape[1..]].concat(), 0);
        }
        file.close().unwrap();
        let out = dir.path().join("out");
        let error = convert(&bad, &out, &ConvertOptions::default(), &mut quiet).unwrap_err().to_string();
        let key = path.rsplit('/').next().unwrap();
        let named = error.split("; found").next().unwrap();
        assert!(named.contains(&format!("bad_{layout}_0.hdf5")) && named.contains(key), "{layout} {path}: {error}");
        assert!(!error.contains('\n') && !out.exists(), "{error}");
    }
}
