//! A row: one training under one protocol, or several of one family.

use std::collections::BTreeMap;

use zoo::external::EXTERNAL;
use zoo::protocols::Block;
use zoo::results::{EpisodeTiming, EvaluationRecord, Execution, StoredEvaluation};

use crate::comparison::Standing;
use crate::statistics::{Estimate, mean, mean_interval, over_trainings, percent, quantile, wilson_interval};

/// With fewer episodes a training a row stands last in its protocol and has no rank.
pub const FEWEST_TO_RANK: u64 = 20;

pub(super) const TOO_FEW: &str = "too few to rank";

/// What a policy is measured against: rows that say how little and how much a task can give.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Bound {
    /// What acts without looking: zeros, random actions, a demonstration played back blindly.
    Floor,
    /// What nobody has to learn: the scripted expert.
    Ceiling,
}

impl Bound {
    /// Which bound a kind of policy is, if it is one.
    pub fn of(policy: &str) -> Option<Self> {
        match policy {
            "zero" | "random" | "replay" => Some(Self::Floor),
            "expert" => Some(Self::Ceiling),
            _ => None,
        }
    }

    /// The word in place of a rank.
    pub fn word(self) -> &'static str {
        match self {
            Self::Floor => "floor",
            Self::Ceiling => "ceiling",
        }
    }
}

/// Trainings of one family, or a single one, under one protocol.
#[derive(Debug, Clone, PartialEq)]
pub struct LeaderboardRow {
    /// At least one, by the training's seed.
    trainings: Vec<StoredEvaluation>,
    /// Successes among all episodes of all trainings.
    pub counts: Counts,
    /// The same for each group of episodes, where the task has groups.
    pub groups: BTreeMap<String, Counts>,
    /// The 95% interval of the success rate: Wilson's for one training; for several that of both variances,
    /// which holds the chance of training.
    pub interval: (f64, f64),
    /// The family, where the entry was trained here.
    pub family: Option<String>,
    /// The cameras that it sees through, by their names; none where it sees no pictures.
    pub cameras: Vec<String>,
    /// The named protocol and the block of its seeds that were run, if they are one.
    pub named: Option<(String, Block)>,
    /// What of the simulator is of another version than in other rows under the same rules: `mujoco 3.2.7`; empty where
    /// nothing is.
    pub simulator: String,
    /// What tells it from other rows of the same entry under the same protocol: its seeds, how chunks are executed.
    pub apart: String,
    /// Its place in its task and protocol, by the lower end of the interval; equal counts share one. `None` for a row of
    /// too few episodes, for a [`Bound`], and for one that was not ranked with others.
    pub rank: Option<u64>,
    /// What it can be told apart from, if it was compared.
    pub standing: Option<Standing>,
    /// How far an episode comes on its way, on average: 1 for those in which the task was done. None where not every
    /// episode says it.
    pub progress: Option<Estimate>,
    /// Median and 95% quantile of a query's duration in milliseconds; none where none was asked.
    latency: Option<(f64, f64)>,
    /// Median durations of what pictures take, in milliseconds; none where the policy sees none.
    seeing: Option<Seeing>,
}

/// What pictures take of a query, in milliseconds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Seeing {
    /// Drawing them, in the simulator and before the query.
    pub rendering: f64,
    /// Until they are tokens, within the query.
    pub encoding: f64,
}

impl Seeing {
    /// The medians of all queries of `trainings`, where any of them saw pictures.
    fn of(trainings: &[StoredEvaluation]) -> Option<Self> {
        let median = |times: fn(&EpisodeTiming) -> &[f64]| {
            let timings = trainings.iter().flat_map(|one| &one.timings);
            let mut all: Vec<f64> = timings.flat_map(|timing| times(timing).iter().copied()).collect();
            all.sort_by(f64::total_cmp);
            quantile(&all, 0.5)
        };
        Some(Self { rendering: median(|t| &t.rendering_ms)?, encoding: median(|t| &t.encoding_ms)? })
    }
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

    fn of(evaluation: &StoredEvaluation) -> Self {
        let mut counts = Self::default();
        evaluation.episodes.iter().for_each(|episode| counts.add(episode.success));
        counts
    }

    /// Share of successful episodes; 0 for none.
    pub fn rate(&self) -> f64 {
        self.successes as f64 / self.episodes.max(1) as f64
    }

