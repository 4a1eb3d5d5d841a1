//! MimicGen and Isaac Lab Mimic: robomimic's layout with `datagen_info` and the demos it was made from.

use super::{Draft, Layout, Survey, family};
use crate::error::InputError;
use crate::plan::Dialect;

pub(super) struct Mimicgen;

impl Layout for Mimicgen {
    fn expected(&self) -> &'static str {
        "a group data whose demos have datagen_info or src_demo_inds (MimicGen)"
    }

    fn recognises(&self, survey: &Survey) -> bool {
        survey.any(|file| {
            ["datagen_info", "obs/datagen_info", "src_demo_inds"].iter().any(|below| family::any_demo_has(file, below))
        })
    }

    fn draft(&self, survey: &Survey, beat: &mut dyn FnMut()) -> Result<Draft, InputError> {
        family::draft(survey, Dialect::Mimicgen, beat)
    }
}
