//! The driver for Slurm, with a stand-in for `sbatch` that runs at once what would be queued.

use std::fs;
use std::os::unix::fs::PermissionsExt as _;
use std::process::Command;

use e2e::{copied_zoo, listing, program, root, succeeds, text};

/// Runs the wrapped command, once for each task of an array, with the variables that Slurm sets, and prints a job's id.
const SBATCH: &str = r#"#!/usr/bin/env bash
set -euo pipefail
array=1-1
for option in "$@"; do
    case $option in
    --array=*) array=${option#--array=} ;;
    --cpus-per-task=*) export SLURM_CPUS_PER_TASK=${option#*=} ;;
    --wrap=*) wrap=${option#--wrap=} ;;
    esac
    echo "$option" >>"$JOBS"
done
for ((task = ${array%-*}; task <= ${array#*-}; task++)); do
    SLURM_ARRAY_TASK_ID=$task bash -c "$wrap" >>"$JOBS"
done
echo 4711
"#;

#[test]
fn an_array_of_shards_and_the_job_that_merges_them() {
    let (folder, entries) = copied_zoo();
    let bin = folder.path().join("bin");
    fs::create_dir(&bin).expect("creatable");
    fs::write(bin.join("sbatch"), SBATCH).expect("writable");
    fs::set_permissions(bin.join("sbatch"), fs::Permissions::from_mode(0o755)).expect("executable");
    let jobs = folder.path().join("jobs");
    let path = format!("{}:{}", text(&bin), std::env::var("PATH").expect("a PATH"));
    let script = root().join("tools/cluster/slurm_eval.sh");
    let mut command = Command::new(&script);
    command.args(["3", "lift-act@1", "--episodes", "4", "--max-steps", "3", "--zoo", text(&entries)]);
    let zoo = program("actrm-zoo").get_program().to_owned();
    succeeds(command.env("PATH", path).env("ACTRM_ZOO", zoo).env("JOBS", &jobs).current_dir(root()));
    let jobs = fs::read_to_string(jobs).expect("jobs were queued");
    assert!(jobs.contains("--array=1-3") && jobs.contains("--dependency=afterok:4711"), "{jobs}");
    assert!(jobs.contains("of 4 episodes succeeded"), "{jobs}");
    let results = listing(&entries.join("results"));
    assert_eq!(results.iter().filter(|name| name.contains("_shard-")).count(), 3, "{results:?}");
    assert_eq!(results.iter().filter(|name| !name.contains("_shard-")).count(), 1, "{results:?}");
    let refused = Command::new(&script).args(["none", "lift-act@1"]).output().expect("it starts");
    assert_eq!(refused.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("slurm_eval.sh SHARDS"));
}
