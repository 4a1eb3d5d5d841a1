//! The content hash: SHA-256 over what a source says, not over how its file is laid out. A mutation that every
//! reader accepts in silence changes it; copying, repacking or exporting does not.

use std::collections::BTreeMap;

use sha2::{Digest, Sha256};

use super::codec::code_of;
use crate::tree::{Array, Attrs, Demo, Dtype};

type Hash = [u8; 32];

fn text(hasher: &mut Sha256, text: &str) {
    hasher.update((text.len() as u64).to_le_bytes());
    hasher.update(text);
}

/// Hashes one array as its rows arrive.
pub struct ArrayHasher(Sha256);

impl ArrayHasher {
    /// Starts with type and shape.
    pub fn new(dtype: &Dtype, shape: &[usize]) -> Self {
        let mut hasher = Sha256::new();
        let (code, width) = code_of(dtype);
        hasher.update([code]);
        hasher.update((width as u64).to_le_bytes());
        hasher.update((shape.len() as u64).to_le_bytes());
        for &extent in shape {
            hasher.update((extent as u64).to_le_bytes());
        }
        Self(hasher)
    }

    /// Adds elements in order.
    pub fn update(&mut self, bytes: &[u8]) {
        self.0.update(bytes);
    }

    /// The hash.
    pub fn finish(self) -> Hash {
        self.0.finalize().into()
    }

    fn of(array: &Array) -> Hash {
        let mut hasher = Self::new(&array.dtype, &array.shape);
        hasher.update(&array.bytes);
        hasher.finish()
    }
}

/// Hashes one demo; datasets too large to hold are added one by one.
pub struct DemoHasher {
    attrs: Hash,
    datasets: BTreeMap<String, Hash>,
}

impl DemoHasher {
    /// Starts with everything that is in `demo`.
    pub fn new(demo: &Demo) -> Self {
        let mut hasher = Sha256::new();
        put_attrs(&mut hasher, &demo.attrs);
        hasher.update((demo.groups.len() as u64).to_le_bytes());
        for group in &demo.groups {
            text(&mut hasher, group);
        }
        hasher.update((demo.inner_attrs.len() as u64).to_le_bytes());
        for (path, attrs) in &demo.inner_attrs {
            text(&mut hasher, path);
            put_attrs(&mut hasher, attrs);
        }
        let datasets = demo.datasets.iter().map(|(k, v)| (k.clone(), ArrayHasher::of(v))).collect();
        Self { attrs: hasher.finalize().into(), datasets }
    }

    /// Adds a dataset that was not in the demo.
    pub fn dataset(&mut self, key: &str, hash: Hash) {
        self.datasets.insert(key.to_owned(), hash);
    }

    /// The hash; the order in which datasets were added does not matter.
    pub fn finish(self) -> Hash {
        let mut hasher = Sha256::new();
        hasher.update(self.attrs);
        for (key, hash) in &self.datasets {
            text(&mut hasher, key);
            hasher.update(hash);
        }
        hasher.finalize().into()
    }
}

fn put_attrs(hasher: &mut Sha256, attrs: &Attrs) {
    hasher.update((attrs.len() as u64).to_le_bytes());
    for (name, value) in attrs {
        text(hasher, name);
        hasher.update(ArrayHasher::of(value));
    }
}

/// Hashes a source from the hashes of its demos, in whatever order they are finished.
#[derive(Default)]
pub struct ContentHasher {
    root: Hash,
    demos: BTreeMap<String, Hash>,
}

impl ContentHasher {
    /// An empty source.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds what belongs to no demo.
    pub fn root(&mut self, root: &Demo) {
        self.root = DemoHasher::new(root).finish();
    }

    /// Adds a demo.
    pub fn demo(&mut self, id: &str, hash: Hash) {
        self.demos.insert(id.to_owned(), hash);
    }

    /// The hash in hexadecimal.
    pub fn finish(self) -> String {
        let mut hasher = Sha256::new();
        hasher.update(self.root);
        for (id, hash) in &self.demos {
            text(&mut hasher, id);
            hasher.update(hash);
        }
        hasher.finalize().iter().map(|b| format!("{b:02x}")).collect()
    }
}
