//! One optimiser step on any scalar loss: what puzzles and reinforcement learning train with.
//!
//! `Trainer` owns a policy model and cuts its batches; here the caller makes the loss, and the rest
//! is the same: clipping, schedule, optimiser, moving average, and a state that can be saved.

use crate::error::{ModelError, Result};
use crate::gradients::{Gradients, ParamLayout};
use crate::optim::{Optimiser, flat};
use crate::params::Params;
use crate::simd::sum_of_squares;
use crate::train::TrainConfig;
use candle_core::{Tensor, Var};
use std::collections::BTreeMap;
use std::sync::Arc;

/// What a step measured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LearnerMetrics {
    /// Loss before the update.
    pub loss: f32,
    /// Global norm of the gradient before clipping.
    pub grad_norm: f64,
    /// Learning rate of this step.
    pub lr: f64,
}

/// Optimiser and moving average of a set of parameters.
#[derive(Debug)]
pub struct Learner {
    params: Params,
    config: TrainConfig,
    optimiser: Optimiser,
    gradients: Gradients,
    ema: Option<BTreeMap<String, Vec<f32>>>,
}

impl Learner {
    /// Trains `params`, which share their storage with the model's. `config.accumulation` is the
    /// caller's business and ignored.
    ///
    /// # Errors
    /// A configuration out of range.
    pub fn new(params: &Params, config: TrainConfig) -> Result<Self> {
        config.validate()?;
        let layout = Arc::new(ParamLayout::new(params));
        let ema = match config.ema_decay {
            Some(_) => Some(values(params)?),
            None => None,
        };
        Ok(Self {
            optimiser: Optimiser::new(config.optimiser, layout.clone()),
            gradients: Gradients::zeros(layout),
            params: params.clone(),
            config,
            ema,
        })
    }

    /// Steps taken.
    pub fn step_count(&self) -> u64 {
        self.optimiser.steps()
    }

    /// How it trains.
    pub fn config(&self) -> &TrainConfig {
        &self.config
    }

    /// One step down the gradient of `loss`. After an error the weights are those from before.
    ///
    /// # Errors
    /// `NotFinite` naming the step and the loss or the gradient at fault, `NoGradient` naming a
    /// parameter that the loss does not reach.
    pub fn step(&mut self, loss: &Tensor) -> Result<LearnerMetrics> {
        Ok(self.step_with(loss, None)?.0)
    }

    /// [`Self::step`] that also returns the gradient of a variable which it does not train.
    pub(crate) fn step_with(&mut self, loss: &Tensor, other: Option<&Var>) -> Result<(LearnerMetrics, Option<Tensor>)> {
        let step = self.step_count();
        let value = loss.to_dtype(candle_core::DType::F32)?.to_scalar::<f32>()?;
        let not_finite = |tensor: String, value: f32| ModelError::NotFinite { step: step + 1, tensor, value };
        if !value.is_finite() {
            return Err(not_finite("loss".into(), value));
        }
        let grads = loss.backward()?;
        self.gradients.clear();
        for (name, var) in self.params.iter() {
            let grad = grads.get(var).ok_or_else(|| ModelError::NoGradient { name: name.to_string() })?;
            self.gradients.add_tensor(name, grad)?;
        }
        let grad_norm = sum_of_squares(self.gradients.values()).sqrt();
        if !grad_norm.is_finite() {
            for (name, span) in self.gradients.layout().iter() {
                if let Some(&value) = self.gradients.values()[span].iter().find(|x| !x.is_finite()) {
                    return Err(not_finite(format!("gradient of {name}"), value));
                }
            }
            return Err(not_finite("gradient norm".into(), grad_norm as f32));
        }
        let lr = self.config.lr_at(step);
        let clip = self.config.clip_norm;
        let scale = if clip > 0.0 { (clip / (grad_norm + 1e-6)).min(1.0) } else { 1.0 };
        self.optimiser.step(&self.params, &self.gradients, scale as f32, lr)?;
        if let (Some(ema), Some(decay)) = (&mut self.ema, self.config.ema_decay) {
            for (name, now) in values(&self.params)? {
                let mean = ema.get_mut(&name).expect("the moving average has every parameter");
                for (mean, now) in mean.iter_mut().zip(now) {
                    *mean = (f64::from(*mean) * decay + f64::from(now) * (1.0 - decay)) as f32;
                }
            }
        }
        let other = other.and_then(|var| grads.get(var).cloned());
        Ok((LearnerMetrics { loss: value, grad_norm, lr }, other))
    }

