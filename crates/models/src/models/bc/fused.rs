//! BC's training step on slices: the maths of `bc/mod.rs`, written out forwards and backwards.

use super::{Bc, Loss};
use crate::batch::Batch;
use crate::error::Result;
use crate::fused::{Pass, with_weights};
use crate::gradients::Gradients;
use crate::kernels::{activate, activate_backward};
use crate::layers::{Activation, Shape};
use crate::model::{LossValues, PolicyModel};
use crate::simd::vectorised;
use crate::values::with_values;
use std::collections::BTreeMap;

impl Bc {
    /// Loss of a batch, and its gradients added to `into`.
    pub(super) fn fused_gradients(&self, batch: &Batch, into: &mut Gradients) -> Result<LossValues> {
        let width = self.signature.action_dim;
        let seen = with_values(&self.joined(batch.rows(), &batch.observation)?, <[f32]>::to_vec)?;
        let actions = with_values(&batch.actions, <[f32]>::to_vec)?;
        let is_pad = with_values(&batch.is_pad, <[f32]>::to_vec)?;
        let entries = (batch.total_valid_steps * width).max(1) as f64;
        // of transformers alone
        let shape = Shape { dim: 1, heads: 1, hidden: 1, activation: Activation::Relu, dropout: 0.0, pre_norm: false };
        self.workspaces.with(|space| {
            with_weights(self.params(), |weights| {
                let pass = &mut Pass { weights, shape, space, rng: None, packed: None, on_seen: None };
                let grads = &mut into.views();
                let names: Vec<String> = (0..self.hidden.len()).map(|i| format!("hidden.{i}")).collect();
                // what every layer reads
                let mut read = vec![pass.space.pool.copy(&seen)];
                for (name, x) in names.iter().zip(0..) {
                    let mut y = pass.linear(name, &read[x]);
                    vectorised(
                        #[inline(always)]
                        || activate(&mut y, Activation::Relu, None, 0),
                    );
                    read.push(y);
                }
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
                    let input = x.len() / batch.rows();
                    pass.linear_backward(name, x, &grad, input, grads);
                    if let Some(below) = i.checked_sub(1) {
                        let mut of_x = pass.linear_input(name, &grad, input);
                        vectorised(
                            #[inline(always)]
                            || activate_backward(&mut of_x, x, Activation::Relu, None, 0),
                        );
                        pass.give(std::mem::replace(&mut grad, of_x));
                        name = &names[below];
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
