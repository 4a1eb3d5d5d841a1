//! Arrays of numpy's: made of memory that is filled here, and read into memory of ours.
//!
//! numpy's own interface in C is not used: an array is a view of a `bytearray`, which is written in place, so that values
//! are copied once, from where they lie into the array.

use bytemuck::Pod;
use pyo3::buffer::PyBuffer;
use pyo3::exceptions::{PyMemoryError, PyRuntimeError};
use pyo3::intern;
use pyo3::prelude::*;
use pyo3::sync::GILOnceCell;
use pyo3::types::{PyByteArray, PyDict, PyTuple, PyType};

use crate::work::Inside;

/// numpy's `ndarray`.
fn ndarray(py: Python<'_>) -> PyResult<&Bound<'_, PyType>> {
    static NDARRAY: GILOnceCell<Py<PyType>> = GILOnceCell::new();
    NDARRAY.import(py, "numpy", "ndarray")
}

/// A number that numpy has a type for.
pub(crate) trait Number: Pod + Send {
    /// numpy's name of it.
    const NAME: &'static str;
}

impl Number for f32 {
    const NAME: &'static str = "float32";
}
impl Number for f64 {
    const NAME: &'static str = "float64";
}
impl Number for i64 {
    const NAME: &'static str = "int64";
}
impl Number for u64 {
    const NAME: &'static str = "uint64";
}
impl Number for u8 {
    const NAME: &'static str = "uint8";
}

/// A new array of this shape whose values `fill` writes, row-major.
pub(crate) fn filled<'py, T: Number>(
    py: Python<'py>,
    shape: &[usize],
    fill: impl FnOnce(&mut [T]),
) -> PyResult<Bound<'py, PyAny>> {
    made(py, shape, T::NAME, fill)
}

/// A new array of truth values, made of bytes: what is not 0 is true.
pub(crate) fn flags<'py, T: Number>(
    py: Python<'py>,
    shape: &[usize],
    fill: impl FnOnce(&mut [T]),
) -> PyResult<Bound<'py, PyAny>> {
    made(py, shape, "bool", fill)
}

/// A new array of these values; an exception where the shape is not theirs.
pub(crate) fn array<'py, T: Number>(py: Python<'py>, shape: &[usize], values: &[T]) -> PyResult<Bound<'py, PyAny>> {
    if shape.iter().product::<usize>() != values.len() {
        let text = format!("array: expected {} values, found shape {shape:?}", values.len());
        return Err(PyRuntimeError::new_err(text));
    }
    filled(py, shape, |out| out.copy_from_slice(values))
}

/// So many zeros; an exception where there is no memory for them.
pub(crate) fn zeros<T: Pod>(count: usize) -> PyResult<Vec<T>> {
    let mut values = Vec::new();
    if values.try_reserve_exact(count).is_err() {
        let text = format!("no memory for {count} numbers of {} bytes", size_of::<T>());
        return Err(PyMemoryError::new_err(text));
    }
    values.resize(count, T::zeroed());
    Ok(values)
}

fn made<'py, T: Pod>(
    py: Python<'py>,
    shape: &[usize],
    name: &str,
    fill: impl FnOnce(&mut [T]),
) -> PyResult<Bound<'py, PyAny>> {
    let count: usize = shape.iter().product();
    let memory = PyByteArray::new_with(py, count * size_of::<T>(), |bytes| {
        if let Ok(values) = bytemuck::try_cast_slice_mut(bytes) {
            fill(values);
        } else {
            // no allocator of Python's gives memory that is aligned so badly
            let mut values = zeros(count)?;
            fill(&mut values);
            bytes.copy_from_slice(bytemuck::cast_slice(&values));
        }
        Ok(())
    })?;
    ndarray(py)?.call1((PyTuple::new(py, shape)?, name, memory))
}

/// The shape and the values, row-major, of whatever numpy can make an array of.
pub(crate) fn read<T: Number + pyo3::buffer::Element>(value: &Bound<'_, PyAny>) -> PyResult<(Vec<usize>, Vec<T>)> {
    let py = value.py();
    let _inside = Inside::with_lock(py);
    let options = PyDict::new(py);
    options.set_item(intern!(py, "dtype"), T::NAME)?;
    options.set_item(intern!(py, "order"), "C")?;
    let array = numpy(py)?.call_method(intern!(py, "asarray"), (readable(value)?,), Some(&options))?;
    let shape: Vec<usize> = array.getattr(intern!(py, "shape"))?.extract()?;
    // a single number without an axis has no shape that a buffer could state
    let array = if shape.is_empty() { array.call_method1(intern!(py, "reshape"), (1,))? } else { array };
    Ok((shape, PyBuffer::<T>::get(&array)?.to_vec(py)?))
}

/// What numpy can read: tensors of PyTorch's without gradients, on the CPU, of a type that numpy has.
pub(crate) fn readable<'py>(value: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
    let py = value.py();
    if !value.hasattr(intern!(py, "detach"))? {
        return Ok(value.clone());
    }
    let tensor = value.call_method0(intern!(py, "detach"))?.call_method0(intern!(py, "cpu"))?;
    match tensor.call_method0(intern!(py, "is_floating_point"))?.is_truthy()? {
        true => tensor.call_method0(intern!(py, "float")),
        false => Ok(tensor),
    }
}

/// The module.
pub(crate) fn numpy(py: Python<'_>) -> PyResult<&Bound<'_, PyModule>> {
    static NUMPY: GILOnceCell<Py<PyModule>> = GILOnceCell::new();
    NUMPY.get_or_try_init(py, || Ok::<_, PyErr>(py.import("numpy")?.unbind())).map(|module| module.bind(py))
}
