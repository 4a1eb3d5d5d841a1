//! The recursion over actions.
//!
//! Exact savings over the composed model: the memory's keys and values are projected once per observation, those of the
//! answer once per round; a thought that begins at zero begins with the same tokens in every row, so their projections
//! in the first round are computed once for the whole batch.

use super::{AnswerGrad, Carry, Recursion, Step, mean_over_tokens, shaped};
use crate::fused::{
    BlockLayer, Encoder, Grads, Input, Part, Pass, Tokens, add_to_first, ask, gather, keys_and_values,
    keys_and_values_backward, positions_backward, scatter, slot,
};
use crate::layers::{Shape, Told};
use crate::models::actrm::{Actrm, Config};
use nn::kernels::add;

pub(super) struct OverActions<'m> {
    config: &'m Config,
    rows: usize,
    encoder: Option<Encoder>,
    /// (b, M, D), positions added
    memory: Vec<f32>,
    /// its keys and values for each layer of every block, (b, M, 2D)
    memory_kv: Vec<Vec<f32>>,
    /// and their gradients, once one is there
    memory_kv_grad: Vec<Vec<f32>>,
    /// the gradient of the memory's first tokens, (b, D), where these were asked for something
    first_grad: Option<Vec<f32>>,
}

/// One run of the block over z or y.
struct Update {
    /// inputs of the layers after the first
    inputs: Vec<Vec<f32>>,
    layers: Vec<BlockLayer>,
}

/// What the backward pass of a round needs.
pub(super) struct Round {
    /// number of its block's first layer
    first_layer: usize,
    /// the answer before it with positions, (b, H, D), or (H, D) if it was zero
    y: Vec<f32>,
    /// the reasoning with positions that each update saw, likewise
    z: Vec<Vec<f32>>,
    /// `l_cycles` of the reasoning, then the answer's
    updates: Vec<Update>,
}

impl Round {
    fn free(self, pass: &mut Pass<'_>) {
        for update in self.updates {
            update.layers.into_iter().for_each(|layer| layer.free(pass));
            update.inputs.into_iter().for_each(|buffer| pass.give(buffer));
        }
        self.z.into_iter().chain([self.y]).for_each(|buffer| pass.give(buffer));
    }
}

/// Adds to `into`, (t, D), the sum of the sequences of `x`.
fn add_sequences(into: &mut [f32], x: &[f32]) {
    for sequence in x.chunks_exact(into.len()) {
        add(into, sequence);
    }
}

/// x: (b, t, D) -> x + pos, or pos alone, (t, D), for an x of zeros
fn positioned(pass: &mut Pass<'_>, x: Option<&[f32]>, pos: &[f32]) -> Vec<f32> {
    let mut out = pass.space.pool.copy(x.unwrap_or(pos));
    if x.is_some() {
        out.chunks_exact_mut(pos.len()).for_each(|sequence| add(sequence, pos));
    }
    out
}

fn layer_prefix(i: usize) -> String {
    format!("reasoning.layers.{i}")
}

fn attention_prefix(i: usize) -> String {
    format!("reasoning.layers.{i}.attn")
}

