//! What answers are worth, in counts, and the answers of those who do not think.

use std::collections::BTreeMap;

use puzzles::{Puzzle, Split, Task};
use serde::{Deserialize, Serialize};

/// Graded answers in counts; rates are derived.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Counts {
    /// Puzzles graded.
    pub puzzles: u64,
    /// Answered exactly as the first shortest path, or the solution, is.
    pub exact: u64,
    /// Answered right: a shortest path, whichever; the solution.
    pub valid: u64,
    /// Mazes in which a walk that follows the answer's scores takes a shortest way.
    pub walk: u64,
    /// Mazes whose way is longer than it would be without walls.
    pub detours: u64,
    /// Of these, answered right.
    pub detours_valid: u64,
    /// Cells.
    pub cells: u64,
    /// Cells answered as the solution has them.
    pub cells_right: u64,
}

impl Counts {
    /// Adds one answer; `scores` say where a walker goes in a maze.
    pub fn add(&mut self, puzzle: &Puzzle, answer: &[u8], scores: &[f32]) {
        let grade = puzzle.grade(answer);
        self.puzzles += 1;
        self.exact += u64::from(grade.exact);
        self.valid += u64::from(grade.valid);
        self.cells += answer.len() as u64;
        self.cells_right += grade.cells_right as u64;
        if let (Puzzle::Maze(maze), Some(distance)) = (puzzle, puzzle.distance()) {
            self.walk += u64::from(maze.greedy_walk(scores) == Some(distance));
            if maze.has_detour() {
                self.detours += 1;
                self.detours_valid += u64::from(grade.valid);
            }
        }
    }

    /// `part` of all puzzles.
    pub fn share(&self, part: u64) -> f64 {
        part as f64 / self.puzzles.max(1) as f64
    }

    /// Share of cells that are right.
    pub fn cell_accuracy(&self) -> f64 {
        self.cells_right as f64 / self.cells.max(1) as f64
    }
}

/// Answers to puzzles that take a search about as many guesses.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EffortBand {
    /// Fewest guesses; the next band's are more than this one's.
    pub guesses_from: u64,
    /// Puzzles of the band.
    pub puzzles: u64,
    /// Answered right.
    pub valid: u64,
    /// Cells that they give, together.
    pub givens: u64,
}

impl EffortBand {
    /// Where bands begin: what needs no guess, and then ever wider.
    pub const FROM: [u64; 5] = [0, 1, 5, 17, 33];

    /// Bands of graded puzzles, given whether each was answered right; none of a family that is not told apart so.
    pub(super) fn of(puzzles: &[Puzzle], valid: impl Iterator<Item = bool>) -> Vec<Self> {
        let mut bands = Vec::new();
        for (puzzle, valid) in puzzles.iter().zip(valid) {
            let Some(guesses) = puzzle.guesses() else { continue };
            if bands.is_empty() {
                bands.extend(Self::FROM.map(|guesses_from| Self { guesses_from, ..Self::default() }));
            }
            let place = Self::FROM.iter().rposition(|&from| from <= guesses).unwrap_or(0);
            let band: &mut Self = &mut bands[place];
            band.puzzles += 1;
            band.valid += u64::from(valid);
            band.givens += puzzle.givens().unwrap_or(0) as u64;
        }
        bands
    }
}

/// An answer that needs no thought: what a number is worth is how far it is above these.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Baseline {
    /// Nothing is on the path.
    AllOff,
    /// The same answer for every puzzle: each cell's most common one among training puzzles.
    Constant,
    /// The way without walls, along the row and then along the column.
    Straight,
    /// A walk of moves that are all as probable.
    Random,
    /// The givens, and each other cell's most common digit.
    Givens,
}

/// Training puzzles that the constant answer is made of.
const CONSTANT_FROM: u64 = 1000;

impl Baseline {
    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::AllOff => "all off",
            Self::Constant => "constant",
            Self::Straight => "straight",
            Self::Givens => "givens",
            Self::Random => "random",
        }
    }

    /// The one that walkers are compared with.
    pub(super) fn of_walkers(tests: &[Puzzle]) -> BTreeMap<Self, Counts> {
        [(Self::Random, super::walk::random_walks(tests))].into()
    }

    /// Those that a family has, graded on `tests`.
    pub fn grade_all(task: Task, givens: (usize, usize), tests: &[Puzzle]) -> BTreeMap<Self, Counts> {
        let constant = constant(task, givens);
        let which: &[Self] = match task {
            Task::Maze(_) => &[Self::AllOff, Self::Constant, Self::Straight],
            Task::Sudoku(_) => &[Self::Constant, Self::Givens],
        };
        which
            .iter()
            .map(|&baseline| {
                let mut counts = Counts::default();
                for puzzle in tests {
                    let answer = baseline.answer(puzzle, &constant);
                    let scores: Vec<f32> = answer.iter().map(|&x| f32::from(x)).collect();
                    counts.add(puzzle, &answer, &scores);
                }
                (baseline, counts)
            })
            .collect()
    }

    fn answer(self, puzzle: &Puzzle, constant: &[u8]) -> Vec<u8> {
        match (self, puzzle) {
            (Self::AllOff, _) => vec![0; puzzle.cells()],
            (Self::Straight, Puzzle::Maze(maze)) => maze.straight_path().into_iter().map(u8::from).collect(),
            (Self::Givens, Puzzle::Sudoku(_, sudoku)) => sudoku
                .puzzle
                .iter()
                .zip(constant)
                .map(|(&given, &common)| if given > 0 { given } else { common })
                .collect(),
            _ => constant.to_vec(),
        }
    }
}

