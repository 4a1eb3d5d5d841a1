//! Reinforcement learning on networks that score actions: REINFORCE, A2C and PPO, and learning from an expert's choices.
//!
//! Papers: Williams (1992) for REINFORCE; Mnih et al., arXiv 1602.01783, for A2C; Schulman et al., arXiv 1707.06347, for
//! PPO and arXiv 1506.02438 for generalised advantage estimation.
//!
//! This crate knows no environment. The caller asks [`Agent::decide`] for actions, plays them, notes what came of them in
//! one [`Episode`] per episode, and hands whole episodes to [`Agent::update`]:
//!
//! ```no_run
//! # use models::TrainConfig;
//! # use solvers::{WalkerConfig, rl::{Agent, Algorithm, Choice, Episode, RlConfig}};
//! # fn main() -> nn::Result<()> {
//! let net = WalkerConfig::Mlp { hidden: vec![128, 128], value: true }.build(25, 4, 0)?;
//! let mut agent = Agent::new(net, RlConfig::new(Algorithm::A2c), TrainConfig::default(), 0)?;
//! let mut episode = Episode::default();
//! loop {
//!     let observation = vec![0.0; 25]; // what the environment shows
//!     let decision = agent.decide(&observation, &[episode.previous_action()], Choice::Sample)?[0];
//!     let (reward, done) = (1.0, true); // what the environment answers to decision.action
//!     episode.push(&observation, decision, reward);
//!     if done {
//!         break;
//!     }
//! }
//! agent.update(&[episode])?;
//! # Ok(())
//! # }
//! ```
//!
//! Results: docs/results/puzzles.md.
//!
//! Two slips that cost others their results cannot happen here, and tests say so: the product of log-probabilities and
//! advantages is one of two vectors of the same length (broadcast to a matrix its gradient is zero, as the advantages'
//! mean is), and the advantages' standard deviation has a floor (once every episode succeeds what is left of it is noise,
//! and dividing by it blows the noise up until the policy is gone).

mod advantages;
mod losses;
#[cfg(test)]
mod tests;

use crate::WalkerNet;
use advantages::{advantages, standardise};
use candle_core::{D, Device, Tensor};
use losses::{Chosen, entropy, log_softmax};
use models::{Learner, LearnerMetrics, TrainConfig};
use nn::Rng;
use nn::{ModelError, Result};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// How a policy is improved.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Algorithm {
    /// Up the log-probability of each action times the standardised return that followed. The network has no value head.
    Reinforce,
    /// As REINFORCE with generalised advantages instead of returns; the value head learns the returns.
    A2c,
    /// Several passes over the same episodes, within a trust region.
    Ppo {
        /// How far from 1 the ratio of new to old probability may go and still be rewarded.
        clip: f64,
        /// Passes over the episodes.
        epochs: usize,
        /// Steps per optimiser step; the last batch of a pass may be smaller.
        batch_size: usize,
        /// Ends the passes once the estimated divergence from the policy that acted exceeds this.
        target_kl: Option<f64>,
    },
}

/// What of an update can be chosen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RlConfig {
    /// How the policy is improved.
    pub algorithm: Algorithm,
    /// Discount per step.
    pub gamma: f64,
    /// Weight of longer estimates in the advantage; 1 takes the whole return, 0 one step.
    pub gae_lambda: f64,
    /// Weight of the entropy bonus.
    pub entropy_weight: f64,
    /// Weight of the value head's squared error.
    pub value_weight: f64,
    /// Rewards are multiplied by this before anything else, so that values are of the order of 1.
    pub reward_scale: f64,
    /// Least standard deviation, in scaled rewards, that advantages are divided by.
    pub advantage_std_floor: f64,
}

impl RlConfig {
    /// `algorithm` with defaults for the rest.
    pub fn new(algorithm: Algorithm) -> Self {
        Self {
            algorithm,
            gamma: 0.95,
            gae_lambda: 0.95,
            entropy_weight: 0.01,
            value_weight: 0.5,
            reward_scale: 0.1,
            advantage_std_floor: 0.1,
        }
    }

