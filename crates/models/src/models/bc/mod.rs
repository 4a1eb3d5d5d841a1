//! BC, behaviour cloning with a multi-layer perceptron: the floor that every other policy has to rise above.
//!
//! Reference: robomimic's `BC` on low-dimensional observations (`algo/bc.py`, `config/bc_config.py`, Mandlekar et al.,
//! arXiv 2108.03298): dense layers of 1024 and 1024 with ReLU over the joined observation, squared error.
//!
//! Deviations: actions may be predicted as a chunk; robomimic predicts one. Its outputs go through `tanh`, because its
//! actions lie in -1 to 1; ours are normalised and do not. Its history goes through an LSTM (`BC-RNN`); here the steps of a
//! history lie side by side. Images become the cells of `[policy.vision]`'s feature map behind the numbers (robomimic:
//! keypoints).

mod config;

pub use config::{Config, Loss};

use crate::batch::Batch;
use crate::checks::{check_batch, check_observation};
use crate::chunk_policy::ChunkPolicy;
use crate::encoders::VisionConfig;
use crate::features::{FeatureKind, Features, Signature};
use crate::layers::{Activation, ImageFeatures, Linear};
use crate::model::PolicyModel;
use crate::policy::{Clock, Policy};
use crate::preprocess::Preprocess;
use candle_core::Tensor;
use nn::ops::{Error, activation, cat_rows, chunk_error, linear};
use nn::{Backend, Cache, Context, Params, Result, Rng, Value};
use std::sync::Arc;

/// The kinds of features that it reads.
pub const READS: &[FeatureKind] =
    &[FeatureKind::State, FeatureKind::EnvironmentState, FeatureKind::Entity, FeatureKind::Image];

/// The model.
#[derive(Debug)]
pub struct Bc {
    config: Config,
    signature: Signature,
    params: Params,
    image_features: Option<ImageFeatures>,
    hidden: Vec<Linear>,
    action_head: Linear,
    cache: Cache,
}

impl Bc {
    /// Initial weights are torch's defaults.
    ///
    /// # Errors
    /// A configuration or a signature that describes no possible model.
    pub fn new(config: &Config, signature: &Signature, seed: u64, backend: &Backend) -> Result<Self> {
        config.validate()?;
        signature.check("bc", READS)?;
        let rng = &mut Rng::new(seed, "init");
        let mut p = Params::new(backend);
        let image_features = ImageFeatures::new(&mut p, signature, config.vision.as_ref(), rng)?;
        let numbers = signature.observation.iter().filter(|spec| spec.kind != FeatureKind::Image);
        let numbers: usize = numbers.map(|spec| spec.width() * signature.n_obs_steps).sum();
        let mut width = numbers + image_features.as_ref().map_or(0, ImageFeatures::width);
        let mut hidden = Vec::with_capacity(config.hidden.len());
        for (i, &next) in config.hidden.iter().enumerate() {
            hidden.push(Linear::new(&mut p, &format!("hidden.{i}"), width, next, rng)?);
            width = next;
        }
        let action_head = Linear::new(&mut p, "action_head", width, config.action_horizon * signature.action_dim, rng)?;
        let (config, signature, cache) = (config.clone(), signature.clone(), Cache::default());
        Ok(Self { config, signature, params: p, image_features, hidden, action_head, cache })
    }

    /// The signature's features that are numbers, (b, …) each -> (b, all of them)
    fn numbers(&self, rows: usize, observation: &Features<Tensor>) -> Result<Tensor> {
        let mut joined = Vec::with_capacity(self.signature.observation.len());
        for spec in self.signature.observation.iter().filter(|spec| spec.kind != FeatureKind::Image) {
            joined.push(observation.require("bc", &spec.name)?.reshape((rows, ()))?);
        }
        Ok(Tensor::cat(&joined, 1)?)
    }

