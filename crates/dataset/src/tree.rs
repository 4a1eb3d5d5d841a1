//! A neutral copy of HDF5 content: what the reader returns, the side folder keeps and the writer takes.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use serde::{Deserialize, Serialize};

/// Element type of an [`Array`].
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub enum Dtype {
    /// Unsigned 8-bit integer.
    U8,
    /// Signed 8-bit integer.
    I8,
    /// Unsigned 16-bit integer.
    U16,
    /// Signed 16-bit integer.
    I16,
    /// Unsigned 32-bit integer.
    U32,
    /// Signed 32-bit integer.
    I32,
    /// Unsigned 64-bit integer.
    U64,
    /// Signed 64-bit integer.
    I64,
    /// IEEE 754 single precision.
    F32,
    /// IEEE 754 double precision.
    F64,
    /// One byte, 0 or 1; in HDF5 the FALSE/TRUE enumeration that h5py writes.
    Bool,
    /// Byte string of a fixed number of bytes, padded with zeros (numpy `S`).
    FixedStr(usize),
    /// UTF-8 string of a fixed number of bytes, padded with zeros.
    FixedUtf8(usize),
    /// UTF-8 string of any length: per element a little-endian `u32` byte count, then the bytes.
    VarStr,
    /// As [`Dtype::VarStr`], marked ASCII in the file.
    VarAscii,
    /// Bytes, any number of them an element (variable-length uint8); stored as [`Dtype::VarStr`] is.
    VarBytes,
    /// A type that cannot be carried, in words. Only plans hold it, never an [`Array`].
    Other(String),
}

impl Dtype {
    /// Bytes per element; `None` for strings of any length and for types that cannot be carried.
    pub fn size(&self) -> Option<usize> {
        match self {
            Self::U8 | Self::I8 | Self::Bool => Some(1),
            Self::U16 | Self::I16 => Some(2),
            Self::U32 | Self::I32 | Self::F32 => Some(4),
            Self::U64 | Self::I64 | Self::F64 => Some(8),
            Self::FixedStr(n) | Self::FixedUtf8(n) => Some(*n),
            Self::VarStr | Self::VarAscii | Self::VarBytes | Self::Other(_) => None,
        }
    }

    /// Whether elements are numbers or truth values.
    pub fn is_numeric(&self) -> bool {
        !matches!(
            self,
            Self::FixedStr(_) | Self::FixedUtf8(_) | Self::VarStr | Self::VarAscii | Self::VarBytes | Self::Other(_)
        )
    }
}

impl fmt::Display for Dtype {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::U8 => f.write_str("uint8"),
            Self::I8 => f.write_str("int8"),
            Self::U16 => f.write_str("uint16"),
            Self::I16 => f.write_str("int16"),
            Self::U32 => f.write_str("uint32"),
            Self::I32 => f.write_str("int32"),
            Self::U64 => f.write_str("uint64"),
            Self::I64 => f.write_str("int64"),
            Self::F32 => f.write_str("float32"),
            Self::F64 => f.write_str("float64"),
            Self::Bool => f.write_str("bool"),
            Self::FixedStr(n) => write!(f, "bytes[{n}]"),
            Self::FixedUtf8(n) => write!(f, "utf8[{n}]"),
            Self::VarStr => f.write_str("string"),
            Self::VarAscii => f.write_str("ascii string"),
            Self::VarBytes => f.write_str("uint8 of any length"),
            Self::Other(text) => f.write_str(text),
        }
    }
}

/// An n-dimensional array: little-endian, row-major. A scalar has an empty shape; an array without a
/// dataspace (h5py's `Empty`) has an empty shape and no bytes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Array {
    /// Element type.
    pub dtype: Dtype,
    /// Extent of each axis.
    pub shape: Vec<usize>,
    /// The elements.
    pub bytes: Vec<u8>,
}

macro_rules! numeric {
    ($($make:ident $t:ty => $variant:ident;)*) => {
        $(
            #[doc = concat!("An array of `", stringify!($t), "`; `shape` has to hold as many elements as `values`.")]
            pub fn $make(shape: Vec<usize>, values: &[$t]) -> Self {
                assert_eq!(shape.iter().product::<usize>(), values.len(), "shape and values agree");
                let mut bytes = Vec::with_capacity(std::mem::size_of_val(values));
                for value in values {
                    bytes.extend_from_slice(&value.to_le_bytes());
                }
                Self { dtype: Dtype::$variant, shape, bytes }
            }
        )*
    };
}

impl Array {
    numeric! {
        from_u8 u8 => U8;
        from_i32 i32 => I32;
        from_i64 i64 => I64;
        from_f32 f32 => F32;
        from_f64 f64 => F64;
    }

