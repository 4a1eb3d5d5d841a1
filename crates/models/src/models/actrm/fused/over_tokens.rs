//! The recursion over the observation's tokens, and ACT's decoder.

use super::{AnswerGrad, Carry, Recursion, Step, mean_over_tokens, shaped};
use crate::fused::{
    Decoder, DecoderGrads, EncoderLayer, Grads, Memory, Norm, Pass, Pointed, PointerGrads, Tokens, positions_backward,
    slot,
};
use crate::kernels::add;
use crate::layers::Pointer;
use crate::models::actrm::{Actrm, Config, Design, OverTokens as Layers};

pub(super) struct OverTokens<'m> {
    config: &'m Config,
    pointer: Option<&'m Pointer>,
    rows: usize,
    /// of the tokens before the first step
    first_norm: Norm,
    /// what it leaves, (b, M, D)
    memory: Vec<f32>,
    memory_grad: Vec<f32>,
    /// the memory with noise, if thoughts begin with it
    noisy: Option<Vec<f32>>,
    /// positions in the block, (M, D): tokens have brought theirs along
    nowhere: Vec<f32>,
    /// positions of what the decoder reads, (M, D) or, with the token that is pointed at, (M + 1, D)
    read_pos: Vec<f32>,
}

pub(super) struct Trace {
    /// whether the step began with what was observed
    first: bool,
    /// `l_cycles` times those of the block
    layers: Vec<EncoderLayer>,
    norm: Norm,
    pointed: Option<Pointed>,
    /// what the decoder reads, (b, M, D) or (b, M + 1, D)
    read: Vec<f32>,
    decoder: Decoder,
    /// what the action head reads, (b, H, D)
    decoded: Vec<f32>,
}

