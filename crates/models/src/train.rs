//! The training step: gradients of two half batches on two threads, clipping, learning-rate schedule, optimiser, moving
//! average, and a state that can be saved and restored to the bit.
//!
//! The batch is always cut in the same number of shards and their gradients are added in the same order, so the weights
//! depend on the seed and the data, not on the number of cores.

use crate::batch::Batch;
use crate::error::{ModelError, Result};
use crate::gradients::{Gradients, ParamLayout};
use crate::model::{LossValues, PolicyModel};
use crate::optim::{Optimiser, OptimiserConfig, flat};
use crate::rng::Rng;
use crate::simd::{sum_of_squares, vectorised};
use crate::values::with_values;
use candle_core::Tensor;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Shards of a batch that run at the same time. Part of what defines a training: changing it changes the weights.
const SHARDS: usize = 2;

/// What the learning rate does after the warm-up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, Default)]
#[serde(rename_all = "snake_case")]
pub enum Schedule {
    /// stays
    Constant,
    /// falls along half a cosine to `lr * min_lr_ratio` at the last step
    #[default]
    Cosine,
}

/// How a model is trained.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrainConfig {
    /// optimiser steps in all; the end of the cosine
    pub steps: u64,
    /// highest learning rate
    pub lr: f64,
    /// steps over which the learning rate rises linearly
    pub warmup_steps: u64,
    /// after the warm-up
    pub schedule: Schedule,
    /// end of the cosine as a share of `lr`
    pub min_lr_ratio: f64,
    /// optimiser
    pub optimiser: OptimiserConfig,
    /// largest global gradient norm; 0 for none
    pub clip_norm: f64,
    /// decay of the weights' moving average, if one is kept
    pub ema_decay: Option<f64>,
    /// parts that a batch is cut into, one after the other, to save memory; the gradient is that of the whole batch
    pub accumulation: usize,
}

impl Default for TrainConfig {
    fn default() -> Self {
        Self {
            steps: 1000,
            lr: 1e-3,
            warmup_steps: 50,
            schedule: Schedule::Cosine,
            min_lr_ratio: 0.0,
            optimiser: OptimiserConfig::default(),
            clip_norm: 10.0,
            ema_decay: None,
            accumulation: 1,
        }
    }
}

impl TrainConfig {
    /// Checks the ranges.
    ///
    /// # Errors
    /// The first field out of its range.
    pub fn validate(&self) -> Result<()> {
        let ok = [
            ("steps", self.steps > 0, self.steps.to_string(), "at least 1"),
            ("lr", self.lr.is_finite() && self.lr > 0.0, self.lr.to_string(), "a positive number"),
            ("min_lr_ratio", (0.0..=1.0).contains(&self.min_lr_ratio), self.min_lr_ratio.to_string(), "0 to 1"),
            ("clip_norm", self.clip_norm.is_finite() && self.clip_norm >= 0.0, self.clip_norm.to_string(), "0 or more"),
            (
                "ema_decay",
                self.ema_decay.is_none_or(|d| (0.0..1.0).contains(&d)),
                format!("{:?}", self.ema_decay),
                "at least 0 and below 1",
            ),
            ("accumulation", self.accumulation > 0, self.accumulation.to_string(), "at least 1"),
        ];
        match ok.into_iter().find(|(_, good, _, _)| !good) {
            None => Ok(()),
            Some((field, _, found, expected)) => {
                Err(ModelError::Config { model: "training", field, found, expected: expected.to_string() })
            }
        }
    }

    /// The learning rate of step `step`, counted from 0.
    pub fn lr_at(&self, step: u64) -> f64 {
        if step < self.warmup_steps {
            return self.lr * (step + 1) as f64 / self.warmup_steps as f64;
        }
        match self.schedule {
            Schedule::Constant => self.lr,
            Schedule::Cosine => {
                let span = self.steps.saturating_sub(self.warmup_steps).max(1) as f64;
                let at = ((step - self.warmup_steps) as f64 / span).min(1.0);
                let fall = 0.5 * (1.0 + (std::f64::consts::PI * at).cos());
                self.lr * (self.min_lr_ratio + (1.0 - self.min_lr_ratio) * fall)
            }
        }
    }
}

/// What one step measured.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StepMetrics {
    /// the step, counted from 1
    pub step: u64,
    /// loss before the update
    pub loss: f32,
    /// its parts
    pub parts: BTreeMap<String, f32>,
    /// global norm of the gradient before clipping
    pub grad_norm: f64,
    /// learning rate of this step
    pub lr: f64,
}

/// Everything that a training needs to go on.
#[derive(Debug, Clone)]
pub struct TrainerState {
    /// `param.<name>`, `moment1.<name>`, `moment2.<name>` and, with a moving average, `ema.<name>`
    pub tensors: BTreeMap<String, Tensor>,
    /// steps taken and the generator's state
    pub meta: serde_json::Value,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Meta {
    step: u64,
    rng: Vec<u8>,
}

/// Trains one model.
pub struct Trainer {
    model: Box<dyn PolicyModel>,
    config: TrainConfig,
    optimiser: Optimiser,
    /// one buffer a shard
    gradients: Vec<Gradients>,
    ema: Option<Vec<f32>>,
    rng: Rng,
    threads: usize,
}

impl std::fmt::Debug for Trainer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Trainer")
            .field("config", &self.config)
            .field("step", &self.step_count())
            .finish_non_exhaustive()
    }
}

