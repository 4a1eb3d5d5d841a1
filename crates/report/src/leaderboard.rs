//! The leaderboard: one row an evaluation, ranked inside its task and protocol.
//!
//! A row stores counts and sums; rates are derived. The same results give the same rows, and the same
//! rows the same bytes.

use std::cmp::Ordering;
use std::collections::BTreeMap;

use zoo::results::{EntryIdentity, Execution, Seeds, StoredEvaluation, TrainingFacts};

use crate::wilson::wilson_interval;

/// One entry's evaluation under one protocol.
#[derive(Debug, Clone, PartialEq)]
pub struct LeaderboardRow {
    /// The entry.
    pub entry: EntryIdentity,
    /// Where it comes from.
    pub training: TrainingFacts,
    /// The task.
    pub task: String,
    /// The protocol's name.
    pub protocol: String,
    /// How predictions became actions.
    pub execution: Execution,
    /// Episodes in which the task was done.
    pub successes: u64,
    /// Episodes run.
    pub episodes: u64,
    /// Both for each group of episodes, where the task has groups.
    pub groups: BTreeMap<String, Counts>,
    /// Sum of all episodes' returns.
    pub return_sum: f64,
    /// Sum of the steps of the successful episodes.
    pub success_steps: u64,
    /// Duration of a policy query in milliseconds: median and 95th percentile.
    pub inference_ms: (f64, f64),
    /// The episodes' seeds.
    pub seeds: Seeds,
    /// Versions of the simulator and what it stands on.
    pub versions: BTreeMap<String, String>,
}

/// Episodes in which the task was done, of those that were run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counts {
    /// Episodes in which the task was done.
    pub successes: u64,
    /// Episodes run.
    pub episodes: u64,
}

impl LeaderboardRow {
    /// The row of a finished evaluation.
    pub fn new(evaluation: &StoredEvaluation) -> Self {
        let StoredEvaluation { record, episodes, timings, .. } = evaluation;
        let queries: Vec<f64> = timings.iter().flat_map(|t| t.inference_ms.iter().copied()).collect();
        let won = || episodes.iter().filter(|episode| episode.success);
        let mut groups: BTreeMap<String, Counts> = BTreeMap::new();
        for episode in episodes {
            if let Some(group) = &episode.group {
                let counts = groups.entry(group.clone()).or_default();
                counts.episodes += 1;
                counts.successes += u64::from(episode.success);
            }
        }
        Self {
            groups,
            entry: record.entry.clone(),
            training: record.training.clone(),
            task: record.protocol.task.clone(),
            protocol: record.protocol.id(),
            execution: record.execution,
            successes: won().count() as u64,
            episodes: episodes.len() as u64,
            return_sum: episodes.iter().map(|episode| episode.total_reward).sum(),
            success_steps: won().map(|episode| u64::from(episode.steps)).sum(),
            inference_ms: (quantile(&queries, 0.5), quantile(&queries, 0.95)),
            seeds: record.seeds,
            versions: record.versions.clone(),
        }
    }

    /// Share of successful episodes; 0 for none.
    pub fn success_rate(&self) -> f64 {
        ratio(self.successes as f64, self.episodes).unwrap_or(0.0)
    }

    /// The success rate in whole percents, in tenths where those would say that all or none succeeded.
    pub fn percent(&self) -> String {
        let rate = self.success_rate() * 1e2;
        let whole = format!("{rate:.0}");
        let some = 0 < self.successes && self.successes < self.episodes;
        if some && (whole == "0" || whole == "100") {
            return format!("{:.1}%", rate.clamp(0.1, 99.9));
        }
        format!("{whole}%")
    }

    /// The 95% Wilson interval of the success rate.
    pub fn interval(&self) -> (f64, f64) {
        wilson_interval(self.successes, self.episodes)
    }

    /// Mean return of an episode.
    pub fn mean_return(&self) -> Option<f64> {
        ratio(self.return_sum, self.episodes)
    }

    /// Mean number of control steps to success, over the successful episodes.
    pub fn mean_steps_to_success(&self) -> Option<f64> {
        ratio(self.success_steps as f64, self.successes)
    }

