//! ACT's training step and prediction on `fused` layers: the maths of `act/mod.rs`, written out forwards and backwards.
//!
//! Exact savings over the composed model: of the VAE encoder's last layer only the first token is computed, because
//! nothing else is read; the first decoder layer's queries, keys and values are computed once for the whole batch,
//! because its input is zero for every sample.

use super::Act;
use crate::batch::Batch;
use crate::device::HERE;
use crate::error::Result;
use crate::features::Features;
use crate::fused::{
    AbsoluteError, Data, Decoder, DecoderGrads, Encoder, Grads, Memory, Pass, Pointed, PointerGrads, Tokens, Vae,
    add_to_first, ask, inputs, positions_backward, slot, with_weights,
};
use crate::gradients::Gradients;
use crate::kernels::add;
use crate::layers::{Asked, Told};
use crate::model::{LossValues, PolicyModel};
use crate::rng::Rng;
use crate::values::with_values;
use candle_core::Tensor;
use std::collections::BTreeMap;

/// What the decoder's backward pass needs.
struct Decoded {
    encoder: Encoder,
    /// what the decoder reads, (b, M, D), or (b, M + 1, D) with the token that is pointed at
    memory: Vec<f32>,
    /// its positions
    pos: Vec<f32>,
    /// what a pointer says, and the tokens before the encoder, (b, M, D)
    pointed: Option<(Pointed, Vec<f32>)>,
    decoder: Decoder,
    /// after the norm, (b, C, D)
    x: Vec<f32>,
    /// (b, C, A)
    actions: Vec<f32>,
}

