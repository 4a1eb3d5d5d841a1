#![allow(clippy::unwrap_used)]
//! Every dialect from a small file of its kind, made with libhdf5 as its own tools make them.

use std::path::Path;

use hdf5::types::VarLenUnicode;
use hdf5::{File, Group};

use super::*;
use crate::plan::Dialect;

fn text(group: &Group, name: &str, value: &str) {
    let value: VarLenUnicode = value.parse().unwrap();
    group.new_attr::<VarLenUnicode>().create(name).unwrap().write_scalar(&value).unwrap();
}

fn floats(group: &Group, name: &str, shape: &[usize]) {
    let values: Vec<f32> = (0..shape.iter().product()).map(|i| i as f32 * 0.5).collect();
    let dataset = group.new_dataset::<f32>().shape(shape.to_vec()).create(name).unwrap();
    dataset.write_raw(&values).unwrap();
}

fn bytes(group: &Group, name: &str, shape: &[usize], value: impl Fn(usize) -> u8) {
    let values: Vec<u8> = (0..shape.iter().product()).map(value).collect();
    group.new_dataset::<u8>().shape(shape.to_vec()).create(name).unwrap().write_raw(&values).unwrap();
}

/// `data/demo_<k>` with what every robomimic-like file has.
fn demo(file: &File, number: usize, steps: usize) -> Group {
    let data = file.group("data").or_else(|_| file.create_group("data")).unwrap();
    let demo = data.create_group(&format!("demo_{number}")).unwrap();
    demo.new_attr::<i64>().create("num_samples").unwrap().write_scalar(&(steps as i64)).unwrap();
    floats(&demo, "actions", &[steps, 7]);
    floats(&demo, "rewards", &[steps]);
    bytes(&demo, "dones", &[steps], |i| u8::from(i + 1 == steps));
    let obs = demo.create_group("obs").unwrap();
    floats(&obs, "ee_pos", &[steps, 3]);
    demo
}

fn made(make: impl FnOnce(&File)) -> (tempfile::TempDir, Source) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("some.hdf5");
    let file = File::create(&path).unwrap();
    make(&file);
    file.close().unwrap();
    let source = Source::open(&path).unwrap();
    (dir, source)
}

