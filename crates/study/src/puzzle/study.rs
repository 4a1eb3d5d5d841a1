//! The puzzle study: which experiments with how many seeds, what each is tested on, and a run of it that can be stopped
//! and taken up again.
//!
//! A row of the study is one small JSON file in a results folder. A row whose file is there, made by the same experiment,
//! is not run again; one whose experiment has changed since is.

use std::path::{Path, PathBuf};

use puzzles::Task;

use zoo::config::Library;
use zoo::entry::{Entry, EntryRequest};
use zoo::registry::Registry;
use zoo::run::{TrainEvent, TrainOutcome};
use zoo::{ZooError, sha256_hex};

use super::door::AnyExperiment;
use super::entry::SolverEntry;
use super::evaluation::{DEPTH, Judge, PuzzleEvaluation, PuzzleEvaluationOptions, Starts, TEST_SEED, evaluate_puzzles};
use super::experiment::PuzzleExperiment;
use super::training::{PuzzleTrainRequest, train_puzzles};

/// Test puzzles a row.
pub const STUDY_PUZZLES: u64 = 600;

/// What a trained model is tested on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StudyTest {
    /// Another family than the one trained on.
    pub task: Option<&'static str>,
    /// Givens of a Sudoku, if not the fewest trained on.
    pub givens: Option<usize>,
    /// Most supervision steps.
    pub depth: usize,
    /// Seed of the test puzzles.
    pub seed: u64,
    /// How often a thought may begin.
    pub starts: Starts,
    /// From how many sides a puzzle is seen.
    pub views: u64,
    /// Who weighs what was seen from several.
    pub judge: Judge,
    /// What it should reach.
    pub bar: Option<Bar>,
}

/// What a test should reach: a share of right or of exact answers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bar {
    /// Least share of right answers (a shortest path, the solution, the goal reached).
    pub right: f64,
    /// Least share of exact answers.
    pub exact: f64,
    /// Most weights.
    pub parameters: Option<u64>,
    /// Most processor seconds of training.
    pub cpu_seconds: Option<f64>,
}

/// One experiment of the study.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StudyRow {
    /// The experiment.
    pub experiment: &'static str,
    /// It is trained with the seeds 1 to this.
    pub seeds: u64,
    /// What it is tested on.
    pub tests: &'static [StudyTest],
}

const PLAIN: StudyTest = StudyTest {
    task: None,
    givens: None,
    depth: DEPTH,
    seed: TEST_SEED,
    starts: Starts::ONE,
    views: 1,
    judge: Judge::Halting,
    bar: None,
};
/// Puzzles that were not looked at when settings were chosen and changed.
const FRESH: u64 = 21_000;
/// The same once more: `noisy-trm_dfs10` was trained for a shorter time after its answers to those above had been counted.
const FRESHER: u64 = 23_000;
/// And once more: that every view is thought about from noise as well was chosen after those.
const FRESHEST: u64 = 24_000;
/// As often as a thought that does not settle may begin anew, and from how much noise.
const STARTS: Starts = Starts { most: 8, noise: 1.0 };
/// All the sides of a square.
const VIEWS: u64 = 8;
/// The family that is told apart by the effort of a search.
const RATED: &str = "sudoku9-hard";
/// Fewer than a million weights.
const LARGE: Bar = Bar { right: 1.0, exact: 0.0, parameters: Some(999_999), cpu_seconds: None };
const BAR: Bar = Bar { right: 1.0, exact: 0.0, parameters: None, cpu_seconds: None };

const fn with_bar(bar: Bar) -> StudyTest {
    StudyTest { bar: Some(bar), ..PLAIN }
}

const fn fresh(bar: Bar) -> StudyTest {
    StudyTest { seed: FRESH, ..with_bar(bar) }
}

/// Puzzles rated by search effort, of so many givens or as few as there can be.
const fn hard(givens: usize, views: u64) -> StudyTest {
    StudyTest { task: Some(RATED), givens: Some(givens), depth: 64, views, ..PLAIN }
}

