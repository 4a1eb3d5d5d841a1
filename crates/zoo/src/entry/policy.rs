//! An entry as a policy: shared weights, one small state an environment.

use std::sync::Arc;

use candle_core::{Device, Tensor};
use models::{
    ACTION, ActionChunk, Dims, ENVIRONMENT_STATE, ModelError, Normaliser, Observation, Policy, PolicyModel, STATE,
};

use crate::experiment::Experiment;
use crate::{ZooError, tensors};

use super::{Entry, MODEL_FILE, NORMALISER_FILE};

/// An entry's weights and normaliser in memory, shared by every environment.
#[derive(Clone)]
pub struct LoadedEntry {
    entry: Entry,
    experiment: Experiment,
    model: Arc<dyn PolicyModel>,
    normaliser: Arc<Normaliser>,
}

impl Entry {
    /// Reads weights and normaliser. Every tensor must be there, in its shape, and no other.
    ///
    /// # Errors
    /// What does not fit, by name.
    pub fn load(&self) -> Result<LoadedEntry, ZooError> {
        if !self.meta().is_robot_policy() {
            return Err(ZooError::UnfitEntry {
                entry: self.id().to_string(),
                task: self.meta().task.clone(),
                what: "kind of entry".to_owned(),
                expected: "a robot policy".to_owned(),
                found: self.meta().kind.clone().unwrap_or_else(|| "another kind".to_owned()),
            });
        }
        let experiment = Experiment::from_toml(&self.id().to_string(), &self.config_text()?)?;
        let failed = |operation| {
            let name = self.id().to_string();
            move |source| ZooError::Model { operation, name, source }
        };
        let dims = self.meta().dims;
        let model = experiment.policy.build(&dims, 0).map_err(failed("build the policy of"))?;
        let (weights, _) = tensors::read(&self.folder().join(MODEL_FILE))?;
        model.params().load(&weights).map_err(failed("load the weights of"))?;
        let (statistics, _) = tensors::read(&self.folder().join(NORMALISER_FILE))?;
        let modes = experiment.normalisation.modes(dims.environment_state > 0);
        let normaliser = Normaliser::new(&modes, &statistics).map_err(failed("load the normaliser of"))?;
        Ok(LoadedEntry { entry: self.clone(), experiment, model: model.into(), normaliser: Arc::new(normaliser) })
    }
}

impl LoadedEntry {
    /// The entry.
    pub fn entry(&self) -> &Entry {
        &self.entry
    }

    /// The experiment that it was made by.
    pub fn experiment(&self) -> &Experiment {
        &self.experiment
    }

    /// The network.
    pub fn model(&self) -> &Arc<dyn PolicyModel> {
        &self.model
    }

    /// The statistics.
    pub fn normaliser(&self) -> &Arc<Normaliser> {
        &self.normaliser
    }

    /// A policy for one environment; it shares the weights with all others.
    pub fn policy(&self) -> EntryPolicy {
        EntryPolicy {
            model: Arc::clone(&self.model),
            normaliser: Arc::clone(&self.normaliser),
            dims: self.entry.meta().dims,
        }
    }
}

/// One environment's policy: raw observation in, raw action chunk out.
#[derive(Clone)]
pub struct EntryPolicy {
    model: Arc<dyn PolicyModel>,
    normaliser: Arc<Normaliser>,
    dims: Dims,
}

impl EntryPolicy {
    fn input(&self, feature: &'static str, values: &[f32], dim: usize) -> Result<Tensor, ModelError> {
        if values.len() != dim {
            return Err(ModelError::Shape {
                operation: "predict",
                object: feature,
                expected: vec![dim],
                found: vec![values.len()],
            });
        }
        let mut values = values.to_vec();
        self.normaliser.normalise(feature, &mut values)?;
        Ok(Tensor::from_vec(values, (1, dim), &Device::Cpu)?)
    }
}

impl Policy for EntryPolicy {
    fn predict(&mut self, observation: &Observation) -> Result<ActionChunk, ModelError> {
        let state = self.input(STATE, &observation.state, self.dims.state)?;
        let environment_state = match self.dims.environment_state {
            0 => None,
            dim => Some(self.input(ENVIRONMENT_STATE, &observation.environment_state, dim)?),
        };
        let chunk = self.model.predict(&state, environment_state.as_ref())?;
        let mut actions = chunk.flatten_all()?.to_vec1::<f32>()?;
        self.normaliser.unnormalise(ACTION, &mut actions)?;
        ActionChunk::new(actions, self.model.action_horizon(), self.dims.action)
    }

    fn reset(&mut self) {}
}
