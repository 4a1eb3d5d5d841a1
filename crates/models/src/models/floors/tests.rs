#![allow(clippy::unwrap_used)]
use super::nearest::Nearest;
use super::random::Random;
use super::replay::Replay;
use super::zero::Zero;
use super::*;
use crate::features::Observation;
use crate::normaliser::{ACTION, NormMode, Normaliser, STATE};
use crate::policy::{Actor, RecedingHorizon};
use crate::testing::{batch, signatures};
use crate::train::{TrainConfig, Trainer};

struct NoClock;

impl Clock for NoClock {
    fn milliseconds(&mut self) -> f64 {
        0.0
    }
}

/// One number seen, one done, as they are.
fn plain() -> Arc<Preprocess> {
    let modes = [STATE, ACTION].map(|name| (name.to_string(), NormMode::Identity));
    let normaliser = Normaliser::new(&BTreeMap::from(modes), &BTreeMap::new()).unwrap();
    Arc::new(Preprocess::new(Signature::low_dimensional(1, 0, 1), normaliser, &candle_core::Device::Cpu).unwrap())
}

/// A demonstration: what was seen and done, windows of `horizon`.
fn demonstration(steps: &[(f32, f32)], horizon: usize) -> Batch {
    let n = steps.len();
    let seen: Vec<f32> = steps.iter().map(|step| step.0).collect();
    let done: Vec<f32> = (0..n).flat_map(|t| (0..horizon).map(move |k| steps[(t + k).min(n - 1)].1)).collect();
    let pad: Vec<bool> = (0..n).flat_map(|t| (0..horizon).map(move |k| t + k >= n)).collect();
    Batch::from_slices(plain().signature(), horizon, &Features::of_slices(&seen, &[]), &done, &pad).unwrap()
}

fn seen(x: f32) -> Observation {
    Observation::of_state(vec![x], vec![])
}

#[test]
fn zero_does_nothing_and_chance_fills_the_range() {
    let signature = signatures().history;
    let config = Config { action_horizon: 3 };
    let batch = batch(&signature, 3, 200, 1);
    let flat = |t: Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    let zero = Zero::new(&config, &signature, 0, &Backend::CPU).unwrap();
    let sample =
        |model: &dyn PolicyModel, seed| model.sample(&batch.observation, &mut Rng::new(seed, "policy")).unwrap();
    assert_eq!(sample(&zero, 1).dims(), [200, 3, 2]);
    assert!(flat(sample(&zero, 1)).iter().all(|x| *x == 0.0));
    let random = Random::new(&config, &signature, 0, &Backend::CPU).unwrap();
    let drawn = flat(sample(&random, 1));
    assert_eq!(drawn, flat(sample(&random, 1)));
    assert_ne!(drawn, flat(sample(&random, 2)));
    let (least, most) = drawn.iter().fold((1.0_f32, -1.0_f32), |(a, b), x| (a.min(*x), b.max(*x)));
    assert!((-1.0..-0.98).contains(&least) && (0.98..1.0).contains(&most), "{least} {most}");
    assert!((drawn.iter().sum::<f32>() / 1200.0).abs() < 0.05);
}

#[test]
fn the_nearest_are_those_of_a_search_through_all() {
    let signature = signatures().entities;
    for k in [1, 3, 40] {
        let config = nearest::Config { action_horizon: 2, k };
        let model = Nearest::new(&config, &signature, 0, &Backend::CPU).unwrap();
        let episodes = [batch(&signature, 2, 17, 3), batch(&signature, 2, 23, 4)];
        model.memory().unwrap().remember(&episodes, &[]).unwrap();
        let asked = batch(&signature, 2, 5, 9);
        let rows =
            |batch: &Batch| joined("test", &signature, batch.rows(), &batch.observation).unwrap().to_vec2().unwrap();
        let all: Vec<Vec<f32>> = episodes.iter().flat_map(rows).collect();
        let actions: Vec<Vec<Vec<f32>>> = episodes.iter().flat_map(|e| e.actions.to_vec3::<f32>().unwrap()).collect();
        let got = model.predict(&asked.observation).unwrap().to_vec3::<f32>().unwrap();
        for (row, got) in rows(&asked).iter().zip(got) {
            let mut order: Vec<(f64, usize)> = all
                .iter()
                .enumerate()
                .map(|(i, other)| (row.iter().zip(other).map(|(a, b)| f64::from(a - b).powi(2)).sum(), i))
                .collect();
            order.sort_by(|a, b| a.0.total_cmp(&b.0));
            for (step, numbers) in got.iter().enumerate() {
                for (dim, got) in numbers.iter().enumerate() {
                    let want = order[..k].iter().map(|(_, i)| actions[*i][step][dim]).sum::<f32>() / k as f32;
                    assert!((got - want).abs() < 1e-5, "{got} {want}");
                }
            }
        }
    }
    let model = Nearest::new(
        &nearest::Config { action_horizon: 1, k: 4 },
        &Signature::low_dimensional(1, 0, 1),
        0,
        &Backend::CPU,
    )
    .unwrap();
    let few = demonstration(&[(0.0, 1.0), (1.0, 2.0)], 1);
    let error = model.memory().unwrap().remember(&[few], &[]).unwrap_err().to_string();
    assert!(error.contains("k is 4, expected at most the number of windows, 2"), "{error}");
}

