//! Puzzle solvers: the Tiny Recursive Model ([`trm`]), the networks it is compared with, from grids to a class per cell
//! ([`GridConfig`]) and through mazes ([`WalkerConfig`]), and reinforcement learning for the latter ([`rl`]).
//!
//! Knows tensors and numbers only, no puzzle: grids come in as numbers, environments are the caller's.

mod nets;
pub mod rl;
pub mod trm;

pub use nets::{
    ConvWalker, GridConfig, GridDims, GridModel, MlpWalker, SmallTrm, SmallTrmConfig, Stem, TrmWalker, WalkerConfig,
    WalkerNet, WalkerOutput,
};
