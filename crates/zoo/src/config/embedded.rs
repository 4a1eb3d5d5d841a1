//! The files of `configs/`, built into the binary so that it works from any folder.

/// Name and text of every file, sorted by name, as the build script lists them.
pub(super) const FILES: &[(&str, &str)] = include!(concat!(env!("OUT_DIR"), "/experiments.rs"));
