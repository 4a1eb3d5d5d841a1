//! Steps and thoughts on hand-written kernels beside those on candle's operations, in all designs.
#![allow(clippy::unwrap_used)]
use super::*;
use crate::cases::Signatures;
use crate::encoders::{TokenKind, VisionConfig};
use crate::features::Signature;
use crate::layers::{Activation, AuxiliaryConfig, GridConfig, PointerConfig};
use crate::testing::{
    assert_the_gradient_is_the_slope, assert_the_step_is_the_composed_one, batch, gradients, move_parameters,
    signatures, vision_config,
};
use candle_core::Tensor;
use nn::simd::{Level, at_most};

/// Odd sizes in all designs: no width is a multiple of a vector, more and fewer tokens than a register tile has rows.
fn configs() -> Vec<(Config, Signature, usize)> {
    let Signatures { plain, no_env, entities, history, grid, with_auxiliary, .. } = signatures();
    let auxiliary = Some(AuxiliaryConfig { weight: 0.6 });
    let cells = |way| Some(GridConfig { among: "cell".to_string(), columns: 3, way });
    let base = Config {
        action_horizon: 5,
        dim_model: 12,
        n_heads: 3,
        dim_feedforward: 19,
        latent_dim: 3,
        dropout: 0.2,
        ..Default::default()
    };
    let reasoning = |change: &dyn Fn(&mut ReasoningConfig)| {
        let mut reasoning = ReasoningConfig { tokens: 3, ..Default::default() };
        change(&mut reasoning);
        Config { reasoning, ..base.clone() }
    };
    let memory = |change: &dyn Fn(&mut ReasoningConfig)| {
        let mut reasoning = ReasoningConfig {
            n_layers: 2,
            h_cycles: 2,
            l_cycles: 2,
            supervision_steps: 3,
            ..ReasoningConfig::original()
        };
        change(&mut reasoning);
        Config { reasoning, ..base.clone() }
    };
    let tokens = |pointer: bool, change: &dyn Fn(&mut ReasoningConfig)| {
        let mut reasoning = ReasoningConfig { over: Over::Tokens, supervision_steps: 3, ..Default::default() };
        change(&mut reasoning);
        let pointer = pointer.then(|| PointerConfig { among: "cube".to_string(), weight: 0.7 });
        Config { reasoning, pointer, ..base.clone() }
    };
    let warm = Some(WarmStart { noise: 0.1 });
    let gelu = Activation::Gelu;
    vec![
        (reasoning(&|_| ()), plain.clone(), 3),
        (reasoning(&|r| r.warm_start = warm), entities.clone(), 3),
        (reasoning(&|_| ()), history.clone(), 2),
        (Config { auxiliary, n_memory_layers: 2, ..reasoning(&|r| r.h_cycles = 2) }, with_auxiliary, 3),
        (reasoning(&|r| (r.untied, r.n_layers, r.h_cycles, r.l_cycles) = (true, 2, 2, 2)), entities.clone(), 3),
        (reasoning(&|r| (r.start_noise, r.deep_supervision) = (0.7, false)), plain.clone(), 3),
        (tokens(true, &|_| ()), entities.clone(), 4),
        (tokens(true, &|r| (r.untied, r.n_layers, r.l_cycles) = (true, 2, 2)), entities.clone(), 3),
        (tokens(true, &|r| (r.start_noise, r.deep_supervision) = (0.7, false)), entities.clone(), 3),
        (Config { n_decoder_layers: 2, ..tokens(false, &|r| r.dim_feedforward = Some(7)) }, history.clone(), 2),
        (Config { use_vae: false, ..tokens(true, &|r| r.n_layers = 2) }, entities.clone(), 2),
        (tokens(false, &|r| (r.grid, r.l_cycles) = (cells(0.9), 2)), grid.clone(), 3),
        (tokens(false, &|r| (r.grid, r.untied, r.n_layers) = (cells(0.3), true, 2)), grid.clone(), 2),
        (Config { use_vae: false, ..tokens(false, &|r| (r.grid, r.start_noise) = (cells(0.0), 0.4)) }, grid, 4),
        (memory(&|r| r.supervision_steps = 2), entities, 2),
        (memory(&|_| ()), history, 2),
        (
            Config { action_horizon: 17, feedforward_activation: gelu, ..reasoning(&|r| r.n_layers = 2) },
            no_env.clone(),
            2,
        ),
        (Config { n_memory_layers: 0, use_vae: false, ..reasoning(&|r| r.l_cycles = 3) }, plain.clone(), 4),
        (reasoning(&|r| (r.h_cycles, r.l_cycles, r.n_layers) = (3, 2, 2)), plain.clone(), 1),
        (
            Config { n_memory_layers: 2, n_vae_encoder_layers: 2, ..reasoning(&|r| r.warm_start = warm) },
            plain.clone(),
            5,
        ),
        (
            Config { dim_model: 35, n_heads: 1, action_horizon: 1, dropout: 0.0, ..reasoning(&|r| r.tokens = 1) },
            plain.clone(),
            5,
        ),
        (memory(&|_| ()), plain.clone(), 3),
        (Config { n_decoder_layers: 2, feedforward_activation: gelu, ..memory(&|r| r.n_layers = 1) }, no_env, 2),
        (Config { use_vae: false, action_horizon: 13, ..memory(&|r| r.h_cycles = 1) }, plain, 4),
    ]
}