const fn row(experiment: &'static str, seeds: u64, tests: &'static [StudyTest]) -> StudyRow {
    StudyRow { experiment, seeds, tests }
}

const ORIGINAL8: &[StudyTest] = &[with_bar(Bar { exact: 1.0, parameters: Some(9_922), ..BAR })];
const ORIGINAL10: &[StudyTest] = &[with_bar(Bar { exact: 1.0, parameters: Some(28_258), ..BAR })];
const DFS10: &[StudyTest] = &[
    with_bar(Bar { right: 0.995, exact: 0.995, parameters: Some(16_000), cpu_seconds: Some(100.0) }),
    StudyTest { task: Some("dfs16"), depth: 32, bar: Some(Bar { right: 0.9, ..BAR }), ..PLAIN },
    StudyTest { task: Some("dfs20"), depth: 32, bar: Some(Bar { right: 0.9, ..BAR }), ..PLAIN },
    fresh(Bar { right: 0.995, exact: 0.995, ..BAR }),
    StudyTest { task: Some("dfs16"), depth: 128, ..PLAIN },
    StudyTest { task: Some("dfs20"), depth: 128, ..PLAIN },
    StudyTest { task: Some("dfs16"), depth: 32, starts: STARTS, ..PLAIN },
    StudyTest { task: Some("dfs20"), depth: 32, starts: STARTS, ..PLAIN },
    StudyTest { task: Some("dfs16"), depth: 64, views: VIEWS, ..PLAIN },
    StudyTest { task: Some("dfs20"), depth: 64, views: VIEWS, ..PLAIN },
];
const STABLE: &[StudyTest] = &[
    with_bar(Bar { right: 0.995, exact: 0.995, parameters: Some(16_000), ..BAR }),
    StudyTest { task: Some("dfs16"), depth: 32, ..PLAIN },
    StudyTest { task: Some("dfs20"), depth: 32, ..PLAIN },
    StudyTest { task: Some("dfs16"), depth: 128, bar: Some(Bar { right: 0.9, ..BAR }), ..PLAIN },
    StudyTest { task: Some("dfs20"), depth: 128, bar: Some(Bar { right: 0.9, ..BAR }), ..PLAIN },
    StudyTest { task: Some("dfs16"), depth: 64, views: VIEWS, bar: Some(Bar { right: 0.9, ..BAR }), ..PLAIN },
    StudyTest { task: Some("dfs20"), depth: 64, views: VIEWS, bar: Some(Bar { right: 0.9, ..BAR }), ..PLAIN },
];
const LONG_DFS10: &[StudyTest] = &[
    with_bar(Bar { right: 0.995, exact: 0.995, parameters: Some(16_000), ..BAR }),
    StudyTest { task: Some("dfs16"), depth: 64, views: VIEWS, bar: Some(Bar { right: 0.9, ..BAR }), ..PLAIN },
    StudyTest { task: Some("dfs20"), depth: 64, views: VIEWS, bar: Some(Bar { right: 0.9, ..BAR }), ..PLAIN },
    StudyTest { task: Some("dfs16"), depth: 128, ..PLAIN },
    StudyTest { task: Some("dfs20"), depth: 128, ..PLAIN },
];
/// Fresh mazes of another size, from all sides, the answers weighed by the probabilities of their cells.
const fn weighed(task: &'static str) -> StudyTest {
    let bar = Some(Bar { right: 0.9, ..BAR });
    StudyTest { task: Some(task), depth: 64, seed: FRESHER, views: VIEWS, judge: Judge::Cells, bar, ..PLAIN }
}
/// The same with a second thought about every side, from noise.
const fn weighed_twice(task: &'static str) -> StudyTest {
    StudyTest { seed: FRESHEST, starts: Starts { most: 2, ..STARTS }, ..weighed(task) }
}
const NOISY_DFS10: &[StudyTest] = &[
    with_bar(Bar { right: 0.995, exact: 0.995, parameters: Some(16_000), ..BAR }),
    weighed("dfs16"),
    weighed("dfs20"),
    weighed_twice("dfs16"),
    weighed_twice("dfs20"),
];
const OPEN8: &[StudyTest] = &[
    with_bar(Bar { right: 0.98, exact: 0.96, parameters: Some(9_922), cpu_seconds: None }),
    fresh(Bar { right: 0.98, exact: 0.96, ..BAR }),
];
const SUDOKU4: &[StudyTest] = &[with_bar(BAR), fresh(BAR)];
const SUDOKU6: &[StudyTest] = &[with_bar(Bar { right: 0.99, ..BAR })];
const SUDOKU9: &[StudyTest] = &[
    with_bar(Bar { right: 0.9, ..BAR }),
    StudyTest { givens: Some(30), ..PLAIN },
    StudyTest { givens: Some(30), depth: 128, ..PLAIN },
    StudyTest { givens: Some(30), depth: 32, starts: STARTS, ..PLAIN },
    StudyTest { givens: Some(30), depth: 64, views: VIEWS, ..PLAIN },
    hard(30, 1),
    hard(30, VIEWS),
    hard(24, 1),
    hard(24, VIEWS),
    hard(17, 1),
    hard(17, VIEWS),
];
/// Trained on fewer givens: what is asked of `trm_sudoku9` first is asked of these, too.
const LONG_SUDOKU9: &[StudyTest] = &[
    StudyTest { givens: Some(36), ..PLAIN },
    StudyTest { givens: Some(30), ..PLAIN },
    StudyTest { givens: Some(30), depth: 64, views: VIEWS, bar: Some(Bar { right: 0.95, ..LARGE }), ..PLAIN },
    hard(30, 1),
    hard(30, VIEWS),
    hard(24, 1),
    hard(24, VIEWS),
    hard(17, 1),
    hard(17, VIEWS),
];
const NONE: &[StudyTest] = &[PLAIN];
const MAZE5_RL: &[StudyTest] = &[with_bar(BAR)];
const WALLS_PPO: &[StudyTest] = &[with_bar(Bar { right: 0.95, parameters: Some(6_100), ..BAR })];
const WALLS_SEARCH: &[StudyTest] = &[with_bar(Bar { right: 0.98, parameters: Some(6_100), ..BAR })];

