//! Checks of what comes into a model, each naming what does not fit.

use crate::batch::Batch;
use crate::features::{FeatureKind, Features, Signature};
use candle_core::{DType, Tensor};
use nn::{ModelError, Result};

pub(crate) fn check_shape(
    operation: &'static str,
    object: &'static str,
    tensor: &Tensor,
    expected: &[usize],
) -> Result<()> {
    if tensor.dims() == expected {
        return Ok(());
    }
    let (expected, found) = (expected.to_vec(), tensor.dims().to_vec());
    Err(ModelError::Shape { operation, object, expected, found })
}

/// Checks that a model which reads `reads`, and a state in any case, can be built for the signature.
pub(crate) fn check_signature(model: &'static str, signature: &Signature, reads: &[FeatureKind]) -> Result<()> {
    signature.check(model, reads)?;
    if signature.of_kind(FeatureKind::State).next().is_none() {
        let names: Vec<&str> = signature.observation.iter().map(|spec| spec.name.as_str()).collect();
        let found = if names.is_empty() { "empty".to_string() } else { names.join(", ") };
        let expected = "a feature of kind state among others".to_string();
        return Err(ModelError::Config { model, field: "observation", found, expected });
    }
    Ok(())
}

/// Checks the weight of a part of a loss.
pub(crate) fn check_weight(model: &'static str, field: &'static str, weight: f64) -> Result<()> {
    if weight.is_finite() && weight >= 0.0 {
        return Ok(());
    }
    let (found, expected) = (weight.to_string(), "a finite number, at least 0".to_string());
    Err(ModelError::Config { model, field, found, expected })
}

/// Checks a batch of windows against the model's signature.
pub(crate) fn check_batch(
    operation: &'static str,
    signature: &Signature,
    action_horizon: usize,
    batch: &Batch,
) -> Result<()> {
    let rows = check_observation(operation, signature, &batch.observation)?;
    let expected = [rows, action_horizon, signature.action_dim];
    check_shape(operation, "actions", &batch.actions, &expected)?;
    check_shape(operation, "is_pad", &batch.is_pad, &expected[..2])
}

/// Checks that the features are the signature's, each (b, …) in its shape; returns b.
pub(crate) fn check_observation(
    operation: &'static str,
    signature: &Signature,
    observation: &Features<Tensor>,
) -> Result<usize> {
    let rows = observation.iter().next().and_then(|(_, tensor)| tensor.dims().first().copied()).unwrap_or(0).max(1);
    for spec in &signature.observation {
        let tensor = observation.require(operation, &spec.name)?;
        // what was prepared already has the size of what is seen
        if spec.kind == FeatureKind::Image && tensor.dtype() == DType::F32 && tensor.dims().first() == Some(&rows) {
            continue;
        }
        let expected = signature.batch_shape(spec, rows);
        if tensor.dims() != expected {
            let (name, found) = (spec.name.clone(), tensor.dims().to_vec());
            return Err(ModelError::FeatureShape { operation, name, expected, found });
        }
    }
    if let Some(name) = observation.names().find(|name| signature.get(name).is_none()) {
        let names: Vec<&str> = signature.observation.iter().map(|spec| spec.name.as_str()).collect();
        return Err(ModelError::Input {
            operation,
            object: "observation",
            found: format!("with feature {name}"),
            expected: format!("{} alone", names.join(", ")),
        });
    }
    Ok(rows)
}
