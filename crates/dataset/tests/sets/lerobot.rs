//! Conversion on a file that robomimic's own tools wrote, and back.

#![allow(clippy::unwrap_used)]

use dataset::{
    Array, ConvertOptions, Dataset, DatasetError, Demo, ImageForm, MISTAKE, NonFinite, RobomimicWriter, RotationForm,
    Source, WindowBatch, WindowSpec, WriteOptions, convert, export, verify, verify_source,
};
use proptest::prelude::*;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

fn fixture() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/lift_low_dim_3_demos.hdf5")
}

fn files(root: &Path) -> BTreeMap<String, Vec<u8>> {
    fn walk(root: &Path, folder: &Path, found: &mut BTreeMap<String, Vec<u8>>) {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                walk(root, &path, found);
            } else {
                let name = path.strip_prefix(root).unwrap().to_str().unwrap().to_owned();
                found.insert(name, std::fs::read(&path).unwrap());
            }
        }
    }
    let mut found = BTreeMap::new();
    walk(root, root, &mut found);
    found
}

/// Everything in a file, in order.
fn content(path: &Path) -> (Demo, Vec<Demo>) {
    let source = Source::open(path).unwrap().nonfinite(NonFinite::Keep);
    let demos = (0..source.plan().demos.len()).map(|i| source.read_demo(i).unwrap()).collect();
    (source.root().unwrap(), demos)
}

fn quiet(_: u64, _: u64) {}

#[test]
fn the_columns_hold_the_numbers_of_the_file() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("set");
    let mut told = (0, 0);
    let report =
        convert(&fixture(), &out, &ConvertOptions::default(), &mut |done, total| told = (done, total)).unwrap();
    assert_eq!((report.episodes, report.frames, told), (3, 166, (166, 166)));
    assert_eq!(report.tasks, ["Lift"]);
    let set = Dataset::open(&out).unwrap();
    let (_, demos) = content(&fixture());
    assert_eq!(set.info().fps, 20.0);
    assert_eq!(set.env().unwrap().env_version.as_deref(), Some("1.5.2"));
    let state = set.column("observation.state").unwrap();
    let env = set.column("observation.environment_state").unwrap();
    let action = set.column("action").unwrap();
    assert_eq!((state.dim, env.dim, action.dim), (9, 10, 7));
    for (episode, demo) in set.episodes().iter().zip(&demos) {
        assert_eq!(episode.demo.as_deref(), Some(demo.id.as_str()));
        let numbers = |key: &str| demo.datasets[key].to_f32().unwrap();
        assert_eq!(&action.data[episode.from * 7..episode.to * 7], numbers("actions"));
        assert_eq!(&env.data[episode.from * 10..episode.to * 10], numbers("obs/object"));
        let (pos, quat, grip) =
            (numbers("obs/robot0_eef_pos"), numbers("obs/robot0_eef_quat"), numbers("obs/robot0_gripper_qpos"));
        for t in 0..episode.length {
            let row = &state.data[(episode.from + t) * 9..(episode.from + t + 1) * 9];
            assert_eq!(row, [&pos[t * 3..t * 3 + 3], &quat[t * 4..t * 4 + 4], &grip[t * 2..t * 2 + 2]].concat());
        }
        let (reward, done) = (numbers("rewards"), numbers("dones"));
        let range = episode.from..episode.to;
        assert_eq!(&set.column("next.reward").unwrap().data[range.clone()], reward);
        assert_eq!(&set.column("next.done").unwrap().data[range.clone()], done);
        assert_eq!(&set.column("next.success").unwrap().data[range], reward);
    }
    assert_eq!(set.split("train"), Some(vec![0, 1, 2]));
    assert_eq!(set.split("valid"), Some(vec![]));
    assert_eq!(set.split("none"), None);
    // the statistics on disk are those of the frames
    let all = set.statistics_of(&[0, 1, 2]).unwrap();
    for (name, computed) in &all {
        let stored = &set.stats()[name];
        assert_eq!(stored.count, computed.count);
        // JSON is read back to the last digit but one
        let vectors = |s: &dataset::FeatureStats| {
            let extremes = [s.min.clone(), s.max.clone(), s.mean.clone(), s.std.clone()].concat();
            [extremes, s.quantiles().concat()].concat()
        };
        for (a, b) in vectors(stored).iter().zip(vectors(computed)) {
            assert!((a - b).abs() < 1e-14, "{name}: {a} {b}");
        }
    }
    assert!(set.statistics_of(&[3]).is_err());
    for check in verify(&out, &mut quiet).unwrap() {
        assert_eq!(check.problem, None, "{}", check.name);
    }
}