/// The study, the rows that say most first.
pub const STUDY: &[StudyRow] = &[
    row("trm_maze8-original", 3, ORIGINAL8),
    row("small-trm_maze8-original", 3, NONE),
    row("cnn_maze8-original", 3, NONE),
    row("mlp_maze8-original", 3, NONE),
    row("trm_maze10-original", 3, ORIGINAL10),
    row("small-trm_maze10-original", 3, NONE),
    row("transformer_maze10-original", 1, NONE),
    row("trm_dfs10", 3, DFS10),
    row("stable-trm_dfs10", 3, STABLE),
    row("long-trm_dfs10", 3, LONG_DFS10),
    row("noisy-trm_dfs10", 3, NOISY_DFS10),
    row("trm_open8", 3, OPEN8),
    row("trm_sudoku4", 3, SUDOKU4),
    row("reinforce_mlp_maze5-rl", 5, MAZE5_RL),
    row("reinforce_trm3_maze5-rl", 5, MAZE5_RL),
    row("reinforce_trm5_maze5-rl", 5, MAZE5_RL),
    row("a2c_mlp_maze5-rl", 5, MAZE5_RL),
    row("a2c_trm3_maze5-rl", 5, MAZE5_RL),
    row("a2c_trm5_maze5-rl", 5, MAZE5_RL),
    row("ppo_mlp_maze5-rl", 5, MAZE5_RL),
    row("ppo_trm3_maze5-rl", 5, MAZE5_RL),
    row("ppo_trm5_maze5-rl", 5, MAZE5_RL),
    row("ppo_trm_maze5-walls", 5, WALLS_PPO),
    row("ppo_trm2_maze5-walls", 5, NONE),
    row("ppo_mlp_maze5-walls", 5, NONE),
    row("search_trm_maze5-walls", 5, WALLS_SEARCH),
    row("search_trm2_maze5-walls", 5, NONE),
    row("search_mlp_maze5-walls", 5, NONE),
    row("a2c_trm_maze5-walls", 5, NONE),
    row("reinforce_trm_maze5-walls", 5, NONE),
    row("small-trm_open8", 3, NONE),
    row("cnn_open8", 3, NONE),
    row("small-trm_dfs10", 3, NONE),
    row("transformer_dfs10", 1, NONE),
    row("trm_sudoku6", 3, SUDOKU6),
    row("trm_sudoku9", 3, SUDOKU9),
    row("long-trm_sudoku9", 3, LONG_SUDOKU9),
];

