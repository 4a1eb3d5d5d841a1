//! What a step is once its gradient is there: clipping, learning rate, optimiser, moving average; and the state that all
//! this goes on from, to the bit.

use super::config::TrainConfig;
use candle_core::Tensor;
use nn::simd::vectorised;
use nn::values::with_values;
use nn::{Gradients, ModelError, Number, Optimiser, ParamLayout, Params, PerParameter, Result};
use std::collections::BTreeMap;
use std::marker::PhantomData;
use std::sync::Arc;

/// In which precision the moving average is computed; it is kept in f32 either way. Part of what defines a training:
/// policies have always averaged in f32 and puzzles in f64, and each goes on as it was.
pub(super) trait Precision {
    /// `mean = mean * decay + now * (1 - decay)`
    fn blend(decay: f64, mean: &mut [f32], now: &[f32]);
}

/// In f32.
#[derive(Debug)]
pub(super) struct Single;

/// In f64.
#[derive(Debug)]
pub(super) struct Double;

impl Precision for Single {
    fn blend(decay: f64, mean: &mut [f32], now: &[f32]) {
        let (keep, take) = (decay as f32, (1.0 - decay) as f32);
        vectorised(
            #[inline(always)]
            || mean.iter_mut().zip(now).for_each(|(e, p)| *e = *e * keep + p * take),
        );
    }
}

impl Precision for Double {
    fn blend(decay: f64, mean: &mut [f32], now: &[f32]) {
        for (mean, now) in mean.iter_mut().zip(now) {
            *mean = (f64::from(*mean) * decay + f64::from(*now) * (1.0 - decay)) as f32;
        }
    }
}

/// Optimiser and moving average of a set of parameters.
#[derive(Debug)]
pub(super) struct Core<P> {
    params: Params,
    config: TrainConfig,
    layout: Arc<ParamLayout>,
    optimiser: Optimiser,
    ema: Option<PerParameter>,
    precision: PhantomData<P>,
}

impl<P: Precision> Core<P> {
    /// Trains `params`, which share their storage with the model's.
    pub(super) fn new(params: &Params, config: TrainConfig) -> Result<Self> {
        config.validate()?;
        let layout = Arc::new(ParamLayout::new(params));
        let ema = config.ema_decay.map(|_| PerParameter::copy_of(params, &layout)).transpose()?;
        let optimiser = Optimiser::new(config.optimiser, layout.clone())?;
        Ok(Self { params: params.clone(), config, layout, optimiser, ema, precision: PhantomData })
    }

    pub(super) fn config(&self) -> &TrainConfig {
        &self.config
    }

    pub(super) fn params(&self) -> &Params {
        &self.params
    }

    pub(super) fn layout(&self) -> &Arc<ParamLayout> {
        &self.layout
    }

    pub(super) fn set_threads(&mut self, threads: usize) {
        self.optimiser.set_threads(threads);
    }

    /// Steps taken.
    pub(super) fn steps(&self) -> u64 {
        self.optimiser.steps()
    }

    /// One step down `gradients`, whose global norm is `grad_norm`; returns its learning rate.
    pub(super) fn step(&mut self, gradients: &Gradients, norm: &Number) -> Result<f64> {
        let lr = self.config.lr_at(self.steps());
        let clip = self.config.clip_norm;
        // torch.nn.utils.clip_grad_norm_'s factor
        let scale = match norm {
            _ if clip <= 0.0 => Number::Here(1.0),
            Number::Here(norm) => Number::Here((clip / (norm + 1e-6)).min(1.0)),
            Number::There(norm) => Number::There(((norm + 1e-6)?.recip()? * clip)?.minimum(1.0)?),
        };
        self.optimiser.step(&self.params, gradients, &scale, lr)?;
        match (&mut self.ema, self.config.ema_decay) {
            (Some(PerParameter::Flat(ema)), Some(decay)) => {
                let mut rest = ema.as_mut_slice();
                for (_, var) in self.params.iter() {
                    let (mean, tail) = rest.split_at_mut(var.elem_count());
                    rest = tail;
                    with_values(var.as_tensor(), |now| P::blend(decay, mean, now))?;
                }
            }
            (Some(PerParameter::Tensor(ema)), Some(decay)) => {
                let now = self.optimiser.values(&self.params)?;
                *ema = ((&*ema * decay)? + (now * (1.0 - decay))?)?;
            }
            _ => {}
        }
        Ok(lr)
    }

    /// Says which tensor is not finite, in the step that would come next.
    pub(super) fn not_finite(&self, tensor: String, value: f32) -> ModelError {
        ModelError::NotFinite { step: self.steps() + 1, tensor, value }
    }

    /// The first parameter whose gradient is not finite, as an error.
    pub(super) fn gradient_at_fault(&self, gradients: &Gradients) -> Result<Option<ModelError>> {
        let found = gradients.not_finite()?;
        Ok(found.map(|(name, value)| self.not_finite(format!("gradient of {name}"), value)))
    }

    /// The weights to evaluate: the moving average if there is one. Copies.
    pub(super) fn eval_params(&self) -> Result<BTreeMap<String, Tensor>> {
        let averaged = match &self.ema {
            Some(ema) => ema.named(&self.params, &self.layout)?,
            None => Vec::new(),
        };
        let mut tensors: BTreeMap<_, _> =
            averaged.into_iter().map(|(name, tensor)| (name.to_string(), tensor)).collect();
        for (name, var) in self.params.all() {
            if !tensors.contains_key(name) {
                tensors.insert(name.to_string(), var.as_detached_tensor().copy()?);
            }
        }
        tensors.extend(self.params.tables());
        Ok(tensors)
    }

    /// What the names of the state's tensors begin with.
    pub(super) fn prefixes(&self) -> Vec<&'static str> {
        let mut prefixes = vec!["param.", "moment1.", "moment2."];
        if self.ema.is_some() {
            prefixes.push("ema.");
        }
        prefixes
    }

    /// Everything needed to go on later beside the number of steps, copied: `param.<name>`, `moment1.<name>`,
    /// `moment2.<name>` and, with a moving average, `ema.<name>`.
    pub(super) fn state(&self) -> Result<BTreeMap<String, Tensor>> {
        let mut tensors = self.optimiser.state(&self.params)?;
        for (name, var) in self.params.all() {
            tensors.insert(format!("param.{name}"), var.as_detached_tensor().copy()?);
        }
        tensors.extend(self.params.tables().into_iter().map(|(name, rows)| (format!("param.{name}"), rows)));
        if self.ema.is_some() {
            for (name, tensor) in self.eval_params()? {
                tensors.insert(format!("ema.{name}"), tensor);
            }
        }
        Ok(tensors)
    }

    /// Goes on from [`Self::state`] after `steps` steps. Nothing is changed unless everything fits.
    pub(super) fn restore(&mut self, tensors: &BTreeMap<String, Tensor>, steps: u64) -> Result<()> {
        // all checks come before the first change
        let ema = self.ema.as_ref().map(|_| PerParameter::restored(&self.params, &self.layout, "ema", tensors));
        let (ema, moments) = (ema.transpose()?, self.optimiser.saved(&self.params, tensors)?);
        let with_prefix = |(name, tensor): (&String, &Tensor)| {
            let name = name.strip_prefix("param.")?;
            Some((name.to_string(), tensor.clone()))
        };
        self.params.load(&tensors.iter().filter_map(with_prefix).collect())?;
        self.optimiser.restore(moments, steps);
        self.ema = ema;
        Ok(())
    }
}
