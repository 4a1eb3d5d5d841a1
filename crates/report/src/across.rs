//! Policies across tasks: the interquartile mean of their success rates.

use std::cmp::Reverse;
use std::collections::BTreeMap;

use zoo::protocols::Block;

use crate::column::{Column, count, number, text};
use crate::leaderboard::{Asked, Counts, LeaderboardRow, asked};
use crate::statistics::{Estimate, interquartile};

/// Seed of the bootstrap: the same results give the same table.
const BOOTSTRAP_SEED: u64 = 1;

/// One kind of policy over the tasks that it was evaluated on.
#[derive(Debug, Clone, PartialEq)]
pub struct AcrossTasks {
    /// The kind of policy, and whether it sees pictures.
    pub policy: String,
    /// The tasks, with the row that speaks for the policy in each: `Lift lift-act@1`.
    pub tasks: BTreeMap<String, String>,
    /// Trainings in all tasks together.
    pub trainings: usize,
    /// The interquartile mean over tasks and trainings.
    pub mean: f64,
    /// Its 95% interval from a bootstrap that draws trainings within each task; none where a task has a single one, which
    /// says nothing about another.
    pub interval: Option<(f64, f64)>,
}

/// The statistics across tasks, in their order.
pub const ACROSS_COLUMNS: &[Column<AcrossTasks>] = &[
    text(|row: &AcrossTasks| row.policy.clone()).csv("policy").table("policy").page("policy").left().kept(),
    count(|row: &AcrossTasks| Some(row.tasks.len() as u64)).csv("tasks").table("tasks").page("tasks").kept(),
    count(|row: &AcrossTasks| Some(row.trainings as u64)).csv("trainings").table("trainings").page("trainings"),
    number(|row: &AcrossTasks| Some(row.mean), 4, 4).csv("interquartile_mean"),
    number(|row: &AcrossTasks| Some(row.interval?.0), 4, 4).csv("ci95_low"),
    number(|row: &AcrossTasks| Some(row.interval?.1), 4, 4).csv("ci95_high"),
    text(AcrossTasks::mean_text).table("interquartile mean [95%]").page("interquartile mean [95%]").kept(),
    text(AcrossTasks::rows_text).csv("rows").table("rows").page("rows").left(),
];

impl AcrossTasks {
    fn mean_text(&self) -> String {
        let mean = format!("{:.1}%", self.mean * 1e2);
        match self.interval {
            Some((low, high)) => format!("{mean} [{:.0}-{:.0}]", low * 1e2, high * 1e2),
            None => format!("{mean} (a task has one training)"),
        }
    }

    fn rows_text(&self) -> String {
        self.tasks.values().cloned().collect::<Vec<_>>().join(", ")
    }
}

/// The row that speaks for each kind of policy in each task: `table[policy][task]`.
///
/// For each task the protocol with most episodes counts, a named test block before others, and in it the policy's row of most
/// trainings, a ranked one before others, the first of several, floors and ceilings among them. What became of a policy whose pictures were changed does not speak for it.
pub(crate) fn speaking(rows: &[LeaderboardRow]) -> BTreeMap<String, BTreeMap<String, &LeaderboardRow>> {
    let as_seen = || rows.iter().filter(|row| row.record().protocol.perturbation.is_none());
    let mut protocols: BTreeMap<&str, BTreeMap<Asked, (bool, u64)>> = BTreeMap::new();
    for row in as_seen() {
        let test = row.named.as_ref().is_some_and(|(_, block)| *block == Block::Test);
        let weight = protocols.entry(row.task()).or_default().entry(asked(row)).or_insert((test, 0));
        weight.1 += row.counts.episodes;
    }
    let first = |of: BTreeMap<Asked, (bool, u64)>| {
        of.into_iter().max_by_key(|(asked, weight)| (*weight, Reverse(asked.clone()))).map(|(asked, _)| asked)
    };
    let chosen: BTreeMap<&str, _> = protocols.into_iter().filter_map(|(task, of)| Some((task, first(of)?))).collect();
    let mut table: BTreeMap<String, BTreeMap<String, &LeaderboardRow>> = BTreeMap::new();
    for row in as_seen().filter(|row| chosen.get(row.task()) == Some(&asked(row))) {
        let speaks = table.entry(row.kind()).or_default().entry(row.task().to_owned()).or_insert(row);
        let weight = |row: &LeaderboardRow| (row.rank.is_some(), row.evaluations().len());
        if weight(row) > weight(speaks) {
            *speaks = row;
        }
    }
    table
}

