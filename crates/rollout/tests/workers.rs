//! Workers with a real robosuite behind them: same episode from any worker, and every way to fail.

#![allow(clippy::unwrap_used)]

mod common;

use std::ops::ControlFlow;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::{Duration, Instant};

use common::{alive, impatient, options, spec, wait_until, wrapped};
use rollout::{
    EpisodePlan, JobError, Pool, PoolOptions, RecordedEpisode, RolloutError, RunEnd, Skill, TimeLimits, Worker,
};
use rustix::process::{Pid, Signal, kill_process};

/// Everything that an episode shows, to the last bit: fingerprint, observations, rewards.
fn trace(worker: &mut Worker, seed: u64, steps: u32) -> Result<Vec<String>, JobError> {
    let initial = worker.reset(seed)?;
    let bits = |observations: &std::collections::BTreeMap<String, Vec<f64>>| {
        let values = observations.values().flatten().map(|value| value.to_bits());
        values.fold(0u64, |hash, bits| (hash ^ bits).wrapping_mul(0x0100_0000_01b3).rotate_left(17))
    };
    let mut lines = vec![initial.fingerprint.clone(), format!("{:x}", bits(initial.observations.numbers()))];
    for step in 0..steps {
        let wave = |k: u64| ((seed * 31 + u64::from(step) * 7 + k * 13) % 201) as f64 / 100.0 - 1.0;
        let action: Vec<f64> = (0..7).map(wave).collect();
        let stepped = worker.step(&[action])?;
        lines.push(format!("{:x} {:x}", stepped.rewards[0].to_bits(), bits(stepped.observations.numbers())));
    }
    Ok(lines)
}

fn traces(pool: &mut Pool, seeds: &[u64], steps: u32) -> Vec<(u64, Vec<String>)> {
    let seed_of = |job: u64| seeds[job as usize];
    let work = |(): &mut (), worker: &mut Worker, job| trace(worker, seed_of(job), steps);
    let mut all = Vec::new();
    let end = pool
        .run(0..seeds.len() as u64, &seed_of, &|| Ok(()), &work, &mut |job, result| {
            all.push((seed_of(job), result.unwrap()));
            ControlFlow::Continue(())
        })
        .unwrap();
    assert_eq!(end, RunEnd::Complete);
    all
}

#[test]
fn an_episode_is_the_same_on_any_worker_in_any_order_after_anything() {
    let seeds = [10_000, 10_001, 10_002, 10_003];
    let mut one = Pool::start(options("Lift", 1)).unwrap();
    let expected = traces(&mut one, &seeds, 12);
    assert_eq!(expected.iter().map(|(seed, _)| *seed).collect::<Vec<_>>(), seeds, "delivered in order");
    for (a, b) in expected.iter().zip(&expected[1..]) {
        assert_ne!(a.1[0], b.1[0], "other seeds begin elsewhere");
    }
    // the same worker, now with a history, an episode cut short, and the other way round
    let reversed: Vec<u64> = seeds.iter().rev().copied().collect();
    traces(&mut one, &[77], 3);
    let mut again = traces(&mut one, &reversed, 12);
    again.reverse();
    assert_eq!(again, expected);
    one.close();
    // other processes, several at once
    let mut two = Pool::start(options("Lift", 2)).unwrap();
    let mut again = traces(&mut two, &[10_003, 10_001, 10_000, 10_002], 12);
    again.sort_by_key(|(seed, _)| *seed);
    assert_eq!(again, expected);
    // expert episodes too, and they do not disturb the others
    let experts = shown(&mut two, 0..3);
    assert_eq!(traces(&mut two, &seeds, 12), expected);
    assert!(experts.iter().any(|episode| episode.success));
    assert_eq!(shown(&mut two, 2..3)[0], experts[2], "an expert's episode depends on its seed alone");
    assert!(two.incidents().is_empty(), "{:?}", two.incidents());
}

/// Episodes of the expert.
fn shown(pool: &mut Pool, attempts: std::ops::Range<u64>) -> Vec<RecordedEpisode> {
    let work = |(): &mut (), worker: &mut Worker, attempt| Ok(worker.expert(1_000_000 + attempt, None, Skill::Good)?);
    let mut all = Vec::new();
    pool.run(attempts, &|attempt| attempt, &|| Ok(()), &work, &mut |_, episode| {
        all.push(episode.unwrap());
        ControlFlow::Continue(())
    })
    .unwrap();
    all
}

