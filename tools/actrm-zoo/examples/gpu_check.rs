//! Whether a GPU gives what the CPU gives, for every policy, and what a training step takes beside LeRobot on the same GPU.
//!
//!     target/cuda/release/examples/gpu_check --device cuda [--peer PYTHON] [--rounds N] [--out FILE]
//!
//! prints a table and writes FILE (target/bench/gpu.json). The exit status is 1 if a policy is further off than 1e-4.
//! `--device cpu` rehearses it with candle's operations on the CPU; `--rounds 0` times nothing. PYTHON has PyTorch and LeRobot.
#![allow(clippy::unwrap_used)]

use std::process::{Command, ExitCode};
use std::sync::Arc;
use std::time::Instant;

use candle_core::Tensor;
use models::{
    Backend, Batch, DeviceChoice, FeatureKind, FeatureSpec, Gradients, Number, Optimiser, OptimiserConfig, ParamLayout,
    PolicyConfig, PolicyModel, Precision, Rng, Signature, TrainConfig, Trainer, cases,
};
use serde_json::{Value, json};

/// Of outputs and gradients, relative to the largest number of the tensor.
const TOLERANCE: f64 = 1e-4;
/// Optimiser steps that are compared.
const STEPS: u64 = 20;
/// Frames that batches are gathered from.
const FRAMES: usize = 2000;

/// Sets dropout to 0: a GPU draws masks of its own.
fn without_dropout(value: &mut Value) {
    if let Value::Object(map) = value {
        for (key, value) in map {
            match key == "dropout" || key.ends_with("_dropout") {
                true => *value = json!(0.0),
                false => without_dropout(value),
            }
        }
    }
}

/// The largest difference, relative to the largest number that is expected or, where that is smaller, to `least`.
fn apart(got: &[f32], want: &[f32], least: f64) -> f64 {
    assert_eq!(got.len(), want.len());
    let scale = least.max(largest(want));
    got.iter().zip(want).fold(0.0, |off, (a, b)| f64::max(off, f64::from((a - b).abs()) / scale))
}

fn largest(of: &[f32]) -> f64 {
    of.iter().fold(0.0, |largest, x| largest.max(f64::from(x.abs())))
}

/// What one backend makes of a policy: a prediction, the gradients of its parameters, the losses of some steps.
struct Found {
    output: Vec<f32>,
    gradients: Vec<Vec<f32>>,
    losses: Vec<f32>,
}

fn found(policy: &PolicyConfig, signature: &Signature, backend: &Backend) -> Found {
    let model = policy.build(signature, 1, backend).unwrap();
    let batch = cases::batch(signature, policy.action_horizon(), 6, 3).to_device(backend.device()).unwrap();
    let output = model.sample(&batch.observation, &mut Rng::new(1, "sample")).unwrap();
    let layout = Arc::new(ParamLayout::new(model.params()));
    let (mut gradients, mut losses) = (Vec::new(), Vec::new());
    let config = OptimiserConfig::default();
    let (mut optimiser, mut grads) =
        (Optimiser::new(config, layout.clone()).unwrap(), Gradients::zeros(layout.clone()).unwrap());
    for step in 0..STEPS {
        grads.clear().unwrap();
        let loss = model.accumulate_gradients(&batch, &mut Rng::new(step, "step"), &mut grads).unwrap();
        losses.push(loss.read().unwrap().total);
        if step == 0 {
            let all = grads.read().unwrap();
            gradients = layout.iter().map(|(_, span)| all[span].to_vec()).collect();
        }
        optimiser.step(model.params(), &grads, &Number::Here(1.0), 1e-3).unwrap();
    }
    Found { output: output.flatten_all().unwrap().to_vec1().unwrap(), gradients, losses }
}

