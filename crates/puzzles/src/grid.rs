//! A rectangular grid of walls and the exact search on it: distances, the first shortest path in a fixed order of
//! directions, and the number of shortest paths.

/// Right, down, left, up: the order in which breadth-first search looks at neighbours, and so the one that decides which
/// of several shortest paths is "the" path.
pub const RIGHT_DOWN_LEFT_UP: [(isize, isize); 4] = [(0, 1), (1, 0), (0, -1), (-1, 0)];

/// Walls of a maze, row by row. A cell is its index `row * width + column`.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Grid {
    width: usize,
    walls: Vec<bool>,
}

impl Grid {
    /// A grid where every cell is a wall, or none.
    pub fn filled(height: usize, width: usize, wall: bool) -> Self {
        Self { width, walls: vec![wall; height * width] }
    }

    /// Number of rows.
    pub fn height(&self) -> usize {
        self.walls.len() / self.width
    }

    /// Number of columns.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Number of cells.
    pub fn len(&self) -> usize {
        self.walls.len()
    }

    /// Whether there is no cell at all.
    pub fn is_empty(&self) -> bool {
        self.walls.is_empty()
    }

    /// Index of the cell at a row and a column.
    pub fn cell(&self, row: usize, column: usize) -> usize {
        row * self.width + column
    }

    /// Row and column of a cell.
    pub fn place(&self, cell: usize) -> (usize, usize) {
        (cell / self.width, cell % self.width)
    }

    /// Whether a cell is a wall.
    pub fn is_wall(&self, cell: usize) -> bool {
        self.walls[cell]
    }

    /// Make a cell a wall, or free.
    pub fn set_wall(&mut self, cell: usize, wall: bool) {
        self.walls[cell] = wall;
    }

    /// Walls, row by row.
    pub fn walls(&self) -> &[bool] {
        &self.walls
    }

    /// The cell one step from another, walls or not; none beyond the edge.
    pub fn step(&self, cell: usize, (down, right): (isize, isize)) -> Option<usize> {
        let (row, column) = self.place(cell);
        let row = row.checked_add_signed(down).filter(|&row| row < self.height())?;
        let column = column.checked_add_signed(right).filter(|&column| column < self.width)?;
        Some(self.cell(row, column))
    }

    /// Steps that a walker would need between two cells if there were no walls.
    pub fn manhattan(&self, one: usize, two: usize) -> usize {
        let ((r, c), (s, d)) = (self.place(one), self.place(two));
        r.abs_diff(s) + c.abs_diff(d)
    }

    /// Steps from `from` to every cell, none where it cannot be reached. `from` itself may not be a wall.
    pub fn distances(&self, from: usize) -> Vec<Option<u16>> {
        let mut distances = vec![None; self.len()];
        if self.walls[from] {
            return distances;
        }
        let mut queue = Vec::with_capacity(self.len());
        distances[from] = Some(0);
        queue.push(from);
        let mut next = 0;
        while let Some(&cell) = queue.get(next) {
            next += 1;
            let further = distances[cell].map(|steps| steps + 1);
            for direction in RIGHT_DOWN_LEFT_UP {
                if let Some(to) = self.step(cell, direction)
                    && !self.walls[to]
                    && distances[to].is_none()
                {
                    distances[to] = further;
                    queue.push(to);
                }
            }
        }
        distances
    }

    /// The shortest path that breadth-first search finds first, looking right, down, left, up: both ends included.
    /// None if there is no way.
    pub fn first_shortest_path(&self, start: usize, goal: usize) -> Option<Vec<usize>> {
        if self.walls[start] || self.walls[goal] {
            return None;
        }
        let mut parent = vec![usize::MAX; self.len()];
        let mut queue = Vec::with_capacity(self.len());
        parent[start] = start;
        queue.push(start);
        let mut next = 0;
        while let Some(&cell) = queue.get(next) {
            next += 1;
            if cell == goal {
                let mut path = vec![goal];
                let mut at = goal;
                while at != start {
                    at = parent[at];
                    path.push(at);
                }
                path.reverse();
                return Some(path);
            }
            for direction in RIGHT_DOWN_LEFT_UP {
                if let Some(to) = self.step(cell, direction)
                    && !self.walls[to]
                    && parent[to] == usize::MAX
                {
                    parent[to] = cell;
                    queue.push(to);
                }
            }
        }
        None
    }

