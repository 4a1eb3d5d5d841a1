//! Evaluating a solver on puzzles of the test split, in this process.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use arrow_array::{ArrayRef, BooleanArray, RecordBatch, UInt32Array, UInt64Array};
use models::{ModelError, Rng};
use parquet::arrow::ArrowWriter;
use puzzles::{Puzzle, Split, Task};
use serde::{Deserialize, Serialize};

use audit::{Audit, KnownEntries, check_folder_name};
use zoo::entry::{CONFIG_FILE, training_facts};
use zoo::results::{EntryIdentity, ResultsError, SEAL_FILE, Seal, TrainingFacts, result_folders};
use zoo::{ZooError, sha256_file, sha256_hex, write_atomic};

use super::entry::{ProgressPoint, SolverEntry};
use super::grade::{Baseline, Counts, EffortBand};
use super::solver::{Solver, Start, Thought, settled};
use super::walk;

/// Seed of the test puzzles: every solver answers the same ones.
pub const TEST_SEED: u64 = 20_000;
/// Seed of the validation puzzles.
pub(super) const VALID_SEED: u64 = 10_000;

/// Numbers of supervision steps after which answers are graded, as far as an evaluation goes.
pub const DEPTHS: [usize; 8] = [1, 2, 4, 8, 16, 32, 64, 128];

/// A finished evaluation of a solver.
pub const RECORD_FILE: &str = "puzzles.json";

const OUTCOMES_FILE: &str = "outcomes.parquet";

/// Most supervision steps, where no other number is asked for.
pub const DEPTH: usize = 16;

/// Puzzles answered at once.
const BATCH: usize = 50;

/// What the vote of an answer that has not settled counts, against one of a settled one.
const UNSETTLED: f32 = 0.01;

/// Most views of a puzzle: a square has eight, and no more are worth their time where a Sudoku's digits are renamed.
pub const MOST_VIEWS: u64 = 8;

/// What to evaluate on.
#[derive(Debug, Clone, PartialEq)]
pub struct PuzzleEvaluationOptions {
    /// Another family than the entry's.
    pub task: Option<Task>,
    /// Givens of a Sudoku; the fewest that the entry was trained on unless given.
    pub givens: Option<usize>,
    /// Number of puzzles.
    pub puzzles: u64,
    /// Most supervision steps.
    pub depth: usize,
    /// Seed of the puzzles: [`TEST_SEED`] for those that every solver answers, another for a fresh stream of the same split.
    pub seed: u64,
    /// How often a thought about a puzzle may begin; of several views, how often a thought about each of them begins.
    pub starts: Starts,
    /// From how many sides a puzzle is seen: turned or in a mirror, a Sudoku with its digits renamed; up to
    /// [`MOST_VIEWS`]. Each thought's answer has as many votes as `judge` gives it.
    pub views: u64,
    /// Who weighs the answers of several views.
    pub judge: Judge,
}

impl PuzzleEvaluationOptions {
    /// The options as far as a solver and its puzzles take them.
    ///
    /// # Errors
    /// An entry of a family that is not there.
    pub fn fitting(self, entry: &SolverEntry) -> Result<Self, ZooError> {
        let givens = match self.task.map_or_else(|| entry.experiment().task.family(), Ok)? {
            Task::Maze(_) => None,
            Task::Sudoku(_) => self.givens,
        };
        Ok(match entry.solver().is_recursive() {
            true => Self { givens, ..self },
            false => Self { givens, depth: DEPTH, starts: Starts::ONE, views: 1, ..self },
        })
    }
}

/// Who says how many votes a view's answer has.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Judge {
    /// The halting head: its probability that the answer is right.
    #[default]
    Halting,
    /// The answer itself: the product of the probabilities that its cells have. One cell in doubt is seen, where the halting
    /// head's mean over many cells hides it.
    Cells,
}

impl Judge {
    /// Its name in commands and files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Halting => "halting",
            Self::Cells => "cells",
        }
    }

    #[expect(clippy::trivially_copy_pass_by_ref, reason = "serde hands over a reference")]
    fn is_halting(&self) -> bool {
        *self == Self::Halting
    }
}

