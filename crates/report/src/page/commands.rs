//! The commands that lead to a row again, as the program takes them.

use zoo::protocols::Block;
use zoo::results::{EvaluationRecord, Execution, Seeds};

use crate::leaderboard::LeaderboardRow;

/// Folders that the commands of a page name; `None` for those at their usual places.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Places {
    /// The zoo.
    pub zoo: Option<String>,
    /// The results, where they are not in the zoo.
    pub results: Option<String>,
    /// Named protocols beside those built in.
    pub protocols: Option<String>,
}

/// A command as one types it, word by word.
struct Words(Vec<String>);

impl Words {
    fn new(command: &str, object: &str) -> Self {
        Self(["actrm-zoo", command, object].map(str::to_owned).to_vec())
    }

    fn flag(&mut self, name: &str) {
        self.0.push(name.to_owned());
    }

    fn option(&mut self, name: &str, value: impl ToString) {
        self.0.extend([name.to_owned(), value.to_string()]);
    }

    fn places(&mut self, places: &Places) {
        for (name, folder) in [("--zoo", &places.zoo), ("--results", &places.results)] {
            if let Some(folder) = folder {
                self.option(name, folder);
            }
        }
    }

    /// The module of the evaluation's environment, which runs only if it is named.
    fn module(&mut self, record: &EvaluationRecord) {
        if let Some(module) = &record.protocol.env_module {
            self.option("--env-module", module);
        }
    }

    fn line(&self) -> String {
        self.0.iter().map(|word| shell_quoted(word)).collect::<Vec<_>>().join(" ")
    }
}

/// A word as a shell reads it back.
pub fn shell_quoted(word: &str) -> String {
    let harmless = |c: char| c.is_ascii_alphanumeric() || "_-./=:,@%+".contains(c);
    match !word.is_empty() && word.chars().all(harmless) {
        true => word.to_owned(),
        false => format!("'{}'", word.replace('\'', "'\\''")),
    }
}

/// From the demonstrations to the episodes of a row of one training, held against what is stored.
pub(super) fn rerun(row: &LeaderboardRow, places: &Places) -> String {
    let folder = row.evaluations().next().and_then(|one| one.folder.file_name());
    let name = folder.map_or_else(|| row.record().folder_name(), |name| name.to_string_lossy().into_owned());
    let mut words = Words::new("rerun", &name);
    words.module(row.record());
    words.places(places);
    words.line()
}

/// The episodes of a row of one training again; none where time decides how they end. `task` is the entry's own, if it is
/// known.
pub(super) fn again(row: &LeaderboardRow, task: Option<&str>, places: &Places) -> Option<String> {
    if row.record().time_decides {
        return None;
    }
    let mut words = evaluation(row, None, task, places);
    words.flag("--again");
    words.places(places);
    Some(words.line())
}

/// One episode of a row of one training as a film. It is compared with the stored one, where that must be the same.
pub(super) fn watch(row: &LeaderboardRow, seed: u64, task: Option<&str>, places: &Places) -> String {
    let mut words = evaluation(row, Some(seed), task, places);
    if !row.record().time_decides {
        words.flag("--again");
    }
    words.option("--video", 1);
    words.places(places);
    words.line()
}

/// The evaluation of a row, or of one of its seeds. What an entry would do by itself is said as well: its defaults are not
/// the record's.
fn evaluation(row: &LeaderboardRow, seed: Option<u64>, task: Option<&str>, places: &Places) -> Words {
    let record = row.record();
    let mut words = Words::new("eval", &record.entry.to_string());
    if task != Some(record.protocol.task.as_str()) {
        words.option("--task", &record.protocol.task);
    }
    match (&row.named, seed) {
        (Some((name, block)), None) => {
            words.option("--protocol", name);
            if *block != Block::Test {
                words.option("--block", block);
            }
            if let Some(folder) = &places.protocols {
                words.option("--protocols", folder);
            }
        }
        _ => {
            let Seeds { start, count } = seed.map_or(record.seeds, |start| Seeds { start, count: 1 });
            words.option("--seed-start", start);
            words.option("--episodes", count);
            words.option("--max-steps", record.protocol.max_steps);
            // the compiled loop is what is asked for by itself, and a simulator's only loop is taken whatever is asked for
            if record.protocol.control.as_str() == "robosuite" {
                words.option("--control", record.protocol.control);
            }
        }
    }
    match record.execution {
        Execution::RecedingHorizon { n_action_steps } => words.option("--n-action-steps", n_action_steps),
        Execution::TemporalEnsemble { coefficient } => words.option("--temporal-ensemble", coefficient),
    }
    if let Some(perturbation) = &record.protocol.perturbation {
        words.option("--perturb", perturbation);
    }
    words.module(record);
    if forced(record) {
        words.flag("--force");
    }
    words
}

