//! The validation loss: how far predictions at latent zero are from the demonstrations held out.

use candle_core::Tensor;
use dataset::{WindowBatch, Windows};
use models::{Batch, ModelError, PolicyModel};

use crate::ZooError;
use crate::experiment::Experiment;
use crate::transforms::{Stage, unreadable};

use super::data::Demonstrations;

/// Windows used, evenly spread; more would cost time and tell the same.
const MOST_WINDOWS: usize = 512;
/// Windows at once.
const BATCH: usize = 128;
/// Pixels at once, where windows have pictures: those of [`BATCH`] windows with four of 84 x 84. A network's maps take some
/// hundred bytes for each.
const PIXELS: usize = BATCH * 4 * 84 * 84;

/// Mean absolute error in network units over all steps that are not padding.
pub(super) fn validation_loss(
    model: &dyn PolicyModel,
    windows: &Windows,
    demonstrations: &Demonstrations,
    experiment: &Experiment,
) -> Result<f64, ZooError> {
    let stride = windows.len().div_ceil(MOST_WINDOWS).max(1);
    let indices: Vec<u32> = (0..windows.len()).step_by(stride).map(|i| i as u32).collect();
    let (mut sum, mut count) = (0.0, 0.0);
    let mut gathered = WindowBatch::default();
    let pixels: usize = windows.pictures().map(|(_, (height, width))| height * width).sum();
    let at_once = (PIXELS / (pixels * windows.n_obs_steps()).max(1)).clamp(1, BATCH);
    for chunk in indices.chunks(at_once) {
        windows.try_gather(chunk, &mut gathered).map_err(unreadable(&demonstrations.meta.name))?;
        let batch = demonstrations.batch(Stage::Validation, &mut gathered, experiment)?;
        let (error, entries) = absolute_error(model, &batch).map_err(experiment.model_error("validate"))?;
        sum += error;
        count += entries;
    }
    Ok(sum / count)
}

/// Sum of absolute errors and the number of entries it is over.
fn absolute_error(model: &dyn PolicyModel, batch: &Batch) -> Result<(f64, f64), ModelError> {
    let predicted = model.predict(&batch.observation)?;
    let valid: Tensor = (1.0 - &batch.is_pad)?.unsqueeze(2)?;
    let error = (predicted - &batch.actions)?.abs()?.broadcast_mul(&valid)?;
    let action_dim = batch.actions.dim(2)? as f64;
    let sum = f64::from(error.sum_all()?.to_scalar::<f32>()?);
    let steps = f64::from(valid.sum_all()?.to_scalar::<f32>()?);
    Ok((sum, steps * action_dim))
}
