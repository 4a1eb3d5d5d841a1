//! The training loop: from an experiment to an entry, stoppable at any step.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

use candle_core::Tensor;
use dataset::{EnvMeta, WindowBatch};
use models::{ModelError, PolicyModel, Trainer, TrainerState};
use serde::{Deserialize, Serialize};

use crate::entry::{CardWords, EntryDraft, EntryId, EntryMeta, ModuleMeta, TrainingMeta};
use crate::experiment::Experiment;
use crate::{ZooError, tensors, write_atomic};

use super::checkpoint::Checkpoint;
use super::data::{self, Demonstrations};
use super::folder::RunFolder;
use super::loop_parts::{curve, open_folder, same_settings, wall_time};
use super::metrics::{Metrics, MetricsRow};
use super::sampler::Sampler;
use super::tensorboard::EventWriter;
use super::validation::validation_loss;

/// What to train and where to put it.
#[derive(Debug, Clone)]
pub struct TrainRequest {
    /// Name of the experiment, for the run's folder and the model card.
    pub name: String,
    /// The resolved experiment.
    pub experiment: Experiment,
    /// Demonstrations instead of the experiment's.
    pub data: Option<PathBuf>,
    /// Folder of runs; the run becomes `<runs>/<name>/<number>`.
    pub runs: PathBuf,
    /// Exactly this folder instead.
    pub run: Option<PathBuf>,
    /// Go on with the run that is there.
    pub resume: bool,
    /// The zoo that gets the entry.
    pub zoo: PathBuf,
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
        /// Windows to train on.
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

/// What a run remembers beside its config.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RunNote {
    experiment: String,
    #[serde(with = "crate::files::any_path")]
    data: PathBuf,
    /// Set once the data is open.
    fingerprint: String,
}

