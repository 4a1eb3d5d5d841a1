//! What a policy is to whoever runs it: observations in, action chunks out, one instance per environment.
//!
//! Executing a chunk is not part of a policy: `RecedingHorizon` and `TemporalEnsemble` wrap one.

use crate::error::{ModelError, Result};
use std::collections::VecDeque;

/// One observation in raw units.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Observation {
    /// the robot's own state
    pub state: Vec<f32>,
    /// the rest of the world; empty if the policy does not see it
    pub environment_state: Vec<f32>,
}

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

/// Executes the first `n_action_steps` of a chunk, then asks again.
#[derive(Debug)]
pub struct RecedingHorizon<P> {
    policy: P,
    n_action_steps: usize,
    queue: VecDeque<Vec<f32>>,
}

impl<P: Policy> RecedingHorizon<P> {
    /// # Errors
    /// If `n_action_steps` is 0.
    pub fn new(policy: P, n_action_steps: usize) -> Result<Self> {
        if n_action_steps == 0 {
            return Err(too_many_steps(0, "at least 1".to_string()));
        }
        Ok(Self { policy, n_action_steps, queue: VecDeque::new() })
    }

    /// The wrapped policy.
    pub fn policy(&self) -> &P {
        &self.policy
    }

    /// Whether the next `act` asks the policy.
    pub fn is_due(&self) -> bool {
        self.queue.is_empty()
    }
}

fn too_many_steps(found: usize, expected: String) -> ModelError {
    ModelError::Config { model: "receding horizon", field: "n_action_steps", found: found.to_string(), expected }
}

impl<P: Policy> Actor for RecedingHorizon<P> {
    fn act(&mut self, observation: &Observation) -> Result<Vec<f32>> {
        if self.queue.is_empty() {
            let chunk = self.policy.predict(observation)?;
            if self.n_action_steps > chunk.action_horizon {
                let most = format!("at most the action horizon, {}", chunk.action_horizon);
                return Err(too_many_steps(self.n_action_steps, most));
            }
            self.queue.extend(chunk.rows().take(self.n_action_steps).map(<[f32]>::to_vec));
        }
        Ok(self.queue.pop_front().expect("a chunk has at least one row, and it was just refilled"))
    }

    fn act_ahead(&mut self, observation: &Observation) -> Result<Vec<Vec<f32>>> {
        let first = self.act(observation)?;
        Ok(std::iter::once(first).chain(self.queue.drain(..)).collect())
    }

    fn reset(&mut self) {
        self.queue.clear();
        self.policy.reset();
    }
}

/// Asks at every step and averages all predictions made for it, weight `exp(-coefficient * i)` with i = 0 the oldest
/// (ACT, arXiv 2304.13705, algorithm 2; the online form is LeRobot's).
#[derive(Debug)]
pub struct TemporalEnsemble<P> {
    policy: P,
    coefficient: f64,
    /// running averages of the steps to come, oldest first, and how many predictions are in each
    ahead: VecDeque<(Vec<f64>, usize)>,
}

impl<P: Policy> TemporalEnsemble<P> {
    /// LeRobot and the paper use a coefficient of 0.01.
    ///
    /// # Errors
    /// If the coefficient is not finite.
    pub fn new(policy: P, coefficient: f64) -> Result<Self> {
        if !coefficient.is_finite() {
            return Err(ModelError::Config {
                model: "temporal ensemble",
                field: "coefficient",
                found: coefficient.to_string(),
                expected: "a finite number".to_string(),
            });
        }
        Ok(Self { policy, coefficient, ahead: VecDeque::new() })
    }

    /// The wrapped policy.
    pub fn policy(&self) -> &P {
        &self.policy
    }
}

