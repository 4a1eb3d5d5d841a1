//! ACT's training step and prediction on `fused` layers: the maths of `act.rs`, written out forwards and backwards.
//!
//! Exact savings over the composed model: of the VAE encoder's last layer only the first token is computed, because
//! nothing else is read; the first decoder layer's queries, keys and values are computed once for the whole batch,
//! because its input is zero for every sample.

use crate::act::Act;
use crate::batch::Batch;
use crate::error::{ModelError, Result};
use crate::fused::{
    DecoderGrads, DecoderLayer, EncoderLayer, Grads, Memory, Norm, Pass, Shape, Weights, Workspace, slot,
};
use crate::gradients::Gradients;
use crate::kernels::{Mat, Start, add, gemm};
use crate::model::{LossValues, PolicyModel};
use crate::rng::Rng;
use crate::train::with_values;
use candle_core::{Device, Storage, Tensor};
use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};

/// Workspaces of shards that ran before.
#[derive(Debug, Default)]
pub(crate) struct Workspaces(Mutex<Vec<Workspace>>);

impl Workspaces {
    fn take(&self) -> Workspace {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).pop().unwrap_or_default()
    }

    fn give(&self, space: Workspace) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push(space);
    }
}

/// A batch as slices.
struct Data<'a> {
    rows: usize,
    state: &'a [f32],
    environment_state: &'a [f32],
    actions: &'a [f32],
    is_pad: &'a [f32],
    eps: &'a [f32],
}

/// What the VAE encoder's backward pass needs.
struct Encoded {
    layers: Vec<EncoderLayer>,
    norm: Option<Norm>,
    /// the first token, (b, D)
    cls: Vec<f32>,
    /// mean and log-variance, (b, 2L)
    latent: Vec<f32>,
}

/// What the decoder's backward pass needs.
struct Decoded {
    encoder: Vec<EncoderLayer>,
    encoder_norm: Option<Norm>,
    memory: Vec<f32>,
    decoder: Vec<DecoderLayer>,
    decoder_norm: Norm,
    /// after the norm, (b, C, D)
    x: Vec<f32>,
    /// (b, C, A)
    actions: Vec<f32>,
}

impl Act {
    fn shape(&self) -> Shape {
        let c = self.config();
        Shape {
            dim: c.dim_model,
            heads: c.n_heads,
            hidden: c.dim_feedforward,
            activation: c.feedforward_activation,
            dropout: c.dropout,
            pre_norm: c.pre_norm,
        }
    }