#[test]
fn the_same_bytes_whatever_the_number_of_threads() {
    let dir = tempfile::tempdir().unwrap();
    let options = |jobs| ConvertOptions { jobs, ..ConvertOptions::default() };
    for jobs in [1, 4] {
        convert(&fixture(), &dir.path().join(jobs.to_string()), &options(jobs), &mut quiet).unwrap();
    }
    let (one, four) = (files(&dir.path().join("1")), files(&dir.path().join("4")));
    assert_eq!(one.keys().collect::<Vec<_>>(), four.keys().collect::<Vec<_>>());
    for (name, bytes) in &one {
        assert!(*bytes == four[name], "{name} differs");
    }
    let expected = [
        "actrm/frames/chunk-000/file-000.parquet",
        "actrm/info.json",
        "actrm/layout.json",
        "actrm/manifest.json",
        "actrm/objects/chunk-000/file-000.parquet",
        "data/chunk-000/file-000.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        "meta/info.json",
        "meta/stats.json",
        "meta/tasks.parquet",
    ];
    assert_eq!(one.keys().collect::<Vec<_>>(), expected);
}

#[test]
fn small_files_change_the_shards_and_nothing_else() {
    let dir = tempfile::tempdir().unwrap();
    let (small, whole, bare) = (dir.path().join("small"), dir.path().join("whole"), dir.path().join("bare"));
    // every row group begins a file; the fixture's demos are too short for several row groups
    let long = dir.path().join("long.hdf5");
    write_demos(&long, &(0..30).map(|i| synthetic(i, 400, false)).collect::<Vec<_>>());
    convert(&long, &small, &ConvertOptions { data_file_mb: 0.001, ..options() }, &mut quiet).unwrap();
    convert(&long, &whole, &options(), &mut quiet).unwrap();
    convert(&long, &bare, &ConvertOptions { lossless: false, ..options() }, &mut quiet).unwrap();
    assert!(small.join("data/chunk-000/file-002.parquet").exists());
    assert!(!whole.join("data/chunk-000/file-001.parquet").exists());
    assert_eq!(std::fs::read_dir(bare.join("actrm")).unwrap().count(), 1, "provenance alone");
    let (a, b, c) = (Dataset::open(&small).unwrap(), Dataset::open(&whole).unwrap(), Dataset::open(&bare).unwrap());
    assert_eq!(a.fingerprint(), b.fingerprint());
    assert_eq!(a.fingerprint(), c.fingerprint());
    assert_eq!(a.column("action"), b.column("action"));
    assert_eq!(a.episodes(), b.episodes());
    let back = dir.path().join("back.hdf5");
    export(&small, &back, &WriteOptions::default(), &mut quiet).unwrap();
    assert_eq!(content(&back), content(&long));
    // without the side folder the file is one of the columns
    let columns = dir.path().join("columns.hdf5");
    export(&bare, &columns, &WriteOptions::default(), &mut quiet).unwrap();
    let demo = Source::open(&columns).unwrap().read_demo(0).unwrap();
    assert_eq!(
        demo.datasets["obs/state"].to_f32().unwrap(),
        c.column("observation.state").unwrap().data[..demo.datasets["obs/state"].len()]
    );
}

#[test]
fn export_rebuilds_the_file() {
    let dir = tempfile::tempdir().unwrap();
    let (out, back) = (dir.path().join("set"), dir.path().join("back.hdf5"));
    convert(&fixture(), &out, &ConvertOptions::default(), &mut quiet).unwrap();
    let report = export(&out, &back, &WriteOptions::default(), &mut quiet).unwrap();
    assert_eq!((report.demos, report.frames), (3, 166));
    let (original, again) = (content(&fixture()), content(&back));
    assert_eq!(original.0, again.0);
    for (a, b) in original.1.iter().zip(&again.1) {
        assert_eq!(a.id, b.id);
        assert_eq!(a.attrs, b.attrs);
        assert_eq!(a.groups, b.groups);
        assert_eq!(a.inner_attrs, b.inner_attrs);
        assert_eq!(a.datasets.keys().collect::<Vec<_>>(), b.datasets.keys().collect::<Vec<_>>());
        for (key, array) in &a.datasets {
            assert!(*array == b.datasets[key], "{} {key}", a.id);
        }
    }
    assert!(matches!(
        export(&out, &back, &WriteOptions::default(), &mut quiet),
        Err(DatasetError::OutputExists { .. })
    ));
}

