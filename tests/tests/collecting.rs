//! `actrm-data collect` as users run it: killed and run again, with cameras, refused.

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};

use e2e::{data, listing, refused, succeeds, text, wait_until};

fn collect(out: &Path, more: &[&str]) -> Command {
    let mut command = data(["collect", "--task", "Lift", "--out", text(out)]);
    if !more.contains(&"--episodes") {
        command.args(["--episodes", "3"]);
    }
    command.args(more);
    command
}

/// Kills it once its first attempt is on disk. It is asked for more than it can record until then.
fn killed(out: &Path) {
    let mut child = collect(out, &["--workers", "1", "--episodes", "300"])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("it starts");
    let attempts = out.with_file_name(format!(".{}.attempts", out.file_name().expect("a file").to_string_lossy()));
    wait_until("the first attempt", || {
        assert!(child.try_wait().expect("its state").is_none(), "it ended by itself");
        listing(&attempts).iter().any(|name| name.starts_with("attempt-")).then_some(())
    });
    child.kill().expect("it can be killed");
    child.wait().expect("it ends");
    assert!(!out.exists());
}

#[test]
fn killed_and_run_again_it_writes_the_same_bytes_and_leaves_nothing_else() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (straight, again) = (folder.path().join("straight.hdf5"), folder.path().join("again.hdf5"));
    succeeds(&mut collect(&straight, &["--workers", "2"]));
    killed(&again);
    // what lies there belongs to seed 1
    refused(&mut collect(&again, &["--seed", "2"]), &[".again.hdf5.attempts", "first_seed", "2000000", "1000000"]);
    // and to the good demonstrator
    refused(&mut collect(&again, &["--skill", "poor"]), &[".again.hdf5.attempts", "skill", "poor", "good"]);
    let output = succeeds(&mut collect(&again, &["--workers", "1"]));
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(error.contains("going on after"), "{error}");
    assert!(fs::read(&straight).expect("a file") == fs::read(&again).expect("a file"), "the files differ");
    assert_eq!(listing(folder.path()), ["again.hdf5", "straight.hdf5"]);
    refused(&mut collect(&again, &[]), &["again.hdf5", "exists"]);

    // the seeds that its attempts used go with the demonstrations, so that no evaluation begins as they did
    let set = folder.path().join("set");
    succeeds(&mut data(["convert", text(&straight), text(&set)]));
    let origin = fs::read(set.join("actrm/info.json")).expect("a data set");
    let origin: serde_json::Value = serde_json::from_slice(&origin).expect("JSON");
    let seeds = origin["seeds"].as_str().expect("the seeds are recorded");
    let (first, last) = seeds.split_once('-').expect("FIRST-LAST");
    assert_eq!(first, "1000000");
    assert!((1_000_002..1_000_100).contains(&last.parse::<u64>().expect("a seed")), "{seeds}");
}

#[test]
fn which_expert_recorded_demonstrations_goes_with_them() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (file, set) = (folder.path().join("towers.hdf5"), folder.path().join("set"));
    let one = |task: &str, expert: &str| {
        let mut command = data(["collect", "--task", task, "--episodes", "1", "--expert", expert, "--workers", "1"]);
        command.args(["--out", text(&file)]);
        command
    };
    refused(&mut one("Lift", "recoveries"), &["Lift", "recoveries", "known: none"]);
    succeeds(&mut one("StackColor", "recoveries"));
    succeeds(&mut data(["convert", text(&file), text(&set)]));
    let origin = fs::read(set.join("actrm/info.json")).expect("a data set");
    let origin: serde_json::Value = serde_json::from_slice(&origin).expect("JSON");
    assert_eq!(origin["expert"], "recoveries");
    // back in the file it says so, too
    let again = folder.path().join("again.hdf5");
    succeeds(&mut data(["export", text(&set), text(&again)]));
    let expert = |path: &Path| {
        let attribute = hdf5::File::open(path).expect("a file").group("data").expect("data").attr("expert");
        attribute.expect("an attribute").read_scalar::<hdf5::types::VarLenUnicode>().expect("text").to_string()
    };
    assert_eq!((expert(&file), expert(&again)), ("recoveries".to_owned(), "recoveries".to_owned()));
}