/// Each cell's most common answer; the smaller one where two are as common.
fn constant(task: Task, givens: (usize, usize)) -> Vec<u8> {
    let classes = usize::from(task.first_answer()) + task.classes();
    let mut counts = vec![0_u32; task.cells() * classes];
    for index in 0..CONSTANT_FROM {
        for (cell, answer) in task.numbered_answer(Split::Train, givens, 0, index).into_iter().enumerate() {
            counts[cell * classes + usize::from(answer)] += 1;
        }
    }
    counts
        .chunks(classes)
        .map(|counts| {
            let most = counts.iter().max().copied().unwrap_or(0);
            counts.iter().position(|&n| n == most).unwrap_or(0) as u8
        })
        .collect()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn graded(name: &str, count: u64) -> BTreeMap<Baseline, Counts> {
        let task = Task::by_name(name).unwrap();
        let tests: Vec<Puzzle> = (0..count).map(|i| task.numbered(Split::Test, (0, 0), 99, i)).collect();
        Baseline::grade_all(task, (0, 0), &tests)
    }

    #[test]
    fn the_studys_mazes_are_answered_without_thought_and_the_repaired_ones_are_not() {
        assert_eq!(graded("maze8-original", 200)[&Baseline::Constant].exact, 200);
        assert_eq!(graded("maze10-original", 200)[&Baseline::AllOff].exact, 200);
        let open = graded("open8", 2000);
        assert_eq!(open[&Baseline::AllOff].exact, 0);
        assert_eq!(open[&Baseline::Constant].valid, 0);
        // measured elsewhere: exact 39.0%, valid 45.8%, all-off cells 89.5%; four standard errors of 2000
        let straight = open[&Baseline::Straight];
        assert!((straight.share(straight.exact) - 0.39).abs() < 0.05, "{straight:?}");
        assert!((straight.share(straight.valid) - 0.458).abs() < 0.05, "{straight:?}");
        assert!((open[&Baseline::AllOff].cell_accuracy() - 0.895).abs() < 0.01);
        assert_eq!(graded("dfs10", 500)[&Baseline::Constant].exact, 0);
    }

    #[test]
    fn a_right_answer_counts_everywhere() {
        let task = Task::by_name("dfs10").unwrap();
        let mut counts = Counts::default();
        for index in 0..50 {
            let puzzle = task.numbered(Split::Test, (0, 0), 1, index);
            let answer = puzzle.answer();
            counts.add(&puzzle, &answer, &answer.iter().map(|&x| f32::from(x)).collect::<Vec<_>>());
        }
        assert_eq!((counts.exact, counts.valid, counts.walk), (50, 50, 50));
        assert!(counts.detours > 5 && counts.detours == counts.detours_valid);
        assert_eq!(counts.cell_accuracy(), 1.0);
    }

    #[test]
    fn rated_puzzles_are_counted_by_the_guesses_they_take() {
        let of = |name: &str, givens| -> Vec<Puzzle> {
            let task = Task::by_name(name).unwrap();
            (0..12).map(|index| task.numbered(Split::Test, (givens, givens), 1, index)).collect()
        };
        assert_eq!(EffortBand::of(&of("sudoku9", 30), std::iter::repeat(true)), []);
        assert_eq!(EffortBand::of(&of("dfs10", 0), std::iter::repeat(true)), []);
        let puzzles = of("sudoku9-hard", 26);
        let bands = EffortBand::of(&puzzles, (0..12).map(|index| index % 2 == 0));
        assert_eq!(bands.iter().map(|band| band.guesses_from).collect::<Vec<_>>(), EffortBand::FROM);
        assert_eq!(bands.iter().map(|band| band.puzzles).sum::<u64>(), 12);
        assert_eq!(bands.iter().map(|band| band.valid).sum::<u64>(), 6);
        assert!(bands.iter().filter(|band| band.puzzles > 0).count() > 1, "{bands:?}");
        let givens: usize = puzzles.iter().filter_map(Puzzle::givens).sum();
        assert_eq!(bands.iter().map(|band| band.givens).sum::<u64>(), givens as u64);
    }
}
