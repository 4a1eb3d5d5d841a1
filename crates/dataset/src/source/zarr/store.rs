//! Where the files of a zarr store are: a folder, or a zip file.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use zip::ZipArchive;

pub(super) enum Store {
    Folder(PathBuf),
    Zip(Mutex<ZipArchive<File>>),
}

/// Folders of a store lie no deeper.
const DEPTH: usize = 6;

impl Store {
    /// Opens a zip file as a store; `None` where it holds none.
    pub fn zip(path: &Path) -> Option<Self> {
        let archive = ZipArchive::new(File::open(path).ok()?).ok()?;
        let store = archive.file_names().flatten().any(|name| name == "meta/episode_ends/.zarray");
        store.then(|| Self::Zip(Mutex::new(archive)))
    }

    /// A file of the store; `None` where there is none.
    pub fn get(&self, name: &str, limit: u64) -> Result<Option<Vec<u8>>, String> {
        let too_long = |found: u64| Err(format!("{name} has {found} bytes, at most {limit} can be right"));
        let mut bytes = Vec::new();
        match self {
            Self::Folder(root) => {
                let file = match File::open(root.join(name)) {
                    Ok(file) => file,
                    Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(None),
                    Err(e) => return Err(format!("{name}: {e}")),
                };
                let length = file.metadata().map_err(|e| format!("{name}: {e}"))?.len();
                if length > limit {
                    return too_long(length);
                }
                file.take(limit).read_to_end(&mut bytes).map_err(|e| format!("{name}: {e}"))?;
            }
            Self::Zip(archive) => {
                let mut archive = archive.lock().unwrap_or_else(PoisonError::into_inner);
                let file = match archive.by_name(name) {
                    Ok(file) => file,
                    Err(zip::result::ZipError::FileNotFound) => return Ok(None),
                    Err(e) => return Err(format!("{name}: {e}")),
                };
                if file.size() > limit {
                    return too_long(file.size());
                }
                file.take(limit).read_to_end(&mut bytes).map_err(|e| format!("{name}: {e}"))?;
            }
        }
        Ok(Some(bytes))
    }

    /// Names of the arrays of a group, sorted.
    pub fn arrays(&self, group: &str) -> Result<Vec<String>, String> {
        let mut names: Vec<String> = match self {
            Self::Folder(root) => std::fs::read_dir(root.join(group))
                .map_err(|e| format!("{group}: {e}"))?
                .flatten()
                .filter(|entry| entry.path().join(".zarray").is_file())
                .map(|entry| entry.file_name().to_string_lossy().into_owned())
                .collect(),
            Self::Zip(archive) => {
                let archive = archive.lock().unwrap_or_else(PoisonError::into_inner);
                let name = |path: &str| {
                    let name = path.strip_prefix(group)?.strip_prefix('/')?.strip_suffix("/.zarray")?;
                    (!name.contains('/')).then(|| name.to_owned())
                };
                archive.file_names().flatten().filter_map(|path| name(&path)).collect()
            }
        };
        names.sort();
        Ok(names)
    }

    /// The files that it consists of, with their sizes.
    pub fn files(&self, path: &Path) -> Vec<(PathBuf, u64)> {
        fn walk(folder: &Path, depth: usize, found: &mut Vec<(PathBuf, u64)>) {
            for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
                match entry.file_type() {
                    Ok(kind) if kind.is_dir() && depth > 0 => walk(&entry.path(), depth - 1, found),
                    Ok(kind) if kind.is_dir() => {}
                    _ => found.push((entry.path(), entry.metadata().map_or(0, |m| m.len()))),
                }
            }
        }
        let mut found = Vec::new();
        match self {
            Self::Folder(root) => walk(root, DEPTH, &mut found),
            Self::Zip(_) => found.push((path.to_owned(), std::fs::metadata(path).map_or(0, |m| m.len()))),
        }
        found.sort();
        found
    }
}
