//! One TRM supervision step (forward, loss, backward) beside PyTorch, in turns, in one run.
//!
//!     target/release/examples/bench_trm [--peer PYTHON] [--rounds N] [--mixings attention,mlp_t,conv]
//!
//! prints a table and writes `target/bench/trm.json`. The shapes are hidden 64, 2 layers, 81 positions, batch 64, 3 rounds
//! of 6 cycles, f32; both sides run as processes of their own. Two ratios each: process CPU time with one thread (which a
//! busy machine disturbs less), and wall time with two. Attention and `mlp_t` are the official model; `conv` is our mixing
//! on both sides. Without `--peer` only ours is timed.
#![allow(clippy::unwrap_used, clippy::print_stdout)]

use candle_core::{DType, Device, Tensor};
use models::classification::{ClassProbability, binary_cross_entropy, cross_entropy};
use solvers::trm::{Config, Gradient, Mixing, Positions, Trm};
use std::process::Command;
use std::time::Instant;

/// The bar: our time as a share of PyTorch's.
const BAR: f64 = 0.8;

/// Seconds of CPU that this process has used, all threads.
fn cpu_seconds() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap();
    let fields: Vec<&str> = stat.rsplit_once(')').unwrap().1.split_whitespace().collect();
    (fields[11].parse::<f64>().unwrap() + fields[12].parse::<f64>().unwrap()) / 100.0
}

fn config(mixing: &str) -> Config {
    let base = Config { num_heads: 8, ..Config::new(11, 81, 64) };
    match mixing {
        "attention" => base,
        "mlp_t" => Config { mixing: Mixing::MlpT, positions: Positions::None, ..base },
        "conv" => Config { mixing: Mixing::Conv, positions: Positions::None, grid: Some([9, 9]), ..base },
        other => panic!("unknown mixing {other}: attention, mlp_t or conv"),
    }
}

/// Times `repeats` steps after one that is not counted; prints what the peer's script prints.
fn ours(mixing: &str, repeats: usize) {
    let (batch, len, vocab) = (64, 81, 11);
    let model = Trm::new(config(mixing), 0).unwrap();
    let tokens: Vec<u32> = (0..batch * len).map(|i| (i * 7 % vocab) as u32).collect();
    let labels: Vec<i64> = tokens.iter().map(|t| i64::from((t + 3) % vocab as u32)).collect();
    let inputs = Tensor::from_vec(tokens, (batch, len), &Device::Cpu).unwrap();
    let carry = model.initial_carry(batch).unwrap();
    let targets = Tensor::zeros(batch, DType::F32, &Device::Cpu).unwrap();
    let (mut seconds, mut cpu) = (Vec::new(), Vec::new());
    for repeat in 0..=repeats {
        let begun = (Instant::now(), cpu_seconds());
        let out = model.supervision_step(&carry, &inputs, None, Gradient::On).unwrap();
        let flat = out.logits.reshape((batch * len, vocab)).unwrap();
        let class = cross_entropy(&flat, &labels, ClassProbability::Stablemax).unwrap().mean_all().unwrap();
        let halt = binary_cross_entropy(&out.q_halt, &targets).unwrap().mean_all().unwrap();
        let loss = (class.to_dtype(DType::F32).unwrap() + (halt * 0.5).unwrap()).unwrap();
        let grads = loss.backward().unwrap();
        assert!(model.params().iter().all(|(_, var)| grads.get(var).is_some()));
        if repeat > 0 {
            seconds.push(begun.0.elapsed().as_secs_f64());
            cpu.push(cpu_seconds() - begun.1);
        }
    }
    seconds.sort_by(f64::total_cmp);
    cpu.sort_by(f64::total_cmp);
    let report = serde_json::json!({ "work": "trm supervision step", "mixing": mixing,
        "threads": candle_core::utils::get_num_threads(), "batch": batch, "wall_min": seconds[0],
        "wall_median": seconds[seconds.len() / 2], "cpu_min": cpu[0] });
    println!("{report}");
}

/// Runs a command that prints one line of JSON.
fn timed(command: &mut Command) -> serde_json::Value {
    let output = command.output().expect("the program starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).unwrap();
    serde_json::from_str(text.trim().lines().last().expect("a line")).unwrap()
}

fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    if let [flag, mixing, repeats] = args.as_slice()
        && flag == "--one"
    {
        return ours(mixing, repeats.parse().unwrap());
    }
    let value = |flag: &str| args.iter().position(|arg| arg == flag).map(|i| args[i + 1].clone());
    let peer = value("--peer");
    let rounds: usize = value("--rounds").map_or(3, |n| n.parse().unwrap());
    let mixings = value("--mixings").unwrap_or_else(|| "attention,mlp_t,conv".into());
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/../../benches/peers/trm_torch_replica.py");
    let repeats = "3";
    let mut rows = Vec::new();
    println!("{:<34} {:>12} {:>12} {:>7} {:>6}", "work", "ours", "PyTorch", "ratio", "bar");
    for mixing in mixings.split(',') {
        for (threads, kind) in [("1", "cpu"), ("2", "wall")] {
            let least = format!("{kind}_min");
            // the smallest of all rounds: a busy machine only ever adds
            let (mut mine, mut theirs) = (f64::INFINITY, f64::INFINITY);
            for _ in 0..rounds {
                let mut own = Command::new(std::env::current_exe().unwrap());
                let line = timed(own.env("RAYON_NUM_THREADS", threads).args(["--one", mixing, repeats]));
                mine = mine.min(line[&least].as_f64().unwrap());
                if let Some(python) = &peer {
                    let mut other = Command::new(python);
                    other.args([script, "--threads", threads, "--mixing", mixing, "--repeats", repeats]);
                    theirs = theirs.min(timed(&mut other)[&least].as_f64().unwrap());
                }
            }
            let theirs = if theirs.is_finite() { theirs } else { f64::NAN };
            let (name, ratio) = (format!("TRM step {mixing}, {threads} threads ({kind})"), mine / theirs);
            println!("{name:<34} {:>9.1} ms {:>9.1} ms {ratio:>7.2} {BAR:>6.2}", mine * 1e3, theirs * 1e3);
            rows.push(
                serde_json::json!({ "work": name, "ours_s": mine, "peer_s": theirs, "ratio": ratio, "bar": BAR }),
            );
        }
    }
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../target/bench");
    std::fs::create_dir_all(folder).unwrap();
    std::fs::write(format!("{folder}/trm.json"), serde_json::to_string_pretty(&rows).unwrap()).unwrap();
}
