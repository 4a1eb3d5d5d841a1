#![allow(clippy::unwrap_used)]
//! Records that `tensorflow-datasets` would hardly write; what it writes is in `tests/sets/sources/rlds.rs`.

use serde_json::json;

use super::*;
use crate::source::Source;

/// A field of a message, of less than 16 KiB.
fn field(number: u8, content: &[u8]) -> Vec<u8> {
    [&[number << 3 | 2, content.len() as u8 | 128, (content.len() >> 7) as u8], content].concat()
}

/// A record of these lists: kind and content.
fn record(lists: &[(&str, u8, Vec<u8>)]) -> Vec<u8> {
    let entry = |(name, kind, content): &(&str, u8, Vec<u8>)| {
        field(1, &[field(1, name.as_bytes()), field(2, &field(*kind, content))].concat())
    };
    let content = field(1, &lists.iter().flat_map(entry).collect::<Vec<u8>>());
    let length = (content.len() as u64).to_le_bytes();
    [&length[..], &masked_crc(&length).to_le_bytes(), &content, &masked_crc(&content).to_le_bytes()].concat()
}

fn tensor(dtype: &str) -> Value {
    json!({"tensor": {"shape": {}, "dtype": dtype}})
}

fn dict(features: Value) -> Value {
    json!({"featuresDict": {"features": features}})
}

/// A data set of these features and records.
fn written(folder: &Path, features: &Value, records: &[Vec<u8>]) {
    let info = json!({"name": "toy", "splits": [{"name": "train", "shardLengths": [records.len().to_string()]}]});
    std::fs::create_dir(folder).unwrap();
    std::fs::write(folder.join("features.json"), features.to_string()).unwrap();
    std::fs::write(folder.join("dataset_info.json"), info.to_string()).unwrap();
    std::fs::write(folder.join("toy-train.tfrecord-00000-of-00001"), records.concat()).unwrap();
}

#[test]
fn what_has_no_place_is_named_and_empty_lists_are_an_empty_demo() {
    let dir = tempfile::tempdir().unwrap();
    let image = json!({"image": {"shape": {"dimensions": ["8", "8", "3"]}, "dtype": "uint8"}});
    let steps = json!({"action": tensor("float32"), "blob": tensor("string"), "camera": image});
    let metadata = json!({"text": {"text": {}}, "count": tensor("int64"), "video": {"video": {}}, "cover": image});
    let features = dict(json!({"steps": {"sequence": {"feature": dict(steps)}}, "episode_metadata": dict(metadata)}));
    let bytes = field(1, b"\xff");
    let whole = record(&[
        ("steps/action", 2, field(1, &[0; 8])),
        ("steps/blob", 1, bytes.repeat(2)),
        ("episode_metadata/text", 1, bytes.clone()),
        ("episode_metadata/count", 3, field(1, &[1, 2])),
    ]);
    let empty = record(&[("steps/action", 2, Vec::new()), ("steps/camera", 1, Vec::new())]);
    // an empty list may lack its kind
    let bare = {
        let entry = field(1, &[field(1, b"steps/action"), field(2, b"")].concat());
        let content = field(1, &entry);
        let length = (content.len() as u64).to_le_bytes();
        [&length[..], &masked_crc(&length).to_le_bytes(), &content, &masked_crc(&content).to_le_bytes()].concat()
    };
    let set = dir.path().join("1.0.0");
    written(&set, &features, &[whole, empty, bare]);
    let source = Source::open(&set).unwrap();
    let plan = source.plan();
    let expected = [
        "episode_metadata/count is left out: another number of elements than stated in demo_0",
        "episode_metadata/cover is left out: images of an episode have no place",
        "episode_metadata/text is left out: bytes that are no UTF-8 text in demo_0",
        "episode_metadata/video is left out: a feature without a class is not supported",
        "steps/blob is left out: bytes that are no UTF-8 text in demo_0",
    ];
    assert_eq!(plan.notes, expected);
    let problems: Vec<_> = plan.problems.iter().map(|p| (p.demo.as_deref().unwrap(), p.error.to_string())).collect();
    assert_eq!(problems.len(), 2, "{problems:?}");
    assert!(problems.iter().all(|(_, text)| !text.contains("damaged") && text.contains("steps")), "{problems:?}");
}

#[test]
fn odd_instructions_and_numbers_are_said() {
    let dir = tempfile::tempdir().unwrap();
    let steps = json!({"action": tensor("float32"), "count": tensor("uint8"), "language_instruction": {"text": {}}});
    let features = dict(json!({"steps": {"sequence": {"feature": dict(steps)}}}));
    let episode = |words: [&str; 2], count: u8| {
        let floats: Vec<u8> = [0.5_f32, 1.5].iter().flat_map(|v| v.to_le_bytes()).collect();
        record(&[
            ("steps/action", 2, field(1, &floats)),
            // 300 takes two bytes
            ("steps/count", 3, field(1, &[172, count, 7])),
            ("steps/language_instruction", 1, words.iter().flat_map(|word| field(1, word.as_bytes())).collect()),
        ])
    };
    let version = dir.path().join("1.0.0");
    written(&version, &features, &[episode(["", ""], 2), episode(["open", "close"], 1)]);
    let source = Source::open(&version).unwrap();
    let tasks: Vec<_> = source.plan().demos.iter().map(|demo| demo.task.as_deref().unwrap()).collect();
    assert_eq!(tasks, ["toy", "open"], "the name of the data set where there is no instruction");
    let expected = "steps have different instructions, of which the first becomes the task: demo_1";
    assert_eq!(source.plan().notes, [expected]);
    assert_eq!(source.read_demo(1).unwrap().datasets["count"].bytes, [172, 7]);
    let text = source.read_demo(0).unwrap_err().to_string();
    assert!(text.ends_with("steps/count of demo_0: the number 300 where uint8 is stated"), "{text}");
}

#[test]
fn features_of_one_name_here_are_not_confused() {
    let dir = tempfile::tempdir().unwrap();
    let steps = json!({"action": tensor("float32"), "actions": tensor("float32")});
    let features = dict(json!({"steps": {"sequence": {"feature": dict(steps)}}}));
    let (first, second) = (field(1, &[0; 8]), field(1, &[1; 8]));
    let set = dir.path().join("1.0.0");
    written(&set, &features, &[record(&[("steps/action", 2, first), ("steps/actions", 2, second)])]);
    let source = Source::open(&set).unwrap();
    assert_eq!(source.plan().notes, ["steps/actions is left out: steps/action becomes actions too"]);
    assert_eq!(source.read_rows(0, "actions", 0, 2).unwrap().bytes, [0; 8]);
}
