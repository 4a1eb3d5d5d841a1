//! What a worker is to be, and the command that starts one.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;
use std::time::Duration;

use crate::harness::{Python, cache_folder};
use crate::message::Control;

/// robomimic's `env_args` of a task's environment with these robots, each with its usual controller.
pub fn robots_of(task: &str, robots: &[String]) -> serde_json::Value {
    let robots = match robots {
        [one] => serde_json::json!(one),
        several => serde_json::json!(several),
    };
    serde_json::json!({"type": 1, "env_name": task, "env_kwargs": {"robots": robots}})
}

/// The module that registered the recorded environment, as robomimic's `env_args` name it.
pub fn recorded_module(env_args: &serde_json::Value) -> Option<&str> {
    env_args.get("env_module")?.get("name")?.as_str()
}

/// Refuses an environment that was recorded with a module which the user did not name: files come from others, and only the
/// user decides whose code runs.
///
/// # Errors
/// What was recorded, and how to name it.
pub fn check_module(recorded: Option<&str>, named: Option<&str>) -> Result<(), String> {
    match recorded.filter(|_| named.is_none()) {
        None => Ok(()),
        Some(module) => Err(format!(
            "recorded with module {module:?}, whose code runs only if you name it with --env-module (in Python: env_module)"
        )),
    }
}

/// Runs a module of the harness, having asked Linux (`prctl(PR_SET_PDEATHSIG, SIGKILL)`) to kill it with us: a
/// worker that hangs or is stopped would not see its pipe close.
pub(super) fn boot(module: &str) -> String {
    format!(
        "import runpy, sys
if sys.platform == 'linux':
    import ctypes
    ctypes.CDLL(None).prctl(1, 9)
runpy.run_module('{module}', run_name='__main__', alter_sys=True)"
    )
}

/// What a worker is to run.
#[derive(Debug, Clone)]
pub struct WorkerSpec {
    /// The interpreter.
    pub python: Python,
    /// The folder that holds `actrm_harness`.
    pub harness: PathBuf,
    /// The task.
    pub task: String,
    /// The control loop to ask for; the worker may fall back to robosuite's. A simulator's own is not asked for.
    pub control: Control,
    /// A Python module of the user's that registers environments.
    pub env_module: Option<String>,
    /// robomimic's `env_args`, for an environment other than the task's usual one: other robots or controllers.
    pub env_args: Option<serde_json::Value>,
    /// Cameras whose images belong to the observations.
    pub cameras: Vec<String>,
    /// Edge of the cameras' images in pixels.
    pub image_size: usize,
    /// Draw without reflections and multisampling: a third of the time, and other pixels.
    pub fast_render: bool,
    /// The most private memory in bytes that a worker may take.
    pub memory_limit: Option<u64>,
    /// How long a worker may take.
    pub limits: TimeLimits,
}

impl WorkerSpec {
    /// A worker for `task` with the usual limits.
    pub fn new(python: Python, harness: PathBuf, task: &str) -> Self {
        Self {
            python,
            harness,
            task: task.to_owned(),
            control: Control::Compiled,
            env_module: None,
            env_args: None,
            cameras: Vec::new(),
            image_size: 84,
            fast_render: false,
            memory_limit: Some(8 << 30),
            limits: TimeLimits::default(),
        }
    }

    /// The same for an environment that was recorded with robomimic's `env_args`: its robots and its controllers. A module that
    /// they name is left alone, see [`check_module`].
    #[must_use]
    pub fn recorded(mut self, env_args: Option<&serde_json::Value>) -> Self {
        self.env_args = env_args.filter(|args| args.get("env_kwargs").is_some()).cloned();
        self
    }

    /// A command that runs a module of the harness, finding packages where a worker finds them.
    pub(super) fn python(&self, module: &str) -> Command {
        let mut command = Command::new(&self.python.path);
        command.args(["-c", &boot(module)]);
        let mut path = OsString::from(&self.harness);
        if let Some(rest) = std::env::var_os("PYTHONPATH").filter(|rest| !rest.is_empty()) {
            path.push(":");
            path.push(rest);
        }
        command.env("PYTHONPATH", path);
        command
    }

    /// The command that starts such a worker.
    pub(super) fn command(&self) -> Command {
        let mut command = self.python("actrm_harness.worker");
        command.args(["--task", &self.task]);
        if self.control != Control::Own {
            command.args(["--control", self.control.as_str()]);
        }
        if let Some(module) = &self.env_module {
            command.args(["--env-module", module]);
        }
        if let Some(env_args) = &self.env_args {
            command.args(["--env-args", &env_args.to_string()]);
        }
        if !self.cameras.is_empty() {
            command.args(["--cameras", &self.cameras.join(",")]);
            command.args(["--size", &self.image_size.to_string()]);
            if self.fast_render {
                command.arg("--fast-render");
            }
        }
        if std::env::var_os("NUMBA_CACHE_DIR").is_none() {
            command.env("NUMBA_CACHE_DIR", cache_folder().join("numba"));
        }
        if let Some(library) = control_library().filter(|_| self.control == Control::Compiled) {
            command.env("ACTRM_CONTROL_LIB", library);
        }
        // one environment, one core: threads inside numpy would only fight the other workers
        for name in ["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"] {
            command.env(name, "1");
        }
        command.envs([("PYTHONHASHSEED", "0"), ("MALLOC_ARENA_MAX", "2")]);
        if std::env::var_os(BLAS_KERNELS).is_none() && has_haswells_kernels() {
            command.env(BLAS_KERNELS, "Haswell");
        }
        command
    }
}

