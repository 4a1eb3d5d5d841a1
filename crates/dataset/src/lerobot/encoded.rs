//! Cameras whose images a source keeps as JPEG files, as RoboTwin and newer ALOHA recordings do: a row of bytes a step filled
//! up with zeros, or bytes of any length. Their sizes are in the files alone.

use super::images;
use crate::error::Result;
use crate::plan::KeyPlan;
use crate::source::Source;
use crate::tree::Dtype;
use std::collections::BTreeMap;

/// Whether a dataset of a demo may hold files: bytes for each step.
pub(crate) fn may_hold_files(path: &str, key: &KeyPlan) -> bool {
    let bytes = match (&key.dtype, &key.shape[..]) {
        (Dtype::U8, &[rows, bytes]) => rows > 0 && bytes > 0,
        (Dtype::VarBytes, &[rows]) => rows > 0,
        _ => false,
    };
    bytes && path.starts_with("obs/")
}

/// Height and width of the pictures of such datasets, by path: those of the first step of the first demo that has one. What begins with no
/// JPEG file is left out.
pub(crate) fn sizes(source: &Source) -> Result<BTreeMap<String, (usize, usize)>> {
    let mut found = BTreeMap::new();
    for (index, demo) in source.plan().demos.iter().enumerate() {
        for (path, _) in demo.keys.iter().filter(|(path, key)| may_hold_files(path, key)) {
            if !found.contains_key(path) {
                let row = source.read_rows(index, path, 0, 1)?;
                let file = row.byte_rows().and_then(|rows| images::jpeg(rows.first()?));
                let size = file.and_then(|file| images::jpeg_size(file).ok());
                found.insert(path.to_owned(), size);
            }
        }
    }
    Ok(found.into_iter().filter_map(|(path, size)| Some((path, size?))).collect())
}
