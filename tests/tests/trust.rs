//! The leaderboard before a sceptic: what is forged, damaged or copied is named and left out; the others are ranked.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;

use e2e::{SHIPPED_ACT, listing, root, shipped, succeeds, text, zoo};

/// A leaderboard that leaves something out: exit code 1. What it said on standard error, and its CSV.
fn leaves_out(entries: &Path) -> (String, String) {
    let Output { status, stderr, .. } =
        zoo(["leaderboard", "--zoo", text(entries)]).output().expect("the program starts");
    let said = String::from_utf8(stderr).expect("text");
    assert_eq!(status.code(), Some(1), "{said}");
    assert!(!said.contains("panicked"), "{said}");
    (said, fs::read_to_string(entries.join("leaderboard.csv")).expect("the others are written"))
}

fn result(entries: &Path, name: &str) -> PathBuf {
    let names = listing(&entries.join("results"));
    let found = names.iter().find(|found| found.starts_with(name)).expect("a shipped result");
    entries.join("results").join(found)
}

fn flip(file: &Path) {
    let mut bytes = fs::read(file).expect("readable");
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    fs::write(file, bytes).expect("writable");
}

#[test]
fn what_comes_with_the_repository_is_whole_to_the_last_value() {
    let shipped = root().join("zoo");
    let said = succeeds(&mut zoo(["verify", "--deep", "--zoo", text(&shipped)]));
    let said = String::from_utf8(said.stdout).expect("text");
    assert!(said.contains("lift-act@1: 5 files and 2 results are as they were made"), "{said}");
    assert!(said.lines().count() >= 6, "{said}");
}

#[test]
fn an_entry_says_where_it_comes_from_and_answers_as_when_it_was_sealed() {
    let (_folder, entries) = e2e::copied_zoo();
    let verify = |more: &str| {
        let said = succeeds(&mut zoo(["verify", "lift-act", more, "--zoo", text(&entries)]));
        String::from_utf8(said.stdout).expect("text")
    };
    assert!(verify("--deep").contains("it predicts the stored actions bit for bit"), "{}", verify("--deep"));
    let entry = fs::read_to_string(entries.join("lift-act/1/entry.json")).expect("text");
    let entry: serde_json::Value = serde_json::from_str(&entry).expect("JSON");
    assert_eq!(entry["license"], "apache-2.0");
    assert!(entry["training"]["machine"].as_str().is_some_and(|machine| machine.contains("cores, Linux")), "{entry}");
    let (all, used) = (&entry["data"]["fingerprint"], &entry["data"]["train_fingerprint"]);
    assert!(all != used && used.as_str().is_some_and(|hash| hash.len() == 64), "{entry}");
    for key in ["actrm", "candle", "rustc", "target", "vectors"] {
        assert!(entry["versions"][key].is_string(), "{key}: {entry}");
    }
}

