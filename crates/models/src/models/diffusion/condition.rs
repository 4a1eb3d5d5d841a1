//! What the network is told of an observation: all numbers of every step, then what the cameras see of every step.

use super::values;
use crate::batch::Batch;
use crate::encoders::VisionConfig;
use crate::error::Result;
use crate::features::{FeatureKind, Features, Signature};
use crate::layers::Sight;
use crate::params::Params;
use crate::rng::Rng;
use candle_core::Tensor;

/// The condition of diffusion, flow matching and MIP.
#[derive(Debug)]
pub(crate) struct Condition {
    model: &'static str,
    signature: Signature,
    sight: Option<Sight>,
}

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
        let sight = Sight::new(p, signature, vision, rng)?;
        Ok(Self { model, signature: signature.clone(), sight })
    }

    /// Numbers of a row.
    pub(crate) fn width(&self) -> usize {
        let numbers = self.signature.observation.iter().filter(|spec| spec.kind != FeatureKind::Image);
        let numbers: usize = numbers.map(|spec| spec.width() * self.signature.n_obs_steps).sum();
        numbers + self.sight.as_ref().map_or(0, Sight::width)
    }

    /// How pictures are seen, if there are any.
    pub(crate) fn vision(&self) -> Option<&VisionConfig> {
        self.sight.as_ref().map(Sight::config)
    }

    /// The observation with pictures as the network reads them, random parts with `rng`.
    pub(crate) fn look(&self, observation: &Features<Tensor>, rng: Option<&mut Rng>) -> Result<Features<Tensor>> {
        match &self.sight {
            Some(sight) => sight.look(observation, rng),
            None => Ok(observation.clone()),
        }
    }

    /// The batch with pictures as the network reads them in training.
    pub(crate) fn looked_at(&self, batch: &Batch, rng: &mut Rng) -> Result<Batch> {
        Ok(Batch { observation: self.look(&batch.observation, Some(rng))?, ..batch.clone() })
    }

    /// The features that are numbers, (b, …) each -> (b, steps*width), the features of a step side by side, steps one after
    /// another
    fn numbers(&self, rows: usize, observation: &Features<Tensor>) -> Result<Tensor> {
        let mut joined = Vec::with_capacity(self.signature.observation.len());
        for spec in self.signature.observation.iter().filter(|spec| spec.kind != FeatureKind::Image) {
            let shape = (rows, self.signature.n_obs_steps, ());
            joined.push(observation.require(self.model, &spec.name)?.reshape(shape)?);
        }
        Ok(Tensor::cat(&joined, 2)?.reshape((rows, ()))?)
    }

    /// The signature's features, (b, …) each -> (b, width), with a gradient
    pub(crate) fn forward(&self, rows: usize, observation: &Features<Tensor>) -> Result<Tensor> {
        let numbers = self.numbers(rows, observation)?;
        match &self.sight {
            Some(sight) => Ok(Tensor::cat(&[numbers, sight.forward(&sight.look(observation, None)?)?], 1)?),
            None => Ok(numbers),
        }
    }

    /// The same as slices, its pictures still to be seen.
    pub(crate) fn told(&self, rows: usize, observation: &Features<Tensor>) -> Result<Told<'_>> {
        let numbers = values(&self.numbers(rows, observation)?)?;
        let pictures = match &self.sight {
            Some(sight) => sight.pictures(&sight.look(observation, None)?)?,
            None => Vec::new(),
        };
        Ok(Told { numbers, pictures, sight: self.sight.as_ref() })
    }
}
