//! Recordings that are not as they should be: what is wrong is named with file, demo and key, before anything is written;
//! nothing is left out silently.

#![allow(clippy::unwrap_used)]

#[path = "sources/mod.rs"]
mod sources;

use crate::common::going;
use dataset::{
    Array, ConvertOptions, ConvertReport, Dataset, DatasetError, Demo, NonFinite, RobomimicWriter, Source,
    WriteOptions, convert, edit, export, rewrite, verify, verify_source,
};
use std::path::{Path, PathBuf};

const STEPS: usize = 6;

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name)
}

pub(super) fn quiet(_: u64, _: u64) {}

pub(super) fn options() -> ConvertOptions {
    ConvertOptions { fps: Some(20.0), ..ConvertOptions::default() }
}

fn keep() -> ConvertOptions {
    ConvertOptions { nonfinite: NonFinite::Keep, ..options() }
}

fn skipping() -> ConvertOptions {
    ConvertOptions { skip_bad: true, ..options() }
}

fn ramp(shape: &[usize]) -> Vec<f64> {
    (0..shape.iter().product::<usize>()).map(|i| (i % 7) as f64 * 0.125 - 0.5).collect()
}

/// A demo with keys of float64 and float32 that become columns, stay in the side folder, and are read by rows.
pub(super) fn demo(number: usize) -> Demo {
    let mut demo = Demo { id: format!("demo_{number}"), ..Demo::default() };
    demo.attrs.insert("num_samples".to_owned(), Array::from_i64(vec![], &[STEPS as i64]));
    for (key, width) in [
        ("actions", 7),
        ("states", 9),
        ("obs/robot0_eef_pos", 3),
        ("obs/robot0_eef_quat", 4),
        ("obs/robot0_gripper_qpos", 2),
        ("obs/object", 5),
        ("obs/unasked", 2),
        ("next_obs/object", 5),
        ("obs/points", 700),
    ] {
        demo.datasets.insert(key.to_owned(), Array::from_f64(vec![STEPS, width], &ramp(&[STEPS, width])));
    }
    let single: Vec<f32> = ramp(&[STEPS, 2]).iter().map(|&v| v as f32).collect();
    demo.datasets.insert("obs/single".to_owned(), Array::from_f32(vec![STEPS, 2], &single));
    demo.datasets.insert("rewards".to_owned(), Array::from_f64(vec![STEPS], &[0.0; STEPS]));
    demo.datasets.insert("dones".to_owned(), Array::from_i64(vec![STEPS], &[0; STEPS]));
    demo
}

fn write(path: &Path, demos: &[Demo], masks: &[(&str, &[&str])]) {
    write_of("{}", path, demos, masks);
}

