//! One rollout: reset, then observe, act and step until success or the cap.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use models::{ActionChunk, Actor, ModelError, Observation, Policy};

use super::error::RolloutError;
use super::message::Ready;
use super::pool::JobError;
use super::worker::{Initial, Observations, Worker};

/// What an episode shows its policy and when it ends.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodePlan {
    /// Keys that make up [`Observation::state`], in order.
    pub state_keys: Vec<String>,
    /// Keys that make up [`Observation::environment_state`], in order.
    pub env_keys: Vec<String>,
    /// Control steps after which the episode has failed.
    pub max_steps: usize,
    /// The environment's smallest action.
    pub action_low: Vec<f64>,
    /// The environment's largest action.
    pub action_high: Vec<f64>,
}

/// How an episode ended.
#[derive(Debug, Clone, PartialEq)]
pub struct Outcome {
    /// Whether the task was done.
    pub success: bool,
    /// Control steps done.
    pub steps: usize,
    /// Sum of the rewards.
    pub total_reward: f64,
    /// Hash of the initial state.
    pub fingerprint: String,
    /// The group of episodes that this one belongs to, where the task has groups.
    pub group: Option<String>,
    /// Time spent waiting for the simulator.
    pub simulator: Duration,
    /// Time of the whole episode.
    pub wall: Duration,
}

impl EpisodePlan {
    /// A plan for the environment that `ready` describes.
    ///
    /// # Errors
    /// [`RolloutError::ObservationKey`] for a key that the environment does not give.
    pub fn new(
        ready: &Ready,
        state_keys: &[String],
        env_keys: &[String],
        max_steps: usize,
    ) -> Result<Self, RolloutError> {
        for key in state_keys.iter().chain(env_keys) {
            if !ready.observations.contains_key(key) {
                let available: Vec<&str> = ready.observations.keys().map(String::as_str).collect();
                return Err(RolloutError::ObservationKey {
                    key: key.clone(),
                    task: ready.task.clone(),
                    available: available.join(", "),
                });
            }
        }
        Ok(Self {
            state_keys: state_keys.to_vec(),
            env_keys: env_keys.to_vec(),
            max_steps,
            action_low: ready.action_low.clone(),
            action_high: ready.action_high.clone(),
        })
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

    /// The action that is executed: of the right length, finite, inside the environment's limits.
    fn clipped(&self, action: &[f32]) -> Result<Vec<f64>, String> {
        if action.len() != self.action_low.len() {
            return Err(format!("{} values", action.len()));
        }
        if let Some(at) = action.iter().position(|value| !value.is_finite()) {
            return Err(format!("{} at index {at}", action[at]));
        }
        let limits = self.action_low.iter().zip(&self.action_high);
        let clip = |(&value, (&low, &high)): (&f32, (&f64, &f64))| f64::from(value).clamp(low, high);
        Ok(action.iter().zip(limits).map(clip).collect())
    }

    /// The actions that can be executed, and why the one after them cannot, if so.
    fn executable(&self, planned: &[Vec<f32>]) -> (Vec<Vec<f64>>, Option<String>) {
        let mut good = Vec::with_capacity(planned.len());
        for action in planned {
            match self.clipped(action) {
                Ok(action) => good.push(action),
                Err(found) => return (good, Some(found)),
            }
        }
        (good, None)
    }

    /// Runs the episode of `seed`. Actions that the policy plans ahead go to the worker together, unless `watch` wants
    /// to be called with the worker after the reset and after every step.
    ///
    /// # Errors
    /// A failure of the worker, or one of the policy.
    pub fn run(
        &self,
        worker: &mut Worker,
        actor: &mut dyn Actor,
        seed: u64,
        mut watch: Option<Watch<'_>>,
    ) -> Result<Outcome, JobError> {
        let begun = Instant::now();
        actor.reset();
        let Initial { fingerprint, group, mut observations } = worker.reset(seed)?;
        let mut simulator = begun.elapsed();
        if let Some(watch) = &mut watch {
            watch(worker)?;
        }
        let (mut success, mut steps, mut total_reward) = (false, 0, 0.0);
        while !success && steps < self.max_steps {
            let seen = self.observation(&observations);
            let planned = if watch.is_some() { actor.act(&seen).map(|one| vec![one]) } else { actor.act_ahead(&seen) };
            let mut planned = planned.map_err(|source| {
                let operation = "querying the policy";
                RolloutError::Policy { seed, step: steps, operation, source: Box::new(source) }
            })?;
            planned.truncate(self.max_steps - steps);
            let (actions, unusable) = self.executable(&planned);
            if !actions.is_empty() {
                let asked = Instant::now();
                let stepped = worker.step(&actions)?;
                simulator += asked.elapsed();
                steps += stepped.rewards.len();
                total_reward = stepped.rewards.iter().fold(total_reward, |sum, reward| sum + reward);
                success = stepped.success;
                observations = stepped.observations;
            }
            if let Some(found) = unusable.filter(|_| !success) {
                let expected = format!("{} finite values", self.action_low.len());
                return Err(RolloutError::Action { seed, step: steps, expected, found }.into());
            }
            if let Some(watch) = &mut watch {
                watch(worker)?;
            }
        }
        worker.check_quiet()?;
        Ok(Outcome { success, steps, total_reward, fingerprint, group, simulator, wall: begun.elapsed() })
    }
}

/// Called with the worker after an episode's reset and after every step of it.
pub type Watch<'a> = &'a mut dyn FnMut(&mut Worker) -> Result<(), JobError>;

/// A policy whose queries are timed.
pub struct Timed {
    policy: Box<dyn Policy>,
    times: QueryTimes,
}

/// Durations of a policy's queries, shared with the [`Timed`] that fills it.
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
    pub fn new(policy: Box<dyn Policy>, times: QueryTimes) -> Self {
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
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn plan() -> EpisodePlan {
        EpisodePlan {
            state_keys: vec!["b".into(), "a".into()],
            env_keys: vec!["c".into()],
            max_steps: 5,
            action_low: vec![-1.0, -0.5],
            action_high: vec![1.0, 0.5],
        }
    }

    #[test]
    fn keys_are_joined_in_the_plan_s_order() {
        let observations = [("a", vec![1.0]), ("b", vec![2.0, 3.0]), ("c", vec![4.0])];
        let observations = observations.map(|(key, values)| (key.to_owned(), values)).into();
        let seen = plan().observation(&observations);
        assert_eq!(seen.state, [2.0, 3.0, 1.0]);
        assert_eq!(seen.environment_state, [4.0]);
    }

    #[test]
    fn actions_are_clipped_and_must_be_finite_and_complete() {
        assert_eq!(plan().clipped(&[2.0, -0.25]).unwrap(), [1.0, -0.25]);
        assert_eq!(plan().clipped(&[-7.0, 0.75]).unwrap(), [-1.0, 0.5]);
        assert_eq!(plan().clipped(&[0.0, f32::NAN]).unwrap_err(), "NaN at index 1");
        assert_eq!(plan().clipped(&[f32::INFINITY, 0.0]).unwrap_err(), "inf at index 0");
        assert_eq!(plan().clipped(&[0.0]).unwrap_err(), "1 values");
        let (good, unusable) = plan().executable(&[vec![0.0, 2.0], vec![f32::NAN, 0.0], vec![0.0, 0.0]]);
        assert_eq!((good, unusable), (vec![vec![0.0, 0.5]], Some("NaN at index 0".to_owned())));
    }
}
