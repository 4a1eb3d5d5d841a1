//! Checkpoints: everything that the next step depends on, in one file that is either whole or not there.
//!
//! `checkpoints/<step>.safetensors` holds weights, EMA, moments and the generators' states;
//! `checkpoints/latest.json` names the newest one with its SHA-256 and is replaced after it. A run killed
//! between the two goes on from the one before.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use candle_core::Tensor;
use serde::{Deserialize, Serialize};

use crate::{ZooError, sha256_hex, tensors, write_atomic};

/// Checkpoints kept: the newest, and one before it.
const KEEP: usize = 2;

/// A training run between two steps.
#[derive(Debug)]
pub struct Checkpoint {
    /// Optimiser steps done.
    pub step: u64,
    /// Seconds of training so far, over all sessions of the run.
    pub seconds: f64,
    /// Tensors of the trainer by name.
    pub tensors: BTreeMap<String, Tensor>,
    /// What else the trainer needs.
    pub trainer: serde_json::Value,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Meta {
    step: u64,
    seconds: f64,
    trainer: serde_json::Value,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Latest {
    file: String,
    sha256: String,
    step: u64,
}

impl Checkpoint {
    /// Where the checkpoint of a step is.
    pub fn path(folder: &Path, step: u64) -> PathBuf {
        folder.join(file_name(step))
    }

    /// Writes the checkpoint into `folder` and forgets older ones.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn save(&self, folder: &Path) -> Result<PathBuf, ZooError> {
        fs::create_dir_all(folder).map_err(ZooError::io("create folder", folder))?;
        let path = Self::path(folder, self.step);
        let file = file_name(self.step);
        let latest_path = folder.join("latest.json");
        let meta = Meta { step: self.step, seconds: self.seconds, trainer: self.trainer.clone() };
        let meta = serde_json::to_value(meta).expect("numbers and JSON become JSON");
        let bytes = tensors::to_bytes(&path, &self.tensors, &meta)?;
        write_atomic(&path, &bytes)?;
        let latest = Latest { sha256: sha256_hex(&bytes), step: self.step, file };
        let text = serde_json::to_string_pretty(&latest).expect("strings become JSON") + "\n";
        write_atomic(&latest_path, text.as_bytes())?;
        prune(folder, &path)?;
        Ok(path)
    }

    /// Steps done at the newest checkpoint of `folder`, as its note says; 0 where there is none yet.
    ///
    /// # Errors
    /// A note that cannot be read.
    pub fn latest_step(folder: &Path) -> Result<u64, ZooError> {
        Ok(read_note(folder)?.map_or(0, |latest| latest.step))
    }

    /// The newest checkpoint of `folder`; `None` where there is none yet.
    ///
    /// # Errors
    /// When it is not the file that was written.
    pub fn latest(folder: &Path) -> Result<Option<Self>, ZooError> {
        let Some(latest) = read_note(folder)? else { return Ok(None) };
        let path = folder.join(&latest.file);
        let bytes = fs::read(&path).map_err(ZooError::io("read", &path))?;
        let found = sha256_hex(&bytes);
        if found != latest.sha256 {
            return Err(ZooError::Tampered { path, expected: latest.sha256, found });
        }
        let (tensors, meta) = tensors::from_bytes(&path, &bytes)?;
        let meta: Meta = serde_json::from_value(meta)
            .map_err(|e| ZooError::Malformed { path: path.clone(), reason: format!("not a checkpoint: {e}") })?;
        Ok(Some(Self { step: meta.step, seconds: meta.seconds, tensors, trainer: meta.trainer }))
    }
}

/// What names the newest checkpoint, where there is one.
fn read_note(folder: &Path) -> Result<Option<Latest>, ZooError> {
    let path = folder.join("latest.json");
    if !path.exists() {
        return Ok(None);
    }
    let text = fs::read_to_string(&path).map_err(ZooError::io("read", &path))?;
    let malformed = |e| ZooError::Malformed { path, reason: format!("not a checkpoint note: {e}") };
    serde_json::from_str(&text).map(Some).map_err(malformed)
}

fn file_name(step: u64) -> String {
    format!("{step:08}.safetensors")
}

/// Forgets checkpoints but for `newest` and the latest of the others.
fn prune(folder: &Path, newest: &Path) -> Result<(), ZooError> {
    let mut paths = Vec::new();
    for item in fs::read_dir(folder).map_err(ZooError::io("read folder", folder))? {
        let path = item.map_err(ZooError::io("read folder", folder))?.path();
        let step = path.file_stem().and_then(|stem| stem.to_str()?.parse::<u64>().ok());
        let is_own = step.is_some_and(|step| path.ends_with(file_name(step))) && path.is_file();
        if is_own && path != newest {
            paths.push(path);
        }
    }
    paths.sort();
    paths.truncate((paths.len() + 1).saturating_sub(KEEP));
    for path in paths {
        fs::remove_file(&path).map_err(ZooError::io("remove", path))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use candle_core::Device;

    use super::*;

    fn checkpoint(step: u64) -> Checkpoint {
        let w = Tensor::from_vec(vec![step as f32, 0.1], 2, &Device::Cpu).unwrap();
        Checkpoint {
            step,
            seconds: 1.5,
            tensors: [("model/w".to_owned(), w)].into(),
            trainer: serde_json::json!({"rng": [1, 2, u64::MAX]}),
        }
    }

    #[test]
    fn the_newest_comes_back_and_old_ones_go() {
        let folder = tempfile::tempdir().unwrap();
        let folder = folder.path().join("checkpoints");
        assert!(Checkpoint::latest(&folder).unwrap().is_none());
        fs::create_dir_all(folder.join("000002")).unwrap();
        fs::write(folder.join("1.pt"), "of others").unwrap();
        for step in [5, 10, 200] {
            checkpoint(step).save(&folder).unwrap();
        }
        assert!(folder.join("000002").is_dir() && folder.join("1.pt").is_file());
        let back = Checkpoint::latest(&folder).unwrap().unwrap();
        assert_eq!((back.step, back.seconds), (200, 1.5));
        assert_eq!(back.trainer["rng"][2], u64::MAX);
        assert_eq!(back.tensors["model/w"].to_vec1::<f32>().unwrap(), [200.0, 0.1]);
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 5);
    }

    #[test]
    fn a_kill_before_the_note_leaves_the_one_before() {
        let folder = tempfile::tempdir().unwrap();
        checkpoint(5).save(folder.path()).unwrap();
        let note = fs::read(folder.path().join("latest.json")).unwrap();
        checkpoint(10).save(folder.path()).unwrap();
        fs::write(folder.path().join("latest.json"), note).unwrap();
        assert_eq!(Checkpoint::latest(folder.path()).unwrap().unwrap().step, 5);
    }

    #[test]
    fn a_flipped_byte_is_found() {
        let folder = tempfile::tempdir().unwrap();
        let path = checkpoint(5).save(folder.path()).unwrap();
        let mut bytes = fs::read(&path).unwrap();
        *bytes.last_mut().unwrap() ^= 1;
        fs::write(&path, bytes).unwrap();
        let error = Checkpoint::latest(folder.path()).unwrap_err().to_string();
        assert!(error.contains("00000005.safetensors: sha256 does not match"), "{error}");
    }
}