/// How often a thought about a puzzle may begin: once as the solver was trained, and where it does not settle, again from
/// noise. The first answer that settles counts; where none does, the one that the halting head is most sure of. Where a puzzle
/// is seen from several sides, a thought about every view begins so often, settled or not, and all answers are voted on.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Starts {
    /// Most starts.
    pub most: u64,
    /// Standard deviation of the noise on both states.
    pub noise: f64,
}

/// How a solver is asked.
#[derive(Debug, Clone, Copy)]
pub(super) struct Looks {
    /// Most supervision steps of a thought.
    pub(super) most: usize,
    /// How often it may begin.
    pub(super) starts: Starts,
    /// From how many sides a puzzle is seen: turned or in a mirror, a Sudoku with its digits renamed. Every view is thought
    /// about to its end.
    pub(super) views: u64,
    /// Who weighs their answers.
    pub(super) judge: Judge,
}

impl Looks {
    /// Once, as it is.
    pub(super) fn once(most: usize) -> Self {
        Self { most, starts: Starts::ONE, views: 1, judge: Judge::Halting }
    }
}

fn one() -> u64 {
    1
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde hands over a reference")]
fn is_one(views: &u64) -> bool {
    *views == 1
}

impl Starts {
    /// The usual start alone.
    pub const ONE: Self = Self { most: 1, noise: 0.0 };

    fn is_one(&self) -> bool {
        self.most == 1
    }

    fn one() -> Self {
        Self::ONE
    }
}

/// Everything that an evaluation found, in counts: `puzzles.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PuzzleEvaluation {
    /// Version of this file's layout.
    pub format: u32,
    /// The entry.
    pub entry: EntryIdentity,
    /// Where it comes from.
    pub training: TrainingFacts,
    /// Processor seconds of its training.
    pub cpu_seconds: f64,
    /// The experiment that made it.
    pub experiment: String,
    /// SHA-256 of its resolved text.
    pub config_sha256: String,
    /// The family of puzzles.
    pub task: String,
    /// Givens of a Sudoku at least; 0 for mazes.
    pub givens: usize,
    /// Seed of the puzzles, which are of the test split.
    pub seed: u64,
    /// Most supervision steps that it was given.
    pub depth: usize,
    /// How often a thought might begin.
    #[serde(default = "Starts::one", skip_serializing_if = "Starts::is_one")]
    pub starts: Starts,
    /// From how many sides it saw every puzzle.
    #[serde(default = "one", skip_serializing_if = "is_one")]
    pub views: u64,
    /// Who weighed the answers of its views.
    #[serde(default, skip_serializing_if = "Judge::is_halting")]
    pub judge: Judge,
    /// Its answers: once its halting head is sure of one that stays the same, or after the last step.
    pub answers: Counts,
    /// Supervision steps that these took, or moves of a walker, together.
    pub steps: u64,
    /// A walker's successes with moves drawn as it was trained; `answers` has those with its most probable moves.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sampled: Option<Counts>,
    /// How it did on the way of its training.
    #[serde(default)]
    pub progress: Vec<ProgressPoint>,
    /// Its answers by the guesses that a search needs, of a family that is told apart by them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub by_effort: Vec<EffortBand>,
    /// Its answers after exactly so many steps.
    pub by_depth: BTreeMap<usize, Counts>,
    /// What answers are worth that need no thought.
    pub baselines: BTreeMap<Baseline, Counts>,
}

impl PuzzleEvaluation {
    /// The layout that this program writes.
    pub const FORMAT: u32 = 1;

    /// Mean supervision steps that an answer took.
    pub fn mean_steps(&self) -> f64 {
        self.steps as f64 / self.answers.puzzles.max(1) as f64
    }

    /// The name of its folder: readable, and different for anything that could change an answer.
    pub fn folder_name(&self) -> String {
        let whole = (&self.entry, &self.task, self.givens, self.seed, self.depth, self.answers.puzzles);
        let text = match (self.starts.is_one(), self.views, self.judge) {
            (true, 1, _) => serde_json::to_vec(&whole),
            (false, 1, _) => serde_json::to_vec(&(whole, self.starts)),
            (_, views, Judge::Halting) => serde_json::to_vec(&(whole, self.starts, views)),
            (_, views, judge) => serde_json::to_vec(&(whole, self.starts, views, judge)),
        };
        let hash = sha256_hex(&text.expect("plain fields are always JSON"));
        format!("{}_{}_test-{}_{}", self.entry, self.task, self.answers.puzzles, &hash[..8])
    }

