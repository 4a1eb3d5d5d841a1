//! The real programs stopped at every call that changes a file: killed before it, after it, in the middle of a write, or
//! on a disk that is full from then on. Whatever is left can be read, the same command goes on to the same bytes, and
//! no episode that was finished is run again.
//!
//! `ACTRM_FAULTS=all` for every call and every kind of fault, `ACTRM_FAULTS=200` for so many of each command; without it
//! a few, evenly spread.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use e2e::faults::{Action, Call, Ended, Fault, allowed, run};
use e2e::{copied_zoo, copy, listing, succeeds, text, trained, verified, zoo};

/// Some of the faults that these calls can have: `few` of them, or as many as were asked for.
fn faults(calls: &[Call], few: usize) -> Vec<Fault> {
    let can = |action: Action, call: &Call| action != Action::Torn || call.is_write();
    let kinds = [Action::Before, Action::After, Action::Torn, Action::Full].map(|action| -> Vec<Fault> {
        let places = calls.iter().enumerate().filter(|(_, call)| can(action, call)).map(|(at, _)| at);
        places.map(|at| Fault { at, action }).collect()
    });
    let all: usize = kinds.iter().map(Vec::len).sum();
    let wanted = match std::env::var("ACTRM_FAULTS") {
        Ok(text) if text == "all" => all,
        Ok(text) => text.parse().expect("a number, or `all`"),
        Err(_) => few,
    };
    // evenly spread, some of each kind
    let spread = |kind: &Vec<Fault>| -> Vec<Fault> {
        let share = (wanted.min(all) * kind.len()).div_ceil(all);
        (0..share).map(|k| kind[(2 * k + 1) * kind.len() / (2 * share)]).collect()
    };
    kinds.iter().flat_map(spread).collect()
}

/// Runs a command into a fault and says what must hold of its end: a full disk is an error that names a file of ours.
fn struck(command: &mut Command, folder: &Path, fault: Fault) -> Ended {
    let ended = run(command, folder, Some(fault));
    let Some(call) = ended.calls.get(fault.at) else {
        panic!("{fault:?}: {} calls, {}", ended.calls.len(), ended.stderr)
    };
    let told = format!("{fault:?}, {} {}: {}\n{}", call.name, call.path.display(), ended.status, ended.stderr);
    assert!(!ended.stderr.contains("panicked"), "{told}");
    if fault.action != Action::Full {
        assert_eq!(ended.status.code(), None, "killed: {told}");
    } else if ended.calls[fault.at..].iter().any(Call::takes_room) {
        assert_eq!(ended.status.code(), Some(1), "{told}");
        let line = ended.stderr.lines().find(|line| line.starts_with("error: ")).unwrap_or_else(|| panic!("{told}"));
        assert!(line.contains("No space left on device") && line.contains(text(folder)), "{told}");
    }
    ended
}

/// Says which faults there were, and how many.
fn tally(command: &str, calls: &[Call], faults: &[Fault]) {
    let count = |action: Action| faults.iter().filter(|fault| fault.action == action).count();
    let [before, after, torn, full] = [Action::Before, Action::After, Action::Torn, Action::Full].map(count);
    println!(
        "{command}: {} calls; {} faults: {before} before, {after} after, {torn} torn, {full} disk full",
        calls.len(),
        faults.len()
    );
}

/// Hidden names are what a killed writer leaves; nobody lists them.
fn seen(folder: &Path) -> Vec<String> {
    listing(folder).into_iter().filter(|name| !name.starts_with('.')).collect()
}

/// The folder below `runs` that a run was begun in.
fn run_folder(runs: &Path) -> PathBuf {
    let mut folder = runs.to_owned();
    while !folder.join("config.toml").exists() {
        let names = seen(&folder);
        assert_eq!(names.len(), 1, "{}: {names:?}", folder.display());
        folder = folder.join(&names[0]);
    }
    folder
}

