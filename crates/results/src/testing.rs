//! What tests of this crate and of those above build on.
#![allow(clippy::unwrap_used, missing_docs)]

use std::path::Path;

use rollout::Control;

pub use crate::tables::write_episodes;
use crate::{
    EntryIdentity, EpisodeRecord, EpisodeTiming, EvaluationRecord, Execution, Protocol, ResultsFolder, Seeds,
    StoredEvaluation, TrainingFacts, sha256_hex,
};

/// A record to build tests on.
pub fn sample(name: &str, version: u32, count: u64) -> EvaluationRecord {
    let versions = [("mujoco", "3.3.7"), ("robosuite", "1.5.2")];
    EvaluationRecord {
        format: EvaluationRecord::FORMAT,
        entry: EntryIdentity { name: name.into(), version, hash: sha256_hex(name.as_bytes()) },
        training: TrainingFacts {
            policy: "act".into(),
            parameters: 1_500_000,
            steps: 500,
            minutes: 0.95,
            seed: 1,
            data_set: "lift".into(),
            data_fingerprint: sha256_hex(b"data"),
            data_simulator: Some("1.5.2".into()),
            demos: 50,
        },
        protocol: Protocol {
            rules: 1,
            task: "Lift".into(),
            env_name: "Lift".into(),
            env_module: None,
            env_module_sha256: None,
            env_args_sha256: None,
            control: Control::Robosuite,
            max_steps: 400,
            perturbation: None,
        },
        execution: Execution::RecedingHorizon { n_action_steps: 8 },
        time_decides: false,
        demonstrated: false,
        seeds: Seeds { start: 10_000, count },
        shard: None,
        versions: versions.map(|(name, v)| (name.to_owned(), v.to_owned())).into(),
        kernels: None,
        renderer: None,
        sources: std::collections::BTreeMap::new(),
    }
}

pub fn episode(seed: u64) -> (EpisodeRecord, EpisodeTiming) {
    let success = !seed.is_multiple_of(5);
    let episode = EpisodeRecord {
        seed,
        success,
        steps: if success { 40 + (seed % 7) as u32 } else { 400 },
        total_reward: if success { 1.0 } else { 0.0 },
        fingerprint: format!("{seed:064x}"),
        group: None,
        failure: None,
        progress: None,
    };
    let timing = EpisodeTiming {
        seed,
        wall_ms: 900.0,
        simulator_ms: 700.0,
        rendering_ms: Vec::new(),
        encoding_ms: Vec::new(),
        inference_ms: (0..6).map(|i| 2.0 + (seed % 3) as f64 / 8.0 + f64::from(i)).collect(),
    };
    (episode, timing)
}

/// A finished evaluation on disk.
pub fn finished(results: &Path, record: &EvaluationRecord) -> StoredEvaluation {
    let mut folder = ResultsFolder::open(results, record).unwrap();
    for seed in folder.missing() {
        let (episode, timing) = episode(seed);
        folder.add(episode, timing).unwrap();
    }
    folder.finish().unwrap()
}
