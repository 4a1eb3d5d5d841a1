//! From an experiment file to results.
//!
//! An experiment says what to train on what; a run trains it, with checkpoints that resume to the same
//! bytes; an entry seals the result as `name@version` with a hash of every file; the registry finds
//! entries again; evaluations run them in simulators and keep what came of it.
//!
//! What this crate is not: it reads no HDF5 (that is `dataset`), contains no model and no optimiser
//! (`models`), starts no process (`rollout`), makes no tables for readers (`report`), knows no puzzle (`study`), and
//! neither reads the command line nor prints (`tools`).

pub mod config;
pub mod conventions;
pub mod entry;
mod error;
pub mod experiment;
pub mod external;
mod feature_keys;
pub mod registry;
pub mod run;
pub mod tensors;
mod transforms;

// evaluations
pub mod evaluation;
pub mod protocols;

use ::results::files;
pub use ::results::{self, sha256_file, sha256_hex, write_atomic, write_together};
pub use error::ZooError;
pub use feature_keys::{FeatureKeys, Past};
pub use transforms::{Stage, Transforms};

/// What makes entries, by name: the software's versions, the compiler, what it compiled for, and the vectors of this
/// machine. The same weights come out where all of these are the same.
pub fn versions() -> std::collections::BTreeMap<String, String> {
    let versions = [
        ("actrm", env!("CARGO_PKG_VERSION")),
        ("candle", CANDLE),
        ("rustc", env!("ACTRM_RUSTC")),
        ("target", env!("ACTRM_TARGET")),
        ("vectors", models::vectors()),
    ];
    versions.into_iter().map(|(name, version)| (name.to_owned(), version.to_owned())).collect()
}

/// The pinned version of candle; a test compares it with the workspace's manifest.
const CANDLE: &str = "0.11.1";

#[cfg(test)]
mod tests {
    #[test]
    fn the_version_of_candle_is_the_pinned_one() {
        let manifest = include_str!("../../../Cargo.toml");
        assert!(manifest.contains(&format!("candle-core = {{ version = \"={}\"", super::CANDLE)));
    }
}
