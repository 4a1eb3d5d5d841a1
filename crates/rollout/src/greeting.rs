//! What workers said of themselves the last time: enough to know what an evaluation would be called, without starting one.
//!
//! Remembered in the cache folder, under a name that holds everything a greeting depends on: the harness, the
//! interpreter, the task, the control loop and which kernels were asked for. Versions and sources of the simulator and of
//! what that stands on are asked for again, without importing any of it. An environment module of the user's may say something else every time; workers that load one are not
//! remembered.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::path::PathBuf;
use std::process::Stdio;

use serde::Deserialize;
use sha2::{Digest, Sha256};

use crate::files::write_atomic;
use crate::harness::cache_folder;
use crate::message::Ready;
use crate::spec::{BLAS_KERNELS, WorkerSpec};

/// The greeting that workers of `spec` would give, if they gave it before and nothing that it depends on has changed.
pub fn remembered_greeting(spec: &WorkerSpec) -> Option<Ready> {
    let ready: Ready = serde_json::from_slice(&std::fs::read(path(spec)?).ok()?).ok()?;
    let installed = installed(spec, &ready)?;
    let same = installed.versions == ready.versions && installed.sources == ready.sources;
    (same && !ready.sources.is_empty()).then_some(ready)
}

/// Keeps a greeting for the next time. Whether that succeeds matters to nobody.
pub(crate) fn remember(spec: &WorkerSpec, ready: &Ready) {
    let Some(path) = path(spec) else { return };
    let text = serde_json::to_vec(ready).unwrap_or_default();
    if std::fs::read(&path).is_ok_and(|found| found == text) {
        return;
    }
    let _ = path.parent().map(std::fs::create_dir_all);
    let _ = write_atomic(&path, &text);
}

fn path(spec: &WorkerSpec) -> Option<PathBuf> {
    if spec.env_module.is_some() || !spec.cameras.is_empty() {
        return None;
    }
    let mut hasher = Sha256::new();
    let variable = |name: &str| std::env::var_os(name).unwrap_or_default();
    let (control, kernels) = (variable("ACTRM_CONTROL_LIB"), variable(BLAS_KERNELS));
    let env_args: OsString = spec.env_args.as_ref().map(ToString::to_string).unwrap_or_default().into();
    let parts =
        [spec.harness.as_os_str(), spec.python.path.as_os_str(), &control, &kernels, spec.task.as_ref(), &env_args];
    for part in parts.iter().map(|part| part.as_encoded_bytes()).chain([spec.control.as_str().as_bytes()]) {
        hasher.update((part.len() as u64).to_le_bytes());
        hasher.update(part);
    }
    let name: String = hasher.finalize().iter().take(12).map(|byte| format!("{byte:02x}")).collect();
    Some(cache_folder().join("greetings").join(name + ".json"))
}

/// What the harness says of packages as the interpreter would import them now.
#[derive(Deserialize)]
struct Installed {
    versions: BTreeMap<String, String>,
    sources: BTreeMap<String, String>,
}

/// The same of everything that `ready` names.
fn installed(spec: &WorkerSpec, ready: &Ready) -> Option<Installed> {
    let mut command = spec.python("actrm_harness.source");
    command.args(ready.versions.keys()).arg("--").args(ready.sources.keys());
    let output = command.stdin(Stdio::null()).stderr(Stdio::null()).output().ok()?;
    output.status.success().then(|| serde_json::from_slice(&output.stdout).ok()).flatten()
}