/// A file that states these arguments of its environment.
pub(super) fn write_of(env_kwargs: &str, path: &Path, demos: &[Demo], masks: &[(&str, &[&str])]) {
    let mut writer = RobomimicWriter::create(path, &WriteOptions::default()).unwrap();
    let env = format!(r#"{{"env_name": "Lift", "type": 1, "env_kwargs": {env_kwargs}}}"#);
    writer.set_data_attr("env_args", &Array::from_str(&env)).unwrap();
    let total: i64 = demos.iter().map(|d| d.attrs["num_samples"].to_i64().unwrap()).sum();
    writer.set_data_attr("total", &Array::from_i64(vec![], &[total])).unwrap();
    demos.iter().for_each(|demo| writer.add_demo(demo).unwrap());
    for (name, ids) in masks {
        writer.set_mask(name, &ids.iter().map(|id| (*id).to_owned()).collect::<Vec<_>>()).unwrap();
    }
    writer.finish().unwrap();
}

/// A place of its own for a file, `x.hdf5`, and the set made of it, `set`.
struct Place(tempfile::TempDir);

impl Place {
    fn of(demos: &[Demo]) -> Self {
        let place = Self(tempfile::tempdir().unwrap());
        write(&place.file(), demos, &[]);
        place
    }

    fn file(&self) -> PathBuf {
        self.0.path().join("x.hdf5")
    }

    fn set(&self) -> PathBuf {
        self.0.path().join("set")
    }

    fn convert(&self, options: &ConvertOptions) -> Result<ConvertReport, DatasetError> {
        convert(&self.file(), &self.set(), options, &mut quiet)
    }

    /// The words of the error; nothing was written.
    fn refused(&self, options: &ConvertOptions) -> String {
        let before = std::fs::read_dir(self.0.path()).unwrap().count();
        let text = self.convert(options).unwrap_err().to_string();
        assert_eq!(std::fs::read_dir(self.0.path()).unwrap().count(), before, "{text}");
        text
    }
}

/// The set without its first episode.
fn without_first(set: &Path, out: &Path) {
    let first = edit::Selection { episodes: vec![0], ..edit::Selection::default() };
    edit::without(set, &edit::Destination::New(out.to_owned()), &first, &mut going).unwrap();
}

/// Puts a value at a place of a dataset.
fn plant(demo: &mut Demo, key: &str, at: usize, value: f64) {
    let array = demo.datasets[key].clone();
    let mut values = array.to_f64().unwrap();
    values[at] = value;
    let single: Vec<f32> = values.iter().map(|&v| v as f32).collect();
    let changed = match array.dtype {
        dataset::Dtype::F32 => Array::from_f32(array.shape, &single),
        _ => Array::from_f64(array.shape, &values),
    };
    demo.datasets.insert(key.to_owned(), changed);
}

#[test]
fn a_value_that_is_not_finite_is_found_wherever_it_is() {
    let good: Vec<Demo> = (0..3).map(demo).collect();
    let keys: Vec<&String> = good[0].datasets.keys().filter(|key| *key != "dones").collect();
    for case in 0..200_usize {
        let mixed = case.wrapping_mul(2_654_435_761) >> 7;
        let key = keys[case % keys.len()];
        let (number, value) = (mixed % 3, [f64::NAN, f64::INFINITY, f64::NEG_INFINITY][case % 3]);
        let mut demos = good.clone();
        let elements = demos[number].datasets[key].len();
        let at = (mixed / 3) % elements;
        plant(&mut demos[number], key, at, value);
        let place = Place::of(&demos);
        let step = at / (elements / STEPS);
        let expected = format!("x.hdf5: demo_{number}: {key}: step {step}, ");
        let text = place.refused(&options());
        assert!(text.contains(&expected) && text.ends_with(&format!("found {value}")), "{case}: {text}");
        let source = Source::open(&place.file()).unwrap().nonfinite(NonFinite::Keep);
        let array = source.read_demo(number).unwrap().datasets[key].clone();
        let found = source.not_finite(&format!("demo_{number}"), key, &array, 0).unwrap().to_string();
        assert_eq!(found, text, "as convert says it");
    }
}

#[test]
fn what_float32_cannot_hold_is_found_where_it_becomes_infinite() {
    for key in ["actions", "rewards", "obs/object", "obs/robot0_eef_pos"] {
        let mut one = demo(0);
        plant(&mut one, key, 5, -1e300);
        let text = Place::of(&[one]).refused(&options());
        assert!(text.contains(&format!("demo_0: {key}: step ")), "{text}");
        assert!(text.ends_with("found -1e300, which float32 cannot hold"), "{text}");
    }
    // the side folder keeps float64
    let mut one = demo(0);
    plant(&mut one, "states", 5, 1e300);
    let place = Place::of(&[one]);
    place.convert(&options()).unwrap();
    // a difference of two finite numbers
    let mut one = demo(0);
    plant(&mut one, "obs/object", 7, 3e38);
    plant(&mut one, "obs/points", 702, -3e38);
    let entities = [("far".to_owned(), vec!["object[2:3] - points[2:3]".to_owned()])].into();
    let text = Place::of(&[one]).refused(&ConvertOptions { entities, ..options() });
    assert!(text.contains("demo_0: observation.entity.far: step 1, dimension 0: "), "{text}");
}

#[test]
fn values_that_are_kept_leave_a_set_that_opens_and_comes_back() {
    let mut demos: Vec<Demo> = (0..2).map(demo).collect();
    for (key, value) in [("obs/object", f64::NAN), ("actions", f64::INFINITY), ("rewards", 1e300), ("states", f64::NAN)]
    {
        plant(&mut demos[1], key, 3, value);
    }
    // a dimension that is never finite
    (0..STEPS).for_each(|step| plant(&mut demos[0], "obs/robot0_eef_pos", step * 3, f64::NAN));
    (0..STEPS).for_each(|step| plant(&mut demos[1], "obs/robot0_eef_pos", step * 3, f64::NAN));
    for lossless in [true, false] {
        let place = Place::of(&demos);
        place.convert(&ConvertOptions { lossless, ..keep() }).unwrap();
        let set = Dataset::open(&place.set()).unwrap();
        let text = std::fs::read_to_string(place.set().join("meta/stats.json")).unwrap();
        let stats: serde_json::Value = serde_json::from_str(&text).unwrap();
        fn finite(value: &serde_json::Value) -> bool {
            match value {
                serde_json::Value::Object(all) => all.values().all(finite),
                serde_json::Value::Array(all) => all.iter().all(finite),
                other => other.as_f64().is_some(),
            }
        }
        assert!(finite(&stats), "{text}");
        assert_eq!(set.stats()["action"].max[3], -0.125, "of the finite values");
        let found = set.not_finite("action", &[0, 1]);
        assert_eq!(found, ["action: episode 1 (demo_1), frame 0, dimension 3: inf"]);
        assert!(set.not_finite("action", &[0]).is_empty());
        let checks = verify(&place.set(), &mut quiet).unwrap();
        let wrong: Vec<_> = checks.iter().filter(|c| c.problem.is_some()).map(|c| c.name).collect();
        assert_eq!(wrong, ["every number is finite"]);
        let cut = place.0.path().join("cut");
        without_first(&place.set(), &cut);
        assert_eq!(Dataset::open(&cut).unwrap().episodes().len(), 1);
        if lossless {
            let again = place.0.path().join("again.hdf5");
            export(&place.set(), &again, &WriteOptions::default(), &mut quiet).unwrap();
            let read = |path: &Path| Source::open(path).unwrap().nonfinite(NonFinite::Keep).read_demo(1).unwrap();
            assert_eq!(read(&again), read(&place.file()));
        }
    }
}

#[test]
fn a_bad_demo_is_left_out_with_its_reason_where_that_is_asked() {
    type Spoil = fn(&mut Demo);
    let cases: [(Spoil, &str); 6] = [
        (
            |d| plant(d, "obs/object", 0, f64::NAN),
            "obs/object: step 0, dimension 0: expected a finite number, found NaN",
        ),
        (|d| plant(d, "obs/points", 1400, f64::NAN), "obs/points: step 2, dimension 0: expected a finite number"),
        (
            |d| {
                d.datasets.clear();
                d.attrs.insert("num_samples".to_owned(), Array::from_i64(vec![], &[0]));
            },
            "actions: expected at least 1 steps, found 0: the demo is empty",
        ),
        (|d| drop(d.datasets.remove("obs/robot0_eef_quat")), "no obs/robot0_eef_quat; found "),
        (
            |d| drop(d.datasets.insert("actions".to_owned(), Array::from_f64(vec![STEPS, 6], &[0.0; 6 * STEPS]))),
            "actions: expected 7",
        ),
        (
            |d| drop(d.datasets.insert("rewards".to_owned(), Array::from_f64(vec![4], &[0.0; 4]))),
            "rewards: expected 6 steps, found",
        ),
    ];
    for (spoil, reason) in cases {
        for bad in 0..3 {
            let mut demos: Vec<Demo> = (0..3).map(demo).collect();
            spoil(&mut demos[bad]);
            let place = Place::of(&demos);
            if reason.starts_with("actions: expected 7") && bad == 0 {
                // which of the shapes is wrong cannot be known: the first demo's is taken as right
                assert!(place.refused(&options()).contains("actions: expected 6"));
            } else {
                let text = place.refused(&options());
                assert!(text.contains(&format!("demo_{bad}: {reason}")), "{text}");
            }
            let report = place.convert(&skipping()).unwrap();
            assert_eq!(report.episodes, 2);
            let [skipped] = report.skipped.as_slice() else { panic!("{:?}", report.skipped) };
            assert_eq!(skipped.demo, format!("demo_{bad}"));
            assert!(skipped.reason.starts_with(&format!("demo_{bad}: {reason}")), "{skipped:?}");
            let set = Dataset::open(&place.set()).unwrap();
            assert_eq!(set.provenance().unwrap().skipped, report.skipped);
            assert!(dataset::notes(&place.set()).unwrap()[0].contains(reason), "{reason}");
            assert!(verify(&place.set(), &mut quiet).unwrap().iter().all(|c| c.problem.is_none()));
            // the others are what they are in a file without the bad one
            demos.remove(bad);
            let clean = Place::of(&demos);
            assert_eq!(clean.convert(&options()).unwrap().fingerprint, report.fingerprint);
            let again = place.0.path().join("again.hdf5");
            export(&place.set(), &again, &WriteOptions::default(), &mut quiet).unwrap();
            assert_eq!(std::fs::read(again).unwrap(), std::fs::read(clean.file()).unwrap());
        }
    }
}

#[test]
fn masks_name_no_demo_that_was_left_out() {
    let place = Place(tempfile::tempdir().unwrap());
    let mut demos: Vec<Demo> = (0..3).map(demo).collect();
    plant(&mut demos[2], "obs/object", 0, f64::NAN);
    let masks: [(&str, &[&str]); 2] = [("train", &["demo_0", "demo_2"]), ("valid", &["demo_1", "demo_9"])];
    write(&place.file(), &demos, &masks);
    place.convert(&skipping()).unwrap();
    let absent = |notes: &[String]| notes.iter().filter(|note| note.contains("not in the file")).count();
    let notes = dataset::notes(&place.set()).unwrap();
    assert!(absent(&notes) == 1 && notes[0].contains("demo_9"), "{notes:?}");
    let again = place.0.path().join("again.hdf5");
    export(&place.set(), &again, &WriteOptions::default(), &mut quiet).unwrap();
    let masks = Source::open(&again).unwrap().plan().masks.clone();
    assert_eq!(
        (&*masks["train"], &*masks["valid"]),
        (&["demo_0".to_owned()][..], &["demo_1", "demo_9"].map(String::from)[..])
    );
}

#[test]
fn demos_that_are_all_bad_are_an_error() {
    let mut demos: Vec<Demo> = (0..2).map(demo).collect();
    demos.iter_mut().for_each(|demo| plant(demo, "obs/object", 0, f64::NAN));
    let text = Place::of(&demos).refused(&skipping());
    assert!(text.contains("2 that cannot be converted"), "{text}");
}

#[test]
fn a_key_that_some_demos_lack_is_refused_or_noted_whichever_lacks_it() {
    let image = || Array::from_u8(vec![STEPS, 8, 8, 3], &[7; STEPS * 8 * 8 * 3]);
    for lacking in 0..3 {
        for key in [
            "obs/robot0_eef_pos",
            "obs/object",
            "rewards",
            "dones",
            "obs/agentview_image",
            "obs/unasked",
            "interventions",
        ] {
            let mut demos: Vec<Demo> = (0..3).map(demo).collect();
            for demo in &mut demos {
                demo.datasets.insert("obs/agentview_image".to_owned(), image());
                demo.datasets.insert("interventions".to_owned(), Array::from_f64(vec![STEPS], &[0.0; STEPS]));
            }
            demos[lacking].datasets.remove(key);
            let place = Place::of(&demos);
            if matches!(key, "obs/unasked" | "interventions") {
                let notes = place.convert(&options()).unwrap().notes.join("\n");
                assert!(notes.contains(key) && notes.contains(&format!("demo_{lacking}")), "{notes}");
                continue;
            }
            let text = place.refused(&options());
            assert!(
                text.contains(&format!("demo_{lacking}: no {key}; ")) && text.contains("2 of 3 demos have it"),
                "{text}"
            );
            assert_eq!(place.convert(&skipping()).unwrap().skipped[0].demo, format!("demo_{lacking}"));
        }
    }
}

#[test]
fn masks_that_name_absent_demos_and_share_some_are_noted() {
    let place = Place(tempfile::tempdir().unwrap());
    let masks: [(&str, &[&str]); 3] =
        [("train", &["demo_0", "demo_1", "demo_9"]), ("valid", &["demo_1"]), ("better", &["demo_0", "demo_1"])];
    write(&place.file(), &[demo(0), demo(1)], &masks);
    let expected = [
        "mask/train: 1 of the 3 demos it names are not in the file: demo_9",
        "masks train and valid share 1 demos: demo_1; what is measured on them says nothing about others",
    ];
    let source = Source::open(&place.file()).unwrap();
    assert_eq!(source.plan().notes, expected);
    assert_eq!(source.plan().problems, []);
    assert_eq!(place.convert(&options()).unwrap().notes[..2], expected);
    assert_eq!(dataset::notes(&place.set()).unwrap(), expected);
}

#[test]
fn float16_is_read_exactly() {
    let place = Place(tempfile::tempdir().unwrap());
    std::fs::copy(fixture("float16.hdf5"), place.file()).unwrap();
    let entities = [("half".to_owned(), ["half", "packed", "swapped"].map(str::to_owned).to_vec())].into();
    place.convert(&ConvertOptions { entities, ..options() }).unwrap();
    let set = Dataset::open(&place.set()).unwrap();
    let column = set.column("observation.entity.half").unwrap();
    let cycle = [0.099_975_586_f32, -65504.0, 5.960_464_5e-8, -0.0];
    for (row, values) in column.data.chunks(9).enumerate().take(4) {
        for (at, value) in values.iter().enumerate() {
            let expected = cycle[(row * 3 + at % 3) % 4];
            assert_eq!(value.to_bits(), expected.to_bits(), "step {row}, number {at}");
        }
    }
    let again = place.0.path().join("again.hdf5");
    export(&place.set(), &again, &WriteOptions::default(), &mut quiet).unwrap();
    let read = |path: &Path| Source::open(path).unwrap().read_demo(0).unwrap().datasets;
    assert_eq!(read(&again), read(&place.file()));
    assert!(read(&again).contains_key("half_outside"));
}

#[test]
fn a_key_that_cannot_be_read_is_left_out_unless_it_is_asked_for() {
    let place = Place(tempfile::tempdir().unwrap());
    std::fs::copy(fixture("blosc.hdf5"), place.file()).unwrap();
    let words = "data/demo_0/obs/object cannot be read: it is packed with blosc (HDF5 filter 32001)";
    let asked = ConvertOptions { env_keys: Some(vec!["object".to_owned()]), ..options() };
    let text = place.refused(&asked);
    assert!(text.contains(words) && text.contains("h5repack"), "{text}");
    let report = place.convert(&options()).unwrap();
    let note = report.notes.iter().find(|note| note.contains(words)).unwrap();
    assert!(note.starts_with("obs/object is left out in 2 of 2 demos, from the side folder too: "), "{note}");
    assert_eq!(report.notes.iter().filter(|note| note.contains("obs/object")).count(), 1, "{:?}", report.notes);
    assert_eq!(Dataset::open(&place.set()).unwrap().provenance().unwrap().left_out, ["obs/object"]);
    export(&place.set(), &place.0.path().join("again.hdf5"), &WriteOptions::default(), &mut quiet).unwrap();
    // a file that is made of the file says so too
    let rewritten = place.0.path().join("rewritten.hdf5");
    let options = WriteOptions::default();
    let notes = rewrite(&place.file(), &rewritten, NonFinite::Refuse, &options, &mut quiet).unwrap().notes;
    assert!(notes.iter().any(|note| note.starts_with("obs/object is left out in 2 of 2 demos: ")), "{notes:?}");
}

/// Adds to a file what only libhdf5 itself makes.
pub(super) fn changed(path: &Path, change: impl FnOnce(&hdf5::Group)) {
    let file = hdf5::File::open_rw(path).unwrap();
    change(&file.group("data").unwrap());
    file.close().unwrap();
}

#[test]
fn a_dataset_that_was_never_written_is_no_picture() {
    let place = Place::of(&[demo(0), demo(1)]);
    let camera = |data: &hdf5::Group, number: usize| {
        let obs = data.group(&format!("demo_{number}/obs")).unwrap();
        let new = obs.new_dataset::<u8>().chunk((1, 16, 16, 3)).shape((STEPS, 16, 16, 3));
        new.create("agentview_image").unwrap()
    };
    changed(&place.file(), |data| (0..2).for_each(|number| drop(camera(data, number))));
    let report = place.convert(&options()).unwrap();
    let note = report.notes.iter().find(|note| note.contains("agentview_image")).unwrap();
    assert!(note.contains("is left out in 2 of 2 demos") && note.contains("it was never written"), "{note}");
    // written in one demo, it is a camera that the other lacks
    let place = Place::of(&[demo(0), demo(1)]);
    changed(&place.file(), |data| {
        camera(data, 0).write_raw(&[1_u8; STEPS * 16 * 16 * 3]).unwrap();
        camera(data, 1);
    });
    let text = place.refused(&options());
    assert!(text.contains("data/demo_1/obs/agentview_image cannot be read: it was never written"), "{text}");
    assert_eq!(place.convert(&skipping()).unwrap().skipped[0].demo, "demo_1");
}

#[test]
fn links_are_followed_inside_the_folder_of_the_file() {
    let place = Place::of(&[demo(0)]);
    let other = place.0.path().join("other.hdf5");
    let mut nan = demo(4);
    plant(&mut nan, "obs/object", 11, f64::NAN);
    write(&other, &[demo(4)], &[]);
    changed(&place.file(), |data| {
        data.link_external("other.hdf5", "/data/demo_4", "demo_1").unwrap();
        data.link_soft("/data/demo_0", "demo_2").unwrap();
        data.attr("total").unwrap().write_scalar(&(3 * STEPS as i64)).unwrap();
    });
    let report = place.convert(&options()).unwrap();
    assert_eq!(report.episodes, 3);
    assert_eq!(report.notes.iter().filter(|note| note.contains("link")).count(), 0, "{:?}", report.notes);
    let copy = Place::of(&[demo(0), demo(1), demo(2)]);
    assert_eq!(copy.convert(&options()).unwrap().fingerprint, report.fingerprint);
    let again = place.0.path().join("again.hdf5");
    export(&place.set(), &again, &WriteOptions::default(), &mut quiet).unwrap();
    let demos = |path: &Path| {
        let source = Source::open(path).unwrap();
        (0..3).map(|index| source.read_demo(index).unwrap()).collect::<Vec<_>>()
    };
    assert_eq!(demos(&again), demos(&copy.file()));
    // a change of the other file is a change of the source
    assert_eq!(verify_source(&place.set(), &place.file()).unwrap().problem, None);
    std::fs::remove_file(&other).unwrap();
    write(&other, &[nan], &[]);
    assert!(verify_source(&place.set(), &place.file()).unwrap().problem.is_some());
    std::fs::remove_dir_all(place.set()).unwrap();
    let text = place.refused(&options());
    assert!(text.contains("demo_1: obs/object: step 2, dimension 1: "), "{text}");
}

#[test]
fn links_that_are_not_followed_are_refused_by_name() {
    let outside = tempfile::tempdir().unwrap();
    let far = outside.path().join("far.hdf5");
    write(&far, &[demo(0)], &[]);
    let far = far.to_str().unwrap().to_owned();
    type Link = fn(&hdf5::Group, &str, &str);
    let cases: [(Link, &str); 5] = [
        (|data, name, far| data.link_external(far, "/data/demo_0", name).unwrap(), "outside the folder of this one"),
        (
            |data, name, _| data.link_external("gone.hdf5", "/data/demo_0", name).unwrap(),
            "a link to the file gone.hdf5, which cannot be opened",
        ),
        (|data, name, _| data.link_soft("/data/none", name).unwrap(), "a link that leads nowhere"),
        (|data, name, _| data.link_soft(&format!("/data/{name}"), name).unwrap(), "a link that leads in a circle"),
        (|data, name, _| data.link_soft("/data", name).unwrap(), "a link to a group that contains it"),
    ];
    for (link, words) in cases {
        // a demo
        let place = Place::of(&[demo(0)]);
        changed(&place.file(), |data| link(data, "demo_1", &far));
        let text = place.refused(&options());
        assert!(text.contains("x.hdf5: data/demo_1 cannot be read: ") && text.contains(words), "{text}");
        let problems = Source::open(&place.file()).unwrap().plan().problems.clone();
        assert!(problems.iter().any(|p| p.message.contains(words)), "inspect and validate say so");
        let report = place.convert(&skipping()).unwrap();
        assert_eq!((report.episodes, report.skipped[0].demo.as_str()), (1, "demo_1"));
        assert!(report.skipped[0].reason.contains(words), "{:?}", report.skipped);
        // a key that nothing asks for, and one that is asked for
        let place = Place::of(&[demo(0)]);
        changed(&place.file(), |data| link(data, "demo_0/obs/extra", &far));
        let notes = place.convert(&options()).unwrap().notes.join("\n");
        assert!(notes.contains("obs/extra is left out in 1 of 1 demos") && notes.contains(words), "{notes}");
        std::fs::remove_dir_all(place.set()).unwrap();
        let asked = ConvertOptions { env_keys: Some(vec!["extra".to_owned()]), ..options() };
        assert!(place.refused(&asked).contains(words), "{words}");
    }
}

/// An ALOHA episode without any attribute.
fn episode(path: &Path, cameras: &[&str]) {
    let file = hdf5::File::create(path).unwrap();
    let floats = |at: &hdf5::Group, name: &str| {
        let values: Vec<f64> = (0..STEPS * 14).map(|i| i as f64 * 0.1).collect();
        at.new_dataset::<f64>().shape([STEPS, 14]).create(name).unwrap().write_raw(&values).unwrap();
    };
    floats(&file, "action");
    let observations = file.create_group("observations").unwrap();
    floats(&observations, "qpos");
    for camera in cameras {
        let images = observations.group("images").or_else(|_| observations.create_group("images")).unwrap();
        let pixels = vec![9_u8; STEPS * 8 * 8 * 3];
        images.new_dataset::<u8>().shape([STEPS, 8, 8, 3]).create(*camera).unwrap().write_raw(&pixels).unwrap();
    }
    file.close().unwrap();
}

fn episodes(cameras: &[&[&str]]) -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().join("episodes");
    std::fs::create_dir(&folder).unwrap();
    for (number, cameras) in cameras.iter().enumerate() {
        episode(&folder.join(format!("episode_{number}.hdf5")), cameras);
    }
    (dir, folder)
}