#[test]
fn bad_files_stop_nothing_and_are_named() {
    let (_folder, entries) = shipped(&SHIPPED_ACT);
    succeeds(&mut zoo(["leaderboard", "--zoo", text(&entries)]));
    let all = fs::read_to_string(entries.join("leaderboard.csv")).expect("a leaderboard");
    let rows = |text: &str, entry: &str| text.lines().filter(|row| row.starts_with(entry)).count();

    // a bit of an entry, an empty record, a bit of each table, an edited record, a folder under another name
    flip(&entries.join("lift-act/1/normaliser.safetensors"));
    fs::write(result(&entries, "door-act@1_Door_10000").join("evaluation.json"), "").expect("writable");
    flip(&result(&entries, "stack-act@1_Stack_10000").join("timings.parquet"));
    flip(&result(&entries, "stack-act@1_Stack_40000").join("outcomes.parquet"));
    let record = result(&entries, "nutassemblysquare-act@1_NutAssemblySquare_10000").join("evaluation.json");
    let story = fs::read_to_string(&record).expect("text").replace("\"demos\": 180", "\"demos\": 18");
    fs::write(&record, story).expect("writable");
    let copied = entries.join("results/pickplacecan-act@2_PickPlaceCan_10000-10099_8773bb9f");
    fs::rename(result(&entries, "pickplacecan-act@1_PickPlaceCan_10000"), copied).expect("renamed");
    fs::remove_file(result(&entries, "pickplacecan-act@1_PickPlaceCan_40000").join("seal.json")).expect("removed");

    let (said, board) = leaves_out(&entries);
    for words in [
        "entry lift-act@1",
        "left out: ",
        "normaliser.safetensors: sha256 does not match",
        "evaluation.json: not an evaluation",
        "timings.parquet: sha256 does not match",
        "outcomes.parquet: sha256 does not match",
        "evaluation.json: sha256 does not match",
        "name of the folder: expected pickplacecan-act@1",
        "not sealed",
    ] {
        assert!(said.contains(words), "no {words:?} in\n{said}");
    }
    // lift: the entry and both of its results
    assert_eq!(said.lines().count(), 9, "{said}");
    for (entry, left) in
        [("lift", 0), ("door", 1), ("stack", 0), ("nutassemblysquare", 1), ("pickplacecan", 0), ("stackthreecubes", 2)]
    {
        let entry = &format!("{entry}-act,");
        assert_eq!((rows(&all, entry), rows(&board, entry)), (2, left), "{entry}:\n{board}");
    }
    let report = fs::read_to_string(entries.join("report.html")).expect("a report");
    assert!(report.contains("stackthreecubes-act@1") && !report.contains("pickplacecan-act@1"));

    let verify = zoo(["verify", "--zoo", text(&entries)]).output().expect("the program starts");
    let named = String::from_utf8(verify.stderr).expect("text");
    assert_eq!((verify.status.code(), named.lines().count()), (Some(1), 9), "{named}");
    let one = zoo(["verify", "stackthreecubes-act", "--zoo", text(&entries)]).output().expect("the program starts");
    assert_eq!(one.status.code(), Some(0), "only what was asked for: {}", String::from_utf8_lossy(&one.stderr));

    // of an entry that was asked for, a result under another's name; one without its seal that looks unfinished
    let stray = entries.join("results/stackthreecubes-act@1_copied");
    fs::rename(result(&entries, "nutassemblysquare-act@1_NutAssemblySquare_40000"), stray).expect("renamed");
    let hidden = result(&entries, "door-act@1_Door_40000");
    fs::remove_file(hidden.join("seal.json")).expect("removed");
    fs::write(hidden.join("journal.jsonl"), "").expect("writable");
    let said = |name: &str| {
        let output = zoo(["verify", name, "--zoo", text(&entries)]).output().expect("the program starts");
        String::from_utf8(output.stderr).expect("text")
    };
    assert!(
        said("nutassemblysquare-act").contains("stackthreecubes-act@1_copied: "),
        "{}",
        said("nutassemblysquare-act")
    );
    let words = "not finished: 0 of 200 episodes; outcomes.parquet is there without a seal";
    assert!(said("door-act").contains(words), "{}", said("door-act"));
}

#[test]
fn a_result_of_an_entry_that_is_not_in_the_zoo_has_no_row() {
    let (_folder, entries) = shipped(&SHIPPED_ACT);
    fs::remove_dir_all(entries.join("lift-act")).expect("removed");
    let (said, board) = leaves_out(&entries);
    assert_eq!(said.matches("found lift-act@1").count(), 2, "{said}");
    assert!(!board.contains("\nlift-act,") && board.contains("\nstack-act,"), "{board}");
}

#[test]
fn a_report_that_cannot_be_written_leaves_the_table_as_it_was() {
    let (_folder, entries) = shipped(&["door-act"]);
    fs::create_dir(entries.join("report.html")).expect("creatable");
    fs::write(entries.join("leaderboard.csv"), "old").expect("writable");
    let output = zoo(["leaderboard", "--zoo", text(&entries)]).output().expect("the program starts");
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stderr).contains("report.html"));
    assert_eq!(fs::read_to_string(entries.join("leaderboard.csv")).expect("text"), "old");
}
