//! Image features beside other numbers, for models that read one vector: the cells of every camera's feature
//! map, each through the same dense layer, side by side, or its keypoints through one. Of a history every step is seen.

use crate::encoders::{ImageEncoder, VisionConfig};
use crate::features::{Features, Signature};
use crate::layers::Cameras;
use candle_core::{DType, Tensor};
use nn::Params;
use nn::Result;
use nn::Rng;
use nn::{Context, Value};

/// Cameras, and the network that their images go through.
#[derive(Debug)]
pub(crate) struct ImageFeatures {
    cameras: Cameras,
    encoder: ImageEncoder,
    steps: usize,
}

impl ImageFeatures {
    /// Of a signature that was checked; `None` where it has no images. Without `vision` the default encoder sees.
    pub(crate) fn new(
        p: &mut Params,
        signature: &Signature,
        vision: Option<&VisionConfig>,
        rng: &mut Rng,
    ) -> Result<Option<Self>> {
        let cell = vision.unwrap_or(&VisionConfig::default()).cell_features();
        let Some(cameras) = Cameras::asked(signature, vision, cell)? else { return Ok(None) };
        let encoder = ImageEncoder::without_positions(p, &cameras.config, &cameras.given, cell, rng)?;
        Ok(Some(Self { cameras, encoder, steps: signature.n_obs_steps }))
    }

    /// How images are seen.
    pub(crate) fn config(&self) -> &VisionConfig {
        &self.cameras.config
    }

    /// The cameras.
    pub(crate) fn cameras(&self) -> &Cameras {
        &self.cameras
    }

    /// Numbers of a row: those of all cells, or keypoints, of all cameras, step after step.
    pub(crate) fn width(&self) -> usize {
        self.steps * self.cameras.tokens * self.config().cell_features()
    }

    /// Of a single step, whatever the history is: images as the data has them, (b, H, W, 3) or (b, 1, H, W, 3) a camera
    /// -> (b, numbers of a step)
    pub(crate) fn apply_to_step(&self, cx: &mut Context<'_>, observation: &Features<Tensor>) -> Result<Value> {
        let mut prepared = Vec::with_capacity(self.cameras.features.len());
        for (i, name) in self.cameras.features.iter().enumerate() {
            let images = observation.require("see", name)?;
            let images = if images.rank() == 5 { images.squeeze(1)? } else { images.clone() };
            prepared.push(self.encoder.prepare(i, &images, None)?);
        }
        let tokens = self.encoder.apply(cx, &prepared)?;
        tokens.reshape((tokens.dim(0)?, self.width() / self.steps))
    }

    /// A camera's images one after the other, (b, …) or (b, steps, …) -> (b*steps, …)
    fn unfolded(&self, images: &Tensor) -> Result<Tensor> {
        Ok(if self.steps > 1 { images.flatten(0, 1)? } else { images.clone() })
    }

    /// The observation with images as the network reads them: random parts in training, with `rng`. Images that
    /// are prepared already stay.
    pub(crate) fn prepare(
        &self,
        observation: &Features<Tensor>,
        mut rng: Option<&mut Rng>,
    ) -> Result<Features<Tensor>> {
        let mut seen = observation.clone();
        for (i, name) in self.cameras.features.iter().enumerate() {
            let images = observation.require("see", name)?;
            if images.dtype() != DType::U8 {
                continue;
            }
            let prepared = self.encoder.prepare(i, &self.unfolded(images)?, rng.as_deref_mut())?;
            let (_, h, w, colours) = prepared.dims4()?;
            seen.insert(
                name,
                if self.steps > 1 { prepared.reshape(((), self.steps, h, w, colours))? } else { prepared },
            );
        }
        Ok(seen)
    }

    /// An observation with prepared images -> (b, width)
    pub(crate) fn apply(&self, cx: &mut Context<'_>, observation: &Features<Tensor>) -> Result<Value> {
        let images = self.cameras.features.iter();
        let images = images.map(|name| self.unfolded(observation.require("see", name)?));
        let tokens = self.encoder.apply(cx, &images.collect::<Result<Vec<_>>>()?)?;
        tokens.reshape((tokens.len() / self.width(), self.width()))
    }
}
