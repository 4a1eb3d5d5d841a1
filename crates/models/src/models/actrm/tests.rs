#![allow(clippy::unwrap_used)]
use super::*;
use crate::batch::Taken;
use crate::features::{FeatureSpec, Features, Observation, ValuesRef};
use crate::history::History;
use crate::layers::{AuxiliaryConfig, GridConfig, PointerConfig};
use crate::models::act::{self, Act};
use crate::normaliser::{ACTION, ENVIRONMENT_STATE, NormMode, Normaliser, STATE};
use crate::policy::Policy;
use crate::preprocess::Preprocess;
use crate::registry::PolicyConfig;
use crate::testing::{assert_the_gradient_is_the_slope, move_parameters, signatures};
use crate::train::{TrainConfig, Trainer};
use candle_core::{DType, Device};
use nn::Gradients;
use nn::ParamLayout;
use std::collections::BTreeMap;
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

fn designs() -> [Config; 4] {
    let deep = ReasoningConfig { h_cycles: 2, l_cycles: 2, ..ReasoningConfig::default() };
    let memory = ReasoningConfig { n_layers: 2, supervision_steps: 4, l_cycles: 2, ..ReasoningConfig::original() };
    let tokens = ReasoningConfig { over: Over::Tokens, supervision_steps: 2, ..ReasoningConfig::default() };
    [small(ReasoningConfig::default()), small(deep), small(memory), small(tokens)]
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

fn among(group: &str) -> PointerConfig {
    PointerConfig { among: group.to_string(), weight: 0.7 }
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
        let act = Act::new(&act, &signature(), 0, &Backend::CPU).unwrap().params().count();
        let ours = Actrm::new(&ours, &signature(), 0, &Backend::CPU).unwrap().params().count();
        assert!(2 * ours <= act, "{ours} against {act} at width {dim_model}");
    }
}

