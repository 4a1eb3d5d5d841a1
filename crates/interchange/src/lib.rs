//! Entries in the formats of others: checkpoints of LeRobot and of robomimic in, LeRobot's and ONNX out.

pub mod lerobot;
pub mod onnx;
pub mod robomimic;
