//! What a policy that thinks over a grid took for the way, step by step of a thought, as a drawing.

use std::fmt::Write as _;

use crate::PolicyTrace;

/// Side of a cell, and the space between grids.
const CELL: usize = 9;
const GAP: usize = 14;
const LEFT: usize = 70;
const TOP: usize = 44;
/// Queries that are drawn, evenly spread over an episode.
const QUERIES: usize = 12;
/// Of what a cell shows beyond its first number: the outlines' colours.
const MARKS: [&str; 3] = ["#2e8b57", "#d2691e", "#8b008b"];

impl PolicyTrace {
    /// A row a query, a grid a step of its thought: bluer where the way is thought to go on, grey where the first number of a
    /// cell is 1 (a wall), outlined where one of the others is (the goal, the hand). `None` of a policy without a grid.
    pub fn way_svg(&self) -> Option<String> {
        let columns = self.columns?;
        let drawn: Vec<_> = self.queries.iter().filter(|query| !query.cells.is_empty()).collect();
        let first = drawn.first()?;
        let rows = first.cells.len().div_ceil(columns.max(1));
        let steps = drawn.iter().map(|query| query.thought.len()).max()?;
        let count = drawn.len().min(QUERIES);
        let (across, down) = (columns * CELL + GAP, rows * CELL + GAP);
        let (width, height) = (LEFT + steps * across, TOP + count * down);
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" font-family=\"sans-serif\" \
             font-size=\"10\">\n<rect width=\"{width}\" height=\"{height}\" fill=\"white\"/>\n\
             <text x=\"6\" y=\"16\" font-size=\"12\">{} on {}, seed {}: where the way is thought to go on</text>\n",
            self.entry, self.task, self.seed
        );
        for step in 0..steps {
            let _ = writeln!(svg, "<text x=\"{}\" y=\"{}\">thought {}</text>", LEFT + step * across, TOP - 6, step + 1);
        }
        for row in 0..count {
            let query = drawn[row * drawn.len() / count];
            let top = TOP + row * down;
            let _ = writeln!(svg, "<text x=\"6\" y=\"{}\">step {}</text>", top + CELL, query.step);
            for (step, thought) in query.thought.iter().enumerate() {
                for (cell, (seen, way)) in query.cells.iter().zip(&thought.way).enumerate() {
                    let (x, y) = (LEFT + step * across + cell % columns * CELL, top + cell / columns * CELL);
                    let is = |number: &f32| *number > 0.5;
                    let base = if seen.first().is_some_and(is) { "#777" } else { "#eee" };
                    let side = format!("x=\"{x}\" y=\"{y}\" width=\"{0}\" height=\"{0}\"", CELL - 1);
                    let _ = writeln!(svg, "<rect {side} fill=\"{base}\"/>");
                    let mark = seen.iter().skip(1).zip(MARKS).find(|(number, _)| is(number));
                    let outline =
                        mark.map_or(String::new(), |(_, colour)| format!(" stroke=\"{colour}\" stroke-width=\"2\""));
                    let _ = writeln!(
                        svg,
                        "<rect {side} fill=\"#1b3a9b\" fill-opacity=\"{way:.3}\"{outline}><title>{way:.3}</title></rect>"
                    );
                }
            }
        }
        svg.push_str("</svg>\n");
        Some(svg)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::{TracedQuery, TracedThought};

    #[test]
    fn a_grid_a_step_is_drawn_with_walls_goal_and_hand() {
        let thought = |way: [f32; 4]| TracedThought {
            actions: vec![vec![0.0]],
            change: None,
            halt: None,
            milliseconds: 0.1,
            attention: Vec::new(),
            way: way.to_vec(),
        };
        let query = |step| TracedQuery {
            step,
            executed: 1,
            milliseconds: 0.2,
            cells: vec![vec![1.0, 0.0, 0.0], vec![0.0, 1.0, 0.0], vec![0.0, 0.0, 0.0], vec![0.0, 0.0, 1.0]],
            thought: vec![thought([0.0, 0.5, 0.0, 1.0]), thought([0.0, 1.0, 0.0, 1.0])],
        };
        let mut trace = PolicyTrace {
            entry: "maze@1".into(),
            task: "Maze".into(),
            seed: 3,
            success: true,
            steps: 40,
            total_reward: 1.0,
            attended: Vec::new(),
            columns: Some(2),
            queries: (0..40).map(query).collect(),
        };
        let svg = trace.way_svg().unwrap();
        assert_eq!(svg.matches("<title>").count(), QUERIES * 2 * 4);
        assert_eq!(svg.matches("fill=\"#777\"").count(), QUERIES * 2, "one wall a grid");
        assert_eq!((svg.matches(MARKS[0]).count(), svg.matches(MARKS[1]).count()), (QUERIES * 2, QUERIES * 2));
        assert!(svg.contains("fill-opacity=\"0.500\"") && svg.contains("step 36"), "{svg}");
        trace.columns = None;
        assert!(trace.way_svg().is_none());
    }
}
