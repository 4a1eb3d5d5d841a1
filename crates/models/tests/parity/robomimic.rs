//! BC-RNN and BC-Transformer against robomimic's networks on PyTorch: the fixtures of this repository, and every folder of
//! the same layout below `$ACTRM_PARITY_DIR` (`benches/peers/make_robomimic_fixture.py` makes fresh ones).
#![allow(clippy::unwrap_used)]

use candle_core::{DType, Device, Tensor};
use models::layers::Mixture;
use models::{
    ACTION, Backend, Batch, Clock, ENVIRONMENT_STATE, Features, NormMode, Normaliser, Observation, PolicyConfig,
    PolicyModel, Preprocess, Rng, STATE, Signature, bc_rnn::BcRnn, bc_transformer::BcTransformer,
};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

/// Largest absolute difference that counts as equal.
const TOLERANCE: f32 = 1e-5;

#[allow(clippy::large_enum_variant)] // one of each in a test
enum Model {
    Rnn(BcRnn),
    Transformer(BcTransformer),
}

struct Fixture {
    name: String,
    folder: PathBuf,
    io: BTreeMap<String, Tensor>,
}

fn tensors(path: PathBuf) -> BTreeMap<String, Tensor> {
    candle_core::safetensors::load(path, &Device::Cpu).unwrap().into_iter().collect()
}

fn fixtures() -> Vec<Fixture> {
    let read = |folder: PathBuf| Fixture {
        name: folder.file_name().unwrap().to_string_lossy().into_owned(),
        io: Tensor::read_npz(folder.join("robomimic.npz")).unwrap().into_iter().collect(),
        folder,
    };
    crate::common::fixtures(&crate::common::ROBOMIMIC, 4).into_iter().map(read).collect()
}

fn largest_of(t: &Tensor) -> f32 {
    t.abs().unwrap().flatten_all().unwrap().max(0).unwrap().to_scalar().unwrap()
}

impl Fixture {
    fn get(&self, name: &str) -> Tensor {
        self.io[name].to_dtype(DType::F32).unwrap()
    }

    fn signature(&self) -> Signature {
        let width = |name: &str| self.get(name).dim(2).unwrap();
        let action_dim = *self.get("action").dims().last().unwrap();
        let n_obs_steps = self.get("state").dim(1).unwrap();
        Signature { n_obs_steps, ..Signature::low_dimensional(width("state"), width("env"), action_dim) }
    }

    fn model(&self) -> Model {
        let text = std::fs::read_to_string(self.folder.join("config.json")).unwrap();
        let model = match serde_json::from_str(&text).unwrap() {
            PolicyConfig::BcRnn(config) => {
                Model::Rnn(BcRnn::new(&config, &self.signature(), 0, &Backend::CPU).unwrap())
            }
            PolicyConfig::BcTransformer(config) => {
                Model::Transformer(BcTransformer::new(&config, &self.signature(), 0, &Backend::CPU).unwrap())
            }
            other => panic!("{other:?}"),
        };
        model.as_dyn().params().load(&tensors(self.folder.join("model.safetensors"))).unwrap();
        model
    }

    fn batch(&self) -> Batch {
        let actions = self.get("action");
        let actions = if actions.rank() == 2 { actions.unsqueeze(1).unwrap() } else { actions };
        let (rows, horizon, _) = actions.dims3().unwrap();
        Batch {
            observation: Features::low_dimensional(self.get("state"), Some(self.get("env"))),
            is_pad: Tensor::zeros((rows, horizon), DType::F32, &Device::Cpu).unwrap(),
            padding: None,
            actions,
            total_rows: rows,
            total_valid_steps: rows * horizon,
            taken: None,
            visited: None,
            auxiliary: None,
            seed: 0,
        }
    }

    fn same(&self, what: &str, got: &Tensor, expected: &Tensor) {
        let expected = expected.reshape(got.dims()).unwrap();
        let off = largest_of(&(got - &expected).unwrap());
        println!("{}: {what} differs by {off:.1e}", self.name);
        assert!(off <= TOLERANCE * largest_of(&expected).max(1.0), "{}: {what} is {off} away", self.name);
    }
}