    /// Reads a `puzzles.json`.
    ///
    /// # Errors
    /// When it is not one.
    pub fn read(path: &Path) -> Result<Self, ZooError> {
        let text = std::fs::read(path).map_err(ZooError::io("read", path))?;
        let malformed = |reason: String| ZooError::Malformed { path: path.to_owned(), reason };
        let record: Self =
            serde_json::from_slice(&text).map_err(|e| malformed(format!("not a puzzle evaluation: {e}")))?;
        if record.format != Self::FORMAT {
            return Err(malformed(format!("format: expected {}, found {}", Self::FORMAT, record.format)));
        }
        Ok(record)
    }

    /// Writes it.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), ZooError> {
        let mut text = serde_json::to_vec_pretty(self).expect("plain fields are always JSON");
        text.push(b'\n');
        Ok(write_atomic(path, &text)?)
    }
}

/// Graded answers of one set of puzzles.
pub(super) struct Graded {
    by_depth: BTreeMap<usize, Counts>,
    halting: Counts,
    steps: u64,
    rows: Vec<Row>,
}

/// One puzzle's outcome.
struct Row {
    exact: bool,
    valid: bool,
    steps: usize,
    cells_right: usize,
}

impl Graded {
    /// Counts of the answers given when halted, and the steps these took.
    pub(super) fn halting(&self) -> (Counts, u64) {
        (self.halting, self.steps)
    }
}

/// The answer that a solver is left with.
struct Kept {
    thought: Thought,
    /// Supervision steps so far, of all starts.
    steps: usize,
    settled: bool,
}

impl Kept {
    /// Where thoughts about the puzzle at `place` settle, or their end.
    fn of(thoughts: &[Vec<Thought>], place: usize) -> Self {
        let answer = |at: usize| thoughts[at][place].answer.as_slice();
        let stops = |at: &usize| {
            let before = at.checked_sub(1).map(answer);
            settled(thoughts[*at][place].halt, answer(*at), before)
        };
        let found = (0..thoughts.len()).find(stops);
        let at = found.unwrap_or(thoughts.len() - 1);
        Self { thought: thoughts[at][place].clone(), steps: at + 1, settled: found.is_some() }
    }

    /// Takes another start's answer where that is better, by the solver's own lights.
    fn weigh(&mut self, other: Self) {
        let steps = self.steps + other.steps;
        if other.settled || other.thought.halt > self.thought.halt {
            *self = other;
        }
        self.steps = steps;
    }
}

/// What each view says for its answer: the probability that the judge gives it, or next to nothing if the answer still changes.
/// The product over an answer's cells may be too small for any number, so products are divided by the largest one.
fn votes(views: &[Kept], judge: Judge) -> Vec<f32> {
    let log = |view: &Kept| -> f64 { view.thought.confidence.iter().map(|&sure| f64::from(sure).ln()).sum() };
    let most = views.iter().map(log).fold(f64::NEG_INFINITY, f64::max);
    let vote = |view: &Kept| {
        let sure = match judge {
            Judge::Halting => view.thought.halt.unwrap_or(1.0),
            Judge::Cells => (log(view) - most).exp() as f32,
        };
        if view.settled { sure } else { sure * UNSETTLED }
    };
    views.iter().map(vote).collect()
}

/// The answer that most of the votes are for, the first of equals, with the steps of all.
fn elected(views: Vec<Kept>, judge: Judge) -> Kept {
    let steps = views.iter().map(|view| view.steps).sum();
    let each = votes(&views, judge);
    let votes_for = |answer: &[u8]| -> f32 {
        views.iter().zip(&each).filter(|(view, _)| view.thought.answer == answer).map(|(_, vote)| vote).sum()
    };
    let votes: Vec<f32> = views.iter().map(|view| votes_for(&view.thought.answer)).collect();
    let best = (0..views.len()).fold(0, |best, at| if votes[at] > votes[best] { at } else { best });
    let settled = views.iter().any(|view| view.settled && view.thought.answer == views[best].thought.answer);
    Kept { thought: views[best].thought.clone(), steps, settled }
}

