//! What workers said of themselves the last time: enough to know what an evaluation would be called, without starting one.
//!
//! Remembered in the cache folder, under a name that holds everything a greeting depends on: the harness, the
//! interpreter, its versions of the simulator and of what that stands on, the task, the control loop and which kernels
//! were asked for. An environment module of the user's may say something else every time; workers that load one are not
//! remembered.

use std::ffi::OsString;
use std::path::PathBuf;
use std::process::{Command, Stdio};

use sha2::{Digest, Sha256};

use crate::files::write_atomic;
use crate::harness::cache_folder;
use crate::message::Ready;
use crate::spec::{BLAS_KERNELS, WorkerSpec};

/// The greeting that workers of `spec` would give, if they gave it before and nothing that it depends on has changed.
pub fn remembered_greeting(spec: &WorkerSpec) -> Option<Ready> {
    let ready: Ready = serde_json::from_slice(&std::fs::read(path(spec)?).ok()?).ok()?;
    (installed(spec, &ready)? == ready.versions).then_some(ready)
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

/// The versions that the interpreter would load now of everything that `ready` names, asked without importing any.
fn installed(spec: &WorkerSpec, ready: &Ready) -> Option<std::collections::BTreeMap<String, String>> {
    let script = "import sys, platform, importlib.metadata as m\n\
         for n in sys.argv[1:]: print(n, platform.python_version() if n == 'python' else m.version(n))";
    let mut command = Command::new(&spec.python.path);
    command.arg("-c").arg(script).args(ready.versions.keys()).stdin(Stdio::null()).stderr(Stdio::null());
    let output = command.output().ok().filter(|output| output.status.success())?;
    let text = String::from_utf8(output.stdout).ok()?;
    text.lines().map(|line| line.split_once(' ').map(|(n, v)| (n.to_owned(), v.to_owned()))).collect()
}
