//! An entry as the subject of an evaluation.

use crate::evaluation::Subject;
use crate::results::{EntryIdentity, Execution, TrainingFacts};

use models::FeatureKind;

use super::{CamerasMeta, EntryMeta, LoadedEntry};

/// Where an entry comes from, as results record it.
pub fn training_facts(meta: &EntryMeta) -> TrainingFacts {
    let (training, data) = (meta.training.as_ref(), meta.data.as_ref());
    TrainingFacts {
        policy: meta.policy.clone(),
        parameters: meta.parameters,
        steps: training.map_or(0, |t| t.steps),
        minutes: training.map_or(0.0, |t| t.minutes),
        seed: training.map_or(0, |t| t.seed),
        data_set: data.map(|d| d.name.clone()).unwrap_or_else(|| "not recorded".to_owned()),
        data_fingerprint: data.map_or_else(String::new, |d| d.fingerprint.clone()),
        data_simulator: meta.env_version.clone(),
        demos: data.map_or(0, |d| d.train_episodes),
    }
}

impl LoadedEntry {
    /// What an evaluation needs to know.
    pub fn subject(&self) -> Subject<'static> {
        let this = self.clone();
        let (meta, rollout) = (self.entry().meta(), &self.experiment().rollout);
        Subject {
            entry: EntryIdentity { name: meta.name.clone(), version: meta.version, hash: meta.content_sha256() },
            training: training_facts(meta),
            task: meta.task.clone(),
            demonstrations: meta.data.as_ref().and_then(|data| data.seeds),
            env_version: meta.env_version.clone(),
            keys: meta.keys.clone(),
            execution: match rollout.temporal_ensemble {
                Some(coefficient) => Execution::TemporalEnsemble { coefficient },
                None => Execution::RecedingHorizon { n_action_steps: rollout.n_action_steps },
            },
            max_steps: rollout.max_steps,
            signature: meta.signature.clone(),
            time_decides: self.model().depends_on_time(),
            conventions: self.conventions(),
            is_scripted: self.model().is_scripted(),
            fast_render: meta
                .signature
                .of_kind(FeatureKind::Image)
                .next()
                .map(|_| meta.env_args.as_ref().is_some_and(CamerasMeta::draws_fast)),
            perturbation: None,
            gpu: self.model().params().backend().gpu(),
            policy: Box::new(move || Ok(this.policy())),
        }
    }
}
