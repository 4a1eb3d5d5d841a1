#![allow(clippy::unwrap_used)]
use super::*;
use crate::features::Values;
use crate::layers::Cell;
use crate::normaliser::{ACTION, ENVIRONMENT_STATE, NormMode, Normaliser, STATE};
use crate::testing::{
    assert_the_gradient_is_the_slope, assert_the_step_is_the_composed_one, batch, losses_of_training, move_parameters,
    signatures, vision_config,
};
use candle_core::Device;
use std::collections::BTreeMap;

fn small() -> Config {
    Config { action_horizon: 3, hidden_dim: 9, n_modes: 2, min_std: 0.05, ..Config::default() }
}

/// A clock that goes on by one whenever somebody looks.
struct Ticks(f64);

impl Clock for Ticks {
    fn milliseconds(&mut self) -> f64 {
        self.0 += 1.0;
        self.0
    }
}

/// A batch whose padding lies at the beginning of its rows, where windows with past actions have it.
fn padded_before(signature: &Signature, rows: usize) -> Batch {
    let mut batch = batch(signature, 3, rows, 3);
    let pad: Vec<f32> = (0..rows * 3).map(|i| if i % 3 < (i / 3) % 3 { 1.0 } else { 0.0 }).collect();
    batch.total_valid_steps = pad.iter().filter(|&&p| p == 0.0).count();
    batch.is_pad = Tensor::from_slice(&pad, (rows, 3), &Device::Cpu).unwrap();
    batch.padding = Some(pad);
    batch
}

#[test]
fn the_gradient_is_the_slope_of_the_loss() {
    let signature = signatures().history;
    let gru = Config { cell: Cell::Gru, ..small() };
    for config in [small(), Config { n_layers: 1, n_modes: 1, ..small() }, gru] {
        let model = BcRnn::new(&config, &signature, 1, &Backend::CPU).unwrap();
        assert_the_gradient_is_the_slope(&model, &padded_before(&signature, 4), &format!("{config:?}"));
    }
}

#[test]
fn the_step_on_kernels_is_the_composed_one() {
    let signature = signatures().history;
    let other = Config { n_layers: 3, hidden_dim: 17, n_modes: 5, ..small() };
    let gru = |config: Config| Config { cell: Cell::Gru, ..config };
    for config in [small(), Config { n_layers: 1, n_modes: 1, ..small() }, gru(small()), gru(other.clone()), other] {
        let model = BcRnn::new(&config, &signature, 1, &Backend::CPU).unwrap();
        for rows in [1, 5] {
            assert_the_step_is_the_composed_one(&model, &padded_before(&signature, rows), &format!("{config:?}"));
        }
    }
    // sequences of one step
    let signature = Signature { n_obs_steps: 1, ..signature };
    for cell in [Cell::Lstm, Cell::Gru] {
        let config = Config { action_horizon: 1, cell, ..small() };
        let model = BcRnn::new(&config, &signature, 1, &Backend::CPU).unwrap();
        assert_the_step_is_the_composed_one(&model, &batch(&signature, 1, 4, 3), "one step");
    }
}

/// What it sees of two cameras' images, a step after another.
fn image_history() -> Signature {
    Signature { n_obs_steps: 3, ..signatures().image_history }
}

#[test]
fn from_images_the_step_on_kernels_is_the_composed_one() {
    for rows in [1, 4] {
        let model =
            BcRnn::new(&Config { vision: Some(vision_config()), ..small() }, &image_history(), 1, &Backend::CPU)
                .unwrap();
        move_parameters(&model);
        assert_the_step_is_the_composed_one(&model, &padded_before(&image_history(), rows), &format!("{rows} rows"));
    }
    let (signature, config) =
        (signatures().images, Config { action_horizon: 1, vision: Some(vision_config()), ..small() });
    let model = BcRnn::new(&config, &signature, 1, &Backend::CPU).unwrap();
    move_parameters(&model);
    assert_the_step_is_the_composed_one(&model, &batch(&signature, 1, 2, 3), "one step");
}

#[test]
fn from_images_the_policy_sees_one_step_at_a_time() {
    let signature = image_history();
    let modes = [STATE, ACTION].map(|name| (name.to_string(), NormMode::Identity));
    let normaliser = Normaliser::new(&BTreeMap::from(modes), &BTreeMap::new()).unwrap();
    let preprocess = Arc::new(Preprocess::new(signature.clone(), normaliser, &Device::Cpu).unwrap());
    let config = Config { n_modes: 1, vision: Some(vision_config()), ..small() };
    let model = Arc::new(BcRnn::new(&config, &signature, 1, &Backend::CPU).unwrap());
    let mut policy = Arc::clone(&model).policy(Arc::clone(&preprocess), Box::new(Ticks(0.0)));
    let seen = |k: usize| {
        let image: Vec<u8> = (0..36 * 40 * 3).map(|i| ((i * 7 + k * 31) % 251) as u8).collect();
        let mut observation = Observation::of_state(vec![k as f32 * 0.3, 1.0, -0.5], Vec::new());
        observation.insert("a", Values::U8(image));
        observation
    };
    policy.reset(7);
    for step in 0..5_usize {
        let action = policy.predict(&seen(step)).unwrap();
        assert_eq!(policy.encoding(), Some(1.0));
        let from = step / 3 * 3;
        let history: Vec<Observation> = (from..from + 3).map(seen).collect();
        let whole = model.predict(&preprocess.observation(&history).unwrap()).unwrap().to_vec3::<f32>().unwrap();
        for (got, want) in action.actions.iter().zip(&whole[0][step - from]) {
            assert!((got - want).abs() < 1e-3, "step {step}: {got} {want}");
        }
    }
}