/// Every kind of policy that has ranked rows in at least two tasks, in each task its row of most trainings under the protocol with
/// most episodes. Policies of other sets of tasks cannot be compared by these numbers: those of one set stand together, by name, the
/// largest set first.
pub fn across_tasks(rows: &[LeaderboardRow]) -> Vec<AcrossTasks> {
    let mut all: Vec<AcrossTasks> = speaking(rows)
        .into_iter()
        .map(|(policy, mut of)| {
            of.retain(|_, row| row.rank.is_some());
            (policy, of)
        })
        .filter(|(_, of)| of.len() > 1)
        .filter_map(|(policy, of)| {
            let scores: Vec<Vec<f64>> = of.values().map(|row| row.each().iter().map(Counts::rate).collect()).collect();
            let episodes = of.values().flat_map(|row| row.each()).map(|counts| counts.episodes).min()?;
            let Estimate { value, low, high } = interquartile(&scores, episodes, BOOTSTRAP_SEED)?;
            let several = scores.iter().all(|trainings| trainings.len() > 1);
            Some(AcrossTasks {
                policy,
                tasks: of.iter().map(|(task, row)| (task.clone(), row.name())).collect(),
                trainings: scores.iter().map(Vec::len).sum(),
                mean: value,
                interval: several.then_some((low, high)),
            })
        })
        .collect();
    all.sort_by(|a, b| {
        let tasks = a.tasks.keys().cmp(b.tasks.keys());
        b.tasks.len().cmp(&a.tasks.len()).then(tasks).then_with(|| a.policy.cmp(&b.policy))
    });
    all
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::{Reading, rank};
    use zoo::results::testing::{finished, sample};

    #[test]
    fn the_interval_needs_several_trainings_in_every_task() {
        let dir = tempfile::tempdir().unwrap();
        let mut reading = Reading::default();
        let mut all = Vec::new();
        for (task, won) in [("Lift", [18, 16, 17]), ("Stack", [10, 12, 8]), ("Door", [20, 20, 19])] {
            for (k, won) in won.into_iter().enumerate() {
                let mut record = sample(&format!("{}-s{k}", task.to_lowercase()), 1, 20);
                record.protocol.task = task.to_owned();
                record.training.seed = k as u64;
                reading.families.insert(&record.entry.name, 1, task.to_owned());
                let mut stored = finished(dir.path(), &record);
                stored.episodes.iter_mut().enumerate().for_each(|(k, episode)| episode.success = k < won);
                all.push(stored);
            }
        }
        let found = across_tasks(&rank(&all, &reading));
        assert_eq!(found.len(), 1);
        assert_eq!((found[0].policy.as_str(), found[0].tasks.len(), found[0].trainings), ("act", 3, 9));
        // scipy.stats.trim_mean([.9, .8, .85, .5, .6, .4, 1, 1, .95], 0.25)
        assert!((found[0].mean - 0.82).abs() < 1e-12, "{}", found[0].mean);
        let (low, high) = found[0].interval.unwrap();
        assert!(low < 0.82 && 0.82 < high && low > 0.5, "{low} {high}");
        // one training a task: no interval; one task: no row
        let single: Vec<_> = all.iter().step_by(3).cloned().collect();
        let found = across_tasks(&rank(&single, &reading));
        assert_eq!((found[0].trainings, found[0].interval), (3, None));
        assert!(across_tasks(&rank(&all[..3], &reading)).is_empty());
    }

    #[test]
    fn changed_pictures_do_not_speak_for_a_policy() {
        let dir = tempfile::tempdir().unwrap();
        let mut all = Vec::new();
        // more episodes under the change than without it
        for (perturbation, episodes, won) in [(None, 30, 30), (Some("black-agentview"), 40, 4)] {
            for task in ["Lift", "Stack"] {
                let mut record = sample(&task.to_lowercase(), 1, episodes);
                record.protocol.task = task.to_owned();
                record.protocol.perturbation = perturbation.map(str::to_owned);
                let mut stored = finished(dir.path(), &record);
                stored.episodes.iter_mut().enumerate().for_each(|(k, episode)| episode.success = k < won);
                all.push(stored);
            }
        }
        let found = across_tasks(&rank(&all, &Reading::default()));
        assert_eq!((found.len(), found[0].mean), (1, 1.0));
        assert!(across_tasks(&rank(&all[2..], &Reading::default())).is_empty());
    }
}
