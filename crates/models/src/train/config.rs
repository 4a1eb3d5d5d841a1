//! How a model is trained.

use nn::OptimiserConfig;
use nn::{ModelError, Result};
use serde::{Deserialize, Serialize};

/// What the learning rate does after the warm-up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, Default)]
#[serde(rename_all = "snake_case")]
pub enum Schedule {
    /// stays
    Constant,
    /// falls along half a cosine; the step after the last would have `lr * min_lr_ratio`
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