    /// Refuses what cannot work, naming the field.
    ///
    /// # Errors
    /// [`ModelError::Config`] with the field, what it is and what it should be.
    pub fn check(&self) -> Result<()> {
        let positive = |x: f64| x.is_finite() && x > 0.0;
        let share = |x: f64| (0.0..=1.0).contains(&x);
        let weight = |x: f64| x.is_finite() && x >= 0.0;
        let mut fields = vec![
            ("gamma", self.gamma, share(self.gamma), "0 to 1"),
            ("gae_lambda", self.gae_lambda, share(self.gae_lambda), "0 to 1"),
            ("entropy_weight", self.entropy_weight, weight(self.entropy_weight), "0 or more"),
            ("value_weight", self.value_weight, weight(self.value_weight), "0 or more"),
            ("reward_scale", self.reward_scale, positive(self.reward_scale), "a positive number"),
            (
                "advantage_std_floor",
                self.advantage_std_floor,
                positive(self.advantage_std_floor),
                "a positive number: without a floor a solved task blows up its own noise",
            ),
        ];
        if let Algorithm::Ppo { clip, epochs, batch_size, target_kl } = self.algorithm {
            fields.push(("algorithm.clip", clip, positive(clip), "a positive number"));
            fields.push(("algorithm.epochs", epochs as f64, epochs > 0, "at least 1"));
            fields.push(("algorithm.batch_size", batch_size as f64, batch_size > 0, "at least 1"));
            if let Some(kl) = target_kl {
                fields.push(("algorithm.target_kl", kl, positive(kl), "a positive number"));
            }
        }
        match fields.into_iter().find(|(_, _, good, _)| !good) {
            None => Ok(()),
            Some((field, found, _, expected)) => {
                Err(ModelError::Config { model: "rl", field, found: found.to_string(), expected: expected.into() })
            }
        }
    }
}

/// How an action is picked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Choice {
    /// Drawn from the policy, by the agent's own generator.
    Sample,
    /// The most probable one, the first among equals; draws nothing.
    Greedy,
}

/// One action and what the policy thought of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Decision {
    /// The action's number.
    pub action: u32,
    /// Log-probability that the policy gave it.
    pub log_prob: f32,
    /// The value head's estimate of the (scaled, discounted) return to come; 0 without a value head.
    pub value: f32,
}

/// What happened in one episode, step by step; every list has one item a step but `observations`, which has as many
/// numbers a step as an observation.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Episode {
    /// What the policy saw, one observation after the other.
    pub observations: Vec<f32>,
    /// What it did.
    pub actions: Vec<u32>,
    /// What it got for it, in the environment's units.
    pub rewards: Vec<f32>,
    /// Log-probability of each action at the time.
    pub log_probs: Vec<f32>,
    /// Value estimate of each observation at the time.
    pub values: Vec<f32>,
    /// Value estimate of what followed the last step: 0 if the episode ended by itself, an estimate if it was cut off.
    pub last_value: f32,
}

impl Episode {
    /// Appends one step.
    pub fn push(&mut self, observation: &[f32], decision: Decision, reward: f32) {
        self.observations.extend_from_slice(observation);
        self.actions.push(decision.action);
        self.rewards.push(reward);
        self.log_probs.push(decision.log_prob);
        self.values.push(decision.value);
    }

    /// Steps so far.
    pub fn len(&self) -> usize {
        self.actions.len()
    }

    /// Whether nothing has happened yet.
    pub fn is_empty(&self) -> bool {
        self.actions.is_empty()
    }

    /// The last action; 0 before the first, as in the study.
    pub fn previous_action(&self) -> u32 {
        self.actions.last().copied().unwrap_or(0)
    }

    /// Undiscounted sum of rewards, in the environment's units.
    pub fn total_reward(&self) -> f64 {
        self.rewards.iter().map(|&r| f64::from(r)).sum()
    }

    fn check(&self, observation: usize) -> Result<()> {
        let steps = self.len();
        for (object, found, expected) in [
            ("observations", self.observations.len(), steps * observation),
            ("rewards", self.rewards.len(), steps),
            ("log_probs", self.log_probs.len(), steps),
            ("values", self.values.len(), steps),
        ] {
            if found != expected || steps == 0 {
                let expected = vec![expected.max(1)];
                return Err(ModelError::Shape { operation: "rl update", object, expected, found: vec![found] });
            }
        }
        Ok(())
    }
}

/// What an update measured; means over its optimiser steps.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct RlMetrics {
    /// Optimiser steps that the update took.
    pub optimiser_steps: u64,
    /// What was minimised.
    pub loss: f64,
    /// Its policy part.
    pub policy_loss: f64,
    /// Mean squared error of the value head; 0 without one.
    pub value_loss: f64,
    /// Mean entropy of the policy, in nats.
    pub entropy: f64,
    /// Estimated divergence of the policy from the one that acted.
    pub kl: f64,
    /// Share of steps whose ratio PPO clipped.
    pub clipped: f64,
    /// Standard deviation of the advantages, in scaled rewards, before the floor.
    pub advantage_std: f64,
    /// Global norm of the gradient before clipping.
    pub grad_norm: f64,
    /// Learning rate of the last step.
    pub lr: f64,
}

