//! The leaderboard: one row an evaluation, ranked inside its task and protocol, and the list of its columns.
//!
//! A row holds what was measured and counts; rates are derived. The same results give the same rows, and the same
//! rows the same bytes.

use std::cmp::Ordering;
use std::collections::BTreeMap;

use zoo::results::{EvaluationRecord, Execution, StoredEvaluation};

use crate::column::{Column, number, text};
use crate::statistics::{mean, quantile, wilson_interval};

/// The statistics of the leaderboard, in their order: everything that writes it walks this list.
pub const COLUMNS: &[Column<LeaderboardRow>] = &[
    text(|row: &LeaderboardRow| row.record().entry.to_string()).table("entry").page("entry").left().kept(),
    text(|row: &LeaderboardRow| row.record().entry.name.clone()).csv("entry"),
    text(|row: &LeaderboardRow| row.record().entry.version.to_string()).csv("version"),
    text(|row: &LeaderboardRow| row.record().training.policy.clone()).csv("policy").page("policy"),
    text(|row: &LeaderboardRow| row.task().to_owned()).csv("task").table("task").left().kept(),
    text(|row: &LeaderboardRow| row.record().protocol.id()).csv("protocol").table("protocol"),
    text(LeaderboardRow::execution_text).csv("execution"),
    text(|row: &LeaderboardRow| row.counts.successes.to_string()).csv("successes"),
    text(|row: &LeaderboardRow| row.counts.episodes.to_string()).csv("episodes"),
    text(LeaderboardRow::success_text).table("success").kept(),
    text(LeaderboardRow::success_intervals_text).page("success"),
    number(|row: &LeaderboardRow| Some(row.counts.rate()), 4, 4).csv("success_rate"),
    number(|row: &LeaderboardRow| Some(row.counts.interval().0), 4, 4).csv("ci95_low"),
    number(|row: &LeaderboardRow| Some(row.counts.interval().1), 4, 4).csv("ci95_high"),
    text(|row: &LeaderboardRow| {
        format!("{} [{}]{}", row.counts.percent(), row.counts.interval_text(0, '-'), row.too_few_text())
    })
    .table("rate [95%]")
    .kept(),
    text(|row: &LeaderboardRow| row.rank.map_or(String::new(), |rank| rank.to_string())).csv("rank").table("rank"),
    text(|row: &LeaderboardRow| row.rank.map_or(TOO_FEW.to_owned(), |rank| rank.to_string())).page("rank"),
    text(|row: &LeaderboardRow| format!("{:.1}%", row.counts.rate() * 1e2)).page("rate"),
    text(|row: &LeaderboardRow| format!("{}%", row.counts.interval_text(1, '–'))).page("95% interval"),
    number(LeaderboardRow::mean_return, 4, 2).csv("mean_return").table("return").page("return"),
    number(LeaderboardRow::mean_steps_to_success, 2, 1)
        .csv("mean_steps_to_success")
        .table("steps")
        .page("steps to success"),
    number(|row: &LeaderboardRow| quantile(&row.steps_to_success(), 0.5), 1, 1)
        .csv("median_steps_to_success")
        .page("median steps"),
    text(|row: &LeaderboardRow| row.record().training.parameters.to_string()).csv("parameters"),
    text(|row: &LeaderboardRow| count_text(row.record().training.parameters)).table("params").page("parameters"),
    number(|row: &LeaderboardRow| Some(row.inference_ms(0.5)), 3, 3).csv("inference_ms_median"),
    number(|row: &LeaderboardRow| Some(row.inference_ms(0.95)), 3, 3).csv("inference_ms_p95"),
    text(|row: &LeaderboardRow| format!("{:.1} / {:.1}", row.inference_ms(0.5), row.inference_ms(0.95)))
        .table("ms med/p95"),
    text(|row: &LeaderboardRow| format!("{:.2} / {:.2}", row.inference_ms(0.5), row.inference_ms(0.95)))
        .page("inference ms\nmedian / p95"),
    text(|row: &LeaderboardRow| row.record().training.steps.to_string()).csv("training_steps"),
    number(|row: &LeaderboardRow| Some(row.record().training.minutes), 2, 2).csv("training_minutes"),
    text(|row: &LeaderboardRow| row.trained_text(", ")).table("trained"),
    text(|row: &LeaderboardRow| row.trained_text("\n")).page("training"),
    text(|row: &LeaderboardRow| row.record().training.data_set.clone()).csv("data_set"),
    text(|row: &LeaderboardRow| row.record().training.demos.to_string()).csv("demos"),
    text(|row: &LeaderboardRow| format!("{} {}", row.record().training.demos, row.record().training.data_set))
        .table("demos"),
    text(|row: &LeaderboardRow| format!("{}\n{} demos", row.record().training.data_set, row.record().training.demos))
        .page("data"),
    text(LeaderboardRow::versions_text).csv("versions"),
    text(LeaderboardRow::seeds_text).csv("seeds").table("seeds"),
    text(|row: &LeaderboardRow| row.record().training.seed.to_string()).csv("training_seed"),
    text(|row: &LeaderboardRow| row.record().entry.hash.clone()).csv("entry_hash"),
    text(|row: &LeaderboardRow| row.record().training.data_fingerprint.clone()).csv("data_fingerprint"),
    text(LeaderboardRow::groups_text).csv("groups"),
];

