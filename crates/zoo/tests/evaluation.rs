//! Evaluations with a real robosuite behind them: the same bytes whatever happens to the workers.

#![allow(clippy::unwrap_used)]

mod common;

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, PoisonError, RwLock, RwLockReadGuard};
use std::time::Duration;

use common::{impatient, options, spec, worker_processes, wrapped};
use models::{ActionChunk, ENVIRONMENT_STATE, ModelError, Observation, Policy, STATE, Signature};
use rollout::{Pool, PoolOptions, RolloutError, TimeLimits};
use rustix::process::{Pid, Signal, kill_process};
use zoo::evaluation::{EvaluationEnd, EvaluationOptions, Progress, Subject, evaluate};
use zoo::results::{EntryIdentity, Execution, Seeds, Shard, StoredEvaluation, TrainingFacts, merge_shards};
use zoo::{FeatureKeys, ZooError};

/// The test that strikes at workers finds them among this process' children: meanwhile no other test may have any.
static WORKERS: RwLock<()> = RwLock::new(());

/// Held by a test that leaves others' workers alone.
fn beside_others() -> RwLockReadGuard<'static, ()> {
    WORKERS.read().unwrap_or_else(PoisonError::into_inner)
}

/// A small closed-loop controller for Lift with a state of its own: over the cube, down, close, up.
#[derive(Default)]
struct Grasper {
    closed: u32,
}

impl Policy for Grasper {
    fn predict(&mut self, seen: &Observation) -> Result<ActionChunk, ModelError> {
        let numbers = |name: &str| Ok::<_, ModelError>(seen.require("grasp", name)?.numbers().unwrap());
        let (hand, cube) = (&numbers(STATE)?[..3], &numbers(ENVIRONMENT_STATE)?[..3]);
        let off = [cube[0] - hand[0], cube[1] - hand[1], cube[2] - hand[2]];
        let aside = off[0].hypot(off[1]);
        let near = aside < 0.012 && off[2].abs() < 0.012;
        if near || self.closed > 0 {
            self.closed += 1;
        }
        let up = match self.closed {
            0 if aside > 0.02 => off[2] + 0.08,
            0 => off[2],
            1..=2 => 0.0,
            _ => 0.2,
        };
        let grip = if self.closed > 0 { 1.0 } else { -1.0 };
        let action = [off[0] * 12.0, off[1] * 12.0, up * 12.0, 0.0, 0.0, 0.0, grip];
        ActionChunk::new([action; 3].concat(), 3, 7)
    }

    fn reset(&mut self, _seed: u64) {
        self.closed = 0;
    }
}

fn subject() -> Subject<'static> {
    let mut keys = FeatureKeys::default();
    keys.insert(STATE, &["robot0_eef_pos", "robot0_gripper_qpos"].map(str::to_owned)).unwrap();
    keys.insert(ENVIRONMENT_STATE, &["object".to_owned()]).unwrap();
    Subject {
        entry: EntryIdentity { name: "grasper".into(), version: 1, hash: "ab".repeat(32) },
        training: TrainingFacts {
            policy: "scripted".into(),
            parameters: 0,
            steps: 0,
            minutes: 0.0,
            seed: 0,
            data_set: "none".into(),
            data_fingerprint: String::new(),
            data_simulator: None,
            demos: 0,
        },
        task: "Lift".into(),
        demonstrations: None,
        env_version: Some("1.5.1".into()),
        keys,
        execution: Execution::RecedingHorizon { n_action_steps: 2 },
        time_decides: false,
        max_steps: Some(45),
        signature: Signature::low_dimensional(5, 10, 7),
        conventions: zoo::conventions::Conventions::default(),
        is_scripted: false,
        fast_render: None,
        perturbation: None,
        gpu: None,
        policy: Box::new(|| Ok(Box::new(Grasper::default()))),
    }
}

fn wanted(count: u64) -> EvaluationOptions {
    EvaluationOptions { seeds: Seeds { start: 10_000, count }, shard: None, env_module: None, force: false }
}

fn run(pool: &mut Pool, results: &Path, options: &EvaluationOptions) -> StoredEvaluation {
    match evaluate(&subject(), pool, results, options, &mut |_| {}).unwrap() {
        EvaluationEnd::Complete(stored) => *stored,
        other => panic!("{other:?}, incidents {:?}", pool.incidents()),
    }
}

fn bytes(evaluation: &StoredEvaluation, name: &str) -> Vec<u8> {
    std::fs::read(evaluation.folder.join(name)).unwrap()
}

/// Two runs must agree in every byte but the timings'.
fn assert_same(a: &StoredEvaluation, b: &StoredEvaluation) {
    assert_eq!(a.episodes, b.episodes);
    for name in ["evaluation.json", "outcomes.parquet"] {
        assert_eq!(bytes(a, name), bytes(b, name), "{name}");
    }
}

