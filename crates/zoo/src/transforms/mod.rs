//! `[data]`, and the data transforms: what its settings change between recorded windows and the batch that a policy learns from.
//!
//! A transform is a file here with the checks of its setting and what it does to windows. Another one is its file, its setting in
//! [`DataSection`] and its row in [`TRANSFORMS`]. Training, validation and probes apply all of them in one loop, in the
//! order of the list. Each one draws from a random stream of its own, and a batch depends on seed and step only, so a resumed run
//! needs no state of them. Image augmentation is not here: the image encoder applies it to whole batches (`[policy.vision]`).

mod auxiliary_targets;
mod beginning;
mod grid_path;
mod mirror;
mod mistakes;
mod slices;
mod swap_augmentation;
mod symmetry;

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};

use candle_core::Tensor;
use dataset::{Dataset, DatasetError, MISTAKE, WindowBatch, WindowSpec, Windows};
use models::{Batch, ENTITY_PREFIX, ModelError, Signature};
use serde::{Deserialize, Serialize};

pub(crate) use self::auxiliary_targets::is_auxiliary;
pub use self::beginning::BeginningSection;
use self::slices::Slices;
pub use self::swap_augmentation::SwapSection;
use crate::experiment::{EntitySection, Experiment, GridSection};
use crate::{FeatureKeys, ZooError};

/// All data transforms, in the order in which they are applied.
const TRANSFORMS: &[&dyn Transform] = &[
    &beginning::Beginning,
    &mistakes::Mistakes,
    &auxiliary_targets::AuxiliaryTargets,
    &symmetry::Symmetry,
    &mirror::Mirror,
    &swap_augmentation::SwapAugmentation,
    &grid_path::GridPath,
];

fn is_one(count: &usize) -> bool {
    *count == 1
}

/// `[data]`
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DataSection {
    /// Demonstrations: an HDF5 file or a LeRobotDataset folder. A relative path is looked up in the current folder, in those above it, then in those above the program.
    pub path: String,
    /// Observation keys that make `observation.state`, in order.
    pub state_keys: Vec<String>,
    /// Observation keys that make `observation.environment_state`, in order; may be empty.
    pub env_keys: Vec<String>,
    /// Observation keys that are known in training only, in order; targets of the auxiliary loss (`policy.auxiliary`).
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub auxiliary_keys: Vec<String>,
    /// Objects that get one token each, by name: a list of observation keys, or a table.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub entities: BTreeMap<String, EntitySection>,
    /// Grids by name; every cell gets one token.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub grids: BTreeMap<String, GridSection>,
    /// Items of the lists above that are permuted together in training, by the name of the symmetry.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub symmetries: BTreeMap<String, Vec<String>>,
    /// Mirror augmentation: the sign of every dimension of every item of the lists above, and of `action`, in the mirror. Half of the
    /// training samples are mirrored, images included.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub mirror: BTreeMap<String, Vec<i8>>,
    /// Groups of objects that are swapped in training, by name.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub exchange: BTreeMap<String, SwapSection>,
    /// Sample the first windows of episodes more often in training.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub beginning: Option<BeginningSection>,
    /// Also learn actions that the demonstrations mark as mistakes. Otherwise each stretch between mistakes is learned as an episode
    /// of its own.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub mistakes: bool,
    /// Number of observations that the policy gets at once: the current one and those before it.
    #[serde(skip_serializing_if = "is_one")]
    pub n_obs_steps: usize,
    /// Cameras whose images the policy gets, by the simulator's names.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub cameras: Vec<String>,
    /// Three entities, each a colour. The first channel of every image is then the amount of the first entity's colour in a pixel, and
    /// so on. Empty: red, green and blue.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub picture_colours: Vec<String>,
    /// Mask of the episodes to train on. With "", or in a data set without masks, all episodes.
    pub train_mask: String,
    /// Mask of the episodes to validate on; "" for none.
    pub valid_mask: String,
}

impl Default for DataSection {
    fn default() -> Self {
        let owned = |keys: &[&str]| keys.iter().map(|k| (*k).to_owned()).collect();
        Self {
            path: String::new(),
            state_keys: owned(&["robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos"]),
            env_keys: owned(&["object"]),
            auxiliary_keys: Vec::new(),
            entities: BTreeMap::new(),
            grids: BTreeMap::new(),
            symmetries: BTreeMap::new(),
            mirror: BTreeMap::new(),
            exchange: BTreeMap::new(),
            beginning: None,
            mistakes: false,
            n_obs_steps: 1,
            cameras: Vec::new(),
            picture_colours: Vec::new(),
            train_mask: "train".to_owned(),
            valid_mask: "valid".to_owned(),
        }
    }
}

/// What batches are made for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stage {
    /// The training step of this number.
    Training(u64),
    /// A validation, which sees the windows as they were recorded.
    Validation,
    /// A probe; the number takes the place of the step in random draws.
    Probe(u64),
}

