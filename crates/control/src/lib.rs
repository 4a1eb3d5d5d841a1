//! The compiled control loop that a robosuite worker loads.
//!
//! One control step of robosuite 1.5.2 is 25 passes of `mj_step1`, controller torques, `mj_step2`;
//! nearly all of its cost is Python. This crate runs those passes in one call, in place on the
//! simulator's own model and data, with the `OSC_POSE` arm controller and the gripper of every
//! Panda computed as robosuite computes them. Everything else of a step (observations, reward, success, counters)
//! stays robosuite's, on the Python side (`actrm_harness.control`).
//!
//! It is not a simulator and not a binding of MuJoCo: it links nothing, knows no layout of
//! `mjModel` or `mjData`, and is handed three function pointers and the addresses of the arrays it
//! reads ([`Binding`]). It knows one kind of robot and one controller; whether an environment has them is
//! decided in Python before anything here is called.
//!
//! The C interface is [`control_abi`], [`control_open`], [`control_run`], [`control_close`].

mod abi;
mod linalg;
mod osc;
mod rotation;
mod substeps;

pub use abi::{
    ArmBinding, Binding, Gripper, State, control_abi, control_close, control_delta_rotation, control_open, control_run,
};
pub use osc::{Arm, Gains, Pose};
pub use rotation::Mat3;
pub use substeps::{JacSiteFunction, Loop, PolicyArm, Status, StepFunction};
