//! What a policy is to whoever runs it: observations in, action chunks out, one instance per environment.
//!
//! Executing a chunk is not part of a policy: `RecedingHorizon` and `TemporalEnsemble` wrap one.

mod receding_horizon;
mod temporal_ensemble;

pub use receding_horizon::RecedingHorizon;
pub use temporal_ensemble::TemporalEnsemble;

use crate::features::Observation;
use nn::{ModelError, Result};

/// Actions for the next steps in raw units, row-major `(action_horizon, action_dim)`.
#[derive(Debug, Clone, PartialEq)]
pub struct ActionChunk {
    /// the values
    pub actions: Vec<f32>,
    /// number of rows
    pub action_horizon: usize,
    /// length of a row
    pub action_dim: usize,
}

impl ActionChunk {
    /// Checks the length.
    ///
    /// # Errors
    /// If `actions` does not hold `action_horizon * action_dim` values, or the chunk is empty.
    pub fn new(actions: Vec<f32>, action_horizon: usize, action_dim: usize) -> Result<Self> {
        if actions.is_empty() || actions.len() != action_horizon * action_dim {
            return Err(ModelError::Shape {
                operation: "action chunk",
                object: "actions",
                expected: vec![action_horizon, action_dim],
                found: vec![actions.len()],
            });
        }
        Ok(Self { actions, action_horizon, action_dim })
    }

    /// The rows in order of time.
    pub fn rows(&self) -> impl Iterator<Item = &[f32]> {
        self.actions.chunks_exact(self.action_dim)
    }
}

/// The clock of whoever runs a policy: models have none of their own.
pub trait Clock: Send {
    /// Milliseconds since a moment that stays the same.
    fn milliseconds(&mut self) -> f64;
}

/// One step of the thought behind a prediction.
#[derive(Debug, Clone, PartialEq)]
pub struct ThoughtStep {
    /// the answer at this depth, raw units
    pub chunk: ActionChunk,
    /// mean absolute change of the answer since the step before, in network units; the first step has none
    pub change: Option<f32>,
    /// the halting head's probability that another step would not help
    pub halt: f32,
    /// time that the step took, by the caller's clock
    pub milliseconds: f64,
}

/// A policy with the state of one episode: the last observations, a generator, the previous thought. Weights are shared
/// behind it.
pub trait Policy: Send {
    /// Actions from this observation on.
    fn predict(&mut self, observation: &Observation) -> Result<ActionChunk>;

    /// Observations that it sees at once: the present one and those of the steps before it.
    fn n_obs_steps(&self) -> usize {
        1
    }

    /// Shows it a step at which it is not asked; needed of the last `n_obs_steps - 1` before a query.
    fn observe(&mut self, _observation: &Observation) {}

    /// Tells it that so many actions of its last chunk are on their way.
    fn executed(&mut self, _actions: usize) {}

    /// Milliseconds from the last query's beginning until its images were tokens; `None` if it sees none, or cannot tell.
    fn encoding(&self) -> Option<f64> {
        None
    }

    /// Forgets the episode and begins another; what it draws from now on depends on `seed` only.
    fn reset(&mut self, seed: u64);

    /// Says what is to be done in the episode that just began, in words; `None` where the environment does not say it.
    fn instruct(&mut self, _instruction: Option<&str>) {}

    /// What it thought at the last query, step by step; nothing if it does not think.
    ///
    /// # Errors
    /// When a tensor operation fails.
    fn thought(&self) -> Result<Vec<ThoughtStep>> {
        Ok(Vec::new())
    }
}

impl<P: Policy + ?Sized> Policy for Box<P> {
    fn predict(&mut self, observation: &Observation) -> Result<ActionChunk> {
        (**self).predict(observation)
    }
    fn n_obs_steps(&self) -> usize {
        (**self).n_obs_steps()
    }
    fn observe(&mut self, observation: &Observation) {
        (**self).observe(observation);
    }
    fn executed(&mut self, actions: usize) {
        (**self).executed(actions);
    }
    fn encoding(&self) -> Option<f64> {
        (**self).encoding()
    }
    fn reset(&mut self, seed: u64) {
        (**self).reset(seed);
    }
    fn instruct(&mut self, instruction: Option<&str>) {
        (**self).instruct(instruction);
    }
    fn thought(&self) -> Result<Vec<ThoughtStep>> {
        (**self).thought()
    }
}

/// Something that gives one action per step.
pub trait Actor: Send {
    /// The action to execute now, raw units.
    fn act(&mut self, observation: &Observation) -> Result<Vec<f32>>;
    /// The actions up to the next observation that matters, at least one: what as many calls of [`Actor::act`] would
    /// give, whatever they were shown after the first.
    fn act_ahead(&mut self, observation: &Observation) -> Result<Vec<Vec<f32>>> {
        Ok(vec![self.act(observation)?])
    }
    /// Forgets the episode and begins that of `seed`.
    fn reset(&mut self, seed: u64);
    /// As [`Policy::instruct`].
    fn instruct(&mut self, _instruction: Option<&str>) {}
}

#[cfg(test)]
mod testing;
