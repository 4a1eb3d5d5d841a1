//! Thinking at inference: step by step, until a rule says stop, with everything on record.

use super::{Actrm, Carry, Config, Observed, Over, ReasoningConfig};
use crate::checks::check_shape;
use crate::features::{Features, Observation};
use crate::history::History;
use crate::policy::{ActionChunk, Clock, Policy, ThoughtStep};
use crate::preprocess::Preprocess;
use candle_core::Tensor;
use nn::ops::linear;
use nn::{Context, Result, Value};
use std::cell::RefCell;
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

/// What a thought begins with.
#[derive(Clone, Copy)]
pub(super) enum Start<'a> {
    Usual,
    /// an answer, (b, tokens, D)
    Answer(&'a Tensor),
    /// the usual beginning and this noise, (b, tokens, D)
    Noise(&'a Tensor),
}

impl<'a> Start<'a> {
    fn of(answer: Option<&'a Tensor>) -> Self {
        answer.map_or(Self::Usual, Self::Answer)
    }

    fn given(self) -> Option<&'a Tensor> {
        match self {
            Self::Usual => None,
            Self::Answer(tensor) | Self::Noise(tensor) => Some(tensor),
        }
    }
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
        self.reason_seen(observation, Start::of(start), &mut || {}, should_stop)
    }

    /// The same, and `on_seen` is called when images have become tokens.
    pub(super) fn reason_seen(
        &self,
        observation: &Features<Tensor>,
        start: Start<'_>,
        on_seen: &mut dyn FnMut(),
        should_stop: &mut dyn FnMut(usize) -> bool,
    ) -> Result<Reasoning> {
        let rows = self.check_thought(observation, start.given())?;
        let observation = self.tokens.prepare(observation, None)?;
        let thought = Thought::new(&self.config.reasoning, rows, should_stop);
        self.cache.predict(&self.params, on_seen, |cx| self.think(cx, rows, &observation, start, thought))
    }

    /// The thought on candle's operations; `reason` runs the same statement on hand-written kernels.
    #[cfg(test)]
    pub(super) fn reason_composed(
        &self,
        observation: &Features<Tensor>,
        start: Option<&Tensor>,
        should_stop: &mut dyn FnMut(usize) -> bool,
    ) -> Result<Reasoning> {
        let rows = self.check_thought(observation, start)?;
        let observation = self.tokens.prepare(observation, None)?;
        let thought = Thought::new(&self.config.reasoning, rows, should_stop);
        self.cache.composed_predict(&self.params, |cx| self.think(cx, rows, &observation, Start::of(start), thought))
    }

    /// Images are as the network reads them.
    fn think(
        &self,
        cx: &mut Context<'_>,
        rows: usize,
        observation: &Features<Tensor>,
        start: Start<'_>,
        mut thought: Thought<'_>,
    ) -> Result<Reasoning> {
        let latent = Value::zeros((rows, self.config.latent_dim), &cx.device().clone())?;
        let memory = self.memory(cx, &latent, observation)?;
        let observed = self.observe(cx, memory)?;
        let mut carry = Carry { answer: self.first_answer(&observed, start)?, reasoning: None };
        loop {
            let step = self.step(cx, &observed, &carry, thought.steps.len())?;
            let logits = linear(cx, &step.mean, &self.halt_head)?.detached().flatten_all()?.to_vec1()?;
            carry = step.carry.detach();
            if thought.step(step.chunk.detached(), &logits)? {
                return thought.end(carry.answer.expect("a step leaves an answer").detached());
            }
        }
    }

    /// The answer that the first step begins with, if it is given one.
    fn first_answer(&self, observed: &Observed, start: Start<'_>) -> Result<Option<Value>> {
        let Some(given) = start.given() else { return Ok(None) };
        let given = given.contiguous()?;
        Ok(Some(match (start, self.config.reasoning.over) {
            // over tokens a thought begins with what is observed, over actions with zeros
            (Start::Noise(_), Over::Tokens) => Value::from(&(observed.begun.detached() + given)?),
            _ => Value::from(&given),
        }))
    }

    /// Of the answer's states of `rows` thoughts: (b, tokens, D).
    pub(super) fn thought_shape(&self, rows: usize) -> [usize; 3] {
        let tokens = match self.config.reasoning.over {
            Over::Actions => self.config.action_horizon,
            Over::Memory | Over::Tokens => self.tokens.layout().len(),
        };
        [rows, tokens, self.config.dim_model]
    }

    /// The number of rows.
    fn check_thought(&self, observation: &Features<Tensor>, start: Option<&Tensor>) -> Result<usize> {
        let rows = self.check_inputs(observation)?;
        if let Some(start) = start {
            check_shape("actrm", "warm start", start, &self.thought_shape(rows))?;
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
        // asked of every step: it is how the caller times them
        let stop = (self.should_stop)(done);
        let last = stop || done == self.rules.max_steps();
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

/// ACTRM as a policy of one environment, in raw units: keeps the last thought, for traces and for the warm start.
pub struct ReasoningPolicy {
    model: Arc<Actrm>,
    preprocess: Arc<Preprocess>,
    clock: Box<dyn Clock>,
    history: History,
    last: Option<Reasoning>,
    /// actions executed since
    executed: usize,
    /// of the last thought's steps, in milliseconds
    times: Vec<f64>,
    /// until the last query's images were tokens, in milliseconds
    encoding: Option<f64>,
}

impl ReasoningPolicy {
    /// Shares `model` with others. `clock` tells when `budget_ms` are spent, and how long steps took.
    pub fn new(model: Arc<Actrm>, preprocess: Arc<Preprocess>, clock: Box<dyn Clock>) -> Self {
        let history = History::new(preprocess.signature().n_obs_steps);
        Self { model, preprocess, clock, history, last: None, executed: 0, times: Vec::new(), encoding: None }
    }

    /// The thought behind the last prediction.
    pub fn last_reasoning(&self) -> Option<&Reasoning> {
        self.last.as_ref()
    }
}

/// The previous answer, moved on by the actions executed since; the last token fills the end.
fn warm_start(config: &Config, last: Option<&Reasoning>, executed: usize) -> Result<Option<Tensor>> {
    let (Some(_), Some(last)) = (config.reasoning.warm_start, last) else {
        return Ok(None);
    };
    let tokens = config.action_horizon;
    let moved: Vec<u32> = (0..tokens).map(|i| (i + executed).min(tokens - 1) as u32).collect();
    let moved = Tensor::new(moved, last.answer.device())?;
    Ok(Some(last.answer.index_select(&moved, 1)?))
}

impl Policy for ReasoningPolicy {
    fn predict(&mut self, observation: &Observation) -> Result<ActionChunk> {
        let (clock, budget) = (RefCell::new(&mut self.clock), self.model.config.reasoning.budget_ms);
        let now = || clock.borrow_mut().milliseconds();
        let begun = now();
        let seen = self.history.see(&self.preprocess, observation)?;
        let warm = warm_start(&self.model.config, self.last.as_ref(), self.executed)?;
        let (mut before, mut times) = (begun, Vec::new());
        let mut should_stop = |_: usize| {
            let now = now();
            times.push(now - std::mem::replace(&mut before, now));
            budget.is_some_and(|budget| now - begun >= budget)
        };
        let mut encoding = None;
        let mut on_seen = || encoding = Some(now() - begun);
        let reasoning = self.model.reason_seen(&seen, Start::of(warm.as_ref()), &mut on_seen, &mut should_stop)?;
        let chunk = self.preprocess.chunk(&reasoning.chunk)?;
        (self.last, self.executed, self.times, self.encoding) = (Some(reasoning), 0, times, encoding);
        Ok(chunk)
    }

    fn n_obs_steps(&self) -> usize {
        self.history.steps()
    }

    fn observe(&mut self, observation: &Observation) {
        self.history.observe(observation);
    }

    fn executed(&mut self, actions: usize) {
        self.executed += actions;
    }

    fn encoding(&self) -> Option<f64> {
        self.encoding
    }

    fn reset(&mut self, _seed: u64) {
        self.history.clear();
        (self.last, self.executed) = (None, 0);
    }

    fn thought(&self) -> Result<Vec<ThoughtStep>> {
        let steps = self.last.iter().flat_map(|last| &last.steps).zip(&self.times);
        steps
            .map(|(step, &milliseconds)| {
                let change = step.change.first().copied().filter(|change| change.is_finite());
                let halt = step.halt.first().copied().unwrap_or_default();
                Ok(ThoughtStep { chunk: self.preprocess.chunk(&step.chunk)?, change, halt, milliseconds })
            })
            .collect()
    }
}
