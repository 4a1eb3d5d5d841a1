//! Recordings that keep their pictures as JPEG files: ALOHA's newer ones.

#![allow(clippy::unwrap_used)]

use dataset::{ConvertOptions, Dataset, Source, VideoOptions, WriteOptions, convert, export, verify_source};
use hdf5::File;
use std::path::Path;

const CAMERA: &str = "observation.images.top";
const KEY: &str = "obs/images/top";

/// A file of the fixtures: Pillow wrote the JPEG files and what it reads of them as PNG.
fn fixture(name: &str) -> Vec<u8> {
    std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/jpeg").join(name)).unwrap()
}

/// Pixels of a PNG file.
fn pixels(file: &[u8]) -> Vec<u8> {
    let mut reader = png::Decoder::new(std::io::Cursor::new(file)).read_info().unwrap();
    let mut out = vec![0; reader.output_buffer_size().unwrap()];
    reader.next_frame(&mut out).unwrap();
    out
}

/// An episode whose rows are as long as its longest file and `more`, filled up with zeros.
fn episode(path: &Path, pictures: &[Vec<u8>], more: usize) {
    let file = File::create(path).unwrap();
    let steps = pictures.len();
    let longest = pictures.iter().map(Vec::len).max().unwrap() + more;
    let numbers = |at: &hdf5::Group, name: &str| {
        let values: Vec<f32> = (0..steps * 14).map(|i| i as f32 / 10.0).collect();
        let set = at.new_dataset::<f32>().shape([steps, 14]).create(name).unwrap();
        set.write_raw(&values).unwrap();
    };
    numbers(&file, "action");
    let observations = file.create_group("observations").unwrap();
    numbers(&observations, "qpos");
    let rows: Vec<u8> = pictures.iter().flat_map(|p| p.iter().copied().chain(vec![0; longest - p.len()])).collect();
    let images = observations.create_group("images").unwrap();
    images.new_dataset::<u8>().shape([steps, longest]).create("top").unwrap().write_raw(&rows).unwrap();
    let lengths: Vec<f32> = pictures.iter().map(|p| p.len() as f32).collect();
    file.new_dataset::<f32>().shape([1, steps]).create("compress_len").unwrap().write_raw(&lengths).unwrap();
    file.close().unwrap();
}

fn recording(folder: &Path) {
    let (a, b) = (fixture("0.jpg"), fixture("1.jpg"));
    std::fs::create_dir(folder).unwrap();
    episode(&folder.join("episode_0.hdf5"), &[a.clone(), b.clone(), a.clone()], 0);
    episode(&folder.join("episode_1.hdf5"), &[a.clone(), a], 9);
}

fn options() -> ConvertOptions {
    ConvertOptions { fps: Some(50.0), ..ConvertOptions::default() }
}

fn quiet(_: u64, _: u64) {}

#[test]
fn jpeg_files_become_a_camera_and_come_back_as_they_were() {
    let dir = tempfile::tempdir().unwrap();
    let (source, out, back) = (dir.path().join("aloha"), dir.path().join("set"), dir.path().join("back"));
    recording(&source);
    let report = convert(&source, &out, &options(), &mut quiet).unwrap();
    assert_eq!((report.episodes, report.frames), (2, 5));
    assert!(report.notes.iter().all(|note| !note.contains("becomes no column")), "{:?}", report.notes);
    let set = Dataset::open(&out).unwrap();
    assert_eq!(set.cameras().collect::<Vec<_>>(), [CAMERA]);
    let seen = set.pictures(CAMERA).unwrap();
    assert_eq!((seen.height, seen.width), (18, 26));
    let expected = ["0.png", "1.png", "0.png", "0.png", "0.png"].map(|name| pixels(&fixture(name)));
    let (mut most, mut sum) = (0, 0);
    for (frame, expected) in expected.iter().enumerate() {
        assert_eq!(seen.frame(frame).len(), expected.len());
        for (a, b) in seen.frame(frame).iter().zip(expected) {
            most = most.max(a.abs_diff(*b));
            sum += u32::from(a.abs_diff(*b));
        }
    }
    // two decoders differ most where colours are stored at half the resolution
    let mean = f64::from(sum) / expected.concat().len() as f64;
    assert!(most <= 8 && mean < 1.0, "{most} levels from Pillow, {mean} on average");
    assert_eq!(seen.frame(0), seen.frame(4));
    verify_source(&out, &source).unwrap();
    export(&out, &back, &WriteOptions::default(), &mut quiet).unwrap();
    let (first, again) = (Source::open(&source).unwrap(), Source::open(&back).unwrap());
    for demo in 0..2 {
        assert_eq!(first.read_demo(demo).unwrap().datasets[KEY], again.read_demo(demo).unwrap().datasets[KEY]);
    }
}

#[test]
fn they_can_be_films_too() {
    let dir = tempfile::tempdir().unwrap();
    let (source, out) = (dir.path().join("aloha"), dir.path().join("set"));
    recording(&source);
    let video = Some(VideoOptions::default());
    convert(&source, &out, &ConvertOptions { video, ..options() }, &mut quiet).unwrap();
    let seen = Dataset::open(&out).unwrap().pictures(CAMERA).unwrap();
    let expected = pixels(&fixture("1.png"));
    let off: f64 = seen.frame(1).iter().zip(&expected).map(|(a, b)| f64::from(a.abs_diff(*b))).sum();
    assert!(off / (expected.len() as f64) < 20.0, "{off}");
}

#[test]
fn a_file_that_is_broken_or_of_another_size_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let good = fixture("0.jpg");
    let error = |name: &str, second: Vec<u8>| {
        let (source, out) = (dir.path().join(name), dir.path().join(format!("{name}-set")));
        std::fs::create_dir(&source).unwrap();
        episode(&source.join("episode_0.hdf5"), &[good.clone(), second], 0);
        let error = convert(&source, &out, &options(), &mut quiet).unwrap_err().to_string();
        assert!(error.contains("demo_0 obs/images/top frame 1"), "{error}");
        assert!(error.contains("expected a JPEG file of 18 x 26"), "{error}");
        assert!(!out.exists());
        error
    };
    assert!(error("cut", good[..good.len() / 2].to_vec()).contains("broken JPEG"));
    assert!(error("other", b"no picture".to_vec()).contains("other bytes"));
    let mut wide = good.clone();
    // width in the start of frame, behind its marker, length, precision and height
    let frame = wide.windows(2).position(|pair| pair == [0xFF, 0xC0]).unwrap();
    wide[frame + 8] += 1;
    assert!(error("wide", wide).contains("18 x 27"));
}

#[test]
fn rows_of_other_bytes_stay_what_they_are() {
    let dir = tempfile::tempdir().unwrap();
    let (source, out) = (dir.path().join("aloha"), dir.path().join("set"));
    std::fs::create_dir(&source).unwrap();
    episode(&source.join("episode_0.hdf5"), &[vec![7; 30], vec![8; 30]], 0);
    let report = convert(&source, &out, &options(), &mut quiet).unwrap();
    assert!(report.notes.iter().any(|note| note.contains("obs/images/top (encoded images")), "{:?}", report.notes);
    assert_eq!(Dataset::open(&out).unwrap().cameras().count(), 0);
}