impl<'m> Recursion<'m> for OverTokens<'m> {
    type Trace = Trace;

    fn observe(model: &'m Actrm, pass: &mut Pass<'_>, tokens: &Tokens<'_>, rows: usize) -> Self {
        let Design::Tokens(Layers { pointer, .. }) = &model.design else { unreachable!("asked for by the design") };
        let (config, pointer, pos) = (&model.config, pointer.as_ref(), tokens.positions(pass).into_owned());
        let mut x = tokens.forward(pass);
        x.chunks_exact_mut(pos.len()).for_each(|sequence| add(sequence, &pos));
        let (memory, first_norm) = Norm::forward(pass, "reasoning.first_norm", &x);
        pass.give(x);
        let memory_grad = pass.space.pool.zeros(memory.len());
        let scale = config.reasoning.start_noise as f32;
        let noisy = pass.rng.as_mut().filter(|_| scale > 0.0).map(|rng| {
            let noise = rng.normals(memory.len());
            // the composed model draws a second state's, which nothing reads
            rng.normals(memory.len());
            noise
        });
        let noisy = noisy.map(|noise| {
            let mut noisy = pass.space.pool.copy(&memory);
            noisy.iter_mut().zip(noise).for_each(|(x, noise)| *x += noise * scale);
            noisy
        });
        let nowhere = pass.space.pool.zeros(pos.len());
        let read_pos = match pointer {
            Some(_) => Pointed::positions(pass, &nowhere),
            None => pass.space.pool.copy(&nowhere),
        };
        Self { config, pointer, rows, first_norm, memory, memory_grad, noisy, nowhere, read_pos }
    }

    fn step(&self, pass: &mut Pass<'_>, carry: &Carry, at: usize) -> Step<Trace> {
        let r = &self.config.reasoning;
        let begun = self.noisy.as_ref().unwrap_or(&self.memory);
        let mut x = pass.space.pool.copy(carry.answer.as_ref().unwrap_or(begun));
        let mut layers = Vec::with_capacity(r.l_cycles * r.n_layers);
        shaped(pass, self.config.block_shape(), |pass| {
            for _ in 0..r.l_cycles {
                for i in r.layers_of(at) {
                    let before = std::mem::take(&mut x);
                    let name = format!("reasoning.layers.{i}");
                    let (after, layer) = EncoderLayer::forward(pass, name, before, &self.nowhere, None, false);
                    x = after;
                    layers.push(layer);
                }
            }
        });
        let (mut read, norm) = Norm::forward(pass, "reasoning.norm", &x);
        let mean = mean_over_tokens(pass, &read, self.rows);
        let pointed = self.pointer.map(|pointer| {
            let (beside, pointed) = Pointed::forward(pass, pointer, &read, &self.memory, self.rows);
            pass.give(std::mem::replace(&mut read, beside));
            pointed
        });
        let query_pos = pass.weight("decoder_pos_embed", ".weight");
        let memory = Memory { x: &read, pos: &self.read_pos, batch: self.rows };
        let (decoded, decoder) = Decoder::forward(pass, self.config.n_decoder_layers, query_pos, memory);
        let chunk = pass.linear("action_head", &decoded);
        let carry_on = Carry { answer: Some(x), reasoning: None };
        let trace = Trace { first: carry.answer.is_none(), layers, norm, pointed, read, decoder, decoded };
        Step { carry: carry_on, chunk, read: mean, trace }
    }

    fn pointed(step: &Step<Trace>) -> Option<&Pointed> {
        step.trace.pointed.as_ref()
    }

    fn backward(
        &mut self,
        pass: &mut Pass<'_>,
        step: Step<Trace>,
        answer_grad: &AnswerGrad,
        carry_grad: Carry,
        grads: &mut Grads<'_>,
    ) -> Carry {
        let Step { carry, chunk, read: mean, trace } = step;
        let Trace { first, layers, norm, pointed, read, decoder, decoded } = trace;
        let dim = pass.shape.dim;
        let query_pos = pass.weight("decoder_pos_embed", ".weight");
        pass.linear_backward("action_head", &decoded, &answer_grad.chunk, dim, grads);
        let x = pass.linear_input("action_head", &answer_grad.chunk, dim);
        let mut read_grad = pass.space.pool.zeros(read.len());
        let mut pos_grad = pass.space.pool.zeros(self.read_pos.len());
        let mut query_grad = pass.space.pool.zeros(query_pos.len());
        let mut into = DecoderGrads { memory: &mut read_grad, memory_pos: &mut pos_grad, query_pos: &mut query_grad };
        let memory = Memory { x: &read, pos: &self.read_pos, batch: self.rows };
        decoder.backward(pass, x, query_pos, memory, &mut into, grads);
        add(slot(grads, "decoder_pos_embed", ".weight"), &query_grad);

        if let (Some(pointer), Some(pointed)) = (self.pointer, pointed) {
            // the other tokens' positions are none of the parameters
            Pointed::positions_backward(&pos_grad, dim, grads);
            let mut encoded = pass.space.pool.zeros(self.memory.len());
            let into = PointerGrads { encoded: &mut encoded, tokens: &mut self.memory_grad };
            let of_answer = (&read_grad[..], answer_grad.scores.as_deref());
            pointed.backward(pass, pointer, &self.memory, of_answer, into, grads);
            pass.give(std::mem::replace(&mut read_grad, encoded));
        }
        norm.backward(pass, "reasoning.norm", &mut read_grad, grads);
        let mut grad = read_grad;
        if let Some(later) = carry_grad.answer {
            add(&mut grad, &later);
            pass.give(later);
        }
        shaped(pass, self.config.block_shape(), |pass| {
            for layer in layers.into_iter().rev() {
                let after = std::mem::take(&mut grad);
                grad = layer.backward(pass, after, &self.nowhere, None, grads);
            }
        });
        carry.free(pass);
        for buffer in [chunk, mean, read, decoded, pos_grad, query_grad] {
            pass.give(buffer);
        }
        if !first {
            return Carry { answer: Some(grad), reasoning: None };
        }
        add(&mut self.memory_grad, &grad);
        pass.give(grad);
        Carry::default()
    }

    fn forget(pass: &mut Pass<'_>, step: Step<Trace>) -> Carry {
        let Step { carry, chunk, read: mean, trace } = step;
        let Trace { first: _, layers, norm, pointed, read, decoder, decoded } = trace;
        layers.into_iter().for_each(|layer| layer.free(pass));
        norm.free(pass);
        decoder.free(pass);
        if let Some(pointed) = pointed {
            pointed.free(pass);
        }
        for buffer in [chunk, mean, read, decoded] {
            pass.give(buffer);
        }
        carry
    }

    fn finish(self, pass: &mut Pass<'_>, tokens: &Tokens<'_>, grads: &mut Grads<'_>) -> Vec<f32> {
        let Self { first_norm, memory, memory_grad: mut grad, noisy, nowhere, read_pos, .. } = self;
        first_norm.backward(pass, "reasoning.first_norm", &mut grad, grads);
        let mut pos_grad = pass.space.pool.zeros(nowhere.len());
        grad.chunks_exact(nowhere.len()).for_each(|sequence| add(&mut pos_grad, sequence));
        positions_backward(tokens.layout(), pass.shape.dim, &pos_grad, grads);
        let latent = tokens.backward(pass, &grad, grads);
        for buffer in [memory, grad, nowhere, read_pos, pos_grad].into_iter().chain(noisy) {
            pass.give(buffer);
        }
        latent
    }

    fn free(self, pass: &mut Pass<'_>) {
        self.first_norm.free(pass);
        for buffer in [self.memory, self.memory_grad, self.nowhere, self.read_pos].into_iter().chain(self.noisy) {
            pass.give(buffer);
        }
    }
}
