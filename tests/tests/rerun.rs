//! `actrm-zoo rerun` as a sceptic runs it: a row again from its demonstrations, and which step differs where something was
//! changed.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;

use e2e::{copy, data, howto, lift, listing, refused, root, signal, succeeds, text, wait_until, zoo};
use serde_json::Value;
use tempfile::TempDir;

/// A zoo with `lift-act@1`, trained for 24 steps on the shipped demonstrations, and a result of two episodes.
fn measured() -> &'static Path {
    static MEASURED: OnceLock<TempDir> = OnceLock::new();
    MEASURED
        .get_or_init(|| {
            let folder = tempfile::tempdir().expect("a temporary folder");
            let (entries, runs) = (folder.path().join("zoo"), folder.path().join("runs"));
            let small = ["train.steps=24", "train.batch_size=16", "train.checkpoint_every=2", "policy.dim_model=64"];
            let mut train = zoo(["train", "act_lift", "--data", text(&lift()), "--zoo", text(&entries)]);
            succeeds(train.args(["--runs", text(&runs)]).args(small));
            let eval = ["eval", "lift-act", "--episodes", "2", "--max-steps", "12", "--zoo", text(&entries)];
            succeeds(&mut zoo(eval));
            folder
        })
        .path()
}

/// A copy of it that a test may change: the folder that holds it, and the zoo.
fn copied() -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let to = folder.path().join("zoo");
    copy(&measured().join("zoo"), &to);
    (folder, to)
}

fn rerun(folder: &Path, more: &[&str]) -> Command {
    let mut command = zoo(["rerun", "lift-act", "--zoo", text(&folder.join("zoo")), "--workers", "1"]);
    command.args(["--work", text(&folder.join("work"))]).args(more);
    command
}

/// What a rerun tells as JSON, with this exit code.
fn told(command: &mut Command, code: i32) -> Value {
    let output = command.arg("--json").output().expect("the program starts");
    let error = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{error}\n{}", String::from_utf8_lossy(&output.stdout));
    serde_json::from_slice(&output.stdout).expect("JSON")
}

/// Each step's outcome, by its name.
fn outcomes(told: &Value) -> Vec<(&str, &str)> {
    let steps = told["steps"].as_array().expect("steps");
    let word = |step: &'static str| move |value: &Value| value[step].as_str().map(str::to_owned);
    assert!(steps.iter().all(|value| word("told")(value).is_some_and(|told| !told.is_empty())), "{told:#}");
    steps.iter().filter_map(|step| Some((step["step"].as_str()?, step["outcome"].as_str()?))).collect()
}

/// What is said of a step.
fn said(told: &Value, step: &str) -> String {
    let steps = told["steps"].as_array().expect("steps");
    let found = steps.iter().find(|value| value["step"] == step).expect("the step");
    found["told"].as_str().expect("text").to_owned()
}

/// Every file below a folder with its bytes.
fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    for name in listing(folder) {
        let path = folder.join(name);
        match path.is_dir() {
            true => found.extend(files(&path)),
            false => drop(found.insert(path.clone(), fs::read(path).expect("readable"))),
        }
    }
    found
}

fn result(entries: &Path) -> PathBuf {
    let names = listing(&entries.join("results"));
    assert_eq!(names.len(), 1, "{names:?}");
    entries.join("results").join(&names[0])
}

const STEPS: [&str; 8] =
    ["entry", "result", "demonstrations", "statistics", "training", "weights", "rules", "episodes"];

#[test]
fn a_row_comes_out_the_same_from_its_demonstrations_to_its_last_episode() {
    let (folder, entries) = copied();
    let before = files(&entries);
    let again = told(&mut rerun(folder.path(), &["--data", text(&lift())]), 0);
    assert_eq!(outcomes(&again), STEPS.map(|step| (step, "same")), "{again:#}");
    assert_eq!((&again["same"], &again["reasons"]), (&true.into(), &Value::Array(Vec::new())));
    assert!(said(&again, "weights").contains("byte for byte"), "{again:#}");
    assert!(said(&again, "episodes").contains("2 of 2 outcomes the same"), "{again:#}");
    assert!(files(&entries) == before, "the zoo is as it was");
    let model = |folder: &Path| fs::read(folder.join("zoo/lift-act/1/model.safetensors")).expect("a model");
    assert!(model(&folder.path().join("work")) == model(folder.path()));

    // once more: what is there is named; the row by its folder, the table for people
    let name = listing(&entries.join("results")).remove(0);
    let mut command = zoo(["rerun", &name, "--zoo", text(&entries), "--work", text(&folder.path().join("work"))]);
    let output = succeeds(command.args(["--data", text(&lift())]));
    let (out, notes) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(out.contains(&format!("{name}: every requested step is the same")), "{out}");
    assert!(notes.contains("trained by an earlier call") && notes.contains("run by an earlier call"), "{notes}");
}

#[test]
fn the_stored_weights_run_alone_and_part_of_the_episodes() {
    let (folder, entries) = copied();
    let again = told(&mut rerun(folder.path(), &["--skip-training", "--episodes", "1"]), 0);
    let expected = STEPS.map(|step| match step {
        "demonstrations" | "statistics" | "training" | "weights" => (step, "not_asked"),
        _ => (step, "same"),
    });
    assert_eq!(outcomes(&again), expected);
    assert!(said(&again, "episodes").contains("1 more were not asked for"), "{again:#}");
    refused(&mut rerun(folder.path(), &["--episodes", "3"]), &["--episodes", "1 to 2", "found 3"]);
    refused(&mut rerun(folder.path(), &["--task", "Stack"]), &["row `lift-act`", "expected one result"]);
    refused(
        &mut rerun(folder.path(), &["--protocol", "lift-v1"]),
        &["expected one result", "lift-act@1_Lift_10000-10001"],
    );
    assert_eq!(listing(&entries.join("results")).len(), 1);
}

