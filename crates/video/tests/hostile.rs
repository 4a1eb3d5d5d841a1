//! Files that are not what they should be: refused by name, or with what is wrong in them; never a panic.
//!
//! Damage inside AV1 samples is tested where such files are read in a process of their own (`dataset`).

#![allow(clippy::unwrap_used)]

use proptest::prelude::*;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use video::{Video, VideoError};

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name)
}

/// Real files, made by FFmpeg 7.1 (PyAV 15.1.0) of three frames each.
const REFUSED: [(&str, &str); 17] = [
    ("hevc", "HEVC (H.265) (hev1)"),
    ("hevc_10bit", "HEVC (H.265) (hev1)"),
    ("vp9", "VP8 or VP9 (vp09)"),
    ("mpeg4", "MPEG-4 part 2 (mp4v)"),
    ("av1_10bit", "AV1 with 10 bits"),
    ("av1_444", "AV1 with 4:4:4"),
    ("av1_grey", "AV1 without colour (4:0:0)"),
    ("av1_odd_height", "a video of odd height (64 x 49)"),
    ("h264_10bit", "H.264 with 10 bits"),
    ("h264_422", "H.264 with 4:2:2"),
    ("h264_444", "H.264 with 4:4:4"),
    ("h264_interlaced", "interlaced H.264"),
    ("h264_bt709", "colour matrix BT.709"),
    ("h264_full_range", "full-range colour"),
    ("fragmented", "a fragmented MP4 file"),
    ("two_tracks", "a file with 2 video tracks"),
    ("sound_only", "a file with 0 video tracks"),
];

#[test]
fn what_is_not_read_is_named() {
    for (name, what) in REFUSED {
        let path = fixture(&format!("refused/{name}.mp4"));
        let error = Video::open(&path).map(|v| v.info().clone()).unwrap_err();
        assert!(matches!(error, VideoError::Unsupported { .. }), "{name}: {error}");
        let text = error.to_string();
        assert!(text.starts_with(&format!("{}: {what}", path.display())), "{text}");
        assert!(text.ends_with("is not read; AV1 and H.264 with 8 bits and 4:2:0 are"), "{text}");
    }
}

#[test]
fn what_is_no_video_is_told_apart() {
    let text = Video::open(Path::new("nowhere/at/all.mp4")).unwrap_err().to_string();
    assert_eq!(text, "nowhere/at/all.mp4: cannot open it");
    let told = |bytes: &[u8]| Video::from_bytes("f", bytes.to_vec()).unwrap_err().to_string();
    assert_eq!(told(b""), "f: not an MP4 file: expected a box ftyp first, found an empty file");
    assert_eq!(told(b"abc"), "f: not an MP4 file: expected a box ftyp first, found [61, 62, 63]");
    assert!(told(&[0x89, b'P', b'N', b'G', 0, 0, 0, 0, 1]).contains("found [89, 50, 4e, 47"));
    let only = [&16_u32.to_be_bytes()[..], b"ftypisom", &[0; 4]].concat();
    assert!(told(&only).contains("box moov: expected one") && told(&only).contains("never finished"));
    let odd = [&only[..], &4_u32.to_be_bytes(), b"free"].concat();
    assert!(
        told(&odd).contains("damaged: box free: expected 8 bytes or more, found 4 bytes at byte 16"),
        "{}",
        told(&odd)
    );
    let many = [&only[..], &[&8_u32.to_be_bytes()[..], b"free"].concat().repeat(5000)].concat();
    assert_eq!(told(&many), "f: boxes: 4097 stated, at most 4096 can be read");
}

#[test]
fn pictures_that_are_to_be_turned_are_refused() {
    let original = std::fs::read(fixture("av1_agentview.mp4")).unwrap();
    let tkhd = original.windows(4).position(|kind| kind == b"tkhd").unwrap() + 4;
    assert_eq!(original[tkhd], 0);
    let with = |a: u32, b: u32, c: u32, d: u32| {
        let mut bytes = original.clone();
        for (i, number) in [(0, a), (1, b), (3, c), (4, d)] {
            bytes[tkhd + 40 + 4 * i..][..4].copy_from_slice(&number.to_be_bytes());
        }
        Video::from_bytes("f", bytes).map(|_| ())
    };
    let (one, minus) = (0x0001_0000, 0xffff_0000);
    assert!(with(one, 0, 0, one).is_ok() && with(0, 0, 0, 0).is_ok());
    for (a, b, c, d) in [(minus, 0, 0, minus), (0, one, minus, 0), (minus, 0, 0, one)] {
        let told = with(a, b, c, d).unwrap_err().to_string();
        assert!(
            told.starts_with("f: a video that is to be turned or mirrored (matrix of box tkhd) is not read"),
            "{told}"
        );
    }
}

#[test]
fn a_file_cut_short_anywhere_says_so() {
    for name in ["av1_agentview.mp4", "h264_agentview.mp4"] {
        let bytes = std::fs::read(fixture(name)).unwrap();
        for length in (0..bytes.len()).rev() {
            let error = Video::from_bytes(name, bytes[..length].to_vec()).map(|v| v.info().clone()).unwrap_err();
            let told = match &error {
                VideoError::Truncated { .. } => true,
                VideoError::NotMp4 { .. } => length < 8,
                // cut between two boxes
                VideoError::Malformed { object, .. } => object == "box moov" && length < 44,
                _ => false,
            };
            assert!(told, "{length} bytes: {error}");
        }
    }
}

