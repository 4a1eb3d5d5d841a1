//! `random`: actions drawn evenly from -1 to 1 in network units, by the policy's own generator. With
//! `normalisation.action = "min_max"`, as its experiments have it, that is between the smallest and the largest action of
//! the demonstrations.

pub use super::{Config, READS};
use super::{Floor, Rule};
use crate::features::{Features, Signature};
use candle_core::Tensor;
use nn::Params;
use nn::Result;
use nn::Rng;

/// The model.
pub type Random = Floor<Chance>;

/// Any action.
#[derive(Debug)]
pub struct Chance {
    config: Config,
}

impl Rule for Chance {
    const NAME: &'static str = "random";
    type Config = Config;

    fn new(config: &Config, _signature: &Signature, _params: &mut Params) -> Result<Self> {
        config.validate()?;
        Ok(Self { config: config.clone() })
    }

    fn action_horizon(&self) -> usize {
        self.config.action_horizon
    }

    fn chunk(&self, model: &Floor<Self>, rows: usize, _: &Features<Tensor>, rng: Option<&mut Rng>) -> Result<Tensor> {
        let width = model.signature.action_dim;
        let Some(rng) = rng else { return model.repeated(rows, vec![0.0; rows * width]) };
        let horizon = self.config.action_horizon;
        let drawn: Vec<f32> = (0..rows * horizon * width).map(|_| 2.0 * rng.uniform() - 1.0).collect();
        Ok(Tensor::from_vec(drawn, (rows, horizon, width), model.params.device())?)
    }
}
