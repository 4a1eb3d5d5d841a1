#![allow(clippy::unwrap_used)]

use std::collections::BTreeMap;
use std::path::PathBuf;

use super::*;
use crate::plan::Dialect;
use crate::tree::{Attrs, Dtype};

fn fixture(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name)
}

/// Everything in a source.
fn everything(path: &Path) -> (Demo, Vec<Demo>) {
    let source = Source::open(path).unwrap();
    let demos = (0..source.plan().demos.len()).map(|i| source.read_demo(i).unwrap()).collect();
    (source.root().unwrap(), demos)
}

fn write(path: &Path, root: &Demo, demos: &[Demo], gzip: Option<u8>) {
    let mut writer = RobomimicWriter::create(path, &WriteOptions { gzip }).unwrap();
    writer.set_root(root).unwrap();
    for demo in demos {
        writer.add_demo(demo).unwrap();
    }
    writer.finish().unwrap();
}

/// A small robomimic demo of `steps` steps.
fn small_demo(id: &str, steps: usize) -> Demo {
    let mut demo = Demo { id: id.to_owned(), ..Demo::default() };
    let ramp = |width: usize| -> Vec<f64> { (0..steps * width).map(|i| (i % 7) as f64 * 0.125 - 0.5).collect() };
    demo.attrs.insert("num_samples".to_owned(), Array::from_i64(vec![], &[steps as i64]));
    demo.datasets.insert("actions".to_owned(), Array::from_f64(vec![steps, 7], &ramp(7)));
    demo.datasets.insert("rewards".to_owned(), Array::from_f64(vec![steps], &ramp(1)));
    demo.datasets.insert("dones".to_owned(), Array::from_i64(vec![steps], &vec![0; steps]));
    demo.datasets.insert("obs/object".to_owned(), Array::from_f64(vec![steps, 3], &ramp(3)));
    demo
}

fn root_with(total: i64) -> Demo {
    let mut root = Demo::default();
    let mut data = Attrs::new();
    let env = r#"{"env_name": "Lift", "env_version": "1.5.2", "type": 1, "env_kwargs": {}}"#;
    data.insert("env_args".to_owned(), Array::from_str(env));
    data.insert("total".to_owned(), Array::from_i64(vec![], &[total]));
    root.inner_attrs.insert("data".to_owned(), data);
    root
}

fn saved(demos: &[Demo], change: impl FnOnce(&mut Demo)) -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("file.hdf5");
    let steps: i64 = demos.iter().map(|d| d.attrs["num_samples"].to_i64().unwrap()).sum();
    let mut root = root_with(steps);
    change(&mut root);
    write(&path, &root, demos, None);
    (dir, path)
}

fn input_error(result: Result<impl std::fmt::Debug>) -> InputError {
    match result.unwrap_err() {
        crate::error::DatasetError::Input(error) => error,
        other => panic!("expected an input error, found {other}"),
    }
}

#[test]
fn fixture_is_planned_in_full() {
    let source = Source::open(&fixture("lift_low_dim_3_demos.hdf5")).unwrap();
    let plan = source.plan();
    assert_eq!(plan.dialect, Dialect::Robomimic);
    assert_eq!(plan.problems, []);
    let ids: Vec<_> = plan.demos.iter().map(|d| (d.id.as_str(), d.length)).collect();
    assert_eq!(ids, [("demo_1", 56), ("demo_2", 56), ("demo_3", 54)]);
    assert_eq!(plan.env_name.as_deref(), Some("Lift"));
    assert_eq!(plan.env_version.as_deref(), Some("1.5.2"));
    let mut train = plan.masks["train"].clone();
    train.sort();
    assert_eq!(train, ["demo_1", "demo_2", "demo_3"], "in robomimic's shuffled order");
    assert_eq!(plan.masks["valid"], Vec::<String>::new());
    let object = &plan.demos[0].keys["obs/object"];
    assert_eq!((&object.dtype, &*object.shape), (&Dtype::F64, &[56, 10][..]));
    assert_eq!(object.place.offset, Some(27080), "as h5py states it");
    let demo = source.read_demo(0).unwrap();
    assert_eq!(demo.datasets.len(), 30);
    assert_eq!(demo.attrs["num_samples"].to_i64(), Some(56));
    assert!(demo.attrs["model_file"].to_text().unwrap().starts_with("<mujoco model=\"base\">"));
}

