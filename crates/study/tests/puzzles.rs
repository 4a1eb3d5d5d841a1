//! Solvers and walkers from experiment to leaderboard: short trainings that must reach what is asked of them, the same
//! bytes through stops, results that are found again.

#![allow(clippy::unwrap_used)]

use std::cell::Cell;
use std::fs;
use std::path::{Path, PathBuf};

use audit::KnownEntries;
use puzzles::Task;
use report::csv;
use study::puzzle::{
    AnyExperiment, Baseline, DEPTH, Judge, PUZZLE_COLUMNS, PuzzleEvaluation, PuzzleEvaluationOptions, PuzzleExperiment,
    PuzzleTrainRequest, RECORD_FILE, SolverEntry, Starts, TEST_SEED, audit_puzzles, evaluate_puzzles,
    evaluate_puzzles_again, trace, train_puzzles,
};
use zoo::config::Library;
use zoo::entry::Entry;
use zoo::registry::Registry;
use zoo::run::TrainOutcome;

fn request(root: &Path, name: &str, overrides: &[&str]) -> PuzzleTrainRequest {
    let overrides: Vec<String> = overrides.iter().map(|o| (*o).to_owned()).collect();
    let experiment = AnyExperiment::load(&Library::built_in(), name, &overrides).unwrap();
    PuzzleTrainRequest {
        name: name.to_owned(),
        experiment: experiment.puzzle().expect("an experiment on puzzles"),
        runs: root.join("runs"),
        run: None,
        resume: false,
        zoo: root.join("zoo"),
        command: None,
    }
}

fn finish(request: &PuzzleTrainRequest) -> Entry {
    match train_puzzles(request, &|| false, &mut |_| {}).unwrap() {
        TrainOutcome::Finished { entry, .. } => Entry::open(&request.zoo, &entry).unwrap(),
        TrainOutcome::Stopped { step, .. } => panic!("stopped after step {step}"),
    }
}

fn evaluated(entry: &Entry, root: &Path, puzzles: u64) -> PuzzleEvaluation {
    let options = PuzzleEvaluationOptions {
        task: None,
        givens: None,
        puzzles,
        depth: DEPTH,
        seed: TEST_SEED,
        starts: Starts::ONE,
        views: 1,
        judge: Judge::Halting,
    };
    evaluate_puzzles(&SolverEntry::load(entry, None).unwrap(), &root.join("zoo/results"), &options).unwrap().record
}

#[test]
fn answers_are_the_same_again_and_a_fresh_stream_is_another_evaluation() {
    let root = tempfile::tempdir().unwrap();
    let entry = finish(&request(root.path(), "trm_maze8-original", &["train.steps=2", "train.validate_every=1000000"]));
    let (solver, results) = (SolverEntry::load(&entry, None).unwrap(), root.path().join("zoo/results"));
    let options = PuzzleEvaluationOptions {
        task: None,
        givens: None,
        puzzles: 20,
        depth: 2,
        seed: TEST_SEED,
        starts: Starts::ONE,
        views: 1,
        judge: Judge::Halting,
    };
    let error = evaluate_puzzles_again(&solver, &results, &options).unwrap_err().to_string();
    assert!(error.contains("nothing to run again"), "{error}");
    let first = evaluate_puzzles(&solver, &results, &options).unwrap();
    let second = evaluate_puzzles(&solver, &results, &options).unwrap();
    assert!(!first.was_there && second.was_there && first.record == second.record);
    assert_eq!(evaluate_puzzles_again(&solver, &results, &options).unwrap().record, first.record);
    let fresh = evaluate_puzzles(&solver, &results, &PuzzleEvaluationOptions { seed: 7, ..options.clone() }).unwrap();
    assert!(!fresh.was_there && fresh.folder != first.folder && fresh.record.seed == 7);
}

/// Trains with few steps and evaluates on 200 test puzzles.
fn short(name: &str, overrides: &[&str]) -> PuzzleEvaluation {
    let root = tempfile::tempdir().unwrap();
    let mut all = vec!["train.validate_every=1000000"];
    all.extend(overrides);
    evaluated(&finish(&request(root.path(), name, &all)), root.path(), 200)
}

