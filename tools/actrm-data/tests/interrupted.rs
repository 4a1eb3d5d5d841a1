//! Conversions that are cut short: killed at any moment, or out of room.

#![allow(clippy::unwrap_used)]

use dataset::shuffle::SplitMix64;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

fn fixture() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../crates/dataset/tests/fixtures/lift_low_dim_3_demos.hdf5")
}

fn convert(source: &Path, out: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_actrm-data"));
    command.arg("convert").arg(source).arg(out).stdout(Stdio::null()).stderr(Stdio::null());
    command
}

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> =
        std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[test]
fn folders_made_for_nothing_go_again() {
    let dir = tempfile::tempdir().unwrap();
    for out in ["nn/a/b", "nn/a/b.hdf5"] {
        assert!(!convert(&dir.path().join("missing.hdf5"), &dir.path().join(out)).status().unwrap().success());
        assert!(names(dir.path()).is_empty());
    }
    assert!(convert(&fixture(), &dir.path().join("nn/a/b")).status().unwrap().success());
    assert_eq!(names(&dir.path().join("nn/a")), ["b"]);
}

#[test]
fn killed_at_fifty_moments_it_leaves_all_or_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let (source, out) = (dir.path().join("in.hdf5"), dir.path().join("set"));
    std::fs::copy(fixture(), &source).unwrap();
    let before = std::fs::read(&source).unwrap();
    let start = Instant::now();
    assert!(convert(&source, &out).status().unwrap().success());
    let whole = start.elapsed();
    std::fs::remove_dir_all(&out).unwrap();
    let mut rng = SplitMix64::new(4, 0);
    let mut killed = 0;
    for _ in 0..50 {
        let mut child = convert(&source, &out).spawn().unwrap();
        std::thread::sleep(Duration::from_micros(rng.below(whole.as_micros() as u64)));
        child.kill().unwrap();
        let status = child.wait().unwrap();
        if out.exists() {
            // it was finished before it was killed
            let checks = dataset::verify(&out, &mut |_, _| {}).unwrap();
            assert!(checks.iter().all(|c| c.problem.is_none()), "{checks:?}");
            std::fs::remove_dir_all(&out).unwrap();
        } else {
            assert!(!status.success());
            killed += 1;
        }
    }
    assert!(killed >= 10, "only {killed} of 50 were killed before they were finished");
    assert_eq!(std::fs::read(&source).unwrap(), before);
    // a rerun finishes and clears away what the killed ones left
    assert!(convert(&source, &out).status().unwrap().success());
    assert_eq!(names(dir.path()), ["in.hdf5", "set"]);
}

#[test]
fn ctrl_c_at_any_moment_leaves_all_or_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let (source, set, parent) = (dir.path().join("in.hdf5"), dir.path().join("set"), dir.path().join("made"));
    std::fs::copy(fixture(), &source).unwrap();
    assert!(convert(&source, &set).status().unwrap().success());
    let mut rng = SplitMix64::new(5, 0);
    let mut ended = 0;
    for (command, from, out) in [("convert", &source, "out"), ("export", &set, "out.hdf5"), ("edit", &set, "out")] {
        let out = parent.join(out);
        let mut whole = 0;
        for turn in 0..20 {
            let start = Instant::now();
            let mut child = Command::new(env!("CARGO_BIN_EXE_actrm-data"));
            child.arg(command).args(if command == "edit" { &["drop", "--episodes", "0"][..] } else { &[] });
            let mut child = child.arg(from).arg(&out).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
            if turn == 0 {
                child.wait().unwrap();
                whole = start.elapsed().as_micros() as u64;
            } else {
                std::thread::sleep(Duration::from_micros(rng.below(whole)));
                assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
            }
            let status = child.wait().unwrap();
            if out.exists() {
                // the next are struck before
                whole = whole.min(start.elapsed().as_micros() as u64);
                if out.is_dir() {
                    let checks = dataset::verify(&out, &mut |_, _| {}).unwrap();
                    assert!(checks.iter().all(|check| check.problem.is_none()), "{command}: {checks:?}");
                }
                assert_eq!(names(&parent), [out.file_name().unwrap().to_str().unwrap()], "{command}");
                std::fs::remove_dir_all(&parent).unwrap();
            } else {
                // a program that has only just begun listens to nothing
                assert!(matches!(status.code(), Some(130) | None), "{command}: {status}");
                assert_eq!(names(dir.path()), ["in.hdf5", "set"], "{command}: {status}");
                ended += usize::from(status.code() == Some(130));
            }
        }
    }
    assert!(ended >= 1, "none was ended while it worked");
}

