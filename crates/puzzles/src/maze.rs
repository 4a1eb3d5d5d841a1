//! Maze tasks: which walls, which start and goal, and the path that is the answer.
//!
//! The `…-original` tasks follow the rules of the published small-TRM study to the letter, degenerate as they are (the
//! answer of `maze8-original` is the same for every maze, that of `maze10-original` is empty); the others are repaired:
//! random start and goal, solvable only, splits that share no maze.

use crate::grid::Grid;
use crate::rng::PuzzleRng;
use crate::split::{Split, fingerprint};

/// One maze with its answer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Maze {
    /// Where the walls are.
    pub grid: Grid,
    /// The cell to start from.
    pub start: usize,
    /// The cell to reach.
    pub goal: usize,
    /// The first shortest path (right, down, left, up), both ends included; empty where the task has no way.
    pub path: Vec<usize>,
}

impl Maze {
    /// The answer as marks, cell by cell.
    pub fn on_path(&self) -> Vec<bool> {
        let mut on = vec![false; self.grid.len()];
        for &cell in &self.path {
            on[cell] = true;
        }
        on
    }

    /// Whether the way is longer than without walls: those that cannot be solved by ignoring them.
    pub fn has_detour(&self) -> bool {
        self.path.len() > self.grid.manhattan(self.start, self.goal) + 1
    }
}

/// A family of mazes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum MazeTask {
    /// 8×8, 5 to 14 wall draws in rows and columns 1..=6, from (0,0) to (7,7): the study's "simple maze".
    Original8,
    /// 10×10 depth-first maze on odd cells, from (1,1) to a goal at (8,8) that nothing leads to: its "complex maze".
    Original10,
    /// 8×8, 10 to 24 wall draws anywhere, random start and goal, solvable.
    Open8,
    /// Perfect 10×10 depth-first mazes (4×4 rooms), random start and goal.
    Dfs10,
    /// As `Dfs10`, 16×16 (7×7 rooms).
    Dfs16,
    /// As `Dfs10`, 20×20 (9×9 rooms).
    Dfs20,
    /// 5×5 without walls, from (0,0) to (4,4): the study's maze for reinforcement learning.
    Empty5,
    /// 5×5, 4 to 9 wall draws, random start and goal, solvable.
    Walls5,
}

