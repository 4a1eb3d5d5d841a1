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
    if holds(kind) {
        found.push(folder.to_path_buf());
    } else if holds(&["model.safetensors"]) {
        let known = holds(&ACT) || holds(&TRM);
        assert!(known, "{}: expected {ACT:?} or {TRM:?}, found {entries:?}", folder.display());
    }
    entries.iter().filter(|path| path.is_dir()).for_each(|path| walk(path, kind, found));
}
