//! Checkpoints of others, in one program.

mod lerobot;
mod robomimic;