#[test]
fn a_set_without_attributes_is_exported_and_edited() {
    let (dir, folder) = episodes(&[&[], &[]]);
    let at = |name: &str| dir.path().join(name);
    convert(&folder, &at("set"), &options(), &mut quiet).unwrap();
    export(&at("set"), &at("again.hdf5"), &WriteOptions::default(), &mut quiet).unwrap();
    without_first(&at("set"), &at("cut"));
    export(&at("cut"), &at("cut.hdf5"), &WriteOptions::default(), &mut quiet).unwrap();
    assert_eq!(Dataset::open(&at("cut")).unwrap().episodes().len(), 1);
}

const POINTER: &str = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a2146\nsize 12345\n";

#[test]
fn an_episode_that_is_no_file_yet_is_not_left_out_in_silence() {
    for bad in 0..3 {
        for (content, words) in [
            (POINTER.to_owned(), "a git-lfs pointer, not the file itself; run `git lfs pull`"),
            (String::new(), "found an empty file"),
            ("\u{1}half".to_owned(), "not an HDF5 file"),
        ] {
            let (dir, folder) = episodes(&[&["top"], &["top"], &["top"]]);
            let file = folder.join(format!("episode_{bad}.hdf5"));
            std::fs::write(&file, &content).unwrap();
            let refused = || convert(&folder, &dir.path().join("set"), &options(), &mut quiet).unwrap_err().to_string();
            let text = refused();
            assert!(text.contains(&format!("episode_{bad}.hdf5: ")) && text.contains(words), "{text}");
            // cut off
            episode(&folder.join("whole.hdf5"), &["top"]);
            let whole = std::fs::read(folder.join("whole.hdf5")).unwrap();
            std::fs::remove_file(folder.join("whole.hdf5")).unwrap();
            std::fs::write(&file, &whole[..whole.len() - 100]).unwrap();
            let text = refused();
            assert!(text.contains(&format!("episode_{bad}.hdf5: truncated")), "{text}");
            let report = convert(&folder, &dir.path().join("set"), &skipping(), &mut quiet).unwrap();
            assert_eq!((report.episodes, report.skipped[0].demo.as_str()), (2, format!("demo_{bad}").as_str()));
        }
    }
}

