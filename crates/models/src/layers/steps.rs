//! Observations step by step, for models that read a sequence: all numbers of a step, then what the cameras see of it.

use super::Sight;
use crate::batch::Batch;
use crate::encoders::VisionConfig;
use crate::features::{FeatureKind, Features, Signature};
use crate::fused::{Grads, Looked, Pass};
use candle_core::Tensor;
use nn::Params;
use nn::Result;
use nn::Rng;

/// What a step shows.
#[derive(Debug)]
pub(crate) struct Steps {
    model: &'static str,
    signature: Signature,
    sight: Option<Sight>,
}

impl Steps {
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

    /// The cameras, if there are any.
    pub(crate) fn sight(&self) -> Option<&Sight> {
        self.sight.as_ref()
    }

    /// How pictures are seen, if there are any.
    pub(crate) fn vision(&self) -> Option<&VisionConfig> {
        self.sight.as_ref().map(Sight::config)
    }

    /// Numbers of a step that cameras make.
    fn of_cameras(&self) -> usize {
        self.sight.as_ref().map_or(0, |sight| sight.width() / self.signature.n_obs_steps)
    }

    /// Steps of an observation.
    pub(crate) fn count(&self) -> usize {
        self.signature.n_obs_steps
    }

    /// Numbers of a step.
    pub(crate) fn width(&self) -> usize {
        let numbers = self.signature.observation.iter().filter(|spec| spec.kind != FeatureKind::Image);
        numbers.map(|spec| spec.width()).sum::<usize>() + self.of_cameras()
    }

    /// The observation with pictures as the network reads them; random parts in training, with `rng`.
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

    /// The features that are numbers, (b, T, …) each -> (b, T, numbers)
    pub(crate) fn numbers(&self, rows: usize, observation: &Features<Tensor>) -> Result<Tensor> {
        let mut joined = Vec::with_capacity(self.signature.observation.len());
        for spec in self.signature.observation.iter().filter(|spec| spec.kind != FeatureKind::Image) {
            let shape = (rows, self.signature.n_obs_steps, ());
            joined.push(observation.require(self.model, &spec.name)?.reshape(shape)?);
        }
        Ok(Tensor::cat(&joined, 2)?)
    }

    /// The signature's features, (b, T, …) each -> (b, T, width), with a gradient
    pub(crate) fn forward(&self, rows: usize, observation: &Features<Tensor>) -> Result<Tensor> {
        let numbers = self.numbers(rows, observation)?;
        let Some(sight) = &self.sight else { return Ok(numbers) };
        let seen = sight.forward(&sight.look(observation, None)?)?;
        Ok(Tensor::cat(&[numbers, seen.reshape((rows, self.signature.n_obs_steps, ()))?], 2)?)
    }

    /// The last step alone, of one row: (1, 1, width). Of a camera's pictures the last one is seen only.
    pub(crate) fn last(&self, observation: &Features<Tensor>) -> Result<Tensor> {
        let steps = self.signature.n_obs_steps;
        let numbers = self.numbers(1, observation)?.narrow(1, steps - 1, 1)?;
        let Some(sight) = &self.sight else { return Ok(numbers) };
        let mut last = Features::new();
        for camera in &sight.cameras().features {
            let pictures = observation.require(self.model, camera)?;
            // a history of one step has no axis of its own
            last.insert(camera, if steps > 1 { pictures.narrow(1, steps - 1, 1)? } else { pictures.clone() });
        }
        let seen = sight.one_step().forward(&last)?;
        Ok(Tensor::cat(&[numbers, seen.unsqueeze(1)?], 2)?)
    }

    /// Its pictures as slices, which were looked at; `None` without any.
    pub(crate) fn pictures(&self, observation: &Features<Tensor>) -> Result<Option<Vec<Vec<f32>>>> {
        self.sight.as_ref().map(|sight| sight.pictures(observation)).transpose()
    }

    /// By hand: numbers, (b*T, numbers), and pictures -> (b*T, width), and what the backward pass needs.
    pub(crate) fn see(
        &self,
        pass: &mut Pass<'_>,
        rows: usize,
        numbers: &[f32],
        pictures: Option<&[Vec<f32>]>,
    ) -> (Vec<f32>, Option<Looked>) {
        let (Some(sight), Some(pictures)) = (&self.sight, pictures) else {
            return (pass.space.pool.copy(numbers), None);
        };
        let (both, looked) = sight.beside(pass, rows * self.signature.n_obs_steps, numbers, pictures);
        (both, Some(looked))
    }

    /// Whether a gradient goes on below what `see` gave.
    pub(crate) fn learns(&self) -> bool {
        self.sight.is_some()
    }

    /// Adds the gradients of the cameras' network, given that of what `see` gave, (b*T, width).
    pub(crate) fn learn(&self, pass: &mut Pass<'_>, looked: Option<Looked>, grad: &[f32], grads: &mut Grads<'_>) {
        let (Some(sight), Some(looked)) = (&self.sight, looked) else { return };
        sight.learn(pass, looked, (grad, self.width()), self.of_cameras(), grads);
    }
}