impl Trainer {
    /// # Errors
    /// A configuration out of range.
    pub fn new(model: Box<dyn PolicyModel>, config: TrainConfig, seed: u64) -> Result<Self> {
        config.validate()?;
        let layout = Arc::new(ParamLayout::new(model.params()));
        let gradients = vec![Gradients::zeros(layout.clone()); SHARDS];
        let ema = match config.ema_decay {
            Some(_) => Some(current(model.as_ref())?),
            None => None,
        };
        let optimiser = Optimiser::new(config.optimiser, layout);
        Ok(Self { model, config, optimiser, gradients, ema, rng: Rng::new(seed, "train"), threads: SHARDS })
    }

    /// Runs on at most `threads` threads (2 unless set). The weights do not depend on it.
    pub fn set_threads(&mut self, threads: usize) {
        self.threads = threads.max(1);
        self.optimiser.set_threads(threads);
    }

    /// Threads that a step is spread over, as far as the machine has them.
    pub fn threads(&self) -> usize {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        self.threads.min(SHARDS).min(cores)
    }

    /// The model as it is now.
    pub fn model(&self) -> &dyn PolicyModel {
        self.model.as_ref()
    }

    /// Gives the model back.
    pub fn into_model(self) -> Box<dyn PolicyModel> {
        self.model
    }

    /// Steps taken.
    pub fn step_count(&self) -> u64 {
        self.optimiser.steps()
    }

    /// One optimiser step on `batch`. After an error the weights are those from before the call.
    ///
    /// # Errors
    /// `NotFinite` naming step and tensor if the loss or a gradient is not finite.
    pub fn step(&mut self, batch: &Batch) -> Result<StepMetrics> {
        let step = self.step_count();
        let rng_before = self.rng.clone();
        let (loss, grad_norm) = match self.gradients_of(batch) {
            Ok(found) => found,
            Err(error) => {
                self.rng = rng_before;
                return Err(error);
            }
        };
        let lr = self.config.lr_at(step);
        let clip = self.config.clip_norm;
        // torch.nn.utils.clip_grad_norm_'s factor
        let scale = if clip > 0.0 { (clip / (grad_norm + 1e-6)).min(1.0) } else { 1.0 };
        self.optimiser.step(self.model.params(), &self.gradients[0], scale as f32, lr)?;
        if let (Some(ema), Some(decay)) = (&mut self.ema, self.config.ema_decay) {
            let (keep, take) = (decay as f32, (1.0 - decay) as f32);
            let mut rest = ema.as_mut_slice();
            for (_, var) in self.model.params().iter() {
                let (head, tail) = rest.split_at_mut(var.elem_count());
                rest = tail;
                with_values(var.as_tensor(), |now| {
                    vectorised(
                        #[inline(always)]
                        || head.iter_mut().zip(now).for_each(|(e, p)| *e = *e * keep + p * take),
                    );
                })?;
            }
        }
        Ok(StepMetrics { step: step + 1, loss: loss.total, parts: loss.parts, grad_norm, lr })
    }

