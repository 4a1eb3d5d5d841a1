//! Writing an entry: all of it under a temporary name, then one rename.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::path::Path;

use rustix::fs::{CWD, RenameFlags, renameat_with};

use crate::files::sync_folder;
use crate::{ZooError, sha256_hex};

use super::format::FORMAT;
use super::meta::seal_text;
use super::{
    CARD_FILE, COMMAND_FILE, CONFIG_FILE, CardWords, ENTRY_FILE, EntryId, EntryMeta, FileMeta, MODEL_FILE,
    NORMALISER_FILE, REFERENCE_FILE, TRAIN_FILE, card, id,
};

/// What a version leaves behind that was removed: it is never given again.
pub(crate) const REMOVED: &str = ".removed-";

/// An entry before it has a version.
#[derive(Debug, Clone)]
pub struct EntryDraft {
    /// Provenance; `format`, `version` and `files` are filled in when it is sealed.
    pub meta: EntryMeta,
    /// Content of `model.safetensors`.
    pub model: Vec<u8>,
    /// Content of `config.toml`.
    pub config: String,
    /// Content of `normaliser.safetensors`.
    pub normaliser: Vec<u8>,
    /// What its model card says in other words than a robot policy's.
    pub card: CardWords,
    /// Content of `train.parquet`, of an entry that was trained here: `entry.json` then holds no curve.
    pub metrics: Option<Vec<u8>>,
    /// Content of `command.txt`, where the command is known.
    pub command: Option<String>,
    /// Content of `reference.safetensors`, where the policy gives the same for the same observations.
    pub reference: Option<Vec<u8>>,
}

impl EntryDraft {
    /// Writes the entry as the next free version under `zoo`.
    ///
    /// Writers of the same name wait for each other; a killed one leaves a hidden folder that no reader
    /// looks at and the next writer removes.
    ///
    /// # Errors
    /// When the name is not one an entry can have or the folder cannot be written.
    pub fn seal(self, zoo: &Path) -> Result<EntryId, ZooError> {
        self.seal_noting(zoo, &mut |_, _| Ok(()))
    }

    /// The same; `note` is told the entry's name and the SHA-256 of its `entry.json` before the entry appears, so that
    /// a caller that is killed after that can tell it from another's.
    ///
    /// # Errors
    /// As [`EntryDraft::seal`], and what `note` refuses.
    pub fn seal_noting(
        mut self,
        zoo: &Path,
        note: &mut dyn FnMut(&EntryId, &str) -> Result<(), ZooError>,
    ) -> Result<EntryId, ZooError> {
        id::check_name(&self.meta.name)?;
        let parent = zoo.join(&self.meta.name);
        fs::create_dir_all(&parent).map_err(ZooError::io("create folder", &parent))?;
        let _lock = lock_name(&parent)?;
        let newest = sweep(&parent)?;

        self.meta.format = FORMAT;
        self.meta.version = newest + 1;
        self.meta.files = BTreeMap::new();
        let card = card::render(&self.meta, &self.card);
        let mut contents: Vec<(&str, &[u8])> = vec![
            (MODEL_FILE, &self.model),
            (CONFIG_FILE, self.config.as_bytes()),
            (NORMALISER_FILE, &self.normaliser),
            (CARD_FILE, card.as_bytes()),
        ];
        contents.extend(self.command.as_ref().map(|command| (COMMAND_FILE, command.as_bytes())));
        contents.extend(self.reference.as_ref().map(|reference| (REFERENCE_FILE, reference.as_slice())));
        if let Some(metrics) = &self.metrics {
            contents.push((TRAIN_FILE, metrics));
            self.meta.training.iter_mut().for_each(|training| training.curve.clear());
        }
        let staging = tempfile::Builder::new()
            .prefix(".tmp-")
            .permissions(std::os::unix::fs::PermissionsExt::from_mode(0o755))
            .tempdir_in(&parent)
            .map_err(ZooError::io("create a temporary folder in", &parent))?;
        for (name, bytes) in contents {
            write_synced(&staging.path().join(name), bytes)?;
            self.meta.files.insert(name.to_owned(), FileMeta { bytes: bytes.len() as u64, sha256: sha256_hex(bytes) });
        }
        let text = seal_text(&self.meta);
        write_synced(&staging.path().join(ENTRY_FILE), text.as_bytes())?;
        sync_folder(staging.path())?;
        note(&self.meta.id(), &sha256_hex(text.as_bytes()))?;
        let target = parent.join(self.meta.version.to_string());
        renameat_with(CWD, staging.path(), CWD, &target, RenameFlags::NOREPLACE)
            .map_err(|e| ZooError::io("create entry", &target)(e.into()))?;
        // renamed away: nothing is left to remove
        let _gone = staging.keep();
        sync_folder(&parent)?;
        Ok(self.meta.id())
    }
}

