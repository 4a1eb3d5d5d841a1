//! The folder of a run: `runs/<experiment>/<number>/`, one training at a time.

use std::fs::{self, File};
use std::path::{Path, PathBuf};

use crate::ZooError;
use crate::files::sweep;

/// In a run's folder: the command that goes on with it, for people.
pub const COMMAND_FILE: &str = "command.txt";
/// Held by the training that works there.
const LOCK: &str = "lock";
/// The command that trains what is trained there.
const BEGUN: &str = "begun.txt";
/// What the run stands on.
pub(super) const NOTE: &str = "run.json";
/// The resolved experiment.
const CONFIG: &str = "config.toml";
const FINISHED: &str = "finished.json";
/// The entry that the run is about to get.
pub(super) const SEALING: &str = "sealing.json";

/// A run's folder, locked for as long as this value lives.
#[derive(Debug)]
pub struct RunFolder {
    path: PathBuf,
    /// Folders that were made for it, innermost first.
    made: Vec<PathBuf>,
    _lock: File,
}

/// Folders of a path that are not there yet, innermost first.
fn missing(path: &Path) -> Vec<PathBuf> {
    let named = path.ancestors().filter(|folder| !folder.as_os_str().is_empty());
    named.take_while(|folder| !folder.exists()).map(Path::to_owned).collect()
}

impl RunFolder {
    /// Makes the next numbered folder under `runs/<experiment>/`; concurrent callers get different ones.
    ///
    /// # Errors
    /// When the folder cannot be made.
    pub fn next(runs: &Path, experiment: &str) -> Result<Self, ZooError> {
        let parent = runs.join(experiment);
        let mut made = missing(&parent);
        fs::create_dir_all(&parent).map_err(ZooError::io("create folder", &parent))?;
        loop {
            let number = numbers(&parent)?.last().map_or(1, |n| n + 1);
            let path = parent.join(format!("{number:03}"));
            match fs::create_dir(&path) {
                Ok(()) => {
                    made.insert(0, path.clone());
                    return Self::lock(path, made);
                }
                Err(e) if e.kind() == std::io::ErrorKind::AlreadyExists => {}
                Err(e) => return Err(ZooError::io("create folder", path)(e)),
            }
        }
    }

    /// Begins a run in exactly this folder, which must be new, empty, or one in which a run was about to begin.
    ///
    /// # Errors
    /// [`ZooError::RunLocked`] while another training works there, [`ZooError::RunExists`] after one did,
    /// [`ZooError::NotARun`] for a folder with files of others.
    pub fn fresh(path: &Path) -> Result<Self, ZooError> {
        let made = missing(path);
        fs::create_dir_all(path).map_err(ZooError::io("create folder", path))?;
        // what a start that was killed left may go, and nothing else: its lock is empty, its data a whole set
        let data = path.join(super::data::CONVERTED);
        if data.exists() && !data.join("meta/info.json").is_file() {
            let found = super::data::CONVERTED.to_owned();
            return Err(ZooError::NotARun { folder: path.to_owned(), found });
        }
        let locked = path.join(LOCK).metadata().is_ok_and(|lock| lock.is_file() && lock.len() == 0);
        let first = fs::read_dir(path).map_err(ZooError::io("read folder", path))?.next().transpose();
        if let (false, Some(found)) = (locked, first.map_err(ZooError::io("read folder", path))?) {
            let found = found.file_name().to_string_lossy().into_owned();
            return Err(ZooError::NotARun { folder: path.to_owned(), found });
        }
        let folder = Self::lock(path.to_owned(), made)?;
        if folder.config_path().exists() {
            return Err(ZooError::RunExists { folder: path.to_owned() });
        }
        Ok(folder)
    }

