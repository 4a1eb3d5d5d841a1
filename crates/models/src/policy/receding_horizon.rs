//! Executing the head of each chunk.

use super::{Actor, Observation, Policy};
use nn::{ModelError, Result};
use std::collections::VecDeque;

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
        } else {
            self.policy.observe(observation);
        }
        self.policy.executed(1);
        Ok(self.queue.pop_front().expect("a chunk has at least one row, and it was just refilled"))
    }

    fn act_ahead(&mut self, observation: &Observation) -> Result<Vec<Vec<f32>>> {
        let first = self.act(observation)?;
        // the steps before the next query matter as far as the policy looks back from it
        let ahead = self.queue.len().saturating_sub(self.policy.n_obs_steps() - 1);
        self.policy.executed(ahead);
        Ok(std::iter::once(first).chain(self.queue.drain(..ahead)).collect())
    }

    fn reset(&mut self, seed: u64) {
        self.queue.clear();
        self.policy.reset(seed);
    }

    fn instruct(&mut self, instruction: Option<&str>) {
        self.policy.instruct(instruction);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::ActionChunk;
    use super::super::testing::tape;
    use super::*;
    use crate::features::Values;
    use crate::normaliser::STATE;
    use proptest::prelude::*;

    proptest! {
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
                let got = actor.act(&Observation::default()).unwrap();
                prop_assert_eq!(&got[..], &chunks[query][row * dim..(row + 1) * dim]);
            }
        }
    }

    /// Answers with the numbers of the steps that it sees.
    struct Looking {
        back: usize,
        seen: Vec<f32>,
        executed: Vec<usize>,
    }

    impl Looking {
        fn see(&mut self, observation: &Observation) {
            let Some(Values::F32(now)) = observation.get(STATE) else { panic!("{observation:?}") };
            self.seen.push(now[0]);
        }
    }

    impl Policy for Looking {
        fn predict(&mut self, observation: &Observation) -> Result<ActionChunk> {
            self.see(observation);
            self.executed.push(0);
            let from = self.seen.len().saturating_sub(self.back);
            let shown = self.seen[from..].to_vec();
            let dim = shown.len();
            ActionChunk::new(shown.repeat(6), 6, dim)
        }
        fn n_obs_steps(&self) -> usize {
            self.back
        }
        fn observe(&mut self, observation: &Observation) {
            self.see(observation);
        }
        fn executed(&mut self, actions: usize) {
            *self.executed.last_mut().unwrap() += actions;
        }
        fn reset(&mut self, _seed: u64) {
            self.seen.clear();
        }
    }

    #[test]
    fn a_policy_that_looks_back_sees_the_steps_before_its_query() {
        for back in 1..5 {
            let mut actor = RecedingHorizon::new(Looking { back, seen: Vec::new(), executed: Vec::new() }, 3).unwrap();
            let (mut step, mut calls) = (0_usize, 0);
            while step < 12 {
                let actions = actor.act_ahead(&Observation::of_state(vec![step as f32], vec![])).unwrap();
                let query = step / 3 * 3;
                let seen: Vec<f32> = ((query + 1).saturating_sub(back)..=query).map(|k| k as f32).collect();
                assert!(actions.iter().all(|action| *action == seen), "back {back}, step {step}: {actions:?}");
                (step, calls) = (step + actions.len(), calls + 1);
            }
            // alone, one exchange a query; else what it has to see comes one by one
            assert_eq!((step, calls), (12, 4 * back.min(3)));
            assert_eq!(actor.policy.executed, [3; 4]);
        }
    }
}
