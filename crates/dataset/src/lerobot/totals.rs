//! What grows with a data set while it is written, kept in files without a name beside it: the values of each column, for the
//! statistics of the whole, and the statistics of each episode.

use super::values::Values;
use crate::error::{DatasetError, Result};
use crate::stats::{FeatureStats, Sample, Streamed};
use std::collections::BTreeMap;
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

/// Bytes of a column's values, and of episodes' statistics, in memory.
const BLOCK_BYTES: usize = 1 << 20;

/// A file that is gone when it is closed, in a folder.
#[derive(Debug)]
struct Spill {
    folder: PathBuf,
    file: Option<File>,
    end: u64,
}

impl Spill {
    fn new(folder: &Path) -> Self {
        Self { folder: folder.to_path_buf(), file: None, end: 0 }
    }

    fn failed(&self, operation: &'static str) -> impl FnOnce(io::Error) -> DatasetError {
        let path = self.folder.clone();
        move |source| DatasetError::Io { path, operation, source }
    }

    /// Appends bytes; gives their place.
    fn append(&mut self, bytes: &[u8]) -> Result<u64> {
        const OPERATION: &str = "keep what statistics are made of in it";
        if self.file.is_none() {
            self.file = Some(tempfile::tempfile_in(&self.folder).map_err(self.failed(OPERATION))?);
        }
        let at = self.end;
        if let Some(file) = &self.file {
            file.write_all_at(bytes, at).map_err(self.failed(OPERATION))?;
        }
        self.end += bytes.len() as u64;
        Ok(at)
    }

    fn read(&self, at: u64, bytes: &mut [u8]) -> Result<()> {
        let file = self.file.as_ref().ok_or_else(|| io::ErrorKind::NotFound.into());
        file.and_then(|file| file.read_exact_at(bytes, at)).map_err(self.failed("read back what was kept in it"))
    }
}

/// The values of one column over all episodes.
pub(crate) struct ColumnTotal {
    dim: usize,
    spill: Spill,
    /// Places and rows of the blocks that are in the file, each with its dimensions one after the other.
    blocks: Vec<(u64, usize)>,
    /// Those that follow, none right after a block; of truths as float32. Once there was an episode, it says their type.
    waiting: Option<Values>,
}

impl ColumnTotal {
    /// Nothing yet; files go into `folder`.
    pub(crate) fn new(folder: &Path, dim: usize) -> Self {
        Self { dim, spill: Spill::new(folder), blocks: Vec::new(), waiting: None }
    }

    /// Takes the values of the next episode.
    pub(crate) fn add(&mut self, values: Values) -> Result<()> {
        let values = match values {
            Values::Pictures => return Ok(()),
            Values::Bool(v) => Values::F32(v.iter().map(|&b| f32::from(u8::from(b))).collect()),
            numbers => numbers,
        };
        let full = match (&mut self.waiting, values) {
            (Some(Values::F32(all)), Values::F32(more)) => joined(all, &more),
            (Some(Values::F64(all)), Values::F64(more)) => joined(all, &more),
            (Some(Values::I64(all)), Values::I64(more)) => joined(all, &more),
            (_, first) => {
                self.waiting = Some(first);
                false
            }
        };
        if full { self.flush() } else { Ok(()) }
    }

    fn flush(&mut self) -> Result<()> {
        let (bytes, rows) = match &mut self.waiting {
            Some(Values::F32(v)) => taken(v, self.dim),
            Some(Values::F64(v)) => taken(v, self.dim),
            Some(Values::I64(v)) => taken(v, self.dim),
            _ => return Ok(()),
        };
        let at = self.spill.append(&bytes)?;
        self.blocks.push((at, rows));
        Ok(())
    }

    /// Their statistics; `None` of no rows.
    pub(crate) fn stats(&self) -> Result<Option<FeatureStats>> {
        match &self.waiting {
            Some(Values::F32(rest)) => self.stats_of(rest),
            Some(Values::F64(rest)) => self.stats_of(rest),
            Some(Values::I64(rest)) => self.stats_of(rest),
            _ => Ok(None),
        }
    }

    fn stats_of<T: Sample>(&self, rest: &[T]) -> Result<Option<FeatureStats>> {
        if self.blocks.is_empty() {
            return Ok(FeatureStats::of(rest, self.dim));
        }
        let (mut bytes, mut values) = (Vec::new(), Vec::new());
        FeatureStats::streamed(self.dim, &mut |dimension, take: &mut Streamed<'_, T>| {
            for &(at, rows) in &self.blocks {
                bytes.resize(rows * T::BYTES, 0);
                self.spill.read(at + (dimension * bytes.len()) as u64, &mut bytes)?;
                values.clear();
                values.extend(bytes.chunks_exact(T::BYTES).map(T::from_bytes));
                take(&values);
            }
            values.clear();
            values.extend(rest.iter().skip(dimension).step_by(self.dim));
            take(&values);
            Ok(())
        })
    }
}

