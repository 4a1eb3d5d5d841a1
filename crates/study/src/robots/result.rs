//! What came of a training on a test.

use std::collections::BTreeMap;
use std::path::Path;

use serde::{Deserialize, Serialize};
use zoo::entry::{EntryMeta, MODEL_FILE};
use zoo::results::{EntryIdentity, Protocol, Seeds, StoredEvaluation, TrainingFacts};
use zoo::{ZooError, write_atomic};

use super::cells::Cell;
use super::file::{Arm, Data, Study, Test};

/// One training's outcomes on one test, with all that they depend on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CellResult {
    /// Version of this form.
    pub format: u32,
    /// Name of the arm.
    pub arm: String,
    /// The arm as it was.
    pub arm_definition: Arm,
    /// Name of the demonstrations.
    pub data: String,
    /// The demonstrations as they were collected.
    pub data_definition: Data,
    /// Name of the test.
    pub test: String,
    /// The test as it was.
    pub test_definition: Test,
    /// The training's seed.
    pub seed: u64,
    /// sha256 of the resolved experiment without its entry's name, its data's path and its seed.
    pub settings: String,
    /// The entry.
    pub entry: EntryIdentity,
    /// sha256 of its weights, where it has some and that was told.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub weights: Option<String>,
    /// Where it comes from.
    pub training: TrainingFacts,
    /// The rules of the evaluation.
    pub protocol: Protocol,
    /// The episodes' seeds.
    pub seeds: Seeds,
    /// Versions of the simulator and what it stands on.
    pub versions: BTreeMap<String, String>,
    /// Which kernels numpy's linear algebra ran, where that was told.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub kernels: Option<String>,
    /// What drew the policy's pictures, where that was told.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub renderer: Option<String>,
    /// SHA-256 by package of the sources that were imported to simulate, where they were told.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub sources: BTreeMap<String, String>,
    /// Median duration of a query in milliseconds.
    pub query_ms: f64,
    /// Floating-point operations of a query that thinks as long as it may, where they are counted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub query_flops: Option<f64>,
    /// Every episode, by seed.
    pub episodes: Vec<EpisodeOutcome>,
}

/// How an episode ended.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EpisodeOutcome {
    /// Its seed.
    pub seed: u64,
    /// Whether the task was done.
    pub success: bool,
    /// Control steps.
    pub steps: u32,
    /// In a word why it was lost before the cap, where the environment says so.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub failure: Option<String>,
    /// The part of the report that it belongs to.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub group: Option<String>,
    /// Which share of its way it came, where the task has stages.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub progress: Option<f64>,
}

/// sha256 of an entry's weights, where it has some.
fn weights(entry: &EntryMeta) -> Option<String> {
    entry.files.get(MODEL_FILE).map(|file| file.sha256.clone())
}

impl CellResult {
    /// The form that this program writes.
    const FORMAT: u32 = 1;

    /// The result of `evaluation`.
    pub(super) fn new(
        cell: &Cell,
        (arm, data): (&Arm, &Data),
        (test, definition): (&str, &Test),
        settings: String,
        query_flops: Option<f64>,
        entry: &EntryMeta,
        evaluation: &StoredEvaluation,
    ) -> Self {
        let mut times: Vec<f64> = evaluation.timings.iter().flat_map(|t| t.inference_ms.iter().copied()).collect();
        times.sort_by(f64::total_cmp);
        let record = &evaluation.record;
        Self {
            format: Self::FORMAT,
            arm: cell.arm.clone(),
            arm_definition: arm.clone(),
            data: cell.data.clone(),
            data_definition: data.clone(),
            test: test.to_owned(),
            test_definition: definition.clone(),
            seed: cell.seed,
            settings,
            entry: record.entry.clone(),
            weights: weights(entry),
            training: record.training.clone(),
            protocol: record.protocol.clone(),
            seeds: record.seeds,
            versions: record.versions.clone(),
            kernels: record.kernels.clone(),
            renderer: record.renderer.clone(),
            sources: record.sources.clone(),
            query_ms: times.get(times.len() / 2).copied().unwrap_or_default(),
            query_flops,
            episodes: evaluation
                .episodes
                .iter()
                .map(|e| EpisodeOutcome {
                    seed: e.seed,
                    success: e.success,
                    steps: e.steps,
                    failure: e.failure.clone(),
                    group: e.group.clone(),
                    progress: e.progress,
                })
                .collect(),
        }
    }

