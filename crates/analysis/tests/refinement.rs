//! A policy that thinks, in a real simulator: its warm start and its budget change what is executed, and a trace shows it.

#![allow(clippy::unwrap_used)]

#[path = "../../rollout/tests/common/mod.rs"]
mod common;

use std::collections::BTreeMap;
use std::sync::Arc;

use analysis::{PolicyTrace, TracedQuery, trace};
use common::options;
use models::actrm::{Config, ReasoningConfig, WarmStart};
use models::{
    ACTION, Backend, ENVIRONMENT_STATE, NormMode, Normaliser, PolicyConfig, PolicyModel, Preprocess, STATE, Signature,
};
use rollout::Pool;
use zoo::FeatureKeys;
use zoo::evaluation::{EvaluationOptions, Subject, WallClock};
use zoo::results::{EntryIdentity, Execution, Seeds, TrainingFacts};

/// The same weights, whatever the rest of its options.
fn subject(reasoning: ReasoningConfig) -> Subject<'static> {
    let signature = Signature::low_dimensional(5, 10, 7);
    let config = PolicyConfig::Actrm(Config {
        action_horizon: 6,
        dim_model: 16,
        n_heads: 2,
        dim_feedforward: 24,
        latent_dim: 3,
        reasoning,
        ..Config::default()
    });
    let model: Arc<dyn PolicyModel> = config.build(&signature, 3, &Backend::CPU).unwrap().into();
    let modes = [STATE, ENVIRONMENT_STATE, ACTION].map(|name| (name.to_owned(), NormMode::Identity));
    let normaliser = Normaliser::new(&BTreeMap::from(modes), &BTreeMap::new()).unwrap();
    let preprocess = Arc::new(Preprocess::new(signature.clone(), normaliser, &candle_core::Device::Cpu).unwrap());
    let mut keys = FeatureKeys::default();
    keys.insert(STATE, &["robot0_eef_pos", "robot0_gripper_qpos"].map(str::to_owned)).unwrap();
    keys.insert(ENVIRONMENT_STATE, &["object".to_owned()]).unwrap();
    Subject {
        entry: EntryIdentity { name: "thinker".into(), version: 1, hash: "ab".repeat(32) },
        training: TrainingFacts {
            policy: config.policy_type().into(),
            parameters: model.params().count() as u64,
            steps: 0,
            minutes: 0.0,
            seed: 3,
            data_set: "none".into(),
            data_fingerprint: String::new(),
            data_simulator: None,
            demos: 0,
        },
        task: "Lift".into(),
        demonstrations: None,
        env_version: Some("1.5.1".into()),
        keys,
        execution: Execution::RecedingHorizon { n_action_steps: 4 },
        time_decides: model.depends_on_time(),
        conventions: zoo::conventions::Conventions::default(),
        is_scripted: false,
        fast_render: None,
        perturbation: None,
        gpu: None,
        max_steps: Some(18),
        signature,
        policy: Box::new(move || Ok(Arc::clone(&model).policy(Arc::clone(&preprocess), Box::new(WallClock::new())))),
    }
}

/// Five steps, whatever the answer does.
fn five() -> ReasoningConfig {
    ReasoningConfig { max_steps: Some(5), halt_threshold: 1.0, change_threshold: 0.0, ..ReasoningConfig::default() }
}

/// The actions that went to the environment, in order.
fn executed(trace: &PolicyTrace) -> Vec<Vec<f32>> {
    let last = |query: &TracedQuery| query.thought.last().unwrap().actions[..query.executed].to_vec();
    trace.queries.iter().flat_map(last).collect()
}

fn depths(trace: &PolicyTrace) -> Vec<usize> {
    trace.queries.iter().map(|query| query.thought.len()).collect()
}

#[test]
fn warm_start_and_budget_change_what_is_executed() {
    let mut pool = Pool::start(options("Lift", 1)).unwrap();
    let mut run = |reasoning: ReasoningConfig| trace(&subject(reasoning), &mut pool, 10_000, None).unwrap().unwrap();
    let plain = run(five());
    assert_eq!((plain.steps, plain.queries.len(), depths(&plain)), (18, 5, vec![5; 5]));
    assert_eq!(plain.queries.iter().map(|query| query.step).collect::<Vec<_>>(), [0, 4, 8, 12, 16]);
    assert_eq!(plain.queries.iter().map(|query| query.executed).collect::<Vec<_>>(), [4, 4, 4, 4, 2]);
    assert_eq!(executed(&plain).len(), 18);
    assert_eq!(executed(&run(five())), executed(&plain), "an episode repeats");

    let warm = ReasoningConfig { warm_start: Some(WarmStart { noise: 0.1 }), ..five() };
    let warm = run(warm.clone());
    let (first, later) = (executed(&plain), executed(&warm));
    assert_eq!(first[..4], later[..4], "there is nothing to start from at first");
    assert_ne!(first[4..], later[4..], "then every thought goes on from the one before");

    let hurried = run(ReasoningConfig { budget_ms: Some(0.0), ..five() });
    assert_eq!(depths(&hurried), [1; 5], "no time but for one step");
    assert_ne!(executed(&hurried)[..4], first[..4]);
    let patient = run(ReasoningConfig { budget_ms: Some(1e6), ..five() });
    assert_eq!(executed(&patient), first, "time enough for everything");
}

#[test]
fn an_evaluation_says_that_time_decides() {
    let pool = Pool::start(options("Lift", 1)).unwrap();
    let wanted =
        EvaluationOptions { seeds: Seeds { start: 10_000, count: 1 }, shard: None, env_module: None, force: false };
    let record = |reasoning| subject(reasoning).record(pool.ready(), &wanted).unwrap();
    let json = |reasoning| serde_json::to_string(&record(reasoning)).unwrap();
    assert!(json(ReasoningConfig { budget_ms: Some(5.0), ..five() }).contains("\"time_decides\":true"));
    assert!(!json(five()).contains("time_decides"));
}
