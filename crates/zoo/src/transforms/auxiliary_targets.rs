//! `data.auxiliary_keys`: targets of the auxiliary loss (`policy.auxiliary`), known in training only.
//!
//! The keys make a column of the data set as those of an entity do. It is no feature of the policy: its normalised values are a part
//! of the batch, and the policy does not get them.

use candle_core::Tensor;
use dataset::WindowBatch;
use models::{Batch, ENTITY_PREFIX, ModelError, NormMode, Normaliser};

use super::{DataSection, Fitted, Source, Transform};
use crate::ZooError;
use crate::experiment::Experiment;

/// The name of the column, as an entity's.
const AUXILIARY: &str = "auxiliary";

/// Whether a column of the windows has auxiliary targets.
pub(crate) fn is_auxiliary(column: &str) -> bool {
    column.strip_prefix(ENTITY_PREFIX) == Some(AUXILIARY)
}

pub(super) struct AuxiliaryTargets;

impl Transform for AuxiliaryTargets {
    fn name(&self) -> &'static str {
        "auxiliary_keys"
    }

    fn column<'d>(&self, data: &'d DataSection) -> Option<(&'static str, &'d Vec<String>)> {
        (!data.auxiliary_keys.is_empty()).then_some((AUXILIARY, &data.auxiliary_keys))
    }

    fn check(&self, experiment: &Experiment, _: &[String]) -> Result<(), ZooError> {
        let (keys, asked) = (&experiment.data.auxiliary_keys, experiment.policy.auxiliary().is_some());
        let invalid = |expected: &str| {
            let (key, found) = ("data.auxiliary_keys".to_owned(), keys.join(", "));
            let found = if found.is_empty() { "none".to_owned() } else { found };
            Err(ZooError::InvalidValue { key, expected: expected.to_owned(), found })
        };
        match (keys.is_empty(), asked) {
            (true, true) => return invalid("observation keys, for policy.auxiliary asks for them"),
            (false, false) => return invalid("none without policy.auxiliary"),
            (true, false) => return Ok(()),
            (false, true) => {}
        }
        // they would have to change with what is seen; a symmetry can name them
        if !experiment.data.exchange.is_empty() {
            return invalid("none with data.exchange");
        }
        match experiment.data.entities.contains_key(AUXILIARY) {
            true => invalid("none beside an entity of this name"),
            false => Ok(()),
        }
    }

    fn fit(&self, source: &Source<'_>) -> Result<Option<Box<dyn Fitted>>, ZooError> {
        let column = source.windows.observation().find(|(column, _)| is_auxiliary(column));
        let Some((column, width)) = column else { return Ok(None) };
        let mut normaliser = Normaliser::new(&[(column.to_owned(), NormMode::MeanStd)].into(), source.statistics)
            .map_err(source.experiment.model_error("take the statistics for"))?;
        normaliser.guard_constant(true);
        Ok(Some(Box::new(Targets { column: column.to_owned(), width, normaliser })))
    }
}

struct Targets {
    column: String,
    width: usize,
    normaliser: Normaliser,
}

impl Fitted for Targets {
    /// Those of the last observation: (n, K).
    fn targets(&self, windows: &WindowBatch, batch: &mut Batch) -> Result<(), ModelError> {
        batch.auxiliary = Some(self.of(windows)?);
        Ok(())
    }
}

impl Targets {
    fn of(&self, windows: &WindowBatch) -> Result<Tensor, ModelError> {
        let all = windows.column(&self.column).expect("the windows have the column that was found in them");
        let last = |history: &[f32]| history[history.len() - self.width..].to_vec();
        let mut values: Vec<f32> = all.chunks_exact(self.width * windows.n_obs_steps).flat_map(last).collect();
        self.normaliser.normalise(&self.column, &mut values)?;
        Ok(Tensor::from_vec(values, (windows.n, self.width), &candle_core::Device::Cpu)?)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn targets_are_those_of_the_last_observation_normalised() {
        let column = format!("{ENTITY_PREFIX}{AUXILIARY}");
        assert!(is_auxiliary(&column) && !is_auxiliary("observation.entity.cube") && !is_auxiliary(AUXILIARY));
        let numbers = |values: &[f32]| Tensor::from_slice(values, 2, &candle_core::Device::Cpu).unwrap();
        let statistics = [("mean", [1.0, 10.0]), ("std", [2.0, 5.0])];
        let statistics = statistics.map(|(name, values)| (format!("{column}.{name}"), numbers(&values))).into();
        let normaliser = Normaliser::new(&[(column.clone(), NormMode::MeanStd)].into(), &statistics).unwrap();
        let targets = Targets { column: column.clone(), width: 2, normaliser };
        // two windows of two observations of two numbers
        let observation = vec![(column, vec![9.0, 9.0, 3.0, 20.0, 9.0, 9.0, -1.0, 5.0])];
        let batch = WindowBatch { n: 2, n_obs_steps: 2, observation, indices: vec![0, 1], ..WindowBatch::default() };
        assert_eq!(targets.of(&batch).unwrap().to_vec2::<f32>().unwrap(), [[1.0, 2.0], [-1.0, -1.0]]);
    }
}