/// A data transform, before its data is there.
trait Transform: Sync {
    /// Its setting: the key of `[data]`.
    fn name(&self) -> &'static str;

    /// A column of its own beside the features: the name, as an entity's, and the keys that it is made of.
    fn column<'d>(&self, _data: &'d DataSection) -> Option<(&'static str, &'d Vec<String>)> {
        None
    }

    /// Lists of observation items that its setting names, with the key of each list.
    fn items<'d>(&self, _data: &'d DataSection) -> Vec<(String, &'d Vec<String>)> {
        Vec::new()
    }

    /// Refuses a setting that does not fit the experiment. `known` are the items of all features.
    fn check(&self, _experiment: &Experiment, _known: &[String]) -> Result<(), ZooError> {
        Ok(())
    }

    /// Changes which windows are made of the episodes.
    fn select(&self, _data: &DataSection, _windows: &mut WindowSpec) {}

    /// Finds its items in the data set; `None` where the experiment does not use it.
    fn fit(&self, _source: &Source<'_>) -> Result<Option<Box<dyn Fitted>>, ZooError> {
        Ok(None)
    }
}

/// A data transform of a run.
trait Fitted: Send + Sync {
    /// Whether it is applied there.
    fn applies(&self, stage: Stage) -> bool {
        matches!(stage, Stage::Training(_))
    }

    /// The windows of an epoch by number, each as often as it is drawn; `None` leaves them as they are.
    fn draws(&self, _episodes: &[Range<u32>]) -> Option<Vec<u32>> {
        None
    }

    /// Changes gathered windows, each on its own. `step` decides random draws.
    fn apply(&self, _step: u64, _windows: &mut WindowBatch) {}

    /// Adds targets to the batch that was made of the windows.
    fn targets(&self, _windows: &WindowBatch, _batch: &mut Batch) -> Result<(), ModelError> {
        Ok(())
    }
}

/// What transforms are fitted to.
pub(crate) struct Source<'a> {
    pub experiment: &'a Experiment,
    pub dataset: &'a Dataset,
    /// Of the data set, for messages.
    pub path: &'a Path,
    /// The windows of training.
    pub windows: &'a Windows,
    /// Statistics of the training episodes by column.
    pub statistics: &'a BTreeMap<String, Tensor>,
    pub signature: &'a Signature,
}

impl Source<'_> {
    /// The places of all items in the data set's columns, for the transform of this name.
    fn slices(&self, name: &str) -> Result<Slices, ZooError> {
        Slices::new(self.experiment, self.dataset, self.path, &format!("data.{name}"))
    }

    /// The windows of each demonstration, for the transform of this name, which needs demonstrations as a whole.
    ///
    /// # Errors
    /// Marked mistakes that are not learned: windows are those of the stretches between them.
    fn demonstrations(&self, name: &str) -> Result<Vec<Range<u32>>, ZooError> {
        let marked = self.dataset.column(MISTAKE).is_some_and(|marks| marks.data.iter().any(|mark| *mark != 0.0));
        if marked && !self.experiment.data.mistakes {
            let reason = format!(
                "data.{name}: expected demonstrations without marked mistakes, at which they are cut; set \
                 data.mistakes=true"
            );
            return Err(ZooError::UnfitData { path: self.path.to_owned(), reason });
        }
        Ok(self.windows.episodes())
    }

    /// The windows of these numbers.
    fn gather(&self, windows: &[u32], batch: &mut WindowBatch) -> Result<(), ZooError> {
        self.windows.try_gather(windows, batch).map_err(unreadable(&self.path.display().to_string()))
    }
}

/// Images of a data set that could be decoded and cannot be read any more.
pub(crate) fn unreadable(name: &str) -> impl FnOnce(DatasetError) -> ZooError + use<> {
    let path = PathBuf::from(name);
    move |source| ZooError::Dataset { path, source: Box::new(source) }
}

/// The transforms of a run, fitted to its data.
pub struct Transforms(Vec<Box<dyn Fitted>>);

impl Transforms {
    /// Fits those that the experiment uses.
    ///
    /// # Errors
    /// Items that the data set's columns do not have; windows that cannot be read.
    pub(crate) fn fit(source: &Source<'_>) -> Result<Self, ZooError> {
        let fitted = TRANSFORMS.iter().filter_map(|transform| transform.fit(source).transpose());
        fitted.collect::<Result<_, _>>().map(Self)
    }

    /// The windows of an epoch by number, each as often as it is drawn; `None`: every window once.
    pub(crate) fn draws(&self, episodes: &[Range<u32>]) -> Option<Vec<u32>> {
        self.0.iter().find_map(|transform| transform.draws(episodes))
    }

    fn of(&self, stage: Stage) -> impl Iterator<Item = &dyn Fitted> {
        self.0.iter().map(Box::as_ref).filter(move |transform| transform.applies(stage))
    }

