//! What an image encoder begins with: the data set's colours, weights that the experiment names.

use std::path::Path;

use models::PolicyModel;
use models::encoders::{ImageEncoder, Normalisation};

use super::data::{Demonstrations, locate};
use crate::experiment::Experiment;
use crate::{ZooError, tensors};

/// Sets what the experiment's `[policy.vision]` says of a model that was just built.
///
/// # Errors
/// A data set without statistics of its pictures, a file of weights that does not fit.
pub(super) fn open(
    model: &dyn PolicyModel,
    demonstrations: &Demonstrations,
    experiment: &Experiment,
) -> Result<(), ZooError> {
    let Some(vision) = model.vision() else { return Ok(()) };
    if vision.normalise == Normalisation::Dataset {
        let statistics = demonstrations.picture_statistics.as_ref().ok_or_else(|| ZooError::InvalidValue {
            key: "policy.vision.normalise".to_owned(),
            expected: "imagenet or unit: the data set has no statistics of its pictures".to_owned(),
            found: "dataset".to_owned(),
        })?;
        let (mean, std): (Vec<_>, Vec<_>) = statistics.iter().copied().unzip();
        ImageEncoder::set_statistics(model.params(), &mean, &std)
            .map_err(experiment.model_error("take the statistics of pictures for"))?;
    }
    if let Some(path) = &vision.weights {
        let (weights, _) = tensors::read(&locate(Path::new(path))?)?;
        ImageEncoder::load_backbone(model.params(), vision.norm, &weights)
            .map_err(experiment.model_error("take the image encoder's weights for"))?;
    }
    Ok(())
}