/// Grades `solver` on `puzzles` after each number of steps in `depths` and where it halts.
pub(super) fn graded(
    solver: &Solver,
    puzzles: &[Puzzle],
    depths: &[usize],
    looks: Looks,
) -> Result<Graded, ModelError> {
    let Looks { most, starts, views, judge } = looks;
    let mut graded = Graded {
        by_depth: BTreeMap::new(),
        halting: Counts::default(),
        steps: 0,
        rows: Vec::with_capacity(puzzles.len()),
    };
    if let Solver::Walker { net, task } = solver {
        let walks = walk::walk_all(net.as_ref(), *task, puzzles, None)?;
        graded.halting = walk::count(puzzles, &walks);
        graded.steps = walks.iter().map(|walk| walk.moves as u64).sum();
        graded.rows.extend(puzzles.iter().zip(&walks).map(|(puzzle, walk)| Row {
            exact: walk.reached && puzzle.distance() == Some(walk.moves),
            valid: walk.reached,
            steps: walk.moves,
            cells_right: 0,
        }));
        return Ok(graded);
    }
    let mut kept: Vec<Kept> = Vec::with_capacity(puzzles.len());
    for batch in puzzles.chunks(BATCH) {
        let thoughts = solver.think(batch, most)?;
        for (index, thoughts) in thoughts.iter().enumerate() {
            if depths.contains(&(index + 1)) {
                let counts = graded.by_depth.entry(index + 1).or_default();
                for (puzzle, thought) in batch.iter().zip(thoughts) {
                    add(counts, puzzle, thought);
                }
            }
        }
        let first = kept.len();
        let mut seen: Vec<Vec<Kept>> = (0..batch.len()).map(|place| vec![Kept::of(&thoughts, place)]).collect();
        let numbers: Vec<usize> = (first..first + batch.len()).collect();
        // seen from several sides, every thought has its vote; else another start is for what has not settled
        let begun = if views == 1 { 1 } else { starts.most };
        for (number, view) in (0..begun).flat_map(|number| (0..views).map(move |view| (number, view))).skip(1) {
            let start = Start { puzzles: &numbers, view, number, noise: starts.noise };
            let thoughts = solver.think_from(batch, most, &start)?;
            seen.iter_mut().enumerate().for_each(|(place, views)| views.push(Kept::of(&thoughts, place)));
        }
        kept.extend(seen.into_iter().map(|views| elected(views, judge)));
    }
    let again = if views == 1 { starts.most } else { 1 };
    for number in 1..again {
        let open: Vec<usize> = (0..kept.len()).filter(|&i| !kept[i].settled).collect();
        for chunk in open.chunks(BATCH) {
            let batch: Vec<Puzzle> = chunk.iter().map(|&i| puzzles[i].clone()).collect();
            let start = Start { puzzles: chunk, view: 0, number, noise: starts.noise };
            let thoughts = solver.think_from(&batch, most, &start)?;
            for (place, &i) in chunk.iter().enumerate() {
                kept[i].weigh(Kept::of(&thoughts, place));
            }
        }
    }
    for (puzzle, Kept { thought, steps, .. }) in puzzles.iter().zip(kept) {
        add(&mut graded.halting, puzzle, &thought);
        graded.steps += steps as u64;
        let grade = puzzle.grade(&thought.answer);
        let (exact, valid, cells_right) = (grade.exact, grade.valid, grade.cells_right);
        graded.rows.push(Row { exact, valid, steps, cells_right });
    }
    Ok(graded)
}

fn add(counts: &mut Counts, puzzle: &Puzzle, thought: &Thought) {
    counts.add(puzzle, &thought.answer, &thought.on_path);
}

/// Refuses what the solver or the puzzles cannot do.
fn check(solver: &Solver, task: Task, options: &PuzzleEvaluationOptions) -> Result<(), ZooError> {
    let refused = |key: &str, expected: String, found: String| {
        Err(ZooError::InvalidValue { key: key.to_owned(), expected, found })
    };
    if let (Task::Maze(_), Some(givens)) = (task, options.givens) {
        return refused("--givens", "none: mazes have no givens".to_owned(), givens.to_string());
    }
    let counts = [
        ("--depth", DEPTH as u64, options.depth as u64),
        ("--starts", 1, options.starts.most),
        ("--views", 1, options.views),
    ];
    match counts.into_iter().find(|(_, usual, found)| !solver.is_recursive() && usual != found) {
        Some((key, usual, found)) => refused(key, format!("{usual}: only a TRM takes others"), found.to_string()),
        None => Ok(()),
    }
}

