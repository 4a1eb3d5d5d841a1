//! BC's training step on slices: the maths of `bc/mod.rs`, written out forwards and backwards.

use super::{Bc, Loss};
use crate::batch::Batch;
use crate::features::Features;
use crate::fused::{Looked, Pass, with_weights};
use crate::layers::{Activation, Shape, Sight};
use crate::model::PolicyModel;
use candle_core::Tensor;
use nn::Gradients;
use nn::LossValues;
use nn::Result;
use nn::device::HERE;
use nn::kernels::{activate, activate_backward};
use nn::simd::vectorised;
use nn::values::with_values;
use std::collections::BTreeMap;

/// What every layer reads, the first one `first`, and last what they give.
fn through(pass: &mut Pass<'_>, names: &[String], first: Vec<f32>) -> Vec<Vec<f32>> {
    let mut read = vec![first];
    for (name, x) in names.iter().zip(0..) {
        let mut y = pass.linear(name, &read[x]);
        vectorised(
            #[inline(always)]
            || activate(&mut y, Activation::Relu, None, 0),
        );
        read.push(y);
    }
    read
}

/// Of transformers alone.
const SHAPE: Shape = Shape { dim: 1, heads: 1, hidden: 1, activation: Activation::Relu, dropout: 0.0, pre_norm: false };

impl Bc {
    /// What the first layer reads, (b, …): numbers, then what the cameras see.
    fn first(
        &self,
        pass: &mut Pass<'_>,
        rows: usize,
        numbers: &[f32],
        pictures: Option<&[Vec<f32>]>,
    ) -> (Vec<f32>, Option<Looked>) {
        let (Some(sight), Some(pictures)) = (&self.sight, pictures) else {
            return (pass.space.pool.copy(numbers), None);
        };
        let (both, looked) = sight.beside(pass, rows, numbers, pictures);
        (both, Some(looked))
    }

    /// The prediction from pictures; without them `forward` is as fast.
    pub(super) fn fused_predict(
        &self,
        sight: &Sight,
        rows: usize,
        observation: &Features<Tensor>,
        on_seen: &mut dyn FnMut(),
    ) -> Result<Tensor> {
        let numbers = with_values(&self.numbers(rows, observation)?, <[f32]>::to_vec)?;
        let pictures = sight.pictures(&sight.look(observation, None)?)?;
        let packed = self.workspaces.packed(self.params());
        let actions = self.workspaces.with(|space| {
            with_weights(self.params(), |weights| {
                let pass = &mut Pass { weights, shape: SHAPE, space, rng: None, packed: Some(&packed), on_seen: None };
                let names: Vec<String> = (0..self.hidden.len()).map(|i| format!("hidden.{i}")).collect();
                let (first, looked) = self.first(pass, rows, &numbers, Some(&pictures));
                looked.into_iter().for_each(|looked| looked.free(pass));
                on_seen();
                let read = through(pass, &names, first);
                let out = pass.linear("action_head", &read[names.len()]);
                read.into_iter().for_each(|buffer| pass.give(buffer));
                // the workspace keeps its buffers
                let actions = out.clone();
                pass.give(out);
                actions
            })
        })?;
        Ok(Tensor::from_vec(actions, (rows, self.config.action_horizon, self.signature.action_dim), &HERE)?)
    }

    /// Loss of a batch, and its gradients added to `into`.
    pub(super) fn fused_gradients(&self, batch: &Batch, into: &mut Gradients) -> Result<LossValues> {
        let width = self.signature.action_dim;
        let rows = batch.rows();
        let numbers = with_values(&self.numbers(rows, &batch.observation)?, <[f32]>::to_vec)?;
        let pictures = self.sight.as_ref().map(|sight| sight.pictures(&batch.observation)).transpose()?;
        let actions = with_values(&batch.actions, <[f32]>::to_vec)?;
        let is_pad = with_values(&batch.is_pad, <[f32]>::to_vec)?;
        let entries = (batch.total_valid_steps * width).max(1) as f64;
        self.workspaces.with(|space| {
            with_weights(self.params(), |weights| {
                let pass = &mut Pass { weights, shape: SHAPE, space, rng: None, packed: None, on_seen: None };
                let grads = &mut into.views();
                let names: Vec<String> = (0..self.hidden.len()).map(|i| format!("hidden.{i}")).collect();
                let (first, mut looked) = self.first(pass, rows, &numbers, pictures.as_deref());
                let read = through(pass, &names, first);
                let mut grad = pass.linear("action_head", &read[names.len()]);
                let (mut l1, mut l2) = (0.0, 0.0);
                for ((out, action), pad) in grad.chunks_exact_mut(width).zip(actions.chunks_exact(width)).zip(&is_pad) {
                    for (out, action) in out.iter_mut().zip(action) {
                        let away = f64::from(1.0 - pad) * f64::from(*out - action);
                        l1 += away.abs();
                        l2 += away * away;
                        *out = match self.config.loss {
                            Loss::L1 if away == 0.0 => 0.0,
                            Loss::L1 => (away.signum() / entries) as f32,
                            Loss::L2 => (2.0 * away / entries) as f32,
                        };
                    }
                }
                let mut name = "action_head";
                for (i, x) in read.iter().enumerate().rev() {
                    let input = x.len() / rows;
                    pass.linear_backward(name, x, &grad, input, grads);
                    if let Some(below) = i.checked_sub(1) {
                        let mut of_x = pass.linear_input(name, &grad, input);
                        vectorised(
                            #[inline(always)]
                            || activate_backward(&mut of_x, x, Activation::Relu, None, 0),
                        );
                        pass.give(std::mem::replace(&mut grad, of_x));
                        name = &names[below];
                    } else if let (Some(sight), Some(looked)) = (&self.sight, looked.take()) {
                        let of_x = pass.linear_input(name, &grad, input);
                        sight.learn(pass, looked, (&of_x, input), sight.width(), grads);
                        pass.give(of_x);
                    }
                }
                read.into_iter().chain([grad]).for_each(|buffer| pass.give(buffer));
                let (l1, l2) = ((l1 / entries) as f32, (l2 / entries) as f32);
                let mut parts = BTreeMap::from([("l1_loss".to_string(), l1)]);
                let total = match self.config.loss {
                    Loss::L1 => l1,
                    Loss::L2 => {
                        parts.insert("l2_loss".to_string(), l2);
                        l2
                    }
                };
                LossValues { total, parts }
            })
        })
    }
}