/// With fewer episodes a row stands last in its protocol and has no rank.
pub const FEWEST_TO_RANK: u64 = 20;

const TOO_FEW: &str = "too few to rank";

/// One entry's evaluation under one protocol.
#[derive(Debug, Clone, PartialEq)]
pub struct LeaderboardRow {
    /// What was measured, episode by episode.
    pub evaluation: StoredEvaluation,
    /// Successes among all episodes.
    pub counts: Counts,
    /// The same for each group of episodes, where the task has groups.
    pub groups: BTreeMap<String, Counts>,
    /// Its place in its task and protocol, by the lower end of the interval; equal counts share one. `None` for a row of
    /// too few episodes, and for one that was not ranked with others.
    pub rank: Option<u64>,
    /// Durations of all queries in milliseconds, ascending.
    queries: Vec<f64>,
}

/// Episodes in which the task was done, of those that were run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counts {
    /// Episodes in which the task was done.
    pub successes: u64,
    /// Episodes run.
    pub episodes: u64,
}

impl Counts {
    fn add(&mut self, success: bool) {
        self.episodes += 1;
        self.successes += u64::from(success);
    }

    /// Share of successful episodes; 0 for none.
    pub fn rate(&self) -> f64 {
        self.successes as f64 / self.episodes.max(1) as f64
    }

    /// The success rate in whole percents, in tenths where those would say that all or none succeeded.
    pub fn percent(&self) -> String {
        let rate = self.rate() * 1e2;
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

    /// The interval in percents: `58-92`.
    fn interval_text(&self, digits: usize, to: char) -> String {
        let (low, high) = self.interval();
        format!("{:.digits$}{to}{:.digits$}", low * 1e2, high * 1e2)
    }
}

impl std::fmt::Display for Counts {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}/{}", self.successes, self.episodes)
    }
}

impl LeaderboardRow {
    /// The row of a finished evaluation.
    pub fn new(evaluation: &StoredEvaluation) -> Self {
        let (mut counts, mut groups) = (Counts::default(), BTreeMap::<String, Counts>::new());
        for episode in &evaluation.episodes {
            counts.add(episode.success);
            if let Some(group) = &episode.group {
                groups.entry(group.clone()).or_default().add(episode.success);
            }
        }
        let mut queries: Vec<f64> = evaluation.timings.iter().flat_map(|t| t.inference_ms.iter().copied()).collect();
        queries.sort_by(f64::total_cmp);
        Self { evaluation: evaluation.clone(), counts, groups, rank: None, queries }
    }

    /// What the evaluation depended on.
    pub fn record(&self) -> &EvaluationRecord {
        &self.evaluation.record
    }

