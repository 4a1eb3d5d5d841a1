//! The drivers for Slurm, with a stand-in for `sbatch` that runs at once what would be queued.

use std::fs;
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;
use std::process::Command;

use e2e::{copied_zoo, listing, program, refused, root, succeeds, text};

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

/// A folder of programs with the stand-in, and the path that finds it first.
fn with_sbatch(folder: &Path) -> String {
    let bin = folder.join("bin");
    fs::create_dir(&bin).expect("creatable");
    fs::write(bin.join("sbatch"), SBATCH).expect("writable");
    fs::set_permissions(bin.join("sbatch"), fs::Permissions::from_mode(0o755)).expect("executable");
    format!("{}:{}", text(&bin), std::env::var("PATH").expect("a PATH"))
}

/// A study of two trainings that is over in seconds.
const STUDY: &str = include_str!("../fixtures/small_study.toml");
/// A later stage of it that has a training of the first once more.
const STAGE: &str = r#"
[tests.again]
task = "Lift"
episodes = 1
seed_start = 40002
[[cells]]
arms = ["act"]
data = "lift"
seeds = 1
tests = ["again"]
stage = 2
"#;

#[test]
fn a_study_as_an_array_of_cells() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let jobs = folder.path().join("jobs");
    fs::write(folder.path().join("small.toml"), format!("{STUDY}{STAGE}")).expect("writable");
    let script = root().join("tools/cluster/slurm_study.sh");
    let zoo = program("actrm-zoo").get_program().to_owned();
    let mut command = Command::new(&script);
    command.args(["small.toml", "--work", "work"]).current_dir(folder.path());
    command.env("PATH", with_sbatch(folder.path())).env("ACTRM_ZOO", zoo).env("JOBS", &jobs);
    command.env("ACTRM_PYTHON", root().join(".venv/bin/python"));
    succeeds(&mut command);
    let said = fs::read_to_string(&jobs).expect("jobs were queued");
    assert!(said.contains("--array=1-2") && said.contains("--dependency=afterok:4711"), "{said}");
    let results =
        ["act-on-lift-seed1_again.json", "act-on-lift-seed1_lift.json", "act-on-lift-seed2_lift.json", "success.svg"];
    assert_eq!(listing(&folder.path().join("results")), results);
    // entries are a family, and their evaluations lie where the leaderboard looks
    assert_eq!(listing(&folder.path().join("zoo")), ["lift-act-s1", "lift-act-s2", "results"]);
    let page = fs::read_to_string(folder.path().join("page.md")).expect("the page");
    assert!(page.contains("| ACT | 0.0% [0-66]<br>0, 0 of 2 |") && !page.contains("## Not run"), "{page}");
    let trains = fs::read_to_string(folder.path().join("zoo/lift-act-s2/1/command.txt")).expect("the command");
    let data = "--data work/small/data/lift-3-seed1.hdf5";
    assert!(trains.starts_with("actrm-zoo train act_lift ") && trains.trim_end().ends_with(data), "{trains}");

    let list = || {
        let mut command = program("actrm-zoo");
        let listed = command.args(["study", "small.toml", "--list"]).current_dir(folder.path()).output();
        String::from_utf8(listed.expect("it runs").stdout).expect("text")
    };
    let (first, second) = ("act-on-lift-seed1: lift (0 of 2), again (0 of 1)\n", "act-on-lift-seed2: lift (0 of 2)\n");
    assert_eq!(list(), format!("{first}{second}"));
    fs::remove_file(folder.path().join("results").join(results[2])).expect("was there");
    assert_eq!(list(), format!("{first}act-on-lift-seed2: lift (not run)\n"));

    let mut unknown = program("actrm-zoo");
    unknown.args(["study", "small.toml", "--work", "work", "--cell", "act-on-lift"]).current_dir(folder.path());
    refused(&mut unknown, &["cell `act-on-lift`", "--list"]);
    // another definition is trained anew, as the next version
    fs::write(folder.path().join("small.toml"), STUDY.replace("steps=3\"", "steps=4\"")).expect("writable");
    let mut again = program("actrm-zoo");
    again.args(["study", "small.toml", "--work", "work", "--cell", "act-on-lift-seed1"]).current_dir(folder.path());
    succeeds(again.env("ACTRM_PYTHON", root().join(".venv/bin/python")));
    assert!(folder.path().join("zoo/lift-act-s1/2/model.safetensors").is_file());
}

