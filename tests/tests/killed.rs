//! SIGKILL at any time during a training, an evaluation, a study, a leaderboard or an edit: nothing is left that cannot be read, and the same
//! command goes on to the same bytes. `ACTRM_KILLS=100` for more than a few of each.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use e2e::{copied_zoo, data, lift, listing, shipped, succeeds, text, trained, verified, zoo};

fn kills() -> u64 {
    std::env::var("ACTRM_KILLS").ok().map_or(2, |text| text.parse().expect("a number"))
}

/// A number from 0 to 1, another for every `k`, spread evenly.
fn spread(k: u64) -> f64 {
    (k as f64 * 0.618_033_988_749_894_9 + 0.37).fract()
}

/// Runs a command and kills it after `share` of the time that it takes; whether it was there to be killed.
fn killed(command: &mut Command, takes: Duration, share: f64) -> bool {
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("it starts");
    let until = Instant::now() + takes.mul_f64(share);
    while Instant::now() < until {
        if child.try_wait().expect("a child").is_some() {
            return false;
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    child.kill().expect("killed");
    child.wait().expect("gone");
    true
}

fn timed(command: &mut Command) -> Duration {
    let begin = Instant::now();
    succeeds(command);
    begin.elapsed()
}

fn train(folder: &Path) -> Command {
    let mut command = zoo([
        "train",
        "act_lift",
        "train.steps=60",
        "train.checkpoint_every=7",
        "train.batch_size=8",
        "train.accumulation=2",
        "train.ema_decay=0.9",
        "policy.dim_model=32",
    ]);
    command.args(["--seeds", "1..2", "--data", text(&trained().join("lift"))]);
    command.args(["--zoo", text(&folder.join("zoo")), "--runs", text(&folder.join("runs"))]);
    command
}

/// Weights of both entries.
fn weights(folder: &Path) -> Vec<Vec<u8>> {
    let read = |name: &str| fs::read(folder.join("zoo").join(name).join("1/model.safetensors")).expect("an entry");
    ["lift-act-s1", "lift-act-s2"].map(read).into()
}

#[test]
fn a_killed_training_goes_on_to_the_same_bytes() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let at = |name: &str| -> PathBuf {
        let path = folder.path().join(name);
        fs::create_dir_all(&path).expect("creatable");
        path
    };
    let straight = at("straight");
    let takes = timed(&mut train(&straight));
    let mut died = 0;
    for k in 0..kills() {
        let folder = at(&format!("killed-{k}"));
        for again in 0..3 {
            died += u32::from(killed(&mut train(&folder), takes, spread(3 * k + again)));
            // whatever is there can be listed and read
            succeeds(&mut zoo(["runs", "--runs", text(&folder.join("runs")), "--all"]));
            verified(&folder.join("zoo"));
        }
        succeeds(&mut train(&folder));
        assert_eq!(weights(&folder), weights(&straight), "after {died} kills");
        assert_eq!(listing(&folder.join("zoo")), ["lift-act-s1", "lift-act-s2"]);
        fs::remove_dir_all(folder).expect("removable");
    }
    assert!(died > 0, "none was killed in time");
}

#[test]
fn a_killed_evaluation_goes_on_to_the_same_bytes() {
    let (_folder, entries) = copied_zoo();
    let eval = |results: &Path| {
        let mut command = zoo(["eval", "lift-act@1", "--max-steps", "6", "--episodes", "16", "--workers", "2"]);
        command.args(["--zoo", text(&entries), "--results", text(results)]);
        command
    };
    let outcomes = |results: &Path| {
        let names = listing(results);
        assert_eq!(names.len(), 1, "{names:?}");
        fs::read(results.join(&names[0]).join("outcomes.parquet")).expect("a finished evaluation")
    };
    let straight = entries.join("straight");
    let takes = timed(&mut eval(&straight));
    let mut died = 0;
    for k in 0..kills() {
        let results = entries.join(format!("killed-{k}"));
        for again in 0..2 {
            died += u32::from(killed(&mut eval(&results), takes, spread(2 * k + again)));
        }
        succeeds(&mut eval(&results));
        assert_eq!(outcomes(&results), outcomes(&straight));
        succeeds(&mut zoo(["verify", "--zoo", text(&entries), "--results", text(&results)]));
        fs::remove_dir_all(results).expect("removable");
    }
    assert!(died > 0, "none was killed in time");
}

/// A study of one small policy: five demonstrations from the expert, a training, three episodes; with `demonstrations`
/// that are there already, it begins with the training.
fn study(folder: &Path, demonstrations: Option<&Path>) -> Command {
    let (results, page) = (folder.join("results"), folder.join("page.md"));
    let file = folder.join("small.toml");
    let settings = ["train.steps=40", "train.checkpoint_every=7", "train.batch_size=8", "policy.dim_model=32"];
    let definition = format!(
        "title = \"Small\"\nresults = {results:?}\npage = {page:?}\n[data.lift]\ntask = \"Lift\"\nepisodes = 5\n\
         [arms.act]\nlabel = \"ACT\"\nexperiment = \"act_lift\"\nset = {settings:?}\n\
         [tests.lift]\ntask = \"Lift\"\nepisodes = 3\nseed_start = 40000\n\
         [[cells]]\narms = [\"act\"]\ndata = \"lift\"\nseeds = 1\ntests = [\"lift\"]\n"
    );
    fs::write(&file, definition).expect("writable");
    if let Some(from) = demonstrations {
        let to = folder.join("work/small/data");
        fs::create_dir_all(&to).expect("creatable");
        fs::copy(from, to.join("lift-5-seed1.hdf5")).expect("copied");
    }
    let mut command = zoo(["study", text(&file), "--work", text(&folder.join("work"))]);
    command.env("RAYON_NUM_THREADS", "1");
    command
}

/// All that a study has made and that no clock decides: demonstrations, weights and outcomes.
fn studied(folder: &Path) -> (Vec<u8>, Vec<u8>, serde_json::Value) {
    let read = |path: PathBuf| fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let work = folder.join("work/small");
    let entries: Vec<String> = listing(&work.join("zoo")).into_iter().filter(|name| name.starts_with("act")).collect();
    assert_eq!(entries.len(), 1, "{entries:?}");
    assert_eq!(listing(&folder.join("results")), ["act-on-lift-seed1_lift.json", "success.svg"]);
    let result = read(folder.join("results/act-on-lift-seed1_lift.json"));
    let mut result: serde_json::Value = serde_json::from_slice(&result).expect("JSON");
    result["query_ms"] = 0.into();
    result["training"]["minutes"] = 0.into();
    assert!(folder.join("page.md").is_file());
    let weights = read(work.join("zoo").join(&entries[0]).join("1/model.safetensors"));
    (read(work.join("data/lift-5-seed1.hdf5")), weights, result)
}

#[test]
fn a_killed_study_goes_on_to_the_same_bytes() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let at = |name: &str| -> PathBuf {
        let path = folder.path().join(name);
        fs::create_dir_all(&path).expect("creatable");
        path
    };
    let straight = at("straight");
    let whole = timed(&mut study(&straight, None));
    let demonstrations = straight.join("work/small/data/lift-5-seed1.hdf5");
    let trained = at("trained");
    let takes = [whole, timed(&mut study(&trained, Some(&demonstrations)))];
    assert_eq!(studied(&trained), studied(&straight));
    let mut died = 0;
    for k in 0..kills().div_ceil(3) {
        let folder = at(&format!("killed-{k}"));
        // every other one begins with the training
        let demonstrations = (k % 2 == 1).then_some(&*demonstrations);
        for again in 0..3 {
            let takes = takes[(k % 2) as usize];
            died += u32::from(killed(&mut study(&folder, demonstrations), takes, spread(3 * k + again)));
            verified(&folder.join("work/small/zoo"));
        }
        succeeds(&mut study(&folder, demonstrations));
        assert_eq!(studied(&folder), studied(&straight), "after {died} kills");
        fs::remove_dir_all(folder).expect("removable");
    }
    assert!(died > 0, "none was killed in time");
}