    /// The task.
    pub fn task(&self) -> &str {
        &self.record().protocol.task
    }

    /// The `q`-quantile of a query's duration in milliseconds.
    pub fn inference_ms(&self, q: f64) -> f64 {
        quantile(&self.queries, q).unwrap_or(0.0)
    }

    /// Mean return of an episode.
    pub fn mean_return(&self) -> Option<f64> {
        mean(self.evaluation.episodes.iter().map(|episode| episode.total_reward))
    }

    /// Mean number of control steps to success, over the successful episodes.
    pub fn mean_steps_to_success(&self) -> Option<f64> {
        mean(self.steps_to_success().into_iter())
    }

    /// Control steps of the successful episodes, ascending.
    fn steps_to_success(&self) -> Vec<f64> {
        let won = self.evaluation.episodes.iter().filter(|episode| episode.success);
        let mut steps: Vec<f64> = won.map(|episode| f64::from(episode.steps)).collect();
        steps.sort_by(f64::total_cmp);
        steps
    }

    /// `mujoco 3.3.7, robosuite 1.5.2, ...`
    pub fn versions_text(&self) -> String {
        let each: Vec<String> = self.record().versions.iter().map(|(name, v)| format!("{name} {v}")).collect();
        each.join(", ")
    }

    /// `8 steps` or `ensemble 0.01`.
    pub fn execution_text(&self) -> String {
        match self.record().execution {
            Execution::RecedingHorizon { n_action_steps } => format!("{n_action_steps} steps"),
            Execution::TemporalEnsemble { coefficient } => format!("ensemble {coefficient}"),
        }
    }

    /// `seen 52/66, unseen 20/34`; nothing where the task has no groups.
    pub fn groups_text(&self) -> String {
        let each: Vec<String> = self.groups.iter().map(|(name, counts)| format!("{name} {counts}")).collect();
        each.join(", ")
    }

    fn too_few(&self) -> bool {
        self.counts.episodes < FEWEST_TO_RANK
    }

    /// A second line for a row of too few episodes.
    fn too_few_text(&self) -> String {
        if self.too_few() { format!("\n{TOO_FEW}") } else { String::new() }
    }

    /// `10000-10099`, and whether the entry has seen some of them.
    fn seeds_text(&self) -> String {
        let seen = if self.record().demonstrated { " (some demonstrated)" } else { "" };
        format!("{}{seen}", self.record().seeds)
    }

    /// `72/100`, and below it each group's.
    fn success_text(&self) -> String {
        let groups = self.groups.iter().map(|(name, counts)| format!("\n{name} {counts}"));
        self.counts.to_string() + &groups.collect::<String>()
    }

    /// `72/100`, and below it each group's with its interval.
    fn success_intervals_text(&self) -> String {
        let line =
            |(name, counts): (&String, &Counts)| format!("\n{name} {counts} ({}%)", counts.interval_text(0, '–'));
        self.counts.to_string() + &self.groups.iter().map(line).collect::<String>()
    }

    fn trained_text(&self, between: &str) -> String {
        let training = &self.record().training;
        format!("{} steps{between}{:.1} min", training.steps, training.minutes)
    }

    /// `lift-act@1 on Lift: 20 of 20 (100.0%, 95% interval 83.9-100.0), mean 44.7 steps to success`, and a line for each
    /// group of episodes; `wrong in 3` where the environment ended episodes with that word.
    pub fn summary(&self) -> String {
        let rate = |counts: &Counts| {
            let (rate, interval) = (counts.rate() * 1e2, counts.interval_text(1, '-'));
            format!("{} of {} ({rate:.1}%, 95% interval {interval})", counts.successes, counts.episodes)
        };
        let mut text = format!("{} on {}: {}", self.record().entry, self.task(), rate(&self.counts));
        if let Some(steps) = self.mean_steps_to_success() {
            text.push_str(&format!(", mean {steps:.1} steps to success"));
        }
        if self.record().time_decides {
            text.push_str("\n  it thinks by the clock: these episodes may end otherwise next time");
        }
        let lost = |group: Option<&String>| {
            let failures = self.failures(group).into_iter();
            failures.map(|(word, count)| format!(", {word} in {count}")).collect::<String>()
        };
        if self.groups.is_empty() {
            text.push_str(&lost(None));
        }
        for (group, counts) in &self.groups {
            text.push_str(&format!("\n  {group}: {}{}", rate(counts), lost(Some(group))));
        }
        text
    }