#[test]
fn a_killed_worker_s_episode_is_run_again_and_ends_the_same() {
    let seeds = [10_000, 10_001, 10_002];
    let mut pool = Pool::start(options("Lift", 1)).unwrap();
    let expected = traces(&mut pool, &seeds, 8);
    let killed = AtomicU32::new(0);
    let work = |(): &mut (), worker: &mut Worker, job: u64| {
        // twice, in the middle of the second episode
        if job == 1 && killed.fetch_add(1, Ordering::Relaxed) < 2 {
            trace(worker, 10_001, 4)?;
            kill_process(Pid::from_raw(worker.process_id() as i32).unwrap(), Signal::KILL).unwrap();
        }
        trace(worker, seeds[job as usize], 8)
    };
    let mut all = Vec::new();
    pool.run(0..3, &|job| seeds[job as usize], &|| Ok(()), &work, &mut |job, result| {
        all.push((seeds[job as usize], result.unwrap()));
        ControlFlow::Continue(())
    })
    .unwrap();
    assert_eq!(all, expected);
    assert_eq!(pool.incidents().len(), 2);
    assert!(pool.incidents()[0].text.contains("signal: 9"), "{}", pool.incidents()[0].text);
}

#[test]
fn a_worker_that_always_dies_is_an_error_after_three_and_the_others_go_on() {
    let dir = tempfile::tempdir().unwrap();
    let mut options = options("Lift", 1);
    options.logs = Some(dir.path().join("logs"));
    let mut pool = Pool::start(options).unwrap();
    let work = |(): &mut (), worker: &mut Worker, job: u64| {
        if job == 0 {
            kill_process(Pid::from_raw(worker.process_id() as i32).unwrap(), Signal::KILL).unwrap();
        }
        trace(worker, 10_000 + job, 1)
    };
    let mut results = Vec::new();
    pool.run(0..2, &|job| 10_000 + job, &|| Ok(()), &work, &mut |_, result| {
        results.push(result);
        ControlFlow::Continue(())
    })
    .unwrap();
    let error = results[0].as_ref().unwrap_err();
    assert!(matches!(error, RolloutError::Episode { seed: 10_000, attempts: 3, .. }), "{error}");
    assert!(error.to_string().contains("no result after 3 workers"), "{error}");
    assert!(results[1].is_ok());
    // four workers were started in all, and each has its log
    assert_eq!(std::fs::read_dir(dir.path().join("logs")).unwrap().count(), 4);
}

#[test]
fn a_stopped_worker_is_a_time_out_and_is_killed() {
    let mut spec = spec("Lift");
    spec.limits = impatient(TimeLimits::default());
    let mut pool = Pool::start(PoolOptions::new(spec, 1)).unwrap();
    let expected = traces(&mut pool, &[10_000], 3);
    let first = pool.process_ids()[0];
    let stopped = AtomicBool::new(false);
    let work = |(): &mut (), worker: &mut Worker, _| {
        if !stopped.swap(true, Ordering::Relaxed) {
            trace(worker, 10_000, 2)?;
            kill_process(Pid::from_raw(first as i32).unwrap(), Signal::STOP).unwrap();
        }
        trace(worker, 10_000, 3)
    };
    pool.run(0..1, &|_| 10_000, &|| Ok(()), &work, &mut |_, result| {
        assert_eq!(result.unwrap(), expected[0].1);
        ControlFlow::Continue(())
    })
    .unwrap();
    let text = &pool.incidents()[0].text;
    assert!(text.contains("no answer within 8.0 s"), "{text}");
    wait_until("the stopped worker is gone", || !alive(first));
}

#[test]
fn dropping_a_pool_leaves_no_process() {
    let pool = Pool::start(options("Lift", 2)).unwrap();
    let ids = pool.process_ids();
    assert!(ids.len() == 2 && ids.iter().all(|&id| alive(id)));
    drop(pool);
    wait_until("both workers are gone", || !ids.iter().any(|&id| alive(id)));
}

