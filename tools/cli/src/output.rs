//! Writing to standard output and standard error.

use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use serde::Serialize;

use crate::text::plain;

/// Writes text to standard output. A reader that has gone (`| head`) ends the output, it is no error.
///
/// # Errors
/// Anything else that keeps it from being written, such as a full disk.
pub fn print(text: &str) -> Result<()> {
    let text = plain(text);
    let mut out = std::io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(()),
        other => other.context("cannot write to standard output"),
    }
}

/// Writes a value as indented JSON.
///
/// # Errors
/// As [`print`].
pub fn print_json<T: Serialize>(value: &T) -> Result<()> {
    let text = serde_json::to_string_pretty(value).context("cannot write JSON")?;
    print(&(text + "\n"))
}

/// Writes a line for people to standard error. Nobody there to read it is no error.
pub fn note(text: &str) {
    let line = plain(text) + "\n";
    // there is no other place left to complain to
    let _ = std::io::stderr().lock().write_all(line.as_bytes());
}

/// Folders that were made for an output. Those of them that are empty in the end are removed again.
#[must_use = "folders that stay empty are removed when this is dropped"]
pub struct Parents(Vec<PathBuf>);

/// Makes the folders that a file or folder at `path` will be in.
///
/// # Errors
/// A folder that cannot be made.
pub fn make_parent(path: &Path) -> Result<Parents> {
    let missing = |folder: &&Path| !folder.as_os_str().is_empty() && !folder.exists();
    let made = Parents(path.ancestors().skip(1).take_while(missing).map(Path::to_path_buf).collect());
    let folder = made.0.first().map_or(Ok(()), std::fs::create_dir_all);
    folder.with_context(|| format!("cannot create the folder of {}", crate::shown(path)))?;
    Ok(made)
}

/// Refuses a file that is there already, before the work whose result would take its place.
///
/// # Errors
/// There is one.
pub fn refuse_existing(path: &Path) -> Result<()> {
    if path.symlink_metadata().is_ok() {
        bail!("{}: exists already; choose another path or remove it first", crate::shown(path));
    }
    Ok(())
}

/// What a new file needs before the work begins: nothing there of its name, and the folders that it will be in.
///
/// # Errors
/// As [`refuse_existing`] and [`make_parent`].
pub fn new_file(path: &Path) -> Result<Parents> {
    refuse_existing(path)?;
    make_parent(path)
}

impl Drop for Parents {
    fn drop(&mut self) {
        for folder in &self.0 {
            // one that holds something stays
            let _ = std::fs::remove_dir(folder);
        }
    }
}

/// `error: …` in one line.
pub(crate) fn complain(text: &str) {
    note(&format!("error: {}", text.trim_end()));
}
