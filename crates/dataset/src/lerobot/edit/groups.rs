//! Rows that come in pieces, put together into row groups.

use super::super::shards::{EncodedGroup, GroupEncoder, Place};
use super::super::work::{GROUP_BYTES, GROUP_FRAMES};
use crate::error::{DatasetError, Result};
use arrow_array::{Array, ArrayRef};
use arrow_select::concat::concat;
use std::collections::VecDeque;
use std::path::Path;

/// Rows that become row groups: small episodes together, a large one in pieces.
pub(super) struct Groups<'a> {
    root: &'a Path,
    encoder: &'a GroupEncoder,
    /// Bytes at which a group is closed.
    full: u64,
    pieces: Vec<Vec<ArrayRef>>,
    rows: usize,
    bytes: u64,
    /// Whether the group begins with an episode.
    begins: bool,
    /// Episodes that begin in it.
    started: usize,
    /// Bytes of a row, as far as rows were seen.
    row_bytes: u64,
    places: VecDeque<Place>,
    /// Where the last group is.
    last: Place,
}

/// Where a row group is appended.
pub(super) type Append<'f> = dyn FnMut(EncodedGroup, bool) -> Result<Place> + 'f;

impl<'a> Groups<'a> {
    pub(super) fn new(root: &'a Path, encoder: &'a GroupEncoder, file_bytes: u64) -> Self {
        Self {
            root,
            encoder,
            full: GROUP_BYTES.min(file_bytes),
            pieces: Vec::new(),
            rows: 0,
            bytes: 0,
            begins: false,
            started: 0,
            row_bytes: 0,
            places: VecDeque::new(),
            last: Place { folder: 0, file: 0 },
        }
    }

    /// The next rows begin an episode of this length.
    pub(super) fn begin(&mut self, length: usize, append: &mut Append<'_>) -> Result<()> {
        let expected = self.row_bytes * length as u64;
        if self.rows > 0 && (self.rows + length > GROUP_FRAMES || self.bytes + expected > self.full) {
            self.flush(append)?;
        }
        self.begins |= self.rows == 0;
        self.started += 1;
        Ok(())
    }

    /// Whether so many more rows are sure to fit, with numbers in them: they may come in any pieces.
    pub(super) fn holds(&self, rows: usize) -> bool {
        self.row_bytes > 0 && self.bytes + (self.row_bytes + 1) * rows as u64 <= GROUP_BYTES / 2
    }

    pub(super) fn push(&mut self, arrays: Vec<ArrayRef>, append: &mut Append<'_>) -> Result<()> {
        let rows = arrays.first().map_or(0, |a| a.len());
        let bytes: u64 = arrays.iter().map(|a| a.to_data().get_slice_memory_size().unwrap_or(0) as u64).sum();
        self.row_bytes = bytes / rows.max(1) as u64;
        self.rows += rows;
        self.bytes += bytes;
        self.pieces.push(arrays);
        // an episode that is larger than a group is cut
        if self.bytes >= GROUP_BYTES { self.flush(append) } else { Ok(()) }
    }

    fn flush(&mut self, append: &mut Append<'_>) -> Result<()> {
        if self.rows == 0 {
            return Ok(());
        }
        let failed = |source: parquet::errors::ParquetError| DatasetError::Parquet {
            path: self.root.to_path_buf(),
            operation: "encode a row group of it",
            source,
        };
        let mut arrays = Vec::with_capacity(self.pieces[0].len());
        for column in 0..self.pieces[0].len() {
            let pieces: Vec<&dyn Array> = self.pieces.iter().map(|piece| piece[column].as_ref()).collect();
            arrays.push(concat(&pieces).map_err(|e| failed(e.into()))?);
        }
        self.last = append(self.encoder.encode(&arrays).map_err(failed)?, self.begins)?;
        self.places.extend(std::iter::repeat_n(self.last, self.started));
        self.pieces.clear();
        (self.rows, self.bytes, self.begins, self.started) = (0, 0, false, 0);
        Ok(())
    }

    /// Where the next episode begins, once that is known.
    pub(super) fn next_place(&mut self) -> Option<Place> {
        self.places.pop_front()
    }

    /// Closes the last group. Episodes without frames that are in none are placed with the last that has some.
    pub(super) fn finish(&mut self, append: &mut Append<'_>) -> Result<()> {
        self.flush(append)?;
        self.places.extend(std::iter::repeat_n(self.last, std::mem::take(&mut self.started)));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::super::schema::writer_properties;
    use super::*;
    use arrow_array::Int64Array;
    use arrow_schema::{DataType, Field, Schema};
    use std::sync::Arc;

    #[test]
    fn episodes_without_frames_have_a_place_wherever_they_come() {
        let schema = Schema::new(vec![Field::new("x", DataType::Int64, false)]);
        let properties = writer_properties(&schema, Vec::new()).unwrap();
        let encoder = GroupEncoder::new(Arc::new(schema), properties).unwrap();
        let root = Path::new("set");
        // so small that each episode is a group of its own
        let mut groups = Groups::new(root, &encoder, 1);
        let mut file = 0..;
        let mut append = |_: EncodedGroup, _| Ok(Place { folder: 0, file: file.next().unwrap() });
        for length in [0, 3, 0, 2, 0, 0] {
            groups.begin(length, &mut append).unwrap();
            if length > 0 {
                let rows: ArrayRef = Arc::new(Int64Array::from(vec![7; length]));
                groups.push(vec![rows], &mut append).unwrap();
                groups.flush(&mut append).unwrap();
            }
        }
        groups.finish(&mut append).unwrap();
        let files: Vec<usize> = std::iter::from_fn(|| groups.next_place()).map(|place| place.file).collect();
        assert_eq!(files, [0, 0, 1, 1, 1, 1]);
    }
}
