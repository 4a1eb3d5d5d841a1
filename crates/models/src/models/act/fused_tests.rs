#![allow(clippy::unwrap_used)]
use super::*;
use crate::Dims;
use crate::fused::testing::{
    assert_the_gradient_is_the_slope, assert_the_step_is_the_composed_one, batch, gradients, move_parameters,
};
use crate::layers::Activation;
use crate::models::act::Config;
use crate::simd::{Level, at_most};

/// Odd sizes: no width is a multiple of a vector, chunks are longer and shorter than a register tile.
fn configs() -> Vec<(Config, Dims, usize)> {
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
    let dims = Dims { state: 3, environment_state: 2, action: 2 };
    let no_env = Dims { environment_state: 0, ..dims };
    let gelu = Config { feedforward_activation: Activation::Gelu, ..base.clone() };
    vec![
        (base.clone(), dims, 3),
        (Config { pre_norm: true, n_decoder_layers: 2, ..base.clone() }, dims, 4),
        (Config { n_decoder_layers: 3, action_horizon: 17, n_vae_encoder_layers: 1, ..gelu.clone() }, no_env, 2),
        (Config { pre_norm: true, use_vae: false, ..gelu }, dims, 1),
        (Config { dim_model: 35, n_heads: 1, dim_feedforward: 70, action_horizon: 1, dropout: 0.0, ..base }, dims, 5),
    ]
}

fn cases() -> impl Iterator<Item = (Act, Batch, String)> {
    configs().into_iter().map(|(config, dims, rows)| {
        let act = Act::new(&config, &dims, 1).unwrap();
        move_parameters(&act);
        (act, batch(&dims, config.action_horizon, rows, 3), format!("{config:?}"))
    })
}

#[test]
fn the_fused_step_is_the_composed_one_with_dropout() {
    for (act, batch, what) in cases() {
        assert_the_step_is_the_composed_one(&act, &batch, &what);
    }
}

#[test]
fn the_fused_prediction_is_the_composed_one() {
    for (act, batch, what) in cases() {
        let env = batch.environment_state.as_ref();
        let want = act.predict_composed(&batch.state, env).unwrap();
        for level in Level::ALL {
            let got = at_most(level, || act.fused_predict(&batch.state, env).unwrap());
            let off = (got - &want).unwrap().abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
            assert!(off < 1e-5, "{off} {level:?} {what}");
        }
    }
}

#[test]
fn the_fused_gradient_is_the_slope_of_the_loss() {
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
