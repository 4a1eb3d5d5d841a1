//! The eight symmetries of the square: a maze seen in a mirror or turned is a maze, and the moves turn with it.

use crate::walker::MOVES;

/// One of the eight ways to lay a square onto itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Symmetry {
    /// Rows and columns change places first.
    transposed: bool,
    /// Then the rows are reversed.
    down_up: bool,
    /// And the columns.
    right_left: bool,
}

impl Symmetry {
    /// All eight, the one that changes nothing first.
    pub fn all() -> [Self; 8] {
        std::array::from_fn(|i| Self { transposed: i & 4 != 0, down_up: i & 2 != 0, right_left: i & 1 != 0 })
    }

    /// Where cell `cell` of a square with `side` rows goes.
    pub fn cell(self, side: usize, cell: usize) -> usize {
        let (row, column) = (cell / side, cell % side);
        let (row, column) = if self.transposed { (column, row) } else { (row, column) };
        let row = if self.down_up { side - 1 - row } else { row };
        let column = if self.right_left { side - 1 - column } else { column };
        row * side + column
    }

    /// What becomes of move number `action` of [`MOVES`].
    ///
    /// # Panics
    /// If there is no such move.
    pub fn action(self, action: usize) -> usize {
        let (down, right) = MOVES[action];
        let (down, right) = if self.transposed { (right, down) } else { (down, right) };
        let turned = (if self.down_up { -down } else { down }, if self.right_left { -right } else { right });
        MOVES.iter().position(|&to| to == turned).expect("the moves of a square are as symmetric as it is")
    }

    /// `plane`, one item a cell of a square with `side` rows, laid anew.
    ///
    /// # Panics
    /// If `plane` has another number of items.
    pub fn plane<T: Copy + Default>(self, side: usize, plane: &[T]) -> Vec<T> {
        assert_eq!(plane.len(), side * side, "one item a cell");
        let mut laid = vec![T::default(); plane.len()];
        for (cell, &item) in plane.iter().enumerate() {
            laid[self.cell(side, cell)] = item;
        }
        laid
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{MazeTask, PuzzleRng, Walker};
    use std::collections::BTreeSet;

    #[test]
    fn the_eight_are_different_and_lose_no_cell() {
        let cells: Vec<usize> = (0..25).collect();
        let laid: BTreeSet<Vec<usize>> = Symmetry::all().iter().map(|s| s.plane(5, &cells)).collect();
        assert_eq!(laid.len(), 8);
        assert!(laid.iter().all(|laid| laid.iter().collect::<BTreeSet<_>>().len() == 25));
        assert_eq!(Symmetry::all()[0].plane(5, &cells), cells);
    }

    #[test]
    fn a_walk_in_the_mirror_is_the_walks_mirror_image() {
        let mut rng = PuzzleRng::new(4, 0);
        for symmetry in Symmetry::all() {
            let maze = MazeTask::Walls5.draw(&mut rng);
            let mut mirrored = maze.clone();
            for cell in 0..25 {
                mirrored.grid.set_wall(symmetry.cell(5, cell), maze.grid.is_wall(cell));
            }
            (mirrored.start, mirrored.goal) = (symmetry.cell(5, maze.start), symmetry.cell(5, maze.goal));
            let (mut one, mut two) = (Walker::new(maze), Walker::new(mirrored));
            loop {
                let action = rng.below(4);
                let moved = one.act(action);
                assert_eq!(moved, two.act(symmetry.action(action)));
                assert_eq!(symmetry.cell(5, one.at()), two.at());
                let planes = one.observe_planes();
                let laid: Vec<f32> = planes.chunks(25).flat_map(|plane| symmetry.plane(5, plane)).collect();
                assert_eq!(laid, two.observe_planes());
                if moved.done {
                    break;
                }
            }
        }
    }
}
