//! What is looked at before a run is begun: names, the zoo, memory. What can be told then is not found out hours later.

use std::path::Path;

use crate::ZooError;
use crate::config::check_experiment_name;
use crate::entry::check_name;

use super::session::{Place, Settings};

/// Refuses a run that cannot end well.
pub(super) fn check(place: &Place, experiment: &impl Settings) -> Result<(), ZooError> {
    check_experiment_name(&place.name)?;
    check_name(experiment.entry())?;
    writable(&place.zoo.join(experiment.entry()))?;
    if let Some(available) = available_memory() {
        fits(experiment, available)?;
    }
    Ok(())
}

/// Refuses a folder that cannot be made or written to. The file that tries it has no name, so a killed process leaves nothing.
fn writable(folder: &Path) -> Result<(), ZooError> {
    let mut there = folder.ancestors().filter(|path| path.symlink_metadata().is_ok());
    let there = there.next().unwrap_or(Path::new("."));
    tempfile::tempfile_in(there).map(drop).map_err(ZooError::io("write into", there))
}

/// Refuses an experiment whose training takes more than the `available` bytes.
fn fits(experiment: &impl Settings, available: f64) -> Result<(), ZooError> {
    let needed = experiment.least_bytes();
    if needed <= available {
        return Ok(());
    }
    let (needed, available) = (bytes(needed), bytes(available));
    Err(ZooError::TooLarge { experiment: experiment.entry().to_owned(), needed, available })
}

/// `3.2 TB`
fn bytes(count: f64) -> String {
    let units = ["bytes", "kB", "MB", "GB", "TB"];
    let mut unit = 0;
    let mut count = count;
    while count >= 1e3 && unit + 1 < units.len() {
        (count, unit) = (count / 1e3, unit + 1);
    }
    if count >= 1e6 { format!("{count:.1e} {}", units[unit]) } else { format!("{count:.1} {}", units[unit]) }
}

/// Bytes that pictures may take unless it is said: half of what is free.
pub(super) fn image_budget() -> u64 {
    available_memory().map_or(u64::MAX, |bytes| (bytes / 2.0) as u64)
}

/// Bytes that this process may still take: the machine's, or its control group's where that has less.
fn available_memory() -> Option<f64> {
    let number = |path: &str| std::fs::read_to_string(path).ok()?.trim().parse::<f64>().ok();
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
    let machine = line.trim().strip_suffix("kB")?.trim().parse::<f64>().ok()? * 1024.0;
    // files in memory count as used there, and go when memory is asked for
    let used = number("/sys/fs/cgroup/memory.current").unwrap_or(0.0);
    let stat = std::fs::read_to_string("/sys/fs/cgroup/memory.stat").unwrap_or_default();
    let files = stat.lines().find_map(|line| line.strip_prefix("inactive_file ")?.parse::<f64>().ok()).unwrap_or(0.0);
    let group = number("/sys/fs/cgroup/memory.max").map_or(f64::INFINITY, |most| most - (used - files).max(0.0));
    Some(machine.min(group))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::config::Library;
    use crate::experiment::Experiment;

    fn experiment(change: &str) -> Experiment {
        Experiment::load(&Library::built_in(), "act_lift", &[change.to_owned()]).unwrap()
    }

    #[test]
    fn absurd_sizes_are_refused_with_what_they_would_take() {
        let machine = 64e9;
        fits(&experiment("train.steps=5"), machine).unwrap();
        for change in [
            "train.batch_size=100000000",
            "policy.dim_model=1000000000",
            "policy.n_encoder_layers=100000",
            "policy.action_horizon=1000000000",
        ] {
            let error = fits(&experiment(change), machine).unwrap_err().to_string();
            assert!(error.starts_with("experiment `lift-act` needs at least "), "{change}: {error}");
            assert!(error.contains("B of memory, 64.0 GB are there"), "{change}: {error}");
        }
        // in parts that fit one after the other
        fits(&experiment("train.accumulation=64"), machine).unwrap();
        assert_eq!(bytes(3.21e12), "3.2 TB");
        assert_eq!(bytes(999.0), "999.0 bytes");
    }

    #[test]
    fn this_machine_has_memory() {
        assert!(available_memory().unwrap() > 1e6);
    }

    #[test]
    fn a_place_that_cannot_be_written_is_named() {
        let root = tempfile::tempdir().unwrap();
        writable(&root.path().join("zoo/lift-act")).unwrap();
        assert_eq!(std::fs::read_dir(root.path()).unwrap().count(), 0, "nothing is left of the attempt");
        let file = root.path().join("zoo");
        std::fs::write(&file, "").unwrap();
        let error = writable(&file.join("lift-act")).unwrap_err().to_string();
        assert!(error.starts_with("cannot write into ") && error.ends_with("zoo"), "{error}");
        // nobody may make a file there, not even root
        let error = writable(Path::new("/proc/zoo/lift-act")).unwrap_err().to_string();
        assert_eq!(error, "cannot write into /proc");
    }
}