impl StudyTest {
    /// The name of the file that holds this test's result for `experiment` with `seed`. It leaves out depths up to 32, the noise
    /// of starts and the number of puzzles, so no two tests of a row may differ in these alone.
    pub fn file_name(&self, experiment: &str, seed: u64) -> String {
        let other = self.task.map_or(String::new(), |task| format!("_on-{task}"));
        let givens = self.givens.map_or(String::new(), |givens| format!("_{givens}-givens"));
        let fresh = if self.seed == TEST_SEED { String::new() } else { format!("_puzzles-{}", self.seed) };
        let depth = if self.depth > 32 { format!("_depth-{}", self.depth) } else { String::new() };
        let starts = if self.starts == Starts::ONE { String::new() } else { format!("_{}-starts", self.starts.most) };
        let views = if self.views == 1 { String::new() } else { format!("_{}-views", self.views) };
        let judge = if self.judge == Judge::Halting { "" } else { "_judged-by-cells" };
        format!("{experiment}_seed-{seed}{other}{givens}{fresh}{depth}{starts}{views}{judge}.json")
    }

    /// Whether a result of `experiment` is of this test.
    fn has(&self, experiment: &str, result: &PuzzleEvaluation) -> bool {
        // experiments are named after their puzzles
        let task = self.task.or_else(|| experiment.rsplit('_').next());
        let of_puzzles = task == Some(result.task.as_str())
            && self.givens.is_none_or(|givens| givens == result.givens)
            && (result.seed, result.answers.puzzles) == (self.seed, STUDY_PUZZLES);
        // what does not recur has no depth
        let thought = result.depth == self.depth || result.depth == 0;
        of_puzzles && thought && (result.starts, result.views, result.judge) == (self.starts, self.views, self.judge)
    }

    /// Whether it is of puzzles that are told apart by the effort of a search.
    pub fn is_rated(&self) -> bool {
        self.task == Some(RATED)
    }

    /// Whether it asks what the first tests of an experiment did not: other puzzles, longer thoughts, more starts or views.
    pub fn is_further(&self) -> bool {
        self.seed != TEST_SEED || self.depth > 32 || self.starts != Starts::ONE || self.views != 1
    }
}

/// Where a study is run and what of it.
#[derive(Debug, Clone)]
pub struct StudyRequest {
    /// Experiments come from here.
    pub library: Library,
    /// Folder of the rows' results.
    pub results: PathBuf,
    /// Folder of runs and of a zoo for the study's entries.
    pub work: PathBuf,
    /// Only these experiments; all if empty.
    pub only: Vec<String>,
    /// Only the seeds up to this.
    pub seeds: Option<u64>,
}