/// Trains, or goes on training, until all steps are done or `stop` says so.
///
/// # Errors
/// Bad data, folders in use, runs that cannot be resumed, a loss that is not finite.
pub fn train(
    request: &TrainRequest,
    stop: &dyn Fn() -> bool,
    on_event: &mut dyn FnMut(TrainEvent<'_>),
) -> Result<TrainOutcome, ZooError> {
    let folder = open_folder(&request.name, &request.runs, request.run.as_deref(), request.resume)?;
    let outcome = train_in(&folder, request, stop, on_event);
    if outcome.is_err() && !folder.config_path().exists() {
        // refused before it began: as if it had never been asked for
        folder.discard();
    }
    outcome
}

fn train_in(
    folder: &RunFolder,
    request: &TrainRequest,
    stop: &dyn Fn() -> bool,
    on_event: &mut dyn FnMut(TrainEvent<'_>),
) -> Result<TrainOutcome, ZooError> {
    let experiment = &request.experiment;
    let note_path = folder.path().join("run.json");
    let earlier = begun(folder, &note_path, request)?;

    let wanted = match (&request.data, &earlier) {
        (Some(path), _) => path.clone(),
        (None, Some(note)) => note.data.clone(),
        (None, None) => PathBuf::from(&experiment.data.path),
    };
    let path = data::locate(&wanted)?;
    let dataset = data::open(&path, folder.path(), experiment, &mut |done, total| {
        on_event(TrainEvent::Converting(done, total));
    })?;
    let name = match dataset.provenance() {
        Some(provenance) => provenance.source.clone(),
        None => path.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned()),
    };
    let demonstrations = data::prepare(&dataset, &path, &name, experiment)?;
    for note in &demonstrations.notes {
        on_event(TrainEvent::Note(note));
    }
    match &earlier {
        Some(note) if note.fingerprint != dataset.fingerprint() => {
            return Err(ZooError::ResumeMismatch {
                folder: folder.path().to_owned(),
                what: "data set".to_owned(),
                expected: note.fingerprint.clone(),
                found: dataset.fingerprint().to_owned(),
            });
        }
        Some(_) => {}
        None => {
            // an impossible policy is refused before anything is kept
            let built = experiment.policy.build(demonstrations.preprocess.signature(), experiment.train.seed);
            built.map_err(experiment.model_error("build the policy of"))?;
            let note = RunNote {
                experiment: request.name.clone(),
                data: path.clone(),
                fingerprint: dataset.fingerprint().to_owned(),
            };
            let text = serde_json::to_string_pretty(&note).expect("strings become JSON") + "\n";
            write_atomic(&note_path, text.as_bytes())?;
            // last: its presence says that the run was begun
            write_atomic(&folder.config_path(), experiment.to_toml().as_bytes())?;
        }
    }

    on_event(TrainEvent::Folder(folder.path()));
    let mut run = Run::start(experiment, folder, &demonstrations, on_event)?;
    if !run.go(stop, on_event)? {
        return Ok(TrainOutcome::Stopped { step: run.step, run: folder.path().to_owned() });
    }
    let draft = run.draft(&request.name, dataset.env())?;
    let minutes = run.seconds() / 60.0;
    let entry = draft.seal(&request.zoo)?;
    let finished = serde_json::json!({"entry": entry.to_string(), "minutes": minutes, "steps": run.step});
    write_atomic(&folder.finished_path(), format!("{finished:#}\n").as_bytes())?;
    Ok(TrainOutcome::Finished { entry, run: folder.path().to_owned(), minutes })
}

/// The note of the session that began this run, once its config is known to be the one asked for.
fn begun(folder: &RunFolder, note_path: &Path, request: &TrainRequest) -> Result<Option<RunNote>, ZooError> {
    if !request.resume {
        return Ok(None);
    }
    let config_path = folder.config_path();
    let text = std::fs::read_to_string(&config_path).map_err(ZooError::io("read", &config_path))?;
    let (saved, asked) = (Experiment::from_toml(&request.name, &text)?.flat(), request.experiment.flat());
    same_settings(folder.path(), &saved, &asked)?;
    let text = std::fs::read_to_string(note_path).map_err(ZooError::io("read", note_path))?;
    let note: RunNote = serde_json::from_str(&text)
        .map_err(|e| ZooError::Malformed { path: note_path.to_owned(), reason: format!("not a run's note: {e}") })?;
    if note.experiment != request.name {
        return Err(ZooError::ResumeMismatch {
            folder: folder.path().to_owned(),
            what: "experiment".to_owned(),
            expected: note.experiment,
            found: request.name.clone(),
        });
    }
    Ok(Some(note))
}

/// A training in progress.
struct Run<'a> {
    experiment: &'a Experiment,
    folder: &'a RunFolder,
    demonstrations: &'a Demonstrations,
    trainer: Trainer,
    /// Carries the weights that are validated and sealed: the moving average where there is one.
    evaluated: Box<dyn PolicyModel>,
    metrics: Metrics,
    events: EventWriter,
    step: u64,
    /// Seconds of earlier sessions.
    before: f64,
    started: Instant,
    last_checkpoint: Option<PathBuf>,
}

