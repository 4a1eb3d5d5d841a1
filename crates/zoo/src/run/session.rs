//! What every training runs, whatever it trains: a folder, steps, validations, metrics, checkpoints, and the entry at
//! the end, stoppable at any step.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Instant, SystemTime};

use candle_core::{DType, Tensor};
use models::ModelError;
use serde::{Deserialize, Serialize};

use crate::entry::{CurvePoint, ENTRY_FILE, Entry, EntryDraft, EntryId, TRAIN_FILE, TrainingMeta, thinned};
use crate::{ZooError, sha256_file, write_atomic};

use super::checkpoint::Checkpoint;
use super::folder::{RunFolder, SEALING};
use super::metrics::{Metrics, MetricsRow};
use super::preflight;
use super::section::TrainSection;
use super::tensorboard::EventWriter;

/// Where a training takes place, and what it is called.
#[derive(Debug, Clone)]
pub struct Place {
    /// Name of the experiment, for the run's folder and the model card.
    pub name: String,
    /// Folder of runs; the run becomes `<runs>/<name>/<number>`.
    pub runs: PathBuf,
    /// Exactly this folder instead.
    pub run: Option<PathBuf>,
    /// Go on with the run that is there.
    pub resume: bool,
    /// The zoo that gets the entry.
    pub zoo: PathBuf,
    /// The command that trains it, for the entry; a run that goes on keeps the one that it began with.
    pub command: Option<String>,
}

