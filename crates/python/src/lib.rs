//! The Python package `actrm`: conversion, data sets, policies, evaluation and leaderboard for those who live in Python.
//!
//! Thin bindings: what they do is the other crates' business. Python's lock is not held while they work; errors become
//! exceptions with the same words. What this crate is not: it starts no process (`rollout` and `dataset` do), prints
//! nothing (the package's Python side draws the bars), and has no logic of data, training or evaluation.

mod arrays;
mod batches;
mod convert;
mod dataset;
mod error;
mod evaluate;
mod external;
mod leaderboard;
mod policy;
mod simulator;
mod work;

use std::path::PathBuf;

use pyo3::prelude::*;

/// Says where the programs and the compiled control loop lie that the package carries.
#[pyfunction]
fn set_places(reader: PathBuf, control: PathBuf) {
    if reader.is_file() {
        ::dataset::isolation::serve_by(&reader);
    }
    if control.is_file() {
        rollout::set_control_library(&control);
    }
}

/// Panics, for a test of what becomes of that.
#[pyfunction]
fn panics(py: Python<'_>) -> PyResult<()> {
    work::unlocked(py, || panic!("as the test asked"))
}

#[pymodule]
fn _actrm(module: &Bound<'_, PyModule>) -> PyResult<()> {
    work::at_home();
    module.py().import("atexit")?.call_method1("register", (work::Ending::default(),))?;
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add("Error", module.py().get_type::<error::Error>())?;
    module.add("ResultsTakenOver", module.py().get_type::<error::ResultsTakenOver>())?;
    module.add_class::<dataset::PyDataset>()?;
    module.add_class::<batches::Batches>()?;
    module.add_class::<policy::PyPolicy>()?;
    module.add_class::<simulator::Simulator>()?;
    module.add_function(wrap_pyfunction!(set_places, module)?)?;
    module.add_function(wrap_pyfunction!(panics, module)?)?;
    module.add_function(wrap_pyfunction!(convert::convert, module)?)?;
    module.add_function(wrap_pyfunction!(policy::load_policy, module)?)?;
    module.add_function(wrap_pyfunction!(evaluate::evaluate, module)?)?;
    module.add_function(wrap_pyfunction!(leaderboard::leaderboard, module)?)?;
    Ok(())
}
