//! Demonstrations under collection: every attempt of the expert on disk as it finishes, so that a collection that was
//! stopped or killed goes on where it was.
//!
//! What a collection depends on is written first (`collection.json`); another one is refused the folder. The folder is
//! removed when the demonstrations have been written to their file.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::ErrorKind;
use std::ops::{ControlFlow, Range};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::episode::no_expert;
use crate::error::RolloutError;
use crate::files::write_atomic;
use crate::locks;
use crate::message::{Control, Ready, Skill};
use crate::pool::{Pool, RunEnd};
use crate::recorded::RecordedEpisode;
use crate::worker::Worker;

const RECORD: &str = "collection.json";
const LOCK: &str = "lock";

/// All that the attempts of a collection depend on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CollectionRecord {
    /// Version of the folder's layout.
    pub format: u32,
    /// The task.
    pub task: String,
    /// Seed of the first attempt; the others count up from it.
    pub first_seed: u64,
    /// The control loop that is really used.
    pub control: Control,
    /// The module of the user's that registers the environment, if any.
    pub env_module: Option<String>,
    /// Another of the task's experts than the usual one, by its name.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub expert: Option<String>,
    /// How able whoever shows the demonstrations is.
    #[serde(default, skip_serializing_if = "Skill::is_good")]
    pub skill: Skill,
    /// robomimic's arguments of the environment, cameras included.
    pub env_args: serde_json::Value,
    /// Versions of the simulator and what it stands on.
    pub versions: BTreeMap<String, String>,
    /// SHA-256 by package of the sources that were imported to simulate.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub sources: BTreeMap<String, String>,
    /// Which kernels numpy's linear algebra ran, where the workers tell.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub kernels: Option<String>,
    /// What draws the cameras' images.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub renderer: Option<String>,
}

impl CollectionRecord {
    /// The record of a collection from workers that greet like this.
    pub fn new(ready: &Ready, first_seed: u64, env_module: Option<String>) -> Self {
        Self {
            format: 1,
            task: ready.task.clone(),
            first_seed,
            control: ready.control,
            env_module,
            expert: None,
            skill: Skill::Good,
            env_args: ready.env_args.clone(),
            versions: ready.versions.clone(),
            sources: ready.sources.clone(),
            kernels: ready.kernels.clone(),
            renderer: ready.renderer.clone(),
        }
    }

    /// Whether the attempts of a stored record are ours. An older one says nothing of kernels and renderer.
    fn is_of(&self, stored: &[u8]) -> bool {
        serde_json::from_slice(stored).is_ok_and(|stored: Self| {
            let kernels = stored.kernels.clone().or_else(|| self.kernels.clone());
            let renderer = stored.renderer.clone().or_else(|| self.renderer.clone());
            Self { kernels, renderer, ..stored } == *self
        })
    }
}

/// How an attempt went.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Attempt {
    /// Which, counted from 0.
    pub index: u64,
    /// Whether the task was done.
    pub success: bool,
    /// Control steps.
    pub steps: usize,
}

impl Attempt {
    fn of(index: u64, episode: &RecordedEpisode) -> Self {
        Self { index, success: episode.success, steps: episode.steps }
    }
}

/// A collection under way. Holds the folder's lock.
#[derive(Debug)]
pub struct Collection {
    folder: PathBuf,
    first_seed: u64,
    expert: Option<String>,
    skill: Skill,
    _lock: File,
}

impl Collection {
    /// Opens the folder of a collection, new or with the attempts that are there.
    ///
    /// # Errors
    /// [`RolloutError::CollectionBusy`] while another process collects there, [`RolloutError::CollectionDiffers`] if the attempts
    /// there are of another collection.
    pub fn open(folder: &Path, record: &CollectionRecord) -> Result<Self, RolloutError> {
        fs::create_dir_all(folder).map_err(RolloutError::file("creating folder", folder))?;
        let path = folder.join(LOCK);
        let lock = File::create(&path).map_err(RolloutError::file("creating", &path))?;
        if !locks::try_lock(&lock, folder).map_err(RolloutError::file("locking", &path))? {
            return Err(RolloutError::CollectionBusy { folder: folder.to_owned() });
        }
        let path = folder.join(RECORD);
        let mut text = serde_json::to_vec_pretty(record).expect("plain fields are always JSON");
        text.push(b'\n');
        let (first_seed, expert, skill) = (record.first_seed, record.expert.clone(), record.skill);
        let collection = Self { folder: folder.to_owned(), first_seed, expert, skill, _lock: lock };
        match fs::read(&path) {
            Ok(found) if found == text => {}
            // of an older program, which did not tell as much
            Ok(found) if record.is_of(&found) => write_atomic(&path, &text)?,
            // one that came to no attempt is in nobody's way
            Ok(found) if collection.count()? > 0 => return Err(differs(folder, &found, record)),
            Ok(_) => write_atomic(&path, &text)?,
            Err(error) if error.kind() == ErrorKind::NotFound => write_atomic(&path, &text)?,
            Err(error) => return Err(RolloutError::file("reading", &path)(error)),
        }
        Ok(collection)
    }

