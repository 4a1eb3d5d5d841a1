//! Training on puzzles: one optimiser step per supervision step, with the puzzles and their states in slots between them.

use super::weights::PUZZLES;
use super::{Carry, Example, Gradient, Release, Slots, StepOutput, Trm};
use candle_core::{DType, Device, Tensor};
use models::classification::{ClassProbability, IGNORE_LABEL, binary_cross_entropy, cross_entropy};
use models::{Learner, TrainConfig};
use nn::Rng;
use nn::{ModelError, Result};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// What of the loss and the slots can be chosen; defaults are the reference's.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PuzzleConfig {
    /// puzzles at a time, one a slot
    pub batch_size: usize,
    /// what turns scores into probabilities
    pub probability: ClassProbability,
    /// weight of the halting loss
    pub halt_weight: f64,
    /// when a puzzle leaves its slot
    pub release: Release,
    /// probability per step that a puzzle's states are lost: it is given noise, or another puzzle's states, and has to find
    /// its answer from there
    pub disturbed: f64,
    /// standard deviation of the normal noise that is added to the states of all puzzles after every step
    pub state_noise: f64,
    /// learning rate of the puzzle embeddings' sign descent
    pub puzzle_lr: f64,
    /// weight decay of the puzzle embeddings
    pub puzzle_weight_decay: f64,
}

impl Default for PuzzleConfig {
    fn default() -> Self {
        Self {
            batch_size: 768,
            probability: ClassProbability::Stablemax,
            halt_weight: 0.5,
            release: Release::Head,
            disturbed: 0.0,
            state_noise: 0.0,
            puzzle_lr: 1e-4,
            puzzle_weight_decay: 1.0,
        }
    }
}

/// What one step measured.
#[derive(Debug, Clone, PartialEq)]
pub struct StepReport {
    /// the step, counted from 1
    pub step: u64,
    /// what was minimised: a mean over the slots
    pub loss: f32,
    /// its classification part
    pub class_loss: f32,
    /// its halting part, unweighted
    pub halt_loss: f32,
    /// share of labelled cells that are right
    pub cell_accuracy: f64,
    /// share of puzzles that are right as a whole
    pub exact: f64,
    /// share of puzzles whose halting logit has the right sign
    pub halt_accuracy: f64,
    /// mean supervision steps of the puzzles that left their slots; `None` if none did
    pub steps_when_halted: Option<f64>,
    /// global norm of the gradient before clipping
    pub grad_norm: f64,
    /// learning rate of this step
    pub lr: f64,
}

/// Trains one TRM on puzzles that the caller supplies.
#[derive(Debug)]
pub struct Trainer {
    model: Trm,
    config: PuzzleConfig,
    learner: Learner,
    slots: Slots,
    rng: Rng,
}

/// Right cells and labelled cells, per puzzle.
fn grade(logits: &Tensor, labels: &[i64]) -> Result<Vec<(usize, usize)>> {
    let (batch, len, _) = logits.dims3()?;
    let predicted = logits.argmax(2)?.flatten_all()?.to_vec1::<u32>()?;
    let grades = (0..batch).map(|puzzle| {
        let at = puzzle * len..(puzzle + 1) * len;
        let labelled = labels[at.clone()].iter().zip(&predicted[at]).filter(|(label, _)| **label != IGNORE_LABEL);
        labelled
            .fold((0, 0), |(right, all), (&label, &class)| (right + usize::from(label == i64::from(class)), all + 1))
    });
    Ok(grades.collect())
}

impl Trainer {
    /// # Errors
    /// A configuration out of range.
    pub fn new(model: Trm, train: TrainConfig, config: PuzzleConfig, seed: u64) -> Result<Self> {
        if config.batch_size == 0 {
            return Err(ModelError::Config {
                model: "trm training",
                field: "batch_size",
                found: "0".into(),
                expected: "at least 1".into(),
            });
        }
        // the puzzle table has its own rule and takes no part in the optimiser
        let learner = Learner::new(&model.params().without(&[PUZZLES]), train)?;
        let slots = Slots::new(&model, config.batch_size)?;
        Ok(Self { model, config, learner, slots, rng: Rng::new(seed, "trm train") })
    }

    /// The model as it is now.
    pub fn model(&self) -> &Trm {
        &self.model
    }

    /// Gives the model back.
    pub fn into_model(self) -> Trm {
        self.model
    }

    /// The puzzles and states in progress.
    pub fn slots(&self) -> &Slots {
        &self.slots
    }

    /// Steps taken.
    pub fn step_count(&self) -> u64 {
        self.learner.step_count()
    }

    /// Puzzles that the next step wants.
    pub fn wanted(&self) -> usize {
        self.slots.vacant().len()
    }

