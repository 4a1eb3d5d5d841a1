//! Whole trainings on a small real file: the same bytes again, through stops, and nothing lost to a NaN.

#![allow(clippy::unwrap_used)]

mod common;

use std::cell::Cell;
use std::fs;
use std::path::Path;

use common::{SMALL, demonstrations};
use dataset::{ConvertOptions, Dataset, RobomimicWriter, Source, WriteOptions};
use models::{FeatureKind, FeatureSpec, Observation, Policy, Values};
use zoo::ZooError;
use zoo::config::Library;
use zoo::entry::{Entry, LoadedEntry};
use zoo::experiment::Experiment;
use zoo::registry::Registry;
use zoo::run::{
    Checkpoint, Score, ScoreRequest, TrainEvent, TrainOutcome, TrainRequest, extend, score, score_folder, train,
};

/// Besides, so that a training that was stopped has something to go on from.
const LONGER: [&str; 3] = ["train.warmup_steps=2", "train.checkpoint_every=3", "train.ema_decay=0.9"];

fn request(root: &Path, data: &Path, extra: &[&str]) -> TrainRequest {
    let overrides: Vec<String> = SMALL.iter().chain(&LONGER).chain(extra).map(|o| (*o).to_owned()).collect();
    TrainRequest {
        name: "act_lift".to_owned(),
        experiment: Experiment::load(&Library::built_in(), "act_lift", &overrides).unwrap(),
        data: Some(data.to_owned()),
        runs: root.join("runs"),
        run: None,
        resume: false,
        zoo: root.join("zoo"),
        from_zoo: None,
        force: false,
        image_memory: None,
        device: models::DeviceChoice::Cpu,
        command: None,
    }
}

fn finish(request: &TrainRequest) -> Entry {
    match train(request, &|| false, &mut |_| {}).unwrap() {
        TrainOutcome::Finished { entry, .. } => Entry::open(&request.zoo, &entry).unwrap(),
        TrainOutcome::Stopped { step, .. } => panic!("stopped after step {step}"),
    }
}

fn model(entry: &Entry) -> Vec<u8> {
    fs::read(entry.folder().join("model.safetensors")).unwrap()
}

#[test]
fn the_same_seed_gives_the_same_bytes_and_another_seed_others() {
    let root = tempfile::tempdir().unwrap();
    let data = demonstrations(root.path());
    let (one, two) = (finish(&request(root.path(), &data, &[])), finish(&request(root.path(), &data, &[])));
    assert_eq!((one.id().version, two.id().version), (1, 2));
    assert!(model(&one) == model(&two), "two trainings with the same seed differ");
    assert_eq!(one.meta().content_sha256(), two.meta().content_sha256());
    let other = finish(&request(root.path(), &data, &["train.seed=2"]));
    assert!(model(&one) != model(&other));

    let meta = one.meta();
    assert_eq!(meta.task, "Lift");
    assert_eq!(meta.env_version.as_deref(), Some("1.5.2"));
    let data = meta.data.as_ref().unwrap();
    assert_eq!((data.name.as_str(), data.train_episodes, data.valid_episodes), ("demos.hdf5", 2, 1));
    assert_eq!(data.train_frames, 112);
    let curve = &meta.training.as_ref().unwrap().curve;
    assert_eq!(curve.last().unwrap().step, 12);
    assert!(curve.last().unwrap().valid_loss.unwrap().is_finite());

    // a policy of it answers in the units of the environment
    let mut policy = one.load().unwrap().policy();
    let observation = Observation::of_state(vec![0.1; 9], vec![0.1; 10]);
    let chunk = policy.predict(&observation).unwrap();
    assert_eq!((chunk.action_horizon, chunk.action_dim), (16, 7));
    assert!(chunk.actions.iter().all(|a| a.is_finite()));
    assert!(policy.predict(&Observation::of_state(vec![0.1; 8], vec![0.1; 10])).is_err());
}

#[test]
fn weights_in_half_are_half_the_size_and_act_as_they_are_stored() {
    let root = tempfile::tempdir().unwrap();
    let data = demonstrations(root.path());
    let full = finish(&request(root.path(), &data, &[]));
    let half = finish(&request(root.path(), &data, &["train.weights=f16"]));
    let (a, b) = (model(&full).len() as f64, model(&half).len() as f64);
    assert!(b < 0.6 * a && b > 0.45 * a, "{a} {b}");
    let weights = |entry: &Entry| entry.load().unwrap().model().params().tensors();
    let (full_weights, half_weights) = (weights(&full), weights(&half));
    assert_eq!(full_weights.keys().collect::<Vec<_>>(), half_weights.keys().collect::<Vec<_>>());
    let mut rounded = 0;
    for (name, exact) in &full_weights {
        let flat = |tensor: &candle_core::Tensor| tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        for (exact, stored) in flat(exact).into_iter().zip(flat(&half_weights[name])) {
            assert!((exact - stored).abs() <= exact.abs() / 2048.0 + 3e-8, "{name}: {exact} {stored}");
            rounded += usize::from(exact != stored);
        }
    }
    assert!(rounded > 100, "{rounded}");
}

