//! Cameras whose images a source keeps as JPEG files, as RoboTwin and newer ALOHA recordings do: a row of bytes a step filled
//! up with zeros, or bytes of any length. Their sizes are in the files alone.

use super::images;
use crate::error::Result;
use crate::plan::KeyPlan;
use crate::source::Source;
use crate::tree::Dtype;
use std::collections::{BTreeMap, BTreeSet};

/// Whether a dataset of a demo may hold files: bytes for each step.
pub(crate) fn may_hold_files(path: &str, key: &KeyPlan) -> bool {
    let bytes = match (&key.dtype, &key.shape[..]) {
        (Dtype::U8, &[rows, bytes]) => rows > 0 && bytes > 0,
        (Dtype::VarBytes, &[rows]) => rows > 0,
        _ => false,
    };
    bytes && path.starts_with("obs/")
}

/// Such datasets by path.
#[derive(Default)]
pub(crate) struct Files {
    /// Height and width of the pictures of those that become a camera.
    pub sizes: BTreeMap<String, (usize, usize)>,
    /// Why the JPEG files of others do not.
    pub others: BTreeMap<String, String>,
}

/// Looks at the first step of the first demo that has such a dataset. What begins with no JPEG file is left out.
pub(crate) fn sizes(source: &Source) -> Result<Files> {
    let (mut found, mut seen) = (Files::default(), BTreeSet::new());
    for (index, demo) in source.plan().demos.iter().enumerate() {
        for (path, _) in demo.keys.iter().filter(|(path, key)| may_hold_files(path, key)) {
            if !seen.insert(path.to_owned()) {
                continue;
            }
            let row = source.read_rows(index, path, 0, 1)?;
            let Some(file) = row.byte_rows().and_then(|rows| images::jpeg(rows.first()?)) else { continue };
            match images::jpeg_size(file) {
                Ok(size) => drop(found.sizes.insert(path.to_owned(), size)),
                Err(reason) => drop(found.others.insert(path.to_owned(), format!("its first step is {reason}"))),
            }
        }
    }
    Ok(found)
}
