#![allow(clippy::unwrap_used)]
use super::*;
use crate::models::denoising::NetworkConfig;
use crate::testing::{batch, losses_of_training, signatures};
use candle_core::Device;

fn small() -> Config {
    let network = NetworkConfig { down_dims: vec![8, 16], n_groups: 4, step_embed_dim: 8, ..NetworkConfig::default() };
    Config { action_horizon: 8, network, ..Config::default() }
}

#[test]
fn the_sampler_is_the_oracle_s() {
    // `benches/peers/make_sampler_fixture.py`: the field v(x, t) = sin(3x) - 2tx + t from this noise, in NumPy
    let fixture = include_str!("../../../tests/fixtures/samplers.json");
    let fixture: serde_json::Value = serde_json::from_str(fixture).unwrap();
    let numbers = |of: &serde_json::Value| -> Vec<f32> {
        of.as_array().unwrap().iter().map(|x| x.as_f64().unwrap() as f32).collect()
    };
    let noise = numbers(&fixture["noise"]);
    let z = Tensor::from_slice(&noise, (1, noise.len(), 1), &Device::Cpu).unwrap();
    for (steps, want) in fixture["flow"].as_object().unwrap() {
        let field = |x: &Tensor, t: f32| -> Result<Tensor> {
            let t = f64::from(t);
            Ok((((x * 3.0)?.sin()? - (x * (2.0 * t))?)? + t)?)
        };
        let got = euler(&z, steps.parse().unwrap(), field).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
        for (got, want) in got.iter().zip(numbers(want)) {
            assert!((got - want).abs() < 1e-5, "{steps} steps: {got} {want}");
        }
    }
}

#[test]
fn on_the_way_there_is_noise_first_and_actions_last() {
    let tensor = |values: [f32; 2]| Tensor::from_slice(&values, (2, 1, 1), &Device::Cpu).unwrap();
    let (z, a) = (tensor([-1.0, 5.0]), tensor([3.0, 1.0]));
    let at = |times: [f32; 2]| between(&z, &a, &times).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
    assert_eq!((at([0.0, 0.0]), at([1.0, 1.0]), at([0.25, 0.5])), (vec![-1.0, 5.0], vec![3.0, 1.0], vec![0.0, 3.0]));
}

#[test]
fn training_lowers_the_loss_with_the_same_bits_every_time() {
    let signature = signatures().history;
    let build = || Flow::new(&small(), &signature, 1, &Backend::CPU);
    let losses = losses_of_training(build, &batch(&signature, 8, 16, 0), (60, 3e-3));
    let ten = |from: usize| losses[from..from + 10].iter().map(|step| step.loss).sum::<f32>();
    assert!(ten(50) < 0.9 * ten(0), "{losses:?}");
}

#[test]
fn impossible_configurations_name_the_field() {
    let error = Flow::new(&Config { inference_steps: 0, ..small() }, &signatures().plain, 0, &Backend::CPU)
        .unwrap_err()
        .to_string();
    assert!(error.contains("config of flow: inference_steps is 0"), "{error}");
}
