//! `zero`: the action that is 0 in network units, always. With actions that are not normalised, as its experiments have
//! them (`normalisation.action = "identity"`), a robosuite arm stays where it is; with `mean_std` it is the demonstrations'
//! mean action.

pub use super::{Config, READS};
use super::{Floor, Rule};
use crate::features::{Features, Signature};
use candle_core::Tensor;
use nn::Params;
use nn::Result;
use nn::Rng;

/// The model.
pub type Zero = Floor<Nothing>;

/// Doing nothing.
#[derive(Debug)]
pub struct Nothing {
    config: Config,
}

impl Rule for Nothing {
    const NAME: &'static str = "zero";
    type Config = Config;

    fn new(config: &Config, _signature: &Signature, _params: &mut Params) -> Result<Self> {
        config.validate()?;
        Ok(Self { config: config.clone() })
    }

    fn action_horizon(&self) -> usize {
        self.config.action_horizon
    }

    fn chunk(&self, model: &Floor<Self>, rows: usize, _: &Features<Tensor>, _: Option<&mut Rng>) -> Result<Tensor> {
        model.repeated(rows, vec![0.0; rows * model.signature.action_dim])
    }
}
