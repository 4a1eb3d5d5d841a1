//! Sources that are no HDF5 file: values are those of the format's own reader.

mod lerobot_v2;
mod rlds;
mod zarr;

use std::path::{Path, PathBuf};

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name)
}

fn quiet(_: u64, _: u64) {}
