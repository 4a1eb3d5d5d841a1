//! ACT against outputs of LeRobot's `ACTPolicy` on PyTorch: the fixtures of this repository, and every folder of the
//! same layout below `$ACTRM_PARITY_DIR` (`benches/peers/make_act_fixture.py --random N` makes fresh ones).
#![allow(clippy::unwrap_used)]

use candle_core::{DType, Device, Tensor};
use models::act::{Act, Config, lerobot};
use models::{Backend, Batch, Features, Gradients, LossNumbers, ParamLayout, PolicyModel, Rng};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

/// Largest absolute difference that counts as equal.
const TOLERANCE: f32 = 1e-5;

struct Fixture {
    name: String,
    act: Act,
    io: BTreeMap<String, Tensor>,
    /// of LeRobot's loss, if the folder has them
    gradients: Option<BTreeMap<String, Tensor>>,
}

fn read(folder: &Path) -> Fixture {
    let config = std::fs::read_to_string(folder.join("config.json")).unwrap();
    let lerobot = lerobot::read_config(&serde_json::from_str(&config).unwrap()).unwrap();
    let act = Act::new(&lerobot.config, &lerobot.signature, 0, &Backend::CPU).unwrap();
    let load = |file: &str| candle_core::safetensors::load(folder.join(file), &Device::Cpu).unwrap();
    let tensors: BTreeMap<_, _> = load("model.safetensors").into_iter().collect();
    lerobot::load_tensors(act.params(), &lerobot.config, &tensors).unwrap();
    let io = Tensor::read_npz(folder.join("io.npz")).unwrap().into_iter().collect();
    let gradients =
        folder.join("gradients.safetensors").exists().then(|| load("gradients.safetensors").into_iter().collect());
    Fixture { name: folder.display().to_string(), act, io, gradients }
}

fn fixtures() -> Vec<Fixture> {
    crate::common::fixtures(&crate::common::ACT, 7).iter().map(|folder| read(folder)).collect()
}

impl Fixture {
    fn get(&self, name: &str) -> Tensor {
        self.io[name].to_dtype(DType::F32).unwrap()
    }

    fn batch(&self) -> Batch {
        let pad: Vec<f32> = self.get("pad").flatten_all().unwrap().to_vec1().unwrap();
        Batch {
            observation: Features::low_dimensional(
                self.get("state"),
                self.io.contains_key("env").then(|| self.get("env")),
            ),
            actions: self.get("action"),
            is_pad: self.get("pad"),
            padding: None,
            total_rows: self.get("state").dim(0).unwrap(),
            total_valid_steps: pad.iter().filter(|&&p| p == 0.0).count(),
            taken: None,
            visited: None,
            auxiliary: None,
            seed: 0,
        }
    }

    fn same(&self, what: &str, got: &Tensor, expected: &Tensor) {
        assert_eq!(got.dims(), expected.dims(), "{}: {what}", self.name);
        let off = (got - expected).unwrap().abs().unwrap().flatten_all().unwrap().max(0).unwrap();
        let off: f32 = off.to_scalar().unwrap();
        println!("{}: {what} differs by {off:.1e}", self.name);
        assert!(off <= TOLERANCE, "{}: {what} is {off} away", self.name);
    }
}

#[test]
fn inference_is_lerobots() {
    for f in fixtures() {
        let batch = f.batch();
        f.same("inference", &f.act.predict(&batch.observation).unwrap(), &f.get("out_infer"));
        f.same("composed inference", &f.act.predict_composed(&batch.observation).unwrap(), &f.get("out_infer"));
    }
}