#[test]
fn libero_has_its_instruction_and_orientation() {
    let (_dir, source) = made(|file| {
        let one = demo(file, 0, 4);
        bytes(&one.group("obs").unwrap(), "agentview_rgb", &[4, 8, 8, 3], |i| i as u8);
        let data = file.group("data").unwrap();
        text(&data, "problem_info", r#"{"language_instruction": "\"open the drawer\"", "problem_name": "x"}"#);
        text(&data, "bddl_file_name", "a.bddl");
        text(&data, "env_name", "Libero_Tabletop");
    });
    let plan = source.plan();
    assert_eq!(plan.dialect, Dialect::Libero);
    assert_eq!(plan.demos[0].task.as_deref(), Some("open the drawer"));
    assert_eq!(plan.env_name.as_deref(), Some("Libero_Tabletop"));
    assert!(plan.notes[0].contains("OpenGL"));
    assert!(plan.problems.is_empty(), "{:?}", plan.problems);
    assert_eq!(source.read_demo(0).unwrap().datasets["obs/agentview_rgb"].bytes[5], 5);
    // the task's suite is the folder of its problem
    let (_dir, source) = made(|file| {
        demo(file, 0, 4);
        let data = file.group("data").unwrap();
        text(&data, "bddl_file_name", "/home/me/bddl_files/libero_goal/open.bddl");
        text(&data, "env_args", r#"{"env_name": "Libero_Tabletop_Manipulation", "type": 1, "env_kwargs": {}}"#);
    });
    assert_eq!(source.plan().env_name.as_deref(), Some("libero_goal"));
}

#[test]
fn robocasa_has_a_task_for_each_demo() {
    let (_dir, source) = made(|file| {
        for (number, lang) in [(0, "pick the apple"), (1, "open the door")] {
            let one = demo(file, number, 3);
            text(&one, "ep_meta", &format!(r#"{{"lang": "{lang}", "layout_id": 2, "style_id": 5}}"#));
        }
    });
    assert_eq!(source.plan().dialect, Dialect::Robocasa);
    let tasks: Vec<_> = source.plan().demos.iter().map(|d| d.task.as_deref().unwrap()).collect();
    assert_eq!(tasks, ["pick the apple", "open the door"]);
}

#[test]
fn mimicgen_keeps_its_nested_groups() {
    let (_dir, source) = made(|file| {
        let one = demo(file, 0, 3);
        let info = one.create_group("datagen_info").unwrap();
        floats(&info, "eef_pose", &[3, 4, 4]);
        floats(&info.create_group("object_poses").unwrap(), "cube", &[3, 4, 4]);
        one.new_dataset::<i64>().shape([2]).create("src_demo_inds").unwrap().write_raw(&[4, 5]).unwrap();
    });
    assert_eq!(source.plan().dialect, Dialect::Mimicgen);
    let one = source.read_demo(0).unwrap();
    assert_eq!(one.datasets["datagen_info/object_poses/cube"].shape, [3, 4, 4]);
    assert_eq!(one.datasets["src_demo_inds"].to_f64().unwrap(), [4.0, 5.0]);
}

#[test]
fn isaac_lab_nests_observations_and_states() {
    let (_dir, source) = made(|file| {
        let one = demo(file, 0, 3);
        let obs = one.group("obs").unwrap();
        floats(&obs.create_group("datagen_info").unwrap(), "object_pose", &[3, 4, 4]);
        let initial = one.create_group("initial_state").unwrap();
        floats(&initial.create_group("articulation").unwrap(), "joint_position", &[1, 9]);
        floats(&one.create_group("states").unwrap(), "joint_position", &[3, 9]);
    });
    assert_eq!(source.plan().dialect, Dialect::IsaacLab);
    let one = source.read_demo(0).unwrap();
    assert_eq!(one.datasets["obs/datagen_info/object_pose"].shape, [3, 4, 4]);
    assert_eq!(one.datasets["initial_state/articulation/joint_position"].shape, [1, 9]);
}

#[test]
fn d4rl_is_cut_at_terminals_and_timeouts() {
    let (_dir, source) = made(|file| {
        floats(file, "observations", &[10, 4]);
        let unit: VarLenUnicode = "m".parse().unwrap();
        let observations = file.dataset("observations").unwrap();
        observations.new_attr::<VarLenUnicode>().create("unit").unwrap().write_scalar(&unit).unwrap();
        floats(file, "actions", &[10, 2]);
        floats(file, "rewards", &[10]);
        bytes(file, "terminals", &[10], |i| u8::from(i == 2));
        bytes(file, "timeouts", &[10], |i| u8::from(i == 6));
        floats(&file.create_group("infos").unwrap(), "qpos", &[10, 3]);
        floats(&file.create_group("metadata").unwrap(), "weights", &[5, 5]);
    });
    let plan = source.plan();
    assert_eq!(plan.dialect, Dialect::D4rl);
    let lengths: Vec<_> = plan.demos.iter().map(|d| d.length).collect();
    assert_eq!(lengths, [3, 4]);
    assert!(plan.notes[0].contains("last 3 steps"), "{:?}", plan.notes);
    let of_run = &source.read_demo(0).unwrap().inner_attrs["obs/flat"]["unit"];
    assert_eq!(of_run.to_text().as_deref(), Some("m"));
    let second = source.read_demo(1).unwrap();
    let expected: Vec<f64> = (3 * 4..7 * 4).map(|i| f64::from(i) * 0.5).collect();
    assert_eq!(second.datasets["obs/flat"].to_f64().unwrap(), expected);
    assert_eq!(second.datasets["infos/qpos"].shape, [4, 3]);
    assert_eq!(second.datasets["dones"].bytes, [0, 0, 0, 0]);
    assert_eq!(source.read_rows(1, "actions", 1, 2).unwrap().to_f64().unwrap(), [4.0, 4.5, 5.0, 5.5]);
    let root = source.root().unwrap();
    assert_eq!(root.datasets.keys().collect::<Vec<_>>(), ["metadata/weights"]);
}

#[test]
fn d4rl_arrays_of_another_length_are_named() {
    let run = |observed: usize| {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("run.hdf5");
        let file = File::create(&path).unwrap();
        floats(&file, "observations", &[observed, 4]);
        floats(&file, "actions", &[10, 2]);
        floats(&file, "rewards", &[9]);
        bytes(&file, "terminals", &[10], |i| u8::from(i == 9));
        file.close().unwrap();
        Source::open(&path).map(|source| source.plan().notes.clone()).map_err(|e| e.to_string())
    };
    assert!(run(10).unwrap()[0].starts_with("rewards has 9 rows where actions has 10"), "{:?}", run(10));
    let error = run(8).unwrap_err();
    assert!(error.ends_with("by observations: expected 10 steps, as actions has, found shape [8, 4]"), "{error}");
}

fn episode(path: &Path, steps: usize) {
    let file = File::create(path).unwrap();
    file.new_attr::<bool>().create("sim").unwrap().write_scalar(&true).unwrap();
    floats(&file, "action", &[steps, 14]);
    let observations = file.create_group("observations").unwrap();
    floats(&observations, "qpos", &[steps, 14]);
    floats(&observations, "qvel", &[steps, 14]);
    bytes(&observations.create_group("images").unwrap(), "top", &[steps, 6, 8, 3], |i| i as u8);
    file.close().unwrap();
}

#[test]
fn a_folder_of_aloha_episodes_is_one_data_set() {
    let dir = tempfile::tempdir().unwrap();
    for (number, steps) in [(0, 3), (2, 5), (10, 4)] {
        episode(&dir.path().join(format!("episode_{number}.hdf5")), steps);
    }
    std::fs::write(dir.path().join("README.txt"), "not an episode").unwrap();
    let source = Source::open(dir.path()).unwrap();
    assert_eq!(source.plan().dialect, Dialect::Aloha);
    let demos: Vec<_> = source.plan().demos.iter().map(|d| (d.id.as_str(), d.length)).collect();
    assert_eq!(demos, [("demo_0", 3), ("demo_2", 5), ("demo_10", 4)]);
    assert!(source.plan().demos[0].keys["obs/images/top"].is_image());
    let last = source.read_demo(2).unwrap();
    assert_eq!(last.datasets["actions"].shape, [4, 14]);
    assert_eq!(last.attrs["sim"].bytes, [1]);
    // an episode that was stopped before its first step
    episode(&dir.path().join("episode_3.hdf5"), 0);
    let problems = Source::open(dir.path()).unwrap().plan().problems.clone();
    assert!(problems[0].message.ends_with("demo_3: action: expected at least 1 steps, found 0: the demo is empty"));
    // one file of them is a data set of one demo
    let one = Source::open(&dir.path().join("episode_2.hdf5")).unwrap();
    assert_eq!(one.plan().demos.len(), 1);
    assert_eq!(one.read_demo(0).unwrap().datasets["obs/qpos"].shape, [5, 14]);
}

#[test]
fn a_folder_without_episodes_says_what_is_there() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("notes.txt"), "x").unwrap();
    let error = Source::open(dir.path()).unwrap_err().to_string();
    assert!(error.ends_with("found notes.txt"), "{error}");
}

#[test]
fn an_unknown_file_is_told_what_was_expected_and_found() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("weather.h5");
    let file = File::create(&path).unwrap();
    floats(&file, "temperature", &[4]);
    file.create_group("stations").unwrap();
    file.close().unwrap();
    let error = Source::open(&path).unwrap_err().to_string();
    assert!(error.contains("(robomimic)") && error.contains("(ALOHA, ACT)"), "{error}");
    assert!(error.ends_with("found stations/, temperature"), "{error}");
}

#[test]
fn links_out_of_the_file_are_not_followed() {
    let (_dir, source) = made(|file| {
        let one = demo(file, 0, 3);
        one.link_external("/etc/passwd", "/", "secret").unwrap();
    });
    let problem = &source.plan().problems[0];
    let words = "data/demo_0/secret cannot be read: a link to the file /etc/passwd, which cannot be opened";
    assert!(problem.message.contains(words), "{problem:?}");
    assert!(source.read_demo_where(0, &|key| key != "secret").is_ok());
}

#[test]
fn a_group_that_contains_itself_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("loop.hdf5");
    let file = File::create(&path).unwrap();
    let one = demo(&file, 0, 3);
    one.link_hard("/data", "again").unwrap();
    drop(one);
    file.close().unwrap();
    let error = Source::open(&path).unwrap_err().to_string();
    assert!(error.contains("contains itself"), "{error}");
}

