#![allow(clippy::unwrap_used)]
use super::*;
use crate::cases::Signatures;
use crate::encoders::{ImageNorm, TokenKind, VisionConfig};
use crate::features::{FeatureSpec, Signature};
use crate::layers::{Activation, AuxiliaryConfig, PointerConfig};
use crate::models::act::Config;
use crate::testing::{
    assert_the_gradient_is_the_slope, assert_the_step_is_the_composed_one, batch, gradients, move_parameters,
    signatures, vision_config,
};
use candle_core::Device;
use nn::ParamLayout;
use nn::simd::{Level, at_most};
use std::sync::Arc;

/// Odd sizes: no width is a multiple of a vector, chunks are longer and shorter than a register tile.
fn configs() -> Vec<(Config, Signature, usize)> {
    let base = Config {
        action_horizon: 5,
        dim_model: 12,
        n_heads: 3,
        dim_feedforward: 19,
        n_encoder_layers: 2,
        n_vae_encoder_layers: 2,
        latent_dim: 3,
        dropout: 0.2,
        ..Default::default()
    };
    let Signatures { plain, no_env, entities, history, with_auxiliary, .. } = signatures();
    let auxiliary = Some(AuxiliaryConfig { weight: 0.6 });
    let pointer = Some(PointerConfig { among: "cube".to_string(), weight: 0.7 });
    let gelu = Config { feedforward_activation: Activation::Gelu, ..base.clone() };
    vec![
        (base.clone(), plain.clone(), 3),
        (Config { pre_norm: true, n_decoder_layers: 2, ..base.clone() }, plain.clone(), 4),
        (base.clone(), entities.clone(), 3),
        (Config { pre_norm: true, n_decoder_layers: 2, ..base.clone() }, entities.clone(), 2),
        (Config { pointer: pointer.clone(), ..base.clone() }, entities.clone(), 4),
        (Config { pointer, pre_norm: true, use_vae: false, ..base.clone() }, entities, 1),
        (base.clone(), history, 4),
        (Config { auxiliary: auxiliary.clone(), ..base.clone() }, with_auxiliary.clone(), 3),
        (Config { auxiliary, pre_norm: true, use_vae: false, ..base.clone() }, with_auxiliary, 2),
        (Config { n_decoder_layers: 3, action_horizon: 17, n_vae_encoder_layers: 1, ..gelu.clone() }, no_env, 2),
        (Config { pre_norm: true, use_vae: false, ..gelu }, plain.clone(), 1),
        (Config { dim_model: 35, n_heads: 1, dim_feedforward: 70, action_horizon: 1, dropout: 0.0, ..base }, plain, 5),
    ]
}

fn cases() -> impl Iterator<Item = (Act, Batch, String)> {
    configs().into_iter().map(|(config, signature, rows)| {
        let act = Act::new(&config, &signature, 1, &Backend::CPU).unwrap();
        move_parameters(&act);
        (act, batch(&signature, config.action_horizon, rows, 3), format!("{config:?}"))
    })
}

/// With images, whose network has too many kinks for slopes.
fn seeing() -> impl Iterator<Item = (Act, Batch, String)> {
    let (first, _, _) = configs().swap_remove(0);
    let frozen = VisionConfig { norm: ImageNorm::Frozen, crop: None, ..vision_config() };
    let keypoints = VisionConfig { tokens: TokenKind::Keypoints { count: 3 }, ..vision_config() };
    let finer = VisionConfig { blocks: Some([2, 2, 1, 0]), ..vision_config() };
    [vision_config(), frozen, keypoints, finer].into_iter().map(move |vision| {
        let config = Config { vision: Some(vision), ..first.clone() };
        let signature = signatures().images;
        let act = Act::new(&config, &signature, 1, &Backend::CPU).unwrap();
        move_parameters(&act);
        (act, batch(&signature, config.action_horizon, 3, 3), format!("{config:?}"))
    })
}

#[test]
fn the_step_on_kernels_is_the_composed_one_with_dropout() {
    for (act, batch, what) in cases().chain(seeing()) {
        assert_the_step_is_the_composed_one(&act, &batch, &what);
    }
}

#[test]
fn the_prediction_by_hand_is_the_composed_one() {
    for (act, batch, what) in cases().chain(seeing()) {
        let want = act.predict_composed(&batch.observation).unwrap();
        for level in Level::ALL {
            let got = at_most(level, || act.predict(&batch.observation).unwrap());
            let off = (got - &want).unwrap().abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
            assert!(off < 1e-5, "{off} {level:?} {what}");
        }
    }
}

#[test]
fn the_gradient_is_the_slope_of_the_loss() {
    for (act, batch, what) in cases() {
        assert_the_gradient_is_the_slope(&act, &batch, &what);
    }
}

#[test]
fn the_same_seed_gives_the_same_bits_in_any_workspace() {
    let (act, batch, _) = cases().nth(1).unwrap();
    let bits = |g: &Gradients| g.values().iter().map(|x| x.to_bits()).collect::<Vec<_>>();
    let (first, second) = (gradients(&act, &batch), gradients(&act, &batch));
    assert_eq!(bits(&first.1), bits(&second.1));
    assert_eq!(first.0, second.0);
}

