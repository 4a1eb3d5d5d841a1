//! The zoo's folder: which entries there are, and which one a name means.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use crate::config::nearest;
use crate::entry::{ENTRY_FILE, Entry, EntryId, EntryRequest, LATEST, REMOVED, check_alias, lock_name};
use crate::results::result_folders;
use crate::{ZooError, write_atomic};

/// Aliases of an entry's versions, beside them.
const ALIASES: &str = "aliases.json";

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

    /// The entry that `name` (newest version) or `name@version` means, or a path in this zoo (`zoo/stack-act`).
    ///
    /// # Errors
    /// [`ZooError::UnknownEntry`] with what there is, [`ZooError::EntryName`] for what cannot be a name.
    pub fn resolve(&self, text: &str) -> Result<EntryId, ZooError> {
        if text.contains(std::path::MAIN_SEPARATOR) {
            let (zoo, name) = parts(Path::new(text));
            let same =
                |one: &Path| one.canonicalize().ok().is_some_and(|one| self.folder.canonicalize().ok() == Some(one));
            if name.is_empty() || !same(&zoo) {
                let reason = "expected a name or a path in this zoo; --zoo names another one";
                return Err(ZooError::EntryName { name: text.to_owned(), reason });
            }
            return self.resolve(&name);
        }
        let mut request: EntryRequest = text.parse()?;
        let ids = self.ids()?;
        if let Some(alias) = request.alias.take().filter(|_| ids.iter().any(|id| id.name == request.name)) {
            let aliases = self.aliases(&request.name)?;
            let Some(version) = aliases.get(&alias) else {
                let known = aliases.iter().map(|(alias, version)| format!("{alias} = {version}")).collect();
                return Err(ZooError::UnknownAlias { name: request.name, alias, known });
            };
            request.version = Some(*version);
        }
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

    /// The entries that `text` means: one as [`Registry::resolve`] finds it, or with a `*` in the name the newest version of
    /// every name that fits (`lift-act-s*`: a family's trainings), or those of the given version.
    ///
    /// # Errors
    /// As [`Registry::resolve`]; a pattern that nothing fits.
    pub fn matching(&self, text: &str) -> Result<Vec<EntryId>, ZooError> {
        let Some((before, after)) = text.split_once('*') else { return Ok(vec![self.resolve(text)?]) };
        let (after, version) = match after.split_once('@') {
            Some((after, version)) => (after, Some(version)),
            None => (after, None),
        };
        let version = match version.map(str::parse::<u32>).transpose() {
            Ok(version) => version,
            Err(_) => {
                let reason = "the version after `@` is a number from 1";
                return Err(ZooError::EntryName { name: text.to_owned(), reason });
            }
        };
        let fits = |id: &EntryId| {
            let rest = id.name.strip_prefix(before).and_then(|rest| rest.strip_suffix(after));
            // of `lift-act-s*` no `lift-act-slow`
            let seed = |rest: &str| !before.ends_with("-s") || rest.chars().all(|c| c.is_ascii_digit());
            rest.is_some_and(|rest| !rest.is_empty() && seed(rest))
                && version.is_none_or(|version| version == id.version)
        };
        let ids = if version.is_some() { self.ids()? } else { self.newest()? };
        let found: Vec<EntryId> = ids.iter().filter(|id| fits(id)).cloned().collect();
        if found.is_empty() {
            return Err(ZooError::UnknownEntry {
                name: text.to_owned(),
                zoo: self.folder.clone(),
                nearest: None,
                available: ids.iter().map(EntryId::to_string).collect(),
            });
        }
        Ok(found)
    }

    /// Opens and verifies the entry that `text` means.
    ///
    /// # Errors
    /// As [`Registry::resolve`] and [`Entry::open`].
    pub fn entry(&self, text: &str) -> Result<Entry, ZooError> {
        Entry::open(&self.folder, &self.resolve(text)?)
    }

    /// Versions of an entry by their aliases. Versions are never rewritten; an alias points wherever it was set to last.
    ///
    /// # Errors
    /// [`ZooError::Malformed`] for a file that holds none.
    pub fn aliases(&self, name: &str) -> Result<BTreeMap<String, u32>, ZooError> {
        let path = self.folder.join(name).join(ALIASES);
        let text = match fs::read(&path) {
            Ok(text) => text,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(BTreeMap::new()),
            Err(error) => return Err(ZooError::io("read", path)(error)),
        };
        serde_json::from_slice(&text)
            .map_err(|e| ZooError::Malformed { path, reason: format!("expected versions by alias: {e}") })
    }

    /// Lets `alias` point at an entry, or at none.
    ///
    /// # Errors
    /// An entry that is not there, an alias that cannot be one, a file that cannot be written.
    pub fn set_alias(&self, id: &EntryId, alias: &str, set: bool) -> Result<(), ZooError> {
        check_alias(alias)?;
        if alias == LATEST {
            let reason = "`latest` is the newest version, always";
            return Err(ZooError::EntryName { name: format!("{}@{alias}", id.name), reason });
        }
        let _lock = lock_name(&self.folder.join(&id.name))?;
        let id = self.resolve(&id.to_string())?;
        let mut aliases = self.aliases(&id.name)?;
        if set {
            aliases.insert(alias.to_owned(), id.version);
        } else if aliases.remove(alias).is_none() {
            let (name, alias) = (id.name, alias.to_owned());
            let known = aliases.iter().map(|(alias, version)| format!("{alias} = {version}")).collect();
            return Err(ZooError::UnknownAlias { name, alias, known });
        }
        let text = serde_json::to_string_pretty(&aliases).expect("names and numbers become JSON") + "\n";
        Ok(write_atomic(&self.folder.join(&id.name).join(ALIASES), text.as_bytes())?)
    }

    /// Removes an entry that no result and no alias is of. Its version is never given again.
    ///
    /// # Errors
    /// [`ZooError::InUse`] with what stands on it.
    pub fn remove(&self, id: &EntryId, results: &Path) -> Result<(), ZooError> {
        let parent = self.folder.join(&id.name);
        let _lock = lock_name(&parent)?;
        let prefix = format!("{id}_");
        let named = |folder: &PathBuf| folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let mut users: Vec<String> =
            result_folders(results)?.iter().map(named).filter(|name| name.starts_with(&prefix)).collect();
        let aliases = self.aliases(&id.name)?;
        users.extend(
            aliases.iter().filter(|(_, version)| **version == id.version).map(|(alias, _)| format!("alias {alias}")),
        );
        if !users.is_empty() {
            return Err(ZooError::InUse { entry: id.to_string(), users });
        }
        let folder = parent.join(id.version.to_string());
        write_atomic(&parent.join(format!("{REMOVED}{}", id.version)), b"")?;
        // first out of sight: a killed removal leaves what the next writer of this name sweeps away
        let hidden = parent.join(format!(".tmp-removed-{}", id.version));
        fs::rename(&folder, &hidden).map_err(ZooError::io("remove", &folder))?;
        fs::remove_dir_all(&hidden).map_err(ZooError::io("remove", &hidden))
    }

    /// Opens and verifies the entry that `text` means: one of this zoo, or the path of another: of its folder
    /// (`zoo/stack-act/1`), or of its name in its zoo (`zoo/stack-act`, the newest version, `zoo/stack-act@1`).
    ///
    /// # Errors
    /// As [`Registry::entry`].
    pub fn locate(&self, text: &str) -> Result<Entry, ZooError> {
        let path = Path::new(text);
        if !text.contains(std::path::MAIN_SEPARATOR) && !path.is_dir() {
            return self.entry(text);
        }
        let (zoo, name) = parts(path);
        Self::open(&zoo).entry(&name)
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

/// The zoo and the name of an entry from its path.
fn parts(path: &Path) -> (PathBuf, String) {
    // `..` and a slash at the end have no name
    let whole = match path.canonicalize() {
        Ok(path) if path.is_dir() => path,
        _ => path.to_owned(),
    };
    let name = |path: &Path| path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let above = |path: &Path| path.parent().map(Path::to_owned).unwrap_or_default();
    if !whole.join(ENTRY_FILE).is_file() {
        return (above(&whole), name(&whole));
    }
    let parent = above(&whole);
    (above(&parent), format!("{}@{}", name(&parent), name(&whole)))
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
        crate::entry::testing::draft(name)
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
    fn an_alias_points_at_a_version() {
        let zoo = tempfile::tempdir().unwrap();
        let registry = Registry::open(zoo.path());
        for _ in 0..3 {
            draft("a").seal(zoo.path()).unwrap();
        }
        let two = registry.resolve("a@2").unwrap();
        let message = registry.resolve("a@best").unwrap_err().to_string();
        assert!(message.contains("no alias `best`; aliases: latest; set one with"), "{message}");
        registry.set_alias(&two, "best", true).unwrap();
        assert_eq!(registry.resolve("a@best").unwrap(), two);
        assert_eq!(registry.resolve("a@latest").unwrap().version, 3);
        registry.set_alias(&registry.resolve("a@3").unwrap(), "best", true).unwrap();
        assert_eq!(registry.resolve("a@best").unwrap().version, 3);
        for wrong in ["latest", "1", "B", ""] {
            assert!(registry.set_alias(&two, wrong, true).is_err(), "{wrong}");
        }
        registry.set_alias(&two, "best", false).unwrap();
        assert!(registry.resolve("a@best").is_err());
        assert!(registry.resolve("b@best").unwrap_err().to_string().contains("unknown entry `b@best`"));
        // what lies beside the versions is no version
        assert_eq!(registry.ids().unwrap().len(), 3);
    }

    #[test]
    fn an_entry_that_something_stands_on_is_not_removed_and_no_version_comes_twice() {
        let zoo = tempfile::tempdir().unwrap();
        let (registry, results) = (Registry::open(zoo.path()), zoo.path().join("results"));
        for _ in 0..2 {
            draft("a").seal(zoo.path()).unwrap();
        }
        let two = registry.resolve("a@2").unwrap();
        fs::create_dir_all(results.join("a@2_Lift_10000-10019_0123abcd")).unwrap();
        registry.set_alias(&two, "best", true).unwrap();
        let message = registry.remove(&two, &results).unwrap_err().to_string();
        assert!(message.contains("a@2_Lift_10000-10019_0123abcd, alias best"), "{message}");
        Entry::open(zoo.path(), &two).unwrap();
        fs::remove_dir_all(&results).unwrap();
        registry.set_alias(&two, "best", false).unwrap();
        registry.remove(&two, &results).unwrap();
        assert_eq!(registry.resolve("a").unwrap().version, 1);
        assert_eq!(draft("a").seal(zoo.path()).unwrap().version, 3);
    }

    #[test]
    fn a_pattern_means_every_name_that_fits() {
        let zoo = tempfile::tempdir().unwrap();
        let registry = Registry::open(zoo.path());
        for name in ["lift-act-s1", "lift-act-s2", "lift-act-s2", "lift-act-s10", "lift-act-slow", "stack-act"] {
            draft(name).seal(zoo.path()).unwrap();
        }
        let matching = |text: &str| -> Result<Vec<String>, String> {
            let found = registry.matching(text).map_err(|e| e.to_string())?;
            Ok(found.iter().map(EntryId::to_string).collect())
        };
        assert_eq!(matching("lift-act-s*").unwrap(), ["lift-act-s1@1", "lift-act-s10@1", "lift-act-s2@2"]);
        assert_eq!(matching("lift-act-s*@1").unwrap(), ["lift-act-s1@1", "lift-act-s10@1", "lift-act-s2@1"]);
        assert_eq!(matching("lift*").unwrap().len(), 4);
        assert_eq!(matching("*act").unwrap(), ["stack-act@1"]);
        assert_eq!(matching("stack-act").unwrap(), ["stack-act@1"]);
        assert!(matching("door*").unwrap_err().contains("unknown entry `door*`"));
        assert!(matching("lift*@x").unwrap_err().contains("number from 1"));
    }

    #[test]
    fn an_entry_is_found_by_its_name_and_by_its_path() {
        let zoo = tempfile::tempdir().unwrap();
        let other = Registry::open(Path::new("/nonexistent-zoo"));
        for name in ["a", "a", "b"] {
            draft(name).seal(zoo.path()).unwrap();
        }
        let place = |text: &str| zoo.path().join(text).display().to_string();
        for (text, id) in
            [("a", "a@2"), ("a/", "a@2"), ("a@1", "a@1"), ("a/1", "a@1"), ("a/1/", "a@1"), ("b/1/../../a/2", "a@2")]
        {
            assert_eq!(other.locate(&place(text)).unwrap().id().to_string(), id, "{text}");
        }
        assert_eq!(Registry::open(zoo.path()).locate("a").unwrap().id().to_string(), "a@2");
        let message = other.locate(&place("c")).unwrap_err().to_string();
        assert!(
            message.starts_with("unknown entry `c` in zoo ") && message.contains("entries: a@1, a@2, b@1"),
            "{message}"
        );
        let message = other.locate("/").unwrap_err().to_string();
        assert!(message.starts_with("entry name ``"), "{message}");
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