/// `tests/fixtures/content_hash.py` reads the same files with h5py and comes to these hashes: every group,
/// dataset, type, shape, attribute and value is read as h5py reads it.
#[test]
fn fixture_hashes_equal_h5py() {
    for (name, expected) in [
        ("lift_low_dim_3_demos.hdf5", "f32adc64bcc5c60f1863febd3b2d25ea0e388dae9781aa749b7bd66a6d10b939"),
        ("lift_raw_3_demos.hdf5", "405ea8898dc0a1c6de80779bdaf72cf70f11b7ef191f983f29a9acfdf5cf2fca"),
    ] {
        let source = Source::open(&fixture(name)).unwrap();
        assert_eq!(content_hash::content_hash(&source), expected, "{name}");
    }
}

#[test]
fn names_that_command_a_terminal_are_refused_in_one_plain_line() {
    for (id, attribute) in [("demo_1\u{1b}[31m\n", "note"), ("demo_1", "a\u{7}b")] {
        let mut demo = small_demo(id, 3);
        demo.attrs.insert(attribute.to_owned(), Array::from_str("x"));
        let (_dir, path) = saved(&[demo], |_| {});
        let text = Source::open(&path).unwrap_err().to_string();
        assert!(text.contains("control characters") && !text.contains(char::is_control), "{text:?}");
    }
}

#[test]
fn raw_recordings_are_recognised() {
    let source = Source::open(&fixture("lift_raw_3_demos.hdf5")).unwrap();
    assert_eq!(source.plan().dialect, Dialect::RobosuiteRaw);
    assert_eq!(source.plan().env_version.as_deref(), Some("1.5.2"));
    let demo = source.read_demo(2).unwrap();
    assert_eq!(demo.datasets["states"].shape, [54, 32]);
}

#[test]
fn fixtures_survive_rewriting_in_full() {
    let dir = tempfile::tempdir().unwrap();
    for name in ["lift_low_dim_3_demos.hdf5", "lift_raw_3_demos.hdf5"] {
        let (root, demos) = everything(&fixture(name));
        for gzip in [None, Some(4)] {
            let copy = dir.path().join(format!("{gzip:?}{name}"));
            write(&copy, &root, &demos, gzip);
            assert_eq!(everything(&copy), (root.clone(), demos.clone()), "{name} {gzip:?}");
        }
    }
}

#[test]
fn same_calls_give_the_same_bytes() {
    let dir = tempfile::tempdir().unwrap();
    let (root, demos) = everything(&fixture("lift_low_dim_3_demos.hdf5"));
    let (a, b) = (dir.path().join("a.hdf5"), dir.path().join("b.hdf5"));
    write(&a, &root, &demos, Some(4));
    std::thread::sleep(std::time::Duration::from_millis(1100)); // object times have seconds
    write(&b, &root, &demos, Some(4));
    assert!(std::fs::read(a).unwrap() == std::fs::read(b).unwrap());
}

#[test]
fn writer_refuses_an_existing_path_and_leaves_nothing_unfinished() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("there.hdf5");
    std::fs::write(&path, "mine").unwrap();
    let error = RobomimicWriter::create(&path, &WriteOptions::default()).unwrap_err();
    assert!(matches!(error, crate::error::DatasetError::OutputExists { .. }), "{error}");
    let other = dir.path().join("other.hdf5");
    let mut writer = RobomimicWriter::create(&other, &WriteOptions::default()).unwrap();
    writer.add_demo(&small_demo("demo_0", 3)).unwrap();
    drop(writer);
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1, "only the first file");
    // a file that appears while we write is kept
    let writer = RobomimicWriter::create(&other, &WriteOptions::default()).unwrap();
    std::fs::write(&other, "theirs").unwrap();
    assert!(writer.finish().is_err());
    assert_eq!(std::fs::read_to_string(&other).unwrap(), "theirs");
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 2);
}