/// Both kinds of policy, with two things cut out of `object` in place of the environment's state.
#[test]
fn entities_are_trained_on_sealed_and_asked_for_again() {
    const ENTITIES: [&str; 4] = [
        "data.env_keys=[]",
        "data.entities.thing0=['object[0:3]', 'object[0:3] - robot0_eef_pos']",
        "data.entities.thing1=['robot0_eef_pos', 'object[7:10]']",
        "data.symmetries.axes=['object[0:3]', 'object[7:10]']",
    ];
    let root = tempfile::tempdir().unwrap();
    let data = demonstrations(root.path());
    let actrm = ["policy.type=actrm", "policy.reasoning.tokens=2", "entry=thinking"];
    for extra in [&[][..], &actrm] {
        let extra: Vec<&str> = ENTITIES.iter().chain(extra).copied().collect();
        let mut request = request(root.path(), &data, &[]);
        let overrides = SMALL.iter().filter(|o| extra.len() == ENTITIES.len() || !o.contains("n_encoder_layers"));
        let overrides: Vec<String> = overrides.chain(&extra).map(|o| (*o).to_owned()).collect();
        let name = if extra.len() == ENTITIES.len() { "act_lift" } else { "actrm_lift" };
        request.experiment = Experiment::load(&Library::built_in(), name, &overrides).unwrap();
        let mut notes = Vec::new();
        let outcome = train(&request, &|| false, &mut |event| {
            if let TrainEvent::Note(note) = event {
                notes.push(note.to_owned());
            }
        });
        let TrainOutcome::Finished { entry, .. } = outcome.unwrap() else { panic!("not finished") };
        assert!(notes.iter().all(|note| !note.contains("autograd")), "{notes:?}");
        let entry = Entry::open(&request.zoo, &entry).unwrap();
        let meta = entry.meta();
        let names: Vec<&str> = meta.signature.observation.iter().map(|spec| spec.name.as_str()).collect();
        assert_eq!(names, ["observation.state", "observation.entity.thing0", "observation.entity.thing1"]);
        assert!(meta.signature.observation[1..].iter().all(|spec| spec.group() == "thing" && spec.width() == 6));
        assert_eq!(meta.keys.of(names[2]), ["robot0_eef_pos", "object[7:10]"]);
        assert!(entry.card().unwrap().contains("object[0:3], object[0:3] - robot0_eef_pos"));

        // one group, one set of statistics
        let (statistics, _) = zoo::tensors::read(&entry.folder().join("normaliser.safetensors")).unwrap();
        let of = |name: &str, statistic: &str| statistics[&format!("{name}.{statistic}")].to_vec1::<f32>().unwrap();
        assert_eq!(of(names[1], "mean"), of(names[2], "mean"));
        assert_eq!(of(names[1], "std"), of(names[2], "std"));

        let mut policy = entry.load().unwrap().policy();
        let mut observation = Observation::of_state(vec![0.1; 9], Vec::new());
        let error = policy.predict(&observation).unwrap_err().to_string();
        assert!(error.contains("observation.entity.thing0 is missing"), "{error}");
        observation.insert(names[1], vec![0.1; 6].into());
        observation.insert(names[2], (0..6).map(|i| i as f32).collect::<Vec<_>>().into());
        let chunk = policy.predict(&observation).unwrap();
        // the things of a group are a set
        let mut swapped = observation.clone();
        swapped.insert(names[1], observation.get(names[2]).unwrap().clone());
        swapped.insert(names[2], observation.get(names[1]).unwrap().clone());
        let other = policy.predict(&swapped).unwrap();
        for (a, b) in chunk.actions.iter().zip(&other.actions) {
            assert!((a - b).abs() < 1e-4, "{a} {b}");
        }
    }
    // the symmetry is at work: without it other weights come out
    let weights = |extra: &[&str]| model(&finish(&request(root.path(), &data, extra)));
    assert!(weights(&ENTITIES) != weights(&ENTITIES[..3]));
    assert!(weights(&ENTITIES) == weights(&ENTITIES));
    // a data set without them is refused by name
    let converted = root.path().join("set");
    dataset::convert(&data, &converted, &dataset::ConvertOptions::default(), &mut |_, _| {}).unwrap();
    let refused = train(&request(root.path(), &converted, &ENTITIES[1..3]), &|| false, &mut |_| {}).unwrap_err();
    let expected = "data.entities.thing0: expected object[0:3], object[0:3] - robot0_eef_pos, found none";
    assert!(refused.to_string().contains(expected), "{refused}");
}

#[test]
fn what_training_alone_is_told_is_asked_for_there_alone() {
    let root = tempfile::tempdir().unwrap();
    let data = demonstrations(root.path());
    let told =
        ["data.env_keys=[]", "data.auxiliary_keys=['object[0:3] - robot0_eef_pos']", "policy.auxiliary.weight=0.5"];
    let entry = finish(&request(root.path(), &data, &told));
    // what is asked reaches the weights
    let deaf = [told[0], told[1], "policy.auxiliary.weight=0"];
    assert!(model(&entry) != model(&finish(&request(root.path(), &data, &deaf))));
    assert_eq!((entry.meta().signature.observation.len(), entry.meta().signature.auxiliary_dim), (1, 3));
    // the robot's state is all that it reads
    let mut policy = entry.load().unwrap().policy();
    let chunk = policy.predict(&Observation::of_state(vec![0.1; 9], Vec::new())).unwrap();
    assert!(chunk.actions.iter().all(|a| a.is_finite()));
    // a data set without these numbers is refused by the setting's name
    let converted = root.path().join("set");
    dataset::convert(&data, &converted, &dataset::ConvertOptions::default(), &mut |_, _| {}).unwrap();
    let refused = train(&request(root.path(), &converted, &told[1..]), &|| false, &mut |_| {}).unwrap_err();
    let expected = "data.auxiliary_keys: expected object[0:3] - robot0_eef_pos, found none";
    assert!(refused.to_string().contains(expected), "{refused}");
}