/// Every policy on the device beside hand-written kernels.
fn parity(backend: &Backend) -> Vec<Value> {
    let mut rows = Vec::new();
    println!("{:<44} {:>10} {:>10} {:>10}", "policy", "outputs", "gradients", "20 steps");
    for (policy, signature) in cases::policies() {
        let mut config = serde_json::to_value(&policy).unwrap();
        without_dropout(&mut config);
        let policy: PolicyConfig = serde_json::from_value(config).unwrap();
        let [want, got] = [&Backend::CPU, backend].map(|backend| found(&policy, &signature, backend));
        let outputs = apart(&got.output, &want.output, 1e-3);
        // some gradients are zero but for rounding, such as those of a bias before a norm
        let least = 0.01 * want.gradients.iter().fold(0.0, |most, grad| f64::max(most, largest(grad)));
        let each = got.gradients.iter().zip(&want.gradients).map(|(got, want)| apart(got, want, least));
        let gradients = each.fold(0.0, f64::max);
        let losses = apart(&got.losses, &want.losses, 1e-3);
        let features: Vec<&str> = signature.observation.iter().map(|spec| spec.kind.name()).collect();
        let name = format!("{} on {} features", policy.policy_type(), features.len());
        let met = outputs <= TOLERANCE && gradients <= TOLERANCE;
        let verdict = if met { "" } else { "MISSED" };
        println!("{name:<44} {outputs:>10.1e} {gradients:>10.1e} {losses:>10.1e} {verdict}");
        rows.push(json!({
            "policy": policy.policy_type().to_string(), "features": features, "outputs": outputs,
            "gradients": gradients, "losses_of_20_steps": losses, "met": met,
        }));
    }
    rows
}

/// Name, policy, what it sees, windows a step; the name is that of the peer's work.
fn works() -> Vec<(&'static str, Value, Signature, usize)> {
    let mut images = Signature::low_dimensional(9, 0, 7);
    images.observation.extend(["front", "wrist"].map(|name| FeatureSpec::image(name, 224, 224)));
    let mut denoised = Signature { n_obs_steps: 2, ..Signature::low_dimensional(9, 0, 7) };
    denoised.observation.push(FeatureSpec::image("front", 96, 96));
    let act = json!({"type": "act", "action_horizon": 32, "dim_model": 256, "dim_feedforward": 1024});
    let mut seeing = act.clone();
    seeing["vision"] = json!({"width": 64, "blocks": [2, 2, 2, 2], "norm": "frozen", "shift": 0, "jitter": 0.0});
    let unet = json!({"down_dims": [512, 1024, 2048], "n_groups": 8, "step_embed_dim": 128});
    let vision = json!({"width": 64, "blocks": [2, 2, 2, 2], "crop": 84, "shift": 0, "jitter": 0.0,
        "tokens": {"keypoints": {"count": 32}}});
    let diffusion = json!({"type": "diffusion", "action_horizon": 16, "network": unet, "vision": vision});
    vec![
        ("act_d256", act, Signature::low_dimensional(9, 10, 7), 64),
        ("act_images", seeing, images, 32),
        ("diffusion_images", diffusion, denoised, 64),
    ]
}

/// Batches like this one, whose images are gathered on the device from [`FRAMES`] frames, as a training does it.
fn gathering(signature: &Signature, batch: &Batch) -> impl FnMut() -> Batch {
    let images = signature.of_kind(FeatureKind::Image).map(|spec| {
        let (frames, device) = (batch.observation.get(&spec.name).unwrap(), batch.device());
        let size = spec.width();
        let flat = frames.reshape((frames.elem_count() / size, size)).unwrap();
        let copies = FRAMES / flat.dim(0).unwrap();
        let all = Tensor::cat(&vec![flat; copies], 0).unwrap().to_device(device).unwrap();
        (spec.name.clone(), all, frames.dims().to_vec())
    });
    let (images, batch) = (images.collect::<Vec<_>>(), batch.clone());
    let mut rng = Rng::new(1, "gathering");
    move || {
        let mut batch = batch.clone();
        for (name, all, shape) in &images {
            let (frames, size) = all.dims2().unwrap();
            let count = shape.iter().product::<usize>() / size;
            let places: Vec<u32> = (0..count).map(|_| rng.below(frames as u64) as u32).collect();
            let places = Tensor::from_vec(places, count, all.device()).unwrap();
            batch.observation.insert(name, all.index_select(&places, 0).unwrap().reshape(shape.as_slice()).unwrap());
        }
        batch
    }
}

/// Milliseconds of a training step: the least of all rounds.
fn step_ms(trainer: &mut Trainer, batch: &mut dyn FnMut() -> Batch, (rounds, steps): (usize, usize)) -> f64 {
    let mut run = |steps: usize| {
        let begun = Instant::now();
        let mut last = None;
        for _ in 0..steps {
            let batch = batch();
            last = Some((trainer.step_ahead(&batch, false).unwrap(), batch));
        }
        let (numbers, batch) = last.unwrap();
        trainer.read(&numbers, &batch).unwrap();
        begun.elapsed().as_secs_f64() * 1e3 / steps as f64
    };
    run(steps.min(3));
    (0..rounds).map(|_| run(steps)).fold(f64::INFINITY, f64::min)
}

