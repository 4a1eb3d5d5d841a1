//! Policies: entries of a zoo and checkpoints of LeRobot's, asked from Python.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError, TryLockError};

use interchange::lerobot::{ImportOptions, exported_task, import};
use models::{
    ActionChunk, Actor, Backend, DeviceChoice, FeatureKind, FeatureSpec, ModelError, Observation, Policy, Values,
};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyMapping, PyTuple};
use rustix::process::{Pid, getpid};
use zoo::ZooError;
use zoo::conventions::Conventions;
use zoo::entry::LoadedEntry;
use zoo::evaluation::acting;
use zoo::registry::Registry;
use zoo::results::Execution;

use crate::arrays::{array, numpy, read, readable};
use crate::error::{Error, named, natural, raised};
use crate::work::{Inside, run, unlocked};

/// The most rows of a batch of observations, each with a policy's state of its own.
const MOST_ROWS: usize = 1 << 16;

/// A trained policy: an entry of a zoo, or a checkpoint of LeRobot's. Made by `load_policy`.
///
/// Observations are dicts with LeRobot's keys, in the units of the data. `observation.state` and the others are arrays
/// or what numpy converts to arrays, or tensors; a feature of one number needs no axis of it. Images are 0 to 255 (uint8)
/// or 0 to 1 (float), channels first or last. Further keys are ignored. A leading axis makes a batch, in which each row
/// is an episode of its own. Actions are in the units of the data: nothing has to be normalised before or after.
///
/// `select_action` and `predict_action_chunk` each keep the state of their own episode: past observations and, with a
/// warm start, the previous chunk. `reset` clears both. A policy may be used from several threads, one after the other.
#[pyclass(frozen, module = "actrm", name = "Policy")]
pub(crate) struct PyPolicy {
    /// What loads it again.
    path: PathBuf,
    loaded: LoadedEntry,
    execution: Execution,
    /// Locked for a moment only, by who has Python's lock, so that a fork never finds it locked.
    episodes: Mutex<(Pid, Arc<Episodes>)>,
}

/// What it keeps of its episodes.
struct Episodes {
    acting: Mutex<Rows<Box<dyn Actor>>>,
    predicting: Mutex<Rows<Predicting>>,
}

impl Episodes {
    fn new() -> Arc<Self> {
        Arc::new(Self { acting: Mutex::new(Rows::new()), predicting: Mutex::new(Rows::new()) })
    }
}

/// A policy and whether it was asked before in its episode.
struct Predicting {
    policy: Box<dyn Policy>,
    asked: bool,
}

/// What each row of a batch keeps.
struct Rows<T> {
    seeds: Seeds,
    rows: Vec<T>,
}

/// The seeds of the rows' episodes.
#[derive(Clone)]
enum Seeds {
    /// Of the first; the others count up from it.
    First(u64),
    Each(Vec<u64>),
}

/// The argument `seed` of `reset`.
#[derive(FromPyObject)]
enum Seed {
    First(i128),
    Each(Vec<i128>),
}

impl TryFrom<Seed> for Seeds {
    type Error = PyErr;

    fn try_from(seed: Seed) -> PyResult<Self> {
        let one = |seed| natural("seed", seed);
        match seed {
            Seed::First(seed) => one(seed).map(Self::First),
            Seed::Each(seeds) => seeds.into_iter().map(one).collect::<PyResult<_>>().map(Self::Each),
        }
    }
}

impl Seeds {
    fn of(&self, row: usize) -> Result<u64, PyErr> {
        match self {
            Self::First(seed) => Ok(seed.wrapping_add(row as u64)),
            Self::Each(seeds) => seeds.get(row).copied().ok_or_else(|| {
                PyValueError::new_err(format!("seed: expected one for each row, found {} seeds", seeds.len()))
            }),
        }
    }
}

impl<T> Rows<T> {
    fn new() -> Self {
        Self { seeds: Seeds::First(0), rows: Vec::new() }
    }

    /// Makes sure that there are so many; `make` begins the episode of a seed.
    fn grow(&mut self, rows: usize, make: impl Fn(u64) -> PyResult<T>) -> PyResult<&mut [T]> {
        while self.rows.len() < rows {
            self.rows.push(make(self.seeds.of(self.rows.len())?)?);
        }
        Ok(&mut self.rows[..rows])
    }
}

