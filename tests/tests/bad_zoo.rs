//! Bad experiments, entries and interpreters: each gives one clear line, a non-zero exit code, and leaves nothing behind.

use std::fs;

use e2e::{copied_zoo, listing, refused, succeeds, text, trained, zoo};

/// Train in a fresh folder with these arguments: refused, and neither a run nor an entry comes of it.
fn train_refused(arguments: &[&str], words: &[&str]) {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (runs, entries) = (folder.path().join("runs"), folder.path().join("zoo"));
    let mut command = zoo(["train"]);
    command.args(arguments).args(["--zoo", text(&entries), "--runs", text(&runs)]);
    refused(&mut command, words);
    assert!(listing(folder.path()).is_empty(), "{:?}", listing(folder.path()));
}

#[test]
fn an_unknown_experiment() {
    train_refused(&["act_lfit", "--data", text(&trained().join("lift"))], &["act_lfit", "act_lift"]);
}

#[test]
fn a_list_of_nothing_names_what_there_is() {
    for (what, other) in [("--task", "Lfit"), ("--policy", "atc")] {
        let output = succeeds(&mut zoo(["list", "--experiments", what, other]));
        let said = String::from_utf8_lossy(&output.stderr);
        let expected = if what == "--task" { "PickChain, PickPlace" } else { "act, actrm" };
        let begin = format!("no match for {what} {other}; expected one of: ");
        assert!(said.starts_with(&begin) && said.contains(expected), "{said}");
    }
}

#[test]
fn an_unknown_key() {
    train_refused(
        &["act_lift", "--data", text(&trained().join("lift")), "train.stepz=5"],
        &["train.stepz", "did you mean `steps`"],
    );
    train_refused(
        &["act_lift", "--data", text(&trained().join("lift")), "polcy.dim_model=5"],
        &["polcy", "did you mean `policy`"],
    );
}

#[test]
fn an_impossible_value() {
    train_refused(&["act_lift", "--data", text(&trained().join("lift")), "train.steps=many"], &["train.steps"]);
    train_refused(&["act_lift", "--data", text(&trained().join("lift")), "policy.n_heads=7"], &["n_heads", "7"]);
}

#[test]
fn a_data_set_that_is_not_there() {
    train_refused(&["act_lift", "--data", "/nowhere/at/all"], &["/nowhere/at/all"]);
}

#[test]
fn an_unknown_entry() {
    let (_folder, entries) = copied_zoo();
    refused(&mut zoo(["eval", "lift-atc@1", "--episodes", "1", "--zoo", text(&entries)]), &["lift-atc", "lift-act"]);
    refused(&mut zoo(["eval", "lift-act@7", "--episodes", "1", "--zoo", text(&entries)]), &["lift-act", "7"]);
}

#[test]
fn an_empty_zoo() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    refused(&mut zoo(["eval", "--all", "--zoo", text(folder.path())]), &["no entr"]);
    assert!(listing(folder.path()).is_empty());
}

#[test]
fn a_folder_that_was_named_has_to_be_there() {
    let (folder, entries) = copied_zoo();
    let nowhere = folder.path().join("nowhere");
    for command in ["verify", "leaderboard"] {
        refused(&mut zoo([command, "--zoo", text(&nowhere)]), &["--zoo ", "nowhere: expected a folder, found none"]);
        let results = [command, "--zoo", text(&entries), "--results", text(&nowhere)];
        refused(&mut zoo(results), &["--results ", "nowhere: expected a folder, found none"]);
    }
    assert!(!nowhere.exists());
}

#[test]
fn a_python_without_packages() {
    let (folder, entries) = copied_zoo();
    let bare = folder.path().join("bare");
    let made = std::process::Command::new(e2e::root().join(".venv/bin/python"))
        .args(["-m", "venv", "--without-pip"])
        .arg(&bare)
        .output()
        .expect("`make test` has made .venv");
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let python = bare.join("bin/python");
    let mut command =
        zoo(["eval", "lift-act@1", "--episodes", "1", "--zoo", text(&entries), "--python", text(&python)]);
    refused(&mut command, &[text(&python), "it has no numpy", "make venv"]);
}

#[test]
fn a_python_that_is_not_there() {
    let (_folder, entries) = copied_zoo();
    let mut command = zoo(["eval", "lift-act@1", "--episodes", "1", "--zoo", text(&entries), "--python", "/no/python"]);
    refused(&mut command, &["/no/python"]);
}

#[test]
fn an_entry_with_one_flipped_byte() {
    for name in ["model.safetensors", "normaliser.safetensors", "config.toml", "entry.json"] {
        let (_folder, entries) = copied_zoo();
        let file = entries.join("lift-act/1").join(name);
        let mut bytes = fs::read(&file).expect("an entry has this file");
        let middle = bytes.len() / 2;
        bytes[middle] ^= 1;
        fs::write(&file, &bytes).expect("writable");
        refused(&mut zoo(["eval", "lift-act@1", "--episodes", "1", "--zoo", text(&entries)]), &[name]);
    }
}

#[test]
fn a_page_of_a_study_without_results() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (study, page) = (folder.path().join("study.toml"), folder.path().join("page.md"));
    let shipped = fs::read_to_string(e2e::root().join("studies/pillar.toml")).expect("a study");
    let results = folder.path().join("results");
    let shipped = shipped.replace("\"docs/results/pillar.md\"", &format!("{page:?}"));
    let shipped = shipped.replace("\"docs/results/pillar\"", &format!("{results:?}"));
    fs::write(&study, shipped).expect("writable");
    refused(&mut zoo(["study", text(&study), "--page-only"]), &["study.toml", text(&results), "without --page-only"]);
    assert!(!page.exists());
}
