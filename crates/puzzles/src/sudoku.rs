//! Sudoku of 4×4, 6×6 and 9×9: an exact solver that counts solutions, a generator of full grids, and puzzles with a
//! unique solution whose difficulty is the number of givens, or the effort that a search has with them.

use crate::rng::PuzzleRng;
use crate::split::{Split, fingerprint};

/// Size of a Sudoku: rows, columns and digits `1..=side`, in boxes of `box_rows` × `box_columns`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct SudokuTask {
    box_rows: usize,
    box_columns: usize,
    /// How often a puzzle is changed for one that takes a search no less effort.
    climbs: usize,
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
#[derive(Clone)]
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

impl Board {
    /// Guesses of a search that tries every one; see [`SudokuTask::guesses`].
    fn guesses(mut self, units: &[Vec<usize>]) -> u64 {
        let Some(open) = self.fill_certain(units) else { return 0 };
        let Some(cell) = open else { return 0 };
        let mut candidates = self.candidates(cell);
        let mut guesses = 0;
        while candidates != 0 {
            let digit = smallest(candidates);
            candidates &= !(1 << digit);
            let mut other = self.clone();
            other.fill(cell, digit);
            guesses += 1 + other.guesses(units);
        }
        guesses
    }

    fn fill(&mut self, cell: usize, digit: u8) {
        self.put(cell, digit);
        self.empty.retain(|&other| other != cell);
    }

    /// Fills in what is certain. None if that leads to a contradiction, else an empty cell with the fewest candidates if
    /// one is left.
    fn fill_certain(&mut self, units: &[Vec<usize>]) -> Option<Option<usize>> {
        'again: loop {
            let mut fewest = None;
            for index in 0..self.empty.len() {
                let cell = self.empty[index];
                let candidates = self.candidates(cell);
                match candidates.count_ones() {
                    0 => return None,
                    1 => {
                        self.fill(cell, smallest(candidates));
                        continue 'again;
                    }
                    count if fewest.is_none_or(|(least, _)| count < least) => fewest = Some((count, cell)),
                    _ => (),
                }
            }
            for unit in units {
                // digits that may stand in one of its cells, and in several; those that stand in it already
                let (mut once, mut more, mut stands) = (0_u16, 0_u16, 0_u16);
                for &cell in unit {
                    if self.cells[cell] == 0 {
                        let candidates = self.candidates(cell);
                        more |= once & candidates;
                        once |= candidates;
                    } else {
                        stands |= 1 << self.cells[cell];
                    }
                }
                if (once | stands).count_ones() < unit.len() as u32 {
                    return None;
                }
                let only = once & !more;
                if only != 0 {
                    let digit = smallest(only);
                    let holds = |cell: &&usize| self.cells[**cell] == 0 && self.candidates(**cell) >> digit & 1 == 1;
                    let cell = *unit.iter().find(holds)?;
                    self.fill(cell, digit);
                    continue 'again;
                }
            }
            return Some(fewest.map(|(_, cell)| cell));
        }
    }
}

/// The smallest digit of a bit set.
fn smallest(candidates: u16) -> u8 {
    candidates.trailing_zeros() as u8
}

