//! Where the output of the programs goes: to readers that go away, to full disks, to nobody.

use std::fs::{self, File};
use std::path::Path;
use std::process::{Command, Output, Stdio};

use e2e::{copied_zoo, data, lift, listing, succeeds, text, trained, zoo};

/// Ends by itself and does not panic.
fn ran(command: &mut Command) -> Output {
    let output = command.output().expect("the program starts");
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(!error.contains("panicked") && output.status.code().is_some(), "{command:?}: {:?}\n{error}", output.status);
    output
}

/// A pipe that nobody reads any more.
fn closed() -> Stdio {
    let (reader, writer) = std::io::pipe().expect("a pipe");
    drop(reader);
    writer.into()
}

/// A disk without room.
fn full() -> Stdio {
    File::options().write(true).open("/dev/full").expect("Linux has it").into()
}

/// Every command that prints without starting a simulator, on the trained entry.
fn printing(entries: &Path) -> Vec<Command> {
    let with = |arguments: &[&str]| {
        let mut command = zoo([]);
        command.args(arguments).args(["--zoo", text(entries)]);
        command
    };
    let set = trained().join("lift");
    vec![
        with(&["list"]),
        zoo(["list", "--experiments"]),
        with(&["show", "lift-act"]),
        with(&["show", "lift-act", "--config"]),
        with(&["show", "lift-act", "--json"]),
        with(&["train", "act_lift", "--print-config"]),
        zoo(["study", "--list"]),
        zoo(["runs", "--runs", text(&trained().join("runs")), "--all"]),
        zoo(["runs", "--runs", text(&trained().join("runs")), "--all", "--json"]),
        zoo(["completions", "bash"]),
        data(["inspect", text(&set)]),
        data(["inspect", text(&set), "--json"]),
        data(["stats", text(&set)]),
        data(["validate", text(&set)]),
        data(["query", text(&set), "SELECT * FROM episodes"]),
        data(["completions", "zsh"]),
    ]
}

#[test]
fn a_reader_that_has_gone_is_no_error() {
    let (_folder, entries) = copied_zoo();
    for mut command in printing(&entries) {
        let output = ran(command.stdout(closed()));
        assert!(output.status.success() && output.stderr.is_empty(), "{command:?}: {output:?}");
    }
    for mut command in printing(&entries) {
        assert!(ran(command.stdout(closed()).stderr(closed())).status.success(), "{command:?}");
    }
    for mut command in [zoo(["--help"]), data(["--help"]), zoo(["eval", "--help"]), data(["--version"])] {
        ran(command.stdout(closed()));
    }
}

#[test]
fn a_full_disk_is_an_error_in_one_line() {
    let (_folder, entries) = copied_zoo();
    for mut command in printing(&entries) {
        let output = ran(command.stdout(full()));
        let error = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{command:?}: {error}");
        assert!(error.starts_with("error: cannot write to standard output") && error.lines().count() == 1, "{error}");
    }
    // nobody can be told
    for mut command in printing(&entries) {
        assert_eq!(ran(command.stdout(full()).stderr(full())).status.code(), Some(1), "{command:?}");
    }
    for mut command in [zoo(["list", "--zoo", "/nowhere/at/all"]), zoo(["runs", "--runs", "/nowhere/at/all"])] {
        assert!(ran(command.stderr(full())).status.success(), "{command:?}");
    }
}

#[test]
fn files_are_written_whoever_reads_the_table() {
    let (folder, shipped) = e2e::shipped(&["door-act", "lift-act-s1", "lift-act-s2"]);
    // families and tasks decide which files there are: a reader who stays sees as many
    let read = folder.path().join("read");
    assert!(ran(&mut zoo(["leaderboard", "--zoo", text(&shipped), "--out", text(&read)])).status.success());
    let written = listing(&read);
    assert!(
        ["leaderboard.csv", "report.html"].iter().all(|name| written.iter().any(|file| file == name)),
        "{written:?}"
    );
    for (name, to, code) in [("gone", closed(), 0), ("full", full(), 1)] {
        // the folder that --help shows as an example need not be there
        let out = folder.path().join(name).join("public");
        let mut command = zoo(["leaderboard", "--zoo", text(&shipped), "--out", text(&out)]);
        assert_eq!(ran(command.stdout(to)).status.code(), Some(code));
        assert_eq!(listing(&out), written, "{name}");
    }
    // what was trained, converted and exported is there as well
    let at = |name: &str| folder.path().join(name);
    let mut convert = data(["convert", text(&lift()), text(&at("set"))]);
    assert!(ran(convert.stdout(closed()).stderr(closed())).status.success());
    let mut export = data(["export", text(&at("set")), text(&at("again.hdf5"))]);
    assert!(ran(export.stdout(closed())).status.success());
    assert!(fs::metadata(at("again.hdf5")).is_ok_and(|file| file.len() > 0));
    let mut train = zoo(["train", "act_lift", "train.steps=1", "--data", text(&at("set"))]);
    train.args(["--zoo", text(&at("zoo")), "--runs", text(&at("runs"))]);
    assert!(ran(train.stdout(closed()).stderr(closed())).status.success());
    succeeds(&mut zoo(["show", "lift-act@1", "--zoo", text(&at("zoo"))]));
}

#[test]
fn names_from_files_do_not_command_the_terminal() {
    let (folder, entries) = copied_zoo();
    let runs = folder.path().join("runs");
    let run = runs.join("e\u{1b}[2Jvil/001");
    fs::create_dir_all(&run).expect("creatable");
    fs::write(run.join("config.toml"), "").expect("writable");
    for mut command in [zoo(["runs", "--runs", text(&runs)]), zoo(["list", "--zoo", text(&entries)])] {
        let output = succeeds(&mut command);
        assert!(!output.stdout.contains(&0x1b), "{}", String::from_utf8_lossy(&output.stdout));
    }
    let output = ran(&mut zoo(["show", "lift\u{1b}[2J", "--zoo", text(&entries)]));
    assert!(!output.stderr.contains(&0x1b), "{}", String::from_utf8_lossy(&output.stderr));
}
