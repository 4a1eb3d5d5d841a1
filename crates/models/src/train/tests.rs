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
    PolicyConfig::Act(config).build(&Signature::low_dimensional(3, 2, 2), seed).unwrap()
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
        let mut trainer =
            Trainer::new(config.build(&Signature::low_dimensional(3, 2, 2), 1).unwrap(), self::config(), 5).unwrap();
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
        let fresh = config.build(&Signature::low_dimensional(3, 2, 2), 2).unwrap();
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
        let model = PolicyConfig::Act(still.clone()).build(&Signature::low_dimensional(3, 2, 2), 1).unwrap();
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

/// A model whose training steps run on candle's operations, as on a device without kernels of its own.
struct Fallback(Box<dyn PolicyModel>);

impl PolicyModel for Fallback {
    fn params(&self) -> &nn::Params {
        self.0.params()
    }

    fn signature(&self) -> &Signature {
        self.0.signature()
    }

    fn loss(&self, batch: &Batch, rng: &mut Rng) -> nn::Result<nn::LossParts> {
        self.0.loss(batch, rng)
    }

    fn predict(&self, observation: &Features<Tensor>) -> nn::Result<Tensor> {
        self.0.predict(observation)
    }

    fn policy(
        self: std::sync::Arc<Self>,
        _: std::sync::Arc<crate::Preprocess>,
        _: Box<dyn crate::Clock>,
    ) -> Box<dyn crate::Policy> {
        unreachable!("it trains")
    }

    fn action_horizon(&self) -> usize {
        self.0.action_horizon()
    }
}

/// Policies on hand-written kernels and on candle's operations: 50 steps of training end with the same losses.
#[test]
fn the_fallback_trains_to_the_same_losses() {
    use serde_json::json;
    let of = crate::testing::signatures();
    let act = json!({"action_horizon": 5, "dim_model": 12, "n_heads": 3, "dim_feedforward": 19, "latent_dim": 3});
    let actrm = |reasoning| {
        let mut config = act.clone();
        config["reasoning"] = reasoning;
        config
    };
    let pointer = json!({"among": "cube", "weight": 0.7});
    let mut pointing = actrm(json!({"over": "tokens"}));
    pointing["pointer"] = pointer.clone();
    let grid = json!({"over": "tokens", "grid": {"among": "cell", "columns": 3, "way": 0.5}});
    let memory = json!({"over": "memory", "n_layers": 1, "h_cycles": 2, "l_cycles": 2, "supervision_steps": 2});
    let rnn = |cell| json!({"action_horizon": 3, "hidden_dim": 9, "n_modes": 2, "min_std": 0.05, "cell": cell});
    let transformer = json!({"dim_model": 12, "n_heads": 2, "n_layers": 2, "n_modes": 2, "min_std": 0.05});
    for (kind, mut policy, signature) in [
        ("act", act.clone(), &of.plain),
        ("bc", json!({"action_horizon": 3, "hidden": [11, 7]}), &of.plain),
        ("actrm", actrm(json!({"h_cycles": 2, "l_cycles": 2})), &of.entities),
        ("actrm", actrm(json!({"warm_start": {"noise": 0.1}})), &of.plain),
        ("actrm", pointing, &of.entities),
        ("actrm", actrm(grid), &of.grid),
        ("actrm", actrm(memory), &of.plain),
        ("bc_rnn", rnn("lstm"), &of.history),
        ("bc_rnn", rnn("gru"), &of.history),
        ("bc_transformer", transformer, &of.history),
    ] {
        policy["type"] = kind.into();
        let policy: PolicyConfig = serde_json::from_value(policy).unwrap();
        let losses = |fallback: bool| {
            let model = policy.build(signature, 1).unwrap();
            let model = if fallback { Box::new(Fallback(model)) as Box<dyn PolicyModel> } else { model };
            let config = TrainConfig { steps: 50, lr: 1e-3, warmup_steps: 5, ..Default::default() };
            let mut trainer = Trainer::new(model, config, 5).unwrap();
            let batch = crate::testing::batch(signature, policy.action_horizon(), 4, 3);
            (0..50).map(|_| trainer.step(&batch).unwrap().loss).collect::<Vec<_>>()
        };
        let (fast, fallback) = (losses(false), losses(true));
        for (step, (a, b)) in fast.iter().zip(&fallback).enumerate() {
            assert!((a - b).abs() < 1e-3 * b.abs().max(1.0), "{policy:?}, step {step}: {a} and {b}");
        }
        assert!(fast[49] < fast[0], "{policy:?}: {} and {}", fast[0], fast[49]);
    }
}
