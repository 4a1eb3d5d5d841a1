//! Opening an entry: every byte is checked before any is used.

use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};

use crate::files::read_file;
use crate::{ZooError, sha256_file, sha256_hex};

use super::format::upgrade;
use super::meta::self_hashes;
use super::{
    CARD_FILE, CONFIG_FILE, CurvePoint, ENTRY_FILE, EntryId, EntryMeta, MODEL_FILE, NORMALISER_FILE, TRAIN_FILE, curve,
    hub,
};

/// More bytes than `entry.json` has.
const MOST_META: u64 = 1 << 26;

/// An entry whose files are the ones that were written.
#[derive(Debug, Clone)]
pub struct Entry {
    folder: PathBuf,
    meta: EntryMeta,
}

impl Entry {
    /// Opens `id` in `zoo` and verifies every file.
    ///
    /// # Errors
    /// [`ZooError::Tampered`] for the first file that differs from what was written.
    pub fn open(zoo: &Path, id: &EntryId) -> Result<Self, ZooError> {
        let mut entry = Self::open_meta(zoo, id)?;
        for (name, file) in &entry.meta.files {
            let path = entry.folder.join(name);
            let bytes = path.metadata().ok().filter(fs::Metadata::is_file).map(|metadata| metadata.len());
            let found = match bytes {
                // a file that grew may be too long to read; results of evaluations make a card longer
                Some(bytes) if bytes != file.bytes && name != CARD_FILE => {
                    format!("{bytes} bytes in place of {}", file.bytes)
                }
                Some(_) => sha256_file(&path)?,
                None => "no such file".to_owned(),
            };
            if found != file.sha256 && !(name == CARD_FILE && entry.card_with_results(&file.sha256)?) {
                return Err(ZooError::Tampered { path, expected: file.sha256.clone(), found });
            }
        }
        if let Some(training) = entry.meta.training.as_mut().filter(|training| training.curve.is_empty())
            && entry.meta.files.contains_key(TRAIN_FILE)
        {
            training.curve = curve::read(&entry.folder.join(TRAIN_FILE))?;
        }
        Ok(entry)
    }

    /// Reads and verifies `entry.json` alone: enough to list entries.
    ///
    /// # Errors
    /// [`ZooError::Tampered`] or [`ZooError::Malformed`] when it is not the file that was written.
    pub fn open_meta(zoo: &Path, id: &EntryId) -> Result<Self, ZooError> {
        let folder = zoo.join(&id.name).join(id.version.to_string());
        let path = folder.join(ENTRY_FILE);
        let text = read_file(&path, MOST_META).map_err(ZooError::io("read", &path))?;
        let malformed = |reason: String| ZooError::Malformed { path: path.clone(), reason };
        let (expected, found) =
            self_hashes(&text).ok_or_else(|| malformed("the hash of the file itself is missing".to_owned()))?;
        if expected != found {
            return Err(ZooError::Tampered { path, expected, found });
        }
        let not_an_entry = |e: serde_json::Error| malformed(format!("not an entry: {e}"));
        let value = upgrade(serde_json::from_slice(&text).map_err(not_an_entry)?).map_err(malformed)?;
        let meta: EntryMeta = serde_json::from_value(value).map_err(not_an_entry)?;
        if meta.id() != *id {
            return Err(malformed(format!("expected entry {id}, found {}", meta.id())));
        }
        if let Some(name) = meta.files.keys().find(|name| Path::new(name).file_name() != Some(OsStr::new(name))) {
            return Err(malformed(format!("files: expected plain names, found {name:?}")));
        }
        for name in [MODEL_FILE, CONFIG_FILE, NORMALISER_FILE, CARD_FILE] {
            if !meta.files.contains_key(name) {
                return Err(malformed(format!("no hash of {name}")));
            }
        }
        Ok(Self { folder, meta })
    }

    /// What `entry.json` says.
    pub fn meta(&self) -> &EntryMeta {
        &self.meta
    }

    /// Every point of its training curve; where the metrics of its training are not there, those that `entry.json` kept.
    ///
    /// # Errors
    /// When they cannot be read.
    pub fn whole_curve(&self) -> Result<Vec<CurvePoint>, ZooError> {
        if self.meta.training.is_some() && self.meta.files.contains_key(TRAIN_FILE) {
            return curve::whole(&self.folder.join(TRAIN_FILE));
        }
        Ok(self.meta.training.as_ref().map_or_else(Vec::new, |training| training.curve.clone()))
    }

    /// `name@version`.
    pub fn id(&self) -> EntryId {
        self.meta.id()
    }

    /// The entry's folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// The model card.
    ///
    /// # Errors
    /// When it cannot be read.
    pub fn card(&self) -> Result<String, ZooError> {
        self.text(CARD_FILE)
    }

