//! Maze and Sudoku tasks for recursive reasoning: seeded generators, exact solvers and a walking environment.
//!
//! Each task is either one of the published small-TRM study's, with its rules to the letter (`maze8-original`,
//! `maze10-original`, `maze5-rl`), or a repaired one in which something has to be found out (`open8`, `dfs10`, `dfs16`,
//! `dfs20`, `maze5-walls`, `sudoku4`, `sudoku6`, `sudoku9`, `sudoku9-hard`). Every puzzle comes with its exact answer. A repaired one
//! belongs to the training, validation or test split by its content, so that no maze and no solution is in two of them; the original
//! tasks have no splits.
//!
//! This crate knows nothing of tensors, models, files or training.

mod grid;
mod maze;
mod rng;
mod split;
mod sudoku;
mod symmetry;
mod table;
mod task;
mod view;
mod walker;

pub use grid::{Grid, RIGHT_DOWN_LEFT_UP};
pub use maze::{Maze, MazeTask};
pub use rng::PuzzleRng;
pub use split::{Split, fingerprint};
pub use sudoku::{Sudoku, SudokuTask};
pub use symmetry::Symmetry;
pub use table::table_mazes;
pub use task::{Grade, Puzzle, Task};
pub use view::View;
pub use walker::{MAX_MOVES, MOVES, Moved, Walker};
