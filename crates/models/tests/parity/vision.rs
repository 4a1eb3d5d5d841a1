//! ACT with cameras against LeRobot 0.6.1: the fixtures of this repository, and every folder of the same layout below
//! `$ACTRM_PARITY_DIR`. Where a folder holds no weights they come from the formula of `common/recipe.rs`; where it holds no
//! gradients, probes of them.
#![allow(clippy::unwrap_used)]

use crate::common::npz::{self, Array};
use crate::common::recipe::{self, assert_probes};
use candle_core::{DType, Device, Tensor};
use models::act::Act;
use models::act::lerobot::{self, LerobotAct};
use models::{
    Backend, Batch, FeatureKind, Features, Gradients, LossNumbers, OptimiserConfig, ParamLayout, PolicyModel, Schedule,
    TrainConfig,
};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Of outputs and losses, relative to the largest.
const TOLERANCE: f32 = 1e-5;
/// Of gradients, relative to the largest.
const OF_GRADIENTS: f32 = 2e-4;

struct Fixture {
    name: String,
    folder: PathBuf,
    lerobot: LerobotAct,
    act: Act,
    io: BTreeMap<String, Tensor>,
}

fn json(path: &Path) -> serde_json::Value {
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

fn safetensors(path: &Path) -> BTreeMap<String, Tensor> {
    candle_core::safetensors::load(path, &Device::Cpu).unwrap().into_iter().collect()
}

/// Folders with networks that we have: Bottleneck blocks are refused by name.
fn folders() -> Vec<PathBuf> {
    let mut all = crate::common::fixtures(&crate::common::SEEING_ACT, 4);
    all.retain(|folder| {
        let config = json(&folder.join("config.json"));
        let known = !config["vision_backbone"].as_str().unwrap().starts_with("resnet50");
        if !known {
            let error = lerobot::read_config(&config).unwrap_err().to_string();
            assert!(error.contains("vision_backbone") && error.contains("resnet18 or resnet34"), "{error}");
        }
        known
    });
    all
}

fn read(folder: &Path) -> Fixture {
    let lerobot = lerobot::read_config(&json(&folder.join("config.json"))).unwrap();
    let act = Act::new(&lerobot.config, &lerobot.signature, 0, &Backend::CPU).unwrap();
    let weights = folder.join("model.safetensors");
    match weights.exists() {
        true => lerobot::load_tensors(act.params(), &lerobot.config, &safetensors(&weights)).unwrap(),
        false => {
            let ours =
                |(name, _): &(&str, &candle_core::Var)| *name != "encoder_img_mean" && *name != "encoder_img_std";
            let mut tensors = act.params().tensors();
            for (name, var) in act.params().all().filter(ours) {
                tensors.insert(name.to_string(), recipe::tensor(&format!("model.{name}"), var.dims()));
            }
            act.params().load(&tensors).unwrap();
        }
    }
    let io = npz::read(&folder.join("io.npz"));
    Fixture { name: folder.display().to_string(), folder: folder.to_path_buf(), lerobot, act, io }
}

fn values(t: &Tensor) -> Vec<f32> {
    t.to_dtype(DType::F32).unwrap().flatten_all().unwrap().to_vec1().unwrap()
}

fn close(what: &str, got: &[f32], want: &[f32], tolerance: f32) {
    assert_eq!(got.len(), want.len(), "{what}");
    let scale = want.iter().fold(1e-2f32, |m, x| m.max(x.abs()));
    let off = got.iter().zip(want).fold(0f32, |m, (a, b)| m.max((a - b).abs())) / scale;
    println!("{what}: {off:.1e} of the largest");
    assert!(off <= tolerance, "{what} is {off} of the largest away");
}

impl Fixture {
    fn observation(&self) -> Features<Tensor> {
        let mut observation = Features::low_dimensional(self.io["state"].clone(), self.io.get("env").cloned());
        for spec in self.lerobot.signature.of_kind(FeatureKind::Image) {
            let bytes = self.io[&format!("raw|{}", spec.name)].to_dtype(DType::U8).unwrap();
            observation.insert(&spec.name, bytes);
        }
        observation
    }

    fn batch(&self) -> Batch {
        let pad = values(&self.io["pad"]);
        Batch {
            observation: self.observation(),
            actions: self.io["action"].clone(),
            is_pad: self.io["pad"].clone(),
            padding: None,
            total_rows: self.io["state"].dim(0).unwrap(),
            total_valid_steps: pad.iter().filter(|&&p| p == 0.0).count(),
            seed: 0,
            taken: None,
            visited: None,
            auxiliary: None,
        }
    }

    fn eps(&self) -> Tensor {
        match self.io.get("eps") {
            Some(eps) => eps.clone(),
            None => {
                let shape = (self.io["state"].dim(0).unwrap(), self.act.config().latent_dim);
                Tensor::zeros(shape, DType::F32, &Device::Cpu).unwrap()
            }
        }
    }

    /// Against whole gradients or against probes of them.
    fn check_gradients(&self, way: &str, of: impl Fn(&str) -> Vec<f32>) {
        let whole = self.folder.join("gradients.safetensors");
        let whole = whole.exists().then(|| safetensors(&whole));
        let probes = self.folder.join("gradient_probes.npz");
        let probes: BTreeMap<String, Array> = if probes.exists() { npz::arrays(&probes) } else { BTreeMap::new() };
        for (name, _) in self.act.params().iter() {
            let (got, full) = (of(name), format!("model.{name}"));
            match &whole {
                Some(whole) => {
                    close(&format!("{} {way}: {name}", self.name), &got, &values(&whole[&full]), OF_GRADIENTS)
                }
                None => assert_probes(&probes, &full, &got, f64::from(OF_GRADIENTS), &format!("{} {way}", self.name)),
            }
        }
    }
}

#[test]
fn inference_is_lerobots() {
    for f in folders().iter().map(|folder| read(folder)) {
        let (observation, want) = (f.observation(), values(&f.io["out_infer"]));
        close(&f.name, &values(&f.act.predict(&observation).unwrap()), &want, TOLERANCE);
        close(&f.name, &values(&f.act.predict_composed(&observation).unwrap()), &want, TOLERANCE);
    }
}

#[test]
fn training_is_lerobots() {
    for f in folders().iter().map(|folder| read(folder)) {
        let (batch, eps) = (f.batch(), f.eps());
        let (actions, _) = f.act.training_output(&batch, &eps).unwrap();
        close(&format!("{}: output", f.name), &values(&actions), &values(&f.io["out_train"]), TOLERANCE);
        let loss = f.act.composed_loss_with(&batch, &eps).unwrap();
        let want = values(&f.io["loss"])[0];
        let got = loss.total.to_scalar::<f32>().unwrap();
        assert!((got - want).abs() <= TOLERANCE * want.abs().max(1.0), "{}: loss {got} {want}", f.name);
        let tape = loss.total.backward().unwrap();
        f.check_gradients("composed", |name| values(tape.get(f.act.params().get(name).unwrap()).unwrap()));

        // by hand, in two shards that add up
        let mut sum = Gradients::zeros(Arc::new(ParamLayout::new(f.act.params()))).unwrap();
        let mut total = LossNumbers::default();
        let at = batch.rows() / 2;
        for (from, shard) in [0, at].into_iter().zip(batch.shards(2).unwrap()) {
            let eps = eps.narrow(0, from, shard.rows()).unwrap().contiguous().unwrap();
            total.add(&f.act.gradients_with(&shard, &eps, None, &mut sum).unwrap()).unwrap();
        }
        let total = total.read().unwrap();
        assert!((total.total - want).abs() <= TOLERANCE * want.abs().max(1.0), "{}: {total:?} {want}", f.name);
        f.check_gradients("by hand", |name| sum.get(name).unwrap().to_vec());
    }
}

/// LeRobot's two groups: the backbone learns at a tenth of the rate.
#[test]
fn three_steps_with_two_rates_are_lerobots() {
    for folder in folders() {
        let after = folder.join("after_3_steps_probes.npz");
        if !after.exists() {
            continue;
        }
        let mut f = read(&folder);
        let mut config = f.lerobot.config.clone();
        config.vision.as_mut().unwrap().lr_backbone = Some(0.1);
        let act = Act::new(&config, &f.lerobot.signature, 0, &Backend::CPU).unwrap();
        act.params().load(&f.act.params().tensors()).unwrap();
        f.act = act;
        let steps = json(&folder.join("train_steps.json"));
        let train = TrainConfig { lr: 1e-3, schedule: Schedule::Constant, ..TrainConfig::default() };
        assert_eq!(train.optimiser, OptimiserConfig::default());
        let layout = Arc::new(ParamLayout::new(f.act.params()));
        let mut optimiser = models::Optimiser::new(train.optimiser, layout.clone()).unwrap();
        let (batch, eps) = (f.batch(), f.eps());
        for step in 0..3 {
            let mut grads = Gradients::zeros(layout.clone()).unwrap();
            let loss = f.act.gradients_with(&batch, &eps, None, &mut grads).unwrap().read().unwrap().total;
            let want = steps["losses"][step].as_f64().unwrap() as f32;
            assert!((loss - want).abs() < 1e-4 * want, "{}: step {step}: {loss} {want}", f.name);
            let norm = grads.values().iter().map(|g| f64::from(*g).powi(2)).sum::<f64>().sqrt();
            let want = steps["norms_before_clipping"][step].as_f64().unwrap();
            assert!((norm - want).abs() < 1e-4 * want, "{}: step {step}: norm {norm} {want}", f.name);
            let scale = models::Number::Here((10.0 / (norm + 1e-6)).min(1.0));
            optimiser.step(f.act.params(), &grads, &scale, train.lr).unwrap();
        }
        let probes = npz::arrays(&after);
        for (name, var) in f.act.params().iter() {
            // keys' biases have a gradient of zero but for rounding, and Adam makes whole steps of it
            let tolerance = if name.ends_with("in_proj_bias") { 5e-2 } else { 1e-3 };
            assert_probes(&probes, &format!("model.{name}"), &values(var.as_tensor()), tolerance, &f.name);
        }
    }
}

#[test]
fn tensors_and_configuration_come_back() {
    for f in folders().iter().map(|folder| read(folder)) {
        let out = lerobot::tensors_out(f.act.params(), &f.lerobot.config).unwrap();
        let file = f.folder.join("model.safetensors");
        if file.exists() {
            let given = safetensors(&file);
            assert_eq!(out.keys().collect::<Vec<_>>(), given.keys().collect::<Vec<_>>(), "{}", f.name);
            for (name, tensor) in &given {
                let tolerance = if name.ends_with("pos_enc") { 1e-6 } else { 0.0 };
                close(name, &values(&out[name]), &values(tensor), tolerance);
            }
        }
        let narrow = f.lerobot.config.vision.as_ref().unwrap().width != 64;
        match lerobot::write_config(&f.lerobot) {
            Ok(config) => {
                assert!(!narrow && config["pretrained_backbone_weights"].is_null(), "{}", f.name);
                assert_eq!(lerobot::read_config(&config).unwrap(), f.lerobot);
            }
            Err(error) => assert!(narrow && error.to_string().contains("vision.width"), "{}: {error}", f.name),
        }
    }
}