    /// A scalar string, as h5py stores Python's `str`.
    #[allow(clippy::should_implement_trait)] // nothing is parsed, nothing can fail
    pub fn from_str(text: &str) -> Self {
        Self::from_strings(Vec::new(), &[text])
    }

    /// Strings of any length; `shape` has to hold as many elements as `values`.
    pub fn from_strings<S: AsRef<str>>(shape: Vec<usize>, values: &[S]) -> Self {
        assert_eq!(shape.iter().product::<usize>(), values.len(), "shape and values agree");
        let mut bytes = Vec::new();
        for value in values {
            push_str(&mut bytes, value.as_ref().as_bytes());
        }
        Self { dtype: Dtype::VarStr, shape, bytes }
    }

    /// A 1-D array of byte strings as numpy's `S` type makes it: as wide as the longest, at least 1.
    pub fn from_fixed_strings<S: AsRef<str>>(values: &[S]) -> Self {
        let width = values.iter().map(|v| v.as_ref().len()).max().unwrap_or(0).max(1);
        let mut bytes = Vec::with_capacity(width * values.len());
        for value in values {
            bytes.extend_from_slice(value.as_ref().as_bytes());
            bytes.resize(bytes.len() + width - value.as_ref().len(), 0);
        }
        Self { dtype: Dtype::FixedStr(width), shape: vec![values.len()], bytes }
    }

    /// Number of elements.
    pub fn len(&self) -> usize {
        if self.is_null() { 0 } else { self.shape.iter().product() }
    }

    /// Whether there is no element.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Whether the array has no dataspace at all (h5py's `Empty`).
    pub fn is_null(&self) -> bool {
        self.shape.is_empty() && self.bytes.is_empty()
    }

    /// Length of the first axis; `None` for scalars.
    pub fn rows(&self) -> Option<usize> {
        self.shape.first().copied()
    }

    /// The elements as `f64`; `None` unless numeric. 64-bit integers beyond 2^53 are rounded.
    pub fn to_f64(&self) -> Option<Vec<f64>> {
        let b = &self.bytes;
        Some(match self.dtype {
            Dtype::U8 | Dtype::Bool => b.iter().map(|&v| f64::from(v)).collect(),
            Dtype::I8 => b.iter().map(|&v| f64::from(v as i8)).collect(),
            Dtype::U16 => chunks(b).map(|v| f64::from(u16::from_le_bytes(v))).collect(),
            Dtype::I16 => chunks(b).map(|v| f64::from(i16::from_le_bytes(v))).collect(),
            Dtype::U32 => chunks(b).map(|v| f64::from(u32::from_le_bytes(v))).collect(),
            Dtype::I32 => chunks(b).map(|v| f64::from(i32::from_le_bytes(v))).collect(),
            Dtype::U64 => chunks(b).map(|v| u64::from_le_bytes(v) as f64).collect(),
            Dtype::I64 => chunks(b).map(|v| i64::from_le_bytes(v) as f64).collect(),
            Dtype::F32 => chunks(b).map(|v| f64::from(f32::from_le_bytes(v))).collect(),
            Dtype::F64 => chunks(b).map(f64::from_le_bytes).collect(),
            _ => return None,
        })
    }

    /// The elements as `f32`; `None` unless numeric. Rounded to nearest, as numpy's `astype` does.
    pub fn to_f32(&self) -> Option<Vec<f32>> {
        let b = &self.bytes;
        Some(match self.dtype {
            Dtype::F32 => chunks(b).map(f32::from_le_bytes).collect(),
            Dtype::F64 => chunks(b).map(|v| f64::from_le_bytes(v) as f32).collect(),
            Dtype::I64 => chunks(b).map(|v| i64::from_le_bytes(v) as f32).collect(),
            Dtype::U64 => chunks(b).map(|v| u64::from_le_bytes(v) as f32).collect(),
            _ => self.to_f64()?.into_iter().map(|v| v as f32).collect(),
        })
    }

    /// Position of the first element that is NaN or infinite, or that becomes infinite as `f32` where `as_f32`; none of
    /// what is no float.
    pub fn first_not_finite(&self, as_f32: bool) -> Option<usize> {
        fn first<const N: usize>(bytes: &[u8], good: impl Fn([u8; N]) -> bool) -> Option<usize> {
            // without a branch for each element: nearly always all are good
            const BLOCK: usize = 4096;
            let (elements, _) = bytes.as_chunks::<N>();
            let blocks = elements.chunks(BLOCK).enumerate();
            let mut bad = blocks.filter(|(_, block)| !block.iter().fold(true, |all, &e| all & good(e)));
            let (block, elements) = bad.next()?;
            elements.iter().position(|&e| !good(e)).map(|at| block * BLOCK + at)
        }
        match self.dtype {
            Dtype::F32 => first(&self.bytes, |b| f32::from_le_bytes(b).is_finite()),
            Dtype::F64 if as_f32 => first(&self.bytes, |b| (f64::from_le_bytes(b) as f32).is_finite()),
            Dtype::F64 => first(&self.bytes, |b| f64::from_le_bytes(b).is_finite()),
            _ => None,
        }
    }

