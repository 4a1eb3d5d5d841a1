//! `[train]`: the numbers of a training.

use std::collections::BTreeMap;
use std::path::Path;

use candle_core::Tensor;
use models::{OptimiserConfig, Precision, Schedule, TrainConfig};
use serde::{Deserialize, Serialize};

use crate::entry::MODEL_FILE;
use crate::{ZooError, tensors};

/// Which optimiser.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OptimiserKind {
    /// AdamW with PyTorch's eps of 1e-8.
    Adamw,
    /// Adam with `atan2` in place of the quotient, as the official TRM.
    AdamAtan2,
}

/// How an entry stores its weights.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum WeightsFormat {
    /// Rounded to float16. The stored weights are those that are evaluated.
    F16,
}

/// `[train]`
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrainSection {
    /// Optimiser steps.
    pub steps: u64,
    /// Windows per step.
    pub batch_size: usize,
    /// Seed of weights, latents, dropout and batch order.
    pub seed: u64,
    /// The entry, `name@version`, whose weights it begins with, as far as names and shapes are the same; absent: drawn from
    /// the seed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub from: Option<String>,
    /// Highest learning rate.
    pub lr: f64,
    /// Steps of linear warm-up to `lr`.
    pub warmup_steps: u64,
    /// Learning rate after the warm-up.
    pub schedule: Schedule,
    /// End of the cosine as a share of `lr`.
    pub min_lr_ratio: f64,
    /// The optimiser.
    pub optimiser: OptimiserKind,
    /// Decay rates of the first and second moment.
    pub betas: [f64; 2],
    /// Decoupled weight decay.
    pub weight_decay: f64,
    /// Largest gradient norm; larger gradients are scaled down. 0: no limit.
    pub grad_clip_norm: f64,
    /// Gradient accumulation: number of parts of a batch, one after the other, to save memory.
    pub accumulation: usize,
    /// Decay of the exponential moving average of the weights; absent or 0: no average.
    #[serde(skip_serializing_if = "Option::is_none", deserialize_with = "zero_is_none")]
    pub ema_decay: Option<f64>,
    /// How an entry stores its weights; absent: as float32.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub weights: Option<WeightsFormat>,
    /// Precision of products on a GPU: `f32`, `tf32` or `bf16`; weights and sums are f32. The CPU computes in f32.
    #[serde(skip_serializing_if = "is_f32")]
    pub precision: Precision,
    /// Steps between rows of metrics.
    pub log_every: u64,
    /// Steps between validations.
    pub validate_every: u64,
    /// Steps between checkpoints.
    pub checkpoint_every: u64,
}

fn is_f32(precision: &Precision) -> bool {
    *precision == Precision::F32
}

impl Default for TrainSection {
    fn default() -> Self {
        Self {
            steps: 1000,
            batch_size: 64,
            seed: 1,
            from: None,
            lr: 1e-3,
            warmup_steps: 50,
            schedule: Schedule::Cosine,
            min_lr_ratio: 0.0,
            optimiser: OptimiserKind::Adamw,
            betas: [0.9, 0.999],
            weight_decay: 1e-4,
            grad_clip_norm: 10.0,
            accumulation: 1,
            ema_decay: None,
            weights: None,
            precision: Precision::F32,
            log_every: 10,
            validate_every: 100,
            checkpoint_every: 250,
        }
    }
}

impl TrainSection {
    /// Refuses numbers that no training can have.
    ///
    /// # Errors
    /// [`ZooError::InvalidValue`] naming the key.
    pub fn check(&self) -> Result<(), ZooError> {
        let invalid = |key: &str, expected: &str, found: String| {
            Err(ZooError::InvalidValue { key: format!("train.{key}"), expected: expected.to_owned(), found })
        };
        for (key, value) in [
            ("steps", self.steps),
            ("batch_size", self.batch_size as u64),
            ("accumulation", self.accumulation as u64),
            ("log_every", self.log_every),
            ("validate_every", self.validate_every),
            ("checkpoint_every", self.checkpoint_every),
        ] {
            if value == 0 {
                return invalid(key, "at least 1", value.to_string());
            }
        }
        if i64::try_from(self.seed).is_err() {
            return invalid("seed", "at most 9223372036854775807, the largest integer of TOML", self.seed.to_string());
        }
        if !self.lr.is_finite() || self.lr <= 0.0 {
            return invalid("lr", "a positive number", self.lr.to_string());
        }
        for (key, value) in [("grad_clip_norm", self.grad_clip_norm), ("weight_decay", self.weight_decay)] {
            if !value.is_finite() || value < 0.0 {
                return invalid(key, "a number from 0", value.to_string());
            }
        }
        if !(0.0..=1.0).contains(&self.min_lr_ratio) {
            return invalid("min_lr_ratio", "0 to 1", self.min_lr_ratio.to_string());
        }
        if let Some(beta) = self.betas.into_iter().find(|beta| !(0.0..1.0).contains(beta)) {
            return invalid("betas", "numbers at least 0 and below 1", beta.to_string());
        }
        if let Some(decay) = self.ema_decay
            && !(0.0..1.0).contains(&decay)
        {
            return invalid("ema_decay", "at least 0 and below 1", decay.to_string());
        }
        Ok(())
    }

    /// Weights as an entry stores them.
    ///
    /// # Errors
    /// [`ZooError::Malformed`]: a weight that is too large for the format.
    pub fn stored(&self, weights: BTreeMap<String, Tensor>) -> Result<BTreeMap<String, Tensor>, ZooError> {
        match self.weights {
            None => Ok(weights),
            Some(WeightsFormat::F16) => tensors::halved(Path::new(MODEL_FILE), weights),
        }
    }

    /// The part of it that the trainer wants.
    pub fn trainer_config(&self) -> TrainConfig {
        let ([beta1, beta2], weight_decay) = (self.betas, self.weight_decay);
        TrainConfig {
            steps: self.steps,
            lr: self.lr,
            warmup_steps: self.warmup_steps,
            schedule: self.schedule,
            min_lr_ratio: self.min_lr_ratio,
            optimiser: match self.optimiser {
                OptimiserKind::Adamw => OptimiserConfig::AdamW { beta1, beta2, eps: 1e-8, weight_decay },
                OptimiserKind::AdamAtan2 => OptimiserConfig::AdamAtan2 { beta1, beta2, weight_decay },
            },
            clip_norm: self.grad_clip_norm,
            ema_decay: self.ema_decay,
            accumulation: self.accumulation,
        }
    }
}
/// No average, whatever is extended: TOML has no word for "absent".
fn zero_is_none<'de, D: serde::Deserializer<'de>>(decay: D) -> Result<Option<f64>, D::Error> {
    Ok(Option::deserialize(decay)?.filter(|decay| *decay != 0.0))
}
