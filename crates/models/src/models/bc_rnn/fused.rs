//! BC-RNN's training step on `fused` layers: the maths of `bc_rnn/mod.rs`, written out forwards and backwards.

use super::{BcRnn, beginnings};
use crate::batch::Batch;
use crate::error::Result;
use crate::fused::{Lstm, Pass, Wanted, likelihood, with_weights};
use crate::gradients::Gradients;
use crate::layers::{Activation, Shape};
use crate::model::{LossValues, PolicyModel};
use crate::values::with_values;
use std::collections::BTreeMap;

/// A shard of sequences, step by step, without the padding that they begin with.
struct Sequences {
    /// (T, b, everything of a step)
    x: Vec<f32>,
    /// (T, b, A)
    actions: Vec<f32>,
    /// (T, b)
    real: Vec<f32>,
}

impl Sequences {
    fn of(model: &BcRnn, batch: &Batch) -> Result<Self> {
        let (rows, steps) = (batch.rows(), model.config.action_horizon);
        let values = |t: &candle_core::Tensor| with_values(t, <[f32]>::to_vec);
        let specs = &model.signature.observation;
        let features: Vec<(Vec<f32>, usize)> = specs
            .iter()
            .map(|spec| Ok((values(batch.observation.require("bc_rnn", &spec.name)?)?, spec.width())))
            .collect::<Result<_>>()?;
        let (actions, is_pad, wide) = (values(&batch.actions)?, values(&batch.is_pad)?, model.signature.action_dim);
        let mut all = Self { x: Vec::new(), actions: Vec::new(), real: Vec::new() };
        for step in 0..steps {
            for (row, (from, real)) in (0..rows).map(|row| (row, beginnings(&is_pad[row * steps..][..steps], step))) {
                let at = row * steps + from;
                for (values, width) in &features {
                    all.x.extend_from_slice(&values[at * width..][..*width]);
                }
                all.actions.extend_from_slice(&actions[at * wide..][..wide]);
                all.real.push(real);
            }
        }
        Ok(all)
    }
}

impl BcRnn {
    /// Loss of a batch, and its gradients added to `into`.
    pub(super) fn fused_gradients(&self, batch: &Batch, into: &mut Gradients) -> Result<LossValues> {
        let Sequences { x, actions, real } = Sequences::of(self, batch)?;
        let (config, rows) = (&self.config, batch.rows());
        let hidden = config.hidden_dim;
        let shape =
            Shape { dim: hidden, heads: 1, hidden, activation: Activation::Relu, dropout: 0.0, pre_norm: false };
        self.workspaces.with(|space| {
            with_weights(self.params(), |weights| {
                let pass = &mut Pass { weights, shape, space, rng: None, packed: None, on_seen: None };
                let grads = &mut into.views();
                // of the pool, to which the layers give it back
                let x = pass.space.pool.copy(&x);
                let rnn = Lstm::forward(pass, "rnn", (config.n_layers, hidden), x, rows);
                let wanted = Wanted { actions: &actions, real: &real, total: batch.total_valid_steps };
                let modes = (config.n_modes, config.min_std);
                let (loss, grad) = likelihood(pass, "decoder", modes, &rnn.output, &wanted, grads);
                rnn.backward(pass, grad, grads);
                let parts = [("nll", loss.nll), ("l1_loss", loss.l1)];
                let parts = parts.map(|(name, value)| (name.to_string(), value as f32));
                LossValues { total: loss.nll as f32, parts: BTreeMap::from(parts) }
            })
        })
    }
}
