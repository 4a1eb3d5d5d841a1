//! Trains a TRM on one puzzle task with this crate's recipe for it, and prints how it does on puzzles that it has not
//! seen, with the CPU seconds that training took. Recipes are starting points: any value can be changed.
//!
//!     RAYON_NUM_THREADS=1 target/release/examples/puzzle_recipes dfs10 seed=1 train.lr=0.003
//!
//! Every line is a JSON object; the last one is measured on the test split, those before it on the validation split.
#![allow(clippy::unwrap_used, clippy::print_stdout)]

use candle_core::{Device, Tensor};
use models::TrainConfig;
use models::trm::{Config, Example, Gradient, PuzzleConfig, Trainer, Trm};
use puzzles::{Maze, MazeTask, Rng, Split, SudokuTask};
use serde_json::{Value, json};

/// What a task is made of.
#[derive(Clone, Copy)]
enum Task {
    Maze(MazeTask),
    /// Fewest and most givens.
    Sudoku(SudokuTask, usize, usize),
}

/// A puzzle as the model sees it, and what it takes to grade an answer.
struct Puzzle {
    example: Example,
    maze: Option<Maze>,
}

impl Task {
    fn draw(self, split: Split, rng: &mut Rng) -> Puzzle {
        let (inputs, labels, maze): (Vec<u32>, Vec<i64>, _) = match self {
            Self::Maze(task) => {
                let maze = task.draw_from(split, rng);
                let token = |(cell, &wall): (usize, &bool)| match cell {
                    _ if cell == maze.start => 2,
                    _ if cell == maze.goal => 3,
                    _ => u32::from(wall),
                };
                let inputs = maze.grid.walls().iter().enumerate().map(token).collect();
                (inputs, maze.on_path().into_iter().map(i64::from).collect(), Some(maze))
            }
            Self::Sudoku(task, fewest, most) => {
                let givens = rng.between(fewest, most);
                let sudoku = task.draw_from(split, givens, rng);
                let labels = sudoku.solution.iter().map(|&digit| i64::from(digit) - 1).collect();
                (sudoku.puzzle.iter().map(|&digit| u32::from(digit)).collect(), labels, None)
            }
        };
        Puzzle { example: Example { inputs, labels, identifier: 0 }, maze }
    }
}

/// The recipe of a task: everything but the seed.
fn recipe(name: &str) -> Option<(Task, Value)> {
    let maze = |task: MazeTask, model: Value, puzzle: Value, train: Value| {
        let side = task.side();
        let base = json!({ "vocab_size": 4, "classes": 2, "seq_len": side * side, "grid": [side, side],
            "mixing": "conv", "positions": "none", "layers": 1, "h_cycles": 2, "l_cycles": 4, "q_outputs": 1,
            "pooling": "mean" });
        (Task::Maze(task), base, model, puzzle, train)
    };
    let sudoku = |task: SudokuTask, (fewest, most), model: Value, puzzle: Value, train: Value| {
        let base = json!({ "vocab_size": task.side() + 1, "classes": task.side(), "seq_len": task.cells(),
            "mixing": "mlp_t", "positions": "none", "layers": 2, "h_cycles": 2, "l_cycles": 4, "q_outputs": 1,
            "pooling": "mean" });
        (Task::Sudoku(task, fewest, most), base, model, puzzle, train)
    };
    let (task, mut model, more, puzzle, train) = match name {
        "dfs10" => maze(
            MazeTask::Dfs10,
            json!({ "hidden_size": 32, "inner_size": 64, "halt_max_steps": 8 }),
            json!({}),
            json!({ "steps": 4000 }),
        ),
        "open8" => maze(
            MazeTask::Open8,
            json!({ "hidden_size": 24, "inner_size": 48, "halt_max_steps": 8 }),
            json!({}),
            json!({ "steps": 4000 }),
        ),
        "maze8-original" => maze(
            MazeTask::Original8,
            json!({ "hidden_size": 16, "inner_size": 32, "halt_max_steps": 4 }),
            json!({}),
            json!({ "steps": 200 }),
        ),
        "maze10-original" => maze(
            MazeTask::Original10,
            json!({ "hidden_size": 16, "inner_size": 32, "halt_max_steps": 4 }),
            json!({}),
            json!({ "steps": 100 }),
        ),
        "sudoku4" => sudoku(
            SudokuTask::FOUR,
            (4, 10),
            json!({ "hidden_size": 32, "inner_size": 64, "halt_max_steps": 6 }),
            json!({}),
            json!({ "steps": 2000 }),
        ),
        "sudoku6" => sudoku(
            SudokuTask::SIX,
            (10, 22),
            json!({ "hidden_size": 48, "inner_size": 96, "halt_max_steps": 8 }),
            json!({}),
            json!({ "steps": 4000 }),
        ),
        "sudoku9" => sudoku(
            SudokuTask::NINE,
            (36, 45),
            json!({ "hidden_size": 64, "inner_size": 128, "halt_max_steps": 8 }),
            json!({}),
            json!({ "steps": 6000 }),
        ),
        _ => return None,
    };
    merge(&mut model, more);
    let mut settings = json!({
        "model": model,
        "puzzle": { "batch_size": 32, "probability": "softmax", "halt_weight": 0.1, "release": { "solved": 0.5 } },
        "train": { "lr": 2e-3, "warmup_steps": 50, "clip_norm": 1.0, "ema_decay": 0.99,
            "optimiser": { "type": "adam_w", "beta1": 0.9, "beta2": 0.95, "eps": 1e-8, "weight_decay": 0.1 } },
        "seed": 0, "every": 500, "tests": 600, "depth": 16, "eval_task": "", "eval_depth": 0, "givens": [],
    });
    merge(&mut settings["puzzle"], puzzle);
    merge(&mut settings["train"], train);
    Some((task, settings))
}