/// An evaluation before it was run: what it depends on.
fn plan(entry: &SolverEntry, options: &PuzzleEvaluationOptions) -> Result<(Task, PuzzleEvaluation), ZooError> {
    let meta = entry.entry().meta();
    let own = entry.experiment().task.family()?;
    let task = options.task.unwrap_or(own);
    check(entry.solver(), task, options)?;
    let puzzle = entry.meta();
    let givens = match task {
        Task::Maze(_) => 0,
        Task::Sudoku(_) => options.givens.unwrap_or(puzzle.givens[0]),
    };
    let record = PuzzleEvaluation {
        format: PuzzleEvaluation::FORMAT,
        entry: EntryIdentity { name: meta.name.clone(), version: meta.version, hash: meta.content_sha256() },
        training: TrainingFacts { data_set: format!("puzzles of {}", meta.task), ..training_facts(meta) },
        cpu_seconds: puzzle.cpu_seconds,
        experiment: meta.experiment.clone(),
        config_sha256: meta.files.get(CONFIG_FILE).map_or_else(String::new, |file| file.sha256.clone()),
        task: task.name().to_owned(),
        givens,
        seed: options.seed,
        starts: options.starts,
        views: options.views,
        judge: if options.views > 1 { options.judge } else { Judge::Halting },
        depth: if entry.solver().is_recursive() { options.depth } else { 0 },
        answers: Counts { puzzles: options.puzzles, ..Counts::default() },
        steps: 0,
        sampled: None,
        progress: puzzle.progress.clone(),
        by_effort: Vec::new(),
        by_depth: BTreeMap::new(),
        baselines: BTreeMap::new(),
    };
    Ok((task, record))
}

/// Runs what `record` plans: fills it in, and gives one row a puzzle.
fn run(
    entry: &SolverEntry,
    task: Task,
    record: &mut PuzzleEvaluation,
    options: &PuzzleEvaluationOptions,
) -> Result<Vec<Row>, ZooError> {
    let (givens, seed) = ((record.givens, record.givens), record.seed);
    let puzzles: Vec<Puzzle> =
        (0..options.puzzles).map(|index| task.numbered(Split::Test, givens, seed, index)).collect();
    let name = record.entry.to_string();
    let failed = |source| ZooError::Model { operation: "evaluate", name: name.clone(), source };
    let looks = Looks { most: options.depth, starts: record.starts, views: record.views, judge: record.judge };
    let graded = graded(entry.solver(), &puzzles, &DEPTHS, looks).map_err(failed)?;
    record.baselines = match entry.solver() {
        Solver::Walker { .. } => Baseline::of_walkers(&puzzles),
        _ => Baseline::grade_all(task, givens, &puzzles),
    };
    if let Solver::Walker { net, task } = entry.solver() {
        let mut rng = Rng::new(seed, "sampled walks");
        let walks = walk::walk_all(net.as_ref(), *task, &puzzles, Some(&mut rng)).map_err(failed)?;
        record.sampled = Some(walk::count(&puzzles, &walks));
    }
    record.by_effort = EffortBand::of(&puzzles, graded.rows.iter().map(|row| row.valid));
    (record.answers, record.steps, record.by_depth) = (graded.halting, graded.steps, graded.by_depth);
    Ok(graded.rows)
}

/// A finished evaluation of a solver.
#[derive(Debug, Clone, PartialEq)]
pub struct EvaluatedPuzzles {
    /// Its folder.
    pub folder: PathBuf,
    /// What it found.
    pub record: PuzzleEvaluation,
    /// Whether it was there already, so that nothing had to be answered.
    pub was_there: bool,
}

