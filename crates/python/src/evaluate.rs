//! Evaluations.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use pyo3::exceptions::{PyRuntimeWarning, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use rollout::{Control, Pool, PoolOptions, find_python, harness_folder, remembered_greeting};
use zoo::ZooError;
use zoo::evaluation::{Environment, EvaluationEnd, EvaluationOptions, Progress, evaluate as run_missing, finished};
use zoo::results::{Execution, Seeds, StoredEvaluation};

use crate::arrays::{array, flags};
use crate::error::{Error, raised, words};
use crate::policy::registry;
use crate::work::interruptible;

/// What an evaluation tells on its way.
enum News {
    At(u64, u64),
    Note(String),
}

/// How it ended.
enum End {
    Complete(Box<StoredEvaluation>),
    /// It was stopped, which the caller knows.
    Stopped,
    Failed(String),
}

/// `actrm.evaluate` without its bar: `tell(done, total)` is called as episodes end.
#[pyfunction]
#[pyo3(signature = (
    entry, tell, *, episodes, workers, seed, task, max_steps, n_action_steps, temporal_ensemble, control, python,
    env_module, zoo, results, force
))]
#[expect(clippy::too_many_arguments, reason = "options by name")]
pub(crate) fn evaluate<'py>(
    py: Python<'py>,
    entry: PathBuf,
    tell: &Bound<'py, PyAny>,
    episodes: u64,
    workers: usize,
    seed: u64,
    task: Option<String>,
    max_steps: Option<usize>,
    n_action_steps: Option<usize>,
    temporal_ensemble: Option<f64>,
    control: &str,
    python: Option<PathBuf>,
    env_module: Option<String>,
    zoo: Option<PathBuf>,
    results: Option<PathBuf>,
    force: bool,
) -> PyResult<Bound<'py, PyDict>> {
    let control: Control = control.parse().map_err(PyValueError::new_err)?;
    let invalid = |text: String| Err(PyValueError::new_err(text));
    if !(1..=1_000_000).contains(&episodes) || seed.checked_add(episodes).is_none() {
        return invalid(format!("episodes: expected 1 to 1000000 and seeds below 2^64, found {episodes} from {seed}"));
    }
    if !(1..=1024).contains(&workers) {
        return invalid(format!("workers: expected 1 to 1024, found {workers}"));
    }
    if max_steps == Some(0) {
        return invalid("max_steps: expected at least 1, found 0".to_owned());
    }
    let execution = match (n_action_steps, temporal_ensemble) {
        (Some(_), Some(_)) => {
            return invalid("n_action_steps and temporal_ensemble: expected one of them".to_owned());
        }
        (Some(n_action_steps), None) => Some(Execution::RecedingHorizon { n_action_steps }),
        (None, Some(coefficient)) => Some(Execution::TemporalEnsemble { coefficient }),
        (None, None) => None,
    };
    let registry = registry(zoo);
    let end = interruptible(
        py,
        |stop, news| -> Result<End, ZooError> {
            let entry = registry.locate(&entry.to_string_lossy())?;
            let zoo = entry.folder().ancestors().nth(2).map(PathBuf::from).unwrap_or_default();
            let results = results.unwrap_or_else(|| zoo.join("results"));
            let loaded = entry.load()?;
            let environment = Environment::of(entry.meta(), task.as_deref(), env_module.as_deref())?;
            let mut subject = loaded.subject();
            subject.max_steps = max_steps.or(subject.max_steps);
            subject.execution = execution.unwrap_or(subject.execution);
            subject.execution.check(loaded.experiment().policy.action_horizon())?;
            let mut spec = environment.worker(find_python(python.as_deref())?, harness_folder()?);
            spec.control = control;
            let options = EvaluationOptions {
                seeds: Seeds { start: seed, count: episodes },
                shard: None,
                env_module: environment.env_module.clone(),
                force,
            };
            if let Some(ready) = remembered_greeting(&spec)
                && let Some(stored) = finished(&subject, &ready, &results, &options)?
            {
                return Ok(End::Complete(Box::new(stored)));
            }
            let flag = Arc::clone(stop);
            let asked = move || flag.load(Ordering::SeqCst);
            let mut pool = Pool::start(PoolOptions { stop: Arc::new(asked), ..PoolOptions::new(spec, workers) })?;
            let note = |text: String| drop(news.send(News::Note(text)));
            pool.fallback().into_iter().for_each(|why| note(why.to_owned()));
            let mut at = (0, 0);
            let end = run_missing(&subject, &mut pool, &results, &options, &mut |progress| {
                at = match progress {
                    Progress::Apart(other) => {
                        note(other.to_string());
                        return;
                    }
                    Progress::Begin { done, total, .. } => (done, total),
                    Progress::Episode(_) => (at.0 + 1, at.1),
                };
                drop(news.send(News::At(at.0, at.1)));
            });
            let incidents = pool.incidents().len();
            if incidents > 0 {
                note(format!("{incidents} worker failures; the episodes were run again"));
            }
            pool.close();
            Ok(match end? {
                EvaluationEnd::Complete(evaluation) => End::Complete(evaluation),
                EvaluationEnd::Stopped { .. } => End::Stopped,
                EvaluationEnd::Failed { done, errors } => {
                    let first = errors.first().map_or_else(String::new, |error| words(error));
                    End::Failed(format!("{done} episodes done, others could not be run: {first}"))
                }
            })
        },
        |news| match news {
            News::At(done, total) => tell.call1((done, total)).map(drop),
            News::Note(text) => {
                let text = std::ffi::CString::new(text.replace('\0', "\u{fffd}"))?;
                PyErr::warn(py, &py.get_type::<PyRuntimeWarning>(), &text, 1)
            }
        },
    )?;
    match end.map_err(raised)? {
        End::Complete(evaluation) => arrays(py, &evaluation),
        End::Stopped => Err(Error::new_err("the evaluation was stopped")),
        End::Failed(text) => Err(Error::new_err(text)),
    }
}

