//! Ctrl-C and SIGTERM, once, at any time: the program ends within two seconds, says how to go on, and that works.

use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use e2e::{copied_zoo, data, listing, program, signal, succeeds, text, trained, wait_until, zoo};

/// Two seconds, and what a crowded machine takes to notice.
const SOON: Duration = Duration::from_secs(4);

fn started(command: &mut Command) -> Child {
    command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("it starts")
}

/// Ends by exit code 130 soon after one signal; returns what it said on standard error.
fn ends(mut child: Child, name: &str) -> String {
    let begin = Instant::now();
    signal(&child, name);
    while child.try_wait().expect("a child").is_none() {
        assert!(begin.elapsed() < Duration::from_secs(60), "{name}: still there after a minute");
        std::thread::sleep(Duration::from_millis(10));
    }
    let took = begin.elapsed();
    let output = child.wait_with_output().expect("its output");
    let error = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(130), "{name}: {:?}: {error}", output.status);
    assert!(took < SOON, "{name}: it took {took:?}: {error}");
    error
}

/// Worker processes whose parent is this process.
fn workers(of: u32) -> usize {
    let parent = of.to_string();
    let output = Command::new("pgrep").args(["-P", &parent]).output().expect("pgrep");
    String::from_utf8_lossy(&output.stdout).lines().count()
}

#[test]
fn one_signal_ends_a_program_that_starts_its_simulators() {
    let (folder, entries) = copied_zoo();
    let out = folder.path().join("out.hdf5");
    for (name, wait) in [("INT", 50), ("TERM", 50), ("INT", 1500)] {
        for mut command in [
            zoo(["eval", "lift-act@1", "--episodes", "400", "--workers", "2", "--zoo", text(&entries)]),
            data(["collect", "--task", "Lift", "--episodes", "400", "--workers", "2", "--out", text(&out)]),
        ] {
            let child = started(&mut command);
            let id = child.id();
            // from the first worker's start on
            wait_until("a simulator", || (workers(id) > 0).then_some(()));
            std::thread::sleep(Duration::from_millis(wait));
            let error = ends(child, name);
            assert!(error.contains("run the same command again"), "{error}");
        }
    }
    assert!(!out.exists());
    assert!(!listing(folder.path()).iter().any(|name| name.ends_with(".part")), "{:?}", listing(folder.path()));
}

/// A training that would take hours, into a zoo and with settings of its own.
fn long_training(folder: &Path) -> Command {
    let (set, entries, runs) = (trained().join("lift"), folder.join("a zoo's"), folder.join("runs"));
    let mut command = zoo(["train", "act_lift", "train.steps=1000000", "train.batch_size=2", "policy.dim_model=32"]);
    command.args(["--data", text(&set), "--zoo", text(&entries), "--runs", text(&runs)]);
    command
}

#[test]
fn a_stopped_training_says_the_command_that_goes_on_and_runs_lists_it() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let folder = folder.path();
    let runs = folder.join("runs");
    let listed = || {
        let output = succeeds(&mut zoo(["runs", "--runs", text(&runs), "--json"]));
        serde_json::from_slice::<serde_json::Value>(&output.stdout).expect("JSON")
    };
    assert_eq!(listed(), serde_json::json!([]));
    let child = started(&mut long_training(folder));
    // its first line names the columns
    let metrics = || std::fs::read_to_string(runs.join("act_lift/001/metrics.csv")).unwrap_or_default();
    wait_until("a step", || (metrics().lines().count() > 1).then_some(()));
    assert_eq!((&listed()[0]["state"], &listed()[0]["steps"]), (&"training".into(), &1_000_000.into()));
    let error = ends(child, "TERM");
    let hint = error.lines().find_map(|line| line.split_once("resume with: ")).expect("a hint").1.to_owned();

    let run = listed()[0].clone();
    assert_eq!((&run["state"], &run["command"]), (&"stopped".into(), &hint.clone().into()));
    assert!(run["step"].as_u64().is_some_and(|step| step > 0), "{run}");
    let table = String::from_utf8(succeeds(&mut zoo(["runs", "--runs", text(&runs)])).stdout).expect("text");
    assert!(table.contains("stopped") && table.contains(&hint), "{table}");

    // pasted into a shell it goes on, with the same settings, into the same zoo
    let programs = Path::new(program("actrm-zoo").get_program()).parent().expect("a folder").to_owned();
    let path = format!("{}:{}", programs.display(), std::env::var("PATH").expect("a PATH"));
    let mut resumed = Command::new("bash");
    resumed.args(["-c", &format!("exec {hint}")]).env("PATH", path).current_dir("/");
    let child = started(&mut resumed);
    let before = run["step"].as_u64();
    wait_until("the training again", || (listed()[0]["state"] == "training").then_some(()));
    std::thread::sleep(Duration::from_secs(2));
    let error = ends(child, "INT");
    assert!(error.contains("resumed after step") && error.contains(&hint), "{error}");
    assert!(listed()[0]["step"].as_u64() >= before, "{:?}", listed());
    assert_eq!(listing(&runs.join("act_lift")), ["001"]);
}

