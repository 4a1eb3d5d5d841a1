//! How much noise there is at each step, and the way back: diffusers' `DDPMScheduler` and `DDIMScheduler` as LeRobot makes
//! them, with betas of the squared cosine (Nichol and Dhariwal, arXiv 2102.09672), the DDPM of Ho et al. (arXiv 2006.11239,
//! `fixed_small` variance) and the DDIM of Song et al. (arXiv 2010.02502, eta 0), timesteps spaced `leading`.

use super::config::{Config, Prediction, Sampler};
use candle_core::Tensor;
use nn::Result;

/// The share of the actions' variance that is left at each step.
#[derive(Debug, Clone)]
pub struct NoiseSchedule {
    /// products of 1 - beta, one a step
    alphas_cumprod: Vec<f32>,
}

/// What a step back needs.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Between {
    /// share left at the step
    now: f64,
    /// share left at the next one
    next: f64,
    /// whether it is the last
    last: bool,
}

impl NoiseSchedule {
    /// Of `steps` steps.
    pub fn new(steps: usize) -> Self {
        let bar = |t: f64| ((t + 0.008) / 1.008 * std::f64::consts::FRAC_PI_2).cos().powi(2);
        let n = steps as f64;
        let mut product = 1.0_f64;
        let alphas_cumprod = (0..steps)
            .map(|i| {
                let beta = (1.0 - bar((i + 1) as f64 / n) / bar(i as f64 / n)).min(0.999);
                // in the precision of the reference: the last alphas have few digits
                product *= f64::from(1.0 - beta as f32);
                product as f32
            })
            .collect();
        Self { alphas_cumprod }
    }

    /// Steps in all.
    pub fn steps(&self) -> usize {
        self.alphas_cumprod.len()
    }

    #[cfg(test)]
    pub(super) fn alphas_cumprod_at(&self, step: u32) -> f32 {
        self.alphas_cumprod[step as usize]
    }

    /// actions, noise: (b, T, A) -> the actions as noisy as each row's step says
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn add_noise(&self, actions: &Tensor, noise: &Tensor, steps: &[u32]) -> Result<Tensor> {
        let column = |of: &dyn Fn(f32) -> f32| {
            let values: Vec<f32> = steps.iter().map(|&t| of(self.alphas_cumprod[t as usize])).collect();
            Tensor::from_vec(values, (steps.len(), 1, 1), actions.device())
        };
        let (keep, add) = (column(&|a: f32| a.sqrt())?, column(&|a: f32| (1.0 - a).sqrt())?);
        Ok((actions.broadcast_mul(&keep)? + noise.broadcast_mul(&add)?)?)
    }

    /// The steps that `count` of them are visited at, from the noisiest on.
    pub fn visited(&self, count: usize) -> Vec<u32> {
        let ratio = self.steps() / count;
        (0..count).rev().map(|i| (i * ratio) as u32).collect()
    }

    fn between(&self, step: u32, count: usize) -> Between {
        let ratio = (self.steps() / count) as u32;
        let share = |t: u32| f64::from(self.alphas_cumprod[t as usize]);
        let next = step.checked_sub(ratio).map_or(1.0, share);
        Between { now: share(step), next, last: step == 0 }
    }

    /// One step back. x, output: (b, T, A) -> less noisy; `drawn` gives noise of that shape, which only DDPM asks for.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn back(
        &self,
        config: &Config,
        x: &Tensor,
        output: &Tensor,
        step: u32,
        drawn: &mut dyn FnMut() -> Result<Tensor>,
    ) -> Result<Tensor> {
        let Between { now, next, last } = self.between(step, config.inference_steps);
        let (clean, noise) = match config.prediction {
            Prediction::Epsilon => {
                let clean = ((x - (output * (1.0 - now).sqrt())?)? / now.sqrt())?;
                (clean, output.clone())
            }
            Prediction::Sample => {
                let noise = ((x - (output * now.sqrt())?)? / (1.0 - now).sqrt())?;
                (output.clone(), noise)
            }
        };
        let range = config.clip_sample as f32;
        let clean = if range > 0.0 { clean.clamp(-range, range)? } else { clean };
        match config.sampler {
            Sampler::Ddim => Ok(((clean * next.sqrt())? + (noise * (1.0 - next).sqrt())?)?),
            Sampler::Ddpm => {
                let alpha = now / next;
                let of_clean = next.sqrt() * (1.0 - alpha) / (1.0 - now);
                let of_x = alpha.sqrt() * (1.0 - next) / (1.0 - now);
                let mean = ((clean * of_clean)? + (x * of_x)?)?;
                if last {
                    return Ok(mean);
                }
                let variance = ((1.0 - next) / (1.0 - now) * (1.0 - alpha)).max(1e-20);
                Ok((mean + (drawn()? * variance.sqrt())?)?)
            }
        }
    }
}