#[test]
fn pictures_that_are_drawn_otherwise_than_the_demonstrations_are_refused() {
    let _workers = beside_others();
    let dir = tempfile::tempdir().unwrap();
    let seeing = |fast_render| Subject { fast_render: Some(fast_render), ..subject() };
    for drawn in [false, true] {
        let mut options = options("Lift", 1);
        (options.spec.cameras, options.spec.image_size) = (vec!["agentview".to_owned()], 16);
        options.spec.fast_render = drawn;
        let mut pool = Pool::start(options).unwrap();
        let evaluated = |learned, pool: &mut Pool| {
            evaluate(&seeing(learned), pool, dir.path(), &wanted(1), &mut |_| {}).map(|_| ()).map_err(|e| e.to_string())
        };
        evaluated(drawn, &mut pool).unwrap();
        let error = evaluated(!drawn, &mut pool).unwrap_err();
        assert!(error.contains("grasper@1") && error.contains("images drawn"), "{error}");
    }
}

#[test]
fn one_two_and_three_workers_shards_and_resuming_give_the_same_bytes() {
    let _workers = beside_others();
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let mut one = Pool::start(options("Lift", 1)).unwrap();
    let straight = run(&mut one, &at("one"), &wanted(6));
    assert!(straight.successes() > 0, "the controller should lift now and then: {:?}", straight.episodes);
    // a second time on the same worker: nothing is left to run
    let mut episodes = 0;
    let again = evaluate(&subject(), &mut one, &at("one"), &wanted(6), &mut |news| {
        episodes += usize::from(matches!(news, Progress::Episode(_)));
    });
    assert!(matches!(again.unwrap(), EvaluationEnd::Complete(_)));
    assert_eq!(episodes, 0);
    drop(one);

    let mut three = Pool::start(options("Lift", 3)).unwrap();
    assert_same(&run(&mut three, &at("three"), &wanted(6)), &straight);
    drop(three);

    let stop = Arc::new(AtomicBool::new(false));
    let mut pool_options = options("Lift", 2);
    let asked = Arc::clone(&stop);
    pool_options.stop = Arc::new(move || asked.load(Ordering::Relaxed));
    let mut two = Pool::start(pool_options).unwrap();
    assert_same(&run(&mut two, &at("two"), &wanted(6)), &straight);

    // in three shards, the last one first, then joined
    let mut parts = Vec::new();
    for index in [3, 1, 2] {
        let options = EvaluationOptions { shard: Some(Shard { index, count: 3 }), ..wanted(6) };
        parts.push(run(&mut two, &at("shards"), &options).folder);
    }
    assert_same(&merge_shards(&parts, &at("merged")).unwrap(), &straight);

    // stopped after the first episode, as by Ctrl-C, then resumed
    let end = evaluate(&subject(), &mut two, &at("stopped"), &wanted(6), &mut |news| {
        if matches!(news, Progress::Episode(_)) {
            stop.store(true, Ordering::Relaxed);
        }
    });
    let EvaluationEnd::Stopped { done, total: 6 } = end.unwrap() else { panic!("expected a stop") };
    // results come in order: the other worker may have run ahead of a slow first episode
    assert!((1..6).contains(&done), "{done}");
    stop.store(false, Ordering::Relaxed);
    let mut begun = 0;
    let resumed = evaluate(&subject(), &mut two, &at("stopped"), &wanted(6), &mut |news| {
        if let Progress::Begin { done, .. } = news {
            begun = done;
        }
    });
    let EvaluationEnd::Complete(resumed) = resumed.unwrap() else { panic!("expected the whole") };
    assert_eq!(begun, done, "what was done is not done again");
    assert_same(&resumed, &straight);
}