/// What a policy is asked with.
struct Asked {
    /// Rows; nothing for one observation without an axis of them.
    batch: Option<usize>,
    observations: Vec<Observation>,
}

#[pymethods]
impl PyPolicy {
    /// Begins an episode and clears the last one. Random draws of a policy depend on the seed only; row `i` of a batch has
    /// the seed `seed + i`, or the `i`-th of a list.
    #[pyo3(signature = (seed=None))]
    fn reset(&self, py: Python<'_>, seed: Option<Seed>) -> PyResult<()> {
        let seeds = seed.map_or(Ok(Seeds::First(0)), Seeds::try_from)?;
        let episodes = self.episodes(py);
        unlocked(py, || {
            *lock(&episodes.acting) = Rows { seeds: seeds.clone(), rows: Vec::new() };
            *lock(&episodes.predicting) = Rows { seeds, rows: Vec::new() };
            Ok(())
        })
    }

    /// The action to execute now: (action_dim,), or (rows, action_dim) for a batch. Queries the network when the actions
    /// that were planned are used up, as the entry's evaluations do.
    fn select_action<'py>(&self, py: Python<'py>, observation: &Bound<'py, PyMapping>) -> PyResult<Bound<'py, PyAny>> {
        let (asked, episodes) = (self.asked(observation)?, self.episodes(py));
        let actions = unlocked(py, || {
            let mut rows = lock(&episodes.acting);
            let rows = rows.grow(asked.observations.len(), |seed| {
                let mut actor = acting(self.loaded.policy(), self.execution).map_err(raised)?;
                actor.reset(seed);
                Ok(actor)
            })?;
            let act = |(actor, seen): (&mut Box<dyn Actor>, _)| {
                let action = actor.act(seen).map_err(raised)?;
                finite(&action, seen).map(|()| action)
            };
            run(|| rows.iter_mut().zip(&asked.observations).map(act).collect::<PyResult<Vec<_>>>())
        })?;
        let width = self.loaded.preprocess().signature().action_dim;
        array(py, &shape(asked.batch, &[width]), &actions.concat())
    }

