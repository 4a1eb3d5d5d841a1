//! `[train]`: the numbers of a training.

use serde::{Deserialize, Serialize};

use crate::ZooError;

/// How the learning rate goes after the warm-up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Schedule {
    /// It stays.
    Constant,
    /// Half a cosine down to zero at the last step.
    Cosine,
}

/// `[train]`
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrainSection {
    /// Optimiser steps.
    pub steps: u64,
    /// Windows a step.
    pub batch_size: usize,
    /// Seed of weights, latents, dropout and batch order.
    pub seed: u64,
    /// Highest learning rate.
    pub lr: f64,
    /// Steps over which the learning rate rises to it.
    pub warmup_steps: u64,
    /// What it does after that.
    pub schedule: Schedule,
    /// AdamW's decoupled weight decay.
    pub weight_decay: f64,
    /// Largest norm of the gradient; larger ones are scaled down.
    pub grad_clip_norm: f64,
    /// Decay of the moving average of the weights; absent: no average.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ema_decay: Option<f64>,
    /// Steps between rows of metrics.
    pub log_every: u64,
    /// Steps between validations.
    pub validate_every: u64,
    /// Steps between checkpoints.
    pub checkpoint_every: u64,
}

impl Default for TrainSection {
    fn default() -> Self {
        Self {
            steps: 1000,
            batch_size: 64,
            seed: 1,
            lr: 1e-3,
            warmup_steps: 50,
            schedule: Schedule::Cosine,
            weight_decay: 1e-4,
            grad_clip_norm: 10.0,
            ema_decay: None,
            log_every: 10,
            validate_every: 100,
            checkpoint_every: 250,
        }
    }
}

impl TrainSection {
    /// Refuses numbers that no training can have.
    pub(crate) fn check(&self) -> Result<(), ZooError> {
        let invalid = |key: &str, expected: &str, found: String| {
            Err(ZooError::InvalidValue { key: format!("train.{key}"), expected: expected.to_owned(), found })
        };
        for (key, value) in [
            ("steps", self.steps),
            ("batch_size", self.batch_size as u64),
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
        for (key, value) in [("lr", self.lr), ("grad_clip_norm", self.grad_clip_norm)] {
            if !value.is_finite() || value <= 0.0 {
                return invalid(key, "a positive number", value.to_string());
            }
        }
        if !self.weight_decay.is_finite() || self.weight_decay < 0.0 {
            return invalid("weight_decay", "a number from 0", self.weight_decay.to_string());
        }
        if let Some(decay) = self.ema_decay
            && !(0.0..1.0).contains(&decay)
        {
            return invalid("ema_decay", "at least 0 and below 1", decay.to_string());
        }
        Ok(())
    }
}
