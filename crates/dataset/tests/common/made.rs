//! Small recordings of each layout, as its own recorder writes them.
#![allow(clippy::unwrap_used, dead_code, reason = "each test uses a part")]

use hdf5::types::{FixedAscii, VarLenArray, VarLenUnicode};
use hdf5::{File, Group};
use std::path::{Path, PathBuf};

/// A JPEG file of 18 x 26 pixels that holds zero bytes.
pub fn jpeg(which: usize) -> Vec<u8> {
    let name = format!("tests/fixtures/jpeg/{which}.jpg");
    std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join(name)).unwrap()
}

/// The value of a dataset at a place: other ones for every dataset.
pub fn value(seed: usize, at: usize) -> f32 {
    seed as f32 * 1000.0 + at as f32 * 0.25
}

pub fn text(group: &Group, name: &str, value: &str) {
    let value: VarLenUnicode = value.parse().unwrap();
    group.new_attr::<VarLenUnicode>().create(name).unwrap().write_scalar(&value).unwrap();
}

pub fn number(group: &Group, name: &str, value: i64) {
    group.new_attr::<i64>().create(name).unwrap().write_scalar(&value).unwrap();
}

/// The group at a path, made where it is not there.
pub fn group(file: &Group, path: &str) -> Group {
    path.split('/').fold(file.clone(), |at, name| at.group(name).or_else(|_| at.create_group(name)).unwrap())
}

/// A dataset at a path, packed where it is large.
pub fn floats(file: &Group, path: &str, shape: &[usize], seed: usize) {
    let values: Vec<f32> = (0..shape.iter().product()).map(|at| value(seed, at)).collect();
    let (above, name) = path.rsplit_once('/').map_or((file.clone(), path), |(above, name)| (group(file, above), name));
    let set = above.new_dataset::<f32>().shape(shape.to_vec()).create(name).unwrap();
    set.write_raw(&values).unwrap();
}

pub fn bytes(file: &Group, path: &str, shape: &[usize]) {
    let values: Vec<u8> = (0..shape.iter().product::<usize>()).map(|at| (at % 251) as u8).collect();
    let (above, name) = path.rsplit_once('/').unwrap();
    let set = group(file, above).new_dataset::<u8>().shape(shape.to_vec()).create(name).unwrap();
    set.write_raw(&values).unwrap();
}

/// JPEG files as byte strings of one width. The library writes no zero byte into a string, so the strings are written as
/// marks and the bytes put into the file afterwards.
pub fn strings(file: &Group, path: &str, files: &[Vec<u8>]) -> Vec<(Vec<u8>, Vec<u8>)> {
    const WIDTH: usize = 1500;
    let mut patches = Vec::new();
    let marks: Vec<FixedAscii<WIDTH>> = files
        .iter()
        .enumerate()
        .map(|(at, file)| {
            let mark = format!("{path}{at:04}").repeat(WIDTH / (path.len() + 4) + 1).into_bytes()[..WIDTH].to_vec();
            let mut row = file.clone();
            assert!(row.len() <= WIDTH, "{} bytes", row.len());
            row.resize(WIDTH, 0);
            patches.push((mark.clone(), row));
            FixedAscii::from_ascii(&mark).unwrap()
        })
        .collect();
    let (above, name) = path.rsplit_once('/').unwrap();
    let set = group(file, above).new_dataset::<FixedAscii<WIDTH>>().shape([files.len()]).create(name).unwrap();
    set.write_raw(&marks).unwrap();
    patches
}

/// Puts bytes in place of others of the same length.
pub fn patch(path: &Path, patches: &[(Vec<u8>, Vec<u8>)]) {
    let mut content = std::fs::read(path).unwrap();
    for (mark, row) in patches {
        let at = content.windows(mark.len()).position(|window| window == mark).unwrap();
        content[at..at + row.len()].copy_from_slice(row);
    }
    std::fs::write(path, content).unwrap();
}

