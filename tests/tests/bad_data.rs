//! Bad demonstrations: each kind gives one clear line (what, where, expected, found), a non-zero exit code, and leaves
//! nothing half-written.

use std::fs;
use std::path::{Path, PathBuf};

use e2e::{data, lift, listing, refused, succeeds, text, train_lift};
use tempfile::TempDir;

/// A folder with a damaged copy of the shipped demonstrations, `bad.hdf5`.
fn damaged(damage: impl FnOnce(&Path)) -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let file = folder.path().join("bad.hdf5");
    fs::copy(lift(), &file).expect("the shipped demonstrations are there");
    damage(&file);
    (folder, file)
}

/// As [`damaged`], with the copy opened as HDF5.
fn edited(edit: impl FnOnce(&hdf5::Group)) -> (TempDir, PathBuf) {
    damaged(|path| {
        let file = hdf5::File::open_rw(path).expect("the copy opens");
        edit(&file.group("data").expect("there is a data group"));
        file.close().expect("the copy closes");
    })
}

/// Replace a data set by other values.
fn replace(group: &hdf5::Group, name: &str, values: &[f64], shape: [usize; 2]) {
    group.unlink(name).expect("the old one goes");
    let data = group.new_dataset::<f64>().shape(shape).create(name).expect("the new one comes");
    data.write_raw(values).expect("it takes its values");
}

/// Converting the file is refused with `words`, and nothing is left beside it.
fn convert_refused((folder, file): (TempDir, PathBuf), words: &[&str]) {
    let before = fs::read(&file).expect("readable");
    let out = folder.path().join("out");
    let line = refused(&mut data(["convert", text(&file), text(&out)]), words);
    assert!(line.contains("bad.hdf5"), "the file is not named: {line}");
    assert_eq!(listing(folder.path()), ["bad.hdf5"]);
    assert!(fs::read(&file).expect("readable") == before, "the source is untouched");
}

#[test]
fn truncated() {
    convert_refused(
        damaged(|path| {
            let bytes = fs::read(path).expect("readable");
            fs::write(path, &bytes[..bytes.len() * 2 / 3]).expect("writable");
        }),
        &["truncated"],
    );
}

#[test]
fn a_demo_with_a_missing_key() {
    convert_refused(
        edited(|demos| demos.group("demo_3").expect("there").unlink("obs/robot0_eef_pos").expect("there")),
        &["demo_3", "robot0_eef_pos"],
    );
}

#[test]
fn nan_in_actions() {
    convert_refused(
        edited(|demos| {
            let demo = demos.group("demo_11").expect("there");
            let mut values = demo.dataset("actions").expect("there").read_raw::<f64>().expect("readable");
            let length = values.len() / 7;
            values[7 * 4 + 2] = f64::NAN;
            replace(&demo, "actions", &values, [length, 7]);
        }),
        &["demo_11", "actions", "NaN"],
    );
}

#[test]
fn masks_that_name_demos_which_are_not_there() {
    // as robomimic's `dataset_states_to_obs --n 5` leaves a file: the first demos, and the masks of them all
    let (folder, file) = edited(|demos| {
        let ids = demos.member_names().expect("listable");
        let mut numbers: Vec<u32> = ids.iter().filter_map(|id| id.strip_prefix("demo_")?.parse().ok()).collect();
        numbers.sort_unstable();
        for number in &numbers[5..] {
            demos.unlink(&format!("demo_{number}")).expect("there");
        }
        let lengths = numbers[..5].iter().map(|n| {
            let demo = demos.group(&format!("demo_{n}")).expect("there");
            demo.attr("num_samples").expect("there").read_scalar::<i64>().expect("a number")
        });
        let total: i64 = lengths.sum();
        demos.attr("total").expect("there").write_scalar(&total).expect("writable");
    });
    let at = |name: &str| folder.path().join(name);
    let told = succeeds(&mut data(["convert", text(&file), text(&at("set"))]));
    let told = String::from_utf8_lossy(&told.stdout).into_owned() + &String::from_utf8_lossy(&told.stderr);
    assert!(told.contains("mask/train: ") && told.contains(" demos it names are not in the file"), "{told}");
    succeeds(&mut data(["validate", text(&at("set"))]));
    train_lift(&at("set"), &at("zoo"), &at("runs"));
    succeeds(&mut data(["export", text(&at("set")), text(&at("again.hdf5"))]));
    let masks = |path: &Path| {
        let group = hdf5::File::open(path).expect("it opens").group("mask").expect("there are masks");
        let names = group.member_names().expect("listable");
        let read = |name: &String| {
            let mask = group.dataset(name).expect("there");
            let ids = mask.read_raw::<hdf5::types::FixedAscii<64>>().expect("names of demos");
            (name.clone(), mask.dtype().expect("a type").size(), ids)
        };
        names.iter().map(read).collect::<Vec<_>>()
    };
    let (before, after) = (masks(&file), masks(&at("again.hdf5")));
    assert_eq!(before, after);
    assert!(before.iter().map(|(_, _, ids)| ids.len()).sum::<usize>() > 5, "{before:?}");
}

#[test]
fn an_output_folder_that_exists() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let out = folder.path().join("out");
    fs::create_dir(&out).expect("creatable");
    fs::write(out.join("precious.txt"), "mine").expect("writable");
    refused(&mut data(["convert", text(&lift()), text(&out)]), &["out", "exists"]);
    assert_eq!(listing(&out), ["precious.txt"]);
    assert_eq!(listing(folder.path()), ["out"]);
}

#[test]
fn an_unknown_task() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let out = folder.path().join("x.hdf5");
    refused(
        &mut data(["collect", "--task", "Lfit", "--episodes", "1", "--seed", "1", "--out", text(&out)]),
        &["Lfit", "Lift"],
    );
    assert!(listing(folder.path()).is_empty());
}

#[test]
fn a_converted_data_set_is_valid_and_exports_its_source() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (set, again) = (folder.path().join("lift"), folder.path().join("again.hdf5"));
    succeeds(&mut data(["convert", text(&lift()), text(&set)]));
    succeeds(&mut data(["validate", text(&set)]));
    succeeds(&mut data(["export", text(&set), text(&again)]));
    succeeds(&mut data(["validate", text(&again)]));
    refused(&mut data(["validate", text(&again), "--tolerance", "1"]), &["--tolerance belongs to a data set"]);
    assert_eq!(listing(folder.path()), ["again.hdf5", "lift"]);
}