fn merge(into: &mut Value, from: Value) {
    for (key, value) in from.as_object().unwrap() {
        into[key] = value.clone();
    }
}

/// Sets `a.b=value`; the key must be one that the configuration has or takes.
fn set(settings: &mut Value, dotted: &str) {
    let (path, text) = dotted.split_once('=').expect("overrides are written key=value");
    let value = serde_json::from_str(text).unwrap_or_else(|_| Value::String(text.into()));
    let mut at = settings;
    for part in path.split('.') {
        at = &mut at[part];
    }
    *at = value;
}

/// Seconds of CPU that this process has used, all threads.
fn cpu_seconds() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap();
    let fields: Vec<&str> = stat.rsplit_once(')').unwrap().1.split_whitespace().collect();
    (fields[11].parse::<f64>().unwrap() + fields[12].parse::<f64>().unwrap()) / 100.0
}

/// Shares of exact and of valid answers: after each supervision step, and with halting.
fn grade(model: &Trm, tests: &[Puzzle], depth: usize) -> Value {
    let len = model.config().seq_len;
    let mut exact = vec![0usize; depth + 1];
    let mut valid = vec![0usize; depth + 1];
    let (mut steps, mut detours, mut detours_valid) = (0, 0, 0);
    for group in tests.chunks(50) {
        let inputs: Vec<u32> = group.iter().flat_map(|p| p.example.inputs.iter().copied()).collect();
        let inputs = Tensor::from_vec(inputs, (group.len(), len), &Device::Cpu).unwrap();
        let mut states = model.initial_states(group.len()).unwrap();
        let mut halted = vec![false; group.len()];
        let mut before: Vec<Vec<u32>> = vec![Vec::new(); group.len()];
        for step in 0..depth {
            let out = model.supervision_step(&states, &inputs, None, Gradient::Off).unwrap();
            states = out.states;
            let classes = out.logits.argmax(2).unwrap().to_vec2::<u32>().unwrap();
            let q = out.q_halt.to_vec1::<f32>().unwrap();
            for (i, puzzle) in group.iter().enumerate() {
                let same = classes[i].iter().zip(&puzzle.example.labels).all(|(&c, &l)| i64::from(c) == l);
                let on: Vec<bool> = classes[i].iter().map(|&c| c == 1).collect();
                let good = match &puzzle.maze {
                    Some(maze) if !maze.path.is_empty() => maze.grid.is_shortest_path(maze.start, maze.goal, &on),
                    _ => same,
                };
                exact[step] += usize::from(same);
                valid[step] += usize::from(good);
                // the head says so and the answer has come to rest
                let rests = q[i] > 0.0 && classes[i] == before[i];
                if !halted[i] && (rests || step + 1 == depth) {
                    halted[i] = true;
                    steps += step + 1;
                    exact[depth] += usize::from(same);
                    valid[depth] += usize::from(good);
                    if puzzle.maze.as_ref().is_some_and(Maze::has_detour) {
                        detours += 1;
                        detours_valid += usize::from(good);
                    }
                }
            }
            before = classes;
        }
    }
    let share = |n: usize| (n as f64 / tests.len() as f64 * 1e4).round() / 1e4;
    let depths: Vec<usize> = [1, 2, 4, 6, 8, 12, 16, 32].into_iter().filter(|&d| d <= depth).collect();
    json!({
        "halting": { "exact": share(exact[depth]), "valid": share(valid[depth]),
            "detours_valid": detours_valid as f64 / detours.max(1) as f64, "steps": share(steps) },
        "depths": depths,
        "exact": depths.iter().map(|&d| share(exact[d - 1])).collect::<Vec<_>>(),
        "valid": depths.iter().map(|&d| share(valid[d - 1])).collect::<Vec<_>>(),
    })
}

fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let Some((mut task, mut settings)) = args.first().and_then(|name| recipe(name)) else {
        eprintln!(
            "usage: puzzle_recipes dfs10|open8|maze8-original|maze10-original|sudoku4|sudoku6|sudoku9 [key=value]..."
        );
        std::process::exit(1);
    };
    args[1..].iter().for_each(|arg| set(&mut settings, arg));
    if let (Task::Sudoku(size, ..), Some([from, to])) = (task, settings["givens"].as_array().map(Vec::as_slice)) {
        task = Task::Sudoku(size, from.as_u64().unwrap() as usize, to.as_u64().unwrap() as usize);
    }
    let number = |key: &str| settings[key].as_u64().unwrap();
    let (seed, every, tests, depth) =
        (number("seed"), number("every"), number("tests") as usize, number("depth") as usize);
    let config: Config = serde_json::from_value(settings["model"].clone()).unwrap();
    let train: TrainConfig = serde_json::from_value(settings["train"].clone()).unwrap();
    let puzzle: PuzzleConfig = serde_json::from_value(settings["puzzle"].clone()).unwrap();
    let steps = train.steps;
    let model = Trm::new(config.clone(), seed).unwrap();
    println!("{}", json!({ "task": args[0], "parameters": model.params().count(), "settings": settings }));

    let set_of = |task: Task, split, stream| {
        let mut rng = Rng::new(1, stream);
        (0..tests).map(|_| task.draw(split, &mut rng)).collect::<Vec<_>>()
    };
    let valid = set_of(task, Split::Valid, 1);
    let mut trainer = Trainer::new(model, train, puzzle, seed).unwrap();
    let mut rng = Rng::new(seed, 7);
    let mut used = 0.0;
    let (mut loss, mut right) = (0.0, 0.0);
    for step in 1..=steps {
        let begun = cpu_seconds();
        let fresh: Vec<Example> = (0..trainer.wanted()).map(|_| task.draw(Split::Train, &mut rng).example).collect();
        let report = trainer.step(&fresh).unwrap();
        used += cpu_seconds() - begun;
        loss += f64::from(report.class_loss);
        right += report.exact;
        if step % every == 0 && step < steps {
            let mut averaged = Trm::new(config.clone(), seed).unwrap();
            averaged.load(&trainer.eval_tensors().unwrap()).unwrap();
            let n = every as f64;
            println!(
                "{}",
                json!({ "step": step, "cpu_s": used, "loss": loss / n, "exact_in_training": right / n,
                "validation": grade(&averaged, &valid, depth) })
            );
            (loss, right) = (0.0, 0.0);
        }
    }
    let mut averaged = Trm::new(config, seed).unwrap();
    averaged.load(&trainer.eval_tensors().unwrap()).unwrap();
    let report = grade(&averaged, &set_of(task, Split::Test, 2), depth);
    println!(
        "{}",
        json!({ "step": steps, "cpu_s": used, "seed": seed, "parameters": trainer.model().params().count(), "test": report })
    );
    // weights are tied over positions with mix conv: the same weights on larger mazes
    if let Some((_, bigger)) = MazeTask::ALL.iter().find(|(name, _)| *name == settings["eval_task"]) {
        let side = bigger.side();
        let mut large = settings["model"].clone();
        merge(&mut large, json!({ "seq_len": side * side, "grid": [side, side] }));
        let mut large = Trm::new(serde_json::from_value(large).unwrap(), seed).unwrap();
        large.load(&trainer.eval_tensors().unwrap()).unwrap();
        let report = grade(&large, &set_of(Task::Maze(*bigger), Split::Test, 2), number("eval_depth") as usize);
        println!("{}", json!({ "larger": settings["eval_task"], "test": report }));
    }
}