impl MazeTask {
    /// Every family, with the name it has in commands and files.
    pub const ALL: [(&'static str, Self); 8] = [
        ("maze8-original", Self::Original8),
        ("maze10-original", Self::Original10),
        ("open8", Self::Open8),
        ("dfs10", Self::Dfs10),
        ("dfs16", Self::Dfs16),
        ("dfs20", Self::Dfs20),
        ("maze5-rl", Self::Empty5),
        ("maze5-walls", Self::Walls5),
    ];

    /// Rows and columns.
    pub fn side(self) -> usize {
        match self {
            Self::Original8 | Self::Open8 => 8,
            Self::Original10 | Self::Dfs10 => 10,
            Self::Dfs16 => 16,
            Self::Dfs20 => 20,
            Self::Empty5 | Self::Walls5 => 5,
        }
    }

    /// A maze of this family, whatever its split.
    pub fn draw(self, rng: &mut PuzzleRng) -> Maze {
        match self {
            Self::Original8 => original8(rng),
            Self::Original10 => original10(rng),
            Self::Empty5 => empty5(),
            Self::Open8 => scattered(8, 10, 24, rng),
            Self::Walls5 => scattered(5, 4, 9, rng),
            Self::Dfs10 | Self::Dfs16 | Self::Dfs20 => perfect(self.side(), rng),
        }
    }

    /// A maze of this family that belongs to `split`. Mazes with the same walls always belong to the same one; the
    /// original tasks have no splits (the study drew training and test mazes alike).
    pub fn draw_from(self, split: Split, rng: &mut PuzzleRng) -> Maze {
        loop {
            let maze = self.draw(rng);
            if self.split_of(maze.grid.walls()).is_none_or(|its| its == split) {
                return maze;
            }
        }
    }

    /// The split that mazes with these walls belong to, if this family has splits.
    pub fn split_of(self, walls: &[bool]) -> Option<Split> {
        let original = matches!(self, Self::Original8 | Self::Original10 | Self::Empty5);
        (!original).then(|| Split::of(fingerprint(walls.iter().map(|&wall| u64::from(wall)))))
    }
}

fn solved(grid: Grid, start: usize, goal: usize) -> Maze {
    let path = grid.first_shortest_path(start, goal).unwrap_or_default();
    Maze { grid, start, goal, path }
}

fn original8(rng: &mut PuzzleRng) -> Maze {
    let mut grid = Grid::filled(8, 8, false);
    for _ in 0..rng.between(5, 14) {
        let (row, column) = (rng.between(1, 6), rng.between(1, 6));
        let cell = grid.cell(row, column);
        grid.set_wall(cell, true);
    }
    // start and goal lie outside the rows and columns that walls can be drawn in
    let (start, goal) = (grid.cell(0, 0), grid.cell(7, 7));
    solved(grid, start, goal)
}

/// Walls of a depth-first ("recursive backtracker") maze: rooms at odd rows and columns below `side - 1`.
fn carve(side: usize, rng: &mut PuzzleRng) -> Grid {
    const TWO_STEPS: [(isize, isize); 4] = [(0, 2), (2, 0), (0, -2), (-2, 0)];
    let mut grid = Grid::filled(side, side, true);
    let first = grid.cell(1, 1);
    grid.set_wall(first, false);
    let mut stack = vec![first];
    while let Some(&cell) = stack.last() {
        let mut closed = [(0, 0); 4];
        let mut count = 0;
        for (down, right) in TWO_STEPS {
            if let Some(to) = grid.step(cell, (down, right)) {
                let (row, column) = grid.place(to);
                let inside = row > 0 && column > 0 && row < side - 1 && column < side - 1;
                if inside && grid.is_wall(to) {
                    closed[count] = (down, right);
                    count += 1;
                }
            }
        }
        if count == 0 {
            stack.pop();
            continue;
        }
        let (down, right) = closed[rng.below(count)];
        for direction in [(down / 2, right / 2), (down, right)] {
            let open = grid.step(cell, direction).expect("two steps inside are one step inside");
            grid.set_wall(open, false);
        }
        stack.push(grid.step(cell, (down, right)).expect("the room that was found closed"));
    }
    grid
}

fn empty5() -> Maze {
    let grid = Grid::filled(5, 5, false);
    let (start, goal) = (grid.cell(0, 0), grid.cell(4, 4));
    solved(grid, start, goal)
}

fn original10(rng: &mut PuzzleRng) -> Maze {
    let mut grid = carve(10, rng);
    let (start, goal) = (grid.cell(1, 1), grid.cell(8, 8));
    grid.set_wall(goal, false);
    solved(grid, start, goal)
}

fn perfect(side: usize, rng: &mut PuzzleRng) -> Maze {
    let grid = carve(side, rng);
    let free: Vec<usize> = (0..grid.len()).filter(|&cell| !grid.is_wall(cell)).collect();
    let start = rng.below(free.len());
    let goal = (start + rng.between(1, free.len() - 1)) % free.len();
    solved(grid, free[start], free[goal])
}

fn scattered(side: usize, fewest: usize, most: usize, rng: &mut PuzzleRng) -> Maze {
    loop {
        let mut grid = Grid::filled(side, side, false);
        for _ in 0..rng.between(fewest, most) {
            let cell = rng.below(side * side);
            grid.set_wall(cell, true);
        }
        let start = rng.below(side * side);
        let goal = (start + rng.between(1, side * side - 1)) % (side * side);
        grid.set_wall(start, false);
        grid.set_wall(goal, false);
        let maze = solved(grid, start, goal);
        if !maze.path.is_empty() {
            return maze;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    fn draw(task: MazeTask, count: usize) -> Vec<Maze> {
        let mut rng = PuzzleRng::new(11, 0);
        (0..count).map(|_| task.draw(&mut rng)).collect()
    }

    #[test]
    fn the_simple_maze_of_the_study_has_one_answer() {
        let mazes = draw(MazeTask::Original8, 2000);
        let answers: BTreeSet<_> = mazes.iter().map(|maze| maze.path.clone()).collect();
        assert_eq!(answers.len(), 1, "top row, then right column");
        let walls: Vec<usize> =
            mazes.iter().map(|maze| maze.grid.walls().iter().filter(|&&wall| wall).count()).collect();
        assert!(walls.iter().all(|n| (3..=14).contains(n)));
        let mean = walls.iter().sum::<usize>() as f64 / walls.len() as f64;
        assert!((mean - 8.4).abs() < 0.2, "measured 8.4 on the study's own code, here {mean}");
    }

    #[test]
    fn the_complex_maze_of_the_study_has_no_way_and_322_shapes() {
        let mazes = draw(MazeTask::Original10, 20_000);
        assert!(mazes.iter().all(|maze| maze.path.is_empty()));
        assert!(mazes.iter().all(|maze| maze.grid.walls().iter().filter(|&&wall| wall).count() == 68));
        assert_eq!(mazes.iter().map(|maze| &maze.grid).collect::<BTreeSet<_>>().len(), 322);
    }

    #[test]
    fn repaired_mazes_can_be_solved_and_have_different_ends() {
        for (name, task) in MazeTask::ALL {
            if matches!(task, MazeTask::Original8 | MazeTask::Original10) {
                continue;
            }
            for maze in draw(task, 200) {
                assert_ne!(maze.start, maze.goal, "{name}");
                assert!(maze.path.len() > 1, "{name}");
                assert!(maze.grid.is_shortest_path(maze.start, maze.goal, &maze.on_path()), "{name}");
            }
        }
    }

    #[test]
    fn perfect_mazes_have_one_way_and_open_ones_often_several() {
        assert!(
            draw(MazeTask::Dfs16, 100).iter().all(|maze| maze.grid.count_shortest_paths(maze.start, maze.goal) == 1)
        );
        let open = draw(MazeTask::Open8, 3000);
        let tied = open.iter().filter(|maze| maze.grid.count_shortest_paths(maze.start, maze.goal) > 1).count();
        let rate = tied as f64 / open.len() as f64;
        assert!((rate - 0.66).abs() < 0.04, "two thirds of them have ties: {rate}");
        assert!(open.iter().any(Maze::has_detour) && !open.iter().all(Maze::has_detour));
    }

    #[test]
    fn splits_share_no_maze() {
        let mut seen: Vec<BTreeSet<Grid>> = Vec::new();
        for split in Split::ALL {
            let mut rng = PuzzleRng::new(5, 0);
            seen.push((0..3000).map(|_| MazeTask::Dfs10.draw_from(split, &mut rng).grid).collect());
        }
        assert!(seen.iter().all(|mazes| mazes.len() > 15), "{:?}", seen.iter().map(BTreeSet::len).collect::<Vec<_>>());
        assert_eq!(seen.iter().map(BTreeSet::len).sum::<usize>(), 322, "together they are all mazes there are");
        for (at, one) in seen.iter().enumerate() {
            assert!(seen[at + 1..].iter().all(|two| one.is_disjoint(two)));
        }
    }
}
