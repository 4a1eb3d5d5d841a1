//! Policies that see, end to end: demonstrations with two cameras, videos, training, evaluation, what they look at, and
//! what does not fit.

use std::fs;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use e2e::{data, listing, refused, succeeds, text, zoo};
use serde_json::Value;
use tempfile::TempDir;

const AGENT: &str = "observation.images.agentview";

fn said(command: &mut Command) -> String {
    String::from_utf8(succeeds(command).stdout).expect("text")
}

/// Three demonstrations of Lift seen by two cameras, `seen.hdf5`, and `set`, the data set of it, in a folder.
fn seen() -> &'static Path {
    static SEEN: OnceLock<TempDir> = OnceLock::new();
    SEEN.get_or_init(|| {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let (file, set) = (folder.path().join("seen.hdf5"), folder.path().join("set"));
        let mut collect = data(["collect", "--task", "Lift", "--episodes", "3", "--no-next-obs", "--out", text(&file)]);
        collect.args(["--cameras", "agentview,robot0_eye_in_hand", "--image-size", "24", "--fast-render"]);
        succeeds(&mut collect);
        succeeds(&mut data(["convert", text(&file), text(&set), "--env-keys", ""]));
        folder
    })
    .path()
}

/// Trains `lift-act-image` on a data set for two steps, small.
fn train(set: &Path, folder: &Path, more: &[&str]) -> Command {
    let mut command = zoo(["train", "act_lift_image", "--data", text(set)]);
    command.args(["--zoo", text(&folder.join("zoo")), "--runs", text(&folder.join("runs"))]);
    command.args(["train.steps=2", "train.batch_size=4", "policy.dim_model=16", "policy.n_heads=2"]);
    command.args(["policy.dim_feedforward=16", "policy.n_encoder_layers=1", "policy.vision.crop=20"]).args(more);
    command
}

/// A zoo with `lift-act-image@1`, trained for two steps.
fn trained() -> &'static Path {
    static TRAINED: OnceLock<TempDir> = OnceLock::new();
    TRAINED
        .get_or_init(|| {
            let folder = tempfile::tempdir().expect("a temporary folder");
            succeeds(&mut train(&seen().join("set"), folder.path(), &[]));
            folder
        })
        .path()
}

fn eval(entry: &str, zoo_folder: &Path, more: &[&str]) -> Command {
    let mut command = zoo(["eval", entry, "--zoo", text(zoo_folder), "--workers", "1", "--max-steps", "12"]);
    command.args(more);
    command
}

/// Runs a training that must be refused, in words that hold every one of these; it has told of its folder before.
fn stopped(command: &mut Command, words: &[&str]) {
    let output = command.output().expect("the program starts");
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{command:?}: {said}");
    for word in words {
        assert!(said.contains(word), "{command:?}: no {word:?} in: {said}");
    }
}

fn weights(zoo_folder: &Path) -> Vec<u8> {
    fs::read(zoo_folder.join("lift-act-image/1/model.safetensors")).expect("weights")
}

#[test]
fn from_cameras_to_the_leaderboard() {
    let entries = trained().join("zoo");
    let origin: Value =
        serde_json::from_slice(&fs::read(seen().join("set/actrm/info.json")).expect("info")).expect("JSON");
    assert_eq!(origin["env_args"]["fast_render"], true, "{}", origin["env_args"]);
    let entry = fs::read(entries.join("lift-act-image/1/entry.json")).expect("an entry");
    let entry: Value = serde_json::from_slice(&entry).expect("JSON");
    assert_eq!(entry["env_args"]["fast_render"], true);
    assert!(entry["signature"]["observation"].as_array().is_some_and(|specs| specs.len() == 3), "{entry}");

    let plain = eval("lift-act-image@1", &entries, &["--episodes", "2", "--video-failed", "1"]);
    let text_of = |mut command: Command| said(&mut command);
    let shown = text_of(plain);
    assert!(shown.contains("lift-act-image@1 on Lift, seeds 10000-10001: 0 of 2"), "{shown}");
    let videos = listing(&entries.join("videos/lift-act-image@1"));
    assert!(videos.len() == 1 && videos[0].starts_with("Lift-10000-failure-seen-"), "{videos:?}");
    // every outcome again, whatever drew the pictures
    let again = text_of(eval("lift-act-image@1", &entries, &["--episodes", "2", "--again"]));
    assert!(again.contains("2 episodes run again, every outcome the same"), "{again}");
    let changed = text_of(eval("lift-act-image@1", &entries, &["--episodes", "2", "--perturb", "black-agentview"]));
    assert!(changed.contains("lift-act-image@1 on Lift, black-agentview, seeds 10000-10001: 0 of 2"), "{changed}");
    refused(
        &mut eval("lift-act-image@1", &entries, &["--episodes", "2", "--perturb", "black-frontview"]),
        &["lift-act-image@1", "black-frontview", "camera frontview, found agentview, robot0_eye_in_hand"],
    );
    refused(&mut eval("lift-act-image@1", &entries, &["--perturb", "upside-down"]), &["upside-down", "swap-cameras"]);

    let board = said(&mut zoo(["leaderboard", "--zoo", text(&entries), "--wide"]));
    assert!(board.contains("-black-agentview"), "changed pictures are a protocol of their own: {board}");
}

