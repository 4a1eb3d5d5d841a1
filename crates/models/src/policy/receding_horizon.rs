//! Executing the head of each chunk.

use super::{Actor, Observation, Policy};
use crate::error::{ModelError, Result};
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

    /// The wrapped policy.
    pub fn policy(&self) -> &P {
        &self.policy
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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::testing::tape;
    use super::*;
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
}
