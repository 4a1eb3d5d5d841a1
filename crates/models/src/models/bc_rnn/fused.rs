//! BC-RNN's training step on `fused` layers: the maths of `bc_rnn/mod.rs`, written out forwards and backwards.

use super::{BcRnn, beginnings};
use crate::batch::Batch;
use crate::fused::{Pass, Recurrent, Wanted, likelihood, with_weights};
use crate::layers::{Activation, Shape};
use crate::model::PolicyModel;
use nn::Gradients;
use nn::LossValues;
use nn::Result;
use nn::kernels::add;
use nn::values::with_values;
use std::collections::BTreeMap;

/// A shard of sequences, step by step, without the padding that they begin with.
struct Sequences {
    /// of each step and row the place in the batch that it comes from, row by row: (T, b)
    from: Vec<usize>,
    /// (T, b, A)
    actions: Vec<f32>,
    /// (T, b)
    real: Vec<f32>,
}

impl Sequences {
    fn of(model: &BcRnn, batch: &Batch) -> Result<Self> {
        let (rows, steps, wide) = (batch.rows(), model.config.action_horizon, model.signature.action_dim);
        let (actions, is_pad) =
            (with_values(&batch.actions, <[f32]>::to_vec)?, with_values(&batch.is_pad, <[f32]>::to_vec)?);
        let mut all = Self { from: Vec::new(), actions: Vec::new(), real: Vec::new() };
        for step in 0..steps {
            for (row, (from, real)) in (0..rows).map(|row| (row, beginnings(&is_pad[row * steps..][..steps], step))) {
                let at = row * steps + from;
                all.actions.extend_from_slice(&actions[at * wide..][..wide]);
                all.from.push(at);
                all.real.push(real);
            }
        }
        Ok(all)
    }
}

impl BcRnn {
    /// Loss of a batch whose pictures were looked at, and its gradients added to `into`.
    pub(super) fn fused_gradients(&self, batch: &Batch, into: &mut Gradients) -> Result<LossValues> {
        let Sequences { from, actions, real } = Sequences::of(self, batch)?;
        let numbers = with_values(&self.steps.numbers(batch.rows(), &batch.observation)?, <[f32]>::to_vec)?;
        let pictures = self.steps.pictures(&batch.observation)?;
        let (config, rows) = (&self.config, batch.rows());
        let hidden = config.hidden_dim;
        let shape =
            Shape { dim: hidden, heads: 1, hidden, activation: Activation::Relu, dropout: 0.0, pre_norm: false };
        self.workspaces.with(|space| {
            with_weights(self.params(), |weights| {
                let pass = &mut Pass { weights, shape, space, rng: None, packed: None, on_seen: None };
                let grads = &mut into.views();
                let (seen, looked) = self.steps.see(pass, rows, &numbers, pictures.as_deref());
                let width = self.steps.width();
                let mut x = pass.take(seen.len());
                for (x, &from) in x.chunks_exact_mut(width).zip(&from) {
                    x.copy_from_slice(&seen[from * width..][..width]);
                }
                pass.give(seen);
                let rnn = Recurrent::forward(pass, "rnn", config.cell, (config.n_layers, hidden), x, rows);
                let wanted = Wanted { actions: &actions, real: &real, total: batch.total_valid_steps };
                let modes = (config.n_modes, config.min_std);
                let (loss, grad) = likelihood(pass, "decoder", modes, rnn.output(), &wanted, grads);
                if let Some(of_x) = rnn.backward(pass, grad, self.steps.learns(), grads) {
                    let mut of_seen = pass.space.pool.zeros(of_x.len());
                    for (of_x, &from) in of_x.chunks_exact(width).zip(&from) {
                        add(&mut of_seen[from * width..][..width], of_x);
                    }
                    self.steps.learn(pass, looked, &of_seen, grads);
                    pass.give(of_seen);
                    pass.give(of_x);
                }
                let parts = [("nll", loss.nll), ("l1_loss", loss.l1)];
                let parts = parts.map(|(name, value)| (name.to_string(), value as f32));
                LossValues { total: loss.nll as f32, parts: BTreeMap::from(parts) }
            })
        })
    }
}
