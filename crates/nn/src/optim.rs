//! Optimisers whose state can be saved.

use crate::error::{ModelError, Result};
use crate::gradients::{Gradients, ParamLayout};
use crate::number::Number;
use crate::params::Params;
use crate::per_parameter::{PerParameter, joined};
use crate::simd::vectorised;
use candle_core::{CpuStorage, InplaceOp1, Layout, Tensor, Var};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

/// Which optimiser, without its learning rate.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub enum OptimiserConfig {
    /// Loshchilov and Hutter, arXiv 1711.05101, as `torch.optim.AdamW`
    AdamW {
        /// decay of the first moment
        beta1: f64,
        /// decay of the second moment
        beta2: f64,
        /// added to the root of the second moment
        eps: f64,
        /// decoupled; every parameter decays
        weight_decay: f64,
    },
    /// Everett et al., arXiv 2407.05872: `lr * atan2(m, sqrt(v))` instead of a quotient with eps, as the official TRM
    AdamAtan2 {
        /// decay of the first moment
        beta1: f64,
        /// decay of the second moment
        beta2: f64,
        /// decoupled; every parameter decays
        weight_decay: f64,
    },
}

impl Default for OptimiserConfig {
    /// LeRobot's for ACT.
    fn default() -> Self {
        Self::AdamW { beta1: 0.9, beta2: 0.999, eps: 1e-8, weight_decay: 1e-4 }
    }
}

/// An optimiser and its moments.
#[derive(Debug)]
pub struct Optimiser {
    config: OptimiserConfig,
    layout: Arc<ParamLayout>,
    moments: [PerParameter; 2],
    step: u64,
    threads: usize,
    /// the parameters one after the other, and their version, where operations are candle's
    values: Option<(Tensor, u64)>,
    /// the parameters' rates where operations are candle's, once a step has asked for them; `None` inside: all are 1
    rates: Option<Option<Tensor>>,
}

/// One step's constants.
#[derive(Debug, Clone, Copy)]
struct Update {
    config: OptimiserConfig,
    lr: f64,
    grad_scale: f32,
    /// 1 - beta^t of both moments
    corrections: (f64, f64),
}

impl OptimiserConfig {
    fn betas(self) -> [f64; 2] {
        match self {
            Self::AdamW { beta1, beta2, .. } | Self::AdamAtan2 { beta1, beta2, .. } => [beta1, beta2],
        }
    }
}

/// `atan2(y, x)` for x from 0 on, of candle's operations: four times the angle of a quarter, by its series.
fn atan2(y: &Tensor, x: &Tensor) -> candle_core::Result<Tensor> {
    let scale = (y.abs()?.maximum(x)? + 1e-30)?;
    let (y, x) = ((y / &scale)?, (x / &scale)?);
    let half = (&y / ((&x + (x.sqr()? + y.sqr()?)?.sqrt()?)? + 1e-30)?)?;
    let quarter = (&half / ((half.sqr()? + 1.0)?.sqrt()? + 1.0)?)?;
    let square = quarter.sqr()?;
    let mut series = square.zeros_like()?;
    for k in (0..10).rev() {
        let term = if k % 2 == 0 { 1.0 } else { -1.0 } / f64::from(2 * k + 1);
        series = ((series * &square)? + term)?;
    }
    (series * quarter)? * 4.0
}

