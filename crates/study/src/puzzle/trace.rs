//! What a solver believed of one puzzle, step by step: as text, as JSON and as a strip of pictures.

use std::fmt::Write as _;

use models::ModelError;
use puzzles::{Split, Task};
use serde::Serialize;

use super::entry::SolverEntry;
use super::evaluation::TEST_SEED;
use super::solver::settled;
use zoo::ZooError;

/// The course of one answer.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Trace {
    /// The entry, `name@version`.
    pub entry: String,
    /// The family of puzzles.
    pub task: String,
    /// Number of the puzzle in the test split.
    pub index: u64,
    /// Rows and columns.
    pub side: usize,
    /// What it saw, cell by cell.
    pub input: Vec<u8>,
    /// The answer that is right.
    pub target: Vec<u8>,
    /// The step after which it stopped, by its halting head or because there were no more.
    pub stopped_after: usize,
    /// What it believed after each step.
    pub steps: Vec<TraceStep>,
}

/// What a solver believed after one supervision step.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TraceStep {
    /// The step, from 1.
    pub step: usize,
    /// Its answer.
    pub answer: Vec<u8>,
    /// The probability that it gave each cell's answer.
    pub confidence: Vec<f32>,
    /// The probability that it gave each cell of a maze to be on the path; empty for Sudoku.
    pub on_path: Vec<f32>,
    /// The probability that it gave its answer to be right; absent for models without a halting head.
    pub halt: Option<f32>,
    /// Cells that are right.
    pub cells_right: usize,
    /// Whether the answer is right.
    pub valid: bool,
}

/// Has `entry` answer puzzle number `index` of the test split in up to `depth` steps.
///
/// # Errors
/// A model that fails.
pub fn trace(entry: &SolverEntry, task: Task, givens: usize, index: u64, depth: usize) -> Result<Trace, ZooError> {
    let puzzle = task.numbered(Split::Test, (givens, givens), TEST_SEED, index);
    let id = entry.entry().id().to_string();
    let failed = |source: ModelError| ZooError::Model { operation: "trace", name: id.clone(), source };
    let thoughts = entry.solver().think(std::slice::from_ref(&puzzle), depth).map_err(failed)?;
    let steps: Vec<TraceStep> = thoughts
        .into_iter()
        .filter_map(|mut thoughts| thoughts.pop())
        .enumerate()
        .map(|(index, thought)| {
            let grade = puzzle.grade(&thought.answer);
            TraceStep {
                step: index + 1,
                answer: thought.answer,
                confidence: thought.confidence,
                on_path: thought.on_path,
                halt: thought.halt,
                cells_right: grade.cells_right,
                valid: grade.valid,
            }
        })
        .collect();
    let stops = |at: &usize| {
        let before = at.checked_sub(1).map(|before| steps[before].answer.as_slice());
        settled(steps[*at].halt, &steps[*at].answer, before)
    };
    let stopped = (0..steps.len()).find(stops).map_or(steps.len(), |at| at + 1);
    Ok(Trace {
        entry: id,
        task: task.name().to_owned(),
        index,
        side: task.side(),
        input: puzzle.tokens(),
        target: puzzle.answer(),
        stopped_after: stopped,
        steps,
    })
}

/// Space between pictures and around them.
const GAP: usize = 18;
/// Height of the lines under a picture.
const CAPTION: usize = 52;
/// Pictures in a row.
const ROW: usize = 6;

impl Trace {
    fn is_maze(&self) -> bool {
        self.task.starts_with("maze") || self.task.starts_with("open") || self.task.starts_with("dfs")
    }

    /// As text: a grid and the confidence in each of its cells, step by step.
    pub fn to_text(&self) -> String {
        let mut text = format!("{} on {} number {} (test split)\n", self.entry, self.task, self.index);
        text.push_str(match self.is_maze() {
            true => "# wall, S start, G goal, * on the path, + marked and wrong, - on the path and not marked; confidence 0 to 9\n",
            false => "digits as given or answered, ! before a wrong one, . before a given one; confidence 0 to 9\n",
        });
        for step in &self.steps {
            let halt = step.halt.map_or(String::new(), |halt| format!(", halting {halt:.2}"));
            let stops = if step.step == self.stopped_after { ", stops here" } else { "" };
            let verdict = if step.valid { "right" } else { "wrong" };
            let _ = writeln!(
                text,
                "\nstep {}: {verdict}, {} of {} cells{halt}{stops}",
                step.step,
                step.cells_right,
                self.target.len()
            );
            for row in 0..self.side {
                let cells = row * self.side..(row + 1) * self.side;
                let grid: Vec<String> = cells.clone().map(|cell| self.cell_text(step, cell)).collect();
                let sure: String = cells.map(|cell| digit(step.confidence[cell])).collect();
                let _ = writeln!(text, "  {}    {sure}", grid.concat());
            }
        }
        text
    }