    /// The predicted actions from now on: (action_horizon, action_dim), or (rows, action_horizon, action_dim) for a batch.
    /// A policy with past observations (`n_obs_steps`) needs those between two calls by `observe`. `executed`: how many
    /// actions of the last chunk were executed since, for a policy with a warm start; unless given, as many as the
    /// entry's evaluations execute.
    #[pyo3(signature = (observation, executed=None))]
    fn predict_action_chunk<'py>(
        &self,
        py: Python<'py>,
        observation: &Bound<'py, PyMapping>,
        executed: Option<i128>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let executed = executed.map_or_else(|| Ok(self.n_action_steps()), |executed| natural("executed", executed))?;
        let (asked, episodes) = (self.asked(observation)?, self.episodes(py));
        let chunks = unlocked(py, || {
            let mut rows = lock(&episodes.predicting);
            let rows = rows.grow(asked.observations.len(), |seed| Ok(self.predicting_from(seed)))?;
            let predict = |(row, seen): (&mut Predicting, _)| {
                if std::mem::replace(&mut row.asked, true) {
                    row.policy.executed(executed);
                }
                let chunk = row.policy.predict(seen).map_err(raised)?;
                finite(&chunk.actions, seen).map(|()| chunk)
            };
            run(|| rows.iter_mut().zip(&asked.observations).map(predict).collect::<PyResult<Vec<ActionChunk>>>())
        })?;
        let rows = [self.action_horizon(), self.loaded.preprocess().signature().action_dim];
        let values: Vec<f32> = chunks.into_iter().flat_map(|chunk| chunk.actions).collect();
        array(py, &shape(asked.batch, &rows), &values)
    }

    /// Adds the observation of a step at which `predict_action_chunk` is not called; `select_action` needs no such call.
    fn observe(&self, py: Python<'_>, observation: &Bound<'_, PyMapping>) -> PyResult<()> {
        let (asked, episodes) = (self.asked(observation)?, self.episodes(py));
        unlocked(py, || {
            let mut rows = lock(&episodes.predicting);
            let rows = rows.grow(asked.observations.len(), |seed| Ok(self.predicting_from(seed)))?;
            rows.iter_mut().zip(&asked.observations).for_each(|(row, seen)| row.policy.observe(seen));
            Ok(())
        })
    }

    /// `name@version`.
    #[getter]
    fn id(&self) -> String {
        self.loaded.entry().id().to_string()
    }

    /// The folder that it was loaded from.
    #[getter]
    fn path(&self) -> PathBuf {
        self.path.clone()
    }

    /// The task that it was trained for.
    #[getter]
    fn task(&self) -> &str {
        &self.loaded.entry().meta().task
    }

    /// Type of the policy: `act`, `actrm`, ...
    #[getter]
    fn kind(&self) -> &str {
        &self.loaded.entry().meta().policy
    }

    /// Number of weights.
    #[getter]
    fn parameters(&self) -> u64 {
        self.loaded.entry().meta().parameters
    }

    /// The features of an observation and their shapes, with LeRobot's keys; images have their channels first.
    #[getter]
    fn input_features<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let all = PyDict::new(py);
        for spec in &self.loaded.preprocess().signature().observation {
            let shape = match (spec.kind, spec.shape.as_slice()) {
                (FeatureKind::Image, &[height, width, colours]) => vec![colours, height, width],
                (_, shape) => shape.to_vec(),
            };
            all.set_item(&spec.name, PyTuple::new(py, shape)?)?;
        }
        Ok(all)
    }

    /// The shape of an action.
    #[getter]
    fn output_features<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let all = PyDict::new(py);
        all.set_item(models::ACTION, PyTuple::new(py, [self.loaded.preprocess().signature().action_dim])?)?;
        Ok(all)
    }

    /// The simulator's observation keys that make each feature, in order.
    #[getter]
    fn observation_keys<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let keys = &self.loaded.entry().meta().keys;
        let all = PyDict::new(py);
        keys.features().try_for_each(|feature| all.set_item(feature, keys.of(feature)))?;
        Ok(all)
    }

    /// How its numbers are meant, as far as the entry says so: `control_freq`, `action_space`, `gripper`, ...; see `conventions`
    /// of `load_policy`.
    #[getter]
    fn conventions(&self) -> BTreeMap<String, String> {
        self.loaded.conventions().iter().map(|(name, value)| (name.to_owned(), value.to_owned())).collect()
    }

    /// Actions in a chunk (LeRobot: `chunk_size`), without those of past observations.
    #[getter]
    fn action_horizon(&self) -> usize {
        let past = self.loaded.experiment().policy.past_actions(self.n_obs_steps());
        self.loaded.model().action_horizon() - past
    }

    /// Actions that are executed before the next query of the network; 1 with a temporal ensemble.
    #[getter]
    fn n_action_steps(&self) -> usize {
        match self.execution {
            Execution::RecedingHorizon { n_action_steps } => n_action_steps,
            Execution::TemporalEnsemble { .. } => 1,
        }
    }

    /// Number of observations that the policy gets at once: the present one and those before it, which it keeps.
    #[getter]
    fn n_obs_steps(&self) -> usize {
        self.loaded.preprocess().signature().n_obs_steps
    }

    /// The model card, as Markdown.
    #[getter]
    fn card(&self, py: Python<'_>) -> PyResult<String> {
        unlocked(py, || self.loaded.entry().card().map_err(raised))
    }

    fn __repr__(&self) -> String {
        let (id, kind, task) = (self.id(), self.kind(), self.task());
        format!("Policy({id}: {kind}, {} weights, for {task})", self.parameters())
    }

    fn __reduce__<'py>(&self, py: Python<'py>) -> PyResult<(Bound<'py, PyAny>, (PathBuf,))> {
        Ok((py.import("actrm")?.getattr("load_policy")?, (self.path.clone(),)))
    }
}

fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Refuses actions that are no numbers, which come of observations that are far too large.
fn finite(actions: &[f32], seen: &Observation) -> PyResult<()> {
    let Some(value) = actions.iter().find(|value| !value.is_finite()) else { return Ok(()) };
    let size = |values: &Values| match values {
        Values::F32(all) => all.iter().fold(0.0_f32, |most, value| most.max(value.abs())),
        Values::U8(_) => 0.0,
    };
    let largest = seen.iter().map(|(name, values)| (name, size(values))).max_by(|a, b| a.1.total_cmp(&b.1));
    let (name, size) = largest.unwrap_or(("nothing", 0.0));
    Err(Error::new_err(format!(
        "predict: an action is {value}, expected finite numbers; the largest number observed is {size:e} in {name}: give \
         observations in the units of the data, after a reset"
    )))
}

fn shape(batch: Option<usize>, rest: &[usize]) -> Vec<usize> {
    batch.into_iter().chain(rest.iter().copied()).collect()
}

impl PyPolicy {
    fn new(path: PathBuf, loaded: LoadedEntry) -> PyResult<Self> {
        let rollout = &loaded.experiment().rollout;
        let execution = match rollout.temporal_ensemble {
            Some(coefficient) => Execution::TemporalEnsemble { coefficient },
            None => Execution::RecedingHorizon { n_action_steps: rollout.n_action_steps },
        };
        Ok(Self { path, loaded, execution, episodes: Mutex::new((getpid(), Episodes::new())) })
    }

    /// The state of its episodes. A forked process goes on with them, unless another thread was using them then: that
    /// thread is not there to give them back, and the episodes begin anew.
    fn episodes(&self, _py: Python<'_>) -> Arc<Episodes> {
        let mut held = lock(&self.episodes);
        let (process, episodes) = &mut *held;
        if *process != getpid() {
            let in_use = matches!(episodes.acting.try_lock(), Err(TryLockError::WouldBlock))
                || matches!(episodes.predicting.try_lock(), Err(TryLockError::WouldBlock));
            if in_use {
                *episodes = Episodes::new();
            }
            *process = getpid();
        }
        Arc::clone(episodes)
    }

    /// A row that begins the episode of a seed.
    fn predicting_from(&self, seed: u64) -> Predicting {
        let mut policy = self.loaded.policy();
        policy.reset(seed);
        Predicting { policy, asked: false }
    }

    /// The features of an observation, row by row.
    fn asked(&self, observation: &Bound<'_, PyMapping>) -> PyResult<Asked> {
        let operation = "predict";
        let mut batch: Option<(Option<usize>, &str)> = None;
        let mut features = Vec::new();
        let specs = &self.loaded.preprocess().signature().observation;
        // a feature of one number may be without its axis, and is then the last to say how many rows there are
        let (one, several): (Vec<_>, Vec<_>) = specs.iter().partition(|spec| spec.shape == [1]);
        for spec in several.into_iter().chain(one) {
            if !observation.contains(&spec.name)? {
                let is_given = |name: &&String| observation.contains(name).unwrap_or(false);
                let names: Vec<&str> =
                    specs.iter().map(|spec| &spec.name).filter(is_given).map(String::as_str).collect();
                let given = if names.is_empty() { "nothing".to_owned() } else { names.join(", ") };
                return Err(raised(ModelError::MissingFeature { operation, name: spec.name.clone(), given }));
            }
            let (found, values) = feature(spec, &observation.get_item(&spec.name)?)?;
            let before = batch.and_then(|(rows, _)| rows);
            let rows = match (spec.shape.as_slice(), found.as_slice()) {
                ([1], []) => None,
                ([1], &[rows]) if (2..=MOST_ROWS).contains(&rows) || before == Some(rows) => Some(rows),
                (shape, found) => match found.strip_suffix(shape) {
                    Some([]) => None,
                    Some(&[rows]) if (1..=MOST_ROWS).contains(&rows) => Some(rows),
                    _ => {
                        let (name, expected, found) = (spec.name.clone(), spec.shape.clone(), found.to_vec());
                        return Err(raised(ModelError::FeatureShape { operation, name, expected, found }));
                    }
                },
            };
            if let Values::F32(values) = &values
                && let Some(at) = values.iter().position(|number| !number.is_finite())
            {
                let (name, place) = (&spec.name, place(at, &found));
                let text = format!("predict: {name}{place:?} is {}, expected a finite number", values[at]);
                return Err(PyValueError::new_err(text));
            }
            match batch {
                Some((before, other)) if before != rows => {
                    let words = |rows: Option<usize>| rows.map_or("no".to_owned(), |rows| rows.to_string());
                    let (expected, found) = (words(before), words(rows));
                    let text = format!("predict: {} has {found} rows, expected {expected}, as {other}", spec.name);
                    return Err(Error::new_err(text));
                }
                _ => batch = Some((rows, &spec.name)),
            }
            features.push((spec, values));
        }
        let batch = batch.and_then(|(rows, _)| rows);
        let row = |row: usize| {
            let cut = |(spec, values): &(&FeatureSpec, Values)| {
                let range = row * spec.width()..(row + 1) * spec.width();
                let part = match values {
                    Values::F32(all) => Values::F32(all[range].to_vec()),
                    Values::U8(all) => Values::U8(all[range].to_vec()),
                };
                (spec.name.clone(), part)
            };
            features.iter().map(cut).collect()
        };
        Ok(Asked { batch, observations: (0..batch.unwrap_or(1)).map(row).collect() })
    }
}

