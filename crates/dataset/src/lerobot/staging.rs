//! A folder that appears whole or not at all.
//!
//! Everything is written into a hidden folder beside the target; [`Staging::publish`] flushes it to disk and
//! renames it, or exchanges it with the folder that it replaces. A writer that is killed leaves a hidden folder, locked by
//! nobody, and the next writer of the same target removes it.

use super::other_files;
use super::work::in_order;
use crate::error::{DatasetError, Result};
use rustix::fs::{CWD, RenameFlags, renameat_with};
use std::collections::BTreeMap;
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// How the work of this process on a target ended.
#[derive(Clone, Copy, PartialEq, Eq)]
enum End {
    /// It was given up: nothing gets the name any more.
    GivenUp,
    /// The target is there.
    Published,
}

/// Held while a folder gets its name or is given up, so that never both happen.
static ENDS: Mutex<BTreeMap<PathBuf, End>> = Mutex::new(BTreeMap::new());

fn ends() -> MutexGuard<'static, BTreeMap<PathBuf, End>> {
    ENDS.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A target under one name, whether it is there or not.
fn whole(target: &Path) -> PathBuf {
    std::fs::canonicalize(target).unwrap_or_else(|_| {
        let parent = parent_of(target);
        let parent = std::fs::canonicalize(parent).unwrap_or_else(|_| parent.to_path_buf());
        target.file_name().map_or(parent.clone(), |name| parent.join(name))
    })
}

/// A folder under construction. Dropped before it is published, it removes itself.
#[derive(Debug)]
pub(crate) struct Staging {
    path: PathBuf,
    target: PathBuf,
    /// Held open and locked: a folder that somebody is still writing is not removed by others.
    _lock: File,
    /// Whether the target is there and is to be replaced.
    replaces: bool,
    published: bool,
}

fn io_error(path: &Path, operation: &'static str) -> impl FnOnce(io::Error) -> DatasetError {
    let path = path.to_path_buf();
    move |source| DatasetError::Io { path, operation, source }
}

impl Staging {
    /// Starts a folder that is to appear as `target`, which must not exist; its parent must.
    pub(crate) fn create(target: &Path) -> Result<Self> {
        refuse_existing(target)?;
        Self::beside(target, false)
    }

    /// Starts a folder that is to take the place of the folder `target`.
    pub(crate) fn replacing(target: &Path) -> Result<Self> {
        // what a link names is replaced, not the link
        let target = std::fs::canonicalize(target).map_err(io_error(target, "look at it"))?;
        Self::beside(&target, true)
    }

    fn beside(target: &Path, replaces: bool) -> Result<Self> {
        let parent = parent_of(target);
        let prefix = prefix_of(target).ok_or_else(|| DatasetError::Io {
            path: target.to_path_buf(),
            operation: "create a folder of this name",
            source: io::Error::from(io::ErrorKind::InvalidInput),
        })?;
        sweep(parent, &prefix);
        let prefix = own(&prefix);
        loop {
            let folder = tempfile::Builder::new()
                .prefix(&prefix)
                .tempdir_in(parent)
                .map_err(io_error(parent, "create a folder in it"))?;
            // somebody who swept between creation and lock has removed it: take another
            let lock = match File::open(folder.path()) {
                Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
                opened => opened.map_err(io_error(folder.path(), "open it"))?,
            };
            match lock.lock() {
                // where nothing can be locked nothing is swept
                Err(error) if !has_no_locks(&error) => return Err(io_error(folder.path(), "lock it")(error)),
                _ => {}
            }
            if folder.path().exists() {
                // one that replaces another gets those of that one in the end
                if !replaces {
                    widen_permissions(folder.path())?;
                }
                let path = folder.keep();
                return Ok(Self { path, target: target.to_path_buf(), _lock: lock, replaces, published: false });
            }
        }
    }

    /// Where to write.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Flushes everything to disk and gives the folder its name. What is no part of the set that it replaces stays there.
    ///
    /// # Errors
    /// [`DatasetError::Stopped`] after [`remove_unfinished`].
    pub(crate) fn publish(mut self) -> Result<()> {
        sync_tree(&self.path)?;
        let target = whole(&self.target);
        let mut ends = ends();
        if ends.get(&target) == Some(&End::GivenUp) {
            return Err(DatasetError::Stopped { path: self.target.clone() });
        }
        match self.replaces {
            true => self.exchange()?,
            false => self.name()?,
        }
        ends.insert(target, End::Published);
        sync_parent(&self.target)
    }