/// What a training tells while it runs.
#[derive(Debug)]
pub enum TrainEvent<'a> {
    /// The folder that the run lives in.
    Folder(&'a Path),
    /// An HDF5 file is being converted: frames done and in all.
    Converting(u64, u64),
    /// Something that a user should know.
    Note(&'a str),
    /// Everything is ready: the first step to be done, counted from 0, and the number of steps.
    Begin {
        /// Steps done by earlier sessions of this run.
        from: u64,
        /// Steps in all.
        steps: u64,
        /// Number of weights.
        parameters: u64,
        /// Examples to train on; 0 where they are drawn as they are needed.
        windows: u64,
    },
    /// A step was done.
    Step(&'a MetricsRow),
    /// A checkpoint was written.
    Saved(&'a Path),
}

/// How a training ended.
#[derive(Debug, Clone, PartialEq)]
pub enum TrainOutcome {
    /// All steps done, entry written.
    Finished {
        /// The new entry.
        entry: EntryId,
        /// The run's folder.
        run: PathBuf,
        /// Minutes of training over all sessions.
        minutes: f64,
    },
    /// Asked to stop; a checkpoint is written.
    Stopped {
        /// Steps done.
        step: u64,
        /// The run's folder.
        run: PathBuf,
    },
}

/// A resolved experiment, as a run needs to know it.
pub trait Settings: Sized {
    /// Reads the text of a saved `config.toml`.
    ///
    /// # Errors
    /// Text that is no such experiment.
    fn read(name: &str, text: &str) -> Result<Self, ZooError>;
    /// The same as text.
    fn text(&self) -> String;
    /// Dotted keys and values, for comparing two experiments.
    fn values(&self) -> BTreeMap<String, String>;
    /// Its numbers.
    fn section(&self) -> &TrainSection;
    /// Name of the entry that it makes.
    fn entry(&self) -> &str;
    /// Bytes of memory that its training takes, rather less than really.
    fn least_bytes(&self) -> f64;
}

/// What learns in a run. All of its state is in [`Training::state`].
pub trait Training {
    /// Number of weights.
    fn parameters(&self) -> u64;
    /// Examples to train on; 0 where they are drawn as they are needed.
    fn examples(&self) -> u64;
    /// Threads that it works on.
    fn threads(&self) -> usize;

    /// The GPU that it works on, and CUDA's version; nothing on the CPU.
    fn gpu(&self) -> Option<String> {
        None
    }

    /// One optimiser step, number `step` from 0; what it measured, by name. Without `read` it may say nothing, so as not to wait
    /// for a GPU.
    ///
    /// # Errors
    /// A model that fails; [`ModelError::NotFinite`] inside [`ZooError::Model`] ends the run at its last checkpoint.
    fn step(&mut self, step: u64, read: bool) -> Result<BTreeMap<String, f64>, ZooError>;

    /// What a validation of the present weights finds, by name.
    ///
    /// # Errors
    /// A model that fails.
    fn validate(&mut self) -> Result<BTreeMap<String, f64>, ZooError>;

    /// A row of metrics was written: what is measured between rows begins anew.
    fn logged(&mut self) {}

    /// Everything that the next step depends on: tensors by name, and the rest.
    ///
    /// # Errors
    /// A model that fails.
    fn state(&self) -> Result<(BTreeMap<String, Tensor>, serde_json::Value), ZooError>;

    /// Goes on from `checkpoint`, which is the file at `path`.
    ///
    /// # Errors
    /// A state that is not one of this training.
    fn restore(&mut self, checkpoint: Checkpoint, path: &Path) -> Result<(), ZooError>;

    /// The entry that it has earned.
    ///
    /// # Errors
    /// A model that fails.
    fn draft(&mut self, name: &str, training: TrainingMeta, rows: &[MetricsRow]) -> Result<EntryDraft, ZooError>;
}

/// Trains what `make` makes, or goes on training it, until all steps are done or `stop` says so.
///
/// A run that `make` refuses leaves nothing behind.
///
/// # Errors
/// What `make` refuses, folders in use, runs that cannot be resumed, a loss that is not finite.
pub fn run<E: Settings, T: Training>(
    place: &Place,
    experiment: &E,
    make: impl FnOnce(&RunFolder, &mut dyn FnMut(TrainEvent<'_>)) -> Result<T, ZooError>,
    stop: &dyn Fn() -> bool,
    on_event: &mut dyn FnMut(TrainEvent<'_>),
) -> Result<TrainOutcome, ZooError> {
    preflight::check(place, experiment)?;
    let folder = match (&place.run, place.resume) {
        (Some(path), true) => RunFolder::resume(path)?,
        (Some(path), false) => RunFolder::fresh(path)?,
        (None, true) => RunFolder::resume_latest(&place.runs, &place.name)?,
        (None, false) => RunFolder::next(&place.runs, &place.name)?,
    };
    let outcome = run_in(&folder, place, experiment, make, stop, on_event);
    if outcome.is_err() && !folder.config_path().exists() {
        // refused before it began: as if it had never been asked for
        folder.discard();
    }
    outcome
}

fn run_in<E: Settings, T: Training>(
    folder: &RunFolder,
    place: &Place,
    experiment: &E,
    make: impl FnOnce(&RunFolder, &mut dyn FnMut(TrainEvent<'_>)) -> Result<T, ZooError>,
    stop: &dyn Fn() -> bool,
    on_event: &mut dyn FnMut(TrainEvent<'_>),
) -> Result<TrainOutcome, ZooError> {
    let config = folder.config_path();
    if place.resume {
        let text = std::fs::read_to_string(&config).map_err(ZooError::io("read", &config))?;
        same_settings(folder.path(), &E::read(&place.name, &text)?.values(), &experiment.values())?;
        if let Some(entry) = sealed(folder, &place.zoo)? {
            return finish(folder, entry.id(), &entry.meta().training.clone().unwrap_or_default());
        }
    }
    let training = make(folder, on_event)?;
    if !place.resume {
        if let Some(command) = &place.command {
            write_atomic(&folder.begun_path(), format!("{command}\n").as_bytes())?;
        }
        // last: its presence says that the run was begun
        write_atomic(&config, experiment.text().as_bytes())?;
    }
    on_event(TrainEvent::Folder(folder.path()));
    let mut session = Session::start(folder, experiment.section(), training, on_event)?;
    if !session.go(stop, on_event)? {
        return Ok(TrainOutcome::Stopped { step: session.step, run: folder.path().to_owned() });
    }
    let training = session.meta();
    let mut draft = session.training.draft(&place.name, training.clone(), session.metrics.rows())?;
    draft.metrics = Some(session.metrics.to_parquet(Path::new(TRAIN_FILE))?);
    draft.command = folder.begun()?;
    let entry = draft.seal_noting(&place.zoo, &mut |entry, sha256| {
        let note = Sealing { name: entry.name.clone(), version: entry.version, sha256: sha256.to_owned() };
        let text = serde_json::to_string_pretty(&note).expect("strings and numbers become JSON") + "\n";
        Ok(write_atomic(&folder.sealing_path(), text.as_bytes())?)
    })?;
    finish(folder, entry, &training)
}

/// Says that the run is finished.
fn finish(folder: &RunFolder, entry: EntryId, training: &TrainingMeta) -> Result<TrainOutcome, ZooError> {
    let minutes = training.minutes;
    let finished = serde_json::json!({"entry": entry.to_string(), "minutes": minutes, "steps": training.steps});
    write_atomic(&folder.finished_path(), format!("{finished:#}\n").as_bytes())?;
    Ok(TrainOutcome::Finished { entry, run: folder.path().to_owned(), minutes })
}

/// The entry that the run in `folder` made, as `name@version`; nothing while it is not finished. With it, whether the zoo has it.
///
/// # Errors
/// A note that cannot be read or names none.
pub fn finished_in(folder: &Path, zoo: &Path) -> Result<Option<(String, bool)>, ZooError> {
    let Some(entry) = finished_entry(folder)? else { return Ok(None) };
    let there = match sealing(folder)? {
        Some(note) => note.is_in(zoo)?,
        // a run from before there was a note
        None => {
            entry.split_once('@').is_some_and(|(name, version)| zoo.join(name).join(version).join(ENTRY_FILE).is_file())
        }
    };
    Ok(Some((entry, there)))
}

/// The entry that the run in `folder` made, as `name@version`; nothing while it is not finished.
///
/// # Errors
/// A note that cannot be read or names none.
pub fn finished_entry(folder: &Path) -> Result<Option<String>, ZooError> {
    let path = folder.join("finished.json");
    if !path.is_file() {
        return Ok(None);
    }
    let text = std::fs::read(&path).map_err(ZooError::io("read", &path))?;
    let malformed = |reason: String| ZooError::Malformed { path: path.clone(), reason };
    let note: serde_json::Value =
        serde_json::from_slice(&text).map_err(|e| malformed(format!("not the note of a finished run: {e}")))?;
    match note["entry"].as_str() {
        Some(entry) => Ok(Some(entry.to_owned())),
        None => Err(malformed(format!("entry: expected its name, found {}", note["entry"]))),
    }
}

/// The entry that a run is about to get, written before the entry appears: a run that was killed between the two
/// finds its own again.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Sealing {
    name: String,
    version: u32,
    /// Of `entry.json`, which no other run has: it holds the minutes that this one took.
    sha256: String,
}

impl Sealing {
    fn is_in(&self, zoo: &Path) -> Result<bool, ZooError> {
        let file = zoo.join(&self.name).join(self.version.to_string()).join(ENTRY_FILE);
        Ok(file.is_file() && sha256_file(&file)? == self.sha256)
    }
}

/// The note in a run's folder, if there is one.
fn sealing(folder: &Path) -> Result<Option<Sealing>, ZooError> {
    let path = folder.join(SEALING);
    if !path.exists() {
        return Ok(None);
    }
    let text = std::fs::read(&path).map_err(ZooError::io("read", &path))?;
    let note = serde_json::from_slice(&text);
    note.map(Some).map_err(|e| ZooError::Malformed { path, reason: format!("not the note of an entry: {e}") })
}

/// The entry that an earlier session of this run has sealed into `zoo`.
fn sealed(folder: &RunFolder, zoo: &Path) -> Result<Option<Entry>, ZooError> {
    let Some(note) = sealing(folder.path())? else { return Ok(None) };
    if !note.is_in(zoo)? {
        return Ok(None);
    }
    Entry::open(zoo, &EntryId { name: note.name, version: note.version }).map(Some)
}

/// A run under way.
struct Session<'a, T> {
    folder: &'a RunFolder,
    section: &'a TrainSection,
    training: T,
    metrics: Metrics,
    events: EventWriter,
    step: u64,
    /// Seconds of earlier sessions.
    before: f64,
    started: Instant,
    last_checkpoint: Option<PathBuf>,
}

impl<'a, T: Training> Session<'a, T> {
    fn start(
        folder: &'a RunFolder,
        section: &'a TrainSection,
        mut training: T,
        on_event: &mut dyn FnMut(TrainEvent<'_>),
    ) -> Result<Self, ZooError> {
        let (mut step, mut before, mut last_checkpoint) = (0, 0.0, None);
        if let Some(checkpoint) = Checkpoint::latest(&folder.checkpoints())? {
            (step, before) = (checkpoint.step, checkpoint.seconds);
            let path = Checkpoint::path(&folder.checkpoints(), step);
            training.restore(checkpoint, &path)?;
            last_checkpoint = Some(path);
        }
        let metrics = Metrics::open(folder.path().join("metrics.csv"), step)?;
        let events_path = folder.path().join("events.out.tfevents.0.actrm");
        let events = EventWriter::create(&events_path, metrics.rows(), wall_time())?;
        let (parameters, windows) = (training.parameters(), training.examples());
        on_event(TrainEvent::Begin { from: step, steps: section.steps, parameters, windows });
        let started = Instant::now();
        Ok(Self { folder, section, training, metrics, events, step, before, started, last_checkpoint })
    }

    fn seconds(&self) -> f64 {
        self.before + self.started.elapsed().as_secs_f64()
    }

    /// Steps until all are done (true) or `stop` says so (false). Either way a checkpoint is written.
    fn go(&mut self, stop: &dyn Fn() -> bool, on_event: &mut dyn FnMut(TrainEvent<'_>)) -> Result<bool, ZooError> {
        let section = self.section;
        while self.step < section.steps {
            if stop() {
                self.save(on_event)?;
                return Ok(false);
            }
            let next = self.step + 1;
            let last = next == section.steps;
            let validate = last || next.is_multiple_of(section.validate_every);
            let log = validate || next.is_multiple_of(section.log_every);
            let save = last || next.is_multiple_of(section.checkpoint_every);
            let values = self.training.step(self.step, log || save);
            let mut values = values.map_err(|error| self.step_error(error))?;
            self.step = next;
            if validate {
                values.extend(self.training.validate()?);
            }
            let row = MetricsRow { step: self.step, values };
            on_event(TrainEvent::Step(&row));
            if log {
                self.events.push(&row, wall_time())?;
                self.metrics.push(row)?;
                self.training.logged();
            }
            if save {
                self.save(on_event)?;
            }
        }
        Ok(true)
    }

    /// A number that is not finite stops the run; the checkpoint before it stays.
    fn step_error(&self, error: ZooError) -> ZooError {
        match error {
            ZooError::Model { source: ModelError::NotFinite { step, tensor, value }, .. } => {
                ZooError::NotFinite { step, tensor, value: f64::from(value), checkpoint: self.last_checkpoint.clone() }
            }
            other => other,
        }
    }

    fn save(&mut self, on_event: &mut dyn FnMut(TrainEvent<'_>)) -> Result<(), ZooError> {
        let (tensors, trainer) = self.training.state()?;
        if let Some((tensor, value)) = not_finite(&tensors)? {
            let checkpoint = self.last_checkpoint.clone();
            return Err(ZooError::NotFinite { step: self.step, tensor, value, checkpoint });
        }
        let checkpoint = Checkpoint { step: self.step, seconds: self.seconds(), tensors, trainer };
        let path = checkpoint.save(&self.folder.checkpoints())?;
        self.metrics.write_parquet(&self.folder.path().join("metrics.parquet"))?;
        on_event(TrainEvent::Saved(&path));
        self.last_checkpoint = Some(path);
        Ok(())
    }

    fn meta(&self) -> TrainingMeta {
        TrainingMeta {
            steps: self.step,
            batch_size: self.section.batch_size as u64,
            seed: self.section.seed,
            minutes: self.seconds() / 60.0,
            threads: self.training.threads() as u64,
            machine: machine(),
            gpu: self.training.gpu(),
            curve: curve(self.metrics.rows()),
        }
    }
}

/// Processor, cores and kernel of this machine; nothing where Linux does not say.
fn machine() -> Option<String> {
    let text = std::fs::read_to_string("/proc/cpuinfo").ok()?;
    // Arm's processors have no name there
    let name = text.lines().find_map(|line| line.strip_prefix("model name")?.split_once(':'));
    let name = name.map_or("unnamed processor", |(_, name)| name.trim());
    let cores = text.lines().filter(|line| line.starts_with("processor")).count();
    let kernel = std::fs::read_to_string("/proc/sys/kernel/osrelease").ok()?;
    Some(format!("{name}, {cores} cores, Linux {}", kernel.trim()))
}

/// Refuses to resume with other settings than the run began with; names the first that differs.
pub fn same_settings(
    folder: &Path,
    saved: &BTreeMap<String, String>,
    asked: &BTreeMap<String, String>,
) -> Result<(), ZooError> {
    let absent = || "nothing".to_owned();
    for key in saved.keys().chain(asked.keys()) {
        let (expected, found) = (saved.get(key), asked.get(key));
        if expected != found {
            return Err(ZooError::ResumeMismatch {
                folder: folder.to_owned(),
                what: key.clone(),
                expected: expected.cloned().unwrap_or_else(absent),
                found: found.cloned().unwrap_or_else(absent),
            });
        }
    }
    Ok(())
}

/// The loss curve, thinned.
fn curve(rows: &[MetricsRow]) -> Vec<CurvePoint> {
    let value = |row: &MetricsRow, name: &str| row.values.get(name).copied();
    thinned(rows.iter().map(|row| (row.step, value(row, "loss"), value(row, "valid_loss"))))
}

/// Seconds since 1970.
fn wall_time() -> f64 {
    SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).map_or(0.0, |d| d.as_secs_f64())
}

/// The first tensor with a value that no training recovers from.
fn not_finite(tensors: &BTreeMap<String, Tensor>) -> Result<Option<(String, f64)>, ZooError> {
    for (name, tensor) in tensors.iter().filter(|(_, tensor)| tensor.dtype() == DType::F32) {
        let values = tensor.flatten_all().and_then(|flat| flat.to_vec1::<f32>()).map_err(|e| ZooError::Model {
            operation: "read the state of",
            name: name.clone(),
            source: ModelError::Tensor(e),
        })?;
        if let Some(value) = values.into_iter().find(|x| !x.is_finite()) {
            return Ok(Some((name.clone(), f64::from(value))));
        }
    }
    Ok(None)
}