#[test]
fn a_flipped_byte_is_found_wherever_it_is() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("set");
    convert(&fixture(), &out, &ConvertOptions::default(), &mut quiet).unwrap();
    for (name, bytes) in files(&out) {
        if name == "actrm/manifest.json" {
            continue;
        }
        let mut flipped = bytes.clone();
        flipped[bytes.len() / 2] ^= 0x10;
        std::fs::write(out.join(&name), flipped).unwrap();
        let checks = verify(&out, &mut quiet).unwrap();
        assert!(checks.iter().any(|c| c.problem.is_some()), "{name}");
        std::fs::write(out.join(&name), bytes).unwrap();
    }
    assert!(verify(&out, &mut quiet).unwrap().iter().all(|c| c.problem.is_none()));
}

#[test]
fn an_existing_output_and_a_wrong_input_leave_everything_as_it_was() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("set");
    std::fs::create_dir(&out).unwrap();
    let refused = convert(&fixture(), &out, &ConvertOptions::default(), &mut quiet).unwrap_err();
    assert!(matches!(refused, DatasetError::OutputExists { .. }), "{refused}");
    let other = dir.path().join("other");
    let keys = ConvertOptions { env_keys: Some(vec!["cube".to_owned()]), ..ConvertOptions::default() };
    let refused = convert(&fixture(), &other, &keys, &mut quiet).unwrap_err().to_string();
    assert!(refused.contains("demo_1") && refused.contains("obs/cube") && refused.contains("obs/object"), "{refused}");
    let absolute = ConvertOptions { actions: dataset::ActionKind::Absolute, ..ConvertOptions::default() };
    let refused = convert(&fixture(), &other, &absolute, &mut quiet).unwrap_err().to_string();
    assert!(refused.contains("actions_abs"), "{refused}");
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1);
}

#[test]
fn entities_are_columns_of_keys_their_parts_and_differences() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("set");
    let list = |keys: &[&str]| keys.iter().map(|key| (*key).to_owned()).collect::<Vec<_>>();
    let with = |name: &str, keys: &[&str]| ConvertOptions {
        entities: BTreeMap::from([(name.to_owned(), list(keys))]),
        ..ConvertOptions::default()
    };
    let mut options = with("cube", &["object[0:3]", "object[0:3] - robot0_eef_pos"]);
    options.entities.insert("hand".to_owned(), list(&["robot0_eef_pos", "robot0_gripper_qpos[1:2]"]));
    options.entities.insert("begun".to_owned(), list(&["first(robot0_eef_pos)", "first(object)[0:1] - object[0:1]"]));
    options.entities.insert("before".to_owned(), list(&["before(robot0_eef_pos:2)", "before(object:3)[0:1]"]));
    convert(&fixture(), &out, &options, &mut quiet).unwrap();
    let set = Dataset::open(&out).unwrap();
    let (_, demos) = content(&fixture());
    let (cube, hand) = (set.column("observation.entity.cube").unwrap(), set.column("observation.entity.hand").unwrap());
    assert_eq!((cube.dim, hand.dim, set.column("observation.state").unwrap().dim), (6, 4, 9));
    for (episode, demo) in set.episodes().iter().zip(&demos) {
        let numbers = |key: &str| demo.datasets[key].to_f32().unwrap();
        let (object, pos, grip) =
            (numbers("obs/object"), numbers("obs/robot0_eef_pos"), numbers("obs/robot0_gripper_qpos"));
        for t in 0..episode.length {
            let (at, place) = (episode.from + t, &object[t * 10..t * 10 + 3]);
            let away: Vec<f32> = place.iter().zip(&pos[t * 3..]).map(|(a, b)| a - b).collect();
            assert_eq!(cube.data[at * 6..at * 6 + 6], [place, &away].concat());
            let begun = set.column("observation.entity.begun").unwrap();
            assert_eq!(begun.data[at * 4..at * 4 + 4], [&pos[..3], &[object[0] - object[t * 10]]].concat());
            let before = set.column("observation.entity.before").unwrap();
            let (two, three) = (t.saturating_sub(2), t.saturating_sub(3));
            assert_eq!(before.data[at * 4..at * 4 + 4], [&pos[two * 3..two * 3 + 3], &[object[three * 10]]].concat());
            assert_eq!(hand.data[at * 4..at * 4 + 4], [&pos[t * 3..t * 3 + 3], &grip[t * 2 + 1..t * 2 + 2]].concat());
        }
    }
    assert_eq!(set.provenance().unwrap().entities, options.entities);
    let names = &set.info().features.get("observation.entity.hand").unwrap().names;
    assert_eq!(
        names,
        &serde_json::json!(["robot0_eef_pos_0", "robot0_eef_pos_1", "robot0_eef_pos_2", "robot0_gripper_qpos_1"])
    );
    // statistics over several columns together
    let columns = list(&["observation.entity.hand", "observation.entity.hand"]);
    let alone = set.statistics_of(&[0, 1]).unwrap().remove("observation.entity.hand").unwrap();
    let pooled = set.pooled_statistics(&columns, &[0, 1]).unwrap().unwrap();
    assert_eq!((pooled.count, &pooled.min, &pooled.max), (2 * alone.count, &alone.min, &alone.max));
    let unequal = list(&["observation.entity.hand", "observation.entity.cube"]);
    let refused = set.pooled_statistics(&unequal, &[0]).unwrap_err().to_string();
    assert!(refused.contains("observation.entity.cube of 4 numbers"), "{refused}");
    // it is a data set like any other: it verifies, and the source comes back
    assert!(verify(&out, &mut quiet).unwrap().iter().all(|c| c.problem.is_none()));
    let other = dir.path().join("other");
    for (keys, named) in [
        (&["object[3:11]"][..], "observation.entity.cube: object[3:11]: object has 10 numbers"),
        (&["object - robot0_eef_pos"], "object - robot0_eef_pos: 10 numbers minus 3"),
        (&["object[3"], "`object[3`: expected key[from:to] with from below to"),
        (&["cube"], "obs/cube"),
        (&[], "observation.entity.cube: no keys"),
    ] {
        let refused = convert(&fixture(), &other, &with("cube", keys), &mut quiet).unwrap_err().to_string();
        assert!(refused.contains(named), "{refused}");
    }
    let refused = convert(&fixture(), &other, &with("a/b", &["object"]), &mut quiet).unwrap_err().to_string();
    assert!(refused.contains("observation.entity.a/b: a name of letters, digits"), "{refused}");
}

