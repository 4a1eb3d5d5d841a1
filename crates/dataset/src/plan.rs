//! What is in a file or folder of demonstrations, before any of it is read.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::error::InputError;
use crate::sorted_map::SortedMap;
use crate::tree::Dtype;

/// Whose layout a file follows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum Dialect {
    /// robomimic of any generation, and everything that writes the same tree.
    Robomimic,
    /// robosuite's own recordings: states and actions, no observations.
    RobosuiteRaw,
    /// LIBERO.
    Libero,
    /// robocasa.
    Robocasa,
    /// MimicGen.
    Mimicgen,
    /// Isaac Lab, with Mimic or without.
    IsaacLab,
    /// BEHAVIOR and whatever else OmniGibson records.
    Behavior,
    /// ManiSkill: `trajectory.h5` with a JSON file beside it.
    Maniskill,
    /// RoboTwin: one file per episode.
    Robotwin,
    /// DROID as it was recorded: one `trajectory.h5` per episode.
    Droid,
    /// D4RL: one run of steps, cut into episodes at terminals and timeouts.
    D4rl,
    /// ALOHA and ACT: one file per episode.
    Aloha,
    /// A zarr replay buffer, as Diffusion Policy and UMI record it.
    Zarr,
    /// RLDS, as `tensorflow-datasets` stores it.
    Rlds,
}

impl Dialect {
    /// The name for people.
    pub fn name(self) -> &'static str {
        match self {
            Self::Robomimic => "robomimic",
            Self::RobosuiteRaw => "raw robosuite",
            Self::Libero => "LIBERO",
            Self::Robocasa => "robocasa",
            Self::Mimicgen => "MimicGen",
            Self::IsaacLab => "Isaac Lab",
            Self::Behavior => "BEHAVIOR",
            Self::Maniskill => "ManiSkill",
            Self::Robotwin => "RoboTwin",
            Self::Droid => "DROID",
            Self::D4rl => "D4RL",
            Self::Aloha => "ALOHA",
            Self::Zarr => "zarr replay buffer",
            Self::Rlds => "RLDS",
        }
    }

    /// Whether a layout of this name has robomimic's tree: `data/demo_<k>` with what it needs.
    pub(crate) fn is_robomimics(name: &str) -> bool {
        let tree = [
            Self::Robomimic,
            Self::RobosuiteRaw,
            Self::Libero,
            Self::Robocasa,
            Self::Mimicgen,
            Self::IsaacLab,
            Self::Behavior,
        ];
        tree.iter().any(|dialect| dialect.name() == name)
    }

    /// Whether it was recorded without a simulator's rewards and ends, which nobody misses in it.
    pub(crate) fn is_a_recording(self) -> bool {
        matches!(
            self,
            Self::Zarr
                | Self::Rlds
                | Self::Aloha
                | Self::Robotwin
                | Self::Droid
                | Self::Maniskill
                | Self::IsaacLab
                | Self::Behavior
        )
    }

    /// How a recording without observations gets them.
    pub(crate) fn observe(self) -> &'static str {
        match self {
            Self::RobosuiteRaw => "this is a raw robosuite recording; run `actrm-data extract` on it first",
            Self::Behavior => "replay it with OmniGibson's DataPlaybackWrapper, which writes them",
            Self::Maniskill => {
                "replay it with `python -m mani_skill.trajectory.replay_trajectory -o state --save-traj`"
            }
            _ => "record it again with observations",
        }
    }

    /// Frames a second of recordings that do not state them: what the recorder does unless it is told otherwise.
    pub(crate) fn usual_fps(self) -> Option<f64> {
        match self {
            Self::Aloha | Self::Robotwin => Some(50.0),
            Self::Maniskill => Some(20.0),
            Self::Droid => Some(15.0),
            Self::Zarr | Self::Rlds => Some(10.0),
            _ => None,
        }
    }

    /// The format of its files.
    pub fn format(self) -> &'static str {
        match self {
            Self::Zarr => "zarr",
            Self::Rlds => "TFRecord",
            _ => "HDF5",
        }
    }
}

