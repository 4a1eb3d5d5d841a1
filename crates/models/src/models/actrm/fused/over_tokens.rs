//! The recursion over the observation's tokens, and ACT's decoder.

use super::{AnswerGrad, Carry, Recursion, Step, mean_over_tokens, shaped};
use crate::fused::{
    Decoder, DecoderGrads, EncoderLayer, Grads, GridLayer, Memory, Norm, Pass, Pointed, PointerGrads, Tokens, cells_of,
    positions_backward, put_cells, slot,
};
use crate::layers::{Cells, Pointer, WAY};
use crate::models::actrm::{Actrm, Config, Design, TokenLayers};
use nn::kernels::add;

pub(super) struct OverTokens<'m> {
    config: &'m Config,
    pointer: Option<&'m Pointer>,
    /// of a grid, if the recursion goes over one
    cells: Option<&'m Cells>,
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

/// What the way of a grid is read off, (b, cells, D), and what it says, (b, cells).
struct Way {
    read: Vec<f32>,
    scores: Vec<f32>,
}

/// `l_cycles` times those of the block.
enum Layers {
    Attention(Vec<EncoderLayer>),
    Grid(Vec<GridLayer>),
}

pub(super) struct Trace {
    /// whether the step began with what was observed
    first: bool,
    layers: Layers,
    norm: Norm,
    pointed: Option<Pointed>,
    way: Option<Way>,
    /// what the decoder reads, (b, M, D) or (b, M + 1, D)
    read: Vec<f32>,
    decoder: Decoder,
    /// what the action head reads, (b, H, D)
    decoded: Vec<f32>,
}

impl OverTokens<'_> {
    /// The layers of step `at` on all tokens, (b, M, D), by attention.
    fn attend(&self, pass: &mut Pass<'_>, at: usize, x: &mut Vec<f32>) -> Layers {
        let r = &self.config.reasoning;
        let mut layers = Vec::with_capacity(r.l_cycles * r.n_layers);
        shaped(pass, self.config.block_shape(), |pass| {
            for i in (0..r.l_cycles).flat_map(|_| r.layers_of(at)) {
                let (name, before) = (format!("reasoning.layers.{i}"), std::mem::take(x));
                let (after, layer) = EncoderLayer::forward(pass, name, before, &self.nowhere, None, false);
                *x = after;
                layers.push(layer);
            }
        });
        Layers::Attention(layers)
    }

    /// The same on the cells of a grid, from neighbour to neighbour; the other tokens stay.
    fn spread(&self, pass: &mut Pass<'_>, at: usize, cells: &Cells, x: &mut [f32]) -> Layers {
        let r = &self.config.reasoning;
        let mut layers = Vec::with_capacity(r.l_cycles * r.n_layers);
        let mut own = cells_of(pass, cells.grid, x, self.rows);
        shaped(pass, self.config.block_shape(), |pass| {
            for i in (0..r.l_cycles).flat_map(|_| r.layers_of(at)) {
                let name = format!("reasoning.layers.{i}");
                let (after, layer) = GridLayer::forward(pass, name, cells.grid, std::mem::take(&mut own));
                own = after;
                layers.push(layer);
            }
        });
        put_cells(pass.shape.dim, cells.grid, x, &own);
        pass.give(own);
        Layers::Grid(layers)
    }
}