#[test]
fn half_of_the_samples_can_be_what_a_mirror_shows() {
    let root = tempfile::tempdir().unwrap();
    let data = demonstrations(root.path());
    let told =
        ["data.env_keys=[]", "data.auxiliary_keys=['object[0:3] - robot0_eef_pos']", "policy.auxiliary.weight=0.5"];
    let mirror = |action: &str| {
        format!(
            "data.mirror={{ robot0_eef_pos=[1, -1, 1], robot0_eef_quat=[1, 1, 1, 1], robot0_gripper_qpos=[1, 1], \
             'object[0:3] - robot0_eef_pos'=[1, -1, 1], action={action} }}"
        )
    };
    let with = |mirror: &str| request(root.path(), &data, &[told[0], told[1], told[2], mirror]);
    let entry = finish(&with(&mirror("[1, -1, 1, -1, 1, -1, 1]")));
    assert!(model(&entry) == model(&finish(&with(&mirror("[1, -1, 1, -1, 1, -1, 1]")))));
    assert!(model(&entry) != model(&finish(&request(root.path(), &data, &told))));
    // the actions' signs are their own
    assert!(model(&entry) != model(&finish(&with(&mirror("[1, 1, 1, 1, 1, 1, 1]")))));
    let refused = train(&with(&mirror("[1, -1]")), &|| false, &mut |_| {}).unwrap_err().to_string();
    assert!(refused.contains("data.mirror.action: 2 signs, 7 numbers"), "{refused}");
}

#[test]
fn a_history_is_trained_on_and_kept_at_inference() {
    let root = tempfile::tempdir().unwrap();
    let data = demonstrations(root.path());
    let entry = finish(&request(root.path(), &data, &["data.n_obs_steps=3"]));
    assert_eq!(entry.meta().signature.n_obs_steps, 3);
    let observation = |x: f32| Observation::of_state(vec![x; 9], vec![-x; 10]);
    let after = |past: &[f32]| {
        let mut policy = entry.load().unwrap().policy();
        assert_eq!(policy.n_obs_steps(), 3);
        past.iter().for_each(|&x| policy.observe(&observation(x)));
        policy.predict(&observation(0.1)).unwrap().actions
    };
    // the first observation is repeated before the episode, and what is older than three steps is forgotten
    assert_eq!(after(&[]), after(&[0.1, 0.1]));
    assert_ne!(after(&[]), after(&[0.2]));
    assert_eq!(after(&[0.2]), after(&[0.2, 0.2]));
    assert_eq!(after(&[0.9, 0.3, 0.2]), after(&[0.3, 0.2]));
    assert_ne!(after(&[0.3, 0.2]), after(&[0.2, 0.3]));
}

