//! Entries that are whole and tell another story than their weights: only training again finds that.

#![allow(clippy::unwrap_used)]

#[path = "../../zoo/tests/common/mod.rs"]
mod common;

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use audit::rerun::{Outcome, Report, Rerun, Retrained, Retraining, find_row};
use candle_core::Tensor;
use common::{SMALL, demonstrations};
use rollout::Control;
use zoo::config::Library;
use zoo::entry::{
    CardWords, Entry, EntryDraft, EntryId, EntryMeta, MODEL_FILE, REFERENCE_FILE, Repeats, training_facts,
};
use zoo::experiment::Experiment;
use zoo::registry::Registry;
use zoo::results::{
    EntryIdentity, EpisodeRecord, EpisodeTiming, EvaluationRecord, Execution, Protocol, ResultsFolder, Seeds,
    StoredEvaluation,
};
use zoo::run::{TrainOutcome, TrainRequest, train};
use zoo::tensors;

fn trained(folder: &Path, data: &Path) -> Entry {
    let overrides: Vec<String> = SMALL.iter().map(|set| (*set).to_owned()).collect();
    let request = TrainRequest {
        name: "act_lift".to_owned(),
        experiment: Experiment::load(&Library::built_in(), "act_lift", &overrides).unwrap(),
        data: Some(data.to_owned()),
        runs: folder.join("runs"),
        run: None,
        resume: false,
        zoo: folder.join("zoo"),
        from_zoo: None,
        force: false,
        image_memory: None,
        device: zoo::run::DeviceChoice::Cpu,
        command: None,
    };
    match train(&request, &|| false, &mut |_| {}).unwrap() {
        TrainOutcome::Finished { entry, .. } => Entry::open(&request.zoo, &entry).unwrap(),
        TrainOutcome::Stopped { step, .. } => panic!("stopped after step {step}"),
    }
}

/// The same files sealed anew, with other settings or another story.
fn forged(entry: &Entry, zoo: &Path, config: &[(&str, &str)], story: impl Fn(&mut EntryMeta)) -> Entry {
    let mut text = entry.config_text().unwrap();
    for (from, to) in config {
        assert!(text.contains(from), "{from} in {text}");
        text = text.replacen(from, to, 1);
    }
    let mut meta = entry.meta().clone();
    story(&mut meta);
    let draft = EntryDraft {
        meta,
        model: fs::read(entry.folder().join("model.safetensors")).unwrap(),
        config: text,
        normaliser: fs::read(entry.folder().join("normaliser.safetensors")).unwrap(),
        card: CardWords::default(),
        metrics: fs::read(entry.folder().join("train.parquet")).ok(),
        command: None,
        reference: fs::read(entry.folder().join("reference.safetensors")).ok(),
    };
    Entry::open(zoo, &draft.seal(zoo).unwrap()).unwrap()
}

/// A finished evaluation of an entry, sealed, whose single outcome nobody measured.
fn result(zoo: &Path, entry: &Entry) -> StoredEvaluation {
    let EntryId { name, version } = entry.id();
    let record = EvaluationRecord {
        format: EvaluationRecord::FORMAT,
        entry: EntryIdentity { name, version, hash: entry.meta().content_sha256() },
        training: training_facts(entry.meta()),
        protocol: Protocol {
            rules: Protocol::RULES,
            task: "Lift".into(),
            env_name: "Lift".into(),
            env_module: None,
            env_module_sha256: None,
            env_args_sha256: None,
            control: Control::Compiled,
            max_steps: 40,
            perturbation: None,
        },
        execution: Execution::RecedingHorizon { n_action_steps: 8 },
        time_decides: false,
        demonstrated: false,
        seeds: Seeds { start: 10_000, count: 1 },
        shard: None,
        versions: [("mujoco".to_owned(), "3.3.7".to_owned())].into(),
        kernels: None,
        renderer: None,
        sources: std::collections::BTreeMap::new(),
    };
    let mut folder = ResultsFolder::open(&zoo.join("results"), &record).unwrap();
    let episode = EpisodeRecord {
        seed: 10_000,
        success: true,
        steps: 12,
        total_reward: 1.0,
        fingerprint: "0".repeat(64),
        group: None,
        failure: None,
        progress: None,
    };
    let timing = EpisodeTiming {
        seed: 10_000,
        wall_ms: 1.0,
        simulator_ms: 1.0,
        rendering_ms: Vec::new(),
        encoding_ms: Vec::new(),
        inference_ms: vec![1.0],
    };
    folder.add(episode, timing).unwrap();
    folder.finish().unwrap()
}

/// Trains the row of the only result in `zoo` again.
fn rerun(zoo: &Path, work: &Path, data: &Path) -> (Rerun, Report) {
    let (registry, results) = (Registry::open(zoo), zoo.join("results"));
    let row = find_row("lift-act", &registry, &results, &|_| true).unwrap();
    let mut report = Report::default();
    let rerun =
        Rerun::open(&row, &registry, Some(work.to_owned()), Path::new("nowhere"), &mut report).unwrap().unwrap();
    let how = Retraining { data: Some(data.to_owned()), image_memory: None };
    let outcome = rerun.retrain(&how, &|| false, &mut |_| {}, &mut report).unwrap();
    assert!(matches!(outcome, Retrained::Entry(_)), "{outcome:?}");
    (rerun, report)
}

