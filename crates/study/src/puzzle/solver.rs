//! A model that answers puzzles, of whatever kind, and what it believes after each step of its recursion.

use std::collections::BTreeMap;

use candle_core::{Device, Tensor};
use models::classification::ClassProbability;
use models::{ModelError, Rng};
use puzzles::{MazeTask, Puzzle, PuzzleRng, Task, View};
use solvers::trm::{Carry, Gradient, Trm};
use solvers::{GridDims, GridModel, WalkerNet};

/// A model for one family of puzzles.
pub enum Solver {
    /// Recursive: may take as many steps as it is given.
    Trm {
        /// The network.
        model: Box<Trm>,
        /// What it is built for.
        task: Task,
        /// What turns its scores into probabilities.
        probability: ClassProbability,
    },
    /// From the grid to scores in a fixed number of steps.
    Grid {
        /// The network.
        model: Box<dyn GridModel>,
        /// Its grid.
        dims: GridDims,
        /// What it is built for.
        task: Task,
        /// What turns its scores into probabilities.
        probability: ClassProbability,
    },
    /// A policy that walks through mazes instead of marking cells.
    Walker {
        /// The network.
        net: Box<dyn WalkerNet>,
        /// The mazes that it walks in.
        task: MazeTask,
    },
}

/// What a model believes of one puzzle after a supervision step.
#[derive(Debug, Clone, PartialEq)]
pub struct Thought {
    /// Its answer, a number a cell as in [`Puzzle::answer`].
    pub answer: Vec<u8>,
    /// The probability that it gives each cell's answer.
    pub confidence: Vec<f32>,
    /// For mazes: the probability that each cell is on the path; empty for Sudoku.
    pub on_path: Vec<f32>,
    /// The probability that the answer is right as a whole, if the model has a halting head.
    pub halt: Option<f32>,
}

impl Solver {
    /// Number of weights.
    pub fn parameters(&self) -> u64 {
        match self {
            Self::Trm { model, .. } => model.params().count() as u64,
            Self::Grid { model, .. } => model.params().count() as u64,
            Self::Walker { net, .. } => net.params().count() as u64,
        }
    }

    /// Everything that has to be stored.
    pub fn tensors(&self) -> BTreeMap<String, Tensor> {
        match self {
            Self::Trm { model, .. } => model.tensors(),
            Self::Grid { model, .. } => model.params().tensors(),
            Self::Walker { net, .. } => net.params().tensors(),
        }
    }

    /// Takes what [`Solver::tensors`] gave.
    ///
    /// # Errors
    /// The first tensor that is missing, extra or misshapen.
    pub fn load(&mut self, tensors: &BTreeMap<String, Tensor>) -> Result<(), ModelError> {
        match self {
            Self::Trm { model, .. } => model.load(tensors),
            Self::Grid { model, .. } => model.params().load(tensors),
            Self::Walker { net, .. } => net.params().load(tensors),
        }
    }

    /// Whether more steps are possible than it was trained with.
    pub fn is_recursive(&self) -> bool {
        matches!(self, Self::Trm { .. })
    }

    /// What it believes of each puzzle after each of up to `steps` supervision steps: `[step][puzzle]`. A model without a
    /// free number of steps takes those that it has.
    ///
    /// # Errors
    /// Puzzles of another size than the model's.
    pub fn think(&self, puzzles: &[Puzzle], steps: usize) -> Result<Vec<Vec<Thought>>, ModelError> {
        self.think_from(puzzles, steps, &Start::default())
    }

    /// The same from another start, if it is a recursion.
    pub(super) fn think_from(
        &self,
        puzzles: &[Puzzle],
        steps: usize,
        start: &Start<'_>,
    ) -> Result<Vec<Vec<Thought>>, ModelError> {
        let mut thoughts = Vec::new();
        match self {
            Self::Trm { model, task, probability } => {
                let views = start.views(*task);
                let inputs = tokens(puzzles, &views)?;
                let mut carry = start.of(model.initial_carry(puzzles.len())?)?;
                for _ in 0..steps {
                    let out = model.supervision_step(&carry, &inputs, None, Gradient::Off)?;
                    carry = out.carry;
                    let halt = out.q_halt.to_vec1::<f32>()?.into_iter().map(|q| 1.0 / (1.0 + (-q).exp()));
                    let mut now = read(*task, *probability, &out.logits, halt.map(Some).collect())?;
                    now.iter_mut().zip(&views).for_each(|(thought, view)| thought.turn_back(view));
                    thoughts.push(now);
                }
            }
            Self::Grid { model, dims, task, probability } => {
                for (_, scores) in model.forward(&planes(puzzles, *dims)?)? {
                    thoughts.push(read(*task, *probability, &scores, vec![None; puzzles.len()])?);
                }
            }
            Self::Walker { .. } => {
                return Err(ModelError::Input {
                    operation: "think",
                    object: "model",
                    found: "a walker, which marks no cells".to_owned(),
                    expected: "a model that answers cell by cell".to_owned(),
                });
            }
        }
        Ok(thoughts)
    }
}