    /// Takes up the run in exactly this folder.
    ///
    /// # Errors
    /// [`ZooError::RunLocked`] while another training works there, [`ZooError::NothingToResume`] where no
    /// run was begun or it is finished.
    pub fn resume(path: &Path) -> Result<Self, ZooError> {
        let nothing = |reason: &str| ZooError::NothingToResume { folder: path.to_owned(), reason: reason.to_owned() };
        if !path.is_dir() {
            return Err(nothing("there is no such folder"));
        }
        if !path.join(CONFIG).exists() {
            return Err(nothing("no run was begun there"));
        }
        let folder = Self::lock(path.to_owned(), Vec::new())?;
        if folder.finished_path().exists() {
            return Err(nothing("the run is finished"));
        }
        Ok(folder)
    }

    /// Takes up the latest run of `experiment` that is not finished.
    ///
    /// # Errors
    /// As [`RunFolder::resume`].
    pub fn resume_latest(runs: &Path, experiment: &str) -> Result<Self, ZooError> {
        let parent = runs.join(experiment);
        let all = match parent.is_dir() {
            true => numbers(&parent)?,
            false => Vec::new(),
        };
        let folders: Vec<PathBuf> = all.iter().rev().map(|number| parent.join(format!("{number:03}"))).collect();
        let begun = |folder: &&PathBuf| folder.join(CONFIG).exists() && !folder.join(FINISHED).exists();
        match folders.iter().find(begun).or(folders.first()) {
            Some(folder) => Self::resume(folder),
            None => Err(ZooError::NothingToResume { folder: parent, reason: "no run was begun there".to_owned() }),
        }
    }

    fn lock(path: PathBuf, made: Vec<PathBuf>) -> Result<Self, ZooError> {
        let file_path = path.join(LOCK);
        let file = File::options().write(true).create(true).truncate(false).open(&file_path);
        let file = file.map_err(ZooError::io("create", &file_path))?;
        if !rollout::try_lock(&file, &path).map_err(ZooError::io("lock", file_path))? {
            return Err(ZooError::RunLocked { folder: path });
        }
        let folder = Self { path, made, _lock: file };
        sweep(&folder.path)?;
        sweep(&folder.checkpoints())?;
        Ok(folder)
    }

    /// Removes what a run that never began has put here, and the folders that were made for it. Files of others
    /// stay, and so do their folders.
    pub(super) fn discard(&self) {
        // whatever cannot be removed is not worth hiding the error that led here
        let _ = fs::remove_dir_all(self.path.join(super::data::CONVERTED));
        // the lock last: it says that the others are ours
        for name in [BEGUN, NOTE, COMMAND_FILE, LOCK] {
            let _ = fs::remove_file(self.path.join(name));
        }
        for folder in &self.made {
            if fs::remove_dir(folder).is_err() {
                return;
            }
        }
    }

    /// The folder itself.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The resolved experiment; its presence says that a run was begun.
    pub fn config_path(&self) -> PathBuf {
        self.path.join(CONFIG)
    }

    /// Written last; its presence says that the run is finished.
    pub fn finished_path(&self) -> PathBuf {
        self.path.join(FINISHED)
    }

    /// The entry that the run is about to get.
    pub(super) fn sealing_path(&self) -> PathBuf {
        self.path.join(SEALING)
    }

    /// The command that trains what is trained here, if the run was begun by one.
    pub(super) fn begun_path(&self) -> PathBuf {
        self.path.join(BEGUN)
    }

    /// What is written there.
    pub(super) fn begun(&self) -> Result<Option<String>, ZooError> {
        let path = self.begun_path();
        match path.is_file() {
            true => fs::read_to_string(&path).map(Some).map_err(ZooError::io("read", path)),
            false => Ok(None),
        }
    }

    /// Where checkpoints go.
    pub fn checkpoints(&self) -> PathBuf {
        self.path.join("checkpoints")
    }
}

