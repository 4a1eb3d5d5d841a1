//! Trains a policy network on the 5x5 mazes with this crate's recipe for it: by reinforcement, or supervised by search.
//!
//!     RAYON_NUM_THREADS=1 target/release/examples/rl_recipes maze5-rl mlp seed=1
//!     RAYON_NUM_THREADS=1 target/release/examples/rl_recipes maze5-walls conv episodes=5000
//!     RAYON_NUM_THREADS=1 target/release/examples/rl_recipes maze5-walls conv search=2000
//!
//! Networks: mlp, trm3, trm5 (the study's), conv (a TRM of at most 6,100 parameters). Every line is a JSON object: success
//! is the share of held-out mazes that greedy moves solve on a shortest way.
#![allow(clippy::unwrap_used, clippy::print_stdout)]

use models::baselines::{PolicyNet, PolicyNetConfig};
use models::rl::{Agent, Algorithm, Choice, Episode, RlConfig, decide};
use models::{Schedule, TrainConfig};
use puzzles::{MOVES, Rng, Split, Walker};
use serde_json::{Value, json};

fn set(settings: &mut Value, dotted: &str) {
    let (path, text) = dotted.split_once('=').expect("overrides are written key=value");
    let value = serde_json::from_str(text).unwrap_or_else(|_| Value::String(text.into()));
    let mut at = settings;
    for part in path.split('.') {
        at = &mut at[part];
    }
    *at = value;
}

fn cpu_seconds() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap();
    let fields: Vec<&str> = stat.rsplit_once(')').unwrap().1.split_whitespace().collect();
    (fields[11].parse::<f64>().unwrap() + fields[12].parse::<f64>().unwrap()) / 100.0
}

#[derive(Clone, Copy)]
struct Task {
    walls: bool,
}

impl Task {
    fn start(self, split: Split, rng: &mut Rng) -> Walker {
        if self.walls { Walker::walls5(split, rng) } else { Walker::empty5() }
    }

    fn observe(self, walker: &Walker) -> Vec<f32> {
        if self.walls { walker.observe_planes() } else { walker.observe_study() }
    }

    /// Share of mazes that greedy moves solve on a shortest way.
    fn success(self, net: &dyn PolicyNet, mazes: &[Walker]) -> f64 {
        let mut open: Vec<(Walker, Episode)> = mazes.iter().map(|w| (w.clone(), Episode::default())).collect();
        let mut solved = 0;
        while !open.is_empty() {
            let seen: Vec<Vec<f32>> = open.iter().map(|(walker, _)| self.observe(walker)).collect();
            let previous: Vec<u32> = open.iter().map(|(_, episode)| episode.previous_action()).collect();
            let decisions = decide(net, &seen.concat(), &previous, None).unwrap();
            for (((walker, episode), decision), seen) in open.iter_mut().zip(decisions).zip(&seen) {
                let moved = walker.act(decision.action as usize);
                episode.push(seen, decision, moved.reward);
                solved += usize::from(moved.at_goal && walker.moves() == walker.maze().path.len() - 1);
            }
            open.retain(|(walker, _)| walker.at() != walker.maze().goal && walker.moves() < walker.maze().path.len());
        }
        solved as f64 / mazes.len() as f64
    }
}

/// Whole episodes, played side by side.
fn play(agent: &mut Agent, task: Task, count: usize, rng: &mut Rng) -> Vec<Episode> {
    let mut open: Vec<(Walker, Episode)> =
        (0..count).map(|_| (task.start(Split::Train, rng), Episode::default())).collect();
    let mut over = Vec::new();
    while !open.is_empty() {
        let seen: Vec<Vec<f32>> = open.iter().map(|(walker, _)| task.observe(walker)).collect();
        let previous: Vec<u32> = open.iter().map(|(_, episode)| episode.previous_action()).collect();
        let decisions = agent.decide(&seen.concat(), &previous, Choice::Sample).unwrap();
        let mut left = Vec::new();
        for (((mut walker, mut episode), decision), seen) in open.into_iter().zip(decisions).zip(&seen) {
            let moved = walker.act(decision.action as usize);
            episode.push(seen, decision, moved.reward);
            if moved.done { over.push(episode) } else { left.push((walker, episode)) }
        }
        open = left;
    }
    over
}

/// Cells of random mazes with the first moves of their shortest ways.
fn labelled(task: Task, count: usize, rng: &mut Rng) -> (Vec<f32>, Vec<f32>) {
    let (mut observations, mut targets) = (Vec::new(), Vec::new());
    for _ in 0..count {
        let mut maze = task.start(Split::Train, rng).maze().clone();
        let distances = maze.grid.distances(maze.goal);
        let reachable: Vec<usize> = (0..maze.grid.len()).filter(|&c| distances[c].is_some_and(|d| d > 0)).collect();
        maze.start = reachable[rng.below(reachable.len())];
        let here = distances[maze.start].unwrap();
        let best: Vec<bool> = MOVES
            .iter()
            .map(|&by| maze.grid.step(maze.start, by).is_some_and(|to| distances[to] == Some(here - 1)))
            .collect();
        let share = 1.0 / best.iter().filter(|b| **b).count() as f32;
        targets.extend(best.iter().map(|&b| if b { share } else { 0.0 }));
        observations.extend(task.observe(&Walker::new(maze)));
    }
    (observations, targets)
}

fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [name, kind, rest @ ..] = args.as_slice() else {
        eprintln!("usage: rl_recipes maze5-rl|maze5-walls mlp|trm3|trm5|conv [key=value]...");
        std::process::exit(1);
    };
    let task = Task { walls: name == "maze5-walls" };
    let mut settings = json!({
        "seed": 0, "episodes": 500, "per_update": 5, "every": 100, "search": 0, "batch": 128,
        "hidden": [128, 128], "conv": [20, 32, 8], "reinforce": false,
        "rl": { "algorithm": { "kind": "a2c" }, "gamma": 0.95, "entropy_weight": 0.01 },
        "train": { "steps": 100, "lr": 3e-3, "warmup_steps": 0, "clip_norm": 1.0, "schedule": "constant",
            "optimiser": { "type": "adam_w", "beta1": 0.9, "beta2": 0.999, "eps": 1e-8, "weight_decay": 0.0 } },
    });
    if task.walls {
        settings["episodes"] = 5000.into();
        settings["per_update"] = 16.into();
        settings["every"] = 500.into();
        settings["rl"]["algorithm"] = json!({ "kind": "ppo", "clip": 0.2, "epochs": 4, "batch_size": 128 });
        settings["train"]["lr"] = 2e-3.into();
    }
    rest.iter().for_each(|arg| set(&mut settings, arg));
    let number = |key: &str| settings[key].as_u64().unwrap() as usize;
    let (seed, search) = (number("seed") as u64, number("search"));
    let config: RlConfig = serde_json::from_value(settings["rl"].clone()).unwrap();
    let value = !matches!(config.algorithm, Algorithm::Reinforce) && search == 0;
    let config = if search > 0 { RlConfig { algorithm: Algorithm::Reinforce, ..config } } else { config };
    let list = |key: &str| -> Vec<usize> { serde_json::from_value(settings[key].clone()).unwrap() };
    let net = match kind.as_str() {
        "mlp" => PolicyNetConfig::Mlp { hidden: list("hidden"), value },
        "trm3" => PolicyNetConfig::Trm { high: 64, low: 32, cycles: 3, previous_action: true, value },
        "trm5" => PolicyNetConfig::Trm { high: 64, low: 32, cycles: 5, previous_action: true, value },
        _ => {
            let [hidden, inner, cycles] = list("conv")[..] else { panic!("conv=[hidden,inner,cycles]") };
            PolicyNetConfig::Conv { channels: 3, height: 5, width: 5, hidden, inner, cycles, value }
        }
    };
    let observation = if task.walls { 75 } else { 25 };
    let train: TrainConfig = serde_json::from_value(settings["train"].clone()).unwrap();
    let train = if search > 0 {
        TrainConfig { steps: search as u64, schedule: Schedule::Cosine, ema_decay: Some(0.99), ..train }
    } else {
        train
    };
    let build = || net.build(observation, 4, seed).unwrap();
    let mut agent = Agent::new(build(), config, train, seed).unwrap();
    let parameters = agent.net().params().count();
    println!("{}", json!({ "task": name, "net": net, "parameters": parameters, "settings": settings }));
    let mazes: Vec<Walker> = {
        let mut rng = Rng::new(1, 1);
        (0..if task.walls { 1000 } else { 1 }).map(|_| task.start(Split::Test, &mut rng)).collect()
    };
    let mut rng = Rng::new(seed, 9);
    let (mut used, mut done) = (0.0, 0);
    let total = if search > 0 { search } else { number("episodes") };
    let (mut reached, mut seen) = (0, 0);
    while done < total {
        let begun = cpu_seconds();
        let before = done;
        let mut metrics = json!(null);
        if search > 0 {
            let (observations, targets) = labelled(task, number("batch"), &mut rng);
            let step = agent.imitate(&observations, &vec![0; number("batch")], &targets).unwrap();
            metrics = json!(step.loss);
            done += 1;
        } else {
            let episodes = play(&mut agent, task, number("per_update"), &mut rng);
            reached += episodes.iter().filter(|e| e.rewards.last().is_some_and(|&r| r > 5.0)).count();
            seen += episodes.len();
            done += episodes.len();
            let report = agent.update(&episodes).unwrap();
            if done / number("every") > before / number("every") {
                metrics = serde_json::to_value(report).unwrap();
            }
        }
        used += cpu_seconds() - begun;
        if done / number("every") > before / number("every") || done >= total {
            let averaged = build();
            averaged.params().load(&agent.eval_tensors().unwrap()).unwrap();
            println!(
                "{}",
                json!({ "done": done, "cpu_s": (used * 100.0).round() / 100.0,
                "greedy": task.success(averaged.as_ref(), &mazes), "last": task.success(agent.net(), &mazes),
                "sampled_reached": reached as f64 / seen.max(1) as f64, "metrics": metrics })
            );
            (reached, seen) = (0, 0);
        }
    }
}
