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
    /// Of a signature that was checked. Without images nothing is drawn from `rng`.
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

    /// How images are seen, if there are any.
    pub(crate) fn vision(&self) -> Option<&VisionConfig> {
        self.0.vision()
    }

    /// The batch with images as the network reads them in training.
    pub(crate) fn with_images(&self, batch: &Batch, rng: &mut Rng) -> Result<Batch> {
        self.0.with_images(batch, rng)
    }

    /// The signature's features, (b, …) each -> (b, width): the features of a step side by side, steps one after another
    pub(crate) fn apply(&self, cx: &mut Context<'_>, rows: usize, observation: &Features<Tensor>) -> Result<Value> {
        let numbers = Value::from(&self.0.numbers(rows, observation)?.reshape((rows, ()))?.contiguous()?);
        let Some(image_features) = self.0.image_features() else { return Ok(numbers) };
        let seen = image_features.apply(cx, &image_features.prepare(observation, None)?)?;
        cat_rows(cx, &numbers, &seen)
    }
}