#[test]
fn rotations_in_six_numbers_are_robomimic_s() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("set");
    let options = ConvertOptions { rotation: RotationForm::SixD, ..ConvertOptions::default() };
    convert(&fixture(), &out, &options, &mut quiet).unwrap();
    let set = Dataset::open(&out).unwrap();
    let action = set.column("action").unwrap();
    assert_eq!(action.dim, 10);
    let (_, demos) = content(&fixture());
    // robomimic's own 6D of the same actions, to f32
    let theirs: Vec<f32> = demos.iter().flat_map(|d| d.datasets["action_dict/rel_rot_6d"].to_f32().unwrap()).collect();
    for (ours, theirs) in action.data.chunks_exact(10).zip(theirs.chunks_exact(6)) {
        for (a, b) in ours[3..9].iter().zip(theirs) {
            assert!((a - b).abs() < 2e-6, "{a} {b}");
        }
    }
}

#[test]
fn windows_of_a_split_come_in_a_seeded_order() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("set");
    convert(&fixture(), &out, &ConvertOptions::default(), &mut quiet).unwrap();
    let set = Dataset::open(&out).unwrap();
    let spec = WindowSpec {
        observation: vec!["observation.state".to_owned()],
        n_obs_steps: 1,
        action_horizon: 16,
        episodes: vec![0, 2],
        mistakes: false,
    };
    let windows = set.windows(&spec).unwrap();
    let lengths: Vec<usize> = set.episodes().iter().map(|e| e.length).collect();
    assert_eq!(windows.len(), lengths[0] + lengths[2]);
    let mut batch = WindowBatch::default();
    // the last frame of the first episode: one action, fifteen times repeated
    windows.gather(&[lengths[0] as u32 - 1], &mut batch);
    assert_eq!(batch.is_pad.iter().filter(|&&p| p).count(), 15);
    let last = &set.column("action").unwrap().data[(lengths[0] - 1) * 7..lengths[0] * 7];
    assert!(batch.actions.chunks_exact(7).all(|a| a == last));
    let refused = |spec: WindowSpec| set.windows(&spec).unwrap_err().to_string();
    assert!(refused(WindowSpec { action_horizon: 0, ..spec.clone() }).contains("window of 0 actions"));
    assert!(refused(WindowSpec { n_obs_steps: 0, ..spec.clone() }).contains("window of 0 observations"));
    assert!(refused(WindowSpec { episodes: vec![7], ..spec.clone() }).contains("episode 7"));
    let error = refused(WindowSpec { observation: vec!["observation.entity.cube".to_owned()], ..spec });
    assert!(error.contains("column observation.entity.cube") && error.contains("observation.state"), "{error}");
}