    fn exchange(&self) -> Result<()> {
        other_files::carry_over(&self.target, &self.path)?;
        std::fs::metadata(&self.target)
            .and_then(|target| std::fs::set_permissions(&self.path, target.permissions()))
            .map_err(io_error(&self.target, "keep its permissions"))?;
        // at once: at no time is there neither of the two; dropped then, the hidden folder is the old one
        renameat_with(CWD, &self.path, CWD, &self.target, RenameFlags::EXCHANGE)
            .map_err(|errno| io_error(&self.target, "exchange it with what was written beside it")(errno.into()))
    }

    fn name(&mut self) -> Result<()> {
        match renameat_with(CWD, &self.path, CWD, &self.target, RenameFlags::NOREPLACE) {
            Ok(()) => {}
            Err(rustix::io::Errno::EXIST) => {
                return Err(DatasetError::OutputExists { path: self.target.clone() });
            }
            // file systems without RENAME_NOREPLACE: a plain rename never replaces a folder that has content
            Err(rustix::io::Errno::INVAL | rustix::io::Errno::NOSYS) => {
                refuse_existing(&self.target)?;
                std::fs::rename(&self.path, &self.target)
                    .map_err(io_error(&self.target, "move the finished folder there"))?;
            }
            Err(errno) => {
                return Err(io_error(&self.target, "move the finished folder there")(errno.into()));
            }
        }
        self.published = true;
        Ok(())
    }
}

impl Drop for Staging {
    fn drop(&mut self) {
        if !self.published {
            // nothing more can be done about a failure here; the next writer sweeps
            let _ = std::fs::remove_dir_all(&self.path);
        }
    }
}

/// How the names of the hidden folders of a target begin.
fn prefix_of(target: &Path) -> Option<String> {
    Some(format!(".{}.partial-", target.file_name()?.to_string_lossy()))
}

/// How those of this process begin.
pub(super) fn own(prefix: &str) -> String {
    format!("{prefix}{}-", rustix::process::getpid().as_raw_nonzero())
}

/// Removes what this process has begun to write for the file or folder `out`, before it ends without unwinding; a data set does not
/// appear there after that. `false` where one has appeared: the work is done but for its last words.
pub fn remove_unfinished(out: &Path) -> bool {
    {
        let mut ends = ends();
        let target = whole(out);
        if ends.get(&target) == Some(&End::Published) {
            return false;
        }
        ends.insert(target, End::GivenUp);
    }
    crate::source::remove_unfinished(out);
    // what a link names is replaced
    let target = std::fs::canonicalize(out).unwrap_or_else(|_| out.to_path_buf());
    let folders = [
        (parent_of(&target).to_path_buf(), prefix_of(&target)),
        (std::env::temp_dir(), Some(super::v2::VIEW.to_owned())),
    ];
    for (parent, prefix) in folders {
        let (Some(prefix), Ok(entries)) = (prefix, std::fs::read_dir(parent)) else { continue };
        let prefix = own(&prefix);
        for entry in entries.flatten().filter(|e| e.file_name().to_string_lossy().starts_with(&prefix)) {
            // other threads may still be writing there
            for _ in 0..10 {
                if std::fs::remove_dir_all(entry.path()).is_ok() {
                    break;
                }
            }
        }
    }
    true
}

fn parent_of(target: &Path) -> &Path {
    match target.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    }
}

fn sync_parent(target: &Path) -> Result<()> {
    let parent = parent_of(target);
    let folder = File::open(parent).map_err(io_error(parent, "open it"))?;
    folder.sync_all().map_err(io_error(parent, "flush it to disk"))
}

fn refuse_existing(target: &Path) -> Result<()> {
    match std::fs::symlink_metadata(target) {
        Ok(_) => Err(DatasetError::OutputExists { path: target.to_path_buf() }),
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(()),
        Err(e) => Err(io_error(target, "look at it")(e)),
    }
}