    /// Leaves the gradient of the whole batch in the first buffer; returns loss and gradient norm.
    fn gradients_of(&mut self, batch: &Batch) -> Result<(LossValues, f64)> {
        let mut batch = batch.clone();
        batch.seed = self.rng.next_u64();
        self.gradients.iter_mut().for_each(Gradients::clear);
        let model = self.model.as_ref();
        let mut loss = LossValues::default();
        for part in batch.shards(self.config.accumulation)? {
            let shards = part.shards(SHARDS)?;
            let mut work: Vec<_> = shards
                .iter()
                .zip(&mut self.gradients)
                .map(|(shard, into)| (shard, Rng::new(self.rng.next_u64(), "shard"), into))
                .collect();
            let alone = if self.threads == 1 { work.len() } else { 1 };
            let mine: Vec<_> = work.drain(..alone).collect();
            let run = |(shard, mut rng, into): (&Batch, Rng, &mut Gradients)| {
                model.accumulate_gradients(shard, &mut rng, into)
            };
            let values = std::thread::scope(|scope| {
                let others: Vec<_> = work.into_iter().map(|w| scope.spawn(move || run(w))).collect();
                let mut values: Vec<_> = mine.into_iter().map(run).collect();
                for other in others {
                    values.push(other.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)));
                }
                values
            });
            for value in values {
                loss.add(&value?);
            }
        }
        let (first, others) = self.gradients.split_at_mut(1);
        let sum = first[0].values_mut();
        for other in others {
            vectorised(
                #[inline(always)]
                || sum.iter_mut().zip(other.values()).for_each(|(a, b)| *a += b),
            );
        }
        let norm = sum_of_squares(sum).sqrt();
        if !loss.total.is_finite() || !norm.is_finite() {
            return Err(self.not_finite(&batch, &loss)?);
        }
        Ok((loss, norm))
    }

    /// Finds out what is not finite: data, then weights, then parts of the loss, then gradients.
    fn not_finite(&self, batch: &Batch, loss: &LossValues) -> Result<ModelError> {
        let bad = |values: &[f32]| values.iter().copied().find(|x| !x.is_finite());
        let found = |tensor: String, value: f32| ModelError::NotFinite { step: self.step_count() + 1, tensor, value };
        let data = [
            ("batch.state", Some(&batch.state)),
            ("batch.environment_state", batch.environment_state.as_ref()),
            ("batch.actions", Some(&batch.actions)),
        ];
        for (name, tensor) in data {
            if let Some(value) = tensor.map(|t| with_values(t, bad)).transpose()?.flatten() {
                return Ok(found(name.to_string(), value));
            }
        }
        for (name, var) in self.model.params().iter() {
            if let Some(value) = with_values(var.as_tensor(), bad)? {
                return Ok(found(format!("parameter {name}"), value));
            }
        }
        for (name, &value) in &loss.parts {
            if !value.is_finite() {
                return Ok(found(format!("loss part {name}"), value));
            }
        }
        let grads = &self.gradients[0];
        for (name, span) in grads.layout().iter() {
            if let Some(value) = bad(&grads.values()[span]) {
                return Ok(found(format!("gradient of {name}"), value));
            }
        }
        Ok(found("loss".to_string(), loss.total))
    }

    /// The weights to evaluate: the moving average if there is one. Copies.
    pub fn eval_params(&self) -> Result<BTreeMap<String, Tensor>> {
        let mut tensors = BTreeMap::new();
        let mut at = 0;
        for (name, var) in self.model.params().iter() {
            let tensor = match &self.ema {
                Some(ema) => Tensor::from_slice(&ema[at..at + var.elem_count()], var.dims(), var.device())?,
                None => var.as_detached_tensor().copy()?,
            };
            at += var.elem_count();
            tensors.insert(name.to_string(), tensor);
        }
        Ok(tensors)
    }

    /// Everything needed to go on later, copied.
    pub fn state(&self) -> Result<TrainerState> {
        let params = self.model.params();
        let mut tensors = self.optimiser.state(params)?;
        for (name, var) in params.iter() {
            tensors.insert(format!("param.{name}"), var.as_detached_tensor().copy()?);
        }
        if self.ema.is_some() {
            for (name, tensor) in self.eval_params()? {
                tensors.insert(format!("ema.{name}"), tensor);
            }
        }
        let meta = Meta { step: self.step_count(), rng: self.rng.state() };
        let meta =
            serde_json::to_value(meta).map_err(|e| ModelError::State { object: "trainer", detail: e.to_string() })?;
        Ok(TrainerState { tensors, meta })
    }

    /// Goes on from `state`: from here on every step gives the bits that it would have given there.
    ///
    /// # Errors
    /// A tensor that is missing, extra or misshapen; metadata that cannot be read.
    pub fn restore(&mut self, state: &TrainerState) -> Result<()> {
        let meta: Meta = serde_json::from_value(state.meta.clone())
            .map_err(|e| ModelError::State { object: "trainer", detail: e.to_string() })?;
        let layout = self.gradients[0].layout().clone();
        let mut known = vec!["param.", "moment1.", "moment2."];
        if self.ema.is_some() {
            known.push("ema.");
        }
        if let Some(name) = state.tensors.keys().find(|k| !known.iter().any(|prefix| k.starts_with(prefix))) {
            return Err(ModelError::ExtraTensor { name: name.clone(), known: known.join(", ") });
        }
        let rng = Rng::from_state(&meta.rng)?;
        let ema = match self.ema {
            Some(_) => Some(flat(&layout, "ema", &state.tensors)?),
            None => None,
        };
        let weights: BTreeMap<String, Tensor> = state
            .tensors
            .iter()
            .filter_map(|(name, tensor)| Some((name.strip_prefix("param.")?.to_string(), tensor.clone())))
            .collect();
        // both check before they change anything; the moments' names are a subset of what was checked here
        flat(&layout, "moment2", &state.tensors)?;
        flat(&layout, "moment1", &state.tensors)?;
        self.model.params().load(&weights)?;
        self.optimiser.restore(&state.tensors, meta.step)?;
        (self.rng, self.ema) = (rng, ema);
        Ok(())
    }
}

/// All parameters one after the other.
fn current(model: &dyn PolicyModel) -> Result<Vec<f32>> {
    let mut values = Vec::with_capacity(model.params().count());
    for (_, var) in model.params().iter() {
        with_values(var.as_tensor(), |v| values.extend_from_slice(v))?;
    }
    Ok(values)
}

#[cfg(test)]
#[path = "train_tests.rs"]
mod tests;
