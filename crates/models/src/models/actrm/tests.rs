#![allow(clippy::unwrap_used)]
use super::*;
use crate::features::{Features, Observation};
use crate::gradients::ParamLayout;
use crate::models::act::{self, Act};
use crate::normaliser::{ACTION, ENVIRONMENT_STATE, NormMode, Normaliser, STATE};
use crate::policy::Policy;
use crate::preprocess::Preprocess;
use crate::registry::PolicyConfig;
use crate::train::{TrainConfig, Trainer};
use candle_core::Device;
use std::sync::Arc;

fn signature() -> Signature {
    Signature::low_dimensional(9, 10, 7)
}

fn small(reasoning: ReasoningConfig) -> Config {
    Config {
        action_horizon: 5,
        dim_model: 16,
        n_heads: 4,
        dim_feedforward: 24,
        latent_dim: 3,
        dropout: 0.0,
        reasoning,
        ..Config::default()
    }
}

fn designs() -> [Config; 3] {
    let deep = ReasoningConfig { h_cycles: 2, l_cycles: 2, ..ReasoningConfig::default() };
    let memory = ReasoningConfig { n_layers: 2, supervision_steps: 4, l_cycles: 2, ..ReasoningConfig::original() };
    [small(ReasoningConfig::default()), small(deep), small(memory)]
}

fn batch(config: &Config, rows: usize, seed: u64) -> Batch {
    let mut rng = Rng::new(seed, "batch");
    let h = config.action_horizon;
    let (state, env) = (rng.normals(rows * 9), rng.normals(rows * 10));
    // a chunk that depends on the observation: something to learn
    let actions: Vec<f32> = (0..rows * h * 7)
        .map(|i| {
            let (row, step, dim) = (i / (h * 7), i / 7 % h, i % 7);
            (state[row * 9 + dim] + env[row * 10 + step % 10]) * 0.5
        })
        .collect();
    let is_pad: Vec<bool> = (0..rows * h).map(|i| i % h == h - 1 && (i / h).is_multiple_of(3)).collect();
    Batch::from_slices(&signature(), h, &Features::of_slices(&state, &env), &actions, &is_pad).unwrap()
}

fn value(t: &Tensor) -> f32 {
    t.to_scalar().unwrap()
}

#[test]
fn it_has_at_most_half_of_acts_parameters() {
    let sizes = [(512, 3200, 100), (256, 1024, 32), (128, 512, 16)];
    for (dim_model, dim_feedforward, action_horizon) in sizes {
        let act = act::Config { dim_model, dim_feedforward, action_horizon, ..act::Config::default() };
        let ours = Config { dim_model, dim_feedforward, action_horizon, ..Config::default() };
        let act = Act::new(&act, &signature(), 0).unwrap().params().count();
        let ours = Actrm::new(&ours, &signature(), 0).unwrap().params().count();
        assert!(2 * ours <= act, "{ours} against {act} at width {dim_model}");
    }
}

#[test]
fn every_parameter_gets_a_gradient() {
    for config in designs() {
        let model = Actrm::new(&config, &signature(), 1).unwrap();
        // off the zeros that biases start from, which hide gradients behind them
        let mut rng = Rng::new(7, "noise");
        for (_, var) in model.params().iter() {
            let noise = Tensor::from_vec(rng.normals(var.elem_count()), var.shape(), &Device::Cpu).unwrap();
            var.set(&(var.as_tensor().detach() + (noise * 0.1).unwrap()).unwrap()).unwrap();
        }
        for seed in 0..2 {
            let mut batch = batch(&config, 6, seed);
            batch.seed = seed;
            let mut grads = Gradients::zeros(Arc::new(ParamLayout::new(model.params())));
            model.accumulate_gradients(&batch, &mut Rng::new(seed, "loss"), &mut grads).unwrap();
            let composed = model.loss(&batch, &mut Rng::new(seed, "loss")).unwrap().total.backward().unwrap();
            for (name, var) in model.params().iter() {
                let largest = grads.get(name).unwrap().iter().fold(0f32, |m, x| m.max(x.abs()));
                assert!(largest > 0.0 && largest.is_finite(), "{name}: {largest}");
                let grad = composed.get(var.as_tensor()).unwrap_or_else(|| panic!("{name} has no gradient"));
                assert!(value(&grad.abs().unwrap().max_all().unwrap()) > 0.0, "{name} has a zero gradient");
            }
        }
    }
}

#[test]
fn shards_add_up_to_the_batch() {
    for config in designs() {
        let config = Config { use_vae: false, ..config };
        let model = Actrm::new(&config, &signature(), 1).unwrap();
        let batch = batch(&config, 7, 3);
        let whole = value(&model.loss(&batch, &mut Rng::new(0, "loss")).unwrap().total);
        let shards = batch.shards(3).unwrap();
        let sum: f32 = shards.iter().map(|s| value(&model.loss(s, &mut Rng::new(0, "loss")).unwrap().total)).sum();
        assert!((whole - sum).abs() < 1e-5, "{whole} {sum}");
    }
}