    /// Whether it is of this cell and test, with experiment, demonstrations and rules as the study has them now.
    pub(super) fn answers(&self, study: &Study, cell: &Cell, test: &str) -> bool {
        let of_cell = (&self.arm, &self.data, self.seed) == (&cell.arm, &cell.data, cell.seed);
        let trained_as =
            |arm: &Arm| (&arm.experiment, &arm.set) == (&self.arm_definition.experiment, &self.arm_definition.set);
        of_cell
            && self.test == test
            && study.arms.get(&cell.arm).is_some_and(trained_as)
            && study.data.get(&cell.data) == Some(&self.data_definition)
            && study.tests.get(test) == Some(&self.test_definition)
    }

    /// Whether it can be told of an entry that is trained again if it is the same.
    pub(super) fn names_its_weights(&self) -> bool {
        self.weights.is_some() || self.training.parameters == 0
    }

    /// Whether it is a result of this entry, or of one with the same weights.
    pub(super) fn is_of(&self, entry: &EntryMeta) -> bool {
        let weights = weights(entry);
        weights.is_none() || weights == self.weights || entry.content_sha256() == self.entry.hash
    }

    /// It with its weights named, where it is of this entry.
    pub(super) fn with_weights_of(self, entry: &EntryMeta) -> Self {
        match entry.content_sha256() == self.entry.hash {
            true => Self { weights: weights(entry), ..self },
            false => self,
        }
    }

    /// Whether two results may be of different weights.
    pub(super) fn may_differ_from(&self, other: &Self) -> bool {
        self.entry.hash != other.entry.hash && (self.weights.is_none() || self.weights != other.weights)
    }

    /// Reads a result; nothing where there is no such file.
    ///
    /// # Errors
    /// A file that cannot be read, or is no result.
    pub fn read(path: &Path) -> Result<Option<Self>, ZooError> {
        let text = match std::fs::read_to_string(path) {
            Ok(text) => text,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            Err(source) => return Err(ZooError::Io { operation: "read", path: path.to_owned(), source }),
        };
        let malformed = |reason: String| ZooError::Malformed { path: path.to_owned(), reason };
        let result: Self = serde_json::from_str(&text).map_err(|e| malformed(e.to_string()))?;
        if result.format != Self::FORMAT {
            return Err(malformed(format!("format: expected {}, found {}", Self::FORMAT, result.format)));
        }
        result.check().map_err(malformed)?;
        Ok(Some(result))
    }

    /// Whether it has every episode of its test and says one thing of each.
    fn check(&self) -> Result<(), String> {
        let test = &self.test_definition;
        let asked = Seeds { start: test.seed_start, count: test.episodes };
        if self.seeds != asked || !self.episodes.iter().map(|episode| episode.seed).eq(asked.iter()) {
            let found = self.episodes.len();
            return Err(format!(
                "episodes: expected one of each seed of {asked}, in order; found {found} that are not these"
            ));
        }
        if self.training.seed != self.seed {
            return Err(format!("training.seed: expected {}, found {}", self.seed, self.training.seed));
        }
        let wrong = |episode: &&EpisodeOutcome| {
            let fits = |progress: f64| (0.0..=1.0).contains(&progress) && (!episode.success || progress == 1.0);
            !episode.progress.is_none_or(fits)
        };
        match self.episodes.iter().find(wrong) {
            Some(episode) => Err(format!("episode {}: its progress does not fit its success", episode.seed)),
            None => Ok(()),
        }
    }

    /// Writes it.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), ZooError> {
        let mut text = serde_json::to_string(self).expect("plain fields are always JSON");
        // a line an episode: small files that a version control system can compare
        text = text.replace("{\"seed\":", "\n{\"seed\":");
        text.push('\n');
        Ok(write_atomic(path, text.as_bytes())?)
    }
}
