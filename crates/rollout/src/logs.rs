//! Folders for what workers say: locked while they are used, so that those of a killed program can be told and removed.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::time::Duration;

use tempfile::TempDir;

use crate::error::RolloutError;
use crate::locks;

const PREFIX: &str = "actrm-workers-";
const LOCK: &str = "lock";
/// The lock before it is held.
const UNLOCKED: &str = "lock.new";

/// A folder without a lock file is one that is being made, or whose maker was killed at that moment.
const BEING_MADE: Duration = Duration::from_secs(3600);

/// A temporary folder of this process.
pub(crate) struct LogFolder {
    folder: TempDir,
    /// The process that made it: one that was forked from it must not remove it.
    owner: u32,
    _lock: File,
}

impl Drop for LogFolder {
    fn drop(&mut self) {
        self.folder.disable_cleanup(self.owner != std::process::id());
    }
}

impl LogFolder {
    /// Makes a folder in the system's temporary one, and removes those whose makers are gone.
    ///
    /// # Errors
    /// The folder or its lock cannot be made.
    pub(crate) fn make() -> Result<Self, RolloutError> {
        Self::make_in(&std::env::temp_dir())
    }

    fn make_in(parent: &Path) -> Result<Self, RolloutError> {
        sweep(parent);
        let made = tempfile::Builder::new().prefix(PREFIX).tempdir_in(parent);
        let folder = made.map_err(RolloutError::file("creating log folder", parent))?;
        // a lock under its own name is held from the start: whoever sweeps at this moment sees a folder that is being made
        let (unlocked, path) = (folder.path().join(UNLOCKED), folder.path().join(LOCK));
        let lock = File::create(&unlocked).and_then(|lock| {
            // where nothing can be locked nobody takes it for abandoned
            locks::lock(&lock, folder.path())?;
            fs::rename(&unlocked, &path)?;
            Ok(lock)
        });
        let lock = lock.map_err(RolloutError::file("locking", path))?;
        Ok(Self { folder, owner: std::process::id(), _lock: lock })
    }

    /// Where it is.
    pub(crate) fn path(&self) -> PathBuf {
        self.folder.path().to_owned()
    }
}

/// Removes folders that nobody holds; one that cannot be removed is left to somebody who can.
fn sweep(parent: &Path) {
    let Ok(entries) = fs::read_dir(parent) else { return };
    for entry in entries.flatten() {
        let ours = entry.file_name().to_str().is_some_and(|name| name.starts_with(PREFIX));
        if ours && entry.file_type().is_ok_and(|kind| kind.is_dir()) && abandoned(&entry.path()) {
            let _ = fs::remove_dir_all(entry.path());
        }
    }
}

fn abandoned(folder: &Path) -> bool {
    match File::open(folder.join(LOCK)) {
        Ok(lock) => lock.try_lock().is_ok(),
        Err(_) => {
            let age = fs::metadata(folder).and_then(|data| data.modified()).ok().and_then(|time| time.elapsed().ok());
            age.is_some_and(|age| age > BEING_MADE)
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn folders_of_the_dead_are_removed_and_those_of_the_living_are_not() {
        let parent = tempfile::tempdir().unwrap();
        let alive = LogFolder::make_in(parent.path()).unwrap();
        fs::write(alive.path().join("worker-0.0.stderr"), "still here").unwrap();
        // as a killed program leaves them: locked by nobody
        let dead = parent.path().join(format!("{PREFIX}dead"));
        fs::create_dir(&dead).unwrap();
        fs::write(dead.join(LOCK), "").unwrap();
        fs::write(dead.join("worker-0.0.stderr"), "last words").unwrap();
        let (young, old, other) =
            (parent.path().join(format!("{PREFIX}young")), parent.path().join(format!("{PREFIX}old")), "another-dead");
        fs::create_dir(&young).unwrap();
        fs::create_dir(&old).unwrap();
        let long_ago = std::time::SystemTime::now() - 2 * BEING_MADE;
        File::open(&old).unwrap().set_modified(long_ago).unwrap();
        fs::create_dir(parent.path().join(other)).unwrap();
        let next = LogFolder::make_in(parent.path()).unwrap();
        assert!(!dead.exists() && !old.exists());
        assert!(alive.path().join("worker-0.0.stderr").exists() && next.path().exists());
        assert!(young.exists() && parent.path().join(other).exists());
        let gone = alive.path();
        drop(alive);
        assert!(!gone.exists());
    }

    #[test]
    fn folders_made_at_the_same_time_do_not_take_each_other_for_abandoned() {
        let parent = tempfile::tempdir().unwrap();
        std::thread::scope(|scope| {
            for _ in 0..8 {
                scope.spawn(|| {
                    for _ in 0..300 {
                        let folder = LogFolder::make_in(parent.path()).unwrap();
                        fs::write(folder.path().join("worker-0.0.stderr"), "here").unwrap();
                        std::thread::yield_now();
                        assert!(folder.path().join("worker-0.0.stderr").exists());
                    }
                });
            }
        });
    }
}
