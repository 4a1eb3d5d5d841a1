//! An entry's policy as a rollout's agent: named observations joined into features, queries timed.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use models::{ActionChunk, Actor, ModelError, Observation, Policy, Signature, ThoughtStep};
use rollout::{Agent, AgentError, Observations};

use super::Perturbation;
use crate::FeatureKeys;

/// A policy that acts on an environment's named observations.
pub struct PolicyAgent {
    actor: Box<dyn Actor>,
    keys: FeatureKeys,
    /// what the episode began with, if that is remembered
    first: Option<Observations>,
    perturbed: Option<(Perturbation, Signature)>,
}

impl PolicyAgent {
    /// `actor`, shown the features that `keys` make of the observations.
    pub fn new(actor: Box<dyn Actor>, keys: FeatureKeys) -> Self {
        Self { actor, keys, first: None, perturbed: None }
    }

    /// The same with pictures of the policy's `signature` changed.
    #[must_use]
    pub fn perturbed(mut self, perturbation: Option<Perturbation>, signature: &Signature) -> Self {
        self.perturbed = perturbation.map(|perturbation| (perturbation, signature.clone()));
        self
    }

    fn observe(&mut self, observations: &Observations) -> Observation {
        if self.first.is_none() && self.keys.remember() {
            self.first = Some(observations.clone());
        }
        let mut seen = self.keys.observe(observations, self.first.as_ref().unwrap_or(observations));
        if let Some((perturbation, signature)) = &self.perturbed {
            perturbation.apply(signature, &mut seen);
        }
        seen
    }
}

impl Agent for PolicyAgent {
    fn act(&mut self, observations: &Observations) -> Result<Vec<f32>, AgentError> {
        let seen = self.observe(observations);
        Ok(self.actor.act(&seen)?)
    }

    fn act_ahead(&mut self, observations: &Observations) -> Result<Vec<Vec<f32>>, AgentError> {
        let seen = self.observe(observations);
        Ok(self.actor.act_ahead(&seen)?)
    }

    fn reset(&mut self, seed: u64) {
        self.first = None;
        self.actor.reset(seed);
    }
}

/// A policy whose queries are timed.
pub(super) struct Timed {
    policy: Box<dyn Policy>,
    times: QueryTimes,
}

/// What a query took.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct QueryTime {
    /// All of it.
    pub whole: Duration,
    /// Of that, until pictures were tokens, in milliseconds; `None` without pictures.
    pub encoding: Option<f64>,
}

/// Durations of a policy's queries, shared with the policy that fills it.
#[derive(Debug, Clone, Default)]
pub struct QueryTimes(Arc<Mutex<Vec<QueryTime>>>);

impl QueryTimes {
    /// Takes what was measured since the last time.
    pub fn take(&self) -> Vec<QueryTime> {
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
        let time = QueryTime { whole: asked.elapsed(), encoding: self.policy.encoding() };
        self.times.0.lock().unwrap_or_else(PoisonError::into_inner).push(time);
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

    fn encoding(&self) -> Option<f64> {
        self.policy.encoding()
    }

    fn thought(&self) -> Result<Vec<ThoughtStep>, ModelError> {
        self.policy.thought()
    }
}
