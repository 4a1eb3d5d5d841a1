//! What lives across optimiser steps: each slot of the batch holds a puzzle, its states and how
//! long it has been thought about. A slot is vacant once its puzzle has halted; the next step
//! gives it a new puzzle, and the other slots keep theirs.

use super::{Carry, Trm, misfit};
use candle_core::{Device, Tensor};
use models::classification::IGNORE_LABEL;
use nn::Result;
use nn::Rng;
use serde::{Deserialize, Serialize};

/// One puzzle with its answer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Example {
    /// `seq_len` tokens.
    pub inputs: Vec<u32>,
    /// `seq_len` classes, or [`IGNORE_LABEL`].
    pub labels: Vec<i64>,
    /// The puzzle's row in the table of puzzle embeddings; 0 where there is none.
    pub identifier: u32,
}

/// When a puzzle leaves its slot before `halt_max_steps`.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Release {
    /// Once the halting head says so (the reference's), except for puzzles under exploration.
    #[default]
    Head,
    /// Once the answer is right, with this probability per step.
    Solved(f64),
}

/// The batch's puzzles and states between supervision steps.
#[derive(Debug, Clone)]
pub struct Slots {
    pub(super) carry: Carry,
    pub(super) steps: Vec<u32>,
    pub(super) halted: Vec<bool>,
    pub(super) inputs: Vec<u32>,
    pub(super) labels: Vec<i64>,
    pub(super) identifiers: Vec<u32>,
}

impl Slots {
    /// `batch` vacant slots.
    ///
    /// # Errors
    /// When a tensor operation fails.
    pub fn new(model: &Trm, batch: usize) -> Result<Self> {
        let len = model.config().seq_len;
        Ok(Self {
            carry: model.initial_carry(batch)?,
            steps: vec![0; batch],
            halted: vec![true; batch],
            inputs: vec![0; batch * len],
            labels: vec![IGNORE_LABEL; batch * len],
            identifiers: vec![0; batch],
        })
    }

    /// Number of slots.
    pub fn batch(&self) -> usize {
        self.steps.len()
    }

    /// Slots that want a new puzzle.
    pub fn vacant(&self) -> Vec<usize> {
        (0..self.batch()).filter(|&i| self.halted[i]).collect()
    }

    /// Supervision steps taken by each slot's puzzle.
    pub fn steps(&self) -> &[u32] {
        &self.steps
    }

    /// The states, `(batch, positions, hidden)` each.
    pub fn carry(&self) -> &Carry {
        &self.carry
    }

    /// Gives the vacant slots, in order, the puzzles of `fresh`, and their states the initial
    /// value.
    ///
    /// # Errors
    /// When `fresh` does not hold exactly one puzzle per vacant slot, or one does not fit.
    pub fn admit(&mut self, model: &Trm, fresh: &[Example]) -> Result<()> {
        let vacant = self.vacant();
        if vacant.len() != fresh.len() {
            return Err(misfit("fresh puzzles", &[vacant.len()], &[fresh.len()]));
        }
        let len = model.config().seq_len;
        for (&slot, example) in vacant.iter().zip(fresh) {
            if example.inputs.len() != len {
                return Err(misfit("inputs", &[len], &[example.inputs.len()]));
            }
            if example.labels.len() != len {
                return Err(misfit("labels", &[len], &[example.labels.len()]));
            }
            let at = slot * len..(slot + 1) * len;
            self.inputs[at.clone()].copy_from_slice(&example.inputs);
            self.labels[at].copy_from_slice(&example.labels);
            self.identifiers[slot] = example.identifier;
            self.steps[slot] = 0;
            self.halted[slot] = false;
        }
        if !vacant.is_empty() {
            let mut reset = vec![0u8; self.batch()];
            for &slot in &vacant {
                reset[slot] = 1;
            }
            let initial = model.initial_carry(self.batch())?;
            let shape = initial.z_h.shape().clone();
            let reset = Tensor::from_vec(reset, (self.batch(), 1, 1), &Device::Cpu)?.broadcast_as(shape)?;
            self.carry = Carry {
                z_h: reset.where_cond(&initial.z_h, &self.carry.z_h)?,
                z_l: reset.where_cond(&initial.z_l, &self.carry.z_l)?,
            };
        }
        Ok(())
    }