impl Act {
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
        let observation = self.tokens.look(&batch.observation, None)?;
        let data = Data::of(&Batch { observation, ..batch.clone() }, self.tokens.layout())?;
        let eps = with_values(eps, <[f32]>::to_vec)?;
        let asked = self.pointer.as_ref().map(|pointer| pointer.asked("act", batch)).transpose()?;
        let told = self.auxiliary.as_ref().map(|asked| asked.told("act", batch)).transpose()?;
        self.workspaces.with(|space| {
            with_weights(self.params(), |weights| {
                let pass = &mut Pass { weights, shape: self.config().shape(), space, rng, packed: None, on_seen: None };
                self.step(pass, (&data, asked.as_ref(), told.as_ref()), eps, &mut into.views())
            })
        })
    }

    /// The features of the observation -> (b, C, A); `on_seen` is called when pictures have become tokens.
    pub(crate) fn fused_predict(&self, observation: &Features<Tensor>, on_seen: &mut dyn FnMut()) -> Result<Tensor> {
        let rows = self.check_inputs(observation)?;
        let inputs = inputs(self.tokens.layout(), &self.tokens.look(observation, None)?)?;
        let packed = self.workspaces.packed(self.params());
        let actions = self.workspaces.with(|space| {
            with_weights(self.params(), |weights| {
                let (shape, packed) = (self.config().shape(), Some(&*packed));
                let pass = &mut Pass { weights, shape, space, rng: None, packed, on_seen: Some(&mut *on_seen) };
                let latent = pass.space.pool.zeros(rows * self.config().latent_dim);
                let tokens = Tokens::new(self.tokens.layout(), (&latent, self.config().latent_dim), &inputs);
                let Decoded { encoder, memory, pos, pointed, decoder, x, actions } =
                    self.decode_fused(pass, rows, &tokens);
                let out = actions.clone();
                encoder.free(pass);
                decoder.free(pass);
                if let Some((pointed, before)) = pointed {
                    pointed.free(pass);
                    pass.give(before);
                }
                for buffer in [latent, memory, pos, x, actions] {
                    pass.give(buffer);
                }
                out
            })
        })?;
        Ok(Tensor::from_vec(actions, (rows, self.config().action_horizon, self.signature.action_dim), &HERE)?)
    }

    fn decode_fused(&self, pass: &mut Pass<'_>, rows: usize, tokens: &Tokens<'_>) -> Decoded {
        let x = tokens.forward(pass);
        let given = tokens.positions(pass);
        let mut pos = pass.space.pool.copy(&given);
        let before = self.pointer.as_ref().map(|pointer| (pointer, pass.space.pool.copy(&x)));
        let layers = self.config().n_encoder_layers;
        let (mut memory, encoder) = Encoder::forward(pass, "encoder", layers, x, &given, None, false);
        let pointed = before.map(|(pointer, before)| {
            let (beside, pointed) = Pointed::forward(pass, pointer, &memory, &before, rows);
            pass.give(std::mem::replace(&mut memory, beside));
            let beside = Pointed::positions(pass, &pos);
            pass.give(std::mem::replace(&mut pos, beside));
            (pointed, before)
        });
        let query_pos = pass.weight("decoder_pos_embed", ".weight");
        let from = Memory { x: &memory, pos: &pos, batch: rows };
        let (x, decoder) = Decoder::forward(pass, self.config().n_decoder_layers, query_pos, from);
        let actions = pass.linear("action_head", &x);
        Decoded { encoder, memory, pos, pointed, decoder, x, actions }
    }

    /// Takes the gradients of the actions, (b, C, A), of a pointer's scores, and of the encoder's first tokens, (b, D), where
    /// those are asked for something; returns that of the latent, (b, L).
    fn decode_backward(
        &self,
        pass: &mut Pass<'_>,
        rows: usize,
        tokens: &Tokens<'_>,
        done: Decoded,
        (grad, scores, first): (&[f32], Option<&[f32]>, Option<&[f32]>),
        grads: &mut Grads<'_>,
    ) -> Vec<f32> {
        let dim = pass.shape.dim;
        pass.linear_backward("action_head", &done.x, grad, dim, grads);
        let x = pass.linear_input("action_head", grad, dim);
        let (pos, query_pos) = (&*tokens.positions(pass), pass.weight("decoder_pos_embed", ".weight"));
        let mut memory = pass.space.pool.zeros(done.memory.len());
        let mut memory_pos = pass.space.pool.zeros(done.pos.len());
        let mut query = pass.space.pool.zeros(query_pos.len());
        let from = Memory { x: &done.memory, pos: &done.pos, batch: rows };
        let mut into = DecoderGrads { memory: &mut memory, memory_pos: &mut memory_pos, query_pos: &mut query };
        done.decoder.backward(pass, x, query_pos, from, &mut into, grads);
        let mut before_grad = None;
        if let (Some(pointer), Some((pointed, before))) = (&self.pointer, done.pointed) {
            Pointed::positions_backward(&memory_pos, dim, grads);
            memory_pos.truncate(pos.len());
            let (mut encoded, mut tokens) = (pass.space.pool.zeros(before.len()), pass.space.pool.zeros(before.len()));
            let into = PointerGrads { encoded: &mut encoded, tokens: &mut tokens };
            pointed.backward(pass, pointer, &before, (&memory, scores), into, grads);
            pass.give(std::mem::replace(&mut memory, encoded));
            pass.give(before);
            before_grad = Some(tokens);
        }
        if let Some(first) = first {
            add_to_first(&mut memory, first, rows);
        }
        let mut x = done.encoder.backward(pass, memory, pos, Some(&mut memory_pos), grads);
        if let Some(grad) = before_grad {
            add(&mut x, &grad);
            pass.give(grad);
        }
        positions_backward(tokens.layout(), dim, &memory_pos, grads);
        add(slot(grads, "decoder_pos_embed", ".weight"), &query);
        let latent = tokens.backward(pass, &x, grads);
        for buffer in [x, memory_pos, query, done.memory, done.pos, done.x, done.actions] {
            pass.give(buffer);
        }
        latent
    }

    /// One shard, forwards and backwards.
    fn step(
        &self,
        pass: &mut Pass<'_>,
        (data, asked, told): (&Data, Option<&Asked>, Option<&Told>),
        eps: Vec<f32>,
        grads: &mut Grads<'_>,
    ) -> LossValues {
        let (config, rows) = (self.config(), data.rows);
        let vae = Vae {
            n_layers: config.n_vae_encoder_layers,
            latent_dim: config.latent_dim,
            positions: self.position_table(),
        };
        let (latent, encoded) = match config.use_vae {
            true => {
                let (latent, encoded) = vae.forward(pass, data, |_| eps);
                (latent, Some(encoded))
            }
            false => (pass.space.pool.zeros(rows * config.latent_dim), None),
        };
        let tokens = Tokens::new(self.tokens.layout(), (&latent, config.latent_dim), &data.inputs);
        let decoded = self.decode_fused(pass, rows, &tokens);

        let entries = data.total_entries as f32;
        let mut grad = pass.take(decoded.actions.len());
        let into = Some((&mut grad[..], 1.0 / entries));
        let l1 = AbsoluteError::of(&decoded.actions, &data.actions, &data.is_pad, rows, into).total();
        let l1 = (l1 / f64::from(entries)) as f32;
        let mut loss = LossValues { total: l1, parts: BTreeMap::from([("l1_loss".to_string(), l1)]) };
        let mut scores = None;
        if let (Some(pointer), Some(asked), Some((pointed, _))) = (&self.pointer, asked, &decoded.pointed) {
            let mut grad = pass.take(pointed.scores.len());
            let answers = asked.answers(&pointed.scores, Some((&mut grad, pointer.weight)));
            loss.parts.insert("pointer_loss".to_string(), answers.loss as f32);
            loss.parts.insert("pointer_right".to_string(), answers.right);
            loss.total += (answers.loss * pointer.weight) as f32;
            scores = Some(grad);
        }
        let mut first = None;
        if let (Some(auxiliary), Some(told)) = (&self.auxiliary, told) {
            let (error, grad) = ask(pass, (told, auxiliary.weight), &decoded.memory, rows, grads);
            loss.parts.insert("auxiliary_loss".to_string(), error as f32);
            loss.total += (error * auxiliary.weight) as f32;
            first = Some(grad);
        }
        let of_answers = (&*grad, scores.as_deref(), first.as_deref());
        let latent_grad = self.decode_backward(pass, rows, &tokens, decoded, of_answers, grads);
        [grad].into_iter().chain(scores).chain(first).for_each(|buffer| pass.give(buffer));

        if let Some(encoded) = encoded {
            let kld = vae.backward(pass, data, encoded, &latent_grad, config.kl_weight, grads);
            loss.parts.insert("kld_loss".to_string(), kld);
            loss.total += config.kl_weight as f32 * kld;
        }
        pass.give(latent);
        pass.give(latent_grad);
        loss
    }
}

#[cfg(test)]
#[path = "fused_tests.rs"]
mod tests;