    fn path(&self, attempt: u64) -> PathBuf {
        self.folder.join(format!("attempt-{attempt:06}.safetensors"))
    }

    /// Attempts that are on disk.
    ///
    /// # Errors
    /// A folder that cannot be read.
    pub fn count(&self) -> Result<usize, RolloutError> {
        let entries = fs::read_dir(&self.folder).map_err(RolloutError::file("reading folder", &self.folder))?;
        let is_attempt = |name: &str| name.starts_with("attempt-") && name.ends_with(".safetensors");
        Ok(entries.flatten().filter(|entry| entry.file_name().to_str().is_some_and(is_attempt)).count())
    }

    /// An attempt that is on disk.
    ///
    /// # Errors
    /// A file that cannot be read or is none of ours.
    pub fn get(&self, attempt: u64) -> Result<Option<RecordedEpisode>, RolloutError> {
        let path = self.path(attempt);
        let bytes = match fs::read(&path) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(RolloutError::file("reading", &path)(error)),
        };
        let malformed = |problem| RolloutError::Attempt { path: path.clone(), problem };
        RecordedEpisode::from_bytes(&bytes).map(Some).map_err(malformed)
    }

    /// Puts an attempt on disk; of a failure nothing but its length.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn put(&self, attempt: u64, mut episode: RecordedEpisode) -> Result<(), RolloutError> {
        let path = self.path(attempt);
        if !episode.success {
            episode.attrs.clear();
            episode.tensors.clear();
        }
        let malformed = |problem| RolloutError::Attempt { path: path.clone(), problem };
        write_atomic(&path, &episode.into_bytes().map_err(malformed)?)
    }

    /// Runs the attempts that are not on disk and puts each there when it is done; `deliver` gets every attempt's
    /// success and length, in order, until it breaks.
    ///
    /// # Errors
    /// A failure on our side; a worker's failure that could not be made good is delivered.
    pub fn run(
        &self,
        pool: &mut Pool,
        attempts: Range<u64>,
        deliver: &mut dyn FnMut(Result<Attempt, RolloutError>) -> ControlFlow<()>,
    ) -> Result<RunEnd, RolloutError> {
        let first_seed = self.first_seed;
        let seed_of = |attempt: u64| first_seed + attempt;
        let failed = |attempt, operation| {
            let (seed, step) = (seed_of(attempt), 0);
            move |source: RolloutError| RolloutError::Policy { seed, step, operation, source: Box::new(source) }
        };
        let work = |(): &mut (), worker: &mut Worker, attempt| {
            if let Some(episode) = self.get(attempt).map_err(failed(attempt, "reading the stored attempt"))? {
                return Ok(Attempt::of(attempt, &episode));
            }
            let played = worker.expert(seed_of(attempt), self.expert.as_deref(), self.skill);
            let episode = played.map_err(|fault| no_expert(worker, fault))?;
            let done = Attempt::of(attempt, &episode);
            self.put(attempt, episode).map_err(failed(attempt, "storing the attempt"))?;
            Ok(done)
        };
        pool.run(attempts, &seed_of, &|| Ok(()), &work, &mut |_, result| deliver(result))
    }

    /// Removes the folder: its attempts are not needed any more.
    ///
    /// # Errors
    /// Files that cannot be removed.
    pub fn discard(self) -> Result<(), RolloutError> {
        fs::remove_dir_all(&self.folder).map_err(RolloutError::file("removing folder", &self.folder))
    }
}