    /// Calls `f` with all parameters as slices.
    fn with_weights<R>(&self, f: impl FnOnce(&Weights<'_>) -> Result<R>) -> Result<R> {
        let guards: Vec<_> =
            self.params().iter().map(|(name, var)| (name, var.as_tensor().storage_and_layout())).collect();
        let mut weights = BTreeMap::new();
        for (name, (storage, layout)) in &guards {
            let Storage::Cpu(storage) = &**storage else {
                let (found, expected) = ("on another device".to_string(), "on the CPU".to_string());
                return Err(ModelError::Input { operation: "act", object: "parameter", found, expected });
            };
            let from = layout.start_offset();
            weights.insert(*name, &storage.as_slice::<f32>()?[from..from + layout.shape().elem_count()]);
        }
        f(&weights)
    }

    /// Loss of a training forward pass with the latent's noise `eps`: (b, L), and its gradients added to `into`.
    /// Dropout masks are drawn from `rng`; without it nothing is dropped.
    ///
    /// # Errors
    /// Inputs of the wrong shape.
    pub fn fused_gradients(
        &self,
        batch: &Batch,
        eps: &Tensor,
        rng: Option<&mut Rng>,
        into: &mut Gradients,
    ) -> Result<LossValues> {
        self.check_batch(batch)?;
        let values = |t: &Tensor| with_values(t, <[f32]>::to_vec);
        let environment_state = match &batch.environment_state {
            Some(env) => values(env)?,
            None => Vec::new(),
        };
        let (state, actions, is_pad) = (values(&batch.state)?, values(&batch.actions)?, values(&batch.is_pad)?);
        let eps = values(eps)?;
        let data = Data {
            rows: batch.rows(),
            state: &state,
            environment_state: &environment_state,
            actions: &actions,
            is_pad: &is_pad,
            eps: &eps,
        };
        let mut space = self.workspaces.take();
        let result = self.with_weights(|weights| {
            let pass = &mut Pass { weights, shape: self.shape(), space: &mut space, rng };
            Ok(self.step(pass, &data, (batch.total_rows, batch.total_valid_steps), &mut into.views()))
        });
        self.workspaces.give(space);
        result
    }

    /// state: (b, S), environment_state: (b, E) -> (b, C, A)
    pub(crate) fn fused_predict(&self, state: &Tensor, environment_state: Option<&Tensor>) -> Result<Tensor> {
        self.check_inputs(state, environment_state)?;
        let rows = state.dim(0)?;
        let values = |t: &Tensor| with_values(t, <[f32]>::to_vec);
        let env = match environment_state {
            Some(env) => values(env)?,
            None => Vec::new(),
        };
        let state = values(state)?;
        let mut space = self.workspaces.take();
        let actions = self.with_weights(|weights| {
            let pass = &mut Pass { weights, shape: self.shape(), space: &mut space, rng: None };
            let latent = pass.space.pool.zeros(rows * self.config().latent_dim);
            let done = self.decode_fused(pass, rows, &latent, &state, &env);
            pass.give(latent);
            let actions = done.actions.clone();
            for layer in done.encoder {
                layer.free(pass);
            }
            for layer in done.decoder {
                layer.free(pass);
            }
            for norm in done.encoder_norm.into_iter().chain([done.decoder_norm]) {
                norm.free(pass);
            }
            for buffer in [done.memory, done.x, done.actions] {
                pass.give(buffer);
            }
            Ok(actions)
        });
        self.workspaces.give(space);
        Ok(Tensor::from_vec(actions?, (rows, self.config().action_horizon, self.dims().action), &Device::Cpu)?)
    }

    /// Encodes the actions: tokens `[cls, state, actions…]`.
    fn encode_fused(&self, pass: &mut Pass<'_>, data: &Data<'_>) -> Encoded {
        let (b, dim, horizon) = (data.rows, pass.shape.dim, self.config().action_horizon);
        let tokens = horizon + 2;
        let (cls, pos) = (pass.weight("vae_encoder_cls_embed", ".weight"), self.position_table());
        let state = pass.linear("vae_encoder_robot_state_input_proj", data.state, self.dims().state);
        let actions = pass.linear("vae_encoder_action_input_proj", data.actions, self.dims().action);
        let mut x = pass.take(b * tokens * dim);
        let mut key_pad = pass.space.pool.zeros(b * tokens);
        for i in 0..b {
            let x = &mut x[i * tokens * dim..(i + 1) * tokens * dim];
            x[..dim].copy_from_slice(cls);
            x[dim..2 * dim].copy_from_slice(&state[i * dim..(i + 1) * dim]);
            x[2 * dim..].copy_from_slice(&actions[i * horizon * dim..(i + 1) * horizon * dim]);
            key_pad[i * tokens + 2..(i + 1) * tokens].copy_from_slice(&data.is_pad[i * horizon..(i + 1) * horizon]);
        }
        pass.give(state);
        pass.give(actions);
        let n = self.config().n_vae_encoder_layers;
        let mut layers = Vec::with_capacity(n);
        for i in 0..n {
            let (out, layer) =
                EncoderLayer::forward(pass, format!("vae_encoder.layers.{i}"), x, pos, Some(&key_pad), i + 1 == n);
            x = out;
            layers.push(layer);
        }
        pass.give(key_pad);
        let (cls, norm) = final_norm(pass, "vae_encoder.norm", x);
        let latent = pass.linear("vae_encoder_latent_output_proj", &cls, dim);
        Encoded { layers, norm, cls, latent }
    }

    /// grad: that of mean and log-variance, (b, 2L)
    fn encode_backward(
        &self,
        pass: &mut Pass<'_>,
        data: &Data<'_>,
        done: Encoded,
        grad: &[f32],
        grads: &mut Grads<'_>,
    ) {
        let (b, dim, horizon) = (data.rows, pass.shape.dim, self.config().action_horizon);
        let tokens = horizon + 2;
        pass.linear_backward("vae_encoder_latent_output_proj", &done.cls, grad, dim, grads);
        let mut x = pass.linear_input("vae_encoder_latent_output_proj", grad, dim);
        if let Some(norm) = done.norm {
            norm.backward(pass, "vae_encoder.norm", &mut x, grads);
        }
        for layer in done.layers.into_iter().rev() {
            x = layer.backward(pass, x, self.position_table(), None, grads);
        }
        let (mut state, mut actions) = (pass.take(b * dim), pass.take(b * horizon * dim));
        for i in 0..b {
            let x = &x[i * tokens * dim..(i + 1) * tokens * dim];
            add(slot(grads, "vae_encoder_cls_embed", ".weight"), &x[..dim]);
            state[i * dim..(i + 1) * dim].copy_from_slice(&x[dim..2 * dim]);
            actions[i * horizon * dim..(i + 1) * horizon * dim].copy_from_slice(&x[2 * dim..]);
        }
        pass.linear_backward("vae_encoder_robot_state_input_proj", data.state, &state, self.dims().state, grads);
        pass.linear_backward("vae_encoder_action_input_proj", data.actions, &actions, self.dims().action, grads);
        for buffer in [state, actions, x, done.cls, done.latent] {
            pass.give(buffer);
        }
    }

    /// The encoder's inputs in the order of its tokens: parameter prefix, values, width.
    fn inputs<'a>(&self, latent: &'a [f32], state: &'a [f32], env: &'a [f32]) -> Vec<(&'static str, &'a [f32], usize)> {
        let mut inputs = vec![
            ("encoder_latent_input_proj", latent, self.config().latent_dim),
            ("encoder_robot_state_input_proj", state, self.dims().state),
        ];
        if self.dims().environment_state > 0 {
            inputs.push(("encoder_env_state_input_proj", env, self.dims().environment_state));
        }
        inputs
    }