/// What thoughts about puzzles begin with; of itself, what the solver was trained with, of puzzles as they are.
#[derive(Default)]
pub(super) struct Start<'a> {
    /// Numbers of the puzzles: each has noise and names of its own, whatever it is thought about together with.
    pub(super) puzzles: &'a [usize],
    /// The side that each is seen from; 0: as it is.
    pub(super) view: u64,
    /// Which start from there; 0: as the solver was trained, any other from noise on both states.
    pub(super) number: u64,
    /// Standard deviation of that noise.
    pub(super) noise: f64,
}

impl Start<'_> {
    /// The states to begin with instead of `carry`.
    fn of(&self, carry: Carry) -> Result<Carry, ModelError> {
        let stream = match (self.number, self.view) {
            (0, _) => return Ok(carry),
            (number, 0) => format!("noisy start {number}"),
            (number, view) => format!("noisy start {number} of view {view}"),
        };
        let (_, positions, width) = carry.z_h.dims3()?;
        let mut noises = [Vec::new(), Vec::new()];
        for &puzzle in self.puzzles {
            let mut rng = Rng::new(puzzle as u64, &stream);
            noises.iter_mut().for_each(|noise| noise.extend(rng.normals(positions * width)));
        }
        let [h, l] = noises.map(|noise| Tensor::from_vec(noise, carry.z_h.shape(), &Device::Cpu));
        Ok(Carry { z_h: (&carry.z_h + (h? * self.noise)?)?, z_l: (&carry.z_l + (l? * self.noise)?)? })
    }

    /// How each puzzle is seen; none where they are seen as they are.
    fn views(&self, task: Task) -> Vec<View> {
        if self.view == 0 {
            return Vec::new();
        }
        let view = |&puzzle: &usize| View::new(task, self.view, &mut PuzzleRng::new(puzzle as u64, self.view));
        self.puzzles.iter().map(view).collect()
    }
}

impl Thought {
    /// Makes a thought about what is seen one about the puzzle.
    fn turn_back(&mut self, view: &View) {
        self.answer = view.answer(&self.answer);
        self.confidence = view.plane(&self.confidence);
        if !self.on_path.is_empty() {
            self.on_path = view.plane(&self.on_path);
        }
    }
}

/// Whether a solver stops after a step: its halting head says that the answer is right, and the answer is the one that it
/// had before. The head alone stops too early: it was trained on answers that are still changing.
pub(super) fn settled(halt: Option<f32>, answer: &[u8], before: Option<&[u8]>) -> bool {
    halt.is_some_and(|halt| halt > 0.5) && before == Some(answer)
}

/// `(batch, cells)` of token numbers, each puzzle as its view sees it if there is one.
fn tokens(puzzles: &[Puzzle], views: &[View]) -> Result<Tensor, ModelError> {
    let seen = |(at, puzzle): (usize, &Puzzle)| match views.get(at) {
        Some(view) => view.of(&puzzle.tokens()),
        None => puzzle.tokens(),
    };
    let all: Vec<u32> = puzzles.iter().enumerate().flat_map(seen).map(u32::from).collect();
    let cells = puzzles.first().map_or(0, Puzzle::cells);
    Ok(Tensor::from_vec(all, (puzzles.len(), cells), &Device::Cpu)?)
}

/// `(batch, channels, height, width)`: 1 where a cell holds token `channel + 1`, so walls, start and goal for a maze.
pub(super) fn planes(puzzles: &[Puzzle], dims: GridDims) -> Result<Tensor, ModelError> {
    let (channels, cells) = (dims.channels, dims.cells());
    let mut all = vec![0.0_f32; puzzles.len() * channels * cells];
    for (puzzle, planes) in puzzles.iter().zip(all.chunks_mut(channels * cells)) {
        for (cell, token) in puzzle.tokens().into_iter().enumerate().filter(|(_, token)| *token > 0) {
            planes[(usize::from(token) - 1) * cells + cell] = 1.0;
        }
    }
    Ok(Tensor::from_vec(all, (puzzles.len(), channels, dims.height, dims.width), &Device::Cpu)?)
}