/// Appends, and says whether it is enough for a block.
fn joined<T: Copy>(all: &mut Vec<T>, more: &[T]) -> bool {
    all.extend_from_slice(more);
    std::mem::size_of_val(all.as_slice()) >= BLOCK_BYTES
}

/// Takes rows of `dim` values: their bytes, one dimension after the other, and their number.
fn taken<T: Sample>(values: &mut Vec<T>, dim: usize) -> (Vec<u8>, usize) {
    let mut bytes = Vec::with_capacity(values.len() * T::BYTES);
    for dimension in 0..dim {
        values.iter().skip(dimension).step_by(dim).for_each(|value| value.put(&mut bytes));
    }
    let rows = values.len() / dim.max(1);
    values.clear();
    (bytes, rows)
}

/// A feature that episodes have statistics of.
struct Counted {
    name: String,
    /// How many do.
    episodes: usize,
    /// Which of [`FeatureStats::vectors`] one of them lacks.
    lacks: [bool; 9],
}

/// The statistics of each episode's features.
pub(crate) struct EpisodeStats {
    spill: Spill,
    /// The features that any episode has statistics of.
    features: Vec<Counted>,
    /// Place and length of the statistics of each group of episodes.
    groups: Vec<(u64, usize)>,
    waiting: Vec<u8>,
    episodes: usize,
    /// Those of them that have no frames, and no statistics.
    empty: usize,
}

impl EpisodeStats {
    /// Episodes that are read together.
    pub(crate) const GROUP: usize = 1000;

    pub(crate) fn new(folder: &Path) -> Self {
        let (features, groups, waiting) = (Vec::new(), Vec::new(), Vec::new());
        Self { spill: Spill::new(folder), features, groups, waiting, episodes: 0, empty: 0 }
    }

    /// Takes those of the next episode, of so many frames.
    pub(crate) fn add(&mut self, stats: &BTreeMap<String, FeatureStats>, frames: usize) -> Result<()> {
        let none = BTreeMap::new();
        let stats = if frames == 0 { &none } else { stats };
        self.empty += usize::from(frames == 0);
        put(&mut self.waiting, stats.len() as u64);
        for (name, stats) in stats {
            let at = self.features.iter().position(|known| known.name == *name).unwrap_or_else(|| {
                self.features.push(Counted { name: name.clone(), episodes: 0, lacks: [false; 9] });
                self.features.len() - 1
            });
            let counted = &mut self.features[at];
            counted.episodes += 1;
            put(&mut self.waiting, at as u64);
            put(&mut self.waiting, stats.count);
            for (vector, lacks) in stats.vectors().into_iter().zip(&mut counted.lacks) {
                *lacks |= vector.is_empty();
                put(&mut self.waiting, vector.len() as u64);
                vector.iter().for_each(|value| put(&mut self.waiting, value.to_bits()));
            }
        }
        self.episodes += 1;
        if self.episodes.is_multiple_of(Self::GROUP) {
            let at = self.spill.append(&self.waiting)?;
            self.groups.push((at, self.waiting.len()));
            self.waiting.clear();
        }
        Ok(())
    }

    /// Whether every episode that has frames has statistics of a feature.
    pub(crate) fn all_have(&self, feature: &str) -> bool {
        self.of(feature).is_some_and(|counted| counted.episodes == self.episodes - self.empty)
    }

    /// Which of [`FeatureStats::vectors`] an episode with statistics of a feature lacks.
    pub(crate) fn lacks(&self, feature: &str) -> [bool; 9] {
        self.of(feature).map_or([true; 9], |counted| counted.lacks)
    }

    fn of(&self, feature: &str) -> Option<&Counted> {
        self.features.iter().find(|counted| counted.name == feature)
    }

    /// Whether an episode has none.
    pub(crate) fn some_lack(&self) -> bool {
        self.empty > 0
    }

    /// Those of the episodes from `group * GROUP` on.
    pub(crate) fn group(&self, group: usize) -> Result<Vec<BTreeMap<String, FeatureStats>>> {
        let mut stored = Vec::new();
        let mut bytes = match self.groups.get(group) {
            Some(&(at, length)) => {
                stored.resize(length, 0);
                self.spill.read(at, &mut stored)?;
                stored.as_slice()
            }
            None => self.waiting.as_slice(),
        };
        let mut next = || {
            let (word, rest) = bytes.split_first_chunk().unwrap_or((&[0; 8], &[]));
            bytes = rest;
            u64::from_le_bytes(*word)
        };
        let first = group * Self::GROUP;
        let mut episodes = Vec::new();
        for _ in first..self.episodes.min(first + Self::GROUP) {
            let mut of_episode = BTreeMap::new();
            for _ in 0..next() {
                let name = &self.features[next() as usize].name;
                let count = next();
                let mut vector = || (0..next()).map(|_| f64::from_bits(next())).collect::<Vec<f64>>();
                of_episode.insert(name.clone(), FeatureStats::from_vectors(count, std::array::from_fn(|_| vector())));
            }
            episodes.push(of_episode);
        }
        Ok(episodes)
    }

