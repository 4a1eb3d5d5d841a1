//! Every task with a written answer under one name: what a learner sees of a puzzle, what it should answer, and what an
//! answer is worth.

use crate::maze::{Maze, MazeTask};
use crate::rng::PuzzleRng;
use crate::split::{Split, fingerprint};
use crate::sudoku::{Sudoku, SudokuTask};

/// A family of puzzles, mazes or Sudoku.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Task {
    /// Mark the way through a maze.
    Maze(MazeTask),
    /// Fill a grid.
    Sudoku(SudokuTask),
}

impl Task {
    /// Every family with its name in commands and files.
    pub fn all() -> Vec<(&'static str, Self)> {
        let mazes = MazeTask::ALL.map(|(name, task)| (name, Self::Maze(task)));
        let sudokus = SudokuTask::ALL.map(|(name, task)| (name, Self::Sudoku(task)));
        mazes.into_iter().chain(sudokus).collect()
    }

    /// The family of that name.
    pub fn by_name(name: &str) -> Option<Self> {
        Self::all().into_iter().find(|(n, _)| *n == name).map(|(_, task)| task)
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        let found = Self::all().into_iter().find(|(_, task)| *task == self);
        found.expect("every family is listed").0
    }

    /// Rows and columns.
    pub fn side(self) -> usize {
        match self {
            Self::Maze(task) => task.side(),
            Self::Sudoku(task) => task.side(),
        }
    }

    /// Number of cells.
    pub fn cells(self) -> usize {
        self.side() * self.side()
    }

    /// Number of different tokens of a cell: free, wall, start and goal, or empty and every digit.
    pub fn vocabulary(self) -> usize {
        match self {
            Self::Maze(_) => 4,
            Self::Sudoku(task) => task.side() + 1,
        }
    }

    /// Number of different answers of a cell: off and on the path, or the digits.
    pub fn classes(self) -> usize {
        match self {
            Self::Maze(_) => 2,
            Self::Sudoku(task) => task.side(),
        }
    }

    /// The answer that class 0 stands for; the others follow: 0 for off the path, or the digit 1.
    pub fn first_answer(self) -> u8 {
        match self {
            Self::Maze(_) => 0,
            Self::Sudoku(_) => 1,
        }
    }

    /// A puzzle of this family that belongs to `split`. Of a Sudoku a number of cells that is drawn from `givens`
    /// (fewest, most) is kept, more where fewer would leave a second solution; mazes have no givens.
    pub fn draw(self, split: Split, (fewest, most): (usize, usize), rng: &mut PuzzleRng) -> Puzzle {
        match self {
            Self::Maze(task) => Puzzle::Maze(task.draw_from(split, rng)),
            Self::Sudoku(task) => {
                let givens = rng.between(fewest, most.max(fewest));
                Puzzle::Sudoku(task, task.draw_from(split, givens, rng))
            }
        }
    }

    /// Puzzle number `index` of a split: the same for the same seed, whatever was drawn before.
    pub fn numbered(self, split: Split, givens: (usize, usize), seed: u64, index: u64) -> Puzzle {
        self.draw(split, givens, &mut PuzzleRng::new(seed, index))
    }

    /// The answer of that puzzle. Of a Sudoku it is drawn without the search for its givens.
    pub fn numbered_answer(self, split: Split, (fewest, most): (usize, usize), seed: u64, index: u64) -> Vec<u8> {
        match self {
            Self::Maze(_) => self.numbered(split, (fewest, most), seed, index).answer(),
            Self::Sudoku(task) => {
                let mut rng = PuzzleRng::new(seed, index);
                // the number of givens comes first
                rng.between(fewest, most.max(fewest));
                task.solution_from(split, &mut rng)
            }
        }
    }
}

/// One puzzle with its answer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Puzzle {
    /// A maze.
    Maze(Maze),
    /// A Sudoku of a size.
    Sudoku(SudokuTask, Sudoku),
}