/// Class numbers of the answers, one puzzle after the other.
pub(super) fn labels(task: Task, puzzle: &Puzzle) -> Vec<i64> {
    puzzle.answer().into_iter().map(|answer| i64::from(answer - task.first_answer())).collect()
}

/// `logits (batch, cells, classes)` as answers and probabilities.
fn read(
    task: Task,
    probability: ClassProbability,
    logits: &Tensor,
    halt: Vec<Option<f32>>,
) -> Result<Vec<Thought>, ModelError> {
    let (_, cells, classes) = logits.dims3()?;
    let scores = logits.flatten_all()?.to_vec1::<f32>()?;
    let each = scores.chunks(cells * classes).zip(halt).map(|(scores, halt)| {
        let mut thought = Thought { answer: Vec::new(), confidence: Vec::new(), on_path: Vec::new(), halt };
        for scores in scores.chunks(classes) {
            let shares = shares(probability, scores);
            let mut best = 0;
            for class in 1..classes {
                if scores[class] > scores[best] {
                    best = class;
                }
            }
            thought.answer.push(best as u8 + task.first_answer());
            thought.confidence.push(shares[best]);
            if matches!(task, Task::Maze(_)) {
                thought.on_path.push(shares[1]);
            }
        }
        thought
    });
    Ok(each.collect())
}

fn shares(probability: ClassProbability, scores: &[f32]) -> Vec<f32> {
    let most = scores.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let weight = |x: f32| match probability {
        ClassProbability::Softmax => (x - most).exp(),
        ClassProbability::Stablemax if x >= 0.0 => x + 1.0,
        ClassProbability::Stablemax => 1.0 / (1.0 - x),
    };
    let weights: Vec<f32> = scores.iter().map(|&x| weight(x)).collect();
    let sum: f32 = weights.iter().sum();
    weights.into_iter().map(|w| w / sum).collect()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use solvers::{GridConfig, SmallTrmConfig};

    #[test]
    fn a_model_without_a_free_number_of_steps_takes_its_own() {
        let task = Task::by_name("open8").unwrap();
        let dims = GridDims { channels: 3, height: 8, width: 8, classes: 2 };
        let model = GridConfig::SmallTrm(SmallTrmConfig::simple()).build(dims, 1).unwrap();
        let solver = Solver::Grid { model, dims, task, probability: ClassProbability::Softmax };
        let puzzle = task.numbered(puzzles::Split::Test, (0, 0), 1, 0);
        for steps in [1, 16] {
            assert_eq!(solver.think(std::slice::from_ref(&puzzle), steps).unwrap().len(), 5);
        }
    }

    #[test]
    fn probabilities_add_up_and_follow_the_scores() {
        for probability in [ClassProbability::Softmax, ClassProbability::Stablemax] {
            let shares = shares(probability, &[0.5, -2.0, 3.0]);
            assert!((shares.iter().sum::<f32>() - 1.0).abs() < 1e-6);
            assert!(shares[2] > shares[0] && shares[0] > shares[1]);
        }
        let even = shares(ClassProbability::Softmax, &[800.0, 800.0]);
        assert_eq!(even, [0.5, 0.5]);
    }

    #[test]
    fn a_solver_stops_once_it_is_sure_of_an_answer_that_stays() {
        assert!(settled(Some(0.9), &[1, 2], Some(&[1, 2])));
        assert!(!settled(Some(0.9), &[1, 2], Some(&[1, 1])) && !settled(Some(0.9), &[1, 2], None));
        assert!(!settled(Some(0.5), &[1, 2], Some(&[1, 2])) && !settled(None, &[1, 2], Some(&[1, 2])));
    }

    #[test]
    fn planes_mark_each_token_once() {
        let task = Task::by_name("open8").unwrap();
        let puzzle = task.numbered(puzzles::Split::Train, (0, 0), 1, 0);
        let dims = GridDims { channels: 3, height: 8, width: 8, classes: 2 };
        let planes =
            planes(std::slice::from_ref(&puzzle), dims).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let tokens = puzzle.tokens();
        for (i, &x) in planes.iter().enumerate() {
            assert_eq!(x == 1.0, usize::from(tokens[i % 64]) == i / 64 + 1);
        }
        let sudoku = Task::by_name("sudoku4").unwrap();
        let puzzle = sudoku.numbered(puzzles::Split::Train, (4, 8), 1, 0);
        assert!(labels(sudoku, &puzzle).iter().all(|label| (0..4).contains(label)));
    }
}
