//! Cameras whose pictures a source keeps as JPEG files, a row of bytes a step filled up with zeros, as newer ALOHA
//! recordings do: their sizes stand in the files alone.

use super::images;
use crate::error::Result;
use crate::plan::KeyPlan;
use crate::source::Source;
use crate::tree::Dtype;
use std::collections::BTreeMap;

/// Where such datasets are.
const CAMERAS: &str = "obs/images/";

/// Whether a dataset of a demo may hold files: a row of bytes a step.
pub(crate) fn may_hold_files(path: &str, key: &KeyPlan) -> bool {
    path.starts_with(CAMERAS)
        && key.dtype == Dtype::U8
        && matches!(key.shape[..], [rows, bytes] if rows > 0 && bytes > 0)
}

/// Height and width of the pictures of such datasets, by path: those of the first step of the first demo that has one. What begins with no
/// JPEG file is left out.
pub(crate) fn sizes(source: &Source) -> Result<BTreeMap<String, (usize, usize)>> {
    let mut found = BTreeMap::new();
    for (index, demo) in source.plan().demos.iter().enumerate() {
        for (path, _) in demo.keys.iter().filter(|(path, key)| may_hold_files(path, key)) {
            if !found.contains_key(path) {
                let row = source.read_rows(index, path, 0, 1)?;
                let size = images::jpeg(&row.bytes).and_then(|file| images::jpeg_size(file).ok());
                found.insert(path.clone(), size);
            }
        }
    }
    Ok(found.into_iter().filter_map(|(path, size)| Some((path, size?))).collect())
}