/// Runs one of our commands that has no room for its output: it says so in one line, and `before` is all that is left.
fn refused_without_room(dir: &Path, command: &mut Command, before: &[&str]) -> String {
    let output = command.output().unwrap();
    let message = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{message}");
    assert_eq!(message.lines().filter(|l| l.starts_with("error: ")).count(), 1, "{message}");
    assert_eq!(names(dir), before, "{message}");
    message
}

/// Files may not grow beyond so many blocks of 512 bytes; writing more fails as on a full disk.
fn limited(blocks: u32, command: &str, from: &Path, to: &Path) -> Command {
    let mut limited = Command::new("bash");
    limited.arg("-c").arg(format!("trap '' XFSZ; ulimit -S -f {}; exec \"$0\" {command} \"$1\" \"$2\"", blocks / 2));
    limited.arg(env!("CARGO_BIN_EXE_actrm-data")).arg(from).arg(to);
    limited
}

#[test]
fn without_room_it_says_so_and_leaves_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let (source, set, back) = (dir.path().join("in.hdf5"), dir.path().join("set"), dir.path().join("back.hdf5"));
    std::fs::copy(fixture(), &source).unwrap();
    let before = std::fs::read(&source).unwrap();
    let message = refused_without_room(dir.path(), &mut limited(40, "convert", &source, &set), &["in.hdf5"]);
    assert!(message.contains(".parquet") && message.contains("cannot write"), "{message}");
    assert!(convert(&source, &set).status().unwrap().success());
    let message = refused_without_room(dir.path(), &mut limited(40, "export", &set, &back), &["in.hdf5", "set"]);
    assert!(message.contains("back.hdf5") && message.contains("reserve disk space"), "{message}");
    assert_eq!(std::fs::read(&source).unwrap(), before);
    // with room, both do what they could not
    assert!(limited(40_000, "export", &set, &back).status().unwrap().success());
}

#[test]
fn a_full_disk_is_told_and_left_as_it_was() {
    let dir = tempfile::tempdir().unwrap();
    let mount = dir.path().join("small");
    std::fs::create_dir(&mount).unwrap();
    let (source, set) = (dir.path().join("in.hdf5"), dir.path().join("set"));
    std::fs::copy(fixture(), &source).unwrap();
    assert!(convert(&source, &set).status().unwrap().success());
    // a disk of 150 kB that only this command sees, in name spaces of its own
    let on_small_disk = |command: &str, from: &Path, to: &str| {
        let script = format!(
            "mount -t tmpfs -o size=150k none \"$2\" || exit 77; \"$0\" {command} \"$1\" \"$2/{to}\"; code=$?; \
             [ -z \"$(ls -A \"$2\")\" ] || echo left: $(ls -A \"$2\") >&2; exit $code"
        );
        let mut command = Command::new("unshare");
        command.args(["--user", "--map-root-user", "--mount", "sh", "-c"]).arg(script);
        command.arg(env!("CARGO_BIN_EXE_actrm-data")).arg(from).arg(&mount);
        command.output()
    };
    for (command, from, to) in [("convert", &source, "set"), ("export", &set, "back.hdf5")] {
        let output = match on_small_disk(command, from, to) {
            Ok(output) if output.status.code() != Some(77) && !output.stderr.starts_with(b"unshare:") => output,
            other => {
                eprintln!("SKIPPED: this system lets nobody mount a small disk: {other:?}");
                return;
            }
        };
        let message = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{command}: {message}");
        assert!(message.contains("No space left on device") && message.contains(to), "{command}: {message}");
        assert!(!message.contains("left:"), "{command}: {message}");
    }
    assert_eq!(std::fs::read(&source).unwrap(), std::fs::read(fixture()).unwrap());
}