/// Kills, stops and slows workers at random, and prints into their pipes, while ten episodes run.
#[test]
fn chaos_among_the_workers_does_not_change_a_byte() {
    let _workers = WORKERS.write().unwrap_or_else(PoisonError::into_inner);
    let dir = tempfile::tempdir().unwrap();
    let mut calm = Pool::start(options("Lift", 2)).unwrap();
    let expected = run(&mut calm, &dir.path().join("calm"), &wanted(10));
    drop(calm);

    // every third start prints into its pipe after a while: not the first ones, which have only three attempts each
    let garble = "echo >> \"$0.starts\"; N=$(wc -l < \"$0.starts\")\n\
        if [ $((N % 3)) -eq 0 ]; then ( sleep $((4 + N % 5)).$((N % 10)); echo 'Welcome to the simulator, have fun' ) & fi\n\
        exec \"$PY\" \"$@\"";
    let mut spec = spec("Lift");
    spec.python = wrapped(dir.path(), "garbling-python", garble);
    spec.limits = impatient(TimeLimits::default());
    let mut pool = Pool::start(PoolOptions::new(spec, 2)).unwrap();
    let over = AtomicBool::new(false);
    let disturbed = std::thread::scope(|scope| {
        let over = &over;
        scope.spawn(move || {
            let mut state = 0x9e37_79b9_7f4a_7c15_u64;
            let mut draw = |below: u64| {
                state ^= state << 13;
                state ^= state >> 7;
                state ^= state << 17;
                state % below
            };
            while !over.load(Ordering::Relaxed) {
                std::thread::sleep(Duration::from_millis(200 + draw(2500)));
                let workers = worker_processes();
                if workers.is_empty() {
                    continue;
                }
                let victim = workers[draw(workers.len() as u64) as usize];
                let send = |signal| Pid::from_raw(victim).map(|pid| kill_process(pid, signal));
                match draw(4) {
                    0 => drop(send(Signal::KILL)),
                    1 => drop(send(Signal::STOP)),
                    _ => {
                        send(Signal::STOP);
                        std::thread::sleep(Duration::from_millis(100 + draw(900)));
                        send(Signal::CONT);
                    }
                }
            }
        });
        let result = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            let results = dir.path().join("disturbed");
            // a fast machine is done before the first of those: all are killed before a step, and amid an episode
            let mut blows = 2;
            let mut strike = |_: Progress<'_>| {
                if blows > 0 {
                    blows -= 1;
                    for worker in worker_processes() {
                        let _ = Pid::from_raw(worker).map(|pid| kill_process(pid, Signal::KILL));
                    }
                }
            };
            // an episode that met three bad workers in a row is reported; asking again runs it again
            loop {
                match evaluate(&subject(), &mut pool, &results, &wanted(10), &mut strike) {
                    Ok(EvaluationEnd::Complete(stored)) => break *stored,
                    Ok(EvaluationEnd::Failed { .. }) | Err(ZooError::Rollout(RolloutError::Start { .. })) => {}
                    other => panic!("{other:?}"),
                }
            }
        }));
        over.store(true, Ordering::Relaxed);
        result
    });
    let disturbed = disturbed.unwrap();
    assert!(!pool.incidents().is_empty(), "nothing was disturbed");
    assert_same(&disturbed, &expected);
    let journal = disturbed.folder.join("journal.jsonl");
    assert!(!journal.exists());
}

#[test]
fn what_does_not_fit_is_refused_before_anything_is_written() {
    let _workers = beside_others();
    let dir = tempfile::tempdir().unwrap();
    let mut pool = Pool::start(options("Lift", 1)).unwrap();
    let results = dir.path().join("results");
    let mut refuse = |change: fn(&mut Subject<'static>)| {
        let mut subject = subject();
        change(&mut subject);
        let error = evaluate(&subject, &mut pool, &results, &wanted(1), &mut |_| {}).unwrap_err();
        let mut text = error.to_string();
        let mut cause: &dyn std::error::Error = &error;
        while let Some(next) = cause.source() {
            text = format!("{text}: {next}");
            cause = next;
        }
        text
    };
    let error = refuse(|s| s.env_version = Some("1.4.1".into()));
    assert!(error.contains("robosuite 1.4.1") && error.contains("--force"), "{error}");
    let error = refuse(|s| s.keys.insert(ENVIRONMENT_STATE, &["objekt".into()]).unwrap());
    assert!(error.contains("\"objekt\"") && error.contains("object,"), "{error}");
    let error = refuse(|s| s.keys.insert(STATE, &["robot0_eef_pos[1:4]".into()]).unwrap());
    assert!(error.contains("robot0_eef_pos[1:4]: robot0_eef_pos has 3 numbers"), "{error}");
    let error = refuse(|s| s.signature = Signature::low_dimensional(9, 10, 7));
    assert!(error.contains("length of observation.state: expected 9, found 5"), "{error}");
    let error = refuse(|s| s.signature.action_dim = 8);
    assert!(error.contains("length of an action: expected 8, found 7"), "{error}");
    assert!(!results.exists());
    // a policy that gives what is no action ends the evaluation with an error that says where
    let error = refuse(|s| {
        s.policy = Box::new(|| {
            struct Broken;
            impl Policy for Broken {
                fn predict(&mut self, _: &Observation) -> Result<ActionChunk, ModelError> {
                    ActionChunk::new([0.0, 0.0, f32::NAN, 0.0, 0.0, 0.0, 0.0].repeat(2), 2, 7)
                }
                fn reset(&mut self, _seed: u64) {}
            }
            Ok(Box::new(Broken))
        });
    });
    assert!(error.contains("seed 10000, step 0: action: expected 7 finite values, found NaN at index 2"), "{error}");
    // episodes that begin as its demonstrations did are no test
    let error = refuse(|s| s.demonstrations = Some(Seeds { start: 9_990, count: 11 }));
    assert!(error.contains("seeds 10000") && error.contains("began with 9990-10000"), "{error}");
    // forced, the other generation is evaluated
    let forced = EvaluationOptions { force: true, ..wanted(1) };
    let other = Subject { env_version: None, ..subject() };
    let end: Result<EvaluationEnd, ZooError> = evaluate(&other, &mut pool, &results, &forced, &mut |_| {});
    assert!(matches!(end.unwrap(), EvaluationEnd::Complete(_)));
    // the result says that they were no test; beside those seeds it is one
    for (start, told) in [(9_990, true), (10_001, false)] {
        let other = Subject { demonstrations: Some(Seeds { start, count: 11 }), ..subject() };
        assert_eq!(other.record(pool.ready(), &forced).unwrap().demonstrated, told);
        assert_eq!(other.record(pool.ready(), &wanted(1)).is_err(), told);
    }
}
