//! Numbers kept beside the parameters: gradients, moments, a moving average.

use crate::error::{ModelError, Result};
use crate::gradients::ParamLayout;
use crate::params::Params;
use crate::values::with_values;
use candle_core::Tensor;
use std::collections::BTreeMap;

/// A number for every number of the parameters, in the order of the parameters' names.
#[derive(Debug, Clone)]
pub enum PerParameter {
    /// in one buffer, where hand-written kernels run
    Flat(Vec<f32>),
    /// one tensor per parameter on its device; `None` is zero
    Tensors(Vec<Option<Tensor>>),
}

impl PerParameter {
    /// Zeros.
    pub fn zeros(layout: &ParamLayout) -> Self {
        match layout.is_composed() {
            false => Self::Flat(vec![0.0; layout.len()]),
            true => Self::Tensors(vec![None; layout.iter().count()]),
        }
    }

    /// The parameters' own values, copied.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn copy_of(params: &Params, layout: &ParamLayout) -> Result<Self> {
        if layout.is_composed() {
            let copies = params.iter().map(|(_, var)| Ok(Some(var.as_detached_tensor().copy()?)));
            return Ok(Self::Tensors(copies.collect::<Result<_>>()?));
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
        let mut all = Vec::new();
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
            all.push(tensor);
        }
        if layout.is_composed() {
            let placed = all.into_iter().zip(params.iter());
            let placed =
                placed.map(|(tensor, (_, var))| Ok(Some(tensor.reshape(var.shape())?.to_device(var.device())?)));
            return Ok(Self::Tensors(placed.collect::<Result<_>>()?));
        }
        let mut values = Vec::with_capacity(layout.len());
        for tensor in all {
            with_values(tensor, |v| values.extend_from_slice(v))?;
        }
        Ok(Self::Flat(values))
    }

    /// Copies as tensors of the parameters' shapes, with the parameters' names.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn named<'a>(&self, params: &'a Params, layout: &ParamLayout) -> Result<Vec<(&'a str, Tensor)>> {
        let mut named = Vec::new();
        for (at, ((name, var), (_, span))) in params.iter().zip(layout.iter()).enumerate() {
            let tensor = match self {
                Self::Flat(values) => Tensor::from_slice(&values[span], var.dims(), var.device())?,
                Self::Tensors(tensors) => match &tensors[at] {
                    Some(tensor) => tensor.copy()?,
                    None => var.as_detached_tensor().zeros_like()?,
                },
            };
            named.push((name, tensor));
        }
        Ok(named)
    }
}
