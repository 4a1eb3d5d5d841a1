//! Thinking at inference: step by step, until a rule says stop, with everything on record.

use super::{Actrm, Carry};
use crate::error::{ModelError, Result};
use crate::layers::Mode;
use crate::normaliser::{ACTION, ENVIRONMENT_STATE, Normaliser, STATE};
use crate::policy::{ActionChunk, Observation, Policy};
use candle_core::{DType, Device, Tensor};
use std::sync::Arc;

/// One supervision step as it happened.
#[derive(Debug, Clone)]
pub struct ReasoningStep {
    /// (b, H, A), network units: the answer at this depth.
    pub chunk: Tensor,
    /// Per row: the halting head's probability that another step would not help.
    pub halt: Vec<f32>,
    /// Per row: mean absolute change of the chunk since the step before; the first step's is
    /// infinite.
    pub change: Vec<f32>,
}

/// A whole thought.
#[derive(Debug, Clone)]
pub struct Reasoning {
    /// Every step that ran.
    pub steps: Vec<ReasoningStep>,
    /// (b, H, A), network units: each row's chunk at the step where it halted.
    pub chunk: Tensor,
    /// Steps each row took, from 1.
    pub depth: Vec<usize>,
    /// (b, tokens, D): the answer state after the last step, for a warm start.
    pub answer: Tensor,
}

impl Actrm {
    /// Thinks about observations in network units: state (b, S), environment_state (b, E). `start`
    /// is the answer state to begin from, (b, H, D) (`over = "actions"`). After each step
    /// `should_stop` gets the number of steps done and ends the thought by returning true.
    ///
    /// Each row halts by itself, so a row's chunk does not depend on its neighbours.
    ///
    /// # Errors
    /// Inputs of the wrong shape.
    pub fn reason(
        &self,
        state: &Tensor,
        environment_state: Option<&Tensor>,
        start: Option<&Tensor>,
        should_stop: &mut dyn FnMut(usize) -> bool,
    ) -> Result<Reasoning> {
        self.check_inputs(state, environment_state)?;
        let rows = state.dim(0)?;
        let rules = &self.config.reasoning;
        let latent = Tensor::zeros((rows, self.config.latent_dim), DType::F32, &Device::Cpu)?;
        let memory = self.memory(&latent, state, environment_state, &mut Mode::Eval)?.detach();
        let mut carry = self.start(rows, &memory)?;
        if let Some(start) = start {
            if start.dims() != carry.answer.dims() {
                return Err(ModelError::Shape {
                    operation: "actrm",
                    object: "warm start",
                    expected: carry.answer.dims().to_vec(),
                    found: start.dims().to_vec(),
                });
            }
            carry.answer = start.clone();
        }
        let mut steps: Vec<ReasoningStep> = Vec::new();
        let mut depth = vec![0usize; rows];
        for done in 1..=rules.max_steps() {
            let step = self.step(&memory, &carry, &mut Mode::Eval)?;
            carry = Carry::detach(&step.carry);
            let chunk = step.chunk.detach();
            let halt = candle_nn::ops::sigmoid(&step.halt_logit)?.to_vec1::<f32>()?;
            let change = match steps.last() {
                Some(before) => (&chunk - &before.chunk)?.abs()?.mean((1, 2))?.to_vec1::<f32>()?,
                None => vec![f32::INFINITY; rows],
            };
            let last = done == rules.max_steps() || should_stop(done);
            for row in 0..rows {
                let settled =
                    f64::from(change[row]) < rules.change_threshold || f64::from(halt[row]) > rules.halt_threshold;
                if depth[row] == 0 && (last || settled) {
                    depth[row] = done;
                }
            }
            steps.push(ReasoningStep { chunk, halt, change });
            if depth.iter().all(|&d| d > 0) {
                break;
            }
        }
        let chunk = match depth.iter().all(|&d| d == steps.len()) {
            true => steps[steps.len() - 1].chunk.clone(),
            false => {
                let rows = depth.iter().enumerate();
                let rows: Vec<Tensor> =
                    rows.map(|(row, &d)| steps[d - 1].chunk.narrow(0, row, 1)).collect::<candle_core::Result<_>>()?;
                Tensor::cat(&rows, 0)?
            }
        };
        Ok(Reasoning { steps, chunk, depth, answer: carry.answer })
    }
}

