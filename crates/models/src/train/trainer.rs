//! The training step of a policy: gradients of two half batches on two threads, then the core's step.
//!
//! On the CPU the batch is always cut in the same number of shards and their gradients are added in the same order, so the
//! weights depend on the seed and the data, not on the number of cores. Other devices take it whole, and a step does not wait
//! for them: numbers are read when they are asked for.

use super::config::TrainConfig;
use super::core::{Core, Single};
use crate::batch::Batch;
use crate::model::PolicyModel;
use candle_core::Tensor;
use nn::Gradients;
use nn::Rng;
use nn::values::with_values;
use nn::{LossNumbers, Number};
use nn::{ModelError, Result};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Shards of a batch that run at the same time on the CPU. Part of what defines a training: changing it changes the weights.
const SHARDS: usize = 2;

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

/// What one step measured, which the device may still be computing.
#[derive(Debug, Clone)]
pub struct StepNumbers {
    step: u64,
    loss: LossNumbers,
    norm: Number,
    lr: f64,
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
    core: Core<Single>,
    /// one buffer a shard
    gradients: Vec<Gradients>,
    rng: Rng,
    threads: usize,
}

impl std::fmt::Debug for Trainer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Trainer")
            .field("config", self.core.config())
            .field("step", &self.step_count())
            .finish_non_exhaustive()
    }
}

impl Trainer {
    /// # Errors
    /// A configuration out of range.
    pub fn new(model: Box<dyn PolicyModel>, config: TrainConfig, seed: u64) -> Result<Self> {
        let core = Core::new(model.params(), config)?;
        let shards = if core.params().device().is_cpu() { SHARDS } else { 1 };
        let gradients = vec![Gradients::zeros(core.layout().clone())?; shards];
        core.params().backend().seed(seed)?;
        Ok(Self { model, core, gradients, rng: Rng::new(seed, "train"), threads: rayon::current_num_threads() })
    }

    /// Runs on at most `threads` threads (unless set, as many as `RAYON_NUM_THREADS` says, else as this process may use
    /// processors; never more than two). The weights do not depend on it.
    pub fn set_threads(&mut self, threads: usize) {
        self.threads = threads.max(1);
        self.core.set_threads(threads);
    }

    /// Threads that a step is spread over.
    pub fn threads(&self) -> usize {
        self.threads.min(self.gradients.len())
    }

    /// The model as it is now.
    pub fn model(&self) -> &dyn PolicyModel {
        self.model.as_ref()
    }

    /// Steps taken.
    pub fn step_count(&self) -> u64 {
        self.core.steps()
    }

    /// One optimiser step on `batch`. After an error the weights are those from before the call.
    ///
    /// # Errors
    /// `NotFinite` naming step and tensor if the loss or a gradient is not finite.
    pub fn step(&mut self, batch: &Batch) -> Result<StepMetrics> {
        let numbers = self.step_ahead(batch, true)?;
        self.read(&numbers, batch)
    }

    /// The same without waiting for the device, unless `check` says so. What is not finite is then found by [`Self::read`], in
    /// this step or in a later one.
    ///
    /// # Errors
    /// `NotFinite` as [`Self::step`], where operations run on the CPU or `check` is set.
    pub fn step_ahead(&mut self, batch: &Batch, check: bool) -> Result<StepNumbers> {
        let step = self.step_count();
        let rng_before = self.rng.clone();
        let check = check || batch.device().is_cpu();
        let (loss, norm) = match self.gradients_of(batch, check) {
            Ok(found) => found,
            Err(error) => {
                self.rng = rng_before;
                return Err(error);
            }
        };
        let lr = self.core.step(&self.gradients[0], &norm)?;
        Ok(StepNumbers { step: step + 1, loss, norm, lr })
    }

    /// Waits for what the last step, on `batch`, measured.
    ///
    /// # Errors
    /// `NotFinite` naming what is not, in this step or in one before that was not read.
    pub fn read(&self, numbers: &StepNumbers, batch: &Batch) -> Result<StepMetrics> {
        let (loss, grad_norm) = (numbers.loss.read()?, numbers.norm.read()?);
        if !loss.total.is_finite() || !grad_norm.is_finite() {
            return Err(self.not_finite(batch, &numbers.loss)?);
        }
        Ok(StepMetrics { step: numbers.step, loss: loss.total, parts: loss.parts, grad_norm, lr: numbers.lr })
    }

    /// Leaves the gradient of the whole batch in the first buffer; returns loss and gradient norm.
    fn gradients_of(&mut self, batch: &Batch, check: bool) -> Result<(LossNumbers, Number)> {
        let mut batch = batch.clone();
        batch.seed = self.rng.next_u64();
        self.gradients.iter_mut().try_for_each(Gradients::clear)?;
        let model = self.model.as_ref();
        let mut loss = LossNumbers::default();
        for part in batch.shards(self.core.config().accumulation)? {
            let shards = part.shards(self.gradients.len())?;
            let mut work: Vec<_> = shards
                .iter()
                .zip(&mut self.gradients)
                .map(|(shard, into)| (shard, Rng::new(self.rng.next_u64(), "shard"), into))
                .collect();
            let alone = if self.threads == 1 { work.len() } else { work.len().min(1) };
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
                loss.add(&value?)?;
            }
        }
        let (first, others) = self.gradients.split_at_mut(1);
        others.iter().try_for_each(|other| first[0].add(other))?;
        let norm = first[0].norm()?;
        if check && !(loss.total.read()?.is_finite() && norm.read()?.is_finite()) {
            return Err(self.not_finite(&batch, &loss)?);
        }
        Ok((loss, norm))
    }

    /// Finds out what is not finite: data, then weights, then parts of the loss, then gradients.
    fn not_finite(&self, batch: &Batch, loss: &LossNumbers) -> Result<ModelError> {
        let loss = loss.read()?;
        let bad = |values: &[f32]| values.iter().copied().find(|x| !x.is_finite());
        let found = |tensor: String, value: f32| self.core.not_finite(tensor, value);
        for (name, tensor) in batch.observation.iter().chain([("actions", &batch.actions)]) {
            if let Some(value) = with_values(tensor, bad)? {
                return Ok(found(format!("batch.{name}"), value));
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
        let fault = self.core.gradient_at_fault(&self.gradients[0])?;
        Ok(fault.unwrap_or_else(|| found("loss".to_string(), loss.total)))
    }

    /// The weights to evaluate: the moving average if there is one. Copies.
    pub fn eval_params(&self) -> Result<BTreeMap<String, Tensor>> {
        self.core.eval_params()
    }

    /// Everything needed to go on later, copied.
    pub fn state(&self) -> Result<TrainerState> {
        let tensors = self.core.state()?;
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
        let known = self.core.prefixes();
        if let Some(name) = state.tensors.keys().find(|k| !known.iter().any(|prefix| k.starts_with(prefix))) {
            return Err(ModelError::ExtraTensor { name: name.clone(), known: known.join(", ") });
        }
        let rng = Rng::from_state(&meta.rng)?;
        self.core.restore(&state.tensors, meta.step)?;
        self.core.params().backend().seed(rng.clone().next_u64())?;
        self.rng = rng;
        Ok(())
    }
}
