//! The tape of a training step: what every operation needs for its backward pass, freed as the gradient goes back.

use crate::context::Workspace;
use crate::error::{ModelError, Result};
use crate::gradients::Gradients;
use crate::kernels::add;
use crate::params::Params;
use candle_core::{Tensor, TensorId};
use std::collections::HashMap;
use std::ops::Range;

type Passes<G> = Box<dyn FnOnce(G, &mut Backward<'_>) -> Result<()>>;

/// What passes a gradient on.
enum Back {
    /// of a result
    Result(Passes<Vec<f32>>),
    /// of a term of the loss, whose gradient is its weight
    Term(Passes<f64>),
}

/// Backward passes in the order of the operations.
#[derive(Default)]
pub(crate) struct Tape(Vec<Back>);

impl std::fmt::Debug for Tape {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "a tape of {} operations", self.0.len())
    }
}

impl Tape {
    /// Notes an operation; its place is that of its result.
    pub(crate) fn push(&mut self, back: impl FnOnce(Vec<f32>, &mut Backward<'_>) -> Result<()> + 'static) -> usize {
        self.0.push(Back::Result(Box::new(back)));
        self.0.len() - 1
    }

    /// Notes a term of the loss.
    pub(crate) fn push_term(&mut self, back: impl FnOnce(f64, &mut Backward<'_>) -> Result<()> + 'static) -> usize {
        self.0.push(Back::Term(Box::new(back)));
        self.0.len() - 1
    }

    /// Passes the gradients that are there back to the parameters.
    pub(crate) fn backward(mut self, backward: &mut Backward<'_>) -> Result<()> {
        while let Some(back) = self.0.pop() {
            let node = self.0.len();
            match back {
                Back::Result(back) => {
                    if let Some(grad) = backward.grads.get_mut(node).and_then(Option::take) {
                        back(grad, backward)?;
                    }
                }
                Back::Term(back) => {
                    if let Some(weight) = backward.weights.remove(&node) {
                        back(weight, backward)?;
                    }
                }
            }
        }
        Ok(())
    }
}

/// A backward pass: gradients of results that are still to be passed on, and of parameters.
pub(crate) struct Backward<'a> {
    grads: Vec<Option<Vec<f32>>>,
    /// of the loss's terms
    weights: HashMap<usize, f64>,
    spans: HashMap<TensorId, Range<usize>>,
    values: &'a mut [f32],
    pub(crate) space: &'a mut Workspace,
}

impl<'a> Backward<'a> {
    pub(crate) fn new(params: &Params, into: &'a mut Gradients, space: &'a mut Workspace) -> Result<Self> {
        let mut spans = HashMap::new();
        for (name, span) in into.layout().clone().iter() {
            let var = params.get(name).ok_or_else(|| ModelError::NoGradient { name: name.to_string() })?;
            spans.insert(var.as_tensor().id(), span);
        }
        Ok(Self { grads: Vec::new(), weights: HashMap::new(), spans, values: into.values_mut(), space })
    }

    /// The gradient of a parameter, and buffers; `None` for a buffer of the model, which is not trained.
    pub(crate) fn parameter(&mut self, parameter: &Tensor) -> Option<(&mut [f32], &mut Workspace)> {
        let span = self.spans.get(&parameter.id())?.clone();
        Some((&mut self.values[span], &mut *self.space))
    }

    /// Says how much a term of the loss weighs.
    pub(crate) fn weigh(&mut self, term: Option<usize>, weight: f64) {
        self.weights.extend(term.map(|node| (node, weight)));
    }

    fn slot(&mut self, node: usize) -> &mut Option<Vec<f32>> {
        if self.grads.len() <= node {
            self.grads.resize_with(node + 1, || None);
        }
        &mut self.grads[node]
    }

    /// Takes out the gradient of a result, to be added to and given back.
    pub(crate) fn take(&mut self, node: Option<usize>) -> Option<Vec<f32>> {
        self.grads.get_mut(node?).and_then(Option::take)
    }

    /// Adds to the gradient of a result, if it has one.
    pub(crate) fn add(&mut self, node: Option<usize>, grad: Vec<f32>) {
        let Some(node) = node else { return self.space.pool.give(grad) };
        match self.slot(node) {
            Some(sum) => {
                add(sum, &grad);
                self.space.pool.give(grad);
            }
            empty => *empty = Some(grad),
        }
    }
}
