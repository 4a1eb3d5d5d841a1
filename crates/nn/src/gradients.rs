//! The gradients of a model, in the order of the parameters' names.

use crate::backend::Backend;
use crate::error::{ModelError, Result};
use crate::number::Number;
use crate::params::Params;
use crate::per_parameter::{PerParameter, joined};
use crate::simd::{sum_of_squares, vectorised};
use crate::values::with_values;
use candle_core::backprop::GradStore;
use candle_core::{Device, Var};
use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

/// Where each parameter lies in a flat buffer, and where that is.
#[derive(Debug, Clone)]
pub struct ParamLayout {
    spans: BTreeMap<String, Range<usize>>,
    len: usize,
    backend: Backend,
}

impl PartialEq for ParamLayout {
    fn eq(&self, other: &Self) -> bool {
        self.spans == other.spans
            && self.is_composed() == other.is_composed()
            && self.device().same_device(other.device())
    }
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
        Self { spans, len, backend: params.backend().clone() }
    }

    /// Numbers in all.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there is no parameter.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Whether operations on the parameters are candle's, if there are any.
    pub fn is_composed(&self) -> bool {
        self.backend.is_composed() && self.len > 0
    }

    /// Where the parameters are.
    pub fn device(&self) -> &Device {
        self.backend.device()
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
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn zeros(layout: Arc<ParamLayout>) -> Result<Self> {
        let values = PerParameter::zeros(&layout)?;
        Ok(Self { layout, values })
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
            PerParameter::Tensor(_) => &[],
        }
    }

    /// The same.
    pub fn values_mut(&mut self) -> &mut [f32] {
        match &mut self.values {
            PerParameter::Flat(values) => values,
            PerParameter::Tensor(_) => &mut [],
        }
    }

    /// Sets everything to 0.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn clear(&mut self) -> Result<()> {
        match &mut self.values {
            PerParameter::Flat(values) => values.fill(0.0),
            PerParameter::Tensor(values) => *values = values.zeros_like()?,
        }
        Ok(())
    }

    /// All values, in the order of the layout, wherever they are.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn read(&self) -> Result<Vec<f32>> {
        match &self.values {
            PerParameter::Flat(values) => Ok(values.clone()),
            PerParameter::Tensor(values) => with_values(values, <[f32]>::to_vec),
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
    pub fn norm(&self) -> Result<Number> {
        Ok(match &self.values {
            PerParameter::Flat(values) => Number::Here(sum_of_squares(values).sqrt()),
            PerParameter::Tensor(_) if self.layout.is_empty() => Number::Here(0.0),
            PerParameter::Tensor(values) => Number::There(values.sqr()?.sum_all()?.sqrt()?),
        })
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
        match (&mut self.values, &other.values) {
            (PerParameter::Tensor(sum), PerParameter::Tensor(other)) => *sum = (&*sum + other)?,
            _ => {
                let sum = self.values_mut();
                vectorised(
                    #[inline(always)]
                    || sum.iter_mut().zip(other.values()).for_each(|(a, b)| *a += b),
                );
            }
        }
        Ok(())
    }

    /// The first parameter whose gradient is not finite, and the number found there.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn not_finite(&self) -> Result<Option<(&str, f32)>> {
        let bad = |values: &[f32]| {
            let first = |(name, span): (_, Range<usize>)| {
                let found = values[span].iter().copied().find(|x| !x.is_finite());
                found.map(|value| (name, value))
            };
            self.layout.iter().find_map(first)
        };
        match &self.values {
            PerParameter::Flat(values) => Ok(bad(values)),
            PerParameter::Tensor(values) => with_values(values, bad),
        }
    }

    /// Adds the gradients that candle's backward pass found.
    ///
    /// # Errors
    /// A parameter that the loss does not reach.
    pub fn add_graph(&mut self, params: &Params, found: &GradStore) -> Result<()> {
        self.check_parameters(params)?;
        let grads = params
            .iter()
            .map(|(name, var)| found.get(var).ok_or_else(|| ModelError::NoGradient { name: name.to_string() }));
        let grads = grads.collect::<Result<Vec<_>>>()?;
        match &mut self.values {
            PerParameter::Flat(values) => {
                let mut rest = values.as_mut_slice();
                for grad in grads {
                    let (sum, tail) = rest.split_at_mut(grad.elem_count());
                    rest = tail;
                    with_values(grad, |grad| sum.iter_mut().zip(grad).for_each(|(a, b)| *a += b))?;
                }
            }
            PerParameter::Tensor(_) if grads.is_empty() => {}
            PerParameter::Tensor(sum) => *sum = (&*sum + joined(grads.into_iter().cloned())?)?.detach(),
        }
        Ok(())
    }

    fn check_parameters(&self, params: &Params) -> Result<()> {
        let sizes = |(name, var): (_, &Var)| (name, var.elem_count());
        let own = self.layout.iter().map(|(name, span)| (name, span.len()));
        if params.iter().map(sizes).eq(own) {
            return Ok(());
        }
        let detail = "the gradients to add are those of other parameters".to_string();
        Err(ModelError::State { object: "gradients", detail })
    }
}
