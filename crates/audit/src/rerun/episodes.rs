//! The row's episodes, once more.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde_json::Value;

use super::Rerun;
use super::report::{EPISODES, RULES, Report};
use zoo::ZooError;
use zoo::entry::Entry;
use zoo::evaluation::{Environment, EvaluationOptions, Perturbation, Subject};
use zoo::results::{EpisodeRecord, Seeds, StoredEvaluation, differing};

impl Rerun {
    /// Whether outcomes may be another each time, because the policy thinks by the clock; then `report` says so and there
    /// is nothing to run.
    pub fn time_decides(&self, report: &mut Report) -> bool {
        let by_clock = self.stored.record.time_decides;
        if by_clock {
            for step in [RULES, EPISODES] {
                report.not_compared(
                    step,
                    "it refines by the clock, so its episodes can end differently each time".to_owned(),
                );
            }
        }
        by_clock
    }

    /// What simulators are started for, with the module that the user names.
    ///
    /// # Errors
    /// As [`Environment::of`]; the row was measured with a module, and the user names none.
    pub fn environment(&self, env_module: Option<&str>) -> Result<Environment, ZooError> {
        let protocol = &self.stored.record.protocol;
        let environment = Environment::of(self.entry.meta(), Some(&protocol.task), env_module)?;
        environment.expecting(&self.stored.folder.display().to_string(), protocol.env_module.as_deref())
    }

    /// The policy of `entry`, acting as the row's did.
    ///
    /// # Errors
    /// An entry that cannot be loaded, a perturbation that is not known.
    pub fn subject(&self, entry: &Entry) -> Result<Subject<'static>, ZooError> {
        self.as_measured(entry.load()?.subject())
    }

    /// `subject` acting as the row's policy did.
    ///
    /// # Errors
    /// A perturbation that is not known.
    pub fn as_measured<'a>(&self, mut subject: Subject<'a>) -> Result<Subject<'a>, ZooError> {
        let record = &self.stored.record;
        subject.execution = record.execution;
        subject.max_steps = Some(record.protocol.max_steps);
        let known = record.protocol.perturbation.as_deref().map(str::parse::<Perturbation>).transpose();
        subject.perturbation =
            known.map_err(|reason| ZooError::Malformed { path: self.stored.folder.clone(), reason })?;
        Ok(subject)
    }

    /// The first `episodes` of the row's, or all of them.
    ///
    /// # Errors
    /// [`ZooError::InvalidValue`]: more than there are.
    pub fn options(&self, episodes: Option<u64>) -> Result<EvaluationOptions, ZooError> {
        let record = &self.stored.record;
        let own = record.own_seeds();
        let last = match episodes {
            None => own.last(),
            Some(count) => usize::try_from(count).ok().and_then(|count| own.get(count.checked_sub(1)?)),
        };
        let Some(last) = last else {
            return Err(ZooError::InvalidValue {
                key: "--episodes".to_owned(),
                expected: format!("1 to {}, the row's episodes", own.len()),
                found: episodes.unwrap_or_default().to_string(),
            });
        };
        let start = record.seeds.start;
        Ok(EvaluationOptions {
            seeds: Seeds { start, count: last - start + 1 },
            shard: record.shard,
            env_module: record.protocol.env_module.clone(),
            // what was recorded is run, whatever it needed then; other versions are told
            force: true,
        })
    }

    /// Holds what the owner of a policy declares of it now against what was declared when the row was measured.
    pub fn compare_declared(&self, then: Option<&str>, now: Option<&str>, report: &mut Report) {
        if let Some(now) = now {
            report.add_versions([("policy".to_owned(), then.map(str::to_owned), now.to_owned())]);
        }
    }

    /// Where outcomes of `entry` go: beside the retrained entry, or in a folder for the stored one's.
    pub fn results(&self, entry: &Entry) -> PathBuf {
        match entry.folder() == self.entry.folder() {
            true => self.work.join("results"),
            false => self.zoo().join("results"),
        }
    }

    /// Compares what was evaluated now with what is stored, outcome by outcome.
    pub fn compare_episodes(&self, now: &StoredEvaluation, report: &mut Report) {
        let versions = differing(&self.stored.record, &now.record);
        report.add_versions(versions.into_iter().map(|(name, stored, now)| (name, Some(stored), now)));
        match other_rule(self, now) {
            Some(told) => report.differs(RULES, told),
            None => report.same(RULES, format!("{}, seeds {}", now.record.protocol.id(), now.record.seeds)),
        }
        let of = self.stored.episodes.len();
        match other_outcomes(&self.stored.episodes, &now.episodes) {
            Some(told) => report.differs(EPISODES, told),
            None => {
                let (count, successes) = (now.episodes.len(), now.successes());
                let left = if count < of { format!("; {} more were not asked for", of - count) } else { String::new() };
                report.same(EPISODES, format!("{count} of {count} outcomes the same, {successes} successes{left}"));
            }
        }
    }
}

