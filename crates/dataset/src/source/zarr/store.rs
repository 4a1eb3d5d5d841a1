//! Where the files of a zarr store are: a folder, or a zip file.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use flate2::Crc;
use flate2::read::DeflateDecoder;
use zip::{CompressionMethod, ZipArchive};

pub(super) enum Store {
    Folder(PathBuf),
    /// An archive, and the folder in it.
    Zip(Mutex<ZipArchive<File>>, String),
}

/// What a replay buffer has.
pub(super) const MARK: &str = "meta/episode_ends/.zarray";
/// What a store of zarr 3 has.
pub(super) const MARK_3: &str = "zarr.json";

/// Why a store of zarr 3 is not read.
pub(super) const ZARR_3: &str = "it is stored as zarr 3, and zarr 2 is read: copy its arrays into a group that \
    `zarr.open_group(path, mode=\"w\", zarr_format=2)` opens";
/// Folders of a store lie no deeper.
const DEPTH: usize = 6;

impl Store {
    /// Opens a zip file as a store; `None` where the file is no zip file, in words why a zip file is none.
    pub fn zip(path: &Path) -> Result<Option<Self>, String> {
        let Ok(mut file) = File::open(path) else { return Ok(None) };
        let mut begin = [0; 4];
        if file.read_exact(&mut begin).is_err() || begin != *b"PK\x03\x04" {
            return Ok(None);
        }
        let archive = ZipArchive::new(file).map_err(|e| format!("{e}: it may be cut off"))?;
        let ends = |mark: &str| {
            let above = |name: &str| {
                name.strip_suffix(mark).filter(|above| above.is_empty() || above.ends_with('/')).map(str::to_owned)
            };
            archive.file_names().flatten().filter_map(|name| above(&name)).min_by_key(String::len)
        };
        match (ends(MARK), ends(MARK_3)) {
            (Some(above), _) => Ok(Some(Self::Zip(Mutex::new(archive), above))),
            (None, Some(_)) => Err(ZARR_3.to_owned()),
            (None, None) => Err("no meta/episode_ends of a replay buffer is in it".to_owned()),
        }
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
            Self::Zip(archive, above) => {
                let mut archive = archive.lock().unwrap_or_else(PoisonError::into_inner);
                let Some(index) = archive.index_for_name(&format!("{above}{name}")) else { return Ok(None) };
                let file = archive.by_index_raw(index).map_err(|e| format!("{name}: {e}"))?;
                let (size, crc, method) = (file.size(), file.crc32(), file.compression());
                if size > limit {
                    return too_long(size);
                }
                match method {
                    CompressionMethod::STORE => file.take(limit).read_to_end(&mut bytes),
                    CompressionMethod::DEFLATE => DeflateDecoder::new(file).take(limit).read_to_end(&mut bytes),
                    other => return Err(format!("{name}: it is packed with {other}: `zip -r -0` packs nothing")),
                }
                .map_err(|e| format!("{name}: {e}"))?;
                let mut found = Crc::new();
                found.update(&bytes);
                if found.sum() != crc {
                    return Err(format!("{name}: its checksum is wrong"));
                }
            }
        }
        Ok(Some(bytes))
    }

    /// Names of the members of a group that have this file (`.zarray`, `.zgroup`), sorted.
    pub fn members(&self, group: &str, mark: &str) -> Result<Vec<String>, String> {
        let mut names: Vec<String> = match self {
            Self::Folder(root) => std::fs::read_dir(root.join(group))
                .map_err(|e| format!("{group}: {e}"))?
                .flatten()
                .filter(|entry| entry.path().join(mark).is_file())
                .map(|entry| entry.file_name().to_string_lossy().into_owned())
                .collect(),
            Self::Zip(archive, above) => {
                let archive = archive.lock().unwrap_or_else(PoisonError::into_inner);
                let name = |path: &str| {
                    let name = path.strip_prefix(above.as_str())?.strip_prefix(group)?;
                    let name = if group.is_empty() { name } else { name.strip_prefix('/')? };
                    let name = name.strip_suffix(mark)?.strip_suffix('/')?;
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
                // an array may be a link
                match std::fs::metadata(entry.path()) {
                    Ok(meta) if meta.is_dir() && depth > 0 => walk(&entry.path(), depth - 1, found),
                    Ok(meta) if meta.is_dir() => {}
                    meta => found.push((entry.path(), meta.map_or(0, |m| m.len()))),
                }
            }
        }
        let mut found = Vec::new();
        match self {
            Self::Folder(root) => walk(root, DEPTH, &mut found),
            Self::Zip(..) => found.push((path.to_owned(), std::fs::metadata(path).map_or(0, |m| m.len()))),
        }
        found.sort();
        found
    }
}
