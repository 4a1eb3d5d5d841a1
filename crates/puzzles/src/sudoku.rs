//! Sudoku of 4×4, 6×6 and 9×9: an exact solver that counts solutions, a generator of full grids, and puzzles with a
//! unique solution whose difficulty is the number of givens.

use crate::rng::PuzzleRng;
use crate::split::{Split, fingerprint};

/// Size of a Sudoku: rows, columns and digits `1..=side`, in boxes of `box_rows` × `box_columns`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct SudokuTask {
    box_rows: usize,
    box_columns: usize,
}

/// One puzzle with its only solution. Cells row by row, 0 for an empty one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sudoku {
    /// What is given.
    pub puzzle: Vec<u8>,
    /// The only full grid that agrees with it.
    pub solution: Vec<u8>,
}

impl Sudoku {
    /// Number of cells that are given.
    pub fn givens(&self) -> usize {
        self.puzzle.iter().filter(|&&digit| digit != 0).count()
    }
}

/// Cells still to fill, with what rows, columns and boxes already hold as bit sets of digits.
struct Board {
    task: SudokuTask,
    cells: Vec<u8>,
    rows: Vec<u16>,
    columns: Vec<u16>,
    boxes: Vec<u16>,
    empty: Vec<usize>,
}

impl Board {
    /// None if two givens contradict each other or one is no digit of this size.
    fn new(task: SudokuTask, cells: &[u8]) -> Option<Self> {
        let side = task.side();
        let mut board = Self {
            task,
            cells: vec![0; side * side],
            rows: vec![0; side],
            columns: vec![0; side],
            boxes: vec![0; side],
            empty: Vec::with_capacity(side * side),
        };
        for (cell, &digit) in cells.iter().enumerate() {
            if digit == 0 {
                board.empty.push(cell);
            } else if usize::from(digit) <= side && board.candidates(cell) >> digit & 1 == 1 {
                board.put(cell, digit);
            } else {
                return None;
            }
        }
        Some(board)
    }

    /// Bit `d` is set where digit `d` may stand.
    fn candidates(&self, cell: usize) -> u16 {
        let side = self.task.side();
        let all = ((1_u16 << side) - 1) << 1;
        all & !(self.rows[cell / side] | self.columns[cell % side] | self.boxes[self.task.box_of(cell)])
    }

    fn put(&mut self, cell: usize, digit: u8) {
        self.cells[cell] = digit;
        self.flip(cell, digit);
    }

    fn take(&mut self, cell: usize) {
        let digit = std::mem::take(&mut self.cells[cell]);
        self.flip(cell, digit);
    }

    fn flip(&mut self, cell: usize, digit: u8) {
        let side = self.task.side();
        self.rows[cell / side] ^= 1 << digit;
        self.columns[cell % side] ^= 1 << digit;
        self.boxes[self.task.box_of(cell)] ^= 1 << digit;
    }

    /// Fill the empty cell with the fewest candidates first; calls `solved` for every solution until it says stop.
    /// `order` picks the next digit from a bit set of candidates. Returns whether it was stopped.
    fn search(&mut self, order: &mut impl FnMut(u16) -> u8, solved: &mut impl FnMut(&[u8]) -> bool) -> bool {
        let mut best = (u32::MAX, 0, 0);
        for (place, &cell) in self.empty.iter().enumerate() {
            let candidates = self.candidates(cell);
            let count = candidates.count_ones();
            if count < best.0 {
                best = (count, place, candidates);
                if count <= 1 {
                    break;
                }
            }
        }
        let (count, place, mut candidates) = best;
        if count == u32::MAX {
            return solved(&self.cells);
        }
        let cell = self.empty.swap_remove(place);
        let mut stopped = false;
        while candidates != 0 && !stopped {
            let digit = order(candidates);
            candidates &= !(1 << digit);
            self.put(cell, digit);
            stopped = self.search(order, solved);
            self.take(cell);
        }
        self.empty.push(cell);
        let last = self.empty.len() - 1;
        self.empty.swap(place, last);
        stopped
    }
}

/// The smallest digit of a bit set.
fn smallest(candidates: u16) -> u8 {
    candidates.trailing_zeros() as u8
}

