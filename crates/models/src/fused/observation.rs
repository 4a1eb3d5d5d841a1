//! A shard of a batch as slices, and the tokens that observations become.

use super::{Grads, Pass, slot};
use crate::batch::Batch;
use crate::error::Result;
use crate::features::{FeatureKind, FeatureSpec, Features, Signature};
use crate::kernels::{Mat, Start, add, gemm};
use crate::layers::{ENTITY_POSITIONS, FEATURE_POSITIONS, LATENT, Position, TokenLayout};
use crate::values::with_values;
use candle_core::Tensor;
use std::borrow::Cow;

/// The kinds of features that the steps by hand cover.
const COVERED: [FeatureKind; 3] = [FeatureKind::State, FeatureKind::EnvironmentState, FeatureKind::Entity];

/// The first feature that no step by hand covers: a model that reads it runs on candle's autograd.
pub(crate) fn uncovered(signature: &Signature) -> Option<&FeatureSpec> {
    signature.observation.iter().find(|spec| !COVERED.contains(&spec.kind))
}

/// An observation's features as slices, in the layout's order: (b, width) each.
pub(crate) fn inputs(layout: &TokenLayout, observation: &Features<Tensor>) -> Result<Vec<Vec<f32>>> {
    let values = |name: &str| with_values(observation.require("tokens", name)?, <[f32]>::to_vec);
    layout.tokens.iter().map(|token| values(&token.feature)).collect()
}

/// A batch as slices.
#[derive(Debug)]
pub(crate) struct Data {
    pub(crate) rows: usize,
    /// as [`inputs`] gives them; the state is the first
    pub(crate) inputs: Vec<Vec<f32>>,
    /// (b, H, A)
    pub(crate) actions: Vec<f32>,
    /// (b, H) of 0/1
    pub(crate) is_pad: Vec<f32>,
    /// rows of the whole batch
    pub(crate) total_rows: usize,
    /// numbers in the actions of the whole batch that are not padding; at least 1
    pub(crate) total_entries: usize,
}

impl Data {
    pub(crate) fn of(batch: &Batch, layout: &TokenLayout) -> Result<Self> {
        let action = batch.actions.dims().last().copied().unwrap_or(1);
        Ok(Self {
            rows: batch.rows(),
            inputs: inputs(layout, &batch.observation)?,
            actions: with_values(&batch.actions, <[f32]>::to_vec)?,
            is_pad: with_values(&batch.is_pad, <[f32]>::to_vec)?,
            total_rows: batch.total_rows.max(1),
            total_entries: (batch.total_valid_steps * action).max(1),
        })
    }

    /// (b, S)
    pub(crate) fn state(&self) -> &[f32] {
        self.inputs.first().expect("a checked signature has a state")
    }
}

/// The inputs that become one token each, in order: parameter prefix, values (b, width), width.
pub(crate) struct Tokens<'a> {
    inputs: Vec<(&'a str, &'a [f32], usize)>,
    layout: &'a TokenLayout,
}

impl<'a> Tokens<'a> {
    /// latent: (b, L), the inputs in the layout's order
    pub(crate) fn new(
        layout: &'a TokenLayout,
        (latent, latent_dim): (&'a [f32], usize),
        inputs: &'a [Vec<f32>],
    ) -> Self {
        let features = layout.tokens.iter().zip(inputs);
        let features = features.map(|(token, values)| (token.prefix.as_str(), values.as_slice(), token.width));
        Self { inputs: std::iter::once((LATENT, latent, latent_dim)).chain(features).collect(), layout }
    }

    /// -> (b, tokens, D)
    pub(crate) fn forward(&self, pass: &mut Pass<'_>) -> Vec<f32> {
        let (dim, tokens) = (pass.shape.dim, self.inputs.len());
        let rows = self.rows();
        let mut x = pass.take(rows * tokens * dim);
        for (i, &(prefix, values, width)) in self.inputs.iter().enumerate() {
            let (w, bias) = (pass.weight(prefix, ".weight"), pass.weight(prefix, ".bias"));
            let (a, w) = (Mat::rows(values, width), Mat::rows(w, width).t());
            gemm((rows, dim, width), a, w, Start::Bias(bias), &mut x[i * dim..], tokens * dim, &mut pass.space.pack);
        }
        x
    }

    /// grad: (b, tokens, D) -> that of the latent, (b, L)
    pub(crate) fn backward(&self, pass: &mut Pass<'_>, grad: &[f32], grads: &mut Grads<'_>) -> Vec<f32> {
        let (dim, tokens) = (pass.shape.dim, self.inputs.len());
        let mut latent = Vec::new();
        let mut token = pass.take(self.rows() * dim);
        for (i, &(prefix, values, width)) in self.inputs.iter().enumerate() {
            for (to, from) in token.chunks_exact_mut(dim).zip(grad.chunks_exact(tokens * dim)) {
                to.copy_from_slice(&from[i * dim..(i + 1) * dim]);
            }
            pass.linear_backward(prefix, values, &token, width, grads);
            if i == 0 {
                latent = pass.linear_input(prefix, &token, width);
            }
        }
        pass.give(token);
        latent
    }

    /// The positions of the tokens, (tokens, D).
    pub(crate) fn positions<'w>(&self, pass: &Pass<'w>) -> Cow<'w, [f32]> {
        let dim = pass.shape.dim;
        let features = pass.weight(FEATURE_POSITIONS, ".weight");
        if self.layout.len() == self.layout.feature_rows() {
            return Cow::Borrowed(features);
        }
        let mut all = vec![0.0; self.layout.len() * dim];
        all[..dim].copy_from_slice(&features[..dim]);
        for (token, all) in self.layout.tokens.iter().zip(all[dim..].chunks_exact_mut(dim)) {
            match token.position {
                Position::Feature(row) => all.copy_from_slice(&features[row * dim..(row + 1) * dim]),
                Position::Entity(row) => {
                    let entities = pass.weight(ENTITY_POSITIONS, ".weight");
                    all.copy_from_slice(&entities[row * dim..(row + 1) * dim]);
                }
                Position::Nowhere => {}
            }
        }
        Cow::Owned(all)
    }

    /// Which tokens.
    pub(crate) fn layout(&self) -> &'a TokenLayout {
        self.layout
    }

    fn rows(&self) -> usize {
        self.inputs.first().map_or(0, |(_, values, width)| values.len() / width)
    }
}

/// Adds the gradient of the tokens' positions, (tokens, D), to that of the parameters they come from.
pub(crate) fn positions_backward(layout: &TokenLayout, dim: usize, grad: &[f32], grads: &mut Grads<'_>) {
    if layout.len() == layout.feature_rows() {
        add(slot(grads, FEATURE_POSITIONS, ".weight"), grad);
        return;
    }
    add(&mut slot(grads, FEATURE_POSITIONS, ".weight")[..dim], &grad[..dim]);
    for (token, grad) in layout.tokens.iter().zip(grad[dim..].chunks_exact(dim)) {
        let (name, row) = match token.position {
            Position::Feature(row) => (FEATURE_POSITIONS, row),
            Position::Entity(row) => (ENTITY_POSITIONS, row),
            Position::Nowhere => continue,
        };
        add(&mut slot(grads, name, ".weight")[row * dim..(row + 1) * dim], grad);
    }
}
