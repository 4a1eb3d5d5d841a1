#![allow(clippy::unwrap_used)]
use super::*;
use crate::Dims;
use crate::act::Config;
use crate::gradients::ParamLayout;
use crate::layers::Activation;
use std::sync::Arc;

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

/// A model whose norms and biases are not at their initial 1 and 0, where errors would hide.
fn moved(config: &Config, dims: &Dims) -> Act {
    let act = Act::new(config, dims, 1).unwrap();
    let mut rng = Rng::new(2, "moved");
    for (_, var) in act.params().iter() {
        let noise = Tensor::from_vec(rng.normals(var.elem_count()), var.dims(), &Device::Cpu).unwrap();
        var.set(&(var.as_tensor() + (noise * 0.1).unwrap()).unwrap()).unwrap();
    }
    act
}

fn batch(config: &Config, dims: &Dims, rows: usize) -> Batch {
    let mut rng = Rng::new(3, "batch");
    let h = config.action_horizon;
    let (s, e) = (rng.normals(rows * dims.state), rng.normals(rows * dims.environment_state));
    let a = rng.normals(rows * h * dims.action);
    let pad: Vec<bool> = (0..rows * h).map(|i| i / h % 2 == 1 && i % h > h / 2).collect();
    Batch::from_slices(dims, h, &s, &e, &a, &pad).unwrap()
}

fn fused(act: &Act, batch: &Batch) -> (LossValues, Gradients) {
    let mut grads = Gradients::zeros(Arc::new(ParamLayout::new(act.params())));
    let loss = act.accumulate_gradients(batch, &mut Rng::new(4, "step"), &mut grads).unwrap();
    (loss, grads)
}

#[test]
fn the_fused_step_is_the_composed_one_with_dropout() {
    for (config, dims, rows) in configs() {
        let act = moved(&config, &dims);
        let batch = batch(&config, &dims, rows);
        let composed = act.loss(&batch, &mut Rng::new(4, "step")).unwrap();
        let want = LossValues::from_parts(&composed).unwrap();
        let tape = composed.total.backward().unwrap();
        let (got, grads) = fused(&act, &batch);
        assert!((got.total - want.total).abs() < 1e-5 * want.total.abs().max(1.0), "{got:?} {want:?} {config:?}");
        for (name, var) in act.params().iter() {
            let want = tape.get(var).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
            let scale = want.iter().fold(1e-2f32, |m, x| m.max(x.abs()));
            for (g, w) in grads.get(name).unwrap().iter().zip(&want) {
                assert!((g - w).abs() < 1e-4 * scale, "{name}: {g} {w} (largest {scale}) {config:?}");
            }
        }
        // a second pass into the same buffers, with a used workspace, adds the same again
        let mut twice = grads.clone();
        act.accumulate_gradients(&batch, &mut Rng::new(4, "step"), &mut twice).unwrap();
        for (a, b) in twice.values().iter().zip(grads.values()) {
            assert!((a - 2.0 * b).abs() <= 1e-5 * b.abs().max(1e-2), "{a} {b}");
        }
    }
}

#[test]
fn the_fused_prediction_is_the_composed_one() {
    for (config, dims, rows) in configs() {
        let act = moved(&config, &dims);
        let batch = batch(&config, &dims, rows);
        let env = batch.environment_state.as_ref();
        let (got, want) =
            (act.fused_predict(&batch.state, env).unwrap(), act.predict_composed(&batch.state, env).unwrap());
        let off =
            (got - want).unwrap().abs().unwrap().flatten_all().unwrap().max(0).unwrap().to_scalar::<f32>().unwrap();
        assert!(off < 1e-5, "{off} {config:?}");
    }
}

/// Shifts all parameters by `size` times the gradient's direction.
fn shifted(act: &Act, grads: &Gradients, size: f64) -> Act {
    let other = Act::new(act.config(), act.dims(), 1).unwrap();
    for (name, var) in act.params().iter() {
        let direction = Tensor::from_slice(grads.get(name).unwrap(), var.dims(), &Device::Cpu).unwrap();
        let value = (var.as_tensor() + (direction * size).unwrap()).unwrap();
        other.params().get(name).unwrap().set(&value).unwrap();
    }
    other
}

#[test]
fn the_fused_gradient_is_the_slope_of_the_loss() {
    for (config, dims, rows) in configs() {
        let act = moved(&config, &dims);
        let batch = batch(&config, &dims, rows);
        let (_, grads) = fused(&act, &batch);
        let norm = grads.values().iter().map(|g| f64::from(*g).powi(2)).sum::<f64>().sqrt();
        let size = 1e-3 / norm;
        let loss = |size: f64| f64::from(fused(&shifted(&act, &grads, size), &batch).0.total);
        let slope = (loss(size) - loss(-size)) / (2.0 * size);
        // along the gradient the slope is its squared norm; f32 and kinks leave some percent
        assert!((slope / (norm * norm) - 1.0).abs() < 0.03, "{slope} {} {config:?}", norm * norm);
    }
}

#[test]
fn the_same_seed_gives_the_same_bits_in_any_workspace() {
    let (config, dims, rows) = configs().remove(1);
    let act = moved(&config, &dims);
    let batch = batch(&config, &dims, rows);
    let bits = |g: &Gradients| g.values().iter().map(|x| x.to_bits()).collect::<Vec<_>>();
    let first = fused(&act, &batch);
    let second = fused(&act, &batch);
    assert_eq!(bits(&first.1), bits(&second.1));
    assert_eq!(first.0, second.0);
}