    /// The weights to evaluate: the moving average if there is one. Copies.
    ///
    /// # Errors
    /// When a tensor operation fails.
    pub fn eval_params(&self) -> Result<BTreeMap<String, Tensor>> {
        let mut tensors = BTreeMap::new();
        for (name, var) in self.params.iter() {
            let tensor = match &self.ema {
                Some(ema) => Tensor::from_slice(&ema[name], var.dims(), var.device())?,
                None => var.as_detached_tensor().copy()?,
            };
            tensors.insert(name.to_string(), tensor);
        }
        Ok(tensors)
    }

    /// Everything needed to go on later, copied: `param.<name>`, `moment1.<name>`,
    /// `moment2.<name>` and, with a moving average, `ema.<name>`; and the number of steps.
    ///
    /// # Errors
    /// When a tensor operation fails.
    pub fn state(&self) -> Result<(BTreeMap<String, Tensor>, u64)> {
        let mut tensors = self.optimiser.state(&self.params)?;
        for (name, var) in self.params.iter() {
            tensors.insert(format!("param.{name}"), var.as_detached_tensor().copy()?);
        }
        if self.ema.is_some() {
            for (name, tensor) in self.eval_params()? {
                tensors.insert(format!("ema.{name}"), tensor);
            }
        }
        Ok((tensors, self.step_count()))
    }

    /// Goes on from [`Self::state`].
    ///
    /// # Errors
    /// A tensor that is missing or misshapen; nothing is changed then.
    pub fn restore(&mut self, tensors: &BTreeMap<String, Tensor>, step: u64) -> Result<()> {
        let layout = self.gradients.layout().clone();
        flat(&layout, "moment1", tensors)?;
        flat(&layout, "moment2", tensors)?;
        let ema = match self.ema {
            None => None,
            Some(_) => {
                let all = flat(&layout, "ema", tensors)?;
                Some(layout.iter().map(|(name, span)| (name.to_string(), all[span].to_vec())).collect())
            }
        };
        let with_prefix = |(name, tensor): (&String, &Tensor)| {
            let name = name.strip_prefix("param.")?;
            Some((name.to_string(), tensor.clone()))
        };
        self.params.load(&tensors.iter().filter_map(with_prefix).collect())?;
        self.optimiser.restore(tensors, step)?;
        self.ema = ema;
        Ok(())
    }
}

/// All parameters as numbers.
fn values(params: &Params) -> Result<BTreeMap<String, Vec<f32>>> {
    params
        .iter()
        .map(|(name, var)| Ok((name.to_string(), var.as_detached_tensor().flatten_all()?.to_vec1::<f32>()?)))
        .collect()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::params::Init;
    use crate::rng::Rng;

    fn parameters() -> Params {
        let mut params = Params::new();
        params.create("a", &[3], Init::Normal { std: 1.0 }, &mut Rng::new(1, "a")).unwrap();
        params
    }

    fn loss(params: &Params) -> Tensor {
        params.get("a").unwrap().as_tensor().sqr().unwrap().sum_all().unwrap()
    }

    fn config() -> TrainConfig {
        TrainConfig { steps: 20, lr: 0.1, warmup_steps: 2, ema_decay: Some(0.5), ..TrainConfig::default() }
    }

    #[test]
    fn a_restored_learner_goes_on_with_the_same_bits() {
        let params = parameters();
        let mut learner = Learner::new(&params, config()).unwrap();
        let first = learner.step(&loss(&params)).unwrap().loss;
        for _ in 0..4 {
            learner.step(&loss(&params)).unwrap();
        }
        let (saved, step) = learner.state().unwrap();
        let go_on = |learner: &mut Learner, params: &Params| {
            for _ in 0..5 {
                learner.step(&loss(params)).unwrap();
            }
            learner.eval_params().unwrap()["a"].to_vec1::<f32>().unwrap()
        };
        let expected = go_on(&mut learner, &params);
        let other = parameters();
        let mut again = Learner::new(&other, config()).unwrap();
        again.restore(&saved, step).unwrap();
        assert_eq!(go_on(&mut again, &other), expected);
        assert!(loss(&other).to_scalar::<f32>().unwrap() < first);
    }

    #[test]
    fn what_is_not_finite_or_not_reached_is_named() {
        let params = parameters();
        let mut learner = Learner::new(&params, config()).unwrap();
        let error = learner.step(&(loss(&params) / 0.0).unwrap()).unwrap_err().to_string();
        assert!(error.contains("loss is not finite"), "{error}");
        let elsewhere = parameters();
        let error = learner.step(&loss(&elsewhere)).unwrap_err().to_string();
        assert!(error.contains("parameter a got no gradient"), "{error}");
    }
}