#[test]
fn a_camera_that_an_episode_lacks_is_refused_whichever_it_is() {
    for bad in 0..3 {
        let cameras: Vec<&[&str]> =
            (0..3).map(|i| if i == bad { &["top"][..] } else { &["left", "top"][..] }).collect();
        let (dir, folder) = episodes(&cameras);
        let error = convert(&folder, &dir.path().join("set"), &options(), &mut quiet).unwrap_err().to_string();
        assert!(error.contains(&format!("demo_{bad}: no obs/images/left; ")), "{error}");
        let problems = Source::open(&folder).unwrap().plan().problems.clone();
        assert!(
            problems.iter().any(|p| p.message.contains(&format!("demo_{bad}: no obs/images/left"))),
            "{problems:?}"
        );
    }
}

#[test]
fn a_pointer_is_named_wherever_a_file_belongs() {
    let place = Place::of(&[demo(0)]);
    place.convert(&options()).unwrap();
    for name in [
        "data/chunk-000/file-000.parquet",
        "meta/info.json",
        "meta/tasks.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
    ] {
        let path = place.set().join(name);
        let before = std::fs::read(&path).unwrap();
        std::fs::write(&path, POINTER).unwrap();
        let text = Dataset::open(&place.set()).unwrap_err().to_string();
        assert!(text.contains(&format!("{name}: a git-lfs pointer")) && text.contains("git lfs pull"), "{text}");
        std::fs::write(&path, before).unwrap();
    }
    std::fs::write(place.file(), POINTER).unwrap();
    let text = Source::open(&place.file()).unwrap_err().to_string();
    assert!(
        text.ends_with("x.hdf5: a git-lfs pointer, not the file itself; run `git lfs pull` to download it"),
        "{text}"
    );
}

