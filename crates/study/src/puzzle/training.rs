//! Training a solver: the same run folder, checkpoints, metrics and entry as a robot policy's, with puzzles that are
//! drawn as they are needed.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

use candle_core::Tensor;
use models::classification::cross_entropy;
use models::trm::{Example, Trainer as TrmTrainer};
use models::{Learner, ModelError, Signature};
use puzzles::{Puzzle, Split, Task};
use serde::{Deserialize, Serialize};

use zoo::entry::{CardWords, EntryDraft, EntryMeta, TrainingMeta, grouped};
use zoo::run::{Checkpoint, Metrics, MetricsRow, RunFolder, TrainEvent, TrainOutcome, loop_parts};
use zoo::{ZooError, tensors, write_atomic};

use super::cpu::cpu_seconds;
use super::entry::{ProgressPoint, PuzzleMeta, SOLVER};
use super::evaluation::{VALID_SEED, graded};
use super::experiment::PuzzleExperiment;
use super::solver::{Solver, labels, planes};
use super::stream::Stream;
use super::walk;

/// What to train and where to put it.
#[derive(Debug, Clone)]
pub struct PuzzleTrainRequest {
    /// Name of the experiment.
    pub name: String,
    /// The resolved experiment.
    pub experiment: PuzzleExperiment,
    /// Folder of runs; the run becomes `<runs>/<name>/<number>`.
    pub runs: PathBuf,
    /// Exactly this folder instead.
    pub run: Option<PathBuf>,
    /// Go on with the run that is there.
    pub resume: bool,
    /// The zoo that gets the entry.
    pub zoo: PathBuf,
}