#[test]
fn pictures_are_the_same_in_both_forms_and_on_the_way_back() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("image.hdf5");
    // the last demo is cut into several row groups
    write_demos(&file, &[synthetic(0, 5, true), synthetic(1, 40, true), synthetic(2, 900, true)]);
    let mut fingerprints = Vec::new();
    for (name, images, jobs) in [("png", ImageForm::Png, 1), ("ppm", ImageForm::Ppm, 3)] {
        let out = dir.path().join(name);
        convert(&file, &out, &ConvertOptions { images, jobs, ..options() }, &mut quiet).unwrap();
        for check in verify(&out, &mut quiet).unwrap() {
            assert_eq!(check.problem, None, "{name}: {}", check.name);
        }
        fingerprints.push(Dataset::open(&out).unwrap().fingerprint().to_owned());
        let back = dir.path().join(format!("{name}.hdf5"));
        export(&out, &back, &WriteOptions::default(), &mut quiet).unwrap();
        assert!(content(&back) == content(&file), "{name}");
    }
    assert_eq!(fingerprints[0], fingerprints[1]);
}

#[test]
fn a_source_that_changed_is_told_from_the_one_that_was_converted() {
    let dir = tempfile::tempdir().unwrap();
    let (source, out) = (dir.path().join("lift.hdf5"), dir.path().join("set"));
    std::fs::copy(fixture(), &source).unwrap();
    convert(&source, &out, &ConvertOptions::default(), &mut quiet).unwrap();
    assert_eq!(verify_source(&out, &source).unwrap().problem, None);
    let mut bytes = std::fs::read(&source).unwrap();
    // the first number of the first demo's `obs/object`: every reader takes it
    bytes[27080 + 3] ^= 1;
    std::fs::write(&source, bytes).unwrap();
    assert!(content(&source) != content(&fixture()));
    let problem = verify_source(&out, &source).unwrap().problem.unwrap();
    assert!(problem.contains("lift.hdf5: expected sha256 ") && problem.contains(", found "), "{problem}");
    std::fs::remove_file(out.join("actrm/manifest.json")).unwrap();
    let checks = verify(&out, &mut quiet).unwrap();
    assert!(checks.iter().any(|c| c.problem.as_deref() == Some("actrm/manifest.json is missing")), "{checks:?}");
}

#[test]
fn pictures_that_are_not_colour_stay_beside_and_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let (file, out, back) = (dir.path().join("a.hdf5"), dir.path().join("set"), dir.path().join("b.hdf5"));
    let mut demo = synthetic(0, 6, true);
    demo.datasets.insert("obs/depth".to_owned(), Array::from_i32(vec![6, 4, 4, 1], &[5; 96]));
    demo.datasets.insert("obs/heat".to_owned(), Array::from_f32(vec![6, 4, 4, 1], &[0.5; 96]));
    demo.datasets.insert("obs/grey".to_owned(), Array::from_u8(vec![6, 4, 4, 1], &[7; 96]));
    demo.datasets.insert("obs/rgba".to_owned(), Array::from_u8(vec![6, 4, 4, 4], &[9; 384]));
    demo.datasets.insert("obs/images/cam_high".to_owned(), Array::from_u8(vec![6, 5], &[0xff; 30]));
    write_demos(&file, &[demo]);
    let report = convert(&file, &out, &options(), &mut quiet).unwrap();
    let visual: Vec<&str> = report.features.iter().filter(|(_, t, _)| t == "image").map(|(n, ..)| n.as_str()).collect();
    assert_eq!(visual, ["observation.images.agentview"]);
    for (name, what, why) in [
        ("obs/depth", "int32 [4, 4, 1]", "LeRobot's depth is float or uint16"),
        ("obs/heat", "float32 [4, 4, 1]", "nothing in its name says that it is depth"),
        ("obs/grey", "uint8 [4, 4, 1]", "LeRobot records no grey images"),
        ("obs/rgba", "uint8 [4, 4, 4]", "LeRobot records no fourth channel"),
        ("obs/images/cam_high", "encoded images, uint8 [5]", "only uint8 [height, width, 3] and JPEG files do"),
    ] {
        let note = report.notes.iter().find(|n| n.starts_with(name)).unwrap();
        assert!(note.contains(what) && note.contains(why) && note.contains("side folder"), "{note}");
    }
    export(&out, &back, &WriteOptions::default(), &mut quiet).unwrap();
    assert!(content(&back) == content(&file));
    let bare = ConvertOptions { lossless: false, state_keys: Some(vec![]), ..options() };
    let report = convert(&file, &dir.path().join("bare"), &bare, &mut quiet).unwrap();
    assert!(report.notes.iter().any(|n| n.starts_with("obs/depth") && n.contains("left out")), "{:?}", report.notes);
    assert!(report.features.iter().all(|(name, ..)| name != "observation.state"));
}

