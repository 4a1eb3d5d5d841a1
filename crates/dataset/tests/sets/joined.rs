//! Folders of robomimic files, which are one source: what they may differ in, and what each demo keeps.
#![allow(clippy::unwrap_used)]

use super::unclean::{changed, demo, options, quiet, write_of};
use dataset::{ConvertOptions, Dataset, Demo, convert};
use std::path::PathBuf;

/// Two files in a folder of their own, with these arguments and masks.
fn two_files(of_env: [&str; 2], masks: [&[(&str, &[&str])]; 2]) -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().join("files");
    std::fs::create_dir(&folder).unwrap();
    let all: Vec<Demo> = (0..4).map(demo).collect();
    write_of(of_env[0], &folder.join("a.hdf5"), &all, masks[0]);
    write_of(of_env[1], &folder.join("b.hdf5"), &all[..2], masks[1]);
    (dir, folder)
}

#[test]
fn masks_of_several_files_name_their_own_demos_alone() {
    let of_a: &[(&str, &[&str])] = &[("train", &["demo_0", "demo_1"]), ("valid", &["demo_2", "demo_3"])];
    let (dir, folder) = two_files(["{}"; 2], [of_a, &[("train", &["demo_0", "demo_3"])]]);
    let report = convert(&folder, &dir.path().join("set"), &options(), &mut quiet).unwrap();
    let set = Dataset::open(&dir.path().join("set")).unwrap();
    assert_eq!((set.split("train").unwrap(), set.split("valid").unwrap()), (vec![0, 1, 4], vec![2, 3]));
    for expected in [
        "mask/train: 1 of the 2 demos it names are not in the file: b.hdf5 demo_3",
        "the demos of b.hdf5 are in none of the other files' mask/valid",
    ] {
        assert!(report.notes.iter().any(|note| note == expected), "{:?}", report.notes);
    }
}

#[test]
fn files_that_differ_in_what_columns_are_made_by_are_not_joined() {
    let (dir, folder) = two_files([r#"{"control_freq": 50}"#, r#"{"control_freq": 40}"#], [&[], &[]]);
    let set = dir.path().join("set");
    let none = ConvertOptions { fps: None, ..options() };
    let text = convert(&folder, &set, &none, &mut quiet).unwrap_err().to_string();
    assert!(text.contains("control_freq") && text.ends_with("50 in a.hdf5, 40 in b.hdf5"), "{text}");
    // the rate is given; each demo keeps the name of its own task
    for (file, name) in [("a.hdf5", "Lift"), ("b.hdf5", "Stack")] {
        changed(&folder.join(file), |data| {
            data.delete_attr("env_args").unwrap();
            let kwargs = if name == "Lift" { r#"{"control_freq": 50}"# } else { r#"{"control_freq": 40}"# };
            let env = format!(r#"{{"env_name": "{name}", "type": 1, "env_kwargs": {kwargs}}}"#);
            crate::made::text(data, "env_args", &env);
        });
    }
    let report = convert(&folder, &set, &options(), &mut quiet).unwrap();
    assert_eq!((&report.tasks[..], report.episodes), (&["Lift", "Stack"].map(String::from)[..], 6));

    let (dir, folder) = two_files([r#"{"reward_shaping": true}"#, "{}"], [&[], &[]]);
    let text = convert(&folder, &dir.path().join("set"), &options(), &mut quiet).unwrap_err().to_string();
    assert!(text.contains("reward_shaping") && text.ends_with("true in a.hdf5, false in b.hdf5"), "{text}");
    let (dir, folder) = two_files([r#"{"control_freq": 50}"#, r#"{"control_freq": 50.0}"#], [&[], &[]]);
    convert(&folder, &dir.path().join("set"), &none, &mut quiet).unwrap();
    assert_eq!(Dataset::open(&dir.path().join("set")).unwrap().info().fps, 50.0);
}