    fn decode_fused(&self, pass: &mut Pass<'_>, rows: usize, latent: &[f32], state: &[f32], env: &[f32]) -> Decoded {
        let dim = pass.shape.dim;
        let inputs = self.inputs(latent, state, env);
        let tokens = inputs.len();
        let mut x = pass.take(rows * tokens * dim);
        for (i, (prefix, values, width)) in inputs.into_iter().enumerate() {
            let (w, bias) = (pass.weight(prefix, ".weight"), pass.weight(prefix, ".bias"));
            let (a, w) = (Mat::rows(values, width), Mat::rows(w, width).t());
            gemm((rows, dim, width), a, w, Start::Bias(bias), &mut x[i * dim..], tokens * dim, &mut pass.space.pack);
        }
        let pos = pass.weight("encoder_1d_feature_pos_embed", ".weight");
        let mut encoder = Vec::new();
        for i in 0..self.config().n_encoder_layers {
            let (out, layer) = EncoderLayer::forward(pass, format!("encoder.layers.{i}"), x, pos, None, false);
            x = out;
            encoder.push(layer);
        }
        let (memory, encoder_norm) = final_norm(pass, "encoder.norm", x);

        let query_pos = pass.weight("decoder_pos_embed", ".weight");
        // zero for every sample: one sequence stands for all of them
        let mut x = pass.space.pool.zeros(query_pos.len());
        let mut decoder = Vec::new();
        for i in 0..self.config().n_decoder_layers {
            let from = Memory { x: &memory, pos, batch: rows };
            let (out, layer) = DecoderLayer::forward(pass, format!("decoder.layers.{i}"), x, query_pos, from);
            x = out;
            decoder.push(layer);
        }
        let (out, decoder_norm) = Norm::forward(pass, "decoder.norm", &x);
        pass.give(x);
        let actions = pass.linear("action_head", &out, dim);
        Decoded { encoder, encoder_norm, memory, decoder, decoder_norm, x: out, actions }
    }

    /// Takes the gradient of the actions, (b, C, A); returns that of the latent, (b, L).
    fn decode_backward(
        &self,
        pass: &mut Pass<'_>,
        data: &Data<'_>,
        latent: &[f32],
        done: Decoded,
        grad: &[f32],
        grads: &mut Grads<'_>,
    ) -> Vec<f32> {
        let dim = pass.shape.dim;
        pass.linear_backward("action_head", &done.x, grad, dim, grads);
        let mut x = pass.linear_input("action_head", grad, dim);
        done.decoder_norm.backward(pass, "decoder.norm", &mut x, grads);
        let (pos, query_pos) =
            (pass.weight("encoder_1d_feature_pos_embed", ".weight"), pass.weight("decoder_pos_embed", ".weight"));
        let mut memory = pass.space.pool.zeros(done.memory.len());
        let mut memory_pos = pass.space.pool.zeros(pos.len());
        let mut query = pass.space.pool.zeros(query_pos.len());
        for layer in done.decoder.into_iter().rev() {
            let from = Memory { x: &done.memory, pos, batch: data.rows };
            let mut into = DecoderGrads { memory: &mut memory, memory_pos: &mut memory_pos, query_pos: &mut query };
            x = layer.backward(pass, x, query_pos, from, &mut into, grads);
        }
        pass.give(x);
        let mut x = memory;
        if let Some(norm) = done.encoder_norm {
            norm.backward(pass, "encoder.norm", &mut x, grads);
        }
        for layer in done.encoder.into_iter().rev() {
            x = layer.backward(pass, x, pos, Some(&mut memory_pos), grads);
        }
        add(slot(grads, "encoder_1d_feature_pos_embed", ".weight"), &memory_pos);
        add(slot(grads, "decoder_pos_embed", ".weight"), &query);

        let inputs = self.inputs(latent, data.state, data.environment_state);
        let tokens = inputs.len();
        let mut latent_grad = Vec::new();
        let mut token = pass.take(data.rows * dim);
        for (i, (prefix, values, width)) in inputs.into_iter().enumerate() {
            for (to, from) in token.chunks_exact_mut(dim).zip(x.chunks_exact(tokens * dim)) {
                to.copy_from_slice(&from[i * dim..(i + 1) * dim]);
            }
            pass.linear_backward(prefix, values, &token, width, grads);
            if i == 0 {
                latent_grad = pass.linear_input(prefix, &token, width);
            }
        }
        for buffer in [token, x, memory_pos, query, done.memory, done.x, done.actions] {
            pass.give(buffer);
        }
        latent_grad
    }

