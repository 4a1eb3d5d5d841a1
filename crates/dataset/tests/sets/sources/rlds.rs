//! RLDS as tensorflow-datasets writes it.

use super::{fixture, quiet};
use crate::common::copy;
use dataset::{ConvertOptions, Dataset, Dtype, Source, convert};

#[test]
fn every_list_is_what_tensorflow_datasets_reads() {
    let source = Source::open(&fixture("rlds")).unwrap();
    let plan = source.plan();
    assert_eq!(plan.problems, []);
    assert_eq!(plan.demos.iter().map(|d| d.length).collect::<Vec<_>>(), [4, 6, 5, 7]);
    let tasks: Vec<_> = plan.demos.iter().map(|d| d.task.as_deref().unwrap()).collect();
    assert_eq!(tasks, ["pick up the cup", "pick up the cup", "wipe the table", "wipe the table"]);
    assert_eq!((plan.masks["train"].len(), &plan.masks["val"][..]), (3, &["demo_3".to_owned()][..]));
    // the first step's state and gripper of each episode
    let first = [
        ([0.125_730_22, -0.132_104_86, 0.640_422_64, 0.104_900_11, -0.535_669_4_f32], 0.912_755_55),
        ([0.189_053_39, -0.522_748_5, -0.413_063_56, -2.441_467_3, 1.799_707_4], 0.728_560_51),
        ([0.345_584_18, 0.821_618_14, 0.330_437_06, -1.303_157_2, 0.905_355_9], 0.423_326_46),
        ([2.040_919, -2.555_665, 0.418_098_84, -0.567_769_7, -0.452_649_3], 0.433_126_93),
    ];
    let files = [4, 6, 5, 7];
    for (index, (state, gripper)) in first.into_iter().enumerate() {
        let demo = source.read_demo(index).unwrap();
        let read = demo.datasets["obs/state"].to_f32().unwrap();
        // printed to eight digits
        assert!(read.iter().zip(state).all(|(read, state)| (read - state).abs() < 1e-6), "{read:?}");
        assert_eq!(demo.datasets["obs/gripper"].dtype, Dtype::F64);
        assert!((demo.datasets["obs/gripper"].to_f64().unwrap()[0] - gripper).abs() < 1e-8);
        let ends = demo.datasets["dones"].to_f64().unwrap();
        assert_eq!((ends.iter().sum::<f64>(), ends[files[index] - 1]), (1.0, 1.0));
        // the red, green and blue of the wrist's last row, which is the first row of the other camera's
        let wrist = &demo.datasets["obs/wrist_image"];
        let number: usize = [0, 2, 1, 3][index];
        assert_eq!(wrist.shape, [files[index], 16, 12, 3]);
        assert_eq!(
            wrist.bytes[15 * 36..15 * 36 + 6],
            [0, 20 * number as u8, 20 * number as u8, 9, 20 * number as u8, 20 * number as u8]
        );
        assert!(demo.datasets["obs/images/image"].bytes.starts_with(&[0xff, 0xd8]));
        assert_eq!(demo.attrs["file_path"].to_text(), Some(format!("/data/ep{number}.h5")));
        assert_eq!(demo.attrs["seed"].to_i64(), Some(number as i64));
    }
}

#[test]
fn it_converts_without_options_and_keeps_jpeg_files() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("set");
    let report = convert(&fixture("rlds"), &out, &ConvertOptions::default(), &mut quiet).unwrap();
    assert_eq!((report.dialect, report.episodes, report.frames), ("RLDS", 4, 22));
    let set = Dataset::open(&out).unwrap();
    assert_eq!(set.split("val").unwrap(), [3]);
    assert_eq!(set.column("observation.state").unwrap().dim, 6);
    assert_eq!(set.info().features.get("observation.images.image").unwrap().shape, [16, 12, 3]);
    assert_eq!(set.info().features.get("observation.images.depth").unwrap().shape, [4, 3, 1]);
    assert_eq!(set.tasks(), ["pick up the cup", "wipe the table"]);
}

#[test]
fn damage_is_named_by_file_and_record() {
    let dir = tempfile::tempdir().unwrap();
    let set = dir.path().join("set");
    copy(&fixture("rlds"), &set);
    let shard = set.join("toy-train.tfrecord-00000-of-00001");
    let whole = std::fs::read(&shard).unwrap();
    let refused = |bytes: &[u8], options: &ConvertOptions| {
        std::fs::write(&shard, bytes).unwrap();
        convert(&set, &dir.path().join("out"), options, &mut quiet).map_err(|e| e.to_string())
    };
    let text = refused(&whole[..whole.len() - 40], &ConvertOptions::default()).unwrap_err();
    assert!(text.contains("toy-train.tfrecord-00000-of-00001") && text.contains("record 2: it is cut off"), "{text}");
    let mut flipped = whole.clone();
    flipped[100] ^= 1;
    let text = refused(&flipped, &ConvertOptions::default()).unwrap_err();
    assert!(text.contains("record 0") && text.contains("its checksum is wrong"), "{text}");
    let skipping = ConvertOptions { skip_bad: true, ..ConvertOptions::default() };
    let report = refused(&flipped, &skipping).unwrap();
    assert_eq!((report.episodes, report.skipped[0].demo.as_str()), (3, "demo_0"));
    std::fs::remove_file(&shard).unwrap();
    let text = Source::open(&set).unwrap_err().to_string();
    assert!(text.contains("toy-train.tfrecord-00000-of-00001: no such file"), "{text}");
}