    /// The success rate in percent with `digits` decimals, more where those would say that all or none succeeded.
    pub fn percent(&self, digits: usize) -> String {
        percent(self.successes, self.episodes, digits) + "%"
    }

    /// The 95% Wilson interval of the success rate.
    pub fn interval(&self) -> (f64, f64) {
        wilson_interval(self.successes, self.episodes)
    }
}

/// An interval in percents: `58-92`.
pub(crate) fn interval_text((low, high): (f64, f64), digits: usize, to: char) -> String {
    format!("{:.digits$}{to}{:.digits$}", low * 1e2, high * 1e2)
}

impl std::fmt::Display for Counts {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}/{}", self.successes, self.episodes)
    }
}

impl LeaderboardRow {
    /// The row of a finished evaluation.
    pub fn new(evaluation: &StoredEvaluation) -> Self {
        Self::of(vec![evaluation.clone()])
    }

    /// The row of several trainings that were run on the same seeds.
    ///
    /// # Panics
    /// Without one.
    pub(crate) fn of(mut trainings: Vec<StoredEvaluation>) -> Self {
        assert!(!trainings.is_empty(), "a row is of something");
        trainings.sort_by_key(|one| (one.record.training.seed, one.record.entry.clone()));
        let (mut counts, mut groups) = (Counts::default(), BTreeMap::<String, Counts>::new());
        for episode in trainings.iter().flat_map(|training| &training.episodes) {
            counts.add(episode.success);
            if let Some(group) = &episode.group {
                groups.entry(group.clone()).or_default().add(episode.success);
            }
        }
        let outcomes = |one: &StoredEvaluation| -> Vec<f64> {
            one.episodes.iter().map(|episode| f64::from(u8::from(episode.success))).collect()
        };
        let several = (trainings.len() > 1)
            .then(|| over_trainings(&trainings.iter().map(outcomes).collect::<Vec<_>>()))
            .flatten();
        let interval = several.map_or_else(|| counts.interval(), |estimate| (estimate.low, estimate.high));
        let come: Option<Vec<Vec<f64>>> =
            trainings.iter().map(|one| one.episodes.iter().map(|episode| episode.progress).collect()).collect();
        let progress = come.and_then(|come| match come.as_slice() {
            [one] => mean_interval(one),
            _ => over_trainings(&come),
        });
        let timings = trainings.iter().flat_map(|one| &one.timings);
        let mut queries: Vec<f64> = timings.flat_map(|t| t.inference_ms.iter().copied()).collect();
        queries.sort_by(f64::total_cmp);
        let latency = quantile(&queries, 0.5).zip(quantile(&queries, 0.95));
        let seeing = Seeing::of(&trainings);
        let (simulator, apart) = (String::new(), String::new());
        let (family, named, rank, standing) = (None, None, None, None);
        Self {
            trainings,
            counts,
            groups,
            interval,
            family,
            cameras: Vec::new(),
            named,
            simulator,
            apart,
            rank,
            standing,
            progress,
            latency,
            seeing,
        }
    }

    /// What each training was measured, by the training's seed.
    pub fn evaluations(&self) -> impl ExactSizeIterator<Item = &StoredEvaluation> {
        self.trainings.iter()
    }

    /// Each training as a row of its own.
    pub fn details(&self) -> Vec<Self> {
        let one = |evaluation| Self {
            family: self.family.clone(),
            cameras: self.cameras.clone(),
            named: self.named.clone(),
            simulator: self.simulator.clone(),
            apart: self.apart.clone(),
            ..Self::new(evaluation)
        };
        self.trainings.iter().map(one).collect()
    }

    /// Number of trainings.
    pub fn n_trainings(&self) -> usize {
        self.trainings.len()
    }

    /// What the evaluation depended on; of several trainings the first one's.
    pub fn record(&self) -> &EvaluationRecord {
        &self.trainings[0].record
    }

    /// The task.
    pub fn task(&self) -> &str {
        &self.record().protocol.task
    }

    /// The kind of policy.
    pub fn policy(&self) -> &str {
        &self.record().training.policy
    }

    /// Whether it sees pictures.
    pub fn sees_pictures(&self) -> bool {
        !self.cameras.is_empty()
    }

    /// The kind of policy, and whether it sees pictures: `act`, `act from images`.
    pub fn kind(&self) -> String {
        self.policy().to_owned() + if self.sees_pictures() { " from images" } else { "" }
    }

