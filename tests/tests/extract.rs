//! `actrm-data extract`: a raw recording becomes what robomimic's own extraction made of it, and more with cameras.

use std::path::{Path, PathBuf};

use e2e::{data, listing, refused, root, succeeds, text};

/// Raw recording of three demos of Lift, and what robomimic's `dataset_states_to_obs` made of it.
fn fixture(name: &str) -> PathBuf {
    root().join("crates/dataset/tests/fixtures").join(name)
}

fn numbers(demo: &hdf5::Group, key: &str) -> Vec<f64> {
    demo.dataset(key).expect("the key is there").read_raw::<f64>().expect("numbers")
}

/// A copy of the raw recording with its first demo only, cut to so many steps.
fn short(folder: &Path, steps: usize) -> PathBuf {
    let path = folder.join("demo.hdf5");
    std::fs::copy(fixture("lift_raw_3_demos.hdf5"), &path).expect("copied");
    let file = hdf5::File::open_rw(&path).expect("opens");
    for gone in ["data/demo_2", "data/demo_3", "mask", "data/demo_1/action_dict"] {
        file.unlink(gone).expect("there");
    }
    let demo = file.group("data/demo_1").expect("there");
    for (key, width) in [("states", 32), ("actions", 7)] {
        let values = numbers(&demo, key);
        demo.unlink(key).expect("there");
        let data = demo.new_dataset::<f64>().shape([steps, width]).create(key).expect("created");
        data.write_raw(&values[..steps * width]).expect("written");
    }
    demo.delete_attr("num_samples").expect("there");
    file.close().expect("closes");
    path
}

#[test]
fn observations_are_those_of_robomimics_own_extraction() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (made, set) = (folder.path().join("low_dim.hdf5"), folder.path().join("set"));
    succeeds(&mut data(["extract", text(&fixture("lift_raw_3_demos.hdf5")), text(&made), "--workers", "1"]));
    let (ours, theirs) = (
        hdf5::File::open(&made).expect("ours opens"),
        hdf5::File::open(fixture("lift_low_dim_3_demos.hdf5")).expect("theirs opens"),
    );
    for id in ["demo_1", "demo_2", "demo_3"] {
        let group = |file: &hdf5::File| file.group(&format!("data/{id}")).expect("the demo is there");
        let (a, b) = (group(&ours), group(&theirs));
        let members = |demo: &hdf5::Group, name: &str| {
            let mut names = demo.group(name).expect("there").member_names().expect("listed");
            names.sort();
            names
        };
        for name in ["obs", "next_obs", "action_dict"] {
            assert_eq!(members(&a, name), members(&b, name), "{id} {name}");
        }
        let parts = members(&b, "action_dict").into_iter().map(|name| format!("action_dict/{name}"));
        for key in ["states", "actions", "rewards", "dones"].map(str::to_owned).into_iter().chain(parts) {
            assert_eq!(numbers(&a, &key), numbers(&b, &key), "{id} {key}");
        }
        for key in members(&b, "obs") {
            for folder in ["obs", "next_obs"] {
                let key = format!("{folder}/{key}");
                let (x, y) = (numbers(&a, &key), numbers(&b, &key));
                assert_eq!(x.len(), y.len(), "{id} {key}");
                let kind = |demo: &hdf5::Group| demo.dataset(&key).expect("there").dtype().expect("typed").size();
                assert_eq!(kind(&a), kind(&b), "{id} {key}");
                // the same simulator on the same states; another processor may round the last digits otherwise
                let far = x.iter().zip(&y).map(|(x, y)| (x - y).abs()).fold(0.0, f64::max);
                assert!(far < 1e-6, "{id} {key}: {far}");
            }
        }
    }
    assert_eq!(ours.dataset("mask/train").expect("masks are kept").shape(), [3]);
    succeeds(&mut data(["convert", text(&made), text(&set)]));
    succeeds(&mut data(["validate", text(&set), "--source", text(&made)]));
}