/// A policy network in training.
pub struct Agent {
    net: Box<dyn WalkerNet>,
    config: RlConfig,
    learner: Learner,
    rng: Rng,
    sizes: Sizes,
}

/// Numbers in an observation, and actions.
#[derive(Debug, Clone, Copy)]
struct Sizes {
    observation: usize,
    actions: usize,
}

impl std::fmt::Debug for Agent {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Agent").field("config", &self.config).field("learner", &self.learner).finish_non_exhaustive()
    }
}

/// All steps of an update, as tensors.
struct Steps {
    observations: Tensor,
    previous: Tensor,
    chosen: Chosen,
}

impl Agent {
    /// An agent that trains `net`. `seed` settles the actions it draws and the order of PPO's batches; the weights came
    /// with the network. `train.steps` counts optimiser steps, of which PPO takes several an update.
    ///
    /// # Errors
    /// A configuration out of range; a value head with REINFORCE, or none with the others.
    pub fn new(net: Box<dyn WalkerNet>, config: RlConfig, train: TrainConfig, seed: u64) -> Result<Self> {
        net.params().backend().require_cpu("reinforcement learning")?;
        config.check()?;
        let (wants, has) = (!matches!(config.algorithm, Algorithm::Reinforce), net.sizes().2);
        if wants != has {
            let say = |value: bool| if value { "with a value head" } else { "without a value head" };
            return Err(ModelError::Config {
                model: "rl",
                field: "algorithm",
                found: format!("{:?} on a network {}", config.algorithm, say(has)),
                expected: format!("a network {}", say(wants)),
            });
        }
        let (observation, actions, _) = net.sizes();
        let learner = Learner::new(net.params(), train)?;
        Ok(Self { net, config, learner, rng: Rng::new(seed, "rl"), sizes: Sizes { observation, actions } })
    }

    /// The network as it is now.
    pub fn net(&self) -> &dyn WalkerNet {
        self.net.as_ref()
    }

    /// How it learns.
    pub fn config(&self) -> &RlConfig {
        &self.config
    }

    /// Optimiser steps taken.
    pub fn step_count(&self) -> u64 {
        self.learner.step_count()
    }

    /// One decision per observation: `observations` holds them one after the other, `previous` the action before each
    /// (see [`Episode::previous_action`]).
    ///
    /// # Errors
    /// Lengths that do not fit.
    pub fn decide(&mut self, observations: &[f32], previous: &[u32], choice: Choice) -> Result<Vec<Decision>> {
        match choice {
            Choice::Greedy => decide(self.net.as_ref(), observations, previous, None),
            Choice::Sample => decide(self.net.as_ref(), observations, previous, Some(&mut self.rng)),
        }
    }