/// What a file or folder holds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Plan {
    /// The file or folder.
    pub path: PathBuf,
    /// Every file that is read, with its size in bytes; one unless the source is a folder.
    pub files: Vec<(PathBuf, u64)>,
    /// Whose layout it is.
    pub dialect: Dialect,
    /// The demos in numeric order.
    pub demos: Vec<DemoPlan>,
    /// `env_args` as JSON, where the file has it and it parses.
    pub env_args: Option<serde_json::Value>,
    /// Environment name, from `env_args` or the dialect's own place.
    pub env_name: Option<String>,
    /// Simulator generation, where the file states it.
    pub env_version: Option<String>,
    /// Filter keys: mask name to demo ids, in stored order.
    pub masks: BTreeMap<String, Vec<String>>,
    /// Text attributes of the file and of its data group (`/date`, `data/env_args`), as stored.
    pub texts: BTreeMap<String, String>,
    /// Facts worth knowing that are no fault: camera orientation, a dropped tail.
    pub notes: Vec<String>,
    /// Everything that is wrong. What is fatal is refused by `read_demo`; a demo that is named here and not among
    /// `demos` cannot be opened.
    pub problems: Vec<Problem>,
}

impl Plan {
    /// Everything but the demos, to be sent.
    pub(crate) fn without_demos(&self) -> impl Serialize {
        #[derive(Serialize)]
        struct Rest<'a> {
            path: &'a PathBuf,
            files: &'a [(PathBuf, u64)],
            dialect: Dialect,
            demos: [(); 0],
            env_args: &'a Option<serde_json::Value>,
            env_name: &'a Option<String>,
            env_version: &'a Option<String>,
            masks: &'a BTreeMap<String, Vec<String>>,
            texts: &'a BTreeMap<String, String>,
            notes: &'a [String],
            problems: &'a [Problem],
        }
        let Self { path, files, dialect, demos: _, env_args, env_name, env_version, masks, texts, notes, problems } =
            self;
        let dialect = *dialect;
        Rest { path, files, dialect, demos: [], env_args, env_name, env_version, masks, texts, notes, problems }
    }

    /// Steps of all demos together.
    pub fn frames(&self) -> usize {
        self.demos.iter().fold(0, |frames, demo| frames.saturating_add(demo.length))
    }

    /// Demos that the source names and that cannot be opened at all, by id, and why.
    pub fn lost(&self) -> impl Iterator<Item = (&str, &InputError)> {
        let positions = self.positions();
        let lost = move |p: &'_ &Problem| p.fatal && p.demo.as_deref().is_some_and(|id| !positions.contains_key(id));
        self.problems.iter().filter(lost).filter_map(|p| Some((p.demo.as_deref()?, &p.error)))
    }

    /// Why a dataset of a demo cannot be read, where it is there and cannot.
    pub fn unreadable(&self, demo: &DemoPlan, key: &str) -> Option<&InputError> {
        let found = self.problems.iter().find(|p| {
            p.fatal
                && p.key.as_deref() == Some(key)
                && p.demo.as_ref().is_none_or(|id| *id == demo.id)
                && !demo.keys.contains_key(key)
        });
        found.map(|p| &p.error)
    }

    /// Datasets that some demos have and that cannot be read there, and what to say of each; `from` says where else they are
    /// left out.
    pub(crate) fn left_out(&self, from: &str) -> (Vec<String>, Vec<String>) {
        let mut found: BTreeMap<&str, (usize, String)> = BTreeMap::new();
        for demo in &self.demos {
            let mine = |p: &&Problem| p.fatal && p.demo.as_ref().is_none_or(|id| *id == demo.id);
            let keys: BTreeSet<&str> = self.problems.iter().filter(mine).filter_map(|p| p.key.as_deref()).collect();
            for key in keys {
                if let Some(error) = self.unreadable(demo, key) {
                    found.entry(key).or_insert_with(|| (0, error.to_string())).0 += 1;
                }
            }
        }
        let demos = self.demos.len();
        let note = |(key, (count, error)): (&&str, &(usize, String))| {
            format!("{key} is left out in {count} of {demos} demos{from}: {error}")
        };
        (found.keys().map(|key| (*key).to_owned()).collect(), found.iter().map(note).collect())
    }

    /// Positions of the demos by id.
    pub(crate) fn positions(&self) -> HashMap<&str, usize> {
        self.demos.iter().enumerate().rev().map(|(at, demo)| (demo.id.as_str(), at)).collect()
    }

    /// Position of the demo with this id.
    pub fn position(&self, id: &str) -> Option<usize> {
        self.demos.iter().position(|d| d.id == id)
    }
}

