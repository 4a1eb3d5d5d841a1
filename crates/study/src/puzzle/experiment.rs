//! Experiments on puzzles: which task, which model, how it learns.

use std::collections::BTreeMap;

use models::classification::ClassProbability;
use puzzles::{MazeTask, Task, View};
use serde::{Deserialize, Serialize};
use solvers::trm::{PuzzleConfig, Release};
use toml::{Table, Value};

use zoo::ZooError;
use zoo::config::from_value;
use zoo::experiment::flatten;
use zoo::run::TrainSection;

use super::model::SolverConfig;
use super::solver::Solver;
use super::walk::{RlKind, RlSection};

/// Most training and most validation puzzles of an experiment: the order of the former is kept in memory.
const MOST_PUZZLES: u64 = 10_000_000;

/// Largest size of a model.
const LARGEST: usize = 65_536;

/// A resolved experiment on puzzles.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PuzzleExperiment {
    /// Name of the entry that training makes.
    pub entry: String,
    /// One sentence for the model card.
    pub description: String,
    /// The puzzles.
    pub task: PuzzleTask,
    /// The model.
    pub model: SolverConfig,
    /// Its loss and, for a TRM, when a puzzle leaves its slot.
    pub learning: LearningSection,
    /// The training.
    pub train: TrainSection,
    /// How a walker learns; absent: the model marks cells and learns from answers.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rl: Option<RlSection>,
}

/// The same with the model still a table: its type decides which keys it may have.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Sections {
    entry: String,
    #[serde(default)]
    description: String,
    task: PuzzleTask,
    model: Table,
    #[serde(default)]
    learning: LearningSection,
    train: TrainSection,
    #[serde(default)]
    rl: Option<RlSection>,
}

/// `[task]` of a puzzle experiment.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PuzzleTask {
    /// The family, such as `dfs10` or `sudoku9`.
    pub puzzle: String,
    /// Fewest and most givens of a Sudoku to train on; tests have the fewest.
    #[serde(default)]
    pub givens: [usize; 2],
    /// Number of different training puzzles; 0: always new ones.
    #[serde(default)]
    pub train_puzzles: u64,
    /// Augmentation: number of symmetries of the square (1 to 8) that are sampled in training; a Sudoku's digits are renamed as well.
    /// A puzzle whose image belongs to another split stays as it is.
    #[serde(default = "one_view", skip_serializing_if = "is_one_view")]
    pub views: u64,
    /// Number of puzzles of the validation split.
    #[serde(default = "default_valid_puzzles")]
    pub valid_puzzles: u64,
}

fn one_view() -> u64 {
    1
}

fn is_one_view(views: &u64) -> bool {
    *views == 1
}

fn default_valid_puzzles() -> u64 {
    100
}

/// `[learning]`: the loss over cells and the rules of a TRM's carry.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LearningSection {
    /// How scores become probabilities.
    pub probability: ClassProbability,
    /// Weight of the halting loss (TRM).
    pub halt_weight: f64,
    /// Probability per step that a solved puzzle leaves its slot; absent: the halting head decides, as in the
    /// official TRM.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub release_solved: Option<f64>,
    /// Probability per step that a puzzle's states are replaced by noise or by another puzzle's states (TRM).
    #[serde(skip_serializing_if = "is_zero")]
    pub disturbed: f64,
    /// Standard deviation of the noise that is added to all states after every training step (TRM).
    #[serde(skip_serializing_if = "is_zero")]
    pub state_noise: f64,
}

fn is_zero(value: &f64) -> bool {
    *value == 0.0
}

impl Default for LearningSection {
    fn default() -> Self {
        Self {
            probability: ClassProbability::Softmax,
            halt_weight: 0.1,
            release_solved: None,
            disturbed: 0.0,
            state_noise: 0.0,
        }
    }
}