#[test]
fn only_what_dead_writers_left_is_removed() {
    let dir = tempfile::tempdir().unwrap();
    // no process has the largest number, and the first one lives
    let names =
        [".a.hdf5.2147483647-Ab12cd.part", ".a.hdf5.1-Ab12cd.part", ".a.hdf5.backup.part", ".a.hdf5.x-Ab12cd.part"];
    names.iter().for_each(|name| std::fs::write(dir.path().join(name), "theirs").unwrap());
    RobomimicWriter::create(&dir.path().join("a.hdf5"), &WriteOptions::default()).unwrap();
    let left: Vec<bool> = names.iter().map(|name| dir.path().join(name).exists()).collect();
    assert_eq!(left, [false, true, true, true]);
}

#[test]
fn files_are_written_where_hdf5_locks_them() {
    // libhdf5 reads the variable once
    for value in ["TRUE", "1", "BEST_EFFORT", "FALSE"] {
        let run = std::process::Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "source::tests::writer_refuses_an_existing_path_and_leaves_nothing_unfinished"])
            .env("HDF5_USE_FILE_LOCKING", value)
            .output()
            .unwrap();
        let text = String::from_utf8_lossy(&run.stdout);
        assert!(run.status.success() && text.contains("1 passed"), "{value}: {text}");
    }
}

#[test]
fn every_kind_of_element_survives() {
    let mut demo = small_demo("demo_0", 4);
    let mut put = |name: &str, array: Array| demo.datasets.insert(format!("extra/{name}"), array);
    for (name, dtype, width) in [
        ("u8", Dtype::U8, 1),
        ("i8", Dtype::I8, 1),
        ("u16", Dtype::U16, 2),
        ("i16", Dtype::I16, 2),
        ("u32", Dtype::U32, 4),
        ("i32", Dtype::I32, 4),
        ("u64", Dtype::U64, 8),
        ("i64", Dtype::I64, 8),
        ("f32", Dtype::F32, 4),
        ("f64", Dtype::F64, 8),
    ] {
        let bytes = (0..2 * 3 * width).map(|i| (i * 37 + 200) as u8).collect();
        put(name, Array { dtype: dtype.clone(), shape: vec![2, 3], bytes });
        put(&format!("{name}_none"), Array { dtype: dtype.clone(), shape: vec![0, 3], bytes: vec![] });
        put(&format!("{name}_null"), Array { dtype, shape: vec![], bytes: vec![] });
    }
    put("bool", Array { dtype: Dtype::Bool, shape: vec![3], bytes: vec![1, 0, 1] });
    put("masks", Array::from_fixed_strings(&["demo_1", "demo_12", ""]));
    put("utf8", Array { dtype: Dtype::FixedUtf8(6), shape: vec![2], bytes: "füss\0ä\0\0\0\0".into() });
    put("texts", Array::from_strings(vec![2, 2], &["", "ä", "long ".repeat(1000).as_str(), "x"]));
    put("scalar", Array::from_str("one"));
    let ascii = Array { dtype: Dtype::VarAscii, ..Array::from_str("plain") };
    put("ascii", ascii.clone());
    // byte strings are any bytes, whatever their type says
    let raw = Array { dtype: Dtype::FixedStr(5), shape: vec![2], bytes: b"\x01\0\x02\0\x03\0\0\xe9\0\0".to_vec() };
    put("raw", raw.clone());
    put(
        "wide",
        Array { dtype: Dtype::FixedStr(150_001), shape: vec![1], bytes: [0, 200].repeat(75_001)[..150_001].to_vec() },
    );
    put("broken_utf8", Array { dtype: Dtype::FixedUtf8(2), shape: vec![2], bytes: b"\xe9\0\0a".to_vec() });
    put("latin", Array { dtype: Dtype::VarAscii, shape: vec![], bytes: b"\x03\0\0\0\xe9t\xe9".to_vec() });
    demo.attrs.insert("raw".to_owned(), raw);
    let huge = "<mujoco/>".repeat(20_000);
    demo.attrs.insert("model_file".to_owned(), Array::from_str(&huge));
    demo.attrs.insert("fixed".to_owned(), Array::from_fixed_strings(&[&huge[..60_000]]));
    demo.attrs.insert("flag".to_owned(), Array { dtype: Dtype::Bool, shape: vec![], bytes: vec![1] });
    demo.attrs.insert("wide".to_owned(), Array::from_f64(vec![10_000], &vec![0.5; 10_000]));
    demo.attrs.insert("small".to_owned(), Array::from_i32(vec![2], &[1, -1]));
    demo.groups.insert("empty/inside".to_owned());
    demo.inner_attrs.insert("obs".to_owned(), BTreeMap::from([("a".to_owned(), ascii)]));
    demo.inner_attrs.insert("obs/object".to_owned(), BTreeMap::from([("unit".to_owned(), Array::from_str("m"))]));
    let (_dir, path) = saved(std::slice::from_ref(&demo), |root| {
        root.datasets.insert("extra/notes".to_owned(), Array::from_str("root extras"));
        root.attrs.insert("made".to_owned(), Array::from_str("here"));
        root.groups.insert("nothing".to_owned());
    });
    let (root, demos) = everything(&path);
    assert_eq!(demos, [demo]);
    assert_eq!(root.datasets["extra/notes"].to_text().unwrap(), "root extras");
    assert_eq!(root.attrs["made"].to_text().unwrap(), "here");
    assert!(root.groups.contains("nothing"));
}