impl<P: Policy> Actor for TemporalEnsemble<P> {
    fn act(&mut self, observation: &Observation) -> Result<Vec<f32>> {
        let chunk = self.policy.predict(observation)?;
        let weight = |i: usize| (-self.coefficient * i as f64).exp();
        let total = |n: usize| (0..n).map(weight).sum::<f64>();
        for (i, row) in chunk.rows().enumerate() {
            match self.ahead.get_mut(i) {
                Some((average, count)) => {
                    let (before, new) = (total(*count), weight(*count));
                    for (a, &x) in average.iter_mut().zip(row) {
                        *a = (*a * before + f64::from(x) * new) / (before + new);
                    }
                    *count += 1;
                }
                None => self.ahead.push_back((row.iter().map(|&x| f64::from(x)).collect(), 1)),
            }
        }
        let (now, _) = self.ahead.pop_front().expect("a chunk has at least one row");
        Ok(now.into_iter().map(|x| x as f32).collect())
    }

    fn reset(&mut self) {
        self.ahead.clear();
        self.policy.reset();
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use proptest::prelude::*;

    /// Plays back given chunks.
    struct Tape {
        chunks: Vec<Vec<f32>>,
        dim: usize,
        at: usize,
    }

    impl Policy for Tape {
        fn predict(&mut self, _: &Observation) -> Result<ActionChunk> {
            let actions = self.chunks[self.at].clone();
            self.at += 1;
            let horizon = actions.len() / self.dim;
            ActionChunk::new(actions, horizon, self.dim)
        }
        fn reset(&mut self) {
            self.at = 0;
        }
    }

    fn tape(steps: usize, horizon: usize, dim: usize, values: &[f32]) -> Tape {
        let chunks = (0..steps)
            .map(|t| (0..horizon * dim).map(|i| values[(t * 31 + i * 7) % values.len()] + i as f32).collect())
            .collect();
        Tape { chunks, dim, at: 0 }
    }

    proptest! {
        #[test]
        fn the_ensemble_is_the_offline_weighted_mean(
            steps in 1usize..20, horizon in 1usize..7, dim in 1usize..4, m in -0.5f64..2.0,
            values in proptest::collection::vec(-3f32..3.0, 5..40),
        ) {
            let tape = tape(steps, horizon, dim, &values);
            let chunks = tape.chunks.clone();
            let mut actor = TemporalEnsemble::new(tape, m).unwrap();
            for t in 0..steps {
                let got = actor.act(&Observation::default()).unwrap();
                // every chunk made at u <= t that reaches t, oldest first
                let first = (t + 1).saturating_sub(horizon);
                for d in 0..dim {
                    let (mut sum, mut weights) = (0.0, 0.0);
                    for (i, u) in (first..=t).enumerate() {
                        let w = (-m * i as f64).exp();
                        sum += w * f64::from(chunks[u][(t - u) * dim + d]);
                        weights += w;
                    }
                    prop_assert!((f64::from(got[d]) - sum / weights).abs() < 1e-4);
                }
            }
        }

        #[test]
        fn the_receding_horizon_plays_the_head_of_each_chunk(
            queries in 1usize..6, horizon in 1usize..7, dim in 1usize..4, executed in 1usize..7,
            values in proptest::collection::vec(-3f32..3.0, 5..40),
        ) {
            let tape = tape(queries, horizon, dim, &values);
            let chunks = tape.chunks.clone();
            let mut actor = RecedingHorizon::new(tape, executed).unwrap();
            if executed > horizon {
                prop_assert!(actor.act(&Observation::default()).is_err());
                return Ok(());
            }
            for t in 0..queries * executed {
                let (query, row) = (t / executed, t % executed);
                prop_assert_eq!(actor.is_due(), row == 0);
                let got = actor.act(&Observation::default()).unwrap();
                prop_assert_eq!(&got[..], &chunks[query][row * dim..(row + 1) * dim]);
            }
        }
    }

    #[test]
    fn reset_forgets_the_episode() {
        let chunks = vec![vec![1.0, 2.0, 3.0], vec![5.0, 6.0, 7.0]];
        let mut actor = TemporalEnsemble::new(Tape { chunks, dim: 1, at: 0 }, 0.01).unwrap();
        let first = actor.act(&Observation::default()).unwrap();
        actor.act(&Observation::default()).unwrap();
        actor.reset();
        assert_eq!(actor.act(&Observation::default()).unwrap(), first);
    }
}
