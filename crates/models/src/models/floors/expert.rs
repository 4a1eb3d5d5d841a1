//! `expert`: the task's scripted expert, which made the demonstrations. It knows the simulator's state and acts inside of it
//! (`PolicyModel::is_scripted`); asked as a policy, outside of its simulator, it gives the action 0.

pub use super::{Config, READS};
use super::{Floor, Rule};
use crate::features::{Features, Signature};
use candle_core::Tensor;
use nn::Params;
use nn::Result;
use nn::Rng;

/// The model.
pub type Expert = Floor<Scripted>;

/// Leaving it to the expert.
#[derive(Debug)]
pub struct Scripted {
    config: Config,
}

impl Rule for Scripted {
    const NAME: &'static str = "expert";
    const SCRIPTED: bool = true;
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
