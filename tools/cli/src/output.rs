//! Writing to standard output and standard error.

use std::io::{ErrorKind, Write};
use std::path::Path;

use anyhow::{Context, Result};
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

/// Makes the folders that a file or folder at `path` will be in.
///
/// # Errors
/// A folder that cannot be made.
pub fn make_parent(path: &Path) -> Result<()> {
    let parent = path.parent().filter(|parent| !parent.as_os_str().is_empty() && !parent.exists());
    parent
        .map_or(Ok(()), std::fs::create_dir_all)
        .with_context(|| format!("cannot create the folder of {}", crate::shown(path)))
}

/// `error: …` in one line.
pub(crate) fn complain(text: &str) {
    note(&format!("error: {}", text.trim_end()));
}
