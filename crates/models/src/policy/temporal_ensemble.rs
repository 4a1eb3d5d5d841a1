//! Averaging the overlapping chunks.

use super::{Actor, Observation, Policy};
use nn::{ModelError, Result};
use std::collections::VecDeque;

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
}

impl<P: Policy> Actor for TemporalEnsemble<P> {
    fn act(&mut self, observation: &Observation) -> Result<Vec<f32>> {
        let chunk = self.policy.predict(observation)?;
        self.policy.executed(1);
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

    fn reset(&mut self, seed: u64) {
        self.ahead.clear();
        self.policy.reset(seed);
    }

    fn instruct(&mut self, instruction: Option<&str>) {
        self.policy.instruct(instruction);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::testing::{Tape, tape};
    use super::*;
    use proptest::prelude::*;

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
    }

    #[test]
    fn reset_forgets_the_episode() {
        let chunks = vec![vec![1.0, 2.0, 3.0], vec![5.0, 6.0, 7.0]];
        let mut actor = TemporalEnsemble::new(Tape { chunks, dim: 1, at: 0 }, 0.01).unwrap();
        let first = actor.act(&Observation::default()).unwrap();
        actor.act(&Observation::default()).unwrap();
        actor.reset(0);
        assert_eq!(actor.act(&Observation::default()).unwrap(), first);
    }
}
