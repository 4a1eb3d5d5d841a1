//! Bits flipped at random over an entry and a result that come with the repository, and over an entry of today's form:
//! every one is told.
//!
//! `ACTRM_FLIPS=100000 ACTRM_FLIP_SEED=7` for more and others.

#![allow(clippy::unwrap_used)]

#[path = "../../zoo/tests/common/mod.rs"]
mod common;

use std::collections::BTreeMap;
use std::fs::{self, OpenOptions};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use audit::{KnownEntries, audit};
use common::{SMALL, demonstrations};
use zoo::config::Library;
use zoo::entry::{Entry, EntryId};
use zoo::experiment::Experiment;
use zoo::registry::Registry;
use zoo::results::StoredEvaluation;
use zoo::run::{TrainOutcome, TrainRequest, train};

/// splitmix64: enough to choose places.
struct Places(u64);

impl Places {
    fn below(&mut self, n: usize) -> usize {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) % n as u64) as usize
    }
}

fn number(name: &str, default: u64) -> u64 {
    std::env::var(name).ok().map_or(default, |text| text.parse().unwrap())
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for item in fs::read_dir(from).unwrap() {
        let item = item.unwrap();
        fs::copy(item.path(), to.join(item.file_name())).unwrap();
    }
}

/// An entry of today's form, with the curve and the command of its training.
fn trained(root: &Path, zoo: &Path) -> EntryId {
    let overrides: Vec<String> = SMALL.iter().map(|setting| (*setting).to_owned()).collect();
    let request = TrainRequest {
        name: "act_lift".to_owned(),
        experiment: Experiment::load(&Library::built_in(), "act_lift", &overrides).unwrap(),
        data: Some(demonstrations(root)),
        runs: root.join("runs"),
        run: None,
        resume: false,
        zoo: zoo.to_owned(),
        from_zoo: None,
        force: false,
        image_memory: None,
        device: zoo::run::DeviceChoice::Cpu,
        command: Some("actrm-zoo train act_lift".to_owned()),
    };
    match train(&request, &|| false, &mut |_| {}).unwrap() {
        TrainOutcome::Finished { entry, .. } => entry,
        TrainOutcome::Stopped { .. } => panic!("nobody asked it to stop"),
    }
}

/// Which part of a file is hit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Kind {
    /// Names, shapes and places of tensors.
    Header,
    /// Their values.
    Payload,
    Parquet,
    /// JSON, TOML, Markdown.
    Text,
}

/// Where a flip lands: a file, and the bytes of it that may be hit.
struct Target {
    kind: Kind,
    path: PathBuf,
    bytes: std::ops::Range<usize>,
    /// How many of a thousand flips.
    share: usize,
}

impl Target {
    fn whole(kind: Kind, path: PathBuf, share: usize) -> Self {
        let bytes = 0..fs::metadata(&path).unwrap().len() as usize;
        assert!(!bytes.is_empty(), "{}", path.display());
        Self { kind, path, bytes, share }
    }

    /// The header of a file of tensors, its length included, and the values after it.
    fn tensors(path: PathBuf, header: usize, payload: usize) -> [Self; 2] {
        let bytes = fs::read(&path).unwrap();
        let end = 8 + u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
        [
            Self { kind: Kind::Header, path: path.clone(), bytes: 0..end, share: header },
            Self { kind: Kind::Payload, path, bytes: end..bytes.len(), share: payload },
        ]
    }
}

