//! An entry's weights in memory, and policies that share them.

use std::collections::BTreeMap;
use std::sync::Arc;

use candle_core::Tensor;
use models::actrm::{Actrm, Thinking};
use models::{Backend, ModelError, Normaliser, Policy, PolicyModel, Preprocess, Signature};

use crate::evaluation::WallClock;
use crate::experiment::Experiment;
use crate::{ZooError, tensors};

use super::{Entry, EntryId, MODEL_FILE, NORMALISER_FILE};

/// An entry's weights and normaliser in memory, shared by every environment.
#[derive(Clone)]
pub struct LoadedEntry {
    entry: Entry,
    experiment: Experiment,
    model: Arc<dyn PolicyModel>,
    preprocess: Arc<Preprocess>,
}

impl Entry {
    /// Reads weights and normaliser, to predict on the CPU. Every tensor must be there, in its shape, and no other.
    ///
    /// # Errors
    /// What does not fit, by name.
    pub fn load(&self) -> Result<LoadedEntry, ZooError> {
        self.load_on(&Backend::CPU)
    }

    /// [`Self::load`], to predict on another device.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn load_on(&self, backend: &Backend) -> Result<LoadedEntry, ZooError> {
        if self.meta().is_external() {
            return Err(ZooError::External { entry: self.id().to_string() });
        }
        self.meta().require_policy("a robot policy")?;
        let experiment = Experiment::from_toml(&self.id().to_string(), &self.config_text()?)?;
        let (weights, _) = tensors::read(&self.folder().join(MODEL_FILE))?;
        let (statistics, _) = tensors::read(&self.folder().join(NORMALISER_FILE))?;
        let signature = &self.meta().signature;
        let (model, preprocess) = assemble(&self.id(), &experiment, signature, &weights, &statistics, backend)?;
        Ok(LoadedEntry { entry: self.clone(), experiment, model, preprocess })
    }
}

/// The network and what its inputs and outputs go through. Every tensor must be there, in its shape, and no other.
///
/// # Errors
/// What does not fit, by name.
pub(super) fn assemble(
    id: &EntryId,
    experiment: &Experiment,
    signature: &Signature,
    weights: &BTreeMap<String, Tensor>,
    statistics: &BTreeMap<String, Tensor>,
    backend: &Backend,
) -> Result<(Arc<dyn PolicyModel>, Arc<Preprocess>), ZooError> {
    let failed = |operation| move |source| ZooError::Model { operation, name: id.to_string(), source };
    experiment.policy.check_size(weights).map_err(failed("load the weights of"))?;
    let model = experiment.policy.build(signature, 0, backend).map_err(failed("build the policy of"))?;
    model.params().load(weights).map_err(failed("load the weights of"))?;
    let modes = experiment.normalisation.modes(signature);
    let preprocess = Normaliser::new(&modes, statistics)
        .and_then(|normaliser| Preprocess::new(signature.clone(), normaliser, model.params().device()))
        .map_err(failed("load the normaliser of"))?;
    Ok((model.into(), Arc::new(preprocess)))
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

    /// Raw values to what the network reads, and back.
    pub fn preprocess(&self) -> &Arc<Preprocess> {
        &self.preprocess
    }

    /// The same weights in a policy that thinks as `thinking` says.
    ///
    /// # Errors
    /// A policy that cannot think so.
    pub fn thinking(&self, thinking: &Thinking) -> Result<Self, ZooError> {
        let failed = |source| self.failed("change the refinement steps of", source);
        let policy = self.experiment.policy.thinking(thinking).map_err(failed)?;
        let model = policy.build(&self.entry.meta().signature, 0, self.model.params().backend()).map_err(failed)?;
        model.params().load(&self.model.params().tensors()).map_err(failed)?;
        let experiment = Experiment { policy, ..self.experiment.clone() };
        Ok(Self { experiment, model: model.into(), ..self.clone() })
    }

    /// The network of a policy that thinks step by step, to look into its thoughts; `None` of the others.
    ///
    /// # Errors
    /// When a tensor operation fails.
    pub fn reasoner(&self) -> Result<Option<Arc<Actrm>>, ZooError> {
        let Some(config) = self.experiment.policy.reasoner() else { return Ok(None) };
        let failed = |source| self.failed("build the policy of", source);
        let model =
            Actrm::new(config, &self.entry.meta().signature, 0, self.model.params().backend()).map_err(failed)?;
        model.params().load(&self.model.params().tensors()).map_err(failed)?;
        Ok(Some(Arc::new(model)))
    }

    /// An error of the model, with the entry's name.
    pub fn failed(&self, operation: &'static str, source: ModelError) -> ZooError {
        ZooError::Model { operation, name: self.entry.id().to_string(), source }
    }

    /// A policy for one environment, with a state of its own; it shares the weights with all others.
    pub fn policy(&self) -> Box<dyn Policy> {
        Arc::clone(&self.model).policy(Arc::clone(&self.preprocess), Box::new(WallClock::new()))
    }
}
