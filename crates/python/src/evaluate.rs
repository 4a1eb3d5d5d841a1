//! Evaluations.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;
use std::sync::{Arc, PoisonError};

use models::{ModelError, Policy};
use pyo3::PyTypeInfo;
use pyo3::exceptions::{PyRuntimeWarning, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use rollout::{Control, Pool, PoolOptions, Ready, find_python, harness_folder, remembered_greeting};
use zoo::entry::LoadedEntry;
use zoo::evaluation::{
    Environment, EvaluationEnd, EvaluationOptions, FIRST_SEED, Progress, Subject, evaluate as run_missing, finished,
};
use zoo::external::{External, Named, reads_images, usual_inputs};
use zoo::protocols::{Block, NamedProtocol, Protocols};
use zoo::results::{Execution, Seeds, StoredEvaluation};
use zoo::{FeatureKeys, ZooError};

use crate::arrays::{array, flags};
use crate::error::{Error, ResultsTakenOver, natural, raised, words};
use crate::external::{Failure, Given, PythonPolicy};
use crate::policy::{registry, stated};
use crate::work::interruptible;

/// What an evaluation tells on its way.
enum News {
    At(u64, u64),
    Note(String),
    TakenOver(String),
    /// A note on episodes that are done.
    Late(String),
}

/// How it ended.
enum End {
    Complete(Box<StoredEvaluation>),
    /// It was stopped, which the caller knows.
    Stopped,
    Failed(String),
}

/// The policy that is asked about.
enum Asked {
    Entry(Box<LoadedEntry>),
    External {
        external: Box<External>,
        code: Option<String>,
        inputs: Option<FeatureKeys>,
        named: Named,
        called: Py<PyAny>,
    },
}

impl Asked {
    /// What is evaluated in the environment that `ready` describes.
    fn subject<'a>(&'a self, zoo: &Path, ready: &Ready, failure: &'a Failure) -> Result<Subject<'a>, ZooError> {
        match self {
            Self::Entry(loaded) => Ok(loaded.subject()),
            Self::External { external, code, inputs, named, called } => {
                let inputs = inputs.clone().map_or_else(|| usual_inputs(ready), Ok)?;
                let external = External { inputs, ..(**external).clone() };
                let entry = external.entry_of_code(zoo, named, ready, code.as_deref())?;
                let (source, signature) = (external.source.clone(), entry.meta().signature.clone());
                let policy = move || -> Result<Box<dyn Policy>, ModelError> {
                    Ok(Box::new(PythonPolicy::new(called, &source, &signature, failure)?))
                };
                Ok(external.subject(&entry, policy))
            }
        }
    }

    /// What is said where episodes of an earlier call are taken over: nobody knows whether a policy is still the same.
    fn taken_over(&self, subject: &Subject<'_>, episodes: u64) -> Option<String> {
        (matches!(self, Self::External { .. }) && episodes > 0).then(|| {
            format!(
                "{episodes} of the episodes are those of an earlier call, of entry {}: another policy needs another name=, \
                 and other weights need another declared=",
                subject.entry
            )
        })
    }
}

/// `actrm.evaluate` without its bar: `tell(done, total)` is called as episodes end. One of `entry` and `external`.
#[pyfunction]
#[pyo3(signature = (
    entry, external, tell, *, protocol, episodes, workers, seed, task, max_steps, n_action_steps, temporal_ensemble,
    control, python, env_module, zoo, results, force
))]
#[expect(clippy::too_many_arguments, reason = "options by name")]
pub(crate) fn evaluate<'py>(
    py: Python<'py>,
    entry: Option<PathBuf>,
    external: Option<Given>,
    tell: &Bound<'py, PyAny>,
    protocol: Option<String>,
    episodes: Option<i128>,
    workers: i128,
    seed: Option<i128>,
    task: Option<String>,
    max_steps: Option<i128>,
    n_action_steps: Option<i128>,
    temporal_ensemble: Option<f64>,
    control: Option<&str>,
    python: Option<PathBuf>,
    env_module: Option<String>,
    zoo: Option<PathBuf>,
    results: Option<PathBuf>,
    force: bool,
) -> PyResult<Bound<'py, PyDict>> {
    let asked_control: Option<Control> =
        control.map(str::parse::<Control>).transpose().map_err(PyValueError::new_err)?;
    let mut control = asked_control.unwrap_or(Control::Compiled);
    let invalid = |text: String| Err(PyValueError::new_err(text));
    let max_steps: Option<usize> = max_steps.map(|steps| natural("max_steps", steps)).transpose()?;
    let n_action_steps: Option<usize> = n_action_steps.map(|steps| natural("n_action_steps", steps)).transpose()?;
    let workers: usize = natural("workers", workers)?;
    let (mut task, mut max_steps) = (task, max_steps);
    let start = seed.map_or(Ok(FIRST_SEED), |seed| natural("seed", seed))?;
    let mut seeds = Seeds { start, count: natural("episodes", episodes.unwrap_or(20))? };
    let mut execution = match (n_action_steps, temporal_ensemble) {
        (Some(_), Some(_)) => {
            return invalid("n_action_steps and temporal_ensemble: expected one of them".to_owned());
        }
        (Some(n_action_steps), None) => Some(Execution::RecedingHorizon { n_action_steps }),
        (None, Some(coefficient)) => Some(Execution::TemporalEnsemble { coefficient }),
        (None, None) => None,
    };
    if external.is_some() {
        // its horizon is known only once it is asked
        match execution {
            Some(Execution::RecedingHorizon { n_action_steps: 0 }) => {
                return invalid("n_action_steps: expected at least 1, found 0".to_owned());
            }
            Some(ensemble @ Execution::TemporalEnsemble { .. }) => {
                ensemble.check(1).map_err(|error| PyValueError::new_err(words(&error)))?;
            }
            _ => {}
        }
    }
    let rules: Option<NamedProtocol> = match &protocol {
        Some(name) => Some(Protocols::built_in().get(name).map_err(raised)?.clone()),
        None => None,
    };
    if let Some(rules) = &rules {
        let given = [
            ("task", task.as_ref().is_some_and(|task| *task != rules.task)),
            ("episodes", episodes.is_some()),
            ("seed", seed.is_some()),
            ("control", asked_control.is_some()),
            ("max_steps", max_steps.is_some()),
            ("n_action_steps or temporal_ensemble", execution.is_some() && rules.execution.is_some()),
        ];
        if let Some((word, _)) = given.iter().find(|(_, given)| *given) {
            return invalid(format!("{word}: protocol {} fixes it; leave it out", rules.name));
        }
        (task, max_steps, control) = (Some(rules.task.clone()), Some(rules.max_steps), rules.control);
        (seeds, execution) = (rules.seeds(Block::Test), execution.or(rules.execution));
    }
    let (first, count) = (seeds.start, seeds.count);
    if !(1..=1_000_000).contains(&count) || first.checked_add(count).is_none() {
        return invalid(format!("episodes: expected 1 to 1000000 and seeds below 2^64, found {count} from {first}"));
    }
    if !(1..=1024).contains(&workers) {
        return invalid(format!("workers: expected 1 to 1024, found {workers}"));
    }
    if max_steps == Some(0) {
        return invalid("max_steps: expected at least 1, found 0".to_owned());
    }
    let image_size: usize = external.as_ref().map_or(Ok(1), |given| natural("image_size", given.6))?;
    if image_size == 0 {
        return invalid("image_size: expected at least 1, found 0".to_owned());
    }
    let registry = registry(zoo);
    let failure = Failure::default();
    let end = interruptible(
        py,
        |stop, news| -> Result<End, ZooError> {
            let (asked, environment, zoo) = match (entry, external) {
                (Some(entry), _) => {
                    let entry = registry.locate(&entry.to_string_lossy())?;
                    let zoo = entry.folder().ancestors().nth(2).map(PathBuf::from).unwrap_or_default();
                    let loaded = entry.load()?;
                    execution.iter().try_for_each(|e| e.check(loaded.experiment().policy.action_horizon()))?;
                    let environment = Environment::of(entry.meta(), task.as_deref(), env_module.as_deref())?;
                    (Asked::Entry(Box::new(loaded)), environment, zoo)
                }
                (None, Some(given)) => {
                    let (called, name, source, code, declared, inputs, _, conventions) = given;
                    let task = task.ok_or_else(|| missing("task", "a task, such as Lift, or a protocol"))?;
                    let inputs = inputs.map(feature_keys).transpose()?;
                    let execution = execution.unwrap_or(Execution::RecedingHorizon { n_action_steps: 1 });
                    let image_size = inputs.as_ref().is_some_and(reads_images).then_some(image_size);
                    let external = External {
                        source,
                        declared,
                        mapping: None,
                        image_size,
                        execution,
                        inputs: inputs.clone().unwrap_or_default(),
                        conventions: stated(conventions)?,
                    };
                    let environment = Environment::usual(&task, env_module.as_deref(), external.cameras());
                    let named = Named { name, description: String::new() };
                    let asked = Asked::External { external: Box::new(external), code, inputs, named, called };
                    (asked, environment, registry.folder().to_owned())
                }
                (None, None) => return Err(missing("policy", "an entry or a policy")),
            };
            let results = results.unwrap_or_else(|| zoo.join("results"));
            let subject_of = |ready: &Ready| -> Result<Subject<'_>, ZooError> {
                let mut subject = asked.subject(&zoo, ready, &failure)?;
                subject.max_steps = max_steps.or(subject.max_steps);
                subject.execution = execution.unwrap_or(subject.execution);
                Ok(subject)
            };
            let mut spec = environment.worker(find_python(python.as_deref())?, harness_folder()?);
            spec.control = control;
            let options = EvaluationOptions { seeds, shard: None, env_module: environment.env_module.clone(), force };
            let note = |text: String| drop(news.send(News::Note(text)));
            let taken_over = |text: String| drop(news.send(News::TakenOver(text)));
            let doubt = |stored: &StoredEvaluation| {
                let text = rules.as_ref().and_then(|rules| rules.doubt(&stored.record));
                text.into_iter().for_each(|text| drop(news.send(News::Late(text))));
            };
            if let Some(ready) = remembered_greeting(&spec) {
                let subject = subject_of(&ready)?;
                if let Some(stored) = finished(&subject, &ready, &results, &options)? {
                    asked.taken_over(&subject, stored.episodes.len() as u64).into_iter().for_each(taken_over);
                    doubt(&stored);
                    return Ok(End::Complete(Box::new(stored)));
                }
            }
            let flag = Arc::clone(stop);
            let stopped = move || flag.load(Ordering::SeqCst);
            let mut pool = Pool::start(PoolOptions { stop: Arc::new(stopped), ..PoolOptions::new(spec, workers) })?;
            pool.fallback().into_iter().for_each(|why| note(why.to_owned()));
            let subject = subject_of(pool.ready())?;
            let mut at = (0, 0);
            let end = run_missing(&subject, &mut pool, &results, &options, &mut |progress| {
                at = match progress {
                    Progress::Apart(other) => {
                        note(other.to_string());
                        return;
                    }
                    Progress::Begin { done, total, .. } => {
                        asked.taken_over(&subject, done).into_iter().for_each(taken_over);
                        (done, total)
                    }
                    Progress::Episode(_) => (at.0 + 1, at.1),
                };
                drop(news.send(News::At(at.0, at.1)));
            });
            let incidents = pool.incidents().len();
            if incidents > 0 {
                drop(news.send(News::Late(format!("{incidents} worker failures; the episodes were run again"))));
            }
            pool.close();
            Ok(match end? {
                EvaluationEnd::Complete(evaluation) => {
                    doubt(&evaluation);
                    End::Complete(evaluation)
                }
                EvaluationEnd::Stopped { .. } => End::Stopped,
                EvaluationEnd::Failed { done, errors } => {
                    let first = errors.first().map_or_else(String::new, |error| words(error));
                    End::Failed(format!("{done} episodes done, others could not be run: {first}"))
                }
            })
        },
        |news| match news {
            News::At(done, total) => tell.call1((done, total)).map(drop),
            News::Note(text) => warn::<PyRuntimeWarning>(py, &text),
            News::TakenOver(text) => warn::<ResultsTakenOver>(py, &text),
            News::Late(text) => {
                // where warnings are errors, it takes no results away
                if let Err(error) = warn::<PyRuntimeWarning>(py, &text) {
                    error.write_unraisable(py, None);
                }
                Ok(())
            }
        },
    )?;
    let end = end.map_err(|error| {
        let error = raised(error);
        // what the policy itself raised
        error.set_cause(py, failure.lock().unwrap_or_else(PoisonError::into_inner).take());
        error
    })?;
    match end {
        End::Complete(evaluation) => arrays(py, &evaluation),
        End::Stopped => Err(Error::new_err("the evaluation was stopped")),
        End::Failed(text) => Err(Error::new_err(text)),
    }
}

/// Warns whoever called the package's own `evaluate`.
fn warn<T: PyTypeInfo>(py: Python<'_>, text: &str) -> PyResult<()> {
    let text = std::ffi::CString::new(text.replace('\0', "\u{fffd}"))?;
    PyErr::warn(py, &py.get_type::<T>(), &text, 2)
}

/// The features that these keys make.
fn feature_keys(inputs: BTreeMap<String, Vec<String>>) -> Result<FeatureKeys, ZooError> {
    let mut all = FeatureKeys::default();
    for (feature, keys) in inputs {
        let expected = "observation keys, parts of them (key[0:3]) and differences (a - b)".to_owned();
        all.insert(&feature, &keys).map_err(|found| ZooError::InvalidValue {
            key: format!("inputs: {feature}"),
            expected,
            found,
        })?;
    }
    Ok(all)
}

/// An argument that is not there, or not as it should be.
fn missing(key: &str, expected: &str) -> ZooError {
    ZooError::InvalidValue { key: key.to_owned(), expected: expected.to_owned(), found: "none".to_owned() }
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
