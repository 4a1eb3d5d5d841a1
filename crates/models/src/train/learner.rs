//! One optimiser step on any scalar loss: what puzzles and reinforcement learning train with.
//!
//! `Trainer` owns a policy model and cuts its batches; here the caller makes the loss, and the rest is the same core.

use super::config::TrainConfig;
use super::core::{Core, Double};
use candle_core::{Tensor, Var};
use nn::Gradients;
use nn::Params;
use nn::Result;
use std::collections::BTreeMap;

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

/// Trains a set of parameters.
#[derive(Debug)]
pub struct Learner {
    core: Core<Double>,
    gradients: Gradients,
}

impl Learner {
    /// Trains `params`, which share their storage with the model's. `config.accumulation` is the
    /// caller's business and ignored.
    ///
    /// # Errors
    /// A configuration out of range.
    pub fn new(params: &Params, config: TrainConfig) -> Result<Self> {
        let core = Core::new(params, config)?;
        Ok(Self { gradients: Gradients::zeros(core.layout().clone())?, core })
    }

    /// Steps taken.
    pub fn step_count(&self) -> u64 {
        self.core.steps()
    }

    /// How it trains.
    pub fn config(&self) -> &TrainConfig {
        self.core.config()
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
    pub fn step_with(&mut self, loss: &Tensor, other: Option<&Var>) -> Result<(LearnerMetrics, Option<Tensor>)> {
        let value = loss.to_dtype(candle_core::DType::F32)?.to_scalar::<f32>()?;
        if !value.is_finite() {
            return Err(self.core.not_finite("loss".into(), value));
        }
        let grads = loss.backward()?;
        self.gradients.clear()?;
        self.gradients.add_graph(self.core.params(), &grads)?;
        let norm = self.gradients.norm()?;
        let grad_norm = norm.read()?;
        if !grad_norm.is_finite() {
            let fault = self.core.gradient_at_fault(&self.gradients)?;
            return Err(fault.unwrap_or_else(|| self.core.not_finite("gradient norm".into(), grad_norm as f32)));
        }
        let lr = self.core.step(&self.gradients, &norm)?;
        let other = other.and_then(|var| grads.get(var).cloned());
        Ok((LearnerMetrics { loss: value, grad_norm, lr }, other))
    }

    /// The weights to evaluate: the moving average if there is one. Copies.
    ///
    /// # Errors
    /// When a tensor operation fails.
    pub fn eval_params(&self) -> Result<BTreeMap<String, Tensor>> {
        self.core.eval_params()
    }

    /// Everything needed to go on later, copied: `param.<name>`, `moment1.<name>`,
    /// `moment2.<name>` and, with a moving average, `ema.<name>`; and the number of steps.
    ///
    /// # Errors
    /// When a tensor operation fails.
    pub fn state(&self) -> Result<(BTreeMap<String, Tensor>, u64)> {
        Ok((self.core.state()?, self.step_count()))
    }

    /// Goes on from [`Self::state`].
    ///
    /// # Errors
    /// A tensor that is missing or misshapen; nothing is changed then.
    pub fn restore(&mut self, tensors: &BTreeMap<String, Tensor>, step: u64) -> Result<()> {
        self.core.restore(tensors, step)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use nn::Backend;
    use nn::Init;
    use nn::Rng;

    fn parameters() -> Params {
        let mut params = Params::new(&Backend::CPU);
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
