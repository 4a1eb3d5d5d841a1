//! Elements between HDF5 and [`Array`]: which types are carried, and how they are read and written.

use hdf5::types::{FloatSize, H5Type, IntSize, TypeDescriptor, VarLenArray, VarLenAscii, VarLenUnicode};
use hdf5::{Container, Hyperslab, Selection, SliceOrIndex};
use ndarray::IxDyn;

use super::field;
use crate::tree::{Array, Dtype, push_str};

/// Why elements could not be read or written, in words; the caller knows where.
pub(super) type ValueResult<T> = std::result::Result<T, String>;

/// The type that carries a file's type; [`Dtype::Other`] with a description if none does.
pub(super) fn dtype_of(descriptor: &TypeDescriptor) -> Dtype {
    match descriptor {
        TypeDescriptor::Integer(IntSize::U1) => Dtype::I8,
        TypeDescriptor::Integer(IntSize::U2) => Dtype::I16,
        TypeDescriptor::Integer(IntSize::U4) => Dtype::I32,
        TypeDescriptor::Integer(IntSize::U8) => Dtype::I64,
        TypeDescriptor::Unsigned(IntSize::U1) => Dtype::U8,
        TypeDescriptor::Unsigned(IntSize::U2) => Dtype::U16,
        TypeDescriptor::Unsigned(IntSize::U4) => Dtype::U32,
        TypeDescriptor::Unsigned(IntSize::U8) => Dtype::U64,
        TypeDescriptor::Float(FloatSize::U4) => Dtype::F32,
        TypeDescriptor::Float(FloatSize::U8) => Dtype::F64,
        TypeDescriptor::Boolean => Dtype::Bool,
        TypeDescriptor::FixedAscii(n) if *n <= MAX_FIXED => Dtype::FixedStr(*n),
        TypeDescriptor::FixedUnicode(n) if *n <= MAX_FIXED => Dtype::FixedUtf8(*n),
        TypeDescriptor::VarLenAscii => Dtype::VarAscii,
        TypeDescriptor::VarLenUnicode => Dtype::VarStr,
        TypeDescriptor::VarLenArray(of) if **of == TypeDescriptor::Unsigned(IntSize::U1) => Dtype::VarBytes,
        other => Dtype::Other(one_line(&other.to_string())),
    }
}

/// The file's type for a type that is carried.
pub(super) fn descriptor_of(dtype: &Dtype) -> ValueResult<TypeDescriptor> {
    Ok(match dtype {
        Dtype::I8 => TypeDescriptor::Integer(IntSize::U1),
        Dtype::I16 => TypeDescriptor::Integer(IntSize::U2),
        Dtype::I32 => TypeDescriptor::Integer(IntSize::U4),
        Dtype::I64 => TypeDescriptor::Integer(IntSize::U8),
        Dtype::U8 => TypeDescriptor::Unsigned(IntSize::U1),
        Dtype::U16 => TypeDescriptor::Unsigned(IntSize::U2),
        Dtype::U32 => TypeDescriptor::Unsigned(IntSize::U4),
        Dtype::U64 => TypeDescriptor::Unsigned(IntSize::U8),
        Dtype::F32 => TypeDescriptor::Float(FloatSize::U4),
        Dtype::F64 => TypeDescriptor::Float(FloatSize::U8),
        Dtype::Bool => TypeDescriptor::Boolean,
        Dtype::FixedStr(n) => TypeDescriptor::FixedAscii(*n),
        Dtype::FixedUtf8(n) => TypeDescriptor::FixedUnicode(*n),
        Dtype::VarAscii => TypeDescriptor::VarLenAscii,
        Dtype::VarStr => TypeDescriptor::VarLenUnicode,
        Dtype::VarBytes => TypeDescriptor::VarLenArray(Box::new(TypeDescriptor::Unsigned(IntSize::U1))),
        Dtype::Other(text) => return Err(format!("elements of type {text}")),
    })
}

/// Widest fixed-length string that libhdf5 is asked for, in bytes.
pub(super) const MAX_FIXED: usize = 8 << 20;

/// Which part of a dataset to read: everything, or rows.
#[derive(Clone, Copy)]
pub(super) enum Part<'a> {
    All,
    Rows { first: usize, count: usize, shape: &'a [usize] },
}

pub(super) fn elements<T: H5Type>(from: &Container, part: Part<'_>) -> ValueResult<Vec<T>> {
    let words = |e: hdf5::Error| reason(&e);
    match part {
        Part::All => from.read_raw::<T>().map_err(words),
        Part::Rows { first, count, shape } => {
            if count == 0 || shape.contains(&0) {
                return Ok(Vec::new());
            }
            let mut slices: Vec<SliceOrIndex> = vec![(first..first + count).into()];
            slices.extend(shape[1..].iter().map(|&extent| SliceOrIndex::from(0..extent)));
            let selection = Selection::from(Hyperslab::from(slices));
            let array = from.read_slice::<T, _, IxDyn>(selection).map_err(words)?;
            let (values, offset) = array.into_raw_vec_and_offset();
            match offset {
                None | Some(0) => Ok(values),
                Some(n) => Err(format!("elements start at {n} in memory")),
            }
        }
    }
}