#[test]
fn training_lowers_the_error_on_new_observations_and_depth_helps() {
    for mut config in [designs()[0].clone(), designs()[2].clone()] {
        config.reasoning.max_steps = Some(3);
        (config.reasoning.halt_threshold, config.reasoning.change_threshold) = (1.0, 0.0);
        let held_out = batch(&config, 64, 99);
        // the error at each depth, against that of always answering zero
        let errors = |model: &dyn PolicyModel, weights: &BTreeMap<String, Tensor>| -> Vec<f32> {
            let trained = Actrm::new(&config, &signature(), 1).unwrap();
            assert_eq!(model.params().count(), trained.params().count());
            trained.params().load(weights).unwrap();
            let thought = trained.reason(&held_out.observation, None, &mut |_| false).unwrap();
            let mean = |t: &Tensor| value(&t.abs().unwrap().mean_all().unwrap());
            let zero = mean(&held_out.actions);
            thought.steps.iter().map(|s| mean(&(&s.chunk - &held_out.actions).unwrap()) / zero).collect()
        };
        let settings = TrainConfig { steps: 500, lr: 5e-3, ema_decay: Some(0.98), ..TrainConfig::default() };
        let model = Box::new(Actrm::new(&config, &signature(), 1).unwrap());
        let mut trainer = Trainer::new(model, settings, 1).unwrap();
        for step in 0..500 {
            trainer.step(&batch(&config, 32, step)).unwrap();
        }
        let after = errors(trainer.model(), &trainer.eval_params().unwrap());
        println!("{:?}: {after:?}", config.reasoning.over);
        // the recursion over the memory learns this task more slowly
        let bar = if config.reasoning.over == Over::Actions { 0.35 } else { 0.8 };
        assert!(after[2] < bar, "{:?}: {after:?} of the error of answering zero", config.reasoning.over);
        if config.reasoning.over == Over::Actions {
            assert!(after[2] < after[0], "{after:?}: the last depth is no better than the first");
        }
    }
}

#[test]
fn a_rows_thought_does_not_depend_on_its_neighbours() {
    for mut config in designs() {
        config.reasoning.max_steps = Some(6);
        config.reasoning.change_threshold = 0.05;
        config.reasoning.halt_threshold = 0.7;
        let model = Actrm::new(&config, &signature(), 5).unwrap();
        let batch = batch(&config, 5, 1);
        let all = model.reason(&batch.observation, None, &mut |_| false).unwrap();
        for row in 0..5 {
            let one = batch.observation.map(|_, values| values.narrow(0, row, 1).unwrap());
            let one = model.reason(&one, None, &mut |_| false).unwrap();
            assert_eq!(one.depth[0], all.depth[row]);
            let other = all.chunk.narrow(0, row, 1).unwrap();
            let off = value(&(&one.chunk - other).unwrap().abs().unwrap().max_all().unwrap());
            assert!(off < 1e-5, "{off:e}");
        }
    }
}

#[test]
fn every_rule_stops_the_thought() {
    for base in designs() {
        let think = |change: f64, halt: f64, max: usize, stop_at: usize| {
            let mut config = base.clone();
            config.reasoning.change_threshold = change;
            config.reasoning.halt_threshold = halt;
            config.reasoning.max_steps = Some(max);
            let model = Actrm::new(&config, &signature(), 5).unwrap();
            let batch = batch(&config, 2, 1);
            model.reason(&batch.observation, None, &mut |done| done >= stop_at).unwrap()
        };
        assert_eq!(think(0.0, 1.0, 5, 99).depth, [5, 5]);
        assert_eq!(think(0.0, 1.0, 5, 2).depth, [2, 2]);
        assert_eq!(think(1e9, 1.0, 5, 99).depth, [2, 2]); // the first step has no change yet
        assert_eq!(think(0.0, 0.0, 5, 99).depth, [1, 1]);
        let thought = think(0.0, 1.0, 3, 99);
        assert_eq!(thought.steps.len(), 3);
        for (step, before) in thought.steps[1..].iter().zip(&thought.steps) {
            let change = (&step.chunk - &before.chunk).unwrap().abs().unwrap().mean((1, 2)).unwrap();
            assert_eq!(change.to_vec1::<f32>().unwrap(), step.change);
            assert!(step.halt.iter().all(|h| (0.0..=1.0).contains(h)));
        }
    }
}

fn identity() -> Arc<Preprocess> {
    let modes = [STATE, ENVIRONMENT_STATE, ACTION].map(|name| (name.to_string(), NormMode::Identity));
    let normaliser = Normaliser::new(&BTreeMap::from(modes), &BTreeMap::new()).unwrap();
    Arc::new(Preprocess::new(signature(), normaliser).unwrap())
}

