//! What tests here share: workers are those of `rollout`'s tests; small trainings.

#![allow(clippy::unwrap_used)]
#![allow(dead_code, reason = "each test file uses its part")]

#[path = "../../../rollout/tests/common/mod.rs"]
mod workers;

use std::path::{Path, PathBuf};

use dataset::{RobomimicWriter, Source, WriteOptions};

#[allow(unused_imports, reason = "each test file uses its part")]
pub use workers::*;

/// Settings with which ACT trains in a moment.
pub const SMALL: [&str; 10] = [
    "policy.dim_model=16",
    "policy.n_heads=2",
    "policy.dim_feedforward=32",
    "policy.n_encoder_layers=1",
    "policy.n_vae_encoder_layers=1",
    "policy.latent_dim=4",
    "train.steps=12",
    "train.batch_size=8",
    "train.log_every=2",
    "train.validate_every=4",
];

/// Three demonstrations, two of them to train on.
pub fn demonstrations(folder: &Path) -> PathBuf {
    let fixture = Path::new(env!("CARGO_MANIFEST_DIR")).join("../dataset/tests/fixtures/lift_low_dim_3_demos.hdf5");
    let out = folder.join("demos.hdf5");
    let source = Source::open(&fixture).unwrap();
    let ids: Vec<String> = source.plan().demos.iter().map(|d| d.id.clone()).collect();
    let mut writer = RobomimicWriter::create(&out, &WriteOptions::default()).unwrap();
    let mut root = source.root().unwrap();
    root.datasets.retain(|name, _| !name.starts_with("mask"));
    writer.set_root(&root).unwrap();
    for index in 0..ids.len() {
        writer.add_demo(&source.read_demo(index).unwrap()).unwrap();
    }
    writer.set_mask("train", &ids[..2]).unwrap();
    writer.set_mask("valid", &ids[2..]).unwrap();
    writer.finish().unwrap();
    out
}
