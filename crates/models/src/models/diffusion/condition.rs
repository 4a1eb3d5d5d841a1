//! What the network is told of an observation: all numbers of every step, then what the cameras see of every step.

use super::values;
use crate::batch::Batch;
use crate::encoders::VisionConfig;
use crate::features::{Features, Signature};
use crate::layers::{Sight, Steps};
use candle_core::Tensor;
use nn::Params;
use nn::Result;
use nn::Rng;

/// The condition of diffusion, flow matching and MIP.
#[derive(Debug)]
pub(crate) struct Condition(Steps);

/// An observation on slices.
pub(crate) struct Told<'a> {
    /// (n, numbers)
    pub(crate) numbers: Vec<f32>,
    /// (n*steps, H, W, 3) a camera, as the network reads them
    pub(crate) pictures: Vec<Vec<f32>>,
    pub(crate) sight: Option<&'a Sight>,
}

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

    /// The observation with pictures as the network reads them outside of training.
    #[cfg(test)]
    pub(crate) fn look(&self, observation: &Features<Tensor>) -> Result<Features<Tensor>> {
        self.0.look(observation, None)
    }

    /// The batch with pictures as the network reads them in training.
    pub(crate) fn looked_at(&self, batch: &Batch, rng: &mut Rng) -> Result<Batch> {
        self.0.looked_at(batch, rng)
    }

    /// The features that are numbers, (b, …) each -> (b, steps*width), the features of a step side by side, steps one after
    /// another
    fn numbers(&self, rows: usize, observation: &Features<Tensor>) -> Result<Tensor> {
        Ok(self.0.numbers(rows, observation)?.reshape((rows, ()))?)
    }

    /// The signature's features, (b, …) each -> (b, width), with a gradient
    pub(crate) fn forward(&self, rows: usize, observation: &Features<Tensor>) -> Result<Tensor> {
        let numbers = self.numbers(rows, observation)?;
        match self.0.sight() {
            Some(sight) => Ok(Tensor::cat(&[numbers, sight.forward(&sight.look(observation, None)?)?], 1)?),
            None => Ok(numbers),
        }
    }

    /// The same as slices, its pictures still to be seen.
    pub(crate) fn told(&self, rows: usize, observation: &Features<Tensor>) -> Result<Told<'_>> {
        let numbers = values(&self.numbers(rows, observation)?)?;
        let pictures = match self.0.sight() {
            Some(sight) => sight.pictures(&sight.look(observation, None)?)?,
            None => Vec::new(),
        };
        Ok(Told { numbers, pictures, sight: self.0.sight() })
    }
}
