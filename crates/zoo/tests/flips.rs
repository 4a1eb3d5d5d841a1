//! Bits flipped at random over the entries and results that come with the repository: every one is told.
//!
//! `ACTRM_FLIPS=100000 ACTRM_FLIP_SEED=7` for more and others.

#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::{Path, PathBuf};

use zoo::audit::{KnownEntries, audit};
use zoo::entry::{Entry, EntryId};
use zoo::registry::Registry;
use zoo::results::StoredEvaluation;

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

/// Where a flip lands: a file, and the bytes of it that may be hit.
struct Target {
    path: PathBuf,
    bytes: std::ops::Range<usize>,
    /// How many of a thousand flips.
    share: usize,
}

#[test]
fn every_flipped_bit_is_told() {
    let (flips, seed) = (number("ACTRM_FLIPS", 4000), number("ACTRM_FLIP_SEED", 1));
    let root = tempfile::tempdir().unwrap();
    let (shipped, zoo) = (Path::new(env!("CARGO_MANIFEST_DIR")).join("../../zoo"), root.path().join("zoo"));
    let id = EntryId { name: "lift-act".to_owned(), version: 1 };
    let entry = zoo.join("lift-act/1");
    copy(&shipped.join("lift-act/1"), &entry);
    let result = fs::read_dir(shipped.join("results")).unwrap().map(|item| item.unwrap().path());
    let result = result.filter(|path| path.to_string_lossy().contains("lift-act@1_Lift_10000")).min().unwrap();
    let folder = zoo.join("results").join(result.file_name().unwrap());
    copy(&result, &folder);
    let _ = fs::remove_file(folder.join("lock"));

    let whole = |path: &Path| 0..fs::metadata(path).unwrap().len() as usize;
    let model = entry.join("model.safetensors");
    let bytes = fs::read(&model).unwrap();
    let header = 8 + u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let target = |path: PathBuf, share: usize| Target { bytes: whole(&path), path, share };
    let mut targets = vec![
        // hashing the weights is most of the time that a flip takes
        Target { path: model.clone(), bytes: 0..header, share: 20 },
        Target { path: model.clone(), bytes: header..bytes.len(), share: 20 },
        target(entry.join("normaliser.safetensors"), 10),
        target(entry.join("entry.json"), 150),
        target(entry.join("config.toml"), 100),
        target(entry.join("README.md"), 100),
    ];
    for (name, share) in
        [("evaluation.json", 150), ("outcomes.parquet", 150), ("timings.parquet", 150), ("seal.json", 150)]
    {
        targets.push(target(folder.join(name), share));
    }
    let shares: usize = targets.iter().map(|target| target.share).sum();

    let standing = || {
        let found = audit(&zoo.join("results"), &KnownEntries::open(&Registry::open(&zoo)).unwrap()).unwrap();
        (found.standing.len(), found.left_out.len())
    };
    assert_eq!(standing(), (1, 0));
    let mut places = Places(seed);
    for flip in 0..flips {
        let mut at = places.below(shares);
        let target = targets.iter().find(|target| {
            let here = at < target.share;
            at = at.saturating_sub(if here { 0 } else { target.share });
            here
        });
        let Target { path, bytes, .. } = target.unwrap();
        let (place, bit) = (bytes.start + places.below(bytes.len()), places.below(8));
        let original = fs::read(path).unwrap();
        let mut damaged = original.clone();
        damaged[place] ^= 1 << bit;
        fs::write(path, &damaged).unwrap();
        let told = match path.starts_with(&entry) {
            true => Entry::open(&zoo, &id).is_err(),
            false => StoredEvaluation::read(&folder).is_err(),
        };
        assert!(told, "flip {flip}: bit {bit} of byte {place} of {} passed", path.display());
        // now and then the whole way: the row is left out
        if flip % 500 == 0 {
            assert_eq!(standing(), (0, 1), "bit {bit} of byte {place} of {}", path.display());
        }
        fs::write(path, original).unwrap();
    }
    assert_eq!(standing(), (1, 0));
}