#[test]
fn demos_are_in_numeric_order_with_their_ids() {
    let demos: Vec<Demo> = [0, 10, 2, 31, 1].iter().map(|n| small_demo(&format!("demo_{n}"), 2)).collect();
    let (_dir, path) = saved(&demos, |_| {});
    let source = Source::open(&path).unwrap();
    let ids: Vec<_> = source.plan().demos.iter().map(|d| d.id.as_str()).collect();
    assert_eq!(ids, ["demo_0", "demo_1", "demo_2", "demo_10", "demo_31"]);
}

#[test]
fn rows_of_packed_and_plain_datasets() {
    let mut demo = small_demo("demo_0", 700);
    let pixels: Vec<u8> = (0..700 * 20 * 20 * 3).map(|i| (i * 31 / 7) as u8).collect();
    demo.datasets.insert("obs/image".to_owned(), Array::from_u8(vec![700, 20, 20, 3], &pixels));
    let dir = tempfile::tempdir().unwrap();
    for gzip in [None, Some(1)] {
        let path = dir.path().join(format!("{gzip:?}"));
        write(&path, &root_with(700), std::slice::from_ref(&demo), gzip);
        let source = Source::open(&path).unwrap();
        let key = &source.plan().demos[0].keys["obs/image"];
        assert!(key.is_image());
        assert_eq!(key.place.offset.is_none(), gzip.is_some());
        let rows = source.read_rows(0, "obs/image", 650, 50).unwrap();
        assert_eq!(rows.shape, [50, 20, 20, 3]);
        assert!(rows.bytes == pixels[650 * 1200..]);
        assert_eq!(source.read_demo(0).unwrap(), demo);
        assert!(source.read_rows(0, "obs/image", 650, 51).is_err());
        let some = source.read_demo_where(0, &|key| key != "obs/image").unwrap();
        assert!(!some.datasets.contains_key("obs/image") && some.datasets.contains_key("actions"));
    }
}