#[test]
fn lzf_and_odd_blocks_are_read() {
    let values: Vec<f64> = (0..50 * 7).map(f64::from).collect();
    let (_dir, source) = made(|file| {
        let one = demo(file, 0, 50);
        let packed = one.group("obs").unwrap().new_dataset_builder().chunk((7, 3)).shuffle().lzf();
        packed.empty::<f64>().shape((50, 7)).create("packed").unwrap().write_raw(&values).unwrap();
    });
    assert_eq!(source.plan().demos[0].keys["obs/packed"].block_rows, 7);
    assert_eq!(source.read_demo(0).unwrap().datasets["obs/packed"].to_f64().unwrap(), values);
    let rows = source.read_rows(0, "obs/packed", 5, 40).unwrap().to_f64().unwrap();
    assert_eq!(rows, values[5 * 7..45 * 7]);
}

#[test]
fn a_type_that_cannot_be_carried_is_a_fault_of_its_dataset_only() {
    let (_dir, source) = made(|file| {
        let one = demo(file, 0, 3);
        let list = one.new_dataset::<hdf5::types::VarLenArray<f32>>().shape([3]).create("ragged").unwrap();
        drop(list);
    });
    let error = source.read_demo(0).unwrap_err().to_string();
    assert!(error.ends_with("data/demo_0/ragged: the type [float32] (var len) is not supported"), "{error}");
    assert!(source.read_demo_where(0, &|key| key != "ragged").is_ok());
}