#[test]
fn a_training_survives_a_fault_at_any_call() {
    if !allowed() {
        return;
    }
    let root = tempfile::tempdir().expect("a temporary folder");
    let root = root.path().canonicalize().expect("it is there");
    let data = trained().join("lift");
    let train = |folder: &Path| {
        let mut command =
            zoo(["train", "act_lift", "train.steps=4", "train.checkpoint_every=2", "train.validate_every=2"]);
        command.args([
            "train.log_every=1",
            "train.batch_size=4",
            "policy.dim_model=16",
            "policy.n_heads=2",
            "--seeds",
            "1..1",
        ]);
        command.args(["--data", text(&data), "--zoo", text(&folder.join("zoo")), "--runs", text(&folder.join("runs"))]);
        command.env("RAYON_NUM_THREADS", "1");
        command
    };
    let made = |folder: &Path| {
        assert_eq!(seen(&folder.join("zoo")), ["lift-act-s1"]);
        assert_eq!(seen(&folder.join("zoo/lift-act-s1")), ["1"]);
        let read = |name: &str| fs::read(folder.join("zoo/lift-act-s1/1").join(name)).expect("an entry");
        ["model.safetensors", "normaliser.safetensors", "config.toml", "README.md"].map(read)
    };
    let straight = root.join("straight");
    fs::create_dir(&straight).expect("creatable");
    let whole = run(&mut train(&straight), &straight, None);
    assert!(whole.status.success(), "{}", whole.stderr);
    let expected = made(&straight);
    let faults = faults(&whole.calls, 12);
    for fault in &faults {
        let folder = root.join("struck");
        fs::create_dir(&folder).expect("creatable");
        struck(&mut train(&folder), &folder, *fault);
        // what is there is whole, and there is an entry or none
        verified(&folder.join("zoo"));
        succeeds(&mut zoo(["list", "--zoo", text(&folder.join("zoo"))]));
        succeeds(&mut zoo(["runs", "--runs", text(&folder.join("runs")), "--all"]));
        succeeds(&mut train(&folder));
        assert!(made(&folder) == expected, "{fault:?}: other bytes");
        let run = run_folder(&folder.join("runs"));
        let left = [listing(&run), listing(&run.join("checkpoints"))].concat();
        assert!(!left.iter().any(|name| name.starts_with('.')), "{fault:?}: {left:?}");
        fs::remove_dir_all(&folder).expect("removable");
    }
    tally("train", &whole.calls, &faults);
}

fn journal(folder: &Path) -> PathBuf {
    let names = listing(folder);
    names.first().map_or_else(PathBuf::new, |name| folder.join(name).join("journal.jsonl"))
}