    /// The single integer of a scalar or one-element array; `None` for anything else.
    pub fn to_i64(&self) -> Option<i64> {
        if self.len() != 1 {
            return None;
        }
        let b = &self.bytes;
        Some(match self.dtype {
            Dtype::U8 | Dtype::Bool => i64::from(*b.first()?),
            Dtype::I8 => i64::from(*b.first()? as i8),
            Dtype::U16 => i64::from(u16::from_le_bytes(chunks(b).next()?)),
            Dtype::I16 => i64::from(i16::from_le_bytes(chunks(b).next()?)),
            Dtype::U32 => i64::from(u32::from_le_bytes(chunks(b).next()?)),
            Dtype::I32 => i64::from(i32::from_le_bytes(chunks(b).next()?)),
            Dtype::U64 => i64::try_from(u64::from_le_bytes(chunks(b).next()?)).ok()?,
            Dtype::I64 => i64::from_le_bytes(chunks(b).next()?),
            _ => return None,
        })
    }

    /// The elements as strings, zero padding removed; `None` unless they are strings in UTF-8.
    pub fn to_strings(&self) -> Option<Vec<String>> {
        if self.is_null() {
            return None;
        }
        let text = |b: &[u8]| String::from_utf8(b.to_vec()).ok();
        match self.dtype {
            Dtype::FixedStr(n) | Dtype::FixedUtf8(n) => self
                .bytes
                .chunks_exact(n.max(1))
                .map(|b| text(&b[..b.iter().rposition(|&c| c != 0).map_or(0, |last| last + 1)]))
                .collect(),
            Dtype::VarStr | Dtype::VarAscii => self.byte_rows()?.into_iter().map(text).collect(),
            _ => None,
        }
    }

    /// The bytes of each element of any length, or of each row of a table of bytes; `None` of anything else.
    pub(crate) fn byte_rows(&self) -> Option<Vec<&[u8]>> {
        match (&self.dtype, self.shape.as_slice()) {
            (Dtype::U8, &[_, width]) => Some(self.bytes.chunks_exact(width.max(1)).collect()),
            (Dtype::VarStr | Dtype::VarAscii | Dtype::VarBytes, _) => {
                let mut rest = self.bytes.as_slice();
                let mut out = Vec::new();
                while !rest.is_empty() {
                    let (count, tail) = rest.split_first_chunk::<4>()?;
                    let (one, tail) = tail.split_at_checked(u32::from_le_bytes(*count) as usize)?;
                    out.push(one);
                    rest = tail;
                }
                Some(out)
            }
            _ => None,
        }
    }

    /// The string of a scalar or one-element array; `None` for anything else.
    pub fn to_text(&self) -> Option<String> {
        let mut all = self.to_strings()?;
        if all.len() == 1 { all.pop() } else { None }
    }
}

/// Appends one string of any length in the encoding of [`Dtype::VarStr`].
pub(crate) fn push_str(bytes: &mut Vec<u8>, text: &[u8]) {
    let count = u32::try_from(text.len()).expect("a string of the file is below 4 GB");
    bytes.extend_from_slice(&count.to_le_bytes());
    bytes.extend_from_slice(text);
}

fn chunks<const N: usize>(bytes: &[u8]) -> impl Iterator<Item = [u8; N]> + '_ {
    bytes.as_chunks::<N>().0.iter().copied()
}

/// Attributes by name.
pub type Attrs = BTreeMap<String, Array>;

/// A demo, or everything in a file that belongs to no demo: datasets, attributes and empty groups by path.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Demo {
    /// `demo_12`; empty for the part of a file that belongs to no demo.
    pub id: String,
    /// Attributes of the demo's group itself (or of the file).
    pub attrs: Attrs,
    /// Datasets by path below the demo: `actions`, `obs/object`, `datagen_info/object_poses/cube`.
    pub datasets: BTreeMap<String, Array>,
    /// Groups below the demo that hold nothing, by path.
    pub groups: BTreeSet<String>,
    /// Attributes of datasets and groups below the demo, by path; only where there are any.
    pub inner_attrs: BTreeMap<String, Attrs>,
}