#[test]
fn packed_byte_strings_keep_their_zero_bytes() {
    let picture = include_bytes!("../../tests/fixtures/jpeg/0.jpg");
    let make = |group: &Group, name: &str, width: usize, bytes: Vec<u8>| {
        let array = Array { dtype: crate::tree::Dtype::FixedStr(width), shape: vec![bytes.len() / width], bytes };
        let dtype = super::value::descriptor_of(&array.dtype).unwrap();
        let dataset = group.new_dataset_builder().chunk(2).deflate(3).empty_as(&dtype).shape(3).create(name).unwrap();
        super::value::write(&dataset, &array).unwrap();
        array
    };
    let mut written = Vec::new();
    let (_dir, source) = made(|file| {
        let one = demo(file, 0, 3);
        written.push(make(&one, "tags", 5, b"\x01\0\x02\0\x03".repeat(3)));
        written.push(make(&one.group("obs").unwrap(), "front_image", picture.len(), picture.repeat(3)));
    });
    let read = source.read_demo(0).unwrap();
    assert_eq!(read.datasets["tags"], written[0]);
    assert_eq!(source.read_rows(0, "tags", 1, 2).unwrap().bytes, b"\x01\0\x02\0\x03".repeat(2));
    let pictures = &read.datasets["obs/front_image"];
    assert_eq!((&pictures.shape[..], &pictures.bytes), (&[3, picture.len()][..], &written[1].bytes));
}

#[test]
fn attributes_of_odd_types_are_left_out_with_a_note() {
    let (_dir, source) = made(|file| {
        for number in 0..2 {
            let one = demo(file, number, 3);
            let ragged = one.dataset("actions").unwrap().new_attr::<hdf5::types::VarLenArray<f32>>().shape([1]);
            ragged.create("DIMENSION_LIST").unwrap();
            text(&one, "note", "kept");
        }
    });
    let expected = "attribute DIMENSION_LIST of data/demo_0/actions and 1 more is left out: \
        the type [float32] (var len) is not supported";
    assert_eq!(source.plan().notes, [expected]);
    let read = source.read_demo(1).unwrap();
    assert_eq!((read.attrs["note"].to_text().as_deref(), read.inner_attrs["actions"].len()), (Some("kept"), 0));
}

#[test]
fn members_that_look_like_demos_are_named() {
    let (_dir, source) = made(|file| {
        demo(file, 0, 3);
        let data = file.group("data").unwrap();
        for name in ["Demo_3", "demo_1_fixed", "demo_99999999999999999999"] {
            floats(&data.create_group(name).unwrap(), "actions", &[3, 7]);
        }
        floats(&data, "demo_5", &[3]);
        data.create_group("statistics").unwrap();
    });
    let expected = "not read as demos (a demo is a group named demo_ and a whole number below 2^64): data/Demo_3, \
        data/demo_1_fixed, data/demo_5, data/demo_99999999999999999999";
    assert_eq!(source.plan().notes, [expected]);
    assert_eq!(source.plan().demos.len(), 1);
}