    /// How many episodes, of a group or of all, the environment ended with which word.
    pub fn failures(&self, group: Option<&String>) -> BTreeMap<&str, u64> {
        let mut counts = BTreeMap::new();
        for episode in self.evaluation.episodes.iter().filter(|e| group.is_none() || e.group.as_ref() == group) {
            if let Some(word) = &episode.failure {
                *counts.entry(word.as_str()).or_default() += 1;
            }
        }
        counts
    }

    /// Rows that are ranked against each other agree in this.
    fn group(&self) -> (String, String) {
        (self.task().to_owned(), self.record().protocol.id())
    }

    /// Best first: by what the success rate is at least, so that 1 of 1 does not come before 199 of 200. Too few episodes
    /// come last; ties by what does not change.
    fn order(&self, other: &Self) -> Ordering {
        let seeds = |row: &Self| (row.record().seeds.start, row.record().seeds.count);
        let least = |row: &Self| row.counts.interval().0;
        self.group()
            .cmp(&other.group())
            .then(self.too_few().cmp(&other.too_few()))
            .then(least(other).total_cmp(&least(self)))
            .then(other.counts.episodes.cmp(&self.counts.episodes))
            .then_with(|| self.record().entry.cmp(&other.record().entry))
            .then_with(|| seeds(self).cmp(&seeds(other)))
            .then_with(|| self.record().versions.cmp(&other.record().versions))
            .then_with(|| self.execution_text().cmp(&other.execution_text()))
    }
}

/// The rows of all whole evaluations (shards wait until they are merged), best first in each task and protocol.
pub fn rank(evaluations: &[StoredEvaluation]) -> Vec<LeaderboardRow> {
    let whole = evaluations.iter().filter(|evaluation| evaluation.record.shard.is_none());
    let mut rows: Vec<LeaderboardRow> = whole.map(LeaderboardRow::new).collect();
    rows.sort_by(LeaderboardRow::order);
    let mut place = 0;
    for at in 0..rows.len() {
        let before = at.checked_sub(1).map(|at| &rows[at]).filter(|before| before.group() == rows[at].group());
        place = if before.is_some() { place + 1 } else { 1 };
        let same = before.filter(|before| before.counts == rows[at].counts).and_then(|before| before.rank);
        rows[at].rank = if rows[at].too_few() { None } else { Some(same.unwrap_or(place)) };
    }
    rows
}