/// How far beyond 0 to 1 a picture's values may lie and are still taken for rounding.
const BEYOND: f64 = 1e-3;

/// The index along each axis of the `at`-th value, row by row.
fn place(mut at: usize, shape: &[usize]) -> Vec<usize> {
    let mut index = vec![0; shape.len()];
    for (index, size) in index.iter_mut().zip(shape).rev() {
        (*index, at) = (at % size, at / size);
    }
    index
}

/// The shape and values of a feature; pictures with their colours last.
fn feature(spec: &FeatureSpec, value: &Bound<'_, PyAny>) -> PyResult<(Vec<usize>, Values)> {
    let py = value.py();
    let _inside = Inside::with_lock(py);
    if spec.kind != FeatureKind::Image {
        let of = |error| named(py, &format!("predict: {}", spec.name), error);
        let (shape, values) = read::<f32>(value).map_err(of)?;
        return Ok((shape, Values::F32(values)));
    }
    let numpy = numpy(py)?;
    let mut picture = numpy.call_method1("asarray", (readable(value)?,))?;
    let kind: String = picture.getattr("dtype")?.getattr("name")?.extract()?;
    if kind.starts_with("float") {
        // 0 to 1, as PyTorch has them: back to the bytes that they were made of
        let size: usize = picture.getattr("size")?.extract()?;
        let (least, most): (f64, f64) = match size {
            // its shape is what is wrong
            0 => (0.0, 0.0),
            _ => (picture.call_method0("min")?.extract()?, picture.call_method0("max")?.extract()?),
        };
        // rounding may have left a little above 1; what is no number is in no range
        if !(-BEYOND..=1.0 + BEYOND).contains(&least) || !(-BEYOND..=1.0 + BEYOND).contains(&most) {
            let found = format!("values from {least} to {most}");
            let text = format!("predict: {} holds {kind}, expected values from 0 to 1, found {found}", spec.name);
            return Err(PyValueError::new_err(text));
        }
        let scaled = numpy.call_method1("clip", (&picture, 0.0, 1.0))?.mul(255.0)?;
        picture = numpy.call_method1("rint", (scaled,))?.call_method1("astype", ("uint8",))?;
    } else if kind != "uint8" {
        let text = format!("predict: {} holds {kind}, expected uint8 from 0 to 255 or float from 0 to 1", spec.name);
        return Err(PyTypeError::new_err(text));
    }
    let found: Vec<usize> = picture.getattr("shape")?.extract()?;
    let first: Vec<usize> = spec.shape.last().into_iter().chain(spec.shape.iter().take(2)).copied().collect();
    if !found.ends_with(&spec.shape) && found.ends_with(&first) {
        picture = numpy.call_method1("moveaxis", (picture, -3, -1))?;
    }
    let (shape, values) = read::<u8>(&picture)?;
    Ok((shape, Values::U8(values)))
}