/// What a study tells while it runs.
#[derive(Debug)]
pub enum StudyEvent<'a> {
    /// A row begins.
    Begin(&'a str, u64),
    /// News from its training.
    Training(TrainEvent<'a>),
    /// A result was stored, or was there already (`true`).
    Result(&'a PuzzleEvaluation, bool),
}

/// Runs every row that has no result yet; false if `stop` ended it before the last.
///
/// # Errors
/// Experiments that cannot be trained, files that cannot be written.
pub fn run_study(
    request: &StudyRequest,
    stop: &dyn Fn() -> bool,
    on_event: &mut dyn FnMut(StudyEvent<'_>),
) -> Result<bool, ZooError> {
    std::fs::create_dir_all(&request.results).map_err(ZooError::io("create folder", &request.results))?;
    for row in STUDY {
        if !request.only.is_empty() && !request.only.iter().any(|name| name == row.experiment) {
            continue;
        }
        for seed in 1..=request.seeds.map_or(row.seeds, |most| most.min(row.seeds)) {
            if stop() || !run_row(request, row, seed, stop, on_event)? {
                return Ok(false);
            }
        }
    }
    Ok(true)
}

/// The experiment of a row with its seed.
fn experiment(library: &Library, name: &str, seed: u64) -> Result<PuzzleExperiment, ZooError> {
    let experiment = AnyExperiment::load(library, name, &[format!("train.seed={seed}")])?;
    experiment.puzzle().ok_or_else(|| ZooError::InvalidValue {
        key: "task".to_owned(),
        expected: "a puzzle experiment".to_owned(),
        found: name.to_owned(),
    })
}

/// The result of `test` in `results` if this very experiment made it in this very test.
fn stored(
    results: &Path,
    row: &StudyRow,
    test: &StudyTest,
    seed: u64,
    config: &str,
) -> Result<Option<PuzzleEvaluation>, ZooError> {
    let path = results.join(test.file_name(row.experiment, seed));
    if !path.is_file() {
        return Ok(None);
    }
    let result = PuzzleEvaluation::read(&path)?;
    let of_row = (result.experiment.as_str(), result.training.seed) == (row.experiment, seed);
    Ok((result.config_sha256 == config && of_row && test.has(row.experiment, &result)).then_some(result))
}

/// All of one row with one seed; false if it was stopped.
fn run_row(
    request: &StudyRequest,
    row: &StudyRow,
    seed: u64,
    stop: &dyn Fn() -> bool,
    on_event: &mut dyn FnMut(StudyEvent<'_>),
) -> Result<bool, ZooError> {
    let experiment = experiment(&request.library, row.experiment, seed)?;
    let config = sha256_hex(experiment.to_toml().as_bytes());
    let mut missing = Vec::new();
    for test in row.tests {
        match stored(&request.results, row, test, seed, &config)? {
            Some(result) => on_event(StudyEvent::Result(&result, true)),
            None => missing.push(test),
        }
    }
    if missing.is_empty() {
        return Ok(true);
    }
    on_event(StudyEvent::Begin(row.experiment, seed));
    let zoo = request.work.join("zoo");
    // the folder's name holds what decides the training, so that a changed experiment begins anew
    let run = request.work.join("runs").join(format!("{}_seed-{seed}_{}", row.experiment, &config[..8]));
    let entry = match finished(&run, &zoo)? {
        Some(entry) => entry,
        None => {
            let request = PuzzleTrainRequest {
                name: row.experiment.to_owned(),
                experiment,
                runs: request.work.join("runs"),
                resume: run.join("config.toml").is_file(),
                run: Some(run),
                zoo: zoo.clone(),
                command: None,
            };
            match train_puzzles(&request, stop, &mut |event| on_event(StudyEvent::Training(event)))? {
                TrainOutcome::Finished { entry, .. } => Entry::open(&zoo, &entry)?,
                TrainOutcome::Stopped { .. } => return Ok(false),
            }
        }
    };
    for test in missing {
        let task = test.task.map(super::experiment::family).transpose()?;
        let result = evaluate(&entry, task, test, &request.work.join("results"))?;
        result.write(&request.results.join(test.file_name(row.experiment, seed)))?;
        on_event(StudyEvent::Result(&result, false));
    }
    Ok(true)
}

fn evaluate(entry: &Entry, task: Option<Task>, test: &StudyTest, results: &Path) -> Result<PuzzleEvaluation, ZooError> {
    let StudyTest { givens, depth, seed, starts, views, judge, .. } = *test;
    let options = PuzzleEvaluationOptions { task, givens, puzzles: STUDY_PUZZLES, depth, seed, starts, views, judge };
    Ok(evaluate_puzzles(&SolverEntry::load(entry, task)?, results, &options)?.record)
}

/// The entry of a run that has finished.
fn finished(run: &Path, zoo: &Path) -> Result<Option<Entry>, ZooError> {
    let path = run.join("finished.json");
    if !path.is_file() {
        return Ok(None);
    }
    let text = std::fs::read_to_string(&path).map_err(ZooError::io("read", &path))?;
    let malformed = |reason: &str| ZooError::Malformed { path: path.clone(), reason: reason.to_owned() };
    let note: serde_json::Value = serde_json::from_str(&text).map_err(|e| malformed(&e.to_string()))?;
    let name = note["entry"].as_str().ok_or_else(|| malformed("no entry is named"))?;
    let request: EntryRequest = name.parse()?;
    Registry::open(zoo).entry(&request.to_string()).map(Some)
}

/// A test of a row with the results that there are of it, by seed.
pub type TestedRow = (&'static StudyRow, &'static StudyTest, Vec<PuzzleEvaluation>);

/// Every result of the study that is stored in `results`, in the study's order, by row and test. Results of an experiment
/// that is another one by now are left out.
///
/// # Errors
/// A file that cannot be read, an experiment that `library` lacks.
pub fn study_results(library: &Library, results: &Path) -> Result<Vec<TestedRow>, ZooError> {
    let mut all = Vec::new();
    for row in STUDY {
        let configs: Vec<(u64, String)> = (1..=row.seeds)
            .map(|seed| Ok((seed, sha256_hex(experiment(library, row.experiment, seed)?.to_toml().as_bytes()))))
            .collect::<Result<_, ZooError>>()?;
        for test in row.tests {
            let mut found = Vec::new();
            for (seed, config) in &configs {
                found.extend(stored(results, row, test, *seed, config)?);
            }
            all.push((row, test, found));
        }
    }
    Ok(all)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn a_result_answers_its_own_test_alone() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/results/puzzles/trm_dfs10_seed-1.json");
        let result = PuzzleEvaluation::read(&path).unwrap();
        let row = STUDY.iter().find(|row| row.experiment == "trm_dfs10").unwrap();
        let answered: Vec<usize> =
            (0..row.tests.len()).filter(|&at| row.tests[at].has(row.experiment, &result)).collect();
        assert_eq!(answered, [0]);
        let deeper = StudyTest { depth: 24, ..PLAIN };
        assert!(!deeper.has(row.experiment, &result));
        // under the name of another test's file
        let folder = tempfile::tempdir().unwrap();
        result.write(&folder.path().join(row.tests[2].file_name(row.experiment, 1))).unwrap();
        let found = study_results(&Library::built_in(), folder.path()).unwrap();
        assert!(found.iter().all(|(.., results)| results.is_empty()));
    }

    #[test]
    fn every_row_is_an_experiment_and_every_test_has_a_file_of_its_own() {
        let library = Library::built_in();
        let mut files = BTreeSet::new();
        for row in STUDY {
            let experiment = experiment(&library, row.experiment, 2).unwrap();
            assert_eq!(experiment.train.seed, 2);
            experiment.build(experiment.task.family().unwrap(), 0).unwrap();
            for test in row.tests {
                assert!(test.task.is_none_or(|task| Task::by_name(task).is_some()));
                assert!(files.insert(test.file_name(row.experiment, 1)));
            }
        }
    }
}
