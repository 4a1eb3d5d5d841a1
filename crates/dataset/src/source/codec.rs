//! Trees as bytes: how they cross from the reading process, and how a shard keeps them.

use crate::tree::{Array, Attrs, Demo, Dtype};

/// Appends a demo.
pub(crate) fn put_demo(out: &mut Vec<u8>, demo: &Demo) {
    put_text(out, &demo.id);
    put_attrs(out, &demo.attrs);
    put_attrs(out, &demo.datasets);
    put_count(out, demo.groups.len());
    for group in &demo.groups {
        put_text(out, group);
    }
    put_count(out, demo.inner_attrs.len());
    for (path, attrs) in &demo.inner_attrs {
        put_text(out, path);
        put_attrs(out, attrs);
    }
}

/// Appends an array.
pub(crate) fn put_array(out: &mut Vec<u8>, array: &Array) {
    let (code, width) = code_of(&array.dtype);
    out.push(code);
    put_count(out, width);
    put_count(out, array.shape.len());
    for &extent in &array.shape {
        put_count(out, extent);
    }
    put_bytes(out, &array.bytes);
}

fn put_attrs(out: &mut Vec<u8>, attrs: &Attrs) {
    put_count(out, attrs.len());
    for (name, value) in attrs {
        put_text(out, name);
        put_array(out, value);
    }
}

pub(crate) fn put_count(out: &mut Vec<u8>, count: usize) {
    out.extend_from_slice(&(count as u64).to_le_bytes());
}

/// Appends bytes after their count.
pub(crate) fn put_bytes(out: &mut Vec<u8>, bytes: &[u8]) {
    put_count(out, bytes.len());
    out.extend_from_slice(bytes);
}

pub(crate) fn put_text(out: &mut Vec<u8>, text: &str) {
    put_bytes(out, text.as_bytes());
}

/// A number for each type, and the width of fixed-length strings.
pub(crate) fn code_of(dtype: &Dtype) -> (u8, usize) {
    match dtype {
        Dtype::U8 => (0, 0),
        Dtype::I8 => (1, 0),
        Dtype::U16 => (2, 0),
        Dtype::I16 => (3, 0),
        Dtype::U32 => (4, 0),
        Dtype::I32 => (5, 0),
        Dtype::U64 => (6, 0),
        Dtype::I64 => (7, 0),
        Dtype::F32 => (8, 0),
        Dtype::F64 => (9, 0),
        Dtype::Bool => (10, 0),
        Dtype::FixedStr(n) => (11, *n),
        Dtype::FixedUtf8(n) => (12, *n),
        Dtype::VarStr => (13, 0),
        Dtype::VarAscii => (14, 0),
        Dtype::VarBytes => (15, 0),
        Dtype::Other(_) => (255, 0),
    }
}

fn dtype_of(code: u8, width: usize) -> Option<Dtype> {
    Some(match code {
        0 => Dtype::U8,
        1 => Dtype::I8,
        2 => Dtype::U16,
        3 => Dtype::I16,
        4 => Dtype::U32,
        5 => Dtype::I32,
        6 => Dtype::U64,
        7 => Dtype::I64,
        8 => Dtype::F32,
        9 => Dtype::F64,
        10 => Dtype::Bool,
        11 => Dtype::FixedStr(width),
        12 => Dtype::FixedUtf8(width),
        13 => Dtype::VarStr,
        14 => Dtype::VarAscii,
        15 => Dtype::VarBytes,
        _ => return None,
    })
}

/// Takes back what the `put_` functions wrote; `None` where the bytes are something else.
pub(crate) struct Taker<'a>(pub &'a [u8]);

impl<'a> Taker<'a> {
    pub fn demo(&mut self) -> Option<Demo> {
        let id = self.text()?;
        let attrs = self.attrs()?;
        let datasets = self.attrs()?;
        let groups = (0..self.count()?).map(|_| self.text()).collect::<Option<_>>()?;
        let inner_attrs = (0..self.count()?).map(|_| Some((self.text()?, self.attrs()?))).collect::<Option<_>>()?;
        Some(Demo { id, attrs, datasets, groups, inner_attrs })
    }

    pub fn array(&mut self) -> Option<Array> {
        let (&code, rest) = self.0.split_first()?;
        self.0 = rest;
        let width = self.count()?;
        let dtype = dtype_of(code, width)?;
        let shape: Vec<usize> = (0..self.count()?).map(|_| self.count()).collect::<Option<_>>()?;
        Some(Array { dtype, shape, bytes: self.bytes()?.to_vec() })
    }

    fn attrs(&mut self) -> Option<Attrs> {
        (0..self.count()?).map(|_| Some((self.text()?, self.array()?))).collect()
    }

    pub fn count(&mut self) -> Option<usize> {
        let (count, rest) = self.0.split_first_chunk::<8>()?;
        self.0 = rest;
        usize::try_from(u64::from_le_bytes(*count)).ok()
    }

    /// Bytes after their count.
    pub fn bytes(&mut self) -> Option<&'a [u8]> {
        let count = self.count()?;
        let (bytes, rest) = self.0.split_at_checked(count)?;
        self.0 = rest;
        Some(bytes)
    }

    pub fn text(&mut self) -> Option<String> {
        String::from_utf8(self.bytes()?.to_vec()).ok()
    }
}