/// The caller's clock: told that a thought begins, and asked after each step whether time is up.
pub trait Budget: Send {
    /// A thought begins.
    fn begin(&mut self);
    /// Whether `budget_ms` have passed since.
    fn is_spent(&mut self, budget_ms: f64) -> bool;
}

/// ACTRM as a policy of one environment, in raw units: keeps the last thought, for traces and for
/// the warm start.
pub struct ReasoningPolicy {
    model: Arc<Actrm>,
    normaliser: Arc<Normaliser>,
    budget: Option<Box<dyn Budget>>,
    last: Option<Reasoning>,
}

impl ReasoningPolicy {
    /// # Errors
    /// If the configuration has a `budget_ms` and no clock is given.
    pub fn new(model: Arc<Actrm>, normaliser: Arc<Normaliser>, budget: Option<Box<dyn Budget>>) -> Result<Self> {
        if let (Some(ms), None) = (model.config.reasoning.budget_ms, &budget) {
            return Err(ModelError::Input {
                operation: "actrm policy",
                object: "clock",
                found: "absent".into(),
                expected: format!("one, for reasoning.budget_ms = {ms}"),
            });
        }
        Ok(Self { model, normaliser, budget, last: None })
    }

    /// The thought behind the last prediction.
    pub fn last_reasoning(&self) -> Option<&Reasoning> {
        self.last.as_ref()
    }

    /// The previous answer, moved on by the actions executed since; the last token fills the end.
    fn warm_start(&self) -> Result<Option<Tensor>> {
        let (Some(warm), Some(last)) = (self.model.config.reasoning.warm_start, &self.last) else {
            return Ok(None);
        };
        let tokens = self.model.config.action_horizon as u32;
        let moved: Vec<u32> = (0..tokens).map(|i| (i + warm.shift as u32).min(tokens - 1)).collect();
        let moved = Tensor::new(moved, &Device::Cpu)?;
        Ok(Some(last.answer.index_select(&moved, 1)?))
    }

    fn row(&self, feature: &str, values: &[f32]) -> Result<Tensor> {
        let mut values = values.to_vec();
        self.normaliser.normalise(feature, &mut values)?;
        let len = values.len();
        Ok(Tensor::from_vec(values, (1, len), &Device::Cpu)?)
    }
}

impl Policy for ReasoningPolicy {
    fn predict(&mut self, observation: &Observation) -> Result<ActionChunk> {
        let state = self.row(STATE, &observation.state)?;
        let environment_state = match self.model.dims.environment_state {
            0 => None,
            _ => Some(self.row(ENVIRONMENT_STATE, &observation.environment_state)?),
        };
        let start = self.warm_start()?;
        let mut budget = self.budget.as_mut().zip(self.model.config.reasoning.budget_ms);
        if let Some((clock, _)) = &mut budget {
            clock.begin();
        }
        let mut should_stop = |_: usize| budget.as_mut().is_some_and(|(clock, ms)| clock.is_spent(*ms));
        let reasoning = self.model.reason(&state, environment_state.as_ref(), start.as_ref(), &mut should_stop)?;
        let mut actions = reasoning.chunk.flatten_all()?.to_vec1::<f32>()?;
        self.normaliser.unnormalise(ACTION, &mut actions)?;
        self.last = Some(reasoning);
        ActionChunk::new(actions, self.model.config.action_horizon, self.model.dims.action)
    }

    fn reset(&mut self) {
        self.last = None;
    }
}
