//! Running a study: what has no result yet, cell by cell, stoppable and taken up again where it was.

use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use analysis::depth::thinking_subject;
use models::actrm::Thinking;
use recording::{CollectEnd, CollectOptions, collect};
use report::shell_quoted;
use rollout::{Pool, PoolOptions, Python, WorkerSpec, harness_folder};
use zoo::config::Library;
use zoo::entry::{Entry, LoadedEntry, member_name};
use zoo::evaluation::{Environment, EvaluationEnd, EvaluationOptions, evaluate};
use zoo::experiment::Experiment;
use zoo::registry::Registry;
use zoo::results::Seeds;
use zoo::run::{DeviceChoice, TrainEvent, TrainOutcome, TrainRequest, train};
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
    /// Only these cells, by their whole names; all where empty.
    pub cells: Vec<String>,
    /// Only cells of the stages up to this; of all where none is given.
    pub stage: Option<u8>,
    /// Collect what the cells learn from and end.
    pub data_only: bool,
    /// Cells at once.
    pub jobs: usize,
    /// Where policies are trained.
    pub device: DeviceChoice,
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
    /// its results are of another training
    Left,
}

/// Runs every cell that was chosen and has no result; whether nothing was stopped.
///
/// # Errors
/// The first failure; what was done stays. Or, after all else was done, cells whose results are of another training.
pub fn run_robot_study(
    request: &RobotStudyRequest,
    on_event: &mut (dyn FnMut(RobotEvent<'_>) + Send),
) -> Result<bool, StudyError> {
    let study = &request.study;
    std::fs::create_dir_all(&study.results).map_err(|source| ZooError::Io {
        operation: "create folder",
        path: study.results.clone(),
        source,
    })?;
    let all = cells(study);
    let chosen = |cell: &Cell| {
        let named = request.only.is_empty() || request.only.iter().any(|o| cell.name().contains(o.as_str()));
        let whole = request.cells.is_empty() || request.cells.contains(&cell.name());
        named && whole && request.stage.is_none_or(|last| cell.stage <= last)
    };
    let total: usize = all.iter().map(|cell| cell.tests.len()).sum();
    let training = all.iter().map(|cell| (cell.name(), Mutex::new(()))).collect();
    let nobodys = request.cells.iter().find(|name| all.iter().all(|cell| cell.name() != **name));
    let nowhere = request.only.iter().find(|part| all.iter().all(|cell| !cell.name().contains(part.as_str())));
    if let Some(cell) = nobodys.or(nowhere) {
        return Err(StudyError::UnknownCell { cell: cell.clone() });
    }
    let mut due = VecDeque::new();
    let mut there = 0;
    for cell in all {
        let missing = missing_tests(request, &cell).map_err(|error| error.of(&cell))?;
        complete(request, &cell, &missing)?;
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
        stopped: AtomicBool::new(false),
        on_event: Mutex::new(on_event),
        collecting: study.data.keys().map(|name| (name.clone(), Mutex::new(()))).collect(),
        training,
        failure: Mutex::new(None),
        left: Mutex::new(Vec::new()),
    };
    std::thread::scope(|scope| {
        for _ in 0..request.jobs.max(1) {
            scope.spawn(|| shared.work());
        }
    });
    let stopped = shared.stopped.into_inner();
    let mut left = shared.left.into_inner().unwrap_or_else(PoisonError::into_inner);
    // a cell of two stages is there twice
    left.sort();
    left.dedup();
    match shared.failure.into_inner().unwrap_or_else(PoisonError::into_inner) {
        Some(error) => Err(error),
        // who stopped it goes on later, and hears of these then
        None if stopped || left.is_empty() => Ok(!stopped),
        None => Err(StudyError::OtherTrainings { cells: left, results: study.results.clone(), zoo: request.zoo() }),
    }
}

/// The results of a cell's tests in their order, each of the settings as they are or none.
///
/// # Errors
/// An experiment that `library` lacks or that its study changes to what cannot be, a result that cannot be read.
pub fn stored_results(study: &Study, library: &Library, cell: &Cell) -> Result<Vec<Option<CellResult>>, StudyError> {
    let (_, settings) = experiment(study, library, cell)?;
    let stored = |name: &String| {
        let found = CellResult::read(&study.results.join(cell.file_name(name)))?;
        Ok(found.filter(|result| result.settings == settings && result.answers(study, cell, name)))
    };
    cell.tests.iter().map(stored).collect()
}

/// What is stored of a cell's training, of whatever stage, with the settings as they are.
fn results_of_training(study: &Study, library: &Library, cell: &Cell) -> Result<Vec<CellResult>, StudyError> {
    let mut results = Vec::new();
    for same in cells(study).iter().filter(|other| other.name() == cell.name()) {
        results.extend(stored_results(study, library, same)?.into_iter().flatten());
    }
    Ok(results)
}

/// The tests of a cell that have no result of the settings as they are.
fn missing_tests(request: &RobotStudyRequest, cell: &Cell) -> Result<Vec<String>, StudyError> {
    let stored = stored_results(&request.study, &request.library, cell)?;
    let missing = cell.tests.iter().zip(stored).filter(|(_, result)| result.is_none());
    Ok(missing.map(|(name, _)| name.clone()).collect())
}

/// Writes into results that were made before operations were counted how many a query has, and into those made before weights
/// were named which they are, where the entry is still there.
fn complete(request: &RobotStudyRequest, cell: &Cell, missing: &[String]) -> Result<(), StudyError> {
    for test in cell.tests.iter().filter(|test| !missing.contains(test)) {
        let path = request.study.results.join(cell.file_name(test));
        let whole = |result: &CellResult| result.query_flops.is_some() && result.names_its_weights();
        let Some(result) = CellResult::read(&path)?.filter(|result| !whole(result)) else { continue };
        let (experiment, _) = experiment(&request.study, &request.library, cell)?;
        let data = &request.study.data[&cell.data];
        let Some(entry) = request.trained(&experiment.entry, &result.settings, data)? else { continue };
        let query_flops = match result.query_flops {
            None => query_flops(&entry.load()?, &result.test_definition.thinking)?,
            counted => counted,
        };
        let complete = CellResult { query_flops, ..result.clone() }.with_weights_of(entry.meta());
        if complete != result {
            complete.write(&path)?;
        }
    }
    Ok(())
}

/// Floating-point operations of a query of `entry` that thinks as `thinking` says, as long as it may.
fn query_flops(entry: &LoadedEntry, thinking: &Thinking) -> Result<Option<f64>, ZooError> {
    let thoughts = thinking.starts.map_or(1, |starts| starts.count) as f64;
    Ok(entry.thinking(thinking)?.model().query_flops().map(|flops| flops * thoughts))
}

/// The experiment of a cell, under the name of its entry, and the hash of what it depends on.
fn experiment(study: &Study, library: &Library, cell: &Cell) -> Result<(Experiment, String), StudyError> {
    let arm = &study.arms[&cell.arm];
    let mut set = arm.set.clone();
    set.push(format!("train.seed={}", cell.seed));
    let experiment = Experiment::load(library, &study.experiment_on(&cell.arm, &cell.data), &set)?;
    let settings = settings_hash(&experiment);
    let entry = match study.zoo {
        Some(_) => member_name(&experiment.entry, cell.seed),
        // another definition is another entry, so that a changed arm is trained anew
        None => run_name(cell, &settings),
    };
    Ok((Experiment { entry, ..experiment }, settings))
}

/// The same training without the study, as a command.
fn train_command(study: &Study, cell: &Cell, entry: &str, data: &Path) -> String {
    let arm = &study.arms[&cell.arm];
    let mut words = vec!["actrm-zoo".to_owned(), "train".to_owned(), study.experiment_on(&cell.arm, &cell.data)];
    words.extend(arm.set.iter().map(|word| shell_quoted(word)));
    words.extend([format!("train.seed={}", cell.seed), format!("entry={entry}"), "--data".to_owned()]);
    words.push(shell_quoted(&data.display().to_string()));
    words.join(" ")
}

/// Hash of what an experiment's outcome depends on: not its name, seed and path.
fn settings_hash(experiment: &Experiment) -> String {
    let mut flat = experiment.flat();
    for key in ["entry", "description", "train.seed", "data.path"] {
        flat.remove(key);
    }
    let text: Vec<String> = flat.iter().map(|(key, value)| format!("{key}={value}\n")).collect();
    sha256_hex(text.concat().as_bytes())
}

/// A cell by its name and the hash of what it depends on.
fn run_name(cell: &Cell, settings: &str) -> String {
    format!("{}-{}", cell.name(), &settings[..8])
}

impl RobotStudyRequest {
    /// The zoo that gets the entries.
    fn zoo(&self) -> PathBuf {
        self.study.zoo.clone().unwrap_or_else(|| self.work.join("zoo"))
    }

    /// The newest entry called `name` that was trained with these settings after these demonstrations. Cells of one experiment
    /// after different demonstrations are versions of one name.
    fn trained(&self, name: &str, settings: &str, data: &Data) -> Result<Option<Entry>, ZooError> {
        let zoo = Registry::open(&self.zoo());
        // the ids are of whole entries: whoever was killed while he made one leaves a folder, too
        for id in zoo.ids()?.into_iter().rev().filter(|id| id.name == name) {
            let entry = zoo.entry(&id.to_string())?;
            let its = Experiment::from_toml(&id.to_string(), &entry.config_text()?)?;
            let after = entry.meta().data.as_ref().map(|data| data.name.as_str());
            if settings_hash(&its) == settings && after == Some(data.file_name().as_str()) {
                return Ok(Some(entry));
            }
        }
        Ok(None)
    }
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
    /// cells that were not tested further, because their results are of another training
    left: Mutex<Vec<String>>,
    /// whether a cell was left because an end was asked for
    stopped: AtomicBool,
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
        loop {
            let Some(cell) = lock(&self.due).pop_front() else { return };
            let end = if self.stopped() { Ok(CellEnd::Stopped) } else { self.cell(&cell) };
            match end {
                Ok(CellEnd::Done) => {}
                Ok(CellEnd::Left) => lock(&self.left).push(cell.name()),
                Ok(CellEnd::Stopped) => {
                    self.stopped.store(true, Ordering::Relaxed);
                    return;
                }
                Err(error) => {
                    lock(&self.failure).get_or_insert(error.of(&cell));
                    return;
                }
            }
        }
    }

    fn cell(&self, cell: &Cell) -> Result<CellEnd, StudyError> {
        let study = &self.request.study;
        let (arm, data) = (&study.arms[&cell.arm], &study.data[&cell.data]);
        let (experiment, settings) = experiment(study, &self.request.library, cell)?;
        let (zoo, name) = (self.request.zoo(), experiment.entry.clone());
        let earlier = results_of_training(study, &self.request.library, cell)?;
        let told = earlier.iter().all(CellResult::names_its_weights);
        let trained = || self.request.trained(&name, &settings, data);
        if self.request.data_only {
            let collected = self.demonstrations(&cell.data, data)?;
            return Ok(if collected.is_some() { CellEnd::Done } else { CellEnd::Stopped });
        }
        if !told && trained()?.is_none() {
            return Ok(CellEnd::Left);
        }
        // other demonstrations are another run
        let depends = sha256_hex(format!("{settings} {}", data.file_name()).as_bytes());
        let run = self.request.work.join("runs").join(run_name(cell, &depends));
        let training = lock(&self.training[&cell.name()]);
        let stored = match trained()? {
            Some(entry) => entry,
            None => {
                let Some(file) = self.demonstrations(&cell.data, data)? else { return Ok(CellEnd::Stopped) };
                let request = TrainRequest {
                    name: study.experiment_on(&cell.arm, &cell.data),
                    command: Some(train_command(study, cell, &name, &file)),
                    experiment,
                    data: Some(file),
                    runs: self.request.work.join("runs"),
                    resume: run.join("config.toml").exists(),
                    run: Some(run),
                    zoo: zoo.clone(),
                    from_zoo: None,
                    force: false,
                    image_memory: None,
                    device: self.request.device,
                };
                let mut steps = 0;
                let outcome = train(&request, &|| self.stopped(), &mut |event| match event {
                    TrainEvent::Begin { steps: all, .. } => steps = all,
                    TrainEvent::Step(row) => self.tell(RobotEvent::Training(&cell.name(), row.step, steps)),
                    _ => {}
                })?;
                match outcome {
                    TrainOutcome::Finished { entry, .. } => Registry::open(&zoo).entry(&entry.to_string())?,
                    TrainOutcome::Stopped { .. } => return Ok(CellEnd::Stopped),
                }
            }
        };
        drop(training);
        if !earlier.iter().all(|result| result.is_of(stored.meta())) {
            return Ok(CellEnd::Left);
        }
        let entry = stored.load()?;
        for test in missing_tests(self.request, cell)? {
            let definition = &study.tests[&test];
            self.tell(RobotEvent::Testing(&cell.name(), &test));
            // what an entry does where it thinks or sees otherwise is no result of the entry
            let results = match definition.is_plain() {
                true => zoo.join("results"),
                false => self.request.work.join("otherwise").join(&test),
            };
            let Some(evaluation) = self.evaluate((&stored, &entry), definition, &results)? else {
                return Ok(CellEnd::Stopped);
            };
            let of_test = (test.as_str(), definition);
            let flops = query_flops(&entry, &definition.thinking)?;
            let result =
                CellResult::new(cell, (arm, data), of_test, settings.clone(), flops, stored.meta(), &evaluation);
            result.write(&study.results.join(cell.file_name(&test)))?;
            self.tell(RobotEvent::Result(&result));
            let mut done = lock(&self.done);
            *done += 1;
            self.tell(RobotEvent::Done(*done, self.total));
        }
        Ok(CellEnd::Done)
    }

    /// A worker for `task`, without cameras.
    fn worker(&self, task: &str) -> Result<WorkerSpec, StudyError> {
        Ok(WorkerSpec::new(self.request.python.clone(), harness_folder()?, task))
    }

    /// One simulator, in this thread's cell alone.
    fn simulator(&self, spec: WorkerSpec) -> Result<Pool, StudyError> {
        let stop = Arc::clone(&self.request.stop);
        Ok(Pool::start(PoolOptions { stop, ..PoolOptions::new(spec, 1) })?)
    }

    /// The file of demonstrations, collected if it is not there; nothing if that was stopped.
    fn demonstrations(&self, name: &str, data: &Data) -> Result<Option<PathBuf>, StudyError> {
        let _one_at_a_time = lock(&self.collecting[name]);
        let folder = self.request.work.join("data");
        let file = folder.join(data.file_name());
        if file.exists() {
            return Ok(Some(file));
        }
        std::fs::create_dir_all(&folder).map_err(|source| ZooError::Io {
            operation: "create folder",
            path: folder.clone(),
            source,
        })?;
        let mut worker = self.worker(&data.task)?;
        if let Some(cameras) = &data.cameras {
            worker.cameras.clone_from(&cameras.names);
            (worker.image_size, worker.fast_render) = (cameras.size, cameras.fast_render);
        }
        let mut pool = self.simulator(worker)?;
        let options = CollectOptions {
            out: file.clone(),
            episodes: data.episodes,
            seed: data.seed,
            env_module: None,
            expert: data.expert.clone(),
            skill: data.skill,
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
        (stored, entry): (&Entry, &LoadedEntry),
        test: &Test,
        results: &Path,
    ) -> Result<Option<Box<zoo::results::StoredEvaluation>>, StudyError> {
        let environment = Environment::of(stored.meta(), Some(&test.task), None)?;
        let worker = match &environment.cameras {
            // drawn as the demonstrations were
            Some(_) => environment.worker(self.request.python.clone(), harness_folder()?),
            None => self.worker(&test.task)?,
        };
        let mut pool = self.simulator(worker)?;
        let options = EvaluationOptions {
            seeds: Seeds { start: test.seed_start, count: test.episodes },
            shard: None,
            env_module: None,
            force: false,
        };
        let end = match thinking_subject(entry, &test.thinking, &mut pool) {
            Ok(Some(mut subject)) => {
                subject.perturbation = test.perturbation();
                evaluate(&subject, &mut pool, results, &options, &mut |_| {})
            }
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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    const STUDY: &str = r#"
        title = "T"
        results = "RESULTS/results"
        page = "RESULTS/page.md"
        [data.lift]
        task = "Lift"
        episodes = 20
        [arms.act]
        label = "ACT"
        experiment = "act_{data}"
        [tests.t]
        task = "Lift"
        episodes = 4
        seed_start = 40000
        [tests.v]
        task = "Lift"
        episodes = 6
        seed_start = 40000
        [tests.u]
        task = "Lift"
        episodes = 8
        seed_start = 40000
        [[cells]]
        arms = ["act"]
        data = "lift"
        seeds = 1
        tests = ["t", "v"]
        [[cells]]
        arms = ["act"]
        data = "lift"
        seeds = 1
        tests = ["u"]
        stage = 2
    "#;

    /// A study that runs nothing: there is no Python.
    fn request(study: Study, folder: &Path) -> RobotStudyRequest {
        RobotStudyRequest {
            study,
            library: Library::built_in(),
            work: folder.join("work"),
            only: Vec::new(),
            cells: Vec::new(),
            stage: None,
            data_only: false,
            device: DeviceChoice::Cpu,
            jobs: 1,
            python: Python { path: "nowhere".into(), origin: "a test".to_owned() },
            stop: Arc::new(|| false),
        }
    }

    /// A cell with a result whose entry is gone is left before anything is collected or trained for it.
    #[test]
    fn further_tests_are_not_of_another_training() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("study.toml");
        std::fs::write(&file, STUDY.replace("RESULTS", &folder.path().display().to_string())).unwrap();
        let study = Study::open(&file).unwrap();
        let library = Library::built_in();
        let cell = cells(&study).into_iter().next().unwrap();
        let (_, settings) = experiment(&study, &library, &cell).unwrap();
        let episode = |seed: u64| serde_json::json!({"seed": seed, "success": true, "steps": 60});
        let of = |weights: Option<&str>, parameters: u64| -> CellResult {
            serde_json::from_value(serde_json::json!({
                "format": 1, "arm": cell.arm, "arm_definition": study.arms[&cell.arm], "data": cell.data,
                "data_definition": study.data[&cell.data], "test": "t", "test_definition": study.tests["t"],
                "seed": 1, "settings": settings, "entry": {"name": "e", "version": 1, "hash": "h"}, "weights": weights,
                "training": {
                    "policy": "act", "parameters": parameters, "steps": 9, "minutes": 3.0, "seed": 1, "data_set": "d",
                    "data_fingerprint": "f", "data_simulator": "1.5.1", "demos": 18,
                },
                "protocol": {
                    "rules": 1, "task": "Lift", "env_name": "Lift", "env_module": null, "env_module_sha256": null,
                    "env_args_sha256": null, "control": "compiled", "max_steps": 200,
                },
                "seeds": {"start": 40_000, "count": 4}, "versions": {}, "query_ms": 1.0,
                "episodes": (40_000..40_004).map(episode).collect::<Vec<_>>(),
            }))
            .unwrap()
        };
        std::fs::create_dir_all(&study.results).unwrap();
        of(None, 100).write(&study.results.join(cell.file_name("t"))).unwrap();
        let request = request(study.clone(), folder.path());
        let error = run_robot_study(&request, &mut |_| {}).unwrap_err();
        assert!(
            matches!(&error, StudyError::OtherTrainings { cells, .. } if *cells == ["act-on-lift-seed1"]),
            "{error}"
        );
        assert!(!request.work.exists(), "nothing was begun");
        for part in ["act-on-lift", "act-on-lift-seed2"] {
            let only = RobotStudyRequest { only: vec![part.to_owned()], ..self::request(study.clone(), folder.path()) };
            let error = run_robot_study(&only, &mut |_| {}).unwrap_err();
            assert_eq!(matches!(error, StudyError::UnknownCell { .. }), part.ends_with('2'), "{error}");
        }

        // an entry of other weights, of the same weights, the entry itself, and what has none
        let meta = |entry: &str| {
            let zoo = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../zoo");
            Registry::open(&zoo).entry(entry).unwrap().meta().clone()
        };
        let lift = meta("lift-act");
        let weights = lift.files[zoo::entry::MODEL_FILE].sha256.clone();
        let itself = CellResult {
            entry: zoo::results::EntryIdentity { name: lift.name.clone(), version: 1, hash: lift.content_sha256() },
            ..of(None, 100)
        };
        assert!(of(Some(&weights), 100).is_of(&lift) && itself.is_of(&lift));
        assert!(!of(None, 100).is_of(&lift) && !of(Some(&weights), 100).is_of(&meta("door-act")));
        assert!(of(None, 0).names_its_weights() && !of(None, 100).names_its_weights());
        assert_eq!(itself.with_weights_of(&lift).weights, Some(weights));
        assert_eq!(of(None, 100).with_weights_of(&lift).weights, None);
    }

    /// What was trained after other demonstrations, or with other settings, is another training under whatever name.
    #[test]
    fn an_entry_is_of_its_demonstrations() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("study.toml");
        std::fs::write(&file, STUDY.replace("RESULTS", &folder.path().display().to_string())).unwrap();
        let zoo = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../zoo");
        let study = Study { zoo: Some(zoo.clone()), ..Study::open(&file).unwrap() };
        let request = request(study, folder.path());
        let entry = Registry::open(&zoo).entry("lift-act-s1").unwrap();
        let settings = settings_hash(&Experiment::from_toml("lift-act-s1", &entry.config_text().unwrap()).unwrap());
        let found = |settings: &str, data: &Data| {
            request.trained("lift-act-s1", settings, data).unwrap().map(|found| found.id().to_string())
        };
        let usual = Data { episodes: 200, ..request.study.data["lift"].clone() };
        assert_eq!(found(&settings, &usual), Some("lift-act-s1@1".to_owned()));
        assert_eq!(found(&settings, &Data { expert: Some("recoveries".to_owned()), ..usual.clone() }), None);
        assert_eq!(found(&settings, &Data { seed: 2, ..usual.clone() }), None);
        assert_eq!(found(&settings[1..], &usual), None);
    }
}
