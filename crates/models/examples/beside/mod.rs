//! What the benchmarks of policies share: our work and a peer's on PyTorch in turns, timed alike, in one table.
#![allow(dead_code, reason = "each benchmark uses its part")]

use serde_json::{Value, json};
use std::io::{BufRead, BufReader, Write};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::Instant;

/// What follows `name` on the command line.
pub fn option(name: &str) -> Option<String> {
    std::env::args().skip_while(|arg| arg != name).nth(1)
}

/// Seconds.
#[derive(Clone, Copy)]
pub struct Cost {
    wall: f64,
    cpu: f64,
}

/// CPU time of this thread; counted in steps of the scheduler, some milliseconds.
fn thread_cpu() -> f64 {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap();
    text.split_whitespace().next().unwrap().parse::<f64>().unwrap() / 1e9
}

/// One measurement of work that runs on this thread (its CPU time would lack other threads').
pub fn timed(times: usize, work: &mut dyn FnMut()) -> Cost {
    let (wall, cpu) = (Instant::now(), thread_cpu());
    (0..times).for_each(|_| work());
    Cost { wall: wall.elapsed().as_secs_f64() / times as f64, cpu: (thread_cpu() - cpu) / times as f64 }
}

/// Bytes that this process had in memory at its fullest.
pub fn peak_memory() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find(|line| line.starts_with("VmHWM:")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse::<f64>().unwrap() * 1024.0
}

/// The number that this program prints when it is started with these arguments.
pub fn in_own_process(args: &[&str]) -> f64 {
    let output = Command::new(std::env::current_exe().unwrap()).args(args).output().unwrap();
    String::from_utf8(output.stdout).unwrap().trim().parse().unwrap()
}

/// A script of `benches/peers`, which takes orders and gives answers, a line of JSON each.
pub struct Peer {
    child: Child,
    orders: ChildStdin,
    answers: BufReader<ChildStdout>,
}

impl Peer {
    fn start(python: &str, script: &str) -> Self {
        let script = format!("{}/../../benches/peers/{script}", env!("CARGO_MANIFEST_DIR"));
        let mut command = Command::new(python);
        let mut child = command.arg(script).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        let (orders, answers) = (child.stdin.take().unwrap(), BufReader::new(child.stdout.take().unwrap()));
        let mut peer = Self { child, orders, answers };
        peer.read();
        peer
    }

    fn read(&mut self) -> Value {
        loop {
            let mut line = String::new();
            assert!(self.answers.read_line(&mut line).unwrap() > 0, "the peer has ended");
            // libraries print while they are imported
            if line.starts_with('{') {
                return serde_json::from_str(&line).expect("the peer answers in JSON");
            }
        }
    }

    /// The answer to an order.
    pub fn ask(&mut self, order: &Value) -> Value {
        writeln!(self.orders, "{order}").unwrap();
        self.read()
    }

    /// One measurement.
    pub fn timed(&mut self, order: &Value) -> Cost {
        let answer = self.ask(order);
        Cost { wall: answer["wall"].as_f64().unwrap(), cpu: answer["cpu"].as_f64().unwrap() }
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        drop(self.child.kill());
        drop(self.child.wait());
    }
}

/// A benchmark under way.
pub struct Bench {
    python: Option<String>,
    script: &'static str,
    /// Measurements of each side.
    pub rounds: usize,
    only: String,
    rows: Vec<Value>,
}

impl Bench {
    /// As the command line says, beside this script; prints the head of the table.
    pub fn new(script: &'static str, rounds: usize) -> Self {
        let rounds = option("--rounds").map_or(rounds, |n| n.parse().expect("--rounds takes a number"));
        println!("{:<72} {:>10} {:>10} {:<4} {:>7} {:>5}", "work", "ours", "peer", "", "ratio", "bar");
        let only = option("--only").unwrap_or_default();
        Self { python: option("--peer"), script, rounds, only, rows: Vec::new() }
    }

    /// Whether this row was asked for.
    pub fn wants(&self, name: &str) -> bool {
        name.contains(&self.only)
    }

    /// A new process of the peer, if there is one.
    pub fn peer(&self) -> Option<Peer> {
        self.python.as_deref().map(|python| Peer::start(python, self.script))
    }

    /// Both sides in turns, after one run of each to warm up.
    pub fn in_turns(
        &mut self,
        name: &str,
        bar: Option<f64>,
        by_wall: bool,
        mut ours: impl FnMut() -> Cost,
        mut theirs: Option<impl FnMut() -> Cost>,
    ) {
        let mut costs = [Vec::new(), Vec::new()];
        for round in 0..=self.rounds {
            let pair = [Some(ours()), theirs.as_mut().map(|theirs| theirs())];
            for (all, cost) in costs.iter_mut().zip(pair).filter(|_| round > 0) {
                all.extend(cost);
            }
        }
        let pick = |costs: &[Cost]| {
            let mut values: Vec<f64> = costs.iter().map(|c| if by_wall { c.wall } else { c.cpu }).collect();
            values.sort_by(f64::total_cmp);
            values.get(if by_wall { values.len() / 2 } else { 0 }).map(|s| s * 1e3)
        };
        let name = format!("{name}, {}", if by_wall { "wall" } else { "CPU" });
        self.row(&name, "ms", pick(&costs[0]).unwrap(), pick(&costs[1]), bar);
    }

    /// A row of the table.
    pub fn row(&mut self, work: &str, unit: &str, ours: f64, peer: Option<f64>, bar: Option<f64>) {
        let ratio = peer.map(|peer| ours / peer);
        let met = ratio.zip(bar).map(|(ratio, bar)| ratio <= bar);
        let verdict = match met {
            Some(true) => "met",
            Some(false) => "MISSED",
            None => "",
        };
        let show = |value: Option<f64>, digits: usize| value.map_or("-".to_string(), |v| format!("{v:.digits$}"));
        println!(
            "{work:<72} {:>10} {:>10} {unit:<4} {:>7} {:>5} {verdict}",
            show(Some(ours), 2),
            show(peer, 2),
            show(ratio, 4),
            show(bar, 2)
        );
        self.rows.push(json!({
            "work": work, "unit": unit, "ours": ours, "peer": peer, "ratio": ratio, "bar": bar, "met": met,
        }));
    }

    /// All rows as `target/bench/<name>.json`.
    pub fn write(&self, name: &str) {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../target/bench");
        std::fs::create_dir_all(folder).unwrap();
        std::fs::write(format!("{folder}/{name}.json"), serde_json::to_string_pretty(&self.rows).unwrap()).unwrap();
    }
}