#[test]
fn text_on_stdout_is_noticed_and_never_read_as_an_answer() {
    let dir = tempfile::tempdir().unwrap();
    // the first worker prints into the pipe once its environment runs; later ones do not
    let body = format!(
        "if mkdir '{}/first' 2>/dev/null; then ( while [ ! -e '{}/go' ]; do sleep 0.02; done; echo Welcome to the simulator; touch '{}/said' ) & fi\nexec \"$PY\" \"$@\"",
        dir.path().display(),
        dir.path().display(),
        dir.path().display()
    );
    let mut spec = spec("Lift");
    spec.python = wrapped(dir.path(), "python", &body);
    let mut pool = Pool::start(PoolOptions::new(spec, 1)).unwrap();
    let expected = traces(&mut pool, &[10_000], 2);
    std::fs::write(dir.path().join("go"), "").unwrap();
    wait_until("the text is in the pipe", || dir.path().join("said").exists());
    assert_eq!(traces(&mut pool, &[10_000], 2), expected);
    let text = &pool.incidents()[0].text;
    assert!(text.contains("nobody asked for"), "{text}");
}

#[test]
fn a_python_without_robosuite_is_one_clear_line() {
    let dir = tempfile::tempdir().unwrap();
    let mut spec = spec("Lift");
    // -S: without the installed packages
    spec.python = wrapped(dir.path(), "bare-python", "exec \"$PY\" -S \"$@\"");
    let error = Pool::start(PoolOptions::new(spec, 1)).err().unwrap().to_string();
    assert!(error.contains("bare-python") && error.contains("it has no numpy"), "{error}");
    assert!(error.contains("make venv") && !error.contains('\n'), "{error}");
}

#[test]
fn an_unknown_task_is_one_clear_line_that_lists_the_others() {
    let error = Pool::start(options("Lifft", 1)).err().unwrap().to_string();
    assert!(error.contains("Lifft") && error.contains("Lift,") && !error.contains('\n'), "{error}");
}

#[test]
fn a_worker_that_never_greets_is_reported_after_three_tries() {
    let dir = tempfile::tempdir().unwrap();
    let mut spec = spec("Lift");
    spec.python = wrapped(dir.path(), "python", "echo tried >&2; exec sleep 100");
    spec.limits.start = Duration::from_millis(300);
    let error = Pool::start(PoolOptions::new(spec, 1)).err().unwrap().to_string();
    assert!(error.contains("did not start in 3 tries"), "{error}");
    assert!(error.contains("no answer within 0.3 s") && error.contains("tried"), "{error}");
}

#[test]
fn other_robots_are_started_as_env_args_say() {
    let mut options = options("TwoArmLift", 1);
    let usual = Pool::start(options.clone()).unwrap().ready().clone();
    assert_eq!((usual.simulator.as_str(), usual.action_dim), ("robosuite", 14));
    assert_eq!((usual.simulator_version(), &usual.env_args_sha256), (Some("1.5.2"), &None));
    let env_args = serde_json::json!({"env_name": "TwoArmLift", "env_kwargs": {"robots": ["Sawyer", "Panda"]}});
    options.spec.env_args = Some(env_args);
    let mut pool = Pool::start(options).unwrap();
    assert_eq!(pool.ready().env_args["env_kwargs"]["robots"][0], "Sawyer");
    assert!(pool.ready().env_args_sha256.is_some() && pool.fallback().unwrap().contains("compiled control is off"));
    let step = |(): &mut (), worker: &mut Worker, job: u64| -> Result<usize, JobError> {
        worker.reset(job)?;
        Ok(worker.step(&[vec![0.1; 14]])?.observations.get("robot1_joint_pos").map_or(0, Vec::len))
    };
    let mut seen = Vec::new();
    let end = pool.run(0..2, &|job| job, &|| Ok(()), &step, &mut |_, joints| {
        seen.push(joints.unwrap());
        ControlFlow::Continue(())
    });
    assert_eq!((end.unwrap(), seen), (RunEnd::Complete, vec![7, 7]));
}