/// The mask as stored.
fn mask(path: &Path, name: &str) -> Array {
    Source::open(path).unwrap().root().unwrap().datasets[&format!("mask/{name}")].clone()
}

#[test]
fn a_file_cut_down_by_robomimic_keeps_the_masks_of_the_whole() {
    let dir = tempfile::tempdir().unwrap();
    let (file, out, back) = (dir.path().join("a.hdf5"), dir.path().join("set"), dir.path().join("b.hdf5"));
    // what `dataset_states_to_obs --n 2` leaves of robomimic's own file: the first demos, and every mask as it was
    let (mut root, demos) = content(&fixture());
    root.inner_attrs.get_mut("data").unwrap().insert("total".to_owned(), Array::from_i64(vec![], &[112]));
    let mut writer = RobomimicWriter::create(&file, &WriteOptions::default()).unwrap();
    writer.set_root(&root).unwrap();
    for demo in &demos[..2] {
        writer.add_demo(demo).unwrap();
    }
    writer.finish().unwrap();
    assert!(mask(&file, "train").to_strings().unwrap().contains(&"demo_3".to_owned()));
    let report = convert(&file, &out, &ConvertOptions::default(), &mut quiet).unwrap();
    let notes: Vec<&String> = report.notes.iter().filter(|note| note.contains("mask")).collect();
    assert_eq!(notes, ["mask/train: 1 of the 3 demos it names are not in the file: demo_3"]);
    let set = Dataset::open(&out).unwrap();
    assert_eq!(set.split("train"), Some(vec![0, 1]));
    assert!(verify(&out, &mut quiet).unwrap().iter().all(|c| c.problem.is_none()));
    export(&out, &back, &WriteOptions::default(), &mut quiet).unwrap();
    assert_eq!(content(&back), content(&file));
}

/// Options for files without an environment.
fn options() -> ConvertOptions {
    ConvertOptions { fps: Some(20.0), ..ConvertOptions::default() }
}

fn write_demos(path: &Path, demos: &[Demo]) {
    let mut writer = RobomimicWriter::create(path, &WriteOptions::default()).unwrap();
    for demo in demos {
        writer.add_demo(demo).unwrap();
    }
    let total: usize = demos.iter().map(|d| d.datasets["actions"].shape[0]).sum();
    writer.set_data_attr("total", &Array::from_i64(vec![], &[total as i64])).unwrap();
    writer.finish().unwrap();
}

/// A demo of robomimic's layout with values that depend on its number.
fn synthetic(number: usize, length: usize, pictures: bool) -> Demo {
    let mut rng = dataset::shuffle::SplitMix64::new(number as u64, 99);
    let mut numbers = |width: usize| {
        let values: Vec<f64> = (0..length * width).map(|_| rng.below(1 << 40) as f64 / (1_u64 << 40) as f64).collect();
        Array::from_f64(vec![length, width], &values)
    };
    let mut demo = Demo { id: format!("demo_{number}"), ..Demo::default() };
    demo.attrs.insert("num_samples".to_owned(), Array::from_i64(vec![], &[length as i64]));
    for (key, width) in [("robot0_eef_pos", 3), ("robot0_eef_quat", 4), ("robot0_gripper_qpos", 2), ("object", 10)] {
        let array = numbers(width);
        let mut next = array.clone();
        next.bytes.drain(..width * 8);
        next.bytes.extend(numbers(width).bytes[..width * 8].to_vec());
        demo.datasets.insert(format!("next_obs/{key}"), next);
        demo.datasets.insert(format!("obs/{key}"), array);
    }
    demo.datasets.insert("actions".to_owned(), numbers(7));
    demo.datasets.insert("states".to_owned(), numbers(32));
    let rewards = numbers(1);
    demo.datasets.insert("rewards".to_owned(), Array { shape: vec![length], ..rewards });
    if pictures {
        let mut noise = |_| rng.below(256) as u8;
        let bytes: Vec<u8> = (0..length * 84 * 84 * 3).map(&mut noise).collect();
        let mut next = bytes.clone();
        next.drain(..84 * 84 * 3);
        next.extend((0..84 * 84 * 3).map(&mut noise));
        demo.datasets.insert("obs/agentview_image".to_owned(), Array::from_u8(vec![length, 84, 84, 3], &bytes));
        demo.datasets.insert("next_obs/agentview_image".to_owned(), Array::from_u8(vec![length, 84, 84, 3], &next));
    }
    demo
}

