//! The whole line, small: data set, training, evaluation in robosuite, leaderboard; twice, with the same bytes.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use e2e::{data, howto, lift, root, succeeds, text, zoo};

/// Convert, then the commands of the how-to on one's own file in `folder`, small: a few steps, three episodes. Returns the files
/// whose bytes must not depend on the run.
fn line(folder: &Path, workers: &str) -> BTreeMap<String, Vec<u8>> {
    let at = |name: &str| folder.join(name);
    let (set, entries, runs) = (at("lift"), at("my-zoo"), at("runs"));
    succeeds(&mut data(["convert", text(&lift()), text(&set)]));
    let small = fs::read_to_string(root().join("protocols/lift-v1.toml")).expect("a protocol");
    let small = small.replace("40000-40199", "40000-40002").replace("max_steps = 400", "max_steps = 40");
    fs::create_dir_all(at("protocols")).expect("a folder");
    fs::write(at("protocols/small-v1.toml"), small).expect("a protocol is written");
    for words in howto("Compare ACT with diffusion") {
        assert_eq!(words[0], "actrm-zoo");
        let mut command = zoo([]);
        command.current_dir(folder).env("ACTRM_PROTOCOLS", at("protocols"));
        command.args(words[1..].iter().map(|word| match word.as_str() {
            "mine.hdf5" => text(&set),
            "lift-v1" => "small-v1",
            word => word,
        }));
        match words[1].as_str() {
            "train" => command.args(["--runs", text(&runs), "train.steps=5"]),
            "eval" => command.args(["--workers", workers]),
            _ => &mut command,
        };
        succeeds(&mut command);
    }
    assert!(entries.join("leaderboard.csv").is_file());
    let report = fs::read_to_string(entries.join("report.html")).expect("a report");
    assert!(report.contains("lift-act") && report.contains("lift-diffusion"), "the report names the entries");
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
