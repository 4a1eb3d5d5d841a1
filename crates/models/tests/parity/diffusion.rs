//! Diffusion against LeRobot's `DiffusionPolicy` on PyTorch, and its transformer against Chi et al.'s: the fixtures of this
//! repository, and every folder of the same layout below `$ACTRM_PARITY_DIR` (`benches/peers/make_diffusion_fixture.py` and
//! `make_transformer_fixture.py` make fresh ones).
#![allow(clippy::unwrap_used)]

use candle_core::{DType, Device, Tensor};
use models::diffusion::{Config, Diffusion, Sampler, TransformerConfig, lerobot};
use models::{Backend, Batch, Features, PolicyModel, Rng, Signature};
use std::collections::BTreeMap;
use std::path::Path;

/// Largest absolute difference that counts as equal.
const TOLERANCE: f32 = 1e-5;
/// The same of actions drawn in ten steps. Each looks at the answer of the step before: in LeRobot's own sampler on these
/// fixtures a difference of 1e-6 in what the network gives, which is ours, moves the actions by 1e-5 to 3e-5.
const DRAWN: f32 = 5e-5;

struct Fixture {
    name: String,
    folder: std::path::PathBuf,
    io: BTreeMap<String, Tensor>,
}

impl Fixture {
    fn model(&self) -> Diffusion {
        let config = std::fs::read_to_string(self.folder.join("config.json")).unwrap();
        let lerobot = lerobot::read_config(&serde_json::from_str(&config).unwrap()).unwrap();
        let model = Diffusion::new(&lerobot.config, &lerobot.signature, 0, &Backend::CPU).unwrap();
        lerobot::load_tensors(model.params(), &tensors(&self.folder, "model.safetensors")).unwrap();
        model
    }

    fn get(&self, name: &str) -> Tensor {
        self.io[name].to_dtype(DType::F32).unwrap()
    }

    fn batch(&self) -> Batch {
        let pad: Vec<f32> = self.get("pad").flatten_all().unwrap().to_vec1().unwrap();
        // one observation has no axis of steps
        let seen = |name: &str| {
            let all = self.get(name);
            if all.dim(1).unwrap() == 1 { all.squeeze(1).unwrap() } else { all }
        };
        Batch {
            observation: Features::low_dimensional(seen("state"), Some(seen("env"))),
            actions: self.get("action"),
            is_pad: self.get("pad"),
            padding: None,
            total_rows: self.get("state").dim(0).unwrap(),
            total_valid_steps: pad.iter().filter(|&&p| p == 0.0).count(),
            seed: 0,
            taken: None,
            visited: None,
            auxiliary: None,
        }
    }

    fn same(&self, what: &str, got: &Tensor, expected: &Tensor) {
        self.within(TOLERANCE, what, got, expected);
    }

    fn within(&self, tolerance: f32, what: &str, got: &Tensor, expected: &Tensor) {
        assert_eq!(got.dims(), expected.dims(), "{}: {what}", self.name);
        let off = largest_of(&(got - expected).unwrap());
        println!("{}: {what} differs by {off:.1e}", self.name);
        assert!(off <= tolerance * largest_of(expected).max(1.0), "{}: {what} is {off} away", self.name);
    }

    fn steps(&self) -> Vec<u32> {
        self.get("steps").to_vec1::<f32>().unwrap().into_iter().map(|t| t as u32).collect()
    }
}

fn tensors(folder: &Path, file: &str) -> BTreeMap<String, Tensor> {
    candle_core::safetensors::load(folder.join(file), &Device::Cpu).unwrap().into_iter().collect()
}

fn fixtures() -> Vec<Fixture> {
    let read = |folder: std::path::PathBuf| Fixture {
        name: folder.file_name().unwrap().to_string_lossy().into_owned(),
        io: Tensor::read_npz(folder.join("draws.npz")).unwrap().into_iter().collect(),
        folder,
    };
    crate::common::fixtures(&crate::common::DIFFUSION, 3).into_iter().map(read).collect()
}

fn largest_of(t: &Tensor) -> f32 {
    t.abs().unwrap().flatten_all().unwrap().max(0).unwrap().to_scalar().unwrap()
}

#[test]
fn the_network_the_loss_and_its_gradients_are_lerobots() {
    for f in fixtures() {
        let (model, batch) = (f.model(), f.batch());
        let output = model.denoise(&batch.observation, &f.get("noisy"), &f.steps()).unwrap();
        f.same("output", &output, &f.get("output"));
        let loss = model.loss_with(&batch, &f.get("eps"), &f.steps()).unwrap();
        f.same("loss", &loss, &f.get("loss"));
        let gradients = loss.backward().unwrap();
        let expected = tensors(&f.folder, "gradients.safetensors");
        assert_eq!(expected.len(), model.params().iter().count());
        for (name, var) in model.params().iter() {
            let (got, expected) = (gradients.get(var).unwrap(), &expected[&format!("diffusion.{name}")]);
            let off = largest_of(&(got - expected).unwrap());
            // relative to the largest entry: sums over rows and steps
            let scale = largest_of(expected).max(1e-2);
            assert!(off <= 2e-4 * scale, "{}: gradient of {name} is {off} away, largest {scale}", f.name);
        }
    }
}

