//! What the tests over real workers share.

#![allow(dead_code, reason = "each test file uses its part")]

use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use rollout::{PoolOptions, Python, TimeLimits, WorkerSpec, find_python, harness_folder};

/// The Python of the repository's `.venv`, or the one that `ACTRM_PYTHON` names.
pub fn python() -> Python {
    find_python(None).expect("tests over robosuite need .venv (make venv) or ACTRM_PYTHON")
}

/// A worker for `task`, with limits that a loaded machine keeps.
pub fn spec(task: &str) -> WorkerSpec {
    let harness = harness_folder().expect("the harness is built in");
    WorkerSpec::new(python(), harness, task)
}

/// A pool of `workers` for `task`.
pub fn options(task: &str, workers: usize) -> PoolOptions {
    PoolOptions::new(spec(task), workers)
}

/// A Python that is a shell script: `body` may use `"$PY"` and should end in `exec "$PY" "$@"`.
pub fn wrapped(folder: &Path, name: &str, body: &str) -> Python {
    use std::os::unix::fs::PermissionsExt;
    let real = python().path;
    let path = folder.join(name);
    let text = format!("#!/bin/bash\nPY='{}'\n{body}\n", real.display());
    fs::write(&path, text).expect("a script can be written");
    fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).expect("and made executable");
    Python { path, origin: "a test".to_owned() }
}

/// Short limits, so that a hang is noticed soon.
pub fn impatient(limits: TimeLimits) -> TimeLimits {
    TimeLimits { step: Duration::from_secs(3), reset: Duration::from_secs(8), ..limits }
}

/// The ids of living worker processes that this test process started.
pub fn worker_processes() -> Vec<i32> {
    let own = std::process::id().to_string();
    let Ok(entries) = fs::read_dir("/proc") else { return Vec::new() };
    let mut found = Vec::new();
    for entry in entries.flatten() {
        let Some(id) = entry.file_name().to_str().and_then(|name| name.parse::<i32>().ok()) else { continue };
        let folder: PathBuf = entry.path();
        let stat = fs::read_to_string(folder.join("stat")).unwrap_or_default();
        let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or("").split_whitespace().collect();
        let command = fs::read(folder.join("cmdline")).unwrap_or_default();
        let is_worker = String::from_utf8_lossy(&command).contains("actrm_harness");
        if is_worker && fields.len() > 1 && fields[0] != "Z" && fields[1] == own {
            found.push(id);
        }
    }
    found
}

/// Whether a process is there and not a zombie.
pub fn alive(id: u32) -> bool {
    fs::read_to_string(format!("/proc/{id}/stat"))
        .is_ok_and(|stat| !stat.rsplit(')').next().unwrap_or("").trim_start().starts_with('Z'))
}

/// Waits until `condition` holds, 20 s at most.
pub fn wait_until(what: &str, condition: impl Fn() -> bool) {
    let until = Instant::now() + Duration::from_secs(20);
    while !condition() {
        assert!(Instant::now() < until, "waited 20 s in vain: {what}");
        std::thread::sleep(Duration::from_millis(10));
    }
}
