//! Isaac Lab, with Mimic or without: robomimic's layout with the states of every object in groups, without rewards. A
//! recording without `obs` has its states instead: each as it was before the action of its step.

use super::{Draft, Layout, Survey, family};
use crate::error::InputError;
use crate::plan::{DemoPlan, Dialect, Join, KeyPlan};
use crate::source::walk::Walked;
use crate::tree::Array;

pub(super) struct IsaacLab;

/// What its recorder writes and no other does.
const MARKS: [&str; 5] =
    ["states/articulation", "states/rigid_object", "states/deformable_object", "initial_state", "processed_actions"];

fn is_isaac_lab(file: &Walked) -> bool {
    MARKS.iter().any(|below| family::any_demo_has(file, below))
        || family::data_attr(file, "env_args").is_some_and(|text| text.contains("\"sim_args\""))
}

impl Layout for IsaacLab {
    fn expected(&self) -> &'static str {
        "a group data whose demos have states/articulation or initial_state (Isaac Lab)"
    }

    fn recognises(&self, survey: &Survey) -> bool {
        survey.any(is_isaac_lab)
    }

    fn draft(&self, survey: &Survey, beat: &mut dyn FnMut()) -> Result<Draft, InputError> {
        let mut draft = family::draft(survey, Dialect::IsaacLab, beat)?;
        let mut made = 0;
        for demo in &mut draft.demos {
            if !demo.plan.keys.keys().any(|key| key.starts_with("obs/")) {
                made += usize::from(observe(&mut demo.plan));
            }
        }
        if made > 0 {
            draft.notes.push(format!(
                "{made} demos have no obs: their observations are the states, each as it was before the action of its step"
            ));
        }
        let mut failed = Vec::new();
        for demo in &draft.demos {
            let Some((file, home)) = &demo.home else { continue };
            let (_, attrs) = survey.files[*file].some_attrs(home, &["success"])?;
            if attrs.get("success").and_then(Array::to_i64) == Some(0) {
                failed.push(demo.plan.id.as_str());
            }
        }
        if !failed.is_empty() {
            let ids = super::list(failed.into_iter());
            draft.notes.push(format!("their attribute success says that these demos failed: {ids}"));
        }
        Ok(draft)
    }
}

/// Makes observations of a demo's states: the recorder writes them after each step, and the first beforehand.
fn observe(plan: &mut DemoPlan) -> bool {
    let mut made: Vec<(String, KeyPlan)> = Vec::new();
    for (key, state) in &plan.keys {
        let Some(below) = key.strip_prefix("states/") else { continue };
        let Some(first) = plan.keys.get(&format!("initial_state/{below}")) else { continue };
        let fits =
            first.dtype == state.dtype && first.shape.first() == Some(&1) && first.shape[1..] == state.shape[1..];
        if !fits || state.shape.first() != Some(&plan.length) {
            continue;
        }
        // articulation/robot/joint_position
        let name = below.split_once('/').map_or(below, |(_, name)| name).replace('/', "_");
        let mut observed = state.clone();
        observed.place.offset = None;
        observed.place.join = Some(Box::new(Join::Before(first.place.path.clone())));
        made.push((format!("obs/{name}"), observed));
    }
    let any = !made.is_empty();
    plan.keys.extend(made);
    any
}