    /// Its name; in further lines that it reads images, and that its weights are elsewhere.
    pub(super) fn name_lines(&self) -> String {
        let images = if self.sees_pictures() { "\nfrom images" } else { "" };
        let external = if self.policy() == EXTERNAL { "\nweights not in this zoo" } else { "" };
        self.name() + images + external
    }

    /// Whether it has weights that training found.
    pub(crate) fn is_trained(&self) -> bool {
        self.bound().is_none() && self.policy() != "nearest"
    }

    /// Which bound of its task it is, if it is one.
    pub fn bound(&self) -> Option<Bound> {
        Bound::of(self.policy())
    }

    /// `lift-act@1`; of several trainings `lift-act-s*@1`, or `lift-act@1,2,3` where they are versions of one name.
    pub fn name(&self) -> String {
        let ids: Vec<_> = self.trainings.iter().map(|one| &one.record.entry).collect();
        let [first, .., last] = ids.as_slice() else { return self.record().entry.to_string() };
        let versions: Vec<String> = ids.iter().map(|id| id.version.to_string()).collect();
        if ids.iter().all(|id| id.name == first.name) {
            return format!("{}@{}", first.name, versions.join(","));
        }
        let stem = self.stem();
        let all = |of: &dyn Fn(usize) -> bool| (0..ids.len()).all(of);
        if !all(&|k| ids[k].name.starts_with(&stem)) || stem.is_empty() {
            return format!("{first} to {last}");
        }
        let version =
            if all(&|k| ids[k].version == first.version) { format!("@{}", first.version) } else { String::new() };
        format!("{stem}*{version}")
    }

    /// What the names of the trainings have in common before their seeds: `lift-act-s`; of one training its name.
    pub fn stem(&self) -> String {
        let training = &self.record().training;
        let name = &self.record().entry.name;
        match name.strip_suffix(&training.seed.to_string()) {
            Some(stem) if self.trainings.len() > 1 => stem.to_owned(),
            _ => name.clone(),
        }
    }

    /// Counts of each training, by its seed.
    pub fn each(&self) -> Vec<Counts> {
        self.trainings.iter().map(Counts::of).collect()
    }

    /// The median of the trainings' success rates.
    pub fn median_rate(&self) -> f64 {
        self.median_of(|one| Counts::of(one).rate())
    }

    /// The median over the trainings.
    pub(super) fn median_of(&self, value: impl Fn(&StoredEvaluation) -> f64) -> f64 {
        let mut values: Vec<f64> = self.trainings.iter().map(value).collect();
        values.sort_by(f64::total_cmp);
        quantile(&values, 0.5).unwrap_or(0.0)
    }

    /// A text of every training, those that are alike once.
    pub(super) fn joined(&self, value: impl Fn(&StoredEvaluation) -> String) -> String {
        let mut texts: Vec<String> = self.trainings.iter().map(value).collect();
        texts.dedup();
        texts.join(" ")
    }

    /// The median duration of a query in milliseconds, and what 95% of them stay below; none where none was asked.
    pub fn inference_ms(&self) -> Option<(f64, f64)> {
        self.latency
    }

    /// What pictures take of it; none where the policy sees none.
    pub fn seeing(&self) -> Option<Seeing> {
        self.seeing
    }

    /// Minutes of training: the median of several.
    pub fn minutes(&self) -> f64 {
        self.median_of(|one| one.record.training.minutes)
    }

    /// `0.6 / 1.2`: median and 95% quantile of a query in milliseconds; nothing where none was asked. Where pictures are seen,
    /// what they take stands in further lines.
    pub(super) fn inference_text(&self, digits: usize) -> String {
        let Some((median, most)) = self.latency else { return "-".to_owned() };
        let whole = format!("{median:.digits$} / {most:.digits$}");
        self.seeing.map_or(whole.clone(), |Seeing { rendering, encoding }| {
            format!("{whole}\nencoding {encoding:.digits$}\nrendering +{rendering:.digits$}")
        })
    }

    /// `93.4 [90-96]`: how far episodes come on their way, in percent; nothing where that is not known.
    pub(super) fn progress_text(&self, digits: usize) -> String {
        self.progress.map_or_else(
            || "-".to_owned(),
            |Estimate { value, low, high }| {
                format!("{:.digits$}% [{}]", value * 1e2, interval_text((low, high), 0, '-'))
            },
        )
    }