/// Trains, or goes on training, until all steps are done or `stop` says so.
///
/// # Errors
/// Folders in use, runs that cannot be resumed, a loss that is not finite.
pub fn train_puzzles(
    request: &PuzzleTrainRequest,
    stop: &dyn Fn() -> bool,
    on_event: &mut dyn FnMut(TrainEvent<'_>),
) -> Result<TrainOutcome, ZooError> {
    let folder = loop_parts::open_folder(&request.name, &request.runs, request.run.as_deref(), request.resume)?;
    let experiment = &request.experiment;
    if request.resume {
        let path = folder.config_path();
        let text = std::fs::read_to_string(&path).map_err(ZooError::io("read", &path))?;
        let saved = PuzzleExperiment::from_toml(&request.name, &text)?;
        loop_parts::same_settings(folder.path(), &saved.flat(), &experiment.flat())?;
    }
    let started = Run::start(experiment, &folder, on_event);
    let mut run = match started {
        Ok(run) => run,
        Err(error) => {
            if !folder.config_path().exists() {
                folder.discard();
            }
            return Err(error);
        }
    };
    if !request.resume {
        write_atomic(&folder.config_path(), experiment.to_toml().as_bytes())?;
    }
    if !run.go(stop, on_event)? {
        return Ok(TrainOutcome::Stopped { step: run.step, run: folder.path().to_owned() });
    }
    let minutes = run.seconds() / 60.0;
    let entry = run.draft(&request.name)?.seal(&request.zoo)?;
    let finished = serde_json::json!({"entry": entry.to_string(), "minutes": minutes, "steps": run.step});
    write_atomic(&folder.finished_path(), format!("{finished:#}\n").as_bytes())?;
    Ok(TrainOutcome::Finished { entry, run: folder.path().to_owned(), minutes })
}

/// Who learns: a TRM with its carry, or a model that answers at once.
enum Student {
    Trm(Box<TrmTrainer>),
    Walker(Box<walk::WalkerTraining>),
    Grid { solver: Box<Solver>, learner: Box<Learner>, batch: usize },
}

impl Student {
    fn new(experiment: &PuzzleExperiment, task: Task) -> Result<Self, ModelError> {
        let (section, learning) = (&experiment.train, &experiment.learning);
        let solver = experiment.build(task, section.seed)?;
        Ok(match solver {
            Solver::Trm { model, .. } => {
                let config = learning.puzzle_config(section.batch_size);
                Self::Trm(Box::new(TrmTrainer::new(*model, section.trainer_config(), config, section.seed)?))
            }
            Solver::Walker { net, task } => {
                let rl = experiment.rl.as_ref().expect("a walker is built from [rl]");
                let numbers = (section.batch_size, section.seed);
                Self::Walker(Box::new(walk::WalkerTraining::new(net, rl, task, section.trainer_config(), numbers)?))
            }
            Solver::Grid { ref model, .. } => {
                let learner = Box::new(Learner::new(model.params(), section.trainer_config())?);
                Self::Grid { solver: Box::new(solver), learner, batch: section.batch_size }
            }
        })
    }

    /// Puzzles that the next step wants.
    fn wanted(&self) -> usize {
        match self {
            Self::Trm(trainer) => trainer.wanted(),
            Self::Walker(walker) => walker.wanted(),
            Self::Grid { batch, .. } => *batch,
        }
    }

    /// One optimiser step; what it measured, by name.
    fn step(&mut self, task: Task, puzzles: &[Puzzle]) -> Result<BTreeMap<String, f64>, ModelError> {
        match self {
            Self::Trm(trainer) => {
                let examples: Vec<Example> = puzzles.iter().map(|puzzle| example(task, puzzle)).collect();
                let report = trainer.step(&examples)?;
                let mut values = vec![
                    ("loss", f64::from(report.loss)),
                    ("class_loss", f64::from(report.class_loss)),
                    ("halt_loss", f64::from(report.halt_loss)),
                    ("halt_accuracy", report.halt_accuracy),
                    ("cells_right", report.cell_accuracy),
                    ("exact", report.exact),
                    ("grad_norm", report.grad_norm),
                    ("lr", report.lr),
                ];
                values.extend(report.steps_when_halted.map(|steps| ("steps_when_halted", steps)));
                Ok(values.into_iter().map(|(name, value)| (name.to_owned(), value)).collect())
            }
            Self::Walker(walker) => walker.step(puzzles),
            Self::Grid { solver, learner, .. } => {
                let Solver::Grid { model, dims, probability, .. } = solver.as_ref() else {
                    unreachable!("a grid student holds a grid model")
                };
                let targets: Vec<i64> = puzzles.iter().flat_map(|puzzle| labels(task, puzzle)).collect();
                let rows = targets.len();
                let mut loss: Option<Tensor> = None;
                for (weight, scores) in model.forward(&planes(puzzles, *dims)?)? {
                    let flat = scores.reshape((rows, dims.classes))?;
                    let part = (cross_entropy(&flat, &targets, *probability)?.mean_all()? * weight)?;
                    loss = Some(match loss {
                        None => part,
                        Some(sum) => (sum + part)?,
                    });
                }
                let done = learner.step(&loss.expect("a model answers at least once"))?;
                let values = [("loss", f64::from(done.loss)), ("grad_norm", done.grad_norm), ("lr", done.lr)];
                Ok(values.into_iter().map(|(name, value)| (name.to_owned(), value)).collect())
            }
        }
    }

    /// The weights to evaluate: the moving average where there is one.
    fn evaluated(&self) -> Result<BTreeMap<String, Tensor>, ModelError> {
        match self {
            Self::Trm(trainer) => trainer.eval_tensors(),
            Self::Walker(walker) => walker.evaluated(),
            Self::Grid { learner, .. } => learner.eval_params(),
        }
    }

    fn state(&self) -> Result<(BTreeMap<String, Tensor>, serde_json::Value), ModelError> {
        match self {
            Self::Trm(trainer) => trainer.state(),
            Self::Walker(walker) => walker.state(),
            Self::Grid { learner, .. } => {
                let (tensors, step) = learner.state()?;
                Ok((tensors, serde_json::json!(step)))
            }
        }
    }

    fn restore(&mut self, tensors: &BTreeMap<String, Tensor>, meta: &serde_json::Value) -> Result<(), ModelError> {
        match self {
            Self::Trm(trainer) => trainer.restore(tensors, meta),
            Self::Walker(walker) => walker.restore(tensors, meta),
            Self::Grid { learner, .. } => match meta.as_u64() {
                Some(step) => learner.restore(tensors, step),
                None => {
                    Err(ModelError::State { object: "grid learner", detail: "the number of steps is missing".into() })
                }
            },
        }
    }
}

fn example(task: Task, puzzle: &Puzzle) -> Example {
    Example {
        inputs: puzzle.tokens().into_iter().map(u32::from).collect(),
        labels: labels(task, puzzle),
        identifier: 0,
    }
}

/// What a checkpoint remembers beside tensors.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct State {
    /// Puzzles taken from the stream.
    taken: u64,
    /// Processor seconds of all sessions.
    cpu: f64,
    student: serde_json::Value,
}

struct Run<'a> {
    experiment: &'a PuzzleExperiment,
    folder: &'a RunFolder,
    task: Task,
    student: Student,
    stream: Stream,
    /// Carries the weights that are validated and sealed.
    solver: Solver,
    valid: Vec<Puzzle>,
    metrics: Metrics,
    events: zoo::run::EventWriter,
    step: u64,
    /// Seconds on the clock and of the processor in earlier sessions.
    before: (f64, f64),
    started: (Instant, f64),
    last_checkpoint: Option<PathBuf>,
}

