//! Training a policy: from demonstrations to an entry.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

use candle_core::Tensor;
use dataset::EnvMeta;
use dataset::shuffle::Sampler;
use models::{DeviceChoice, PolicyModel, Trainer, TrainerState};
use serde::{Deserialize, Serialize};

use crate::conventions::Conventions;
use crate::entry::{CardWords, EntryDraft, EntryMeta, LICENSE, ModuleMeta, ParentMeta, TrainingMeta, reference};
use crate::experiment::Experiment;
use crate::transforms::{Stage, unreadable};
use crate::{ZooError, tensors, write_atomic};

use super::agreement::agree;
use super::checkpoint::Checkpoint;
use super::data::{self, Demonstrations, ImageMemory};
use super::feed::Feed;
use super::folder::RunFolder;
use super::initial_weights::InitialWeights;
use super::metrics::MetricsRow;
use super::preflight::image_budget;
use super::section::TrainSection;
use super::session::{self, Place, Settings, TrainEvent, TrainOutcome, Training};
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
    /// The zoo that the entry of `train.from` is in; `None`: the same.
    pub from_zoo: Option<PathBuf>,
    /// Train on demonstrations of another task, or of other names, anyway.
    pub force: bool,
    /// Bytes that pictures may take in memory; more are kept in a file and read ahead. `None`: half of what is free.
    pub image_memory: Option<u64>,
    /// The command that trains it, for the entry.
    pub command: Option<String>,
    /// Where it trains.
    pub device: DeviceChoice,
}

impl TrainRequest {
    fn place(&self) -> Place {
        let Self { name, runs, run, resume, zoo, command, .. } = self.clone();
        Place { name, runs, run, resume, zoo, command }
    }
}

impl Settings for Experiment {
    fn read(name: &str, text: &str) -> Result<Self, ZooError> {
        Self::from_toml(name, text)
    }

    fn text(&self) -> String {
        self.to_toml()
    }

    fn values(&self) -> BTreeMap<String, String> {
        self.flat()
    }

    fn section(&self) -> &TrainSection {
        &self.train
    }

    fn entry(&self) -> &str {
        &self.entry
    }