impl LearningSection {
    pub(super) fn puzzle_config(&self, batch_size: usize) -> PuzzleConfig {
        PuzzleConfig {
            batch_size,
            probability: self.probability,
            halt_weight: self.halt_weight,
            release: self.release_solved.map_or(Release::Head, Release::Solved),
            disturbed: self.disturbed,
            state_noise: self.state_noise,
            ..PuzzleConfig::default()
        }
    }
}

impl PuzzleTask {
    /// The family by its name.
    ///
    /// # Errors
    /// [`ZooError::InvalidValue`] listing the families.
    pub fn family(&self) -> Result<Task, ZooError> {
        family(&self.puzzle)
    }

    /// Fewest and most givens.
    pub fn givens(&self) -> (usize, usize) {
        (self.givens[0], self.givens[1])
    }
}

/// The family of that name, or an error that lists them.
pub(super) fn family(name: &str) -> Result<Task, ZooError> {
    Task::by_name(name).ok_or_else(|| {
        let names: Vec<&str> = Task::all().into_iter().map(|(name, _)| name).collect();
        ZooError::InvalidValue {
            key: "task.puzzle".to_owned(),
            expected: format!("one of {}", names.join(", ")),
            found: format!("`{name}`"),
        }
    })
}

impl PuzzleExperiment {
    /// Reads the text of a saved `config.toml`.
    ///
    /// # Errors
    /// As [`super::AnyExperiment::load`].
    pub fn from_toml(name: &str, text: &str) -> Result<Self, ZooError> {
        let table = toml::from_str(text)
            .map_err(|source| ZooError::ExperimentSyntax { experiment: name.to_owned(), source: Box::new(source) })?;
        Self::read(table)
    }

    /// A new experiment: beside what [`Self::from_toml`] refuses, no setting may be without effect.
    pub(super) fn from_table(table: Table) -> Result<Self, ZooError> {
        let experiment = Self::read(table)?;
        experiment.check_used()?;
        Ok(experiment)
    }

    fn read(table: Table) -> Result<Self, ZooError> {
        let sections: Sections = from_value(&Value::Table(table), &[])?;
        let experiment = Self {
            entry: sections.entry,
            description: sections.description,
            task: sections.task,
            model: SolverConfig::from_table(sections.model)?,
            learning: sections.learning,
            train: sections.train,
            rl: sections.rl,
        };
        experiment.check()?;
        Ok(experiment)
    }

    /// Its model for `task`, with weights drawn from `seed`.
    ///
    /// # Errors
    /// A configuration that describes no possible model.
    pub fn build(&self, task: Task, seed: u64) -> Result<Solver, models::ModelError> {
        match (&self.rl, task) {
            (None, _) => self.model.build(task, self.learning.probability, seed),
            (Some(rl), Task::Maze(maze)) => self.model.build_walker(maze, rl.wants_value(), seed),
            (Some(_), Task::Sudoku(_)) => Err(self.model.misplaced("a maze to walk in")),
        }
    }

