//! The Tiny Recursive Model.
//!
//! Paper: Jolicoeur-Martineau, "Less is More: Recursive Reasoning with Tiny Networks" (2025).
//! Reference implementation: SamsungSAILMontreal/TinyRecursiveModels,
//! `models/recursive_reasoning/trm.py`; tensors carry its names.
//!
//! One small network updates two states: `z_h`, the answer, and `z_l`, the reasoning. A
//! supervision step runs `h_cycles` rounds of `l_cycles` updates of `z_l` and one of `z_h`; only
//! the last round keeps a graph, so memory does not grow with the number of rounds. The states
//! then go, detached, to the next supervision step: see [`Slots`].
//!
//! This file is the model as one reads it, on candle's autograd. Supervision steps run the same
//! maths in `fused/`, forward and backward by hand; tests hold the two together.
//!
//! Deviations from the reference:
//! - everything is f32 (the reference trains in bf16 with f32 master weights);
//! - [`Mixing::Conv`], a 3x3 convolution over a grid in place of attention, is ours;
//! - `classes`, `inner_size` and [`Pooling::Mean`] let the small models of the maze study be
//!   written in the same file; unset they give the reference;
//! - initial states and weights come from our own generator, so equal seeds do not give the
//!   reference's numbers.

mod config;
mod fused;
mod official;
mod slots;
#[cfg(test)]
mod tests;
mod train;
mod weights;

pub use config::{Config, Mixing, Pooling, Positions};
pub use fused::Recursion;
pub use slots::{Example, Release, Slots};
pub use train::{PuzzleConfig, StepReport, Trainer};

use candle_core::{D, DType, IndexOp, Tensor};
use nn::Params;
use nn::{ModelError, Result};
use weights::{Mix, Weights};

/// The two states of the recursion, each `(batch, positions, hidden)`.
#[derive(Debug, Clone)]
pub struct Carry {
    /// The answer.
    pub z_h: Tensor,
    /// The reasoning.
    pub z_l: Tensor,
}

impl Carry {
    fn detach(&self) -> Self {
        Self { z_h: self.z_h.detach(), z_l: self.z_l.detach() }
    }
}

/// What a supervision step gives.
#[derive(Debug, Clone)]
pub struct StepOutput {
    /// `(batch, seq_len, classes)`.
    pub logits: Tensor,
    /// `(batch,)`: positive to halt.
    pub q_halt: Tensor,
    /// The states for the next step, detached.
    pub carry: Carry,
}

/// Whether a step keeps a graph.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Gradient {
    /// The last round keeps one.
    On,
    /// Nothing does.
    Off,
}

/// A Tiny Recursive Model.
#[derive(Debug)]
pub struct Trm {
    config: Config,
    params: Params,
    tracked: Weights,
    frozen: Weights,
    h_init: Tensor,
    l_init: Tensor,
    rope: Option<(Tensor, Tensor)>,
    fused: Recursion,
}

fn misfit(object: &'static str, expected: &[usize], found: &[usize]) -> ModelError {
    ModelError::Shape { operation: "trm step", object, expected: expected.to_vec(), found: found.to_vec() }
}

/// `x (.., n) -> (.., m)` with `weight (m, n)`.
fn linear(x: &Tensor, weight: &Tensor) -> Result<Tensor> {
    let mut dims = x.dims().to_vec();
    let n = weight.dim(1)?;
    let rows = x.elem_count() / n;
    let y = x.reshape((rows, n))?.matmul(&weight.t()?)?;
    *dims.last_mut().expect("a tensor with at least one axis") = weight.dim(0)?;
    Ok(y.reshape(dims)?)
}

/// Root-mean-square norm over the last axis, without a gain.
fn rms_norm(x: &Tensor, eps: f64) -> Result<Tensor> {
    let mean_square = x.sqr()?.mean_keepdim(D::Minus1)?;
    Ok(x.broadcast_div(&(mean_square + eps)?.sqrt()?)?)
}

fn swiglu(x: &Tensor, gate_up: &Tensor, down: &Tensor) -> Result<Tensor> {
    let both = linear(x, gate_up)?;
    let inner = gate_up.dim(0)? / 2;
    let gate = both.narrow(D::Minus1, 0, inner)?.contiguous()?.silu()?;
    let up = both.narrow(D::Minus1, inner, inner)?.contiguous()?;
    linear(&(gate * up)?, down)
}

/// Rotates `x (batch, heads, positions, size)` by half-split rotary angles.
fn rotate(x: &Tensor, cos: &Tensor, sin: &Tensor) -> Result<Tensor> {
    let half = x.dim(D::Minus1)? / 2;
    let a = x.narrow(D::Minus1, 0, half)?;
    let b = x.narrow(D::Minus1, half, half)?;
    let turned = Tensor::cat(&[&b.neg()?, &a], D::Minus1)?;
    Ok((x.broadcast_mul(cos)? + turned.broadcast_mul(sin)?)?)
}

