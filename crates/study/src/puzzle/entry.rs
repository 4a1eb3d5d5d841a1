//! An entry that solves puzzles.

use puzzles::Task;
use serde::{Deserialize, Serialize};

use zoo::entry::{ENTRY_FILE, Entry, MODEL_FILE};
use zoo::{ZooError, tensors};

use super::experiment::PuzzleExperiment;
use super::model::SolverConfig;
use super::solver::Solver;
use solvers::trm::Mixing;

/// The kind of entry that solves puzzles.
pub const SOLVER: &str = "a puzzle solver";

/// What `entry.json` says of a solver's training beside what it says of every entry's.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PuzzleMeta {
    /// Fewest and most givens that it was trained on.
    pub givens: [usize; 2],
    /// Different puzzles that it was trained on.
    pub train_puzzles: u64,
    /// Processor seconds of its training, all threads, validation left out.
    pub cpu_seconds: f64,
    /// How it did on the way.
    #[serde(default)]
    pub progress: Vec<ProgressPoint>,
}

impl PuzzleMeta {
    /// What `entry` says of its puzzles; nothing if it is no solver.
    ///
    /// # Errors
    /// A section that is not a solver's.
    pub fn of(entry: &Entry) -> Result<Option<Self>, ZooError> {
        let meta = entry.meta();
        // entries from before kinds were named have the section alone
        if meta.kind.as_deref().is_some_and(|kind| kind != SOLVER) {
            return Ok(None);
        }
        let read = meta.section.clone().map(serde_json::from_value).transpose();
        read.map_err(|e| ZooError::Malformed {
            path: entry.folder().join(ENTRY_FILE),
            reason: format!("section: not that of a puzzle solver: {e}"),
        })
    }
}

/// One validation during a training.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ProgressPoint {
    /// Optimiser steps, or updates of a walker.
    pub step: u64,
    /// Puzzles, or episodes, seen.
    pub seen: u64,
    /// Processor seconds so far.
    pub cpu_seconds: f64,
    /// Share of the validation puzzles that were answered right; for a walker by its most probable moves.
    pub valid: f64,
    /// A walker's successes in its last 50 training episodes, with the moves that it drew.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sampled: Option<f64>,
}

/// A solver's entry with its weights in memory.
pub struct SolverEntry {
    entry: Entry,
    meta: PuzzleMeta,
    experiment: PuzzleExperiment,
    solver: Solver,
}

impl SolverEntry {
    /// Reads the weights of a solver, built for `task` if it is given: a model whose weights are shared by all cells
    /// works on grids of another size than it was trained on.
    ///
    /// # Errors
    /// An entry that is no solver or does not fit `task`; what else does not fit, by name.
    pub fn load(entry: &Entry, task: Option<Task>) -> Result<Self, ZooError> {
        let unfit = |what: &str, expected: String, found: String| ZooError::UnfitEntry {
            entry: entry.id().to_string(),
            task: task.map_or_else(|| entry.meta().task.clone(), |task| task.name().to_owned()),
            what: what.to_owned(),
            expected,
            found,
        };
        let Some(meta) = PuzzleMeta::of(entry)? else {
            return Err(unfit("kind of entry", SOLVER.to_owned(), format!("a policy for {}", entry.meta().task)));
        };
        let experiment = PuzzleExperiment::from_toml(&entry.id().to_string(), &entry.config_text()?)?;
        let own = experiment.task.family()?;
        let built_for = task.unwrap_or(own);
        let any_size = matches!(&experiment.model, SolverConfig::Trm(section) if section.mixing == Mixing::Conv)
            || matches!(&experiment.model, SolverConfig::Cnn(_) | SolverConfig::SmallTrm(_));
        let any_size = any_size && experiment.rl.is_none();
        if (own.vocabulary(), own.classes()) != (built_for.vocabulary(), built_for.classes()) {
            let tokens = |task: Task| format!("{} tokens, {} answers", task.vocabulary(), task.classes());
            return Err(unfit("cells", tokens(own), tokens(built_for)));
        }
        if own.side() != built_for.side() && !any_size {
            let size = |task: Task| format!("{0}x{0}", task.side());
            return Err(unfit("grid (its weights depend on the cell)", size(own), size(built_for)));
        }
        let failed = |operation| {
            let name = entry.id().to_string();
            move |source| ZooError::Model { operation, name, source }
        };
        let built = experiment.build(built_for, 0);
        let mut solver = built.map_err(failed("build the model of"))?;
        let (weights, _) = tensors::read(&entry.folder().join(MODEL_FILE))?;
        solver.load(&weights).map_err(failed("load the weights of"))?;
        Ok(Self { entry: entry.clone(), meta, experiment, solver })
    }

    /// The entry.
    pub fn entry(&self) -> &Entry {
        &self.entry
    }

    /// What it says of its puzzles.
    pub fn meta(&self) -> &PuzzleMeta {
        &self.meta
    }

    /// The experiment that it was made by.
    pub fn experiment(&self) -> &PuzzleExperiment {
        &self.experiment
    }

    /// The model with its weights.
    pub fn solver(&self) -> &Solver {
        &self.solver
    }
}