impl<'a> Run<'a> {
    fn start(
        experiment: &'a Experiment,
        folder: &'a RunFolder,
        demonstrations: &'a Demonstrations,
        on_event: &mut dyn FnMut(TrainEvent<'_>),
    ) -> Result<Self, ZooError> {
        let section = &experiment.train;
        let build = || {
            let model = experiment.policy.build(demonstrations.preprocess.signature(), section.seed);
            model.map_err(experiment.model_error("build the policy of"))
        };
        let mut trainer = Trainer::new(build()?, section.trainer_config(), section.seed)
            .map_err(experiment.model_error("set up the training of"))?;
        let (mut step, mut before, mut last_checkpoint) = (0, 0.0, None);
        if let Some(checkpoint) = Checkpoint::latest(&folder.checkpoints())? {
            (step, before) = (checkpoint.step, checkpoint.seconds);
            last_checkpoint = Some(Checkpoint::path(&folder.checkpoints(), step));
            let state = TrainerState { tensors: checkpoint.tensors, meta: checkpoint.trainer };
            trainer.restore(&state).map_err(experiment.model_error("restore the checkpoint of"))?;
        }
        let metrics = Metrics::open(folder.path().join("metrics.csv"), step)?;
        let events_path = folder.path().join("events.out.tfevents.0.actrm");
        let events = EventWriter::create(&events_path, metrics.rows(), wall_time())?;
        let evaluated = build()?;
        if let Some(reason) = evaluated.composed_because() {
            on_event(TrainEvent::Note(&format!("training steps run on candle's autograd: {reason}")));
        }
        on_event(TrainEvent::Begin {
            from: step,
            steps: section.steps,
            parameters: evaluated.params().count() as u64,
            windows: demonstrations.train.len() as u64,
        });
        Ok(Self {
            experiment,
            folder,
            demonstrations,
            trainer,
            evaluated,
            metrics,
            events,
            step,
            before,
            started: Instant::now(),
            last_checkpoint,
        })
    }

    fn seconds(&self) -> f64 {
        self.before + self.started.elapsed().as_secs_f64()
    }

    /// Steps until all are done (true) or `stop` says so (false). Either way a checkpoint is written.
    fn go(&mut self, stop: &dyn Fn() -> bool, on_event: &mut dyn FnMut(TrainEvent<'_>)) -> Result<bool, ZooError> {
        let section = &self.experiment.train;
        let mut sampler = Sampler::new(&self.demonstrations.train, section.seed, section.batch_size);
        let mut windows = WindowBatch::default();
        let (mut since, mut samples) = (Instant::now(), 0_u64);
        while self.step < section.steps {
            if stop() {
                self.save(on_event)?;
                return Ok(false);
            }
            let indices = sampler.batch(self.step);
            self.demonstrations.train.gather(&indices, &mut windows);
            self.demonstrations.symmetries.apply(self.step, &mut windows);
            let batch = data::batch(&windows, self.demonstrations, self.experiment)?;
            let done = self.trainer.step(&batch).map_err(|source| self.step_error(source))?;
            self.step += 1;
            samples += indices.len() as u64;

            let last = self.step == section.steps;
            let mut values = BTreeMap::from([
                ("loss".to_owned(), f64::from(done.loss)),
                ("grad_norm".to_owned(), done.grad_norm),
                ("lr".to_owned(), done.lr),
                ("samples_per_s".to_owned(), samples as f64 / since.elapsed().as_secs_f64()),
            ]);
            values.extend(done.parts.iter().map(|(name, value)| (name.clone(), f64::from(*value))));
            let validate = last || self.step.is_multiple_of(section.validate_every);
            if validate && let Some(valid) = &self.demonstrations.valid {
                self.take_evaluated()?;
                let loss = validation_loss(self.evaluated.as_ref(), valid, self.demonstrations, self.experiment)?;
                values.insert("valid_loss".to_owned(), loss);
            }
            let row = MetricsRow { step: self.step, values };
            on_event(TrainEvent::Step(&row));
            if validate || self.step.is_multiple_of(section.log_every) {
                self.events.push(&row, wall_time())?;
                self.metrics.push(row)?;
                (since, samples) = (Instant::now(), 0);
            }
            if last || self.step.is_multiple_of(section.checkpoint_every) {
                self.save(on_event)?;
            }
        }
        Ok(true)
    }

    fn take_evaluated(&mut self) -> Result<(), ZooError> {
        let taken = self.trainer.eval_params().and_then(|weights| self.evaluated.params().load(&weights));
        taken.map_err(self.experiment.model_error("take the weights of"))
    }

    /// A number that is not finite stops the run; the checkpoint before it stays.
    fn step_error(&self, source: ModelError) -> ZooError {
        match source {
            ModelError::NotFinite { step, tensor, value } => {
                ZooError::NotFinite { step, tensor, value: f64::from(value), checkpoint: self.last_checkpoint.clone() }
            }
            other => self.experiment.model_error("train")(other),
        }
    }

    fn save(&mut self, on_event: &mut dyn FnMut(TrainEvent<'_>)) -> Result<(), ZooError> {
        let state = self.trainer.state().map_err(self.experiment.model_error("save the training of"))?;
        if let Some((tensor, value)) = not_finite(&state.tensors).map_err(self.experiment.tensor_error("save"))? {
            let checkpoint = self.last_checkpoint.clone();
            return Err(ZooError::NotFinite { step: self.step, tensor, value, checkpoint });
        }
        let checkpoint =
            Checkpoint { step: self.step, seconds: self.seconds(), tensors: state.tensors, trainer: state.meta };
        let path = checkpoint.save(&self.folder.checkpoints())?;
        self.metrics.write_parquet(&self.folder.path().join("metrics.parquet"))?;
        on_event(TrainEvent::Saved(&path));
        self.last_checkpoint = Some(path);
        Ok(())
    }

    /// The entry that this run has earned.
    fn draft(&mut self, name: &str, env: Option<&EnvMeta>) -> Result<EntryDraft, ZooError> {
        let (experiment, demonstrations) = (self.experiment, self.demonstrations);
        self.take_evaluated()?;
        let section = &experiment.train;
        let weights = self.evaluated.params().tensors();
        let signature = demonstrations.preprocess.signature().clone();
        let mut keys = experiment.data.feature_keys()?;
        keys.retain(|feature| signature.get(feature).is_some());
        let policy = experiment.policy_type();
        let meta = EntryMeta {
            format: 0,
            name: experiment.entry.clone(),
            version: 0,
            description: experiment.description.clone(),
            experiment: name.to_owned(),
            policy: policy.clone(),
            task: experiment.task.name.clone(),
            env_name: env.map(|env| env.env_name.clone()),
            env_version: env.and_then(|env| env.env_version.clone()),
            env_module: env.and_then(|env| ModuleMeta::of(&env.env_args)),
            env_args: env.map(|env| env.env_args.clone()).filter(serde_json::Value::is_object),
            parameters: self.evaluated.params().count() as u64,
            signature,
            keys,
            data: Some(demonstrations.meta.clone()),
            kind: None,
            section: None,
            training: Some(TrainingMeta {
                steps: self.step,
                batch_size: section.batch_size as u64,
                seed: section.seed,
                minutes: self.seconds() / 60.0,
                threads: self.trainer.threads() as u64,
                curve: curve(self.metrics.rows()),
            }),
            versions: crate::versions(),
            files: BTreeMap::new(),
        };
        let statistics = demonstrations
            .preprocess
            .normaliser()
            .tensors()
            .map_err(experiment.model_error("store the normaliser of"))?;
        let about = serde_json::json!({"format": 1, "policy": policy});
        Ok(EntryDraft {
            card: CardWords::default(),
            meta,
            model: tensors::to_bytes(Path::new(crate::entry::MODEL_FILE), &weights, &about)?,
            config: experiment.to_toml(),
            normaliser: tensors::to_bytes(
                Path::new(crate::entry::NORMALISER_FILE),
                &statistics,
                &serde_json::json!({"format": 1}),
            )?,
        })
    }
}

/// The first tensor with a value that no training recovers from.
fn not_finite(tensors: &BTreeMap<String, Tensor>) -> candle_core::Result<Option<(String, f64)>> {
    for (name, tensor) in tensors {
        let values = tensor.flatten_all()?.to_vec1::<f32>()?;
        if let Some(value) = values.into_iter().find(|x| !x.is_finite()) {
            return Ok(Some((name.clone(), f64::from(value))));
        }
    }
    Ok(None)
}
