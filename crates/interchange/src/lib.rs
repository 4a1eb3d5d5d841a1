//! Entries in the formats of others: checkpoints of LeRobot and of robomimic in, LeRobot's and ONNX out.

pub mod lerobot;
pub mod onnx;
pub mod robomimic;

/// `env_args` without the module to import, which who evaluates names (`--env-module`), not a file of somebody else's.
fn without_module(mut env_args: serde_json::Value) -> serde_json::Value {
    if let Some(args) = env_args.as_object_mut() {
        args.remove("env_module");
    }
    env_args
}
