//! What can go wrong with results.

use std::path::PathBuf;

/// An operation on results that failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ResultsError {
    /// The operating system refused a file operation.
    #[error("cannot {operation} {}", path.display())]
    Io {
        /// What was tried: `read`, `write`, `create folder`, …
        operation: &'static str,
        /// On which file or folder.
        path: PathBuf,
        /// Why it failed.
        #[source]
        source: std::io::Error,
    },
    /// A file that this crate wrote does not have the form it was written in.
    #[error("{}: {reason}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// A key holds something that it cannot.
    #[error("key `{key}`: expected {expected}, found {found}")]
    InvalidValue {
        /// Dotted path of the key.
        key: String,
        /// What would be allowed.
        expected: String,
        /// What is there.
        found: String,
    },
    /// A file of an entry is not the one that was written.
    #[error("{}: sha256 does not match: expected {expected}, found {found}", path.display())]
    Tampered {
        /// The file.
        path: PathBuf,
        /// The recorded hash.
        expected: String,
        /// The hash of what is there, or `no such file`.
        found: String,
    },
    /// A table of results cannot be read or written.
    #[error("cannot {operation} {}", path.display())]
    Table {
        /// What was tried.
        operation: &'static str,
        /// The file.
        path: PathBuf,
        /// What the Parquet library said.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// Another process evaluates the same thing into the same folder.
    #[error("results folder {} is in use by another evaluation", folder.display())]
    Busy {
        /// The evaluation's folder.
        folder: PathBuf,
    },
    /// What is stored and what was found now are not the same.
    #[error("results in {}: {what} differs: stored {expected}, now {found}", folder.display())]
    Differ {
        /// The evaluation's folder.
        folder: PathBuf,
        /// What differs.
        what: String,
        /// What is stored.
        expected: String,
        /// What was found.
        found: String,
    },
    /// A finished evaluation without a seal: it was made before there were seals, or its seal was taken away.
    #[error(
        "results in {}: not sealed, so nothing says that they are as they were measured; run all of its episodes again with `eval --again`, which seals them where every outcome is the same",
        folder.display()
    )]
    Unsealed {
        /// The evaluation's folder.
        folder: PathBuf,
    },
    /// A result does not fit its folder, its seal or its entry.
    #[error("results in {}: {what}: expected {expected}, found {found}", folder.display())]
    Unfit {
        /// The evaluation's folder.
        folder: PathBuf,
        /// What does not fit.
        what: String,
        /// What the seal, the entry or the record says.
        expected: String,
        /// What is there.
        found: String,
    },
    /// Shards that are not parts of one evaluation.
    #[error("cannot merge {}: {what}: expected {expected}, found {found}", folder.display())]
    Merge {
        /// The shard.
        folder: PathBuf,
        /// What does not fit.
        what: String,
        /// What the others have.
        expected: String,
        /// What this one has.
        found: String,
    },
}

impl ResultsError {
    /// Builds the closure that `map_err` wants around a file operation.
    pub fn io(operation: &'static str, path: impl Into<PathBuf>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.into();
        move |source| Self::Io { operation, path, source }
    }
}