    /// Improves the policy by whole episodes that it has just played itself.
    ///
    /// # Errors
    /// No episode, an episode whose lists do not fit, a loss or gradient that is not finite.
    pub fn update(&mut self, episodes: &[Episode]) -> Result<RlMetrics> {
        let (steps, advantage_std) = self.steps(episodes)?;
        let count = steps.chosen.actions.len();
        let mut metrics = RlMetrics { advantage_std, ..RlMetrics::default() };
        let (epochs, batch_size, target_kl) = match self.config.algorithm {
            Algorithm::Reinforce | Algorithm::A2c => (1, count, None),
            Algorithm::Ppo { epochs, batch_size, target_kl, .. } => (epochs, batch_size, target_kl),
        };
        let mut order: Vec<u32> = (0..count as u32).collect();
        'passes: for _ in 0..epochs {
            if batch_size < count {
                self.rng.shuffle(&mut order);
            }
            for batch in order.chunks(batch_size) {
                let kl = self.improve(&steps, batch, &mut metrics)?;
                if target_kl.is_some_and(|most| kl > most) {
                    break 'passes;
                }
            }
        }
        let taken = metrics.optimiser_steps as f64;
        for sum in [
            &mut metrics.loss,
            &mut metrics.policy_loss,
            &mut metrics.value_loss,
            &mut metrics.entropy,
            &mut metrics.kl,
            &mut metrics.clipped,
            &mut metrics.grad_norm,
        ] {
            *sum /= taken;
        }
        Ok(metrics)
    }

    /// One optimiser step on the steps `batch`; adds to `metrics` and returns the divergence.
    fn improve(&mut self, steps: &Steps, batch: &[u32], metrics: &mut RlMetrics) -> Result<f64> {
        let index = Tensor::from_slice(batch, batch.len(), &Device::Cpu)?;
        let observations = steps.observations.index_select(&index, 0)?;
        let previous = steps.previous.index_select(&index, 0)?;
        let chosen = steps.chosen.select(batch);
        let out = self.net.forward(&observations, Some(&previous))?;
        let log_policy = log_softmax(&out.logits)?;
        let clip = match self.config.algorithm {
            Algorithm::Ppo { clip, .. } => Some(clip),
            Algorithm::Reinforce | Algorithm::A2c => None,
        };
        let policy = chosen.policy_loss(&log_policy, clip)?;
        let entropy = entropy(&log_policy)?;
        let mut loss = (&policy.loss - (&entropy * self.config.entropy_weight)?)?;
        if let Some(value) = &out.value {
            let value_loss = chosen.value_loss(value)?;
            loss = (loss + (&value_loss * self.config.value_weight)?)?;
            metrics.value_loss += f64::from(value_loss.to_scalar::<f32>()?);
        }
        let step = self.learner.step(&loss)?;
        metrics.optimiser_steps += 1;
        metrics.loss += f64::from(step.loss);
        metrics.policy_loss += f64::from(policy.loss.to_scalar::<f32>()?);
        metrics.entropy += f64::from(entropy.to_scalar::<f32>()?);
        metrics.kl += policy.kl;
        metrics.clipped += policy.clipped;
        metrics.grad_norm += step.grad_norm;
        metrics.lr = step.lr;
        Ok(policy.kl)
    }

    /// The episodes' steps one after the other, and the advantages' standard deviation before its floor.
    fn steps(&self, episodes: &[Episode]) -> Result<(Steps, f64)> {
        if episodes.is_empty() {
            return Err(ModelError::Input {
                operation: "rl update",
                object: "episodes",
                found: "none".into(),
                expected: "at least one".into(),
            });
        }
        let mut chosen = Chosen::default();
        let (mut observations, mut previous) = (Vec::new(), Vec::new());
        for episode in episodes {
            episode.check(self.sizes.observation)?;
            if let Some(&action) = episode.actions.iter().find(|&&action| action as usize >= self.sizes.actions) {
                return Err(ModelError::Input {
                    operation: "rl update",
                    object: "action",
                    found: action.to_string(),
                    expected: format!("below {}", self.sizes.actions),
                });
            }
            observations.extend_from_slice(&episode.observations);
            previous.push(0);
            previous.extend_from_slice(&episode.actions[..episode.len() - 1]);
            chosen.actions.extend_from_slice(&episode.actions);
            chosen.log_probs.extend_from_slice(&episode.log_probs);
            let (advantages, returns) = advantages(episode, &self.config);
            chosen.advantages.extend(advantages);
            chosen.returns.extend(returns);
        }
        let std = standardise(&mut chosen.advantages, self.config.advantage_std_floor);
        let count = previous.len();
        let steps = Steps {
            observations: Tensor::from_vec(observations, (count, self.sizes.observation), &Device::Cpu)?,
            previous: Tensor::from_vec(previous, count, &Device::Cpu)?,
            chosen,
        };
        Ok((steps, std))
    }

    /// One optimiser step towards an expert's choices: cross-entropy against `targets`, which holds a distribution over
    /// the actions for each observation (several actions can be equally good). "Search-supervised" training of the puzzle
    /// study labels each cell of a maze with the first moves of its shortest paths. The network has no value head.
    ///
    /// # Errors
    /// Lengths that do not fit, a row of `targets` that is no distribution, a loss or gradient that is not finite.
    pub fn imitate(&mut self, observations: &[f32], previous: &[u32], targets: &[f32]) -> Result<LearnerMetrics> {
        let (observations, previous) = inputs(self.net.as_ref(), observations, previous)?;
        let (rows, actions) = (previous.dim(0)?, self.sizes.actions);
        if targets.len() != rows * actions {
            let (expected, found) = (vec![rows, actions], vec![targets.len()]);
            return Err(ModelError::Shape { operation: "imitate", object: "targets", expected, found });
        }
        for (row, target) in targets.chunks_exact(actions).enumerate() {
            let sum: f32 = target.iter().sum();
            if (sum - 1.0).abs() > 1e-3 || target.iter().any(|&p| p < 0.0) {
                return Err(ModelError::Input {
                    operation: "imitate",
                    object: "targets",
                    found: format!("{target:?} in row {row}"),
                    expected: "shares that add up to 1".into(),
                });
            }
        }
        let targets = Tensor::from_slice(targets, (rows, actions), &Device::Cpu)?;
        let log_policy = log_softmax(&self.net.forward(&observations, Some(&previous))?.logits)?;
        let loss = ((log_policy * targets)?.sum_all()? * (-1.0 / rows as f64))?;
        self.learner.step(&loss)
    }

    /// The weights to evaluate: the moving average if there is one. Copies.
    ///
    /// # Errors
    /// When a tensor operation fails.
    pub fn eval_tensors(&self) -> Result<BTreeMap<String, Tensor>> {
        self.learner.eval_params()
    }

    /// Everything needed to go on later.
    ///
    /// # Errors
    /// When a tensor operation fails.
    pub fn state(&self) -> Result<(BTreeMap<String, Tensor>, serde_json::Value)> {
        let (tensors, step) = self.learner.state()?;
        let meta = serde_json::to_value(Meta { step, rng: self.rng.state() }).map_err(|e| misfit(e.to_string()))?;
        Ok((tensors, meta))
    }

    /// Goes on from [`Self::state`]: the same episodes give the same bits as there, and the same observations the same
    /// actions.
    ///
    /// # Errors
    /// A tensor that is missing or misshapen, metadata that cannot be read; nothing is changed then.
    pub fn restore(&mut self, tensors: &BTreeMap<String, Tensor>, meta: &serde_json::Value) -> Result<()> {
        let meta: Meta = serde_json::from_value(meta.clone()).map_err(|e| misfit(e.to_string()))?;
        let rng = Rng::from_state(&meta.rng)?;
        self.learner.restore(tensors, meta.step)?;
        self.rng = rng;
        Ok(())
    }
}

