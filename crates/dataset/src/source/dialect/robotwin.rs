//! RoboTwin: one file per episode, a row a frame, cameras as JPEG files. As its own training scripts take it, the action of a
//! frame is the joint vector of the next one, so an episode has one step less than frames. `joint_action/vector` is `obs/qpos`
//! and `actions`, `observation/head_camera/rgb` is `obs/head_camera_image`, `endpose/left_endpose` is `obs/left_endpose`. The
//! instruction is the first seen one of `instructions/episode<k>.json`.

use serde_json::Value;

use super::{
    DemoDraft, Draft, Layout, Survey, beside, contents, id_of, key_plan, missing, observed, stranger, wrong_lengths,
};
use crate::error::InputError;
use crate::plan::{DemoPlan, Dialect, Join, KeyPlan, Problem};
use crate::source::walk::Walked;

pub(super) struct Robotwin;

const VECTOR: &str = "joint_action/vector";
/// What the vector is made of, where it is not there.
const PARTS: [&str; 4] = ["left_arm", "left_gripper", "right_arm", "right_gripper"];

fn is_episode(file: &Walked) -> bool {
    file.groups.contains_key("joint_action") && file.groups.contains_key("observation")
}

impl Layout for Robotwin {
    fn expected(&self) -> &'static str {
        "joint_action/vector and observation/<camera>/rgb, one file an episode (RoboTwin)"
    }

    fn recognises(&self, survey: &Survey) -> bool {
        survey.any(is_episode)
    }

    fn draft(&self, survey: &Survey, beat: &mut dyn FnMut()) -> Result<Draft, InputError> {
        let mut out = Draft::new(Dialect::Robotwin);
        for (index, file) in survey.files.iter().enumerate() {
            if is_episode(file) {
                episode(index, file, &mut out)?;
            } else {
                out.problems.push(stranger(file, "joint_action and observation as in the other files"));
            }
            beat();
        }
        out.notes.push(
            "the action of a frame is the joint vector of the next one, as RoboTwin's own scripts take it: an episode has one \
             step less than frames"
                .to_owned(),
        );
        Ok(out)
    }
}

/// robomimic's names for RoboTwin's datasets.
fn name_of(path: &str) -> String {
    let camera = path.strip_prefix("observation/").and_then(|rest| rest.split_once('/'));
    match (camera, path.strip_prefix("endpose/")) {
        (Some((camera, "rgb")), _) => format!("obs/{camera}_image"),
        // its unit is the millimetre, in floats
        (Some((camera, "depth")), _) => format!("obs/{camera}_millimetres"),
        (Some((camera, what)), _) => format!("obs/{camera}_{what}"),
        (None, Some(pose)) => format!("obs/{pose}"),
        (None, None) if path == "pointcloud" => "obs/pointcloud".to_owned(),
        (None, None) if path == "third_view_rgb" => "obs/third_view_image".to_owned(),
        (None, None) => path.to_owned(),
    }
}

/// The joint vector of every frame.
fn vector(index: usize, file: &Walked) -> Option<KeyPlan> {
    if let Some(vector) = key_plan(index, file, VECTOR) {
        return Some(vector);
    }
    let parts: Vec<KeyPlan> =
        PARTS.iter().map(|part| key_plan(index, file, &format!("joint_action/{part}"))).collect::<Option<_>>()?;
    let same = parts.iter().all(|part| part.dtype == parts[0].dtype && part.shape.first() == parts[0].shape.first());
    let width = parts.iter().map(|part| part.shape.iter().skip(1).product::<usize>()).sum();
    let mut vector = parts[0].clone();
    vector.shape = [*vector.shape.first()?, width].into();
    vector.place.offset = None;
    vector.place.join = Some(Box::new(Join::Beside(parts[1..].iter().map(|part| part.place.path.clone()).collect())));
    same.then_some(vector)
}

fn episode(index: usize, file: &Walked, out: &mut Draft) -> Result<(), InputError> {
    let (attr_names, _) = file.some_attrs("/", &[])?;
    let (number, id) = id_of(&file.path, index, &out.demos);
    let mut found = contents((index, file), "", &id, &name_of, &mut out.problems);
    let mut length = 0;
    match vector(index, file) {
        None => out.problems.push(missing(file, &id, VECTOR, &found.keys)),
        Some(vector) => {
            let frames = vector.shape.first().copied().unwrap_or(0);
            length = frames.saturating_sub(1);
            found.keys.insert("obs/qpos".to_owned(), vector.clone());
            found.keys.insert("actions".to_owned(), vector.part(1, length));
            observed(&mut found.keys, length);
            if length == 0 {
                let error = InputError::WrongLength {
                    path: file.path.clone(),
                    demo: id.clone(),
                    key: VECTOR.to_owned(),
                    expected: "at least 2".to_owned(),
                    found: format!("{frames} frames"),
                };
                out.problems.push(Problem::new(Some(&id), None, true, error));
            } else {
                out.problems.extend(wrong_lengths(file, &id, (length, "one less than frames"), &found.keys));
            }
        }
    }
    let task = instruction(file);
    let plan = DemoPlan { id, number, length, keys: found.keys.into(), attr_names, task };
    out.demos.push(DemoDraft { plan, home: Some((index, String::new())), groups: found.groups, inner: found.inner });
    Ok(())
}

/// The first seen instruction of an episode, from the folder beside that of the file.
fn instruction(file: &Walked) -> Option<String> {
    let folder = file.path.parent()?;
    let name = file.path.with_extension("json").file_name()?.to_owned();
    let text = [folder.parent(), Some(folder)]
        .into_iter()
        .flatten()
        .find_map(|folder| beside(&folder.join("instructions").join(&name)))?;
    let json: Value = serde_json::from_str(&text).ok()?;
    let first = json["seen"][0].as_str().or_else(|| json["instructions"][0].as_str()).or_else(|| json[0].as_str());
    first.filter(|text| !text.is_empty()).map(str::to_owned)
}
