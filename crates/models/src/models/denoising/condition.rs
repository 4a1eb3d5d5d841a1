//! What the network is told of an observation: all numbers of every step, then what the cameras see of every step.

use crate::batch::Batch;
use crate::encoders::VisionConfig;
use crate::features::{Features, Signature};
use crate::layers::Steps;
use candle_core::Tensor;
use nn::ops::cat_rows;
use nn::{Context, Params, Result, Rng, Value};

/// The condition of diffusion, flow matching and MIP.
#[derive(Debug)]
pub(crate) struct Condition(Steps);

impl Condition {
    /// Of a signature that was checked. Without pictures nothing is drawn from `rng`.
    pub(crate) fn new(
        p: &mut Params,
        model: &'static str,
        signature: &Signature,
        vision: Option<&VisionConfig>,
        rng: &mut Rng,
    ) -> Result<Self> {
        Ok(Self(Steps::new(p, model, signature, vision, rng)?))
    }

    /// Numbers of a row.
    pub(crate) fn width(&self) -> usize {
        self.0.width() * self.0.count()
    }

    /// How pictures are seen, if there are any.
    pub(crate) fn vision(&self) -> Option<&VisionConfig> {
        self.0.vision()
    }

    /// The batch with pictures as the network reads them in training.
    pub(crate) fn looked_at(&self, batch: &Batch, rng: &mut Rng) -> Result<Batch> {
        self.0.looked_at(batch, rng)
    }

    /// The signature's features, (b, …) each -> (b, width): the features of a step side by side, steps one after another
    pub(crate) fn apply(&self, cx: &mut Context<'_>, rows: usize, observation: &Features<Tensor>) -> Result<Value> {
        let numbers = Value::from(&self.0.numbers(rows, observation)?.reshape((rows, ()))?.contiguous()?);
        let Some(sight) = self.0.sight() else { return Ok(numbers) };
        let seen = sight.apply(cx, &sight.look(observation, None)?)?;
        cat_rows(cx, &numbers, &seen)
    }
}
