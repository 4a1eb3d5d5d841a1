//! Damaged and hostile files through the isolated reader: each ends with data or with an error, in time, within
//! memory, and this process lives on. Runs without the test harness, because the reading process is this program
//! started again.
//!
//! `ACTRM_MUTATIONS=2000` sets how many files are made (300 otherwise), `ACTRM_MUTATION_SEED` which ones.
#![allow(clippy::unwrap_used, clippy::result_large_err)]

use std::collections::BTreeMap;
use std::path::Path;
use std::time::{Duration, Instant};

#[path = "common/made.rs"]
mod made;

use dataset::{DatasetError, Demo, InputError, RobomimicWriter, Source, WriteOptions, isolation};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{RngCore, SeedableRng};

/// What the tool promises: no hang beyond this. A test run on a machine with much else to do gets more.
const LIMIT: Duration = Duration::from_secs(10);
const PATIENT_LIMIT: Duration = Duration::from_secs(60);

fn main() {
    isolation::serve_if_child();
    isolated_reading_equals_reading_in_process();
    an_unarmed_path_reports_like_an_armed_one();
    a_reading_process_that_dies_is_an_error();
    mutations();
}

fn fixture(name: &str) -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name)
}

/// Everything in a source.
fn everything(source: &Source) -> Result<(Demo, Vec<Demo>), DatasetError> {
    let demos = (0..source.plan().demos.len()).map(|i| source.read_demo(i)).collect::<Result<_, _>>()?;
    Ok((source.root()?, demos))
}

/// A packed copy of a fixture: chunks, B-trees, shuffle and gzip to attack.
fn packed(path: &Path, to: &Path) {
    let (root, demos) = everything(&Source::open(path).unwrap()).unwrap();
    let mut writer = RobomimicWriter::create(to, &WriteOptions { gzip: Some(4) }).unwrap();
    writer.set_root(&root).unwrap();
    demos.iter().for_each(|demo| writer.add_demo(demo).unwrap());
    writer.finish().unwrap();
}

fn isolated_reading_equals_reading_in_process() {
    let dir = tempfile::tempdir().unwrap();
    let copy = dir.path().join("packed.hdf5");
    packed(&fixture("lift_low_dim_3_demos.hdf5"), &copy);
    for path in [fixture("lift_low_dim_3_demos.hdf5"), fixture("lift_raw_3_demos.hdf5"), copy] {
        let (here, there) = (Source::open(&path).unwrap(), Source::open_isolated(&path).unwrap());
        assert_eq!(here.plan(), there.plan());
        assert_eq!(everything(&here).unwrap(), everything(&there).unwrap());
    }
    println!("isolated reading equals reading in process: ok");
}

fn an_unarmed_path_reports_like_an_armed_one() {
    let path = Path::new("nowhere/at/all.hdf5");
    let texts = [Source::open(path), Source::open_isolated(path)].map(|r| r.unwrap_err().to_string());
    assert_eq!(texts[0], texts[1]);
    let text = Path::new(env!("CARGO_MANIFEST_DIR")).join("Cargo.toml");
    let texts = [Source::open(&text), Source::open_isolated(&text)].map(|r| r.unwrap_err().to_string());
    assert_eq!(texts[0], texts[1]);
    println!("errors cross from the reading process unchanged: ok");
}

fn a_reading_process_that_dies_is_an_error() {
    let dir = tempfile::tempdir().unwrap();
    let copy = dir.path().join("packed.hdf5");
    packed(&fixture("lift_low_dim_3_demos.hdf5"), &copy);
    let source = Source::open_isolated(&copy).unwrap();
    let child = children()[0];
    rustix::process::kill_process(rustix::process::Pid::from_raw(child).unwrap(), rustix::process::Signal::ABORT)
        .unwrap();
    for _ in 0..2 {
        let text = source.read_demo(0).map(|demo| demo.id).unwrap_err().to_string();
        assert!(text.contains("gave up (SIGABRT) while it was to read"), "{text}");
    }
    drop(source);
    assert!(children().is_empty(), "nothing is left running");
    println!("a reading process that dies is an error: ok");
}

/// The processes that this one has started and that live.
fn children() -> Vec<i32> {
    let me = std::process::id();
    let list = std::fs::read_to_string(format!("/proc/{me}/task/{me}/children")).unwrap_or_default();
    list.split_whitespace().filter_map(|pid| pid.parse().ok()).collect()
}

fn number(name: &str, otherwise: u64) -> u64 {
    std::env::var(name).ok().and_then(|v| v.parse().ok()).unwrap_or(otherwise)
}