    fn cell_text(&self, step: &TraceStep, cell: usize) -> String {
        let (input, right, answer) = (self.input[cell], self.target[cell], step.answer[cell]);
        if !self.is_maze() {
            let mark = if answer != right {
                '!'
            } else if input > 0 {
                '.'
            } else {
                ' '
            };
            return format!("{mark}{answer} ");
        }
        let symbol = match (input, answer, right) {
            (2, ..) => 'S',
            (3, ..) => 'G',
            (_, 1, 1) => '*',
            (_, 1, _) => '+',
            (_, _, 1) => '-',
            (1, ..) => '#',
            _ => ' ',
        };
        format!("{symbol} ")
    }

    /// As a strip of pictures, one a step, and the right answer last: SVG that needs nothing else.
    pub fn to_svg(&self) -> String {
        // small grids in large cells: a caption has to fit under each
        let size = (176 / self.side).clamp(11, 44);
        let (picture, count) = (self.side * size, self.steps.len() + 1);
        let columns = count.min(ROW);
        let (wide, high) = (picture + GAP, picture + GAP + CAPTION);
        let (width, height) = (GAP + columns * wide, 56 + count.div_ceil(columns) * high);
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" width=\"{width}\" height=\"{height}\" \
             font-family=\"sans-serif\" font-size=\"12\">\n<rect width=\"{width}\" height=\"{height}\" fill=\"#ffffff\"/>\n\
             <text x=\"{GAP}\" y=\"24\" font-size=\"15\" font-weight=\"bold\">{} on {} number {}</text>\n\
             <text x=\"{GAP}\" y=\"42\" fill=\"#555555\">{}</text>\n",
            self.entry,
            self.task,
            self.index,
            match self.is_maze() {
                true => "the bluer a cell, the surer that it is on the path; a dot marks the path that is right",
                false => "bold: given; blue: answered, the paler the less sure; red: wrong",
            }
        );
        for place in 0..count {
            let (x, y) = (GAP + place % columns * wide, 56 + place / columns * high);
            let _ = writeln!(svg, "<g transform=\"translate({x} {y})\">");
            let step = self.steps.get(place);
            for cell in 0..self.target.len() {
                let (left, top) = (cell % self.side * size, cell / self.side * size);
                svg.push_str(&self.cell_svg(step, cell, left, top, size));
            }
            let _ = writeln!(
                svg,
                "<rect width=\"{picture}\" height=\"{picture}\" fill=\"none\" stroke=\"#333333\" stroke-width=\"1\"/>"
            );
            let lines = match step {
                None => [("the right answer".to_owned(), "#333333"), (String::new(), "#333333")],
                Some(step) => {
                    let stops = if step.step == self.stopped_after { ", stops" } else { "" };
                    let halt = step.halt.map_or(String::new(), |halt| format!(" · halting {halt:.2}{stops}"));
                    let verdict = if step.valid { ("right", "#1a7f37") } else { ("wrong", "#b3261e") };
                    let cells = format!("{}, {} of {} cells", verdict.0, step.cells_right, self.target.len());
                    [(format!("step {}{halt}", step.step), "#333333"), (cells, verdict.1)]
                }
            };
            for (line, (text, colour)) in lines.iter().enumerate() {
                let _ = writeln!(svg, "<text y=\"{}\" fill=\"{colour}\">{text}</text>", picture + 16 + 16 * line);
            }
            svg.push_str("</g>\n");
        }
        svg.push_str("</svg>\n");
        svg
    }

    fn cell_svg(&self, step: Option<&TraceStep>, cell: usize, x: usize, y: usize, size: usize) -> String {
        let (input, right) = (self.input[cell], self.target[cell]);
        let answer = step.map_or(right, |step| step.answer[cell]);
        let sure = step.map_or(1.0, |step| step.confidence[cell]);
        let middle = (x as f32 + size as f32 / 2.0, y as f32 + size as f32 / 2.0);
        let write = |text: &str, colour: &str, weight: &str, opacity: f32| {
            format!(
                "<text x=\"{:.1}\" y=\"{:.1}\" font-size=\"{}\" font-weight=\"{weight}\" fill=\"{colour}\" opacity=\"{opacity:.2}\" \
                 text-anchor=\"middle\">{text}</text>\n",
                middle.0,
                middle.1 + size as f32 * 0.28,
                size * 7 / 10
            )
        };
        let square = |fill: &str| {
            format!(
                "<rect x=\"{x}\" y=\"{y}\" width=\"{size}\" height=\"{size}\" fill=\"{fill}\" stroke=\"#d0d0d0\" stroke-width=\"0.5\"/>\n"
            )
        };
        if !self.is_maze() {
            if input > 0 {
                return square("#eeeeee")
                    + &write(&answer.to_string(), if answer == right { "#222222" } else { "#b3261e" }, "bold", 1.0);
            }
            let colour = if answer == right { "#1556c0" } else { "#b3261e" };
            return square("#ffffff") + &write(&answer.to_string(), colour, "normal", 0.35 + 0.65 * sure);
        }
        let belief = step.map_or(f32::from(right), |step| step.on_path[cell]).clamp(0.0, 1.0);
        // from white, or from a wall's grey, to blue
        let from = if input == 1 { [70.0, 70.0, 70.0] } else { [255.0, 255.0, 255.0] };
        let mix = |i: usize, to: f32| (from[i] + (to - from[i]) * belief).round() as u8;
        let mut out = square(&format!("#{:02x}{:02x}{:02x}", mix(0, 66.0), mix(1, 133.0), mix(2, 244.0)));
        match input {
            2 => out += &write("S", "#000000", "bold", 1.0),
            3 => out += &write("G", "#000000", "bold", 1.0),
            _ if right == 1 => {
                let _ = writeln!(
                    out,
                    "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"{:.1}\" fill=\"#000000\"/>",
                    middle.0,
                    middle.1,
                    size as f32 * 0.12
                );
            }
            _ => {}
        }
        out
    }
}