#[test]
fn a_row_that_begins_with_padding_is_a_shorter_sequence() {
    let signature = signatures().history;
    let model = BcRnn::new(&small(), &signature, 1, &Backend::CPU).unwrap();
    let batch = padded_before(&signature, 3);
    let (mut sum, mut count) = (0.0, 0);
    let x = model.steps.numbers(3, &batch.observation).unwrap();
    for row in 0..3 {
        // rows with 0, 1 and 2 steps of padding
        let own = x.get(row).unwrap().narrow(0, row, 3 - row).unwrap().unsqueeze(1).unwrap();
        let own = Value::from(&own.contiguous().unwrap());
        let forward = |cx: &mut Context<'_>| model.forward(cx, &own, None)?.mixture();
        let mixtures = model.cache.predict(&model.params, &mut || {}, forward).unwrap();
        let actions = batch.actions.get(row).unwrap().narrow(0, row, 3 - row).unwrap();
        let log_prob = mixtures.log_prob(&actions).unwrap().to_vec1::<f32>().unwrap();
        sum += log_prob.iter().sum::<f32>();
        count += log_prob.len();
    }
    let loss = model.loss(&batch, &mut Rng::new(0, "loss")).unwrap().total.to_scalar::<f32>().unwrap();
    let want = -sum / count as f32;
    assert!((loss - want).abs() < 1e-5 * want.abs().max(1.0), "{loss} {want}");
}

#[test]
fn the_policy_carries_its_state_and_begins_anew_after_its_horizon() {
    let signature = Signature { n_obs_steps: 3, ..signatures().plain };
    let modes = [STATE, ENVIRONMENT_STATE, ACTION].map(|name| (name.to_string(), NormMode::Identity));
    let normaliser = Normaliser::new(&BTreeMap::from(modes), &BTreeMap::new()).unwrap();
    let preprocess = Arc::new(Preprocess::new(signature.clone(), normaliser, &Device::Cpu).unwrap());
    let model = Arc::new(BcRnn::new(&Config { n_modes: 1, ..small() }, &signature, 1, &Backend::CPU).unwrap());
    let mut policy = Carrying {
        model: Arc::clone(&model),
        preprocess: Arc::clone(&preprocess),
        state: None,
        steps: 0,
        rng: generator(0),
        clock: Box::new(Ticks(0.0)),
        encoding: None,
    };
    let seen = |k: usize| Observation::of_state(vec![k as f32 * 0.3, 1.0, -0.5], vec![0.1 * k as f32, 2.0]);
    for seed in [7, 8] {
        policy.reset(seed);
        for step in 0..8_usize {
            let action = policy.predict(&seen(step)).unwrap();
            assert_eq!(action.action_horizon, 1);
            // what the network gives for the whole sequence since the state was new
            let from = step / 3 * 3;
            let history: Vec<Observation> = (from..from + 3).map(seen).collect();
            let whole = model.predict(&preprocess.observation(&history).unwrap()).unwrap().to_vec3::<f32>().unwrap();
            for (got, want) in action.actions.iter().zip(&whole[0][step - from]) {
                assert!((got - want).abs() < 1e-3, "step {step}: {got} {want}");
            }
        }
    }
    // the noise is the seed's
    let mut first = |seed| {
        policy.reset(seed);
        policy.predict(&seen(0)).unwrap()
    };
    let again = first(7);
    assert_ne!(first(8), again);
    assert_eq!(first(7), again);
}

#[test]
fn training_lowers_the_loss_with_the_same_bits_every_time() {
    let signature = signatures().history;
    let build = || BcRnn::new(&Config { hidden_dim: 24, ..small() }, &signature, 1, &Backend::CPU);
    let losses = losses_of_training(build, &padded_before(&signature, 8), (60, 1e-2));
    assert!(losses[59].loss < losses[0].loss - 0.5, "{losses:?}");
}

#[test]
fn impossible_configurations_name_the_field() {
    let signature = signatures().history;
    let error = |config: Config| BcRnn::new(&config, &signature, 0, &Backend::CPU).unwrap_err().to_string();
    assert!(error(Config { action_horizon: 4, ..small() }).contains("action_horizon is 4, expected n_obs_steps, 3"));
    assert!(error(Config { hidden_dim: 0, ..small() }).contains("hidden_dim"));
    assert!(error(Config { min_std: 0.0, ..small() }).contains("min_std"));
}
