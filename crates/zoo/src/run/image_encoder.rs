//! What an image encoder starts with: the data set's colour statistics, weights that the experiment names.

use std::path::Path;

use models::PolicyModel;
use models::encoders::{ImageEncoder, Normalisation};

use super::data::{Demonstrations, locate};
use crate::experiment::Experiment;
use crate::{ZooError, tensors};

/// Less than this of a channel's range from 0 to 1 is no spread: a step of 8 bits in one pixel of a million is more.
const LEAST_SPREAD: f32 = 1e-6;

/// Sets what the experiment's `[policy.vision]` says of a model that was just built.
///
/// # Errors
/// A data set without statistics of its pictures, a file of weights that does not fit.
pub(super) fn initialise(
    model: &dyn PolicyModel,
    demonstrations: &Demonstrations,
    experiment: &Experiment,
) -> Result<(), ZooError> {
    let Some(vision) = model.vision() else { return Ok(()) };
    if vision.normalise == Normalisation::Dataset {
        let statistics = demonstrations.image_statistics.as_ref().ok_or_else(|| ZooError::InvalidValue {
            key: "policy.vision.normalise".to_owned(),
            expected: "imagenet or unit: the data set has no statistics of its images".to_owned(),
            found: "dataset".to_owned(),
        })?;
        let (mean, std) = scales(statistics);
        ImageEncoder::set_statistics(model.params(), &mean, &std)
            .map_err(experiment.model_error("take the statistics of images for"))?;
    }
    if let Some(path) = &vision.weights {
        let weights = tensors::read_weights(&locate(Path::new(path))?)?;
        ImageEncoder::load_backbone(model.params(), vision.norm, &weights)
            .map_err(experiment.model_error("take the image encoder's weights for"))?;
    }
    Ok(())
}

/// Mean and standard deviation of every camera's channels; one that never changes gets a deviation of 1, or whatever
/// differs from it later would be blown up.
fn scales(statistics: &[([f32; 3], [f32; 3])]) -> (Vec<[f32; 3]>, Vec<[f32; 3]>) {
    let (mean, mut std): (Vec<_>, Vec<_>) = statistics.iter().copied().unzip();
    std.iter_mut().flatten().filter(|std| **std < LEAST_SPREAD).for_each(|std| *std = 1.0);
    (mean, std)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_channel_that_never_changes_is_not_blown_up() {
        let (mean, std) = scales(&[([0.5, 0.4, 0.0], [0.2, 0.1, 0.0])]);
        assert_eq!((mean, std), (vec![[0.5, 0.4, 0.0]], vec![[0.2, 0.1, 1.0]]));
    }
}
