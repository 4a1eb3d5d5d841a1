//! Paths that are not UTF-8: every command works in them, or refuses them in one line.

use std::ffi::{OsStr, OsString};
use std::os::unix::ffi::OsStrExt;
use std::path::Path;
use std::process::{Command, Output};

use e2e::{data, lift, text, zoo};

fn ran(command: &mut Command) -> Output {
    let output = command.output().expect("the program starts");
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(!error.contains("panicked") && output.status.code().is_some(), "{command:?}: {:?}\n{error}", output.status);
    output
}

/// The line works: a program, its arguments with `@` for the folder.
fn works(folder: &OsStr, program: fn([&str; 0]) -> Command, arguments: &[&str]) {
    let mut command = program([]);
    for argument in arguments {
        match argument.strip_prefix('@') {
            Some(rest) => {
                let mut path = OsString::from(folder);
                path.push(rest);
                command.arg(path);
            }
            None => {
                command.arg(argument);
            }
        }
    }
    let output = ran(&mut command);
    assert!(output.status.success(), "{command:?}: {}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn every_command_works_in_a_folder_whose_name_is_not_utf8() {
    let outer = tempfile::tempdir().expect("a temporary folder");
    let folder = outer.path().join(OsStr::from_bytes(b"caf\xe9 \xff"));
    std::fs::create_dir(&folder).expect("creatable");
    let folder = folder.as_os_str();
    for arguments in [
        &["convert", text(&lift()), "@/set", "--json"][..],
        &["validate", "@/set", "--source", text(&lift()), "--json"],
        &["inspect", "@/set", "--json"],
        &["stats", "@/set", "--json"],
        &["query", "@/set", "SELECT demo FROM episodes", "--json"],
        &["plot", "@/set", "--out", "@/set.svg"],
        &["puzzle", "open8", "@/puzzles/open8.parquet", "--count", "5", "--json"],
    ] {
        works(folder, data, arguments);
    }
    let theirs = e2e::root().join("crates/interchange/tests/fixtures/robomimic/bc_rnn.pth");
    std::fs::copy(theirs, Path::new(folder).join("model.pth")).expect("copied");
    let places = ["--zoo", "@/zoo", "--runs", "@/runs"];
    let small = ["train", "act_lift", "train.steps=1", "--data"];
    works(folder, zoo, &[&small[..], &["@/set"], &places].concat());
    works(folder, zoo, &[&small[..], &[text(&lift())], &places].concat());
    for arguments in [
        &["list", "--zoo", "@/zoo"][..],
        &["show", "lift-act", "--json", "--zoo", "@/zoo"],
        &["runs", "--runs", "@/runs", "--all"],
        &["runs", "--runs", "@/runs", "--all", "--json"],
        &["export", "lerobot", "lift-act@1", "@/theirs", "--zoo", "@/zoo"],
        &["import", "lerobot", "@/theirs", "--name", "again", "--task", "Lift", "--zoo", "@/zoo"],
        &["import", "robomimic", "@/model.pth", "--name", "robomimics", "--task", "Lift", "--zoo", "@/zoo"],
        &["leaderboard", "--zoo", "@/zoo", "--out", "@/public"],
    ] {
        works(folder, zoo, arguments);
    }
}

#[test]
fn an_hdf5_file_there_is_refused_in_one_line_because_its_library_cannot_open_it() {
    let outer = tempfile::tempdir().expect("a temporary folder");
    let (set, folder) = (outer.path().join("set"), outer.path().join(OsStr::from_bytes(b"caf\xe9")));
    std::fs::create_dir(&folder).expect("creatable");
    let (file, new) = (folder.join("lift.hdf5"), folder.join("new.hdf5"));
    std::fs::copy(lift(), &file).expect("copied");
    e2e::succeeds(&mut data(["convert", text(&lift()), text(&set)]));
    let refused = |command: &mut Command| {
        let output = ran(command);
        let error = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{command:?}: {error}");
        assert!(error.contains("UTF-8") && error.lines().count() == 1, "{command:?}: {error}");
    };
    refused(data(["inspect"]).arg(&file));
    refused(data(["validate"]).arg(&file));
    refused(data(["convert"]).arg(&file).arg(outer.path().join("other")));
    refused(data(["export", text(&set)]).arg(&new));
    refused(zoo(["train", "act_lift", "--runs", text(&outer.path().join("runs")), "--data"]).arg(&file));
    assert_eq!(e2e::listing(&folder), ["lift.hdf5"]);
    assert_eq!(e2e::listing(outer.path()).len(), 2);
}

#[test]
fn a_path_that_is_not_there_is_named_as_far_as_it_can_be_shown() {
    let nowhere = OsStr::from_bytes(b"/nowhere/caf\xe9");
    let mut commands: Vec<Command> = Vec::new();
    for arguments in [&["inspect"][..], &["validate"], &["stats"], &["convert"]] {
        let mut command = data([]);
        command.args(arguments).arg(nowhere);
        if arguments == ["convert"] {
            command.arg("/nowhere/out");
        }
        commands.push(command);
    }
    let mut command = zoo(["train", "act_lift", "--runs", "/nowhere/runs", "--data"]);
    command.arg(nowhere);
    commands.push(command);
    for mut command in commands {
        let output = ran(&mut command);
        assert_eq!(output.status.code(), Some(1), "{command:?}");
    }
    // a word that has to be text
    let mut command = zoo(["train"]);
    command.arg(OsStr::from_bytes(b"act_\xff"));
    assert_eq!(ran(&mut command).status.code(), Some(2));
}