impl Trm {
    /// The states of `batch` puzzles that have not been thought about.
    ///
    /// # Errors
    /// When a tensor operation fails.
    pub fn initial_carry(&self, batch: usize) -> Result<Carry> {
        let shape = (batch, self.config.positions_len(), self.config.hidden_size);
        Ok(Carry {
            z_h: self.h_init.broadcast_as(shape)?.contiguous()?,
            z_l: self.l_init.broadcast_as(shape)?.contiguous()?,
        })
    }

    /// One supervision step on `inputs (batch, seq_len)` of tokens (u32), with a row of the
    /// puzzle table for each puzzle if the model has one.
    ///
    /// # Errors
    /// When shapes do not fit, a token lies outside the vocabulary or puzzle identifiers are
    /// missing.
    pub fn supervision_step(
        &self,
        carry: &Carry,
        inputs: &Tensor,
        identifiers: Option<&Tensor>,
        gradient: Gradient,
    ) -> Result<StepOutput> {
        self.check_step(carry, inputs)?;
        let weights = self.weights(gradient);
        let embedded = self.embed(weights, inputs, identifiers)?;
        let cycles = (self.config.h_cycles, self.config.l_cycles);
        let now = self.fused.step(&weights.flat()?, carry, &embedded, cycles, gradient)?;
        self.read_out(weights, now)
    }

    /// [`Self::supervision_step`] on candle's autograd: slower, and what it is checked against.
    ///
    /// # Errors
    /// The same.
    pub fn supervision_step_composed(
        &self,
        carry: &Carry,
        inputs: &Tensor,
        identifiers: Option<&Tensor>,
        gradient: Gradient,
    ) -> Result<StepOutput> {
        self.composed((self.weights(gradient), &self.frozen), carry, inputs, identifiers)
    }

    /// A supervision step without gradient in f64. The recursion amplifies rounding, so two
    /// implementations in f32 drift apart; this one says how far the drift is rounding alone.
    ///
    /// # Errors
    /// The same.
    pub fn supervision_step_exact(
        &self,
        carry: &Carry,
        inputs: &Tensor,
        identifiers: Option<&Tensor>,
    ) -> Result<StepOutput> {
        let weights = self.frozen.map(&|t| Ok(t.to_dtype(DType::F64)?))?;
        let carry = Carry { z_h: carry.z_h.to_dtype(DType::F64)?, z_l: carry.z_l.to_dtype(DType::F64)? };
        self.composed((&weights, &weights), &carry, inputs, identifiers)
    }

    /// One supervision step, its last round with the first weights, earlier ones with the second.
    fn composed(
        &self,
        (weights, quiet_weights): (&Weights, &Weights),
        carry: &Carry,
        inputs: &Tensor,
        identifiers: Option<&Tensor>,
    ) -> Result<StepOutput> {
        self.check_step(carry, inputs)?;
        let embedded = self.embed(weights, inputs, identifiers)?;
        let mut now = carry.detach();
        let quiet = embedded.detach();
        for _ in 1..self.config.h_cycles {
            now = self.round(quiet_weights, &now, &quiet)?;
        }
        let now = self.round(weights, &now, &embedded)?;
        self.read_out(weights, now)
    }

    fn weights(&self, gradient: Gradient) -> &Weights {
        match gradient {
            Gradient::On => &self.tracked,
            Gradient::Off => &self.frozen,
        }
    }

    fn check_step(&self, carry: &Carry, inputs: &Tensor) -> Result<()> {
        let (batch, len) = inputs.dims2()?;
        if len != self.config.seq_len {
            return Err(misfit("inputs", &[batch, self.config.seq_len], inputs.dims()));
        }
        let expected = [batch, self.config.positions_len(), self.config.hidden_size];
        for (name, state) in [("z_h", &carry.z_h), ("z_l", &carry.z_l)] {
            if state.dims() != expected {
                return Err(misfit(name, &expected, state.dims()));
            }
        }
        Ok(())
    }

    /// Answers and halting logits of the states after the last round.
    fn read_out(&self, weights: &Weights, now: Carry) -> Result<StepOutput> {
        let answer = now.z_h.narrow(1, self.config.prefix_len(), self.config.seq_len)?;
        let pooled = match self.config.pooling {
            Pooling::First => now.z_h.i((.., 0, ..))?.contiguous()?,
            Pooling::Mean => now.z_h.mean(1)?,
        };
        let q = linear(&pooled, &weights.q_weight)?.broadcast_add(&weights.q_bias)?;
        Ok(StepOutput {
            logits: linear(&answer.contiguous()?, &weights.lm_head)?,
            q_halt: q.i((.., 0))?,
            carry: now.detach(),
        })
    }

