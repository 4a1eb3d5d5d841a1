//! Training steps and predictions of diffusion, BC-RNN and BC-Transformer beside LeRobot and robomimic on PyTorch, in turns,
//! in one run.
//!
//!     target/release/examples/bench_policies [--peer PYTHON] [--rounds N] [--only WORD]
//!
//! prints a table and writes `target/bench/policies.json`. Work on one thread, by CPU time: the least of all rounds, as a busy
//! machine only ever adds to it. Start it with `RAYON_NUM_THREADS=1`. Without `--peer` only ours is timed. `--only` takes a
//! part of a row's name.
#![allow(clippy::unwrap_used)]

mod beside;

use beside::{Bench, timed};
use models::{Backend, Batch, Features, PolicyConfig, Rng, Signature, TrainConfig, Trainer};
use serde_json::json;

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

fn main() {
    let mut bench = Bench::new("policies_torch.py", 5);
    let mut peer = bench.peer();
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
            let name = format!("{policy} {work}{}, 1 thread", if work == "train" { " batch 64" } else { " batch 1" });
            if !bench.wants(&name) {
                continue;
            }
            let mut step = || match work {
                "train" => drop(trainer.step(&batch).unwrap()),
                _ => drop(model.sample(&one, &mut Rng::new(1, "policy")).unwrap()),
            };
            let order = json!({ "policy": policy, "work": work, "times": times });
            let theirs = peer.as_mut().map(|peer| || peer.timed(&order));
            bench.in_turns(&name, bar, false, || timed(times, &mut step), theirs);
        }
    }
    bench.write("policies");
}