#[test]
fn every_flipped_bit_is_told() {
    let (flips, seed) = (number("ACTRM_FLIPS", 4000), number("ACTRM_FLIP_SEED", 1));
    let root = tempfile::tempdir().unwrap();
    let (shipped, zoo) = (Path::new(env!("CARGO_MANIFEST_DIR")).join("../../zoo"), root.path().join("zoo"));
    let old = EntryId { name: "lift-act".to_owned(), version: 1 };
    let old_entry = zoo.join("lift-act/1");
    copy(&shipped.join("lift-act/1"), &old_entry);
    let result = fs::read_dir(shipped.join("results")).unwrap().map(|item| item.unwrap().path());
    let result = result.filter(|path| path.to_string_lossy().contains("lift-act@1_Lift_10000")).min().unwrap();
    let folder = zoo.join("results").join(result.file_name().unwrap());
    copy(&result, &folder);
    let _ = fs::remove_file(folder.join("lock"));
    let new = trained(root.path(), &zoo);
    assert_eq!((new.name.as_str(), new.version), ("lift-act", 2));
    let new_entry = zoo.join("lift-act/2");

    let mut targets = Vec::new();
    // hashing the old entry's weights is most of the time that a flip takes
    targets.extend(Target::tensors(old_entry.join("model.safetensors"), 25, 50));
    targets.extend(Target::tensors(new_entry.join("model.safetensors"), 125, 75));
    targets.extend(Target::tensors(new_entry.join("reference.safetensors"), 25, 25));
    targets.extend(Target::tensors(new_entry.join("normaliser.safetensors"), 75, 50));
    for (name, share) in [("entry.json", 5), ("config.toml", 5), ("README.md", 5), ("normaliser.safetensors", 5)] {
        let kind = if name.ends_with("safetensors") { Kind::Payload } else { Kind::Text };
        targets.push(Target::whole(kind, old_entry.join(name), share));
    }
    for (name, share) in [("entry.json", 60), ("config.toml", 30), ("README.md", 30), ("command.txt", 20)] {
        targets.push(Target::whole(Kind::Text, new_entry.join(name), share));
    }
    targets.push(Target::whole(Kind::Parquet, new_entry.join("train.parquet"), 90));
    for (name, share) in [("evaluation.json", 70), ("seal.json", 70)] {
        targets.push(Target::whole(Kind::Text, folder.join(name), share));
    }
    for name in ["outcomes.parquet", "timings.parquet"] {
        targets.push(Target::whole(Kind::Parquet, folder.join(name), 80));
    }
    let shares: usize = targets.iter().map(|target| target.share).sum();
    assert_eq!(shares, 1000);
    // no file is left out
    for folder in [&old_entry, &new_entry, &folder] {
        for item in fs::read_dir(folder).unwrap() {
            let path = item.unwrap().path();
            assert!(targets.iter().any(|target| target.path == path), "{}", path.display());
        }
    }

    // rows that stand, rows left out, entries that are bad
    let standing = || {
        let entries = KnownEntries::open(&Registry::open(&zoo)).unwrap();
        let found = audit(&zoo.join("results"), &entries).unwrap();
        (found.standing.len(), found.left_out.len(), entries.bad().count())
    };
    assert_eq!(standing(), (1, 0, 0));
    let mut places = Places(seed);
    let mut counts: BTreeMap<Kind, u64> = BTreeMap::new();
    for flip in 0..flips {
        let mut at = places.below(shares);
        let target = targets.iter().find(|target| {
            let here = at < target.share;
            at = at.saturating_sub(if here { 0 } else { target.share });
            here
        });
        let Target { kind, path, bytes, .. } = target.unwrap();
        *counts.entry(*kind).or_default() += 1;
        let (place, bit) = (bytes.start + places.below(bytes.len()), places.below(8));
        let file = OpenOptions::new().read(true).write(true).open(path).unwrap();
        let mut byte = [0_u8];
        file.read_exact_at(&mut byte, place as u64).unwrap();
        let original = byte;
        byte[0] ^= 1 << bit;
        file.write_all_at(&byte, place as u64).unwrap();
        let told = match path.parent().unwrap() {
            parent if parent == old_entry => Entry::open(&zoo, &old).is_err(),
            parent if parent == new_entry => Entry::open(&zoo, &new).is_err(),
            _ => StoredEvaluation::read(&folder).is_err(),
        };
        assert!(told, "flip {flip}: bit {bit} of byte {place} of {} passed", path.display());
        // now and then the whole way: the entry is named, the row is left out
        if flip % 500 == 0 {
            let expected = match path.parent().unwrap() {
                parent if parent == old_entry => (0, 1, 1),
                parent if parent == new_entry => (1, 0, 1),
                _ => (0, 1, 0),
            };
            assert_eq!(standing(), expected, "bit {bit} of byte {place} of {}", path.display());
        }
        file.write_all_at(&original, place as u64).unwrap();
    }
    assert_eq!(standing(), (1, 0, 0));
    println!("{flips} flips, seed {seed}: {counts:?}");
    for (kind, count) in counts {
        assert!(count * 10 >= flips, "{kind:?}: {count} of {flips}");
    }
}