/// Holds the name whose versions are in `parent` until it is dropped: others wait.
pub(crate) fn lock_name(parent: &Path) -> Result<File, ZooError> {
    let path = parent.join(".lock");
    let lock = File::create(&path).map_err(ZooError::io("create", &path))?;
    rollout::lock(&lock, parent).map_err(ZooError::io("lock", &path))?;
    Ok(lock)
}

fn write_synced(path: &Path, bytes: &[u8]) -> Result<(), ZooError> {
    use std::io::Write;
    File::create(path)
        .and_then(|mut file| {
            file.write_all(bytes)?;
            file.sync_all()
        })
        .map_err(ZooError::io("write", path))
}

/// Removes what killed writers left and gives the newest version. Only under the name's lock.
fn sweep(parent: &Path) -> Result<u32, ZooError> {
    let mut newest = 0;
    for item in fs::read_dir(parent).map_err(ZooError::io("read folder", parent))? {
        let item = item.map_err(ZooError::io("read folder", parent))?;
        let name = item.file_name();
        let name = name.to_string_lossy();
        if name.starts_with(".tmp-") {
            fs::remove_dir_all(item.path()).map_err(ZooError::io("remove", item.path()))?;
        } else if let Ok(version) = name.strip_prefix(REMOVED).unwrap_or(&name).parse::<u32>() {
            newest = newest.max(version);
        }
    }
    Ok(newest)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::Entry;
    use super::super::testing::draft;
    use super::*;
    use crate::registry::Registry;

    #[test]
    fn versions_count_up_and_are_never_rewritten() {
        let zoo = tempfile::tempdir().unwrap();
        let ids: Vec<String> = (0..3).map(|_| draft("lift-act").seal(zoo.path()).unwrap().to_string()).collect();
        assert_eq!(ids, ["lift-act@1", "lift-act@2", "lift-act@3"]);
        fs::remove_dir_all(zoo.path().join("lift-act/2")).unwrap();
        assert_eq!(draft("lift-act").seal(zoo.path()).unwrap().version, 4);
    }

    #[test]
    fn concurrent_writers_get_different_versions() {
        let zoo = tempfile::tempdir().unwrap();
        let mut versions: Vec<u32> = std::thread::scope(|scope| {
            let threads: Vec<_> =
                (0..8).map(|_| scope.spawn(|| draft("x").seal(zoo.path()).unwrap().version)).collect();
            threads.into_iter().map(|t| t.join().unwrap()).collect()
        });
        versions.sort_unstable();
        assert_eq!(versions, (1..=8).collect::<Vec<_>>());
        for id in Registry::open(zoo.path()).ids().unwrap() {
            Entry::open(zoo.path(), &id).unwrap();
        }
    }

    #[test]
    fn a_killed_writer_leaves_no_entry() {
        let zoo = tempfile::tempdir().unwrap();
        let left = zoo.path().join("x/.tmp-killed");
        fs::create_dir_all(&left).unwrap();
        fs::write(left.join(MODEL_FILE), b"half").unwrap();
        assert!(Registry::open(zoo.path()).ids().unwrap().is_empty());
        assert_eq!(draft("x").seal(zoo.path()).unwrap().version, 1);
        assert!(!left.exists());
    }

    #[test]
    fn names_outside_the_rule_are_refused() {
        let zoo = tempfile::tempdir().unwrap();
        for name in ["../x", "Results", "results", ""] {
            assert!(matches!(draft(name).seal(zoo.path()), Err(ZooError::EntryName { .. })));
        }
        assert_eq!(fs::read_dir(zoo.path()).unwrap().count(), 0);
    }
}
