//! Lists the files of `configs/` and `protocols/`, so that an experiment or a protocol is built in by lying there, and
//! says which compiler made the program for what.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

fn main() {
    list("../../configs", "experiments.rs");
    list("../../protocols", "protocols.rs");
    println!("cargo:rustc-env=ACTRM_RUSTC={}", compiler());
    println!("cargo:rustc-env=ACTRM_TARGET={}", std::env::var("TARGET").expect("cargo sets TARGET"));
}

/// `1.95.0`, or `unknown` of a compiler that does not say.
fn compiler() -> String {
    let rustc = std::env::var_os("RUSTC").expect("cargo sets RUSTC");
    let said = std::process::Command::new(rustc).arg("--version").output();
    let said = said.map(|output| String::from_utf8_lossy(&output.stdout).into_owned()).unwrap_or_default();
    said.split_whitespace().nth(1).unwrap_or("unknown").to_owned()
}

/// Writes name and text of every TOML file below `folder` as a Rust expression.
fn list(folder: &str, out: &str) {
    // asked when it runs: a checkout may have moved, its built script with it
    let here = std::env::var_os("CARGO_MANIFEST_DIR").expect("cargo says where the package is");
    let folder = Path::new(&here).join(folder);
    let mut files = Vec::new();
    below(&folder, &mut files);
    files.sort();
    let mut list = String::from("&[\n");
    for file in &files {
        let name = file.strip_prefix(&folder).expect("below the folder").with_extension("");
        let name = name.to_str().expect("these files have plain names");
        let path = file.canonicalize().expect("a file that was listed");
        writeln!(list, "    ({name:?}, include_str!({path:?})),").expect("a string takes all");
    }
    list.push(']');
    let out = PathBuf::from(std::env::var_os("OUT_DIR").expect("cargo sets OUT_DIR")).join(out);
    std::fs::write(&out, list).unwrap_or_else(|e| panic!("{}: {e}", out.display()));
}

fn below(folder: &Path, into: &mut Vec<PathBuf>) {
    println!("cargo:rerun-if-changed={}", folder.display());
    for item in std::fs::read_dir(folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display())) {
        let path = item.expect("a folder can be listed").path();
        match path.is_dir() {
            true => below(&path, into),
            false if path.extension().is_some_and(|extension| extension == "toml") => into.push(path),
            false => {}
        }
    }
}