#[test]
fn a_conversion_as_an_array_of_shards() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (jobs, path) = (folder.path().join("jobs"), with_sbatch(folder.path()));
    let (source, script) = (root().join("data/lift.hdf5"), root().join("tools/cluster/slurm_convert.sh"));
    let run = || {
        let mut command = Command::new(&script);
        command.args(["3", text(&source), "set", "--file-size", "0.05"]).current_dir(folder.path());
        command.env("PATH", &path).env("ACTRM_DATA", program("actrm-data").get_program()).env("JOBS", &jobs);
        command.env("ACTRM_CLUSTER_PYTHON", root().join(".venv/bin/python"));
        command
    };
    succeeds(&mut run());
    let said = fs::read_to_string(&jobs).expect("jobs were queued");
    assert!(said.contains("--array=1-3") && said.contains("--dependency=afterok:4711"), "{said}");
    assert!(said.contains("set.shards/3-of-3: shard 3/3, "), "{said}");
    let mut whole = program("actrm-data");
    whole.args(["convert", text(&source), "whole", "--file-size", "0.05"]).current_dir(folder.path());
    succeeds(&mut whole);
    let same =
        Command::new("diff").args(["-r", "set", "whole"]).current_dir(folder.path()).output().expect("it starts");
    assert!(same.status.success(), "{}", String::from_utf8_lossy(&same.stdout));
    // what is there is not converted again, and nothing is overwritten
    let again = run().output().expect("it starts");
    assert!(String::from_utf8_lossy(&again.stderr).contains("set: exists already"));
    assert_eq!(fs::read_to_string(&jobs).expect("jobs").matches("(complete already)").count(), 3);
    // a shard is no data set
    let shard = text(&folder.path().join("set.shards/1-of-3")).to_owned();
    for command in ["inspect", "validate", "stats"] {
        refused(program("actrm-data").args([command, &shard]), &["shard 1/3 of a conversion", "actrm-data merge"]);
    }
    refused(
        program("actrm-data").args(["edit", "drop", &shard, "x", "--episodes", "0"]),
        &["shard 1/3 of a conversion"],
    );
    refused(program("actrm-zoo").args(["train", "act_lift", "--data", &shard]), &["shard 1/3 of a conversion"]);
}

#[test]
fn an_array_of_shards_and_the_job_that_merges_them() {
    let (folder, entries) = copied_zoo();
    let (jobs, path) = (folder.path().join("jobs"), with_sbatch(folder.path()));
    let script = root().join("tools/cluster/slurm_eval.sh");
    let mut command = Command::new(&script);
    let place = folder.path().join("elsewhere");
    command.args(["3", "lift-act@1", "--episodes", "4", "--max-steps", "3", "--zoo", text(&entries)]);
    command.args(["--results", text(&place)]);
    let zoo = program("actrm-zoo").get_program().to_owned();
    succeeds(command.env("PATH", path).env("ACTRM_ZOO", zoo).env("JOBS", &jobs).current_dir(root()));
    let jobs = fs::read_to_string(jobs).expect("jobs were queued");
    assert!(jobs.contains("--array=1-3") && jobs.contains("--dependency=afterok:4711"), "{jobs}");
    assert!(jobs.contains("of 4 episodes succeeded"), "{jobs}");
    let results = listing(&place);
    assert_eq!(results.iter().filter(|name| name.contains("_shard-")).count(), 3, "{results:?}");
    assert_eq!(results.iter().filter(|name| !name.contains("_shard-")).count(), 1, "{results:?}");
    let refused = Command::new(&script).args(["none", "lift-act@1"]).output().expect("it starts");
    assert_eq!(refused.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("slurm_eval.sh SHARDS"));
}
