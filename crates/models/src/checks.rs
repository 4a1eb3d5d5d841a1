//! Checks of what comes into a model, each naming what does not fit.

use crate::batch::{Batch, Dims};
use crate::error::{ModelError, Result};
use candle_core::Tensor;

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

/// Checks that there is something to see and something to do.
pub(crate) fn check_dims(model: &'static str, dims: &Dims) -> Result<()> {
    for (field, size) in [("dims.state", dims.state), ("dims.action", dims.action)] {
        if size == 0 {
            let expected = "at least 1".to_string();
            return Err(ModelError::Config { model, field, found: "0".to_string(), expected });
        }
    }
    Ok(())
}

/// Checks a batch of windows against the model's sizes.
pub(crate) fn check_batch(operation: &'static str, dims: &Dims, action_horizon: usize, batch: &Batch) -> Result<()> {
    check_observation(operation, dims, &batch.state, batch.environment_state.as_ref())?;
    let expected = [batch.rows(), action_horizon, dims.action];
    check_shape(operation, "actions", &batch.actions, &expected)?;
    check_shape(operation, "is_pad", &batch.is_pad, &expected[..2])
}

/// Checks `state: (b, S)` and `environment_state: (b, E)` against the model's sizes.
pub(crate) fn check_observation(
    operation: &'static str,
    dims: &Dims,
    state: &Tensor,
    environment_state: Option<&Tensor>,
) -> Result<()> {
    let b = state.dims().first().copied().unwrap_or(0).max(1);
    check_shape(operation, "state", state, &[b, dims.state])?;
    match (environment_state, dims.environment_state) {
        (None, 0) => Ok(()),
        (Some(env), e) if e > 0 => check_shape(operation, "environment_state", env, &[b, e]),
        (given, e) => Err(ModelError::Input {
            operation,
            object: "environment_state",
            found: given.map_or("absent".to_string(), |t| format!("{:?}", t.dims())),
            expected: if e == 0 { "absent".to_string() } else { format!("[{b}, {e}]") },
        }),
    }
}
