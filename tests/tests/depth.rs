//! A data set with depth that LeRobot recorded, through the programs.

use e2e::{data, refused, root, succeeds, text, zoo};
use std::fs;

#[test]
fn depth_is_shown_drawn_cut_and_is_no_camera() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let at = |name: &str| folder.path().join(name);
    let set = root().join("crates/dataset/tests/fixtures/depth/lerobot");
    let said = |output: std::process::Output| String::from_utf8_lossy(&output.stdout).into_owned();
    succeeds(&mut data(["validate", text(&set)]));
    let shown = said(succeeds(&mut data(["inspect", text(&set)])));
    for line in [
        ["observation.images.front_depth", "image, depth in m ", "10 x 14 x 1", "9.96"],
        ["observation.images.wrist_depth", "image, depth in mm", "10 x 14 x 1", "4980"],
    ] {
        let found = shown.lines().find(|l| l.contains(line[0])).unwrap_or_default();
        assert!(line.iter().all(|word| found.contains(word)), "{found} in {shown}");
    }
    let told: serde_json::Value =
        serde_json::from_str(&said(succeeds(&mut data(["inspect", text(&set), "--json"])))).expect("JSON");
    let units: Vec<_> =
        told["keys"].as_array().expect("a list").iter().filter_map(|key| key["depth"].as_str()).collect();
    assert_eq!(units, ["m", "mm"]);
    // a row of pictures a camera, of colours and of depth
    succeeds(&mut data(["plot", text(&set), "--frames", "3", "--out", text(&at("all.png"))]));
    let depth = "observation.images.front_depth";
    succeeds(&mut data(["plot", text(&set), "--frames", "3", "--column", depth, "--out", text(&at("one.png"))]));
    let rows = |name: &str| {
        let file = fs::read(at(name)).expect("a picture");
        u32::from_be_bytes(file[20..24].try_into().expect("the height of a PNG file"))
    };
    assert_eq!((rows("all.png"), rows("one.png")), (3 * 10 + 2 * 4, 10));
    succeeds(&mut data(["view", text(&set), "--frames", "2", "--out", text(&at("page.html"))]));
    let page = fs::read_to_string(at("page.html")).expect("a page");
    assert!(page.contains("wrist_depth") && page.contains("No problems found."));
    succeeds(&mut data(["edit", "drop", text(&set), text(&at("cut")), "--episodes", "1"]));
    succeeds(&mut data(["validate", text(&at("cut"))]));
    // a policy that sees is not shown distances
    let mut train = zoo(["train", "act_lift_image", "--data", text(&set), "--runs", text(&at("runs"))]);
    train.args(["data.cameras=[\"front_depth\"]", "data.state_keys=[\"any\"]", "data.env_keys=[]", "train.steps=1"]);
    train.args(["--zoo", text(&at("zoo"))]);
    refused(&mut train, &["front_depth", "depth of that name, which has no colours"]);
}
