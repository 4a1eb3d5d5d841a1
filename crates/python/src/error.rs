//! Our errors as Python's.

use std::any::Any;

use pyo3::create_exception;
use pyo3::exceptions::{PyException, PyOverflowError, PyRuntimeWarning, PyTypeError, PyValueError};
use pyo3::prelude::*;

create_exception!(
    actrm,
    Error,
    PyException,
    "An error of actrm, with the message of its programs: file, key, what was expected and what was found."
);

create_exception!(
    actrm,
    ResultsTakenOver,
    PyRuntimeWarning,
    "A warning: episodes of an earlier call are among the results of a policy of yours. It comes every time, unless a \
     filter of yours says otherwise."
);

/// An error with everything behind it, in one line.
pub(crate) fn words(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        text.push_str(&format!(": {error}"));
        cause = error.source();
    }
    text
}

/// What a panic said: it would be a defect of ours, and becomes an exception like every other error.
pub(crate) fn defect(panic: &(dyn Any + Send)) -> PyErr {
    let said = panic.downcast_ref::<&str>().copied().or_else(|| panic.downcast_ref::<String>().map(String::as_str));
    Error::new_err(format!("a defect of actrm, please report it: {}", said.unwrap_or("nothing more is known")))
}

/// An error of ours as an exception.
pub(crate) fn raised(error: impl std::error::Error) -> PyErr {
    Error::new_err(words(&error))
}

/// The argument `name` as a number that is not negative.
pub(crate) fn natural<T: TryFrom<i128>>(name: &str, value: i128) -> PyResult<T> {
    T::try_from(value).ok().ok_or_else(|| {
        let bits = 8 * size_of::<T>();
        PyValueError::new_err(format!("{name}: expected a whole number from 0, below 2^{bits}, found {value}"))
    })
}

/// An error of Python's about `what`, which it does not name: that it is not a value as it should be.
pub(crate) fn named(py: Python<'_>, what: &str, error: PyErr) -> PyErr {
    let of_value = error.is_instance_of::<PyTypeError>(py)
        || error.is_instance_of::<PyValueError>(py)
        || error.is_instance_of::<PyOverflowError>(py);
    if !of_value {
        return error;
    }
    let named = PyValueError::new_err(format!("{what}: {}", error.value(py)));
    named.set_cause(py, Some(error));
    named
}
