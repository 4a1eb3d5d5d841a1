//! One model, one folder: `mod.rs` is the model as one reads it, `config.rs` its options.

pub mod act;
pub mod actrm;
pub mod bc;
pub mod bc_rnn;
pub mod bc_transformer;
pub mod denoising;
pub mod diffusion;
pub mod floors;
pub mod flow;
pub mod mip;