#[test]
fn the_training_forward_pass_and_the_loss_are_lerobots() {
    for f in fixtures() {
        let batch = f.batch();
        let shape = (batch.rows(), f.act.config().latent_dim);
        let eps = match f.io.contains_key("eps") {
            true => f.get("eps"),
            false => Tensor::zeros(shape, DType::F32, &Device::Cpu).unwrap(),
        };
        let (actions, latent) = f.act.training_output(&batch, &eps).unwrap();
        f.same("training output", &actions, &f.get("out_train"));
        if let Some(latent) = &latent {
            let width = latent.dim(1).unwrap() / 2;
            for (part, name) in ["mu", "logvar"].into_iter().enumerate() {
                f.same(name, &latent.narrow(1, part * width, width).unwrap(), &f.get(name));
            }
        }
        let loss = f.act.composed_loss_with(&batch, &eps).unwrap();
        // a loss of some tens has fewer digits behind the point
        let expected = f.get("loss").to_scalar::<f32>().unwrap();
        let got = loss.total.to_scalar::<f32>().unwrap();
        assert!((got - expected).abs() <= TOLERANCE * expected.abs().max(1.0), "{}: loss {got} {expected}", f.name);
        for (ours, theirs) in [("l1_loss", "l1_loss"), ("kld_loss", "kld_loss")] {
            if f.io.contains_key(theirs) && loss.parts.contains_key(ours) {
                let (got, expected) =
                    (loss.parts[ours].to_scalar::<f32>().unwrap(), f.get(theirs).to_scalar::<f32>().unwrap());
                assert!(
                    (got - expected).abs() <= TOLERANCE * expected.abs().max(1.0),
                    "{}: {ours} {got} {expected}",
                    f.name
                );
            }
        }
        if let Some(expected) = &f.gradients {
            let grads = loss.total.backward().unwrap();
            for (name, var) in f.act.params().iter() {
                let got = grads.get(var).unwrap_or_else(|| panic!("{}: no gradient for {name}", f.name));
                close(&f.name, name, got, &expected[&format!("model.{name}")]);
            }
            // shards add up to the whole, and the fused path has the same gradients
            let mut sum = Gradients::zeros(Arc::new(ParamLayout::new(f.act.params()))).unwrap();
            let mut values = LossNumbers::default();
            let at = batch.rows() / 2;
            for (from, shard) in [0, at].into_iter().zip(batch.shards(2).unwrap()) {
                let eps = eps.narrow(0, from, shard.rows()).unwrap().contiguous().unwrap();
                values.add(&f.act.gradients_with(&shard, &eps, None, &mut sum).unwrap()).unwrap();
            }
            let values = values.read().unwrap();
            assert!((values.total - got).abs() <= TOLERANCE * got.abs().max(1.0), "{}: {values:?} {got}", f.name);
            for (name, _) in f.act.params().iter() {
                let expected = &expected[&format!("model.{name}")];
                let got = Tensor::from_slice(sum.get(name).unwrap(), expected.dims(), &Device::Cpu).unwrap();
                close(&f.name, name, &got, expected);
            }
        }
    }
}

fn largest_of(t: &Tensor) -> f32 {
    t.abs().unwrap().flatten_all().unwrap().max(0).unwrap().to_scalar().unwrap()
}

fn close(folder: &str, name: &str, got: &Tensor, expected: &Tensor) {
    let off = largest_of(&(got - expected).unwrap());
    // relative to the largest entry: sums over hundreds of rows
    let scale = largest_of(expected).max(1e-2);
    assert!(off <= 2e-4 * scale, "{folder}: gradient of {name} is {off} away, largest {scale}");
}

/// What has a gradient of zero in LeRobot too: the projection of a latent that is always 0, and the gain of a norm whose
/// input is always 0, as the first decoder layer's is.
fn known_zero(config: &Config) -> Vec<&'static str> {
    let mut names = Vec::new();
    if !config.use_vae {
        names.push("encoder_latent_input_proj.weight");
    }
    if config.pre_norm {
        names.push("decoder.layers.0.norm1.weight");
    }
    names
}

#[test]
fn every_parameter_gets_a_gradient() {
    for f in fixtures() {
        let mut grads = Gradients::zeros(Arc::new(ParamLayout::new(f.act.params()))).unwrap();
        f.act.accumulate_gradients(&f.batch(), &mut Rng::new(1, "test"), &mut grads).unwrap();
        for (name, span) in grads.layout().clone().iter() {
            let zero = known_zero(f.act.config()).contains(&name);
            if let Some(reference) = &f.gradients {
                assert!(!zero || largest_of(&reference[&format!("model.{name}")]) == 0.0, "{}: {name}", f.name);
            }
            if zero {
                continue;
            }
            let largest = grads.values()[span].iter().fold(0f32, |m, x| m.max(x.abs()));
            assert!(largest > 0.0, "{}: {name}", f.name);
        }
    }
}
