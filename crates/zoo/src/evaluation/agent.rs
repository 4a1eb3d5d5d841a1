//! An entry's policy as a rollout's agent: named observations joined into features, queries timed.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use models::{ActionChunk, Actor, ModelError, Observation, Policy, ThoughtStep};
use rollout::{Agent, AgentError, Observations};

use crate::FeatureKeys;

/// A policy that acts on an environment's named observations.
pub struct PolicyAgent {
    actor: Box<dyn Actor>,
    keys: FeatureKeys,
}

impl PolicyAgent {
    /// `actor`, shown the features that `keys` make of the observations.
    pub fn new(actor: Box<dyn Actor>, keys: FeatureKeys) -> Self {
        Self { actor, keys }
    }
}

impl Agent for PolicyAgent {
    fn act(&mut self, observations: &Observations) -> Result<Vec<f32>, AgentError> {
        Ok(self.actor.act(&self.keys.observe(observations))?)
    }

    fn act_ahead(&mut self, observations: &Observations) -> Result<Vec<Vec<f32>>, AgentError> {
        Ok(self.actor.act_ahead(&self.keys.observe(observations))?)
    }

    fn reset(&mut self, seed: u64) {
        self.actor.reset(seed);
    }
}

/// A policy whose queries are timed.
pub(super) struct Timed {
    policy: Box<dyn Policy>,
    times: QueryTimes,
}

/// Durations of a policy's queries, shared with the policy that fills it.
#[derive(Debug, Clone, Default)]
pub struct QueryTimes(Arc<Mutex<Vec<Duration>>>);

impl QueryTimes {
    /// Takes what was measured since the last time.
    pub fn take(&self) -> Vec<Duration> {
        std::mem::take(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl Timed {
    /// Wraps `policy`; durations go to `times`.
    pub(super) fn new(policy: Box<dyn Policy>, times: QueryTimes) -> Self {
        Self { policy, times }
    }
}

impl Policy for Timed {
    fn predict(&mut self, observation: &Observation) -> Result<ActionChunk, ModelError> {
        let asked = Instant::now();
        let predicted = self.policy.predict(observation);
        self.times.0.lock().unwrap_or_else(PoisonError::into_inner).push(asked.elapsed());
        predicted
    }

    fn n_obs_steps(&self) -> usize {
        self.policy.n_obs_steps()
    }

    fn observe(&mut self, observation: &Observation) {
        self.policy.observe(observation);
    }

    fn executed(&mut self, actions: usize) {
        self.policy.executed(actions);
    }

    fn reset(&mut self, seed: u64) {
        self.policy.reset(seed);
    }

    fn thought(&self) -> Result<Vec<ThoughtStep>, ModelError> {
        self.policy.thought()
    }
}
