//! A walker in a maze, one move at a time: the environment for reinforcement learning.
//!
//! Rewards are the published study's: a move inside the grid costs 0.01 and earns 0.2 for every step nearer (in Manhattan
//! distance), reaching the goal earns 10 more, a move that cannot be made costs 0.5 and changes nothing.

use crate::maze::{Maze, MazeTask};
use crate::rng::PuzzleRng;

/// Up, down, left, right: the actions, by number.
pub const MOVES: [(isize, isize); 4] = [(-1, 0), (1, 0), (0, -1), (0, 1)];

/// The study ends an episode after its step counter has passed 50, so at most 51 moves are made.
pub const MAX_MOVES: usize = 51;

/// What a move led to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Moved {
    /// The reward of this move.
    pub reward: f32,
    /// Whether the walker stands on the goal.
    pub at_goal: bool,
    /// Whether the episode is over, at the goal or out of moves.
    pub done: bool,
}

/// A maze with a walker in it.
#[derive(Clone, Debug)]
pub struct Walker {
    maze: Maze,
    at: usize,
    moves: usize,
}

impl Walker {
    /// The study's `maze5-rl`: an empty 5×5 grid, from (0,0) to (4,4).
    pub fn empty5() -> Self {
        Self::new(MazeTask::Empty5.draw(&mut PuzzleRng::new(0, 0)))
    }

    /// A walker at the start of any maze.
    pub fn new(maze: Maze) -> Self {
        Self { at: maze.start, maze, moves: 0 }
    }

    /// The maze.
    pub fn maze(&self) -> &Maze {
        &self.maze
    }

    /// Where the walker stands.
    pub fn at(&self) -> usize {
        self.at
    }

    /// Moves made so far.
    pub fn moves(&self) -> usize {
        self.moves
    }

    /// Back to the start.
    pub fn reset(&mut self) {
        (self.at, self.moves) = (self.maze.start, 0);
    }

    /// Make move number `action` of [`MOVES`].
    ///
    /// # Panics
    /// If there is no such move.
    pub fn act(&mut self, action: usize) -> Moved {
        self.moves += 1;
        let goal = self.maze.goal;
        let to = self.maze.grid.step(self.at, MOVES[action]).filter(|&to| !self.maze.grid.is_wall(to));
        let (reward, at_goal) = match to {
            None => (-0.5, false),
            Some(to) => {
                let nearer = self.maze.grid.manhattan(self.at, goal) as f32 - self.maze.grid.manhattan(to, goal) as f32;
                self.at = to;
                let bonus = if to == goal { 10.0 } else { 0.0 };
                (-0.01 + 0.2 * nearer + bonus, to == goal)
            }
        };
        Moved { reward, at_goal, done: at_goal || self.moves >= MAX_MOVES }
    }

    /// The study's observation, one number a cell: 1 where the walker is, 0.5 at the goal (written last).
    pub fn observe_study(&self) -> Vec<f32> {
        let mut observation = vec![0.0; self.maze.grid.len()];
        observation[self.at] = 1.0;
        observation[self.maze.goal] = 0.5;
        observation
    }

    /// Three planes of one number a cell: walker, walls, goal.
    pub fn observe_planes(&self) -> Vec<f32> {
        let cells = self.maze.grid.len();
        let mut observation = vec![0.0; 3 * cells];
        for (cell, &wall) in self.maze.grid.walls().iter().enumerate() {
            observation[cells + cell] = f32::from(u8::from(wall));
        }
        observation[self.at] = 1.0;
        observation[2 * cells + self.maze.goal] = 1.0;
        observation
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::split::Split;

    #[test]
    fn the_best_return_of_the_study_is_11_52_in_8_moves() {
        let mut walker = Walker::empty5();
        let mut total = 0.0;
        for action in [1, 1, 1, 1, 3, 3, 3, 3] {
            let moved = walker.act(action);
            assert_eq!(moved.done, moved.at_goal);
            total += moved.reward;
        }
        assert_eq!(walker.moves(), 8);
        assert!((total - 11.52).abs() < 1e-5, "{total}");
        assert_eq!(walker.observe_study()[24], 0.5, "the goal is written last");
    }

    #[test]
    fn a_wall_or_the_edge_costs_half_and_changes_nothing() {
        let mut walker = Walker::empty5();
        assert_eq!(walker.act(0), Moved { reward: -0.5, at_goal: false, done: false });
        assert_eq!(walker.at(), 0);
        for _ in 0..49 {
            assert!(!walker.act(2).done);
        }
        assert!(walker.act(2).done, "51 moves, and it is over");
    }

    #[test]
    fn a_uniform_walk_reaches_the_goal_as_often_as_exact_analysis_says() {
        // 0.323 by dynamic programming over the uniform policy
        let mut rng = PuzzleRng::new(0, 0);
        let episodes = 20_000;
        let reached = (0..episodes)
            .filter(|_| {
                let mut walker = Walker::empty5();
                loop {
                    let moved = walker.act(rng.below(4));
                    if moved.done {
                        return moved.at_goal;
                    }
                }
            })
            .count();
        let rate = reached as f64 / f64::from(episodes);
        assert!((rate - 0.323).abs() < 0.014, "four standard errors: {rate}");
    }

    #[test]
    fn planes_show_walker_walls_and_goal() {
        let walker = Walker::new(MazeTask::Walls5.draw_from(Split::Train, &mut PuzzleRng::new(2, 0)));
        let planes = walker.observe_planes();
        assert_eq!(
            planes.iter().filter(|&&x| x == 1.0).count(),
            2 + walker.maze().grid.walls().iter().filter(|&&w| w).count()
        );
        assert_eq!(planes[walker.maze().start], 1.0);
        assert_eq!(planes[50 + walker.maze().goal], 1.0);
    }
}