    fn check(&self) -> Result<(), ZooError> {
        let invalid = |key: &str, expected: String, found: String| {
            Err(ZooError::InvalidValue { key: key.to_owned(), expected, found })
        };
        zoo::entry::check_name(&self.entry)?;
        let task = self.task.family()?;
        let (fewest, most) = self.task.givens();
        if fewest > most || most > task.cells() {
            return invalid(
                "task.givens",
                format!("two numbers up to {}, rising", task.cells()),
                format!("[{fewest}, {most}]"),
            );
        }
        if most > 0 && matches!(task, Task::Maze(_)) {
            return invalid("task.givens", "none: mazes have no givens".to_owned(), format!("[{fewest}, {most}]"));
        }
        let sides = View::sides(task);
        if !(1..=sides).contains(&self.task.views) {
            return invalid("task.views", format!("1 to {sides}"), self.task.views.to_string());
        }
        if self.task.views > 1 && self.rl.is_some() {
            return invalid(
                "task.views",
                "1 with [rl], which has `rl.mirrored`".to_owned(),
                self.task.views.to_string(),
            );
        }
        let (train, valid) = (self.task.train_puzzles, self.task.valid_puzzles);
        for (key, least, found) in [("task.train_puzzles", 0, train), ("task.valid_puzzles", 1, valid)] {
            if !(least..=MOST_PUZZLES).contains(&found) {
                return invalid(key, format!("{least} to {MOST_PUZZLES}"), found.to_string());
            }
        }
        for (key, size, least) in self.model.sizes() {
            if !(least..=LARGEST).contains(&size) {
                return invalid(key, format!("{least} to {LARGEST}"), size.to_string());
            }
        }
        if self.train.accumulation != 1 {
            return invalid("train.accumulation", "1 for puzzles".to_owned(), self.train.accumulation.to_string());
        }
        let LearningSection { halt_weight, release_solved, disturbed, state_noise, .. } = self.learning;
        for (key, value) in [("learning.halt_weight", halt_weight), ("learning.state_noise", state_noise)] {
            if !(value >= 0.0 && value.is_finite()) {
                return invalid(key, "a finite number, at least 0".to_owned(), value.to_string());
            }
        }
        for (key, p) in [("learning.release_solved", release_solved), ("learning.disturbed", Some(disturbed))] {
            if let Some(p) = p
                && !(0.0..=1.0).contains(&p)
            {
                return invalid(key, "0 to 1".to_owned(), p.to_string());
            }
        }
        if let Some(rl) = &self.rl {
            if rl.episodes == 0 {
                return invalid("rl.episodes", "at least 1".to_owned(), "0".to_owned());
            }
            if rl.mirrored && rl.algorithm != RlKind::Ppo {
                return invalid(
                    "rl.mirrored",
                    "false: only PPO weighs what another policy did".to_owned(),
                    "true".to_owned(),
                );
            }
            if !matches!(task, Task::Maze(maze) if maze != MazeTask::Original10) {
                return invalid("task.puzzle", "mazes that have a way, with [rl]".to_owned(), self.task.puzzle.clone());
            }
        }
        self.train.check()
    }

    /// Refuses settings that only other models or algorithms read.
    fn check_used(&self) -> Result<(), ZooError> {
        let (learning, usual) = (&self.learning, LearningSection::default());
        let mut unused = Vec::new();
        if !matches!(self.model, SolverConfig::Trm(_)) {
            unused.extend([
                ("learning.halt_weight", "a TRM", learning.halt_weight != usual.halt_weight),
                ("learning.release_solved", "a TRM", learning.release_solved.is_some()),
                ("learning.disturbed", "a TRM", learning.disturbed != usual.disturbed),
                ("learning.state_noise", "a TRM", learning.state_noise != usual.state_noise),
            ]);
        }
        if let Some(rl) = self.rl.as_ref().filter(|rl| rl.algorithm != RlKind::Ppo) {
            unused.extend(rl.of_ppo().map(|(key, changed)| (key, "PPO", changed)));
        }
        match unused.into_iter().find(|(_, _, changed)| *changed) {
            Some((key, reader, _)) => Err(ZooError::InvalidValue {
                key: key.to_owned(),
                expected: format!("the default: only {reader} reads it"),
                found: self.flat().remove(key).unwrap_or_default(),
            }),
            None => Ok(()),
        }
    }

    /// The resolved experiment as TOML: the same text for the same experiment.
    pub fn to_toml(&self) -> String {
        let table = Table::try_from(self).expect("an experiment read from TOML can be written as TOML");
        toml::to_string_pretty(&table).expect("a table is TOML")
    }

    /// Dotted keys and values, for comparing two experiments.
    pub fn flat(&self) -> BTreeMap<String, String> {
        let mut flat = BTreeMap::new();
        let table = Table::try_from(self).expect("an experiment read from TOML can be written as TOML");
        flatten("", &table, &mut flat);
        flat
    }

    /// Wraps an error of the model with where it comes from.
    pub(super) fn model_error(&self, operation: &'static str) -> impl FnOnce(models::ModelError) -> ZooError + use<> {
        let name = self.entry.clone();
        move |source| ZooError::Model { operation, name, source }
    }
}