#[test]
fn d4rl_and_its_kind_are_held_to_the_same() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("walker.hdf5");
    let file = hdf5::File::create(&path).unwrap();
    let floats = |name: &str, width: usize, bad: Option<usize>| {
        let mut values = vec![0.5_f32; 10 * width];
        bad.into_iter().for_each(|at| values[at] = f32::NAN);
        file.new_dataset::<f32>().shape([10, width]).create(name).unwrap().write_raw(&values).unwrap();
    };
    floats("observations", 4, Some(4 * 6 + 1));
    floats("actions", 2, None);
    file.new_dataset::<f32>().shape([10]).create("rewards").unwrap().write_raw(&[0.0_f32; 10]).unwrap();
    for (name, at) in [("terminals", 2), ("timeouts", 9)] {
        let ends: Vec<u8> = (0..10).map(|i| u8::from(i == at)).collect();
        file.new_dataset::<u8>().shape([10]).create(name).unwrap().write_raw(&ends).unwrap();
    }
    file.close().unwrap();
    let set = dir.path().join("set");
    let text = convert(&path, &set, &options(), &mut quiet).unwrap_err().to_string();
    assert!(text.contains("walker.hdf5: demo_1: obs/flat: step 3, dimension 1: "), "{text}");
    let report = convert(&path, &set, &skipping(), &mut quiet).unwrap();
    assert_eq!((report.episodes, report.skipped[0].demo.as_str()), (1, "demo_1"));
    // the whole run is at fault, of which no demo can be left out
    let file = hdf5::File::open_rw(&path).unwrap();
    file.unlink("observations").unwrap();
    file.new_dataset::<f32>().shape([9, 4]).create("observations").unwrap().write_raw(&[0.5_f32; 36]).unwrap();
    file.close().unwrap();
    let error = convert(&path, &dir.path().join("no"), &options(), &mut quiet).unwrap_err();
    assert!(
        error.to_string().contains("observations: expected 10 steps, as actions has, found shape [9, 4]"),
        "{error}"
    );
    assert!(matches!(error, DatasetError::Input(dataset::InputError::Damaged { .. })));
}