/// Entities of one group without positions are a set: their order changes nothing. With positions it does.
#[test]
fn the_chunk_does_not_depend_on_the_order_of_a_group() {
    let (config, signature, rows) =
        configs().into_iter().find(|(_, s, _)| s.get("observation.entity.goal0").is_some()).unwrap();
    let act = Act::new(&config, &signature, 1, &Backend::CPU).unwrap();
    move_parameters(&act);
    let batch = batch(&signature, config.action_horizon, rows, 3);
    let chunk = |swapped: Option<[&str; 2]>| {
        let mut observation = batch.observation.clone();
        if let Some([a, b]) = swapped.map(|names| names.map(|name| format!("observation.entity.{name}"))) {
            let (x, y) = (observation.get(&a).unwrap().clone(), observation.get(&b).unwrap().clone());
            observation.insert(&a, y);
            observation.insert(&b, x);
        }
        act.predict(&observation).unwrap()
    };
    let off =
        |other: Tensor| (other - chunk(None)).unwrap().abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
    assert!(off(chunk(Some(["cube0", "cube2"]))) < 1e-5);
    assert!(off(chunk(Some(["goal0", "goal1"]))) > 1e-3);
}

#[test]
fn features_that_act_cannot_read_are_refused_by_name() {
    let config = configs().remove(0).0;
    let error = |signature: Signature| Act::new(&config, &signature, 1, &Backend::CPU).unwrap_err().to_string();
    let mut signature = Signature::low_dimensional(3, 2, 2);
    let front = "observation.images.front";
    signature.observation.push(FeatureSpec { shape: vec![8, 8, 4], ..FeatureSpec::image(front, 8, 8) });
    let expected = "observation.images.front of shape [8, 8, 4], expected height, width and 3 colours";
    assert_eq!(error(signature.clone()), format!("config of vision: observation is {expected}"));
    signature.observation[2] = FeatureSpec::image(front, 8, 8);
    let with = |vision: VisionConfig| Config { vision: Some(vision), ..config.clone() };
    let small = Act::new(&with(VisionConfig { crop: Some(9), ..vision_config() }), &signature, 1, &Backend::CPU)
        .unwrap_err()
        .to_string();
    assert_eq!(small, "config of vision: crop is 9, expected at most the image's side, 8");
    for blocks in [[0, 2, 2, 2], [2, 0, 2, 2], [0; 4]] {
        let vision = VisionConfig { blocks: Some(blocks), crop: None, ..vision_config() };
        let refused = Act::new(&with(vision), &signature, 1, &Backend::CPU).unwrap_err().to_string();
        assert!(refused.starts_with(&format!("config of vision: blocks is {blocks:?}, expected")), "{refused}");
    }
    signature.n_obs_steps = 2;
    assert!(error(signature.clone()).contains("n_obs_steps is 2, expected 1 with images"));
    signature.n_obs_steps = 1;
    signature.observation = vec![FeatureSpec::environment_state(2)];
    let expected =
        "config of act: observation is observation.environment_state, expected a feature of kind state among others";
    assert_eq!(error(signature), expected);
}

#[test]
fn a_pointer_needs_candidates_and_a_weight() {
    let (base, signature, _) = configs().swap_remove(2);
    let error = |among: &str, weight: f64| {
        let pointer = Some(PointerConfig { among: among.to_string(), weight });
        Act::new(&Config { pointer, ..base.clone() }, &signature, 1, &Backend::CPU).unwrap_err().to_string()
    };
    // the goals have positions
    assert!(error("goal", 1.0).contains("pointer.among is 0 of group goal"), "{}", error("goal", 1.0));
    assert!(error("cube", -1.0).contains("pointer.weight"));
}

/// Shards' losses add up to the batch's, a batch that tells nothing is refused, and when it acts nobody asks.
#[test]
fn what_is_told_in_training_alone_is_asked_there_alone() {
    let (config, signature, rows) = configs().into_iter().find(|(config, ..)| config.auxiliary.is_some()).unwrap();
    let act = Act::new(&config, &signature, 1, &Backend::CPU).unwrap();
    let batch = batch(&signature, config.action_horizon, rows, 3);
    let loss = |batch: &Batch| {
        let eps = Tensor::zeros((batch.rows(), config.latent_dim), candle_core::DType::F32, &Device::Cpu).unwrap();
        let mut grads = Gradients::zeros(Arc::new(ParamLayout::new(act.params()))).unwrap();
        act.gradients_with(batch, &eps, None, &mut grads).and_then(|loss| Ok(loss.read()?.parts["auxiliary_loss"]))
    };
    let whole = loss(&batch).unwrap();
    let shards: f32 = batch.shards(2).unwrap().iter().map(|shard| loss(shard).unwrap()).sum();
    assert!(whole > 0.1 && (whole - shards).abs() < 1e-5, "{whole} {shards}");
    let error = |auxiliary| loss(&Batch { auxiliary, ..batch.clone() }).unwrap_err().to_string();
    assert!(error(None).contains("auxiliary numbers") && error(None).contains("nothing"), "{}", error(None));
    let narrow = Tensor::zeros((rows, 2), candle_core::DType::F32, &Device::Cpu).unwrap();
    assert!(error(Some(narrow)).contains("[3, 2], expected [3, 3]"));

    let head = |params: &nn::Params| {
        let (_, weight) = params.iter().find(|(name, _)| *name == "auxiliary_head.weight").unwrap();
        weight.clone()
    };
    let before = act.predict(&batch.observation).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
    let weight = head(act.params());
    weight.set(&(weight.as_tensor() + 1.0).unwrap()).unwrap();
    let after = act.predict(&batch.observation).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
    assert_eq!(before, after);

    let refused =
        |config: &Config, signature: &Signature| Act::new(config, signature, 1, &Backend::CPU).unwrap_err().to_string();
    let silent = Signature { auxiliary_dim: 0, ..signature.clone() };
    assert!(refused(&config, &silent).contains("auxiliary_dim is 0"), "{}", refused(&config, &silent));
    let heavy = Config { auxiliary: Some(AuxiliaryConfig { weight: f64::INFINITY }), ..config };
    assert!(refused(&heavy, &signature).contains("auxiliary.weight"));
}
