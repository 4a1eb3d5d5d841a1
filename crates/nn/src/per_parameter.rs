//! Numbers kept beside the parameters: gradients, moments, a moving average.

use crate::error::{ModelError, Result};
use crate::gradients::ParamLayout;
use crate::params::Params;
use crate::values::with_values;
use candle_core::{DType, Tensor};
use std::collections::BTreeMap;

/// A number for every number of the parameters, in the order of the parameters' names.
#[derive(Debug, Clone)]
pub enum PerParameter {
    /// where hand-written kernels run
    Flat(Vec<f32>),
    /// on the parameters' device, (n), where operations are candle's: one tensor, so that a step has few of them
    Tensor(Tensor),
}

impl PerParameter {
    /// Zeros.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn zeros(layout: &ParamLayout) -> Result<Self> {
        Ok(match layout.is_composed() {
            false => Self::Flat(vec![0.0; layout.len()]),
            true => Self::Tensor(Tensor::zeros(layout.len(), DType::F32, layout.device())?),
        })
    }

    /// The parameters' own values, copied.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn copy_of(params: &Params, layout: &ParamLayout) -> Result<Self> {
        if layout.is_composed() {
            return Ok(Self::Tensor(joined(params.iter().map(|(_, var)| var.as_detached_tensor()))?));
        }
        let mut values = Vec::with_capacity(layout.len());
        for (_, var) in params.iter() {
            with_values(var.as_tensor(), |v| values.extend_from_slice(v))?;
        }
        Ok(Self::Flat(values))
    }

    /// From saved tensors named `<kind>.<parameter>`.
    ///
    /// # Errors
    /// A tensor that is missing or of the wrong size.
    pub fn restored(
        params: &Params,
        layout: &ParamLayout,
        kind: &str,
        saved: &BTreeMap<String, Tensor>,
    ) -> Result<Self> {
        let mut values = Vec::with_capacity(layout.len());
        for (parameter, var) in params.iter() {
            let name = format!("{kind}.{parameter}");
            let tensor = saved.get(&name).ok_or_else(|| ModelError::MissingTensor {
                name: name.clone(),
                given: crate::error::some_names(saved.keys()),
            })?;
            if tensor.elem_count() != var.elem_count() {
                let (expected, found) = (vec![var.elem_count()], tensor.dims().to_vec());
                return Err(ModelError::MisshapenTensor { name, expected, found });
            }
            with_values(tensor, |v| values.extend_from_slice(v))?;
        }
        Ok(match layout.is_composed() {
            false => Self::Flat(values),
            true => Self::Tensor(Tensor::from_vec(values, layout.len(), layout.device())?),
        })
    }

    /// Copies as tensors of the parameters' shapes, with the parameters' names.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn named<'a>(&self, params: &'a Params, layout: &ParamLayout) -> Result<Vec<(&'a str, Tensor)>> {
        let each = params.iter().zip(layout.iter()).map(|((name, var), (_, span))| {
            let tensor = match self {
                Self::Flat(values) => Tensor::from_slice(&values[span], var.dims(), var.device())?,
                Self::Tensor(values) => values.narrow(0, span.start, span.len())?.reshape(var.dims())?.copy()?,
            };
            Ok((name, tensor))
        });
        each.collect()
    }
}

/// Tensors one after the other: (n)
pub(crate) fn joined(tensors: impl Iterator<Item = Tensor>) -> Result<Tensor> {
    let flat = tensors.map(|tensor| tensor.flatten_all()).collect::<candle_core::Result<Vec<_>>>()?;
    Ok(Tensor::cat(&flat, 0)?)
}