#[test]
fn what_a_policy_looks_at_is_drawn() {
    let (entries, folder) = (trained().join("zoo"), tempfile::tempdir().expect("a temporary folder"));
    let out = folder.path().join("looked.png");
    let saliency = |entry: &'static str, zoo_folder: &Path| {
        let mut command = zoo(["saliency", entry, "--seed", "10003", "--queries", "2", "--zoo", text(zoo_folder)]);
        command.args(["--out", text(&out), "--json"]);
        command
    };
    let looked: Value = serde_json::from_str(&said(&mut saliency("lift-act-image@1", &entries))).expect("JSON");
    let queries = looked["queries"].as_array().expect("queries");
    assert_eq!(queries.len(), 2);
    for query in queries {
        let cameras = query["cameras"].as_array().expect("cameras");
        let names: Vec<_> = cameras.iter().map(|camera| camera["camera"].as_str().expect("a name")).collect();
        assert_eq!(names, ["agentview", "robot0_eye_in_hand"]);
        assert!(cameras.iter().all(|camera| camera["most"].as_f64().is_some_and(|x| x > 0.0)), "{query}");
    }
    assert!(fs::read(&out).expect("a picture").starts_with(b"\x89PNG"));
    refused(&mut saliency("lift-act-image@1", &entries), &["looked.png: exists already"]);
    refused(&mut saliency("lift-act@1", &e2e::root().join("zoo")), &["lift-act@1", "not an image policy"]);
    // a thought about pictures is traced in the environment of its demonstrations
    let traced = said(&mut zoo(["trace", "lift-act-image@1", "--zoo", text(&entries)]));
    assert!(traced.starts_with("lift-act-image@1 on Lift, seed 10000: "), "{traced}");
}

#[test]
fn an_image_policy_thinks_in_the_environment_of_its_demonstrations() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let mut depth =
        zoo(["depth", "lift-actrm-image-s1", "--steps", "1", "--episodes", "1", "--workers", "1", "--json"]);
    depth.args(["--zoo", text(&e2e::root().join("zoo")), "--work", text(folder.path())]);
    let rows: Value = serde_json::from_str(&said(&mut depth)).expect("JSON");
    assert_eq!((&rows[0]["steps"], &rows[0]["episodes"]), (&Value::from(1), &Value::from(1)), "{rows}");
}