impl OverActions<'_> {
    /// No dropout inside the recursion.
    fn inner(&self) -> Shape {
        Shape { hidden: self.config.block_feedforward(), dropout: 0.0, ..self.config.shape() }
    }

    fn n_layers(&self) -> usize {
        self.config.reasoning.n_layers
    }

    fn memory_tokens(&self) -> usize {
        self.memory.len() / (self.rows * self.config.dim_model)
    }

    /// `l_cycles` updates of the reasoning, one of the answer, by the block that begins with layer `first_layer`.
    fn round(&self, pass: &mut Pass<'_>, carry: &Carry, first_layer: usize) -> (Carry, Round) {
        let prefix = |i: usize| attention_prefix(first_layer + i);
        let (dim, horizon) = (pass.shape.dim, self.config.action_horizon);
        let (tokens, l_cycles) = (self.config.reasoning.tokens, self.config.reasoning.l_cycles);
        let action_pos = pass.weight("reasoning.action_pos_embed", ".weight");
        let latent_pos = pass.weight("reasoning.latent_pos_embed", ".weight");
        let y = positioned(pass, carry.answer.as_deref(), action_pos);
        // a thought that begins at zero reads its positions alone
        let y_parameter = carry.answer.is_none().then_some("the action positions");
        let y_input = Input { x: &y, parameter: y_parameter };
        let y_kv: Vec<_> = (0..self.n_layers()).map(|i| keys_and_values(pass, &prefix(i), y_input)).collect();
        let mut z = vec![positioned(pass, carry.reasoning.as_deref(), latent_pos)];
        let mut updates = Vec::with_capacity(l_cycles + 1);
        let mut settled: Option<Vec<f32>> = None;
        loop {
            let of_answer = updates.len() == l_cycles;
            let seen = z.last().expect("it begins with one");
            let parameter = (settled.is_none() && carry.reasoning.is_none()).then_some("the latent positions");
            let seen = Input { x: seen, parameter };
            let (first, queries) = if of_answer { (y_input, horizon) } else { (seen, tokens) };
            let (mut inputs, mut layers) = (Vec::<Vec<f32>>::new(), Vec::with_capacity(self.n_layers()));
            for (i, y_kv) in y_kv.iter().enumerate() {
                let z_kv = keys_and_values(pass, &prefix(i), seen);
                let parts = [
                    Part { values: &z_kv, tokens },
                    Part { values: y_kv, tokens: horizon },
                    Part { values: &self.memory_kv[first_layer + i], tokens: self.memory_tokens() },
                ];
                let kv = gather(pass, self.rows, 2 * dim, &parts);
                pass.give(z_kv);
                let input = inputs.last().map_or(first, |x| Input { x, parameter: None });
                let name = layer_prefix(first_layer + i);
                let (out, layer) = BlockLayer::forward(pass, name, (self.rows, queries), input, kv);
                inputs.push(out);
                layers.push(layer);
            }
            let out = inputs.pop();
            updates.push(Update { inputs, layers });
            if of_answer {
                y_kv.into_iter().for_each(|buffer| pass.give(buffer));
                return (Carry { answer: out, reasoning: settled }, Round { first_layer, y, z, updates });
            }
            z.push(positioned(pass, out.as_deref(), latent_pos));
            if let Some(before) = std::mem::replace(&mut settled, out) {
                pass.give(before);
            }
        }
    }

    /// Takes the gradients of the carry that the round left; returns those of the one it began with.
    fn round_backward(&mut self, pass: &mut Pass<'_>, round: Round, after: Carry, grads: &mut Grads<'_>) -> Carry {
        let (dim, tokens, horizon) = (pass.shape.dim, self.config.reasoning.tokens, self.config.action_horizon);
        let memory_tokens = self.memory_tokens();
        let Round { first_layer, y, z, updates } = round;
        let mut y_kv_grad: Vec<_> = (0..self.n_layers()).map(|_| pass.space.pool.zeros(2 * y.len())).collect();
        // what will be the gradient of y once the answer's update, the last, is passed
        let (mut out_grad, mut reasoning_grad) = (after.answer, after.reasoning);
        let mut y_grad = None;
        for (update, seen) in updates.into_iter().zip(z).rev() {
            let of_answer = y_grad.is_none();
            let mut grad = out_grad.take().expect("the gradient of an update's result");
            let mut z_grad = pass.space.pool.zeros(seen.len());
            for (i, layer) in update.layers.into_iter().enumerate().rev() {
                let x = match i {
                    0 if of_answer => &y,
                    0 => &seen,
                    _ => &update.inputs[i - 1],
                };
                let (x_grad, kv_grad) = layer.backward(pass, grad, x, grads);
                grad = x_grad;
                let mut z_kv_grad = pass.space.pool.zeros(2 * seen.len());
                let mut parts = [
                    (&mut z_kv_grad[..], tokens),
                    (&mut y_kv_grad[i][..], horizon),
                    (&mut self.memory_kv_grad[first_layer + i][..], memory_tokens),
                ];
                scatter(&kv_grad, 2 * dim, &mut parts);
                let prefix = attention_prefix(first_layer + i);
                keys_and_values_backward(pass, &prefix, &seen, &z_kv_grad, &mut z_grad, grads);
                pass.give(kv_grad);
                pass.give(z_kv_grad);
            }
            if of_answer {
                y_grad = Some(grad);
            } else {
                add(&mut z_grad, &grad);
                pass.give(grad);
            }
            add_sequences(slot(grads, "reasoning.latent_pos_embed", ".weight"), &z_grad);
            // the reasoning that the answer saw is also the one that the carry takes on
            if let Some(later) = reasoning_grad.take() {
                add(&mut z_grad, &later);
                pass.give(later);
            }
            out_grad = Some(z_grad);
            update.inputs.into_iter().chain([seen]).for_each(|buffer| pass.give(buffer));
        }
        let mut y_grad = y_grad.expect("the answer is updated in every round");
        for (i, kv_grad) in y_kv_grad.into_iter().enumerate() {
            let prefix = attention_prefix(first_layer + i);
            keys_and_values_backward(pass, &prefix, &y, &kv_grad, &mut y_grad, grads);
            pass.give(kv_grad);
        }
        add_sequences(slot(grads, "reasoning.action_pos_embed", ".weight"), &y_grad);
        pass.give(y);
        Carry { answer: Some(y_grad), reasoning: out_grad }
    }
}