/// The first field in which the stored record differs.
fn differs(folder: &Path, stored: &[u8], record: &CollectionRecord) -> RolloutError {
    let mut stored: serde_json::Value = serde_json::from_slice(stored).unwrap_or_default();
    let mut now = serde_json::to_value(record).expect("plain fields are always JSON");
    for fields in [&mut stored, &mut now].into_iter().filter_map(serde_json::Value::as_object_mut) {
        // the usual one is left out of records, but not of what is said about them
        fields.entry("skill").or_insert_with(|| Skill::Good.as_str().into());
    }
    // an older record does not have these, which is no difference
    let telling = |name: &&str| stored.get(*name).is_some();
    let untold: Vec<&str> = ["kernels", "renderer"].into_iter().filter(|name| !telling(name)).collect();
    let fields = now.as_object().into_iter().flatten().filter(|(name, _)| !untold.contains(&name.as_str()));
    let text = |value: Option<&serde_json::Value>| value.map_or_else(|| "nothing".to_owned(), ToString::to_string);
    let found = fields.map(|(name, value)| (name, value, stored.get(name))).find(|(_, now, was)| *was != Some(*now));
    let (what, expected, found) = match found {
        Some((name, now, was)) => (name.clone(), text(Some(now)), text(was)),
        None => (RECORD.to_owned(), text(Some(&now)), text(Some(&stored))),
    };
    RolloutError::CollectionDiffers { folder: folder.to_owned(), what, expected, found }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::frame::FrameTensor;

    fn record() -> CollectionRecord {
        CollectionRecord {
            format: 1,
            task: "Lift".into(),
            first_seed: 1_000_000,
            control: Control::Compiled,
            env_module: None,
            expert: None,
            skill: Skill::Good,
            env_args: serde_json::json!({"env_name": "Lift", "env_kwargs": {"camera_names": ["agentview"]}}),
            versions: [("mujoco".to_owned(), "3.3.7".to_owned())].into(),
            sources: [("robosuite".to_owned(), "a".repeat(64))].into(),
            kernels: Some("openblas Haswell".into()),
            renderer: None,
        }
    }

    fn episode(success: bool) -> RecordedEpisode {
        RecordedEpisode {
            success,
            steps: 2,
            attrs: [("model_file".to_owned(), serde_json::json!("<mujoco>\"\n</mujoco>"))].into(),
            tensors: [("obs/object".to_owned(), FrameTensor::from_f64(&[2, 1], &[0.1, -0.0]))].into(),
        }
    }

    #[test]
    fn attempts_come_back_as_they_were_and_a_failure_keeps_its_length() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("parts");
        let collection = Collection::open(&folder, &record()).unwrap();
        assert_eq!(collection.get(3).unwrap(), None);
        collection.put(3, episode(true)).unwrap();
        collection.put(1, episode(false)).unwrap();
        drop(collection);
        let collection = Collection::open(&folder, &record()).unwrap();
        assert_eq!(collection.count().unwrap(), 2);
        assert_eq!(collection.get(3).unwrap(), Some(episode(true)));
        let failed = collection.get(1).unwrap().unwrap();
        assert_eq!((failed.success, failed.steps, failed.tensors.len()), (false, 2, 0));
        collection.discard().unwrap();
        assert!(!folder.exists());
    }

    #[test]
    fn another_collection_and_another_process_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let first = Collection::open(dir.path(), &record()).unwrap();
        let busy = Collection::open(dir.path(), &record()).unwrap_err();
        assert!(matches!(busy, RolloutError::CollectionBusy { .. }), "{busy}");
        // one without an attempt gives way to another
        drop(first);
        let other = CollectionRecord { first_seed: 2_000_000, ..record() };
        drop(Collection::open(dir.path(), &other).unwrap());
        let first = Collection::open(dir.path(), &record()).unwrap();
        first.put(0, episode(true)).unwrap();
        drop(first);
        let error = Collection::open(dir.path(), &other).unwrap_err().to_string();
        assert!(error.contains("first_seed: expected 2000000, found 1000000"), "{error}");
        let mixed = CollectionRecord { skill: Skill::Mixed, ..record() };
        let error = Collection::open(dir.path(), &mixed).unwrap_err().to_string();
        assert!(error.contains("skill: expected \"mixed\", found \"good\""), "{error}");
        let shadow = CollectionRecord { sources: [("robosuite".to_owned(), "b".repeat(64))].into(), ..record() };
        let error = Collection::open(dir.path(), &shadow).unwrap_err().to_string();
        assert!(error.contains("sources: expected {\"robosuite\":\"bbbb"), "{error}");
        let kernels = CollectionRecord { kernels: Some("openblas SkylakeX".into()), ..record() };
        let error = Collection::open(dir.path(), &kernels).unwrap_err().to_string();
        assert!(error.contains("kernels: expected \"openblas SkylakeX\", found \"openblas Haswell\""), "{error}");
        // of an older program, which did not tell
        let older = CollectionRecord { kernels: None, ..record() };
        fs::write(dir.path().join(RECORD), serde_json::to_vec(&older).unwrap()).unwrap();
        assert_eq!(Collection::open(dir.path(), &kernels).unwrap().count().unwrap(), 1);
    }

    #[test]
    fn a_skill_is_kept_and_the_usual_one_is_written_as_it_always_was() {
        let text = serde_json::to_string(&record()).unwrap();
        assert!(!text.contains("skill"), "{text}");
        let dir = tempfile::tempdir().unwrap();
        let mixed = CollectionRecord { skill: Skill::Mixed, ..record() };
        Collection::open(dir.path(), &mixed).unwrap().put(0, episode(true)).unwrap();
        assert_eq!(Collection::open(dir.path(), &mixed).unwrap().count().unwrap(), 1);
        let error = Collection::open(dir.path(), &record()).unwrap_err().to_string();
        assert!(error.contains("skill: expected \"good\", found \"mixed\""), "{error}");
    }

    #[test]
    fn a_damaged_attempt_is_an_error_that_names_the_file() {
        let dir = tempfile::tempdir().unwrap();
        let collection = Collection::open(dir.path(), &record()).unwrap();
        collection.put(0, episode(true)).unwrap();
        let path = dir.path().join("attempt-000000.safetensors");
        let bytes = fs::read(&path).unwrap();
        fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
        let error = collection.get(0).unwrap_err().to_string();
        assert!(error.contains("attempt-000000.safetensors"), "{error}");
    }
}