#[test]
fn what_is_marked_as_a_mistake_is_not_asked_of_a_policy() {
    let dir = tempfile::tempdir().unwrap();
    let (file, out, back) = (dir.path().join("a.hdf5"), dir.path().join("set"), dir.path().join("back.hdf5"));
    let mut demos = [synthetic(0, 9, false), synthetic(1, 4, false)];
    for (demo, marks) in demos.iter_mut().zip([&[0, 0, 0, 1, 1, 0, 0, 0, 0][..], &[1, 0, 0, 0]]) {
        demo.datasets.insert("mistakes".to_owned(), Array::from_i64(vec![marks.len()], marks));
    }
    write_demos(&file, &demos);
    convert(&file, &out, &options(), &mut quiet).unwrap();
    export(&out, &back, &WriteOptions::default(), &mut quiet).unwrap();
    assert_eq!(content(&back), content(&file));

    let set = Dataset::open(&out).unwrap();
    let (column, action) = (set.column(MISTAKE).unwrap(), set.column("action").unwrap());
    assert_eq!(column.data[..], [0., 0., 0., 1., 1., 0., 0., 0., 0., 1., 0., 0., 0.]);
    let state = vec!["observation.state".to_owned()];
    let spec =
        WindowSpec { observation: state, n_obs_steps: 2, action_horizon: 3, episodes: vec![0, 1], mistakes: false };
    let windows = set.windows(&spec).unwrap();
    let all = set.windows(&WindowSpec { mistakes: true, ..spec }).unwrap();
    assert_eq!((windows.len(), all.len()), (10, 13));
    let mut batch = WindowBatch::default();
    let begins: Vec<u32> = (0..10).collect();
    windows.gather(&begins, &mut batch);
    for ((frame, actions), pad) in [0, 1, 2, 5, 6, 7, 8, 10, 11, 12]
        .into_iter()
        .zip(batch.actions.chunks_exact(3 * 7))
        .zip(batch.is_pad.chunks_exact(3))
    {
        assert_eq!(actions[..7], action.data[frame * 7..(frame + 1) * 7], "the window of frame {frame}");
        let end = [3, 9, 13].into_iter().find(|&end| frame < end).unwrap();
        let asked = (end - frame).min(3);
        assert_eq!(pad, [asked < 1, asked < 2, asked < 3], "the window of frame {frame}");
    }

    demos[1].datasets.insert("mistakes".to_owned(), Array::from_i64(vec![4, 2], &[0; 8]));
    demos[0].datasets.insert("mistakes".to_owned(), Array::from_i64(vec![9, 2], &[0; 18]));
    let wide = dir.path().join("wide.hdf5");
    write_demos(&wide, &demos);
    let error = convert(&wide, &dir.path().join("no"), &options(), &mut quiet).unwrap_err().to_string();
    assert!(error.contains("mistakes") && error.contains("one number a step"), "{error}");
}