#[test]
fn an_evaluation_survives_a_fault_at_any_call() {
    if !allowed() {
        return;
    }
    const EPISODES: usize = 3;
    let (_folder, entries) = copied_zoo();
    let entries = entries.canonicalize().expect("it is there");
    let eval = |results: &Path| {
        let mut command = zoo(["eval", "lift-act@1", "--max-steps", "6", "--episodes", "3", "--workers", "1"]);
        command.args(["--zoo", text(&entries), "--results", text(results)]);
        command
    };
    let outcomes = |results: &Path| {
        let names = listing(results);
        assert_eq!(names.len(), 1, "{names:?}");
        let folder = results.join(&names[0]);
        let mut files = listing(&folder);
        // killed between the seal and the journal's removal: nobody reads it beside a seal
        files.retain(|name| name != "journal.jsonl" || !folder.join("seal.json").exists());
        assert_eq!(files, ["evaluation.json", "lock", "outcomes.parquet", "seal.json", "timings.parquet"]);
        fs::read(folder.join("outcomes.parquet")).expect("a finished evaluation")
    };
    let recorded = |ended: &Ended| {
        ended.calls.iter().filter(|call| call.is_write() && call.path.ends_with("journal.jsonl")).count()
    };
    let at = |name: &str| {
        let path = entries.join(name);
        fs::create_dir(&path).expect("creatable");
        path
    };
    let straight = at("straight");
    let whole = run(&mut eval(&straight), &straight, None);
    assert!(whole.status.success(), "{}", whole.stderr);
    assert_eq!(recorded(&whole), EPISODES, "a line an episode");
    let expected = outcomes(&straight);
    let faults = faults(&whole.calls, 3);
    for fault in &faults {
        let results = at("struck");
        let ended = struck(&mut eval(&results), &results, *fault);
        // a result that is not finished is no result, and nothing is wrong with it
        succeeds(&mut zoo(["verify", "--zoo", text(&entries), "--results", text(&results)]));
        let finished = recorded(&ended)
            - usize::from(ended.calls[fault.at..].iter().any(|call| {
                // the line that was struck may not have come to its end
                call.path.ends_with("journal.jsonl") && call.is_write() && fault.action != Action::After
            }));
        let journal = fs::read(journal(&results)).unwrap_or_default();
        let kept = journal.iter().filter(|&&byte| byte == b'\n').count();
        let again = run(&mut eval(&results), &results, None);
        assert!(again.status.success(), "{fault:?}: {}", again.stderr);
        let sealed = recorded(&again) == 0 && kept == 0;
        assert!(kept >= finished || sealed, "{fault:?}: {finished} episodes were finished, {kept} kept");
        let ran = recorded(&again);
        assert!(sealed || ran + kept == EPISODES, "{fault:?}: {kept} episodes kept, {ran} run; {}", again.stderr);
        assert!(outcomes(&results) == expected, "{fault:?}: other outcomes");
        succeeds(&mut zoo(["verify", "--zoo", text(&entries), "--results", text(&results)]));
        fs::remove_dir_all(&results).expect("removable");
    }
    tally("eval", &whole.calls, &faults);
}

#[test]
fn a_leaderboard_survives_a_fault_at_any_call() {
    if !allowed() {
        return;
    }
    let root = tempfile::tempdir().expect("a temporary folder");
    let root = root.path().canonicalize().expect("it is there");
    let (entries, out) = (root.join("zoo"), root.join("out"));
    fs::create_dir(&entries).expect("creatable");
    let shipped = e2e::root().join("zoo");
    copy(&shipped.join("door-act"), &entries.join("door-act"));
    fs::create_dir(entries.join("results")).expect("creatable");
    for name in listing(&shipped.join("results")).iter().filter(|name| name.starts_with("door-act@1")) {
        copy(&shipped.join("results").join(name), &entries.join("results").join(name));
    }
    let board = || {
        let mut command = zoo(["leaderboard", "--zoo", text(&entries), "--out", text(&out)]);
        command.args(["--markdown", text(&out.join("table.md"))]);
        command
    };
    let names = ["leaderboard.csv", "report.html", "table.md"];
    let files = || names.map(|name| fs::read(out.join(name)).ok());
    fs::create_dir(&out).expect("creatable");
    let whole = run(&mut board(), &out, None);
    assert!(whole.status.success(), "{}", whole.stderr);
    let expected = files();
    let faults = faults(&whole.calls, 12);
    for (k, fault) in faults.iter().enumerate() {
        // over old files, and where there are none
        let old = (k % 2 == 0).then(|| b"old".to_vec());
        for name in names {
            match &old {
                Some(old) => fs::write(out.join(name), old).expect("writable"),
                None => fs::remove_file(out.join(name)).expect("removable"),
            }
        }
        struck(&mut board(), &out, *fault);
        for (found, expected) in files().iter().zip(&expected) {
            assert!(found == expected || *found == old, "{fault:?}: half a file");
        }
        succeeds(&mut board());
        assert!(files() == expected, "{fault:?}: other bytes");
        listing(&out).iter().filter(|name| name.starts_with('.')).for_each(|name| {
            fs::remove_file(out.join(name)).expect("removable");
        });
    }
    tally("leaderboard", &whole.calls, &faults);
}