fn observation(seed: u64) -> Observation {
    let mut rng = Rng::new(seed, "observation");
    Observation::of_state(rng.normals(9), rng.normals(10))
}

/// A millisecond passes between two looks at it.
struct Ticking(f64);

impl Clock for Ticking {
    fn milliseconds(&mut self) -> f64 {
        self.0 += 1.0;
        self.0
    }
}

fn ticking() -> Box<dyn Clock> {
    Box::new(Ticking(0.0))
}

#[test]
fn without_warm_start_and_budget_the_policy_predicts() {
    for config in designs() {
        let model = Arc::new(Actrm::new(&config, &signature(), 5).unwrap());
        assert!(!model.depends_on_time());
        let mut policy = Arc::clone(&model).policy(identity(), ticking());
        for seed in 0..3 {
            let chunk = policy.predict(&observation(seed)).unwrap();
            let seen = identity().observation(&[observation(seed)]).unwrap();
            let predicted = model.predict(&seen).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
            let bits = |x: &[f32]| x.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
            assert_eq!(bits(&chunk.actions), bits(&predicted));
        }
    }
}

#[test]
fn the_policy_keeps_to_its_budget_and_starts_warm() {
    let mut config = small(ReasoningConfig::default());
    config.reasoning.max_steps = Some(8);
    config.reasoning.halt_threshold = 1.0;
    config.reasoning.change_threshold = 0.0;
    config.reasoning.budget_ms = Some(3.0);
    config.reasoning.warm_start = Some(WarmStart { noise: 0.1 });
    let model = Arc::new(Actrm::new(&config, &signature(), 5).unwrap());
    assert!(model.depends_on_time());
    let mut policy = ReasoningPolicy::new(Arc::clone(&model), identity(), ticking());
    assert!(policy.thought().unwrap().is_empty());
    let first = policy.predict(&observation(1)).unwrap();
    assert_eq!((first.action_horizon, first.action_dim), (5, 7));
    assert_eq!(policy.last_reasoning().unwrap().depth, [3]);
    // every step is on record, the last is what is executed
    let thought = policy.thought().unwrap();
    assert_eq!(thought.iter().map(|step| step.milliseconds).collect::<Vec<_>>(), [1.0; 3]);
    assert_eq!(thought[2].chunk, first);
    assert_eq!(thought.iter().map(|step| step.change.is_some()).collect::<Vec<_>>(), [false, true, true]);
    let warm = policy.predict(&observation(1)).unwrap();
    assert_ne!(warm, first, "the second thought starts from the first");
    // what was executed in between moves the start
    let after = |actions: usize| {
        let mut policy = Arc::clone(&model).policy(identity(), ticking());
        policy.predict(&observation(1)).unwrap();
        policy.executed(actions);
        policy.predict(&observation(1)).unwrap()
    };
    assert_eq!(after(0), warm);
    assert_ne!(after(2), warm);
    policy.reset(7);
    assert_eq!(policy.predict(&observation(1)).unwrap(), first);
    // more time, another answer
    config.reasoning.budget_ms = Some(6.0);
    let patient = Arc::new(Actrm::new(&config, &signature(), 5).unwrap());
    let longer = patient.policy(identity(), ticking()).predict(&observation(1)).unwrap();
    assert_ne!(longer, first);
    // and the model trains with warm starts
    let mut batch = batch(&config, 4, 0);
    batch.seed = 1;
    let loss = model.loss(&batch, &mut Rng::new(0, "loss")).unwrap();
    assert!(value(&loss.total).is_finite());
}

#[test]
fn impossible_configurations_name_the_field() {
    let with = |change: &dyn Fn(&mut Config)| {
        let mut config = small(ReasoningConfig::default());
        change(&mut config);
        Actrm::new(&config, &signature(), 0).unwrap_err().to_string()
    };
    for (error, field) in [
        (with(&|c| c.n_heads = 3), "n_heads"),
        (with(&|c| c.reasoning.tokens = 0), "reasoning.tokens"),
        (with(&|c| c.reasoning.max_steps = Some(0)), "reasoning.max_steps"),
        (with(&|c| c.reasoning.halt_threshold = 1.5), "reasoning.halt_threshold"),
    ] {
        assert!(error.contains(field), "{error}");
    }
}

#[test]
fn it_is_configured_beside_act() {
    let json = serde_json::json!({"type": "actrm", "dim_model": 16, "n_heads": 2, "reasoning": {"over": "memory"}});
    let config: PolicyConfig = serde_json::from_value(json).unwrap();
    let PolicyConfig::Actrm(config) = &config else { panic!("{config:?}") };
    assert_eq!((config.dim_model, config.reasoning.over), (16, Over::Memory));
    let wrong = serde_json::json!({"type": "actrm", "reasoning": {"cycles": 3}});
    assert!(serde_json::from_value::<PolicyConfig>(wrong).is_err());
}