/// Load a policy: an entry of a zoo, whose files are checked against their hashes, or a checkpoint of LeRobot's.
///
/// Parameters
/// ----------
/// path: an entry by its folder (`zoo/stack-act/1`, or `zoo/stack-act` for its newest version, `zoo/stack-act@1`), by its
///     name in `zoo` (`stack-act`, `stack-act@1`), or the folder of a LeRobot checkpoint.
/// zoo: the folder that names are looked up in; `$ACTRM_ZOO_DIR` or `zoo` unless given.
/// conventions: what your robot or environment does, such as `{"control_freq": "20", "gripper": "-1 opens, 1 closes"}`. A
///     policy that says otherwise is refused. Names and values: `policy.conventions`.
/// device: where it predicts: "cpu", "auto" (the first GPU, else the CPU), "cuda" or "cuda:N". The wheel has no CUDA.
#[pyfunction]
#[pyo3(signature = (path, zoo=None, *, conventions=None, device="cpu"))]
pub(crate) fn load_policy(
    py: Python<'_>,
    path: PathBuf,
    zoo: Option<PathBuf>,
    conventions: Option<BTreeMap<String, String>>,
    device: &str,
) -> PyResult<PyPolicy> {
    let device: DeviceChoice = device.parse().map_err(PyValueError::new_err)?;
    unlocked(py, || {
        run(|| {
            let yours = stated(conventions.unwrap_or_default()).map_err(raised)?;
            let backend = device.open().map_err(|e| PyValueError::new_err(e.to_string()))?.backend;
            let (folder, loaded) = if let Some(folder) = lerobot_checkpoint(&path) {
                let loaded = import_checkpoint(&folder, &backend).map_err(raised)?;
                (folder, loaded)
            } else {
                let entry = registry(zoo).locate(&path.to_string_lossy()).map_err(raised)?;
                (entry.folder().to_owned(), entry.load_on(&backend).map_err(raised)?)
            };
            let (id, task) = (loaded.entry().id().to_string(), &loaded.entry().meta().task);
            loaded.conventions().check(&yours, "`conventions`", &id, task).map_err(raised)?;
            PyPolicy::new(std::path::absolute(folder)?, loaded)
        })
    })
}

/// The conventions that a caller states.
pub(crate) fn stated(conventions: BTreeMap<String, String>) -> Result<Conventions, ZooError> {
    Conventions::try_from(conventions).map_err(|found| ZooError::InvalidValue {
        key: "conventions".to_owned(),
        expected: "names of conventions".to_owned(),
        found,
    })
}

/// The zoo that is meant.
pub(crate) fn registry(zoo: Option<PathBuf>) -> Registry {
    let named = || std::env::var_os("ACTRM_ZOO_DIR").filter(|folder| !folder.is_empty()).map(PathBuf::from);
    Registry::open(&zoo.or_else(named).unwrap_or_else(|| PathBuf::from("zoo")))
}

/// The folder of a LeRobot checkpoint at `path`, or in the folder that LeRobot's training puts it in.
fn lerobot_checkpoint(path: &Path) -> Option<PathBuf> {
    // in one file, or in several and a list of them
    let weights = ["model.safetensors", "model.safetensors.index.json"];
    let has = |folder: &PathBuf, name: &str| folder.join(name).is_file();
    let is_one = |folder: &PathBuf| has(folder, "config.json") && weights.iter().any(|weights| has(folder, weights));
    [path.to_owned(), path.join("pretrained_model")].into_iter().find(is_one)
}

/// A checkpoint as an entry that nobody keeps.
fn import_checkpoint(folder: &Path, backend: &Backend) -> Result<LoadedEntry, ZooError> {
    let zoo = tempfile::tempdir().map_err(ZooError::io("create folder", std::env::temp_dir()))?;
    let task = exported_task(folder)?.unwrap_or_else(|| "unknown".to_owned());
    let name = "lerobot-checkpoint".to_owned();
    let options = ImportOptions { name, task, state_keys: None, env_keys: None, fast_render: false };
    let id = import(folder, &options, zoo.path())?;
    Registry::open(zoo.path()).entry(&id.to_string())?.load_on(backend)
}
