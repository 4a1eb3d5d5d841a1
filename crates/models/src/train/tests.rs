#![allow(clippy::unwrap_used)]
use super::*;
use crate::{Batch, Features, PolicyConfig, PolicyModel, Rng, Signature, act};
use candle_core::Tensor;
use std::collections::BTreeMap;

const HORIZON: usize = 4;

fn model(seed: u64) -> Box<dyn PolicyModel> {
    let config = act::Config {
        action_horizon: HORIZON,
        dim_model: 8,
        n_heads: 2,
        dim_feedforward: 12,
        n_encoder_layers: 1,
        n_vae_encoder_layers: 2,
        latent_dim: 3,
        ..Default::default()
    };
    PolicyConfig::Act(config).build(&Signature::low_dimensional(3, 2, 2), seed, &nn::Backend::CPU).unwrap()
}

fn batch(seed: u64, rows: usize) -> Batch {
    let mut rng = Rng::new(seed, "test data");
    let pad: Vec<bool> = (0..rows * HORIZON).map(|i| i % HORIZON > 1 && i % 3 == 0).collect();
    let (s, e, a) = (rng.normals(rows * 3), rng.normals(rows * 2), rng.normals(rows * HORIZON * 2));
    Batch::from_slices(&Signature::low_dimensional(3, 2, 2), HORIZON, &Features::of_slices(&s, &e), &a, &pad).unwrap()
}

fn config() -> TrainConfig {
    TrainConfig { steps: 20, warmup_steps: 3, ema_decay: Some(0.9), ..Default::default() }
}

fn bits(tensors: &BTreeMap<String, Tensor>) -> BTreeMap<String, Vec<u32>> {
    let bits = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap().iter().map(|x| x.to_bits()).collect();
    tensors.iter().map(|(k, t)| (k.clone(), bits(t))).collect()
}

#[test]
fn the_same_seed_gives_the_same_bits() {
    let run = || {
        let mut trainer = Trainer::new(model(1), config(), 5).unwrap();
        for k in 0..4 {
            trainer.step(&batch(k, 7)).unwrap();
        }
        bits(&trainer.state().unwrap().tensors)
    };
    assert_eq!(run(), run());
}

#[test]
fn one_thread_gives_the_same_bits() {
    let run = |threads: usize| {
        let mut trainer = Trainer::new(model(1), TrainConfig { accumulation: 2, ..config() }, 5).unwrap();
        trainer.set_threads(threads);
        for k in 0..3 {
            trainer.step(&batch(k, 7)).unwrap();
        }
        bits(&trainer.state().unwrap().tensors)
    };
    assert_eq!(run(1), run(2));
}

#[test]
fn predictions_use_the_weights_as_they_are_now() {
    for kind in ["act", "actrm"] {
        let config = serde_json::json!({
            "type": kind, "action_horizon": HORIZON, "dim_model": 16, "n_heads": 2, "dim_feedforward": 24,
        });
        let config: PolicyConfig = serde_json::from_value(config).unwrap();
        let mut trainer = Trainer::new(
            config.build(&Signature::low_dimensional(3, 2, 2), 1, &nn::Backend::CPU).unwrap(),
            self::config(),
            5,
        )
        .unwrap();
        let batch = batch(0, 5);
        let predict = |model: &dyn PolicyModel| {
            let chunk = model.predict(&batch.observation).unwrap();
            chunk.flatten_all().unwrap().to_vec1::<f32>().unwrap()
        };
        let before = predict(trainer.model());
        let weights = trainer.state().unwrap();
        trainer.step(&batch).unwrap();
        let after = predict(trainer.model());
        assert_ne!(before, after, "{kind}");
        // a model that never predicted before knows no other weights
        let fresh = config.build(&Signature::low_dimensional(3, 2, 2), 2, &nn::Backend::CPU).unwrap();
        let now: BTreeMap<_, _> = trainer.model().params().tensors();
        fresh.params().load(&now).unwrap();
        assert_eq!(predict(fresh.as_ref()), after, "{kind}");
        trainer.restore(&weights).unwrap();
        assert_eq!(predict(trainer.model()), before, "{kind}");
    }
}

