//! Mazes for the robot's table, as a text that the Python side reads: the harness cannot draw them itself.

use crate::maze::{Maze, MazeTask};
use crate::rng::PuzzleRng;
use crate::split::Split;

/// Mazes of each family for learning, and for evaluating.
const COUNTS: [(Split, usize); 2] = [(Split::Train, 1000), (Split::Test, 200)];

/// The families that lie on the table.
const FAMILIES: [&str; 2] = ["open8", "dfs10"];

/// A fixed choice of mazes as JSON: family, then split, then one text a maze, `walls start goal`, the walls as 0 and 1
/// row by row. Walls of one split are never those of another; there are few perfect mazes of 10 x 10, which come again
/// with other ends.
pub fn table_mazes() -> String {
    let mut families = Vec::new();
    for (stream, name) in FAMILIES.into_iter().enumerate() {
        let task = MazeTask::ALL.into_iter().find(|(known, _)| *known == name).expect("a family of this crate").1;
        let mut rng = PuzzleRng::new(20_261_122, stream as u64);
        let mut splits = Vec::new();
        for (split, count) in COUNTS {
            let mut texts: Vec<String> = Vec::new();
            let mut seen = std::collections::BTreeSet::new();
            while texts.len() < count {
                let maze = task.draw_from(split, &mut rng);
                let text = text(&maze);
                if seen.insert(text.clone()) {
                    texts.push(text);
                }
            }
            splits.push(format!("\"{}\": [\n{}\n]", split.name(), texts.join(",\n")));
        }
        families.push(format!("\"{name}\": {{{}}}", splits.join(", ")));
    }
    format!("{{{}}}\n", families.join(",\n"))
}

fn text(maze: &Maze) -> String {
    let walls: String = maze.grid.walls().iter().map(|&wall| if wall { '1' } else { '0' }).collect();
    format!("\"{walls} {} {}\"", maze.start, maze.goal)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_harness_has_these_mazes() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tools/harness/actrm_harness/environments/mazes.json");
        let there = std::fs::read_to_string(path).expect("the harness holds mazes.json");
        assert!(there == table_mazes(), "{path} differs: make it anew with the example table_mazes");
    }
}
