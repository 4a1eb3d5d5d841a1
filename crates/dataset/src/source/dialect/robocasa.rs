//! robocasa: robomimic's layout with a kitchen; the instruction is in each demo's `ep_meta`.

use super::{Draft, Layout, Survey, family};
use crate::error::InputError;
use crate::plan::Dialect;

pub(super) struct Robocasa;

impl Layout for Robocasa {
    fn expected(&self) -> &'static str {
        "a group data whose demos have an ep_meta with a kitchen layout (robocasa)"
    }

    fn recognises(&self, survey: &Survey) -> bool {
        survey.any(|file| {
            family::any_demo_has(file, "obs")
                && family::first_ep_meta(file)
                    .is_some_and(|meta| ["layout_id", "style_id", "fixture_refs"].iter().any(|k| meta.get(k).is_some()))
        })
    }

    fn draft(&self, survey: &Survey, beat: &mut dyn FnMut()) -> Result<Draft, InputError> {
        family::draft(survey, Dialect::Robocasa, beat)
    }
}
