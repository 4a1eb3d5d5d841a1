//! From the demonstrations to the weights, once more.

use std::path::PathBuf;

use serde_json::Value;

use super::Rerun;
use super::report::{DEMONSTRATIONS, OF_TRAINING, Report, STATISTICS, TRAINING, WEIGHTS};
use super::weights::compare;
use zoo::ZooError;
use zoo::config::check_experiment_name;
use zoo::entry::{CurvePoint, Entry, EntryMeta, MODEL_FILE, NORMALISER_FILE, grouped};
use zoo::experiment::Experiment;
use zoo::registry::Registry;
use zoo::run::{
    DeviceChoice, TrainEvent, TrainOutcome, TrainRequest, demonstrations, finished_entry, same_settings, train,
};

/// How a row is trained again.
#[derive(Debug, Clone, Default)]
pub struct Retraining {
    /// Demonstrations, where they are not at the experiment's path.
    pub data: Option<PathBuf>,
    /// Bytes that pictures may take in memory. `None`: half of what is free.
    pub image_memory: Option<u64>,
}

/// What came of it.
#[derive(Debug)]
pub enum Retrained {
    /// An entry in the work folder's zoo.
    Entry(Box<Entry>),
    /// Nothing: its demonstrations are not there, or others are.
    Not,
    /// Asked to stop; the same rerun goes on.
    Stopped {
        /// Steps done.
        step: u64,
    },
}

impl Rerun {
    /// The zoo that gets the retrained entry.
    pub fn zoo(&self) -> PathBuf {
        self.work.join("zoo")
    }

    /// Where the entry's experiment says that its demonstrations are; nothing for one that was not trained on any here.
    ///
    /// # Errors
    /// An experiment that cannot be read.
    pub fn usual_demonstrations(&self) -> Result<Option<PathBuf>, ZooError> {
        let meta = self.entry.meta();
        if meta.data.is_none() || meta.training.is_none() {
            return Ok(None);
        }
        let experiment = Experiment::from_toml(&meta.id().to_string(), &self.entry.config_text()?)?;
        Ok(Some(PathBuf::from(experiment.data.path)))
    }