    /// One optimiser step. `fresh` holds [`Self::wanted`] puzzles.
    ///
    /// # Errors
    /// A wrong number of puzzles, a puzzle that does not fit, a loss or gradient that is not
    /// finite.
    pub fn step(&mut self, fresh: &[Example]) -> Result<StepReport> {
        self.slots.admit(&self.model, fresh)?;
        let (batch, len) = (self.slots.batch(), self.model.config().seq_len);
        let inputs = self.slots.input_tensor()?;
        let identifiers = self.slots.identifier_tensor()?;
        let out = self.model.supervision_step(self.slots.carry(), &inputs, Some(&identifiers), Gradient::On)?;

        let grades = grade(&out.logits, &self.slots.labels)?;
        let solved: Vec<bool> = grades.iter().map(|(right, all)| right == all).collect();
        let class_loss = self.class_loss(&out, &grades)?;
        let targets: Vec<f32> = solved.iter().map(|&s| f32::from(u8::from(s))).collect();
        let targets = Tensor::from_vec(targets, batch, &Device::Cpu)?;
        let halt_loss = (binary_cross_entropy(&out.q_halt, &targets)?.sum_all()? / batch as f64)?;
        let loss = (&class_loss + (halt_loss.to_dtype(DType::F64)? * self.config.halt_weight)?)?;

        let puzzles = self.model.params().get(PUZZLES).cloned();
        let (metrics, puzzle_grad) = self.learner.step_with(&loss, puzzles.as_ref())?;
        if let (Some(var), Some(grad)) = (puzzles, puzzle_grad) {
            self.step_puzzles(&var, &grad)?;
        }

        let q_halt = out.q_halt.to_vec1::<f32>()?;
        self.slots.advance(&self.model, out.carry, &q_halt, &solved, self.config.release, &mut self.rng);
        if self.config.disturbed > 0.0 {
            self.slots.disturb(self.config.disturbed, &mut self.rng)?;
        }
        if self.config.state_noise > 0.0 {
            self.slots.blur(self.config.state_noise, &mut self.rng)?;
        }
        let halted: Vec<u32> = self.slots.vacant().iter().map(|&slot| self.slots.steps()[slot]).collect();
        let count = |of: usize| of as f64 / batch as f64;
        let (right, all) = grades.iter().fold((0, 0), |(a, b), (right, all)| (a + right, b + all));
        let agrees = q_halt.iter().zip(&solved).filter(|(q, solved)| (**q > 0.0) == **solved);
        debug_assert_eq!(self.slots.labels.len(), batch * len);
        Ok(StepReport {
            step: self.learner.step_count(),
            loss: metrics.loss,
            class_loss: class_loss.to_scalar::<f64>()? as f32,
            halt_loss: halt_loss.to_scalar::<f32>()?,
            cell_accuracy: right as f64 / all.max(1) as f64,
            exact: count(solved.iter().filter(|s| **s).count()),
            halt_accuracy: count(agrees.count()),
            steps_when_halted: match halted.len() {
                0 => None,
                n => Some(halted.iter().map(|&s| f64::from(s)).sum::<f64>() / n as f64),
            },
            grad_norm: metrics.grad_norm,
            lr: metrics.lr,
        })
    }

    /// Mean over the slots of each puzzle's mean over its labelled cells.
    fn class_loss(&self, out: &StepOutput, grades: &[(usize, usize)]) -> Result<Tensor> {
        let (batch, len, classes) = out.logits.dims3()?;
        let flat = out.logits.reshape((batch * len, classes))?;
        let losses = cross_entropy(&flat, &self.slots.labels, self.config.probability)?;
        let per_puzzle = losses.reshape((batch, len))?.sum(1)?;
        let weights: Vec<f64> = grades.iter().map(|(_, all)| 1.0 / ((*all).max(1) * batch) as f64).collect();
        Ok((per_puzzle * Tensor::from_vec(weights, batch, &Device::Cpu)?)?.sum_all()?)
    }

    /// Sign descent with decoupled decay on the rows that the batch used.
    fn step_puzzles(&self, var: &candle_core::Var, grad: &Tensor) -> Result<()> {
        let width = self.model.config().puzzle_emb_ndim;
        let mut table = var.as_detached_tensor().flatten_all()?.to_vec1::<f32>()?;
        let grad = grad.flatten_all()?.to_vec1::<f32>()?;
        let scheduled = self.learner.config().lr_at(self.learner.step_count() - 1) / self.learner.config().lr;
        let lr = self.config.puzzle_lr * scheduled;
        let keep = (1.0 - lr * self.config.puzzle_weight_decay) as f32;
        let used: std::collections::BTreeSet<u32> = self.slots.identifiers.iter().copied().collect();
        for row in used {
            let at = row as usize * width..(row as usize + 1) * width;
            for (value, g) in table[at.clone()].iter_mut().zip(&grad[at]) {
                let sign = if *g == 0.0 { 0.0 } else { g.signum() };
                *value = *value * keep - lr as f32 * sign;
            }
        }
        var.set(&Tensor::from_vec(table, var.shape(), var.device())?)?;
        Ok(())
    }

