//! An entry's policy as a rollout's agent: named observations joined into features, queries timed.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use models::{ActionChunk, Actor, ModelError, Observation, Policy};
use rollout::{Agent, AgentError, Observations};

/// A policy that acts on an environment's named observations.
pub struct PolicyAgent {
    actor: Box<dyn Actor>,
    state_keys: Vec<String>,
    env_keys: Vec<String>,
}

impl PolicyAgent {
    /// `actor`, shown the observations of `state_keys` and `env_keys`, each in this order.
    pub fn new(actor: Box<dyn Actor>, state_keys: &[String], env_keys: &[String]) -> Self {
        Self { actor, state_keys: state_keys.to_vec(), env_keys: env_keys.to_vec() }
    }

    fn observation(&self, observations: &Observations) -> Observation {
        let pick = |keys: &[String]| {
            keys.iter()
                .filter_map(|key| observations.get(key))
                .flat_map(|values| values.iter().map(|&value| value as f32))
                .collect()
        };
        Observation { state: pick(&self.state_keys), environment_state: pick(&self.env_keys) }
    }
}

impl Agent for PolicyAgent {
    fn act(&mut self, observations: &Observations) -> Result<Vec<f32>, AgentError> {
        Ok(self.actor.act(&self.observation(observations))?)
    }

    fn act_ahead(&mut self, observations: &Observations) -> Result<Vec<Vec<f32>>, AgentError> {
        Ok(self.actor.act_ahead(&self.observation(observations))?)
    }

    fn reset(&mut self) {
        self.actor.reset();
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

    fn reset(&mut self) {
        self.policy.reset();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Nobody;

    impl Actor for Nobody {
        fn act(&mut self, _: &Observation) -> Result<Vec<f32>, ModelError> {
            Ok(Vec::new())
        }
        fn reset(&mut self) {}
    }

    #[test]
    fn keys_are_joined_in_their_order() {
        let agent = PolicyAgent::new(Box::new(Nobody), &["b".into(), "a".into()], &["c".into()]);
        let observations = [("a", vec![1.0]), ("b", vec![2.0, 3.0]), ("c", vec![4.0])];
        let seen = agent.observation(&observations.map(|(key, values)| (key.to_owned(), values)).into());
        assert_eq!(seen.state, [2.0, 3.0, 1.0]);
        assert_eq!(seen.environment_state, [4.0]);
    }
}
