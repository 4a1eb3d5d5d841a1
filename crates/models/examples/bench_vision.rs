//! ACT with two cameras of 84 x 84: training step, prediction and memory, beside LeRobot's ACT on PyTorch, in turns.
//!
//!     target/release/examples/bench_vision [--peer PYTHON] [--rounds N] [--only WORD]
//!
//! prints a table and writes `target/bench/vision.json`. One thread; CPU time, the least of all rounds. Images come as
//! bytes on our side and as normalised floats on theirs. Without `--peer` only ours is timed.
#![allow(clippy::unwrap_used)]

use models::encoders::{ImageNorm, VisionConfig};
use models::{
    Backend, Batch, FeatureSpec, Features, NormMode, Normaliser, PolicyConfig, PolicyModel, Preprocess, Rng, Signature,
    TrainConfig, Trainer, ValuesRef, act,
};
use serde_json::json;
use std::io::{BufRead, BufReader, Write};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::Instant;

const CAMERAS: [&str; 2] = ["observation.images.agentview", "observation.images.robot0_eye_in_hand"];
const SIDE: usize = 84;

/// Name, width, hidden width, actions, channels of the backbone, its norm.
struct Size {
    name: &'static str,
    dim_model: usize,
    dim_feedforward: usize,
    action_horizon: usize,
    vision: VisionConfig,
}

fn size(name: &str) -> Size {
    let vision = |width, norm| VisionConfig { width, norm, ..VisionConfig::default() };
    let (name, (dim_model, dim_feedforward, action_horizon), vision) = match name {
        "narrow" => ("narrow", (128, 512, 16), vision(16, ImageNorm::Group)),
        "d256" => ("d256", (256, 1024, 32), vision(64, ImageNorm::Frozen)),
        "d512" => ("d512", (512, 3200, 100), vision(64, ImageNorm::Frozen)),
        other => panic!("unknown size {other}: narrow, d256 or d512"),
    };
    Size { name, dim_model, dim_feedforward, action_horizon, vision }
}

fn signature() -> Signature {
    let images = CAMERAS.map(|name| FeatureSpec::image(name, SIDE, SIDE));
    let observation = std::iter::once(FeatureSpec::state(9)).chain(images).collect();
    Signature { observation, action_dim: 7, ..Signature::default() }
}

impl Size {
    fn model(&self) -> Box<dyn PolicyModel> {
        let Self { dim_model, dim_feedforward, action_horizon, .. } = *self;
        let vision = Some(self.vision.clone());
        let config = act::Config { dim_model, dim_feedforward, action_horizon, vision, ..Default::default() };
        PolicyConfig::Act(config).build(&signature(), 1, &Backend::CPU).unwrap()
    }

    fn batch(&self, rows: usize) -> Batch {
        let mut rng = Rng::new(1, "bench");
        let modes = [("observation.state", NormMode::Identity), ("action", NormMode::Identity)];
        let modes = modes.map(|(name, mode)| (name.to_string(), mode)).into();
        let preprocess = Preprocess::new(
            signature(),
            Normaliser::new(&modes, &Default::default()).unwrap(),
            &candle_core::Device::Cpu,
        )
        .unwrap();
        let state = rng.normals(rows * 9);
        let images = CAMERAS.map(|_| (0..rows * SIDE * SIDE * 3).map(|_| rng.below(256) as u8).collect::<Vec<u8>>());
        let mut seen = Features::new();
        seen.insert("observation.state", ValuesRef::F32(&state));
        for (name, bytes) in CAMERAS.iter().zip(&images) {
            seen.insert(name, ValuesRef::U8(bytes));
        }
        let actions = rng.normals(rows * self.action_horizon * 7);
        preprocess.batch(self.action_horizon, &seen, &actions, &vec![false; rows * self.action_horizon]).unwrap()
    }

    fn trainer(&self) -> Trainer {
        let mut trainer = Trainer::new(self.model(), TrainConfig::default(), 1).unwrap();
        trainer.set_threads(1);
        trainer
    }
}

/// CPU time of this thread; counted in steps of the scheduler, some milliseconds.
fn thread_cpu() -> f64 {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap();
    text.split_whitespace().next().unwrap().parse::<f64>().unwrap() / 1e9
}

/// CPU seconds of one of `times` runs on this thread; says if it waited much longer than it worked.
fn timed(times: usize, work: &mut dyn FnMut()) -> f64 {
    let (wall, cpu) = (Instant::now(), thread_cpu());
    (0..times).for_each(|_| work());
    let (wall, cpu) = (wall.elapsed().as_secs_f64(), thread_cpu() - cpu);
    if wall > 3.0 * cpu {
        eprintln!("note: the machine was busy: {wall:.2} s for {cpu:.2} s of work");
    }
    cpu / times as f64
}

struct Peer {
    child: Child,
    orders: ChildStdin,
    answers: BufReader<ChildStdout>,
}

impl Peer {
    fn start(python: &str) -> Self {
        let script = concat!(env!("CARGO_MANIFEST_DIR"), "/../../benches/peers/vision_torch.py");
        let mut command = Command::new(python);
        let mut child = command.arg(script).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        let (orders, answers) = (child.stdin.take().unwrap(), BufReader::new(child.stdout.take().unwrap()));
        let mut peer = Self { child, orders, answers };
        peer.read();
        peer
    }

    fn read(&mut self) -> serde_json::Value {
        let mut line = String::new();
        self.answers.read_line(&mut line).unwrap();
        serde_json::from_str(&line).expect("the peer answers in JSON")
    }

    fn ask(&mut self, work: &str, size: &str, batch: usize, times: usize) -> serde_json::Value {
        let order = json!({ "work": work, "size": size, "batch": batch, "threads": 1, "times": times });
        writeln!(self.orders, "{order}").unwrap();
        self.read()
    }