/// Six of them were sealed in the first form of `entry.json`.
#[test]
fn shipped_entries_open_and_answer() {
    let registry = Registry::open(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../../zoo"));
    let ids = registry.ids().unwrap();
    assert!(ids.len() >= 6, "{ids:?}");
    for id in ids {
        let loaded = registry.entry(&id.to_string()).unwrap().load().unwrap();
        let signature = &loaded.entry().meta().signature;
        assert_eq!(signature.action_dim, 7, "{id}");
        let values = |spec: &FeatureSpec| match spec.kind {
            FeatureKind::Image => Values::U8(vec![100; spec.width()]),
            _ => Values::F32(vec![0.1; spec.width()]),
        };
        let observation: Observation =
            signature.observation.iter().map(|spec| (spec.name.clone(), values(spec))).collect();
        assert!(observation.len() >= 2, "{id}");
        assert!(signature.observation.iter().all(|spec| !loaded.entry().meta().keys.of(&spec.name).is_empty()));
        let chunk = loaded.policy().predict(&observation).unwrap();
        assert!(chunk.actions.iter().all(|a| a.is_finite()), "{id}");
    }
}

#[test]
fn a_run_stopped_anywhere_goes_on_to_the_same_bytes() {
    let root = tempfile::tempdir().unwrap();
    let data = demonstrations(root.path());
    let whole = finish(&request(root.path(), &data, &[]));
    let mut request = request(root.path(), &data, &[]);
    request.runs = root.path().join("interrupted");
    // stopped before the first step, then after every second one
    let mut outcome = None;
    for round in 0..8 {
        let polls = Cell::new(0);
        let patience = if round == 0 { 0 } else { 2 };
        let stop = || {
            polls.set(polls.get() + 1);
            polls.get() > patience
        };
        outcome = Some(train(&request, &stop, &mut |_| {}).unwrap());
        request.resume = true;
        if matches!(outcome, Some(TrainOutcome::Finished { .. })) {
            break;
        }
    }
    let Some(TrainOutcome::Finished { entry, run, .. }) = outcome else { panic!("{outcome:?}") };
    let pieced = Entry::open(&request.zoo, &entry).unwrap();
    assert!(model(&whole) == model(&pieced), "a resumed run differs from one that ran through");
    // the metrics are those of one run, step by step
    let csv = fs::read_to_string(run.join("metrics.csv")).unwrap();
    let steps: Vec<&str> = csv.lines().skip(1).map(|line| line.split(',').next().unwrap()).collect();
    assert_eq!(steps, ["2", "4", "6", "8", "10", "12"]);
    assert!(run.join("metrics.parquet").is_file());
    // and it is finished
    let error = train(&request, &|| false, &mut |_| {}).unwrap_err().to_string();
    assert!(error.ends_with("the run is finished"), "{error}");
}

#[test]
fn a_loss_that_is_not_finite_stops_the_run_and_keeps_the_last_good_checkpoint() {
    let root = tempfile::tempdir().unwrap();
    let data = demonstrations(root.path());
    let extra = [
        "train.lr=1e37",
        "train.warmup_steps=1000000",
        "train.steps=1000",
        "train.checkpoint_every=1",
        "train.grad_clip_norm=0",
    ];
    let request = request(root.path(), &data, &extra);
    let mut saved = Vec::new();
    let error = train(&request, &|| false, &mut |event| {
        if let TrainEvent::Saved(path) = event {
            saved.push(path.to_owned());
        }
    })
    .unwrap_err();
    let ZooError::NotFinite { step, tensor, checkpoint, .. } = &error else { panic!("{error}") };
    assert!(!tensor.is_empty() && error.to_string().starts_with(&format!("step {step}: ")));
    assert_eq!(checkpoint.as_ref(), saved.last());
    if let Some(path) = checkpoint {
        assert!(error.to_string().ends_with(&path.display().to_string()), "{error}");
        let kept = Checkpoint::latest(path.parent().unwrap()).unwrap().unwrap();
        for (name, tensor) in &kept.tensors {
            let values = tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap();
            assert!(values.iter().all(|x| x.is_finite()), "{name}");
        }
    }
    assert!(Registry::open(&request.zoo).ids().unwrap().is_empty(), "no entry may come of it");
}

#[test]
fn a_run_goes_on_only_with_what_it_began_with() {
    let root = tempfile::tempdir().unwrap();
    let data = demonstrations(root.path());
    let mut first = request(root.path(), &data, &[]);
    first.run = Some(root.path().join("run"));
    let polls = Cell::new(0);
    let stop = || {
        polls.set(polls.get() + 1);
        polls.get() > 2
    };
    assert!(matches!(train(&first, &stop, &mut |_| {}).unwrap(), TrainOutcome::Stopped { step: 2, .. }));

    let again = train(&first, &|| false, &mut |_| {}).unwrap_err().to_string();
    assert!(again.contains("already holds a run"), "{again}");
    let mut other = request(root.path(), &data, &["train.lr=0.5"]);
    (other.run, other.resume) = (first.run.clone(), true);
    let error = train(&other, &|| false, &mut |_| {}).unwrap_err().to_string();
    assert!(error.ends_with("train.lr differs: the run has 0.001, asked for 0.5"), "{error}");

    // the same demonstrations, split otherwise, are the same data; one demo less is not
    let less = root.path().join("less.hdf5");
    let source = Source::open(&data).unwrap();
    let mut writer = RobomimicWriter::create(&less, &WriteOptions::default()).unwrap();
    let mut root_group = source.root().unwrap();
    root_group.datasets.retain(|name, _| !name.starts_with("mask"));
    writer.set_root(&root_group).unwrap();
    writer.add_demo(&source.read_demo(0).unwrap()).unwrap();
    writer.finish().unwrap();
    let mut other = first.clone();
    (other.data, other.resume) = (Some(less), true);
    let error = train(&other, &|| false, &mut |_| {}).unwrap_err().to_string();
    assert!(error.contains("data set differs"), "{error}");
}

#[test]
fn a_run_killed_after_its_entry_appeared_finds_it_again() {
    let root = tempfile::tempdir().unwrap();
    let data = demonstrations(root.path());
    let mut request = request(root.path(), &data, &[]);
    let entry = finish(&request);
    let run = root.path().join("runs/act_lift/001");
    // what is left when the process dies between the two
    fs::remove_file(run.join("finished.json")).unwrap();
    request.resume = true;
    let again = finish(&request);
    assert_eq!(again.id(), entry.id());
    assert_eq!(Registry::open(&request.zoo).ids().unwrap(), [entry.id()]);
    assert!(run.join("finished.json").is_file());

    // the version is another run's: this one still gets its own
    fs::remove_file(run.join("finished.json")).unwrap();
    fs::remove_dir_all(entry.folder()).unwrap();
    let mut other = request.clone();
    (other.resume, other.run) = (false, Some(root.path().join("other")));
    assert_eq!(finish(&other).id(), entry.id());
    let own = finish(&request);
    assert_eq!(own.id().version, 2);
    assert!(model(&own) == model(&entry));
}

#[test]
fn what_cannot_end_well_is_refused_before_a_run_is_begun() {
    let root = tempfile::tempdir().unwrap();
    let data = demonstrations(root.path());
    let refused = |request: &TrainRequest| {
        let error = train(request, &|| false, &mut |_| {}).unwrap_err().to_string();
        assert!(!request.runs.exists(), "{error}");
        error
    };
    let huge = refused(&request(root.path(), &data, &["train.batch_size=100000000"]));
    assert!(huge.starts_with("experiment `lift-act` needs at least "), "{huge}");
    let up = refused(&TrainRequest { name: "../c/up".to_owned(), ..request(root.path(), &data, &[]) });
    assert!(up.starts_with("experiment name `../c/up`"), "{up}");
    // nobody may make a file there, not even root
    let read_only = refused(&TrainRequest { zoo: "/proc/zoo".into(), ..request(root.path(), &data, &[]) });
    assert_eq!(read_only, "cannot write into /proc");
}

#[test]
fn a_mask_that_is_not_there_is_an_error_that_lists_those_that_are() {
    let root = tempfile::tempdir().unwrap();
    let data = demonstrations(root.path());
    let refused = |change: &str| {
        let request = request(root.path(), &data, &[change]);
        train(&request, &|| false, &mut |_| {}).unwrap_err().to_string()
    };
    let typo = refused("data.valid_mask=vaild");
    assert!(typo.contains("data.valid_mask: no mask `vaild`; there is train, valid"), "{typo}");
    let typo = refused("data.train_mask=trian");
    assert!(typo.contains("data.train_mask: no mask `trian`; there is train, valid"), "{typo}");
    // none asked for: none held out
    let entry = finish(&request(root.path(), &data, &["data.valid_mask=\"\""]));
    assert_eq!(entry.meta().data.as_ref().unwrap().valid_episodes, 0);
}

/// What a training is refused for, which leaves nothing behind.
fn refused(request: &TrainRequest) -> String {
    let error = train(request, &|| false, &mut |_| {}).unwrap_err().to_string();
    assert!(!request.zoo.exists() && !request.runs.exists(), "{error}");
    error
}

/// What a training noted, and the entry that it made.
fn noted(request: &TrainRequest) -> (String, Entry) {
    let mut notes = Vec::new();
    let outcome = train(request, &|| false, &mut |event| {
        if let TrainEvent::Note(note) = event {
            notes.push(note.to_owned());
        }
    });
    let TrainOutcome::Finished { entry, .. } = outcome.unwrap() else { panic!("not finished") };
    (notes.join("\n"), Entry::open(&request.zoo, &entry).unwrap())
}

const STATE: [&str; 3] = ["robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos"];

/// The demonstrations as a LeRobotDataset whose state is made of these keys, as LeRobot writes one: without our side folder,
/// and with names of the state and of the actions as JSON.
fn lerobots(data: &Path, out: &Path, keys: &[&str], names: [&str; 2]) {
    let keys = keys.iter().map(|key| (*key).to_owned()).collect();
    let options = ConvertOptions { state_keys: Some(keys), ..ConvertOptions::default() };
    dataset::convert(data, out, &options, &mut |_, _| {}).unwrap();
    let path = out.join("meta/info.json");
    let mut info: serde_json::Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    fs::remove_dir_all(out.join("actrm")).unwrap();
    for (feature, names) in ["observation.state", "action"].into_iter().zip(names) {
        info["features"][feature]["names"] = serde_json::from_str(names).unwrap();
    }
    fs::write(&path, info.to_string()).unwrap();
}

const NO_MASKS: [&str; 1] = ["data.valid_mask=''"];

#[test]
fn numbers_in_another_order_are_put_into_the_one_that_is_read() {
    let root = tempfile::tempdir().unwrap();
    let data = demonstrations(root.path());
    let turned: Vec<&str> = STATE.into_iter().rev().collect();
    let usual = root.path().join("usual");
    lerobots(&data, &usual, &STATE, ["null", "null"]);
    let (notes, usual) = noted(&request(root.path(), &usual, &NO_MASKS));
    let unnamed = "observation.state: the data set does not say what its 9 numbers are (has no names); taken as robot0_eef_pos, \
                   robot0_eef_quat, robot0_gripper_qpos, in this order";
    assert!(notes.contains(unnamed) && notes.contains("action: the data set does not say"), "{notes}");
    assert!(usual.card().unwrap().contains("robot0_gripper_qpos; which the data set does not name"));

    let named = r#"["gripper_0", "gripper_1", "qx", "qy", "qz", "qw", "x", "y", "z"]"#;
    let action = r#"{"motors": ["x", "y", "z", "roll", "pitch", "yaw", "gripper"]}"#;
    let theirs = root.path().join("theirs");
    lerobots(&data, &theirs, &turned, [named, action]);
    let (notes, entry) = noted(&request(root.path(), &theirs, &NO_MASKS));
    assert!(notes.contains("observation.state: put into the order robot0_eef_pos"), "{notes}");
    assert!(model(&entry) == model(&usual), "other weights than of the same numbers in the usual order");
    let card = entry.card().unwrap();
    assert!(card.contains("robot0_gripper_qpos; in the data set: gripper_0, gripper_1, qx, qy"), "{card}");
    assert!(card.contains("| action | 7 numbers, in the data set: x, y, z, roll"), "{card}");
    // the demonstrations are found again by what is in their files
    let stored = dataset::Dataset::open(&theirs).unwrap();
    let recorded = entry.meta().data.as_ref().unwrap();
    assert_eq!(recorded.train_fingerprint.as_deref(), Some(&*stored.fingerprint_of(&[0, 1, 2])));

    // so with a set of ours
    let ours = root.path().join("ours");
    let keys = turned.iter().map(|key| (*key).to_owned()).collect();
    let options = ConvertOptions { state_keys: Some(keys), ..ConvertOptions::default() };
    dataset::convert(&data, &ours, &options, &mut |_, _| {}).unwrap();
    let (notes, entry) = noted(&request(root.path(), &ours, &[]));
    assert!(notes.contains("put into the order"), "{notes}");
    let (notes, straight) = noted(&request(root.path(), &data, &[]));
    assert!(!notes.contains("order"), "{notes}");
    assert!(model(&entry) == model(&straight));
    assert!(straight.meta().data.as_ref().unwrap().names.is_empty());
}

#[test]
fn numbers_of_other_names_are_refused_or_forced() {
    let root = tempfile::tempdir().unwrap();
    let data = demonstrations(root.path());
    let joints = r#"["waist", "shoulder", "elbow", "wrist", "roll", "gripper", "a", "b", "c"]"#;
    let set = root.path().join("set");
    lerobots(&data, &set, &STATE, [joints, "null"]);
    let mut request = request(root.path(), &set, &NO_MASKS);
    let error = refused(&request);
    let expected =
        "observation.state: expected robot0_eef_pos, robot0_eef_quat, robot0_gripper_qpos, found waist, shoulder";
    assert!(error.contains(expected) && error.contains("--force"), "{error}");
    request.force = true;
    let (notes, entry) = noted(&request);
    assert!(notes.contains(expected) && notes.contains("(--force)"), "{notes}");
    assert!(entry.card().unwrap().contains("in the data set: waist, shoulder"));

    let set = root.path().join("actions");
    lerobots(&data, &set, &STATE, ["null", r#"["j1", "j2", "elbow", "j4", "j5", "j6", "gripper"]"#]);
    let elsewhere = root.path().join("elsewhere");
    let error = refused(&self::request(&elsewhere, &set, &NO_MASKS));
    assert!(error.contains("action: expected position, rotation and gripper, found j1, j2, elbow"), "{error}");
}

#[test]
fn demonstrations_of_another_task_are_refused_or_forced() {
    let root = tempfile::tempdir().unwrap();
    let data = demonstrations(root.path());
    // by their environment, and by the instruction where LeRobot's set names none
    let set = root.path().join("set");
    lerobots(&data, &set, &STATE, ["null", "null"]);
    for (path, task) in [(&data, "Stack"), (&data, "anything"), (&set, "Stack"), (&set, "anything")] {
        let error = refused(&request(root.path(), path, &[&format!("task.name={task}"), NO_MASKS[0]]));
        let expected =
            format!("demonstrations of Lift, but the experiment's task is {task}; train with task.name=Lift");
        assert!(error.contains(&expected) && error.contains("--force"), "{error}");
    }
    let mut request = request(root.path(), &data, &["task.name=Stack"]);
    request.force = true;
    let (notes, entry) = noted(&request);
    assert!(notes.contains("demonstrations of Lift, but the experiment's task is Stack"), "{notes}");
    let card = entry.card().unwrap();
    assert!(card.contains("| task | Stack |") && card.contains("| recorded in | Lift, "), "{card}");
    assert!(card.contains("A policy of type act for Stack, with the settings of act_lift."), "{card}");
}

/// Three demonstrations of a task that no simulator has, without an environment.
fn of_no_simulator(data: &Path, out: &Path, names: &str) {
    let source = Source::open(data).unwrap();
    let other = data.with_file_name("other.hdf5");
    let mut writer = RobomimicWriter::create(&other, &WriteOptions::default()).unwrap();
    let mut group = source.root().unwrap();
    group.datasets.retain(|name, _| !name.starts_with("mask"));
    let args = dataset::Array::from_str(r#"{"env_name": "pour the tea", "type": 1, "env_kwargs": {}}"#);
    group.inner_attrs.get_mut("data").unwrap().insert("env_args".to_owned(), args);
    writer.set_root(&group).unwrap();
    for index in 0..source.plan().demos.len() {
        writer.add_demo(&source.read_demo(index).unwrap()).unwrap();
    }
    writer.finish().unwrap();
    lerobots(&other, out, &STATE, [names, names]);
}

#[test]
fn a_task_without_a_simulator_has_the_keys_of_its_data_and_a_true_card() {
    let root = tempfile::tempdir().unwrap();
    let data = demonstrations(root.path());
    let set = root.path().join("tea");
    of_no_simulator(&data, &set, r#"{"motors": ["waist", "shoulder", "elbow", "b1", "b2", "b3", "b4", "b5", "b6"]}"#);
    let free = [NO_MASKS[0], "task.name=tea", "entry=tea-act"];
    let (_, entry) = noted(&request(root.path(), &set, &free));
    let card = entry.card().unwrap();
    assert!(card.contains("| observation.state | 9 numbers, in the data set: waist, shoulder, elbow, b1"), "{card}");
    assert!(card.contains("no simulator has the task above") && card.contains("\"tea-act@1\""), "{card}");
    for false_word in ["robot0", "robosuite", "Lift", "actrm-zoo eval"] {
        assert!(!card.contains(false_word), "{false_word} in {card}");
    }
    // what it was trained with trains the same again
    let config = fs::read_to_string(entry.folder().join("config.toml")).unwrap();
    let again = TrainRequest {
        experiment: Experiment::from_toml("tea", &config).unwrap(),
        ..request(root.path(), &set, &free)
    };
    let (_, second) = noted(&again);
    assert_eq!(second.meta().content_sha256(), entry.meta().content_sha256());
    let chunk = entry.load().unwrap().policy().predict(&Observation::of_state(vec![0.1; 9], vec![0.1; 10])).unwrap();
    assert_eq!(chunk.action_dim, 7);
}

#[test]
fn a_finished_run_goes_on_to_the_bytes_of_a_longer_one() {
    let root = tempfile::tempdir().unwrap();
    let data = demonstrations(root.path());
    let whole = finish(&request(root.path(), &data, &["train.schedule=constant"]));
    let short = request(root.path(), &data, &["train.schedule=constant", "train.steps=5"]);
    let runs = root.path().join("runs");
    let run = runs.join("act_lift/002");
    let first = finish(&short);
    for (steps, words) in [(5, "`train.steps`: expected more than the 5 of the finished run"), (0, "found 0")] {
        let error = extend(&run, &runs, steps).err().unwrap().to_string();
        assert!(error.contains(words), "{error}");
    }
    let extended = extend(&run, &runs, 12).unwrap();
    assert!(extended.folder.ends_with("act_lift/003"));
    let request = TrainRequest {
        name: extended.name,
        experiment: extended.experiment,
        data: None,
        run: Some(extended.folder),
        resume: true,
        ..request(root.path(), &data, &[])
    };
    let longer = finish(&request);
    assert!(model(&longer) == model(&whole) && model(&longer) != model(&first));
    assert_eq!(longer.config_text().unwrap(), whole.config_text().unwrap());
    assert_eq!(longer.meta().training.as_ref().unwrap().steps, 12);
    // rates that depend on the number of steps
    finish(&TrainRequest { resume: false, ..request_of_cosine(root.path(), &data) });
    let error = extend(&runs.join("act_lift/004"), &runs, 50).err().unwrap().to_string();
    assert!(error.contains("its cosine schedule") && error.contains("--from lift-act@4"), "{error}");
    let error = extend(&runs, &runs, 50).err().unwrap().to_string();
    assert!(error.contains("not finished"), "{error}");
}

fn request_of_cosine(root: &Path, data: &Path) -> TrainRequest {
    request(root, data, &["train.steps=2"])
}

/// What an entry's actions are wrong by, on episodes that it was not trained on.
#[test]
fn an_entry_is_scored_on_held_out_episodes() {
    let root = tempfile::tempdir().unwrap();
    let data = demonstrations(root.path());
    let entry = finish(&request(root.path(), &data, &[])).load().unwrap();
    let work = root.path().join("work");
    let scored = |entry: &LoadedEntry, data: &Path, mask: Option<&str>, most: usize| {
        let work = score_folder(&work, data)?;
        score(&ScoreRequest { entry, data, work: &work, mask, most, force: false })
    };
    let held_out = scored(&entry, &data, None, 1000).unwrap();
    assert_eq!((held_out.mask.as_deref(), held_out.episodes), (Some("valid"), 1));
    assert_eq!((held_out.names.len(), held_out.errors.len(), held_out.errors[0].len()), (7, 16, 7));
    // at the last steps of an episode a chunk is longer than it
    assert_eq!(held_out.counts[0], held_out.queries);
    assert_eq!(held_out.counts[15], held_out.queries - 15);
    assert!(held_out.mean > 0.0 && held_out.mean < 2.0, "{held_out:?}");
    let was_trained_on = |score: &Score| score.notes.iter().any(|note| note.contains("was trained on these episodes"));
    assert!(!was_trained_on(&held_out), "{:?}", held_out.notes);
    let of_dimensions = held_out.of_dimensions();
    assert!((of_dimensions.iter().sum::<f64>() / 7.0 - held_out.mean).abs() < 1e-9);
    assert_eq!(held_out.of_steps().len(), 16);
    // by hand, at one step
    let one = scored(&entry, &data, Some("train"), 1).unwrap();
    assert!(one.queries == 1 && was_trained_on(&one), "{:?}", one.notes);
    let folder = score_folder(&work, &data).unwrap().join("data");
    let set = Dataset::open(&folder).unwrap();
    let first = set.split("train").unwrap()[0];
    let from = set.episodes()[..first].iter().map(|episode| episode.length).sum::<usize>();
    let row = |name: &str| {
        let column = set.column(name).unwrap();
        column.data[from * column.dim..][..column.dim].to_vec()
    };
    let mut policy = entry.policy();
    policy.reset(0);
    let seen = Observation::of_state(row("observation.state"), row("observation.environment_state"));
    let predicted = policy.predict(&seen).unwrap();
    for (dim, shown) in row("action").iter().enumerate() {
        let expected = f64::from((predicted.actions[dim] - shown).abs());
        assert!((one.errors[0][dim] - expected).abs() < 1e-6, "{dim}: {} {expected}", one.errors[0][dim]);
    }
    let error = scored(&entry, &data, Some("tset"), 1).unwrap_err().to_string();
    assert!(error.contains("tset"), "{error}");
}

/// Demonstrations that were recorded at another rate, or by another controller.
#[test]
fn other_conventions_of_the_data_are_refused_by_name() {
    let root = tempfile::tempdir().unwrap();
    let data = demonstrations(root.path());
    let entry = finish(&request(root.path(), &data, &[]));
    let other = root.path().join("other.hdf5");
    let flip = |place: &str, key: &str, value: serde_json::Value| {
        let source = Source::open(&data).unwrap();
        let mut writer = RobomimicWriter::create(&other, &WriteOptions::default()).unwrap();
        let mut root = source.root().unwrap();
        let mut args = source.plan().env_args.clone().unwrap();
        args.pointer_mut(place).unwrap()[key] = value;
        let attrs = root.inner_attrs.get_mut("data").unwrap();
        attrs.insert("env_args".to_owned(), dataset::Array::from_str(&args.to_string()));
        writer.set_root(&root).unwrap();
        for index in 0..source.plan().demos.len() {
            writer.add_demo(&source.read_demo(index).unwrap()).unwrap();
        }
        writer.finish().unwrap();
    };
    let loaded = entry.load().unwrap();
    let arm = "/env_kwargs/controller_configs/body_parts/right";
    for (place, key, value, name) in [
        ("/env_kwargs", "control_freq", 10.into(), "control_freq"),
        (arm, "input_max", 2.into(), "action_range"),
        (arm, "input_type", "absolute".into(), "action_space"),
        (arm, "input_ref_frame", "world".into(), "action_frame"),
    ] {
        let _ = fs::remove_file(&other);
        flip(place, key, value);
        let request = TrainRequest {
            data: Some(other.clone()),
            ..request(root.path(), &data, &[&format!("train.from={}", entry.id())])
        };
        let error = train(&request, &|| false, &mut |_| {}).unwrap_err().to_string();
        assert!(error.contains(&format!("entry lift-act@1 in task Lift: convention {name}: expected")), "{error}");
        let work = score_folder(&root.path().join("work"), &other).unwrap();
        let request = ScoreRequest { entry: &loaded, data: &other, work: &work, mask: Some(""), most: 1, force: false };
        let error = score(&request).unwrap_err().to_string();
        assert!(error.contains(&format!("convention {name}: expected")), "{error}");
    }
}

#[test]
fn a_training_begins_with_an_entry_s_weights() {
    let root = tempfile::tempdir().unwrap();
    let data = demonstrations(root.path());
    let first = finish(&request(root.path(), &data, &[]));
    let from = format!("train.from={}", first.id());
    // a step so small that the weights stay
    let still =
        |extra: &[&str]| request(root.path(), &data, &[&[&*from, "train.lr=1e-30", "train.steps=1"], extra].concat());
    let (notes, second) = noted(&still(&["train.ema_decay=0"]));
    assert!(notes.contains("tensors begin as in lift-act@1"), "{notes}");
    assert_eq!(model(&second), model(&first));
    let parent = second.meta().parent.as_ref().unwrap();
    assert_eq!((&*parent.entry, &parent.content_sha256), ("lift-act@1", &first.meta().content_sha256()));
    // what has another shape begins anew, and is named
    let (notes, _) = noted(&still(&["policy.action_horizon=3", "rollout.n_action_steps=2"]));
    assert!(notes.contains("; new: ") && notes.contains("; not used: "), "{notes}");
    // from a seed it would be another training; from the entry it is the same twice
    let again = request(root.path(), &data, &[&from]);
    assert_eq!(model(&finish(&again)), model(&finish(&again)));
    for (from, words) in [("nobody", "expected name@version of an entry"), ("lift-act@7", "lift-act/7/entry.json")] {
        let request = request(root.path(), &data, &[&format!("train.from={from}")]);
        let error = train(&request, &|| false, &mut |_| {}).unwrap_err().to_string();
        assert!(error.contains(words), "{error}");
    }
}

#[test]
fn what_a_conversion_notes_a_training_notes() {
    let root = tempfile::tempdir().unwrap();
    let data = demonstrations(root.path());
    let source = Source::open(&data).unwrap();
    let path = root.path().join("masked.hdf5");
    let mut writer = RobomimicWriter::create(&path, &WriteOptions::default()).unwrap();
    let mut group = source.root().unwrap();
    group.datasets.retain(|name, _| !name.starts_with("mask"));
    writer.set_root(&group).unwrap();
    for index in 0..3 {
        writer.add_demo(&source.read_demo(index).unwrap()).unwrap();
    }
    writer.set_mask("train", &["demo_0".to_owned(), "demo_1".to_owned()]).unwrap();
    writer.set_mask("valid", &["demo_99".to_owned()]).unwrap();
    writer.finish().unwrap();
    let (notes, entry) = noted(&request(root.path(), &path, &[]));
    assert!(notes.contains("demo_99"), "{notes}");
    assert_eq!(entry.meta().data.as_ref().unwrap().valid_episodes, 0);
}

#[test]
fn data_that_does_not_serve_is_refused_before_anything_is_trained() {
    let root = tempfile::tempdir().unwrap();
    let data = demonstrations(root.path());
    let refuse = |request: &TrainRequest| {
        let error = train(request, &|| false, &mut |_| {}).unwrap_err();
        assert!(!request.zoo.exists());
        error.to_string()
    };
    let shared = refuse(&request(root.path(), &data, &["data.valid_mask=train"]));
    assert!(shared.contains("share episode 0"), "{shared}");
    let absent = refuse(&request(root.path(), Path::new("nowhere/x.hdf5"), &[]));
    assert!(absent.starts_with("data `nowhere/x.hdf5` not found; looked at "), "{absent}");
}