/// The first rule of the protocol or the execution that is not as it is stored.
fn other_rule(rerun: &Rerun, now: &StoredEvaluation) -> Option<String> {
    let json = |value: Result<Value, serde_json::Error>| value.expect("plain fields are always JSON");
    let rules = |stored: &StoredEvaluation| {
        let mut rules = json(serde_json::to_value(&stored.record.protocol));
        rules["execution"] = json(serde_json::to_value(stored.record.execution));
        rules
    };
    let (expected, found) = (rules(&rerun.stored), rules(now));
    let names = [&expected, &found].into_iter().filter_map(Value::as_object).flat_map(serde_json::Map::keys);
    let other = names.clone().find(|name| expected.get(name) != found.get(name))?;
    Some(format!("{other}: stored {}, now {}", expected[other], found[other]))
}

/// How many outcomes are not as they are stored, in what, and the first of them.
fn other_outcomes(stored: &[EpisodeRecord], now: &[EpisodeRecord]) -> Option<String> {
    let stored: BTreeMap<u64, &EpisodeRecord> = stored.iter().map(|episode| (episode.seed, episode)).collect();
    let pairs = now.iter().filter_map(|now| Some((*stored.get(&now.seed)?, now)));
    let other: Vec<(&EpisodeRecord, &EpisodeRecord)> = pairs.filter(|(stored, now)| !stored.is_same(now)).collect();
    let (first, then) = other.first()?;
    type Same = fn(&EpisodeRecord, &EpisodeRecord) -> bool;
    let parts: [(&str, Same); 7] = [
        ("initial state", |a, b| a.fingerprint == b.fingerprint),
        ("success", |a, b| a.success == b.success),
        ("steps", |a, b| a.steps == b.steps),
        ("return", |a, b| a.total_reward == b.total_reward),
        ("group", |a, b| a.group == b.group),
        ("failure", |a, b| a.failure == b.failure),
        ("progress", |a, b| a.progress.zip(b.progress).is_none_or(|(a, b)| a == b)),
    ];
    let counts = parts.iter().filter_map(|(name, same)| {
        let count = other.iter().filter(|(stored, now)| !same(stored, now)).count();
        (count > 0).then(|| format!("{name} of {count}"))
    });
    let counts: Vec<String> = counts.collect();
    let text = |episode: &EpisodeRecord| {
        let word = if episode.success { "success" } else { "failure" };
        format!("{word} after {} steps, return {:?}", episode.steps, episode.total_reward)
    };
    Some(format!(
        "{} of {} outcomes ({}); the first at seed {}: stored {}, now {}",
        other.len(),
        now.len(),
        counts.join(", "),
        first.seed,
        text(first),
        text(then)
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use results::testing::{finished, sample};
    use zoo::entry::testing::draft;

    #[test]
    fn the_module_of_a_row_is_named_by_the_user() {
        let zoo = tempfile::tempdir().expect("a temporary folder");
        let id = draft("lift-act").seal(zoo.path()).expect("an entry");
        let entry = Entry::open(zoo.path(), &id).expect("an entry");
        let mut record = sample("lift-act", 1, 5);
        record.protocol.env_module = Some("theirs".to_owned());
        let stored = finished(&zoo.path().join("results"), &record);
        let rerun = Rerun { entry, stored, work: PathBuf::new() };
        let refused = rerun.environment(None).expect_err("nobody named it").to_string();
        assert!(refused.contains("lift-act@1") && refused.contains("\"theirs\""), "{refused}");
        let environment = rerun.environment(Some("mine")).expect("an environment");
        assert_eq!(environment.env_module.as_deref(), Some("mine"));
    }

    fn episode(seed: u64, success: bool, steps: u32) -> EpisodeRecord {
        let fingerprint = format!("{seed:064x}");
        EpisodeRecord {
            seed,
            success,
            steps,
            total_reward: 0.5,
            fingerprint,
            group: None,
            failure: None,
            progress: None,
        }
    }

    #[test]
    fn outcomes_are_compared_in_every_part() {
        let stored: Vec<EpisodeRecord> = (0..4).map(|seed| episode(seed, true, 40)).collect();
        assert_eq!(other_outcomes(&stored, &stored), None);
        assert_eq!(other_outcomes(&stored, &stored[..2]), None, "only what was run is compared");
        let mut now = stored.clone();
        (now[1].success, now[1].steps) = (false, 400);
        now[3].fingerprint = "0".repeat(64);
        assert_eq!(
            other_outcomes(&stored, &now).as_deref(),
            Some(
                "2 of 4 outcomes (initial state of 1, success of 1, steps of 1); the first at seed 1: stored success after \
                 40 steps, return 0.5, now failure after 400 steps, return 0.5"
            )
        );
        // the last bit of a return
        let mut now = stored.clone();
        now[2].total_reward = 0.5_f64.next_up();
        assert!(other_outcomes(&stored, &now).is_some_and(|told| told.starts_with("1 of 4 outcomes (return of 1)")));
    }
}
