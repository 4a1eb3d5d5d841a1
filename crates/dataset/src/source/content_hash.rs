//! One number for everything that a source holds, as `tests/fixtures/content_hash.py` computes it with h5py: what is
//! hashed is the content, not how the file lays it out.

#![allow(clippy::unwrap_used)]

use std::collections::BTreeMap;

use sha2::{Digest, Sha256};

use super::Source;
use super::codec::code_of;
use crate::tree::{Array, Attrs, Demo};

type Hash = [u8; 32];

fn count(hasher: &mut Sha256, count: usize) {
    hasher.update((count as u64).to_le_bytes());
}

fn text(hasher: &mut Sha256, text: &str) {
    count(hasher, text.len());
    hasher.update(text);
}

fn array(array: &Array) -> Hash {
    let mut hasher = Sha256::new();
    let (code, width) = code_of(&array.dtype);
    hasher.update([code]);
    count(&mut hasher, width);
    count(&mut hasher, array.shape.len());
    array.shape.iter().for_each(|&extent| count(&mut hasher, extent));
    hasher.update(&array.bytes);
    hasher.finalize().into()
}

fn attributes(hasher: &mut Sha256, attrs: &Attrs) {
    count(hasher, attrs.len());
    for (name, value) in attrs {
        text(hasher, name);
        hasher.update(array(value));
    }
}

fn tree(demo: &Demo) -> Hash {
    let mut head = Sha256::new();
    attributes(&mut head, &demo.attrs);
    count(&mut head, demo.groups.len());
    demo.groups.iter().for_each(|group| text(&mut head, group));
    count(&mut head, demo.inner_attrs.len());
    for (path, attrs) in &demo.inner_attrs {
        text(&mut head, path);
        attributes(&mut head, attrs);
    }
    let mut hasher = Sha256::new();
    hasher.update(head.finalize());
    for (key, value) in &demo.datasets {
        text(&mut hasher, key);
        hasher.update(array(value));
    }
    hasher.finalize().into()
}

/// The hash of a source in hexadecimal.
pub(super) fn content_hash(source: &Source) -> String {
    let demos: BTreeMap<String, Hash> = (0..source.plan().demos.len())
        .map(|index| (source.plan().demos[index].id.clone(), tree(&source.read_demo(index).unwrap())))
        .collect();
    let mut hasher = Sha256::new();
    hasher.update(tree(&source.root().unwrap()));
    for (id, hash) in &demos {
        text(&mut hasher, id);
        hasher.update(hash);
    }
    hasher.finalize().iter().map(|b| format!("{b:02x}")).collect()
}
