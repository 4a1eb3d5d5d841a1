//! Looking into a thought: its states after every step, what its action tokens attend to, and what becomes of it where
//! its reasoning is tampered with. On candle's autograd: for measurements, not for speed.

use super::{Actrm, Carry, Config, Design, positioned, update};
use crate::features::{Features, Observation};
use crate::history::History;
use crate::layers::Mode;
use crate::policy::{ActionChunk, Policy};
use crate::preprocess::Preprocess;
use candle_core::{DType, Tensor};
use nn::{ModelError, Result};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// What is done to the reasoning `z` of a thought, while its answer `y` goes on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Intervention {
    /// It stays as the first step left it.
    Freeze,
    /// After every update it is that of another observation's thought.
    Shuffle,
}

impl Intervention {
    /// Every one.
    pub const ALL: [Self; 2] = [Self::Freeze, Self::Shuffle];

    /// Its name in commands and files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Freeze => "freeze",
            Self::Shuffle => "shuffle",
        }
    }
}

/// How a trained policy thinks where that is not as its configuration says; it is not trained again for it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Thinking {
    /// Supervision steps: exactly so many, or with halting at most
    #[serde(skip_serializing_if = "Option::is_none")]
    pub steps: Option<usize>,
    /// Whether a thought may stop before its last step; by default as configured, and no where `steps` are given
    #[serde(skip_serializing_if = "Option::is_none")]
    pub halting: Option<bool>,
    /// With halting: the probability of the halting head above which a thought stops; by default as configured
    #[serde(skip_serializing_if = "Option::is_none")]
    pub halt_threshold: Option<f64>,
    /// With halting: the mean change of the chunk (network units) below which a thought stops; by default as configured
    #[serde(skip_serializing_if = "Option::is_none")]
    pub change_threshold: Option<f64>,
    /// What is done to its reasoning; such thoughts do not halt
    #[serde(skip_serializing_if = "Option::is_none")]
    pub intervene: Option<Intervention>,
}

impl Config {
    /// The configuration of a model with the same weights that thinks otherwise.
    ///
    /// # Errors
    /// No steps; halting together with an intervention; a threshold of halting that is none or without it.
    pub fn thinking(&self, thinking: &Thinking) -> Result<Self> {
        let mut config = self.clone();
        let reasoning = &mut config.reasoning;
        if thinking.halting == Some(true) && thinking.intervene.is_some() {
            let (found, expected) = ("true".to_string(), "false with an intervention".to_string());
            return Err(ModelError::Config { model: "actrm", field: "thinking.halting", found, expected });
        }
        if thinking.steps.is_some() {
            (reasoning.max_steps, reasoning.budget_ms) = (thinking.steps, None);
        }
        let halting = thinking.halting.unwrap_or(thinking.steps.is_none() && thinking.intervene.is_none());
        let thresholds = [
            ("thinking.halt_threshold", thinking.halt_threshold),
            ("thinking.change_threshold", thinking.change_threshold),
        ];
        if let Some((field, threshold)) = thresholds.into_iter().find(|(_, threshold)| threshold.is_some() && !halting)
        {
            let found = format!("{} without halting", threshold.unwrap_or_default());
            return Err(ModelError::Config {
                model: "actrm",
                field,
                found,
                expected: "halting = true beside it".to_string(),
            });
        }
        reasoning.halt_threshold = thinking.halt_threshold.unwrap_or(reasoning.halt_threshold);
        reasoning.change_threshold = thinking.change_threshold.unwrap_or(reasoning.change_threshold);
        if !halting {
            (reasoning.halt_threshold, reasoning.change_threshold, reasoning.budget_ms) = (1.0, 0.0, None);
        }
        config.validate()?;
        Ok(config)
    }
}