fn misfit(detail: String) -> ModelError {
    ModelError::State { object: "rl agent", detail }
}

/// The part of an agent's state that is not tensors.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Meta {
    step: u64,
    rng: Vec<u8>,
}

/// Observations `(n, observation)` and previous actions `(n,)` for a network.
fn inputs(net: &dyn WalkerNet, observations: &[f32], previous: &[u32]) -> Result<(Tensor, Tensor)> {
    let (n, (width, actions, _)) = (previous.len(), net.sizes());
    if observations.len() != n * width || n == 0 {
        let (expected, found) = (vec![n.max(1), width], vec![observations.len()]);
        return Err(ModelError::Shape { operation: "decide", object: "observations", expected, found });
    }
    if let Some(&action) = previous.iter().find(|&&action| action as usize >= actions) {
        return Err(ModelError::Input {
            operation: "decide",
            object: "previous action",
            found: action.to_string(),
            expected: format!("below {actions}"),
        });
    }
    let observations = Tensor::from_slice(observations, (n, width), &Device::Cpu)?;
    Ok((observations, Tensor::from_slice(previous, n, &Device::Cpu)?))
}

/// Decisions of any policy network: drawn with `rng`, or the most probable ones without.
///
/// # Errors
/// Lengths that do not fit.
pub fn decide(
    net: &dyn WalkerNet,
    observations: &[f32],
    previous: &[u32],
    mut rng: Option<&mut Rng>,
) -> Result<Vec<Decision>> {
    let (observations, previous) = inputs(net, observations, previous)?;
    let out = net.forward(&observations, Some(&previous))?;
    let log_policy = log_softmax(&out.logits.detach())?;
    let actions = log_policy.dim(D::Minus1)?;
    let log_policy = log_policy.flatten_all()?.to_vec1::<f32>()?;
    let values = match &out.value {
        Some(value) => value.to_vec1::<f32>()?,
        None => vec![0.0; log_policy.len() / actions],
    };
    let pick = |row: &[f32]| match rng.as_deref_mut() {
        Some(rng) => {
            let mut left = f64::from(rng.uniform());
            // what rounding leaves over goes to the last action
            row.iter()
                .position(|&log_p| {
                    left -= f64::from(log_p).exp();
                    left < 0.0
                })
                .unwrap_or(actions - 1)
        }
        None => (1..actions).fold(0, |best, i| if row[i] > row[best] { i } else { best }),
    };
    let picked: Vec<usize> = log_policy.chunks_exact(actions).map(pick).collect();
    let decision = |((row, action), value): ((&[f32], usize), f32)| Decision {
        action: action as u32,
        log_prob: row[action],
        value,
    };
    Ok(log_policy.chunks_exact(actions).zip(picked).zip(values).map(decision).collect())
}