#[test]
#[ignore = "minutes of training; `make campaign` runs it"]
fn the_studys_mazes_are_learned_to_their_constant_answers() {
    for (name, steps, most) in [
        ("trm_maze8-original", "train.steps=400", 9_922),
        ("cnn_maze8-original", "train.steps=80", 74_850),
        ("trm_maze10-original", "train.steps=100", 28_258),
    ] {
        let result = short(name, &[steps]);
        assert_eq!(result.answers.exact, 200, "{name}: {:?}", result.answers);
        assert!(result.training.parameters <= most, "{name}");
        // and so does who never looked
        assert!(result.baselines.values().any(|counts| counts.exact == 200), "{name}");
    }
}

#[test]
fn walkers_learn_the_studys_maze_by_every_algorithm() {
    for name in ["reinforce_mlp_maze5-rl", "a2c_mlp_maze5-rl", "ppo_mlp_maze5-rl"] {
        let result = short(name, &[]);
        assert_eq!(result.answers.exact, 200, "{name}: 8 moves, every time");
        let sampled = result.sampled.unwrap();
        let random = result.baselines[&Baseline::Random];
        // drawn moves succeed far more often than a random walk's 32%
        assert!(sampled.valid > 150 && random.valid < 100, "{name}: {sampled:?}, {random:?}");
    }
}

/// As `short`, with up to 16 supervision steps.
fn learned(name: &str, overrides: &[&str]) -> PuzzleEvaluation {
    let plain = (TEST_SEED, Starts::ONE, 1, Judge::Halting);
    learned_and_asked(name, overrides, &[plain]).remove(0)
}

/// The same with an evaluation for each seed of test puzzles, number of starts and of views.
fn learned_and_asked(name: &str, overrides: &[&str], asked: &[(u64, Starts, u64, Judge)]) -> Vec<PuzzleEvaluation> {
    let root = tempfile::tempdir().unwrap();
    let mut all = vec!["train.validate_every=1000000", "task.valid_puzzles=5"];
    all.extend(overrides);
    let entry = SolverEntry::load(&finish(&request(root.path(), name, &all)), None).unwrap();
    let evaluate = |&(seed, starts, views, judge): &(u64, Starts, u64, Judge)| {
        let options =
            PuzzleEvaluationOptions { task: None, givens: None, puzzles: 200, depth: 16, seed, starts, views, judge };
        evaluate_puzzles(&entry, &root.path().join("zoo/results"), &options).unwrap().record
    };
    asked.iter().map(evaluate).collect()
}