    /// `(batch, seq_len)` tokens `-> (batch, positions, hidden)`.
    fn embed(&self, weights: &Weights, inputs: &Tensor, identifiers: Option<&Tensor>) -> Result<Tensor> {
        let (batch, len) = inputs.dims2()?;
        let d = self.config.hidden_size;
        let tokens = inputs.flatten_all()?;
        let mut x = weights.embed.index_select(&tokens, 0)?.reshape((batch, len, d))?;
        if let Some(table) = &weights.puzzles {
            let Some(identifiers) = identifiers else {
                return Err(ModelError::Input {
                    operation: "trm step",
                    object: "puzzle identifiers",
                    found: "absent".into(),
                    expected: "one per puzzle".into(),
                });
            };
            let prefix = self.config.prefix_len();
            let rows = table.index_select(identifiers, 0)?;
            let rows = rows.pad_with_zeros(1, 0, prefix * d - self.config.puzzle_emb_ndim)?;
            x = Tensor::cat(&[&rows.reshape((batch, prefix, d))?, &x], 1)?;
        }
        if let Some(positions) = &weights.positions {
            // two unit-variance terms: the sum is scaled back by 1 / sqrt(2)
            x = (x.broadcast_add(positions)? * std::f64::consts::FRAC_1_SQRT_2)?;
        }
        Ok((x * (d as f64).sqrt())?)
    }

    /// One round: `l_cycles` updates of `z_l`, one of `z_h`.
    fn round(&self, weights: &Weights, carry: &Carry, embedded: &Tensor) -> Result<Carry> {
        let Carry { z_h, z_l } = carry;
        let injected = (z_h + embedded)?;
        let mut z_l = z_l.clone();
        for _ in 0..self.config.l_cycles {
            z_l = self.network(weights, &z_l, &injected)?;
        }
        let z_h = self.network(weights, z_h, &z_l)?;
        Ok(Carry { z_h, z_l })
    }

    /// The one network, on `state + injected`.
    fn network(&self, weights: &Weights, state: &Tensor, injected: &Tensor) -> Result<Tensor> {
        let eps = self.config.rms_norm_eps;
        let mut x = (state + injected)?;
        for layer in &weights.layers {
            x = self.mix(&layer.mix, &x)?;
            x = rms_norm(&(&x + swiglu(&x, &layer.gate_up, &layer.down)?)?, eps)?;
        }
        Ok(x)
    }

    /// `norm(x + mixing(x))`.
    fn mix(&self, mix: &Mix, x: &Tensor) -> Result<Tensor> {
        let eps = self.config.rms_norm_eps;
        match mix {
            Mix::Attention { qkv, out } => rms_norm(&(x + self.attention(x, qkv, out)?)?, eps),
            Mix::MlpT { gate_up, down } => {
                let across = x.transpose(1, 2)?.contiguous()?;
                let mixed = (&across + swiglu(&across, gate_up, down)?)?;
                Ok(rms_norm(&mixed, eps)?.transpose(1, 2)?.contiguous()?)
            }
            Mix::Conv { kernel } => rms_norm(&(x + self.convolution(x, kernel)?)?, eps),
        }
    }

    fn attention(&self, x: &Tensor, qkv: &Tensor, out: &Tensor) -> Result<Tensor> {
        let (batch, len, d) = x.dims3()?;
        let heads = self.config.num_heads;
        let size = d / heads;
        let qkv = linear(x, qkv)?.reshape((batch, len, 3, heads, size))?;
        let part = |i: usize| -> Result<Tensor> { Ok(qkv.i((.., .., i))?.transpose(1, 2)?.contiguous()?) };
        let (mut q, mut k, v) = (part(0)?, part(1)?, part(2)?);
        if let Some((cos, sin)) = &self.rope {
            let (cos, sin) = (cos.to_dtype(x.dtype())?, sin.to_dtype(x.dtype())?);
            q = rotate(&q, &cos, &sin)?;
            k = rotate(&k, &cos, &sin)?;
        }
        let scores = (q.matmul(&k.t()?)? * (1.0 / (size as f64).sqrt()))?;
        // candle's softmax_last_dim has no backward; this one is composed
        let weights = candle_nn::ops::softmax(&scores, D::Minus1)?;
        let mixed = weights.matmul(&v)?.transpose(1, 2)?.reshape((batch, len, d))?;
        linear(&mixed, out)
    }

    /// A zero-padded 3x3 convolution as one product over the nine neighbours' channels.
    fn convolution(&self, x: &Tensor, kernel: &Tensor) -> Result<Tensor> {
        let (batch, len, d) = x.dims3()?;
        let [h, w] = self.config.grid.expect("checked: convolution has a grid");
        let padded = x.reshape((batch, h, w, d))?.pad_with_zeros(1, 1, 1)?.pad_with_zeros(2, 1, 1)?;
        let mut neighbours = Vec::with_capacity(9);
        for row in 0..3 {
            for column in 0..3 {
                neighbours.push(padded.narrow(1, row, h)?.narrow(2, column, w)?);
            }
        }
        let neighbours = Tensor::cat(&neighbours, 3)?.reshape((batch, len, 9 * d))?;
        linear(&neighbours, &kernel.reshape((d, 9 * d))?)
    }
}
