//! The zoo's folder: which entries there are, and which one a name means.

use std::fs;
use std::path::{Path, PathBuf};

use crate::ZooError;
use crate::config::nearest;
use crate::entry::{ENTRY_FILE, Entry, EntryId, EntryRequest};

/// A folder of entries. One that is not there is an empty one.
#[derive(Debug, Clone)]
pub struct Registry {
    folder: PathBuf,
}

impl Registry {
    /// The zoo in `folder`.
    pub fn open(folder: &Path) -> Self {
        Self { folder: folder.to_owned() }
    }

    /// The zoo's folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Every `name@version`, sorted by name and version.
    ///
    /// # Errors
    /// When a folder cannot be read.
    pub fn ids(&self) -> Result<Vec<EntryId>, ZooError> {
        let mut ids = Vec::new();
        if !self.folder.exists() {
            return Ok(ids);
        }
        for name in names(&self.folder)? {
            let parent = self.folder.join(&name);
            if name.starts_with('.') || !parent.is_dir() {
                continue;
            }
            for version in names(&parent)? {
                if let Ok(number) = version.parse::<u32>()
                    && parent.join(&version).join(ENTRY_FILE).is_file()
                {
                    ids.push(EntryId { name: name.clone(), version: number });
                }
            }
        }
        ids.sort();
        Ok(ids)
    }

    /// The entry that `name` (newest version) or `name@version` means.
    ///
    /// # Errors
    /// [`ZooError::UnknownEntry`] with what there is, [`ZooError::EntryName`] for what cannot be a name.
    pub fn resolve(&self, text: &str) -> Result<EntryId, ZooError> {
        let request: EntryRequest = text.parse()?;
        let ids = self.ids()?;
        let found = ids
            .iter()
            .filter(|id| id.name == request.name)
            .filter(|id| request.version.is_none_or(|v| v == id.version))
            .max();
        found.cloned().ok_or_else(|| {
            let mut names: Vec<String> = ids.iter().map(|id| id.name.clone()).collect();
            names.dedup();
            ZooError::UnknownEntry {
                name: text.to_owned(),
                zoo: self.folder.clone(),
                nearest: nearest(&request.name, &names).filter(|n| *n != request.name),
                available: ids.iter().map(EntryId::to_string).collect(),
            }
        })
    }

    /// Opens and verifies the entry that `text` means.
    ///
    /// # Errors
    /// As [`Registry::resolve`] and [`Entry::open`].
    pub fn entry(&self, text: &str) -> Result<Entry, ZooError> {
        Entry::open(&self.folder, &self.resolve(text)?)
    }

    /// The newest version of every name.
    ///
    /// # Errors
    /// When a folder cannot be read.
    pub fn newest(&self) -> Result<Vec<EntryId>, ZooError> {
        let mut ids = self.ids()?;
        ids.reverse();
        ids.dedup_by(|a, b| a.name == b.name);
        ids.reverse();
        Ok(ids)
    }
}

fn names(folder: &Path) -> Result<Vec<String>, ZooError> {
    let mut names = Vec::new();
    for item in fs::read_dir(folder).map_err(ZooError::io("read folder", folder))? {
        let item = item.map_err(ZooError::io("read folder", folder))?;
        names.extend(item.file_name().to_str().map(str::to_owned));
    }
    names.sort();
    Ok(names)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::entry::EntryDraft;

    fn draft(name: &str) -> EntryDraft {
        crate::entry::test_draft(name)
    }

    #[test]
    fn names_mean_their_newest_version() {
        let zoo = tempfile::tempdir().unwrap();
        let registry = Registry::open(zoo.path());
        assert!(registry.ids().unwrap().is_empty());
        for name in ["b", "a", "a"] {
            draft(name).seal(zoo.path()).unwrap();
        }
        // ten versions sort as numbers
        for _ in 0..9 {
            draft("b").seal(zoo.path()).unwrap();
        }
        fs::create_dir_all(zoo.path().join("results/1")).unwrap();
        assert_eq!(registry.ids().unwrap().len(), 12);
        assert_eq!(registry.resolve("b").unwrap().to_string(), "b@10");
        assert_eq!(registry.resolve("a@1").unwrap().to_string(), "a@1");
        let newest: Vec<String> = registry.newest().unwrap().iter().map(EntryId::to_string).collect();
        assert_eq!(newest, ["a@2", "b@10"]);
    }

    #[test]
    fn an_unknown_entry_lists_what_there_is() {
        let zoo = tempfile::tempdir().unwrap();
        draft("lift-act").seal(zoo.path()).unwrap();
        let registry = Registry::open(zoo.path());
        let message = |text: &str| registry.resolve(text).unwrap_err().to_string();
        let place = zoo.path().display();
        assert_eq!(
            message("lfit-act"),
            format!("unknown entry `lfit-act` in zoo {place} (did you mean `lift-act`?); entries: lift-act@1")
        );
        assert_eq!(message("lift-act@2"), format!("unknown entry `lift-act@2` in zoo {place}; entries: lift-act@1"));
    }

    #[test]
    fn a_zoo_that_is_not_there_is_empty() {
        let registry = Registry::open(Path::new("/nonexistent-zoo"));
        assert!(registry.ids().unwrap().is_empty());
    }
}
