//! A puzzle seen otherwise: turned or in a mirror and, if it is a Sudoku, with its digits renamed. It is the same puzzle, and
//! the answer to it turns with it; a model that is not built so may do well on the one and badly on the other.

use crate::rng::PuzzleRng;
use crate::sudoku::Sudoku;
use crate::symmetry::Symmetry;
use crate::task::{Puzzle, Task};

/// One way to see puzzles of a task.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct View {
    side: usize,
    symmetry: Symmetry,
    /// What each number becomes, and what was what.
    names: Option<[Vec<u8>; 2]>,
}

impl View {
    /// View number `number` of puzzles of `task`, 0 the usual one. Numbers go round the symmetries that the task has: all
    /// eight of a square, four if a Sudoku's boxes are not square; from 1 on a Sudoku's digits are renamed by `rng`.
    pub fn new(task: Task, number: u64, rng: &mut PuzzleRng) -> Self {
        let side = task.side();
        let names = match task {
            Task::Sudoku(_) if number > 0 => {
                let mut names: Vec<u8> = (1..=side as u8).collect();
                rng.shuffle(&mut names);
                names.insert(0, 0);
                let mut back = vec![0; names.len()];
                names.iter().enumerate().for_each(|(name, &seen)| back[usize::from(seen)] = name as u8);
                Some([names, back])
            }
            _ => None,
        };
        Self { side, symmetry: Symmetry::all()[(number % Self::sides(task)) as usize], names }
    }

    /// How many views of puzzles of `task` lay the square onto itself in different ways.
    pub fn sides(task: Task) -> u64 {
        match task {
            Task::Sudoku(sudoku) if !sudoku.has_square_boxes() => 4,
            _ => 8,
        }
    }

    /// The puzzle that is seen, with its answer.
    ///
    /// # Panics
    /// If it is not a puzzle of the task.
    pub fn puzzle(&self, puzzle: &Puzzle) -> Puzzle {
        match puzzle {
            Puzzle::Maze(maze) => {
                let laid = |cell: usize| self.symmetry.cell(self.side, cell);
                let mut seen = maze.clone();
                maze.grid.walls().iter().enumerate().for_each(|(cell, &wall)| seen.grid.set_wall(laid(cell), wall));
                (seen.start, seen.goal) = (laid(maze.start), laid(maze.goal));
                seen.path = maze.path.iter().map(|&cell| laid(cell)).collect();
                Puzzle::Maze(seen)
            }
            Puzzle::Sudoku(task, sudoku) => {
                let sudoku = Sudoku { puzzle: self.of(&sudoku.puzzle), solution: self.of(&sudoku.solution) };
                Puzzle::Sudoku(*task, sudoku)
            }
        }
    }

    /// Tokens of a puzzle as they are seen, a number a cell.
    ///
    /// # Panics
    /// If they are not of a puzzle of the task.
    pub fn of(&self, tokens: &[u8]) -> Vec<u8> {
        let seen = self.symmetry.plane(self.side, tokens);
        match &self.names {
            Some([names, _]) => seen.into_iter().map(|token| names[usize::from(token)]).collect(),
            None => seen,
        }
    }

    /// An answer to what is seen as an answer to the puzzle.
    ///
    /// # Panics
    /// If it is not an answer to a puzzle of the task.
    pub fn answer(&self, seen: &[u8]) -> Vec<u8> {
        let answer = self.plane(seen);
        match &self.names {
            Some([_, back]) => answer.into_iter().map(|digit| back[usize::from(digit)]).collect(),
            None => answer,
        }
    }

    /// Numbers about the cells that are seen as numbers about the puzzle's cells.
    ///
    /// # Panics
    /// If they are not one a cell.
    pub fn plane<T: Copy>(&self, seen: &[T]) -> Vec<T> {
        assert_eq!(seen.len(), self.side * self.side, "one item a cell");
        (0..seen.len()).map(|cell| seen[self.symmetry.cell(self.side, cell)]).collect()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::split::Split;

    #[test]
    fn the_answer_to_a_view_is_the_puzzles_answer() {
        for name in ["dfs10", "open8", "sudoku4", "sudoku6", "sudoku9"] {
            let task = Task::by_name(name).unwrap();
            let givens = if name == "sudoku9" { (40, 45) } else { (12, 14) };
            let puzzle = task.numbered(Split::Train, givens, 3, 0);
            let mut seen = Vec::new();
            for number in 0..8 {
                let view = View::new(task, number, &mut PuzzleRng::new(number, 0));
                let tokens = view.of(&puzzle.tokens());
                let answer = match (task, &puzzle) {
                    // solved anew: what is seen has one solution, and it is the puzzle's
                    (Task::Sudoku(sudoku), _) => sudoku.solve(&tokens).unwrap(),
                    (_, Puzzle::Maze(maze)) => {
                        let on: Vec<u8> = maze.on_path().into_iter().map(u8::from).collect();
                        let goal = tokens.iter().position(|&token| token == 3).unwrap();
                        let turned = view.symmetry.plane(task.side(), &on);
                        assert_eq!((turned[goal], view.symmetry.cell(task.side(), maze.goal)), (1, goal));
                        turned
                    }
                    _ => unreachable!(),
                };
                assert_eq!(view.answer(&answer), puzzle.answer(), "{name}, view {number}");
                let whole = view.puzzle(&puzzle);
                assert_eq!((whole.tokens(), view.answer(&whole.answer())), (tokens.clone(), puzzle.answer()));
                assert_eq!(whole.distance(), puzzle.distance());
                assert!(whole.grade(&whole.answer()).valid);
                assert_eq!(view.plane(&view.symmetry.plane(task.side(), &puzzle.tokens())), puzzle.tokens());
                assert!(number != 0 || tokens == puzzle.tokens());
                seen.push(tokens);
            }
            seen.sort();
            seen.dedup();
            assert_eq!(seen.len(), 8, "{name}");
        }
    }
}