/// What the peer says of the same work.
fn peer(
    python: &str,
    device: DeviceChoice,
    (work, precision): (&str, &str),
    (rounds, steps): (usize, usize),
) -> Option<Value> {
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/../../benches/peers/gpu_torch.py");
    let device = if device == DeviceChoice::Cpu { "cpu" } else { "cuda" };
    let (rounds, steps) = (rounds.to_string(), steps.to_string());
    let output = Command::new(python).args([script, device, work, precision, &rounds, &steps]).output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let answer = text.lines().rev().find_map(|line| serde_json::from_str::<Value>(line).ok());
    if answer.is_none() {
        eprintln!("the peer gave no time for {work}:\n{}", String::from_utf8_lossy(&output.stderr));
    }
    answer
}

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().collect();
    let option = |name: &str| args.iter().position(|a| a == name).and_then(|i| args.get(i + 1).cloned());
    let device: DeviceChoice = option("--device").map_or(DeviceChoice::Auto, |text| text.parse().unwrap());
    let rounds = option("--rounds").map_or(5, |n| n.parse().expect("--rounds takes a number"));
    let opened = device.open().unwrap();
    let (gpu, backend) = (opened.backend.gpu(), opened.backend);
    // on the CPU candle's operations are rehearsed, not the kernels that they are compared with
    let backend = if gpu.is_none() { Backend::composed(backend.device().clone()) } else { backend };
    println!("{}\n", gpu.as_deref().unwrap_or("no GPU: candle's operations on the CPU"));
    let parity = parity(&backend);
    let steps = if gpu.is_some() { 30 } else { 1 };
    let precisions: &[Precision] =
        if gpu.is_some() { &[Precision::F32, Precision::Tf32, Precision::Bf16] } else { &[Precision::F32] };
    let mut speed = Vec::new();
    let works = if rounds == 0 { Vec::new() } else { works() };
    println!(
        "\n{:<24} {:>9} {:>10} {:>10} {:>7} {:>9}",
        "training step", "products", "ours, ms", "LeRobot's", "ratio", "gathered"
    );
    for (name, config, signature, rows) in works {
        let policy: PolicyConfig = serde_json::from_value(config).unwrap();
        let batch = cases::batch(&signature, policy.action_horizon(), rows, 3).to_device(backend.device()).unwrap();
        for &precision in precisions {
            let backend = backend.clone().with_precision(precision).unwrap();
            let model: Box<dyn PolicyModel> = policy.build(&signature, 1, &backend).unwrap();
            let count = model.params().count() as u64;
            let mut trainer = Trainer::new(model, TrainConfig::default(), 1).unwrap();
            let ours = step_ms(&mut trainer, &mut || batch.clone(), (rounds, steps));
            let mut gathering = gathering(&signature, &batch);
            let gathered = step_ms(&mut trainer, &mut gathering, (rounds, steps));
            drop(trainer);
            let word = format!("{precision:?}").to_lowercase();
            let theirs = option("--peer").and_then(|python| peer(&python, device, (name, &word), (rounds, steps)));
            let parameters = (count, theirs.as_ref().and_then(|theirs| theirs["parameters"].as_u64()));
            let theirs = theirs.and_then(|theirs| theirs["ms"].as_f64());
            let ratio = theirs.map(|theirs| ours / theirs);
            let show = |x: Option<f64>| x.map_or("-".to_owned(), |x| format!("{x:.2}"));
            println!("{name:<24} {word:>9} {ours:>10.2} {:>10} {:>7} {gathered:>9.2}", show(theirs), show(ratio));
            speed.push(json!({
                "work": name, "products": word, "ours_ms": ours, "peer_ms": theirs, "ratio": ratio,
                "with_images_gathered_ms": gathered, "parameters": parameters.0, "peer_parameters": parameters.1,
            }));
        }
    }
    let met = parity.iter().all(|row| row["met"] == true);
    let all = json!({"gpu": gpu, "parity": parity, "speed": speed});
    let out = option("--out").unwrap_or_else(|| "target/bench/gpu.json".to_owned());
    if let Some(folder) = std::path::Path::new(&out).parent() {
        std::fs::create_dir_all(folder).unwrap();
    }
    std::fs::write(&out, serde_json::to_string_pretty(&all).unwrap() + "\n").unwrap();
    ExitCode::from(u8::from(!met))
}
