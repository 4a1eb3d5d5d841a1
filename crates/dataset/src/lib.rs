//! Demonstrations: robomimic-family HDF5 in, LeRobot-ready Parquet out, windows for training.

mod error;
mod plan;
mod source;
mod tree;

pub use error::{DatasetError, InputError, Result};
pub use plan::{DemoPlan, Dialect, KeyPlan, Place, Plan, Problem};
pub use source::{ArrayHasher, ContentHasher, DemoHasher, RobomimicWriter, Source, WriteOptions, isolation};
pub use tree::{Array, Attrs, Demo, Dtype};