#[test]
fn a_request_to_stop_ends_a_start_at_once() {
    let dir = tempfile::tempdir().unwrap();
    let mut options = options("Lift", 2);
    options.spec.python = wrapped(dir.path(), "python", "echo $$ >> \"$(dirname \"$0\")/ids\"; exec sleep 100");
    let begun = Instant::now();
    options.stop = Arc::new(move || begun.elapsed() > Duration::from_millis(500));
    let error = Pool::start(options).err().unwrap();
    assert!(matches!(error, RolloutError::Stopped { .. }), "{error}");
    let ids = std::fs::read_to_string(dir.path().join("ids")).unwrap();
    for id in ids.lines().map(|line| line.trim().parse().unwrap()) {
        wait_until("the starting worker is gone", || !alive(id));
    }
}

#[test]
fn a_request_to_stop_ends_an_endless_episode() {
    let mut options = options("Lift", 1);
    let stop = Arc::new(AtomicBool::new(false));
    let asked = Arc::clone(&stop);
    options.stop = Arc::new(move || asked.load(Ordering::Relaxed));
    let mut pool = Pool::start(options).unwrap();
    let endless = |(): &mut (), worker: &mut Worker, job: u64| -> Result<(), JobError> {
        worker.reset(job)?;
        stop.store(true, Ordering::Relaxed);
        loop {
            worker.step(&vec![vec![0.0; 7]; 10_000])?;
        }
    };
    let mut delivered = 0;
    let end = pool.run(0..10, &|job| job, &|| Ok(()), &endless, &mut |_, _| {
        delivered += 1;
        ControlFlow::Continue(())
    });
    assert_eq!((end.unwrap(), delivered), (RunEnd::Stopped, 0));
    assert!(pool.incidents().is_empty(), "{:?}", pool.incidents());
}

#[test]
fn a_request_to_stop_ends_a_run_after_the_episodes_under_way() {
    let mut options = options("Lift", 1);
    let stop = Arc::new(AtomicBool::new(false));
    let asked = Arc::clone(&stop);
    options.stop = Arc::new(move || asked.load(Ordering::Relaxed));
    let mut pool = Pool::start(options).unwrap();
    let mut delivered = 0;
    let work = |(): &mut (), worker: &mut Worker, job| trace(worker, 10_000 + job, 1);
    let end = pool
        .run(0..1000, &|job| job, &|| Ok(()), &work, &mut |_, result| {
            result.unwrap();
            delivered += 1;
            stop.store(true, Ordering::Relaxed);
            ControlFlow::Continue(())
        })
        .unwrap();
    assert_eq!(end, RunEnd::Stopped);
    assert!((1..=2).contains(&delivered), "{delivered}");
}

/// Steps that go to the worker together are the steps that it does one after the other.
#[test]
fn many_actions_in_one_request_are_as_many_requests() {
    let mut pool = Pool::start(options("Lift", 1)).unwrap();
    let wave = |k: u64| (0..7).map(|j| ((k * 17 + j * 29) % 101) as f64 / 50.0 - 1.0).collect::<Vec<f64>>();
    let actions: Vec<Vec<f64>> = (0..9).map(wave).collect();
    let parts = |sizes: &'static [usize]| {
        let actions = actions.clone();
        move |(): &mut (), worker: &mut Worker, _: u64| {
            worker.reset(10_000)?;
            let (mut rewards, mut at, mut seen) = (Vec::new(), 0, None);
            for size in sizes {
                let stepped = worker.step(&actions[at..at + size])?;
                rewards.extend(stepped.rewards);
                seen = Some((stepped.success, stepped.observations));
                at += size;
            }
            Ok((rewards, seen))
        }
    };
    let mut run = |sizes: &'static [usize]| {
        let mut all = Vec::new();
        pool.run(0..1, &|job| job, &|| Ok(()), &parts(sizes), &mut |_, result| {
            all.push(result.unwrap());
            ControlFlow::Continue(())
        })
        .unwrap();
        all.remove(0)
    };
    let single = run(&[1; 9]);
    assert_eq!(single.0.len(), 9);
    assert_eq!(run(&[9]), single);
    assert_eq!(run(&[4, 1, 4]), single);
}