#[test]
fn tables_that_state_too_much_are_refused_at_once() {
    let original = std::fs::read(fixture("av1_agentview.mp4")).unwrap();
    // av01 is also a brand of the whole file
    let find = |kind: &[u8]| original[..1024].windows(4).rposition(|w| w == kind).unwrap() + 4;
    let changed = |at: usize, value: u32| {
        let mut bytes = original.clone();
        bytes[at..at + 4].copy_from_slice(&value.to_be_bytes());
        let result = Video::from_bytes("f", bytes).map(|v| v.info().frames).map_err(|e| e.to_string());
        result.unwrap_err()
    };
    let (stsz, stts, stsc, stco) = (find(b"stsz"), find(b"stts"), find(b"stsc"), find(b"stco"));
    assert_eq!(changed(stsz + 8, u32::MAX), "f: frames: 4294967295 stated, at most 4194304 can be read");
    assert!(changed(stsz + 8, 37).contains("box stsz: expected all the entries that it counts"));
    assert!(changed(stsz + 8, 0).contains("one sample or more"));
    assert!(changed(stsz + 12, 200 << 20).contains("bytes of a sample: 209715200 stated"));
    assert!(changed(stsz + 12, 1 << 20).contains("truncated: sample 0 ends at byte"));
    // one size for all: no table has to be there
    assert!(changed(stsz + 4, 1 << 20).contains("truncated: the last of 36 samples"));
    assert!(changed(stts + 4, u32::MAX).contains("box stts"));
    assert!(changed(stts + 8, u32::MAX).contains("box stts: expected times of 36 samples, found times of 4294967295"));
    assert!(changed(stts + 12, 0).contains("a time of its own for each frame"));
    assert!(changed(stsc + 8, 2).contains("runs of chunks from 1 on"));
    assert!(changed(stsc + 12, 7).contains("expected places of 36 samples, found 7 in 1 chunks"));
    assert!(changed(stsc + 16, 2).contains("sample entry 2"));
    assert!(changed(stco + 8, u32::MAX - 5).contains("truncated: sample 0"));
    assert!(changed(find(b"stss") + 8, 2).contains("box stss: expected sample 1"));
    assert!(changed(find(b"stss") + 12, 37).contains("samples 1 to 36, found 37"));
    assert!(changed(find(b"mdhd") + 12, 0).contains("box mdhd: expected ticks in a second"));
    assert!(changed(find(b"elst") + 16, 0x2_0000).contains("changes the speed"));
    assert!(changed(find(b"elst") + 12, 1).contains("edit list that cuts frames away"));
    assert!(changed(find(b"elst") + 8, 1000).contains("edit list that cuts frames away"));
    // width and height of the sample entry
    assert!(changed(find(b"av01") + 24, 0x0054_0060).contains("expected 84 x 96 pixels"));
    assert!(changed(find(b"av01") + 24, 0xffff_fffe).contains("pixels of 65535 x 65534"));
    assert!(changed(find(b"av01") + 24, 0).contains("a size above 0"));
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 500, failure_persistence: None, ..ProptestConfig::default() })]
    #[test]
    fn damaged_tables_and_damaged_h264_never_panic(
        h264 in any::<bool>(), places in prop::collection::vec((0.0_f64..1.0, any::<u32>(), 0..3_u8, 1_usize..5), 1..6),
    ) {
        let name = if h264 { "h264_agentview.mp4" } else { "av1_agentview.mp4" };
        let mut bytes = std::fs::read(fixture(name)).unwrap();
        // of AV1 files everything but the samples, which stand at the end
        let end = if h264 { bytes.len() } else { bytes.windows(4).position(|w| w == b"mdat").unwrap() };
        for (at, value, kind, width) in places {
            let at = ((end as f64 * at) as usize).min(end - 4);
            match kind {
                0 => bytes[at] ^= 1 << (value % 8),
                1 => bytes[at..at + width.min(4)].copy_from_slice(&value.to_be_bytes()[..width.min(4)]),
                _ => bytes[at..at + width.min(4)].copy_from_slice(&[0xff; 4][..width.min(4)]),
            }
        }
        let start = Instant::now();
        if let Err(error) = read(&bytes, h264) {
            let text = error.to_string();
            prop_assert!(!text.contains('\n') && text.starts_with("f: "), "{}", text);
        }
        prop_assert!(start.elapsed() < Duration::from_secs(20));
    }
}

/// Opens a file; decodes it as well where that cannot take the process down.
fn read(bytes: &[u8], decode: bool) -> Result<(), VideoError> {
    let video = Video::from_bytes("f", bytes.to_vec())?;
    if decode {
        let mut rgb = vec![0; video.info().picture_bytes()];
        let mut frames = video.frames();
        while let Some(frame) = frames.next_into(&mut rgb) {
            frame?;
        }
    }
    Ok(())
}
