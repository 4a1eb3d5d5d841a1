//! ACT's and ACTRM's training steps, predictions and memory, beside LeRobot's ACT on PyTorch, in turns, in one run.
//!
//!     target/release/examples/bench_act [--peer PYTHON] [--rounds N] [--only WORD]
//!
//! prints a table and writes `target/bench/act.json`. Work on one thread is compared by CPU time (the least of all
//! rounds; a busy machine only ever adds to it), on two threads by wall time (the median). Without `--peer` only ours is
//! timed. `--only` takes a part of a row's name. ACTRM's rows stand beside our ACT, the original's plan (on LeRobot's encoder
//! and on ours), and the same model on candle's autograd.
#![allow(clippy::unwrap_used)]

mod beside;

use beside::{Bench, Cost, in_own_process, option, peak_memory, timed};
use models::actrm::{Actrm, Over, ReasoningConfig};
use models::{
    Backend, Batch, Features, LossParts, PolicyConfig, PolicyModel, Rng, Signature, TrainConfig, Trainer, act, actrm,
};
use serde_json::json;

const BATCH: usize = 64;
/// Predictions of one measurement: a few tenths of a second, as the system counts CPU time in steps of milliseconds.
fn repeats(size: &str) -> usize {
    match size {
        "d128" => 800,
        "d256" => 200,
        _ => 30,
    }
}
/// Calls of the encoder in one prediction of the original ACTRM: 16 supervision steps of 3 rounds of 6 + 1.
const ORIGINAL_CALLS: usize = 336;

/// Width, hidden width, actions.
fn sizes(size: &str) -> (usize, usize, usize) {
    match size {
        "d128" => (128, 512, 16),
        "d256" => (256, 1024, 32),
        "d512" => (512, 3200, 100),
        other => panic!("unknown size {other}: d128, d256 or d512"),
    }
}

fn act_config(size: &str) -> PolicyConfig {
    let (dim_model, dim_feedforward, action_horizon) = sizes(size);
    PolicyConfig::Act(act::Config { dim_model, dim_feedforward, action_horizon, ..Default::default() })
}

fn actrm_config(size: &str, reasoning: ReasoningConfig) -> actrm::Config {
    let (dim_model, dim_feedforward, action_horizon) = sizes(size);
    actrm::Config { dim_model, dim_feedforward, action_horizon, reasoning, ..Default::default() }
}

/// The default, made to think to its full depth.
fn full_depth() -> ReasoningConfig {
    ReasoningConfig { halt_threshold: 1.0, change_threshold: 0.0, ..ReasoningConfig::default() }
}

/// What the original does to predict: 48 rounds of 6 + 1 calls of a four-layer encoder, one decoding at the end.
fn original_plan() -> ReasoningConfig {
    let (h_cycles, l_cycles) = (48, 6);
    assert_eq!(h_cycles * (l_cycles + 1), ORIGINAL_CALLS);
    ReasoningConfig { over: Over::Memory, h_cycles, l_cycles, supervision_steps: 1, ..ReasoningConfig::original() }
}

fn signature() -> Signature {
    Signature::low_dimensional(9, 10, 7)
}

fn batch(size: &str) -> Batch {
    let mut rng = Rng::new(1, "bench");
    let h = sizes(size).2;
    let (s, e, a) = (rng.normals(BATCH * 9), rng.normals(BATCH * 10), rng.normals(BATCH * h * 7));
    Batch::from_slices(&signature(), h, &Features::of_slices(&s, &e), &a, &vec![false; BATCH * h]).unwrap()
}

fn trainer(config: &PolicyConfig, threads: usize) -> Trainer {
    let mut trainer =
        Trainer::new(config.build(&signature(), 1, &Backend::CPU).unwrap(), TrainConfig::default(), 1).unwrap();
    trainer.set_threads(threads);
    trainer
}

impl Bench {
    /// ACT beside LeRobot's.
    fn act(&mut self, size: &str, train_bar: f64) {
        for threads in [1, 2] {
            let name = format!("ACT train {size}, {threads} threads");
            if !self.wants(&name) {
                continue;
            }
            let (batch, mut trainer) = (batch(size), trainer(&act_config(size), threads));
            let order = json!({ "work": "train", "size": size, "threads": threads, "times": 1 });
            let mut peer = self.peer();
            let theirs = peer.as_mut().map(|peer| || peer.timed(&order));
            let ours = || timed(1, &mut || drop(trainer.step(&batch).unwrap()));
            self.in_turns(&name, Some(train_bar), threads > 1, ours, theirs);
        }
        let name = format!("ACT predict {size}, batch 1");
        if self.wants(&name) {
            let model = act_config(size).build(&signature(), 1, &Backend::CPU).unwrap();
            let order = json!({ "work": "predict", "size": size, "threads": 1, "times": repeats(size) });
            let mut peer = self.peer();
            let theirs = peer.as_mut().map(|peer| || peer.timed(&order));
            self.in_turns(&name, Some(0.6), false, || predictions(model.as_ref(), size, repeats(size)), theirs);
        }
    }

