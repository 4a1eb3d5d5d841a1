//! The trained entries that come with the repository: they open, they are on the leaderboard, and a row can be run again.

use std::fs;

use e2e::{listing, root, succeeds, text, zoo};

/// Names of the entries in `zoo/`.
fn entries() -> Vec<String> {
    let folder = root().join("zoo");
    listing(&folder).into_iter().filter(|name| folder.join(name).join("1/entry.json").is_file()).collect()
}

#[test]
fn every_entry_opens_and_has_a_row_on_the_leaderboard() {
    let entries = entries();
    assert!(entries.len() >= 6, "{entries:?}");
    let shipped = root().join("zoo");
    let folder = tempfile::tempdir().expect("a temporary folder");
    succeeds(&mut zoo(["leaderboard", "--zoo", text(&shipped), "--out", text(folder.path())]));
    // a family is one row there; each of its trainings has one here
    let read = |name: &str| fs::read_to_string(folder.path().join(name)).expect("a table");
    let board = read("leaderboard.csv") + &read("leaderboard_trainings.csv");
    for entry in &entries {
        // opening checks every file's hash, every tensor's name and shape
        succeeds(&mut zoo(["show", &format!("{entry}@1"), "--zoo", text(&shipped)]));
        assert!(
            board.lines().any(|row| row.starts_with(&format!("{entry},1,"))),
            "{entry} is not on the board:\n{board}"
        );
    }
}

#[test]
fn a_row_of_the_leaderboard_can_be_run_again() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let results = folder.path().join("results");
    let shipped = root().join("zoo");
    let mut eval = zoo(["eval", "lift-act@1", "--episodes", "3", "--zoo", text(&shipped), "--results", text(&results)]);
    let said = String::from_utf8(succeeds(&mut eval).stdout).expect("text");
    // it solved all of its recorded episodes
    assert!(said.contains("3 of 3"), "{said}");
}