fn model(config: &Config, signature: &Signature) -> Actrm {
    let model = Actrm::new(config, signature, 1, &Backend::CPU).unwrap();
    move_parameters(&model);
    model
}

/// With images, in all designs; their network has too many kinks for slopes.
fn seeing() -> Vec<(Config, Signature, usize)> {
    let all = configs();
    let plain = |config: &Config| config.use_vae && config.pointer.is_none() && config.reasoning.grid.is_none();
    let of = |over: Over| all.iter().find(|(config, ..)| config.reasoning.over == over && plain(config));
    let designs = [Over::Actions, Over::Memory, Over::Tokens].into_iter().filter_map(of);
    let keypoints = VisionConfig { tokens: TokenKind::Keypoints { count: 3 }, ..vision_config() };
    let sees = |config: &Config, vision| (Config { vision: Some(vision), ..config.clone() }, signatures().images, 2);
    designs.flat_map(|(config, ..)| [sees(config, vision_config()), sees(config, keypoints.clone())]).collect()
}

#[test]
fn the_step_on_kernels_is_the_composed_one_with_dropout() {
    assert_eq!(seeing().len(), 6);
    for (config, signature, rows) in configs().into_iter().chain(seeing()) {
        let model = model(&config, &signature);
        for seed in [3, 4] {
            let batch = batch(&signature, config.action_horizon, rows, seed);
            assert_the_step_is_the_composed_one(&model, &batch, &format!("{config:?}"));
        }
    }
}

#[test]
fn the_reasoning_on_kernels_is_the_composed_one() {
    for (mut config, signature, rows) in configs().into_iter().chain(seeing()) {
        config.reasoning.max_steps = Some(4);
        config.reasoning.change_threshold = 0.05;
        let model = model(&config, &signature);
        let batch = batch(&signature, config.action_horizon, rows, 3);
        let first = model.reason_composed(&batch.observation, None, &mut |_| false).unwrap();
        for start in [None, Some(&first.answer)] {
            let want = model.reason_composed(&batch.observation, start, &mut |_| false).unwrap();
            for level in Level::ALL {
                let got = at_most(level, || model.reason(&batch.observation, start, &mut |_| false).unwrap());
                let same = |a: &Tensor, b: &Tensor| {
                    let off = (a - b).unwrap().abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
                    // through a network for images and four rounds of thought
                    let tolerance = if config.vision.is_some() { 1e-4 } else { 1e-5 };
                    assert!(off < tolerance, "{off} {level:?} {config:?}");
                };
                assert_eq!((got.steps.len(), &got.depth), (want.steps.len(), &want.depth), "{config:?}");
                for (got, want) in got.steps.iter().zip(&want.steps) {
                    same(&got.chunk, &want.chunk);
                    assert!(got.halt.iter().zip(&want.halt).all(|(a, b)| (a - b).abs() < 1e-5));
                }
                same(&got.chunk, &want.chunk);
                same(&got.answer, &want.answer);
            }
        }
    }
}

#[test]
fn the_gradient_is_the_slope_of_the_loss() {
    for (mut config, signature, rows) in configs() {
        // what the reference leaves without gradient on purpose: earlier rounds, earlier carries over the memory, what
        // the halting head reads, and warm answers
        config.reasoning.h_cycles = 1;
        config.reasoning.halt_weight = 0.0;
        config.reasoning.warm_start = None;
        if config.reasoning.over == Over::Memory {
            config.reasoning.supervision_steps = 1;
        }
        let batch = batch(&signature, config.action_horizon, rows, 3);
        assert_the_gradient_is_the_slope(&model(&config, &signature), &batch, &format!("{config:?}"));
    }
}

#[test]
fn the_same_seed_gives_the_same_bits_in_any_workspace() {
    for (config, signature, rows) in configs() {
        let (model, batch) = (model(&config, &signature), batch(&signature, config.action_horizon, rows, 3));
        let (first, second) = (gradients(&model, &batch), gradients(&model, &batch));
        assert_eq!(first.0, second.0);
        assert!(first.1.values().iter().zip(second.1.values()).all(|(a, b)| a.to_bits() == b.to_bits()));
    }
}