impl<'a> Run<'a> {
    fn start(
        experiment: &'a PuzzleExperiment,
        folder: &'a RunFolder,
        on_event: &mut dyn FnMut(TrainEvent<'_>),
    ) -> Result<Self, ZooError> {
        let (section, task) = (&experiment.train, experiment.task.family()?);
        let built = experiment.build(task, section.seed);
        let solver = built.map_err(experiment.model_error("build the model of"))?;
        let mut student = Student::new(experiment, task).map_err(experiment.model_error("set up the training of"))?;
        let (mut step, mut before, mut taken, mut last_checkpoint) = (0, (0.0, 0.0), 0, None);
        if let Some(checkpoint) = Checkpoint::latest(&folder.checkpoints())? {
            let path = Checkpoint::path(&folder.checkpoints(), checkpoint.step);
            let state: State = serde_json::from_value(checkpoint.trainer).map_err(|e| ZooError::Malformed {
                path: path.clone(),
                reason: format!("not a checkpoint of a puzzle training: {e}"),
            })?;
            (step, before, taken) = (checkpoint.step, (checkpoint.seconds, state.cpu), state.taken);
            last_checkpoint = Some(path);
            let restored = student.restore(&checkpoint.tensors, &state.student);
            restored.map_err(experiment.model_error("restore the checkpoint of"))?;
        }
        let metrics = Metrics::open(folder.path().join("metrics.csv"), step)?;
        let events_path = folder.path().join("events.out.tfevents.0.actrm");
        let events = zoo::run::EventWriter::create(&events_path, metrics.rows(), loop_parts::wall_time())?;
        let givens = experiment.task.givens();
        let valid = 0..experiment.task.valid_puzzles;
        let valid = valid.map(|index| task.numbered(Split::Valid, givens, VALID_SEED, index)).collect();
        on_event(TrainEvent::Folder(folder.path()));
        on_event(TrainEvent::Begin {
            from: step,
            steps: section.steps,
            parameters: solver.parameters(),
            windows: experiment.task.train_puzzles,
        });
        Ok(Self {
            stream: Stream::new(experiment, taken)?,
            experiment,
            folder,
            task,
            student,
            solver,
            valid,
            metrics,
            events,
            step,
            before,
            started: (Instant::now(), cpu_seconds()),
            last_checkpoint,
        })
    }

    fn seconds(&self) -> f64 {
        self.before.0 + self.started.0.elapsed().as_secs_f64()
    }

    fn cpu(&self) -> f64 {
        self.before.1 + cpu_seconds() - self.started.1
    }

    /// Steps until all are done (true) or `stop` says so (false). Either way a checkpoint is written.
    fn go(&mut self, stop: &dyn Fn() -> bool, on_event: &mut dyn FnMut(TrainEvent<'_>)) -> Result<bool, ZooError> {
        let section = &self.experiment.train;
        while self.step < section.steps {
            if stop() {
                self.save(on_event)?;
                return Ok(false);
            }
            let puzzles = self.stream.take(self.student.wanted());
            let mut values = self.student.step(self.task, &puzzles).map_err(|source| match source {
                ModelError::NotFinite { step, tensor, value } => {
                    let checkpoint = self.last_checkpoint.clone();
                    ZooError::NotFinite { step, tensor, value: f64::from(value), checkpoint }
                }
                other => self.experiment.model_error("train")(other),
            })?;
            self.step += 1;
            let last = self.step == section.steps;
            let validate = last || self.step.is_multiple_of(section.validate_every);
            values.insert("cpu_seconds".to_owned(), self.cpu());
            values.insert("seen".to_owned(), self.stream.taken() as f64);
            if validate {
                // not part of what training costs
                let before = cpu_seconds();
                self.take_evaluated()?;
                let depth = self.depth();
                let (counts, _) = graded(&self.solver, &self.valid, &[depth], depth)
                    .map_err(self.experiment.model_error("validate"))?
                    .halting();
                values.insert("valid_exact".to_owned(), counts.share(counts.exact));
                values.insert("valid_valid".to_owned(), counts.share(counts.valid));
                self.started.1 += cpu_seconds() - before;
            }
            let row = MetricsRow { step: self.step, values };
            on_event(TrainEvent::Step(&row));
            if validate || self.step.is_multiple_of(section.log_every) {
                self.events.push(&row, loop_parts::wall_time())?;
                self.metrics.push(row)?;
            }
            if last || self.step.is_multiple_of(section.checkpoint_every) {
                self.save(on_event)?;
            }
        }
        Ok(true)
    }

    /// Supervision steps of a validation: those of training.
    fn depth(&self) -> usize {
        match &self.solver {
            Solver::Trm { model, .. } => model.config().halt_max_steps,
            Solver::Grid { .. } | Solver::Walker { .. } => usize::MAX,
        }
    }

    fn take_evaluated(&mut self) -> Result<(), ZooError> {
        let taken = self.student.evaluated().and_then(|weights| self.solver.load(&weights));
        taken.map_err(self.experiment.model_error("take the weights of"))
    }

    fn save(&mut self, on_event: &mut dyn FnMut(TrainEvent<'_>)) -> Result<(), ZooError> {
        let state = self.student.state().map_err(self.experiment.model_error("save the training of"))?;
        let trainer = State { taken: self.stream.taken(), cpu: self.cpu(), student: state.1 };
        let trainer = serde_json::to_value(trainer).expect("numbers and JSON become JSON");
        let checkpoint = Checkpoint { step: self.step, seconds: self.seconds(), tensors: state.0, trainer };
        let path = checkpoint.save(&self.folder.checkpoints())?;
        self.metrics.write_parquet(&self.folder.path().join("metrics.parquet"))?;
        on_event(TrainEvent::Saved(&path));
        self.last_checkpoint = Some(path);
        Ok(())
    }

    /// The entry that this run has earned.
    fn draft(&mut self, name: &str) -> Result<EntryDraft, ZooError> {
        self.take_evaluated()?;
        let (experiment, section) = (self.experiment, &self.experiment.train);
        let kind = experiment.model.kind();
        let puzzle = PuzzleMeta {
            givens: experiment.task.givens,
            train_puzzles: match experiment.task.train_puzzles {
                0 => self.stream.taken(),
                fixed => fixed.min(self.stream.taken()),
            },
            cpu_seconds: self.cpu(),
            progress: self.metrics.rows().iter().filter_map(progress).collect(),
        };
        let meta = EntryMeta {
            format: 0,
            name: experiment.entry.clone(),
            version: 0,
            description: experiment.description.clone(),
            experiment: name.to_owned(),
            policy: kind.to_owned(),
            task: experiment.task.puzzle.clone(),
            env_name: None,
            env_version: None,
            env_module: None,
            env_args: None,
            parameters: self.solver.parameters(),
            signature: Signature::default(),
            keys: zoo::FeatureKeys::default(),
            data: None,
            kind: Some(SOLVER.to_owned()),
            section: Some(serde_json::to_value(&puzzle).expect("plain fields are always JSON")),
            training: Some(TrainingMeta {
                steps: self.step,
                batch_size: section.batch_size as u64,
                seed: section.seed,
                minutes: self.seconds() / 60.0,
                threads: candle_core::utils::get_num_threads() as u64,
                curve: loop_parts::curve(self.metrics.rows()),
            }),
            versions: zoo::versions(),
            files: BTreeMap::new(),
        };
        let about = serde_json::json!({"format": 1, "policy": kind});
        Ok(EntryDraft {
            card: card_words(&puzzle),
            meta,
            model: tensors::to_bytes(Path::new(zoo::entry::MODEL_FILE), &self.solver.tensors(), &about)?,
            config: experiment.to_toml(),
            // tokens are not normalised: the file holds no statistic
            normaliser: tensors::to_bytes(
                Path::new(zoo::entry::NORMALISER_FILE),
                &BTreeMap::new(),
                &serde_json::json!({"format": 1}),
            )?,
        })
    }
}

/// The model card's words for a solver.
fn card_words(puzzle: &PuzzleMeta) -> CardWords {
    let mut rows = vec![("puzzles trained on".to_owned(), grouped(puzzle.train_puzzles))];
    if puzzle.givens[1] > 0 {
        rows.push(("givens".to_owned(), format!("{} to {}", puzzle.givens[0], puzzle.givens[1])));
    }
    rows.push(("processor time".to_owned(), format!("{:.0} s, validation left out", puzzle.cpu_seconds)));
    CardWords {
        rows,
        examples: "puzzles".to_owned(),
        usage: "`actrm-zoo eval {id}`, `actrm-zoo trace {id}`".to_owned(),
    }
}

/// What a row says of the way, if there was a validation.
fn progress(row: &MetricsRow) -> Option<ProgressPoint> {
    let value = |name: &str| row.values.get(name).copied();
    Some(ProgressPoint {
        step: row.step,
        seen: value("seen")? as u64,
        cpu_seconds: value("cpu_seconds")?,
        valid: value("valid_valid")?,
        sampled: value("recent_success"),
    })
}