    /// The model card without its metadata, as people read it.
    ///
    /// # Errors
    /// When it cannot be read.
    pub fn card_body(&self) -> Result<String, ZooError> {
        Ok(hub::body(&self.card()?).to_owned())
    }

    /// The resolved experiment as TOML text.
    ///
    /// # Errors
    /// When it cannot be read.
    pub fn config_text(&self) -> Result<String, ZooError> {
        self.text(CONFIG_FILE)
    }

    /// The model card for the Hugging Face Hub: with the results of evaluations, a YAML text that is a `model-index` or
    /// empty, among its metadata.
    ///
    /// # Errors
    /// When the card cannot be read.
    pub fn hub_card(&self, model_index: &str) -> Result<String, ZooError> {
        Ok(hub::with_results(&self.card()?, &self.meta, model_index))
    }

    /// Whether the card is the sealed one but for results of evaluations, which were written to it later.
    fn card_with_results(&self, sealed: &str) -> Result<bool, ZooError> {
        let path = self.folder.join(CARD_FILE);
        let Ok(card) = fs::read(&path) else { return Ok(false) };
        let Ok(card) = String::from_utf8(card) else { return Ok(false) };
        Ok(hub::without_results(&card).iter().any(|text| sha256_hex(text.as_bytes()) == sealed))
    }

    fn text(&self, name: &str) -> Result<String, ZooError> {
        let path = self.folder.join(name);
        fs::read_to_string(&path).map_err(ZooError::io("read", path))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::testing::draft;
    use super::*;

    #[test]
    fn what_was_sealed_opens() {
        let zoo = tempfile::tempdir().unwrap();
        let id = draft("lift-act").seal(zoo.path()).unwrap();
        let entry = Entry::open(zoo.path(), &id).unwrap();
        assert_eq!(entry.meta().training, draft("lift-act").meta.training);
        assert_eq!(entry.meta().files.len(), 4);
        assert!(entry.card().unwrap().contains("lift-act@1"));
        assert_eq!(entry.config_text().unwrap(), draft("x").config);
    }

    /// Any single flipped bit in any file gives one error that names the file.
    #[test]
    fn a_flipped_bit_anywhere_is_found() {
        let zoo = tempfile::tempdir().unwrap();
        let id = draft("lift-act").seal(zoo.path()).unwrap();
        let folder = zoo.path().join("lift-act/1");
        for name in [MODEL_FILE, CONFIG_FILE, NORMALISER_FILE, CARD_FILE, ENTRY_FILE] {
            let path = folder.join(name);
            let original = fs::read(&path).unwrap();
            for position in (0..original.len()).step_by(7) {
                let mut bytes = original.clone();
                bytes[position] ^= 1 << (position % 8);
                fs::write(&path, bytes).unwrap();
                let error = Entry::open(zoo.path(), &id).unwrap_err().to_string();
                assert!(error.starts_with(&path.display().to_string()), "{error}");
            }
            fs::write(&path, original).unwrap();
        }
        Entry::open(zoo.path(), &id).unwrap();
    }

    #[test]
    fn the_error_says_expected_and_found() {
        let zoo = tempfile::tempdir().unwrap();
        let id = draft("lift-act").seal(zoo.path()).unwrap();
        let path = zoo.path().join("lift-act/1").join(MODEL_FILE);
        fs::write(&path, b"weightz").unwrap();
        let error = Entry::open(zoo.path(), &id).unwrap_err().to_string();
        let expected = crate::sha256_hex(b"weights");
        let found = crate::sha256_hex(b"weightz");
        assert_eq!(error, format!("{}: sha256 does not match: expected {expected}, found {found}", path.display()));
        fs::write(&path, b"weights that grew").unwrap();
        let error = Entry::open(zoo.path(), &id).unwrap_err().to_string();
        assert!(error.ends_with(&format!("expected {expected}, found 17 bytes in place of 7")), "{error}");
        fs::remove_file(&path).unwrap();
        let error = Entry::open(zoo.path(), &id).unwrap_err().to_string();
        assert!(error.ends_with("found no such file"), "{error}");
    }

    #[test]
    fn an_entry_moved_to_another_version_is_refused() {
        let zoo = tempfile::tempdir().unwrap();
        draft("a").seal(zoo.path()).unwrap();
        fs::rename(zoo.path().join("a/1"), zoo.path().join("a/2")).unwrap();
        let id = EntryId { name: "a".to_owned(), version: 2 };
        let error = Entry::open(zoo.path(), &id).unwrap_err().to_string();
        assert!(error.ends_with("expected entry a@2, found a@1"), "{error}");
    }
}