/// Isaac Lab: `obs` under the names of a task's own, or none.
pub fn isaac_lab(path: &Path, observed: bool) {
    let file = File::create(path).unwrap();
    let data = file.create_group("data").unwrap();
    let args = r#"{"env_name": "Isaac-Own-v0", "type": 2, "sim_args": {"dt": 0.01, "decimation": 4, "num_envs": 1}}"#;
    text(&data, "env_args", args);
    number(&data, "total", 9);
    for (demo, steps) in [(0, 5), (1, 4)] {
        let home = data.create_group(&format!("demo_{demo}")).unwrap();
        number(&home, "num_samples", steps as i64);
        home.new_attr::<bool>().create("success").unwrap().write_scalar(&(demo == 0)).unwrap();
        floats(&home, "actions", &[steps, 7], 1);
        floats(&home, "processed_actions", &[steps, 8], 2);
        for (at, (name, width)) in
            [("articulation/robot/joint_position", 9), ("rigid_object/cube/root_pose", 7)].into_iter().enumerate()
        {
            floats(&home, &format!("states/{name}"), &[steps, width], 10 + at);
            floats(&home, &format!("initial_state/{name}"), &[1, width], 20 + at);
        }
        if observed {
            floats(&home, "obs/policy/hand", &[steps, 3], 3);
            floats(&home, "obs/finger", &[steps], 4);
            floats(&home, "obs/actions", &[steps, 7], 5);
            floats(&home, "obs/datagen_info/eef_pose/arm", &[steps, 4, 4], 6);
            bytes(&home, "obs/table_cam", &[steps, 6, 8, 3]);
        }
    }
    file.close().unwrap();
}

/// BEHAVIOR: states alone.
pub fn behavior(path: &Path) {
    let file = File::create(path).unwrap();
    let home = group(&file, "data/demo_0");
    number(&home, "num_samples", 3);
    floats(&home, "action", &[3, 23], 1);
    floats(&home, "state", &[3, 50], 2);
    floats(&home, "reward", &[3], 3);
    file.close().unwrap();
}

/// ManiSkill, with the observations of a mode: `rgbd`, `state` or `none`.
pub fn maniskill(path: &Path, mode: &str) {
    let file = File::create(path).unwrap();
    for (demo, steps) in [(0, 4), (1, 3), (10, 2)] {
        let home = file.create_group(&format!("traj_{demo}")).unwrap();
        floats(&home, "actions", &[steps, 8], 1);
        floats(&home, "env_states/actors/cube", &[steps + 1, 13], 2);
        for name in ["terminated", "truncated", "success"] {
            let flags: Vec<bool> = (1..=steps).map(|step| step == steps && name != "truncated").collect();
            home.new_dataset::<bool>().shape([steps]).create(name).unwrap().write_raw(&flags).unwrap();
        }
        match mode {
            "rgbd" => {
                floats(&home, "obs/agent/qpos", &[steps + 1, 9], 3);
                floats(&home, "obs/extra/tcp_pose", &[steps + 1, 7], 4);
                bytes(&home, "obs/sensor_data/base_camera/rgb", &[steps + 1, 6, 8, 3]);
                bytes(&home, "obs/sensor_data/hand_camera/rgb", &[steps + 1, 4, 4, 3]);
                let depth = vec![700_i16; (steps + 1) * 48];
                let camera = group(&home, "obs/sensor_data/base_camera");
                let set = camera.new_dataset::<i16>().shape([steps + 1, 6, 8, 1]).create("depth").unwrap();
                set.write_raw(&depth).unwrap();
            }
            "state" => floats(&home, "obs", &[steps + 1, 42], 3),
            _ => drop(home.create_group("obs").unwrap()),
        }
    }
    file.close().unwrap();
    let json = r#"{"env_info": {"env_id": "PickCube-v1", "env_kwargs": {"obs_mode": "x"}}, "episodes": [{"episode_id": 0},
        {"episode_id": 1}, {"episode_id": 10}]}"#;
    std::fs::write(path.with_extension("json"), json).unwrap();
}

/// RoboTwin: two cameras of JPEG files as byte strings.
pub fn robotwin(path: &Path, frames: usize) {
    let file = File::create(path).unwrap();
    floats(&file, "joint_action/vector", &[frames, 14], 1);
    for (part, width) in [("left_arm", 6), ("right_arm", 6)] {
        floats(&file, &format!("joint_action/{part}"), &[frames, width], 2);
    }
    floats(&file, "endpose/left_endpose", &[frames, 7], 3);
    floats(&file, "observation/head_camera/intrinsic_cv", &[frames, 3, 3], 4);
    let mut patches = Vec::new();
    for (at, camera) in ["head_camera", "left_camera"].into_iter().enumerate() {
        let files: Vec<Vec<u8>> = (0..frames).map(|frame| jpeg((frame + at) % 2)).collect();
        patches.extend(strings(&file, &format!("observation/{camera}/rgb"), &files));
    }
    file.close().unwrap();
    patch(path, &patches);
}

