//! Training a solver: the same run folder, checkpoints, metrics and entry as a robot policy's, with puzzles that are
//! drawn as they are needed.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use candle_core::Tensor;
use models::classification::cross_entropy;
use models::{Learner, ModelError, Signature};
use puzzles::{Puzzle, Split, Task};
use serde::{Deserialize, Serialize};
use solvers::trm::{Example, Trainer as TrmTrainer};

use zoo::entry::{CardWords, EntryDraft, EntryMeta, LICENSE, TrainingMeta, grouped};
use zoo::run::{Checkpoint, MetricsRow, Place, Settings, TrainEvent, TrainOutcome, TrainSection, Training};
use zoo::{ZooError, tensors};

use super::cpu::cpu_seconds;
use super::entry::{ProgressPoint, PuzzleMeta, SOLVER};
use super::evaluation::{Looks, VALID_SEED, graded};
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
    /// The command that trains it, for the entry.
    pub command: Option<String>,
}

impl Settings for PuzzleExperiment {
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
        let cells = self.task.family().map_or(0, Task::cells);
        self.model.size(cells).training_bytes(self.train.batch_size)
    }
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
    let PuzzleTrainRequest { name, experiment, runs, run, resume, zoo, command } = request.clone();
    if let Some(found) = &experiment.train.from {
        let (key, expected) = ("train.from".to_owned(), "none: solvers of puzzles begin from their seed".to_owned());
        return Err(ZooError::InvalidValue { key, expected, found: found.clone() });
    }
    let place = Place { name, runs, run, resume, zoo, command };
    zoo::run::run(&place, &experiment, |_, _| PuzzleTraining::new(&experiment), stop, on_event)
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

/// A solver that learns from puzzles.
struct PuzzleTraining<'a> {
    experiment: &'a PuzzleExperiment,
    task: Task,
    student: Student,
    stream: Stream,
    /// Carries the weights that are validated and sealed.
    solver: Solver,
    valid: Vec<Puzzle>,
    /// Processor seconds of earlier sessions, and of this process when this one began.
    cpu: (f64, f64),
}

impl<'a> PuzzleTraining<'a> {
    fn new(experiment: &'a PuzzleExperiment) -> Result<Self, ZooError> {
        let task = experiment.task.family()?;
        let built = experiment.build(task, experiment.train.seed);
        let solver = built.map_err(experiment.model_error("build the model of"))?;
        let student = Student::new(experiment, task).map_err(experiment.model_error("set up the training of"))?;
        let givens = experiment.task.givens();
        let valid = 0..experiment.task.valid_puzzles;
        let valid = valid.map(|index| task.numbered(Split::Valid, givens, VALID_SEED, index)).collect();
        let stream = Stream::new(experiment, 0)?;
        Ok(Self { experiment, task, student, stream, solver, valid, cpu: (0.0, cpu_seconds()) })
    }

    fn cpu(&self) -> f64 {
        self.cpu.0 + cpu_seconds() - self.cpu.1
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
}

impl Training for PuzzleTraining<'_> {
    fn parameters(&self) -> u64 {
        self.solver.parameters()
    }

    fn examples(&self) -> u64 {
        self.experiment.task.train_puzzles
    }

    fn threads(&self) -> usize {
        candle_core::utils::get_num_threads()
    }

    fn step(&mut self, _: u64, _: bool) -> Result<BTreeMap<String, f64>, ZooError> {
        let puzzles = self.stream.take(self.student.wanted());
        let done = self.student.step(self.task, &puzzles);
        let mut values = done.map_err(self.experiment.model_error("train"))?;
        values.insert("cpu_seconds".to_owned(), self.cpu());
        values.insert("seen".to_owned(), self.stream.taken() as f64);
        Ok(values)
    }

    fn validate(&mut self) -> Result<BTreeMap<String, f64>, ZooError> {
        // not part of what training costs
        let before = cpu_seconds();
        self.take_evaluated()?;
        let depth = self.depth();
        let (counts, _) = graded(&self.solver, &self.valid, &[depth], Looks::once(depth))
            .map_err(self.experiment.model_error("validate"))?
            .halting();
        self.cpu.1 += cpu_seconds() - before;
        Ok([
            ("valid_exact".to_owned(), counts.share(counts.exact)),
            ("valid_valid".to_owned(), counts.share(counts.valid)),
        ]
        .into())
    }

    fn state(&self) -> Result<(BTreeMap<String, Tensor>, serde_json::Value), ZooError> {
        let (tensors, student) = self.student.state().map_err(self.experiment.model_error("save the training of"))?;
        let state = State { taken: self.stream.taken(), cpu: self.cpu(), student };
        Ok((tensors, serde_json::to_value(state).expect("numbers and JSON become JSON")))
    }

    fn restore(&mut self, checkpoint: Checkpoint, path: &Path) -> Result<(), ZooError> {
        let state: State = serde_json::from_value(checkpoint.trainer).map_err(|e| ZooError::Malformed {
            path: path.to_owned(),
            reason: format!("not a checkpoint of a puzzle training: {e}"),
        })?;
        self.stream = Stream::new(self.experiment, state.taken)?;
        self.cpu.0 = state.cpu;
        let restored = self.student.restore(&checkpoint.tensors, &state.student);
        restored.map_err(self.experiment.model_error("restore the checkpoint of"))
    }

    fn draft(&mut self, name: &str, training: TrainingMeta, rows: &[MetricsRow]) -> Result<EntryDraft, ZooError> {
        self.take_evaluated()?;
        let experiment = self.experiment;
        let kind = experiment.model.kind();
        let puzzle = PuzzleMeta {
            givens: experiment.task.givens,
            train_puzzles: match experiment.task.train_puzzles {
                0 => self.stream.taken(),
                fixed => fixed.min(self.stream.taken()),
            },
            cpu_seconds: self.cpu(),
            progress: rows.iter().filter_map(progress).collect(),
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
            training: Some(training),
            parent: None,
            license: Some(LICENSE.to_owned()),
            versions: zoo::versions(),
            files: BTreeMap::new(),
        };
        let about = serde_json::json!({"format": 1, "policy": kind});
        Ok(EntryDraft {
            card: card_words(&puzzle),
            meta,
            metrics: None,
            command: None,
            reference: None,
            model: tensors::to_bytes(
                Path::new(zoo::entry::MODEL_FILE),
                &experiment.train.stored(self.solver.tensors())?,
                &about,
            )?,
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