fn numbers(parent: &Path) -> Result<Vec<u32>, ZooError> {
    let mut found = Vec::new();
    for item in fs::read_dir(parent).map_err(ZooError::io("read folder", parent))? {
        let item = item.map_err(ZooError::io("read folder", parent))?;
        found.extend(item.file_name().to_str().and_then(|n| n.parse::<u32>().ok()));
    }
    found.sort_unstable();
    Ok(found)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn one_training_at_a_time() {
        let root = tempfile::tempdir().unwrap();
        let path = root.path().join("r");
        let first = RunFolder::fresh(&path).unwrap();
        let error = RunFolder::fresh(&path).unwrap_err();
        assert!(error.to_string().contains("in use by another training"), "{error}");
        fs::write(first.config_path(), "").unwrap();
        assert!(matches!(RunFolder::resume(&path), Err(ZooError::RunLocked { .. })));
        fs::remove_file(first.config_path()).unwrap();
        drop(first);
        RunFolder::fresh(&path).unwrap();
    }

    #[test]
    fn a_run_that_never_began_removes_its_own_alone() {
        let root = tempfile::tempdir().unwrap();
        fs::create_dir(root.path().join("data")).unwrap();
        fs::write(root.path().join("data/mine.hdf5"), "mine").unwrap();
        let error = RunFolder::fresh(root.path()).unwrap_err().to_string();
        assert!(error.contains("expected a new or empty folder, found data in it"), "{error}");
        assert_eq!(fs::read_to_string(root.path().join("data/mine.hdf5")).unwrap(), "mine");
        assert_eq!(fs::read_dir(root.path()).unwrap().count(), 1);
        // nor do they go where a start that was killed has left its lock
        fs::write(root.path().join(LOCK), "").unwrap();
        assert!(RunFolder::fresh(root.path()).is_err());
        assert_eq!(fs::read_to_string(root.path().join("data/mine.hdf5")).unwrap(), "mine");
        let path = root.path().join("r/s");
        let folder = RunFolder::fresh(&path).unwrap();
        fs::create_dir(path.join("data")).unwrap();
        folder.discard();
        assert!(!path.exists() && !root.path().join("r").exists());
        // an empty folder of the user's stays
        fs::create_dir_all(&path).unwrap();
        RunFolder::fresh(&path).unwrap().discard();
        assert_eq!(fs::read_dir(&path).unwrap().count(), 0);
        RunFolder::next(&path, "e").unwrap().discard();
        assert_eq!(fs::read_dir(&path).unwrap().count(), 0);
    }

    #[test]
    fn fresh_and_resume_tell_runs_apart() {
        let root = tempfile::tempdir().unwrap();
        let path = root.path().join("r");
        let reason = |r: Result<RunFolder, ZooError>| r.unwrap_err().to_string();
        assert!(reason(RunFolder::resume(&path)).ends_with("no such folder"));
        let folder = RunFolder::fresh(&path).unwrap();
        let (config, finished) = (folder.config_path(), folder.finished_path());
        drop(folder);
        assert!(reason(RunFolder::resume(&path)).ends_with("no run was begun there"));
        fs::write(config, "").unwrap();
        assert!(reason(RunFolder::fresh(&path)).contains("already holds a run"));
        RunFolder::resume(&path).unwrap();
        fs::write(finished, "{}").unwrap();
        assert!(reason(RunFolder::resume(&path)).ends_with("the run is finished"));
    }

    #[test]
    fn numbers_go_up_and_the_latest_is_resumed() {
        let root = tempfile::tempdir().unwrap();
        let reason = RunFolder::resume_latest(root.path(), "e").unwrap_err();
        assert!(matches!(reason, ZooError::NothingToResume { .. }));
        let names: Vec<_> = (0..3)
            .map(|_| RunFolder::next(root.path(), "e").unwrap())
            .map(|f| f.path().file_name().unwrap().to_owned())
            .collect();
        assert_eq!(names, ["001", "002", "003"]);
        fs::write(root.path().join("e/003/config.toml"), "").unwrap();
        let folder = RunFolder::resume_latest(root.path(), "e").unwrap();
        assert!(folder.path().ends_with("e/003"));
        // a later one that is finished hides no other
        fs::write(folder.finished_path(), "{}").unwrap();
        drop(folder);
        fs::write(root.path().join("e/001/config.toml"), "").unwrap();
        assert!(RunFolder::resume_latest(root.path(), "e").unwrap().path().ends_with("e/001"));
    }
}
