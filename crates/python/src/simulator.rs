//! A simulator that is stepped from Python: one worker process with one environment.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};

use models::{Observation, Values};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};
use rollout::{
    Control, FaultKind, Initial, Pool, PoolOptions, Ready, Stepped, Worker, WorkerFault, WorkerSpec, find_python,
    harness_folder,
};
use rustix::process::{Pid, getpid};
use zoo::evaluation::Environment;
use zoo::external::usual_inputs;
use zoo::{FeatureKeys, Past};

use crate::arrays::{array, filled, read};
use crate::error::{Error, named, natural, raised};
use crate::policy::registry;
use crate::work::{interruptible, unlocked};

/// One environment in a worker process, as evaluations use it. `actrm.envs` makes a gymnasium environment of it.
#[pyclass(frozen, module = "actrm")]
pub(crate) struct Simulator {
    ready: Ready,
    keys: FeatureKeys,
    pool: Mutex<Option<Pool>>,
    past: Mutex<Past>,
    /// The process that its worker is of.
    home: Pid,
}

#[pymethods]
impl Simulator {
    #[new]
    #[pyo3(signature = (task=None, *, entry=None, zoo=None, keys=None, control="compiled", python=None, env_module=None))]
    #[expect(clippy::too_many_arguments, reason = "options by name")]
    fn new(
        py: Python<'_>,
        task: Option<String>,
        entry: Option<PathBuf>,
        zoo: Option<PathBuf>,
        keys: Option<BTreeMap<String, Vec<String>>>,
        control: &str,
        python: Option<PathBuf>,
        env_module: Option<String>,
    ) -> PyResult<Self> {
        let control: Control = control.parse().map_err(PyValueError::new_err)?;
        let registry = registry(zoo);
        let start = || -> PyResult<(FeatureKeys, Pool)> {
            let python = find_python(python.as_deref()).map_err(raised)?;
            let harness = harness_folder().map_err(raised)?;
            let (mut spec, of_entry) = match (&entry, task) {
                (Some(entry), task) => {
                    let entry = registry.locate(&entry.to_string_lossy()).map_err(raised)?;
                    let (task, module) = (task.as_deref(), env_module.as_deref());
                    let environment = Environment::of(entry.meta(), task, module).map_err(raised)?;
                    (environment.worker(python, harness), Some(entry.meta().keys.clone()))
                }
                (None, Some(task)) => {
                    let mut spec = WorkerSpec::new(python, harness, &task);
                    spec.env_module.clone_from(&env_module);
                    (spec, None)
                }
                (None, None) => return Err(PyValueError::new_err("task or entry: expected one of them")),
            };
            spec.control = control;
            let pool = Pool::start(PoolOptions::new(spec, 1)).map_err(raised)?;
            let keys = match (keys, of_entry) {
                (Some(keys), _) => chosen(keys.into_iter())?,
                (None, Some(keys)) => keys,
                (None, None) => usual_inputs(pool.ready()).map_err(raised)?,
            };
            for feature in keys.features() {
                let words = |reason| Error::new_err(format!("task {}: {feature}: {reason}", pool.ready().task));
                keys.width(feature, pool.ready()).map_err(words)?;
            }
            Ok((keys, pool))
        };
        let (keys, pool) = interruptible(py, |_, _| start(), |()| Ok(()))??;
        let ready = pool.ready().clone();
        Ok(Self { ready, keys, pool: Mutex::new(Some(pool)), past: Mutex::default(), home: getpid() })
    }

