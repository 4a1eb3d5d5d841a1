//! A policy of the user's, written in Python, as an evaluation takes it.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use models::{ActionChunk, FeatureKind, ModelError, Observation, Policy, Signature, Values};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::{array, read};
use crate::work::locked;

/// Names and lists of keys, or other texts.
type Named<T> = BTreeMap<String, T>;

/// A policy, name of its entry, its source, SHA-256 of its code, what its owner declares, keys of its features,
/// side of its images, conventions.
pub(crate) type Given =
    (Py<PyAny>, String, String, Option<String>, Option<String>, Option<Named<Vec<String>>>, i128, Named<String>);

/// The first exception that the policy raised.
pub(crate) type Failure = Arc<Mutex<Option<PyErr>>>;

/// A policy whose answers Python gives: an object of `actrm._policies.Called`.
pub(crate) struct PythonPolicy {
    called: Py<PyAny>,
    source: String,
    signature: Signature,
    failure: Failure,
    /// what is to be done in the episode, in words
    instruction: Option<String>,
    /// why the episode could not begin
    unready: Option<ModelError>,
}

impl PythonPolicy {
    /// `called` for one simulator: a copy where there are several.
    pub(crate) fn new(
        called: &Py<PyAny>,
        source: &str,
        signature: &Signature,
        failure: &Failure,
    ) -> Result<Self, ModelError> {
        let copied = locked(|py| called.call_method0(py, "copy"));
        let called = copied.map_err(|error| raised(failure, source, error))?;
        let (source, signature) = (source.to_owned(), signature.clone());
        Ok(Self { called, source, signature, failure: Arc::clone(failure), instruction: None, unready: None })
    }

    fn observation<'py>(&self, py: Python<'py>, observation: &Observation) -> PyResult<Bound<'py, PyDict>> {
        let given = PyDict::new(py);
        for spec in &self.signature.observation {
            let value = match observation.get(&spec.name) {
                Some(Values::F32(numbers)) if spec.kind != FeatureKind::Image => array(py, &[numbers.len()], numbers)?,
                Some(Values::U8(image)) => array(py, &spec.shape, image)?,
                _ => continue,
            };
            given.set_item(&spec.name, value)?;
        }
        if let Some(instruction) = &self.instruction {
            // LeRobot's name of it
            given.set_item("task", instruction)?;
        }
        Ok(given)
    }
}

/// Keeps the first exception, and says it in our words.
fn raised(failure: &Failure, policy: &str, error: PyErr) -> ModelError {
    let reason = error.to_string();
    failure.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
    ModelError::External { policy: policy.to_owned(), reason }
}

impl Policy for PythonPolicy {
    fn predict(&mut self, observation: &Observation) -> Result<ActionChunk, ModelError> {
        if let Some(error) = self.unready.take() {
            return Err(error);
        }
        let predicted = locked(|py| {
            let actions = self.called.bind(py).call_method1("predict", (self.observation(py, observation)?,))?;
            read::<f32>(&actions)
        });
        let (shape, actions) = predicted.map_err(|error| raised(&self.failure, &self.source, error))?;
        let &[horizon, dim] = shape.as_slice() else {
            let reason = format!("expected actions (T, D), found shape {shape:?}");
            return Err(ModelError::External { policy: self.source.clone(), reason });
        };
        ActionChunk::new(actions, horizon, dim)
    }

    fn reset(&mut self, seed: u64) {
        let reset = locked(|py| self.called.call_method1(py, "reset", (seed,)).map(drop));
        self.unready = reset.map_err(|error| raised(&self.failure, &self.source, error)).err();
        self.instruction = None;
    }

    fn instruct(&mut self, instruction: Option<&str>) {
        self.instruction = instruction.map(str::to_owned);
    }
}
