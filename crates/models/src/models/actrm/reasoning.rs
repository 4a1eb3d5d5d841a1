//! Thinking at inference: step by step, until a rule says stop, with everything on record.

use super::{Actrm, Carry, Over, ReasoningConfig};
use crate::checks::check_shape;
use crate::error::{ModelError, Result};
use crate::features::{Features, Observation};
use crate::layers::Mode;
use crate::model::PolicyModel;
use crate::policy::{ActionChunk, Policy};
use crate::preprocess::Preprocess;
use candle_core::{DType, Tensor};
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
    /// Thinks about observations in network units: the signature's features, (b, …) each. `start`
    /// is the answer state to begin from, (b, H, D) (`over = "actions"`). After each step
    /// `should_stop` gets the number of steps done and ends the thought by returning true.
    ///
    /// Each row halts by itself, so a row's chunk does not depend on its neighbours.
    ///
    /// # Errors
    /// Inputs of the wrong shape.
    pub fn reason(
        &self,
        observation: &Features<Tensor>,
        start: Option<&Tensor>,
        should_stop: &mut dyn FnMut(usize) -> bool,
    ) -> Result<Reasoning> {
        if self.composed_because().is_some() {
            return self.reason_composed(observation, start, should_stop);
        }
        let rows = self.check_thought(observation, start)?;
        let mut thought = Thought::new(&self.config.reasoning, rows, should_stop);
        let answer = self.think(observation, rows, start, &mut |chunk, logits| thought.step(chunk, &logits))?;
        thought.end(answer)
    }

    /// The thought on candle's autograd; `reason` runs the same maths faster.
    ///
    /// # Errors
    /// Inputs of the wrong shape.
    pub fn reason_composed(
        &self,
        observation: &Features<Tensor>,
        start: Option<&Tensor>,
        should_stop: &mut dyn FnMut(usize) -> bool,
    ) -> Result<Reasoning> {
        let rows = self.check_thought(observation, start)?;
        let latent = Tensor::zeros((rows, self.config.latent_dim), DType::F32, self.action_head.weight.device())?;
        let memory = self.memory(&latent, observation, &mut Mode::Eval)?.detach();
        let mut carry = self.start(rows, &memory)?;
        if let Some(start) = start {
            carry.answer = start.clone();
        }
        let mut thought = Thought::new(&self.config.reasoning, rows, should_stop);
        loop {
            let step = self.step(&memory, &carry, &mut Mode::Eval)?;
            carry = Carry::detach(&step.carry);
            if thought.step(step.chunk.detach(), &step.halt_logit.to_vec1()?)? {
                return thought.end(carry.answer);
            }
        }
    }

    /// The number of rows.
    fn check_thought(&self, observation: &Features<Tensor>, start: Option<&Tensor>) -> Result<usize> {
        let rows = self.check_inputs(observation)?;
        let tokens = match self.config.reasoning.over {
            Over::Actions => self.config.action_horizon,
            Over::Memory => self.tokens.layout().len(),
        };
        if let Some(start) = start {
            check_shape("actrm", "warm start", start, &[rows, tokens, self.config.dim_model])?;
        }
        Ok(rows)
    }
}

/// A thought in progress: the rules that end it, and its record.
struct Thought<'a> {
    rules: &'a ReasoningConfig,
    should_stop: &'a mut dyn FnMut(usize) -> bool,
    steps: Vec<ReasoningStep>,
    depth: Vec<usize>,
}

impl<'a> Thought<'a> {
    fn new(rules: &'a ReasoningConfig, rows: usize, should_stop: &'a mut dyn FnMut(usize) -> bool) -> Self {
        Self { rules, should_stop, steps: Vec::new(), depth: vec![0; rows] }
    }

    /// Records a step's chunk, (b, H, A), and halting logits, (b); whether every row has halted.
    fn step(&mut self, chunk: Tensor, halt_logits: &[f32]) -> Result<bool> {
        let done = self.steps.len() + 1;
        let halt: Vec<f32> = halt_logits.iter().map(|x| 1.0 / (1.0 + (-x).exp())).collect();
        let change = match self.steps.last() {
            Some(before) => (&chunk - &before.chunk)?.abs()?.mean((1, 2))?.to_vec1::<f32>()?,
            None => vec![f32::INFINITY; halt.len()],
        };
        let last = done == self.rules.max_steps() || (self.should_stop)(done);
        for ((depth, change), halt) in self.depth.iter_mut().zip(&change).zip(&halt) {
            let settled =
                f64::from(*change) < self.rules.change_threshold || f64::from(*halt) > self.rules.halt_threshold;
            if *depth == 0 && (last || settled) {
                *depth = done;
            }
        }
        self.steps.push(ReasoningStep { chunk, halt, change });
        Ok(self.depth.iter().all(|&d| d > 0))
    }

    fn end(self, answer: Tensor) -> Result<Reasoning> {
        let Self { steps, depth, .. } = self;
        let chunk = match depth.iter().all(|&d| d == steps.len()) {
            true => steps[steps.len() - 1].chunk.clone(),
            false => {
                let rows = depth.iter().enumerate();
                let rows: Vec<Tensor> =
                    rows.map(|(row, &d)| steps[d - 1].chunk.narrow(0, row, 1)).collect::<candle_core::Result<_>>()?;
                Tensor::cat(&rows, 0)?
            }
        };
        Ok(Reasoning { steps, chunk, depth, answer })
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
    preprocess: Arc<Preprocess>,
    budget: Option<Box<dyn Budget>>,
    last: Option<Reasoning>,
}

impl ReasoningPolicy {
    /// # Errors
    /// If the configuration has a `budget_ms` and no clock is given.
    pub fn new(model: Arc<Actrm>, preprocess: Arc<Preprocess>, budget: Option<Box<dyn Budget>>) -> Result<Self> {
        if let (Some(ms), None) = (model.config.reasoning.budget_ms, &budget) {
            return Err(ModelError::Input {
                operation: "actrm policy",
                object: "clock",
                found: "absent".into(),
                expected: format!("one, for reasoning.budget_ms = {ms}"),
            });
        }
        Ok(Self { model, preprocess, budget, last: None })
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
        let moved = Tensor::new(moved, last.answer.device())?;
        Ok(Some(last.answer.index_select(&moved, 1)?))
    }
}

impl Policy for ReasoningPolicy {
    fn predict(&mut self, observation: &Observation) -> Result<ActionChunk> {
        let seen = self.preprocess.observation(std::slice::from_ref(observation))?;
        let start = self.warm_start()?;
        let mut budget = self.budget.as_mut().zip(self.model.config.reasoning.budget_ms);
        if let Some((clock, _)) = &mut budget {
            clock.begin();
        }
        let mut should_stop = |_: usize| budget.as_mut().is_some_and(|(clock, ms)| clock.is_spent(*ms));
        let reasoning = self.model.reason(&seen, start.as_ref(), &mut should_stop)?;
        let chunk = self.preprocess.chunk(&reasoning.chunk)?;
        self.last = Some(reasoning);
        Ok(chunk)
    }

    fn reset(&mut self) {
        self.last = None;
    }
}