#[test]
fn a_resumed_training_gives_the_same_bits() {
    let mut whole = Trainer::new(model(1), config(), 5).unwrap();
    let mut saved = None;
    for k in 0..6 {
        if k == 3 {
            saved = Some(whole.state().unwrap());
        }
        whole.step(&batch(k, 6)).unwrap();
    }
    // another model and another seed: everything must come from the state
    let mut resumed = Trainer::new(model(2), config(), 6).unwrap();
    resumed.step(&batch(9, 6)).unwrap();
    resumed.restore(&saved.unwrap()).unwrap();
    assert_eq!(resumed.step_count(), 3);
    for k in 3..6 {
        resumed.step(&batch(k, 6)).unwrap();
    }
    assert_eq!(bits(&resumed.state().unwrap().tensors), bits(&whole.state().unwrap().tensors));
    assert_eq!(resumed.state().unwrap().meta, whole.state().unwrap().meta);
    assert_eq!(bits(&resumed.eval_params().unwrap()), bits(&whole.eval_params().unwrap()));
}

#[test]
fn a_state_that_does_not_fit_is_refused_and_changes_nothing() {
    let mut trainer = Trainer::new(model(1), config(), 5).unwrap();
    trainer.step(&batch(0, 4)).unwrap();
    let good = trainer.state().unwrap();
    let mut bad = good.clone();
    bad.tensors.remove("moment2.action_head.bias");
    let error = trainer.restore(&bad).unwrap_err();
    assert!(error.to_string().contains("moment2.action_head.bias"), "{error}");
    let mut bad = good.clone();
    bad.tensors.insert("stray".into(), bad.tensors["param.action_head.bias"].clone());
    assert!(trainer.restore(&bad).unwrap_err().to_string().contains("stray"));
    assert_eq!(bits(&trainer.state().unwrap().tensors), bits(&good.tensors));
}

#[test]
fn a_loss_that_is_not_finite_names_step_and_tensor_and_keeps_the_weights() {
    let mut trainer = Trainer::new(model(1), config(), 5).unwrap();
    trainer.step(&batch(0, 4)).unwrap();
    let before = trainer.state().unwrap();
    let mut bad = batch(1, 4);
    bad.actions = (bad.actions * f64::NAN).unwrap();
    let error = trainer.step(&bad).unwrap_err().to_string();
    assert!(error.contains("step 2") && error.contains("batch.actions"), "{error}");
    assert_eq!(bits(&trainer.state().unwrap().tensors), bits(&before.tensors));
    assert_eq!(trainer.state().unwrap().meta, before.meta);
}

#[test]
fn training_lowers_the_loss() {
    let settings = TrainConfig { steps: 60, lr: 3e-3, ..config() };
    let mut trainer = Trainer::new(model(1), settings, 5).unwrap();
    let batch = batch(0, 8);
    let first = trainer.step(&batch).unwrap().parts["l1_loss"];
    let mut last = first;
    for _ in 0..59 {
        last = trainer.step(&batch).unwrap().parts["l1_loss"];
    }
    assert!(last < 0.9 * first, "{first} {last}");
}

#[test]
fn accumulation_gives_the_gradient_of_the_whole_batch() {
    // without dropout and with the VAE off nothing is drawn: only the order of additions differs
    let still = act::Config {
        action_horizon: HORIZON,
        dim_model: 8,
        n_heads: 2,
        dim_feedforward: 12,
        use_vae: false,
        dropout: 0.0,
        ..Default::default()
    };
    let run = |accumulation: usize| {
        let model =
            PolicyConfig::Act(still.clone()).build(&Signature::low_dimensional(3, 2, 2), 1, &nn::Backend::CPU).unwrap();
        let mut trainer = Trainer::new(model, TrainConfig { accumulation, ..config() }, 5).unwrap();
        trainer.step(&batch(3, 8)).unwrap()
    };
    let (one, three) = (run(1), run(3));
    assert!(
        (one.loss - three.loss).abs() < 1e-5 && (one.grad_norm - three.grad_norm).abs() < 1e-4,
        "{one:?} {three:?}"
    );
}

