//! Checkpoints of other people's that are pickles: the harness reads them, in a process with limits, and says what stands in
//! them as a frame. A pickle is a program; it is read nowhere else, and run nowhere.

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use crate::error::{FaultKind, RolloutError};
use crate::harness::{Python, harness_folder};
use crate::process::{Limit, Process};
use crate::spec::boot;

/// The longest that reading may take; a checkpoint of 100 MB takes a second.
const PATIENCE: Duration = Duration::from_secs(120);
/// The most private memory, in bytes: a frame of 256 MB, its parts and numpy.
const MEMORY: u64 = 2 << 30;

/// What robomimic's `save_model` stored in the file `path`: safetensors bytes, the weights by robomimic's names and, as JSON
/// under the metadata key `actrm`, what stands beside them.
///
/// # Errors
/// [`RolloutError::Checkpoint`] with what the harness says is wrong with the file.
pub fn read_robomimic(python: &Python, path: &Path) -> Result<Vec<u8>, RolloutError> {
    let refused = |problem: String| RolloutError::Checkpoint { path: path.to_owned(), problem };
    let log = tempfile::NamedTempFile::new().map_err(RolloutError::file("creating a log for reading", path))?;
    let mut command = Command::new(&python.path);
    command.args(["-c", &boot("actrm_harness.robomimic")]).arg(path);
    command.env("PYTHONPATH", harness_folder()?).env("OPENBLAS_NUM_THREADS", "1");
    let mut process = Process::spawn(command, log.path(), Some(MEMORY))?;
    process.receive(Limit::of(PATIENCE)).map_err(|fault| {
        let said = process.stderr_tail();
        match fault {
            FaultKind::Died(_) if !said.is_empty() => refused(said),
            fault => refused(format!("reading it: {fault}")),
        }
    })
}