impl SudokuTask {
    /// 4×4, boxes of 2×2: 288 full grids.
    pub const FOUR: Self = Self { box_rows: 2, box_columns: 2, climbs: 0 };
    /// 6×6, boxes of 2×3: 28,200,960 full grids.
    pub const SIX: Self = Self { box_rows: 2, box_columns: 3, climbs: 0 };
    /// 9×9, boxes of 3×3.
    pub const NINE: Self = Self { box_rows: 3, box_columns: 3, climbs: 0 };
    /// 9×9, with the same number of givens harder ones: rated by [`SudokuTask::guesses`].
    pub const HARD_NINE: Self = Self { climbs: 30, ..Self::NINE };
    /// Every family, with the name it has in commands and files.
    pub const ALL: [(&'static str, Self); 4] =
        [("sudoku4", Self::FOUR), ("sudoku6", Self::SIX), ("sudoku9", Self::NINE), ("sudoku9-hard", Self::HARD_NINE)];

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

    /// Whether its puzzles are made for the effort that they take, and told apart by it.
    pub fn is_rated(self) -> bool {
        self.climbs > 0
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
        let solution = self.solution_from(split, rng);
        let mut puzzle = solution.clone();
        self.empty_to(&mut puzzle, givens, rng);
        if self.is_rated() {
            self.climb(&mut puzzle, &solution, givens, rng);
        }
        Sudoku { puzzle, solution }
    }

    /// A full grid that belongs to `split`.
    pub(crate) fn solution_from(self, split: Split, rng: &mut PuzzleRng) -> Vec<u8> {
        loop {
            let full = self.full_grid(rng);
            if Split::of(fingerprint(full.iter().map(|&digit| u64::from(digit)))) == split {
                return full;
            }
        }
    }

    /// Empties cells in random order while the solution stays unique, until `givens` are left or no further cell can go.
    fn empty_to(self, puzzle: &mut [u8], givens: usize, rng: &mut PuzzleRng) {
        let mut order: Vec<usize> = (0..self.cells()).filter(|&cell| puzzle[cell] != 0).collect();
        rng.shuffle(&mut order);
        let mut left = order.len();
        for cell in order {
            if left <= givens {
                break;
            }
            if self.may_go(puzzle, cell) {
                left -= 1;
            }
        }
    }

    /// Makes a puzzle harder: a few more cells are given, others emptied instead, and what comes of it is kept if a search
    /// has no less effort with it.
    fn climb(self, puzzle: &mut Vec<u8>, solution: &[u8], givens: usize, rng: &mut PuzzleRng) {
        let mut effort = self.guesses(puzzle);
        for _ in 0..self.climbs {
            let mut other = puzzle.clone();
            let mut empty: Vec<usize> = (0..self.cells()).filter(|&cell| other[cell] == 0).collect();
            rng.shuffle(&mut empty);
            for &cell in &empty[..rng.between(2, 6).min(empty.len())] {
                other[cell] = solution[cell];
            }
            self.empty_to(&mut other, givens, rng);
            let its = self.guesses(&other);
            if its >= effort {
                (*puzzle, effort) = (other, its);
            }
        }
    }

    /// How hard a puzzle is: the guesses of a search that fills in what is certain, the only digit of a cell and the only
    /// cell of a digit, guesses where nothing is, in a cell with the fewest candidates, and tries every guess. 0 if no
    /// guess is needed.
    ///
    /// # Panics
    /// If `puzzle` has another number of cells.
    pub fn guesses(self, puzzle: &[u8]) -> u64 {
        assert_eq!(puzzle.len(), self.cells(), "one value a cell");
        let units = self.units();
        Board::new(self, puzzle).map_or(0, |board| board.guesses(&units))
    }

    /// The cells of every row, column and box.
    fn units(self) -> Vec<Vec<usize>> {
        let (side, all) = (self.side(), 0..self.cells());
        let of = |unit: &dyn Fn(usize) -> usize| -> Vec<Vec<usize>> {
            (0..side).map(|number| all.clone().filter(|&cell| unit(cell) == number).collect()).collect()
        };
        [of(&|cell| cell / side), of(&|cell| cell % side), of(&|cell| self.box_of(cell))].concat()
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
    fn a_hard_puzzle_takes_guesses_and_an_easy_one_none() {
        let digits = |text: &str| text.bytes().map(|b| if b == b'.' { 0 } else { b - b'0' }).collect::<Vec<_>>();
        let easy = "53..7....6..195....98....6.8...6...34..8.3..17...2...6.6....28....419..5....8..79";
        assert_eq!(SudokuTask::NINE.guesses(&digits(easy)), 0);
        // "AI Escargot", made by Arto Inkala to be hard
        let hard = "1....7.9..3..2...8..96..5....53..9...1..8...26....4...3......1..4......7..7...3..";
        let guesses = SudokuTask::NINE.guesses(&digits(hard));
        assert!(guesses > 20, "{guesses}");
        assert_eq!(SudokuTask::NINE.guesses(&[0; 81].map(|_: u8| 1)), 0, "a contradiction is seen at once");
    }

    #[test]
    fn a_climb_makes_puzzles_harder_and_gives_no_more() {
        let (mut plain, mut hard) = (Vec::new(), Vec::new());
        for index in 0..6 {
            for (task, into) in [(SudokuTask::NINE, &mut plain), (SudokuTask::HARD_NINE, &mut hard)] {
                let sudoku = task.draw_from(Split::Test, 25, &mut PuzzleRng::new(4, index));
                assert_eq!(task.solve(&sudoku.puzzle).as_ref(), Some(&sudoku.solution));
                into.push((sudoku.solution.clone(), sudoku.givens(), task.guesses(&sudoku.puzzle)));
            }
        }
        for (plain, hard) in plain.iter().zip(&hard) {
            assert_eq!(plain.0, hard.0, "the same grid");
            assert!(hard.1 <= plain.1.max(26) && hard.2 >= plain.2, "{plain:?} {hard:?}");
        }
        let sum = |of: &[(Vec<u8>, usize, u64)]| of.iter().map(|p| p.2).sum::<u64>();
        assert!(sum(&hard) > sum(&plain) + 10, "{plain:?} {hard:?}");
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
