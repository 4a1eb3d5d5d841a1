//! Running a study: what has no result yet, cell by cell, stoppable and taken up again where it was.

use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use recording::{CollectEnd, CollectOptions, collect};
use rollout::{Pool, PoolOptions, Python, WorkerSpec, harness_folder};
use zoo::config::Library;
use zoo::entry::LoadedEntry;
use zoo::evaluation::{EvaluationEnd, EvaluationOptions, evaluate, thinking_subject};
use zoo::experiment::Experiment;
use zoo::registry::Registry;
use zoo::results::Seeds;
use zoo::run::{TrainEvent, TrainOutcome, TrainRequest, train};
use zoo::{ZooError, sha256_hex};

use super::cells::{Cell, cells};
use super::error::StudyError;
use super::file::{Data, Study, Test};
use super::result::CellResult;

/// What to run and where.
pub struct RobotStudyRequest {
    /// The study.
    pub study: Study,
    /// Experiments come from here.
    pub library: Library,
    /// Folder for demonstrations, runs and entries.
    pub work: PathBuf,
    /// Only cells whose name holds one of these; all where empty.
    pub only: Vec<String>,
    /// Only cells of the stages up to this; of all where none is given.
    pub stage: Option<u8>,
    /// Cells at once.
    pub jobs: usize,
    /// Python with robosuite.
    pub python: Python,
    /// Whether to stop.
    pub stop: Arc<dyn Fn() -> bool + Send + Sync>,
}