    /// The signature's features, (b, …) each, images as the network reads them -> (b, H, A)
    fn forward(&self, cx: &mut Context<'_>, rows: usize, observation: &Features<Tensor>) -> Result<Value> {
        let mut x = Value::from(&self.numbers(rows, observation)?);
        if let Some(image_features) = &self.image_features {
            let seen = image_features.apply(cx, observation)?;
            x = cat_rows(cx, &x, &seen)?;
        }
        for layer in &self.hidden {
            x = linear(cx, &x, layer)?;
            x = activation(cx, &x, Activation::Relu)?;
        }
        let shape = (rows, self.config.action_horizon, self.signature.action_dim);
        linear(cx, &x, &self.action_head)?.reshape(shape)
    }

    /// The observation with images as the network reads them: random parts in training, with `rng`.
    fn prepare(&self, observation: &Features<Tensor>, rng: Option<&mut Rng>) -> Result<Features<Tensor>> {
        self.image_features
            .as_ref()
            .map_or_else(|| Ok(observation.clone()), |image_features| image_features.prepare(observation, rng))
    }

    /// The prediction on candle's operations; `predict` runs the same statement on hand-written kernels.
    #[cfg(test)]
    fn predict_composed(&self, observation: &Features<Tensor>) -> Result<Tensor> {
        let rows = check_observation("bc", &self.signature, observation)?;
        let observation = self.prepare(observation, None)?;
        self.cache.composed_predict(&self.params, |cx| Ok(self.forward(cx, rows, &observation)?.detached()))
    }
}

impl PolicyModel for Bc {
    fn params(&self) -> &Params {
        &self.params
    }

    fn signature(&self) -> &Signature {
        &self.signature
    }

    fn cache(&self) -> Option<&Cache> {
        Some(&self.cache)
    }