#[test]
fn a_short_training_finds_ways_through_perfect_mazes_it_has_not_seen() {
    let short = ["train.steps=1700", "train.batch_size=16", "model.hidden_size=24", "model.inner_size=48"];
    let starts = |most: u64| Starts { most, noise: 1.0 };
    let once = (TEST_SEED, Starts::ONE, 1, Judge::Halting);
    let often = (TEST_SEED, starts(3), 1, Judge::Halting);
    let seen = |judge: Judge| (TEST_SEED, Starts::ONE, 8, judge);
    let both = (TEST_SEED, starts(2), 8, Judge::Cells);
    let asked =
        [once, often, often, (7, Starts::ONE, 1, Judge::Halting), seen(Judge::Halting), seen(Judge::Cells), both];
    let results = learned_and_asked("trm_dfs10", &short, &asked);
    let result = &results[0];
    // more starts take more steps where a thought does not settle, the same ones every time; a network trained so briefly,
    // and never from noise, answers fewer that way, but far more than who never looked
    assert_eq!(results[1], results[2]);
    assert!(results[1].steps > result.steps, "{} {}", results[1].steps, result.steps);
    assert!(results[1].answers.exact > 80, "{:?} {:?}", results[1].answers, result.answers);
    assert_eq!(results[1].by_depth, result.by_depth, "of the usual start");
    // of another seed are other puzzles, as hard
    assert_ne!((results[3].seed, &results[3].answers), (result.seed, &result.answers));
    assert!(results[3].answers.exact.abs_diff(result.answers.exact) < 40, "{:?}", results[3].answers);
    // votes make this network no better (111 of 200 where one view has 143), but far better than who never looked; these
    // mazes have walls of two cells to the right and below, in a mirror to the left or above; every view takes its steps
    assert!(results[4].answers.exact > 80 && results[4].answers != result.answers, "{:?}", results[4].answers);
    assert!(results[4].steps > 6 * result.steps && results[4].by_depth == result.by_depth, "{}", results[4].steps);
    // the same views thought about in the same steps, their answers weighed otherwise
    assert_eq!((results[5].judge, results[5].steps), (Judge::Cells, results[4].steps));
    assert!(results[5].answers.exact > 80 && results[5].answers != results[4].answers, "{:?}", results[5].answers);
    // a second thought about every view, from noise, settled or not: they take their steps as well, and all vote
    let (steps, often) = (results[6].steps, results[6].starts.most);
    assert!(often == 2 && steps > results[5].steps * 18 / 10, "{steps} {}", results[5].steps);
    assert!(results[6].answers.exact > 80 && results[6].answers != results[5].answers, "{:?}", results[6].answers);
    assert_eq!(results[6].by_depth, result.by_depth, "of the usual start, as it is seen");
    // along the row and then along the column is the way in a quarter of them
    assert!(result.baselines.values().all(|counts| counts.exact < 70), "{:?}", result.baselines);
    assert!(result.answers.exact > 90, "{:?}", result.answers);
    // none of them is a way that ignores the walls
    assert!(result.answers.detours_valid > 25, "{:?}", result.answers);
}

#[test]
fn a_short_training_fills_sudoku_it_has_not_seen() {
    let result = learned("trm_sudoku4", &["train.steps=900"]);
    assert!(result.baselines.values().all(|counts| counts.exact == 0), "{:?}", result.baselines);
    assert!(result.answers.exact > 100, "{:?}", result.answers);
}

#[test]
#[ignore = "minutes of training; `make campaign` runs it"]
fn a_walker_learns_mazes_with_walls_from_search_and_from_rewards() {
    let searched = short("search_trm_maze5-walls", &["train.steps=250"]);
    // half of them are what random moves reach
    assert!(searched.answers.valid > 140, "{:?}", searched.answers);
    let rewarded = short("ppo_trm_maze5-walls", &["train.steps=25"]);
    assert!(rewarded.answers.valid > 100, "{:?}", rewarded.answers);
}

const TINY_TRM: [&str; 6] = [
    "model.hidden_size=8",
    "model.inner_size=8",
    "train.steps=9",
    "train.batch_size=4",
    "train.validate_every=4",
    "train.checkpoint_every=2",
];
const TINY: [&str; 3] = ["train.steps=9", "train.validate_every=4", "train.checkpoint_every=2"];

#[test]
fn a_run_stopped_anywhere_goes_on_to_the_same_bytes() {
    for (name, overrides) in [
        ("trm_sudoku4", TINY_TRM.as_slice()),
        ("trm_maze8-original", TINY_TRM.as_slice()),
        ("cnn_open8", &TINY),
        ("reinforce_trm3_maze5-rl", &TINY),
        ("ppo_mlp_maze5-walls", &TINY),
    ] {
        let root = tempfile::tempdir().unwrap();
        let mut few = overrides.to_vec();
        few.push("task.valid_puzzles=5");
        let whole = finish(&request(root.path(), name, &few));
        let mut request = request(root.path(), name, &few);
        request.run = Some(root.path().join("interrupted"));
        let mut outcome = None;
        for round in 0..12 {
            let polls = Cell::new(0);
            let stop = || {
                polls.set(polls.get() + 1);
                polls.get() > 2
            };
            outcome = Some(train_puzzles(&request, &stop, &mut |_| {}).unwrap());
            if matches!(outcome, Some(TrainOutcome::Finished { .. })) {
                assert!(round > 2, "it was interrupted");
                break;
            }
            request.resume = true;
        }
        let Some(TrainOutcome::Finished { entry, run, .. }) = outcome else { panic!("{name} never ended") };
        let entry = Entry::open(&request.zoo, &entry).unwrap();
        let model = |entry: &Entry| fs::read(entry.folder().join("model.safetensors")).unwrap();
        assert!(model(&whole) == model(&entry), "{name}: other bytes after interruptions");
        assert_eq!(whole.meta().content_sha256(), entry.meta().content_sha256());
        assert!(run.join("metrics.parquet").is_file());
        // with other settings it does not go on
        fs::remove_file(run.join("finished.json")).unwrap();
        request.experiment.train.lr *= 2.0;
        let error = train_puzzles(&request, &|| false, &mut |_| {}).unwrap_err().to_string();
        assert!(error.contains("train.lr differs"), "{error}");
    }
}

