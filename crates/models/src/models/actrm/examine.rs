//! Looking into a thought: its states after every step, what its action tokens attend to, and what becomes of it where
//! its reasoning is tampered with or it begins from noise.

use super::{Actrm, Carry, Config, Design, Observed, Over, OverActions, Start};
use crate::features::{Features, Observation};
use crate::history::History;
use crate::policy::{ActionChunk, Policy};
use crate::preprocess::Preprocess;
use candle_core::Tensor;
use nn::{Context, ModelError, Result, Rng, Value};
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

/// Several thoughts about one observation; the halting head chooses the one whose chunk is executed.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Starts {
    /// Thoughts, at least 2: the usual one and others from noise
    pub count: usize,
    /// Standard deviation of the normal noise added to the states that the others begin with
    pub noise: f64,
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
    /// Further thoughts from noise (arXiv 2605.19943), over actions or tokens
    #[serde(skip_serializing_if = "Option::is_none")]
    pub starts: Option<Starts>,
}

impl Config {
    /// The configuration of a model with the same weights that thinks otherwise.
    ///
    /// # Errors
    /// No steps; an intervention or starts beside a warm start; halting together with an intervention; a threshold of halting that is none or without it; fewer than two
    /// starts, noise that is not positive, starts together with an intervention or over the memory.
    pub fn thinking(&self, thinking: &Thinking) -> Result<Self> {
        let mut config = self.clone();
        let reasoning = &mut config.reasoning;
        if thinking.halting == Some(true) && thinking.intervene.is_some() {
            let (found, expected) = ("true".to_string(), "false with an intervention".to_string());
            return Err(ModelError::Config { model: "actrm", field: "thinking.halting", found, expected });
        }
        let tampered =
            [("thinking.intervene", thinking.intervene.is_some()), ("thinking.starts", thinking.starts.is_some())];
        if let Some((field, _)) = tampered.into_iter().find(|(_, given)| *given && reasoning.warm_start.is_some()) {
            let (found, expected) = ("with a warm start".to_string(), "a policy without a warm start".to_string());
            return Err(ModelError::Config { model: "actrm", field, found, expected });
        }
        if let Some(starts) = thinking.starts {
            let wrong = |field, found: String, expected: &str| {
                Err(ModelError::Config { model: "actrm", field, found, expected: expected.to_string() })
            };
            if starts.count < 2 {
                return wrong("thinking.starts.count", starts.count.to_string(), "at least 2");
            }
            if !(starts.noise > 0.0 && starts.noise.is_finite()) {
                return wrong("thinking.starts.noise", starts.noise.to_string(), "a positive number");
            }
            if let Some(intervene) = thinking.intervene {
                return wrong("thinking.starts", intervene.name().to_string(), "no intervention beside it");
            }
            if reasoning.over == Over::Memory {
                return wrong("thinking.starts", "over memory".to_string(), "reasoning over actions or tokens");
            }
            // several thoughts run without a clock
            reasoning.budget_ms = None;
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
            let (found, expected) = ("memory".to_string(), "actions or tokens, to look into the reasoning".to_string());
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
        let observation = self.tokens.prepare(observation, None)?;
        self.cache.predict(&self.params, &mut || {}, |cx| {
            let latent = Value::zeros((rows, self.config.latent_dim), &cx.device().clone())?;
            let memory = self.memory(cx, &latent, &observation)?;
            let (observed, mut carry) = (self.observe(cx, memory)?, Carry::default());
            let mut done: Vec<ExaminedStep> = Vec::with_capacity(steps);
            for at in 0..steps {
                let others = others.as_ref().map(|others| &others[at].reasoning);
                let instead = match (intervene, done.first(), others) {
                    (Some(Intervention::Freeze), Some(first), _) => Some(Value::from(&first.reasoning)),
                    (Some(Intervention::Shuffle), _, Some(others)) => Some(Value::from(&rolled(others)?)),
                    _ => None,
                };
                let step = match &self.design {
                    Design::Actions(design) => {
                        self.examine_actions(cx, design, &observed, (&mut carry, at), instead)?
                    }
                    _ => self.examine_tokens(cx, &observed, (&mut carry, at), instead)?,
                };
                done.push(step);
            }
            Ok(done)
        })
    }

    /// A step over actions, of whose reasoning another may take the place before the answer reads it.
    fn examine_actions(
        &self,
        cx: &mut Context<'_>,
        design: &OverActions,
        observed: &Observed,
        (carry, at): (&mut Carry, usize),
        instead: Option<Value>,
    ) -> Result<ExaminedStep> {
        let (rows, memory) = (observed.memory.dim(0)?, observed.memory.detached());
        let attn = &design.layers[self.config.reasoning.layers_of(at).start].attn;
        let mut attention = None;
        for _ in 0..self.config.reasoning.h_cycles {
            let positions = design.action_pos.weight.detach().unsqueeze(0)?;
            let y = match &carry.answer {
                Some(answer) => answer.detached().broadcast_add(&positions)?,
                None => positions.repeat((rows, 1, 1))?,
            };
            let mut between = |reasoning: &mut Value| {
                if let Some(instead) = &instead {
                    *reasoning = instead.clone();
                }
                let z = reasoning.detached().broadcast_add(&design.latent_pos.weight.detach().unsqueeze(0)?)?;
                let context = Tensor::cat(&[&z, &y, &memory], 1)?;
                attention = Some(attn.weights(&y, &context)?.mean(1)?.detach());
                Ok(())
            };
            *carry = design.round(cx, &self.config, observed, (carry, at), &mut between)?;
        }
        let step = self.answer(cx, observed, carry.clone(), None)?;
        let reasoning = carry.reasoning.as_ref().expect("a round leaves a reasoning").detached();
        Ok(ExaminedStep {
            chunk: step.chunk.detached(),
            answer: step.decoded.detached(),
            reasoning,
            attention,
            scores: None,
        })
    }

    /// A step over tokens. Where others take their place, the answer is decoded from these, and what is pointed at is read from its
    /// own observation.
    fn examine_tokens(
        &self,
        cx: &mut Context<'_>,
        observed: &Observed,
        (carry, at): (&mut Carry, usize),
        instead: Option<Value>,
    ) -> Result<ExaminedStep> {
        *carry = self.rounds(cx, observed, carry, (at, None))?;
        if instead.is_some() {
            carry.answer = instead;
        }
        let step = self.answer(cx, observed, carry.clone(), None)?;
        // over a grid what goes on is under a norm; what is seen is as it was left
        let left = std::mem::replace(carry, step.carry).answer.expect("a round leaves an answer");
        Ok(ExaminedStep {
            chunk: step.chunk.detached(),
            answer: step.decoded.detached(),
            reasoning: left.detached(),
            attention: None,
            scores: step.scores.map(|scores| scores.detached()),
        })
    }

    /// What the columns of [`ExaminedStep::attention`] stand for: the reasoning's tokens, the actions', the latent, features
    /// by name, places of images.
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

/// ACTRM as a policy that thinks several times about every observation. It executes the chunk of the thought whose last
/// step has the highest halting probability.
pub struct RestartedPolicy {
    model: Arc<Actrm>,
    preprocess: Arc<Preprocess>,
    starts: Starts,
    rng: Rng,
    history: History,
}

impl RestartedPolicy {
    /// Shares `model`. What it draws depends on the episode's seed.
    pub fn new(model: Arc<Actrm>, preprocess: Arc<Preprocess>, starts: Starts) -> Self {
        let history = History::new(preprocess.signature().n_obs_steps);
        Self { model, preprocess, starts, rng: Rng::new(0, Self::STREAM), history }
    }

    const STREAM: &str = "starts";
}

impl Policy for RestartedPolicy {
    fn predict(&mut self, observation: &Observation) -> Result<ActionChunk> {
        let seen = self.history.see(&self.preprocess, observation)?;
        let count = self.starts.count;
        let mut rows = Features::new();
        for (name, values) in seen.iter() {
            rows.insert(name, Tensor::cat(&vec![values; count], 0)?);
        }
        let [_, tokens, dim] = self.model.thought_shape(count);
        let mut noise = vec![0.0; tokens * dim];
        let drawn = self.rng.normals((count - 1) * tokens * dim).into_iter();
        noise.extend(drawn.map(|x| x * self.starts.noise as f32));
        let noise = Tensor::from_vec(noise, (count, tokens, dim), self.model.params.device())?;
        let thoughts = self.model.reason_seen(&rows, Start::Noise(&noise), &mut || {}, &mut |_| false)?;
        let halt = |row: usize| thoughts.steps[thoughts.depth[row] - 1].halt[row];
        // of equal ones the first, which is the usual thought
        let best = (1..count).fold(0, |best, row| if halt(row) > halt(best) { row } else { best });
        self.preprocess.chunk(&thoughts.chunk.narrow(0, best, 1)?)
    }

    fn n_obs_steps(&self) -> usize {
        self.history.steps()
    }

    fn observe(&mut self, observation: &Observation) {
        self.history.observe(observation);
    }

    fn reset(&mut self, seed: u64) {
        self.history.clear();
        self.rng = Rng::new(seed, Self::STREAM);
    }
}