#[test]
fn cameras_give_pictures_that_convert() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let raw = short(folder.path(), 4);
    let (made, set) = (folder.path().join("image.hdf5"), folder.path().join("set"));
    let cameras = ["--cameras", "agentview,robot0_eye_in_hand", "--size", "84", "--workers", "1"];
    succeeds(data(["extract", text(&raw), text(&made)]).args(cameras));
    let file = hdf5::File::open(&made).expect("opens");
    for camera in ["agentview_image", "robot0_eye_in_hand_image"] {
        let pictures = file.dataset(&format!("data/demo_1/obs/{camera}")).expect("pictures are there");
        assert_eq!(pictures.shape(), [4, 84, 84, 3]);
        let levels = pictures.read_raw::<u8>().expect("8-bit");
        let spread = levels.iter().max().expect("pixels") - levels.iter().min().expect("pixels");
        assert!(spread > 100, "{camera}: a scene has light and shade, found a spread of {spread}");
    }
    succeeds(&mut data(["convert", text(&made), text(&set)]));
    let shown = succeeds(&mut data(["inspect", text(&set)]));
    assert!(String::from_utf8_lossy(&shown.stdout).contains("observation.images.robot0_eye_in_hand"));
    // what does not fit is named, and leaves nothing
    let nowhere = folder.path().join("nowhere.hdf5");
    refused(data(["extract", text(&raw), text(&nowhere)]).args(["--cameras", "sideview9"]), &["sideview9"]);
    refused(&mut data(["extract", text(&made), text(&made)]), &["image.hdf5", "exists"]);
    assert_eq!(listing(folder.path()), ["demo.hdf5", "image.hdf5", "set"]);
}

#[test]
fn what_was_recorded_stays_as_it_was_recorded() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (raw, made) = (short(folder.path(), 2), folder.path().join("made.hdf5"));
    let recorded = [
        ("data", "seeds", "1000000-1000004"),
        ("data", "skill", "mixed"),
        ("data/demo_1", "ep_meta", "{\"group\":\"left\"}"),
    ];
    let file = hdf5::File::open_rw(&raw).expect("opens");
    for (place, name, value) in recorded {
        let value: hdf5::types::VarLenUnicode = value.parse().expect("text");
        let group = file.group(place).expect("there");
        let attr = group.new_attr::<hdf5::types::VarLenUnicode>().create(name).expect("created");
        attr.write_scalar(&value).expect("written");
    }
    file.close().expect("closes");
    succeeds(&mut data(["extract", text(&raw), text(&made), "--workers", "1"]));
    let file = hdf5::File::open(&made).expect("opens");
    for (place, name, value) in recorded {
        let attr = file.group(place).expect("there").attr(name).expect("it is kept");
        let kept = attr.read_scalar::<hdf5::types::VarLenUnicode>().expect("text");
        assert_eq!(kept.as_str(), value, "{place}: {name}");
    }
    // counted anew: the recording says how many steps its three demos had
    let total = file.group("data").expect("there").attr("total").expect("there");
    assert_eq!(total.read_scalar::<i64>().expect("a number"), 2);
}

#[test]
fn what_is_wiped_stays_wiped_in_a_replay() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (file, film) = (folder.path().join("wipe.hdf5"), folder.path().join("wipe.mp4"));
    succeeds(&mut data(["collect", "--task", "Wipe", "--episodes", "1", "--workers", "1", "--out", text(&file)]));
    let replay = ["replay", text(&file), "--demo", "0", "--video", text(&film), "--size", "64", "--workers", "1"];
    let said = succeeds(&mut data(replay)).stdout;
    let said = String::from_utf8_lossy(&said);
    assert!(said.contains("images at 20 Hz, success"), "{said}");
}

#[test]
fn a_model_that_does_not_load_is_one_line_with_file_and_demo() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (raw, out) = (short(folder.path(), 2), folder.path().join("out.hdf5"));
    let file = hdf5::File::open_rw(&raw).expect("opens");
    let demo = file.group("data/demo_1").expect("there");
    let model = demo.attr("model_file").expect("there");
    let xml = model.read_scalar::<hdf5::types::VarLenUnicode>().expect("text");
    demo.delete_attr("model_file").expect("there");
    // as of a version that knows other elements; nothing in the file says which one recorded it
    let old: hdf5::types::VarLenUnicode =
        xml.as_str().replacen("<worldbody>", "<worldbody><elsewhere/>", 1).parse().expect("text");
    let attr = demo.new_attr::<hdf5::types::VarLenUnicode>().create("model_file").expect("created");
    attr.write_scalar(&old).expect("written");
    drop((model, attr, demo));
    file.close().expect("closes");
    let film = folder.path().join("film.mp4");
    let replay = ["replay", text(&raw), "--demo", "1", "--video", text(&film)];
    for mut command in [data(["extract", text(&raw), text(&out), "--workers", "1"]), data(replay)] {
        let said = refused(&mut command, &["demo.hdf5: demo_1: robosuite 1.5", "model_file does not load", "--python"]);
        assert!(said.trim_end().lines().count() == 1 && said.len() < 700, "{} bytes: {said}", said.len());
    }
    assert_eq!(listing(folder.path()), ["demo.hdf5"]);
}
