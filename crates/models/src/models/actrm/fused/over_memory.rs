//! The recursion over the memory, the original's, and ACT's decoder.

use super::{AnswerGrad, Carry, Recursion, Step, mean_over_tokens, shaped};
use crate::fused::{Decoder, DecoderGrads, Encoder, Grads, Memory, Pass, Tokens, positions_backward, slot};
use crate::layers::{Shape, TokenLayout};
use crate::models::actrm::{Actrm, Config, fixed_values};
use nn::kernels::add;

pub(super) struct OverMemory<'m> {
    config: &'m Config,
    rows: usize,
    /// the observation's tokens, (b, M, D)
    tokens: Vec<f32>,
    tokens_grad: Vec<f32>,
    layout: &'m TokenLayout,
    /// their positions, (M, D)
    positions: Vec<f32>,
    /// what `z_h` and `z_l` begin with, (D)
    start: [Vec<f32>; 2],
}

pub(super) struct Trace {
    /// the last round's runs of the block: `l_cycles` of `z_l`, then that of `z_h`
    updates: Vec<Encoder>,
    decoder: Decoder,
    /// what the action head reads, (b, H, D)
    decoded: Vec<f32>,
}

fn forget_updates(pass: &mut Pass<'_>, updates: Vec<Encoder>) {
    updates.into_iter().for_each(|update| update.free(pass));
}

impl OverMemory<'_> {
    /// No dropout inside the recursion.
    fn inner(&self) -> Shape {
        Shape { dropout: 0.0, ..self.config.shape() }
    }

    /// The block over the sum of two states.
    fn update(&self, pass: &mut Pass<'_>, a: &[f32], b: &[f32]) -> (Vec<f32>, Encoder) {
        let mut x = pass.space.pool.copy(a);
        add(&mut x, b);
        Encoder::forward(pass, "reasoning", self.config.reasoning.n_layers, x, &self.positions, None, false)
    }

    /// A copy of a state, or what it begins with in every token.
    fn begun(&self, pass: &mut Pass<'_>, state: Option<&[f32]>, start: &[f32]) -> Vec<f32> {
        let mut copy = pass.take(self.tokens.len());
        match state {
            Some(state) => copy.copy_from_slice(state),
            None => copy.chunks_exact_mut(start.len()).for_each(|token| token.copy_from_slice(start)),
        }
        copy
    }

    /// `l_cycles` updates of `z_l`, one of `z_h`.
    fn round(&self, pass: &mut Pass<'_>, carry: &Carry) -> (Carry, Vec<Encoder>) {
        let answer = self.begun(pass, carry.answer.as_deref(), &self.start[0]);
        let mut reasoning = self.begun(pass, carry.reasoning.as_deref(), &self.start[1]);
        let mut injected = pass.space.pool.copy(&answer);
        add(&mut injected, &self.tokens);
        let mut updates = Vec::with_capacity(self.config.reasoning.l_cycles + 1);
        for _ in 0..self.config.reasoning.l_cycles {
            let (out, update) = self.update(pass, &reasoning, &injected);
            pass.give(std::mem::replace(&mut reasoning, out));
            updates.push(update);
        }
        let (out, update) = self.update(pass, &answer, &reasoning);
        updates.push(update);
        pass.give(injected);
        pass.give(answer);
        (Carry { answer: Some(out), reasoning: Some(reasoning) }, updates)
    }
}