#[test]
fn not_there_not_hdf5_empty_truncated() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("x.hdf5");
    assert_eq!(input_error(Source::open(&path)), InputError::NotFound { path: path.clone() });
    std::fs::write(&path, "PAR1 is not it").unwrap();
    let error = input_error(Source::open(&path));
    assert!(
        error
            .to_string()
            .ends_with("not an HDF5 file: expected the HDF5 signature, found the bytes 50 41 52 31 20 69 73 20"),
        "{error}"
    );
    std::fs::write(&path, "").unwrap();
    assert!(matches!(input_error(Source::open(&path)), InputError::NotHdf5 { .. }));
    let whole = std::fs::read(fixture("lift_low_dim_3_demos.hdf5")).unwrap();
    std::fs::write(&path, &whole[..200_000]).unwrap();
    let (expected, found) = (whole.len() as u64, 200_000);
    assert_eq!(input_error(Source::open(&path)), InputError::Truncated { path, expected, found });
}

#[test]
fn what_is_no_regular_file_is_refused_at_once() {
    let error = input_error(Source::open(Path::new("/dev/null")));
    assert!(matches!(&error, InputError::Unreadable { reason, .. } if reason == "not a regular file"), "{error}");
}

#[test]
fn a_folder_of_data_sets_and_a_data_set_say_what_to_name_instead() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::create_dir_all(dir.path().join("sets/lift/meta")).unwrap();
    std::fs::write(dir.path().join("sets/lift/meta/info.json"), "{}").unwrap();
    for (folder, end) in [
        ("", "folder of HDF5 files with one episode each; found sets"),
        ("sets", "expected one data set: name one of its folders; found lift"),
        ("sets/lift", "`convert --to robomimic` writes HDF5"),
    ] {
        let error = input_error(Source::open(&dir.path().join(folder))).to_string();
        assert!(error.ends_with(end), "{error}");
    }
}

#[test]
fn no_data_group_and_no_demos() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("x.hdf5");
    let file = hdf5::File::create(&path).unwrap();
    file.create_group("results").unwrap();
    file.close().unwrap();
    let error = input_error(Source::open(&path));
    assert!(matches!(error, InputError::UnknownLayout { .. }), "{error}");
    assert!(error.to_string().ends_with("found results/"), "{error}");
    std::fs::remove_file(&path).unwrap();
    let file = hdf5::File::create(&path).unwrap();
    file.create_group("data").unwrap().create_group("episode_a").unwrap();
    file.close().unwrap();
    let error = input_error(Source::open(&path));
    assert_eq!(error, InputError::NoDemos { path, found: "episode_a".to_owned() });
}

#[test]
fn missing_actions_and_missing_obs() {
    let mut without = small_demo("demo_1", 3);
    without.datasets.remove("actions");
    let (_dir, path) = saved(&[small_demo("demo_0", 3), without], |_| {});
    let source = Source::open(&path).unwrap();
    assert!(source.read_demo(0).is_ok());
    let error = input_error(source.read_demo(1));
    let found = "dones, obs/object, rewards".to_owned();
    let (demo, key) = ("demo_1".to_owned(), "actions".to_owned());
    assert_eq!(error, InputError::MissingKey { path, demo, key, found });
    assert_eq!(source.plan().problems[0].error, error, "inspect sees it without reading");

    let mut without = small_demo("demo_0", 3);
    without.datasets.remove("obs/object");
    let (_dir, path) = saved(&[without], |_| {});
    let error = input_error(Source::open(&path).unwrap().read_demo(0));
    assert!(matches!(&error, InputError::MissingKey { key, .. } if key == "obs"), "{error}");
}

