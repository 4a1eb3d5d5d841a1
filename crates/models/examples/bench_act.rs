//! ACT's training step and batch-1 prediction beside LeRobot's on PyTorch, in turns, in one run.
//!
//!     cargo run --release -p models --example bench_act -- [--peer PYTHON] [--rounds N] [--sizes d256,d512]
//!
//! prints a table and writes `target/bench/act.json`. Two ratios each: wall time with two threads on both sides, and
//! process CPU time with PyTorch on one thread (which a busy machine disturbs less). Without `--peer` only ours is timed.
#![allow(clippy::unwrap_used)]

use models::{Batch, Dims, PolicyConfig, Rng, TrainConfig, Trainer, act};
use std::io::{BufRead, BufReader, Write};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::Instant;

const DIMS: Dims = Dims { state: 9, environment_state: 10, action: 7 };
const BATCH: usize = 64;

fn config(size: &str) -> act::Config {
    let (dim_model, dim_feedforward, action_horizon) = match size {
        "d128" => (128, 512, 16),
        "d256" => (256, 1024, 32),
        "d512" => (512, 3200, 100),
        other => panic!("unknown size {other}: d128, d256 or d512"),
    };
    act::Config { dim_model, dim_feedforward, action_horizon, ..Default::default() }
}

/// Seconds of CPU that this process has used, all threads.
fn cpu_seconds() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap();
    let fields: Vec<&str> = stat.rsplit_once(')').unwrap().1.split_whitespace().collect();
    (fields[11].parse::<f64>().unwrap() + fields[12].parse::<f64>().unwrap()) / 100.0
}

fn timed(times: usize, mut f: impl FnMut()) -> (f64, f64) {
    let (wall, cpu) = (Instant::now(), cpu_seconds());
    (0..times).for_each(|_| f());
    (wall.elapsed().as_secs_f64() / times as f64, (cpu_seconds() - cpu) / times as f64)
}

struct Peer {
    child: Child,
    orders: ChildStdin,
    answers: BufReader<ChildStdout>,
}

impl Peer {
    fn start(python: &str) -> Self {
        let script = concat!(env!("CARGO_MANIFEST_DIR"), "/../../benches/peers/act_torch.py");
        let mut child = Command::new(python)
            .arg(script)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("the peer's Python starts");
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

    fn ask(&mut self, work: &str, size: &str, threads: usize, times: usize) -> (f64, f64) {
        let order = serde_json::json!({ "work": work, "size": size, "threads": threads, "times": times });
        writeln!(self.orders, "{order}").unwrap();
        let answer = self.read();
        (answer["wall"].as_f64().unwrap(), answer["cpu"].as_f64().unwrap())
    }
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn least(values: &[f64]) -> f64 {
    values.iter().copied().fold(f64::INFINITY, f64::min)
}

fn main() {
    let args: Vec<String> = std::env::args().collect();
    let option = |name: &str| args.iter().position(|a| a == name).and_then(|i| args.get(i + 1).cloned());
    let rounds: usize = option("--rounds").map_or(5, |n| n.parse().expect("--rounds takes a number"));
    let sizes = option("--sizes").unwrap_or("d256,d512".to_string());
    let mut peer = option("--peer").map(|python| Peer::start(&python));
    let mut rows = Vec::new();
    println!("{:<28} {:>12} {:>12} {:>7} {:>6}", "work", "ours", "peer", "ratio", "bar");
    for size in sizes.split(',') {
        let config = config(size);
        let policy = PolicyConfig::Act(config.clone());
        let mut trainer = Trainer::new(policy.build(&DIMS, 1).unwrap(), TrainConfig::default(), 1).unwrap();
        let mut rng = Rng::new(1, "bench");
        let h = config.action_horizon;
        let (s, e, a) = (rng.normals(BATCH * 9), rng.normals(BATCH * 10), rng.normals(BATCH * h * 7));
        let batch = Batch::from_slices(&DIMS, h, &s, &e, &a, &vec![false; BATCH * h]).unwrap();
        let (state, env) =
            (batch.state.narrow(0, 0, 1).unwrap(), batch.environment_state.as_ref().unwrap().narrow(0, 0, 1).unwrap());
        for (work, bar, times) in [("train", if size == "d512" { 1.1 } else { 1.0 }, 1), ("predict", 0.6, 30)] {
            let ours = |trainer: &mut Trainer| match work {
                "train" => timed(times, || drop(trainer.step(&batch).unwrap())),
                _ => timed(times, || drop(trainer.model().predict(&state, Some(&env)).unwrap())),
            };
            ours(&mut trainer);
            if let Some(peer) = &mut peer {
                peer.ask(work, size, 2, times);
            }
            let [mut wall, mut cpu, mut peer_wall, mut peer_cpu] = [const { Vec::new() }; 4];
            for _ in 0..rounds {
                let (w, c) = ours(&mut trainer);
                wall.push(w);
                cpu.push(c);
                if let Some(peer) = &mut peer {
                    // a prediction runs on one thread
                    peer_wall.push(peer.ask(work, size, if work == "train" { 2 } else { 1 }, times).0);
                    peer_cpu.push(peer.ask(work, size, 1, times).1);
                }
            }
            for (kind, mine, theirs) in [("wall", &mut wall, &mut peer_wall), ("cpu", &mut cpu, &mut peer_cpu)] {
                // CPU time is only ever disturbed upwards
                let pick = |v: &mut Vec<f64>| if kind == "cpu" { least(v) } else { median(v) };
                let (mine, theirs) = (pick(mine), if theirs.is_empty() { f64::NAN } else { pick(theirs) });
                let (name, ratio) = (format!("ACT {work} {size} ({kind})"), mine / theirs);
                println!("{name:<28} {:>9.2} ms {:>9.2} ms {ratio:>7.2} {bar:>6.2}", mine * 1e3, theirs * 1e3);
                rows.push(
                    serde_json::json!({ "work": name, "ours_s": mine, "peer_s": theirs, "ratio": ratio, "bar": bar }),
                );
            }
        }
    }
    if let Some(mut peer) = peer {
        drop(peer.orders);
        peer.child.wait().unwrap();
    }
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../target/bench");
    std::fs::create_dir_all(folder).unwrap();
    std::fs::write(format!("{folder}/act.json"), serde_json::to_string_pretty(&rows).unwrap()).unwrap();
}