/// DROID: no images.
pub fn droid(path: &Path, steps: usize) {
    let file = File::create(path).unwrap();
    text(&file, "current_task", "Put the cup on the shelf");
    for (name, width) in [("joint_velocity", 7), ("cartesian_velocity", 6)] {
        floats(&file, &format!("action/{name}"), &[steps, width], width);
    }
    floats(&file, "action/gripper_position", &[steps], 2);
    floats(&file, "action/robot_state/joint_positions", &[steps, 7], 3);
    floats(&file, "observation/robot_state/joint_positions", &[steps, 7], 4);
    floats(&file, "observation/robot_state/gripper_position", &[steps], 5);
    floats(&file, "observation/timestamp/control/step_start", &[steps], 6);
    file.close().unwrap();
}

/// ALOHA with JPEG files in uint8 of any length.
pub fn aloha(path: &Path, files: &[Vec<u8>]) {
    let file = File::create(path).unwrap();
    floats(&file, "action", &[files.len(), 14], 1);
    floats(&file, "observations/qpos", &[files.len(), 14], 2);
    let rows: Vec<VarLenArray<u8>> = files.iter().map(|file| VarLenArray::from_slice(file)).collect();
    let images = group(&file, "observations/images");
    let set = images.new_dataset::<VarLenArray<u8>>().shape([files.len()]).create("top").unwrap();
    set.write_raw(&rows).unwrap();
    file.close().unwrap();
}

/// LIBERO: one task with two demos.
pub fn libero(path: &Path, instruction: &str) {
    let file = File::create(path).unwrap();
    let data = file.create_group("data").unwrap();
    text(&data, "problem_info", &format!(r#"{{"language_instruction": "{instruction}"}}"#));
    text(&data, "bddl_file_name", &format!("{instruction}.bddl"));
    let args = format!(
        r#"{{"env_name": "Libero", "type": 1, "bddl_file": "{instruction}", "env_kwargs": {{"control_freq": 20, "x": 1}}}}"#
    );
    text(&data, "env_args", &args);
    number(&data, "total", 5);
    for (demo, steps) in [(0, 3), (1, 2)] {
        let home = data.create_group(&format!("demo_{demo}")).unwrap();
        number(&home, "num_samples", steps as i64);
        let seed = instruction.len() * 10 + demo;
        for (name, width) in [("actions", 7), ("obs/ee_pos", 3), ("obs/ee_ori", 3), ("obs/gripper_states", 2)] {
            floats(&home, name, &[steps, width], seed);
        }
        floats(&home, "rewards", &[steps], 0);
        floats(&home, "dones", &[steps], 0);
    }
    let names: Vec<FixedAscii<6>> = vec![FixedAscii::from_ascii(b"demo_1").unwrap()];
    let mask = file.create_group("mask").unwrap();
    mask.new_dataset::<FixedAscii<6>>().shape([1]).create("valid").unwrap().write_raw(&names).unwrap();
    file.close().unwrap();
}

/// One file of every layout, in a folder of its own.
pub fn each(folder: &Path) -> Vec<PathBuf> {
    let path = |name: &str| {
        std::fs::create_dir_all(folder.join(name)).unwrap();
        folder.join(name).join(format!("{name}_0.hdf5"))
    };
    isaac_lab(&path("isaac"), true);
    isaac_lab(&path("states"), false);
    behavior(&path("behavior"));
    maniskill(&path("maniskill"), "rgbd");
    robotwin(&path("robotwin"), 4);
    droid(&path("droid"), 3);
    aloha(&path("aloha"), &[jpeg(0), jpeg(1)]);
    libero(&path("libero"), "open it");
    let names = ["isaac", "states", "behavior", "maniskill", "robotwin", "droid", "aloha", "libero"];
    names.into_iter().map(path).collect()
}