    /// `mujoco 3.3.7, robosuite 1.5.2, ...`
    pub fn versions_text(&self) -> String {
        let each: Vec<String> = self.versions.iter().map(|(name, v)| format!("{name} {v}")).collect();
        each.join(", ")
    }

    /// `8 steps` or `ensemble 0.01`.
    pub fn execution_text(&self) -> String {
        match self.execution {
            Execution::RecedingHorizon { n_action_steps } => format!("{n_action_steps} steps"),
            Execution::TemporalEnsemble { coefficient } => format!("ensemble {coefficient}"),
        }
    }

    /// `seen 52/66, unseen 20/34`; nothing where the task has no groups.
    pub fn groups_text(&self) -> String {
        let each: Vec<String> =
            self.groups.iter().map(|(name, c)| format!("{name} {}/{}", c.successes, c.episodes)).collect();
        each.join(", ")
    }

    /// Best first; ties by what does not change.
    fn order(&self, other: &Self) -> Ordering {
        let group = |row: &Self| (row.task.clone(), row.protocol.clone());
        let rate = |row: &Self| u128::from(row.successes);
        let better = rate(other) * u128::from(self.episodes.max(1));
        group(self)
            .cmp(&group(other))
            .then(better.cmp(&(rate(self) * u128::from(other.episodes.max(1)))))
            .then(other.episodes.cmp(&self.episodes))
            .then_with(|| self.entry.cmp(&other.entry))
            .then_with(|| (self.seeds.start, self.seeds.count).cmp(&(other.seeds.start, other.seeds.count)))
            .then_with(|| self.versions.cmp(&other.versions))
            .then_with(|| self.execution_text().cmp(&other.execution_text()))
    }
}

fn ratio(sum: f64, count: u64) -> Option<f64> {
    (count > 0).then(|| sum / count as f64)
}

/// The rows of all whole evaluations (shards wait until they are merged), best first in each task.
pub fn rank(evaluations: &[StoredEvaluation]) -> Vec<LeaderboardRow> {
    let whole = evaluations.iter().filter(|evaluation| evaluation.record.shard.is_none());
    let mut rows: Vec<LeaderboardRow> = whole.map(LeaderboardRow::new).collect();
    rows.sort_by(LeaderboardRow::order);
    rows
}

/// The columns of [`to_csv`].
pub const CSV_COLUMNS: [&str; 26] = [
    "entry",
    "version",
    "policy",
    "task",
    "protocol",
    "execution",
    "successes",
    "episodes",
    "success_rate",
    "ci95_low",
    "ci95_high",
    "mean_return",
    "mean_steps_to_success",
    "parameters",
    "inference_ms_median",
    "inference_ms_p95",
    "training_steps",
    "training_minutes",
    "data_set",
    "demos",
    "versions",
    "seeds",
    "training_seed",
    "entry_hash",
    "data_fingerprint",
    "groups",
];

/// The leaderboard as CSV (RFC 4180, `\n` line ends): one row an evaluation, every column of the record.
pub fn to_csv(rows: &[LeaderboardRow]) -> String {
    let mut text = CSV_COLUMNS.join(",");
    text.push('\n');
    for row in rows {
        let (low, high) = row.interval();
        let t = &row.training;
        let optional = |value: Option<f64>, digits| value.map_or(String::new(), |v| format!("{v:.digits$}"));
        let cells: [String; CSV_COLUMNS.len()] = [
            row.entry.name.clone(),
            row.entry.version.to_string(),
            t.policy.clone(),
            row.task.clone(),
            row.protocol.clone(),
            row.execution_text(),
            row.successes.to_string(),
            row.episodes.to_string(),
            format!("{:.4}", row.success_rate()),
            format!("{low:.4}"),
            format!("{high:.4}"),
            optional(row.mean_return(), 4),
            optional(row.mean_steps_to_success(), 2),
            t.parameters.to_string(),
            format!("{:.3}", row.inference_ms.0),
            format!("{:.3}", row.inference_ms.1),
            t.steps.to_string(),
            format!("{:.2}", t.minutes),
            t.data_set.clone(),
            t.demos.to_string(),
            row.versions_text(),
            row.seeds.to_string(),
            t.seed.to_string(),
            row.entry.hash.clone(),
            t.data_fingerprint.clone(),
            row.groups_text(),
        ];
        let quoted: Vec<String> = cells.iter().map(|cell| quote(cell)).collect();
        text.push_str(&quoted.join(","));
        text.push('\n');
    }
    text
}

