//! The folders above an output.

use anyhow::Result;
use std::path::{Path, PathBuf};

/// Folders that were made for an output. Those of them that are empty in the end are removed again.
pub struct Parents(Vec<PathBuf>);

impl Parents {
    /// Makes the folders that a file or folder at `out` will be in.
    ///
    /// # Errors
    /// A folder that cannot be made.
    pub fn make(out: &Path) -> Result<Self> {
        let missing = |folder: &&Path| !folder.as_os_str().is_empty() && !folder.exists();
        let made = Self(out.ancestors().skip(1).take_while(missing).map(Path::to_path_buf).collect());
        cli::make_parent(out)?;
        Ok(made)
    }
}

impl Drop for Parents {
    fn drop(&mut self) {
        for folder in &self.0 {
            // one that holds something stays
            let _ = std::fs::remove_dir(folder);
        }
    }
}