    #[allow(clippy::needless_range_loop)] // mean and log-variance lie side by side in one row
    /// One shard, forwards and backwards. `totals`: rows and valid steps of the whole batch.
    fn step(&self, pass: &mut Pass<'_>, data: &Data<'_>, totals: (usize, usize), grads: &mut Grads<'_>) -> LossValues {
        let width = self.config().latent_dim;
        let encoded = self.config().use_vae.then(|| self.encode_fused(pass, data));
        let mut latent = pass.space.pool.zeros(data.rows * width);
        if let Some(encoded) = &encoded {
            for ((z, out), eps) in latent
                .chunks_exact_mut(width)
                .zip(encoded.latent.chunks_exact(2 * width))
                .zip(data.eps.chunks_exact(width))
            {
                let (mu, log_variance) = out.split_at(width);
                for (((z, mu), lv), eps) in z.iter_mut().zip(mu).zip(log_variance).zip(eps) {
                    *z = mu + (lv / 2.0).exp() * eps;
                }
            }
        }
        let decoded = self.decode_fused(pass, data.rows, &latent, data.state, data.environment_state);

        // L1 over valid steps: loss and its gradient
        let action = self.dims().action;
        let entries = (totals.1 * action).max(1) as f32;
        let mut grad = pass.space.pool.zeros(decoded.actions.len());
        let mut l1 = 0.0f64;
        let steps = decoded
            .actions
            .chunks_exact(action)
            .zip(data.actions.chunks_exact(action))
            .zip(grad.chunks_exact_mut(action));
        for (((got, want), grad), pad) in steps.zip(data.is_pad) {
            if *pad > 0.0 {
                continue;
            }
            for ((got, want), grad) in got.iter().zip(want).zip(grad) {
                let difference = got - want;
                l1 += f64::from(difference.abs());
                *grad = if difference == 0.0 { 0.0 } else { difference.signum() / entries };
            }
        }
        let l1 = (l1 / f64::from(entries)) as f32;
        let latent_grad = self.decode_backward(pass, data, &latent, decoded, &grad, grads);
        pass.give(grad);

        let mut loss = LossValues { total: l1, parts: BTreeMap::from([("l1_loss".to_string(), l1)]) };
        if let Some(encoded) = encoded {
            let (weight, rows) = (self.config().kl_weight as f32, totals.0.max(1) as f32);
            let mut kld = 0.0f64;
            let mut grad = pass.take(encoded.latent.len());
            for (i, (grad, out)) in
                grad.chunks_exact_mut(2 * width).zip(encoded.latent.chunks_exact(2 * width)).enumerate()
            {
                for j in 0..width {
                    let (mu, lv) = (out[j], out[width + j]);
                    let (through, eps) = (latent_grad[i * width + j], data.eps[i * width + j]);
                    kld -= 0.5 * f64::from(1.0 + lv - mu * mu - lv.exp());
                    grad[j] = through + weight * mu / rows;
                    grad[width + j] = through * eps * 0.5 * (lv / 2.0).exp() + weight * 0.5 * (lv.exp() - 1.0) / rows;
                }
            }
            let kld = (kld / f64::from(rows)) as f32;
            self.encode_backward(pass, data, encoded, &grad, grads);
            pass.give(grad);
            loss.parts.insert("kld_loss".to_string(), kld);
            loss.total += weight * kld;
        }
        pass.give(latent);
        pass.give(latent_grad);
        loss
    }
}

/// The norm after the last layer, if layers norm before their branches.
fn final_norm(pass: &mut Pass<'_>, prefix: &str, x: Vec<f32>) -> (Vec<f32>, Option<Norm>) {
    if !pass.shape.pre_norm {
        return (x, None);
    }
    let (out, norm) = Norm::forward(pass, prefix, &x);
    pass.give(x);
    (out, Some(norm))
}

#[cfg(test)]
#[path = "act_fused_tests.rs"]
mod tests;
