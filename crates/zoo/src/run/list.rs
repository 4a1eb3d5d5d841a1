//! Which runs there are under a folder: what is training, what was stopped and can go on, what is finished.

use std::fs::{self, File};
use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::ZooError;

use super::checkpoint::Checkpoint;
use super::folder::COMMAND_FILE;

/// How a run stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum RunState {
    /// A process is training in it.
    Training,
    /// It was begun and has no entry yet.
    Stopped,
    /// Its entry is in a zoo.
    Finished,
}

impl RunState {
    /// The word for it.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Training => "training",
            Self::Stopped => "stopped",
            Self::Finished => "finished",
        }
    }
}

/// A run that was begun.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FoundRun {
    /// Its folder.
    pub folder: PathBuf,
    /// The experiment, by the name of the folder above.
    pub experiment: String,
    /// How it stands.
    pub state: RunState,
    /// Steps done at its newest checkpoint.
    pub step: u64,
    /// Steps in all, if its settings can be read.
    pub steps: Option<u64>,
    /// The command that goes on with it, if it is recorded.
    pub command: Option<String>,
}

/// Every run that was begun under `runs`, by experiment and number. A folder that is not there holds none. A run whose notes cannot
/// be read hides no other: it is left out and told to `left_out`.
///
/// # Errors
/// Folders that cannot be read.
pub fn list_runs(runs: &Path, left_out: &mut dyn FnMut(ZooError)) -> Result<Vec<FoundRun>, ZooError> {
    let mut found = Vec::new();
    if !runs.is_dir() {
        return Ok(found);
    }
    for parent in folders(runs)? {
        for folder in folders(&parent)? {
            let config = folder.join("config.toml");
            if !config.is_file() {
                continue;
            }
            let experiment = parent.file_name().unwrap_or_default().to_string_lossy().into_owned();
            match one(folder, experiment) {
                Ok(run) => found.push(run),
                Err(error) => left_out(error),
            }
        }
    }
    Ok(found)
}

fn one(folder: PathBuf, experiment: String) -> Result<FoundRun, ZooError> {
    let config = folder.join("config.toml");
    let text = fs::read_to_string(&config).map_err(ZooError::io("read", &config))?;
    Ok(FoundRun {
        experiment,
        state: state(&folder)?,
        step: Checkpoint::latest_step(&folder.join("checkpoints"))?,
        steps: steps(&text),
        command: fs::read_to_string(folder.join(COMMAND_FILE)).ok().map(|text| text.trim_end().to_owned()),
        folder,
    })
}

fn state(folder: &Path) -> Result<RunState, ZooError> {
    if folder.join("finished.json").exists() {
        return Ok(RunState::Finished);
    }
    let path = folder.join("lock");
    let Ok(lock) = File::open(&path) else { return Ok(RunState::Stopped) };
    // shared, and given back at once
    match rollout::try_lock_shared(&lock, folder).map_err(ZooError::io("lock", path))? {
        true => Ok(RunState::Stopped),
        false => Ok(RunState::Training),
    }
}

/// Steps that the settings ask for.
fn steps(config: &str) -> Option<u64> {
    let table: toml::Table = toml::from_str(config).ok()?;
    u64::try_from(table.get("train")?.get("steps")?.as_integer()?).ok()
}

/// Folders in a folder, sorted; hidden ones left out.
fn folders(folder: &Path) -> Result<Vec<PathBuf>, ZooError> {
    let mut found = Vec::new();
    for item in fs::read_dir(folder).map_err(ZooError::io("read folder", folder))? {
        let item = item.map_err(ZooError::io("read folder", folder))?;
        if item.path().is_dir() && !item.file_name().as_encoded_bytes().starts_with(b".") {
            found.push(item.path());
        }
    }
    found.sort();
    Ok(found)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::run::RunFolder;

    #[test]
    fn runs_are_told_apart_by_how_they_stand() {
        let root = tempfile::tempdir().unwrap();
        let list = |folder: &Path| {
            let mut left_out = Vec::new();
            let found = list_runs(folder, &mut |error| left_out.push(error.to_string())).unwrap();
            (found, left_out)
        };
        assert!(list(&root.path().join("none")).0.is_empty());
        let begin = |text: &str| {
            let folder = RunFolder::next(root.path(), "e").unwrap();
            fs::write(folder.config_path(), text).unwrap();
            folder
        };
        let training = begin("[train]\nsteps = 50");
        let stopped = begin("not TOML at all [");
        fs::write(stopped.path().join(COMMAND_FILE), "actrm-zoo train e\n").unwrap();
        fs::create_dir(stopped.checkpoints()).unwrap();
        let note = "{\"file\": \"x\", \"sha256\": \"y\", \"step\": 20}";
        fs::write(stopped.checkpoints().join("latest.json"), note).unwrap();
        drop(stopped);
        let finished = begin("[train]\nsteps = 7");
        fs::write(finished.finished_path(), "{}").unwrap();
        drop(finished);
        drop(RunFolder::next(root.path(), "e").unwrap());
        let (found, left_out) = list(root.path());
        assert!(left_out.is_empty());
        let short: Vec<_> = found.iter().map(|run| (run.state, run.step, run.steps)).collect();
        assert_eq!(
            short,
            [(RunState::Training, 0, Some(50)), (RunState::Stopped, 20, None), (RunState::Finished, 0, Some(7))]
        );
        assert_eq!(found[1].command.as_deref(), Some("actrm-zoo train e"));
        drop(training);
        assert_eq!(list(root.path()).0[0].state, RunState::Stopped);
        // a damaged run is named and hides no other
        fs::write(root.path().join("e/002/checkpoints/latest.json"), "{").unwrap();
        let (found, left_out) = list(root.path());
        assert_eq!((found.len(), left_out.len()), (2, 1));
        assert!(left_out[0].contains("latest.json"), "{left_out:?}");
    }
}
