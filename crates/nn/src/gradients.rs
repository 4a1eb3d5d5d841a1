//! The gradients of a model in one flat buffer, in the order of the parameters' names.

use crate::error::{ModelError, Result};
use crate::params::Params;
use candle_core::{DType, Tensor};
use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

/// Where each parameter lies in a flat buffer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ParamLayout {
    spans: BTreeMap<String, Range<usize>>,
    len: usize,
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
        Self { spans, len }
    }

    /// Numbers in all.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there is no parameter.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Names and places in order.
    pub fn iter(&self) -> impl Iterator<Item = (&str, Range<usize>)> {
        self.spans.iter().map(|(k, r)| (k.as_str(), r.clone()))
    }

    /// The name of the parameter that holds flat index `at`.
    pub fn name_at(&self, at: usize) -> Option<&str> {
        self.spans.iter().find(|(_, span)| span.contains(&at)).map(|(name, _)| name.as_str())
    }
}

/// One number per parameter scalar; allocated once and reused.
#[derive(Debug, Clone)]
pub struct Gradients {
    layout: Arc<ParamLayout>,
    values: Vec<f32>,
}

impl Gradients {
    /// All zero.
    pub fn zeros(layout: Arc<ParamLayout>) -> Self {
        let values = vec![0.0; layout.len()];
        Self { layout, values }
    }

    /// Where each parameter lies.
    pub fn layout(&self) -> &Arc<ParamLayout> {
        &self.layout
    }

    /// All values, in the order of the layout.
    pub fn values(&self) -> &[f32] {
        &self.values
    }

    /// All values.
    pub fn values_mut(&mut self) -> &mut [f32] {
        &mut self.values
    }

    /// Sets everything to 0.
    pub fn clear(&mut self) {
        self.values.fill(0.0);
    }

    /// The gradient of one parameter.
    pub fn get(&self, name: &str) -> Option<&[f32]> {
        self.values.get(self.layout.spans.get(name)?.clone())
    }

    /// Disjoint slices by name.
    pub fn views(&mut self) -> BTreeMap<&str, &mut [f32]> {
        let mut views = BTreeMap::new();
        let mut rest = self.values.as_mut_slice();
        for (name, span) in &self.layout.spans {
            let (head, tail) = rest.split_at_mut(span.len());
            views.insert(name.as_str(), head);
            rest = tail;
        }
        views
    }

    /// Adds a tensor to the gradient of `name`.
    ///
    /// # Errors
    /// If there is no such parameter or the sizes differ.
    pub fn add_tensor(&mut self, name: &str, grad: &Tensor) -> Result<()> {
        let span = self.layout.spans.get(name).ok_or_else(|| ModelError::MissingTensor {
            name: name.to_string(),
            given: crate::error::some_names(self.layout.spans.keys()),
        })?;
        if span.len() != grad.elem_count() {
            return Err(ModelError::Shape {
                operation: "add a gradient",
                object: "gradient",
                expected: vec![span.len()],
                found: grad.dims().to_vec(),
            });
        }
        let grad = grad.to_dtype(DType::F32)?.flatten_all()?.to_vec1::<f32>()?;
        for (a, b) in self.values[span.clone()].iter_mut().zip(grad) {
            *a += b;
        }
        Ok(())
    }
}
