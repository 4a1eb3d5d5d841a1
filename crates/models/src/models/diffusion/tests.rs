#![allow(clippy::unwrap_used)]
use super::*;
use crate::encoders::{ImageNorm, TokenKind, VisionConfig};
use crate::features::FeatureKind;
use crate::layers::PointerConfig;
use crate::model::PolicyModel;
use crate::testing::{
    assert_the_gradient_is_the_slope, assert_the_step_is_the_composed_one, batch, losses_of_training, move_parameters,
    signatures, vision_config,
};
use candle_core::Device;
use nn::simd::{Level, at_most};

fn small() -> Config {
    let network = NetworkConfig { down_dims: vec![8, 16], n_groups: 4, step_embed_dim: 8, ..NetworkConfig::default() };
    Config { action_horizon: 8, network, ..Config::default() }
}

fn tokens() -> TransformerConfig {
    TransformerConfig {
        dim_model: 12,
        n_heads: 3,
        n_layers: 2,
        dropout: 0.0,
        causal: true,
        ..TransformerConfig::default()
    }
}

/// Over a token for each feature, of which one is pointed at.
fn pointing() -> TransformerConfig {
    let pointer = Some(PointerConfig { among: "cube".into(), weight: 2.0 });
    TransformerConfig { n_encoder_layers: 2, causal: false, pointer, ..tokens() }
}

fn attending(transformer: TransformerConfig) -> Config {
    Config { transformer: Some(transformer), ..small() }
}

/// With images, whose network has too many kinks for slopes; of one step and of two.
fn seeing() -> Vec<(Signature, Config)> {
    let of = signatures();
    let frozen = VisionConfig { norm: ImageNorm::Frozen, cell_features: Some(4), ..vision_config() };
    let masked = Config { mask_padding: true, vision: Some(frozen), ..small() };
    let keypoints = VisionConfig { tokens: TokenKind::Keypoints { count: 5 }, ..vision_config() };
    vec![
        (of.images, Config { vision: Some(vision_config()), ..small() }),
        (of.image_history.clone(), masked),
        (of.image_history, Config { vision: Some(keypoints), ..small() }),
    ]
}

/// One level and three, with and without scales, masked and not.
fn cases() -> Vec<(Signature, Config)> {
    let of = signatures();
    let shifted = NetworkConfig { film_scale: false, kernel_size: 3, ..small().network };
    let one_level = NetworkConfig { down_dims: vec![24], kernel_size: 1, ..small().network };
    let three = NetworkConfig { down_dims: vec![16, 24, 40], ..small().network };
    vec![
        (of.plain, small()),
        (of.history.clone(), Config { prediction: Prediction::Sample, mask_padding: true, ..small() }),
        (of.entities.clone(), Config { network: shifted, ..small() }),
        (of.no_env.clone(), Config { network: one_level, ..small() }),
        (of.no_env, Config { network: three, mask_padding: true, ..small() }),
        (of.entities.clone(), attending(TransformerConfig { dropout: 0.2, ..tokens() })),
        (of.entities, attending(pointing())),
        (of.history, Config { mask_padding: true, ..attending(TransformerConfig { causal: false, ..tokens() }) }),
    ]
}

#[test]
fn the_gradient_is_the_slope_of_the_loss() {
    for (signature, config) in cases().into_iter().filter(|(_, config)| config.network.down_dims.len() == 2) {
        let model = Diffusion::new(&config, &signature, 1, &Backend::CPU).unwrap();
        move_parameters(&model);
        let batch = batch(&signature, 8, 3, 3);
        assert_the_gradient_is_the_slope(&model, &batch, &format!("{config:?}"));
    }
}

#[test]
fn the_step_on_kernels_is_the_composed_one() {
    for (signature, config) in cases().into_iter().chain(seeing()) {
        let model = Diffusion::new(&config, &signature, 1, &Backend::CPU).unwrap();
        move_parameters(&model);
        for rows in if config.vision.is_some() { [1, 3] } else { [1, 13] } {
            let batch = batch(&signature, 8, rows, 3);
            assert_the_step_is_the_composed_one(&model, &batch, &format!("{rows} rows, {config:?}"));
        }
    }
}

#[test]
fn answers_by_hand_are_the_composed_ones_also_when_weights_change() {
    for (signature, config) in cases().into_iter().chain(seeing()) {
        let model = Diffusion::new(&config, &signature, 1, &Backend::CPU).unwrap();
        for rows in [1, 2, 13] {
            let other = Diffusion::new(&config, &signature, rows as u64, &Backend::CPU).unwrap();
            move_parameters(&other);
            model.params().load(&other.params().tensors()).unwrap();
            let batch = batch(&signature, 8, rows, 3);
            let steps: Vec<u32> = (0..rows as u32).map(|row| row * 7).collect();
            let values = |t: Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
            let want = values(model.denoise(&batch.observation, &batch.actions, &steps).unwrap());
            let steps: Vec<f32> = steps.iter().map(|&t| t as f32).collect();
            for level in Level::ALL {
                let got = at_most(level, || model.answered(&batch.observation, &batch.actions, &steps).unwrap());
                for (got, want) in values(got).iter().zip(&want) {
                    assert!((got - want).abs() < 1e-5 * want.abs().max(1.0), "{got} {want} {level:?} {config:?}");
                }
            }
        }
    }
}