#[test]
fn an_entry_is_evaluated_once_shown_on_the_board_and_refused_where_it_does_not_fit() {
    let root = tempfile::tempdir().unwrap();
    let entry = finish(&request(root.path(), "trm_dfs10", &TINY_TRM));
    let results: PathBuf = root.path().join("zoo/results");
    let first = evaluated(&entry, root.path(), 20);
    assert_eq!(first, evaluated(&entry, root.path(), 20), "a finished one is read again");
    let entries = KnownEntries::open(&Registry::open(&root.path().join("zoo"))).unwrap();
    let board = || audit_puzzles(&results, &entries).unwrap();
    assert_eq!((board().standing, board().left_out.len()), (vec![first.clone()], 0));
    let record = results.join(first.folder_name()).join(RECORD_FILE);
    let honest = std::fs::read_to_string(&record).unwrap();
    std::fs::write(&record, honest.replacen("\"steps\": ", "\"steps\": 1", 1)).unwrap();
    assert!(board().standing.is_empty());
    let reason = board().left_out[0].reason.to_string();
    assert!(reason.contains("puzzles.json: sha256 does not match"), "{reason}");
    std::fs::write(&record, honest).unwrap();
    assert_eq!(first.by_depth.keys().copied().collect::<Vec<_>>(), [1, 2, 4, 8, 16]);
    assert_eq!((first.answers.puzzles, first.task.as_str()), (20, "dfs10"));
    assert!(csv::table(PUZZLE_COLUMNS, [&first]).contains("trm-dfs10,1,trm,dfs10"));
    assert!(entry.card().unwrap().contains("processor time"));

    // shared by all cells, its weights work on larger mazes, but not on Sudoku
    let task = |name: &str| Task::by_name(name).unwrap();
    let larger = SolverEntry::load(&entry, Some(task("dfs16"))).unwrap();
    let seen = trace(&larger, task("dfs16"), 0, 3, 2).unwrap();
    assert_eq!((seen.side, seen.steps.len(), seen.steps[0].answer.len()), (16, 2, 256));
    let error = SolverEntry::load(&entry, Some(task("sudoku4"))).err().unwrap().to_string();
    assert!(error.contains("trm-dfs10@1") && error.contains("5 tokens, 4 answers"), "{error}");
    let error = entry.load().err().unwrap().to_string();
    assert!(error.contains("expected a robot policy, found a puzzle solver"), "{error}");
    let cnn = finish(&request(root.path(), "mlp_maze8-original", &TINY));
    let error = SolverEntry::load(&cnn, Some(task("dfs10"))).err().unwrap().to_string();
    assert!(error.contains("expected 8x8, found 10x10"), "{error}");
    // what would have no effect is refused
    let usual = PuzzleEvaluationOptions {
        task: None,
        givens: None,
        puzzles: 5,
        depth: DEPTH,
        seed: TEST_SEED,
        starts: Starts::ONE,
        views: 1,
        judge: Judge::Halting,
    };
    let cnn = SolverEntry::load(&cnn, None).unwrap();
    for (key, options) in [
        ("--givens", PuzzleEvaluationOptions { givens: Some(5), ..usual.clone() }),
        ("--depth", PuzzleEvaluationOptions { depth: 4, ..usual.clone() }),
        ("--starts", PuzzleEvaluationOptions { starts: Starts { most: 3, noise: 1.0 }, ..usual.clone() }),
        ("--views", PuzzleEvaluationOptions { views: 4, ..usual.clone() }),
    ] {
        let error = evaluate_puzzles(&cnn, &results, &options).unwrap_err().to_string();
        assert!(error.starts_with(&format!("key `{key}`: expected")), "{error}");
    }
}