    fn least_bytes(&self) -> f64 {
        let samples = self.train.batch_size.div_ceil(self.train.accumulation);
        self.policy.size().training_bytes(samples)
    }
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
    /// The GPU that it began on; `None` on the CPU.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    gpu: Option<String>,
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
    let make =
        |folder: &RunFolder, on_event: &mut dyn FnMut(TrainEvent<'_>)| PolicyTraining::make(request, folder, on_event);
    session::run(&request.place(), &request.experiment, make, stop, on_event)
}

/// The note of the session that began this run.
fn begun(note_path: &Path, folder: &RunFolder, request: &TrainRequest) -> Result<Option<RunNote>, ZooError> {
    if !request.resume {
        return Ok(None);
    }
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

/// What a user should know of a run that began elsewhere.
fn moved(from: Option<&str>, to: Option<&str>) -> String {
    let on = |gpu: Option<&str>| gpu.unwrap_or("the CPU").to_owned();
    format!("this run began on {} and resumes on {}: its weights may differ in their last digits", on(from), on(to))
}

/// A policy that learns from demonstrations.
struct PolicyTraining {
    /// With the keys of the data set, where it has none of its own.
    experiment: Experiment,
    demonstrations: Demonstrations,
    /// The environment of the demonstrations and its version.
    env: Option<EnvMeta>,
    trainer: Trainer,
    /// Carries the weights that are validated and sealed: the moving average where there is one.
    evaluated: Box<dyn PolicyModel>,
    /// The entry whose weights it began with.
    parent: Option<ParentMeta>,
    feed: Feed,
    /// When the last row of metrics was written, and the samples since.
    rate: (Instant, u64),
}

impl PolicyTraining {
    fn make(
        request: &TrainRequest,
        folder: &RunFolder,
        on_event: &mut dyn FnMut(TrainEvent<'_>),
    ) -> Result<Self, ZooError> {
        let experiment = &request.experiment;
        let note_path = folder.path().join(super::folder::NOTE);
        let earlier = begun(&note_path, folder, request)?;
        let wanted = match (&request.data, &earlier) {
            (Some(path), _) => path.clone(),
            (None, Some(note)) => note.data.clone(),
            (None, None) => PathBuf::from(&experiment.data.path),
        };
        let path = data::locate(&wanted)?;
        if request.data.is_none() && earlier.is_none() && !wanted.exists() {
            on_event(TrainEvent::Note(&format!("demonstrations: {}", path.display())));
        }
        let (dataset, converted) = data::open(&path, folder.path(), experiment, &mut |done, total| {
            on_event(TrainEvent::Converting(done, total));
        })?;
        let name = match dataset.provenance() {
            Some(provenance) => provenance.source.clone(),
            None => path.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned()),
        };
        let budget = request.image_memory.unwrap_or_else(image_budget);
        if let Some(note) = &earlier
            && note.fingerprint != dataset.fingerprint()
        {
            return Err(ZooError::ResumeMismatch {
                folder: folder.path().to_owned(),
                what: "data set".to_owned(),
                expected: note.fingerprint.clone(),
                found: dataset.fingerprint().to_owned(),
            });
        }
        let agreed = agree(&dataset, &path, experiment, request.force)?;
        let opened = request.device.open().map_err(experiment.model_error("open the device for"))?;
        let backend = opened.backend.with_precision(experiment.train.precision);
        let backend = backend.map_err(experiment.model_error("open the device for"))?;
        let gpu = backend.gpu();
        let memory = ImageMemory { budget, folder: folder.path(), device: &backend };
        let demonstrations = data::prepare(&dataset, &path, &name, &agreed, &memory)?;
        let experiment = agreed.experiment;
        let moved =
            earlier.as_ref().filter(|note| note.gpu != gpu).map(|note| moved(note.gpu.as_deref(), gpu.as_deref()));
        let of_device = opened.note.iter().chain(&moved);
        for note in converted.iter().chain(&agreed.notes).chain(&demonstrations.notes).chain(of_device) {
            on_event(TrainEvent::Note(note));
        }
        let section = &experiment.train;
        let from_zoo = request.from_zoo.as_ref().unwrap_or(&request.zoo);
        let initial = section.from.as_ref().map(|from| InitialWeights::read(from_zoo, from)).transpose()?;
        if let (Some(initial), Some(env)) = (&initial, dataset.env().filter(|_| !request.force)) {
            initial.check(&Conventions::of_env_args(&env.env_args), &name, &experiment.task.name)?;
        }
        let build = || {
            let model = experiment.policy.build(demonstrations.preprocess.signature(), section.seed, &backend);
            let model = model.map_err(experiment.model_error("build the policy of"))?;
            super::image_encoder::initialise(model.as_ref(), &demonstrations, &experiment)?;
            super::memory::fill(model.as_ref(), &demonstrations, &experiment)?;
            if let Some(initial) = &initial {
                let taken = model.params().load(&initial.weights(&model.params().tensors()));
                taken.map_err(experiment.model_error("take the weights of `train.from` for"))?;
            }
            Ok::<_, ZooError>(model)
        };
        let trainer = Trainer::new(build()?, section.trainer_config(), section.seed)
            .map_err(experiment.model_error("set up the training of"))?;
        let evaluated = build()?;
        if let Some(initial) = &initial {
            on_event(TrainEvent::Note(&initial.note(&evaluated.params().tensors(), &experiment.data.feature_keys()?)?));
        }
        if earlier.is_none() {
            let (experiment, fingerprint) = (request.name.clone(), dataset.fingerprint().to_owned());
            let note = RunNote { experiment, data: path, fingerprint, gpu };
            let text = serde_json::to_string_pretty(&note).expect("strings become JSON") + "\n";
            write_atomic(&note_path, text.as_bytes())?;
        }
        let sampler = Sampler::new(section.seed, section.batch_size);
        let drawn = demonstrations.transforms.draws(&demonstrations.train.episodes());
        let feed = Feed::new(sampler, drawn, section.steps);
        Ok(Self {
            experiment,
            demonstrations,
            env: dataset.env().cloned(),
            trainer,
            evaluated,
            parent: initial.map(|initial| initial.parent),
            feed,
            rate: (Instant::now(), 0),
        })
    }

    fn take_evaluated(&mut self) -> Result<(), ZooError> {
        let taken = self.trainer.eval_params().and_then(|weights| self.evaluated.params().load(&weights));
        taken.map_err(self.experiment.model_error("take the weights of"))
    }
}

impl Training for PolicyTraining {
    fn parameters(&self) -> u64 {
        self.evaluated.params().count() as u64
    }

    fn examples(&self) -> u64 {
        self.demonstrations.train.len() as u64
    }

    fn threads(&self) -> usize {
        self.trainer.threads()
    }

    fn gpu(&self) -> Option<String> {
        self.trainer.model().params().backend().gpu()
    }

    fn step(&mut self, step: u64, read: bool) -> Result<BTreeMap<String, f64>, ZooError> {
        let unreadable = unreadable(&self.demonstrations.meta.name);
        let windows = self.feed.take(&self.demonstrations.train, step).map_err(unreadable)?;
        let rows = windows.n;
        let batch = self.demonstrations.batch(Stage::Training(step), windows, &self.experiment)?;
        let done = self.trainer.step_ahead(&batch, false).map_err(self.experiment.model_error("train"))?;
        self.rate.1 += rows as u64;
        if !read && !batch.device().is_cpu() {
            return Ok(BTreeMap::new());
        }
        let done = self.trainer.read(&done, &batch).map_err(self.experiment.model_error("train"))?;
        let mut values = BTreeMap::from([
            ("loss".to_owned(), f64::from(done.loss)),
            ("grad_norm".to_owned(), done.grad_norm),
            ("lr".to_owned(), done.lr),
            ("samples_per_s".to_owned(), self.rate.1 as f64 / self.rate.0.elapsed().as_secs_f64()),
        ]);
        values.extend(done.parts.iter().map(|(name, value)| (name.clone(), f64::from(*value))));
        Ok(values)
    }

    fn validate(&mut self) -> Result<BTreeMap<String, f64>, ZooError> {
        self.take_evaluated()?;
        let Some(valid) = &self.demonstrations.valid else { return Ok(BTreeMap::new()) };
        let loss = validation_loss(self.evaluated.as_ref(), valid, &self.demonstrations, &self.experiment)?;
        Ok([("valid_loss".to_owned(), loss)].into())
    }

    fn logged(&mut self) {
        self.rate = (Instant::now(), 0);
    }

    fn state(&self) -> Result<(BTreeMap<String, Tensor>, serde_json::Value), ZooError> {
        let state = self.trainer.state().map_err(self.experiment.model_error("save the training of"))?;
        Ok((state.tensors, state.meta))
    }

    fn restore(&mut self, checkpoint: Checkpoint, _: &Path) -> Result<(), ZooError> {
        let state = TrainerState { tensors: checkpoint.tensors, meta: checkpoint.trainer };
        self.trainer.restore(&state).map_err(self.experiment.model_error("restore the checkpoint of"))
    }

    fn draft(&mut self, name: &str, training: TrainingMeta, _: &[MetricsRow]) -> Result<EntryDraft, ZooError> {
        self.take_evaluated()?;
        let (experiment, demonstrations) = (&self.experiment, &self.demonstrations);
        let env = self.env.as_ref();
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
            parameters: self.parameters(),
            signature,
            keys,
            data: Some(demonstrations.meta.clone()),
            kind: None,
            section: None,
            training: Some(training),
            parent: self.parent.clone(),
            license: Some(LICENSE.to_owned()),
            versions: crate::versions(),
            files: BTreeMap::new(),
        };
        let weights = experiment.train.stored(self.evaluated.params().tensors())?;
        let statistics = demonstrations
            .preprocess
            .normaliser()
            .tensors()
            .map_err(experiment.model_error("store the normaliser of"))?;
        let about = serde_json::json!({"format": 1, "policy": policy});
        Ok(EntryDraft {
            reference: reference(&meta.id(), experiment, &meta.signature, &weights, &statistics)?,
            card: CardWords::default(),
            meta,
            metrics: None,
            command: None,
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