fn quote(cell: &str) -> String {
    if cell.contains(['"', ',', '\n', '\r']) { format!("\"{}\"", cell.replace('"', "\"\"")) } else { cell.to_owned() }
}

/// The columns of [`to_table`].
pub const TABLE_COLUMNS: [&str; 11] =
    ["entry", "task", "success", "rate [95%]", "return", "steps", "params", "ms med/p95", "trained", "demos", "seeds"];

/// The leaderboard in short, for a terminal: cells in the order of [`TABLE_COLUMNS`].
pub fn to_table(rows: &[LeaderboardRow]) -> Vec<[String; TABLE_COLUMNS.len()]> {
    let optional = |value: Option<f64>, digits| value.map_or("-".to_owned(), |v| format!("{v:.digits$}"));
    rows.iter()
        .map(|row| {
            let (low, high) = row.interval();
            [
                row.entry.to_string(),
                row.task.clone(),
                success_text(row),
                format!("{} [{:.0}-{:.0}]", row.percent(), low * 1e2, high * 1e2),
                optional(row.mean_return(), 2),
                optional(row.mean_steps_to_success(), 1),
                count_text(row.training.parameters),
                format!("{:.1} / {:.1}", row.inference_ms.0, row.inference_ms.1),
                format!("{} steps, {:.1} min", row.training.steps, row.training.minutes),
                format!("{} {}", row.training.demos, row.training.data_set),
                row.seeds.to_string(),
            ]
        })
        .collect()
}

/// The leaderboard as a Markdown table, with the columns of [`TABLE_COLUMNS`].
pub fn to_markdown(rows: &[LeaderboardRow]) -> String {
    let line = |cells: &[String]| {
        let escaped: Vec<String> = cells.iter().map(|cell| cell.replace('|', "\\|").replace('\n', "<br>")).collect();
        format!("| {} |\n", escaped.join(" | "))
    };
    let mut text = line(&TABLE_COLUMNS.map(str::to_owned));
    text.push_str(&line(&TABLE_COLUMNS.map(|_| "---".to_owned())));
    to_table(rows).iter().for_each(|cells| text.push_str(&line(cells)));
    text
}

/// `72/100`, and below it each group's.
fn success_text(row: &LeaderboardRow) -> String {
    let groups = row.groups_text().replace(", ", "\n");
    let total = format!("{}/{}", row.successes, row.episodes);
    if groups.is_empty() { total } else { format!("{total}\n{groups}") }
}

/// `9,922` stays as it is, `1500000` becomes `1.50M`.
pub fn count_text(count: u64) -> String {
    match count {
        0..100_000 => count.to_string(),
        100_000..1_000_000 => format!("{}k", (count + 500) / 1000),
        _ => format!("{:.2}M", count as f64 / 1e6),
    }
}

