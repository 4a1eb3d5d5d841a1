//! Observations step by step, for models that read a sequence: all numbers of a step, then what the cameras see of it.

use super::Sight;
use crate::batch::Batch;
use crate::encoders::VisionConfig;
use crate::features::{FeatureKind, Features, Signature};
use candle_core::Tensor;
use nn::ops::cat_rows;
use nn::{Context, Params, Result, Rng, Value};

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

    /// The signature's features, (b, T, …) each, pictures as the network reads them -> (b, T, width)
    pub(crate) fn apply(&self, cx: &mut Context<'_>, rows: usize, observation: &Features<Tensor>) -> Result<Value> {
        let numbers = Value::from(&self.numbers(rows, observation)?);
        let Some(sight) = &self.sight else { return Ok(numbers) };
        let seen = sight.apply(cx, observation)?;
        let lines = rows * self.signature.n_obs_steps;
        let seen = seen.reshape((lines, self.of_cameras()))?;
        let both = cat_rows(cx, &numbers.reshape((lines, numbers.width()))?, &seen)?;
        both.reshape((rows, self.signature.n_obs_steps, self.width()))
    }

    /// The last step alone, of one row: (1, 1, width). Of a camera's pictures, as the data has them, the last one is seen only.
    pub(crate) fn apply_to_last(&self, cx: &mut Context<'_>, observation: &Features<Tensor>) -> Result<Value> {
        let steps = self.signature.n_obs_steps;
        let numbers = self.numbers(1, observation)?.narrow(1, steps - 1, 1)?.contiguous()?;
        let Some(sight) = &self.sight else { return Ok(Value::from(&numbers)) };
        let mut last = Features::new();
        for camera in &sight.cameras().features {
            let pictures = observation.require(self.model, camera)?;
            // a history of one step has no axis of its own
            last.insert(camera, if steps > 1 { pictures.narrow(1, steps - 1, 1)? } else { pictures.clone() });
        }
        let seen = sight.apply_to_step(cx, &last)?;
        cat_rows(cx, &Value::from(&numbers.squeeze(1)?), &seen)?.reshape((1, 1, self.width()))
    }
}