#[test]
fn actions_are_drawn_as_there() {
    for f in fixtures() {
        let batch = f.batch();
        for (sampler, steps, name) in
            [(Sampler::Ddim, 10, "ddim_10"), (Sampler::Ddim, 1, "ddim_1"), (Sampler::Ddpm, 10, "ddpm_10")]
        {
            let model = f.model().sampling(sampler, steps).unwrap();
            let between = f.get("between");
            let mut at = 0;
            let mut drawn = || -> models::Result<Tensor> {
                at += 1;
                Ok(between.get(at - 1)?)
            };
            let got = model.sample_from(&batch.observation, &f.get("eps"), &mut drawn).unwrap();
            f.within(DRAWN, name, &got, &f.get(name));
        }
    }
}

#[test]
fn what_is_written_for_lerobot_is_what_it_wrote() {
    for f in fixtures() {
        let text = std::fs::read_to_string(f.folder.join("config.json")).unwrap();
        let read = lerobot::read_config(&serde_json::from_str(&text).unwrap()).unwrap();
        let written = lerobot::write_config(&read).unwrap();
        assert_eq!(lerobot::read_config(&written).unwrap(), read, "{}", f.name);
        let model = f.model();
        let (out, theirs) = (lerobot::tensors_out(model.params()), tensors(&f.folder, "model.safetensors"));
        assert_eq!(out.keys().collect::<Vec<_>>(), theirs.keys().collect::<Vec<_>>(), "{}", f.name);
        // what a checkpoint lacks is named
        let mut less = theirs.clone();
        less.remove("diffusion.unet.final_conv.1.bias").unwrap();
        let error = lerobot::load_tensors(model.params(), &less).unwrap_err().to_string();
        assert!(error.contains("unet.final_conv.1.bias is missing"), "{error}");
    }
    let f = &fixtures()[0];
    let drawn = |seed| f.model().sample(&f.batch().observation, &mut Rng::new(seed, "policy")).unwrap();
    assert_eq!(drawn(1).to_vec3::<f32>().unwrap(), drawn(1).to_vec3::<f32>().unwrap());
}

#[test]
fn the_transformer_its_error_and_its_gradients_are_chi_et_als() {
    for folder in crate::common::fixtures(&crate::common::TRANSFORMER, 2) {
        let name = folder.file_name().unwrap().to_string_lossy().into_owned();
        let io = Tensor::read_npz(folder.join("transformer.npz")).unwrap().into_iter().collect();
        let f = Fixture { name, io, folder };
        let text = std::fs::read_to_string(f.folder.join("config.json")).unwrap();
        let told: serde_json::Value = serde_json::from_str(&text).unwrap();
        let number = |key: &str| usize::try_from(told[key].as_u64().unwrap()).unwrap();
        let transformer: TransformerConfig = serde_json::from_value(told["transformer"].clone()).unwrap();
        let width = |key: &str| f.get(key).dim(2).unwrap();
        let sizes = Signature::low_dimensional(width("state"), width("env"), width("eps"));
        let signature = Signature { n_obs_steps: number("n_obs_steps"), ..sizes };
        let config = Config { action_horizon: number("horizon"), transformer: Some(transformer), ..Config::default() };
        let model = Diffusion::new(&config, &signature, 0, &Backend::CPU).unwrap();
        let prefixed = |file: &str| -> BTreeMap<String, Tensor> {
            tensors(&f.folder, file).into_iter().map(|(name, t)| (format!("transformer.{name}"), t)).collect()
        };
        model.params().load(&prefixed("model.safetensors")).unwrap();
        // one observation has no axis of steps
        let seen = |key: &str| if signature.n_obs_steps == 1 { f.get(key).squeeze(1).unwrap() } else { f.get(key) };
        let observation = Features::low_dimensional(seen("state"), Some(seen("env")));
        let output = model.denoise(&observation, &f.get("noisy"), &f.steps()).unwrap();
        f.same("output", &output, &f.get("output"));
        let loss = (output - f.get("eps")).unwrap().sqr().unwrap().mean_all().unwrap();
        f.same("loss", &loss, &f.get("loss"));
        let (gradients, expected) = (loss.backward().unwrap(), prefixed("gradients.safetensors"));
        assert_eq!(expected.len(), model.params().iter().count());
        for (name, var) in model.params().iter() {
            let (got, expected) = (gradients.get(var).unwrap(), &expected[name]);
            let off = largest_of(&(got - expected).unwrap());
            let scale = largest_of(expected).max(1e-2);
            assert!(off <= 2e-4 * scale, "{}: gradient of {name} is {off} away, largest {scale}", f.name);
        }
    }
}
