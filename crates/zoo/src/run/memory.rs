//! What a model keeps of the demonstrations themselves.

use dataset::{WindowBatch, Windows};
use models::{Batch, PolicyModel};

use super::data::{self, Demonstrations};
use crate::ZooError;
use crate::experiment::Experiment;

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
            windows.try_gather(&indices, &mut gathered).map_err(data::unreadable(&demonstrations.meta.name))?;
            batches.push(data::batch(&gathered, demonstrations, experiment)?);
        }
        Ok(batches)
    };
    let train = episodes(&demonstrations.train)?;
    let held_out = demonstrations.valid.as_ref().map(episodes).transpose()?.unwrap_or_default();
    memory.remember(&train, &held_out).map_err(experiment.model_error("show the demonstrations to"))
}
