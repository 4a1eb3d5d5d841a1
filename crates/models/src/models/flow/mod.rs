//! Flow matching: actions are where a velocity field, looking at the observation, carries noise in a few Euler steps.
//!
//! Papers: Lipman et al., "Flow Matching for Generative Modeling" (arXiv 2210.02747), and the straight paths of Liu et al.,
//! "Flow Straight and Fast" (arXiv 2209.03003); in robotics Black et al., "π0" (arXiv 2410.24164). On the way from noise z at
//! time 0 to the demonstrated actions a at time 1, x = (1-t) z + t a, the network is trained to give the velocity a - z
//! (mean squared error, t even in 0 to 1). An action sequence is drawn by `inference_steps` Euler steps of the same length from
//! noise.
//!
//! The network is diffusion's (`models/denoising`), a UNet or a transformer, which is shown 100 t as its step. No implementation is taken for the reference: the sampler is held to an oracle in NumPy, the network to
//! LeRobot's with diffusion. Deviations: π0 draws t from a beta distribution and has a transformer.

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
pub type Flow = Denoising<Velocity>;

/// The network learns the velocity from noise to actions.
#[derive(Debug)]
pub struct Velocity {
    inference_steps: usize,
}

/// `steps` Euler steps along `velocity`, which is given x and the time.
fn euler(z: &Tensor, steps: usize, mut velocity: impl FnMut(&Tensor, f32) -> Result<Tensor>) -> Result<Tensor> {
    let mut x = z.clone();
    for step in 0..steps {
        let v = velocity(&x, step as f32 / steps as f32)?;
        x = (x + (v / steps as f64)?)?;
    }
    Ok(x)
}

impl Method for Velocity {
    const NAME: &'static str = "flow";

    fn answers(&self) -> usize {
        self.inference_steps
    }

    fn targets(&self, rng: &mut Rng, actions: &Tensor) -> Result<Vec<Target>> {
        let noise = normals_like(actions, rng)?;
        let times: Vec<f32> = (0..actions.dim(0)?).map(|_| rng.uniform()).collect();
        let (x, wanted) = (between(&noise, actions, &times)?, (actions - noise)?);
        let steps = times.iter().map(|t| t * LAST_STEP).collect();
        Ok(vec![Target { name: "l2_loss", weight: 1.0, x, steps, wanted }])
    }

    fn sample(
        &self,
        _: &Tensor,
        noise: &mut dyn FnMut() -> Result<Tensor>,
        answer: &mut dyn FnMut(&Tensor, f32) -> Result<Tensor>,
    ) -> Result<Tensor> {
        euler(&noise()?, self.inference_steps, |x, time| answer(x, time * LAST_STEP))
    }
}

impl Flow {
    /// Initial weights are torch's defaults.
    ///
    /// # Errors
    /// A configuration or a signature that describes no possible model.
    pub fn new(config: &Config, signature: &Signature, seed: u64, backend: &Backend) -> Result<Self> {
        config.validate()?;
        Self::build(Velocity { inference_steps: config.inference_steps }, &config.setup(), signature, seed, backend)
    }
}

#[cfg(test)]
mod tests;