/// Begins the names of the environment's arguments in messages.
pub(crate) const ENV_KWARGS: &str = "env_args.env_kwargs.";

/// What is said of an argument of the environment in which the files of a folder differ.
pub(crate) fn at_odds<'p>(problems: &'p [Problem], argument: &str) -> Option<&'p InputError> {
    let of = |error: &InputError| match error {
        InputError::BadAttribute { attribute, .. } => attribute.strip_prefix(ENV_KWARGS) == Some(argument),
        _ => false,
    };
    problems.iter().map(|problem| &problem.error).find(|error| of(error))
}

/// One demo, unread.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DemoPlan {
    /// `demo_12`; kept as stored.
    pub id: String,
    /// The number in the id, which gives the order.
    pub number: u64,
    /// Steps.
    pub length: usize,
    /// Datasets by path below the demo.
    pub keys: SortedMap<KeyPlan>,
    /// Names of the attributes of the demo's group.
    pub attr_names: Vec<String>,
    /// The instruction in words, where the file has one for this demo.
    pub task: Option<String>,
}

/// One dataset of a demo, unread.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct KeyPlan {
    /// Element type.
    pub dtype: Dtype,
    /// Shape as the demo sees it: the first axis is time for everything that has the demo's length.
    pub shape: Box<[usize]>,
    /// Reading rows in multiples of this many avoids decoding a stored block twice; 1 if it does not matter.
    pub block_rows: usize,
    /// Where the elements are.
    pub place: Place,
}

impl KeyPlan {
    /// Rows `first .. first + count` of the same dataset.
    pub(crate) fn part(mut self, first: usize, count: usize) -> Self {
        let row = self.dtype.size().unwrap_or(0) * self.shape.iter().skip(1).product::<usize>();
        self.place.first_row += first;
        self.place.offset = self.place.offset.map(|at| at + (first * row) as u64);
        if let Some(rows) = self.shape.first_mut() {
            *rows = count;
        }
        self
    }

    /// Bytes once read; `None` where the size is not known beforehand.
    pub fn bytes(&self) -> Option<u64> {
        let size = self.dtype.size()? as u64;
        self.shape.iter().try_fold(size, |n, &extent| n.checked_mul(extent as u64))
    }

    /// Whether each step is an image: 8-bit, height x width x channels.
    pub fn is_image(&self) -> bool {
        self.dtype == Dtype::U8 && self.shape.len() == 4 && matches!(self.shape[3], 1 | 3 | 4)
    }
}

/// Where the elements of a dataset are.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Place {
    /// Index into [`Plan::files`].
    pub file: usize,
    /// Absolute path of the dataset in that file.
    pub path: Box<str>,
    /// First row that belongs to the demo (0 unless several demos share a dataset).
    pub first_row: usize,
    /// Position in the file of the demo's first element, where they lie there as they are in memory.
    pub offset: Option<u64>,
    /// What is read together with it.
    #[serde(default)]
    pub join: Option<Box<Join>>,
}

/// Datasets of the same file that make one with another.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub enum Join {
    /// The first row is the only one of this dataset; the rows of the other follow.
    Before(Box<str>),
    /// Each row goes on with that of each of these.
    Beside(Vec<Box<str>>),
}

impl Problem {
    pub(crate) fn new(demo: Option<&str>, key: Option<&str>, fatal: bool, error: InputError) -> Self {
        let (demo, key) = (demo.map(str::to_owned), key.map(str::to_owned));
        Self { demo, key, fatal, message: error.to_string(), error }
    }

    /// A demo of no steps, which nothing can be made of.
    pub(crate) fn empty(path: &Path, id: &str, key: &str) -> Self {
        let error = InputError::WrongLength {
            path: path.to_owned(),
            demo: id.to_owned(),
            key: key.to_owned(),
            expected: "at least 1".to_owned(),
            found: "0: the demo is empty".to_owned(),
        };
        Self::new(Some(id), None, true, error)
    }
}

/// Something wrong with a source.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Problem {
    /// The demo it concerns, if one.
    pub demo: Option<String>,
    /// The dataset of the demo it concerns, if one.
    pub key: Option<String>,
    /// Whether reading the demo is refused because of it (where a dataset is named: reading that dataset).
    pub fatal: bool,
    /// What, where, expected, found.
    pub message: String,
    /// The same, for programs: what reading would answer.
    pub error: InputError,
}
