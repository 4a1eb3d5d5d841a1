//! The whole line, small: data set, training, evaluation in robosuite, leaderboard; twice, with the same bytes.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use e2e::{data, lift, succeeds, text, zoo};

/// Convert, train briefly, evaluate and rank in `folder`; returns the files whose bytes must not depend on the run.
fn line(folder: &Path, workers: &str) -> BTreeMap<String, Vec<u8>> {
    let at = |name: &str| folder.join(name);
    let (set, entries, runs) = (at("lift"), at("zoo"), at("runs"));
    succeeds(&mut data(["convert", text(&lift()), text(&set)]));
    succeeds(&mut zoo([
        "train",
        "act_lift",
        "--data",
        text(&set),
        "--zoo",
        text(&entries),
        "--runs",
        text(&runs),
        "train.steps=5",
    ]));
    succeeds(&mut zoo([
        "eval",
        "lift-act@1",
        "--episodes",
        "3",
        "--max-steps",
        "40",
        "--workers",
        workers,
        "--zoo",
        text(&entries),
    ]));
    succeeds(&mut zoo(["leaderboard", "--zoo", text(&entries)]));
    assert!(entries.join("leaderboard.csv").is_file());
    let report = fs::read_to_string(entries.join("report.html")).expect("a report");
    assert!(report.contains("lift-act"), "the report names the entry");
    assert!(!report.contains("http://") && !report.contains("https://"), "the report needs nothing from elsewhere");
    let mut files = BTreeMap::new();
    gather(folder, folder, &mut files);
    files.retain(|name, _| {
        name.starts_with("lift/") || name.ends_with("model.safetensors") || name.ends_with("outcomes.parquet")
    });
    files
}

/// Every file below a folder, by its path from `root`.
fn gather(root: &Path, folder: &Path, into: &mut BTreeMap<String, Vec<u8>>) {
    for entry in fs::read_dir(folder).expect("readable") {
        let path = entry.expect("readable").path();
        if path.is_dir() {
            gather(root, &path, into);
        } else {
            let name = path.strip_prefix(root).expect("below the root");
            into.insert(text(name).to_owned(), fs::read(&path).expect("readable"));
        }
    }
}

#[test]
fn the_same_bytes_twice_with_one_worker_and_with_two() {
    let (one, two) = (tempfile::tempdir().expect("a folder"), tempfile::tempdir().expect("a folder"));
    let (first, second) = (line(one.path(), "1"), line(two.path(), "2"));
    assert_eq!(first.keys().collect::<Vec<_>>(), second.keys().collect::<Vec<_>>());
    assert!(first.keys().any(|name| name.ends_with("model.safetensors")));
    assert!(first.keys().any(|name| name.ends_with("outcomes.parquet")), "{:?}", first.keys());
    for (name, bytes) in &first {
        assert!(*bytes == second[name], "{name} differs between two runs");
    }
}