#[test]
fn the_page_of_a_study_survives_a_fault_at_any_call() {
    if !allowed() {
        return;
    }
    let root = tempfile::tempdir().expect("a temporary folder");
    let root = root.path().canonicalize().expect("it is there");
    let (file, out) = (root.join("study.toml"), root.join("out"));
    let shipped = fs::read_to_string(e2e::root().join("studies/recovery_demonstrations.toml")).expect("a study");
    // charts are drawn beside the results
    let results = root.join("results");
    copy(&e2e::root().join("docs/results/recovery_demonstrations"), &results);
    let shipped = shipped.replace("\"docs/results/recovery_demonstrations\"", &format!("{results:?}"));
    fs::write(
        &file,
        shipped.replace("\"docs/results/recovery_demonstrations.md\"", &format!("{:?}", out.join("page.md"))),
    )
    .expect("writable");
    let study = || zoo(["study", text(&file), "--page-only"]);
    fs::create_dir(&out).expect("creatable");
    let page = || fs::read_to_string(out.join("page.md")).ok();
    let whole = run(&mut study(), &out, None);
    assert!(whole.status.success(), "{}", whole.stderr);
    let expected = page();
    assert!(expected.as_ref().is_some_and(|page| page.contains("# The square nut")));
    let faults = faults(&whole.calls, 8);
    for fault in &faults {
        fs::write(out.join("page.md"), "old").expect("writable");
        struck(&mut study(), &out, *fault);
        assert!(page() == expected || page().as_deref() == Some("old"), "{fault:?}: half a page");
        succeeds(&mut study());
        assert!(page() == expected, "{fault:?}: another page");
    }
    tally("study --page-only", &whole.calls, &faults);
}

#[test]
fn an_alias_and_a_removal_survive_a_fault_at_any_call() {
    if !allowed() {
        return;
    }
    let (_folder, entries) = copied_zoo();
    let entries = entries.canonicalize().expect("it is there");
    let original = entries.join("../original");
    copy(&entries.join("lift-act"), &original);
    let afresh = || {
        if entries.join("lift-act").exists() {
            fs::remove_dir_all(entries.join("lift-act")).expect("removable");
        }
        copy(&original, &entries.join("lift-act"));
    };
    let whole_zoo = || {
        for command in ["verify", "list"] {
            succeeds(&mut zoo([command, "--zoo", text(&entries)]));
        }
    };
    let alias = || zoo(["alias", "lift-act@1", "best", "--zoo", text(&entries)]);
    let named = || fs::read_to_string(entries.join("lift-act/aliases.json")).ok();
    let straight = run(&mut alias(), &entries, None);
    assert!(straight.status.success(), "{}", straight.stderr);
    let expected = named();
    assert!(expected.as_deref().is_some_and(|text| text.contains("best")), "{expected:?}");
    let aliased = faults(&straight.calls, 8);
    for fault in &aliased {
        afresh();
        struck(&mut alias(), &entries, *fault);
        whole_zoo();
        assert!(named().is_none() || named() == expected, "{fault:?}: half a file");
        succeeds(&mut alias());
        assert_eq!(named(), expected, "{fault:?}");
    }
    tally("alias", &straight.calls, &aliased);

    afresh();
    let remove = || zoo(["remove", "lift-act@1", "--zoo", text(&entries)]);
    let straight = run(&mut remove(), &entries, None);
    assert!(straight.status.success(), "{}", straight.stderr);
    let removed = faults(&straight.calls, 8);
    for fault in &removed {
        afresh();
        struck(&mut remove(), &entries, *fault);
        // there and whole, or gone; and what is gone is not there in part
        whole_zoo();
        let left = run(&mut remove(), &entries, None);
        let told = format!("{fault:?}: {}", left.stderr);
        assert!(left.status.success() || left.stderr.contains("unknown entry"), "{told}");
        assert!(!entries.join("lift-act/1").exists(), "{told}");
        whole_zoo();
    }
    tally("remove", &straight.calls, &removed);
}