#[test]
fn experiments_that_cannot_work_are_refused_by_key() {
    let error = |name: &str, change: &str| {
        AnyExperiment::load(&Library::built_in(), name, &[change.to_owned()]).unwrap_err().to_string()
    };
    assert!(error("trm_dfs10", "task.puzzle=dfs11").starts_with("key `task.puzzle`: expected one of maze8-original"));
    assert!(
        error("trm_dfs10", "model.hiden_size=3")
            .contains("unknown key `model.hiden_size` (did you mean `hidden_size`?)")
    );
    assert!(error("trm_dfs10", "model.type=rnn").contains("key `model.type`: expected one of cnn, conv"));
    assert!(error("trm_dfs10", "task.givens=[3, 5]").contains("mazes have no givens"));
    assert!(error("trm_sudoku4", "task.givens=[9, 5]").contains("key `task.givens`"));
    assert!(error("ppo_mlp_maze5-walls", "task.puzzle=sudoku4").contains("mazes that have a way"));
    assert!(error("a2c_trm_maze5-walls", "rl.mirrored=true").contains("only PPO"));
    assert!(error("ppo_mlp_maze5-walls", "rl.algorithm=sarsa").contains("one of a2c, ppo, reinforce, search"));
    for (name, key, value) in [
        ("small-trm_open8", "model.supervision_steps", "0"),
        ("small-trm_open8", "model.inner_steps", "0"),
        ("small-trm_open8", "model.latent", "0"),
        ("small-trm_open8", "model.hidden", "1000000000000"),
        ("cnn_open8", "model.channels", "[0]"),
        ("mlp_maze8-original", "model.hidden", "[0]"),
        ("transformer_dfs10", "model.dim", "0"),
        ("transformer_dfs10", "model.dim", "1"),
        ("transformer_dfs10", "model.heads", "0"),
        ("reinforce_trm3_maze5-rl", "model.high", "0"),
        ("reinforce_trm3_maze5-rl", "model.high", "1"),
        ("reinforce_trm3_maze5-rl", "model.low", "0"),
        ("search_trm_maze5-walls", "model.cycles", "1"),
        ("trm_dfs10", "task.train_puzzles", "9000000000000000000"),
        ("trm_dfs10", "task.valid_puzzles", "0"),
        ("trm_dfs10", "learning.halt_weight", "-1.0"),
        ("trm_dfs10", "learning.halt_weight", "nan"),
        ("trm_dfs10", "learning.state_noise", "inf"),
        // without effect
        ("reinforce_mlp_maze5-rl", "rl.clip", "0.1"),
        ("a2c_mlp_maze5-rl", "rl.epochs", "2"),
        ("search_trm_maze5-walls", "rl.target_kl", "0.1"),
        ("cnn_open8", "learning.halt_weight", "0.5"),
        ("small-trm_open8", "learning.release_solved", "0.5"),
    ] {
        let error = error(name, &format!("{key}={value}"));
        assert!(error.starts_with(&format!("key `{key}`: expected ")), "{name} {key}={value}: {error}");
    }
    // an entry that was trained with such a setting is read
    let mut old = request(Path::new(""), "reinforce_mlp_maze5-rl", &[]).experiment;
    old.rl.as_mut().unwrap().clip = 0.1;
    assert_eq!(PuzzleExperiment::from_toml("old", &old.to_toml()).unwrap(), old);
    let root = tempfile::tempdir().unwrap();
    let request = request(root.path(), "trm_dfs10", &["model.mixing=attention", "model.num_heads=5"]);
    let error = train_puzzles(&request, &|| false, &mut |_| {}).unwrap_err();
    assert!(error.to_string().contains("cannot build the model of `trm-dfs10`"), "{error}");
    assert!(!root.path().join("runs").exists(), "nothing is left of a run that never began");
}