/// The episodes of an evaluation as columns, ascending by seed.
fn arrays<'py>(py: Python<'py>, evaluation: &StoredEvaluation) -> PyResult<Bound<'py, PyDict>> {
    let (episodes, timings) = (&evaluation.episodes, &evaluation.timings);
    let n = &[episodes.len()][..];
    let all = PyDict::new(py);
    all.set_item("seed", array(py, n, &episodes.iter().map(|e| e.seed).collect::<Vec<_>>())?)?;
    let success = flags(py, n, |out| out.iter_mut().zip(episodes).for_each(|(out, e)| *out = u8::from(e.success)))?;
    all.set_item("success", success)?;
    all.set_item("steps", array(py, n, &episodes.iter().map(|e| i64::from(e.steps)).collect::<Vec<_>>())?)?;
    all.set_item("return", array(py, n, &episodes.iter().map(|e| e.total_reward).collect::<Vec<_>>())?)?;
    all.set_item("fingerprint", episodes.iter().map(|e| &e.fingerprint).collect::<Vec<_>>())?;
    all.set_item("group", episodes.iter().map(|e| &e.group).collect::<Vec<_>>())?;
    all.set_item("failure", episodes.iter().map(|e| &e.failure).collect::<Vec<_>>())?;
    let of = |seed: u64| timings.iter().find(|timing| timing.seed == seed);
    let wall: Vec<f64> = episodes.iter().map(|e| of(e.seed).map_or(f64::NAN, |t| t.wall_ms)).collect();
    all.set_item("wall_ms", array(py, n, &wall)?)?;
    let inference = episodes.iter().map(|e| {
        let queries = of(e.seed).map_or(&[][..], |t| &t.inference_ms);
        queries.iter().sum::<f64>() / queries.len() as f64
    });
    all.set_item("inference_ms", array(py, n, &inference.collect::<Vec<_>>())?)?;
    Ok(all)
}
