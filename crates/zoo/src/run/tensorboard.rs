//! TensorBoard event files: TFRecord frames around `Event` messages, written by hand because it is small.
//!
//! Formats: TensorFlow's `record_writer.cc` (length, masked CRC32C of the length, data, masked CRC32C of
//! the data) and `event.proto` (`wall_time` = 1, `step` = 2, `file_version` = 3, `summary` = 5 with
//! `value` = 1 of `tag` = 1 and `simple_value` = 2).

use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

use crate::ZooError;

use super::metrics::MetricsRow;

/// Appends scalars to one event file.
#[derive(Debug)]
pub struct EventWriter {
    path: PathBuf,
    file: File,
}

impl EventWriter {
    /// Writes a new file at `path` with `rows` in it; `wall_time` is in seconds since 1970.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn create(path: &Path, rows: &[MetricsRow], wall_time: f64) -> Result<Self, ZooError> {
        let mut event = Vec::new();
        double(&mut event, 1, wall_time);
        bytes(&mut event, 3, b"brain.Event:2");
        let mut content = record(&event);
        for row in rows {
            content.extend(record(&scalars(row, wall_time)));
        }
        crate::write_atomic(path, &content)?;
        let file = OpenOptions::new().append(true).open(path).map_err(ZooError::io("open", path))?;
        Ok(Self { path: path.to_owned(), file })
    }

    /// Appends one row.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn push(&mut self, row: &MetricsRow, wall_time: f64) -> Result<(), ZooError> {
        self.file.write_all(&record(&scalars(row, wall_time))).map_err(ZooError::io("write", &self.path))
    }
}

fn scalars(row: &MetricsRow, wall_time: f64) -> Vec<u8> {
    let mut summary = Vec::new();
    for (name, value) in &row.values {
        let mut item = Vec::new();
        bytes(&mut item, 1, name.as_bytes());
        varint(&mut item, (2 << 3) | 5);
        item.extend((*value as f32).to_le_bytes());
        bytes(&mut summary, 1, &item);
    }
    let mut event = Vec::new();
    double(&mut event, 1, wall_time);
    varint(&mut event, 2 << 3);
    varint(&mut event, row.step);
    bytes(&mut event, 5, &summary);
    event
}

fn record(data: &[u8]) -> Vec<u8> {
    let length = (data.len() as u64).to_le_bytes();
    let mut out = Vec::with_capacity(data.len() + 16);
    out.extend(length);
    out.extend(masked(crc32c(&length)).to_le_bytes());
    out.extend(data);
    out.extend(masked(crc32c(data)).to_le_bytes());
    out
}

fn masked(crc: u32) -> u32 {
    crc.rotate_right(15).wrapping_add(0xa282_ead8)
}

/// CRC-32C (Castagnoli), bit by bit: a few hundred bytes a step.
fn crc32c(data: &[u8]) -> u32 {
    !data.iter().fold(!0_u32, |crc, byte| {
        (0..8).fold(crc ^ u32::from(*byte), |crc, _| (crc >> 1) ^ (0x82f6_3b78 & (crc & 1).wrapping_neg()))
    })
}

fn varint(out: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        out.push((value & 0x7f) as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

fn bytes(out: &mut Vec<u8>, field: u64, content: &[u8]) {
    varint(out, (field << 3) | 2);
    varint(out, content.len() as u64);
    out.extend(content);
}

fn double(out: &mut Vec<u8>, field: u64, value: f64) {
    varint(out, (field << 3) | 1);
    out.extend(value.to_le_bytes());
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn crc_agrees_with_rfc_3720() {
        // RFC 3720, B.4: 32 bytes of zeroes, and the check value of "123456789"
        assert_eq!(crc32c(&[0; 32]), 0x8a91_36aa);
        assert_eq!(crc32c(b"123456789"), 0xe306_9283);
    }

    #[test]
    fn records_frame_the_messages() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("events.out.tfevents.1.actrm");
        let row = |step| MetricsRow { step, values: [("loss".to_owned(), 0.5)].into() };
        let mut writer = EventWriter::create(&path, &[row(1)], 1.5).unwrap();
        writer.push(&row(300), 2.5).unwrap();
        let content = std::fs::read(&path).unwrap();
        let (mut rest, mut records) = (&content[..], Vec::new());
        while !rest.is_empty() {
            let length = u64::from_le_bytes(rest[..8].try_into().unwrap()) as usize;
            assert_eq!(rest[8..12], masked(crc32c(&rest[..8])).to_le_bytes());
            let data = &rest[12..12 + length];
            assert_eq!(rest[12 + length..16 + length], masked(crc32c(data)).to_le_bytes());
            records.push(data.to_vec());
            rest = &rest[16 + length..];
        }
        assert_eq!(records.len(), 3);
        assert!(records[0].ends_with(b"brain.Event:2"));
        // wall_time 2.5, step 300 (two varint bytes), summary { value { tag "loss" simple_value 0.5 } }
        let mut expected = vec![0x09, 0, 0, 0, 0, 0, 0, 0x04, 0x40, 0x10, 0xac, 0x02, 0x2a, 13, 0x0a, 11];
        expected.extend([0x0a, 4, b'l', b'o', b's', b's', 0x15, 0, 0, 0, 0x3f]);
        assert_eq!(records[2], expected);
    }
}