#[test]
fn a_killed_leaderboard_leaves_whole_files() {
    let (folder, entries) = shipped(&["door-act"]);
    let out = folder.path().join("out");
    let board = || {
        let mut command = zoo(["leaderboard", "--zoo", text(&entries), "--out", text(&out)]);
        command.stdout(Stdio::null());
        command
    };
    let files = || ["leaderboard.csv", "report.html"].map(|name| fs::read(out.join(name)).unwrap_or_default());
    let takes = timed(&mut board());
    let whole = files();
    let mut died = 0;
    for k in 0..2 * kills() {
        // over old files, and where there are none
        if k % 2 == 0 {
            fs::remove_dir_all(&out).expect("removable");
        }
        died += u32::from(killed(&mut board(), takes, spread(k)));
        for (found, expected) in files().iter().zip(&whole) {
            assert!(found == expected || (k % 2 == 0 && found.is_empty()), "half a file");
        }
        succeeds(&mut board());
        assert_eq!(files(), whole);
    }
    assert!(died > 0, "none was killed in time");
}

#[test]
fn a_killed_edit_in_place_leaves_the_old_set_or_the_new() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let set = folder.path().join("set");
    succeeds(&mut data(["convert", text(&lift()), text(&set)]));
    let rename = |from: &str, to: &str| {
        let mut command = data(["edit", "rename", text(&set), "--in-place", "--feature"]);
        command.arg(format!("{from}={to}"));
        command
    };
    let mut names = ["next.reward", "reward"];
    let takes = timed(&mut rename(names[0], names[1]));
    names.reverse();
    let mut died = 0;
    for k in 0..6 * kills() {
        died += u32::from(killed(&mut rename(names[0], names[1]), takes, spread(k)));
        succeeds(&mut data(["validate", text(&set)]));
        let columns = String::from_utf8(succeeds(&mut data(["inspect", text(&set), "--json"])).stdout).expect("text");
        let has = |name: &str| columns.contains(&format!("\"key\": \"{name}\""));
        assert!(has(names[0]) != has(names[1]), "{columns}");
        if has(names[1]) {
            names.reverse();
        }
    }
    // the next one takes away what the killed ones left
    succeeds(&mut rename(names[0], names[1]));
    assert_eq!(listing(folder.path()), ["set"], "after {died} kills");
    assert!(died > 0, "none was killed in time");
}
