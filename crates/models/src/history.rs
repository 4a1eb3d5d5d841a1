//! The observations that a policy still remembers.

use crate::features::{Features, Observation};
use crate::preprocess::Preprocess;
use candle_core::Tensor;
use nn::Result;

/// The last observations of an episode, as many as the signature's `n_obs_steps` say.
#[derive(Debug, Clone)]
pub struct History {
    steps: usize,
    /// oldest first
    seen: Vec<Observation>,
}

impl History {
    /// Of the last `steps` observations.
    pub fn new(steps: usize) -> Self {
        Self { steps: steps.max(1), seen: Vec::new() }
    }

    /// Observations that it holds at most.
    pub fn steps(&self) -> usize {
        self.steps
    }

    /// Takes in the observation of a step.
    pub fn observe(&mut self, observation: &Observation) {
        if self.seen.len() == self.steps {
            self.seen.remove(0);
        }
        self.seen.push(observation.clone());
    }

    /// Takes in the observation of a step; what a network reads there.
    ///
    /// # Errors
    /// As [`Preprocess::observation`].
    pub fn see(&mut self, preprocess: &Preprocess, observation: &Observation) -> Result<Features<Tensor>> {
        self.observe(observation);
        preprocess.observation(&self.seen)
    }

    /// Forgets everything.
    pub fn clear(&mut self) {
        self.seen.clear();
    }
}