/// What there is to see after a supervision step.
#[derive(Debug, Clone)]
pub struct ExaminedStep {
    /// (b, H, A), network units
    pub chunk: Tensor,
    /// (b, H, D): the answer's state; over tokens what the decoder makes of them
    pub answer: Tensor,
    /// (b, R, D): the reasoning's state; over tokens (b, M, D), all of them
    pub reasoning: Tensor,
    /// (b, H, R + H + M): what each action token attended to as it was updated last, mean of the heads of the block's first
    /// layer; the columns are [`Actrm::context_names`]; `None` over tokens
    pub attention: Option<Tensor>,
    /// (b, candidates or cells): scores of what is asked beside the actions; `None` if nothing is
    pub scores: Option<Tensor>,
}

impl Actrm {
    /// A thought of so many steps about observations in network units, (b, …) each, from the usual start; no rule stops it.
    /// Shuffled, a row goes on with the reasoning of the next row's own thought, the last with the first's.
    ///
    /// # Errors
    /// Inputs of the wrong shape, `over = "memory"`, a shuffle of a single row.
    pub fn examine(
        &self,
        observation: &Features<Tensor>,
        steps: usize,
        intervene: Option<Intervention>,
    ) -> Result<Vec<ExaminedStep>> {
        let rows = self.check_inputs(observation)?;
        if let Design::Memory(_) = &self.design {
            let (found, expected) = ("memory".to_string(), "actions or tokens, to look into a thought".to_string());
            return Err(ModelError::Config { model: "actrm", field: "reasoning.over", found, expected });
        }
        let others = match intervene {
            Some(Intervention::Shuffle) if rows < 2 => {
                let (found, expected) = ("1 row".to_string(), "at least 2 to shuffle".to_string());
                return Err(ModelError::Input { operation: "examine", object: "observation", found, expected });
            }
            Some(Intervention::Shuffle) => Some(self.examine(observation, steps, None)?),
            _ => None,
        };
        let latent = Tensor::zeros((rows, self.config.latent_dim), DType::F32, self.action_head.weight.device())?;
        let memory = self.memory(&latent, &self.tokens.look(observation, None)?, &mut Mode::Eval)?.detach();
        let mut carry = self.start(rows, &memory)?;
        let mut done: Vec<ExaminedStep> = Vec::with_capacity(steps);
        for at in 0..steps {
            let Design::Actions(design) = &self.design else {
                let others = others.as_ref().map(|others| &others[at].reasoning);
                done.push(self.examine_tokens(&memory, &mut carry, (at, intervene), done.first(), others)?);
                continue;
            };
            let layers = &design.layers[self.config.reasoning.layers_of(at)];
            let mut attention = None;
            for _ in 0..self.config.reasoning.h_cycles {
                let y = positioned(&carry.answer, &design.action_pos)?;
                for _ in 0..self.config.reasoning.l_cycles {
                    let z = positioned(&carry.reasoning, &design.latent_pos)?;
                    carry.reasoning = update(layers, &z, &[&z, &y, &memory])?.detach();
                }
                match (intervene, &others) {
                    (Some(Intervention::Freeze), _) if at > 0 => carry.reasoning = done[0].reasoning.clone(),
                    (Some(Intervention::Shuffle), Some(others)) => carry.reasoning = rolled(&others[at].reasoning)?,
                    _ => {}
                }
                let z = positioned(&carry.reasoning, &design.latent_pos)?;
                let context = Tensor::cat(&[&z, &y, &memory], 1)?;
                attention = Some(layers[0].attn.weights(&y, &context, None)?.mean(1)?.detach());
                carry.answer = update(layers, &y, &[&z, &y, &memory])?.detach();
            }
            done.push(ExaminedStep {
                chunk: self.action_head.forward(&carry.answer)?.detach(),
                answer: carry.answer.clone(),
                reasoning: carry.reasoning.clone(),
                attention,
                scores: None,
            });
        }
        Ok(done)
    }