/// News from a study under way.
#[derive(Debug)]
pub enum RobotEvent<'a> {
    /// So many of all results are there.
    Done(usize, usize),
    /// Demonstrations are being collected: name, done, in all.
    Collecting(&'a str, u64, u64),
    /// A training is under way: name of the cell, steps done, in all.
    Training(&'a str, u64, u64),
    /// A training is being tested: name of the cell, the test.
    Testing(&'a str, &'a str),
    /// A result was written.
    Result(&'a CellResult),
}

/// How a cell went.
enum CellEnd {
    Done,
    Stopped,
}

/// Runs every cell that has no result; whether all have one now.
///
/// # Errors
/// The first failure; what was done stays.
pub fn run_robot_study(
    request: &RobotStudyRequest,
    on_event: &mut (dyn FnMut(RobotEvent<'_>) + Send),
) -> Result<bool, StudyError> {
    let study = &request.study;
    let all = cells(study);
    let chosen = |cell: &Cell| {
        let named = request.only.is_empty() || request.only.iter().any(|o| cell.name().contains(o.as_str()));
        named && request.stage.is_none_or(|last| cell.stage <= last)
    };
    let total: usize = all.iter().map(|cell| cell.tests.len()).sum();
    let training = all.iter().map(|cell| (cell.name(), Mutex::new(()))).collect();
    let mut due = VecDeque::new();
    let mut there = 0;
    for cell in all {
        let missing = missing_tests(request, &cell)?;
        count_operations(request, &cell, &missing)?;
        there += cell.tests.len() - missing.len();
        if !missing.is_empty() && chosen(&cell) {
            due.push_back(cell);
        }
    }
    on_event(RobotEvent::Done(there, total));
    let shared = Shared {
        request,
        due: Mutex::new(due),
        done: Mutex::new(there),
        total,
        on_event: Mutex::new(on_event),
        collecting: study.data.keys().map(|name| (name.clone(), Mutex::new(()))).collect(),
        training,
        failure: Mutex::new(None),
    };
    std::thread::scope(|scope| {
        for _ in 0..request.jobs.max(1) {
            scope.spawn(|| shared.work());
        }
    });
    match shared.failure.into_inner().unwrap_or_else(PoisonError::into_inner) {
        Some(error) => Err(error),
        None => Ok(shared.done.into_inner().unwrap_or_else(PoisonError::into_inner) == total),
    }
}

/// The tests of a cell that have no result of the settings as they are.
fn missing_tests(request: &RobotStudyRequest, cell: &Cell) -> Result<Vec<String>, StudyError> {
    let study = &request.study;
    let (_, settings) = experiment(request, cell)?;
    let mut missing = Vec::new();
    for name in &cell.tests {
        let found = CellResult::read(&study.results.join(cell.file_name(name)))?;
        let same = |result: &CellResult| {
            result.settings == settings
                && result.data_definition == study.data[&cell.data]
                && result.test_definition == study.tests[name]
        };
        if !found.is_some_and(|result| same(&result)) {
            missing.push(name.clone());
        }
    }
    Ok(missing)
}

/// Writes into results that were made before operations were counted how many a query has, where the entry is still there.
fn count_operations(request: &RobotStudyRequest, cell: &Cell, missing: &[String]) -> Result<(), StudyError> {
    for test in cell.tests.iter().filter(|test| !missing.contains(test)) {
        let path = request.study.results.join(cell.file_name(test));
        let Some(result) = CellResult::read(&path)?.filter(|result| result.query_flops.is_none()) else { continue };
        let zoo = request.work.join("zoo");
        let name = format!("{}-{}", cell.name(), &result.settings[..8]);
        if !zoo.join(&name).exists() {
            continue;
        }
        let query_flops = Registry::open(&zoo).entry(&name)?.load()?.model().query_flops();
        if query_flops.is_some() {
            CellResult { query_flops, ..result }.write(&path)?;
        }
    }
    Ok(())
}

/// The experiment of a cell, and the hash of what it depends on: not its name, seed and path.
fn experiment(request: &RobotStudyRequest, cell: &Cell) -> Result<(Experiment, String), StudyError> {
    let arm = &request.study.arms[&cell.arm];
    let mut set = arm.set.clone();
    set.extend([format!("entry={}", cell.name()), format!("train.seed={}", cell.seed)]);
    let experiment = Experiment::load(&request.library, &arm.experiment, &set)?;
    let mut flat = experiment.flat();
    for key in ["entry", "description", "train.seed", "data.path"] {
        flat.remove(key);
    }
    let text: Vec<String> = flat.iter().map(|(key, value)| format!("{key}={value}\n")).collect();
    Ok((experiment, sha256_hex(text.concat().as_bytes())))
}

/// What the threads of a study share.
struct Shared<'a> {
    request: &'a RobotStudyRequest,
    due: Mutex<VecDeque<Cell>>,
    done: Mutex<usize>,
    total: usize,
    on_event: Mutex<&'a mut (dyn FnMut(RobotEvent<'_>) + Send)>,
    /// held while demonstrations of that name are collected
    collecting: BTreeMap<String, Mutex<()>>,
    /// held while the training of that cell is under way
    training: BTreeMap<String, Mutex<()>>,
    failure: Mutex<Option<StudyError>>,
}

fn lock<T: ?Sized>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Shared<'_> {
    fn tell(&self, event: RobotEvent<'_>) {
        (lock(&self.on_event))(event);
    }

    fn stopped(&self) -> bool {
        (self.request.stop)() || lock(&self.failure).is_some()
    }

    /// One thread: cells until there is none, or an end is asked for.
    fn work(&self) {
        while !self.stopped() {
            let Some(cell) = lock(&self.due).pop_front() else { return };
            match self.cell(&cell) {
                Ok(CellEnd::Done) => {}
                Ok(CellEnd::Stopped) => return,
                Err(error) => {
                    lock(&self.failure).get_or_insert(error);
                    return;
                }
            }
        }
    }

    fn cell(&self, cell: &Cell) -> Result<CellEnd, StudyError> {
        let study = &self.request.study;
        let (arm, data) = (&study.arms[&cell.arm], &study.data[&cell.data]);
        let Some(file) = self.demonstrations(&cell.data, data)? else { return Ok(CellEnd::Stopped) };
        let (experiment, settings) = experiment(self.request, cell)?;
        let zoo = self.request.work.join("zoo");
        // another definition is another entry, so that a changed arm is trained anew
        let runs = self.request.work.join("runs").join(format!("{}-{}", cell.name(), &settings[..8]));
        let name = format!("{}-{}", cell.name(), &settings[..8]);
        let training = lock(&self.training[&cell.name()]);
        if !zoo.join(&name).exists() {
            let request = TrainRequest {
                name: arm.experiment.clone(),
                experiment: Experiment { entry: name.clone(), ..experiment },
                data: Some(file),
                runs: self.request.work.join("runs"),
                resume: runs.join("config.toml").exists(),
                run: Some(runs),
                zoo: zoo.clone(),
                image_memory: None,
                command: None,
            };
            let mut steps = 0;
            let outcome = train(&request, &|| self.stopped(), &mut |event| match event {
                TrainEvent::Begin { steps: all, .. } => steps = all,
                TrainEvent::Step(row) => self.tell(RobotEvent::Training(&cell.name(), row.step, steps)),
                _ => {}
            })?;
            if matches!(outcome, TrainOutcome::Stopped { .. }) {
                return Ok(CellEnd::Stopped);
            }
        }
        drop(training);
        let entry = Registry::open(&zoo).entry(&name)?.load()?;
        for test in missing_tests(self.request, cell)? {
            let definition = &study.tests[&test];
            self.tell(RobotEvent::Testing(&cell.name(), &test));
            // what an entry does where it thinks otherwise is no result of the entry
            let results = match definition.thinking_words() {
                None => zoo.join("results"),
                Some(_) => self.request.work.join("otherwise").join(&test),
            };
            let Some(evaluation) = self.evaluate(&entry, definition, &results)? else {
                return Ok(CellEnd::Stopped);
            };
            let of_test = (test.as_str(), definition);
            let flops = entry.thinking(&definition.thinking)?.model().query_flops();
            let result = CellResult::new(cell, (arm, data), of_test, settings.clone(), flops, &evaluation);
            result.write(&study.results.join(cell.file_name(&test)))?;
            self.tell(RobotEvent::Result(&result));
            let mut done = lock(&self.done);
            *done += 1;
            self.tell(RobotEvent::Done(*done, self.total));
        }
        Ok(CellEnd::Done)
    }

    /// One simulator for `task`, in this thread's cell alone.
    fn simulator(&self, task: &str) -> Result<Pool, StudyError> {
        let spec = WorkerSpec::new(self.request.python.clone(), harness_folder()?, task);
        let stop = Arc::clone(&self.request.stop);
        Ok(Pool::start(PoolOptions { stop, ..PoolOptions::new(spec, 1) })?)
    }

    /// The file of demonstrations, collected if it is not there; nothing if that was stopped.
    fn demonstrations(&self, name: &str, data: &Data) -> Result<Option<PathBuf>, StudyError> {
        let _one_at_a_time = lock(&self.collecting[name]);
        let folder = self.request.work.join("data");
        let file = folder.join(format!("{}-{}-seed{}.hdf5", data.task.to_lowercase(), data.episodes, data.seed));
        if file.exists() {
            return Ok(Some(file));
        }
        std::fs::create_dir_all(&folder).map_err(|source| ZooError::Io {
            operation: "create folder",
            path: folder.clone(),
            source,
        })?;
        let mut pool = self.simulator(&data.task)?;
        let options = CollectOptions {
            out: file.clone(),
            episodes: data.episodes,
            seed: data.seed,
            env_module: None,
            next_obs: false,
            gzip: None,
        };
        let end = collect(&mut pool, &options, &mut |progress| {
            if let recording::CollectProgress::Demos(done) = progress {
                self.tell(RobotEvent::Collecting(name, done, data.episodes));
            }
        });
        pool.close();
        match end? {
            CollectEnd::Written(_) => Ok(Some(file)),
            CollectEnd::Stopped(_) => Ok(None),
        }
    }

    /// A finished evaluation; nothing if it was stopped.
    fn evaluate(
        &self,
        entry: &LoadedEntry,
        test: &Test,
        results: &Path,
    ) -> Result<Option<Box<zoo::results::StoredEvaluation>>, StudyError> {
        let mut pool = self.simulator(&test.task)?;
        let options = EvaluationOptions {
            seeds: Seeds { start: test.seed_start, count: test.episodes },
            shard: None,
            env_module: None,
            force: false,
        };
        let end = match thinking_subject(entry, &test.thinking, &mut pool) {
            Ok(Some(subject)) => evaluate(&subject, &mut pool, results, &options, &mut |_| {}),
            Ok(None) => return Ok(None),
            Err(error) => Err(error),
        };
        pool.close();
        match end? {
            EvaluationEnd::Complete(evaluation) => Ok(Some(evaluation)),
            EvaluationEnd::Stopped { .. } => Ok(None),
            EvaluationEnd::Failed { mut errors, .. } => Err(errors.pop().expect("a failed evaluation says why").into()),
        }
    }
}
