//! What is written is read back: times, sizes, pictures close to what was given, the same bytes every time.

#![allow(clippy::unwrap_used)]

use proptest::prelude::*;
use video::{Codec, EncodeOptions, Encoder, Muxer, Rate, Sample, TOLERANCE, Video};

/// Smooth pictures that move, as a camera's do.
fn picture(width: usize, height: usize, frame: usize, seed: u64) -> Vec<u8> {
    let (a, b) = ((seed % 7 + 2) as f64, (seed % 5 + 3) as f64);
    let mut rgb = Vec::with_capacity(width * height * 3);
    for y in 0..height {
        for x in 0..width {
            let (x, y, t) = (x as f64 / width as f64, y as f64 / height as f64, frame as f64 * 0.1);
            let value = |phase: f64| (127.5 + 80.0 * (a * x + t + phase).sin() * (b * y - t * 0.5).cos()) as u8;
            rgb.extend([value(0.0), value(0.7), value(1.4)]);
        }
    }
    rgb
}

fn encode(width: usize, height: usize, rate: Rate, pictures: &[Vec<u8>], options: &EncodeOptions) -> Vec<Sample> {
    let mut encoder = Encoder::new(width, height, rate, options).unwrap();
    for rgb in pictures {
        encoder.push(rgb).unwrap();
    }
    encoder.finish().unwrap()
}

fn file(width: usize, height: usize, rate: Rate, episodes: &[Vec<Sample>]) -> Vec<u8> {
    let mut muxer = Muxer::new(width as u16, height as u16, rate);
    for sample in episodes.iter().flatten() {
        muxer.push(sample).unwrap();
    }
    let mut bytes = muxer.header();
    episodes.iter().flatten().for_each(|sample| bytes.extend_from_slice(&sample.bytes));
    bytes
}

fn psnr(a: &[u8], b: &[u8]) -> f64 {
    let error: f64 =
        a.iter().zip(b).map(|(&a, &b)| (f64::from(a) - f64::from(b)).powi(2)).sum::<f64>() / a.len() as f64;
    10.0 * (255.0 * 255.0 / error.max(1e-9)).log10()
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 12, failure_persistence: None, ..ProptestConfig::default() })]
    #[test]
    fn episodes_one_after_the_other_come_back(
        width in 16_usize..90, half in 8_usize..45, lengths in prop::collection::vec(1_usize..6, 1..4),
        fps in prop::sample::select(vec![20.0, 30.0, 12.5, 50.0, 30_000.0 / 1001.0]), seed in any::<u64>(),
    ) {
        let height = 2 * half;
        let rate = Rate::of(fps).unwrap();
        let pictures: Vec<Vec<Vec<u8>>> = lengths.iter().enumerate()
            .map(|(e, &n)| (0..n).map(|i| picture(width, height, i + 10 * e, seed)).collect()).collect();
        let options = EncodeOptions { quantizer: 20, ..EncodeOptions::default() };
        let episodes: Vec<Vec<Sample>> = pictures.iter().map(|p| encode(width, height, rate, p, &options)).collect();
        for samples in &episodes {
            // each can be decoded without the others, from every second frame on
            prop_assert!(samples.iter().enumerate().all(|(i, s)| s.key == (i % 2 == 0)));
        }
        let bytes = file(width, height, rate, &episodes);
        let video = Video::from_bytes("written", bytes).unwrap();
        let all: Vec<&Vec<u8>> = pictures.iter().flatten().collect();
        let info = video.info().clone();
        prop_assert_eq!((info.width, info.height, info.frames, info.codec), (width, height, all.len(), Codec::Av1));
        prop_assert!((info.fps - fps).abs() < 1e-6);
        for (i, (frame, original)) in video.frames().zip(&all).enumerate() {
            let frame = frame.unwrap();
            prop_assert!((frame.timestamp - i as f64 / fps).abs() < TOLERANCE / 10.0);
            prop_assert!(psnr(original, &frame.rgb) > 28.0, "frame {}: {}", i, psnr(original, &frame.rgb));
            prop_assert_eq!(video.frame_at(i as f64 / fps).unwrap(), frame);
        }
    }
}

#[test]
fn the_same_pictures_make_the_same_bytes() {
    let rate = Rate::of(20.0).unwrap();
    let pictures: Vec<_> = (0..6).map(|i| picture(84, 84, i, 3)).collect();
    let made = || file(84, 84, rate, &[encode(84, 84, rate, &pictures, &EncodeOptions::default())]);
    let first = made();
    // on another thread
    let again = std::thread::scope(|scope| scope.spawn(made).join().unwrap());
    assert_eq!(first, again);
}

#[test]
fn what_cannot_be_encoded_is_named() {
    let rate = Rate::of(20.0).unwrap();
    let refused = |w, h| Encoder::new(w, h, rate, &EncodeOptions::default()).err().unwrap().to_string();
    assert!(refused(84, 85).contains("84 x 85") && refused(84, 85).contains("odd"), "{}", refused(84, 85));
    assert!(refused(8, 84).contains("16 to 8192"));
    let mut encoder = Encoder::new(84, 84, rate, &EncodeOptions::default()).unwrap();
    let text = encoder.push(&[0; 100]).unwrap_err().to_string();
    assert!(text.contains("frame 0 has 100 bytes instead of 21168"), "{text}");
    assert!(Encoder::new(84, 84, rate, &EncodeOptions::default()).unwrap().finish().unwrap().is_empty());
    let mut muxer = Muxer::new(84, 84, rate);
    let late = Sample { bytes: vec![0x32, 0], key: false, parameters: Vec::new() };
    assert!(muxer.push(&late).unwrap_err().to_string().contains("sequence header"));
}