#[test]
fn pictures_of_other_shapes_are_named() {
    let mut one = demo(0);
    let cameras: [(&str, &[usize]); 3] =
        [("obs/agentview_image", &[3, 8, 8]), ("obs/scene", &[8, 8]), ("obs/pair", &[2, 8, 8, 3])];
    for (key, frame) in cameras {
        let shape: Vec<usize> = [STEPS].iter().chain(frame).copied().collect();
        one.datasets.insert(key.to_owned(), Array::from_u8(shape.clone(), &vec![7; shape.iter().product()]));
    }
    let floats = Array::from_f64(vec![STEPS, 3, 8, 8], &ramp(&[STEPS, 3, 8, 8]));
    one.datasets.insert("obs/front_rgb".to_owned(), floats.clone());
    // no picture, and one that is asked for as numbers
    one.datasets.insert("obs/voxels".to_owned(), floats);
    let chosen = ConvertOptions { env_keys: Some(vec!["object".to_owned(), "scene".to_owned()]), ..options() };
    for (lossless, fate) in [(true, "the side folder keeps it as stored"), (false, "it is left out (--no-lossless)")] {
        let place = Place::of(&[one.clone()]);
        let notes = place.convert(&ConvertOptions { lossless, ..chosen.clone() }).unwrap().notes;
        let named = |key: &str| notes.iter().filter(|note| note.starts_with(key)).collect::<Vec<_>>();
        let end = format!("becomes no column: only uint8 [height, width, 3] and JPEG files do; {fate}");
        for (key, what) in [
            ("obs/agentview_image", "uint8 [3, 8, 8]"),
            ("obs/pair", "uint8 [2, 8, 8, 3]"),
            ("obs/front_rgb", "float64 [3, 8, 8]"),
        ] {
            assert_eq!(named(key), [&format!("{key} ({what}) {end}")]);
        }
        assert_eq!((named("obs/voxels").len(), named("obs/scene").len()), (0, 0));
    }
}