    fn end(self) {
        let Self { mut child, orders, .. } = self;
        drop(orders);
        child.wait().unwrap();
    }
}

struct Bench {
    python: Option<String>,
    rounds: usize,
    only: String,
    rows: Vec<serde_json::Value>,
}

impl Bench {
    /// Both sides in turns, after one run of each to warm up.
    fn in_turns(&mut self, name: &str, bar: f64, order: (&str, &str, usize, usize), mut ours: impl FnMut() -> f64) {
        let (work, size, batch, times) = order;
        let mut peer = self.python.as_deref().map(Peer::start);
        let (mut best, mut theirs) = (f64::INFINITY, None);
        for round in 0..=self.rounds {
            let pair = (ours(), peer.as_mut().map(|p| p.ask(work, size, batch, times)["cpu"].as_f64().unwrap()));
            if round > 0 {
                best = best.min(pair.0);
                theirs = pair.1.map(|x| theirs.map_or(x, |least: f64| least.min(x)));
            }
        }
        peer.into_iter().for_each(Peer::end);
        self.row(&format!("{name}, CPU"), "ms", best * 1e3, theirs.map(|s| s * 1e3), bar);
    }

    fn row(&mut self, work: &str, unit: &str, ours: f64, peer: Option<f64>, bar: f64) {
        let ratio = peer.map(|peer| ours / peer);
        let met = ratio.map(|ratio| ratio <= bar);
        let verdict = met.map_or("", |met| if met { "met" } else { "MISSED" });
        let show = |value: Option<f64>| value.map_or("-".to_string(), |v| format!("{v:.2}"));
        println!(
            "{work:<64} {:>10} {:>10} {unit:<4} {:>7} {bar:>5} {verdict}",
            show(Some(ours)),
            show(peer),
            show(ratio)
        );
        self.rows.push(json!({
            "work": work, "unit": unit, "ours": ours, "peer": peer, "ratio": ratio, "bar": bar, "met": met,
        }));
    }

    fn train(&mut self, size: &Size, batch: usize, bar: f64) {
        let name = format!("ACT train {}, 2 cameras, batch {batch}", size.name);
        if name.contains(&self.only) {
            let (data, mut trainer) = (size.batch(batch), size.trainer());
            let ours = || timed(1, &mut || drop(trainer.step(&data).unwrap()));
            self.in_turns(&name, bar, ("train", size.name, batch, 1), ours);
        }
    }

    fn predict(&mut self, size: &Size, bar: f64) {
        let name = format!("ACT predict {}, 2 cameras, batch 1", size.name);
        if name.contains(&self.only) {
            let (model, times) = (size.model(), 10);
            let one = size.batch(1).observation;
            let ours = || timed(times, &mut || drop(model.predict(&one).unwrap()));
            self.in_turns(&name, bar, ("predict", size.name, 1, times), ours);
        }
    }

    /// Peak memory of two training steps, each side in a process of its own; torch's import is taken off.
    fn memory(&mut self, size: &Size, batch: usize, bar: f64) {
        let name = format!("ACT train {}, 2 cameras, batch {batch}, peak memory", size.name);
        if !name.contains(&self.only) {
            return;
        }
        let me = std::env::current_exe().unwrap();
        let output = Command::new(me).args(["--memory-of", size.name, &batch.to_string()]).output().unwrap();
        let ours: f64 = String::from_utf8(output.stdout).unwrap().trim().parse().unwrap();
        let theirs = self.python.as_deref().map(|python| {
            let mut peer = Peer::start(python);
            peer.ask("train", size.name, batch, 2);
            let answer = peer.ask("memory", size.name, batch, 1);
            peer.end();
            answer["peak"].as_f64().unwrap() - answer["import"].as_f64().unwrap()
        });
        self.row(&name, "MB", ours / 1e6, theirs.map(|peak| peak / 1e6), bar);
    }
}

/// Bytes that this process had in memory at its fullest.
fn peak_memory() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find(|line| line.starts_with("VmHWM:")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse::<f64>().unwrap() * 1024.0
}

fn main() {
    let args: Vec<String> = std::env::args().collect();
    let at = |name: &str| args.iter().position(|a| a == name);
    let option = |name: &str| at(name).and_then(|i| args.get(i + 1).cloned());
    if let Some(i) = at("--memory-of") {
        let (size, batch) = (size(&args[i + 1]), args[i + 2].parse().unwrap());
        let (data, mut trainer) = (size.batch(batch), size.trainer());
        (0..2).for_each(|_| drop(trainer.step(&data).unwrap()));
        println!("{}", peak_memory());
        return;
    }
    let rounds = option("--rounds").map_or(3, |n| n.parse().expect("--rounds takes a number"));
    let only = option("--only").unwrap_or_default();
    let mut bench = Bench { python: option("--peer"), rounds, only, rows: Vec::new() };
    println!("{:<64} {:>10} {:>10} {:<4} {:>7} {:>5}", "work", "ours", "peer", "", "ratio", "bar");
    bench.train(&size("narrow"), 64, 0.8);
    bench.train(&size("d256"), 8, 0.8);
    bench.train(&size("d256"), 64, 0.8);
    bench.train(&size("d512"), 8, 0.7);
    bench.predict(&size("d256"), 0.4);
    bench.predict(&size("d512"), 0.4);
    bench.memory(&size("narrow"), 64, 0.6);
    bench.memory(&size("d256"), 8, 0.6);
    bench.memory(&size("d512"), 8, 0.6);
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../target/bench");
    std::fs::create_dir_all(folder).unwrap();
    std::fs::write(format!("{folder}/vision.json"), serde_json::to_string_pretty(&bench.rows).unwrap()).unwrap();
}
