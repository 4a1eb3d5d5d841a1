//! The gradients of a model, in the order of the parameters' names.

use crate::error::{ModelError, Result};
use crate::params::Params;
use crate::per_parameter::PerParameter;
use crate::simd::{sum_of_squares, vectorised};
use candle_core::{DType, Tensor};
use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

/// Where each parameter lies in a flat buffer, and whether there is one: composed operations have a tensor per parameter.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ParamLayout {
    spans: BTreeMap<String, Range<usize>>,
    len: usize,
    composed: bool,
}

impl ParamLayout {
    /// Parameters one after the other, sorted by name.
    pub fn new(params: &Params) -> Self {
        let mut len = 0;
        let mut spans = BTreeMap::new();
        for (name, var) in params.iter() {
            spans.insert(name.to_string(), len..len + var.elem_count());
            len += var.elem_count();
        }
        Self { spans, len, composed: params.backend().is_composed() }
    }

    /// Numbers in all.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there is no parameter.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Whether operations on the parameters are candle's.
    pub fn is_composed(&self) -> bool {
        self.composed
    }

    /// Names and places in order.
    pub fn iter(&self) -> impl Iterator<Item = (&str, Range<usize>)> {
        self.spans.iter().map(|(k, r)| (k.as_str(), r.clone()))
    }
}

/// One number per parameter scalar; allocated once and reused.
#[derive(Debug, Clone)]
pub struct Gradients {
    layout: Arc<ParamLayout>,
    values: PerParameter,
}

impl Gradients {
    /// All zero.
    pub fn zeros(layout: Arc<ParamLayout>) -> Self {
        let values = PerParameter::zeros(&layout);
        Self { layout, values }
    }

    /// Where each parameter lies.
    pub fn layout(&self) -> &Arc<ParamLayout> {
        &self.layout
    }

    pub(crate) fn stored(&self) -> &PerParameter {
        &self.values
    }

    /// All values of hand-written steps, in the order of the layout; none where operations are candle's.
    pub fn values(&self) -> &[f32] {
        match &self.values {
            PerParameter::Flat(values) => values,
            PerParameter::Tensors(_) => &[],
        }
    }

    /// The same.
    pub fn values_mut(&mut self) -> &mut [f32] {
        match &mut self.values {
            PerParameter::Flat(values) => values,
            PerParameter::Tensors(_) => &mut [],
        }
    }

    /// Sets everything to 0.
    pub fn clear(&mut self) {
        match &mut self.values {
            PerParameter::Flat(values) => values.fill(0.0),
            PerParameter::Tensors(tensors) => tensors.fill(None),
        }
    }

    /// The gradient of one parameter in hand-written steps.
    pub fn get(&self, name: &str) -> Option<&[f32]> {
        self.values().get(self.layout.spans.get(name)?.clone())
    }

    /// The global norm.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn norm(&self) -> Result<f64> {
        match &self.values {
            PerParameter::Flat(values) => Ok(sum_of_squares(values).sqrt()),
            PerParameter::Tensors(tensors) => {
                let squares = tensors.iter().flatten().map(|t| t.sqr()?.sum_all());
                let squares = squares.collect::<candle_core::Result<Vec<_>>>()?;
                // one transfer for all of them
                match squares.is_empty() {
                    true => Ok(0.0),
                    false => Ok(f64::from(Tensor::stack(&squares, 0)?.sum_all()?.to_scalar::<f32>()?).sqrt()),
                }
            }
        }
    }

    /// Adds the gradients of another shard.
    ///
    /// # Errors
    /// Gradients of other parameters.
    pub fn add(&mut self, other: &Self) -> Result<()> {
        if self.layout != other.layout {
            let detail = "the gradients to add are those of other parameters".to_string();
            return Err(ModelError::State { object: "gradients", detail });
        }
        if let PerParameter::Tensors(tensors) = &other.values {
            for ((name, _), grad) in other.layout.iter().zip(tensors) {
                grad.iter().try_for_each(|grad| self.add_tensor(name, grad))?;
            }
            return Ok(());
        }
        let sum = self.values_mut();
        vectorised(
            #[inline(always)]
            || sum.iter_mut().zip(other.values()).for_each(|(a, b)| *a += b),
        );
        Ok(())
    }

    /// The first parameter whose gradient is not finite, and the number found there.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn not_finite(&self) -> Result<Option<(&str, f32)>> {
        for (at, (name, span)) in self.layout.iter().enumerate() {
            let bad = |values: &[f32]| values.iter().copied().find(|x| !x.is_finite());
            let found = match &self.values {
                PerParameter::Flat(values) => bad(&values[span]),
                PerParameter::Tensors(tensors) => match &tensors[at] {
                    Some(tensor) => crate::values::with_values(tensor, bad)?,
                    None => None,
                },
            };
            if let Some(value) = found {
                return Ok(Some((name, value)));
            }
        }
        Ok(None)
    }

    /// Adds a tensor to the gradient of `name`.
    ///
    /// # Errors
    /// If there is no such parameter or the sizes differ.
    pub fn add_tensor(&mut self, name: &str, grad: &Tensor) -> Result<()> {
        let spans = &self.layout.spans;
        let span = spans.get(name).cloned().ok_or_else(|| ModelError::MissingTensor {
            name: name.to_string(),
            given: crate::error::some_names(spans.keys()),
        })?;
        if span.len() != grad.elem_count() {
            return Err(ModelError::Shape {
                operation: "add a gradient",
                object: "gradient",
                expected: vec![span.len()],
                found: grad.dims().to_vec(),
            });
        }
        match &mut self.values {
            PerParameter::Flat(values) => {
                let grad = grad.to_dtype(DType::F32)?.flatten_all()?.to_vec1::<f32>()?;
                values[span].iter_mut().zip(grad).for_each(|(a, b)| *a += b);
            }
            PerParameter::Tensors(tensors) => {
                let at = spans.keys().take_while(|known| *known != name).count();
                let sum = tensors[at].take().map_or_else(|| Ok(grad.clone()), |sum| sum + grad)?;
                tensors[at] = Some(sum.detach());
            }
        }
        Ok(())
    }
}
