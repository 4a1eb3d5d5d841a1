//! What a policy is to whoever runs it: observations in, action chunks out, one instance per environment.
//!
//! Executing a chunk is not part of a policy: `RecedingHorizon` and `TemporalEnsemble` wrap one.

mod receding_horizon;
mod temporal_ensemble;

pub use receding_horizon::RecedingHorizon;
pub use temporal_ensemble::TemporalEnsemble;

use crate::error::{ModelError, Result};
use crate::features::Observation;

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

/// A policy with the state of one episode; weights are shared behind it.
pub trait Policy: Send {
    /// Actions from this observation on.
    fn predict(&mut self, observation: &Observation) -> Result<ActionChunk>;
    /// Forgets the episode.
    fn reset(&mut self);
}

impl<P: Policy + ?Sized> Policy for Box<P> {
    fn predict(&mut self, observation: &Observation) -> Result<ActionChunk> {
        (**self).predict(observation)
    }
    fn reset(&mut self) {
        (**self).reset();
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
    /// Forgets the episode.
    fn reset(&mut self);
}

#[cfg(test)]
mod testing;