impl Model {
    fn as_dyn(&self) -> &dyn PolicyModel {
        match self {
            Self::Rnn(model) => model,
            Self::Transformer(model) => model,
        }
    }

    fn mixtures(&self, batch: &Batch) -> Mixture {
        match self {
            Self::Rnn(model) => model.mixtures(&batch.observation).unwrap(),
            Self::Transformer(model) => model.mixtures(&batch.observation).unwrap(),
        }
    }
}

#[test]
fn mixtures_likelihoods_and_gradients_are_robomimics() {
    for f in fixtures() {
        let (model, batch) = (f.model(), f.batch());
        let mixtures = model.mixtures(&batch);
        f.same("mean", &mixtures.means, &f.get("mean"));
        f.same("scale", &mixtures.scales, &f.get("scale"));
        let normalised = |logits: &Tensor| {
            let weights = logits.exp().unwrap();
            weights.broadcast_div(&weights.sum_keepdim(1).unwrap()).unwrap()
        };
        let expected = f.get("logits").reshape(mixtures.logits.dims()).unwrap();
        f.same("weights", &normalised(&mixtures.logits), &normalised(&expected));
        let actions = batch.actions.flatten(0, 1).unwrap();
        f.same("log-likelihood", &mixtures.log_prob(&actions).unwrap(), &f.get("log_prob"));
        let loss = model.as_dyn().loss(&batch, &mut Rng::new(0, "loss")).unwrap().total;
        f.same("loss", &loss, &f.get("loss"));
        let gradients = loss.backward().unwrap();
        let expected = tensors(f.folder.join("gradients.safetensors"));
        assert_eq!(expected.len(), model.as_dyn().params().iter().count());
        for (name, var) in model.as_dyn().params().iter() {
            let (got, expected) = (gradients.get(var).unwrap(), &expected[name]);
            let off = largest_of(&(got - expected).unwrap());
            // relative to the largest entry: sums over rows and steps
            let scale = largest_of(expected).max(1e-2);
            assert!(off <= 2e-4 * scale, "{}: gradient of {name} is {off} away, largest {scale}", f.name);
        }
    }
}

struct NoClock;

impl Clock for NoClock {
    fn milliseconds(&mut self) -> f64 {
        0.0
    }
}

#[test]
fn a_state_is_carried_and_begun_anew_as_robomimics() {
    for f in fixtures().into_iter().filter(|f| f.io.contains_key("carried")) {
        let modes = [STATE, ENVIRONMENT_STATE, ACTION].map(|name| (name.to_string(), NormMode::Identity));
        let normaliser = Normaliser::new(&BTreeMap::from(modes), &BTreeMap::new()).unwrap();
        let preprocess = Arc::new(Preprocess::new(f.signature(), normaliser, &candle_core::Device::Cpu).unwrap());
        let Model::Rnn(model) = f.model() else { panic!("{}", f.name) };
        let model = Arc::new(model);
        let (state, env) = (f.get("state").to_vec3::<f32>().unwrap(), f.get("env").to_vec3::<f32>().unwrap());
        let carried = f.get("carried");
        for row in 0..state.len() {
            let mut policy = Arc::clone(&model).policy(Arc::clone(&preprocess), Box::new(NoClock));
            policy.reset(row as u64);
            let steps = state[row].len();
            for step in 0..2 * steps {
                let seen = Observation::of_state(state[row][step % steps].clone(), env[row][step % steps].clone());
                let got = policy.predict(&seen).unwrap().actions;
                // a Gaussian is drawn, and its mean with a noise of 1e-4 is the action: one of theirs
                let theirs = carried.get(row).unwrap().get(step).unwrap().to_vec2::<f32>().unwrap();
                let near = |mean: &Vec<f32>| got.iter().zip(mean).all(|(a, b)| (a - b).abs() < 6e-4);
                assert!(theirs.iter().any(near), "{} row {row} step {step}: {got:?} of {theirs:?}", f.name);
            }
        }
    }
}