    /// Begins the episode of `seed`: the observation, and what is known of the episode.
    fn reset<'py>(&self, py: Python<'py>, seed: i128) -> PyResult<(Bound<'py, PyDict>, Bound<'py, PyDict>)> {
        let seed: u64 = natural("seed", seed)?;
        let Initial { fingerprint, group, instruction, observations, .. } =
            unlocked(py, || self.worker(|worker| worker.reset(seed)))?;
        let info = PyDict::new(py);
        info.set_item("seed", seed)?;
        info.set_item("fingerprint", fingerprint)?;
        info.set_item("group", group)?;
        info.set_item("instruction", instruction)?;
        let mut past = Past::default();
        let seen = self.keys.observe(&observations, &mut past).map_err(Error::new_err)?;
        *self.past() = past;
        Ok((self.seen(py, &seen)?, info))
    }

    /// Executes an action, clipped to its limits. Returns the observation, the reward, whether the task is solved, and
    /// `failure`: a word where the environment reports that the task is lost, else None.
    fn step<'py>(
        &self,
        py: Python<'py>,
        action: &Bound<'py, PyAny>,
    ) -> PyResult<(Bound<'py, PyDict>, f64, bool, Option<String>)> {
        let (shape, values) = read::<f32>(action).map_err(|error| named(py, "action", error))?;
        let action = self.executable(&shape, &values)?;
        let Stepped { rewards, success, failure, observations, .. } =
            unlocked(py, || self.worker(|worker| worker.step(&[action])))?;
        let seen = {
            let mut past = self.past();
            past.pass(1);
            self.keys.observe(&observations, &mut past).map_err(Error::new_err)?
        };
        Ok((self.seen(py, &seen)?, rewards.iter().sum(), success, failure))
    }

    /// An image of the present state: (height, width, 3), uint8.
    #[pyo3(signature = (camera="agentview", height=256, width=256))]
    fn render<'py>(&self, py: Python<'py>, camera: &str, height: i128, width: i128) -> PyResult<Bound<'py, PyAny>> {
        if !(1..=4096).contains(&height) || !(1..=4096).contains(&width) {
            return Err(PyValueError::new_err(format!("image: expected a side of 1 to 4096, found {height}x{width}")));
        }
        let (height, width) = (natural("height", height)?, natural("width", width)?);
        let image = unlocked(py, || self.worker(|worker| worker.render(camera, height, width)))?;
        filled(py, &[height, width, 3], |out| out.copy_from_slice(&image.rgb))
    }

    /// Ends the worker.
    fn close(&self, py: Python<'_>) -> PyResult<()> {
        unlocked(py, || {
            if getpid() == self.home
                && let Some(pool) = self.lock().take()
            {
                pool.close();
            }
            Ok(())
        })
    }

    /// The task.
    #[getter]
    fn task(&self) -> &str {
        &self.ready.task
    }

    /// The task's step limit of an episode.
    #[getter]
    fn max_steps(&self) -> usize {
        self.ready.max_steps
    }

    /// Control steps a second.
    #[getter]
    fn control_freq(&self) -> f64 {
        self.ready.control_freq
    }

    /// Smallest and largest action.
    #[getter]
    fn action_limits<'py>(&self, py: Python<'py>) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
        let limit = |values: &[f64]| {
            let values: Vec<f32> = values.iter().map(|&value| value as f32).collect();
            array(py, &[values.len()], &values)
        };
        Ok((limit(&self.ready.action_low)?, limit(&self.ready.action_high)?))
    }

    /// The features of an observation with their shapes; those of images have three axes.
    #[getter]
    fn features<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let all = PyDict::new(py);
        for feature in self.keys.features() {
            let one = match self.keys.items(feature) {
                [item] => self.ready.observations.get(&item.to_string()).filter(|shape| shape.len() == 3),
                _ => None,
            };
            let shape = match one {
                Some(shape) => shape.clone(),
                None => vec![self.keys.width(feature, &self.ready).map_err(Error::new_err)?],
            };
            all.set_item(feature, PyTuple::new(py, shape)?)?;
        }
        Ok(all)
    }

    /// Versions of the simulator and of its dependencies.
    #[getter]
    fn versions(&self) -> BTreeMap<String, String> {
        self.ready.versions.clone()
    }
}

impl Simulator {
    fn past(&self) -> MutexGuard<'_, Past> {
        self.past.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn lock(&self) -> MutexGuard<'_, Option<Pool>> {
        self.pool.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Asks the worker; one that failed is gone, one that says what is wrong with the request stays.
    fn worker<T>(&self, ask: impl FnOnce(&mut Worker) -> Result<T, WorkerFault>) -> PyResult<T> {
        if getpid() != self.home {
            // another thread may have held the lock when this process was forked, and is not here to give it back
            let task = &self.ready.task;
            let text = format!("the simulator of task {task} is another process's, from which this one was forked");
            return Err(Error::new_err(text));
        }
        let mut held = self.lock();
        let Some(worker) = held.as_mut().and_then(Pool::first_worker) else {
            return Err(Error::new_err(format!("the simulator of task {} was closed", self.ready.task)));
        };
        ask(worker).map_err(|fault| {
            if !matches!(&fault.kind, FaultKind::Reported { kind, .. } if kind != "failed") {
                // whatever it says from now on is not to be believed
                *held = None;
            }
            raised(fault)
        })
    }

    /// The action that is executed: of the right length, finite, inside the environment's limits.
    fn executable(&self, shape: &[usize], values: &[f32]) -> PyResult<Vec<f64>> {
        let expected = [self.ready.action_dim];
        if shape != expected {
            return Err(PyValueError::new_err(format!("action: expected shape {expected:?}, found {shape:?}")));
        }
        if let Some(at) = values.iter().position(|value| !value.is_finite()) {
            return Err(PyValueError::new_err(format!("action: {} at index {at}", values[at])));
        }
        let limits = self.ready.action_low.iter().zip(&self.ready.action_high);
        Ok(values.iter().zip(limits).map(|(&value, (&low, &high))| f64::from(value).clamp(low, high)).collect())
    }

    fn seen<'py>(&self, py: Python<'py>, observation: &Observation) -> PyResult<Bound<'py, PyDict>> {
        let all = PyDict::new(py);
        for (name, values) in observation.iter() {
            let values = match values {
                Values::F32(values) => array(py, &[values.len()], values)?,
                Values::U8(bytes) => {
                    let item = self.keys.of(name).concat();
                    let shape = self.ready.observations.get(&item).cloned().unwrap_or_else(|| vec![bytes.len()]);
                    array(py, &shape, bytes)?
                }
            };
            all.set_item(name, values)?;
        }
        Ok(all)
    }
}

impl Drop for Simulator {
    fn drop(&mut self) {
        if getpid() != self.home {
            // a thread that is not here may have been at it
            std::mem::forget(self.pool.get_mut().unwrap_or_else(PoisonError::into_inner).take());
        }
    }
}

/// The features that were asked for.
fn chosen(keys: impl Iterator<Item = (String, Vec<String>)>) -> PyResult<FeatureKeys> {
    let mut all = FeatureKeys::default();
    for (feature, of) in keys {
        let words = |found| PyValueError::new_err(format!("keys: {feature}: {found}"));
        all.insert(&feature, &of).map_err(words)?;
    }
    Ok(all)
}
