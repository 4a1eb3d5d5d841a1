//! Files that are either whole or not there, and their hashes.

use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::os::unix::fs::FileTypeExt;
use std::path::Path;

use rustix::fs::{CWD, RenameFlags, renameat_with};
use sha2::{Digest, Sha256};

use crate::ResultsError;

/// How names begin of what is not finished.
const TEMPORARY: &str = ".tmp-";

/// More bytes than a record or a seal has.
pub(crate) const MOST_TEXT: u64 = 1 << 26;

/// Lower-case hexadecimal SHA-256 of `bytes`.
pub fn sha256_hex(bytes: &[u8]) -> String {
    hex(&Sha256::digest(bytes))
}

/// Opens a regular file, or a link to one, to read it. A pipe or a device could be read for ever.
///
/// # Errors
/// When it cannot be opened or is something else.
pub fn open_file(path: &Path) -> io::Result<File> {
    let kind = fs::metadata(path)?.file_type();
    if kind.is_file() {
        return File::open(path);
    }
    let found = match (kind.is_dir(), kind.is_fifo()) {
        (true, _) => "a folder",
        (_, true) => "a pipe",
        _ => "a device or a socket",
    };
    Err(io::Error::other(format!("expected a regular file, found {found}")))
}

/// The content of a regular file that holds at most `most` bytes.
///
/// # Errors
/// As [`open_file`]; a longer file.
pub fn read_file(path: &Path, most: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    open_file(path)?.take(most.saturating_add(1)).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > most {
        return Err(io::Error::other(format!("expected at most {most} bytes, found more")));
    }
    Ok(bytes)
}

/// Lower-case hexadecimal SHA-256 of a file's content.
///
/// # Errors
/// When the file cannot be read or is no regular file.
pub fn sha256_file(path: &Path) -> Result<String, ResultsError> {
    let mut file = open_file(path).map_err(ResultsError::io("read", path))?;
    let mut hasher = Sha256::new();
    let mut buffer = vec![0_u8; 1 << 16];
    loop {
        let n = file.read(&mut buffer).map_err(ResultsError::io("read", path))?;
        if n == 0 {
            return Ok(hex(&hasher.finalize()));
        }
        hasher.update(&buffer[..n]);
    }
}

fn hex(digest: &[u8]) -> String {
    use std::fmt::Write as _;
    digest.iter().fold(String::new(), |mut text, byte| {
        write!(text, "{byte:02x}").expect("writing into a String cannot fail");
        text
    })
}

/// Replaces `path` by `bytes`: a temporary name beside it, fsync, rename, fsync of the folder.
///
/// A reader sees the old content or the new, never a part; a killed writer leaves the old.
///
/// # Errors
/// When the folder is not there or cannot be written to.
pub fn write_atomic(path: &Path, bytes: &[u8]) -> Result<(), ResultsError> {
    stage(path, bytes)?.persist(path).map_err(|e| ResultsError::io("write", path)(e.error))?;
    sync_folder(parent(path))
}

/// Replaces several files: all are written under temporary names before the first takes its place, so that a full disk or
/// a folder that cannot be written leaves all of them as they were.
///
/// # Errors
/// As [`write_atomic`]; a path that is a folder.
pub fn write_together(files: &[(std::path::PathBuf, Vec<u8>)]) -> Result<(), ResultsError> {
    let mut staged = Vec::new();
    for (path, bytes) in files {
        if path.is_dir() {
            return Err(ResultsError::io("write", path)(std::io::ErrorKind::IsADirectory.into()));
        }
        staged.push((path, stage(path, bytes)?));
    }
    for (path, file) in staged {
        file.persist(path).map_err(|e| ResultsError::io("write", path)(e.error))?;
        sync_folder(parent(path))?;
    }
    Ok(())
}

/// Makes the new folder `out`: `fill` writes into a temporary one beside it, which then takes the name. It appears whole or
/// not at all, and takes nobody's place.
///
/// # Errors
/// When `out` exists or cannot be made there; those of `fill`.
pub fn new_folder<E: From<ResultsError>>(out: &Path, fill: impl FnOnce(&Path) -> Result<(), E>) -> Result<(), E> {
    let parent = parent(out);
    if out.exists() {
        return Err(ResultsError::io("create folder", out)(std::io::ErrorKind::AlreadyExists.into()).into());
    }
    let staging = tempfile::Builder::new()
        .prefix(TEMPORARY)
        .permissions(mode(0o755))
        .tempdir_in(parent)
        .map_err(ResultsError::io("create a temporary folder in", parent))?;
    fill(staging.path())?;
    renameat_with(CWD, staging.path(), CWD, out, RenameFlags::NOREPLACE)
        .map_err(|e| ResultsError::io("create folder", out)(e.into()))?;
    // renamed away: nothing is left to remove
    let _gone = staging.keep();
    Ok(sync_folder(parent)?)
}

/// Removes what killed writers have left in `folder`, where there is one. Only for whoever holds the folder's lock.
pub fn sweep(folder: &Path) -> Result<(), ResultsError> {
    let items = match fs::read_dir(folder) {
        Ok(items) => items,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(()),
        Err(error) => return Err(ResultsError::io("read folder", folder)(error)),
    };
    for item in items {
        let item = item.map_err(ResultsError::io("read folder", folder))?;
        if item.file_name().to_string_lossy().starts_with(TEMPORARY) && item.path().is_file() {
            fs::remove_file(item.path()).map_err(ResultsError::io("remove", item.path()))?;
        }
    }
    Ok(())
}

fn parent(path: &Path) -> &Path {
    path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or_else(|| Path::new("."))
}