#[test]
fn the_schedule_rises_then_falls() {
    let config = TrainConfig { steps: 110, lr: 1.0, warmup_steps: 10, min_lr_ratio: 0.1, ..Default::default() };
    assert!((config.lr_at(0) - 0.1).abs() < 1e-12 && (config.lr_at(9) - 1.0).abs() < 1e-12);
    assert!((config.lr_at(60) - 0.55).abs() < 1e-12 && (config.lr_at(110) - 0.1).abs() < 1e-12);
    let flat = TrainConfig { schedule: Schedule::Constant, ..config };
    assert_eq!(flat.lr_at(99), 1.0);
    assert!(TrainConfig { accumulation: 0, ..Default::default() }.validate().is_err());
}

/// Every policy on hand-written kernels and on candle's operations, augmentation, clipping, optimiser and moving average
/// included: 50 steps of training end with the same losses, weights and predictions.
#[test]
fn the_fallback_trains_to_the_same_losses() {
    for (policy, signature) in &crate::cases::policies() {
        let train = |backend: nn::Backend| {
            let model = policy.build(signature, 1, &backend).unwrap();
            let config =
                TrainConfig { steps: 50, lr: 1e-3, warmup_steps: 5, ema_decay: Some(0.8), ..Default::default() };
            let mut trainer = Trainer::new(model, config, 5).unwrap();
            let batch = crate::testing::batch(signature, policy.action_horizon(), 4, 3);
            let losses = (0..50).map(|_| trainer.step(&batch).unwrap().loss).collect::<Vec<_>>();
            let chunk = trainer.model().predict(&batch.observation).unwrap();
            (losses, trainer.eval_params().unwrap(), chunk.flatten_all().unwrap().to_vec1::<f32>().unwrap())
        };
        let (fast, averages, chunk) = train(nn::Backend::CPU);
        let (fallback, of_fallback, chunk_of_fallback) = train(nn::Backend::composed(candle_core::Device::Cpu));
        for (step, (a, b)) in fast.iter().zip(&fallback).enumerate() {
            assert!((a - b).abs() < 1e-3 * b.abs().max(1.0), "{policy:?}, step {step}: {a} and {b}");
        }
        for (name, average) in &averages {
            let off = (average - &of_fallback[name]).unwrap().abs().unwrap().flatten_all().unwrap().max(0).unwrap();
            let off = off.to_scalar::<f32>().unwrap();
            // Adam moves by its rate wherever a gradient is almost zero, whatever its sign
            assert!(off < 2e-2, "{policy:?}, {name}: {off}");
        }
        let off = chunk.iter().zip(&chunk_of_fallback).fold(0f32, |off, (a, b)| off.max((a - b).abs()));
        assert!(off < 2e-2, "{policy:?}: predictions are {off} apart");
        let ten = |from: usize| fast[from..from + 10].iter().sum::<f32>();
        assert!(ten(40) < ten(0), "{policy:?}: {} and {}", ten(0), ten(40));
    }
}

/// Trainings on candle's operations resume, and say what is not finite, as those on kernels do.
#[test]
fn the_fallback_resumes_and_names_what_is_not_finite() {
    let config =
        act::Config { action_horizon: HORIZON, dim_model: 8, n_heads: 2, dim_feedforward: 12, ..Default::default() };
    let trainer = |seed: u64| {
        let backend = nn::Backend::composed(candle_core::Device::Cpu);
        let model = PolicyConfig::Act(config.clone()).build(&Signature::low_dimensional(3, 2, 2), seed, &backend);
        Trainer::new(model.unwrap(), self::config(), seed).unwrap()
    };
    let (mut whole, mut resumed) = (trainer(1), trainer(2));
    whole.step(&batch(0, 4)).unwrap();
    let saved = whole.state().unwrap();
    whole.step(&batch(1, 4)).unwrap();
    resumed.restore(&saved).unwrap();
    let mut bad = batch(1, 4);
    bad.actions = (bad.actions * f64::NAN).unwrap();
    assert!(resumed.step(&bad).unwrap_err().to_string().contains("batch.actions"));
    resumed.step(&batch(1, 4)).unwrap();
    assert_eq!(bits(&resumed.state().unwrap().tensors), bits(&whole.state().unwrap().tensors));
    let mut bad = saved.clone();
    bad.tensors.remove("ema.action_head.bias");
    assert!(resumed.restore(&bad).unwrap_err().to_string().contains("ema.action_head.bias"));
}
