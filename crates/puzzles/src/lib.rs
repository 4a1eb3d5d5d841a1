//! Maze and Sudoku tasks: generators, exact solvers, environments.