    /// Mean return of an episode.
    pub fn mean_return(&self) -> Option<f64> {
        mean(self.trainings.iter().flat_map(|one| &one.episodes).map(|episode| episode.total_reward))
    }

    /// Mean number of control steps to success, over the successful episodes.
    pub fn mean_steps_to_success(&self) -> Option<f64> {
        mean(self.steps_to_success().into_iter())
    }

    /// The median of the same.
    pub fn median_steps_to_success(&self) -> Option<f64> {
        quantile(&self.steps_to_success(), 0.5)
    }

    /// Control steps of the successful episodes, ascending.
    pub(crate) fn steps_to_success(&self) -> Vec<f64> {
        let won = self.trainings.iter().flat_map(|one| &one.episodes).filter(|episode| episode.success);
        let mut steps: Vec<f64> = won.map(|episode| f64::from(episode.steps)).collect();
        steps.sort_by(f64::total_cmp);
        steps
    }

    /// `mujoco 3.3.7, robosuite 1.5.2, ...`, with the sources' sum where they are not those of the release.
    pub fn versions_text(&self) -> String {
        let mut changed = self.record().changed_sources();
        let version = |(name, version): (&String, &String)| match changed.remove(name.as_str()) {
            Some(sum) => format!("{name} {version} (sources {sum})"),
            None => format!("{name} {version}"),
        };
        let mut each: Vec<String> = self.record().versions.iter().map(version).collect();
        each.extend(changed.into_iter().map(|(name, sum)| format!("{name} (sources {sum})")));
        each.join(", ")
    }

    /// `drawn by llvmpipe (LLVM 15.0.6)`, or that it was not written down.
    pub(super) fn renderer_text(&self) -> String {
        let name = self.record().renderer.as_deref().map(|name| name.split(", OpenGL").next().unwrap_or(name));
        format!("drawn by {}", name.unwrap_or("what was not written down"))
    }

    /// `sources 1a2b3c4d`, a sum over those of all packages, or that they were not written down.
    pub(super) fn sources_text(&self) -> String {
        let sources = &self.record().sources;
        if sources.is_empty() {
            return "sources not written down".to_owned();
        }
        let all: Vec<String> = sources.iter().map(|(name, sum)| format!("{name} {sum}\n")).collect();
        format!("sources {}", &zoo::sha256_hex(all.concat().as_bytes())[..8])
    }

    /// `8 steps` or `ensemble 0.01`.
    pub fn execution_text(&self) -> String {
        match self.record().execution {
            Execution::RecedingHorizon { n_action_steps } => format!("{n_action_steps} steps"),
            Execution::TemporalEnsemble { coefficient } => format!("ensemble {coefficient}"),
        }
    }

    /// `lift-v1 test` for a block of a named protocol; else the rules' own name, and what tells their simulator from others'.
    pub fn protocol_text(&self) -> String {
        match &self.named {
            Some((name, block)) => format!("{name} {block}"),
            None if self.simulator.is_empty() => self.record().protocol.id(),
            None => format!("{} {}", self.record().protocol.id(), self.simulator),
        }
    }

    /// The same for headings, without a hash: `400 steps, compiled control`.
    pub(crate) fn protocol_words(&self) -> String {
        if self.named.is_some() {
            return self.protocol_text();
        }
        let protocol = &self.record().protocol;
        let mut text = format!("{} steps, {} control", protocol.max_steps, protocol.control);
        for more in protocol.perturbation.iter().chain(Some(&self.simulator).filter(|text| !text.is_empty())) {
            text.push_str(&format!(", {more}"));
        }
        text
    }

    /// The same, and below it what tells the row from others of its entry there.
    pub(super) fn protocol_lines(&self) -> String {
        if self.apart.is_empty() { self.protocol_text() } else { format!("{}\n{}", self.protocol_text(), self.apart) }
    }

    /// `seen 52/66, unseen 20/34`; nothing where the task has no groups.
    pub fn groups_text(&self) -> String {
        let each: Vec<String> = self.groups.iter().map(|(name, counts)| format!("{name} {counts}")).collect();
        each.join(", ")
    }

    pub(super) fn too_few(&self) -> bool {
        (self.trainings[0].episodes.len() as u64) < FEWEST_TO_RANK
    }