#[test]
fn videos_become_windows_and_pictures_may_stay_in_a_file() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let at = |name: &str| folder.path().join(name);
    succeeds(&mut data(["convert", text(&seen().join("seen.hdf5")), text(&at("video")), "--env-keys", "", "--video"]));
    let inspected: Value =
        serde_json::from_str(&said(&mut data(["inspect", text(&at("video")), "--json"]))).expect("JSON");
    let keys = inspected["keys"].as_array().expect("keys");
    let camera = keys.iter().find(|key| key["key"] == AGENT).expect("the camera is there");
    assert_eq!((&camera["dtype"], &camera["video"]["codecs"][0]), (&Value::from("video"), &Value::from("av1")));
    // the same windows, from memory and from a file that is read ahead: the same weights to the bit
    for (name, more) in [("memory", &[][..]), ("file", &["--image-memory", "1k"][..])] {
        let output = succeeds(&mut train(&at("video"), &at(name), &[more, &["train.steps=3"]].concat()));
        let kept = String::from_utf8_lossy(&output.stderr).contains("kept in a file");
        assert_eq!(kept, name == "file");
    }
    assert!(weights(&at("memory/zoo")) == weights(&at("file/zoo")), "where pictures are kept changes what is learned");
    let sheet = at("sheet.png");
    succeeds(&mut data(["plot", text(&at("video")), "--episode", "2", "--frames", "4", "--out", text(&sheet)]));
    assert!(fs::read(&sheet).expect("a picture").starts_with(b"\x89PNG"));
    refused(
        &mut data(["plot", text(&at("video")), "--column", "observation.images.side", "--out", text(&at("x.png"))]),
        &["observation.images.side", AGENT],
    );
    // a video that ends before its episodes do
    let file = |camera: &str| -> PathBuf { at("video").join(format!("videos/{camera}/chunk-000/file-000.mp4")) };
    let short = folder.path().join("short.hdf5");
    let mut one = data(["collect", "--task", "Lift", "--episodes", "1", "--no-next-obs", "--out", text(&short)]);
    succeeds(one.args(["--cameras", "agentview", "--image-size", "24", "--fast-render"]));
    succeeds(&mut data(["convert", text(&short), text(&at("short")), "--env-keys", "", "--video"]));
    fs::copy(at("short").join(format!("videos/{AGENT}/chunk-000/file-000.mp4")), file(AGENT)).expect("copied");
    stopped(&mut train(&at("video"), &at("cut"), &[]), &[AGENT, "frame 0 of episode 1", "within 0.0001 s of"]);
}

/// The FFmpeg of the Python package `imageio-ffmpeg`.
fn ffmpeg() -> String {
    let asked = "import imageio_ffmpeg; print(imageio_ffmpeg.get_ffmpeg_exe())";
    let python = Command::new(e2e::root().join(".venv/bin/python")).args(["-c", asked]).output().expect("it starts");
    String::from_utf8(python.stdout).expect("a path").trim().to_owned()
}

/// All images of a camera in a robomimic file.
fn images(file: &Path) -> Vec<u8> {
    let file = hdf5::File::open(file).expect("an HDF5 file");
    let of = |demo: usize| file.dataset(&format!("data/demo_{demo}/obs/agentview_image")).expect("images");
    (0..3).flat_map(|demo| of(demo).read_raw::<u8>().expect("bytes")).collect()
}