/// The `q`-quantile of `values` by linear interpolation; 0 for none.
fn quantile(values: &[f64], q: f64) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let at = q * (sorted.len() - 1) as f64;
    let (below, share) = (at.floor() as usize, at.fract());
    let above = (below + 1).min(sorted.len() - 1);
    sorted[below] + (sorted[above] - sorted[below]) * share
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::testing::{finished, sample};
    use zoo::results::{Shard, list_evaluations};

    #[test]
    fn quantiles_interpolate_as_numpy_s() {
        let values = [4.0, 1.0, 3.0, 2.0];
        assert_eq!(quantile(&values, 0.5), 2.5);
        assert!((quantile(&values, 0.95) - 3.85).abs() < 1e-12);
        assert_eq!(quantile(&values, 0.0), 1.0);
        assert_eq!(quantile(&values, 1.0), 4.0);
        assert_eq!(quantile(&[7.0], 0.95), 7.0);
        assert_eq!(quantile(&[], 0.5), 0.0);
    }

    #[test]
    fn a_rate_is_not_rounded_to_all_or_none() {
        let dir = tempfile::tempdir().unwrap();
        let mut row = board(dir.path()).remove(0);
        row.episodes = 200;
        let texts = [(0, "0%"), (1, "0.5%"), (2, "1%"), (151, "76%"), (198, "99%"), (199, "99.5%"), (200, "100%")];
        for (successes, text) in texts {
            row.successes = successes;
            assert_eq!(row.percent(), text);
        }
        (row.successes, row.episodes) = (99_999, 100_000);
        assert_eq!(row.percent(), "99.9%");
        (row.successes, row.episodes) = (1, 100_000);
        assert_eq!(row.percent(), "0.1%");
    }

    fn board(folder: &std::path::Path) -> Vec<LeaderboardRow> {
        for (name, version, count) in [("lift-act", 1, 20), ("lift-act", 2, 4), ("lift, \"b\"", 1, 20)] {
            finished(folder, &sample(name, version, count));
        }
        let mut shard = sample("lift-act", 3, 20);
        shard.shard = Some(Shard { index: 1, count: 2 });
        finished(folder, &shard);
        let mut none = sample("none", 1, 1);
        none.protocol.task = "Stack".into();
        none.execution = Execution::TemporalEnsemble { coefficient: 0.01 };
        finished(folder, &none);
        rank(&list_evaluations(folder).unwrap())
    }

    #[test]
    fn csv_and_table_read_like_this() {
        let dir = tempfile::tempdir().unwrap();
        let rows = board(dir.path());
        insta::assert_snapshot!("leaderboard_csv", to_csv(&rows));
        let table: Vec<String> = to_table(&rows).iter().map(|cells| cells.join(" | ")).collect();
        insta::assert_snapshot!("leaderboard_table", table.join("\n"));
    }

    #[test]
    fn the_order_of_the_folders_does_not_matter() {
        let dir = tempfile::tempdir().unwrap();
        let expected = to_csv(&board(dir.path()));
        let mut all = list_evaluations(dir.path()).unwrap();
        for _ in 0..all.len() {
            all.rotate_left(1);
            assert_eq!(to_csv(&rank(&all)), expected);
        }
    }

    #[test]
    fn groups_are_counted_apart() {
        let dir = tempfile::tempdir().unwrap();
        let mut evaluation = finished(dir.path(), &sample("color", 1, 20));
        for (k, episode) in evaluation.episodes.iter_mut().enumerate() {
            episode.group = Some(if k < 15 { "seen" } else { "unseen" }.to_owned());
        }
        let row = LeaderboardRow::new(&evaluation);
        // the sample fails for every fifth seed
        assert_eq!(row.groups_text(), "seen 12/15, unseen 4/5");
        assert_eq!(to_table(std::slice::from_ref(&row))[0][2], "16/20\nseen 12/15\nunseen 4/5");
        assert!(to_markdown(std::slice::from_ref(&row)).contains(" | 16/20<br>seen 12/15<br>unseen 4/5 | "));
        assert!(to_csv(&[row]).trim_end().ends_with(",\"seen 12/15, unseen 4/5\""));
    }

    #[test]
    fn rates_are_derived_from_counts() {
        let dir = tempfile::tempdir().unwrap();
        let rows = board(dir.path());
        let row = rows.iter().find(|row| row.entry.to_string() == "lift-act@1").unwrap();
        // the sample fails for every fifth seed
        assert_eq!((row.successes, row.episodes), (16, 20));
        assert_eq!(row.success_rate(), 0.8);
        assert_eq!(row.mean_return(), Some(0.8));
        let steps: u64 = (10_000..10_020).filter(|s| s % 5 != 0).map(|s| 40 + s % 7).sum();
        assert_eq!(row.mean_steps_to_success(), Some(steps as f64 / 16.0));
        let none = rows.iter().find(|row| row.task == "Stack").unwrap();
        assert_eq!((none.successes, none.mean_steps_to_success()), (0, None));
    }
}
