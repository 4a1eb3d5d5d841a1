//! Lists the Python sources of the harness, so that the binaries carry them and work from any folder.
//!
//! Cargo watches the files one by one. If it watched the folder, it would see `__pycache__` too, and running Python would
//! cause a rebuild. A new file is found when another file changes; a test fails if one is missing.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::{env, fs, io};

fn main() -> io::Result<()> {
    let manifest = PathBuf::from(env::var_os("CARGO_MANIFEST_DIR").expect("cargo sets it"));
    let package = manifest.join("../../tools/harness/actrm_harness");
    println!("cargo::rerun-if-changed=build.rs");
    let mut files = Vec::new();
    if package.is_dir() {
        collect(&package, &mut files)?;
    }
    files.sort();
    let mut text = String::from("[\n");
    for path in &files {
        println!("cargo::rerun-if-changed={}", path.display());
        let name = path.strip_prefix(&package).expect("found below the package");
        let name = name.to_str().expect("the harness has plain file names");
        let path = path.canonicalize()?;
        writeln!(text, "    ({name:?}, include_bytes!({:?}) as &[u8]),", path.display().to_string())
            .expect("writing to a string");
    }
    text.push(']');
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets it"));
    fs::write(out.join("harness_files.rs"), text)
}

fn collect(folder: &Path, files: &mut Vec<PathBuf>) -> io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        if path.is_dir() {
            if !path.ends_with("__pycache__") {
                collect(&path, files)?;
            }
        } else if path.extension().is_some_and(|e| e == "py" || e == "typed" || e == "json" || e == "xml") {
            files.push(path);
        }
    }
    Ok(())
}