/// Reads standard error until a line contains `words`.
fn said(errors: &mut impl BufRead, words: &str) {
    let mut line = String::new();
    while !line.contains(words) {
        line.clear();
        assert!(errors.read_line(&mut line).expect("text") > 0, "it ended without {words:?}");
    }
}

/// Sends as many signals, one after the other, once the first step can have begun.
fn signalled(command: &mut Command, count: usize, between: &str) -> (Option<i32>, String) {
    let mut child = started(command);
    let mut errors = BufReader::new(child.stderr.take().expect("piped"));
    said(&mut errors, " steps");
    let kills = vec![format!("kill -TERM {}", child.id()); count].join(between) + "; true";
    assert!(Command::new("bash").args(["-c", &kills]).status().expect("bash runs").success());
    let mut rest = String::new();
    errors.read_to_string(&mut rest).expect("text");
    (child.wait().expect("a child").code(), rest)
}

#[test]
fn two_signals_at_once_save_the_checkpoint_like_one() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let run = folder.path().join("run");
    let mut before = 0;
    for time in 0..50 {
        let mut command = long_training(folder.path());
        command.args(["--run", text(&run)]);
        if time > 0 {
            command.arg("--resume");
        }
        let (code, errors) = signalled(&mut command, 2, "; ");
        assert_eq!(code, Some(130), "time {time}: {errors}");
        let step = errors.lines().find_map(|line| line.strip_prefix("stopped after step ")?.split(';').next());
        let step: u64 = step.and_then(|step| step.parse().ok()).unwrap_or_else(|| panic!("time {time}: {errors}"));
        let checkpoint = run.join(format!("checkpoints/{step:08}.safetensors"));
        assert!(step >= before && checkpoint.is_file(), "time {time}: {before} {step}: {errors}");
        before = step;
    }
}

#[test]
fn a_third_signal_ends_a_training_at_once() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    // a step that takes longer than the signals
    let mut command = long_training(folder.path());
    command.args(["train.batch_size=1000", "policy.dim_model=256"]);
    // signals that come at the same moment are one
    let (code, errors) = signalled(&mut command, 10, "; sleep 0.02; ");
    assert_eq!(code, Some(130), "{errors}");
    assert!(errors.contains("stopped without a new checkpoint"), "{errors}");
}

#[test]
fn a_signal_while_demonstrations_are_read_ends_a_training_that_never_began() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let child = started(&mut long_training(folder.path()));
    // a program that has only just begun listens to nothing
    wait_until("its handler", || {
        let status = std::fs::read_to_string(format!("/proc/{}/status", child.id())).ok()?;
        let caught = status.lines().find_map(|line| line.strip_prefix("SigCgt:\t"))?;
        (u64::from_str_radix(caught, 16).ok()? & 2 != 0).then_some(())
    });
    ends(child, "INT");
}