/// What an answer is worth.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Grade {
    /// Cells that agree with the answer.
    pub cells_right: usize,
    /// Whether all do.
    pub exact: bool,
    /// Whether it is a right answer, this one or another: a shortest path (there may be several), a full grid that
    /// agrees with the givens. A maze without a way wants nothing marked.
    pub valid: bool,
}

impl Puzzle {
    /// One number a cell. Mazes: 0 free, 1 wall, 2 start, 3 goal. Sudoku: the digit, 0 where none is given.
    pub fn tokens(&self) -> Vec<u8> {
        match self {
            Self::Maze(maze) => {
                let mut tokens: Vec<u8> = maze.grid.walls().iter().map(|&wall| u8::from(wall)).collect();
                tokens[maze.start] = 2;
                tokens[maze.goal] = 3;
                tokens
            }
            Self::Sudoku(_, sudoku) => sudoku.puzzle.clone(),
        }
    }

    /// The answer, one number a cell: 1 on the path and 0 off it, or the digit.
    pub fn answer(&self) -> Vec<u8> {
        match self {
            Self::Maze(maze) => maze.on_path().into_iter().map(u8::from).collect(),
            Self::Sudoku(_, sudoku) => sudoku.solution.clone(),
        }
    }

    /// Compares an answer with the puzzle.
    ///
    /// # Panics
    /// If `answer` has another number of cells.
    pub fn grade(&self, answer: &[u8]) -> Grade {
        let right = self.answer();
        assert_eq!(answer.len(), right.len(), "one answer a cell");
        let cells_right = answer.iter().zip(&right).filter(|(given, right)| given == right).count();
        let exact = cells_right == right.len();
        let valid = match self {
            // a Sudoku's solution is unique
            Self::Sudoku(..) => exact,
            Self::Maze(maze) if maze.path.is_empty() => exact,
            Self::Maze(maze) => {
                let on: Vec<bool> = answer.iter().map(|&class| class == 1).collect();
                maze.grid.is_shortest_path(maze.start, maze.goal, &on)
            }
        };
        Grade { cells_right, exact, valid }
    }

    /// Number of cells.
    pub fn cells(&self) -> usize {
        match self {
            Self::Maze(maze) => maze.grid.len(),
            Self::Sudoku(task, _) => task.cells(),
        }
    }

    /// Steps of the shortest way through a maze that has one.
    pub fn distance(&self) -> Option<usize> {
        match self {
            Self::Maze(maze) => maze.path.len().checked_sub(1),
            Self::Sudoku(..) => None,
        }
    }

    /// Cells that a Sudoku gives.
    pub fn givens(&self) -> Option<usize> {
        match self {
            Self::Maze(_) => None,
            Self::Sudoku(_, sudoku) => Some(sudoku.givens()),
        }
    }

    /// Guesses that a search needs, where puzzles are told apart by them ([`SudokuTask::is_rated`]).
    pub fn guesses(&self) -> Option<u64> {
        match self {
            Self::Sudoku(task, sudoku) if task.is_rated() => Some(task.guesses(&sudoku.puzzle)),
            Self::Maze(_) | Self::Sudoku(..) => None,
        }
    }

    /// The split that its content puts it in (original tasks are drawn without regard to it).
    pub fn split(&self) -> Split {
        Split::of(match self {
            Self::Maze(maze) => fingerprint(maze.grid.walls().iter().map(|&wall| u64::from(wall))),
            Self::Sudoku(_, sudoku) => fingerprint(sudoku.solution.iter().map(|&digit| u64::from(digit))),
        })
    }
}

impl Maze {
    /// The way for someone who sees no walls: along the row first, then along the column.
    pub fn straight_path(&self) -> Vec<bool> {
        let mut on = vec![false; self.grid.len()];
        let ((row, column), (down, right)) = (self.grid.place(self.start), self.grid.place(self.goal));
        for c in column.min(right)..=column.max(right) {
            on[self.grid.cell(row, c)] = true;
        }
        for r in row.min(down)..=row.max(down) {
            on[self.grid.cell(r, right)] = true;
        }
        on
    }

