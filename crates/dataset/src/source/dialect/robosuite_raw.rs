//! robosuite's own recordings (`demo.hdf5`, also after robomimic's `convert_robosuite`): states and actions,
//! no observations anywhere. The states have to be replayed before anything can be learnt from them.

use super::{Draft, Layout, Survey, family};
use crate::error::InputError;
use crate::plan::Dialect;

pub(super) struct RobosuiteRaw;

impl Layout for RobosuiteRaw {
    fn expected(&self) -> &'static str {
        "a group data with demo_<number>/states and actions (raw robosuite)"
    }

    fn recognises(&self, survey: &Survey) -> bool {
        survey.any(|file| {
            family::any_demo_has(file, "states")
                && family::any_demo_has(file, "actions")
                && !family::any_demo_has(file, "obs")
        })
    }

    fn draft(&self, survey: &Survey, beat: &mut dyn FnMut()) -> Result<Draft, InputError> {
        let mut draft = family::draft(survey, Dialect::RobosuiteRaw, beat)?;
        // robosuite itself states name and version beside env_info; robomimic's converter adds env_args
        let text = |key: &str| draft.texts.get(key).cloned();
        draft.env_name = draft.env_name.or_else(|| text("data/env"));
        draft.env_version = draft.env_version.or_else(|| text("data/repository_version"));
        draft.notes.push("no observations: `actrm-data extract` replays the states and writes them".to_owned());
        Ok(draft)
    }
}