#[test]
fn every_parameter_gets_a_gradient() {
    for config in designs() {
        let model = Actrm::new(&config, &signature(), 1, &Backend::CPU).unwrap();
        // off the zeros that biases start from, which hide gradients behind them
        let mut rng = Rng::new(7, "noise");
        for (_, var) in model.params().iter() {
            let noise = Tensor::from_vec(rng.normals(var.elem_count()), var.shape(), &Device::Cpu).unwrap();
            var.set(&(var.as_tensor().detach() + (noise * 0.1).unwrap()).unwrap()).unwrap();
        }
        for seed in 0..2 {
            let mut batch = batch(&config, 6, seed);
            batch.seed = seed;
            let mut grads = Gradients::zeros(Arc::new(ParamLayout::new(model.params()))).unwrap();
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
        let model = Actrm::new(&config, &signature(), 1, &Backend::CPU).unwrap();
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
            let trained = Actrm::new(&config, &signature(), 1, &Backend::CPU).unwrap();
            assert_eq!(model.params().count(), trained.params().count());
            trained.params().load(weights).unwrap();
            let thought = trained.reason(&held_out.observation, None, &mut |_| false).unwrap();
            let mean = |t: &Tensor| value(&t.abs().unwrap().mean_all().unwrap());
            let zero = mean(&held_out.actions);
            thought.steps.iter().map(|s| mean(&(&s.chunk - &held_out.actions).unwrap()) / zero).collect()
        };
        let settings = TrainConfig { steps: 500, lr: 5e-3, ema_decay: Some(0.98), ..TrainConfig::default() };
        let model = Box::new(Actrm::new(&config, &signature(), 1, &Backend::CPU).unwrap());
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
        let model = Actrm::new(&config, &signature(), 5, &Backend::CPU).unwrap();
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
            let model = Actrm::new(&config, &signature(), 5, &Backend::CPU).unwrap();
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
    Arc::new(Preprocess::new(signature(), normaliser, &Device::Cpu).unwrap())
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
        let model = Arc::new(Actrm::new(&config, &signature(), 5, &Backend::CPU).unwrap());
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
    let model = Arc::new(Actrm::new(&config, &signature(), 5, &Backend::CPU).unwrap());
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
    let patient = Arc::new(Actrm::new(&config, &signature(), 5, &Backend::CPU).unwrap());
    let longer = patient.policy(identity(), ticking()).predict(&observation(1)).unwrap();
    assert_ne!(longer, first);
    // and the model trains with warm starts
    let mut batch = batch(&config, 4, 0);
    batch.seed = 1;
    let loss = model.loss(&batch, &mut Rng::new(0, "loss")).unwrap();
    assert!(value(&loss.total).is_finite());
}

#[test]
fn settings_that_change_nothing_are_not_written() {
    let text = serde_json::to_string(&small(ReasoningConfig::default())).unwrap();
    for field in ["untied", "start_noise", "deep_supervision"] {
        assert!(!text.contains(field), "{field} is in {text}: configurations would not keep their text");
    }
    let changed = ReasoningConfig { untied: true, start_noise: 0.5, deep_supervision: false, ..Default::default() };
    let text = serde_json::to_string(&changed).unwrap();
    assert_eq!(serde_json::from_str::<ReasoningConfig>(&text).unwrap(), changed);
}

#[test]
fn untied_steps_have_blocks_of_their_own_and_the_shared_one_is_the_first() {
    let tied = small(ReasoningConfig::default());
    let untied = small(ReasoningConfig { untied: true, ..ReasoningConfig::default() });
    let model = |config: &Config| Actrm::new(config, &signature(), 1, &Backend::CPU).unwrap();
    let (tied, free) = (model(&tied), model(&untied));
    let of_block = |model: &Actrm| -> usize {
        model
            .params()
            .iter()
            .filter(|(name, _)| name.starts_with("reasoning.layers."))
            .map(|(_, v)| v.elem_count())
            .sum()
    };
    assert_eq!(of_block(&free), 3 * of_block(&tied));
    assert_eq!(free.params().count() - of_block(&free), tied.params().count() - of_block(&tied));
    // with the same weights in every block it is the shared one
    for (name, var) in free.params().iter() {
        let source = match name.strip_prefix("reasoning.layers.").and_then(|rest| rest.split_once('.')) {
            Some((_, rest)) => format!("reasoning.layers.0.{rest}"),
            None => name.to_string(),
        };
        var.set(&tied.params().get(&source).unwrap().as_tensor().copy().unwrap()).unwrap();
    }
    free.params().changed();
    let batch = batch(tied.config(), 3, 1);
    let chunk =
        |model: &Actrm| model.predict(&batch.observation).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
    let (a, b) = (chunk(&tied), chunk(&free));
    assert!(a.iter().zip(&b).all(|(a, b)| (a - b).abs() < 1e-6));
    // another last block, another answer
    let var = free.params().get("reasoning.layers.2.linear1.weight").unwrap();
    var.set(&(var.as_tensor().copy().unwrap() * 2.0).unwrap()).unwrap();
    free.params().changed();
    assert_ne!(chunk(&free), b);
}

#[test]
fn without_deep_supervision_only_the_last_answer_counts() {
    let config = small(ReasoningConfig { deep_supervision: false, halt_weight: 0.0, ..ReasoningConfig::default() });
    let config = Config { use_vae: false, ..config };
    let model = Actrm::new(&config, &signature(), 1, &Backend::CPU).unwrap();
    let loss = model.loss(&batch(&config, 4, 0), &mut Rng::new(0, "loss")).unwrap();
    assert!((value(&loss.total) - value(&loss.parts["l1_loss"])).abs() < 1e-6);
    assert!((value(&loss.total) - value(&loss.parts["l1_loss_first"])).abs() > 1e-4);
}

#[test]
fn thoughts_begin_with_noise_in_training_only() {
    let with = |start_noise: f64| small(ReasoningConfig { start_noise, ..ReasoningConfig::default() });
    let (plain, noisy) = (with(0.0), with(1.0));
    let loss = |config: &Config, seed: u64| {
        let model = Actrm::new(&Config { use_vae: false, ..config.clone() }, &signature(), 1, &Backend::CPU).unwrap();
        value(&model.loss(&batch(config, 4, 0), &mut Rng::new(seed, "loss")).unwrap().total)
    };
    assert_eq!(loss(&plain, 0), loss(&plain, 1));
    assert_ne!(loss(&noisy, 0), loss(&noisy, 1));
    let predict = |config: &Config| {
        let model = Actrm::new(config, &signature(), 1, &Backend::CPU).unwrap();
        model.predict(&batch(config, 4, 0).observation).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap()
    };
    assert_eq!(predict(&plain), predict(&noisy));
}

#[test]
fn a_thought_over_a_grid_looked_into_is_the_thought() {
    let grid = Some(GridConfig { among: "cell".to_string(), columns: 3, way: 1.0 });
    let base = ReasoningConfig { over: Over::Tokens, grid, max_steps: Some(5), ..ReasoningConfig::default() };
    let reasoning = ReasoningConfig { l_cycles: 2, halt_threshold: 1.0, change_threshold: 0.0, ..base };
    let config = small(reasoning);
    let signature = crate::testing::signatures().grid;
    let model = Actrm::new(&config, &signature, 5, &Backend::CPU).unwrap();
    let batch = crate::testing::batch(&signature, config.action_horizon, 3, 1);
    let off = |a: &Tensor, b: &Tensor| value(&(a - b).unwrap().abs().unwrap().max_all().unwrap());
    let thought = model.reason(&batch.observation, None, &mut |_| false).unwrap();
    let steps = model.examine(&batch.observation, 5, None).unwrap();
    for (seen, step) in steps.iter().zip(&thought.steps) {
        assert!(off(&seen.chunk, &step.chunk) < 1e-5);
        assert_eq!(seen.scores.as_ref().unwrap().dims(), [3, 6]);
    }
    let frozen = model.examine(&batch.observation, 5, Some(Intervention::Freeze)).unwrap();
    assert_eq!(off(frozen[4].scores.as_ref().unwrap(), steps[0].scores.as_ref().unwrap()), 0.0);
    assert!(off(steps[4].scores.as_ref().unwrap(), steps[0].scores.as_ref().unwrap()) > 0.0);
    // a thought goes farther with every application
    let mut moved = batch.observation.clone();
    let far = "observation.entity.cell0";
    let changed = (batch.observation.get(far).unwrap() + 1.0).unwrap();
    moved.insert(far, changed);
    let other = model.examine(&moved, 5, None).unwrap();
    let of = |step: &ExaminedStep, cell: usize| step.scores.as_ref().unwrap().narrow(1, cell, 1).unwrap();
    // two rows of three cells: the far corner is two columns away, which two applications reach
    assert!(off(&of(&other[0], 5), &of(&steps[0], 5)) > 0.0);
    let one = ReasoningConfig { l_cycles: 1, ..config.reasoning.clone() };
    let near = Actrm::new(&small(one), &signature, 5, &Backend::CPU).unwrap();
    let (before, after) = (near.examine(&batch.observation, 2, None).unwrap(), near.examine(&moved, 2, None).unwrap());
    assert_eq!(off(&of(&after[0], 5), &of(&before[0], 5)), 0.0);
    assert!(off(&of(&after[0], 4), &of(&before[0], 4)) > 0.0);
    assert!(off(&of(&after[1], 5), &of(&before[1], 5)) > 0.0);
}

#[test]
fn a_thought_looked_into_is_the_thought() {
    let still = ReasoningConfig { halt_threshold: 1.0, change_threshold: 0.0, ..ReasoningConfig::default() };
    let deep = ReasoningConfig { h_cycles: 2, l_cycles: 2, n_layers: 2, untied: true, ..still.clone() };
    let tokens = ReasoningConfig { over: Over::Tokens, ..still.clone() };
    for config in [small(still), small(deep), small(tokens)] {
        let config = Config { reasoning: ReasoningConfig { max_steps: Some(5), ..config.reasoning.clone() }, ..config };
        let model = Actrm::new(&config, &signature(), 5, &Backend::CPU).unwrap();
        let batch = batch(&config, 3, 1);
        let thought = model.reason(&batch.observation, None, &mut |_| false).unwrap();
        let steps = model.examine(&batch.observation, 5, None).unwrap();
        let off = |a: &Tensor, b: &Tensor| value(&(a - b).unwrap().abs().unwrap().max_all().unwrap());
        for (seen, step) in steps.iter().zip(&thought.steps) {
            assert!(off(&seen.chunk, &step.chunk) < 1e-5);
            // every action token's attention is a share
            let names = model.context_names();
            let Some(attention) = &seen.attention else {
                assert_eq!(config.reasoning.over, Over::Tokens);
                continue;
            };
            assert_eq!(attention.dims(), [3, 5, names.len()]);
            let sums = attention.sum(2).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
            assert!(sums.iter().all(|sum| (sum - 1.0).abs() < 1e-5));
        }
        let frozen = model.examine(&batch.observation, 5, Some(Intervention::Freeze)).unwrap();
        assert_eq!(off(&frozen[0].chunk, &steps[0].chunk), 0.0);
        assert_eq!(off(&frozen[4].reasoning, &steps[0].reasoning), 0.0);
        assert!(off(&frozen[4].chunk, &steps[4].chunk) > 0.0);
        let shuffled = model.examine(&batch.observation, 5, Some(Intervention::Shuffle)).unwrap();
        for row in 0..3 {
            let of = |step: &ExaminedStep, row: usize| step.reasoning.narrow(0, row, 1).unwrap();
            assert_eq!(off(&of(&shuffled[3], row), &of(&steps[3], (row + 1) % 3)), 0.0);
        }
        let one = batch.observation.map(|_, values| values.narrow(0, 0, 1).unwrap());
        assert!(model.examine(&one, 2, Some(Intervention::Shuffle)).unwrap_err().to_string().contains("2 to shuffle"));
    }
    let memory = Actrm::new(&designs()[2], &signature(), 5, &Backend::CPU).unwrap();
    let error = memory.examine(&batch(&designs()[2], 2, 1).observation, 2, None).unwrap_err().to_string();
    assert!(error.contains("reasoning.over"), "{error}");
}

#[test]
fn a_trained_policy_can_be_asked_to_think_otherwise() {
    let config = small(ReasoningConfig { budget_ms: Some(1.0), ..ReasoningConfig::default() });
    let of = |thinking: &Thinking| config.thinking(thinking).unwrap().reasoning;
    assert_eq!(of(&Thinking::default()), config.reasoning);
    let exactly = of(&Thinking { steps: Some(7), ..Thinking::default() });
    assert_eq!((exactly.max_steps(), exactly.halt_threshold, exactly.change_threshold), (7, 1.0, 0.0));
    assert_eq!((exactly.supervision_steps, exactly.budget_ms), (3, None));
    let at_most = of(&Thinking { steps: Some(7), halting: Some(true), ..Thinking::default() });
    assert_eq!((at_most.max_steps(), at_most.halt_threshold), (7, config.reasoning.halt_threshold));
    assert_eq!(of(&Thinking { halting: Some(false), ..Thinking::default() }).max_steps(), 3);
    let both = Thinking { halting: Some(true), intervene: Some(Intervention::Freeze), ..Thinking::default() };
    assert!(config.thinking(&both).unwrap_err().to_string().contains("thinking.halting"));
    assert!(config.thinking(&Thinking { steps: Some(0), ..Thinking::default() }).is_err());
    // several thoughts run without a clock; no intervention and no start goes with a warm start
    let starts = Thinking { starts: Some(Starts { count: 3, noise: 1.0 }), ..Thinking::default() };
    assert_eq!((of(&starts).budget_ms, of(&starts).halt_threshold), (None, config.reasoning.halt_threshold));
    let warm = small(ReasoningConfig { warm_start: Some(WarmStart { noise: 0.1 }), ..ReasoningConfig::default() });
    for intervene in [None, Some(Intervention::Freeze)] {
        let tampered = Thinking { intervene, starts: starts.starts.filter(|_| intervene.is_none()), ..starts };
        let error = warm.thinking(&tampered).unwrap_err().to_string();
        assert!(error.contains("without a warm start"), "{error}");
    }
    let early = Thinking {
        halting: Some(true),
        halt_threshold: Some(0.6),
        change_threshold: Some(0.02),
        ..Thinking::default()
    };
    assert_eq!((of(&early).halt_threshold, of(&early).change_threshold, of(&early).max_steps()), (0.6, 0.02, 3));
    let one = Thinking { halt_threshold: None, ..early };
    assert_eq!((of(&one).halt_threshold, of(&one).change_threshold), (config.reasoning.halt_threshold, 0.02));
    let refused = |thinking: &Thinking| config.thinking(thinking).unwrap_err().to_string();
    assert!(refused(&Thinking { halting: Some(false), ..early }).contains("thinking.halt_threshold"));
    assert!(refused(&Thinking { steps: Some(7), halting: None, ..one }).contains("thinking.change_threshold"));
    assert!(refused(&Thinking { halt_threshold: Some(1.5), ..early }).contains("halt_threshold"));
    let act = PolicyConfig::Act(act::Config::default());
    assert_eq!(act.thinking(&Thinking::default()).unwrap(), act);
    assert!(act.thinking(&Thinking { steps: Some(2), ..Thinking::default() }).is_err());
}

#[test]
fn a_disturbed_policy_depends_on_the_episode_only() {
    let config =
        small(ReasoningConfig::default()).thinking(&Thinking { steps: Some(4), ..Thinking::default() }).unwrap();
    let model = Arc::new(Actrm::new(&config, &signature(), 5, &Backend::CPU).unwrap());
    let others = Arc::new((10..13).map(observation).collect::<Vec<_>>());
    let make =
        |intervene| DisturbedPolicy::new(Arc::clone(&model), identity(), intervene, Arc::clone(&others)).unwrap();
    let mut policy = make(Intervention::Shuffle);
    let mut of = |seed: u64| {
        policy.reset(seed);
        policy.predict(&observation(1)).unwrap()
    };
    let first = of(0);
    assert_ne!(of(1), first, "another thought's reasoning");
    assert_eq!((of(0), of(3)), (first.clone(), first.clone()));
    let undisturbed = Arc::clone(&model).policy(identity(), ticking()).predict(&observation(1)).unwrap();
    assert_ne!(first, undisturbed);
    assert_ne!(make(Intervention::Freeze).predict(&observation(1)).unwrap(), undisturbed);
    let nobody = DisturbedPolicy::new(model, identity(), Intervention::Shuffle, Arc::default());
    assert!(nobody.is_err());
}

#[test]
fn of_several_thoughts_the_halting_head_chooses_one() {
    let thinking = |count, noise| Thinking { starts: Some(Starts { count, noise }), ..Thinking::default() };
    for over in [Over::Actions, Over::Tokens] {
        let config = small(ReasoningConfig { over, ..ReasoningConfig::default() });
        let config = config.thinking(&Thinking { steps: Some(4), ..thinking(5, 1.0) }).unwrap();
        let model = Arc::new(Actrm::new(&config, &signature(), 5, &Backend::CPU).unwrap());
        let make = |noise| RestartedPolicy::new(Arc::clone(&model), identity(), Starts { count: 5, noise });
        let mut policy = make(1.0);
        let mut of = |seed: u64| {
            policy.reset(seed);
            policy.predict(&observation(1)).unwrap()
        };
        let chunks: Vec<_> = (0..20).map(&mut of).collect();
        assert_eq!(of(3), chunks[3], "an episode repeats itself");
        // the same thoughts one by one
        let seen = History::new(1).see(&identity(), &observation(1)).unwrap();
        let [_, tokens, dim] = model.thought_shape(1);
        let plain = model.reason(&seen, None, &mut |_| false).unwrap();
        let none = Tensor::zeros((1, tokens, dim), DType::F32, &Device::Cpu).unwrap();
        let none = model.reason_seen(&seen, Start::Noise(&none), &mut || {}, &mut |_| false).unwrap();
        assert_eq!(identity().chunk(&none.chunk).unwrap(), identity().chunk(&plain.chunk).unwrap());
        for (seed, chosen) in chunks.iter().enumerate() {
            let drawn = Rng::new(seed as u64, "starts").normals(4 * tokens * dim);
            let drawn = Tensor::from_vec(drawn, (4, tokens, dim), &Device::Cpu).unwrap();
            let mut thoughts = vec![plain.clone()];
            thoughts.extend((0..4).map(|row| {
                let noise = drawn.narrow(0, row, 1).unwrap();
                model.reason_seen(&seen, Start::Noise(&noise), &mut || {}, &mut |_| false).unwrap()
            }));
            let sure = |thought: &Reasoning| thought.steps[3].halt[0];
            let best = thoughts.iter().max_by(|a, b| sure(a).total_cmp(&sure(b))).unwrap();
            let best = identity().chunk(&best.chunk).unwrap().actions;
            assert!(best.iter().zip(&chosen.actions).all(|(a, b)| (a - b).abs() < 1e-5), "{best:?} {chosen:?}");
        }
        let usual = Arc::clone(&model).policy(identity(), ticking()).predict(&observation(1)).unwrap();
        assert!(chunks.iter().any(|chunk| *chunk != usual), "noise finds other thoughts");
    }
    let config = small(ReasoningConfig::default());
    let refused = |config: &Config, thinking| config.thinking(&thinking).unwrap_err().to_string();
    assert!(refused(&config, thinking(1, 1.0)).contains("thinking.starts.count"));
    assert!(refused(&config, thinking(8, 0.0)).contains("thinking.starts.noise"));
    let both = Thinking { intervene: Some(Intervention::Freeze), ..thinking(8, 1.0) };
    assert!(refused(&config, both).contains("no intervention"));
    assert!(refused(&designs()[2], thinking(8, 1.0)).contains("over memory"));
}

#[test]
fn untied_steps_and_more_steps_cost_what_they_are() {
    let flops = |reasoning: ReasoningConfig| {
        Actrm::new(&small(reasoning), &signature(), 1, &Backend::CPU).unwrap().query_flops().unwrap()
    };
    let of = |supervision_steps: usize, untied: bool| {
        flops(ReasoningConfig { supervision_steps, untied, ..ReasoningConfig::default() })
    };
    let step = of(2, false) - of(1, false);
    assert!((of(6, false) - of(1, false) - 5.0 * step).abs() < 1e-3);
    // 3 tokens of memory: keys and values for each block
    assert_eq!(of(6, true) - of(6, false), 5.0 * 2.0 * (3 * 16 * 32) as f64);
    assert!(step > 0.0);
    let of = |supervision_steps, l_cycles| {
        flops(ReasoningConfig { supervision_steps, l_cycles, n_layers: 1, ..ReasoningConfig::original() })
    };
    // an update more in each of three rounds, in one step and in two
    assert_eq!(of(2, 3) - of(2, 2), 2.0 * (of(1, 3) - of(1, 2)));
    assert!(of(1, 3) > of(1, 2));
}

#[test]
fn impossible_configurations_name_the_field() {
    let with = |change: &dyn Fn(&mut Config)| {
        let mut config = small(ReasoningConfig::default());
        change(&mut config);
        Actrm::new(&config, &signature(), 0, &Backend::CPU).unwrap_err().to_string()
    };
    for (error, field) in [
        (with(&|c| c.n_heads = 3), "n_heads"),
        (with(&|c| c.reasoning.tokens = 0), "reasoning.tokens"),
        (with(&|c| c.reasoning.max_steps = Some(0)), "reasoning.max_steps"),
        (with(&|c| c.reasoning.halt_threshold = 1.5), "reasoning.halt_threshold"),
        (with(&|c| (c.reasoning.over, c.reasoning.untied) = (Over::Memory, true)), "reasoning.untied"),
        (with(&|c| (c.reasoning.over, c.reasoning.start_noise) = (Over::Memory, 1.0)), "reasoning.start_noise"),
        (with(&|c| c.reasoning.start_noise = f64::NAN), "reasoning.start_noise"),
        (with(&|c| (c.reasoning.over, c.reasoning.h_cycles) = (Over::Tokens, 2)), "reasoning.h_cycles"),
        (
            with(&|c| (c.reasoning.over, c.reasoning.warm_start) = (Over::Tokens, Some(WarmStart { noise: 0.1 }))),
            "reasoning.warm_start",
        ),
        (with(&|c| c.pointer = Some(among("cube"))), "pointer is among cube"),
        (with(&|c| c.auxiliary = Some(AuxiliaryConfig::default())), "auxiliary_dim is 0"),
        (
            with(&|c| (c.auxiliary, c.n_memory_layers) = (Some(AuxiliaryConfig::default()), 0)),
            "auxiliary is weight 1, expected absent but for",
        ),
        (with(&|c| (c.reasoning.over, c.pointer) = (Over::Tokens, Some(among("cube")))), "0 of group cube"),
        (
            with(&|c| {
                c.reasoning.over = Over::Tokens;
                c.pointer = Some(PointerConfig { weight: f64::NAN, ..among("cube") });
            }),
            "pointer.weight",
        ),
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

/// A policy over tokens that points at one of three cubes, and windows of which each took one.
fn pointing(change: &dyn Fn(&mut Config)) -> (Actrm, Batch) {
    let tokens = ReasoningConfig { over: Over::Tokens, supervision_steps: 3, ..ReasoningConfig::default() };
    let mut config = Config { pointer: Some(among("cube")), use_vae: false, ..small(tokens) };
    change(&mut config);
    let signature = signatures().entities;
    let model = Actrm::new(&config, &signature, 1, &Backend::CPU).unwrap();
    move_parameters(&model);
    let mut batch = crate::testing::batch(&signature, config.action_horizon, 6, 3);
    let cubes: Vec<u32> = (0..signature.observation.len() as u32)
        .filter(|&i| signature.observation[i as usize].group() == "cube")
        .collect();
    // of every fourth row it is not asked
    batch.taken = Some(Taken::new((0..6).map(|row| (row % 4 != 3).then(|| cubes[row % 3])).collect()));
    (model, batch)
}

#[test]
fn the_gradient_of_pointing_is_the_slope_of_the_loss() {
    let variants: [&dyn Fn(&mut Config); 4] = [
        &|_| (),
        &|c| (c.reasoning.untied, c.reasoning.n_layers, c.reasoning.l_cycles) = (true, 2, 2),
        &|c| (c.reasoning.deep_supervision, c.reasoning.start_noise) = (false, 0.3),
        &|c| (c.pointer, c.use_vae) = (None, true),
    ];
    for change in variants {
        let (model, batch) = pointing(&|c| {
            change(c);
            // the halting head leaves what it reads without gradient on purpose
            c.reasoning.halt_weight = 1e-6;
        });
        assert_the_gradient_is_the_slope(&model, &batch, &format!("{:?}", model.config()));
    }
}

#[test]
fn a_batch_says_what_was_taken_of_the_candidates() {
    let (model, batch) = pointing(&|_| ());
    let error = |taken: Option<Vec<u32>>| {
        let taken = taken.map(|taken| Taken::new(taken.into_iter().map(Some).collect()));
        let batch = Batch { taken, ..batch.clone() };
        model.loss(&batch, &mut Rng::new(0, "loss")).unwrap_err().to_string()
    };
    assert!(error(None).contains("what was taken"), "{}", error(None));
    assert!(error(Some(vec![0; 6])).contains("feature 0"), "the state is no candidate");
    assert!(error(Some(vec![1; 5])).contains("5 for 6 rows"));
    let whole = value(&model.loss(&batch, &mut Rng::new(0, "loss")).unwrap().parts["pointer_loss"]);
    let shards = batch.shards(4).unwrap();
    let of = |shard: &Batch| value(&model.loss(shard, &mut Rng::new(0, "loss")).unwrap().parts["pointer_loss"]);
    let sum: f32 = shards.iter().map(of).sum();
    assert!((whole - sum).abs() < 1e-5, "{whole} {sum}");
}

#[test]
fn an_answer_over_tokens_does_not_depend_on_the_order_of_a_group() {
    let (model, batch) = pointing(&|_| ());
    let (before, mut other) = (model.predict(&batch.observation).unwrap(), Features::new());
    let turned = |name: &str| match name {
        "observation.entity.cube0" => "observation.entity.cube1".to_string(),
        "observation.entity.cube1" => "observation.entity.cube2".to_string(),
        "observation.entity.cube2" => "observation.entity.cube0".to_string(),
        name => name.to_string(),
    };
    for name in batch.observation.names() {
        other.insert(name, batch.observation.get(&turned(name)).unwrap().clone());
    }
    let off = |a: &Tensor| value(&(a - &before).unwrap().abs().unwrap().max_all().unwrap());
    assert!(off(&model.predict(&other).unwrap()) < 1e-5);
    // and on what they are it does
    let cube = batch.observation.get("observation.entity.cube0").unwrap();
    other.insert("observation.entity.cube0", (cube + 1.0).unwrap());
    assert!(off(&model.predict(&other).unwrap()) > 1e-3);
}

/// One hop: each of four things shows a name and one it points to, the goal a name; the thing to take is that which the named
/// one points to. Its numbers are the actions.
fn one_hop(config: &Config, signature: &Signature, rows: usize, seed: u64) -> Batch {
    let mut rng = Rng::new(seed, "hop");
    let one_hot = |name: usize| (0..4).map(move |i| if i == name { 1.5f32 } else { -0.5 });
    let (mut things, mut goal, mut actions, mut taken) = (vec![Vec::new(); 4], Vec::new(), Vec::new(), Vec::new());
    for _ in 0..rows {
        let mut names: Vec<usize> = (0..4).collect();
        for i in (1..4).rev() {
            names.swap(i, rng.below(i as u64 + 1) as usize);
        }
        // a ring of things, in an order that only what they show tells
        let (first, places) = (rng.below(4) as usize, rng.normals(4));
        for (i, thing) in things.iter_mut().enumerate() {
            thing.extend(one_hot(names[i]).chain(one_hot(names[(i + 1) % 4])).chain([places[i]]));
        }
        goal.extend(std::iter::repeat_n(0.0, 4).chain(one_hot(names[first])).chain([0.0]));
        let target = (first + 1) % 4;
        actions.extend(std::iter::repeat_n(places[target], config.action_horizon));
        taken.push(Some(1 + target as u32));
    }
    let mut observation = Features::new();
    observation.insert(STATE, ValuesRef::F32(&[0.0; 4096][..rows]));
    for (i, thing) in things.iter().enumerate() {
        observation.insert(&format!("observation.entity.thing{i}"), ValuesRef::F32(thing));
    }
    observation.insert("observation.entity.goal", ValuesRef::F32(&goal));
    let is_pad = vec![false; rows * config.action_horizon];
    let batch = Batch::from_slices(signature, config.action_horizon, &observation, &actions, &is_pad).unwrap();
    Batch { taken: Some(Taken::new(taken)), ..batch }
}

#[test]
fn a_pointer_learns_to_follow_a_relation_and_the_actions_go_there() {
    let thing = |i: usize| FeatureSpec::entity(&format!("thing{i}"), 9, "thing", false);
    let goal = FeatureSpec::entity("goal", 9, "thing", true);
    let observation = [FeatureSpec::state(1)].into_iter().chain((0..4).map(thing)).chain([goal]).collect();
    let signature = Signature { observation, action_dim: 1, ..Signature::default() };
    let tokens = ReasoningConfig { over: Over::Tokens, supervision_steps: 3, ..ReasoningConfig::default() };
    let base = Config { use_vae: false, dim_model: 32, dim_feedforward: 64, action_horizon: 2, ..small(tokens) };
    let error = |pointer: Option<PointerConfig>| {
        let config = Config { pointer, ..base.clone() };
        let settings = TrainConfig { steps: 700, lr: 3e-3, ..TrainConfig::default() };
        let model = Box::new(Actrm::new(&config, &signature, 1, &Backend::CPU).unwrap());
        let mut trainer = Trainer::new(model, settings, 1).unwrap();
        for step in 0..700 {
            trainer.step(&one_hop(&config, &signature, 48, step)).unwrap();
        }
        let fresh = one_hop(&config, &signature, 256, 10_000);
        let off = (trainer.model().predict(&fresh.observation).unwrap() - &fresh.actions).unwrap();
        value(&off.abs().unwrap().mean_all().unwrap())
    };
    // always answering zero is off by 0.8
    let with = error(Some(among("thing")));
    assert!(with < 0.25, "{with}");
}
