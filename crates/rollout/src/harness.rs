//! Where the Python side lives: the harness sources, carried inside the binary and unpacked into a
//! cache folder named by their hash, and the interpreter that runs them.

use std::fs;
use std::io::Write;
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use sha2::{Digest, Sha256};

use crate::error::RolloutError;

/// Every file of `actrm_harness`, by its path inside the package.
const FILES: &[(&str, &[u8])] = &include!(concat!(env!("OUT_DIR"), "/harness_files.rs"));

/// The name of the Python package.
const PACKAGE: &str = "actrm_harness";

/// What the worker itself must be able to import; what a simulator needs is asked there.
const NEEDED: [&str; 1] = ["numpy"];

/// The folder that goes on `PYTHONPATH`: `$ACTRM_HARNESS` where it is set, else the sources in this
/// binary, unpacked once into the cache.
///
/// # Errors
/// [`RolloutError::NoHarness`] if `ACTRM_HARNESS` holds none, [`RolloutError::File`] if the cache cannot
/// be written or its copy was changed.
pub fn harness_folder() -> Result<PathBuf, RolloutError> {
    if let Some(path) = std::env::var_os("ACTRM_HARNESS") {
        let path = PathBuf::from(path);
        if !path.join(PACKAGE).join("worker.py").is_file() {
            return Err(RolloutError::NoHarness { path });
        }
        return std::path::absolute(&path).map_err(|source| RolloutError::File {
            operation: "resolving",
            path,
            source,
        });
    }
    unpack(&cache_folder(), FILES)
}

/// The folder for things that can be made again: `$ACTRM_CACHE`, else the first of `$XDG_CACHE_HOME/actrm`,
/// `~/.cache/actrm` and a folder of this user's under the system's temporary one that can be written to.
pub fn cache_folder() -> PathBuf {
    let set = |name| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    let usual = || {
        let places = [
            set("XDG_CACHE_HOME").map(|path| path.join("actrm")),
            set("HOME").map(|path| path.join(".cache").join("actrm")),
        ];
        places.into_iter().flatten().find(|path| is_writable(path))
    };
    set("ACTRM_CACHE").or_else(usual).unwrap_or_else(|| temporary_cache(&std::env::temp_dir()))
}

/// Whether something can be put into a folder, which is made if it is not there.
fn is_writable(folder: &Path) -> bool {
    fs::create_dir_all(folder).is_ok() && rustix::fs::access(folder, rustix::fs::Access::WRITE_OK).is_ok()
}

/// A folder under `parent` that nobody else can put anything into: what lies in a cache is run.
fn temporary_cache(parent: &Path) -> PathBuf {
    let user = rustix::process::getuid();
    let folder = parent.join(format!("actrm-cache-{}", user.as_raw()));
    let _ = fs::DirBuilder::new().mode(0o700).create(&folder);
    let own = |data: &fs::Metadata| data.is_dir() && data.uid() == user.as_raw() && data.mode() & 0o022 == 0;
    match fs::symlink_metadata(&folder) {
        Ok(data) if own(&data) => folder,
        // somebody else's, under our name: one for this process
        _ => parent.join(format!("actrm-cache-{}-{}", user.as_raw(), std::process::id())),
    }
}

fn hash_of(files: &[(&str, &[u8])]) -> String {
    let mut hasher = Sha256::new();
    for (name, content) in files {
        hasher.update((name.len() as u64).to_le_bytes());
        hasher.update(name.as_bytes());
        hasher.update((content.len() as u64).to_le_bytes());
        hasher.update(content);
    }
    hasher.finalize().iter().take(8).map(|byte| format!("{byte:02x}")).collect()
}