/// Reads the elements as [`Array`] keeps them.
pub(super) fn read(from: &Container, dtype: &Dtype, part: Part<'_>) -> ValueResult<Vec<u8>> {
    macro_rules! numbers {
        ($t:ty) => {{
            let values = elements::<$t>(from, part)?;
            let mut bytes = Vec::with_capacity(std::mem::size_of_val(values.as_slice()));
            for value in values {
                bytes.extend_from_slice(&value.to_le_bytes());
            }
            bytes
        }};
    }
    Ok(match dtype {
        Dtype::U8 => elements::<u8>(from, part)?,
        Dtype::I8 => numbers!(i8),
        Dtype::U16 => numbers!(u16),
        Dtype::I16 => numbers!(i16),
        Dtype::U32 => numbers!(u32),
        Dtype::I32 => numbers!(i32),
        Dtype::U64 => numbers!(u64),
        Dtype::I64 => numbers!(i64),
        Dtype::F32 => numbers!(f32),
        Dtype::F64 => numbers!(f64),
        Dtype::Bool => {
            // as its integer: a damaged file may hold bytes that are no truth value
            let values = elements::<u8>(from, part)?;
            if let Some(bad) = values.iter().find(|&&v| v > 1) {
                return Err(format!("a truth value of {bad}"));
            }
            values
        }
        Dtype::FixedStr(n) | Dtype::FixedUtf8(n) => field::read(from, part, *n, matches!(dtype, Dtype::FixedUtf8(_)))?,
        Dtype::VarAscii => {
            let mut bytes = Vec::new();
            for value in elements::<VarLenAscii>(from, part)? {
                push_str(&mut bytes, value.as_bytes());
            }
            bytes
        }
        Dtype::VarStr => {
            let mut bytes = Vec::new();
            for value in elements::<VarLenUnicode>(from, part)? {
                std::str::from_utf8(value.as_bytes()).map_err(|e| format!("a string that is not UTF-8: {e}"))?;
                push_str(&mut bytes, value.as_bytes());
            }
            bytes
        }
        Dtype::VarBytes => {
            let mut bytes = Vec::new();
            for value in elements::<VarLenArray<u8>>(from, part)? {
                push_str(&mut bytes, &value);
            }
            bytes
        }
        Dtype::Other(text) => return Err(format!("elements of type {text} are not supported")),
    })
}

pub(super) fn put<T: H5Type>(to: &Container, values: &[T]) -> ValueResult<()> {
    to.write_raw(values).map_err(|e| reason(&e))
}

/// Checks that shape, type and bytes of an array agree.
pub(super) fn check(array: &Array) -> ValueResult<()> {
    descriptor_of(&array.dtype)?;
    if array.is_null() {
        return Ok(());
    }
    let count: usize = array.shape.iter().product();
    let (expected, found) = match array.dtype.size() {
        Some(0) => return Err("strings of no bytes".to_owned()),
        Some(size) => (count * size, array.bytes.len()),
        None if array.dtype != Dtype::VarStr => (count, array.byte_rows().ok_or("bytes that are cut off")?.len()),
        None => (count, array.to_strings().ok_or("strings that are cut off or not UTF-8")?.len()),
    };
    if expected == found {
        Ok(())
    } else {
        Err(format!("shape {:?} of {} needs {expected}, found {found}", array.shape, array.dtype))
    }
}

/// Writes the elements into an object of the array's own type and shape.
pub(super) fn write(to: &Container, array: &Array) -> ValueResult<()> {
    macro_rules! numbers {
        ($t:ty) => {{
            let (chunks, _) = array.bytes.as_chunks();
            let values: Vec<$t> = chunks.iter().map(|b| <$t>::from_le_bytes(*b)).collect();
            put(to, &values)
        }};
    }
    if array.is_null() || array.is_empty() {
        return Ok(());
    }
    match &array.dtype {
        Dtype::U8 => put(to, &array.bytes),
        Dtype::I8 => numbers!(i8),
        Dtype::U16 => numbers!(u16),
        Dtype::I16 => numbers!(i16),
        Dtype::U32 => numbers!(u32),
        Dtype::I32 => numbers!(i32),
        Dtype::U64 => numbers!(u64),
        Dtype::I64 => numbers!(i64),
        Dtype::F32 => numbers!(f32),
        Dtype::F64 => numbers!(f64),
        Dtype::Bool => {
            let values: Vec<bool> = array.bytes.iter().map(|&b| b != 0).collect();
            put(to, &values)
        }
        Dtype::FixedStr(n) | Dtype::FixedUtf8(n) => {
            field::write(to, &array.bytes, *n, matches!(array.dtype, Dtype::FixedUtf8(_)))
        }
        Dtype::VarAscii => {
            let rows = array.byte_rows().ok_or("strings that are cut off")?;
            put(to, &rows.into_iter().map(field::ascii).collect::<ValueResult<Vec<_>>>()?)
        }
        Dtype::VarStr => {
            let values: Vec<VarLenUnicode> = array
                .to_strings()
                .ok_or("strings that are not UTF-8")?
                .iter()
                .map(|s| s.parse().map_err(|e| format!("not a string of HDF5: {e}")))
                .collect::<ValueResult<_>>()?;
            put(to, &values)
        }
        Dtype::VarBytes => {
            let rows = array.byte_rows().ok_or("bytes that are cut off")?;
            put(to, &rows.into_iter().map(VarLenArray::from_slice).collect::<Vec<_>>())
        }
        Dtype::Other(text) => Err(format!("elements of type {text}")),
    }
}

/// An HDF5 error in a line: the deepest message says what happened, the rest is the way up.
pub(super) fn reason(error: &hdf5::Error) -> String {
    let text = error.to_string();
    one_line(&text.lines().map(str::trim).filter(|l| !l.is_empty()).collect::<Vec<_>>().join("; "))
}

/// Text of a file, fit for a message: what would end the line or command the terminal is written out.
pub(super) fn one_line(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        if c.is_control() { out.extend(c.escape_default()) } else { out.push(c) }
    }
    out
}