#[test]
fn shards_add_up_to_the_whole() {
    let signature = signatures().history;
    for mask_padding in [false, true] {
        let model = Diffusion::new(&Config { mask_padding, ..small() }, &signature, 1, &Backend::CPU).unwrap();
        let batch = batch(&signature, 8, 5, 3);
        let noise = normals_like(&batch.actions, &mut Rng::new(1, "noise")).unwrap();
        let steps = [3, 99, 0, 50, 20];
        let number = |loss: Tensor| loss.to_scalar::<f32>().unwrap();
        let whole = number(model.loss_with(&batch, &noise, &steps).unwrap());
        let mut sum = 0.0;
        for (from, shard) in [0, 2].into_iter().zip(batch.shards(2).unwrap()) {
            let part = noise.narrow(0, from, shard.rows()).unwrap().contiguous().unwrap();
            sum += number(model.loss_with(&shard, &part, &steps[from..from + shard.rows()]).unwrap());
        }
        assert!((whole - sum).abs() < 1e-5 * whole, "{whole} {sum}");
    }
}

#[test]
fn ddpm_with_a_network_that_knows_the_noise_comes_back_to_the_actions() {
    // with the true noise as output every step back keeps the same clean actions
    let config = Config { clip_sample: 0.0, inference_steps: 100, ..small() };
    let schedule = NoiseSchedule::new(100);
    let clean = Tensor::new(&[[[0.3_f32], [-0.7]]], &Device::Cpu).unwrap();
    for sampler in [Sampler::Ddim, Sampler::Ddpm] {
        let config = Config { sampler, ..config.clone() };
        let rng = &mut Rng::new(4, "test");
        let noise = Tensor::from_vec(rng.normals(2), (1, 2, 1), &Device::Cpu).unwrap();
        let mut x = schedule.add_noise(&clean, &noise, &[99]).unwrap();
        for step in schedule.visited(100) {
            let share = f64::from(schedule.alphas_cumprod_at(step));
            let knows = ((&x - (&clean * share.sqrt()).unwrap()).unwrap() / (1.0 - share).sqrt()).unwrap();
            let mut drawn = || -> Result<Tensor> { Ok(Tensor::from_vec(rng.normals(2), (1, 2, 1), &Device::Cpu)?) };
            x = schedule.back(&config, &x, &knows, step, &mut drawn).unwrap();
        }
        let off =
            (&x - &clean).unwrap().abs().unwrap().flatten_all().unwrap().max(0).unwrap().to_scalar::<f32>().unwrap();
        assert!(off < 1e-3, "{sampler:?} {off}");
    }
}

#[test]
fn training_lowers_the_loss_with_the_same_bits_every_time() {
    let signature = signatures().history;
    let build = || Diffusion::new(&small(), &signature, 1, &Backend::CPU);
    let losses = losses_of_training(build, &batch(&signature, 8, 16, 0), (60, 3e-3));
    let ten = |from: usize| losses[from..from + 10].iter().map(|step| step.loss).sum::<f32>();
    assert!(ten(50) < 0.9 * ten(0), "{losses:?}");
}

#[test]
fn what_is_drawn_depends_on_the_generator_and_stays_in_range() {
    let signature = signatures().history;
    let model = Diffusion::new(&small(), &signature, 1, &Backend::CPU).unwrap();
    let batch = batch(&signature, 8, 4, 3);
    let flat = |t: Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    let draw = |seed| flat(model.sample(&batch.observation, &mut Rng::new(seed, "policy")).unwrap());
    assert_eq!(draw(1), draw(1));
    assert_ne!(draw(1), draw(2));
    assert!(draw(1).iter().all(|x| x.abs() <= 1.0));
    assert_eq!(draw(1).len(), 4 * 8 * 2);
}

