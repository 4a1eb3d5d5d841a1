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

#[test]
fn odd_instructions_and_numbers_are_said() {
    let dir = tempfile::tempdir().unwrap();
    let tensor = |dtype: &str| json!({"tensor": {"shape": {}, "dtype": dtype}});
    let steps = json!({"action": tensor("float32"), "count": tensor("uint8"), "language_instruction": {"text": {}}});
    let dict = |features: Value| json!({"featuresDict": {"features": features}});
    let features = dict(json!({"steps": {"sequence": {"feature": dict(steps)}}}));
    let info = json!({"name": "toy", "splits": [{"name": "train", "shardLengths": ["2"]}]});
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
    std::fs::create_dir(&version).unwrap();
    std::fs::write(version.join("features.json"), features.to_string()).unwrap();
    std::fs::write(version.join("dataset_info.json"), info.to_string()).unwrap();
    let records = [episode(["", ""], 2), episode(["open", "close"], 1)].concat();
    std::fs::write(version.join("toy-train.tfrecord-00000-of-00001"), records).unwrap();
    let source = Source::open(&version).unwrap();
    let tasks: Vec<_> = source.plan().demos.iter().map(|demo| demo.task.as_deref().unwrap()).collect();
    assert_eq!(tasks, ["toy", "open"], "the name of the data set where there is no instruction");
    let expected = "steps have different instructions, of which the first becomes the task: demo_1";
    assert_eq!(source.plan().notes, [expected]);
    assert_eq!(source.read_demo(1).unwrap().datasets["count"].bytes, [172, 7]);
    let text = source.read_demo(0).unwrap_err().to_string();
    assert!(text.ends_with("steps/count of demo_0: the number 300 where uint8 is stated"), "{text}");
}
