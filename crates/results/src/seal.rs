//! The seal of a result folder: what its files were when the evaluation ended, written last.
//!
//! A seal tells damage, edits and folders that were copied or renamed. It is no signature: who edits a result and seals
//! it anew is found by running it again (`eval --again`), not by a hash.

use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::record::EntryIdentity;
use crate::files::{MOST_TEXT, read_file, sha256_file, sha256_hex, write_atomic};
use crate::{EvaluationRecord, ResultsError};

/// The seal's file.
pub const SEAL_FILE: &str = "seal.json";

/// What a result folder was when its evaluation ended.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Seal {
    /// Version of this file's layout.
    pub format: u32,
    /// The folder's name.
    pub folder: String,
    /// The entry.
    pub entry: EntryIdentity,
    /// sha256 of the rules.
    pub protocol: String,
    /// sha256 of each file.
    pub files: BTreeMap<String, String>,
    /// One hash for the content: over the lines `<sha256>  <file>`.
    pub content: String,
}

impl Seal {
    const FORMAT: u32 = 1;

    /// The seal that the `files` in `folder` have now; `name` is what their record says the folder is called.
    ///
    /// # Errors
    /// [`ResultsError::Tampered`] for a file that is not there, and files that cannot be read.
    pub fn of(
        folder: &Path,
        name: &str,
        entry: &EntryIdentity,
        protocol: &str,
        files: &[&str],
    ) -> Result<Self, ResultsError> {
        let mut hashes = BTreeMap::new();
        for file in files {
            hashes.insert((*file).to_owned(), sha256_file(&folder.join(file))?);
        }
        let lines: String = hashes.iter().map(|(file, sha256)| format!("{sha256}  {file}\n")).collect();
        Ok(Self {
            format: Self::FORMAT,
            folder: name.to_owned(),
            entry: entry.clone(),
            protocol: protocol.to_owned(),
            files: hashes,
            content: sha256_hex(lines.as_bytes()),
        })
    }

    /// What the seal in `folder` says, true or not.
    ///
    /// # Errors
    /// A file that is not there, cannot be read or is no seal.
    pub(super) fn read(folder: &Path) -> Result<Self, ResultsError> {
        let path = folder.join(SEAL_FILE);
        let text = read_file(&path, MOST_TEXT).map_err(ResultsError::io("read", &path))?;
        Self::parse(&path, &text)
    }

    fn parse(path: &Path, text: &[u8]) -> Result<Self, ResultsError> {
        let malformed = |e| ResultsError::Malformed { path: path.to_owned(), reason: format!("not a seal: {e}") };
        serde_json::from_slice(text).map_err(malformed)
    }

    fn text(&self) -> Vec<u8> {
        let mut text = serde_json::to_vec_pretty(self).expect("plain fields are always JSON");
        text.push(b'\n');
        text
    }

    /// Writes it into `folder`: the last step of an evaluation.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<(), ResultsError> {
        write_atomic(&folder.join(SEAL_FILE), &self.text())
    }

    /// Compares with the seal that lies in `folder`, byte by byte; `false` where there is none.
    ///
    /// # Errors
    /// [`ResultsError::Tampered`] naming the first file that is not as it was, [`ResultsError::Unfit`] for anything else that
    /// the seal says otherwise, [`ResultsError::Malformed`] for a seal that is none.
    pub fn check(&self, folder: &Path) -> Result<bool, ResultsError> {
        let path = folder.join(SEAL_FILE);
        let text = match read_file(&path, MOST_TEXT) {
            Ok(text) => text,
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(false),
            Err(error) => return Err(ResultsError::io("read", path)(error)),
        };
        if text == self.text() {
            return Ok(true);
        }
        let malformed = |reason: String| ResultsError::Malformed { path: path.clone(), reason };
        let stored = Self::parse(&path, &text)?;
        for (file, found) in &self.files {
            let expected = stored.files.get(file).cloned().unwrap_or_else(|| "a file that the seal names".to_owned());
            if expected != *found {
                return Err(ResultsError::Tampered { path: folder.join(file), expected, found: found.clone() });
            }
        }
        let fields = [
            ("folder", &stored.folder, &self.folder),
            ("hash of the entry", &stored.entry.hash, &self.entry.hash),
            ("hash of the protocol", &stored.protocol, &self.protocol),
            ("hash of the content", &stored.content, &self.content),
        ];
        for (what, expected, found) in fields {
            if expected != found {
                let (what, expected, found) = (format!("{what} in {SEAL_FILE}"), expected.clone(), found.clone());
                return Err(ResultsError::Unfit { folder: folder.to_owned(), what, expected, found });
            }
        }
        Err(malformed("the seal is not as it was written".to_owned()))
    }
}

/// The seal that a finished evaluation in `folder` has now.
pub(super) fn seal_of(folder: &Path, record: &EvaluationRecord, files: &[&str]) -> Result<Seal, ResultsError> {
    Seal::of(folder, &record.folder_name(), &record.entry, &record.protocol.hash(), files)
}