#[test]
fn wrong_length_and_wrong_num_samples() {
    let mut demo = small_demo("demo_0", 5);
    demo.datasets.insert("obs/object".to_owned(), Array::from_f64(vec![4, 3], &[0.0; 12]));
    let (_dir, path) = saved(&[demo], |_| {});
    let error = input_error(Source::open(&path).unwrap().read_demo(0));
    assert!(error.to_string().ends_with("demo_0: obs/object: expected 5 steps, found shape [4, 3]"), "{error}");

    let mut demo = small_demo("demo_0", 5);
    demo.attrs.insert("num_samples".to_owned(), Array::from_i32(vec![], &[6]));
    let (_dir, path) = saved(&[demo], |_| {});
    let error = input_error(Source::open(&path).unwrap().read_demo(0));
    assert!(
        error.to_string().ends_with("demo_0: actions: expected 6 (num_samples) steps, found shape [5, 7]"),
        "{error}"
    );
    let plan = Source::open(&path).unwrap().plan().clone();
    assert!(plan.problems.iter().any(|p| p.fatal && p.key.is_none()), "{:?}", plan.problems);
}

#[test]
fn what_belongs_to_no_demo_and_is_too_large_is_named() {
    let (_dir, path) = saved(&[small_demo("demo_0", 3)], |_| {});
    let file = hdf5::File::open_rw(&path).unwrap();
    let (size, block) = (200_usize << 20, 8_usize << 20);
    let large = file.new_dataset_builder().chunk((block,)).empty::<u8>().shape((block..,)).create("large").unwrap();
    large.write_raw(&vec![7_u8; block]).unwrap();
    large.resize((size,)).unwrap();
    drop(large);
    file.close().unwrap();
    let source = Source::open(&path).unwrap();
    let error = input_error(source.root()).to_string();
    assert!(error.contains("large and what else") && error.contains("--no-lossless"), "{error}");
    source.data_attrs().unwrap();
}

#[test]
fn nan_in_actions_is_refused_with_its_place() {
    let mut demo = small_demo("demo_0", 5);
    let mut values = demo.datasets["actions"].to_f64().unwrap();
    values[3 * 7 + 2] = f64::NAN;
    demo.datasets.insert("actions".to_owned(), Array::from_f64(vec![5, 7], &values));
    let (_dir, path) = saved(&[demo], |_| {});
    let error = input_error(Source::open(&path).unwrap().read_demo(0));
    assert!(
        error.to_string().ends_with("demo_0: actions: step 3, dimension 2: expected a finite number, found NaN"),
        "{error}"
    );
}

#[test]
fn ragged_keys_masks_and_totals_are_problems_not_failures() {
    let mut other = small_demo("demo_1", 3);
    other.datasets.insert("obs/extra".to_owned(), Array::from_f32(vec![3, 2], &[0.0; 6]));
    other.datasets.insert("obs/object".to_owned(), Array::from_f32(vec![3, 4], &[0.0; 12]));
    let (_dir, path) = saved(&[small_demo("demo_0", 3), other], |root| {
        root.datasets.insert("mask/train".to_owned(), Array::from_fixed_strings(&["demo_0", "demo_7"]));
        root.inner_attrs.get_mut("data").unwrap().insert("total".to_owned(), Array::from_i64(vec![], &[9]));
    });
    let source = Source::open(&path).unwrap();
    assert_eq!(source.plan().notes, ["mask/train: 1 of the 2 demos it names are not in the file: demo_7"]);
    let messages: Vec<_> = source.plan().problems.iter().map(|p| p.message.split_once("hdf5: ").unwrap().1).collect();
    assert_eq!(
        messages,
        [
            "data: attribute total: expected 6, the steps of all demos, found 9",
            "demo_1: obs/object: expected float64 [3] per step as in demo_0, found float32 [4] per step",
            "demo_0: no obs/extra; found it in demo_1; here actions, dones, obs/object, rewards",
        ]
    );
    assert!(source.read_demo(0).is_ok() && source.read_demo(1).is_ok());
}