impl<'m> Recursion<'m> for OverMemory<'m> {
    type Trace = Trace;

    fn observe(model: &'m Actrm, pass: &mut Pass<'_>, tokens: &Tokens<'_>, rows: usize) -> Self {
        let config = &model.config;
        let positions = tokens.positions(pass).into_owned();
        let tokens = tokens.forward(pass);
        let tokens_grad = pass.space.pool.zeros(tokens.len());
        let start = fixed_values(config.dim_model);
        Self { config, rows, tokens, tokens_grad, layout: model.tokens.layout(), positions, start }
    }

    fn step(&self, pass: &mut Pass<'_>, carry: &Carry, _at: usize) -> Step<Trace> {
        let (after, updates) = shaped(pass, self.inner(), |pass| {
            let (mut after, mut updates) = self.round(pass, carry);
            // earlier rounds than the last leave no trace
            for _ in 1..self.config.reasoning.h_cycles {
                forget_updates(pass, updates);
                let before = after;
                (after, updates) = self.round(pass, &before);
                before.free(pass);
            }
            (after, updates)
        });
        let answer = after.answer.as_ref().expect("a round leaves an answer");
        let query_pos = pass.weight("decoder_pos_embed", ".weight");
        let memory = Memory { x: answer, pos: &self.positions, batch: self.rows };
        let (decoded, decoder) = Decoder::forward(pass, self.config.n_decoder_layers, query_pos, memory);
        let chunk = pass.linear("action_head", &decoded);
        let read = mean_over_tokens(pass, answer, self.rows);
        Step { carry: after, chunk, read, trace: Trace { updates, decoder, decoded } }
    }

    /// The carry goes on detached: no gradient comes with it, none is returned.
    fn backward(
        &mut self,
        pass: &mut Pass<'_>,
        step: Step<Trace>,
        answer_grad: &AnswerGrad,
        carry_grad: Carry,
        grads: &mut Grads<'_>,
    ) -> Carry {
        let Step { carry, chunk, read, trace: Trace { mut updates, decoder, decoded } } = step;
        let dim = pass.shape.dim;
        let query_pos = pass.weight("decoder_pos_embed", ".weight");
        pass.linear_backward("action_head", &decoded, &answer_grad.chunk, dim, grads);
        let x = pass.linear_input("action_head", &answer_grad.chunk, dim);
        let answer = carry.answer.as_ref().expect("a step leaves an answer");
        let mut state_grad = pass.space.pool.zeros(answer.len());
        let pos = &self.positions;
        let (mut pos_grad, mut query_grad) = (pass.space.pool.zeros(pos.len()), pass.space.pool.zeros(query_pos.len()));
        let mut into = DecoderGrads { memory: &mut state_grad, memory_pos: &mut pos_grad, query_pos: &mut query_grad };
        let memory = Memory { x: answer, pos, batch: self.rows };
        decoder.backward(pass, x, query_pos, memory, &mut into, grads);
        add(slot(grads, "decoder_pos_embed", ".weight"), &query_grad);

        shaped(pass, self.inner(), |pass| {
            let last = updates.pop().expect("a round updates its answer");
            let mut grad = last.backward(pass, state_grad, pos, Some(&mut pos_grad), grads);
            for update in updates.into_iter().rev() {
                // of the state before and of what was injected alike
                grad = update.backward(pass, grad, pos, Some(&mut pos_grad), grads);
                add(&mut self.tokens_grad, &grad);
            }
            pass.give(grad);
        });
        positions_backward(self.layout, dim, &pos_grad, grads);
        carry.free(pass);
        carry_grad.free(pass);
        for buffer in [pos_grad, query_grad, chunk, read, decoded] {
            pass.give(buffer);
        }
        Carry::default()
    }

    fn forget(pass: &mut Pass<'_>, step: Step<Trace>) -> Carry {
        let Step { carry, chunk, read, trace: Trace { updates, decoder, decoded } } = step;
        forget_updates(pass, updates);
        decoder.free(pass);
        for buffer in [chunk, read, decoded] {
            pass.give(buffer);
        }
        carry
    }

    fn finish(self, pass: &mut Pass<'_>, tokens: &Tokens<'_>, grads: &mut Grads<'_>) -> Vec<f32> {
        let latent = tokens.backward(pass, &self.tokens_grad, grads);
        self.free(pass);
        latent
    }

    fn free(self, pass: &mut Pass<'_>) {
        pass.give(self.tokens);
        pass.give(self.tokens_grad);
    }
}