#[test]
fn ffmpeg_decodes_what_is_not_read_here_and_is_asked_for_where_it_is_not() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let at = |name: &str| folder.path().join(name);
    let ffmpeg = ffmpeg();
    let mut convert = data(["convert", text(&seen().join("seen.hdf5")), text(&at("set")), "--env-keys", "", "--video"]);
    convert.args(["--video-encoder", "h264", "--quantizer", "40", "--no-lossless"]).env("ACTRM_FFMPEG", &ffmpeg);
    succeeds(&mut convert);
    // a set of somebody else's: nothing is known of its content
    fs::remove_dir_all(at("set/actrm")).expect("a side folder");
    let export = |name: &str, program: &str| {
        let mut command = data(["convert", text(&at("set")), text(&at(name)), "--to", "robomimic"]);
        command.env("ACTRM_FFMPEG", program);
        command
    };
    succeeds(&mut export("first.hdf5", "nowhere"));
    let expected = images(&at("first.hdf5"));
    let film = at("set").join(format!("videos/{AGENT}/chunk-000/file-000.mp4"));
    let original = at("original.mp4");
    fs::rename(&film, &original).expect("moved");
    let video = |more: &[&str]| {
        let mut command = Command::new(&ffmpeg);
        command.args(["-y", "-loglevel", "error", "-i", text(&original)]).args(more).arg(&film);
        succeeds(&mut command);
    };
    for (what, more) in [
        ("HEVC (H.265)", &["-c:v", "libx265", "-crf", "8", "-x265-params", "log-level=none"][..]),
        (
            "HEVC (H.265)",
            &["-c:v", "libx265", "-pix_fmt", "yuv420p10le", "-crf", "8", "-x265-params", "log-level=none"],
        ),
        ("AV1 with 10 bits", &["-c:v", "libsvtav1", "-pix_fmt", "yuv420p10le", "-crf", "8"]),
        ("AV1 with 4:4:4", &["-c:v", "libaom-av1", "-pix_fmt", "yuv444p", "-crf", "8", "-cpu-used", "8"]),
        ("H.264 with 10 bits", &["-c:v", "libx264", "-pix_fmt", "yuv420p10le", "-crf", "8"]),
        ("H.264 with 4:4:4", &["-c:v", "libx264", "-pix_fmt", "yuv444p", "-crf", "8"]),
        ("VP8 or VP9", &["-c:v", "libvpx-vp9", "-crf", "8"]),
    ] {
        video(more);
        let name = more.join("_") + ".hdf5";
        succeeds(&mut export(&name, &ffmpeg));
        let found = images(&at(&name));
        assert_eq!(found.len(), expected.len(), "{what}");
        let off: u64 = found.iter().zip(&expected).map(|(&a, &b)| u64::from(a.abs_diff(b))).sum();
        assert!(off < 6 * found.len() as u64, "{what}: {off} levels in {} values", found.len());
        stopped(&mut export("x.hdf5", "nowhere"), &["file-000.mp4", what, "install `ffmpeg`", "imageio-ffmpeg"]);
    }
    // FFmpeg cannot be led to other files, and a damaged one is named
    let bytes = fs::read(&film).expect("a film");
    let (start, end) = (bytes.len() / 2, bytes.len());
    fs::write(&film, [&bytes[..start], &vec![0x55; end - start]].concat()).expect("writable");
    stopped(&mut export("x.hdf5", &ffmpeg), &["file-000.mp4"]);
    assert!(!at("x.hdf5").exists());
}

#[test]
fn ffmpeg_encodes_videos_where_it_is_and_is_named_where_it_cannot() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let at = |name: &str| folder.path().join(name);
    let ffmpeg = ffmpeg();
    let convert = |program: &str, out: &str, more: &[&str]| {
        let mut command =
            data(["convert", text(&seen().join("seen.hdf5")), text(&at(out)), "--env-keys", "", "--video"]);
        command.args(more).env("ACTRM_FFMPEG", program);
        command
    };
    succeeds(&mut convert(&ffmpeg, "one", &["--video-encoder", "ffmpeg"]));
    succeeds(&mut convert(&ffmpeg, "again", &["--jobs", "1"]));
    assert_eq!(listing(&at("one")), listing(&at("again")));
    let film = format!("videos/{AGENT}/chunk-000/file-000.mp4");
    let (one, again) = (fs::read(at("one").join(&film)).expect("a film"), fs::read(at("again").join(&film)));
    assert!(one == again.expect("a film"), "the same command writes the same bytes");
    succeeds(&mut data(["validate", text(&at("one"))]));
    let info = fs::read_to_string(at("one/actrm/info.json")).expect("readable");
    assert!(info.contains("SVT-AV1 by FFmpeg"), "{info}");
    // H.264, which LeRobot's users know by this name
    succeeds(&mut convert(&ffmpeg, "h264", &["--video-encoder", "h264"]));
    succeeds(&mut convert(&ffmpeg, "h264_again", &["--video-encoder", "h264", "--jobs", "1"]));
    let (one, again) = (fs::read(at("h264").join(&film)).expect("a film"), fs::read(at("h264_again").join(&film)));
    assert!(one == again.expect("a film") && one.windows(4).any(|kind| kind == b"avc1"));
    succeeds(&mut data(["validate", text(&at("h264"))]));
    for (file, words) in [("meta/info.json", "\"video.codec\": \"h264\""), ("actrm/info.json", "x264 by FFmpeg")] {
        let info = fs::read_to_string(at("h264").join(file)).expect("readable");
        assert!(info.contains(words), "{info}");
    }
    // the built-in encoder has no need of it
    succeeds(&mut convert("nowhere", "builtin", &["--quantizer", "120", "--video-encoder", "builtin"]));
    let info = fs::read_to_string(at("builtin/actrm/info.json")).expect("readable");
    assert!(info.contains("rav1e"), "{info}");
    // whoever names one wants it
    for more in [&["--video-encoder", "libsvtav1"][..], &[]] {
        stopped(&mut convert("nowhere", "x", more), &["FFmpeg cannot be used: nowhere", "ACTRM_FFMPEG"]);
    }
    stopped(&mut convert("/bin/true", "x", &["--video-encoder", "ffmpeg"]), &["/bin/true: no FFmpeg", "builtin"]);
    // one that breaks, one that is killed midway, one that makes nothing
    let broken = at("ffmpeg");
    for (does, words) in [
        ("echo no room >&2; exit 1", "exit status: 1: no room"),
        ("head -c 3000 >/dev/null; kill -9 $$", "signal: 9"),
        ("cat >/dev/null", "it made 0 frames of"),
    ] {
        let script = format!("#!/bin/sh\ncase \"$*\" in *rawvideo*) {does}; exit;; esac\nexec '{ffmpeg}' \"$@\"\n");
        fs::write(&broken, script).expect("writable");
        fs::set_permissions(&broken, fs::Permissions::from_mode(0o755)).expect("executable");
        stopped(&mut convert(text(&broken), "x", &[]), &["cannot be encoded", words]);
    }
    assert!(!at("x").exists());
}