    /// A step over tokens. Where they are tampered with, the answer is decoded from what they became, and what is pointed at is
    /// read from its own observation.
    fn examine_tokens(
        &self,
        memory: &Tensor,
        carry: &mut Carry,
        (at, intervene): (usize, Option<Intervention>),
        first: Option<&ExaminedStep>,
        others: Option<&Tensor>,
    ) -> Result<ExaminedStep> {
        let mode = &mut Mode::Eval;
        *carry = self.round(memory, carry, at, false)?.detach();
        match (intervene, first, others) {
            (Some(Intervention::Freeze), Some(first), _) => carry.answer = first.reasoning.clone(),
            (Some(Intervention::Shuffle), _, Some(others)) => carry.answer = rolled(others)?,
            _ => {}
        }
        let step = self.answer(memory, carry.clone(), mode)?;
        let (chunk, answer) = (step.chunk.detach(), step.decoded.detach());
        // over a grid what goes on is under a norm; what is seen is as it was left
        let left = std::mem::replace(carry, step.carry.detach());
        let scores = step.scores.map(|scores| scores.detach());
        Ok(ExaminedStep { chunk, answer, reasoning: left.answer, attention: None, scores })
    }

    /// What the columns of [`ExaminedStep::attention`] stand for: the reasoning's tokens, the actions', the latent, features
    /// by name, places of pictures.
    pub fn context_names(&self) -> Vec<String> {
        let layout = self.tokens.layout();
        let states = (0..self.config.reasoning.tokens).map(|i| format!("z{i}"));
        let actions = (0..self.config.action_horizon).map(|i| format!("y{i}"));
        let features = layout.tokens.iter().map(|token| token.feature.clone());
        let places = layout.len() - layout.vectors();
        let memory = std::iter::once("latent".to_string()).chain(features);
        states.chain(actions).chain(memory).chain((0..places).map(|i| format!("picture{i}"))).collect()
    }
}

/// Each row in the place of the one before, the first in the last one's.
fn rolled(x: &Tensor) -> Result<Tensor> {
    let rows = x.dim(0)?;
    Ok(Tensor::cat(&[x.narrow(0, 1, rows - 1)?, x.narrow(0, 0, 1)?], 0)?)
}

/// ACTRM as a policy whose reasoning is tampered with, and that thinks as many steps as it may.
pub struct DisturbedPolicy {
    model: Arc<Actrm>,
    preprocess: Arc<Preprocess>,
    intervene: Intervention,
    /// what the other thoughts are about, one an episode
    others: Arc<Vec<Observation>>,
    other: usize,
    history: History,
}

impl DisturbedPolicy {
    /// Shares `model`. `others` are observations whose reasoning takes the place of its own where it is shuffled: an
    /// episode's is the one that its seed names, counted around.
    ///
    /// # Errors
    /// A shuffle without others.
    pub fn new(
        model: Arc<Actrm>,
        preprocess: Arc<Preprocess>,
        intervene: Intervention,
        others: Arc<Vec<Observation>>,
    ) -> Result<Self> {
        if intervene == Intervention::Shuffle && others.is_empty() {
            let (found, expected) = ("none".to_string(), "at least one to shuffle".to_string());
            return Err(ModelError::Input { operation: "disturb", object: "other observations", found, expected });
        }
        let history = History::new(preprocess.signature().n_obs_steps);
        Ok(Self { model, preprocess, intervene, others, other: 0, history })
    }
}

impl Policy for DisturbedPolicy {
    fn predict(&mut self, observation: &Observation) -> Result<ActionChunk> {
        let mut seen = self.history.see(&self.preprocess, observation)?;
        if self.intervene == Intervention::Shuffle {
            let other = self.preprocess.observation(std::slice::from_ref(&self.others[self.other]))?;
            let mut both = Features::new();
            for (name, values) in seen.iter() {
                both.insert(name, Tensor::cat(&[values, other.require("disturb", name)?], 0)?);
            }
            seen = both;
        }
        let steps = self.model.examine(&seen, self.model.config.reasoning.max_steps(), Some(self.intervene))?;
        let last = steps.last().expect("at least one step");
        self.preprocess.chunk(&last.chunk.narrow(0, 0, 1)?)
    }

    fn n_obs_steps(&self) -> usize {
        self.history.steps()
    }

    fn observe(&mut self, observation: &Observation) {
        self.history.observe(observation);
    }

    fn reset(&mut self, seed: u64) {
        self.history.clear();
        self.other = (seed % self.others.len().max(1) as u64) as usize;
    }
}