fn digit(confidence: f32) -> char {
    char::from(b'0' + (confidence * 10.0).clamp(0.0, 9.0) as u8)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn maze() -> Trace {
        let answers: [[u8; 4]; 2] = [[1, 1, 0, 1], [1, 0, 1, 1]];
        let steps = answers.iter().enumerate().map(|(i, answer)| TraceStep {
            step: i + 1,
            answer: answer.to_vec(),
            confidence: vec![0.99, 0.6, 0.85, 1.0],
            on_path: vec![0.99, 0.6, 0.15, 1.0],
            halt: Some(if i == 0 { 0.1 } else { 0.9 }),
            cells_right: if i == 0 { 2 } else { 4 },
            valid: i == 1,
        });
        Trace {
            entry: "trm@1".into(),
            task: "open8".into(),
            index: 3,
            side: 2,
            input: vec![2, 1, 0, 3],
            target: vec![1, 0, 1, 1],
            stopped_after: 2,
            steps: steps.collect(),
        }
    }

    #[test]
    fn the_text_shows_what_was_marked_and_how_sure() {
        let text = maze().to_text();
        assert!(text.contains("step 1: wrong, 2 of 4 cells, halting 0.10\n  S +     96\n  - G     89\n"), "{text}");
        assert!(
            text.contains("step 2: right, 4 of 4 cells, halting 0.90, stops here\n  S #     96\n  * G     89\n"),
            "{text}"
        );
    }

    #[test]
    fn the_strip_has_a_picture_a_step_and_one_of_the_answer() {
        let svg = maze().to_svg();
        assert_eq!(svg.matches("<g ").count(), 3);
        assert_eq!(svg.matches("<g ").count(), svg.matches("</g>").count());
        assert!(svg.contains("halting 0.90, stops") && svg.contains("the right answer"));
        for outside in ["href", "<script", "<image"] {
            assert!(!svg.contains(outside));
        }
        let json = serde_json::to_value(maze()).unwrap();
        assert_eq!(json["steps"][1]["answer"][2], 1);
    }
}
