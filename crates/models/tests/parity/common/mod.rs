//! Fixture folders: this repository's, and everybody's own below the directory that `ACTRM_PARITY_DIR` names.
#![allow(clippy::unwrap_used)]
// every test program uses a part of it
#![allow(dead_code)]

pub mod npz;
pub mod recipe;

use std::path::{Path, PathBuf};

/// A folder is a fixture of LeRobot's ACT if it holds these files.
pub const ACT: [&str; 3] = ["config.json", "model.safetensors", "io.npz"];
/// A folder is a fixture of the official TRM if it holds these files.
pub const TRM: [&str; 3] = ["config.json", "model.safetensors", "io.safetensors"];

/// A folder is a fixture of LeRobot's diffusion if it holds these files.
pub const DIFFUSION: [&str; 3] = ["config.json", "model.safetensors", "draws.npz"];
/// A folder is a fixture of Chi et al.'s transformer if it holds these files.
pub const TRANSFORMER: [&str; 3] = ["config.json", "model.safetensors", "transformer.npz"];
/// A folder is a fixture of robomimic's if it holds these files.
pub const ROBOMIMIC: [&str; 3] = ["config.json", "model.safetensors", "robomimic.npz"];

/// A folder is a fixture of LeRobot's ACT with cameras if it holds these files and its configuration has images.
pub const SEEING_ACT: [&str; 2] = ["config.json", "io.npz"];
/// A folder is a fixture of an image encoder alone if it holds these files.
pub const ENCODER: [&str; 3] = ["note.txt", "model.safetensors", "io.npz"];

/// Whether a LeRobot configuration reads images.
fn sees(config: &str) -> bool {
    config.contains(r#""type": "VISUAL""#)
}

/// All fixtures of one kind, in order: those below `tests/fixtures`, which are `shipped` in number, and those below
/// `ACTRM_PARITY_DIR`, at any depth. A folder there with weights that is neither kind is an error, not passed over.
pub fn fixtures(kind: &[&str], shipped: usize) -> Vec<PathBuf> {
    let mut found = Vec::new();
    walk(&Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures"), kind, &mut found);
    assert_eq!(found.len(), shipped, "fixtures of this repository: {found:?}");
    if let Some(own) = std::env::var_os("ACTRM_PARITY_DIR") {
        walk(Path::new(&own), kind, &mut found);
        println!("{} fixtures below {}", found.len() - shipped, own.display());
    }
    found
}

fn walk(folder: &Path, kind: &[&str], found: &mut Vec<PathBuf>) {
    let entries = std::fs::read_dir(folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display()));
    let mut entries: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    entries.sort();
    let holds = |files: &[&str]| files.iter().all(|file| folder.join(file).is_file());
    // the same files with images are the business of `vision_parity.rs`
    let sees = std::fs::read_to_string(folder.join("config.json")).is_ok_and(|text| sees(&text));
    if holds(kind) && sees == (kind == SEEING_ACT) {
        found.push(folder.to_path_buf());
    } else if holds(&["model.safetensors"]) {
        let known = [&ACT, &TRM, &ENCODER, &DIFFUSION, &TRANSFORMER, &ROBOMIMIC].into_iter().any(|kind| holds(kind));
        assert!(known, "{}: expected {ACT:?}, {TRM:?} or {ENCODER:?}, found {entries:?}", folder.display());
    }
    entries.iter().filter(|path| path.is_dir()).for_each(|path| walk(path, kind, found));
}