impl Update {
    /// The same on candle's operations, of all parameters at once; `rates` are relative to the learning rate.
    fn composed(
        &self,
        values: &Tensor,
        grads: &Tensor,
        [first, second]: [&mut Tensor; 2],
        rates: Option<&Tensor>,
    ) -> Result<Tensor> {
        let [beta1, beta2] = self.config.betas();
        *first = ((&*first * beta1)? + (grads * (1.0 - beta1))?)?;
        *second = ((&*second * beta2)? + (grads.sqr()? * (1.0 - beta2))?)?;
        let m = (&*first / self.corrections.0)?;
        let root = (&*second / self.corrections.1)?.sqrt()?;
        let (direction, weight_decay) = match self.config {
            OptimiserConfig::AdamW { eps, weight_decay, .. } => ((m / (root + eps)?)?, weight_decay),
            OptimiserConfig::AdamAtan2 { weight_decay, .. } => (atan2(&m, &root)?, weight_decay),
        };
        Ok(match rates {
            None => ((values * (1.0 - self.lr * weight_decay))? - (direction * self.lr)?)?,
            Some(rates) => {
                let rates = (rates * self.lr)?;
                let kept = (1.0 - (&rates * weight_decay)?)?;
                (values.mul(&kept)? - direction.mul(&rates)?)?
            }
        })
    }

    /// Elementwise, so the order does not matter.
    fn apply(&self, params: &mut [f32], grads: &[f32], first: &mut [f32], second: &mut [f32]) {
        let (c1, c2) = (self.corrections.0, self.corrections.1);
        let s = self.grad_scale;
        let rows = params.iter_mut().zip(grads).zip(first.iter_mut().zip(second.iter_mut()));
        match self.config {
            OptimiserConfig::AdamW { beta1, beta2, eps, weight_decay } => {
                let decay = (1.0 - self.lr * weight_decay) as f32;
                let (b1, b2, eps) = (beta1 as f32, beta2 as f32, eps as f32);
                let (n1, n2) = ((1.0 - beta1) as f32, (1.0 - beta2) as f32);
                let (rate, root) = ((self.lr / c1) as f32, (1.0 / c2.sqrt()) as f32);
                vectorised(
                    #[inline(always)]
                    || {
                        for ((p, g), (m, v)) in rows {
                            let g = g * s;
                            *m = *m * b1 + g * n1;
                            *v = *v * b2 + g * g * n2;
                            *p = *p * decay - rate * *m / (v.sqrt() * root + eps);
                        }
                    },
                );
            }
            OptimiserConfig::AdamAtan2 { beta1, beta2, weight_decay } => {
                let decay = (1.0 - self.lr * weight_decay) as f32;
                let (b1, b2) = (beta1 as f32, beta2 as f32);
                let (n1, n2) = ((1.0 - beta1) as f32, (1.0 - beta2) as f32);
                let (k1, k2, lr) = ((1.0 / c1) as f32, (1.0 / c2) as f32, self.lr as f32);
                for ((p, g), (m, v)) in rows {
                    let g = g * s;
                    *m = *m * b1 + g * n1;
                    *v = *v * b2 + g * g * n2;
                    *p = *p * decay - lr * (*m * k1).atan2((*v * k2).sqrt());
                }
            }
        }
    }
}

/// One parameter with its slices; candle hands out the storage for the time of the call.
struct InPlace<'a> {
    update: Update,
    grads: &'a [f32],
    moments: Mutex<(&'a mut [f32], &'a mut [f32])>,
}

impl InplaceOp1 for InPlace<'_> {
    fn name(&self) -> &'static str {
        "optimiser-step"
    }

    fn cpu_fwd(&self, storage: &mut CpuStorage, layout: &Layout) -> candle_core::Result<()> {
        let CpuStorage::F32(values) = storage else {
            candle_core::bail!("a parameter is not f32");
        };
        let values = match layout.contiguous_offsets() {
            Some((from, to)) => &mut values[from..to],
            None => candle_core::bail!("a parameter is not contiguous"),
        };
        let mut moments = self.moments.lock().unwrap_or_else(PoisonError::into_inner);
        let (first, second) = &mut *moments;
        self.update.apply(values, self.grads, first, second);
        Ok(())
    }
}