#[test]
fn a_rerun_that_was_interrupted_goes_on() {
    let (folder, _) = copied();
    let mut command = rerun(folder.path(), &["--data", text(&lift()), "--episodes", "1"]);
    let child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("it starts");
    let checkpoint = folder.path().join("work/run/checkpoints/latest.json");
    wait_until("a checkpoint", || checkpoint.is_file().then_some(()));
    signal(&child, "INT");
    let output = child.wait_with_output().expect("it ends");
    let notes = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(130), "{notes}");
    assert!(notes.contains("run the same command again to resume"), "{notes}");
    let again = told(&mut rerun(folder.path(), &["--data", text(&lift()), "--episodes", "1"]), 0);
    assert_eq!(again["same"], true);
}

#[test]
fn what_was_edited_is_told_and_nothing_is_run() {
    let (folder, entries) = copied();
    // a bit of the outcomes, as whoever turns a failure into a success has to change
    let path = result(&entries).join("outcomes.parquet");
    let original = fs::read(&path).expect("outcomes");
    let mut bytes = original.clone();
    bytes[40] ^= 1;
    fs::write(&path, bytes).expect("writable");
    let edited = told(&mut rerun(folder.path(), &["--data", text(&lift())]), 1);
    assert_eq!(edited["first_difference"], "result");
    assert!(said(&edited, "result").contains("outcomes.parquet: sha256 does not match"), "{edited:#}");
    assert!(outcomes(&edited)[2..].iter().all(|(_, outcome)| *outcome == "not_compared"), "{edited:#}");
    fs::write(&path, original).expect("writable");

    let config = entries.join("lift-act/1/config.toml");
    let settings = fs::read_to_string(&config).expect("text").replace("steps = 24", "steps = 25");
    fs::write(&config, settings).expect("writable");
    let changed = told(&mut rerun(folder.path(), &["--data", text(&lift())]), 1);
    assert_eq!(changed["first_difference"], "entry");
    assert!(said(&changed, "entry").contains("config.toml: sha256 does not match"), "{changed:#}");
    assert!(!folder.path().join("work").exists(), "nothing was made");
}

#[test]
fn other_demonstrations_are_told_by_their_fingerprint() {
    let (folder, _) = copied();
    let three = root().join("crates/dataset/tests/fixtures/lift_low_dim_3_demos.hdf5");
    let other = told(&mut rerun(folder.path(), &["--data", text(&three)]), 1);
    assert_eq!(other["first_difference"], "demonstrations");
    assert!(said(&other, "demonstrations").contains("45 episodes trained on"), "{other:#}");
    assert!(!folder.path().join("work/run").exists(), "nothing was trained");
    let none = told(&mut rerun(folder.path(), &["--data", "nowhere.hdf5"]), 1);
    assert_eq!(outcomes(&none)[2], ("demonstrations", "not_compared"));
    assert!(said(&none, "demonstrations").contains("nowhere.hdf5"), "{none:#}");
    // the same demonstrations, converted before
    let set = folder.path().join("set");
    succeeds(&mut data(["convert", text(&lift()), text(&set)]));
    assert_eq!(told(&mut rerun(folder.path(), &["--data", text(&set), "--episodes", "1"]), 0)["same"], true);
}

#[test]
fn demonstrations_of_the_scripted_expert_are_collected_again() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (demos, entries) = (folder.path().join("demos.hdf5"), folder.path().join("zoo"));
    let collect =
        ["collect", "--task", "Lift", "--episodes", "4", "--seed", "3", "--workers", "1", "--out", text(&demos)];
    succeeds(&mut data(collect));
    let mut train = zoo(["train", "act_lift", "--data", text(&demos), "--zoo", text(&entries)]);
    train.args(["--runs", text(&folder.path().join("runs"))]);
    succeeds(train.args(["train.steps=4", "train.batch_size=8", "policy.dim_model=32", "data.path=gone.hdf5"]));
    succeeds(&mut zoo(["eval", "lift-act", "--episodes", "1", "--max-steps", "4", "--zoo", text(&entries)]));
    fs::remove_file(&demos).expect("removable");

    // nothing is where the experiment says: the seeds in the entry say how to make it
    let page = howto("Reproduce a row").remove(0);
    assert_eq!(page[..2], ["actrm-zoo", "rerun"]);
    // this small row has no protocol
    let flags: Vec<&str> =
        page[3..].iter().map(String::as_str).filter(|w| !["--protocol", "lift-v1"].contains(w)).collect();
    let again = told(&mut rerun(folder.path(), &flags), 0);
    assert_eq!(outcomes(&again), STEPS.map(|step| (step, "same")), "{again:#}");
    assert!(said(&again, "demonstrations").contains("work/demonstrations.hdf5"), "{again:#}");

    // demonstrations that lie there and are others are not asked about again
    let path = folder.path().join("work/demonstrations.hdf5");
    fs::copy(lift(), &path).expect("copied");
    fs::remove_dir_all(folder.path().join("work/run")).expect("removable");
    let other = told(&mut rerun(folder.path(), &["--collect"]), 1);
    assert_eq!(other["first_difference"], "demonstrations", "{other:#}");
}