#[test]
fn impossible_configurations_name_the_field() {
    let of = signatures();
    let error = |config: Config| Diffusion::new(&config, &of.plain, 0, &Backend::CPU).unwrap_err().to_string();
    let network = |change: fn(&mut NetworkConfig)| {
        let mut config = small();
        change(&mut config.network);
        config
    };
    assert!(error(Config { action_horizon: 6, ..small() }).contains("action_horizon is 6, expected a multiple of 2^2"));
    assert!(error(Config { action_horizon: 0, ..small() }).contains("action_horizon is 0, expected a multiple of 2^2"));
    let nothing = Config { action_horizon: 0, ..attending(tokens()) };
    assert!(error(nothing).contains("action_horizon is 0, expected at least 1"));
    assert!(error(Config { inference_steps: 101, ..small() }).contains("inference_steps"));
    assert!(error(Config { clip_sample: -1.0, ..small() }).contains("clip_sample"));
    assert!(error(network(|n| n.n_groups = 3)).contains("network.n_groups is 3"));
    assert!(error(network(|n| n.kernel_size = 4)).contains("network.kernel_size"));
    assert!(error(network(|n| n.down_dims = vec![])).contains("network.down_dims"));
    assert!(error(network(|n| n.down_dims = vec![12, 24])).contains("a multiple of 8 first"));
    assert!(error(network(|n| n.step_embed_dim = 5)).contains("step_embed_dim"));
    let attends = |change: fn(&mut TransformerConfig)| {
        let mut transformer = tokens();
        change(&mut transformer);
        error(attending(transformer))
    };
    assert!(attends(|t| t.n_heads = 5).contains("transformer.n_heads is 5, expected a divisor of dim_model, 12"));
    assert!(attends(|t| t.dim_model = 9).contains("transformer.dim_model is 9"));
    assert!(attends(|t| t.n_layers = 0).contains("transformer.n_layers is 0"));
    assert!(attends(|t| t.dropout = 1.0).contains("transformer.dropout is 1"));
    assert!(attends(|t| t.pointer = pointing().pointer).contains("transformer.pointer is among cube, expected absent"));
    let both = Config { vision: Some(vision_config()), ..attending(tokens()) };
    assert!(error(both).contains("vision is given, expected none with a transformer"));
    // a signature with images brings an encoder of its own
    let unseen = Diffusion::new(&attending(tokens()), &of.images, 0, &Backend::CPU).unwrap_err().to_string();
    assert!(unseen.contains("transformer is one beside a, b, c, expected none where there are images"), "{unseen}");
    let sees = |vision| {
        let config = Config { vision: Some(vision), ..small() };
        Diffusion::new(&config, &of.images, 0, &Backend::CPU).unwrap_err().to_string()
    };
    assert!(
        sees(VisionConfig { cell_features: Some(6), ..vision_config() })
            .contains("cell_features is 6, expected a multiple")
    );
    let blind = error(Config { vision: Some(vision_config()), ..small() });
    assert!(blind.contains("expected a feature of kind image"), "{blind}");
    let long = Signature { n_obs_steps: 9, ..of.plain.clone() };
    let error = Diffusion::new(&small(), &long, 0, &Backend::CPU).unwrap_err().to_string();
    assert!(error.contains("action_horizon is 8, expected at least n_obs_steps, 9"), "{error}");
}

#[test]
fn what_a_camera_sees_decides_and_is_told_before_anything_is_drawn() {
    for (signature, config) in seeing() {
        let model = Diffusion::new(&config, &signature, 1, &Backend::CPU).unwrap();
        move_parameters(&model);
        assert_eq!(model.vision(), config.vision.as_ref());
        let one = batch(&signature, 8, 1, 3).observation;
        let mut seen = 0;
        let flat = |t: Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let first = flat(model.sample_seen(&one, &mut Rng::new(1, "policy"), &mut || seen += 1).unwrap());
        assert_eq!(seen, 1);
        assert_eq!(first, flat(model.sample(&one, &mut Rng::new(1, "policy")).unwrap()));
        // every camera, and of a history every step
        for spec in signature.of_kind(FeatureKind::Image) {
            for step in 0..signature.n_obs_steps {
                let image = one.get(&spec.name).unwrap();
                let mut bytes = image.flatten_all().unwrap().to_vec1::<u8>().unwrap();
                bytes[step * spec.width()..][..spec.width()].iter_mut().for_each(|byte| *byte = 255 - *byte);
                let mut other = one.clone();
                other.insert(&spec.name, Tensor::from_vec(bytes, image.shape(), &Device::Cpu).unwrap());
                let then = flat(model.sample(&other, &mut Rng::new(1, "policy")).unwrap());
                assert_ne!(then, first, "{} step {step}", spec.name);
            }
        }
    }
}

#[test]
fn over_tokens_a_pointer_is_asked_beside_the_actions() {
    let signature = signatures().entities;
    let model = Diffusion::new(&attending(pointing()), &signature, 1, &Backend::CPU).unwrap();
    let batch = batch(&signature, 8, 6, 3);
    let loss = model.loss(&batch, &mut Rng::new(1, "loss")).unwrap();
    assert!(loss.parts.contains_key("pointer_loss") && loss.parts.contains_key("pointer_right"), "{:?}", loss.parts);
    // without a pointer it is a part less, and the data need not say what was taken
    let silent = TransformerConfig { pointer: None, ..pointing() };
    let model = Diffusion::new(&attending(silent), &signature, 1, &Backend::CPU).unwrap();
    let untold = Batch { taken: None, ..batch };
    assert!(!model.loss(&untold, &mut Rng::new(1, "loss")).unwrap().parts.contains_key("pointer_loss"));
    assert!(model.query_flops().unwrap() > 1e3);
}