impl Optimiser {
    /// Moments at zero.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn new(config: OptimiserConfig, layout: Arc<ParamLayout>) -> Result<Self> {
        let moments = [PerParameter::zeros(&layout)?, PerParameter::zeros(&layout)?];
        Ok(Self { config, layout, moments, step: 0, threads: rayon::current_num_threads(), values: None, rates: None })
    }

    /// The parameters one after the other, (n), where operations are candle's.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn values(&mut self, params: &Params) -> Result<Tensor> {
        if let Some((values, version)) = &self.values
            && *version == params.version()
        {
            return Ok(values.clone());
        }
        let values = joined(params.iter().map(|(_, var)| var.as_detached_tensor()))?;
        self.values = Some((values.clone(), params.version()));
        Ok(values)
    }

    /// A step of [`Self::step`] on candle's operations.
    fn step_composed(&mut self, params: &Params, grads: &Tensor, grad_scale: &Number, update: Update) -> Result<()> {
        let grads = match grad_scale {
            Number::Here(scale) => (grads * *scale)?,
            Number::There(scale) => grads.broadcast_mul(scale)?,
        };
        if self.rates.is_none() {
            self.rates = Some(self.rates_of(params)?);
        }
        let rates = self.rates.clone().flatten();
        let values = self.values(params)?;
        let [PerParameter::Tensor(first), PerParameter::Tensor(second)] = &mut self.moments else {
            unreachable!("gradients and moments have the same layout")
        };
        let values = update.composed(&values, &grads, [first, second], rates.as_ref())?;
        for ((_, var), (_, span)) in params.iter().zip(self.layout.iter()) {
            var.set(&values.narrow(0, span.start, span.len())?.reshape(var.dims())?)?;
        }
        params.changed();
        self.values = Some((values, params.version()));
        Ok(())
    }

    /// The parameters' rates relative to the learning rate, (n), where they are not all 1.
    fn rates_of(&self, params: &Params) -> Result<Option<Tensor>> {
        if params.iter().all(|(name, _)| params.rate(name) == 1.0) {
            return Ok(None);
        }
        let each =
            params.iter().flat_map(|(name, var)| std::iter::repeat_n(params.rate(name) as f32, var.elem_count()));
        Ok(Some(Tensor::from_vec(each.collect::<Vec<_>>(), self.layout.len(), self.layout.device())?))
    }

    /// Steps taken.
    pub fn steps(&self) -> u64 {
        self.step
    }

    /// Runs on at most `threads` threads (unless set: as many as rayon has, at most two). The result is the same.
    pub fn set_threads(&mut self, threads: usize) {
        self.threads = threads.max(1);
    }

    /// One update of `params` with `grads * grad_scale`, each at its own rate relative to `lr`; in place.
    ///
    /// # Errors
    /// If `params` are not those of the layout.
    pub fn step(&mut self, params: &Params, grads: &Gradients, grad_scale: &Number, lr: f64) -> Result<()> {
        if **grads.layout() != *self.layout || params.iter().count() != self.layout.iter().count() {
            return Err(ModelError::State {
                object: "optimiser",
                detail: "parameters and gradients are not those that it was made for".to_string(),
            });
        }
        self.step += 1;
        let [beta1, beta2] = self.config.betas();
        let t = self.step as f64;
        let corrections = (1.0 - beta1.powf(t), 1.0 - beta2.powf(t));
        let update = Update { config: self.config, lr, grad_scale: 1.0, corrections };
        if let PerParameter::Tensor(grads) = grads.stored() {
            return self.step_composed(params, grads, grad_scale, update);
        }
        let update = Update { grad_scale: grad_scale.read()? as f32, ..update };
        let [PerParameter::Flat(first), PerParameter::Flat(second)] = &mut self.moments else {
            unreachable!("gradients and moments have the same layout")
        };
        let (mut first, mut second) = (first.as_mut_slice(), second.as_mut_slice());
        let mut work: Vec<(&Var, InPlace<'_>)> = Vec::new();
        for ((name, var), (_, span)) in params.iter().zip(self.layout.iter()) {
            let update = Update { lr: lr * params.rate(name), ..update };
            let (m, rest) = first.split_at_mut(span.len());
            first = rest;
            let (v, rest) = second.split_at_mut(span.len());
            second = rest;
            let grads = &grads.values()[span];
            work.push((var, InPlace { update, grads, moments: Mutex::new((m, v)) }));
        }
        let mut seen = 0;
        let half = self.layout.len() / 2;
        let cut = work.iter().take_while(|(var, _)| {
            seen += var.elem_count();
            seen <= half
        });
        let cut = cut.count();
        let (left, right) = work.split_at(cut);
        let run = |part: &[(&Var, InPlace<'_>)]| part.iter().try_for_each(|(var, op)| var.inplace_op1(op));
        let done = match self.threads {
            1 => run(left).and_then(|()| run(right)),
            _ => std::thread::scope(|scope| {
                let other = scope.spawn(|| run(right));
                let mine = run(left);
                mine.and(other.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
            }),
        };
        params.changed();
        Ok(done?)
    }

    /// Both moments as tensors named `moment1.<name>` and `moment2.<name>`.
    pub fn state(&self, params: &Params) -> Result<BTreeMap<String, Tensor>> {
        let mut tensors = BTreeMap::new();
        for (kind, values) in MOMENTS.into_iter().zip(&self.moments) {
            let named = values.named(params, &self.layout)?.into_iter();
            tensors.extend(named.map(|(name, tensor)| (format!("{kind}.{name}"), tensor)));
        }
        Ok(tensors)
    }

    /// Moments saved by `state`, for [`Self::restore`].
    ///
    /// # Errors
    /// A moment that is missing or of the wrong size.
    pub fn saved(&self, params: &Params, tensors: &BTreeMap<String, Tensor>) -> Result<[PerParameter; 2]> {
        let restored = |kind: &str| PerParameter::restored(params, &self.layout, kind, tensors);
        let [first, second] = MOMENTS;
        Ok([restored(first)?, restored(second)?])
    }

    /// Takes saved moments, after `step` steps.
    pub fn restore(&mut self, moments: [PerParameter; 2], step: u64) {
        (self.moments, self.step) = (moments, step);
    }
}

/// Prefixes of the moments' names.
const MOMENTS: [&str; 2] = ["moment1", "moment2"];

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::{Backend, Init, Rng};
    use candle_core::Device;

    fn three_steps(config: OptimiserConfig) -> Vec<f32> {
        let [fast, composed] = [Backend::CPU, Backend::composed(Device::Cpu)].map(|backend| steps_on(&backend, config));
        assert!(fast.iter().zip(&composed).all(|(a, b)| (a - b).abs() < 1e-6), "{fast:?} {composed:?}");
        fast
    }

    fn steps_on(backend: &Backend, config: OptimiserConfig) -> Vec<f32> {
        let mut params = Params::new(backend);
        let start = Tensor::new(&[1f32, -2.0, 0.5], &Device::Cpu).unwrap();
        params.insert("w", start.clone()).unwrap();
        params.insert("slow", start).unwrap();
        params.set_rate("slow", 0.1);
        let layout = Arc::new(ParamLayout::new(&params));
        let mut optimiser = Optimiser::new(config, layout.clone()).unwrap();
        let mut grads = Gradients::zeros(layout).unwrap();
        for k in 1..=3 {
            let grad = Tensor::new(&[0.1 * k as f32, -0.3, 2.0 / k as f32], &Device::Cpu).unwrap();
            let loss = params.iter().map(|(_, var)| var.mul(&grad).unwrap().sum_all().unwrap());
            let loss = loss.reduce(|a, b| (a + b).unwrap()).unwrap();
            grads.clear().unwrap();
            grads.add_graph(&params, &loss.backward().unwrap()).unwrap();
            optimiser.step(&params, &grads, &Number::Here(1.0), 0.01).unwrap();
        }
        let values = ["w", "slow"].map(|name| params.get(name).unwrap().to_vec1().unwrap());
        values.concat()
    }

    #[test]
    fn adamw_is_torchs() {
        let got = three_steps(OptimiserConfig::AdamW { beta1: 0.9, beta2: 0.999, eps: 1e-8, weight_decay: 0.1 });
        // torch.optim.AdamW(lr=0.01, weight_decay=0.1), the same three gradients
        let (mut p, mut m, mut v) = ([1f64, -2.0, 0.5], [0f64; 3], [0f64; 3]);
        for k in 1..=3 {
            let g = [0.1 * f64::from(k), -0.3, 2.0 / f64::from(k)];
            for i in 0..3 {
                p[i] *= 1.0 - 0.01 * 0.1;
                m[i] = 0.9 * m[i] + 0.1 * g[i];
                v[i] = 0.999 * v[i] + 0.001 * g[i] * g[i];
                let (mh, vh) = (m[i] / (1.0 - 0.9f64.powi(k)), v[i] / (1.0 - 0.999f64.powi(k)));
                p[i] -= 0.01 * mh / (vh.sqrt() + 1e-8);
            }
        }
        for (a, b) in got.iter().zip(p) {
            assert!((f64::from(*a) - b).abs() < 1e-6, "{a} {b}");
        }
    }

    #[test]
    fn adam_atan2_moves_by_the_angle() {
        let got = three_steps(OptimiserConfig::AdamAtan2 { beta1: 0.9, beta2: 0.95, weight_decay: 0.1 });
        // the first step moves by lr * pi/4 whatever the size of the gradient; constant gradients go on so
        let decayed = |p: f64| p * (1.0 - 0.01 * 0.1) + 0.01 * std::f64::consts::FRAC_PI_4;
        let expected = decayed(decayed(decayed(-2.0)));
        assert!((f64::from(got[1]) - expected).abs() < 1e-5, "{} {expected}", got[1]);
    }

    #[test]
    fn the_composed_angle_is_atan2() {
        let values = [0.0f32, 1e-30, 3e-12, 1e-3, 0.7, 1.0, 55.0, 1e20];
        for y in values.into_iter().flat_map(|y| [y, -y]) {
            let x = Tensor::new(&values, &Device::Cpu).unwrap();
            let got = atan2(&Tensor::full(y, values.len(), &Device::Cpu).unwrap(), &x).unwrap();
            for (got, x) in got.to_vec1::<f32>().unwrap().into_iter().zip(values) {
                assert!((got - y.atan2(x)).abs() < 1e-6 || y.abs() <= 1e-30, "atan2({y}, {x}): {got}");
            }
        }
    }

    #[test]
    fn a_restored_optimiser_goes_on_with_the_same_bits() {
        let mut rng = Rng::new(1, "test");
        let mut params = Params::new(&Backend::CPU);
        params.create("a", &[3, 5], Init::XavierUniform, &mut rng).unwrap();
        params.create("b", &[7], Init::Ones, &mut rng).unwrap();
        let layout = Arc::new(ParamLayout::new(&params));
        let mut grads = Gradients::zeros(layout.clone()).unwrap();
        let mut one = Optimiser::new(OptimiserConfig::default(), layout.clone()).unwrap();
        grads.values_mut().copy_from_slice(&rng.normals(22));
        one.step(&params, &grads, &Number::Here(0.5), 0.1).unwrap();
        let saved = one.state(&params).unwrap();
        let weights: BTreeMap<_, _> = params.tensors().iter().map(|(k, v)| (k.clone(), v.copy().unwrap())).collect();
        one.step(&params, &grads, &Number::Here(0.5), 0.1).unwrap();
        let expected = params.get("a").unwrap().to_vec2::<f32>().unwrap();
        params.load(&weights).unwrap();
        let mut two = Optimiser::new(OptimiserConfig::default(), layout).unwrap();
        two.restore(two.saved(&params, &saved).unwrap(), 1);
        two.step(&params, &grads, &Number::Here(0.5), 0.1).unwrap();
        assert_eq!(params.get("a").unwrap().to_vec2::<f32>().unwrap(), expected);
        assert!(two.saved(&params, &BTreeMap::new()).is_err());
    }
}
