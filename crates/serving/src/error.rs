//! Everything that can go wrong in this crate.

use std::io;

use models::ModelError;

/// What this crate's functions return.
pub type Result<T> = std::result::Result<T, ServingError>;

/// An operation of this crate that failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ServingError {
    /// A message, or a part of one, that is not what it should be.
    #[error("{key}: expected {expected}, found {found}")]
    Message {
        /// the key in the message, or `message`
        key: String,
        /// what is needed
        expected: String,
        /// what is there
        found: String,
    },
    /// A policy that failed.
    #[error(transparent)]
    Policy(#[from] ModelError),
    /// An address that cannot be listened on.
    #[error("{address}: cannot listen")]
    Listen {
        /// host and port
        address: String,
        /// why
        source: io::Error,
    },
    /// An address that other machines reach, without a token.
    #[error("{address} can be reached from other machines: expected --token, or a loopback address such as 127.0.0.1")]
    Unprotected {
        /// host and port
        address: String,
    },
    /// A token that no client could send.
    #[error("token: expected printable ASCII without blanks, found {found}")]
    Token {
        /// what is wrong with it
        found: &'static str,
    },
    /// A mapping that cannot be read.
    #[error("mapping {name}: {detail}")]
    Mapping {
        /// the preset or file
        name: String,
        /// what is wrong with it
        detail: String,
    },
    /// A policy server that cannot be used.
    #[error("policy server {address}: {detail}")]
    Server {
        /// where it is
        address: String,
        /// what happened
        detail: String,
    },
}

impl ServingError {
    pub(crate) fn message(key: impl Into<String>, expected: impl Into<String>, found: impl Into<String>) -> Self {
        Self::Message { key: key.into(), expected: expected.into(), found: found.into() }
    }
}

impl From<ServingError> for ModelError {
    fn from(error: ServingError) -> Self {
        match error {
            ServingError::Policy(error) => error,
            ServingError::Server { address, detail } => {
                Self::External { policy: format!("policy server {address}"), reason: detail }
            }
            other => Self::External { policy: "policy server".to_owned(), reason: other.to_string() },
        }
    }
}