/// Evaluates `entry` and stores the result in a folder of its own under `results`; a finished one is read again.
///
/// # Errors
/// A model that fails, files that cannot be written.
pub fn evaluate_puzzles(
    entry: &SolverEntry,
    results: &Path,
    options: &PuzzleEvaluationOptions,
) -> Result<EvaluatedPuzzles, ZooError> {
    let (task, mut record) = plan(entry, options)?;
    let folder = results.join(record.folder_name());
    // without a seal it was made before there were seals, or not to its end: made again
    if let Some(record) = read_sealed(&folder)? {
        return Ok(EvaluatedPuzzles { folder, record, was_there: true });
    }
    let rows = run(entry, task, &mut record, options)?;
    std::fs::create_dir_all(&folder).map_err(ZooError::io("create folder", &folder))?;
    write_outcomes(&folder.join(OUTCOMES_FILE), &rows)?;
    record.write(&folder.join(RECORD_FILE))?;
    // last: its presence says that the evaluation is whole
    seal(&folder, &record)?.write(&folder)?;
    Ok(EvaluatedPuzzles { folder, record, was_there: false })
}

/// Answers the puzzles of a stored evaluation once more and compares every count and every puzzle's outcome.
///
/// # Errors
/// [`ZooError::NothingToCompare`] where none is stored, [`ResultsError::Differ`] naming what is not the same; as
/// [`evaluate_puzzles`].
pub fn evaluate_puzzles_again(
    entry: &SolverEntry,
    results: &Path,
    options: &PuzzleEvaluationOptions,
) -> Result<EvaluatedPuzzles, ZooError> {
    let (task, mut now) = plan(entry, options)?;
    let folder = results.join(now.folder_name());
    let Some(stored) = read_sealed(&folder)? else {
        return Err(ZooError::NothingToCompare {
            entry: now.entry.to_string(),
            seeds: format!("of {} puzzles from seed {}", options.puzzles, options.seed),
            results: results.to_owned(),
            stored: Vec::new(),
        });
    };
    let rows = run(entry, task, &mut now, options)?;
    let bytes = outcomes_bytes(&folder, &rows)?;
    let path = folder.join(OUTCOMES_FILE);
    let differs = |what: &str, expected: String, found: String| {
        Err(ZooError::from(ResultsError::Differ { folder: folder.clone(), what: what.to_owned(), expected, found }))
    };
    let text = |record: &PuzzleEvaluation| serde_json::to_string(record).unwrap_or_default();
    if stored != now {
        return differs(RECORD_FILE, text(&stored), text(&now));
    }
    if std::fs::read(&path).map_err(ZooError::io("read", &path))? != bytes {
        return differs(OUTCOMES_FILE, sha256_file(&path)?, sha256_hex(&bytes));
    }
    Ok(EvaluatedPuzzles { folder, record: stored, was_there: true })
}

/// The seal that an evaluation in `folder` has now.
fn seal(folder: &Path, record: &PuzzleEvaluation) -> Result<Seal, ZooError> {
    let rules = (&record.task, record.givens, record.seed, record.depth, record.answers.puzzles);
    let protocol = sha256_hex(&serde_json::to_vec(&rules).expect("plain fields are always JSON"));
    Ok(Seal::of(folder, &record.folder_name(), &record.entry, &protocol, &[OUTCOMES_FILE, RECORD_FILE])?)
}

/// The evaluation in `folder` if it has a seal, which then is whole.
fn read_sealed(folder: &Path) -> Result<Option<PuzzleEvaluation>, ZooError> {
    let path = folder.join(RECORD_FILE);
    if !path.is_file() || !folder.join(SEAL_FILE).is_file() {
        return Ok(None);
    }
    let record = PuzzleEvaluation::read(&path)?;
    Ok(seal(folder, &record)?.check(folder)?.then_some(record))
}

/// Every finished evaluation of a solver under `results` that stands, and what does not: sealed, in its own folder, of an
/// entry of the zoo that says the same of its training.
///
/// # Errors
/// A folder of results that cannot be listed.
pub fn audit_puzzles(results: &Path, entries: &KnownEntries) -> Result<Audit<PuzzleEvaluation>, ZooError> {
    let standing = |folder: &Path| {
        let record = read_sealed(folder)?.ok_or_else(|| ResultsError::Unfit {
            folder: folder.to_owned(),
            what: "seal".to_owned(),
            expected: "one (evaluating again makes it)".to_owned(),
            found: "none".to_owned(),
        })?;
        check_folder_name(folder, &record.folder_name())?;
        entries.check(folder, &record.entry, &record.training)?;
        Ok(Some(record))
    };
    let mut audit = Audit::default();
    for folder in result_folders(results)? {
        if folder.join(RECORD_FILE).is_file() {
            audit.add(&folder, standing(&folder));
        }
    }
    Ok(audit)
}