/// Removes what killed writers of the same target left. Best effort: what is locked is in use.
fn sweep(parent: &Path, prefix: &str) {
    let Ok(entries) = std::fs::read_dir(parent) else { return };
    for entry in entries.flatten() {
        if !entry.file_name().to_string_lossy().starts_with(prefix) {
            continue;
        }
        if let Ok(folder) = File::open(entry.path())
            && folder.try_lock().is_ok()
        {
            let _ = std::fs::remove_dir_all(entry.path());
        }
    }
}

/// Whether a file system says that it has no locks: ENOSYS, EOPNOTSUPP, ENOLCK.
fn has_no_locks(error: &io::Error) -> bool {
    use rustix::io::Errno;
    let errno = Errno::from_io_error(error);
    [Errno::NOSYS, Errno::OPNOTSUPP, Errno::NOLCK].map(Some).contains(&errno)
}

/// `tempfile` makes folders that only the owner may enter; a data set is for whoever the umask lets in.
fn widen_permissions(path: &Path) -> Result<()> {
    use std::os::unix::fs::PermissionsExt;
    let probe = path.join("probe");
    std::fs::create_dir(&probe).map_err(io_error(path, "create a folder in it"))?;
    let mode = std::fs::metadata(&probe).map_err(io_error(&probe, "look at it"))?.permissions().mode();
    std::fs::remove_dir(&probe).map_err(io_error(&probe, "remove it"))?;
    std::fs::set_permissions(path, std::fs::Permissions::from_mode(mode)).map_err(io_error(path, "set its permissions"))
}

/// Sends a folder with everything in it to the disk: files beside each other, then the folders that name them.
fn sync_tree(path: &Path) -> Result<()> {
    const AT_ONCE: usize = 8;
    let (mut files, mut folders) = (Vec::new(), Vec::new());
    list_tree(path, &mut files, &mut folders)?;
    let sync = |path: &PathBuf| {
        let file = File::open(path).map_err(io_error(path, "open it"))?;
        file.sync_all().map_err(io_error(path, "flush it to disk"))
    };
    in_order(files.len(), AT_ONCE, |i| sync(&files[i]), Ok)?;
    folders.iter().try_for_each(sync)
}

