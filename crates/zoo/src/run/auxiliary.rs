//! What training alone is told: `data.auxiliary_keys`, asked by `policy.auxiliary`.
//!
//! The keys make a column of the data set as those of an entity do. It is no feature of the policy: its numbers, by mean and
//! deviation, go beside the batch, and nobody sends them when the policy acts.

use std::collections::BTreeMap;

use candle_core::Tensor;
use dataset::{WindowBatch, Windows};
use models::{ENTITY_PREFIX, ModelError, NormMode, Normaliser};

use crate::experiment::{AUXILIARY, Experiment};

/// Whether a column of the windows is told in training alone.
pub(super) fn is_told(column: &str) -> bool {
    column.strip_prefix(ENTITY_PREFIX) == Some(AUXILIARY)
}

/// The statistics of what is told; nothing where nobody asks.
#[derive(Debug, Default)]
pub(crate) struct Told(Option<(String, usize, Normaliser)>);

impl Told {
    /// `statistics` are those of the episodes trained on, by column.
    ///
    /// # Errors
    /// Statistics that are missing or not finite.
    pub fn new(
        experiment: &Experiment,
        windows: &Windows,
        statistics: &BTreeMap<String, Tensor>,
    ) -> Result<Self, ModelError> {
        let Some((column, width)) = windows.observation().find(|(column, _)| is_told(column)) else {
            return Ok(Self::default());
        };
        debug_assert!(experiment.policy.auxiliary().is_some(), "an experiment that was checked");
        let mut normaliser = Normaliser::new(&[(column.to_owned(), NormMode::MeanStd)].into(), statistics)?;
        normaliser.guard_constant();
        Ok(Self(Some((column.to_owned(), width, normaliser))))
    }

    /// Of a batch of windows, at their last observation: (n, K); `None` where nobody asks.
    ///
    /// # Errors
    /// When a tensor cannot be made.
    pub fn of(&self, windows: &WindowBatch) -> Result<Option<Tensor>, ModelError> {
        let Some((column, width, normaliser)) = &self.0 else { return Ok(None) };
        let all = windows.column(column).expect("the windows show what statistics were taken of");
        let last = |history: &[f32]| history[history.len() - width..].to_vec();
        let mut values: Vec<f32> = all.chunks_exact(width * windows.n_obs_steps).flat_map(last).collect();
        normaliser.normalise(column, &mut values)?;
        Ok(Some(Tensor::from_vec(values, (windows.n, *width), &candle_core::Device::Cpu)?))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn the_last_observation_is_told_by_mean_and_deviation() {
        let column = format!("{ENTITY_PREFIX}{AUXILIARY}");
        assert!(is_told(&column) && !is_told("observation.entity.cube") && !is_told(AUXILIARY));
        let numbers = |values: &[f32]| Tensor::from_slice(values, 2, &candle_core::Device::Cpu).unwrap();
        let statistics = [("mean", [1.0, 10.0]), ("std", [2.0, 5.0])];
        let statistics = statistics.map(|(name, values)| (format!("{column}.{name}"), numbers(&values))).into();
        let normaliser = Normaliser::new(&[(column.clone(), NormMode::MeanStd)].into(), &statistics).unwrap();
        let told = Told(Some((column.clone(), 2, normaliser)));
        // two windows of two observations of two numbers
        let observation = vec![(column, vec![9.0, 9.0, 3.0, 20.0, 9.0, 9.0, -1.0, 5.0])];
        let batch = WindowBatch { n: 2, n_obs_steps: 2, observation, indices: vec![0, 1], ..WindowBatch::default() };
        assert_eq!(told.of(&batch).unwrap().unwrap().to_vec2::<f32>().unwrap(), [[1.0, 2.0], [-1.0, -1.0]]);
        assert!(Told::default().of(&batch).unwrap().is_none());
    }
}