#[test]
fn values_that_their_column_does_not_hold_are_noted() {
    let mut demos = [demo(0), demo(1)];
    let plain = Place::of(&demos).convert(&options()).unwrap().notes;
    demos[0].datasets.insert("dones".to_owned(), Array::from_i64(vec![STEPS], &[-1, -1, 0, 0, 1, 1]));
    demos[1].datasets.insert("dones".to_owned(), Array::from_i64(vec![STEPS], &[0, 0, 0, 0, 0, 7]));
    for (demo, time) in demos.iter_mut().zip([3_i64, 1_700_000_000_123_456_789]) {
        let times: Vec<i64> = (0..STEPS as i64).map(|step| time + step).collect();
        demo.datasets.insert("obs/t".to_owned(), Array::from_i64(vec![STEPS, 1], &times));
    }
    let place = Place::of(&demos);
    let chosen = ConvertOptions { env_keys: Some(vec!["object".to_owned(), "t".to_owned()]), ..options() };
    let expected = [
        "dones: 3 steps are neither 0 nor 1; next.done is true wherever they are not 0",
        "obs/t: whole numbers up to 1700000000123456794 are rounded in observation.environment_state, which is float32",
    ];
    assert_eq!(place.convert(&chosen).unwrap().notes, [&plain[..], &expected.map(str::to_owned)].concat());
    let shard = dataset::convert_shard(
        &place.file(),
        &place.0.path().join("part"),
        &chosen,
        "1/1".parse().unwrap(),
        &mut |_, _| std::ops::ControlFlow::Continue(()),
    );
    assert_eq!(shard.unwrap().notes[plain.len()..], expected);
}

