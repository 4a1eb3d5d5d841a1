//! What can go wrong in this crate: an operation and the object it failed on.

use std::collections::BTreeSet;

/// Errors of the `models` crate.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// A configuration that describes no possible model.
    #[error("config of {model}: {field} is {found}, expected {expected}")]
    Config {
        /// the model or component that was configured
        model: &'static str,
        /// the field at fault
        field: &'static str,
        /// its value
        found: String,
        /// what would be accepted
        expected: String,
    },
    /// A tensor of the model that the given set lacks.
    #[error("tensor {name} is missing; given: {given}")]
    MissingTensor {
        /// the name
        name: String,
        /// the names that were given (shortened)
        given: String,
    },
    /// A given tensor that the model does not have.
    #[error("tensor {name} does not belong to the model; it has: {known}")]
    ExtraTensor {
        /// the name
        name: String,
        /// the names that the model has (shortened)
        known: String,
    },
    /// A tensor with the right name and the wrong shape.
    #[error("tensor {name} has shape {found:?}, expected {expected:?}")]
    MisshapenTensor {
        /// the name
        name: String,
        /// the model's shape
        expected: Vec<usize>,
        /// the given shape
        found: Vec<usize>,
    },
    /// An input of the wrong shape or length.
    #[error("{operation}: {object} has shape {found:?}, expected {expected:?}")]
    Shape {
        /// what was being done
        operation: &'static str,
        /// the object at fault
        object: &'static str,
        /// expected shape
        expected: Vec<usize>,
        /// found shape
        found: Vec<usize>,
    },
    /// An input that the model needs and did not get, or got and cannot use.
    #[error("{operation}: {object} is {found}, expected {expected}")]
    Input {
        /// what was being done
        operation: &'static str,
        /// the object at fault
        object: &'static str,
        /// what was given
        found: String,
        /// what was expected
        expected: String,
    },
    /// A feature of an observation that is needed and not there.
    #[error("{operation}: feature {name} is missing; given: {given}")]
    MissingFeature {
        /// what was being done
        operation: &'static str,
        /// the feature
        name: String,
        /// the names that were given (shortened)
        given: String,
    },
    /// A feature of the wrong shape or length.
    #[error("{operation}: {name} has shape {found:?}, expected {expected:?}")]
    FeatureShape {
        /// what was being done
        operation: &'static str,
        /// the feature
        name: String,
        /// expected shape
        expected: Vec<usize>,
        /// found shape
        found: Vec<usize>,
    },
    /// A feature whose values are of another type than its kind has.
    #[error("feature {name} of kind {kind} holds {found}, expected {expected}")]
    FeatureType {
        /// the feature
        name: String,
        /// its kind
        kind: &'static str,
        /// what it holds
        found: &'static str,
        /// what it should hold
        expected: &'static str,
    },
    /// A feature of a kind that a model has no way to read.
    #[error("{model} cannot read feature {feature} of kind {kind}; it reads {reads}")]
    UnreadableFeature {
        /// the model
        model: &'static str,
        /// the feature
        feature: String,
        /// its kind
        kind: &'static str,
        /// the kinds that the model reads
        reads: String,
    },
    /// A statistic that normalisation needs.
    #[error("statistic {name} is missing; given: {given}")]
    MissingStatistic {
        /// for example `action.std`
        name: String,
        /// the names that were given (shortened)
        given: String,
    },
    /// A number that is not finite.
    #[error("step {step}: {tensor} is not finite ({value})")]
    NotFinite {
        /// the optimiser step
        step: u64,
        /// the tensor, for example `loss` or `gradient of action_head.weight`
        tensor: String,
        /// the value that was found
        value: f32,
    },
    /// A parameter that the loss does not reach.
    #[error("parameter {name} got no gradient")]
    NoGradient {
        /// the parameter
        name: String,
    },
    /// Saved state that does not fit the object that should take it.
    #[error("restore {object}: {detail}")]
    State {
        /// what was being restored
        object: &'static str,
        /// what does not fit
        detail: String,
    },
    /// A policy that runs elsewhere, in Python or on a server, failed or did not answer as it should.
    #[error("{policy}: {reason}")]
    External {
        /// the policy: its class, or the address of its server
        policy: String,
        /// what happened
        reason: String,
    },
    /// The tensor library refused an operation.
    #[error("tensor operation failed")]
    Tensor(#[from] candle_core::Error),
}

/// `Result` with this crate's error.
pub type Result<T> = std::result::Result<T, ModelError>;

/// The first names of a set, for a message.
pub fn some_names<'a>(names: impl IntoIterator<Item = &'a String>) -> String {
    let names: BTreeSet<&String> = names.into_iter().collect();
    let total = names.len();
    let shown: Vec<&str> = names.iter().take(8).map(|n| n.as_str()).collect();
    match total {
        0 => "nothing".to_string(),
        n if n > shown.len() => format!("{}, … ({n} in all)", shown.join(", ")),
        _ => shown.join(", "),
    }
}
