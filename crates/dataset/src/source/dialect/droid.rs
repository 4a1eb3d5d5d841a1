//! DROID as it was recorded: `trajectory.h5`, one an episode, with the cameras' recordings beside it. Actions are the joint
//! velocities and the gripper's position, as openpi trains on them; `action_dict` has all of `action`.
//! `observation/robot_state/joint_positions` is `obs/joint_positions`.

use super::{DemoDraft, Draft, Layout, Survey, contents, id_of, key_plan, missing, stranger, wrong_lengths};
use crate::error::InputError;
use crate::plan::{DemoPlan, Dialect, Join, KeyPlan, Problem};
use crate::source::walk::Walked;
use crate::tree::Array;

pub(super) struct Droid;

/// What an action is made of.
const PARTS: [&str; 2] = ["action/joint_velocity", "action/gripper_position"];

fn is_episode(file: &Walked) -> bool {
    file.groups.contains_key("action") && file.groups.contains_key("observation/robot_state")
}

impl Layout for Droid {
    fn expected(&self) -> &'static str {
        "action/joint_velocity and observation/robot_state, one file an episode (DROID)"
    }

    fn recognises(&self, survey: &Survey) -> bool {
        survey.any(is_episode)
    }

    fn draft(&self, survey: &Survey, beat: &mut dyn FnMut()) -> Result<Draft, InputError> {
        let mut out = Draft::new(Dialect::Droid);
        let (mut recorded, mut failed) = (0, 0);
        for (index, file) in survey.files.iter().enumerate() {
            if is_episode(file) {
                failed += usize::from(!episode(index, file, &mut out)?);
                recorded += usize::from(file.path.with_file_name("recordings").is_dir());
            } else {
                out.problems.push(stranger(file, "action and observation/robot_state as in the other files"));
            }
            beat();
        }
        out.notes.push(format!(
            "actions are {} and {}, as openpi takes them; action_dict has the others",
            PARTS[0], PARTS[1]
        ));
        if recorded > 0 {
            out.notes.push(format!(
                "{recorded} episodes have camera recordings (MP4, SVO) in the folder recordings beside them: these are not read"
            ));
        }
        if failed > 0 {
            out.notes.push(format!("the attribute success of {failed} episodes says that they failed"));
        }
        Ok(out)
    }
}

/// robomimic's names for DROID's datasets.
fn name_of(path: &str) -> String {
    match (path.strip_prefix("observation/robot_state/"), path.strip_prefix("action/")) {
        (Some(state), _) => format!("obs/{state}"),
        (None, Some(action)) => format!("action_dict/{action}"),
        (None, None) => path.to_owned(),
    }
}

/// The two parts side by side.
fn actions(index: usize, file: &Walked) -> Option<KeyPlan> {
    let [mut velocity, gripper] = [key_plan(index, file, PARTS[0])?, key_plan(index, file, PARTS[1])?];
    if velocity.dtype != gripper.dtype || velocity.shape.first() != gripper.shape.first() {
        return None;
    }
    let width = |key: &KeyPlan| key.shape.iter().skip(1).product::<usize>();
    velocity.shape = [*velocity.shape.first()?, width(&velocity) + width(&gripper)].into();
    velocity.place.offset = None;
    velocity.place.join = Some(Box::new(Join::Beside(vec![gripper.place.path])));
    Some(velocity)
}

/// Whether it says nothing of having failed.
fn episode(index: usize, file: &Walked, out: &mut Draft) -> Result<bool, InputError> {
    let (attr_names, attrs) = file.some_attrs("/", &["current_task", "success"])?;
    let (number, id) = id_of(&file.path, index, &out.demos);
    let mut found = contents((index, file), "", &id, &name_of, &mut out.problems);
    let mut length = 0;
    match actions(index, file) {
        None => {
            let lacking = PARTS.iter().find(|part| key_plan(index, file, part).is_none());
            out.problems.push(missing(file, &id, lacking.unwrap_or(&"actions of one type and length"), &found.keys));
        }
        Some(actions) => {
            length = actions.shape[0];
            found.keys.insert("actions".to_owned(), actions);
            match length {
                0 => out.problems.push(Problem::empty(&file.path, &id, PARTS[0])),
                _ => out.problems.extend(wrong_lengths(file, &id, (length, PARTS[0]), &found.keys)),
            }
        }
    }
    let task = attrs.get("current_task").and_then(Array::to_text).filter(|task| !task.is_empty());
    let plan = DemoPlan { id, number, length, keys: found.keys.into(), attr_names, task };
    out.demos.push(DemoDraft { plan, home: Some((index, String::new())), groups: found.groups, inner: found.inner });
    Ok(attrs.get("success").and_then(Array::to_i64) != Some(0))
}