    /// ACTRM's predictions beside ACT's and the original's plan.
    fn actrm(&mut self, size: &str) {
        let name = format!("ACTRM predict {size} (peer: our ACT)");
        let ours = PolicyConfig::Actrm(actrm_config(size, full_depth())).build(&signature(), 1, &Backend::CPU).unwrap();
        if self.wants(&name) {
            let act = act_config(size).build(&signature(), 1, &Backend::CPU).unwrap();
            let theirs = Some(|| predictions(act.as_ref(), size, repeats(size)));
            self.in_turns(&name, Some(2.0), false, || predictions(ours.as_ref(), size, repeats(size)), theirs);
        }
        let name = format!("ACTRM predict {size} (peer: {ORIGINAL_CALLS} calls of LeRobot's encoder)");
        if self.wants(&name) {
            let order = json!({ "work": "plan", "size": size, "threads": 1, "times": 1 });
            let mut peer = self.peer();
            let theirs = peer.as_mut().map(|peer| || peer.timed(&order));
            self.in_turns(&name, Some(0.01), false, || predictions(ours.as_ref(), size, repeats(size)), theirs);
        }
        // on our own layers the plan is as fast as it can be made: what remains is what the design saves
        let name = format!("ACTRM predict {size} (peer: {ORIGINAL_CALLS} calls of our encoder)");
        if self.wants(&name) {
            let plan =
                PolicyConfig::Actrm(actrm_config(size, original_plan())).build(&signature(), 1, &Backend::CPU).unwrap();
            let theirs = Some(|| predictions(plan.as_ref(), size, 1));
            self.in_turns(&name, None, false, || predictions(ours.as_ref(), size, repeats(size)), theirs);
        }
    }

    /// The default's training step beside ACT's.
    fn actrm_beside_act(&mut self, size: &str) {
        let name = format!("ACTRM train {size}, 1 threads (peer: our ACT)");
        if !self.wants(&name) {
            return;
        }
        let batch = batch(size);
        let config = PolicyConfig::Actrm(actrm_config(size, ReasoningConfig::default()));
        let (mut ours, mut theirs) = (trainer(&config, 1), trainer(&act_config(size), 1));
        let step = |trainer: &mut Trainer| timed(1, &mut || drop(trainer.step(&batch).unwrap()));
        self.in_turns(&name, None, false, || step(&mut ours), Some(|| step(&mut theirs)));
    }

    /// Beside the same model on candle's autograd.
    fn actrm_training(&mut self, size: &str, reasoning: ReasoningConfig) {
        let over = format!("{:?}", reasoning.over).to_lowercase();
        let name = format!("ACTRM train {size} over {over}, 1 threads (peer: autograd)");
        if !self.wants(&name) {
            return;
        }
        let config = actrm_config(size, reasoning);
        let composed = Actrm::new(&config, &signature(), 1, &Backend::CPU).unwrap();
        let (batch, mut trainer) = (batch(size), trainer(&PolicyConfig::Actrm(config), 1));
        let ours = || timed(1, &mut || drop(trainer.step(&batch).unwrap()));
        // the composed model's gradients only: what the optimiser costs is in ours
        let step = || {
            let LossParts { total, .. } = composed.loss(&batch, &mut Rng::new(1, "bench")).unwrap();
            drop(total.backward().unwrap());
        };
        self.in_turns(&name, None, false, ours, Some(|| timed(1, &mut { step })));
    }

    /// Peak memory of two training steps, each side in a process of its own.
    fn memory(&mut self, size: &str) {
        let name = format!("ACT train {size}, peak memory");
        if !self.wants(&name) {
            return;
        }
        let ours = in_own_process(&["--memory-of", size]);
        let theirs = self.peer().map(|mut peer| {
            peer.ask(&json!({ "work": "train", "size": size, "threads": 2, "times": 2 }));
            peer.ask(&json!({ "work": "memory" }))["peak"].as_f64().unwrap()
        });
        self.row(&name, "MB", ours / 1e6, theirs.map(|peak| peak / 1e6), Some(1.0));
    }
}

fn predictions(model: &dyn PolicyModel, size: &str, times: usize) -> Cost {
    let batch = batch(size);
    let one = batch.observation.map(|_, t| t.narrow(0, 0, 1).unwrap().contiguous().unwrap());
    timed(times, &mut || drop(model.predict(&one).unwrap()))
}

fn main() {
    if let Some(size) = option("--memory-of") {
        let (batch, mut trainer) = (batch(&size), trainer(&act_config(&size), 2));
        (0..2).for_each(|_| drop(trainer.step(&batch).unwrap()));
        println!("{}", peak_memory());
        return;
    }
    let mut bench = Bench::new("act_torch.py", 5);
    bench.act("d256", 1.0);
    for size in ["d128", "d256", "d512"] {
        bench.actrm(size);
    }
    bench.actrm_beside_act("d256");
    bench.actrm_training("d128", ReasoningConfig::default());
    bench.actrm_training("d256", ReasoningConfig::default());
    let memory = ReasoningConfig { h_cycles: 2, l_cycles: 2, n_layers: 2, supervision_steps: 2, ..original_plan() };
    bench.actrm_training("d128", memory);
    bench.memory("d256");
    // slow: fewer rounds keep the whole within minutes
    bench.rounds = bench.rounds.min(3);
    bench.act("d512", 1.1);
    bench.memory("d512");
    bench.write("act");
}
