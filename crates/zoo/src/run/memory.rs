//! What a model keeps of the demonstrations themselves.

use dataset::{WindowBatch, Windows};
use models::{Batch, PolicyModel};

use super::data::Demonstrations;
use crate::ZooError;
use crate::experiment::Experiment;
use crate::transforms::{Stage, unreadable};

/// Shows a model that was just built every episode, if it remembers any.
///
/// # Errors
/// Demonstrations that it cannot do without.
pub(super) fn fill(
    model: &dyn PolicyModel,
    demonstrations: &Demonstrations,
    experiment: &Experiment,
) -> Result<(), ZooError> {
    let Some(memory) = model.memory() else { return Ok(()) };
    let episodes = |windows: &Windows| -> Result<Vec<Batch>, ZooError> {
        let mut gathered = WindowBatch::default();
        let mut batches = Vec::new();
        for episode in windows.episodes() {
            let indices: Vec<u32> = episode.collect();
            windows.try_gather(&indices, &mut gathered).map_err(unreadable(&demonstrations.meta.name))?;
            batches.push(demonstrations.batch(Stage::Validation, &mut gathered, experiment)?);
        }
        Ok(batches)
    };
    let train = episodes(&demonstrations.train)?;
    let held_out = demonstrations.valid.as_ref().map(episodes).transpose()?.unwrap_or_default();
    memory.remember(&train, &held_out).map_err(experiment.model_error("show the demonstrations to"))
}
