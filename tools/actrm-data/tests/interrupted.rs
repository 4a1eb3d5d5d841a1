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
fn without_room_it_says_so_and_leaves_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("set");
    // files may not grow beyond 20 blocks of 512 or 1024 bytes; writing more fails as on a full disk
    let output = Command::new("sh")
        .args(["-c", "trap '' XFSZ; ulimit -f 20; exec \"$0\" convert \"$1\" \"$2\""])
        .arg(env!("CARGO_BIN_EXE_actrm-data"))
        .arg(fixture())
        .arg(&out)
        .output()
        .unwrap();
    let message = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{message}");
    assert_eq!(message.lines().filter(|l| l.starts_with("error: ")).count(), 1, "{message}");
    assert!(message.contains(".parquet") && message.contains("cannot write"), "{message}");
    assert!(names(dir.path()).is_empty(), "{:?}", names(dir.path()));
}