    /// Steps to the goal of a walker who always goes on to the free neighbour with the highest score that it has not
    /// been to (right, down, left, up decide ties); none if it gets stuck before.
    ///
    /// # Panics
    /// If `scores` has another number of cells.
    pub fn greedy_walk(&self, scores: &[f32]) -> Option<usize> {
        assert_eq!(scores.len(), self.grid.len(), "one score a cell");
        let mut been = vec![false; self.grid.len()];
        let mut at = self.start;
        for steps in 0..self.grid.len() {
            if at == self.goal {
                return Some(steps);
            }
            been[at] = true;
            let mut best: Option<usize> = None;
            for direction in crate::grid::RIGHT_DOWN_LEFT_UP {
                if let Some(to) = self.grid.step(at, direction)
                    && !self.grid.is_wall(to)
                    && !been[to]
                    && best.is_none_or(|best| scores[to] > scores[best])
                {
                    best = Some(to);
                }
            }
            at = best?;
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn givens(task: Task) -> (usize, usize) {
        if task == Task::Sudoku(SudokuTask::NINE) { (36, 45) } else { (0, 0) }
    }

    #[test]
    fn every_task_has_its_name_and_puzzles_that_fit_it() {
        for (name, task) in Task::all() {
            assert_eq!(Task::by_name(name), Some(task));
            assert_eq!(task.name(), name);
            for index in 0..20 {
                let puzzle = task.numbered(Split::Test, givens(task), 5, index);
                assert_eq!(puzzle, task.numbered(Split::Test, givens(task), 5, index));
                assert_eq!(puzzle.answer(), task.numbered_answer(Split::Test, givens(task), 5, index));
                let (tokens, answer) = (puzzle.tokens(), puzzle.answer());
                assert_eq!((tokens.len(), answer.len()), (task.cells(), puzzle.cells()));
                assert!(tokens.iter().all(|&token| usize::from(token) < task.vocabulary()));
                let classes = task.first_answer()..task.first_answer() + task.classes() as u8;
                assert!(answer.iter().all(|value| classes.contains(value)));
                assert_eq!(
                    puzzle.grade(&answer),
                    Grade { cells_right: task.cells(), exact: true, valid: true },
                    "{name}"
                );
                let mut wrong = answer.clone();
                wrong[0] = if wrong[0] + 1 < classes.end { wrong[0] + 1 } else { classes.start };
                let grade = puzzle.grade(&wrong);
                assert_eq!((grade.cells_right, grade.exact), (task.cells() - 1, false));
            }
        }
        assert_eq!(Task::by_name("dfs11"), None);
    }

    #[test]
    fn another_shortest_path_is_valid_and_not_exact() {
        // an empty grid between opposite corners has many
        let maze = crate::walker::Walker::empty5().maze().clone();
        let mirrored: Vec<u8> = (0..25).map(|cell| u8::from(cell % 5 == 0 || cell >= 20)).collect();
        let puzzle = Puzzle::Maze(maze.clone());
        let grade = puzzle.grade(&mirrored);
        assert!(grade.valid && !grade.exact);
        assert!(!puzzle.grade(&[1; 25]).valid);
        let straight: Vec<u8> = maze.straight_path().into_iter().map(u8::from).collect();
        assert!(puzzle.grade(&straight).exact);
    }

    #[test]
    fn a_walk_by_distance_takes_the_shortest_way_and_an_even_one_may_not() {
        for index in 0..200 {
            let task = Task::Maze(MazeTask::Open8);
            let Puzzle::Maze(maze) = task.numbered(Split::Test, (0, 0), 1, index) else { unreachable!() };
            let from_goal = maze.grid.distances(maze.goal);
            let scores: Vec<f32> = from_goal.iter().map(|d| d.map_or(-1e3, |d| -f32::from(d))).collect();
            assert_eq!(maze.greedy_walk(&scores), Some(maze.path.len() - 1));
            let on: Vec<f32> = maze.on_path().into_iter().map(|on| f32::from(u8::from(on))).collect();
            assert_eq!(maze.greedy_walk(&on), Some(maze.path.len() - 1), "a right answer walks the shortest way");
        }
    }
}
