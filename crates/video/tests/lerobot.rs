//! Files that LeRobot wrote, against the pixels that LeRobot reads.

#![allow(clippy::unwrap_used)]

use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};
use video::{Codec, Muxer, Rate, Video, VideoError};

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name)
}

fn hashes(name: &str) -> Vec<String> {
    std::fs::read_to_string(fixture(&format!("{name}.sha256"))).unwrap().lines().map(str::to_owned).collect()
}

fn hash(rgb: &[u8]) -> String {
    Sha256::digest(rgb).iter().map(|b| format!("{b:02x}")).collect()
}

const FILES: [(&str, Codec); 4] = [
    ("av1_agentview", Codec::Av1),
    ("av1_robot0_eye_in_hand", Codec::Av1),
    ("h264_agentview", Codec::H264),
    ("h264_robot0_eye_in_hand", Codec::H264),
];

#[test]
fn every_pixel_is_lerobots() {
    for (name, codec) in FILES {
        let video = Video::open(&fixture(&format!("{name}.mp4"))).unwrap();
        let info = video.info();
        assert_eq!((info.width, info.height, info.frames, info.codec), (84, 84, 36, codec));
        assert!((info.fps - 20.0).abs() < 1e-12, "{name}: {}", info.fps);
        for (i, t) in info.timestamps.iter().enumerate() {
            assert!((t - i as f64 / 20.0).abs() < 1e-12, "{name}: frame {i} at {t}");
        }
        let frames: Vec<_> = video.frames().map(|f| f.unwrap()).collect();
        assert_eq!(frames.iter().map(|f| f.index).collect::<Vec<_>>(), (0..36).collect::<Vec<_>>());
        assert_eq!(frames.iter().map(|f| hash(&f.rgb)).collect::<Vec<_>>(), hashes(name), "{name}");
    }
}

#[test]
fn any_frame_is_found_by_its_time_and_by_its_number() {
    for (name, _) in FILES {
        let bytes = std::fs::read(fixture(&format!("{name}.mp4"))).unwrap();
        let (video, expected) = (Video::from_bytes(name, bytes).unwrap(), hashes(name));
        for i in (0..36).rev() {
            let frame = video.frame_at(i as f64 / 20.0 + 0.9e-4).unwrap();
            assert_eq!((frame.index, &hash(&frame.rgb)), (i, &expected[i]), "{name}");
            let few: Vec<_> = video.range(i..36.min(i + 5)).unwrap().map(|f| hash(&f.unwrap().rgb)).collect();
            assert_eq!(few, expected[i..36.min(i + 5)], "{name} from {i}");
        }
        for seconds in [0.0011, -0.05, 1.8, f64::NAN, f64::INFINITY] {
            let text = video.frame_at(seconds).map(|f| f.index).unwrap_err().to_string();
            assert!(text.starts_with(&format!("{name}: no frame at {seconds}")), "{text}");
            assert!(text.ends_with("there is 36 frames from 0 to 1.75 s"), "{text}");
        }
        assert!(matches!(video.range(30..37).map(|_| ()), Err(VideoError::NoSuchFrame { .. })));
        assert_eq!(video.range(36..36).unwrap().count(), 0);
        assert!(video.frames().next_into(&mut [0; 7]).unwrap().is_err());
    }
}

#[test]
fn a_frame_before_the_key_frame_of_an_open_group_needs_the_group_before() {
    let (name, expected) = ("h264_open_group", hashes("h264_open_group"));
    let video = Video::open(&fixture("h264_open_group.mp4")).unwrap();
    assert_eq!(expected.len(), video.info().frames);
    let all: Vec<String> = video.frames().map(|frame| hash(&frame.unwrap().rgb)).collect();
    assert_eq!(all, expected);
    for (i, wanted) in expected.iter().enumerate() {
        let one = video.range(i..i + 1).unwrap().next().unwrap().unwrap();
        assert_eq!(&hash(&one.rgb), wanted, "{name}: frame {i} asked for alone");
    }
}

#[test]
fn delays_below_zero_are_read_whatever_the_version_of_their_table() {
    let mut bytes = std::fs::read(fixture("h264_open_group.mp4")).unwrap();
    let expected = Video::from_bytes("f", bytes.clone()).unwrap().info().timestamps.clone();
    let find = |kind: &[u8]| bytes.windows(4).position(|w| w == kind).unwrap() + 4;
    let (ctts, elst) = (find(b"ctts"), find(b"elst"));
    let entries = u32::from_be_bytes(bytes[ctts + 4..ctts + 8].try_into().unwrap()) as usize;
    // all of them by two frames, and the edit list with them: the same times
    for at in (0..entries).map(|entry| ctts + 12 + 8 * entry).chain([elst + 12]) {
        let ticks = i32::from_be_bytes(bytes[at..at + 4].try_into().unwrap()) - 1024;
        bytes[at..at + 4].copy_from_slice(&ticks.to_be_bytes());
    }
    assert_eq!(bytes[ctts], 0);
    assert_eq!(Video::from_bytes("f", bytes).unwrap().info().timestamps, expected);
}

#[test]
fn samples_of_whole_stretches_make_another_file_of_the_same_pictures() {
    let video = Video::open(&fixture("av1_agentview.mp4")).unwrap();
    let keys: Vec<usize> = (0..36).filter(|&i| video.samples(i..i + 1).is_ok()).collect();
    assert!(keys.len() > 2 && keys.len() < 36, "{keys:?}");
    let (from, to) = (keys[1], keys[keys.len() - 1]);
    let samples = video.samples(from..to).unwrap();
    let mut muxer = Muxer::new(84, 84, Rate::of(20.0).unwrap());
    samples.iter().try_for_each(|sample| muxer.push(sample)).unwrap();
    let bytes = samples.iter().fold(muxer.header(), |file, sample| [file, sample.bytes.clone()].concat());
    let cut = Video::from_bytes("cut", bytes).unwrap();
    let found: Vec<String> = cut.frames().map(|frame| hash(&frame.unwrap().rgb)).collect();
    assert_eq!(found, hashes("av1_agentview")[from..to]);
    let refused = |video: &Video, range| video.samples(range).unwrap_err().to_string();
    let other = (0..36).find(|i| !keys.contains(i)).unwrap();
    assert!(refused(&video, other..36).ends_with("the first is no key frame"), "{}", refused(&video, other..36));
    assert!(refused(&video, 30..37).contains("no frames 30 to 37"));
    let h264 = Video::open(&fixture("h264_agentview.mp4")).unwrap();
    assert!(refused(&h264, 0..36).contains("frames 0 to 35 cannot be cut out as they are: expected av1, found h264"));
}