#[test]
fn images_are_drawn_of_every_step() {
    let mut pool = Pool::start(options("Lift", 1)).unwrap();
    let work = |(): &mut (), worker: &mut Worker, _| {
        worker.reset(10_000)?;
        let mut images = vec![worker.render("agentview", 96, 128)?];
        for _ in 0..5 {
            worker.step(&[vec![0.5, 0.0, -0.5, 0.0, 0.0, 0.0, 1.0]])?;
            images.push(worker.render("agentview", 96, 128)?);
        }
        Ok(images)
    };
    let mut films = Vec::new();
    pool.run(0..1, &|job| job, &|| Ok(()), &work, &mut |_, result| {
        films.push(result.unwrap());
        ControlFlow::Continue(())
    })
    .unwrap();
    let images = films.remove(0);
    assert_ne!(images[0], images[5], "the arm has moved");
    assert!(images.iter().all(|image| (image.height, image.width, image.rgb.len()) == (96, 128, 96 * 128 * 3)));
}

/// Workers of `tools/harness/tests/odd_simulator.py`, whose tasks are what can be wrong with an environment.
fn odd(folder: &std::path::Path, task: &str) -> rollout::WorkerSpec {
    let tests = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tools/harness/tests");
    let (tests, folder_text) = (tests.display(), folder.display());
    let body = format!("export PYTHONPATH=\"$PYTHONPATH:{tests}\" ODD_FOLDER=\"{folder_text}\"\nexec \"$PY\" \"$@\"");
    let mut spec = spec(task);
    spec.python = wrapped(folder, task, &body);
    spec.env_module = Some("odd_simulator".to_owned());
    spec
}

/// One action a job: what is delivered, and the end.
fn stepped(pool: &mut Pool, jobs: u64) -> (Vec<Result<bool, RolloutError>>, Result<RunEnd, RolloutError>) {
    let work = |(): &mut (), worker: &mut Worker, job: u64| {
        worker.reset(10_000 + job)?;
        Ok(worker.step(&[vec![-1.0]])?.success)
    };
    let mut results = Vec::new();
    let end = pool.run(0..jobs, &|job| 10_000 + job, &|| Ok(()), &work, &mut |_, result| {
        results.push(result);
        ControlFlow::Continue(())
    });
    (results, end)
}

#[test]
fn an_environment_that_hangs_ends_the_run_after_three_seeds_from_the_first_step_on() {
    let dir = tempfile::tempdir().unwrap();
    for (task, phase) in [("StepHangs", "step"), ("ResetHangs", "reset")] {
        let mut spec = odd(dir.path(), task);
        let limit = Duration::from_secs(1);
        // a start may take as long as it did; nothing after it has that long
        spec.limits = TimeLimits { step: limit, reset: limit, ..TimeLimits::default() };
        let mut pool = Pool::start(PoolOptions::new(spec, 2)).unwrap();
        let (results, end) = stepped(&mut pool, 50);
        let error = end.unwrap_err();
        let RolloutError::Hangs { seeds, fault, .. } = &error else { panic!("{error}") };
        assert_eq!((seeds.len(), fault.phase), (3, phase), "{error}");
        assert!(error.to_string().contains("no answer within 1.0 s"), "{error}");
        assert!(results.iter().all(Result::is_err), "no episode has a result");
        // three workers for each of two seeds, two for the third, and what the other worker had begun meanwhile
        assert!(pool.incidents().len() < 15, "{:?}", pool.incidents());
    }
}

#[test]
fn workers_that_stand_still_together_once_end_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let mut spec = odd(dir.path(), "HangsOnce");
    let limit = Duration::from_secs(1);
    spec.limits = TimeLimits { step: limit, reset: limit, ..TimeLimits::default() };
    let mut pool = Pool::start(PoolOptions::new(spec, 4)).unwrap();
    let (results, end) = stepped(&mut pool, 4);
    assert_eq!((end.unwrap(), results.len()), (RunEnd::Complete, 4));
    assert!(results.iter().all(Result::is_ok) && pool.incidents().len() == 4, "{:?}", pool.incidents());
}

