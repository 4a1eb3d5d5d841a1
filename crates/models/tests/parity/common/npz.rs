//! Reads numpy's compressed archives, which candle's reader does not.
#![allow(clippy::unwrap_used)]

use candle_core::{Device, Tensor};
use std::collections::BTreeMap;
use std::io::Read;
use std::path::Path;

fn u16_at(bytes: &[u8], at: usize) -> usize {
    usize::from(u16::from_le_bytes(bytes[at..at + 2].try_into().unwrap()))
}

fn u32_at(bytes: &[u8], at: usize) -> usize {
    u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize
}

/// All arrays of an archive: f32 as they are, f64 rounded to f32, bytes and booleans as numbers.
pub fn read(path: &Path) -> BTreeMap<String, Tensor> {
    arrays(path).into_iter().map(|(name, a)| (name, a.tensor())).collect()
}

/// One array.
#[derive(Debug)]
pub struct Array {
    /// its shape
    pub shape: Vec<usize>,
    /// its values, all kinds as f64
    pub values: Vec<f64>,
}

impl Array {
    fn tensor(&self) -> Tensor {
        let values: Vec<f32> = self.values.iter().map(|&x| x as f32).collect();
        Tensor::from_vec(values, self.shape.clone(), &Device::Cpu).unwrap()
    }
}

/// All arrays of an archive.
pub fn arrays(path: &Path) -> BTreeMap<String, Array> {
    let bytes = std::fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let end = bytes.windows(4).rposition(|w| w == b"PK\x05\x06").expect("the end of a zip archive");
    let (count, mut at) = (u16_at(&bytes, end + 10), u32_at(&bytes, end + 16));
    let mut found = BTreeMap::new();
    for _ in 0..count {
        assert_eq!(&bytes[at..at + 4], b"PK\x01\x02");
        let (method, packed) = (u16_at(&bytes, at + 10), u32_at(&bytes, at + 20));
        let (name_len, extra, comment) = (u16_at(&bytes, at + 28), u16_at(&bytes, at + 30), u16_at(&bytes, at + 32));
        let local = u32_at(&bytes, at + 42);
        let name = std::str::from_utf8(&bytes[at + 46..at + 46 + name_len]).unwrap();
        let from = local + 30 + u16_at(&bytes, local + 26) + u16_at(&bytes, local + 28);
        let data = &bytes[from..from + packed];
        let mut content = Vec::new();
        match method {
            0 => content.extend_from_slice(data),
            8 => {
                flate2::read::DeflateDecoder::new(data).read_to_end(&mut content).unwrap();
            }
            other => panic!("{}: {name} is packed by method {other}", path.display()),
        }
        found.insert(name.strip_suffix(".npy").unwrap().to_string(), array(&content));
        at += 46 + name_len + extra + comment;
    }
    found
}

fn array(content: &[u8]) -> Array {
    assert_eq!(&content[..8], b"\x93NUMPY\x01\x00", "version 1.0");
    let header = std::str::from_utf8(&content[10..10 + u16_at(content, 8)]).unwrap();
    let after = |key: &str| header.split_once(key).unwrap().1.trim_start();
    assert!(after("'fortran_order':").starts_with("False"), "{header}");
    let kind = after("'descr':").split('\'').nth(1).unwrap();
    let shape = after("'shape':").split(['(', ')']).nth(1).unwrap();
    let shape: Vec<usize> = shape.split(',').filter_map(|n| n.trim().parse().ok()).collect();
    let data = &content[10 + u16_at(content, 8)..];
    fn each<const N: usize>(data: &[u8], of: impl Fn([u8; N]) -> f64) -> Vec<f64> {
        data.chunks_exact(N).map(|c| of(c.try_into().unwrap())).collect()
    }
    let values = match kind {
        "<f4" => each(data, |c| f64::from(f32::from_le_bytes(c))),
        "<f8" => each(data, f64::from_le_bytes),
        "<i8" => each(data, |c| i64::from_le_bytes(c) as f64),
        "|u1" | "|b1" => each(data, |[c]| f64::from(c)),
        other => panic!("array of {other}"),
    };
    assert_eq!(values.len(), shape.iter().product::<usize>());
    Array { shape, values }
}
