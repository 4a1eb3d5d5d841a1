//! What an update minimises, on vectors of one number a step. Every product is of two vectors of the same length:
//! candle refuses to multiply others, and nothing here broadcasts.

use candle_core::{D, Device, Tensor};
use nn::Result;

/// The steps that an update learns from; each list has one item a step.
#[derive(Debug, Clone, Default)]
pub(super) struct Chosen {
    pub(super) actions: Vec<u32>,
    pub(super) log_probs: Vec<f32>,
    /// Standardised.
    pub(super) advantages: Vec<f32>,
    pub(super) returns: Vec<f32>,
}

/// The policy's part of a loss.
pub(super) struct PolicyLoss {
    pub(super) loss: Tensor,
    /// Estimated divergence from the policy that acted.
    pub(super) kl: f64,
    pub(super) clipped: f64,
}

/// `(n, actions)` scores -> log-probabilities.
pub(super) fn log_softmax(logits: &Tensor) -> Result<Tensor> {
    let shifted = logits.broadcast_sub(&logits.max_keepdim(D::Minus1)?.detach())?;
    Ok(shifted.broadcast_sub(&shifted.exp()?.sum_keepdim(D::Minus1)?.log()?)?)
}

/// Mean entropy of `(n, actions)` log-probabilities.
pub(super) fn entropy(log_policy: &Tensor) -> Result<Tensor> {
    let rows = log_policy.dim(0)? as f64;
    Ok(((log_policy.exp()? * log_policy)?.sum_all()? * (-1.0 / rows))?)
}

impl Chosen {
    /// Some of the steps.
    pub(super) fn select(&self, steps: &[u32]) -> Self {
        let floats = |list: &[f32]| steps.iter().map(|&i| list[i as usize]).collect();
        Self {
            actions: steps.iter().map(|&i| self.actions[i as usize]).collect(),
            log_probs: floats(&self.log_probs),
            advantages: floats(&self.advantages),
            returns: floats(&self.returns),
        }
    }

    fn vector(list: &[f32]) -> Result<Tensor> {
        Ok(Tensor::from_slice(list, list.len(), &Device::Cpu)?)
    }

    /// `-mean(log p(a) A)`, or with `clip` PPO's `-mean(min(r A, clamp(r, 1 - clip, 1 + clip) A))`, `r` the ratio of the
    /// action's probability to that when it was drawn.
    pub(super) fn policy_loss(&self, log_policy: &Tensor, clip: Option<f64>) -> Result<PolicyLoss> {
        let n = self.actions.len();
        let index = Tensor::from_slice(&self.actions, (n, 1), &Device::Cpu)?;
        let log_probs = log_policy.gather(&index, 1)?.squeeze(1)?;
        let advantages = Self::vector(&self.advantages)?;
        let log_ratio = (&log_probs - Self::vector(&self.log_probs)?)?;
        let gain = match clip {
            None => (&log_probs * &advantages)?,
            Some(clip) => {
                let ratio = log_ratio.exp()?;
                let bounded = ratio.clamp(1.0 - clip, 1.0 + clip)?;
                (&ratio * &advantages)?.minimum(&(bounded * &advantages)?)?
            }
        };
        let log_ratio: Vec<f32> = log_ratio.to_vec1()?;
        let mean = |f: &dyn Fn(f64) -> f64| log_ratio.iter().map(|&x| f(f64::from(x))).sum::<f64>() / n as f64;
        Ok(PolicyLoss {
            loss: (gain.sum_all()? * (-1.0 / n as f64))?,
            // (r - 1) - log r: never negative, and right on average (Schulman, "Approximating KL divergence")
            kl: mean(&|x| x.exp() - 1.0 - x),
            clipped: clip.map_or(0.0, |clip| mean(&|x| f64::from(u8::from((x.exp() - 1.0).abs() > clip)))),
        })
    }

    /// Mean squared error of `value (n,)` against the returns.
    pub(super) fn value_loss(&self, value: &Tensor) -> Result<Tensor> {
        let n = self.returns.len() as f64;
        Ok(((value - Self::vector(&self.returns)?)?.sqr()?.sum_all()? * (1.0 / n))?)
    }
}
