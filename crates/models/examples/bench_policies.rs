//! Training steps and predictions of diffusion, BC-RNN and BC-Transformer beside LeRobot and robomimic on PyTorch, in turns,
//! in one run.
//!
//!     target/release/examples/bench_policies [--peer PYTHON] [--rounds N] [--only WORD]
//!
//! prints a table and writes `target/bench/policies.json`. Work on one thread, by CPU time: the least of all rounds, as a busy
//! machine only ever adds to it. Start it with `RAYON_NUM_THREADS=1`. Without `--peer` only ours is timed. `--only` takes a
//! part of a row's name.
#![allow(clippy::unwrap_used)]

use models::{Backend, Batch, Features, PolicyConfig, Rng, Signature, TrainConfig, Trainer};
use serde_json::json;
use std::io::{BufRead, BufReader, Write};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::Instant;

const BATCH: usize = 64;

/// Name, options, observations seen at once, and what is timed: work, repetitions, bar.
type Policy = (&'static str, serde_json::Value, usize, Vec<(&'static str, usize, Option<f64>)>);

fn policies() -> Vec<Policy> {
    let network = json!({"down_dims": [64, 128], "step_embed_dim": 64});
    let train = ("train", 3, Some(1.0));
    vec![
        ("diffusion", json!({"network": network}), 2, vec![train, ("predict", 30, Some(0.5))]),
        ("bc_rnn", json!({}), 10, vec![train]),
        ("bc_transformer", json!({"dim_model": 128, "n_layers": 4}), 10, vec![train, ("predict", 100, None)]),
    ]
}

/// CPU time of this thread; counted in steps of the scheduler, some milliseconds.
fn thread_cpu() -> f64 {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap();
    text.split_whitespace().next().unwrap().parse::<f64>().unwrap() / 1e9
}

/// Seconds of CPU and of wall for one repetition.
fn timed(times: usize, work: &mut dyn FnMut()) -> (f64, f64) {
    let (wall, cpu) = (Instant::now(), thread_cpu());
    (0..times).for_each(|_| work());
    ((thread_cpu() - cpu) / times as f64, wall.elapsed().as_secs_f64() / times as f64)
}

struct Peer {
    child: Child,
    orders: ChildStdin,
    answers: BufReader<ChildStdout>,
}

impl Peer {
    fn start(python: &str) -> Self {
        let script = concat!(env!("CARGO_MANIFEST_DIR"), "/../../benches/peers/policies_torch.py");
        let mut command = Command::new(python);
        let mut child = command.arg(script).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        let (orders, answers) = (child.stdin.take().unwrap(), BufReader::new(child.stdout.take().unwrap()));
        let mut peer = Self { child, orders, answers };
        peer.read();
        peer
    }

    fn read(&mut self) -> serde_json::Value {
        loop {
            let mut line = String::new();
            assert!(self.answers.read_line(&mut line).unwrap() > 0, "the peer has ended");
            // libraries print while they are imported
            if line.starts_with('{') {
                return serde_json::from_str(&line).expect("the peer answers in JSON");
            }
        }
    }

    fn timed(&mut self, policy: &str, work: &str, times: usize) -> f64 {
        writeln!(self.orders, "{}", json!({ "policy": policy, "work": work, "times": times })).unwrap();
        self.read()["cpu"].as_f64().unwrap()
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        drop(self.child.kill());
        drop(self.child.wait());
    }
}

fn main() {
    let args: Vec<String> = std::env::args().collect();
    let option = |name: &str| args.iter().position(|a| a == name).and_then(|i| args.get(i + 1).cloned());
    let rounds: usize = option("--rounds").map_or(5, |n| n.parse().expect("--rounds takes a number"));
    let only = option("--only").unwrap_or_default();
    let mut peer = option("--peer").map(|python| Peer::start(&python));
    let mut rows = Vec::new();
    println!("{:<56} {:>10} {:>10} {:<4} {:>7} {:>5}", "work", "ours", "peer", "", "ratio", "bar");
    for (policy, mut keys, n_obs_steps, works) in policies() {
        keys["type"] = policy.into();
        let config: PolicyConfig = serde_json::from_value(keys).unwrap();
        let signature = Signature { n_obs_steps, ..Signature::low_dimensional(9, 10, 7) };
        let mut rng = Rng::new(1, "bench");
        let horizon = config.action_horizon();
        let (s, e) = (rng.normals(BATCH * n_obs_steps * 9), rng.normals(BATCH * n_obs_steps * 10));
        let a: Vec<f32> = (0..BATCH * horizon * 7).map(|_| 2.0 * rng.uniform() - 1.0).collect();
        let pad = vec![false; BATCH * horizon];
        let batch = Batch::from_slices(&signature, horizon, &Features::of_slices(&s, &e), &a, &pad).unwrap();
        let mut trainer =
            Trainer::new(config.build(&signature, 1, &Backend::CPU).unwrap(), TrainConfig::default(), 1).unwrap();
        trainer.set_threads(1);
        let model = config.build(&signature, 1, &Backend::CPU).unwrap();
        let one = batch.observation.map(|_, t| t.narrow(0, 0, 1).unwrap().contiguous().unwrap());
        for (work, times, bar) in works {
            let name =
                format!("{policy} {work}{}, 1 thread, CPU", if work == "train" { " batch 64" } else { " batch 1" });
            if !name.contains(&only) {
                continue;
            }
            let mut step = || match work {
                "train" => drop(trainer.step(&batch).unwrap()),
                _ => drop(model.sample(&one, &mut Rng::new(1, "policy")).unwrap()),
            };
            let (mut ours, mut theirs) = (Vec::new(), Vec::new());
            for round in 0..=rounds {
                let (own, other) = (timed(times, &mut step).0, peer.as_mut().map(|p| p.timed(policy, work, times)));
                if round > 0 {
                    ours.push(own);
                    theirs.extend(other);
                }
            }
            let least = |costs: &[f64]| costs.iter().copied().reduce(f64::min).map(|seconds| seconds * 1e3);
            let (ours, theirs) = (least(&ours).unwrap(), least(&theirs));
            let ratio = theirs.map(|theirs| ours / theirs);
            let met = ratio.zip(bar).map(|(ratio, bar)| ratio <= bar);
            let show = |value: Option<f64>, digits: usize| value.map_or("-".to_string(), |v| format!("{v:.digits$}"));
            let verdict = met.map_or("", |met| if met { "met" } else { "MISSED" });
            println!(
                "{name:<56} {ours:>10.2} {:>10} ms   {:>7} {:>5} {verdict}",
                show(theirs, 2),
                show(ratio, 4),
                show(bar, 2)
            );
            rows.push(json!({
                "work": name, "unit": "ms", "ours": ours, "peer": theirs, "ratio": ratio, "bar": bar, "met": met,
            }));
        }
    }
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../target/bench");
    std::fs::create_dir_all(folder).unwrap();
    std::fs::write(format!("{folder}/policies.json"), serde_json::to_string_pretty(&rows).unwrap()).unwrap();
}