fn unpack(cache: &Path, files: &[(&str, &[u8])]) -> Result<PathBuf, RolloutError> {
    let error = |operation, path: &Path| {
        let path = path.to_owned();
        move |source| RolloutError::File { operation, path, source }
    };
    let target = cache.join(format!("harness-{}", hash_of(files)));
    if !target.is_dir() {
        fs::create_dir_all(cache).map_err(error("creating cache folder (ACTRM_CACHE names another)", cache))?;
        let temporary = tempfile::Builder::new()
            .prefix(".harness-")
            .tempdir_in(cache)
            .map_err(error("creating a folder in", cache))?;
        for (name, content) in files {
            let path = temporary.path().join(PACKAGE).join(name);
            let folder = path.parent().expect("a file has a folder");
            fs::create_dir_all(folder).map_err(error("creating", folder))?;
            fs::File::create(&path)
                .and_then(|mut file| {
                    file.write_all(content)?;
                    file.sync_all()
                })
                .map_err(error("writing harness file", &path))?;
        }
        // another process may have been first: its copy is as good as ours
        if let Err(source) = fs::rename(temporary.path(), &target)
            && !target.is_dir()
        {
            return Err(error("moving the harness to", &target)(source));
        }
    }
    for (name, content) in files {
        let path = target.join(PACKAGE).join(name);
        let found = fs::read(&path).map_err(error("reading harness file", &path))?;
        if found != *content {
            let changed = std::io::Error::other("it was changed; delete the folder to have it made anew");
            return Err(error("checking harness file", &path)(changed));
        }
    }
    Ok(target)
}

/// An interpreter and how it was found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Python {
    /// The program.
    pub path: PathBuf,
    /// The option, variable or folder that led to it.
    pub origin: String,
}

/// Finds the interpreter: `named` (from `--python`), `$ACTRM_PYTHON`, `.venv/bin/python` in the current
/// folder and the ones above it, the same from this binary's folder, `python3` on `PATH`.
///
/// # Errors
/// [`RolloutError::PythonMissing`] if the one that was named is not there, [`RolloutError::NoPython`] if
/// there is none at all.
pub fn find_python(named: Option<&Path>) -> Result<Python, RolloutError> {
    let variable = std::env::var_os("ACTRM_PYTHON").filter(|value| !value.is_empty());
    for (path, origin) in [(named.map(Path::to_owned), "--python"), (variable.map(PathBuf::from), "ACTRM_PYTHON")] {
        if let Some(path) = path {
            // a virtual environment's python is a link: resolving it would leave the environment
            let absolute = std::path::absolute(&path).unwrap_or_else(|_| path.clone());
            if !absolute.is_file() {
                return Err(RolloutError::PythonMissing { path, origin: origin.to_owned() });
            }
            return Ok(Python { path: absolute, origin: origin.to_owned() });
        }
    }
    let here = std::env::current_dir().ok();
    // one that was built anew while it runs has no path any more; its folder is the same
    let binary = std::env::current_exe().ok().map(|exe| exe.canonicalize().unwrap_or(exe));
    let mut searched = Vec::new();
    for (start, what) in [(here, "current folder"), (binary, "this program")] {
        let Some(start) = start else { continue };
        searched.push(format!(".venv/bin/python from {} upwards", start.display()));
        for folder in start.ancestors() {
            let path = folder.join(".venv/bin/python");
            if path.is_file() {
                return Ok(Python { path, origin: format!(".venv above the {what}") });
            }
        }
    }
    searched.push("python3 on PATH".to_owned());
    let on_path = std::env::var_os("PATH")
        .iter()
        .flat_map(std::env::split_paths)
        .map(|folder| folder.join("python3"))
        .find(|path| path.is_file());
    on_path
        .map(|path| Python { path, origin: "PATH".to_owned() })
        .ok_or_else(|| RolloutError::NoPython { searched: searched.join(", ") })
}