#[test]
fn cameras_that_do_not_fit_are_named() {
    let (set, folder) = (seen().join("set"), tempfile::tempdir().expect("a temporary folder"));
    stopped(
        &mut train(&set, folder.path(), &["data.cameras=[\"frontview\"]"]),
        &["no camera observation.images.frontview", AGENT, "observation.images.robot0_eye_in_hand"],
    );
    stopped(&mut train(&set, folder.path(), &["policy.vision.crop=30"]), &["crop", "30", "24"]);
}

#[test]
fn pictures_are_seen_in_the_colours_of_three_entities() {
    let (file, folder) = (seen().join("seen.hdf5"), tempfile::tempdir().expect("a temporary folder"));
    let at = |name: &str| folder.path().join(name);
    let things = [
        "data.env_keys=[]",
        "data.entities.a={keys=[\"object[0:3]\"], group=\"colour\", position=true}",
        "data.entities.b={keys=[\"robot0_eef_pos\"], group=\"colour\", position=true}",
        "data.entities.c={keys=[\"object[7:10]\"], group=\"colour\", position=true}",
    ];
    let painted = [&things[..], &["data.picture_colours=[\"a\", \"b\", \"c\"]"]].concat();
    let other = [&things[..], &["data.picture_colours=[\"b\", \"a\", \"c\"]"]].concat();
    for (name, more) in [("plain", &things[..]), ("painted", &painted), ("again", &painted), ("other", &other)] {
        succeeds(&mut train(&file, &at(name), more));
    }
    let of = |name: &str| weights(&at(name).join("zoo"));
    assert!(of("painted") == of("again"));
    assert!(of("painted") != of("plain") && of("painted") != of("other"), "the colours change nothing");
    let entry = fs::read(at("painted/zoo/lift-act-image/1/entry.json")).expect("an entry");
    let entry: Value = serde_json::from_slice(&entry).expect("JSON");
    let specs = entry["signature"]["observation"].as_array().expect("features");
    let agent = specs.iter().find(|spec| spec["name"] == AGENT).expect("the camera is there");
    let colours = ["a", "b", "c"].map(|name| format!("observation.entity.{name}"));
    assert_eq!(agent["colours"], serde_json::json!(colours));
    // evaluated in them, and again with the same outcomes
    let entries = at("painted/zoo");
    let shown = said(&mut eval("lift-act-image@1", &entries, &["--episodes", "1"]));
    assert!(shown.contains("lift-act-image@1 on Lift, seeds 10000: 0 of 1"), "{shown}");
    let again = said(&mut eval("lift-act-image@1", &entries, &["--episodes", "1", "--again"]));
    assert!(again.contains("1 episodes run again, every outcome the same"), "{again}");
    let mut wide = painted.clone();
    wide[3] = "data.entities.c={keys=[\"object[3:7]\"]}";
    stopped(&mut train(&file, &at("wide"), &wide), &["colours", "observation.entity.c", "shape [4]", "3 numbers each"]);
}
