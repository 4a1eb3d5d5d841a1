//! The policies beside the reference implementations, in one program.

mod common;

mod act;
mod cameras;
mod diffusion;
mod robomimic;
mod vision;
mod vision_encoders;
