//! What lies in the folder of a data set and is no part of it: a README, a `.git`, tables of other programs.

use super::v2::version as old_version;
use crate::error::{DatasetError, Result};
use std::fs::File;
use std::io;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};

/// Their paths in the folder, sorted; of a folder that holds no part of the set its own alone. `images` counts as one: frames may
/// name files in it, which edits put into the tables. The folder may be one of LeRobot v2.x.
pub(super) fn other_files(root: &Path) -> Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    look(root, old_version(root).is_some(), Path::new(""), &mut found)?;
    found.sort();
    Ok(found)
}

fn look(root: &Path, old: bool, below: &Path, found: &mut Vec<PathBuf>) -> Result<()> {
    let folder = root.join(below);
    let failed = |source| DatasetError::Io { path: folder.clone(), operation: "list it", source };
    for entry in std::fs::read_dir(&folder).map_err(failed)? {
        let entry = entry.map_err(failed)?;
        let path = below.join(entry.file_name());
        // a name that is no text is none of ours
        let names: Option<Vec<&str>> = path.iter().map(|name| name.to_str()).collect();
        let part = match names.as_deref() {
            Some(["actrm"] | ["meta", "info.json" | "stats.json" | "tasks.parquet"]) => true,
            Some(["meta", "tasks.jsonl" | "episodes.jsonl" | "episodes_stats.jsonl"]) => old,
            Some(["meta", "episodes", _, file] | ["data", _, file]) => file.ends_with(".parquet"),
            Some(["videos", _, _, file]) => file.ends_with(".mp4"),
            _ => false,
        };
        let looked_into = matches!(
            names.as_deref(),
            Some(
                ["meta" | "data" | "videos"]
                    | ["meta", "episodes"]
                    | ["meta", "episodes", _]
                    | ["data" | "videos", _]
                    | ["videos", _, _]
            )
        );
        // what a link names, too
        if looked_into && std::fs::metadata(entry.path()).is_ok_and(|found| found.is_dir()) {
            look(root, old, &path, found)?;
        } else if !part {
            found.push(path);
        }
    }
    Ok(())
}

/// Puts them into another folder too, as links to the same files where the file system has such links, and on the disk.
pub(super) fn carry_over(from: &Path, to: &Path) -> Result<()> {
    for path in other_files(from)? {
        super::shards::create_parent(&to.join(&path))?;
        let kept = || {
            carry(&from.join(&path), &to.join(&path))?;
            path.ancestors().skip(1).try_for_each(|folder| sync(&to.join(folder)))
        };
        kept().map_err(|source| DatasetError::Io { path: from.join(&path), operation: "keep it", source })?;
    }
    Ok(())
}

fn sync(path: &Path) -> io::Result<()> {
    File::open(path)?.sync_all()
}

fn carry(from: &Path, to: &Path) -> io::Result<()> {
    let kind = std::fs::symlink_metadata(from)?;
    if kind.is_dir() {
        std::fs::create_dir(to)?;
        for entry in std::fs::read_dir(from)? {
            let entry = entry?;
            carry(&entry.path(), &to.join(entry.file_name()))?;
        }
        sync(to)?;
        return std::fs::set_permissions(to, kind.permissions());
    }
    match std::fs::hard_link(from, to) {
        Err(_) if kind.is_symlink() => symlink(std::fs::read_link(from)?, to),
        Err(_) if kind.is_file() => std::fs::copy(from, to).and_then(|_| sync(to)),
        linked => linked,
    }
}