    /// The weights to evaluate, with the initial states: the moving average if there is one.
    ///
    /// # Errors
    /// When a tensor operation fails.
    pub fn eval_tensors(&self) -> Result<BTreeMap<String, Tensor>> {
        let mut tensors = self.model.tensors();
        tensors.extend(self.learner.eval_params()?);
        Ok(tensors)
    }

    /// Everything needed to go on later.
    ///
    /// # Errors
    /// When a tensor operation fails.
    pub fn state(&self) -> Result<(BTreeMap<String, Tensor>, serde_json::Value)> {
        let (mut tensors, step) = self.learner.state()?;
        for (name, tensor) in self.model.tensors() {
            if !tensors.contains_key(&format!("param.{name}")) {
                tensors.insert(format!("fixed.{name}"), tensor.copy()?);
            }
        }
        let slots = &self.slots;
        let (batch, len) = (slots.batch(), self.model.config().seq_len);
        let saved = |tensor: &Tensor| tensor.copy();
        tensors.insert("carry.z_h".into(), saved(&slots.carry.z_h)?);
        tensors.insert("carry.z_l".into(), saved(&slots.carry.z_l)?);
        tensors.insert("carry.inputs".into(), Tensor::from_slice(&slots.inputs, (batch, len), &Device::Cpu)?);
        tensors.insert("carry.labels".into(), Tensor::from_slice(&slots.labels, (batch, len), &Device::Cpu)?);
        let meta = Meta {
            step,
            rng: self.rng.state(),
            steps: slots.steps.clone(),
            halted: slots.halted.clone(),
            identifiers: slots.identifiers.clone(),
        };
        let meta = serde_json::to_value(meta).map_err(|e| misfit(e.to_string()))?;
        Ok((tensors, meta))
    }

    /// Goes on from [`Self::state`]: every further step gives the bits that it would have given
    /// there.
    ///
    /// # Errors
    /// A tensor that is missing or misshapen; metadata that cannot be read.
    pub fn restore(&mut self, tensors: &BTreeMap<String, Tensor>, meta: &serde_json::Value) -> Result<()> {
        let meta: Meta = serde_json::from_value(meta.clone()).map_err(|e| misfit(e.to_string()))?;
        let (batch, len) = (self.slots.batch(), self.model.config().seq_len);
        if [meta.steps.len(), meta.halted.len(), meta.identifiers.len()] != [batch; 3] {
            return Err(misfit(format!("{} slots, expected {batch}", meta.steps.len())));
        }
        let get = |name: &str, shape: &[usize]| -> Result<Tensor> {
            let Some(tensor) = tensors.get(name) else {
                return Err(ModelError::MissingTensor { name: name.into(), given: nn::some_names(tensors.keys()) });
            };
            if tensor.dims() != shape {
                let (expected, found) = (shape.to_vec(), tensor.dims().to_vec());
                return Err(ModelError::MisshapenTensor { name: name.into(), expected, found });
            }
            Ok(tensor.copy()?)
        };
        let state = [batch, self.model.config().positions_len(), self.model.config().hidden_size];
        let slots = Slots {
            carry: Carry { z_h: get("carry.z_h", &state)?, z_l: get("carry.z_l", &state)? },
            steps: meta.steps,
            halted: meta.halted,
            inputs: get("carry.inputs", &[batch, len])?.flatten_all()?.to_vec1()?,
            labels: get("carry.labels", &[batch, len])?.flatten_all()?.to_vec1()?,
            identifiers: meta.identifiers,
        };
        let strip = |(name, tensor): (&String, &Tensor)| {
            let name = name.strip_prefix("param.").or_else(|| name.strip_prefix("fixed."))?;
            Some((name.to_string(), tensor.clone()))
        };
        let rng = Rng::from_state(&meta.rng)?;
        self.model.load(&tensors.iter().filter_map(strip).collect())?;
        self.learner.restore(tensors, meta.step)?;
        (self.slots, self.rng) = (slots, rng);
        Ok(())
    }
}

fn misfit(detail: String) -> ModelError {
    ModelError::State { object: "trm trainer", detail }
}

/// The part of a trainer's state that is not tensors.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Meta {
    step: u64,
    rng: Vec<u8>,
    steps: Vec<u32>,
    halted: Vec<bool>,
    identifiers: Vec<u32>,
}