/// Whether an evaluation like this one has to be insisted on: with seeds of demonstrations, or in a simulator of another
/// generation (major and minor version) than that of the demonstrations.
fn forced(record: &EvaluationRecord) -> bool {
    let generation = |version: &str| {
        let mut parts = version.split('.').map(|part| part.trim().parse::<u32>().ok());
        Some((parts.next()??, parts.next()??))
    };
    let recorded = record.training.data_simulator.as_deref().and_then(generation);
    let ran = |recorded: (u32, u32)| record.versions.values().any(|version| generation(version) == Some(recorded));
    // one that nobody wrote down is no other
    record.demonstrated || (!record.versions.is_empty() && recorded.is_some_and(|recorded| !ran(recorded)))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::{Reading, rank};
    use zoo::protocols::Protocols;
    use zoo::results::testing::{finished, sample};

    fn row(change: &dyn Fn(&mut EvaluationRecord)) -> LeaderboardRow {
        let dir = tempfile::tempdir().unwrap();
        let mut record = sample("lift-act", 1, 40);
        change(&mut record);
        let stored = finished(dir.path(), &record);
        let reading = Reading { protocols: Protocols::built_in(), ..Reading::default() };
        rank(&[stored], &reading).remove(0)
    }

    #[test]
    fn a_command_says_all_that_is_not_usual() {
        let none = Places::default();
        let plain = row(&|_| {});
        assert_eq!(
            again(&plain, Some("Lift"), &none).unwrap(),
            "actrm-zoo eval lift-act@1 --seed-start 10000 --episodes 40 --max-steps 400 --control robosuite \
             --n-action-steps 8 --again"
        );
        assert_eq!(
            watch(&plain, 10_005, Some("Lift"), &none),
            "actrm-zoo eval lift-act@1 --seed-start 10005 --episodes 1 --max-steps 400 --control robosuite \
             --n-action-steps 8 --again --video 1"
        );
        assert_eq!(rerun(&plain, &none), format!("actrm-zoo rerun {}", plain.record().folder_name()));
        let odd = row(&|record| {
            record.execution = Execution::TemporalEnsemble { coefficient: -0.01 };
            record.protocol.perturbation = Some("hue=0.5".to_owned());
            record.protocol.env_module = Some("my.envs".to_owned());
            record.training.data_simulator = Some("1.4.1".to_owned());
        });
        let places = Places {
            zoo: Some("my zoo".to_owned()),
            results: Some("it's".to_owned()),
            protocols: Some("rules".to_owned()),
        };
        assert_eq!(
            again(&odd, Some("Stack"), &places).unwrap(),
            "actrm-zoo eval lift-act@1 --task Lift --seed-start 10000 --episodes 40 --max-steps 400 --control robosuite \
             --temporal-ensemble -0.01 --perturb hue=0.5 --env-module my.envs --force --again --zoo 'my zoo' --results \
             'it'\\''s'"
        );
        assert!(rerun(&odd, &places).ends_with(" --env-module my.envs --zoo 'my zoo' --results 'it'\\''s'"));
    }

    #[test]
    fn a_block_of_a_named_protocol_is_named() {
        let places = Places { protocols: Some("rules".to_owned()), ..Places::default() };
        let of = |start: u64, count: u64| {
            row(&move |record: &mut EvaluationRecord| {
                record.seeds = Seeds { start, count };
                record.protocol.control = rollout::Control::Compiled;
            })
        };
        let test = of(40_000, 200);
        assert_eq!(
            again(&test, Some("Lift"), &Places::default()).unwrap(),
            "actrm-zoo eval lift-act@1 --protocol lift-v1 --n-action-steps 8 --again"
        );
        assert_eq!(
            again(&of(10_000, 100), Some("Lift"), &places).unwrap(),
            "actrm-zoo eval lift-act@1 --protocol lift-v1 --block dev --protocols rules --n-action-steps 8 --again"
        );
        // one seed is no block
        assert_eq!(
            watch(&test, 40_007, Some("Lift"), &places),
            "actrm-zoo eval lift-act@1 --seed-start 40007 --episodes 1 --max-steps 400 --n-action-steps 8 --again --video 1"
        );
    }

    #[test]
    fn where_time_decides_nothing_is_compared() {
        let row = row(&|record| record.time_decides = true);
        assert_eq!(again(&row, Some("Lift"), &Places::default()), None);
        assert!(!watch(&row, 10_000, Some("Lift"), &Places::default()).contains("--again"));
    }
}