    /// Those of one feature, where every episode that has frames has them.
    pub(crate) fn of_feature(&self, feature: &str) -> Result<Option<Vec<FeatureStats>>> {
        if !self.all_have(feature) {
            return Ok(None);
        }
        let mut all = Vec::with_capacity(self.episodes);
        for group in 0..self.episodes.div_ceil(Self::GROUP) {
            all.extend(self.group(group)?.into_iter().filter_map(|mut of_episode| of_episode.remove(feature)));
        }
        Ok(Some(all))
    }
}

fn put(bytes: &mut Vec<u8>, word: u64) {
    bytes.extend_from_slice(&word.to_le_bytes());
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn values_in_a_file_have_the_same_statistics_bit_for_bit() {
        let folder = tempfile::tempdir().unwrap();
        let mut state = 1_u64;
        let mut random = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as f64 / f64::from(1_u32 << 30) - 1.0
        };
        let rows = 400_000;
        let mut floats: Vec<f32> = (0..3 * rows).map(|_| random() as f32).collect();
        (floats[5], floats[7], floats[9], floats[11]) = (f32::NAN, f32::INFINITY, -0.0, 0.0);
        // one dimension of a few values, one of none that counts
        floats.iter_mut().skip(1).step_by(3).for_each(|v| *v = v.round());
        floats.iter_mut().skip(2).step_by(3).for_each(|v| *v = f32::NAN);
        let doubles: Vec<f64> = (0..rows).map(|_| random() * 1e9).collect();
        let longs: Vec<i64> = (0..rows).map(|i| (i as i64 - 1000) * (random() * 100.0) as i64).collect();
        let truths: Vec<bool> = (0..rows).map(|_| random() > 0.7).collect();
        for (values, dim) in
            [(Values::F32(floats), 3), (Values::F64(doubles), 1), (Values::I64(longs), 1), (Values::Bool(truths), 1)]
        {
            let mut total = ColumnTotal::new(folder.path(), dim);
            for from in (0..rows).step_by(999) {
                let to = rows.min(from + 999);
                let part = from * dim..to * dim;
                total
                    .add(match &values {
                        Values::F32(v) => Values::F32(v[part].to_vec()),
                        Values::F64(v) => Values::F64(v[part].to_vec()),
                        Values::I64(v) => Values::I64(v[part].to_vec()),
                        Values::Bool(v) => Values::Bool(v[part].to_vec()),
                        Values::Pictures => Values::Pictures,
                    })
                    .unwrap();
            }
            assert!(!total.blocks.is_empty());
            let (got, expected) = (total.stats().unwrap().unwrap(), values.stats(dim).unwrap());
            let bits = |s: &FeatureStats| s.vectors().map(|v| v.iter().map(|x| x.to_bits()).collect::<Vec<_>>());
            assert_eq!((got.count, bits(&got)), (expected.count, bits(&expected)));
        }
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }

    #[test]
    fn the_last_episode_may_complete_a_block() {
        let folder = tempfile::tempdir().unwrap();
        let values: Vec<f32> = (0..BLOCK_BYTES as i32 / 4).map(|i| (i % 1000) as f32).collect();
        let mut total = ColumnTotal::new(folder.path(), 2);
        for half in values.chunks(values.len() / 2) {
            total.add(Values::F32(half.to_vec())).unwrap();
        }
        assert_eq!(total.blocks.len(), 1);
        let expected = Values::F32(values).stats(2).unwrap();
        let got = total.stats().unwrap().unwrap();
        assert_eq!((got.count, got.vectors()), (expected.count, expected.vectors()));
    }

    #[test]
    fn statistics_of_many_episodes_come_back_as_they_were() {
        let folder = tempfile::tempdir().unwrap();
        let mut kept = EpisodeStats::new(folder.path());
        let of = |i: usize| {
            let stats = FeatureStats::of(&[i as f64, 0.5], 1).unwrap();
            let mut all = BTreeMap::from([("a".to_owned(), FeatureStats { q10: Vec::new(), ..stats.clone() })]);
            if i != 7 {
                all.insert("b".to_owned(), stats);
            }
            all
        };
        (0..2100).for_each(|i| kept.add(&of(i), 1).unwrap());
        assert!(kept.all_have("a") && !kept.all_have("b") && !kept.all_have("c"));
        for group in 0..3 {
            let last = 2100.min(1000 * group + 1000);
            assert_eq!(kept.group(group).unwrap(), (1000 * group..last).map(of).collect::<Vec<_>>());
        }
        assert_eq!(kept.of_feature("a").unwrap().unwrap()[2099], of(2099)["a"]);
        assert_eq!(kept.of_feature("b").unwrap(), None);
    }
}
