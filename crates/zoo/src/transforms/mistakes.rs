//! `data.mistakes`: whether actions that the demonstrations mark as mistakes are learned.

use dataset::WindowSpec;

use super::{DataSection, Transform};

pub(super) struct Mistakes;

impl Transform for Mistakes {
    fn name(&self) -> &'static str {
        "mistakes"
    }

    fn select(&self, data: &DataSection, windows: &mut WindowSpec) {
        windows.mistakes = data.mistakes;
    }
}
