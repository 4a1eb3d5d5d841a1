#![allow(clippy::unwrap_used)]
use super::*;
use crate::models::denoising::NetworkConfig;
use crate::testing::{batch, losses_of_training, signatures};
use candle_core::{DType, Device};

fn small() -> Config {
    let network = NetworkConfig { down_dims: vec![8, 16], n_groups: 4, step_embed_dim: 8, ..NetworkConfig::default() };
    Config { action_horizon: 8, network, ..Config::default() }
}

#[test]
fn the_two_steps_are_the_oracle_s() {
    // `benches/peers/make_sampler_fixture.py`: the answer π(x, t) = cos(x + 2t) - 0.3x, element by element, in NumPy
    let fixture = include_str!("../../../tests/fixtures/samplers.json");
    let fixture: serde_json::Value = serde_json::from_str(fixture).unwrap();
    for (time, want) in fixture["mip"].as_object().unwrap() {
        let nothing = Tensor::zeros((1, 1, 1), DType::F32, &Device::Cpu).unwrap();
        let answer = |x: &Tensor, t: f32| -> Result<Tensor> { Ok(((x + 2.0 * f64::from(t))?.cos()? - (x * 0.3)?)?) };
        let got = two_steps(&nothing, time.parse().unwrap(), answer).unwrap();
        let got = got.flatten_all().unwrap().to_vec1::<f32>().unwrap()[0];
        let want = want.as_f64().unwrap() as f32;
        assert!((got - want).abs() < 1e-6, "{time}: {got} {want}");
    }
}

#[test]
fn training_lowers_both_parts_of_the_loss_with_the_same_bits_every_time() {
    let signature = signatures().history;
    let build = || Mip::new(&small(), &signature, 1, &Backend::CPU);
    let losses = losses_of_training(build, &batch(&signature, 8, 8, 0), (80, 3e-3));
    for (part, share) in [("first_l2_loss", 0.9), ("second_l2_loss", 0.7)] {
        assert!(losses[79].parts[part] < share * losses[0].parts[part], "{part}: {losses:?}");
    }
}

#[test]
fn impossible_configurations_name_the_field() {
    for second_time in [0.0, 1.0, f64::NAN] {
        let error = Mip::new(&Config { second_time, ..small() }, &signatures().plain, 0, &Backend::CPU)
            .unwrap_err()
            .to_string();
        assert!(error.contains("config of mip: second_time is"), "{error}");
    }
}