/// Files and folders of a folder; a folder comes after those in it.
fn list_tree(path: &Path, files: &mut Vec<PathBuf>, folders: &mut Vec<PathBuf>) -> Result<()> {
    for entry in std::fs::read_dir(path).map_err(io_error(path, "list it"))? {
        let entry = entry.map_err(io_error(path, "list it"))?.path();
        let kind = std::fs::symlink_metadata(&entry).map_err(io_error(&entry, "look at it"))?;
        match (kind.is_dir(), kind.is_file()) {
            (true, _) => list_tree(&entry, files, folders)?,
            (_, true) => files.push(entry),
            // a link, which its folder holds
            _ => {}
        }
    }
    folders.push(path.to_owned());
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let mut names: Vec<String> =
            std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn a_published_folder_appears_with_its_content_and_nothing_else_stays() {
        let dir = tempfile::tempdir().unwrap();
        let target = dir.path().join("set");
        let staging = Staging::create(&target).unwrap();
        std::fs::create_dir(staging.path().join("meta")).unwrap();
        std::fs::write(staging.path().join("meta/x"), "1").unwrap();
        assert!(!target.exists());
        staging.publish().unwrap();
        assert_eq!(names(dir.path()), ["set"]);
        assert_eq!(std::fs::read_to_string(target.join("meta/x")).unwrap(), "1");
    }

    #[test]
    fn an_unfinished_folder_disappears_and_an_existing_target_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let target = dir.path().join("set");
        drop(Staging::create(&target).unwrap());
        assert!(names(dir.path()).is_empty());
        std::fs::write(&target, "precious").unwrap();
        assert!(matches!(Staging::create(&target), Err(DatasetError::OutputExists { .. })));
        assert_eq!(std::fs::read_to_string(&target).unwrap(), "precious");
    }

    #[test]
    fn a_folder_is_replaced_at_once_and_stays_until_then() {
        let dir = tempfile::tempdir().unwrap();
        let (target, link) = (dir.path().join("set"), dir.path().join("link"));
        std::fs::create_dir(&target).unwrap();
        std::fs::create_dir_all(target.join("data/chunk-000")).unwrap();
        std::fs::write(target.join("data/chunk-000/x.parquet"), "old").unwrap();
        for kept in ["README.md", "meta/more.json", ".git/refs/head", "data/notes.txt", "data/extra.parquet"] {
            std::fs::create_dir_all(target.join(kept).parent().unwrap()).unwrap();
            std::fs::write(target.join(kept), kept).unwrap();
        }
        let private = std::os::unix::fs::PermissionsExt::from_mode(0o750);
        std::fs::set_permissions(&target, private).unwrap();
        std::os::unix::fs::symlink("README.md", target.join("LIESMICH")).unwrap();
        std::os::unix::fs::symlink(&target, &link).unwrap();
        drop(Staging::replacing(&target).unwrap());
        let staging = Staging::replacing(&link).unwrap();
        std::fs::create_dir_all(staging.path().join("data/chunk-000")).unwrap();
        std::fs::write(staging.path().join("data/chunk-000/y.parquet"), "new").unwrap();
        assert_eq!(std::fs::read_to_string(target.join("data/chunk-000/x.parquet")).unwrap(), "old");
        staging.publish().unwrap();
        let mode = std::os::unix::fs::PermissionsExt::mode(&std::fs::metadata(&target).unwrap().permissions());
        assert_eq!(mode & 0o777, 0o750);
        assert_eq!(names(&target.join("data")), ["chunk-000", "extra.parquet", "notes.txt"]);
        assert_eq!(names(&target.join("data/chunk-000")), ["y.parquet"]);
        // what is no part of a data set stays as it was
        for kept in ["README.md", "meta/more.json", ".git/refs/head", "data/notes.txt", "data/extra.parquet"] {
            assert_eq!(std::fs::read_to_string(target.join(kept)).unwrap(), kept);
        }
        assert_eq!(std::fs::read_link(target.join("LIESMICH")).unwrap(), Path::new("README.md"));
        assert_eq!(names(dir.path()), ["link", "set"]);
        assert!(Staging::replacing(&dir.path().join("none")).is_err());
    }

    #[test]
    fn a_target_that_appears_meanwhile_is_not_replaced() {
        let dir = tempfile::tempdir().unwrap();
        let target = dir.path().join("set");
        let staging = Staging::create(&target).unwrap();
        std::fs::create_dir(&target).unwrap();
        assert!(matches!(staging.publish(), Err(DatasetError::OutputExists { .. })));
        assert_eq!(names(dir.path()), ["set"]);
    }

    #[test]
    fn leftovers_are_swept_but_not_those_in_use() {
        let dir = tempfile::tempdir().unwrap();
        let target = dir.path().join("set");
        std::fs::create_dir(dir.path().join(".set.partial-dead")).unwrap();
        std::fs::write(dir.path().join(".set.partial-dead/half"), "x").unwrap();
        let alive = Staging::create(&target).unwrap();
        let second = Staging::create(&target).unwrap();
        assert!(alive.path().exists() && second.path().exists());
        assert!(!dir.path().join(".set.partial-dead").exists());
    }

    #[test]
    fn folders_begun_at_the_same_time_leave_each_other_alone() {
        let dir = tempfile::tempdir().unwrap();
        std::thread::scope(|scope| {
            for _ in 0..8 {
                scope.spawn(|| {
                    for _ in 0..100 {
                        let staging = Staging::create(&dir.path().join("set")).unwrap();
                        std::fs::write(staging.path().join("x"), "1").unwrap();
                        std::thread::yield_now();
                        assert!(staging.path().join("x").exists());
                    }
                });
            }
        });
        assert!(names(dir.path()).is_empty());
    }

    #[test]
    fn what_was_given_up_does_not_appear_and_what_has_appeared_is_not_removed() {
        let dir = tempfile::tempdir().unwrap();
        for replaces in [false, true] {
            let target = dir.path().join(format!("set_{replaces}"));
            let staging = || match replaces {
                true => Staging::replacing(&target).unwrap(),
                false => Staging::create(&target).unwrap(),
            };
            if replaces {
                std::fs::create_dir(&target).unwrap();
            }
            let first = staging();
            assert!(remove_unfinished(&target));
            // as work that goes on a little
            std::fs::create_dir_all(first.path()).unwrap();
            assert!(matches!(first.publish(), Err(DatasetError::Stopped { .. })));
            assert_eq!(target.exists(), replaces);
            ends().remove(&whole(&target));
            staging().publish().unwrap();
            assert!(!remove_unfinished(&target) && target.exists());
        }
    }
}