/// `9,922` stays as it is, `1500000` becomes `1.50M`.
pub fn count_text(count: u64) -> String {
    match count {
        0..100_000 => count.to_string(),
        100_000..1_000_000 => format!("{}k", (count + 500) / 1000),
        _ => format!("{:.2}M", count as f64 / 1e6),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::column::cells;
    use crate::testing::{finished, sample};
    use crate::{csv, markdown};
    use zoo::results::{Shard, list_evaluations};

    #[test]
    fn a_rate_is_not_rounded_to_all_or_none() {
        let texts = [(0, "0%"), (1, "0.5%"), (2, "1%"), (151, "76%"), (198, "99%"), (199, "99.5%"), (200, "100%")];
        for (successes, text) in texts {
            assert_eq!(Counts { successes, episodes: 200 }.percent(), text);
        }
        assert_eq!(Counts { successes: 99_999, episodes: 100_000 }.percent(), "99.9%");
        assert_eq!(Counts { successes: 1, episodes: 100_000 }.percent(), "0.1%");
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
        insta::assert_snapshot!("leaderboard_csv", csv::table(COLUMNS, &rows));
        let table: Vec<String> = cells(COLUMNS, &rows).rows.iter().map(|cells| cells.join(" | ")).collect();
        insta::assert_snapshot!("leaderboard_table", table.join("\n"));
    }

    #[test]
    fn the_order_of_the_folders_does_not_matter() {
        let dir = tempfile::tempdir().unwrap();
        let expected = csv::table(COLUMNS, &board(dir.path()));
        let mut all = list_evaluations(dir.path()).unwrap();
        for _ in 0..all.len() {
            all.rotate_left(1);
            assert_eq!(csv::table(COLUMNS, &rank(&all)), expected);
        }
    }

    #[test]
    fn ranks_go_by_what_the_rate_is_at_least_and_few_episodes_have_none() {
        let dir = tempfile::tempdir().unwrap();
        let stored = |name: &str, successes: u64, episodes: u64| {
            let mut stored = finished(dir.path(), &sample(name, 1, episodes));
            stored.episodes.iter_mut().enumerate().for_each(|(k, e)| e.success = (k as u64) < successes);
            stored
        };
        let all = [
            stored("one-of-one", 1, 1),
            stored("all-of-nineteen", 19, 19),
            stored("all-of-twenty", 20, 20),
            stored("none", 0, 200),
            stored("same-as-best", 199, 200),
            stored("best", 199, 200),
            stored("half", 100, 200),
        ];
        let ranked: Vec<(String, Option<u64>)> =
            rank(&all).into_iter().map(|row| (row.record().entry.name.clone(), row.rank)).collect();
        let expected = [
            ("best", Some(1)),
            ("same-as-best", Some(1)),
            ("all-of-twenty", Some(3)),
            ("half", Some(4)),
            ("none", Some(5)),
            ("all-of-nineteen", None),
            ("one-of-one", None),
        ];
        assert_eq!(ranked, expected.map(|(name, rank)| (name.to_owned(), rank)));
        assert!(rank(&all)[5].too_few_text().contains("too few to rank"));
        // another protocol begins anew
        let mut other = all[3].clone();
        other.record.protocol.max_steps = 500;
        assert!(rank(&[all[5].clone(), other]).iter().all(|row| row.rank == Some(1)));
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
        assert_eq!(cells(COLUMNS, [&row]).rows[0][3], "16/20\nseen 12/15\nunseen 4/5");
        assert!(markdown::table(COLUMNS, [&row]).contains(" | 16/20<br>seen 12/15<br>unseen 4/5 | "));
        assert!(csv::table(COLUMNS, [&row]).trim_end().ends_with(",\"seen 12/15, unseen 4/5\""));
        assert!(!row.summary().contains(" in "), "{}", row.summary());
        for (k, episode) in evaluation.episodes.iter_mut().enumerate().filter(|(_, episode)| !episode.success) {
            episode.failure = Some(if k < 5 { "late" } else { "wrong" }.to_owned());
        }
        let summary = LeaderboardRow::new(&evaluation).summary();
        assert!(summary.contains("late in 1, wrong in 2\n") && summary.ends_with(", wrong in 1"), "{summary}");
    }

    #[test]
    fn rates_are_derived_from_counts() {
        let dir = tempfile::tempdir().unwrap();
        let rows = board(dir.path());
        let row = rows.iter().find(|row| row.record().entry.to_string() == "lift-act@1").unwrap();
        // the sample fails for every fifth seed
        assert_eq!((row.counts.successes, row.counts.episodes), (16, 20));
        assert_eq!(row.counts.rate(), 0.8);
        assert_eq!(row.mean_return(), Some(0.8));
        let steps: u64 = (10_000..10_020).filter(|s| s % 5 != 0).map(|s| 40 + s % 7).sum();
        assert_eq!(row.mean_steps_to_success(), Some(steps as f64 / 16.0));
        let none = rows.iter().find(|row| row.task() == "Stack").unwrap();
        assert_eq!((none.counts.successes, none.mean_steps_to_success()), (0, None));
    }
}
