//! robomimic of every generation (0.1, 1.4.1, 1.5): `/data/demo_<k>/{actions,obs,...}`.

use super::{Draft, Layout, Survey, family};
use crate::error::InputError;
use crate::plan::Dialect;

pub(super) struct Robomimic;

impl Layout for Robomimic {
    fn expected(&self) -> &'static str {
        "a group data with demo_<number> (robomimic)"
    }

    fn recognises(&self, survey: &Survey) -> bool {
        survey.any(|file| file.groups.contains_key("data"))
    }

    fn draft(&self, survey: &Survey, beat: &mut dyn FnMut()) -> Result<Draft, InputError> {
        family::draft(survey, Dialect::Robomimic, beat)
    }
}
