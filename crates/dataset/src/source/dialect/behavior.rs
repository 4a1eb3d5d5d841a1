//! BEHAVIOR and whatever else OmniGibson records: robomimic's layout with `action`, `reward` and `state`. A recording has no
//! observations before it is played back.

use super::{Draft, Layout, Survey, family};
use crate::error::InputError;
use crate::plan::Dialect;

pub(super) struct Behavior;

impl Layout for Behavior {
    fn expected(&self) -> &'static str {
        "a group data with demo_<number>/action (BEHAVIOR)"
    }

    fn recognises(&self, survey: &Survey) -> bool {
        survey.any(|file| family::any_demo_has(file, "action") && !family::any_demo_has(file, "actions"))
    }

    fn draft(&self, survey: &Survey, beat: &mut dyn FnMut()) -> Result<Draft, InputError> {
        let mut draft = family::draft(survey, Dialect::Behavior, beat)?;
        if !draft.demos.iter().any(|demo| demo.plan.keys.keys().any(|key| key.starts_with("obs/"))) {
            draft.notes.push(format!("no observations: {}", Dialect::Behavior.observe()));
        }
        Ok(draft)
    }
}

/// robomimic's names for OmniGibson's datasets.
pub(super) fn name_of(path: &str) -> &str {
    match path {
        "action" => "actions",
        "reward" => "rewards",
        other => other,
    }
}
