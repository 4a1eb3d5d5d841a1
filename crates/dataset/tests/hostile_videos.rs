//! Damaged videos through the isolated reader: each ends with pictures or with an error, in time, within memory, and
//! this process lives on. Runs without the test harness, because the reading process is this program started again.
//!
//! `ACTRM_MUTATIONS=2000` sets how many files are made (500 otherwise), `ACTRM_MUTATION_SEED` which ones.
#![allow(clippy::unwrap_used, clippy::result_large_err)]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use dataset::{InputError, VideoFile, isolation};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{RngCore, SeedableRng};

/// No hang beyond this, on a machine with much else to do.
const LIMIT: Duration = Duration::from_secs(60);

fn main() {
    let originals = || ["av1_agentview.mp4", "h264_agentview.mp4"].map(fixture);
    // before this process is armed it reads by itself; the reading process never comes here
    let here = (!is_child()).then(|| originals().map(|path| everything(&path).unwrap()));
    isolation::serve_if_child();
    let there = originals().map(|path| everything(&path).unwrap());
    assert!(here == Some(there.clone()));
    println!("isolated decoding equals decoding in process: ok");
    errors_cross_unchanged();
    mutations(&originals(), &there);
}

fn is_child() -> bool {
    std::env::vars_os().any(|(name, _)| name.to_string_lossy().starts_with("ACTRM_VIDEO_READER"))
}

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../video/tests/fixtures").join(name)
}

/// All pictures of a file, and of a part of it once more.
fn everything(path: &Path) -> Result<Vec<u8>, InputError> {
    let file = VideoFile::open(path)?;
    let mut all = Vec::new();
    let frames = file.info().frames;
    file.read(0..frames, &mut |_, rgb| all.extend_from_slice(rgb))?;
    let size = file.info().width * file.info().height * 3;
    let from = frames / 2;
    file.read(from..frames, &mut |frame, rgb| assert!(rgb == &all[frame * size..(frame + 1) * size]))?;
    Ok(all)
}

fn errors_cross_unchanged() {
    for (path, word) in [
        (PathBuf::from("nowhere/at/all.mp4"), "no such file"),
        (fixture("refused/hevc.mp4"), "HEVC (H.265)"),
        (fixture("README.md"), "not an MP4 file"),
    ] {
        let text = everything(&path).unwrap_err().to_string();
        assert!(text.starts_with(&format!("{}: ", path.display())) && text.contains(word), "{text}");
    }
    let file = VideoFile::open(&fixture("av1_agentview.mp4")).unwrap();
    let text = file.read(30..40, &mut |_, _| ()).unwrap_err().to_string();
    assert!(text.contains("no frames 30 to 40; there is 36 frames"), "{text}");
    println!("errors cross from the reading process unchanged: ok");
}

fn number(name: &str, otherwise: u64) -> u64 {
    std::env::var(name).ok().and_then(|v| v.parse().ok()).unwrap_or(otherwise)
}

/// Changes a file; says how.
fn mutate(bytes: &mut Vec<u8>, rng: &mut ChaCha8Rng) -> &'static str {
    let below = |n: usize, rng: &mut ChaCha8Rng| (rng.next_u64() % n.max(1) as u64) as usize;
    // a third of the damage goes into the boxes that say where everything is
    let spot = |bytes: &[u8], rng: &mut ChaCha8Rng| match rng.next_u64() % 3 {
        0 => below(bytes.len().min(1100), rng),
        _ => below(bytes.len(), rng),
    };
    match rng.next_u64() % 5 {
        0 => {
            for _ in 0..=below(3, rng) {
                let at = spot(bytes, rng);
                bytes[at] ^= 1 << below(8, rng);
            }
            "bits flipped"
        }
        1 => {
            bytes.truncate(below(bytes.len(), rng));
            "truncated"
        }
        2 => {
            let absurd = [u32::MAX, 1 << 31, 1 << 24, 0, 1, bytes.len() as u32];
            let at = spot(bytes, rng).min(bytes.len() - 4);
            bytes[at..at + 4].copy_from_slice(&absurd[below(absurd.len(), rng)].to_be_bytes());
            "absurd number"
        }
        3 => {
            let at = spot(bytes, rng);
            let end = (at + 1 + below(64, rng)).min(bytes.len());
            bytes[at..end].iter_mut().for_each(|b| *b = rng.next_u64() as u8);
            "noise"
        }
        _ => {
            let at = spot(bytes, rng);
            let from = below(bytes.len(), rng);
            let size = (1 + below(256, rng)).min(bytes.len() - at.max(from));
            bytes.copy_within(from..from + size, at);
            "copied over"
        }
    }
}

fn mutations(originals: &[PathBuf], contents: &[Vec<u8>]) {
    let (count, seed) = (number("ACTRM_MUTATIONS", 500), number("ACTRM_MUTATION_SEED", 1));
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("hostile.mp4");
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut tally: BTreeMap<&str, u64> = BTreeMap::new();
    let (mut slowest, mut most) = (Duration::ZERO, 0);
    for i in 0..count {
        let which = (i % originals.len() as u64) as usize;
        let mut bytes = std::fs::read(&originals[which]).unwrap();
        let how = mutate(&mut bytes, &mut rng);
        std::fs::write(&path, &bytes).unwrap();
        let start = Instant::now();
        let result = VideoFile::open(&path).and_then(|file| {
            let mut all = Vec::new();
            let read = file.read(0..file.info().frames.min(100), &mut |_, rgb| all.extend_from_slice(rgb));
            most = most.max(children_peak());
            read.map(|()| all)
        });
        let took = start.elapsed();
        slowest = slowest.max(took);
        assert!(took < LIMIT, "file {i} ({how}, seed {seed}): {took:?}");
        let kind = match &result {
            Ok(same) if *same == contents[which] => "read, nothing of it changed",
            Ok(_) => "read, other images",
            Err(InputError::ReaderDied { .. }) => "the decoder crashed or ran out, alone",
            Err(InputError::ReaderSilent { .. }) => "the decoder hung, alone",
            Err(InputError::Video { .. }) => "refused with a reason",
            Err(other) => panic!("file {i} ({how}, seed {seed}): {other}"),
        };
        *tally.entry(kind).or_default() += 1;
        if let Err(error) = &result {
            let text = error.to_string();
            assert!(!text.contains('\n') && text.contains("hostile.mp4"), "one line with the file: {text}");
        }
    }
    println!("{count} mutated videos, seed {seed}: {tally:#?}");
    println!("slowest {slowest:?}, most memory here and in the reading process {} MB", most >> 20);
    assert!(most < 1 << 30, "{most} bytes");
}

/// Peak resident memory of this process and of its children that live, in bytes.
fn children_peak() -> u64 {
    let peak = |pid: &str| -> u64 {
        let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
        let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:")).unwrap_or("0 kB").trim();
        line.split(' ').next().and_then(|n| n.parse::<u64>().ok()).unwrap_or(0) << 10
    };
    let me = std::process::id();
    let list = std::fs::read_to_string(format!("/proc/{me}/task/{me}/children")).unwrap_or_default();
    peak(&me.to_string()) + list.split_whitespace().map(peak).sum::<u64>()
}
