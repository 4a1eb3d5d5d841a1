//! A shard of a batch as slices, and the tokens that observations become.

use super::vision::{Eyes, Looked};
use super::{Grads, Pass, slot};
use crate::batch::Batch;
use crate::encoders::{CAMERA_EMBED, TokenKind};
use crate::features::{FeatureKind, FeatureSpec, Features, Signature};
use crate::layers::{ENTITY_POSITIONS, FEATURE_POSITIONS, LATENT, Position, TokenLayout};
use candle_core::Tensor;
use nn::Result;
use nn::kernels::{Mat, Start, add, gemm};
use nn::values::with_values;
use std::borrow::Cow;
use std::cell::RefCell;

/// The kinds of features that the steps by hand cover.
const COVERED: [FeatureKind; 4] =
    [FeatureKind::State, FeatureKind::EnvironmentState, FeatureKind::Entity, FeatureKind::Image];

/// The first feature that no step by hand covers: a model that reads it runs on candle's autograd.
pub(crate) fn uncovered(signature: &Signature) -> Option<&FeatureSpec> {
    signature.observation.iter().find(|spec| !COVERED.contains(&spec.kind))
}

/// An observation's features as slices, in the layout's order.
#[derive(Debug, Default)]
pub(crate) struct Inputs {
    /// (b, width) each
    pub(crate) vectors: Vec<Vec<f32>>,
    /// (b, H, W, 3) each, as the network reads them
    pub(crate) pictures: Vec<Vec<f32>>,
}

/// An observation's features as slices; pictures have been looked at.
pub(crate) fn inputs(layout: &TokenLayout, observation: &Features<Tensor>) -> Result<Inputs> {
    let values = |name: &str| with_values(observation.require("tokens", name)?, <[f32]>::to_vec);
    let vectors = layout.tokens.iter().map(|token| values(&token.feature)).collect::<Result<_>>()?;
    let cameras = layout.cameras.iter().flat_map(|cameras| &cameras.features);
    let pictures = cameras.map(|name| values(name)).collect::<Result<_>>()?;
    Ok(Inputs { vectors, pictures })
}

/// A batch as slices.
#[derive(Debug)]
pub(crate) struct Data {
    pub(crate) rows: usize,
    /// as [`inputs`] gives them; the state is the first
    pub(crate) inputs: Inputs,
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
        self.inputs.vectors.first().expect("a checked signature has a state")
    }
}

/// What becomes tokens.
pub(crate) struct Tokens<'a> {
    /// one token each, in order: parameter prefix, values (b, width), width
    inputs: Vec<(&'a str, &'a [f32], usize)>,
    layout: &'a TokenLayout,
    pictures: &'a [Vec<f32>],
    /// what the backward pass needs of the pictures, between the two passes
    looked: RefCell<Option<Looked>>,
}

impl<'a> Tokens<'a> {
    /// latent: (b, L), the inputs in the layout's order
    pub(crate) fn new(layout: &'a TokenLayout, (latent, latent_dim): (&'a [f32], usize), inputs: &'a Inputs) -> Self {
        let features = layout.tokens.iter().zip(&inputs.vectors);
        let features = features.map(|(token, values)| (token.prefix.as_str(), values.as_slice(), token.width));
        let all = std::iter::once((LATENT, latent, latent_dim)).chain(features).collect();
        Self { inputs: all, layout, pictures: &inputs.pictures, looked: RefCell::new(None) }
    }

    fn eyes(&self) -> Option<Eyes<'a>> {
        Some(self.layout.cameras.as_ref()?.eyes())
    }

    /// -> (b, tokens, D)
    pub(crate) fn forward(&self, pass: &mut Pass<'_>) -> Vec<f32> {
        let (dim, tokens) = (pass.shape.dim, self.layout.len());
        let rows = self.rows();
        let mut x = pass.take(rows * tokens * dim);
        for (i, &(prefix, values, width)) in self.inputs.iter().enumerate() {
            let (w, bias) = (pass.weight(prefix, ".weight"), pass.weight(prefix, ".bias"));
            let (a, w) = (Mat::rows(values, width), Mat::rows(w, width).t());
            gemm((rows, dim, width), a, w, Start::Bias(bias), &mut x[i * dim..], tokens * dim, &mut pass.space.pack);
        }
        if let Some(eyes) = self.eyes() {
            let looked = eyes.forward(pass, self.pictures, &mut x, (self.layout.vectors(), tokens));
            if let Some(on_seen) = pass.on_seen.take() {
                on_seen();
            }
            match pass.packed {
                // a prediction has no backward pass
                Some(_) => looked.free(pass),
                None => *self.looked.borrow_mut() = Some(looked),
            }
        }
        x
    }

    /// grad: (b, tokens, D) -> that of the latent, (b, L)
    pub(crate) fn backward(&self, pass: &mut Pass<'_>, grad: &[f32], grads: &mut Grads<'_>) -> Vec<f32> {
        let (dim, tokens) = (pass.shape.dim, self.layout.len());
        if let (Some(eyes), Some(looked)) = (self.eyes(), self.looked.take()) {
            eyes.backward(pass, looked, grad, (self.layout.vectors(), tokens), grads);
        }
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
        if let Some(cameras) = &self.layout.cameras {
            let positions = match cameras.config.tokens {
                TokenKind::Map => &cameras.positions,
                TokenKind::Keypoints { .. } => pass.weight(CAMERA_EMBED, ".weight"),
            };
            all[self.layout.vectors() * dim..].copy_from_slice(positions);
        }
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
    if layout.cameras.as_ref().is_some_and(|cameras| cameras.config.tokens != TokenKind::Map) {
        add(slot(grads, CAMERA_EMBED, ".weight"), &grad[layout.vectors() * dim..]);
    }
}
