//! `replay`: a demonstration that was held out, executed blindly from its first action to its last, which is then repeated.
//! Which one, the policy's own generator draws at the beginning of an episode. It says how far a task can be solved without
//! looking: as far as its objects stand where they stood.

pub use super::{Config, READS};
use super::{Floor, Rule};
use crate::batch::Batch;
use crate::features::{Features, Observation, Signature};
use crate::policy::{ActionChunk, Policy};
use crate::preprocess::Preprocess;
use candle_core::Tensor;
use nn::Params;
use nn::Rng;
use nn::{ModelError, Result};
use std::sync::Arc;

/// Table of the actions of all demonstrations, (steps, A).
const ACTIONS: &str = "actions";
/// Table of one column, (steps, 1): 1 at a demonstration's first action, else 0.
const FIRST: &str = "first";

/// The model.
pub type Replay = Floor<Recording>;

/// Playing back.
#[derive(Debug)]
pub struct Recording {
    config: Config,
}

impl Rule for Recording {
    const NAME: &'static str = "replay";
    type Config = Config;

    fn new(config: &Config, signature: &Signature, params: &mut Params) -> Result<Self> {
        config.validate()?;
        params.insert_table(ACTIONS, signature.action_dim)?;
        params.insert_table(FIRST, 1)?;
        Ok(Self { config: config.clone() })
    }

    fn action_horizon(&self) -> usize {
        self.config.action_horizon
    }

    /// The model alone does not know how far the episode is: its first demonstration's beginning.
    fn chunk(&self, model: &Floor<Self>, rows: usize, _: &Features<Tensor>, _: Option<&mut Rng>) -> Result<Tensor> {
        let chunk = model.steps(0, 0)?.unsqueeze(0)?;
        let (_, horizon, width) = chunk.dims3()?;
        Ok(chunk.broadcast_as((rows, horizon, width))?.contiguous()?)
    }

    fn remember(&self, model: &Floor<Self>, _train: &[Batch], held_out: &[Batch]) -> Result<()> {
        if held_out.is_empty() {
            return Err(ModelError::Input {
                operation: "replay",
                object: "held-out demonstrations",
                found: "none".to_string(),
                expected: "a mask of episodes to validate on".to_string(),
            });
        }
        let (mut actions, mut first) = (Vec::new(), Vec::new());
        for episode in held_out {
            // the action of a window's own frame
            actions.push(episode.actions.narrow(1, 0, 1)?.squeeze(1)?);
            first.extend((0..episode.rows()).map(|step| if step == 0 { 1.0_f32 } else { 0.0 }));
        }
        model.params.set_table(ACTIONS, &Tensor::cat(&actions, 0)?)?;
        let steps = first.len();
        model.params.set_table(FIRST, &Tensor::from_vec(first, (steps, 1), model.params.table(ACTIONS)?.device())?)
    }

    fn policy(model: Arc<Floor<Self>>, preprocess: Arc<Preprocess>) -> Box<dyn Policy> {
        let mut policy = Replaying { model, preprocess, seed: 0, at: 0 };
        policy.reset(0);
        Box::new(policy)
    }
}

impl Floor<Recording> {
    /// First step and the one after the last of every demonstration.
    fn demonstrations(&self) -> Result<Vec<(usize, usize)>> {
        let first = self.params.table(FIRST)?.flatten_all()?.to_vec1::<f32>()?;
        let mut begins: Vec<usize> = (0..first.len()).filter(|&step| first[step] == 1.0).collect();
        begins.push(first.len());
        Ok(begins.windows(2).map(|pair| (pair[0], pair[1])).collect())
    }

    /// The actions of a demonstration from its step `at` on, its last repeated: (H, A) in network units
    fn steps(&self, demonstration: usize, at: usize) -> Result<Tensor> {
        let (from, to) = self.demonstrations()?[demonstration];
        let steps: Vec<u32> =
            (0..self.rule.config.action_horizon).map(|k| (from + at + k).min(to - 1) as u32).collect();
        let count = steps.len();
        let actions = self.params.table(ACTIONS)?;
        Ok(actions.index_select(&Tensor::from_vec(steps, count, actions.device())?, 0)?)
    }
}

/// One episode's playing.
struct Replaying {
    model: Arc<Floor<Recording>>,
    preprocess: Arc<Preprocess>,
    seed: u64,
    /// actions on their way
    at: usize,
}

impl Policy for Replaying {
    fn predict(&mut self, _observation: &Observation) -> Result<ActionChunk> {
        let demonstrations = self.model.demonstrations()?.len() as u64;
        let drawn = Rng::new(self.seed, "policy").below(demonstrations.max(1)) as usize;
        self.preprocess.chunk(&self.model.steps(drawn, self.at)?.unsqueeze(0)?)
    }

    fn executed(&mut self, actions: usize) {
        self.at += actions;
    }

    fn reset(&mut self, seed: u64) {
        (self.seed, self.at) = (seed, 0);
    }
}
