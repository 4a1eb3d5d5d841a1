//! Observations step by step, for models that read a sequence: all numbers of a step, then what the cameras see of it.

use super::ImageFeatures;
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
    image_features: Option<ImageFeatures>,
}

impl Steps {
    /// Of a signature that was checked. Without images nothing is drawn from `rng`.
    pub(crate) fn new(
        p: &mut Params,
        model: &'static str,
        signature: &Signature,
        vision: Option<&VisionConfig>,
        rng: &mut Rng,
    ) -> Result<Self> {
        let image_features = ImageFeatures::new(p, signature, vision, rng)?;
        Ok(Self { model, signature: signature.clone(), image_features })
    }

    /// The cameras, if there are any.
    pub(crate) fn image_features(&self) -> Option<&ImageFeatures> {
        self.image_features.as_ref()
    }

    /// How images are seen, if there are any.
    pub(crate) fn vision(&self) -> Option<&VisionConfig> {
        self.image_features.as_ref().map(ImageFeatures::config)
    }

    /// Numbers of a step that cameras make.
    fn of_cameras(&self) -> usize {
        self.image_features.as_ref().map_or(0, |image_features| image_features.width() / self.signature.n_obs_steps)
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

    /// The observation with images as the network reads them; random parts in training, with `rng`.
    pub(crate) fn prepare(&self, observation: &Features<Tensor>, rng: Option<&mut Rng>) -> Result<Features<Tensor>> {
        match &self.image_features {
            Some(image_features) => image_features.prepare(observation, rng),
            None => Ok(observation.clone()),
        }
    }

    /// The batch with images as the network reads them in training.
    pub(crate) fn with_images(&self, batch: &Batch, rng: &mut Rng) -> Result<Batch> {
        Ok(Batch { observation: self.prepare(&batch.observation, Some(rng))?, ..batch.clone() })
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

    /// The signature's features, (b, T, …) each, images as the network reads them -> (b, T, width)
    pub(crate) fn apply(&self, cx: &mut Context<'_>, rows: usize, observation: &Features<Tensor>) -> Result<Value> {
        let numbers = Value::from(&self.numbers(rows, observation)?);
        let Some(image_features) = &self.image_features else { return Ok(numbers) };
        let seen = image_features.apply(cx, observation)?;
        let lines = rows * self.signature.n_obs_steps;
        let seen = seen.reshape((lines, self.of_cameras()))?;
        let both = cat_rows(cx, &numbers.reshape((lines, numbers.width()))?, &seen)?;
        both.reshape((rows, self.signature.n_obs_steps, self.width()))
    }

    /// The last step alone, of one row: (1, 1, width). Of a camera's images, as the data has them, the last one is seen only.
    pub(crate) fn apply_to_last(&self, cx: &mut Context<'_>, observation: &Features<Tensor>) -> Result<Value> {
        let steps = self.signature.n_obs_steps;
        let numbers = self.numbers(1, observation)?.narrow(1, steps - 1, 1)?.contiguous()?;
        let Some(image_features) = &self.image_features else { return Ok(Value::from(&numbers)) };
        let mut last = Features::new();
        for camera in &image_features.cameras().features {
            let images = observation.require(self.model, camera)?;
            // a history of one step has no axis of its own
            last.insert(camera, if steps > 1 { images.narrow(1, steps - 1, 1)? } else { images.clone() });
        }
        let seen = image_features.apply_to_step(cx, &last)?;
        cat_rows(cx, &Value::from(&numbers.squeeze(1)?), &seen)?.reshape((1, 1, self.width()))
    }
}
