//! What tests of this crate and of those above build on.
#![allow(clippy::unwrap_used, missing_docs)]

use std::collections::BTreeMap;

use super::{CardWords, CurvePoint, DataMeta, EntryDraft, EntryMeta, TrainingMeta};

pub fn draft(name: &str) -> EntryDraft {
    let curve =
        (1..=3).map(|step| CurvePoint { step, loss: 1.0 / step as f64, valid_loss: (step == 3).then_some(0.5) });
    EntryDraft {
        meta: EntryMeta {
            format: 0,
            name: name.to_owned(),
            version: 0,
            description: "A test.".to_owned(),
            experiment: "act_lift".to_owned(),
            policy: "act".to_owned(),
            task: "Lift".to_owned(),
            env_name: Some("Lift".to_owned()),
            env_version: Some("1.5.2".to_owned()),
            env_module: None,
            env_args: None,
            parameters: 12,
            signature: models::Signature::low_dimensional(9, 10, 7),
            keys: {
                let mut keys = crate::FeatureKeys::default();
                keys.insert(models::STATE, &["robot0_eef_pos".to_owned()]).unwrap();
                keys.insert(models::ENVIRONMENT_STATE, &["object".to_owned()]).unwrap();
                keys
            },
            data: Some(DataMeta {
                name: "lift.hdf5".to_owned(),
                fingerprint: "f".repeat(64),
                train_fingerprint: None,
                train_episodes: 45,
                train_frames: 2000,
                valid_episodes: 5,
                seeds: None,
                expert: None,
                skill: None,
                names: BTreeMap::new(),
            }),
            kind: None,
            section: None,
            training: Some(TrainingMeta {
                gpu: None,
                steps: 3,
                batch_size: 64,
                seed: 1,
                minutes: 1.25,
                threads: 2,
                machine: None,
                curve: curve.collect(),
            }),
            parent: None,
            license: None,
            versions: BTreeMap::from([("actrm".to_owned(), "0.1.0".to_owned())]),
            files: BTreeMap::new(),
        },
        model: b"weights".to_vec(),
        config: "[task]\nname = \"Lift\"\n".to_owned(),
        normaliser: b"statistics".to_vec(),
        card: CardWords::default(),
        metrics: None,
        command: None,
        reference: None,
    }
}
