//! A loss and the parts that it is made of.

use crate::context::Context;
use crate::error::Result;
use crate::number::Number;
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
        LossNumbers::from(parts).read()
    }
}

/// A loss that a device may still be computing.
#[derive(Debug, Clone)]
pub struct LossNumbers {
    /// what is minimised
    pub total: Number,
    /// the parts
    pub parts: BTreeMap<String, Number>,
}

impl Default for LossNumbers {
    fn default() -> Self {
        Self { total: Number::Here(0.0), parts: BTreeMap::new() }
    }
}

impl From<&LossParts> for LossNumbers {
    fn from(of: &LossParts) -> Self {
        let number = |tensor: &Tensor| Number::There(tensor.detach());
        let parts = of.parts.iter().map(|(name, tensor)| (name.clone(), number(tensor))).collect();
        Self { total: number(&of.total), parts }
    }
}

impl LossNumbers {
    /// Adds another shard's.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn add(&mut self, other: &Self) -> Result<()> {
        self.total = self.total.plus(&other.total)?;
        for (name, value) in &other.parts {
            let sum = self.parts.get(name).unwrap_or(&Number::Here(0.0)).plus(value)?;
            self.parts.insert(name.clone(), sum);
        }
        Ok(())
    }

    /// The values. Waits for the device.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn read(&self) -> Result<LossValues> {
        let value = |number: &Number| number.read().map(|value| value as f32);
        let parts = self.parts.iter().map(|(name, number)| Ok((name.clone(), value(number)?)));
        Ok(LossValues { total: value(&self.total)?, parts: parts.collect::<Result<_>>()? })
    }
}

/// A term of a loss. Weights reach its gradient in full precision: they are given when it is added.
#[derive(Debug, Clone)]
pub struct Term {
    /// on candle's graph, where it is a tensor
    value: Number,
    /// its place on the tape
    node: Option<usize>,
}

impl Term {
    /// On candle's graph.
    pub(crate) fn composed(tensor: Tensor) -> Self {
        Self { value: Number::There(tensor), node: None }
    }

    /// Its value, without a gradient.
    pub fn value(&self) -> Number {
        match &self.value {
            Number::Here(value) => Number::Here(*value),
            Number::There(tensor) => Number::There(tensor.detach()),
        }
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
        Term { value: Number::Here(value), node }
    }
}

/// The loss of a training pass: weighted terms, and what is reported of them.
#[derive(Debug, Default)]
pub struct Loss {
    terms: Vec<(Term, f64)>,
    parts: BTreeMap<String, Number>,
}

impl Loss {
    /// Adds `weight` times a term, and reports it under this name.
    pub fn add(&mut self, name: &str, term: Term, weight: f64) {
        self.report(name, term.value());
        self.terms.push((term, weight));
    }

    /// Reports a number that is not minimised.
    pub fn report(&mut self, name: &str, value: Number) {
        self.parts.insert(name.to_string(), value);
    }

    /// The same, unless the name is taken.
    pub fn report_first(&mut self, name: &str, value: Number) {
        self.parts.entry(name.to_string()).or_insert(value);
    }

    /// Of hand-written terms.
    pub(crate) fn numbers(self) -> Result<LossNumbers> {
        let mut total = 0.0f32;
        for (term, weight) in &self.terms {
            total += term.value.read()? as f32 * *weight as f32;
        }
        Ok(LossNumbers { total: total.into(), parts: self.parts })
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
            if let Number::There(tensor) = &term.value {
                total = (total + (tensor * *weight)?)?;
            }
        }
        let parts = self.parts.into_iter().map(|(name, value)| Ok((name, value.tensor(device)?)));
        Ok(LossParts { total, parts: parts.collect::<Result<_>>()? })
    }
}