#[test]
fn who_showed_demonstrations_goes_with_them() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let place = |name: &str| folder.path().join(name);
    let few = |out: &Path, episodes: &str, more: &[&str]| {
        let mut command =
            data(["collect", "--task", "Lift", "--episodes", episodes, "--workers", "1", "--out", text(out)]);
        command.args(more);
        command
    };
    let (mixed, usual, good) = (place("mixed.hdf5"), place("usual.hdf5"), place("good.hdf5"));
    refused(&mut few(&mixed, "6", &["--skill", "careless"]), &["careless", "good", "mixed", "poor"]);
    succeeds(&mut few(&mixed, "6", &["--skill", "mixed"]));
    succeeds(&mut few(&usual, "2", &[]));
    succeeds(&mut few(&good, "2", &["--skill", "good"]));
    assert!(fs::read(&usual).expect("a file") == fs::read(&good).expect("a file"), "good is not the usual");

    let word = |place: &hdf5::Group| {
        let attribute = place.attr("skill").expect("an attribute");
        attribute.read_scalar::<hdf5::types::VarLenUnicode>().expect("text").to_string()
    };
    let shown_by = |path: &Path| {
        let all = hdf5::File::open(path).expect("a file").group("data").expect("data");
        assert_eq!(word(&all), "mixed");
        (0..6).map(|demo| word(&all.group(&format!("demo_{demo}")).expect("a demo"))).collect::<Vec<_>>()
    };
    let who = shown_by(&mixed);
    assert!(who.iter().all(|name| ["good", "middling", "poor"].contains(&name.as_str())), "{who:?}");
    assert!(who.iter().any(|name| *name != who[0]), "{who:?}");
    let usual = hdf5::File::open(&usual).expect("a file").group("data").expect("data");
    assert!(usual.attr("skill").is_err() && usual.group("demo_0").expect("a demo").attr("skill").is_err());

    let (set, again) = (place("set"), place("again.hdf5"));
    succeeds(&mut data(["convert", text(&mixed), text(&set)]));
    let origin = fs::read(set.join("actrm/info.json")).expect("a data set");
    let origin: serde_json::Value = serde_json::from_slice(&origin).expect("JSON");
    assert_eq!(origin["skill"], "mixed");
    succeeds(&mut data(["export", text(&set), text(&again)]));
    assert_eq!(shown_by(&again), who);
}

#[test]
fn cameras_add_images_and_change_nothing_else() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (plain, seen) = (folder.path().join("plain.hdf5"), folder.path().join("seen.hdf5"));
    let one = |out: &Path, more: &[&str]| {
        let mut command = data(["collect", "--task", "Lift", "--episodes", "1", "--workers", "1", "--out", text(out)]);
        command.args(more);
        command
    };
    succeeds(&mut one(&plain, &[]));
    succeeds(&mut one(&seen, &["--cameras", "agentview", "--size", "16"]));
    let open = |path: &Path| hdf5::File::open(path).expect("an HDF5 file").group("data/demo_0").expect("demo_0");
    let (plain, seen) = (open(&plain), open(&seen));
    let values = |group: &hdf5::Group, name: &str| group.dataset(name).expect(name).read_raw::<f64>().expect("numbers");
    for name in ["actions", "states", "obs/object", "next_obs/robot0_eef_pos"] {
        assert!(values(&plain, name) == values(&seen, name), "{name} differs");
    }
    let images = seen.dataset("obs/agentview_image").expect("images");
    let steps = plain.dataset("actions").expect("actions").shape()[0];
    assert_eq!(images.shape(), [steps, 16, 16, 3]);
    let pixels = images.read_raw::<u8>().expect("bytes");
    assert!(pixels.iter().any(|&value| value != pixels[0]), "something is to be seen");
    refused(&mut one(&folder.path().join("x.hdf5"), &["--cameras", "nowhere"]), &["nowhere", "agentview"]);
}