    /// The puzzles' tokens, `(batch, seq_len)`.
    pub(super) fn input_tensor(&self) -> Result<Tensor> {
        let len = self.inputs.len() / self.batch();
        Ok(Tensor::from_slice(&self.inputs, (self.batch(), len), &Device::Cpu)?)
    }

    /// The puzzles' rows in the embedding table, `(batch,)`.
    pub(super) fn identifier_tensor(&self) -> Result<Tensor> {
        Ok(Tensor::from_slice(&self.identifiers, self.batch(), &Device::Cpu)?)
    }

    /// Takes the states of a finished step and decides which slots halt.
    pub(super) fn advance(
        &mut self,
        model: &Trm,
        carry: Carry,
        q_halt: &[f32],
        solved: &[bool],
        release: Release,
        rng: &mut Rng,
    ) {
        let max = model.config().halt_max_steps as u32;
        self.carry = carry;
        for slot in 0..self.batch() {
            self.steps[slot] += 1;
            let steps = self.steps[slot];
            // drawn for every slot, so that the stream does not depend on what halts
            let (chance, minimum) = (rng.uniform(), rng.uniform());
            let wants = match release {
                Release::Head => {
                    let explores = f64::from(chance) < model.config().halt_exploration_prob;
                    let minimum = 2 + (f64::from(minimum) * f64::from(max.saturating_sub(1))) as u32;
                    q_halt[slot] > 0.0 && !(explores && steps < minimum)
                }
                Release::Solved(probability) => solved[slot] && f64::from(chance) < probability,
            };
            self.halted[slot] = steps >= max || wants;
        }
    }

    /// Takes the states away from some puzzles, each with this probability: it goes on from normal noise or from the
    /// states of the next slot's puzzle, as often the one as the other. What answers from anywhere answers from where a
    /// long thought about a large puzzle has led.
    ///
    /// # Errors
    /// When a tensor operation fails.
    pub(super) fn disturb(&mut self, probability: f64, rng: &mut Rng) -> Result<()> {
        let batch = self.batch();
        let shape = self.carry.z_h.shape().clone();
        let width = shape.elem_count() / batch;
        let mut states =
            [self.carry.z_h.flatten_all()?.to_vec1::<f32>()?, self.carry.z_l.flatten_all()?.to_vec1::<f32>()?];
        let others = states.clone();
        for slot in 0..batch {
            let (chance, noisy) = (rng.uniform(), rng.uniform() < 0.5);
            if f64::from(chance) >= probability {
                continue;
            }
            let next = (slot + 1) % batch;
            for (state, other) in states.iter_mut().zip(&others) {
                let own = &mut state[slot * width..(slot + 1) * width];
                match noisy {
                    true => own.copy_from_slice(&rng.normals(width)),
                    false => own.copy_from_slice(&other[next * width..(next + 1) * width]),
                }
            }
        }
        let [z_h, z_l] = states.map(|state| Tensor::from_vec(state, shape.clone(), &Device::Cpu));
        self.carry = Carry { z_h: z_h?, z_l: z_l? };
        Ok(())
    }

    /// Adds normal noise of standard deviation `deviation` to both states of every puzzle (the root mean square of a
    /// cell's state is one). What is a matter of degree, such as how far something is, is lost in it from step to step;
    /// what is one thing or the other can be restored, over any distance.
    ///
    /// # Errors
    /// When a tensor operation fails.
    pub(super) fn blur(&mut self, deviation: f64, rng: &mut Rng) -> Result<()> {
        let mut blurred = |state: &Tensor| -> Result<Tensor> {
            let noise = Tensor::from_vec(rng.normals(state.elem_count()), state.shape(), &Device::Cpu)?;
            Ok((state + (noise * deviation)?)?)
        };
        self.carry = Carry { z_h: blurred(&self.carry.z_h)?, z_l: blurred(&self.carry.z_l)? };
        Ok(())
    }
}