/// A synced file with `bytes` beside `path`.
fn stage(path: &Path, bytes: &[u8]) -> Result<tempfile::NamedTempFile, ResultsError> {
    let folder = parent(path);
    let mut file = tempfile::Builder::new()
        .prefix(TEMPORARY)
        .permissions(mode(0o644))
        .tempfile_in(folder)
        .map_err(ResultsError::io("create a temporary file in", folder))?;
    file.write_all(bytes).and_then(|()| file.as_file().sync_all()).map_err(ResultsError::io("write", path))?;
    Ok(file)
}

/// A path in JSON: as text, or as a list of bytes where it is not UTF-8.
pub mod any_path {
    #![allow(missing_docs, clippy::missing_errors_doc)]

    use std::ffi::OsString;
    use std::os::unix::ffi::{OsStrExt, OsStringExt};
    use std::path::{Path, PathBuf};

    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    #[derive(Serialize, Deserialize)]
    #[serde(untagged)]
    enum Stored {
        Text(String),
        Bytes(Vec<u8>),
    }

    pub fn serialize<S: Serializer>(path: &Path, serializer: S) -> Result<S::Ok, S::Error> {
        let stored = match path.to_str() {
            Some(text) => Stored::Text(text.to_owned()),
            None => Stored::Bytes(path.as_os_str().as_bytes().to_vec()),
        };
        stored.serialize(serializer)
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<PathBuf, D::Error> {
        Ok(match Stored::deserialize(deserializer)? {
            Stored::Text(text) => PathBuf::from(text),
            Stored::Bytes(bytes) => PathBuf::from(OsString::from_vec(bytes)),
        })
    }
}

fn mode(bits: u32) -> fs::Permissions {
    std::os::unix::fs::PermissionsExt::from_mode(bits)
}

/// Makes renames inside `folder` survive a power cut.
pub fn sync_folder(folder: &Path) -> Result<(), ResultsError> {
    File::open(folder).and_then(|f| f.sync_all()).map_err(ResultsError::io("sync folder", folder))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn hashes_agree_with_the_published_vector() {
        // FIPS 180-2, "abc"
        let expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(sha256_hex(b"abc"), expected);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("abc");
        write_atomic(&path, b"abc").unwrap();
        assert_eq!(sha256_file(&path).unwrap(), expected);
    }

    #[test]
    fn a_replaced_file_leaves_nothing_else_behind() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x");
        write_atomic(&path, b"one").unwrap();
        write_atomic(&path, b"two").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"two");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn files_that_belong_together_are_all_new_or_all_old() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        write_together(&[(at("a"), b"one".to_vec()), (at("b"), b"two".to_vec())]).unwrap();
        fs::create_dir(at("c")).unwrap();
        for refused in [at("c"), at("nowhere/d")] {
            let error = write_together(&[(at("a"), b"new".to_vec()), (refused.clone(), Vec::new())]).unwrap_err();
            assert!(error.to_string().contains(refused.parent().unwrap().to_str().unwrap()), "{error}");
            assert_eq!(fs::read(at("a")).unwrap(), b"one");
        }
        assert_eq!(fs::read(at("b")).unwrap(), b"two");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 3, "nothing else is left");
    }

    #[test]
    fn what_killed_writers_left_is_swept_away() {
        let folder = tempfile::tempdir().unwrap();
        for name in [".tmp-abc", ".hidden", "kept"] {
            fs::write(folder.path().join(name), "x").unwrap();
        }
        sweep(folder.path()).unwrap();
        sweep(&folder.path().join("nowhere")).unwrap();
        let mut left: Vec<_> = fs::read_dir(folder.path()).unwrap().map(|item| item.unwrap().file_name()).collect();
        left.sort();
        assert_eq!(left, [".hidden", "kept"]);
    }

    #[test]
    fn what_is_no_regular_file_is_refused_and_not_waited_for() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        rustix::fs::mknodat(CWD, at("pipe"), rustix::fs::FileType::Fifo, rustix::fs::Mode::RWXU, 0).unwrap();
        std::os::unix::fs::symlink("/dev/zero", at("device")).unwrap();
        fs::write(at("file"), "text").unwrap();
        std::os::unix::fs::symlink(at("file"), at("link")).unwrap();
        for (path, kind) in [(at("pipe"), "a pipe"), (at("device"), "a device"), (folder.path().into(), "a folder")] {
            let error = sha256_file(&path).unwrap_err();
            let reason = std::error::Error::source(&error).unwrap().to_string();
            assert!(reason.starts_with(&format!("expected a regular file, found {kind}")), "{reason}");
        }
        assert_eq!(read_file(&at("link"), 4).unwrap(), b"text");
        assert_eq!(read_file(&at("file"), 3).unwrap_err().to_string(), "expected at most 3 bytes, found more");
    }

    #[test]
    fn a_path_that_is_not_text_comes_back() {
        use std::os::unix::ffi::OsStrExt;
        #[derive(serde::Serialize, serde::Deserialize, PartialEq, Debug)]
        struct Note(#[serde(with = "any_path")] std::path::PathBuf);
        for (path, text) in [(&b"a b"[..], "\"a b\""), (&b"caf\xe9"[..], "[99,97,102,233]")] {
            let note = Note(std::ffi::OsStr::from_bytes(path).into());
            assert_eq!(serde_json::to_string(&note).unwrap(), text);
            assert_eq!(serde_json::from_str::<Note>(text).unwrap(), note);
        }
    }

    #[test]
    fn a_folder_that_is_not_there_is_named() {
        let error = write_atomic(Path::new("/nonexistent-folder/x"), b"").unwrap_err();
        assert!(error.to_string().contains("/nonexistent-folder"));
    }
}
