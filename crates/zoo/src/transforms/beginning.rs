//! `[data.beginning]`: the first windows of episodes are drawn more often.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::{Fitted, Source, Transform};
use crate::ZooError;
use crate::experiment::Experiment;

/// `[data.beginning]`: how often the first windows of an episode are sampled in training.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BeginningSection {
    /// Number of first windows of an episode.
    pub steps: usize,
    /// How many times as often each of them is sampled as another window.
    pub times: usize,
}

pub(super) struct Beginning;

/// Every window is drawn so often at most.
const MOST: usize = 1000;

impl Transform for Beginning {
    fn name(&self) -> &'static str {
        "beginning"
    }

    fn check(&self, experiment: &Experiment, _: &[String]) -> Result<(), ZooError> {
        let possible = |number: &usize| (1..=MOST).contains(number);
        match experiment.data.beginning.filter(|of| !(possible(&of.steps) && possible(&of.times))) {
            Some(BeginningSection { steps, times }) => Err(ZooError::InvalidValue {
                key: "data.beginning".to_owned(),
                expected: format!("1 to {MOST}"),
                found: format!("steps {steps}, times {times}"),
            }),
            None => Ok(()),
        }
    }

    fn fit(&self, source: &Source<'_>) -> Result<Option<Box<dyn Fitted>>, ZooError> {
        Ok(source.experiment.data.beginning.map(|beginning| Box::new(beginning) as Box<dyn Fitted>))
    }
}

impl Fitted for BeginningSection {
    fn draws(&self, episodes: &[Range<u32>]) -> Option<Vec<u32>> {
        let times = |at: usize| if at < self.steps { self.times } else { 1 };
        let windows = episodes.iter().flat_map(|episode| episode.clone().enumerate());
        Some(windows.flat_map(|(at, window)| std::iter::repeat_n(window, times(at))).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_windows_of_an_episode_are_drawn_as_often_as_set() {
        let windows = BeginningSection { steps: 2, times: 3 }.draws(&[0..3, 3..4, 4..8]);
        assert_eq!(windows, Some(vec![0, 0, 0, 1, 1, 1, 2, 3, 3, 3, 4, 4, 4, 5, 5, 5, 6, 7]));
    }
}