impl SudokuTask {
    /// 4×4, boxes of 2×2: 288 full grids.
    pub const FOUR: Self = Self { box_rows: 2, box_columns: 2 };
    /// 6×6, boxes of 2×3: 28,200,960 full grids.
    pub const SIX: Self = Self { box_rows: 2, box_columns: 3 };
    /// 9×9, boxes of 3×3.
    pub const NINE: Self = Self { box_rows: 3, box_columns: 3 };
    /// Every size, with the name it has in commands and files.
    pub const ALL: [(&'static str, Self); 3] =
        [("sudoku4", Self::FOUR), ("sudoku6", Self::SIX), ("sudoku9", Self::NINE)];

    /// Number of rows, of columns and of digits.
    pub fn side(self) -> usize {
        self.box_rows * self.box_columns
    }

    /// Number of cells.
    pub fn cells(self) -> usize {
        self.side() * self.side()
    }

    /// Whether a box has as many rows as columns, so that a Sudoku on its side is one.
    pub fn has_square_boxes(self) -> bool {
        self.box_rows == self.box_columns
    }

    /// Which box a cell lies in.
    fn box_of(self, cell: usize) -> usize {
        let (row, column) = (cell / self.side(), cell % self.side());
        row / self.box_rows * self.box_rows + column / self.box_columns
    }

    /// Number of solutions, counted up to `most`. Contradictory givens have none.
    ///
    /// # Panics
    /// If `puzzle` has another number of cells.
    pub fn count_solutions(self, puzzle: &[u8], most: usize) -> usize {
        assert_eq!(puzzle.len(), self.cells(), "one value a cell");
        let mut count = 0;
        if let Some(mut board) = Board::new(self, puzzle) {
            board.search(&mut smallest, &mut |_| {
                count += 1;
                count >= most
            });
        }
        count
    }

    /// The solution, if there is exactly one.
    ///
    /// # Panics
    /// If `puzzle` has another number of cells.
    pub fn solve(self, puzzle: &[u8]) -> Option<Vec<u8>> {
        assert_eq!(puzzle.len(), self.cells(), "one value a cell");
        let mut solutions = Vec::new();
        Board::new(self, puzzle)?.search(&mut smallest, &mut |cells| {
            solutions.push(cells.to_vec());
            solutions.len() == 2
        });
        if solutions.len() == 1 { solutions.pop() } else { None }
    }

    /// Whether every row, column and box holds every digit once.
    pub fn is_solved(self, cells: &[u8]) -> bool {
        cells.len() == self.cells() && !cells.contains(&0) && Board::new(self, cells).is_some()
    }

    /// A full grid, found by filling cells with random candidates.
    pub fn full_grid(self, rng: &mut PuzzleRng) -> Vec<u8> {
        let mut board = Board::new(self, &vec![0; self.cells()]).expect("an empty board contradicts nothing");
        // A random first row: the fewest-candidates rule would otherwise start in the same corner every time.
        let mut digits: Vec<u8> = (1..=self.side() as u8).collect();
        rng.shuffle(&mut digits);
        for (cell, &digit) in digits.iter().enumerate() {
            board.put(cell, digit);
        }
        board.empty.retain(|&cell| cell >= digits.len());
        let mut full = Vec::new();
        board.search(
            &mut |candidates| {
                let mut left = candidates;
                for _ in 0..rng.below(candidates.count_ones() as usize) {
                    left &= left - 1;
                }
                smallest(left)
            },
            &mut |cells| {
                full = cells.to_vec();
                true
            },
        );
        full
    }

    /// A puzzle with a unique solution and at least `givens` cells given: cells are emptied in random order while the
    /// solution stays unique, until `givens` are left or no further cell can go. Its solution belongs to `split`.
    pub fn draw_from(self, split: Split, givens: usize, rng: &mut PuzzleRng) -> Sudoku {
        let solution = loop {
            let full = self.full_grid(rng);
            if Split::of(fingerprint(full.iter().map(|&digit| u64::from(digit)))) == split {
                break full;
            }
        };
        let mut puzzle = solution.clone();
        let mut order: Vec<usize> = (0..self.cells()).collect();
        rng.shuffle(&mut order);
        let mut left = self.cells();
        for cell in order {
            if left <= givens {
                break;
            }
            if self.may_go(&mut puzzle, cell) {
                left -= 1;
            }
        }
        Sudoku { puzzle, solution }
    }

    /// Empty a given cell if no other digit could then stand in it; the other givens have a unique solution with it.
    fn may_go(self, puzzle: &mut [u8], cell: usize) -> bool {
        let digit = std::mem::take(&mut puzzle[cell]);
        let mut board = Board::new(self, puzzle).expect("fewer givens contradict nothing");
        board.empty.retain(|&other| other != cell);
        let mut others = board.candidates(cell) & !(1 << digit);
        while others != 0 {
            let other = smallest(others);
            others &= !(1 << other);
            board.put(cell, other);
            if board.search(&mut smallest, &mut |_| true) {
                puzzle[cell] = digit;
                return false;
            }
            board.take(cell);
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::PuzzleRng;
    use proptest::prelude::*;
    use std::collections::BTreeSet;

    #[test]
    fn there_are_288_grids_of_four() {
        assert_eq!(SudokuTask::FOUR.count_solutions(&[0; 16], usize::MAX), 288);
        let mut rng = PuzzleRng::new(0, 0);
        let drawn: BTreeSet<Vec<u8>> = (0..5000).map(|_| SudokuTask::FOUR.full_grid(&mut rng)).collect();
        assert_eq!(drawn.len(), 288, "every one of them is drawn");
    }

    #[test]
    fn a_known_puzzle_of_nine() {
        let text = "53..7....6..195....98....6.8...6...34..8.3..17...2...6.6....28....419..5....8..79";
        let answer = "534678912672195348198342567859761423426853791713924856961537284287419635345286179";
        let digits = |text: &str| text.bytes().map(|b| if b == b'.' { 0 } else { b - b'0' }).collect::<Vec<_>>();
        assert_eq!(SudokuTask::NINE.solve(&digits(text)), Some(digits(answer)));
        assert!(SudokuTask::NINE.is_solved(&digits(answer)));
        let mut wrong = digits(answer);
        wrong.swap(0, 1);
        assert!(!SudokuTask::NINE.is_solved(&wrong));
        let fewer = text.replace(['5', '7'], ".");
        assert_eq!(SudokuTask::NINE.solve(&digits(&fewer)), None, "5 and 7 can change places everywhere");
    }

    #[test]
    fn contradictions_have_no_solution() {
        let mut puzzle = [0; 16];
        (puzzle[0], puzzle[1]) = (1, 1);
        assert_eq!(SudokuTask::FOUR.count_solutions(&puzzle, 2), 0);
        puzzle[1] = 5;
        assert_eq!(SudokuTask::FOUR.count_solutions(&puzzle, 2), 0, "5 is no digit of a 4×4 grid");
    }

    #[test]
    fn the_splits_share_no_solution() {
        let drawn: Vec<BTreeSet<Vec<u8>>> = Split::ALL
            .map(|split| {
                let mut rng = PuzzleRng::new(1, split as u64);
                (0..2000).map(|_| SudokuTask::FOUR.draw_from(split, 16, &mut rng).solution).collect()
            })
            .into();
        assert_eq!(drawn.iter().map(BTreeSet::len).sum::<usize>(), 288);
        assert!(drawn[0].is_disjoint(&drawn[1]) && drawn[0].is_disjoint(&drawn[2]) && drawn[1].is_disjoint(&drawn[2]));
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn puzzles_have_their_solution_and_no_other(seed: u64, size in 0_usize..3, tight in 0_usize..2) {
            let (_, task) = SudokuTask::ALL[size];
            let givens = [[8, 18, 36], [0, 0, 0]][tight][size];
            let sudoku = task.draw_from(Split::Test, givens, &mut PuzzleRng::new(seed, 0));
            prop_assert!(task.is_solved(&sudoku.solution));
            prop_assert!(sudoku.givens() >= givens);
            prop_assert_eq!(task.count_solutions(&sudoku.puzzle, 2), 1);
            prop_assert_eq!(task.solve(&sudoku.puzzle), Some(sudoku.solution.clone()));
            prop_assert!(sudoku.puzzle.iter().zip(&sudoku.solution).all(|(&p, &s)| p == 0 || p == s));
            if tight == 1 {
                // minimal: without any one of the givens there are several solutions
                for cell in (0..task.cells()).filter(|&cell| sudoku.puzzle[cell] != 0) {
                    let mut fewer = sudoku.puzzle.clone();
                    fewer[cell] = 0;
                    prop_assert_eq!(task.count_solutions(&fewer, 2), 2);
                }
            }
        }
    }
}
