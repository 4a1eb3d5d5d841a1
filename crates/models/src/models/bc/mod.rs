//! BC, behaviour cloning with a multi-layer perceptron: the floor that every other policy has to rise above.
//!
//! Reference: robomimic's `BC` on low-dimensional observations (`algo/bc.py`, `config/bc_config.py`, Mandlekar et al.,
//! arXiv 2108.03298): dense layers of 1024 and 1024 with ReLU over the joined observation, squared error.
//!
//! Deviations: actions may be predicted as a chunk; robomimic predicts one. Its outputs go through `tanh`, because its
//! actions lie in -1 to 1; ours are normalised and do not. Its history goes through an LSTM (`BC-RNN`); here the steps of a
//! history lie side by side. Pictures become the cells of `[policy.vision]`'s feature map behind the numbers (robomimic:
//! keypoints).

mod config;
mod fused;

pub use config::{Config, Loss};

use crate::batch::Batch;
use crate::checks::{check_batch, check_observation};
use crate::chunk_policy::ChunkPolicy;
use crate::encoders::VisionConfig;
use crate::features::{FeatureKind, Features, Signature};
use crate::fused::Workspaces;
use crate::layers::{Linear, Sight};
use crate::model::PolicyModel;
use crate::policy::{Clock, Policy};
use crate::preprocess::Preprocess;
use candle_core::Tensor;
use nn::Gradients;
use nn::Params;
use nn::Result;
use nn::Rng;
use nn::losses::absolute;
use nn::{LossParts, LossValues};
use std::collections::BTreeMap;
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
    sight: Option<Sight>,
    hidden: Vec<Linear>,
    action_head: Linear,
    workspaces: Workspaces,
}

impl Bc {
    /// Initial weights are torch's defaults.
    ///
    /// # Errors
    /// A configuration or a signature that describes no possible model.
    pub fn new(config: &Config, signature: &Signature, seed: u64) -> Result<Self> {
        config.validate()?;
        signature.check("bc", READS)?;
        let rng = &mut Rng::new(seed, "init");
        let mut p = Params::new();
        let sight = Sight::new(&mut p, signature, config.vision.as_ref(), rng)?;
        let numbers = signature.observation.iter().filter(|spec| spec.kind != FeatureKind::Image);
        let numbers: usize = numbers.map(|spec| spec.width() * signature.n_obs_steps).sum();
        let mut width = numbers + sight.as_ref().map_or(0, Sight::width);
        let mut hidden = Vec::with_capacity(config.hidden.len());
        for (i, &next) in config.hidden.iter().enumerate() {
            hidden.push(Linear::new(&mut p, &format!("hidden.{i}"), width, next, rng)?);
            width = next;
        }
        let action_head = Linear::new(&mut p, "action_head", width, config.action_horizon * signature.action_dim, rng)?;
        let (config, signature, workspaces) = (config.clone(), signature.clone(), Workspaces::default());
        Ok(Self { config, signature, params: p, sight, hidden, action_head, workspaces })
    }

    /// The signature's features that are numbers, (b, …) each -> (b, all of them)
    fn numbers(&self, rows: usize, observation: &Features<Tensor>) -> Result<Tensor> {
        let mut joined = Vec::with_capacity(self.signature.observation.len());
        for spec in self.signature.observation.iter().filter(|spec| spec.kind != FeatureKind::Image) {
            joined.push(observation.require("bc", &spec.name)?.reshape((rows, ()))?);
        }
        Ok(Tensor::cat(&joined, 1)?)
    }

    /// The signature's features, (b, …) each -> (b, H, A)
    fn forward(&self, rows: usize, observation: &Features<Tensor>) -> Result<Tensor> {
        let mut x = self.numbers(rows, observation)?;
        if let Some(sight) = &self.sight {
            x = Tensor::cat(&[x, sight.forward(&sight.look(observation, None)?)?], 1)?;
        }
        for layer in &self.hidden {
            x = layer.forward(&x)?.relu()?;
        }
        let shape = (rows, self.config.action_horizon, self.signature.action_dim);
        Ok(self.action_head.forward(&x)?.reshape(shape)?)
    }

    /// The batch with pictures as the network reads them in training.
    fn looked_at(&self, batch: &Batch, rng: &mut Rng) -> Result<Batch> {
        check_batch("bc", &self.signature, self.config.action_horizon, batch)?;
        let observation = match &self.sight {
            Some(sight) => sight.look(&batch.observation, Some(rng))?,
            None => batch.observation.clone(),
        };
        Ok(Batch { observation, ..batch.clone() })
    }
}

impl PolicyModel for Bc {
    fn params(&self) -> &Params {
        &self.params
    }

    fn signature(&self) -> &Signature {
        &self.signature
    }

    fn composed_because(&self) -> Option<String> {
        None
    }

    fn accumulate_gradients(&self, batch: &Batch, rng: &mut Rng, into: &mut Gradients) -> Result<LossValues> {
        self.fused_gradients(&self.looked_at(batch, rng)?, into)
    }

