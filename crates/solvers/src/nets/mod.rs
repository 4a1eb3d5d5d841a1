//! What the TRM is compared with on puzzles: networks from grids to a class per cell (`grids`, `small_trm`), and networks
//! that walk through mazes (`walkers`).

mod grids;
mod small_trm;
mod walkers;

pub use grids::{GridDims, GridModel};
pub use small_trm::{SmallTrm, SmallTrmConfig, Stem};
pub use walkers::{ConvWalker, MlpWalker, TrmWalker, WalkerConfig, WalkerNet, WalkerOutput};

use grids::{Cnn, Mlp, Transformer};
use nn::Result;
use nn::Rng;
use serde::{Deserialize, Serialize};

/// Which network from grids, and its sizes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum GridConfig {
    /// 3x3 convolutions with ReLU, then one class score per cell.
    Cnn {
        /// Channels after each convolution; the study's are 32, 64, 64, 32.
        channels: Vec<usize>,
    },
    /// Post-norm Transformer encoder over cells with learned positions.
    Transformer {
        /// Width.
        dim: usize,
        /// Heads.
        heads: usize,
        /// Layers.
        layers: usize,
        /// Width of the feed-forward part.
        feedforward: usize,
    },
    /// Dense layers over the flattened grid.
    Mlp {
        /// Widths of the hidden layers.
        hidden: Vec<usize>,
    },
    /// The study's own TRM, a recursion per cell.
    SmallTrm(SmallTrmConfig),
}

impl GridConfig {
    /// Builds the network with weights drawn from `seed`.
    ///
    /// # Errors
    /// When the configuration cannot work.
    pub fn build(&self, dims: GridDims, seed: u64) -> Result<Box<dyn GridModel>> {
        let mut rng = Rng::new(seed, "baseline");
        Ok(match self {
            Self::Cnn { channels } => Box::new(Cnn::new(dims, channels, &mut rng)?),
            &Self::Transformer { dim, heads, layers, feedforward } => {
                Box::new(Transformer::new(dims, (dim, heads, layers, feedforward), &mut rng)?)
            }
            Self::Mlp { hidden } => Box::new(Mlp::new(dims, hidden, &mut rng)?),
            Self::SmallTrm(config) => Box::new(SmallTrm::new(dims, config.clone(), &mut rng)?),
        })
    }
}