/// Which kernels OpenBLAS, numpy's linear algebra, runs. Left to itself it takes those of the processor, whose last bits differ (an
/// orientation that robosuite takes from an eigenvector may then come with the other sign): episodes of NutAssemblySquare ended
/// otherwise on another machine. A user's own choice stays.
pub(crate) const BLAS_KERNELS: &str = "OPENBLAS_CORETYPE";

/// Whether the kernels for AVX2 run here, which all x86-64 processors of the last ten years have in common.
fn has_haswells_kernels() -> bool {
    #[cfg(target_arch = "x86_64")]
    let has = std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma");
    #[cfg(not(target_arch = "x86_64"))]
    let has = false;
    has
}

/// Where the library of the compiled control loop lies, of a program that is not ours.
static CONTROL_LIBRARY: OnceLock<PathBuf> = OnceLock::new();

/// Says where the library of the compiled control loop lies: for a library in a program that is not ours. The first
/// place that is named stays.
pub fn set_control_library(path: &Path) {
    CONTROL_LIBRARY.get_or_init(|| path.to_owned());
}

/// The library of the compiled control loop: `$ACTRM_CONTROL_LIB`, else where it was said to be, else beside this
/// program, where a build puts it, or in the `lib` folder of an installation.
fn control_library() -> Option<PathBuf> {
    if let Some(path) = std::env::var_os("ACTRM_CONTROL_LIB").filter(|path| !path.is_empty()) {
        return Some(PathBuf::from(path));
    }
    if let Some(path) = CONTROL_LIBRARY.get() {
        return Some(path.clone());
    }
    library_of(&std::env::current_exe().ok()?)
}

/// The library beside `program`, or in the `lib` folder beside its folder.
fn library_of(program: &Path) -> Option<PathBuf> {
    let name = format!("{}control{}", std::env::consts::DLL_PREFIX, std::env::consts::DLL_SUFFIX);
    // one that was built anew while it runs has no path any more; its folder is the same
    let program = program.canonicalize().unwrap_or_else(|_| program.to_owned());
    let folder = program.parent()?;
    let places = [folder.join(&name), folder.join("..").join(&name), folder.join("../lib").join(&name)];
    places.into_iter().find(|path| path.is_file())
}

/// How long a worker may take before it counts as hung.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TimeLimits {
    /// From the start of the process to its greeting: imports, compilation, the first reset.
    pub start: Duration,
    /// For a reset.
    pub reset: Duration,
    /// For a control step or an image.
    pub step: Duration,
    /// For a whole scripted or replayed episode.
    pub episode: Duration,
}

impl Default for TimeLimits {
    fn default() -> Self {
        Self {
            start: Duration::from_secs(300),
            reset: Duration::from_secs(60),
            step: Duration::from_secs(30),
            episode: Duration::from_secs(300),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn workers_run_one_set_of_kernels_unless_the_user_chose_another() {
        let spec = WorkerSpec::new(
            Python { path: "python".into(), origin: "--python".into() },
            PathBuf::from("harness"),
            "Lift",
        );
        let command = spec.command();
        let set = command.get_envs().find(|(name, _)| *name == BLAS_KERNELS).and_then(|(_, value)| value);
        let chosen = std::env::var_os(BLAS_KERNELS).is_some();
        assert_eq!(set, (!chosen && has_haswells_kernels()).then(|| "Haswell".as_ref()));
    }

    #[test]
    fn a_recorded_module_is_not_imported() {
        let python = Python { path: "python".into(), origin: "--python".into() };
        let env_args = serde_json::json!({"env_kwargs": {}, "env_module": {"name": "theirs", "sha256": "0"}});
        let spec = WorkerSpec::new(python, PathBuf::from("harness"), "Lift").recorded(Some(&env_args));
        assert!(!spec.command().get_args().any(|word| word == "--env-module"));
        let recorded = recorded_module(&env_args);
        let refused = check_module(recorded, None).expect_err("nobody named it");
        assert!(refused.contains("\"theirs\"") && refused.contains("--env-module"), "{refused}");
        assert_eq!(check_module(recorded, Some("mine")), Ok(()));
        assert_eq!(check_module(None, None), Ok(()));
    }

    #[test]
    fn a_loop_is_asked_for_unless_it_is_the_simulator_s_own() {
        let python = Python { path: "python".into(), origin: "--python".into() };
        let mut spec = WorkerSpec::new(python, PathBuf::from("harness"), "Lift");
        for (control, asked) in [(Control::Compiled, true), (Control::Robosuite, true), (Control::Own, false)] {
            spec.control = control;
            assert_eq!(spec.command().get_args().any(|word| word == "--control"), asked, "{control}");
        }
    }

    /// A program that was built anew while it runs is found under a path that is none, `… (deleted)` on Linux; a study that
    /// begins another worker then must not go on with another control loop.
    #[test]
    fn the_library_is_found_beside_a_program_that_was_replaced() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let library =
            folder.path().join(format!("{}control{}", std::env::consts::DLL_PREFIX, std::env::consts::DLL_SUFFIX));
        std::fs::write(&library, "").expect("a file");
        assert_eq!(library_of(&folder.path().join("actrm-zoo (deleted)")), Some(library.clone()));
        std::fs::create_dir_all(folder.path().join("deps/bin")).expect("a folder");
        assert_eq!(
            library_of(&folder.path().join("deps/test")).map(|path| path.canonicalize().expect("it is there")),
            Some(library.canonicalize().expect("it is there"))
        );
        assert_eq!(library_of(&folder.path().join("deps/bin/test")), None);
    }
}
