//! Puzzles: the same experiments, runs, entries, evaluations and leaderboard as for robot policies, for models that
//! solve mazes and Sudoku.
//!
//! An entry that solves puzzles is a *solver*. It is evaluated in this process, without workers. What is new here beside
//! the robot's side is only what puzzles have of their own: endless training data drawn from a seed, answers that are
//! graded exactly, and baselines that say what a number is worth.

mod board;
mod cpu;
mod door;
mod entry;
mod evaluation;
mod experiment;
mod grade;
mod model;
mod page;
mod page_sudoku;
mod solver;
mod stream;
mod study;
mod trace;
mod training;
mod walk;

pub use board::{PUZZLE_COLUMNS, puzzle_section, rank_puzzles};
pub use cpu::cpu_seconds;
pub use door::{AnyExperiment, Summary, TrainOptions, is_solver};
pub use entry::{ProgressPoint, PuzzleMeta, SOLVER, SolverEntry};
pub use evaluation::{
    DEPTH, DEPTHS, EvaluatedPuzzles, Judge, MOST_VIEWS, PuzzleEvaluation, PuzzleEvaluationOptions, RECORD_FILE, Starts,
    TEST_SEED, audit_puzzles, evaluate_puzzles, evaluate_puzzles_again,
};
pub use experiment::{LearningSection, PuzzleExperiment, PuzzleTask};
pub use grade::{Baseline, Counts, EffortBand};
pub use model::{
    CnnSection, ConvSection, HierarchicalSection, MlpSection, SolverConfig, TransformerSection, TrmSection,
};
pub use page::study_page;
pub use solver::{Solver, Thought};
pub use study::{
    Bar, STUDY, STUDY_PUZZLES, StudyEvent, StudyRequest, StudyRow, StudyTest, TestedRow, run_study, study_results,
};
pub use trace::{Trace, TraceStep, trace};
pub use training::{PuzzleTrainRequest, train_puzzles};
pub use walk::{RlKind, RlSection};