#[test]
fn a_shape_without_elements_behind_it_is_refused() {
    let (_dir, source) = made(|file| {
        let one = demo(file, 0, 3);
        let huge = one.new_dataset_builder().chunk((1, 1024)).empty::<f64>().shape((1 << 40, 1024));
        huge.create("huge").unwrap();
    });
    let error = source.read_demo(0).unwrap_err().to_string();
    assert!(error.contains("data/demo_0/huge") && error.contains("bytes stated"), "{error}");
}

#[test]
fn numbers_of_another_byte_order_are_read_and_noted() {
    // the types in the file are turned to big-endian, as another machine writes them
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("some.hdf5");
    // the oldest format has no checksums over the bytes that are changed here
    let file = File::with_options().with_fapl(|p| p.libver_earliest()).create(&path).unwrap();
    demo(&file, 0, 3);
    file.close().unwrap();
    let source = Source::open(&path).unwrap();
    let key = source.plan().demos[0].keys["obs/ee_pos"].clone();
    let mut bytes = std::fs::read(&path).unwrap();
    // IEEE little-endian float32 in a datatype message: class 1 version 1, bit fields 20 1f 00, size 4
    let little = [0x11, 0x20, 0x1f, 0x00, 4, 0, 0, 0, 0, 0, 32, 0, 23, 8, 0, 23, 127, 0, 0, 0];
    let at: Vec<usize> = (0..bytes.len() - 20).filter(|&i| bytes[i..i + 20] == little).collect();
    assert_eq!(at.len(), 3, "actions, rewards, ee_pos");
    for at in at {
        bytes[at + 1] |= 1;
    }
    for (name, count) in [("actions", 21), ("rewards", 3), ("obs/ee_pos", 9)] {
        let offset = source.plan().demos[0].keys[name].place.offset.unwrap() as usize;
        bytes[offset..offset + count * 4].chunks_exact_mut(4).for_each(<[u8]>::reverse);
    }
    let before = source.read_demo(0).unwrap();
    drop(source); // libhdf5 keeps what it knows of a file that is open
    std::fs::write(&path, bytes).unwrap();
    let source = Source::open(&path).unwrap();
    assert_eq!(source.read_demo(0).unwrap(), before);
    assert_eq!(source.plan().demos[0].keys["obs/ee_pos"].shape, key.shape);
    assert!(source.plan().notes[0].ends_with("data/demo_0/actions, data/demo_0/obs/ee_pos, data/demo_0/rewards"));
}

#[test]
fn files_of_one_number_get_others_and_a_stray_file_takes_none() {
    let dir = tempfile::tempdir().unwrap();
    for name in ["episode_0", "mirror_episode_0", "episode_1"] {
        episode(&dir.path().join(format!("{name}.hdf5")), 3);
    }
    let file = File::create(dir.path().join("weather_1.hdf5")).unwrap();
    floats(&file, "temperature", &[4]);
    file.close().unwrap();
    let source = Source::open(dir.path()).unwrap();
    let ids: Vec<_> = source.plan().demos.iter().map(|d| d.id.as_str()).collect();
    assert_eq!(ids, ["demo_0", "demo_1", "demo_2"]);
    let told = "mirror_episode_0.hdf5 is demo_1, episode_1.hdf5 is demo_2";
    assert!(source.plan().notes.iter().any(|note| note.ends_with(told)), "{:?}", source.plan().notes);
    assert_eq!(source.plan().problems[0].demo.as_deref(), Some("weather_1.hdf5"));
}

#[test]
fn files_at_several_depths_are_not_left_out_in_silence() {
    let dir = tempfile::tempdir().unwrap();
    for folder in ["a", "b/c"] {
        std::fs::create_dir_all(dir.path().join(folder)).unwrap();
    }
    episode(&dir.path().join("a/episode_0.hdf5"), 3);
    assert_eq!(Source::open(dir.path()).unwrap().plan().demos.len(), 1);
    episode(&dir.path().join("b/c/episode_1.hdf5"), 3);
    let error = Source::open(dir.path()).unwrap_err().to_string();
    assert!(error.ends_with("found a/episode_0.hdf5, and deeper b/c/episode_1.hdf5"), "{error}");
}
