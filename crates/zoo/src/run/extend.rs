//! A finished run once more with more steps, in a folder of its own.

use std::fs;
use std::path::{Path, PathBuf};

use models::Schedule;

use crate::experiment::Experiment;
use crate::{ZooError, write_atomic};

use super::folder::RunFolder;
use super::session::{Settings, finished_entry};

/// A run that goes on where another one was finished.
pub struct Extended {
    /// Name of its experiment.
    pub name: String,
    /// The experiment with more steps.
    pub experiment: Experiment,
    /// Its folder: `TrainRequest` resumes it.
    pub folder: PathBuf,
    /// The command that trains the same from the beginning, where the finished run has one.
    pub command: Option<String>,
}

/// Makes a run below `runs` of the finished one in `run` that ends after `steps` steps. It ends in the bytes of a run that had this many steps
/// from the beginning; so the learning rate must not depend on their number.
///
/// # Errors
/// A run that is not finished or is no robot policy's; a schedule that depends on the number of steps; no more steps than it has.
pub fn extend(run: &Path, runs: &Path, steps: u64) -> Result<Extended, ZooError> {
    let nothing = |reason: &str| ZooError::NothingToResume { folder: run.to_owned(), reason: reason.to_owned() };
    if !run.is_dir() {
        return Err(nothing(
            "there is no such folder; `train` prints the folder of its run, such as runs/act_lift/001",
        ));
    }
    let Some(entry) = finished_entry(run)? else {
        return Err(nothing("it is not finished; --resume continues it"));
    };
    let read = |name: &str| fs::read_to_string(run.join(name)).map_err(ZooError::io("read", run.join(name)));
    let note: serde_json::Value = serde_json::from_str(&read("run.json")?)
        .map_err(|e| ZooError::Malformed { path: run.join("run.json"), reason: format!("not a run's note: {e}") })?;
    let Some(name) = note["experiment"].as_str().map(str::to_owned) else {
        return Err(nothing("it is no training of a robot policy"));
    };
    let mut experiment = Experiment::from_toml(&name, &read("config.toml")?)?;
    if experiment.train.schedule != Schedule::Constant {
        let reason = format!(
            "cannot be extended, because its cosine schedule depends on the number of steps. Train with \
             train.schedule=constant, or begin another training with its weights: --from {entry}"
        );
        return Err(ZooError::NotPossible { what: format!("run {}", run.display()), reason });
    }
    if steps <= experiment.train.steps {
        let expected = format!("more than the {} of the finished run", experiment.train.steps);
        return Err(ZooError::InvalidValue { key: "train.steps".to_owned(), expected, found: steps.to_string() });
    }
    experiment.train.steps = steps;
    let more = format!(" train.steps={steps}");
    let command = run.join("begun.txt").is_file().then(|| read("begun.txt")).transpose()?;
    let command = command.map(|begun| begun.trim_end().to_owned() + &more);
    let folder = RunFolder::next(runs, &name)?;
    let fill = || -> Result<(), ZooError> {
        copy(
            run,
            folder.path(),
            &["lock", "config.toml", "finished.json", "sealing.json", "begun.txt", super::COMMAND_FILE],
        )?;
        if let Some(command) = &command {
            write_atomic(&folder.begun_path(), format!("{command}\n").as_bytes())?;
        }
        // last: its presence says that the run was begun
        write_atomic(&folder.config_path(), experiment.text().as_bytes())?;
        Ok(())
    };
    if let Err(error) = fill() {
        // the folder is new; whatever cannot be removed is not worth hiding the error
        let _ = fs::remove_dir_all(folder.path());
        return Err(error);
    }
    Ok(Extended { name, experiment, folder: folder.path().to_owned(), command })
}

/// Copies a folder's files but those of these names.
fn copy(from: &Path, to: &Path, but: &[&str]) -> Result<(), ZooError> {
    for item in fs::read_dir(from).map_err(ZooError::io("read folder", from))? {
        let item = item.map_err(ZooError::io("read folder", from))?;
        let (source, target) = (item.path(), to.join(item.file_name()));
        if but.iter().any(|name| item.file_name() == *name) {
            continue;
        }
        if source.is_dir() {
            fs::create_dir_all(&target).map_err(ZooError::io("create folder", &target))?;
            copy(&source, &target, &[])?;
        } else {
            fs::copy(&source, &target).map_err(ZooError::io("copy", &source))?;
        }
    }
    Ok(())
}
