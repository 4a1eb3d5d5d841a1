//! MIP, the minimal iterative policy: two steps of regression, the second of which looks at a first answer and learned to
//! correct a noisy one. Nothing is drawn at test time.
//!
//! Paper: Pan et al., "Much Ado About Noising: Dispelling the Myths of Generative Robotic Control" (arXiv 2512.01809). With
//! demonstrated actions a, noise z and t = `second_time` the network π is trained on
//! |π(o, 0, 0) - a|² + |π(o, t a + (1-t) z, t) - a|²; its answer is π(o, t a0, t) with a0 = π(o, 0, 0).
//!
//! The network is diffusion's (`models/denoising`), a UNet or a transformer, which is shown 100 t as its step. Deviations: written from the paper's equations, without its code to hold it to; the two steps are held to an
//! oracle in NumPy, the network to LeRobot's with diffusion. The loss is half the sum, so that it compares with one step's.

mod config;

pub use super::denoising::READS;
pub use config::Config;

use super::denoising::{Denoising, Method, Target, between, normals_like};
use crate::features::Signature;
use candle_core::Tensor;
use nn::{Backend, Result, Rng};

/// What the network is shown at time 1.
const LAST_STEP: f32 = 100.0;

/// The model.
pub type Mip = Denoising<TwoSteps>;

/// The network learns the actions twice: from nothing, and from noisy actions.
#[derive(Debug)]
pub struct TwoSteps {
    second_time: f32,
}

/// A first answer from nothing and a second one that looks at it; `answer` is given what it looks at and the time.
fn two_steps(
    nothing: &Tensor,
    second_time: f32,
    mut answer: impl FnMut(&Tensor, f32) -> Result<Tensor>,
) -> Result<Tensor> {
    let first = answer(nothing, 0.0)?;
    answer(&(first * f64::from(second_time))?, second_time)
}

impl Method for TwoSteps {
    const NAME: &'static str = "mip";

    fn answers(&self) -> usize {
        2
    }

    fn targets(&self, rng: &mut Rng, actions: &Tensor) -> Result<Vec<Target>> {
        let (rows, noise) = (actions.dim(0)?, normals_like(actions, rng)?);
        let target = |name, x, time: f32| {
            let steps = vec![time * LAST_STEP; rows];
            Target { name, weight: 0.5, x, steps, wanted: actions.clone() }
        };
        let noisy = between(&noise, actions, &vec![self.second_time; rows])?;
        // the backward pass begins with the last
        Ok(vec![target("second_l2_loss", noisy, self.second_time), target("first_l2_loss", actions.zeros_like()?, 0.0)])
    }

    /// Nothing is drawn.
    fn sample(
        &self,
        zeros: &Tensor,
        _: &mut dyn FnMut() -> Result<Tensor>,
        answer: &mut dyn FnMut(&Tensor, f32) -> Result<Tensor>,
    ) -> Result<Tensor> {
        two_steps(zeros, self.second_time, |x, time| answer(x, time * LAST_STEP))
    }
}

impl Mip {
    /// Initial weights are torch's defaults.
    ///
    /// # Errors
    /// A configuration or a signature that describes no possible model.
    pub fn new(config: &Config, signature: &Signature, seed: u64, backend: &Backend) -> Result<Self> {
        config.validate()?;
        Self::build(TwoSteps { second_time: config.second_time as f32 }, &config.setup(), signature, seed, backend)
    }
}

#[cfg(test)]
mod tests;