#[test]
fn a_demonstration_is_played_to_its_end_and_its_seed_says_which() {
    let preprocess = plain();
    let held_out =
        [demonstration(&[(0.0, 1.0), (0.0, 2.0), (0.0, 3.0)], 2), demonstration(&[(0.0, -1.0), (0.0, -2.0)], 2)];
    for (horizon, executed) in [(1, 1), (2, 2), (4, 3)] {
        let model = Replay::new(&Config { action_horizon: horizon }, preprocess.signature(), 0, &Backend::CPU).unwrap();
        let error = model.memory().unwrap().remember(&held_out, &[]).unwrap_err().to_string();
        assert!(error.contains("held-out demonstrations is none"), "{error}");
        model.memory().unwrap().remember(&[], &held_out).unwrap();
        let policy = Arc::new(model).policy(Arc::clone(&preprocess), Box::new(NoClock));
        let mut actor = RecedingHorizon::new(policy, executed).unwrap();
        let mut played = Vec::new();
        for seed in 0..20 {
            actor.reset(seed);
            let actions: Vec<f32> = (0..5).map(|step| actor.act(&seen(step as f32)).unwrap()[0]).collect();
            assert!(
                [vec![1.0, 2.0, 3.0, 3.0, 3.0], vec![-1.0, -2.0, -2.0, -2.0, -2.0]].contains(&actions),
                "{actions:?}"
            );
            played.push(actions[0]);
        }
        assert!(played.contains(&1.0) && played.contains(&-1.0), "{played:?}");
        actor.reset(3);
        assert_eq!(actor.act(&seen(7.0)).unwrap()[0], played[3]);
    }
}

#[test]
fn a_training_leaves_what_was_remembered_and_restores_it() {
    let preprocess = plain();
    let episode = demonstration(&[(0.0, 1.0), (1.0, 2.0), (5.0, 3.0)], 1);
    let make = || {
        let model = Nearest::new(&nearest::Config::default(), preprocess.signature(), 0, &Backend::CPU).unwrap();
        model.memory().unwrap().remember(std::slice::from_ref(&episode), &[]).unwrap();
        Trainer::new(Box::new(model), TrainConfig { steps: 1, ..TrainConfig::default() }, 1).unwrap()
    };
    let mut trainer = make();
    let done = trainer.step(&episode).unwrap();
    assert_eq!((done.loss, done.grad_norm), (0.0, 0.0));
    let mut other = make();
    other.restore(&trainer.state().unwrap()).unwrap();
    assert_eq!(other.step_count(), 1);
    // an entry is built empty and takes what was saved
    let entry = Nearest::new(&nearest::Config::default(), preprocess.signature(), 0, &Backend::CPU).unwrap();
    assert!(entry.predict(&episode.observation).unwrap_err().to_string().contains("tensor seen is missing"));
    entry.params().load(&other.eval_params().unwrap()).unwrap();
    let mut policy = Arc::new(entry).policy(preprocess, Box::new(NoClock));
    let asked = [-3.0, 0.6, 3.1].map(|x| policy.predict(&seen(x)).unwrap().actions[0]);
    assert_eq!(asked, [1.0, 2.0, 3.0]);
}

#[test]
fn what_cannot_be_is_named() {
    let signature = signatures().plain;
    let error = |error: ModelError| error.to_string();
    assert!(
        error(Zero::new(&Config { action_horizon: 0 }, &signature, 0, &Backend::CPU).unwrap_err())
            .contains("action_horizon is 0")
    );
    let none = nearest::Config { k: 0, ..Default::default() };
    assert!(error(Nearest::new(&none, &signature, 0, &Backend::CPU).unwrap_err()).contains("k is 0"));
    let sees = signatures().images;
    assert!(
        error(Replay::new(&Config::default(), &sees, 0, &Backend::CPU).unwrap_err())
            .contains("replay cannot read feature a")
    );
}
