//! The puzzles of a training, one after the other: always new ones, or a fixed number in a new order each time around.

use puzzles::{Puzzle, PuzzleRng, Split, Task, View};

use super::experiment::PuzzleExperiment;
use zoo::ZooError;

/// Where a training's puzzles come from. Its whole state is how many were taken.
#[derive(Debug)]
pub(super) struct Stream {
    task: Task,
    givens: (usize, usize),
    seed: u64,
    fixed: u64,
    /// From how many sides puzzles are seen.
    views: u64,
    taken: u64,
    /// The order of the fixed puzzles in one time around, and which.
    order: (u64, Vec<u64>),
}

impl Stream {
    pub(super) fn new(experiment: &PuzzleExperiment, taken: u64) -> Result<Self, ZooError> {
        Ok(Self {
            task: experiment.task.family()?,
            givens: experiment.task.givens(),
            seed: experiment.train.seed,
            fixed: experiment.task.train_puzzles,
            views: experiment.task.views,
            taken,
            order: (u64::MAX, Vec::new()),
        })
    }

    /// How many were taken.
    pub(super) fn taken(&self) -> u64 {
        self.taken
    }

    /// The next `count` puzzles.
    pub(super) fn take(&mut self, count: usize) -> Vec<Puzzle> {
        (0..count)
            .map(|_| {
                let index = self.next();
                let puzzle = self.task.numbered(Split::Train, self.givens, self.seed, index);
                let seen = self.seen(puzzle);
                self.taken += 1;
                seen
            })
            .collect()
    }

    /// The puzzle from one of its sides, another one each time around; as it is, where what is seen belongs to another split.
    fn seen(&self, puzzle: Puzzle) -> Puzzle {
        if self.views == 1 {
            return puzzle;
        }
        // streams from the middle on: none is a puzzle's, none an order's
        let mut rng = PuzzleRng::new(self.seed, (1 << 63) + self.taken);
        let number = rng.below(self.views as usize) as u64;
        let seen = View::new(self.task, number, &mut rng).puzzle(&puzzle);
        let split = match (self.task, &seen) {
            (Task::Maze(task), Puzzle::Maze(maze)) => task.split_of(maze.grid.walls()),
            _ => Some(seen.split()),
        };
        if split.is_none_or(|split| split == Split::Train) { seen } else { puzzle }
    }

    fn next(&mut self) -> u64 {
        if self.fixed == 0 {
            return self.taken;
        }
        let around = self.taken / self.fixed;
        if self.order.0 != around {
            let mut order: Vec<u64> = (0..self.fixed).collect();
            // streams from the other end: none is a puzzle's
            PuzzleRng::new(self.seed, u64::MAX - around).shuffle(&mut order);
            self.order = (around, order);
        }
        self.order.1[(self.taken % self.fixed) as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    fn stream(fixed: u64, taken: u64) -> Stream {
        let task = Task::by_name("maze8-original").expect("a family");
        Stream { task, givens: (0, 0), seed: 3, fixed, views: 1, taken, order: (u64::MAX, Vec::new()) }
    }

    #[test]
    fn fixed_puzzles_come_once_each_time_around_and_in_another_order() {
        let mut one = stream(20, 0);
        let mut first: Vec<u64> = Vec::new();
        let mut second = Vec::new();
        for half in [&mut first, &mut second] {
            for _ in 0..20 {
                half.push(one.next());
                one.taken += 1;
            }
        }
        assert_ne!(first, second);
        first.sort_unstable();
        second.sort_unstable();
        assert_eq!((first.clone(), first), (second, (0..20).collect()));
    }

    #[test]
    fn a_stream_goes_on_where_it_was() {
        for fixed in [0, 7] {
            let all = stream(fixed, 0).take(30);
            assert_eq!(stream(fixed, 11).take(19), all[11..]);
        }
    }

    #[test]
    fn a_puzzle_is_seen_from_all_its_sides_and_none_twice_alike() {
        let seen = |taken| Stream { views: 8, ..stream(5, taken) };
        let all = seen(0).take(400);
        assert_eq!(seen(123).take(277), all[123..], "a stream goes on where it was");
        let goals: BTreeSet<usize> = all
            .iter()
            .map(|puzzle| match puzzle {
                Puzzle::Maze(maze) => maze.goal,
                Puzzle::Sudoku(..) => unreachable!("mazes"),
            })
            .collect();
        assert_eq!(goals, [0, 7, 56, 63].into(), "from the first corner to the last, whichever that is");
        let different: BTreeSet<Vec<u8>> = all.iter().map(Puzzle::tokens).collect();
        // five mazes from eight sides, each with its start in one of four corners
        assert_eq!(different.len(), 40);
        // of a family with splits, the sides that may be trained on
        for (name, givens) in [("dfs10", 0), ("sudoku4", 6)] {
            let task = Task::by_name(name).expect("a family");
            let all = Stream { task, givens: (givens, givens), ..seen(0) }.take(200);
            assert!(all.iter().all(|puzzle| puzzle.split() == Split::Train), "{name}");
            assert!(all.iter().map(Puzzle::tokens).collect::<BTreeSet<_>>().len() > 15, "{name}");
        }
    }
}
