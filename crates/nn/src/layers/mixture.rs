//! A mixture of Gaussians over actions, as robomimic's GMM heads have it.

use super::Linear;
use crate::context::Context;
use crate::error::Result;
use crate::ops::linear;
use crate::params::Params;
use crate::rng::Rng;
use crate::value::Value;
use candle_core::{D, Tensor};

/// Deviation of a component at test time (robomimic: `low_noise_eval`).
const LOW_NOISE: f32 = 1e-4;

/// The layers that give a mixture: three dense ones side by side.
#[derive(Debug)]
pub struct MixtureHead {
    mean: Linear,
    scale: Linear,
    logits: Linear,
    min_std: f64,
    action_dim: usize,
}

/// n mixtures of M Gaussians with A numbers each.
#[derive(Debug)]
pub struct Mixture {
    /// (n, M, A) in -1 to 1
    pub means: Tensor,
    /// (n, M, A)
    pub scales: Tensor,
    /// (n, M)
    pub logits: Tensor,
}

impl MixtureHead {
    /// Creates `{prefix}.mean`, `.scale` and `.logits`.
    pub fn new(
        params: &mut Params,
        prefix: &str,
        (input, modes, action_dim): (usize, usize, usize),
        min_std: f64,
        rng: &mut Rng,
    ) -> Result<Self> {
        let mut layer = |name: &str, width: usize| Linear::new(params, &format!("{prefix}.{name}"), input, width, rng);
        Ok(Self {
            mean: layer("mean", modes * action_dim)?,
            scale: layer("scale", modes * action_dim)?,
            logits: layer("logits", modes)?,
            min_std,
            action_dim,
        })
    }

    /// x: (n, in) -> n mixtures as its layers give them
    ///
    /// # Errors
    /// An input of another width.
    pub fn apply(&self, cx: &mut Context<'_>, x: &Value) -> Result<MixtureParts> {
        // backwards, so that the gradient of x is that of the means, then of the scales, then of the logits
        let logits = linear(cx, x, &self.logits)?;
        let scales = linear(cx, x, &self.scale)?;
        let means = linear(cx, x, &self.mean)?;
        Ok(MixtureParts { means, scales, logits, min_std: self.min_std, action_dim: self.action_dim })
    }
}

/// n mixtures of M Gaussians with A numbers each as a [`MixtureHead`]'s layers give them.
#[derive(Debug)]
pub struct MixtureParts {
    /// (n, M * A), before tanh
    pub means: Value,
    /// (n, M * A), before softplus
    pub scales: Value,
    /// (n, M)
    pub logits: Value,
    /// what is added to scales
    pub min_std: f64,
    /// A
    pub action_dim: usize,
}

impl MixtureParts {
    /// The mixtures, on candle's operations.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn mixture(&self) -> Result<Mixture> {
        let apart = |y: &Tensor| y.reshape((y.dim(0)?, (), self.action_dim));
        let scale = apart(&self.scales.tensor)?;
        // softplus, which cannot overflow so
        let scales = (scale.relu()? + (scale.abs()?.neg()?.exp()? + 1.0)?.log()?)?;
        Ok(Mixture {
            means: apart(&self.means.tensor)?.tanh()?,
            scales: (scales + self.min_std)?,
            logits: self.logits.tensor.clone(),
        })
    }
}

/// ln of the sum of exponentials over the last dimension. x: (n, M) -> (n)
fn log_sum_exp(x: &Tensor) -> Result<Tensor> {
    let max = x.max_keepdim(D::Minus1)?.detach();
    let sum = x.broadcast_sub(&max)?.exp()?.sum(D::Minus1)?;
    Ok((sum.log()? + max.squeeze(D::Minus1)?)?)
}

impl Mixture {
    /// ln of the density at actions: (n, A) -> (n)
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn log_prob(&self, actions: &Tensor) -> Result<Tensor> {
        let away = actions.unsqueeze(1)?.broadcast_sub(&self.means)?.div(&self.scales)?;
        let width = actions.dim(1)? as f64;
        let of_mode = (away.sqr()?.sum(2)? * -0.5)? - self.scales.log()?.sum(2)?;
        let of_mode = (of_mode? - 0.5 * width * std::f64::consts::TAU.ln())?;
        let weights = self.logits.broadcast_sub(&log_sum_exp(&self.logits)?.unsqueeze(1)?)?;
        log_sum_exp(&(weights + of_mode)?)
    }

    /// The mean of each mixture's likeliest Gaussian: (n, A)
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn likeliest(&self) -> Result<Tensor> {
        let (n, _, width) = self.means.dims3()?;
        let best = self.logits.argmax(1)?.reshape((n, 1, 1))?.broadcast_as((n, 1, width))?.contiguous()?;
        Ok(self.means.contiguous()?.gather(&best, 1)?.squeeze(1)?)
    }

    /// Actions drawn as robomimic does at test time: a Gaussian by its weight, then its mean and very little noise. -> (n, A)
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn sample(&self, rng: &mut Rng) -> Result<Tensor> {
        let rows = self.logits.to_vec2::<f32>()?;
        let draw = |row: &Vec<f32>| {
            let max = row.iter().fold(f32::NEG_INFINITY, |m, x| m.max(*x));
            let weights: Vec<f32> = row.iter().map(|x| (x - max).exp()).collect();
            let mut left = rng.uniform() * weights.iter().sum::<f32>();
            let passed = |w: &&f32| {
                left -= **w;
                left >= 0.0
            };
            weights.iter().take_while(passed).count().min(row.len() - 1)
        };
        let modes: Vec<usize> = rows.iter().map(draw).collect();
        let means = self.of_modes(&modes)?;
        let noise = Tensor::from_vec(rng.normals(means.elem_count()), means.shape(), means.device())?;
        Ok((means + (noise * f64::from(LOW_NOISE))?)?)
    }

    /// One mode a row -> their means (n, A)
    fn of_modes(&self, modes: &[usize]) -> Result<Tensor> {
        let (n, count, width) = self.means.dims3()?;
        let rows: Vec<u32> = modes.iter().enumerate().map(|(row, mode)| (row * count + mode) as u32).collect();
        Ok(self.means.reshape((n * count, width))?.index_select(&Tensor::from_vec(rows, n, self.means.device())?, 0)?)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use candle_core::Device;

    #[test]
    fn modes_are_drawn_by_their_weight() {
        let n = 4000;
        let tensor = |values: Vec<f32>, shape: (usize, usize)| {
            Tensor::from_vec(values, shape, &Device::Cpu).unwrap().broadcast_as((n, shape.0, shape.1)).unwrap()
        };
        let mixture = Mixture {
            means: tensor(vec![-0.5, 0.1, 0.8], (3, 1)).contiguous().unwrap(),
            scales: tensor(vec![1.0; 3], (3, 1)).contiguous().unwrap(),
            logits: tensor(vec![0.0, 2.0_f32.ln(), 5.0_f32.ln()], (1, 3)).reshape((n, 3)).unwrap(),
        };
        let drawn = mixture.sample(&mut Rng::new(3, "test")).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
        for (mean, share) in [(-0.5, 0.125), (0.1, 0.25), (0.8, 0.625)] {
            let near = drawn.iter().filter(|x| (*x - mean).abs() < 1e-3).count() as f32 / n as f32;
            assert!((near - share).abs() < 0.03, "{mean}: {near} {share}");
        }
        let likeliest = mixture.likeliest().unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
        assert!(likeliest.iter().all(|x| *x == 0.8));
    }
}