/// Any array that a file may hold.
fn any_array() -> impl Strategy<Value = Array> {
    let shape = prop::collection::vec(0_usize..4, 0..4);
    (shape, 0..7_u8, any::<u64>(), prop::collection::vec("[a-zäß∂]{0,6}", 64)).prop_map(|(shape, kind, seed, words)| {
        let count: usize = shape.iter().product();
        let mut rng = dataset::shuffle::SplitMix64::new(seed, 0);
        let mut bits = || rng.next_u64();
        match kind {
            // any bit pattern, NaN with a payload included
            0 => Array::from_f64(shape, &(0..count).map(|_| f64::from_bits(bits())).collect::<Vec<_>>()),
            1 => Array::from_f32(shape, &(0..count).map(|_| f32::from_bits(bits() as u32)).collect::<Vec<_>>()),
            2 => Array::from_i64(shape, &(0..count).map(|_| bits() as i64).collect::<Vec<_>>()),
            3 => Array::from_i32(shape, &(0..count).map(|_| bits() as i32).collect::<Vec<_>>()),
            4 => Array::from_u8(shape, &(0..count).map(|_| bits() as u8).collect::<Vec<_>>()),
            5 => Array::from_strings(shape, &words[..count]),
            _ => {
                // numpy's byte strings hold any byte; ours are written from text, in ASCII
                let plain: Vec<String> =
                    words[..count].iter().map(|w| w.replace(|c: char| !c.is_ascii(), "")).collect();
                Array::from_fixed_strings(&plain)
            }
        }
    })
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, failure_persistence: None, ..ProptestConfig::default() })]
    #[test]
    fn any_mask_comes_back(
        count in 1_usize..5,
        masks in prop::collection::btree_map("[a-z0-9_]{1,8}", (prop::collection::vec(0_usize..9, 0..7), any::<bool>()), 1..4),
    ) {
        let dir = tempfile::tempdir().unwrap();
        let (file, out, back) = (dir.path().join("a.hdf5"), dir.path().join("set"), dir.path().join("b.hdf5"));
        let mut writer = RobomimicWriter::create(&file, &WriteOptions::default()).unwrap();
        let demos: Vec<Demo> = (0..count).map(|i| synthetic(2 * i, 2, false)).collect();
        let mut root = Demo::default();
        for (name, (numbers, fixed)) in &masks {
            let ids: Vec<String> = numbers.iter().map(|n| format!("demo_{n}")).collect();
            let array = if *fixed { Array::from_fixed_strings(&ids) } else { Array::from_strings(vec![ids.len()], &ids) };
            root.datasets.insert(format!("mask/{name}"), array);
        }
        writer.set_root(&root).unwrap();
        for demo in &demos {
            writer.add_demo(demo).unwrap();
        }
        writer.finish().unwrap();
        let report = convert(&file, &out, &options(), &mut quiet).unwrap();
        let set = Dataset::open(&out).unwrap();
        for (name, (numbers, _)) in &masks {
            // demos 0, 2, 4, ... are there, as episodes 0, 1, 2, ...
            let there = |n: &&usize| n.is_multiple_of(2) && **n / 2 < count;
            let mut episodes: Vec<usize> = numbers.iter().filter(there).map(|n| n / 2).collect();
            episodes.sort_unstable();
            prop_assert_eq!(set.split(name).unwrap(), &*episodes);
            let told = report.notes.iter().any(|n| n.contains(&format!("mask/{name}: ")));
            prop_assert_eq!(told, episodes.len() < numbers.len());
        }
        export(&out, &back, &WriteOptions::default(), &mut quiet).unwrap();
        prop_assert_eq!(content(&back), content(&file));
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, failure_persistence: None, ..ProptestConfig::default() })]
    #[test]
    fn any_file_comes_back(
        lengths in prop::collection::vec(1_usize..9, 1..5),
        extra in prop::collection::vec(("[a-d]{1,2}", prop::option::of("[x-z]{1,2}"), any_array(), 0_usize..5), 0..6),
        attrs in prop::collection::btree_map("[a-f]{1,3}", any_array(), 0..4),
        groups in prop::collection::btree_set("[g-i]{1,2}", 0..3),
    ) {
        let dir = tempfile::tempdir().unwrap();
        let demos: Vec<Demo> = lengths.iter().enumerate().map(|(i, &length)| {
            let mut demo = synthetic(3 * i + 1, length, false);
            demo.attrs.extend(attrs.clone());
            demo.groups = groups.clone();
            for (name, folder, array, owner) in &extra {
                // some datasets are in some demos only
                if *owner == 0 || *owner == i {
                    let path = folder.as_ref().map_or_else(|| name.clone(), |f| format!("{f}/{name}"));
                    demo.datasets.insert(path.clone(), array.clone());
                    demo.inner_attrs.insert(path, attrs.clone());
                }
            }
            demo.inner_attrs.retain(|_, a| !a.is_empty());
            demo
        }).collect();
        let (file, out, back) = (dir.path().join("a.hdf5"), dir.path().join("set"), dir.path().join("b.hdf5"));
        write_demos(&file, &demos);
        prop_assert_eq!(&content(&file).1, &demos);
        // some of any bits are NaN
        convert(&file, &out, &ConvertOptions { nonfinite: NonFinite::Keep, ..options() }, &mut quiet).unwrap();
        export(&out, &back, &WriteOptions::default(), &mut quiet).unwrap();
        prop_assert_eq!(content(&back), content(&file));
    }
}
