//! Sizes that no machine has room or time for are refused before anything is begun.

use std::fs;
use std::process::Command;

use e2e::{copied_zoo, data, listing, refused, succeeds, text, zoo};

#[test]
fn absurd_sizes_are_refused_beforehand() {
    let (folder, entries) = copied_zoo();
    let eval = |arguments: &[&str]| {
        let mut command = zoo(["eval", "lift-act@1", "--zoo", text(&entries)]);
        command.args(arguments);
        command
    };
    // a simulator that would be started does not start, which would be another message
    let nowhere = ("ACTRM_PYTHON", "/bin/false");
    for (arguments, words) in [
        (&["--workers", "100000"][..], &["--workers 100000", "memory", "free"][..]),
        (&["--workers", "0"], &["--workers 0"]),
        (&["--episodes", "4000000000"], &["--episodes", "4000000000"]),
        (&["--episodes", "0"], &["--episodes"]),
        (&["--seed-start", "18446744073709551615"], &["--seed-start", "18446744073709551615"]),
        (&["--max-steps", "18446744073709551615"], &["--max-steps"]),
        (&["--temporal-ensemble", "1e308"], &["--temporal-ensemble", "finite"]),
        (&["--temporal-ensemble", "-1e308"], &["--temporal-ensemble", "finite"]),
        (&["--temporal-ensemble", "nan"], &["--temporal-ensemble", "finite"]),
    ] {
        refused(eval(arguments).env(nowhere.0, nowhere.1), words);
    }
    let out = folder.path().join("x.hdf5");
    for (arguments, words) in [
        (["--episodes", "4000000000", "--seed", "1"], ["--episodes", "4000000000"]),
        (["--episodes", "1", "--workers", "100000"], ["--workers 100000", "memory"]),
    ] {
        let mut command = data(["collect", "--task", "Lift", "--out", text(&out)]);
        command.args(arguments);
        refused(command.env(nowhere.0, nowhere.1), &words);
    }
    assert_eq!(listing(folder.path()), ["zoo"]);
    assert!(!entries.join("results").exists());
}

#[test]
fn many_puzzles_take_no_more_memory_than_few() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    // the most that a process may allocate, in kB: a fraction of what the puzzles take together
    let limited = |count: &str, name: &str| {
        let out = folder.path().join(name);
        let mut puzzles = data(["puzzle", "maze5-walls", "--count", count]);
        puzzles.arg(&out);
        let mut command = Command::new("bash");
        command
            .args(["-c", "ulimit -S -d 150000; exec \"$@\"", "bash"])
            .arg(puzzles.get_program())
            .args(puzzles.get_args());
        succeeds(&mut command);
        fs::metadata(&out).expect("a file").len()
    };
    let (few, many) = (limited("1000", "few"), limited("300000", "many"));
    assert!(many > 100 * few, "{few} {many}");
}