/// One row a puzzle: `index`, `exact`, `valid`, `steps`, `cells_right`.
fn write_outcomes(path: &Path, rows: &[Row]) -> Result<(), ZooError> {
    Ok(write_atomic(path, &outcomes_bytes(path, rows)?)?)
}

/// The same as the bytes of the file at `path`.
fn outcomes_bytes(path: &Path, rows: &[Row]) -> Result<Vec<u8>, ZooError> {
    let failed = |source: Box<dyn std::error::Error + Send + Sync>| ZooError::Table {
        operation: "write outcomes to",
        path: path.to_owned(),
        source,
    };
    let flags =
        |of: fn(&Row) -> bool| -> ArrayRef { Arc::new(BooleanArray::from_iter(rows.iter().map(|r| Some(of(r))))) };
    let counts = |of: fn(&Row) -> usize| -> ArrayRef {
        Arc::new(UInt32Array::from_iter_values(rows.iter().map(|row| of(row) as u32)))
    };
    let batch = RecordBatch::try_from_iter([
        ("index", Arc::new(UInt64Array::from_iter_values(0..rows.len() as u64)) as ArrayRef),
        ("exact", flags(|row| row.exact)),
        ("valid", flags(|row| row.valid)),
        ("steps", counts(|row| row.steps)),
        ("cells_right", counts(|row| row.cells_right)),
    ])
    .map_err(|e| failed(Box::new(e)))?;
    let mut bytes = Vec::new();
    let written = || -> Result<(), parquet::errors::ParquetError> {
        let mut writer = ArrowWriter::try_new(&mut bytes, batch.schema(), None)?;
        writer.write(&batch)?;
        writer.close()?;
        Ok(())
    }();
    written.map_err(|e| failed(Box::new(e)))?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn kept(answer: u8, halt: f32, settled: bool) -> Kept {
        let thought = Thought { answer: vec![answer], confidence: Vec::new(), on_path: Vec::new(), halt: Some(halt) };
        Kept { thought, steps: 3, settled }
    }

    #[test]
    fn views_elect_the_answer_that_the_halting_head_believes_most() {
        let answer = |views: Vec<Kept>| {
            let kept = elected(views, Judge::Halting);
            (kept.thought.answer[0], kept.settled, kept.steps)
        };
        assert_eq!(answer(vec![kept(1, 0.9, true), kept(2, 0.8, true), kept(2, 0.6, true)]), (2, true, 9));
        assert_eq!(answer(vec![kept(1, 0.6, true), kept(2, 0.9, false), kept(2, 0.9, false)]), (1, true, 9));
        assert_eq!(answer(vec![kept(1, 0.2, false), kept(2, 0.3, false)]), (2, false, 6));
        assert_eq!(answer(vec![kept(1, 0.7, true), kept(2, 0.7, true)]), (1, true, 6), "the first of equals");
    }

    #[test]
    fn views_elect_the_answer_whose_cells_are_surest_where_these_are_the_judge() {
        let kept = |answer: u8, cells: &[f32], settled: bool| {
            let mut kept = kept(answer, 0.5, settled);
            kept.thought.confidence = cells.to_vec();
            kept
        };
        let answer = |views: Vec<Kept>| elected(views, Judge::Cells).thought.answer[0];
        // one cell in doubt among many sure ones weighs more than all cells somewhat less sure
        let doubt = [1.0, 1.0, 1.0, 0.6];
        assert_eq!(answer(vec![kept(1, &doubt, true), kept(2, &[0.95; 4], true)]), 2);
        assert_eq!(answer(vec![kept(1, &doubt, true), kept(2, &[0.95; 4], true), kept(1, &doubt, true)]), 1);
        assert_eq!(
            answer(vec![kept(1, &doubt, true), kept(2, &[0.95; 4], false)]),
            1,
            "what still changes hardly counts"
        );
        // of a large puzzle the product is too small for a float
        assert_eq!(answer(vec![kept(1, &[0.5; 400], true), kept(2, &[0.6; 400], true)]), 2);
    }
}