    fn forward_loss(&self, cx: &mut Context<'_>, batch: &Batch) -> Result<nn::Loss> {
        check_batch("bc", &self.signature, self.config.action_horizon, batch)?;
        let observation = self.prepare(&batch.observation, Some(cx.rng()?))?;
        let actions = self.forward(cx, batch.rows(), &observation)?;
        let entries = batch.total_valid_steps * self.signature.action_dim;
        let mut loss = nn::Loss::default();
        let error = |cx: &mut Context<'_>, actions: &Value, error: Error| {
            Ok::<_, nn::ModelError>(chunk_error(cx, (actions, &batch.actions), &batch.is_pad, error, entries)?.0)
        };
        match self.config.loss {
            Loss::L1 => loss.add("l1_loss", error(cx, &actions, Error::Absolute)?, 1.0),
            Loss::L2 => {
                // L1 in any case: it is what other policies report
                let l1 = error(cx, &actions.detach(), Error::Absolute)?;
                loss.report("l1_loss", l1.value());
                loss.add("l2_loss", error(cx, &actions, Error::Squared)?, 1.0);
            }
        }
        Ok(loss)
    }

    fn predict(&self, observation: &Features<Tensor>) -> Result<Tensor> {
        self.sample_seen(observation, &mut Rng::new(0, "predict"), &mut || {})
    }

    /// Nothing is drawn.
    fn sample_seen(&self, observation: &Features<Tensor>, _rng: &mut Rng, on_seen: &mut dyn FnMut()) -> Result<Tensor> {
        let rows = check_observation("bc", &self.signature, observation)?;
        let observation = self.prepare(observation, None)?;
        self.cache.predict(&self.params, on_seen, |cx| Ok(self.forward(cx, rows, &observation)?.detached()))
    }

    fn policy(self: Arc<Self>, preprocess: Arc<Preprocess>, clock: Box<dyn Clock>) -> Box<dyn Policy> {
        Box::new(ChunkPolicy::new(self, preprocess).with_clock(clock))
    }

    fn vision(&self) -> Option<&VisionConfig> {
        self.image_features.as_ref().map(ImageFeatures::config)
    }

    fn action_horizon(&self) -> usize {
        self.config.action_horizon
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::testing::{
        assert_the_gradient_is_the_slope, assert_the_step_is_the_composed_one, batch, losses_of_training,
        move_parameters, signatures, vision_config,
    };

    fn configs() -> Vec<Config> {
        [(Loss::L2, vec![11, 7]), (Loss::L1, vec![9]), (Loss::L2, vec![])]
            .map(|(loss, hidden)| Config { action_horizon: 3, hidden, loss, vision: None })
            .into()
    }

    #[test]
    fn the_step_on_kernels_is_the_composed_one() {
        let of = signatures();
        for signature in [&of.plain, &of.entities, &of.history] {
            for config in configs() {
                let model = Bc::new(&config, signature, 1, &Backend::CPU).unwrap();
                move_parameters(&model);
                let batch = batch(signature, config.action_horizon, 7, 3);
                assert_the_step_is_the_composed_one(&model, &batch, &format!("{config:?}"));
            }
        }
    }

    #[test]
    fn from_images_step_and_prediction_are_the_composed_ones() {
        let of = signatures();
        for signature in [&of.images, &of.image_history] {
            for config in configs() {
                let model =
                    Bc::new(&Config { vision: Some(vision_config()), ..config }, signature, 1, &Backend::CPU).unwrap();
                move_parameters(&model);
                let batch = batch(signature, 3, 3, 3);
                assert_the_step_is_the_composed_one(&model, &batch, &format!("{:?}", model.config));
                let (want, mut seen) = (model.predict_composed(&batch.observation).unwrap(), 0);
                let rng = &mut Rng::new(0, "unused");
                let got = model.sample_seen(&batch.observation, rng, &mut || seen += 1).unwrap();
                let off = (got - want).unwrap().abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
                assert!(off < 1e-4 && seen == 1, "{off} {seen}");
            }
        }
    }

    #[test]
    fn the_gradient_is_the_slope_of_the_loss() {
        let of = signatures();
        for signature in [&of.plain, &of.no_env, &of.entities, &of.history] {
            for config in configs() {
                let model = Bc::new(&config, signature, 1, &Backend::CPU).unwrap();
                let batch = batch(signature, config.action_horizon, 4, 3);
                assert_the_gradient_is_the_slope(&model, &batch, &format!("{config:?}"));
            }
        }
    }

    #[test]
    fn the_loss_is_the_mean_over_steps_that_are_not_padding() {
        let signature = signatures().plain;
        for config in configs() {
            let model = Bc::new(&config, &signature, 1, &Backend::CPU).unwrap();
            let batch = batch(&signature, 3, 4, 3);
            let flat = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
            let (predicted, actions) = (flat(&model.predict(&batch.observation).unwrap()), flat(&batch.actions));
            let pad = flat(&batch.is_pad);
            assert!(pad.contains(&1.0));
            let errors: Vec<f32> = (0..actions.len())
                .filter(|i| pad[i / signature.action_dim] == 0.0)
                .map(|i| (predicted[i] - actions[i]).abs())
                .map(|error| if config.loss == Loss::L1 { error } else { error * error })
                .collect();
            let want = errors.iter().sum::<f32>() / errors.len() as f32;
            let got = model.loss(&batch, &mut Rng::new(0, "loss")).unwrap().total.to_scalar::<f32>().unwrap();
            assert!((got - want).abs() < 1e-5 * want.max(1.0), "{got} {want} {config:?}");
        }
    }

    #[test]
    fn training_lowers_the_loss_with_the_same_bits_every_time() {
        let signature = signatures().entities;
        let config = Config { action_horizon: 2, hidden: vec![32, 32], ..Default::default() };
        let build = || Bc::new(&config, &signature, 1, &Backend::CPU);
        let losses = losses_of_training(build, &batch(&signature, 2, 8, 0), (80, 3e-3));
        assert!(losses[79].loss < 0.2 * losses[0].loss, "{losses:?}");
    }

    #[test]
    fn impossible_configurations_name_the_field() {
        let error = |config: Config| Bc::new(&config, &signatures().plain, 0, &Backend::CPU).unwrap_err().to_string();
        assert!(error(Config { action_horizon: 0, ..Default::default() }).contains("action_horizon"));
        assert!(error(Config { hidden: vec![8, 0], ..Default::default() }).contains("hidden"));
    }
}
