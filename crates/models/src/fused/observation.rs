//! A shard of a batch as slices, and the tokens that observations become.

use super::{Grads, Pass};
use crate::batch::{Batch, Dims};
use crate::error::Result;
use crate::kernels::{Mat, Start, gemm};
use crate::values::with_values;

/// A batch as slices.
#[derive(Debug)]
pub(crate) struct Data {
    pub(crate) rows: usize,
    /// (b, S)
    pub(crate) state: Vec<f32>,
    /// (b, E)
    pub(crate) environment_state: Vec<f32>,
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
    pub(crate) fn of(batch: &Batch) -> Result<Self> {
        let environment_state = match &batch.environment_state {
            Some(env) => with_values(env, <[f32]>::to_vec)?,
            None => Vec::new(),
        };
        let action = batch.actions.dims().last().copied().unwrap_or(1);
        Ok(Self {
            rows: batch.rows(),
            state: with_values(&batch.state, <[f32]>::to_vec)?,
            environment_state,
            actions: with_values(&batch.actions, <[f32]>::to_vec)?,
            is_pad: with_values(&batch.is_pad, <[f32]>::to_vec)?,
            total_rows: batch.total_rows.max(1),
            total_entries: (batch.total_valid_steps * action).max(1),
        })
    }
}

/// The inputs that become one token each, in order: parameter prefix, values (b, width), width.
pub(crate) struct Tokens<'a>(Vec<(&'static str, &'a [f32], usize)>);

impl<'a> Tokens<'a> {
    /// latent: (b, L), state: (b, S), environment_state: (b, E)
    pub(crate) fn new(
        dims: &Dims,
        (latent, latent_dim): (&'a [f32], usize),
        state: &'a [f32],
        environment_state: &'a [f32],
    ) -> Self {
        let mut inputs = vec![
            ("encoder_latent_input_proj", latent, latent_dim),
            ("encoder_robot_state_input_proj", state, dims.state),
        ];
        if dims.environment_state > 0 {
            inputs.push(("encoder_env_state_input_proj", environment_state, dims.environment_state));
        }
        Self(inputs)
    }

    /// -> (b, tokens, D)
    pub(crate) fn forward(&self, pass: &mut Pass<'_>) -> Vec<f32> {
        let (dim, tokens) = (pass.shape.dim, self.0.len());
        let rows = self.rows();
        let mut x = pass.take(rows * tokens * dim);
        for (i, &(prefix, values, width)) in self.0.iter().enumerate() {
            let (w, bias) = (pass.weight(prefix, ".weight"), pass.weight(prefix, ".bias"));
            let (a, w) = (Mat::rows(values, width), Mat::rows(w, width).t());
            gemm((rows, dim, width), a, w, Start::Bias(bias), &mut x[i * dim..], tokens * dim, &mut pass.space.pack);
        }
        x
    }

    /// grad: (b, tokens, D) -> that of the latent, (b, L)
    pub(crate) fn backward(&self, pass: &mut Pass<'_>, grad: &[f32], grads: &mut Grads<'_>) -> Vec<f32> {
        let (dim, tokens) = (pass.shape.dim, self.0.len());
        let mut latent = Vec::new();
        let mut token = pass.take(self.rows() * dim);
        for (i, &(prefix, values, width)) in self.0.iter().enumerate() {
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

    fn rows(&self) -> usize {
        self.0.first().map_or(0, |(_, values, width)| values.len() / width)
    }
}