impl<'m> Recursion<'m> for OverTokens<'m> {
    type Trace = Trace;

    fn observe(model: &'m Actrm, pass: &mut Pass<'_>, tokens: &Tokens<'_>, rows: usize) -> Self {
        let Design::Tokens(design) = &model.design else { unreachable!("asked for by the design") };
        let (config, pointer, pos) = (&model.config, design.pointer.as_ref(), tokens.positions(pass).into_owned());
        let cells = match &design.layers {
            TokenLayers::Grid(cells, _) => Some(cells),
            TokenLayers::Attention(_) => None,
        };
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
        Self { config, pointer, cells, rows, first_norm, memory, memory_grad, noisy, nowhere, read_pos }
    }

    fn step(&self, pass: &mut Pass<'_>, carry: &Carry, at: usize) -> Step<Trace> {
        let begun = self.noisy.as_ref().unwrap_or(&self.memory);
        let mut x = pass.space.pool.copy(carry.answer.as_ref().unwrap_or(begun));
        let layers = match self.cells {
            None => self.attend(pass, at, &mut x),
            Some(cells) => {
                if at > 0 {
                    add(&mut x, &self.memory);
                }
                self.spread(pass, at, cells, &mut x)
            }
        };
        let (mut read, norm) = Norm::forward(pass, "reasoning.norm", &x);
        let mean = mean_over_tokens(pass, &read, self.rows);
        let pointed = self.pointer.map(|pointer| {
            let (beside, pointed) = Pointed::forward(pass, pointer, &read, &self.memory, self.rows);
            pass.give(std::mem::replace(&mut read, beside));
            pointed
        });
        let way = self.cells.filter(|cells| cells.weight > 0.0).map(|cells| {
            let read = cells_of(pass, cells.grid, &read, self.rows);
            Way { scores: pass.linear(WAY, &read), read }
        });
        if self.cells.is_some() {
            let under_norm = pass.space.pool.copy(&read);
            pass.give(std::mem::replace(&mut x, under_norm));
        }
        let query_pos = pass.weight("decoder_pos_embed", ".weight");
        let memory = Memory { x: &read, pos: &self.read_pos, batch: self.rows };
        let (decoded, decoder) = Decoder::forward(pass, self.config.n_decoder_layers, query_pos, memory);
        let chunk = pass.linear("action_head", &decoded);
        let carry_on = Carry { answer: Some(x), reasoning: None };
        let trace = Trace { first: carry.answer.is_none(), layers, norm, pointed, way, read, decoder, decoded };
        Step { carry: carry_on, chunk, read: mean, trace }
    }

    fn scores(step: &Step<Trace>) -> Option<&[f32]> {
        let pointed = step.trace.pointed.as_ref().map(|pointed| &pointed.scores);
        pointed.or(step.trace.way.as_ref().map(|way| &way.scores)).map(Vec::as_slice)
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
        let Trace { first, layers, norm, pointed, way, read, decoder, decoded } = trace;
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
        if let (Some(cells), Some(way)) = (self.cells, way) {
            if let Some(scores) = &answer_grad.scores {
                pass.linear_backward(WAY, &way.read, scores, dim, grads);
                let of_cells = pass.linear_input(WAY, scores, dim);
                let mut of_all = pass.space.pool.zeros(read_grad.len());
                put_cells(dim, cells.grid, &mut of_all, &of_cells);
                add(&mut read_grad, &of_all);
                pass.give(of_cells);
                pass.give(of_all);
            }
            pass.give(way.read);
            pass.give(way.scores);
        }
        // over a grid the states go on under the norm, else before it
        let (before, after) = match self.cells {
            Some(_) => (carry_grad.answer, None),
            None => (None, carry_grad.answer),
        };
        if let Some(later) = before {
            add(&mut read_grad, &later);
            pass.give(later);
        }
        norm.backward(pass, "reasoning.norm", &mut read_grad, grads);
        let mut grad = read_grad;
        if let Some(later) = after {
            add(&mut grad, &later);
            pass.give(later);
        }
        match (layers, self.cells) {
            (Layers::Grid(layers), Some(cells)) => {
                let mut of_cells = cells_of(pass, cells.grid, &grad, self.rows);
                shaped(pass, self.config.block_shape(), |pass| {
                    for layer in layers.into_iter().rev() {
                        of_cells = layer.backward(pass, cells.grid, std::mem::take(&mut of_cells), grads);
                    }
                });
                put_cells(dim, cells.grid, &mut grad, &of_cells);
                pass.give(of_cells);
                if !first {
                    add(&mut self.memory_grad, &grad);
                }
            }
            (Layers::Attention(layers), _) => shaped(pass, self.config.block_shape(), |pass| {
                for layer in layers.into_iter().rev() {
                    let after = std::mem::take(&mut grad);
                    grad = layer.backward(pass, after, &self.nowhere, None, grads);
                }
            }),
            (Layers::Grid(_), None) => unreachable!("layers over a grid have one"),
        }
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
        let Trace { first: _, layers, norm, pointed, way, read, decoder, decoded } = trace;
        match layers {
            Layers::Attention(layers) => layers.into_iter().for_each(|layer| layer.free(pass)),
            Layers::Grid(layers) => layers.into_iter().for_each(|layer| layer.free(pass)),
        }
        norm.free(pass);
        decoder.free(pass);
        if let Some(pointed) = pointed {
            pointed.free(pass);
        }
        if let Some(way) = way {
            pass.give(way.read);
            pass.give(way.scores);
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