fn step<'a>(report: &'a Report, name: &str) -> (Outcome, &'a str) {
    let step = report.steps().iter().find(|step| step.step == name).unwrap();
    (step.outcome, &step.told)
}

/// Weights that answer otherwise than those that the reference output is of.
#[test]
fn an_entry_whose_policy_answers_otherwise_than_when_it_was_sealed_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let entry = trained(folder.path(), &demonstrations(folder.path()));
    let loaded = entry.load().unwrap();
    assert_eq!(loaded.repeats().unwrap(), Repeats::Exactly);
    let (mut contents, about) = tensors::read(&entry.folder().join(MODEL_FILE)).unwrap();
    let changed = |contents: &BTreeMap<String, Tensor>| {
        let draft = EntryDraft {
            meta: entry.meta().clone(),
            model: tensors::to_bytes(Path::new(MODEL_FILE), contents, &about).unwrap(),
            config: entry.config_text().unwrap(),
            normaliser: fs::read(entry.folder().join("normaliser.safetensors")).unwrap(),
            card: CardWords::default(),
            metrics: None,
            command: None,
            reference: fs::read(entry.folder().join(REFERENCE_FILE)).ok(),
        };
        let zoo = folder.path().join("changed");
        Entry::open(&zoo, &draft.seal(&zoo).unwrap()).unwrap().load().unwrap().repeats()
    };
    // the last layer's bias: every action moves as far
    let (name, bias) = contents.iter().find(|(name, _)| name.contains("action_head.bias")).unwrap();
    let (name, bias) = (name.clone(), bias.clone());
    contents.insert(name.clone(), (&bias + 1e-6).unwrap());
    let Repeats::Within(far) = changed(&contents).unwrap() else { panic!("not the same bits") };
    assert!(far > 0.0 && far < 1e-4, "{far}");
    contents.insert(name, (&bias + 0.1).unwrap());
    let error = changed(&contents).unwrap_err().to_string();
    assert!(error.contains("reference output") && error.contains("lift-act@2"), "{error}");
}

#[test]
fn the_same_settings_and_demonstrations_give_the_same_weights() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let data = demonstrations(folder.path());
    let entry = trained(folder.path(), &data);
    let stored = result(&at("zoo"), &entry);
    let (rerun, mut report) = rerun(&at("zoo"), &at("work"), &data);
    assert!(report.is_same(), "{report:#?}");
    assert_eq!(report.steps().len(), 6);
    assert_eq!(report.reasons().count(), 0);
    // an outcome that was made up, and another version of the simulator
    let mut now = stored.clone();
    now.episodes[0].success = false;
    now.record.versions.insert("mujoco".to_owned(), "3.3.8".to_owned());
    now.record.protocol.max_steps = 41;
    rerun.compare_episodes(&now, &mut report);
    assert_eq!(step(&report, "rules"), (Outcome::Differs, "max_steps: stored 40, now 41"));
    let (outcome, told) = step(&report, "episodes");
    assert!(outcome == Outcome::Differs && told.contains("success of 1") && told.contains("seed 10000"), "{told}");
    let reasons: Vec<String> = report.reasons().map(|reason| reason.what.clone()).collect();
    assert_eq!(reasons, ["mujoco"]);
}

#[test]
fn weights_of_other_settings_are_told_however_well_they_are_sealed() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let data = demonstrations(folder.path());
    let entry = trained(folder.path(), &data);
    let lie = forged(&entry, &at("lies"), &[("dropout = 0.1", "dropout = 0.2")], |_| {});
    result(&at("lies"), &lie);
    let (_, report) = rerun(&at("lies"), &at("work"), &data);
    assert_eq!(report.first_difference().map(|step| step.step), Some("training"));
    assert!(step(&report, "training").1.starts_with("loss at step 2: recorded "), "{report:#?}");
    let (outcome, told) = step(&report, "weights");
    assert!(outcome == Outcome::Differs && told.contains("tensors, the first `"), "{told}");
    assert_eq!(step(&report, "statistics").0, Outcome::Same);
}

#[test]
fn a_story_that_the_training_does_not_bear_out_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let data = demonstrations(folder.path());
    let entry = trained(folder.path(), &data);
    let lie = forged(&entry, &at("lies"), &[], |meta| meta.data.as_mut().unwrap().train_episodes = 1);
    result(&at("lies"), &lie);
    let (_, report) = rerun(&at("lies"), &at("work"), &data);
    let told = "entry.json: data.train_episodes: recorded 1, now 2";
    assert_eq!(step(&report, "training"), (Outcome::Differs, told));
    assert_eq!(step(&report, "weights").0, Outcome::Same);
    // the work of one entry is no other's
    let other = forged(&entry, &at("others"), &[("steps = 12", "steps = 13")], |_| {});
    result(&at("others"), &other);
    let (registry, results) = (Registry::open(&at("others")), at("others").join("results"));
    let row = find_row("lift-act", &registry, &results, &|_| true).unwrap();
    let mut report = Report::default();
    let rerun = Rerun::open(&row, &registry, Some(at("work")), Path::new("nowhere"), &mut report).unwrap().unwrap();
    let how = Retraining { data: Some(data), image_memory: None };
    let error = rerun.retrain(&how, &|| false, &mut |_| {}, &mut report).unwrap_err().to_string();
    assert!(error.contains("train.steps differs: the run has 12, asked for 13"), "{error}");
}