    fn loss(&self, batch: &Batch, rng: &mut Rng) -> Result<LossParts> {
        let batch = &self.looked_at(batch, rng)?;
        let difference = (self.forward(batch.rows(), &batch.observation)? - &batch.actions)?;
        let valid = (1.0 - batch.is_pad.unsqueeze(2)?)?;
        let entries = (batch.total_valid_steps * self.signature.action_dim).max(1) as f64;
        let mean = |error: Tensor| -> Result<Tensor> { Ok((error.broadcast_mul(&valid)?.sum_all()? / entries)?) };
        let l1 = mean(absolute(&difference)?)?;
        // L1 in any case: it is what other policies report
        let mut parts = BTreeMap::from([("l1_loss".to_string(), l1.detach())]);
        let total = match self.config.loss {
            Loss::L1 => l1,
            Loss::L2 => {
                let l2 = mean(difference.sqr()?)?;
                parts.insert("l2_loss".to_string(), l2.detach());
                l2
            }
        };
        Ok(LossParts { total, parts })
    }

    fn predict(&self, observation: &Features<Tensor>) -> Result<Tensor> {
        self.sample_seen(observation, &mut Rng::new(0, "predict"), &mut || {})
    }

    /// Nothing is drawn.
    fn sample_seen(&self, observation: &Features<Tensor>, _rng: &mut Rng, on_seen: &mut dyn FnMut()) -> Result<Tensor> {
        let rows = check_observation("bc", &self.signature, observation)?;
        match &self.sight {
            Some(sight) => self.fused_predict(sight, rows, observation, on_seen),
            None => Ok(self.forward(rows, observation)?.detach()),
        }
    }

    fn policy(self: Arc<Self>, preprocess: Arc<Preprocess>, clock: Box<dyn Clock>) -> Box<dyn Policy> {
        Box::new(ChunkPolicy::new(self, preprocess).with_clock(clock))
    }

    fn vision(&self) -> Option<&VisionConfig> {
        self.sight.as_ref().map(Sight::config)
    }

    fn action_horizon(&self) -> usize {
        self.config.action_horizon
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::fused::testing::{
        assert_the_gradient_is_the_slope, assert_the_step_is_the_composed_one, batch, eyes, move_parameters, signatures,
    };
    use crate::train::{TrainConfig, Trainer};

    fn configs() -> Vec<Config> {
        [(Loss::L2, vec![11, 7]), (Loss::L1, vec![9]), (Loss::L2, vec![])]
            .map(|(loss, hidden)| Config { action_horizon: 3, hidden, loss, vision: None })
            .into()
    }

    #[test]
    fn the_step_by_hand_is_the_composed_one() {
        let of = signatures();
        for signature in [&of.plain, &of.entities, &of.history] {
            for config in configs() {
                let model = Bc::new(&config, signature, 1).unwrap();
                move_parameters(&model);
                let batch = batch(signature, config.action_horizon, 7, 3);
                assert_the_step_is_the_composed_one(&model, &batch, &format!("{config:?}"));
            }
        }
    }

    #[test]
    fn from_pictures_step_and_prediction_are_the_composed_ones() {
        let of = signatures();
        for signature in [&of.pictures, &of.film] {
            for config in configs() {
                let model = Bc::new(&Config { vision: Some(eyes()), ..config }, signature, 1).unwrap();
                move_parameters(&model);
                let batch = batch(signature, 3, 3, 3);
                assert_the_step_is_the_composed_one(&model, &batch, &format!("{:?}", model.config));
                let (want, mut seen) = (model.forward(3, &batch.observation).unwrap(), 0);
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
                let model = Bc::new(&config, signature, 1).unwrap();
                let batch = batch(signature, config.action_horizon, 4, 3);
                assert_the_gradient_is_the_slope(&model, &batch, &format!("{config:?}"));
            }
        }
    }

    #[test]
    fn the_loss_is_the_mean_over_steps_that_are_not_padding() {
        let signature = signatures().plain;
        for config in configs() {
            let model = Bc::new(&config, &signature, 1).unwrap();
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
        let run = || {
            let config = Config { action_horizon: 2, hidden: vec![32, 32], ..Default::default() };
            let model = Box::new(Bc::new(&config, &signature, 1).unwrap());
            let settings = TrainConfig { steps: 80, lr: 3e-3, warmup_steps: 3, ..Default::default() };
            let mut trainer = Trainer::new(model, settings, 5).unwrap();
            let batch = batch(&signature, 2, 8, 0);
            let losses: Vec<f32> = (0..80).map(|_| trainer.step(&batch).unwrap().loss).collect();
            (losses[0], losses[79])
        };
        let (first, last) = run();
        assert!(last < 0.2 * first, "{first} {last}");
        assert_eq!(run(), (first, last));
    }

    #[test]
    fn impossible_configurations_name_the_field() {
        let error = |config: Config| Bc::new(&config, &signatures().plain, 0).unwrap_err().to_string();
        assert!(error(Config { action_horizon: 0, ..Default::default() }).contains("action_horizon"));
        assert!(error(Config { hidden: vec![8, 0], ..Default::default() }).contains("hidden"));
    }
}
