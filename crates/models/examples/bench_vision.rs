//! ACT with two cameras of 84 x 84: training step, prediction and memory, beside LeRobot's ACT on PyTorch, in turns.
//!
//!     target/release/examples/bench_vision [--peer PYTHON] [--rounds N] [--only WORD]
//!
//! prints a table and writes `target/bench/vision.json`. One thread; CPU time, the least of all rounds. Images come as
//! bytes on our side and as normalised floats on theirs. Without `--peer` only ours is timed.
#![allow(clippy::unwrap_used)]

mod beside;

use beside::{Bench, in_own_process, option, peak_memory, timed};
use models::encoders::{ImageNorm, VisionConfig};
use models::{
    Backend, Batch, FeatureSpec, Features, NormMode, Normaliser, PolicyConfig, PolicyModel, Preprocess, Rng, Signature,
    TrainConfig, Trainer, ValuesRef, act,
};
use serde_json::json;

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

impl Bench {
    fn train(&mut self, size: &Size, batch: usize, bar: f64) {
        let name = format!("ACT train {}, 2 cameras, batch {batch}", size.name);
        if self.wants(&name) {
            let (data, mut trainer) = (size.batch(batch), size.trainer());
            let order = json!({ "work": "train", "size": size.name, "batch": batch, "threads": 1, "times": 1 });
            let mut peer = self.peer();
            let theirs = peer.as_mut().map(|peer| || peer.timed(&order));
            let ours = || timed(1, &mut || drop(trainer.step(&data).unwrap()));
            self.in_turns(&name, Some(bar), false, ours, theirs);
        }
    }

    fn predict(&mut self, size: &Size, bar: f64) {
        let name = format!("ACT predict {}, 2 cameras, batch 1", size.name);
        if self.wants(&name) {
            let (model, times) = (size.model(), 10);
            let one = size.batch(1).observation;
            let order = json!({ "work": "predict", "size": size.name, "batch": 1, "threads": 1, "times": times });
            let mut peer = self.peer();
            let theirs = peer.as_mut().map(|peer| || peer.timed(&order));
            let ours = || timed(times, &mut || drop(model.predict(&one).unwrap()));
            self.in_turns(&name, Some(bar), false, ours, theirs);
        }
    }

    /// Peak memory of two training steps, each side in a process of its own; torch's import is taken off.
    fn memory(&mut self, size: &Size, batch: usize, bar: f64) {
        let name = format!("ACT train {}, 2 cameras, batch {batch}, peak memory", size.name);
        if !self.wants(&name) {
            return;
        }
        let ours = in_own_process(&["--memory-of", size.name, "--batch", &batch.to_string()]);
        let theirs = self.peer().map(|mut peer| {
            peer.ask(&json!({ "work": "train", "size": size.name, "batch": batch, "threads": 1, "times": 2 }));
            let answer = peer.ask(&json!({ "work": "memory" }));
            answer["peak"].as_f64().unwrap() - answer["import"].as_f64().unwrap()
        });
        self.row(&name, "MB", ours / 1e6, theirs.map(|peak| peak / 1e6), Some(bar));
    }
}

fn main() {
    if let Some(name) = option("--memory-of") {
        let (size, batch) = (size(&name), option("--batch").unwrap().parse().unwrap());
        let (data, mut trainer) = (size.batch(batch), size.trainer());
        (0..2).for_each(|_| drop(trainer.step(&data).unwrap()));
        println!("{}", peak_memory());
        return;
    }
    let mut bench = Bench::new("vision_torch.py", 3);
    bench.train(&size("narrow"), 64, 0.8);
    bench.train(&size("d256"), 8, 0.8);
    bench.train(&size("d256"), 64, 0.8);
    bench.train(&size("d512"), 8, 0.7);
    bench.predict(&size("d256"), 0.4);
    bench.predict(&size("d512"), 0.4);
    bench.memory(&size("narrow"), 64, 0.6);
    bench.memory(&size("d256"), 8, 0.6);
    bench.memory(&size("d512"), 8, 0.6);
    bench.write("vision");
}
