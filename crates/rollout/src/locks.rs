//! Locks on files, and file systems that have none: there work goes on without, and whoever prints says so once.

use std::fs::{File, TryLockError};
use std::io::{Error, Result};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use rustix::io::Errno;

static UNLOCKED: OnceLock<PathBuf> = OnceLock::new();

/// The first folder, if any, whose file system refused to lock anything: two programs that work there are not kept apart.
pub fn without_locks() -> Option<&'static Path> {
    UNLOCKED.get().map(PathBuf::as_path)
}

/// Locks `file`, which stands for `folder`; `false` while another process holds it. Held, too, where nothing can be locked.
///
/// # Errors
/// Any other failure.
pub fn try_lock(file: &File, folder: &Path) -> Result<bool> {
    held(file.try_lock(), folder)
}

/// The same for a lock that several may hold.
///
/// # Errors
/// Any other failure.
pub fn try_lock_shared(file: &File, folder: &Path) -> Result<bool> {
    held(file.try_lock_shared(), folder)
}

/// Waits until `file` is locked; `false` where nothing can be locked.
///
/// # Errors
/// Any other failure.
pub fn lock(file: &File, folder: &Path) -> Result<bool> {
    match file.lock() {
        Ok(()) => Ok(true),
        Err(error) if is_unsupported(&error) => {
            UNLOCKED.get_or_init(|| folder.to_owned());
            Ok(false)
        }
        Err(error) => Err(error),
    }
}

fn held(tried: std::result::Result<(), TryLockError>, folder: &Path) -> Result<bool> {
    match tried {
        Ok(()) => Ok(true),
        Err(TryLockError::WouldBlock) => Ok(false),
        Err(TryLockError::Error(error)) if is_unsupported(&error) => {
            UNLOCKED.get_or_init(|| folder.to_owned());
            Ok(true)
        }
        Err(TryLockError::Error(error)) => Err(error),
    }
}

/// Whether a file system says that it has no locks.
fn is_unsupported(error: &Error) -> bool {
    let errno = Errno::from_io_error(error);
    [Errno::NOSYS, Errno::OPNOTSUPP, Errno::NOLCK].map(Some).contains(&errno)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_file_system_without_locks_is_worked_on_and_remembered() {
        let folder = Path::new("/lustre/results");
        let failed = |errno: Errno| held(Err(TryLockError::Error(errno.into())), folder);
        assert_eq!(failed(Errno::IO).unwrap_err().raw_os_error(), Some(Errno::IO.raw_os_error()));
        assert!(!held(Err(TryLockError::WouldBlock), folder).unwrap());
        assert_eq!(without_locks(), None);
        for errno in [Errno::NOSYS, Errno::OPNOTSUPP, Errno::NOLCK] {
            assert!(failed(errno).unwrap());
        }
        assert_eq!(without_locks(), Some(folder));
    }
}