    /// Changes gathered windows.
    pub fn apply(&self, stage: Stage, windows: &mut WindowBatch) {
        let (Stage::Training(step) | Stage::Probe(step)) = stage else { return };
        self.of(stage).for_each(|transform| transform.apply(step, windows));
    }

    /// Adds targets to the batch that was made of the windows.
    ///
    /// # Errors
    /// When a tensor cannot be made.
    pub(crate) fn targets(&self, stage: Stage, windows: &WindowBatch, batch: &mut Batch) -> Result<(), ModelError> {
        self.of(stage).try_for_each(|transform| transform.targets(windows, batch))
    }
}

/// Refuses settings of transforms that do not fit the experiment.
pub(crate) fn check(experiment: &Experiment) -> Result<(), ZooError> {
    let data = &experiment.data;
    let keys = data.all_keys()?;
    let known: Vec<String> = keys.features().flat_map(|feature| keys.of(feature)).collect();
    for (key, items) in TRANSFORMS.iter().flat_map(|transform| transform.items(data)) {
        let invalid =
            |expected: String, found: String| Err(ZooError::InvalidValue { key: key.clone(), expected, found });
        if items.is_empty() {
            return invalid("at least one item".to_owned(), "none".to_owned());
        }
        if let Some(item) = items.iter().find(|item| !known.contains(item)) {
            return invalid(format!("items of the lists of keys: {}", known.join(", ")), format!("`{item}`"));
        }
    }
    TRANSFORMS.iter().try_for_each(|transform| transform.check(experiment, &known))
}

/// Changes which windows are made of the episodes.
pub(crate) fn select(data: &DataSection, windows: &mut WindowSpec) {
    TRANSFORMS.iter().for_each(|transform| transform.select(data, windows));
}

impl DataSection {
    /// The columns beside those that every data set has: the setting, the name as an entity's, and the keys of each.
    pub(crate) fn columns(&self) -> impl Iterator<Item = (String, &str, &Vec<String>)> {
        let entities = self.entities.iter();
        let entities = entities.map(|(name, entity)| (format!("data.entities.{name}"), name.as_str(), &entity.keys));
        let own = |transform: &&dyn Transform| {
            let (name, keys) = transform.column(self)?;
            Some((format!("data.{}", transform.name()), name, keys))
        };
        entities.chain(TRANSFORMS.iter().filter_map(own))
    }

    /// [`Self::feature_keys`], and the columns of transforms as if they were entities.
    ///
    /// # Errors
    /// The setting whose keys cannot be read.
    pub(crate) fn all_keys(&self) -> Result<FeatureKeys, ZooError> {
        let mut keys = self.feature_keys()?;
        for transform in TRANSFORMS {
            let Some((name, items)) = transform.column(self) else { continue };
            keys.insert(&format!("{ENTITY_PREFIX}{name}"), items).map_err(|found| ZooError::InvalidValue {
                key: format!("data.{}", transform.name()),
                expected: "observation keys, parts of them (key[0:3]) and differences (a - b)".to_owned(),
                found,
            })?;
        }
        Ok(keys)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::config::Library;

    #[test]
    fn every_transform_has_a_setting() {
        let experiment = Experiment::load(&Library::built_in(), "act_lift", &[]).unwrap();
        for transform in TRANSFORMS {
            let table = format!("data = {{ {} = 'neither' }}", transform.name());
            let table: toml::Table = toml::from_str(&table).unwrap();
            let mut whole: toml::Table = toml::from_str(&experiment.to_toml()).unwrap();
            whole["data"].as_table_mut().unwrap().extend(table["data"].as_table().unwrap().clone());
            let error = Experiment::from_table(whole).unwrap_err().to_string();
            assert!(error.contains(&format!("`data.{}`", transform.name())) && !error.contains("unknown"), "{error}");
        }
    }

    /// Appends the step as a digit to the first action, also for probes where it says so.
    struct Appends {
        probed: bool,
    }

    impl Fitted for Appends {
        fn applies(&self, stage: Stage) -> bool {
            matches!(stage, Stage::Training(_)) || self.probed && matches!(stage, Stage::Probe(_))
        }

        fn apply(&self, step: u64, windows: &mut WindowBatch) {
            windows.actions[0] = windows.actions[0] * 10.0 + step as f32;
        }
    }

    #[test]
    fn transforms_are_applied_in_order_where_they_belong() {
        let transforms = Transforms(vec![Box::new(Appends { probed: false }), Box::new(Appends { probed: true })]);
        let after = |stage: Stage| {
            let mut windows = WindowBatch { actions: vec![1.0], ..WindowBatch::default() };
            transforms.apply(stage, &mut windows);
            windows.actions[0]
        };
        assert_eq!(after(Stage::Training(3)), 133.0);
        assert_eq!(after(Stage::Probe(5)), 15.0);
        assert_eq!(after(Stage::Validation), 1.0, "as it was recorded");
        assert_eq!(transforms.draws(&[0..3, 3..5]), None);
    }
}