    /// Number of different shortest paths, 0 if there is no way.
    pub fn count_shortest_paths(&self, start: usize, goal: usize) -> u64 {
        let distances = self.distances(start);
        let Some(length) = distances[goal] else { return 0 };
        let mut order: Vec<usize> =
            (0..self.len()).filter(|&cell| distances[cell].is_some_and(|d| d <= length)).collect();
        order.sort_by_key(|&cell| distances[cell]);
        let mut ways = vec![0_u64; self.len()];
        ways[start] = 1;
        for cell in order {
            for direction in RIGHT_DOWN_LEFT_UP {
                if let Some(to) = self.step(cell, direction)
                    && distances[to].is_some()
                    && distances[to] == distances[cell].map(|d| d + 1)
                {
                    ways[to] += ways[cell];
                }
            }
        }
        ways[goal]
    }

    /// Whether the cells marked in `on` are exactly the cells of one shortest path from `start` to `goal`.
    ///
    /// A set of `length + 1` free cells, one at each distance 0..=length from the start and each beside the next, is a
    /// shortest path, and every shortest path is such a set.
    pub fn is_shortest_path(&self, start: usize, goal: usize, on: &[bool]) -> bool {
        let distances = self.distances(start);
        let Some(length) = distances[goal] else { return false };
        let mut at: Vec<Option<usize>> = vec![None; usize::from(length) + 1];
        for cell in (0..self.len()).filter(|&cell| on[cell]) {
            match distances[cell] {
                Some(d) if d <= length && at[usize::from(d)].is_none() => at[usize::from(d)] = Some(cell),
                _ => return false,
            }
        }
        at[usize::from(length)] == Some(goal)
            && at
                .windows(2)
                .all(|pair| matches!((pair[0], pair[1]), (Some(one), Some(two)) if self.manhattan(one, two) == 1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn grid(height: usize, width: usize, walls: &[bool]) -> Grid {
        let mut grid = Grid::filled(height, width, false);
        for (cell, &wall) in walls.iter().enumerate().take(height * width) {
            grid.set_wall(cell, wall);
        }
        grid
    }

    /// Every simple path of the least length, by brute force.
    fn all_shortest(grid: &Grid, start: usize, goal: usize) -> Vec<Vec<usize>> {
        fn walk(grid: &Grid, goal: usize, path: &mut Vec<usize>, found: &mut Vec<Vec<usize>>) {
            let here = path[path.len() - 1];
            if found.first().is_some_and(|best| path.len() > best.len()) {
                return;
            }
            if here == goal {
                if found.first().is_some_and(|best| path.len() < best.len()) {
                    found.clear();
                }
                found.push(path.clone());
                return;
            }
            for direction in RIGHT_DOWN_LEFT_UP {
                if let Some(to) = grid.step(here, direction)
                    && !grid.is_wall(to)
                    && !path.contains(&to)
                {
                    path.push(to);
                    walk(grid, goal, path, found);
                    path.pop();
                }
            }
        }
        let mut found = Vec::new();
        if !grid.is_wall(start) && !grid.is_wall(goal) {
            walk(grid, goal, &mut vec![start], &mut found);
        }
        found
    }

    proptest! {
        #[test]
        fn search_agrees_with_brute_force(walls in prop::collection::vec(prop::bool::weighted(0.3), 12), start in 0_usize..12, goal in 0_usize..12) {
            let grid = grid(3, 4, &walls);
            let all = all_shortest(&grid, start, goal);
            let path = grid.first_shortest_path(start, goal);
            prop_assert_eq!(path.is_some(), !all.is_empty());
            prop_assert_eq!(grid.count_shortest_paths(start, goal), all.len() as u64);
            if let Some(path) = path {
                prop_assert!(all.contains(&path));
                prop_assert_eq!(grid.distances(start)[goal], Some((path.len() - 1) as u16));
            }
            // every set of cells: a shortest path is recognised, anything else is not
            for set in 0_u32..4096 {
                let on: Vec<bool> = (0..12).map(|cell| set >> cell & 1 == 1).collect();
                let cells: Vec<usize> = (0..12).filter(|&cell| on[cell]).collect();
                let real = all.iter().any(|path| { let mut path = path.clone(); path.sort_unstable(); path == cells });
                prop_assert_eq!(grid.is_shortest_path(start, goal, &on), real);
            }
        }
    }
}