impl Python {
    /// What keeps this interpreter from running the harness, if anything: asked only when a worker did
    /// not start, because it takes a moment.
    pub(super) fn problem(&self) -> Option<RolloutError> {
        let script = "import sys, importlib.util as u\n\
             print('%d.%d' % sys.version_info[:2])\n\
             print(','.join(m for m in sys.argv[1:] if u.find_spec(m) is None))";
        let mut command = Command::new(&self.path);
        command.arg("-c").arg(script).args(NEEDED).stdin(Stdio::null()).stderr(Stdio::piped());
        let problem = match command.output() {
            Err(error) => format!("it does not start: {error}"),
            Ok(output) if !output.status.success() => {
                let stderr = String::from_utf8_lossy(&output.stderr);
                format!("it fails ({}): {}", output.status, stderr.lines().last().unwrap_or(""))
            }
            Ok(output) => {
                let text = String::from_utf8_lossy(&output.stdout);
                let mut lines = text.lines();
                let version = lines.next().unwrap_or("").trim().to_owned();
                let missing = lines.next().unwrap_or("").trim().to_owned();
                let parts: Vec<u32> = version.split('.').filter_map(|p| p.parse().ok()).collect();
                if parts.as_slice() < [3, 11].as_slice() {
                    format!("expected Python 3.11 or newer, found {version}")
                } else if missing.is_empty() {
                    return None;
                } else {
                    format!("it has no {}", missing.replace(',', ", "))
                }
            }
        };
        Some(RolloutError::PythonUnusable { path: self.path.clone(), origin: self.origin.clone(), problem })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    /// Names of the files below a folder, relative to it, without those that Python caches.
    fn sources(folder: &Path, below: &str, into: &mut Vec<String>) {
        for item in fs::read_dir(folder).unwrap().map(Result::unwrap) {
            let name = format!("{below}{}", item.file_name().to_str().unwrap());
            match item.path().is_dir() {
                true => sources(&item.path(), &format!("{name}/"), into),
                false if name.ends_with(".pyc") => {}
                false => into.push(name),
            }
        }
    }

    #[test]
    fn the_binary_carries_every_file_of_the_harness() {
        let mut there = Vec::new();
        sources(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tools/harness/actrm_harness"), "", &mut there);
        there.sort();
        let mut built_in: Vec<&str> = FILES.iter().map(|(name, _)| *name).collect();
        built_in.sort_unstable();
        assert_eq!(
            built_in, there,
            "files were added since the build: `touch crates/rollout/build.rs` and build again"
        );
    }

    #[test]
    fn sources_are_unpacked_once_and_checked_afterwards() {
        let dir = tempfile::tempdir().unwrap();
        let cache = dir.path().join("a cache");
        let files: &[(&str, &[u8])] = &[("a.py", b"1\n"), ("sub/b.py", b"2\n")];
        let folder = unpack(&cache, files).unwrap();
        assert_eq!(fs::read(folder.join("actrm_harness/sub/b.py")).unwrap(), b"2\n");
        assert_eq!(unpack(&cache, files).unwrap(), folder);
        assert_eq!(fs::read_dir(&cache).unwrap().count(), 1);
        let other: &[(&str, &[u8])] = &[("a.py", b"1\n"), ("sub/b.py", b"3\n")];
        assert_ne!(unpack(&cache, other).unwrap(), folder);
        fs::write(folder.join("actrm_harness/a.py"), "changed").unwrap();
        let error = unpack(&cache, files).unwrap_err();
        assert!(error.to_string().contains("a.py"), "{error}");
    }

    #[test]
    fn a_cache_is_a_folder_that_can_be_written_to_and_nobody_elses() {
        let dir = tempfile::tempdir().unwrap();
        assert!(is_writable(&dir.path().join("a/b")));
        fs::write(dir.path().join("file"), "").unwrap();
        // a home that cannot be written, whoever asks: nothing can be made below a file
        assert!(!is_writable(&dir.path().join("file/.cache")));
        let own = temporary_cache(dir.path());
        assert_eq!(fs::metadata(&own).unwrap().permissions().mode() & 0o777, 0o700);
        assert_eq!(temporary_cache(dir.path()), own);
        fs::set_permissions(&own, fs::Permissions::from_mode(0o777)).unwrap();
        assert_ne!(temporary_cache(dir.path()), own, "others may have put something there");
        fs::remove_dir(&own).unwrap();
        std::os::unix::fs::symlink(dir.path(), &own).unwrap();
        assert_ne!(temporary_cache(dir.path()), own, "a link that others may turn");
    }

    #[test]
    fn a_named_python_that_is_not_there_is_an_error() {
        let error = find_python(Some(Path::new("/no/such/python"))).unwrap_err().to_string();
        assert!(error.contains("/no/such/python") && error.contains("--python"), "{error}");
    }

    #[test]
    fn a_python_without_numpy_is_one_clear_line() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("python");
        fs::write(&path, "#!/bin/sh\necho 3.12\necho numpy\n").unwrap();
        fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).unwrap();
        let python = Python { path: path.clone(), origin: "--python".into() };
        let error = python.problem().unwrap().to_string();
        assert!(error.contains("it has no numpy"), "{error}");
        assert!(error.contains("make venv") && !error.contains('\n'), "{error}");
        fs::write(&path, "#!/bin/sh\necho 3.9\necho\n").unwrap();
        let error = python.problem().unwrap().to_string();
        assert!(error.contains("3.11 or newer, found 3.9"), "{error}");
        fs::write(&path, "#!/bin/sh\necho 3.11\necho\n").unwrap();
        assert!(python.problem().is_none());
    }
}