impl<'m> Recursion<'m> for OverActions<'m> {
    type Trace = Round;

    fn observe(model: &'m Actrm, pass: &mut Pass<'_>, tokens: &Tokens<'_>, rows: usize) -> Self {
        let config = &model.config;
        let pos = &*tokens.positions(pass);
        let (mut memory, mut encoder) = (tokens.forward(pass), None);
        if config.n_memory_layers > 0 {
            let (out, done) = Encoder::forward(pass, "encoder", config.n_memory_layers, memory, pos, None, false);
            (memory, encoder) = (out, Some(done));
        }
        memory.chunks_exact_mut(pos.len()).for_each(|sequence| add(sequence, pos));
        let layers = 0..config.reasoning.blocks() * config.reasoning.n_layers;
        let memory_kv = layers
            .map(|i| keys_and_values(pass, &attention_prefix(i), Input { x: &memory, parameter: None }))
            .collect();
        Self { config, rows, encoder, memory, memory_kv, memory_kv_grad: Vec::new(), first_grad: None }
    }

    fn step(&self, pass: &mut Pass<'_>, carry: &Carry, at: usize) -> Step<Round> {
        let first_layer = self.config.reasoning.layers_of(at).start;
        shaped(pass, self.inner(), |pass| {
            let (mut after, mut round) = self.round(pass, carry, first_layer);
            // earlier rounds than the last leave no trace
            for _ in 1..self.config.reasoning.h_cycles {
                round.free(pass);
                let before = after;
                (after, round) = self.round(pass, &before, first_layer);
                before.free(pass);
            }
            let (answer, reasoning) = (after.answer.as_ref(), after.reasoning.as_ref());
            let chunk = pass.linear("action_head", answer.expect("a round leaves an answer"));
            let read = mean_over_tokens(pass, reasoning.expect("a round leaves a reasoning"), self.rows);
            Step { carry: after, chunk, read, trace: round }
        })
    }

    fn ask(&mut self, pass: &mut Pass<'_>, told: (&Told, f64), grads: &mut Grads<'_>) -> Option<f64> {
        let (loss, grad) = ask(pass, told, &self.memory, self.rows, grads);
        self.first_grad = Some(grad);
        Some(loss)
    }

    fn backward(
        &mut self,
        pass: &mut Pass<'_>,
        step: Step<Round>,
        answer_grad: &AnswerGrad,
        carry_grad: Carry,
        grads: &mut Grads<'_>,
    ) -> Carry {
        let Step { carry, chunk, read, trace } = step;
        if self.memory_kv_grad.is_empty() {
            self.memory_kv_grad = self.memory_kv.iter().map(|kv| pass.space.pool.zeros(kv.len())).collect();
        }
        shaped(pass, self.inner(), |pass| {
            let dim = pass.shape.dim;
            let answer = carry.answer.as_ref().expect("a step leaves an answer");
            pass.linear_backward("action_head", answer, &answer_grad.chunk, dim, grads);
            let mut state_grad = pass.linear_input("action_head", &answer_grad.chunk, dim);
            if let Some(later) = carry_grad.answer {
                add(&mut state_grad, &later);
                pass.give(later);
            }
            carry.free(pass);
            pass.give(chunk);
            pass.give(read);
            let after = Carry { answer: Some(state_grad), reasoning: carry_grad.reasoning };
            let before = self.round_backward(pass, trace, after, grads);
            if self.config.reasoning.h_cycles == 1 {
                return before;
            }
            // the rounds before were without gradient
            before.free(pass);
            Carry::default()
        })
    }

    fn forget(pass: &mut Pass<'_>, step: Step<Round>) -> Carry {
        step.trace.free(pass);
        pass.give(step.chunk);
        pass.give(step.read);
        step.carry
    }

    fn finish(mut self, pass: &mut Pass<'_>, tokens: &Tokens<'_>, grads: &mut Grads<'_>) -> Vec<f32> {
        let pos = &*tokens.positions(pass);
        let mut grad = pass.space.pool.zeros(self.memory.len());
        for (i, kv_grad) in std::mem::take(&mut self.memory_kv_grad).into_iter().enumerate() {
            keys_and_values_backward(pass, &attention_prefix(i), &self.memory, &kv_grad, &mut grad, grads);
            pass.give(kv_grad);
        }
        if let Some(first) = self.first_grad.take() {
            add_to_first(&mut grad, &first, self.rows);
            pass.give(first);
        }
        let mut pos_grad = pass.space.pool.zeros(pos.len());
        add_sequences(&mut pos_grad, &grad);
        if let Some(encoder) = self.encoder.take() {
            grad = encoder.backward(pass, grad, pos, Some(&mut pos_grad), grads);
        }
        positions_backward(tokens.layout(), self.config.dim_model, &pos_grad, grads);
        let latent = tokens.backward(pass, &grad, grads);
        pass.give(grad);
        pass.give(pos_grad);
        self.free(pass);
        latent
    }

    fn free(self, pass: &mut Pass<'_>) {
        if let Some(encoder) = self.encoder {
            encoder.free(pass);
        }
        let buffers = self.memory_kv.into_iter().chain(self.memory_kv_grad).chain(self.first_grad).chain([self.memory]);
        buffers.for_each(|buffer| pass.give(buffer));
    }
}