#[test]
fn shaped_rewards_tell_no_success() {
    let place = Place(tempfile::tempdir().unwrap());
    let mut one = demo(0);
    let convert = |name: &str, kwargs: &str, one: &Demo| {
        let (file, set) = (place.0.path().join(format!("{name}.hdf5")), place.0.path().join(name));
        write_of(kwargs, &file, std::slice::from_ref(one), &[]);
        let notes = convert(&file, &set, &options(), &mut quiet).unwrap().notes;
        let success = Dataset::open(&set).unwrap().column("next.success").map(|column| column.data.to_vec());
        (success, notes.iter().any(|note| note.starts_with("no next.success is made")))
    };
    one.datasets.insert("rewards".to_owned(), Array::from_f64(vec![STEPS], &[0.0, 0.5, 1.0, 1.5, 2.0, 2.25]));
    let of_rewards = Some(vec![0.0, 0.0, 1.0, 1.0, 1.0, 1.0]);
    assert_eq!(convert("sparse", r#"{"reward_shaping": false}"#, &one), (of_rewards, false));
    assert_eq!(convert("shaped", r#"{"reward_shaping": true}"#, &one), (None, true));
    one.datasets.insert("success".to_owned(), Array::from_i64(vec![STEPS], &[0, 0, 0, 0, 0, 1]));
    assert_eq!(convert("told", r#"{"reward_shaping": true}"#, &one), (Some(vec![0.0, 0.0, 0.0, 0.0, 0.0, 1.0]), false));
}

#[test]
fn a_rate_is_read_as_text_too_and_refused_where_it_is_none() {
    let place = Place(tempfile::tempdir().unwrap());
    let rate = |control_freq: &str, fps| {
        write_of(&format!(r#"{{"control_freq": {control_freq}}}"#), &place.file(), &[demo(0)], &[]);
        let found = place.convert(&ConvertOptions { fps, ..options() }).map(|report| {
            assert!(report.notes.iter().all(|note| !note.contains("control_freq")), "{:?}", report.notes);
            let fps = Dataset::open(&place.set()).unwrap().info().fps;
            std::fs::remove_dir_all(place.set()).unwrap();
            fps
        });
        std::fs::remove_file(place.file()).unwrap();
        found.map_err(|error| error.to_string())
    };
    assert_eq!(rate(r#""50""#, None), Ok(50.0));
    assert_eq!(rate(r#""fast""#, Some(10.0)), Ok(10.0));
    let text = rate(r#""fast""#, None).unwrap_err();
    assert!(text.contains("a number as env_kwargs.control_freq") && text.ends_with(r#"found "fast""#), "{text}");
    for fps in [0.0, -1.0, 1e300, f64::NAN, f64::INFINITY] {
        let text = rate("20", Some(fps)).unwrap_err();
        assert!(text.ends_with(&format!("expected a number above 0, at most 100000, found {fps}")), "{text}");
    }
}

#[test]
fn a_number_of_steps_that_no_dataset_has_costs_its_demo_alone() {
    let mut demos = [demo(0), demo(1)];
    demos[1].attrs.insert("num_samples".to_owned(), Array::from_i64(vec![], &[10_000_000_000_000]));
    let place = Place::of(&demos);
    let text = place.refused(&options());
    assert!(text.contains("demo_1: actions: expected 10000000000000 (num_samples) steps"), "{text}");
    let report = place.convert(&skipping()).unwrap();
    assert_eq!((report.episodes, report.skipped[0].demo.as_str()), (1, "demo_1"));
}

#[test]
fn what_becomes_no_column_is_not_read_without_a_side_folder() {
    let mut one = demo(0);
    plant(&mut one, "obs/unasked", 3, f64::NAN);
    let place = Place::of(&[one]);
    assert!(place.refused(&options()).contains("obs/unasked"));
    place.convert(&ConvertOptions { lossless: false, ..options() }).unwrap();
}

#[test]
fn cameras_of_one_name_are_numbered() {
    let mut one = demo(0);
    for key in ["obs/x", "obs/x_image", "obs/x_image_image"] {
        one.datasets.insert(key.to_owned(), Array::from_u8(vec![STEPS, 8, 8, 3], &[7; STEPS * 192]));
    }
    let place = Place::of(&[one]);
    let notes = place.convert(&options()).unwrap().notes;
    let set = Dataset::open(&place.set()).unwrap();
    let cameras: Vec<&str> = set.cameras().map(|name| name.trim_start_matches("observation.images.")).collect();
    assert_eq!(cameras, ["x", "x_image", "x_image_2"]);
    assert!(notes.iter().any(|note| note.starts_with("obs/x_image_image becomes ")), "{notes:?}");
    for check in verify(&place.set(), &mut quiet).unwrap() {
        assert_eq!(check.problem, None, "{}", check.name);
    }
}
