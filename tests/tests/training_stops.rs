//! Trainings that end before their time: killed outright and resumed, and stopped by a number that is not finite.

use std::fs;
use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

use e2e::{data, lift, listing, succeeds, text, zoo};

/// Small enough to train in seconds; the recursion, the moving average and accumulation in parts all in use.
const SETTINGS: [&str; 9] = [
    "policy.dim_model=32",
    "policy.dim_feedforward=48",
    "policy.reasoning.warm_start={ noise = 0.1 }",
    "train.steps=40",
    "train.batch_size=12",
    "train.accumulation=3",
    "train.ema_decay=0.9",
    "train.checkpoint_every=1",
    "train.validate_every=10",
];

/// `train actrm_lift` on `folder/lift` into `folder/<name>`; more arguments may follow.
fn train(folder: &Path, name: &str) -> std::process::Command {
    let (set, entries, runs) = (folder.join("lift"), folder.join(name).join("zoo"), folder.join(name).join("runs"));
    let mut command = zoo(["train", "actrm_lift"]);
    command.args(["--data", text(&set), "--zoo", text(&entries), "--runs", text(&runs)]).args(SETTINGS);
    command
}

fn weights(folder: &Path, name: &str) -> Vec<u8> {
    let entry = folder.join(name).join("zoo/lift-actrm/1/model.safetensors");
    fs::read(&entry).unwrap_or_else(|e| panic!("{}: {e}", entry.display()))
}

/// The newest checkpoint of a run, by name.
fn newest(folder: &Path, name: &str) -> Option<String> {
    let names = listing(&folder.join(name).join("runs/actrm_lift/001/checkpoints"));
    names.into_iter().filter(|name| name.ends_with(".safetensors") && !name.starts_with('.')).max()
}

#[test]
fn a_training_killed_again_and_again_ends_in_the_same_bytes() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let folder = folder.path();
    succeeds(&mut data(["convert", text(&lift()), text(&folder.join("lift"))]));
    succeeds(&mut train(folder, "whole"));

    let mut kills = 0;
    loop {
        let before = newest(folder, "killed");
        let mut command = train(folder, "killed");
        if kills > 0 {
            command.arg("--resume");
        }
        let mut child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().expect("the program starts");
        // let it get some checkpoints further, then kill it wherever it is
        let ended = loop {
            if let Some(status) = child.try_wait().expect("a child") {
                break Some(status);
            }
            if kills < 4 && newest(folder, "killed") > before {
                std::thread::sleep(Duration::from_millis(7 * kills));
                child.kill().expect("killed");
                child.wait().expect("a child");
                break None;
            }
            std::thread::sleep(Duration::from_millis(1));
        };
        match ended {
            Some(status) => {
                assert!(status.success(), "{status} after {kills} kills");
                break;
            }
            None => kills += 1,
        }
    }
    assert!(kills > 0, "the training was over before it could be killed");
    assert!(weights(folder, "whole") == weights(folder, "killed"), "{kills} kills changed the weights");
}

#[test]
fn a_loss_that_is_not_finite_names_step_and_tensor_and_leaves_the_last_good_checkpoint() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let folder = folder.path();
    succeeds(&mut data(["convert", text(&lift()), text(&folder.join("lift"))]));
    let mut command = train(folder, "run");
    // the learning rate grows until the weights overflow
    command.args(["train.lr=1e37", "train.warmup_steps=1000000", "train.grad_clip_norm=0", "train.steps=1000"]);
    let output = command.env_remove("RUST_BACKTRACE").output().expect("the program starts");
    let errors = String::from_utf8_lossy(&output.stderr);
    let line = errors.lines().last().expect("a line on standard error").to_owned();
    assert_eq!(output.status.code(), Some(1), "{errors}");
    assert!(line.starts_with("error: step ") && line.contains("training stopped, last good checkpoint"), "{errors}");
    let last = newest(folder, "run").unwrap_or_else(|| panic!("no checkpoint was kept: {line}"));
    assert!(line.contains(&last), "{line} does not name {last}");
    assert!(listing(&folder.join("run/zoo")).is_empty(), "no entry may come of it");
}