    /// Finds the demonstrations, trains on them as the entry's experiment says, or goes on where an earlier call was
    /// stopped, and compares.
    ///
    /// # Errors
    /// [`ZooError::ResumeMismatch`] where the work folder holds another training; what a training refuses.
    pub fn retrain(
        &self,
        how: &Retraining,
        stop: &dyn Fn() -> bool,
        on_event: &mut dyn FnMut(TrainEvent<'_>),
        report: &mut Report,
    ) -> Result<Retrained, ZooError> {
        let meta = self.entry.meta();
        let (Some(data), Some(_), Ok(())) = (&meta.data, &meta.training, check_experiment_name(&meta.experiment))
        else {
            for step in OF_TRAINING {
                report.not_compared(step, format!("{} was not trained here: {}", meta.id(), meta.experiment));
            }
            return Ok(Retrained::Not);
        };
        let experiment = Experiment::from_toml(&meta.id().to_string(), &self.entry.config_text()?)?;
        let wanted = how.data.clone().unwrap_or_else(|| PathBuf::from(&experiment.data.path));
        let found = demonstrations(&wanted, &self.work, &experiment, &mut |done, total| {
            on_event(TrainEvent::Converting(done, total));
        });
        let missing = |report: &mut Report, why: &str| {
            for step in [STATISTICS, TRAINING, WEIGHTS] {
                report.not_compared(step, why.to_owned());
            }
        };
        let (path, dataset) = match found {
            Ok(found) => found,
            Err(error @ ZooError::DataNotFound { .. }) => {
                report.not_compared(DEMONSTRATIONS, format!("{error}; --data says where they are"));
                missing(report, "no demonstrations");
                return Ok(Retrained::Not);
            }
            Err(error) => return Err(error),
        };
        let fingerprint = dataset.fingerprint();
        if fingerprint != data.fingerprint {
            let (expected, named) = (&data.fingerprint, &data.name);
            report.differs(
                DEMONSTRATIONS,
                format!(
                    "{}: fingerprint: recorded {} ({named}, {} episodes trained on), now {}; --data names others",
                    wanted.display(),
                    short(expected),
                    data.train_episodes,
                    short(fingerprint)
                ),
            );
            missing(report, "other demonstrations");
            return Ok(Retrained::Not);
        }
        report.same(DEMONSTRATIONS, format!("{}, fingerprint {}", wanted.display(), short(fingerprint)));

        let (run, zoo) = (self.work.join("run"), self.zoo());
        let entry = match finished_entry(&run)? {
            Some(entry) => {
                let entry = Registry::open(&zoo).entry(&entry)?;
                on_event(TrainEvent::Note(&format!(
                    "trained by an earlier call: remove {} to train again",
                    self.work.display()
                )));
                entry
            }
            None => {
                let request = TrainRequest {
                    name: meta.experiment.clone(),
                    experiment: experiment.clone(),
                    data: Some(path),
                    runs: self.work.clone(),
                    resume: run.join("config.toml").is_file(),
                    run: Some(run.clone()),
                    zoo: zoo.clone(),
                    from_zoo: self.entry.folder().ancestors().nth(2).map(std::path::Path::to_owned),
                    // what was refused then would have made no entry
                    force: true,
                    image_memory: how.image_memory,
                    device: DeviceChoice::Cpu,
                    command: None,
                };
                match train(&request, stop, on_event)? {
                    TrainOutcome::Finished { entry, .. } => Entry::open(&zoo, &entry)?,
                    TrainOutcome::Stopped { step, .. } => return Ok(Retrained::Stopped { step }),
                }
            }
        };
        let settings = Experiment::from_toml(&entry.id().to_string(), &entry.config_text()?)?;
        same_settings(&run, &settings.flat(), &experiment.flat())?;
        self.compare_training(&entry, report)?;
        Ok(Retrained::Entry(Box::new(entry)))
    }

    fn compare_training(&self, now: &Entry, report: &mut Report) -> Result<(), ZooError> {
        let versions = &self.entry.meta().versions;
        report.add_versions(
            zoo::versions().into_iter().map(|(name, now)| (name.clone(), versions.get(&name).cloned(), now)),
        );
        // another machine is no difference, and may be why there is one
        let machine = |entry: &Entry| entry.meta().training.as_ref().and_then(|training| training.machine.clone());
        if let (Some(then), Some(here)) = (machine(&self.entry), machine(now)) {
            report.add_versions([("machine".to_owned(), Some(then), here)]);
        }
        let (outcome, told) = compare(NORMALISER_FILE, &self.entry, now)?;
        report.add(STATISTICS, outcome, told);
        let (expected, found) = (self.entry.meta(), now.meta());
        let difference = other_fact(expected, found).or_else(|| other_loss(curve(expected), curve(found)));
        match difference {
            Some(told) => report.differs(TRAINING, told),
            None => {
                let training = found.training.clone().unwrap_or_default();
                let (steps, seed) = (grouped(training.steps), training.seed);
                report.same(TRAINING, format!("{steps} steps, seed {seed}: the same losses on the way"));
            }
        }
        let (outcome, told) = compare(MODEL_FILE, &self.entry, now)?;
        report.add(WEIGHTS, outcome, told);
        Ok(())
    }
}

fn curve(meta: &EntryMeta) -> &[CurvePoint] {
    meta.training.as_ref().map_or(&[], |training| &training.curve)
}

/// Twelve digits of a hash.
fn short(hash: &str) -> &str {
    hash.get(..12).unwrap_or(hash)
}

/// What an entry says of itself, as far as the same training makes it say the same.
fn facts(meta: &EntryMeta) -> Vec<(String, Value)> {
    let whole = serde_json::to_value(meta).expect("strings and numbers become JSON");
    let mut facts = Vec::new();
    flatten("", whole, &mut facts);
    let varies = |name: &str| {
        [
            "training.minutes",
            "training.threads",
            "training.machine",
            "data.name",
            "format",
            "version",
            "experiment",
            "description",
        ]
        .contains(&name)
            || ["versions.", "files.", "training.curve"].iter().any(|prefix| name.starts_with(prefix))
    };
    facts.retain(|(name, value)| !varies(name) && !value.is_null());
    facts
}

/// Dotted names of everything but objects.
fn flatten(prefix: &str, value: Value, facts: &mut Vec<(String, Value)>) {
    match value {
        Value::Object(fields) => {
            for (key, value) in fields {
                let name = if prefix.is_empty() { key } else { format!("{prefix}.{key}") };
                flatten(&name, value, facts);
            }
        }
        other => facts.push((prefix.to_owned(), other)),
    }
}

/// The first fact that is not as it is recorded. What was not recorded then says nothing.
fn other_fact(recorded: &EntryMeta, now: &EntryMeta) -> Option<String> {
    let found = facts(now);
    facts(recorded).into_iter().find_map(|(name, expected)| {
        let found = found.iter().find(|(other, _)| *other == name).map(|(_, value)| value);
        if found == Some(&expected) {
            return None;
        }
        let found = found.map_or_else(|| "nothing".to_owned(), Value::to_string);
        Some(format!("entry.json: {name}: recorded {expected}, now {found}"))
    })
}

/// The first step whose losses are not as they are recorded.
fn other_loss(recorded: &[CurvePoint], now: &[CurvePoint]) -> Option<String> {
    recorded.iter().find_map(|expected| {
        let found = now.iter().find(|point| point.step == expected.step)?;
        // a number that went through JSON may differ in its last bits
        let near = |a: f64, b: f64| (a - b).abs() <= 1e-14 * a.abs() || a.to_bits() == b.to_bits();
        let valid = match (expected.valid_loss, found.valid_loss) {
            (Some(expected), Some(found)) => near(expected, found),
            (expected, found) => expected.is_none() == found.is_none(),
        };
        if near(expected.loss, found.loss) && valid {
            return None;
        }
        let text = |point: &CurvePoint| match point.valid_loss {
            Some(valid) => format!("{} (validation {valid})", point.loss),
            None => point.loss.to_string(),
        };
        Some(format!("loss at step {}: recorded {}, now {}", expected.step, text(expected), text(found)))
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use zoo::entry::testing::draft as test_draft;

    #[test]
    fn facts_that_a_training_does_not_repeat_are_told() {
        let mut recorded = test_draft("lift-act").meta;
        recorded.training.as_mut().unwrap().machine = Some("one".to_owned());
        assert_eq!(other_fact(&recorded, &recorded), None);
        let mut now = recorded.clone();
        let training = now.training.as_mut().unwrap();
        (training.minutes, training.threads, now.version) = (99.0, 64, 7);
        training.machine = Some("another".to_owned());
        now.versions.insert("rustc".to_owned(), "1.95.0".to_owned());
        now.data.as_mut().unwrap().seeds = Some(zoo::results::Seeds { start: 1, count: 2 });
        assert_eq!(
            other_fact(&recorded, &now),
            None,
            "time, machine and what was not recorded are no facts of a training"
        );
        now.data.as_mut().unwrap().train_episodes = 5;
        assert_eq!(other_fact(&recorded, &now).unwrap(), "entry.json: data.train_episodes: recorded 45, now 5");
        let mut other = recorded.clone();
        other.env_name = None;
        assert_eq!(other_fact(&recorded, &other).unwrap(), "entry.json: env_name: recorded \"Lift\", now nothing");
    }

    #[test]
    fn the_step_from_which_losses_differ_is_told() {
        let point = |step: u64, loss: f64| CurvePoint { step, loss, valid_loss: None };
        let recorded = [point(10, 1.0), point(20, 0.5), point(30, 0.25)];
        assert_eq!(other_loss(&recorded, &recorded), None);
        assert_eq!(other_loss(&recorded, &recorded[1..]), None, "thinned otherwise");
        let now = [point(10, 1.0), point(20, 0.75), point(30, 0.125)];
        assert_eq!(other_loss(&recorded, &now).unwrap(), "loss at step 20: recorded 0.5, now 0.75");
    }
}
