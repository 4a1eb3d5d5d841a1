//! The door to the puzzles: what an experiment or an entry of either kind can do, for those who do not care which kind it is.
//!
//! `[task] puzzle = "dfs10"` distinguishes an experiment on puzzles from one on a robot task.

use std::path::{Path, PathBuf};

use models::{DeviceChoice, Precision};
use zoo::ZooError;
use zoo::config::{Library, apply_overrides};
use zoo::entry::Entry;
use zoo::experiment::Experiment;
use zoo::run::{Place, TrainEvent, TrainOutcome, TrainRequest, train};

use super::entry::SOLVER;
use super::experiment::PuzzleExperiment;
use super::training::{PuzzleTrainRequest, train_puzzles};

/// Whether the entry solves puzzles. All others are for the zoo alone.
pub fn is_solver(entry: &Entry) -> bool {
    let meta = entry.meta();
    // entries from before kinds were named have the section alone
    meta.kind.as_deref().map_or(meta.section.is_some(), |kind| kind == SOLVER)
}

/// An experiment of any kind.
#[derive(Debug, Clone, PartialEq)]
pub struct AnyExperiment(Kind);

#[derive(Debug, Clone, PartialEq)]
enum Kind {
    /// A robot policy from demonstrations.
    Robot(Box<Experiment>),
    /// A puzzle solver from puzzles with their answers.
    Puzzle(Box<PuzzleExperiment>),
}

/// What an experiment trains, in words for a table.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Summary {
    /// The policy, or the kind of solver.
    pub policy: String,
    /// The robot task, or the family of puzzles.
    pub task: String,
    /// What the policy gets.
    pub inputs: String,
}

/// How to train, whatever the experiment is.
#[derive(Debug, Clone)]
pub struct TrainOptions {
    /// Where, and as which experiment.
    pub place: Place,
    /// Demonstrations instead of the experiment's.
    pub data: Option<PathBuf>,
    /// Train on demonstrations of another task anyway.
    pub force: bool,
    /// Bytes of memory for images; `None`: half of what is free.
    pub image_memory: Option<u64>,
    /// Where it trains.
    pub device: DeviceChoice,
}

impl AnyExperiment {
    /// Resolves experiment `name` of `library` with dotted `overrides` laid over it.
    ///
    /// # Errors
    /// Unknown experiments, keys and values; combinations that cannot work.
    pub fn load(library: &Library, name: &str, overrides: &[String]) -> Result<Self, ZooError> {
        let mut table = library.resolve(name)?;
        apply_overrides(&mut table, overrides)?;
        let is_puzzle = table.get("task").and_then(|task| task.get("puzzle")).is_some();
        Ok(Self(match is_puzzle {
            true => Kind::Puzzle(Box::new(PuzzleExperiment::from_table(table)?)),
            false => Kind::Robot(Box::new(Experiment::load(library, name, overrides)?)),
        }))
    }

    /// The experiment on puzzles, if it is one.
    pub fn puzzle(self) -> Option<PuzzleExperiment> {
        match self.0 {
            Kind::Puzzle(experiment) => Some(*experiment),
            Kind::Robot(_) => None,
        }
    }

    /// The resolved experiment as TOML.
    pub fn to_toml(&self) -> String {
        match &self.0 {
            Kind::Robot(experiment) => experiment.to_toml(),
            Kind::Puzzle(experiment) => experiment.to_toml(),
        }
    }

    /// Name of the entry that training makes.
    pub fn entry(&self) -> &str {
        match &self.0 {
            Kind::Robot(experiment) => &experiment.entry,
            Kind::Puzzle(experiment) => &experiment.entry,
        }
    }

    /// One sentence on it.
    pub fn description(&self) -> &str {
        match &self.0 {
            Kind::Robot(experiment) => &experiment.description,
            Kind::Puzzle(experiment) => &experiment.description,
        }
    }

    /// What the experiment, which is called `name`, trains.
    pub fn summary(&self, name: &str) -> Summary {
        match &self.0 {
            Kind::Robot(one) => {
                let data = &one.data;
                let objects = !data.entities.is_empty() || !data.grids.is_empty();
                let kinds = [(!data.cameras.is_empty(), "images"), (objects, "objects"), (true, "state")];
                let inputs: Vec<&str> = kinds.into_iter().filter(|(given, _)| *given).map(|(_, kind)| kind).collect();
                Summary { policy: one.policy_type(), task: one.task.name.clone(), inputs: inputs.join(", ") }
            }
            Kind::Puzzle(one) => Summary {
                policy: name.split('_').next().unwrap_or_default().to_owned(),
                task: one.task.puzzle.clone(),
                inputs: "puzzle".to_owned(),
            },
        }
    }

    /// The command that collects the demonstrations it expects, as far as it says which; puzzles need none.
    pub fn collect(&self) -> Option<String> {
        let Kind::Robot(one) = &self.0 else { return None };
        let data = &one.data;
        let out = if data.path.is_empty() { "demos.hdf5" } else { &data.path };
        let stem = Path::new(out).file_stem().and_then(|stem| stem.to_str()).unwrap_or_default();
        // experiments name their files so: stack.hdf5, stack-recoveries.hdf5
        let expert = stem.rsplit_once('-').map_or(String::new(), |(_, expert)| format!(" --expert {expert}"));
        let cameras = match data.cameras.is_empty() {
            true => String::new(),
            false => format!(" --cameras {} --image-size 84 --fast-render --no-next-obs", data.cameras.join(",")),
        };
        Some(format!("actrm-data collect --task {} --episodes 200{expert}{cameras} --out {out}", one.task.name))
    }

    /// The demonstrations that it is trained on unless others are named; puzzles take none.
    pub fn data(&self) -> Option<&Path> {
        match &self.0 {
            Kind::Robot(experiment) => Some(Path::new(&experiment.data.path)),
            Kind::Puzzle(_) => None,
        }
    }

    /// Trains it, or resumes its training.
    ///
    /// # Errors
    /// As [`train`] and [`train_puzzles`].
    pub fn train(
        self,
        options: TrainOptions,
        stop: &dyn Fn() -> bool,
        on_event: &mut dyn FnMut(TrainEvent<'_>),
    ) -> Result<TrainOutcome, ZooError> {
        let TrainOptions { place, data, force, image_memory, device } = options;
        let Place { name, runs, run, resume, zoo, command } = place;
        match self.0 {
            Kind::Robot(experiment) => {
                let (experiment, from_zoo) = (*experiment, None);
                let request = TrainRequest {
                    name,
                    experiment,
                    data,
                    runs,
                    run,
                    resume,
                    zoo,
                    from_zoo,
                    force,
                    image_memory,
                    command,
                    device,
                };
                train(&request, stop, on_event)
            }
            Kind::Puzzle(_) if matches!(device, DeviceChoice::Cuda(_)) => Err(ZooError::InvalidValue {
                key: "--device".to_owned(),
                expected: "cpu: puzzle solvers train on the CPU".to_owned(),
                found: device.to_string(),
            }),
            Kind::Puzzle(experiment) if experiment.train.precision != Precision::F32 => Err(ZooError::InvalidValue {
                key: "train.precision".to_owned(),
                expected: "f32: puzzle solvers train on the CPU".to_owned(),
                found: format!("{:?}", experiment.train.precision).to_lowercase(),
            }),
            Kind::Puzzle(experiment) => {
                let experiment = *experiment;
                let request = PuzzleTrainRequest { name, experiment, runs, run, resume, zoo, command };
                train_puzzles(&request, stop, on_event)
            }
        }
    }
}
