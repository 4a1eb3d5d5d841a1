//! One hash for what a data set says, whatever the files look like: the same for PNG and PPM, for one shard
//! and for many.

use super::info::Features;
use super::schema::hex;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;

/// sha256 over the columns' names, types and shapes, the rate, and each episode's length, task and digests of
/// its columns in order of name. The five index columns follow from these and stay out.
pub(crate) struct Fingerprint {
    hash: Sha256,
    columns: BTreeMap<String, [u8; 32]>,
}

/// Columns that follow from an episode's place.
pub(crate) const INDEX_COLUMNS: [&str; 5] = ["timestamp", "frame_index", "episode_index", "index", "task_index"];

impl Fingerprint {
    pub(crate) fn new(features: &Features, fps: f64) -> Self {
        let mut hash = Sha256::new();
        hash.update(format!("actrm content 1\nfps {fps}\n"));
        let mut sorted: Vec<_> = features.0.iter().filter(|(n, _)| !INDEX_COLUMNS.contains(&n.as_str())).collect();
        sorted.sort_by_key(|(name, _)| name);
        for (name, feature) in sorted {
            hash.update(format!("column {name} {} {:?}\n", feature.dtype, feature.shape));
        }
        Self { hash, columns: BTreeMap::new() }
    }

    /// Begins the next episode.
    pub(crate) fn episode(&mut self, length: usize, task: &str) {
        self.close_episode();
        self.hash.update(format!("episode {length} {} {task}\n", task.len()));
    }

    /// Digest of a column's values over the present episode, in any order of columns.
    pub(crate) fn column(&mut self, name: &str, digest: [u8; 32]) {
        self.columns.insert(name.to_owned(), digest);
    }

    fn close_episode(&mut self) {
        for (name, digest) in std::mem::take(&mut self.columns) {
            self.hash.update(format!("{name} {}\n", hex(&digest)));
        }
    }

    pub(crate) fn finish(mut self) -> String {
        self.close_episode();
        hex(&self.hash.finalize())
    }
}
