//! An entry's policy as a rollout's agent: named observations joined into features, queries timed.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use models::{ActionChunk, Actor, ModelError, Observation, Policy, Signature, ThoughtStep};
use rollout::{Agent, AgentError, Observations};

use super::Perturbation;
use crate::{FeatureKeys, Past};

/// A policy that acts on an environment's named observations.
pub struct PolicyAgent {
    actor: Box<dyn Actor>,
    keys: FeatureKeys,
    past: Past,
    /// what of the last plan is to be executed after an observation in between, which is remembered
    ahead: VecDeque<Vec<f32>>,
    /// how many steps are done between observations, where a plan is interrupted to look
    stride: Option<usize>,
    perturbed: Option<(Perturbation, Signature)>,
}

impl PolicyAgent {
    /// `actor`, which plans `steps` at once (1 where that is not always the same), shown the features that `keys` make of the
    /// observations.
    pub fn new(actor: Box<dyn Actor>, steps: usize, keys: FeatureKeys) -> Self {
        let stride = keys.stride(steps);
        Self { actor, keys, past: Past::default(), ahead: VecDeque::new(), stride, perturbed: None }
    }

    /// The same with pictures of the policy's `signature` changed.
    #[must_use]
    pub fn perturbed(mut self, perturbation: Option<Perturbation>, signature: &Signature) -> Self {
        self.perturbed = perturbation.map(|perturbation| (perturbation, signature.clone()));
        self
    }

    fn observe(&mut self, observations: &Observations) -> Result<Observation, AgentError> {
        let mut seen = self.keys.observe(observations, &mut self.past)?;
        if let Some((perturbation, signature)) = &self.perturbed {
            perturbation.apply(signature, &mut seen);
        }
        Ok(seen)
    }
}

impl Agent for PolicyAgent {
    fn act(&mut self, observations: &Observations) -> Result<Vec<f32>, AgentError> {
        let seen = self.observe(observations)?;
        self.past.pass(1);
        Ok(self.actor.act(&seen)?)
    }

    fn act_ahead(&mut self, observations: &Observations) -> Result<Vec<Vec<f32>>, AgentError> {
        let seen = self.observe(observations)?;
        if self.ahead.is_empty() {
            self.ahead = self.actor.act_ahead(&seen)?.into();
        }
        let steps = self.stride.unwrap_or(self.ahead.len()).min(self.ahead.len());
        self.past.pass(steps);
        Ok(self.ahead.drain(..steps).collect())
    }

    fn reset(&mut self, seed: u64) {
        self.past = Past::default();
        self.ahead.clear();
        self.actor.reset(seed);
    }

    fn instruct(&mut self, instruction: Option<&str>) {
        self.actor.instruct(instruction);
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

    fn instruct(&mut self, instruction: Option<&str>) {
        self.policy.instruct(instruction);
    }

    fn encoding(&self) -> Option<f64> {
        self.policy.encoding()
    }

    fn thought(&self) -> Result<Vec<ThoughtStep>, ModelError> {
        self.policy.thought()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use models::{RecedingHorizon, STATE};

    use super::*;

    /// Plans what it sees, once a step of the plan.
    struct Sees(usize);

    impl Policy for Sees {
        fn predict(&mut self, observation: &Observation) -> Result<ActionChunk, ModelError> {
            let Some(models::Values::F32(seen)) = observation.get(STATE) else { panic!("no state") };
            ActionChunk::new(seen.repeat(16), 16, seen.len())
        }

        fn n_obs_steps(&self) -> usize {
            self.0
        }

        fn reset(&mut self, _seed: u64) {}
    }

    /// The actions of 100 steps of an episode whose observation is its step.
    fn acted(n_action_steps: usize, n_obs_steps: usize, keys: &[&str], ahead: bool) -> (Vec<Vec<f32>>, usize) {
        let mut feature_keys = FeatureKeys::default();
        feature_keys.insert(STATE, &keys.iter().map(|&key| key.to_owned()).collect::<Vec<_>>()).unwrap();
        let steps = if n_obs_steps == 1 { n_action_steps } else { 1 };
        let actor = RecedingHorizon::new(Sees(n_obs_steps), n_action_steps).unwrap();
        let mut agent = PolicyAgent::new(Box::new(actor), steps, feature_keys);
        let (mut actions, mut looked) = (Vec::new(), 0);
        for episode in 0..2 {
            agent.reset(episode);
            (actions, looked) = (Vec::new(), 0);
            while actions.len() < 100 {
                let observations = [("at".to_owned(), vec![actions.len() as f64])].into();
                let next = match ahead {
                    true => agent.act_ahead(&observations).unwrap(),
                    false => vec![agent.act(&observations).unwrap()],
                };
                actions.extend(next);
                looked += 1;
            }
        }
        actions.truncate(100);
        (actions, looked)
    }

    #[test]
    fn plans_are_interrupted_to_look_where_that_is_asked_about_later() {
        for (n_action_steps, n_obs_steps, lags, looks) in
            [(4, 1, [8, 16], 25), (8, 1, [8, 16], 13), (8, 1, [4, 6], 50), (5, 1, [8, 4], 100), (8, 3, [4, 8], 100)]
        {
            let keys = [&["at".to_owned()][..], &lags.map(|lag| format!("before(at:{lag})"))].concat();
            let keys: Vec<&str> = keys.iter().map(String::as_str).collect();
            let (actions, looked) = acted(n_action_steps, n_obs_steps, &keys, true);
            assert_eq!(looked, looks, "{n_action_steps} steps, {lags:?}");
            for (step, action) in actions.iter().enumerate() {
                let asked = step / n_action_steps * n_action_steps;
                let expected = [0, lags[0], lags[1]].map(|lag| asked.saturating_sub(lag) as f32);
                assert_eq!(action, &expected, "step {step} of plans of {n_action_steps}");
            }
            assert_eq!(acted(n_action_steps, n_obs_steps, &keys, false).0, actions);
        }
        // what is not asked about is not looked at
        assert_eq!(acted(8, 1, &["at", "first(at)"], true).1, 13);
    }
}