    /// What stands in the place of a rank, if there is none: `floor`, `ceiling`, or that there are too few episodes.
    pub fn unranked_text(&self) -> &'static str {
        match self.bound() {
            Some(bound) => bound.word(),
            None if self.too_few() => TOO_FEW,
            None => "",
        }
    }

    /// `95% [88-98]`, with what else is to be said of it in further lines.
    pub(super) fn rate_text(&self) -> String {
        let mut text = format!("{} [{}]", self.counts.percent(0), interval_text(self.interval, 0, '-'));
        if self.trainings.len() > 1 {
            let median = format!("{:.0}", self.median_rate() * 1e2);
            text.push_str(&format!("\n{} trainings, median {median}%", self.trainings.len()));
        }
        if self.rank.is_none() && !self.unranked_text().is_empty() {
            text.push_str(&format!("\n{}", self.unranked_text()));
        }
        text
    }

    /// `10000-10099`, and whether the entry has seen some of them.
    pub fn seeds_text(&self) -> String {
        let seen = if self.record().demonstrated { " (some demonstrated)" } else { "" };
        format!("{}{seen}", self.record().seeds)
    }

    /// `72/100`, and below it each group's.
    pub(super) fn success_text(&self) -> String {
        let groups = self.groups.iter().map(|(name, counts)| format!("\n{name} {counts}"));
        self.counts.to_string() + &groups.collect::<String>()
    }

    /// `72/100`, and below it each group's with its interval, and each training's.
    pub(super) fn success_intervals_text(&self) -> String {
        let line = |(name, counts): (&String, &Counts)| {
            format!("\n{name} {counts} ({}%)", interval_text(counts.interval(), 0, '–'))
        };
        let mut text = self.counts.to_string() + &self.groups.iter().map(line).collect::<String>();
        if self.trainings.len() > 1 {
            text.push_str(&format!("\neach {}", self.each_text(", ")));
        }
        text
    }

    /// Successes of each training: `95, 94, 96`.
    pub(super) fn each_text(&self, between: &str) -> String {
        self.each().iter().map(|counts| counts.successes.to_string()).collect::<Vec<_>>().join(between)
    }

    /// `500 steps, 0.5 min`; that nothing was trained, where that is so.
    pub(crate) fn trained_text(&self, between: &str) -> String {
        if !self.is_trained() {
            return "not trained".to_owned();
        }
        format!("{} steps{between}{:.1} min", self.record().training.steps, self.minutes())
    }

    /// `lift-act@1 on Lift, seeds 10000-10019: 20 of 20 (100.0%, 95% interval 83.9-100.0), mean 44.7 steps to success`, and a line for each
    /// group of episodes; `wrong in 3` where the environment ended episodes with that word.
    pub fn summary(&self) -> String {
        let rate = |counts: &Counts| {
            let (rate, interval) = (counts.percent(1), interval_text(counts.interval(), 1, '-'));
            format!("{} of {} ({rate}, 95% interval {interval})", counts.successes, counts.episodes)
        };
        let changed = self.record().protocol.perturbation.as_ref().map(|word| format!(", {word}")).unwrap_or_default();
        let mut text = format!(
            "{} on {}{changed}, seeds {}: {}",
            self.record().entry,
            self.task(),
            self.record().seeds,
            rate(&self.counts)
        );
        if let Some(steps) = self.mean_steps_to_success() {
            text.push_str(&format!(", mean {steps:.1} steps to success"));
        }
        if let Some(progress) = self.progress.filter(|progress| progress.value < 1.0) {
            text.push_str(&format!(", mean progress {:.1}%", progress.value * 1e2));
        }
        if let (Some(Seeing { rendering, encoding }), Some((query, _))) = (self.seeing, self.latency) {
            let policy = (query - encoding).max(0.0);
            text.push_str(&format!(
                "\n  a query: {rendering:.1} ms of rendering before it, {query:.1} ms of its own: {encoding:.1} of encoding, \
                 {policy:.1} of policy (medians)"
            ));
        }
        if self.record().time_decides {
            text.push_str("\n  it has a time budget, so these episodes may end differently next time");
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
        let episodes = self.trainings.iter().flat_map(|one| &one.episodes);
        for episode in episodes.filter(|e| group.is_none() || e.group.as_ref() == group) {
            if let Some(word) = &episode.failure {
                *counts.entry(word.as_str()).or_default() += 1;
            }
        }
        counts
    }
}