#[test]
fn what_is_no_number_is_the_environment_s_error_and_no_fresh_worker_is_tried() {
    let dir = tempfile::tempdir().unwrap();
    let cases = [
        ("NanReward", "the environment's reward is nan"),
        ("NanSuccess", "the environment's success is nan"),
        ("NanSeen", "the environment's observation obs/place[0] is NaN"),
        ("NanProgress", "cannot be sent"),
        ("NanMeta", "cannot be sent"),
    ];
    for (task, text) in cases {
        let mut pool = Pool::start(PoolOptions::new(odd(dir.path(), task), 1)).unwrap();
        let (results, end) = stepped(&mut pool, 2);
        assert_eq!((end.unwrap(), results.len()), (RunEnd::Complete, 2));
        for result in results {
            let error = result.unwrap_err();
            assert!(matches!(error, RolloutError::Episode { attempts: 1, .. }), "{task}: {error}");
            assert!(error.to_string().contains(text), "{task}: {error}");
        }
    }
}

#[test]
fn actions_without_limits_are_taken_and_limits_that_are_no_numbers_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let mut pool = Pool::start(PoolOptions::new(odd(dir.path(), "Unlimited"), 1)).unwrap();
    assert_eq!(pool.ready().action_low, [f64::NEG_INFINITY]);
    assert_eq!(pool.ready().action_high, [f64::INFINITY]);
    // a greeting that is kept is read as it was
    let text = serde_json::to_string(pool.ready()).unwrap();
    assert_eq!(&serde_json::from_str::<rollout::Ready>(&text).unwrap(), pool.ready());
    assert!(!stepped(&mut pool, 1).0[0].as_ref().unwrap());
    assert!(pool.ready().sources.contains_key("odd_simulator") && pool.ready().sources.contains_key("actrm_harness"));
    let error = Pool::start(PoolOptions::new(odd(dir.path(), "NanLimit"), 1)).err().unwrap().to_string();
    assert!(error.contains("limits of an action"), "{error}");
}

#[test]
fn what_cannot_be_drawn_is_not_asked_of_other_workers() {
    let dir = tempfile::tempdir().unwrap();
    let mut pool = Pool::start(PoolOptions::new(odd(dir.path(), "Unlimited"), 1)).unwrap();
    let work = |(): &mut (), worker: &mut Worker, _| Ok(worker.render("nowhere", 8, 8)?);
    let mut errors = Vec::new();
    pool.run(0..1, &|job| job, &|| Ok(()), &work, &mut |_, result| {
        errors.extend(result.err());
        ControlFlow::Continue(())
    })
    .unwrap();
    assert!(matches!(errors[0], RolloutError::Episode { attempts: 1, .. }), "{}", errors[0]);
    assert!(errors[0].to_string().contains("no camera nowhere"), "{}", errors[0]);
}

/// The expert of `ExpertLoses` is lost in its fourth step, half way; the task's own cap is 30 steps.
#[test]
fn an_expert_s_episode_says_how_it_was_lost_where_it_was_within_the_cap() {
    let dir = tempfile::tempdir().unwrap();
    let mut pool = Pool::start(PoolOptions::new(odd(dir.path(), "ExpertLoses"), 1)).unwrap();
    let mut run = |max_steps: usize| {
        let plan = EpisodePlan::new(pool.ready(), [], max_steps).unwrap();
        let work = |(): &mut (), worker: &mut Worker, seed| plan.run_expert(worker, seed);
        let mut outcomes = Vec::new();
        let end = pool.run(0..1, &|job| job, &|| Ok(()), &work, &mut |_, result| {
            outcomes.push(result.unwrap());
            ControlFlow::Continue(())
        });
        end.map(|_| outcomes.remove(0))
    };
    for (max_steps, steps, failure, progress) in
        [(30, 4, Some("fell"), Some(0.5)), (4, 4, Some("fell"), Some(0.5)), (3, 3, None, None)]
    {
        let outcome = run(max_steps).unwrap();
        assert_eq!((outcome.success, outcome.steps), (false, steps));
        assert_eq!((outcome.failure.as_deref(), outcome.progress), (failure, progress), "{max_steps} steps");
    }
    let error = run(31).unwrap_err().to_string();
    assert!(error.contains("--max-steps of at most 30") && error.contains("found 31"), "{error}");
}