/// Changes a file; says how.
fn mutate(bytes: &mut Vec<u8>, rng: &mut ChaCha8Rng) -> &'static str {
    let below = |n: usize, rng: &mut ChaCha8Rng| (rng.next_u64() % n.max(1) as u64) as usize;
    // half of the damage goes where the structure is: around the places that hold HDF5's block signatures
    let spot = |bytes: &[u8], rng: &mut ChaCha8Rng| {
        let at = below(bytes.len(), rng);
        if rng.next_u64().is_multiple_of(2) {
            return at;
        }
        let marks: [&[u8]; 9] = [b"TREE", b"SNOD", b"HEAP", b"GCOL", b"OHDR", b"OCHK", b"FRHP", b"BTHD", b"\x89HDF"];
        let found =
            (0..bytes.len()).map(|i| (at + i) % bytes.len()).find(|&i| marks.iter().any(|m| bytes[i..].starts_with(m)));
        (found.unwrap_or(at) + below(96, rng)).min(bytes.len() - 1)
    };
    match rng.next_u64() % 6 {
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
            let size = 1 + below(512, rng);
            let (a, b) = (below(bytes.len() - size, rng), below(bytes.len() - size, rng));
            for i in 0..size {
                bytes.swap(a + i, b + i);
            }
            "blocks swapped"
        }
        3 => {
            // an absurd size or address wherever a field may be
            let absurd = [u64::MAX, u64::MAX - 1, 1 << 62, 1 << 40, 1 << 31, 0, 1, bytes.len() as u64];
            let value = absurd[below(absurd.len(), rng)].to_le_bytes();
            let width = [1, 2, 4, 8][below(4, rng)];
            let at = spot(bytes, rng).min(bytes.len() - 8) / width * width;
            bytes[at..at + width].copy_from_slice(&value[..width]);
            "absurd size"
        }
        4 => {
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

fn mutations() {
    let (count, seed) = (number("ACTRM_MUTATIONS", 300), number("ACTRM_MUTATION_SEED", 1));
    let limit = if std::env::var_os("ACTRM_MUTATIONS").is_some() { LIMIT } else { PATIENT_LIMIT };
    let dir = tempfile::tempdir().unwrap();
    let mut originals = Vec::new();
    for name in ["lift_low_dim_3_demos.hdf5", "lift_raw_3_demos.hdf5"] {
        let copy = dir.path().join(format!("packed_{name}"));
        packed(&fixture(name), &copy);
        for path in [fixture(name), copy] {
            let content = everything(&Source::open(&path).unwrap()).unwrap();
            originals.push((std::fs::read(&path).unwrap(), content));
        }
    }
    for path in made::each(&dir.path().join("layouts")) {
        let content = everything(&Source::open(&path).unwrap()).unwrap();
        originals.push((std::fs::read(&path).unwrap(), content));
    }
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut tally: BTreeMap<&str, u64> = BTreeMap::new();
    let (mut slowest, mut most) = (Duration::ZERO, 0);
    let path = dir.path().join("hostile.hdf5");
    for i in 0..count {
        let (original, content) = &originals[(i % originals.len() as u64) as usize];
        let mut bytes = original.clone();
        let how = mutate(&mut bytes, &mut rng);
        std::fs::write(&path, &bytes).unwrap();
        let start = Instant::now();
        let result = Source::open_isolated(&path).and_then(|source| {
            // all of it, as a conversion reads it
            let read = everything(&source);
            most = most.max(children_peak());
            read
        });
        let took = start.elapsed();
        slowest = slowest.max(took);
        assert!(took < limit, "file {i} ({how}, seed {seed}): {took:?}");
        let kind = match &result {
            Ok(same) if same == content => "read, nothing of it changed",
            Ok(_) => "read, changed: only the hash recorded at the conversion tells",
            Err(DatasetError::Input(InputError::ReaderDied { .. })) => "the library crashed or ran out, alone",
            Err(DatasetError::Input(InputError::ReaderSilent { .. })) => "the library hung, alone",
            Err(DatasetError::Input(_)) => "refused with a reason",
            Err(other) => panic!("file {i} ({how}, seed {seed}): {other}"),
        };
        *tally.entry(kind).or_default() += 1;
        if let Err(error) = &result {
            let text = error.to_string();
            assert!(!text.contains('\n'), "one line: {text}");
        }
    }
    println!("{count} mutated files, seed {seed}: {tally:#?}");
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
    peak(&std::process::id().to_string()) + children().iter().map(|pid| peak(&pid.to_string())).sum::<u64>()
}
