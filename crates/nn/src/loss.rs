//! A loss and the parts that it is made of.

use crate::context::Context;
use crate::error::Result;
use crate::tape::Backward;
use candle_core::{DType, Device, Tensor};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// A loss on candle's graph and its parts, each averaged over the whole batch.
#[derive(Debug, Clone)]
pub struct LossParts {
    /// scalar, differentiable
    pub total: Tensor,
    /// scalars for the metrics, for example `l1_loss`
    pub parts: BTreeMap<String, Tensor>,
}

/// A loss as numbers.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct LossValues {
    /// what is minimised
    pub total: f32,
    /// the parts
    pub parts: BTreeMap<String, f32>,
}

impl LossValues {
    /// Reads the scalars.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn from_parts(parts: &LossParts) -> Result<Self> {
        let mut values = BTreeMap::new();
        for (name, tensor) in &parts.parts {
            values.insert(name.clone(), tensor.to_scalar::<f32>()?);
        }
        Ok(Self { total: parts.total.to_scalar::<f32>()?, parts: values })
    }

    /// Adds another shard's.
    pub fn add(&mut self, other: &Self) {
        self.total += other.total;
        for (name, value) in &other.parts {
            *self.parts.entry(name.clone()).or_default() += value;
        }
    }

    /// Multiplies by `factor`.
    pub fn scale(&mut self, factor: f32) {
        self.total *= factor;
        self.parts.values_mut().for_each(|v| *v *= factor);
    }
}

/// A term of a loss. Weights reach its gradient in full precision: they are given when it is added.
#[derive(Debug, Clone)]
pub struct Term {
    value: f64,
    /// on candle's graph
    composed: Option<Tensor>,
    /// its place on the tape
    node: Option<usize>,
}

impl Term {
    /// On candle's graph.
    pub(crate) fn composed(tensor: Tensor) -> Result<Self> {
        Ok(Self { value: f64::from(tensor.to_scalar::<f32>()?), composed: Some(tensor), node: None })
    }

    /// Its value.
    pub fn value(&self) -> f64 {
        self.value
    }
}

impl Context<'_> {
    /// A hand-written term: its value, and what passes its gradient, the term's weight, back.
    pub(crate) fn term(
        &mut self,
        value: f64,
        has_gradient: bool,
        backward: impl FnOnce(f64, &mut Backward<'_>) -> Result<()> + 'static,
    ) -> Term {
        let node = self.tape.as_mut().filter(|_| has_gradient).map(|tape| tape.push_term(backward));
        Term { value, composed: None, node }
    }
}

/// The loss of a training pass: weighted terms, and what is reported of them.
#[derive(Debug, Default)]
pub struct Loss {
    terms: Vec<(Term, f64)>,
    parts: BTreeMap<String, f32>,
}

impl Loss {
    /// Adds `weight` times a term, and reports it under this name.
    pub fn add(&mut self, name: &str, term: Term, weight: f64) {
        self.report(name, term.value as f32);
        self.terms.push((term, weight));
    }

    /// Reports a number that is not minimised.
    pub fn report(&mut self, name: &str, value: f32) {
        self.parts.insert(name.to_string(), value);
    }

    /// The same, unless the name is taken.
    pub fn report_first(&mut self, name: &str, value: f32) {
        self.parts.entry(name.to_string()).or_insert(value);
    }

    /// As numbers.
    pub fn values(&self) -> LossValues {
        let total = self.terms.iter().fold(0.0, |sum: f32, (term, weight)| sum + term.value as f32 * *weight as f32);
        LossValues { total, parts: self.parts.clone() }
    }

    pub(crate) fn seed(&self, backward: &mut Backward<'_>) {
        for (term, weight) in self.terms.iter().filter(|(_, weight)| *weight != 0.0) {
            backward.weigh(term.node, *weight);
        }
    }

    /// On candle's graph.
    pub(crate) fn composed(self, device: &Device) -> Result<LossParts> {
        let mut total = Tensor::zeros((), DType::F32, device)?;
        for (term, weight) in &self.terms {
            if let Some(tensor) = &term.composed {
                total = (total + (tensor * *weight)?)?;
            }
        }
        let scalar = |(name, value): (String, f32)| Ok((name, Tensor::new(value, device)?));
        Ok(LossParts { total, parts: self.parts.into_iter().map(scalar).collect::<Result<_>>()? })
    }
}
