//! MessagePack with NumPy arrays, as openpi writes them.
//!
//! An array is a map with the byte-string keys `__ndarray__`, `data`, `dtype` and `shape`, a NumPy scalar one with
//! `__npgeneric__`, `data` and `dtype`. Nothing is executed and nothing is allocated for a length that a message only
//! claims: texts, bytes and arrays stay where they are in the message.

use std::borrow::Cow;
use std::collections::BTreeSet;
use std::fmt;

use half::f16;
use rmp::Marker;

use crate::error::{Result, ServingError};

/// How deep lists and maps may lie in each other.
const MOST_DEPTH: usize = 16;
/// Values of a message, elements of its arrays not counted.
const MOST_VALUES: usize = 1 << 16;
/// Dimensions of an array, as in NumPy.
const MOST_DIMENSIONS: usize = 32;

/// A value of a message.
#[derive(Debug, Clone, PartialEq)]
pub enum Value<'a> {
    /// `None`
    Nil,
    /// `True` or `False`
    Bool(bool),
    /// from `i64::MIN` to `u64::MAX`
    Integer(i128),
    /// a number
    Float(f64),
    /// a text
    Text(Cow<'a, str>),
    /// bytes
    Bytes(Cow<'a, [u8]>),
    /// values in order
    List(Vec<Value<'a>>),
    /// values by key, in order
    Map(Vec<(Cow<'a, str>, Value<'a>)>),
    /// a NumPy array
    Array(Array<'a>),
}

/// What the elements of an array are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// one byte, 0 or not
    Bool,
    /// two's complement
    Signed,
    /// whole numbers from 0 on
    Unsigned,
    /// IEEE 754
    Float,
}

/// A type of NumPy's.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Dtype {
    kind: Kind,
    bytes: usize,
    big_endian: bool,
}

impl Dtype {
    /// `float32`, little-endian.
    pub const F32: Self = Self { kind: Kind::Float, bytes: 4, big_endian: false };
    /// `uint8`.
    pub const U8: Self = Self { kind: Kind::Unsigned, bytes: 1, big_endian: false };
    const F64: Self = Self { kind: Kind::Float, bytes: 8, big_endian: false };

    /// The type that NumPy writes so (`<f4`, `|u1`).
    fn parse(text: &str) -> Option<Self> {
        let (order, rest) = match text.as_bytes().first()? {
            b'<' | b'>' | b'|' | b'=' => text.split_at(1),
            _ => ("<", text),
        };
        let kind = match rest.as_bytes().first()? {
            b'b' => Kind::Bool,
            b'i' => Kind::Signed,
            b'u' => Kind::Unsigned,
            b'f' => Kind::Float,
            _ => return None,
        };
        let bytes = match (kind, rest.get(1..)?) {
            (_, "1") if kind != Kind::Float => 1,
            (Kind::Signed | Kind::Unsigned | Kind::Float, "2") => 2,
            (Kind::Signed | Kind::Unsigned | Kind::Float, "4") => 4,
            (Kind::Signed | Kind::Unsigned | Kind::Float, "8") => 8,
            _ => return None,
        };
        Some(Self { kind, bytes, big_endian: order == ">" && bytes > 1 })
    }

    fn text(self) -> String {
        let order = match (self.bytes, self.big_endian) {
            (1, _) => '|',
            (_, true) => '>',
            (_, false) => '<',
        };
        let kind = match self.kind {
            Kind::Bool => 'b',
            Kind::Signed => 'i',
            Kind::Unsigned => 'u',
            Kind::Float => 'f',
        };
        format!("{order}{kind}{}", self.bytes)
    }
}

impl fmt::Display for Dtype {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let bits = 8 * self.bytes;
        match self.kind {
            Kind::Bool => f.write_str("bool"),
            Kind::Signed => write!(f, "int{bits}"),
            Kind::Unsigned => write!(f, "uint{bits}"),
            Kind::Float => write!(f, "float{bits}"),
        }
    }
}

/// An array in C order whose data has the length that its shape says.
#[derive(Debug, Clone, PartialEq)]
pub struct Array<'a> {
    dtype: Dtype,
    shape: Vec<usize>,
    data: Cow<'a, [u8]>,
}

impl<'a> Array<'a> {
    /// # Errors
    /// Data of another length than the shape says; more than 32 dimensions.
    pub fn new(dtype: Dtype, shape: Vec<usize>, data: impl Into<Cow<'a, [u8]>>) -> Result<Self> {
        let data = data.into();
        let bytes = shape.iter().try_fold(dtype.bytes, |bytes, extent| bytes.checked_mul(*extent));
        if shape.len() > MOST_DIMENSIONS || bytes != Some(data.len()) {
            let expected = format!("the data of {dtype} {shape:?}");
            return Err(ServingError::message("data", expected, format!("{} bytes", data.len())));
        }
        Ok(Self { dtype, shape, data })
    }

    /// `float32` of this shape.
    ///
    /// # Errors
    /// As [`Array::new`].
    pub fn of_f32(shape: Vec<usize>, values: &[f32]) -> Result<Array<'static>> {
        let data: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        Array::new(Dtype::F32, shape, data)
    }

    /// Extent of each dimension.
    pub fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// What its elements are.
    pub fn dtype(&self) -> Dtype {
        self.dtype
    }

    /// Its elements as bytes, as they were sent.
    pub fn data(&self) -> &[u8] {
        &self.data
    }

    /// The elements; what `float32` cannot hold becomes infinite, as in NumPy.
    pub fn numbers(&self) -> Vec<f32> {
        macro_rules! read {
            ($type:ty, $convert:expr) => {{
                let value = |bytes: &[u8]| {
                    let mut own = [0; size_of::<$type>()];
                    own.copy_from_slice(bytes);
                    if self.dtype.big_endian { <$type>::from_be_bytes(own) } else { <$type>::from_le_bytes(own) }
                };
                self.data.chunks_exact(size_of::<$type>()).map(|bytes| $convert(value(bytes))).collect()
            }};
        }
        match (self.dtype.kind, self.dtype.bytes) {
            (Kind::Bool, _) => self.data.iter().map(|byte| f32::from(u8::from(*byte != 0))).collect(),
            (Kind::Unsigned, 1) => self.data.iter().map(|byte| f32::from(*byte)).collect(),
            (Kind::Unsigned, 2) => read!(u16, f32::from),
            (Kind::Unsigned, 4) => read!(u32, |x| x as f32),
            (Kind::Unsigned, _) => read!(u64, |x| x as f32),
            (Kind::Signed, 1) => read!(i8, f32::from),
            (Kind::Signed, 2) => read!(i16, f32::from),
            (Kind::Signed, 4) => read!(i32, |x| x as f32),
            (Kind::Signed, _) => read!(i64, |x| x as f32),
            (Kind::Float, 2) => read!(f16, |x: f16| x.to_f32()),
            (Kind::Float, 4) => read!(f32, |x| x),
            (Kind::Float, _) => read!(f64, |x| x as f32),
        }
    }

    /// The pixels of an image: `uint8` as it is, floats from 0 to 1 as bytes. The second is the type and range that was
    /// found where it is neither.
    ///
    /// # Errors
    /// What was found instead.
    pub fn pixels(&self) -> std::result::Result<Vec<u8>, String> {
        /// How far beyond 0 to 1 rounding may lead.
        const BEYOND: f32 = 1e-3;
        match (self.dtype.kind, self.dtype.bytes) {
            (Kind::Unsigned, 1) => Ok(self.data.to_vec()),
            (Kind::Float, bytes) => {
                let numbers = self.numbers();
                if let Some(other) = numbers.iter().find(|x| !(-BEYOND..=1.0 + BEYOND).contains(*x)) {
                    return Err(format!("{} with {other}", self.dtype));
                }
                // float16 is scaled in its own precision, as NumPy does
                let scaled = |x: f32| match bytes {
                    2 => f16::from_f32(255.0 * x).to_f32(),
                    _ => 255.0 * x,
                };
                Ok(numbers.iter().map(|x| scaled(x.clamp(0.0, 1.0)).round_ties_even() as u8).collect())
            }
            _ => Err(self.dtype.to_string()),
        }
    }
}

impl<'a> Value<'a> {
    /// A text.
    pub fn text(text: impl Into<Cow<'a, str>>) -> Self {
        Self::Text(text.into())
    }

    /// A map of these.
    pub fn map<K: Into<Cow<'a, str>>>(pairs: impl IntoIterator<Item = (K, Value<'a>)>) -> Self {
        Self::Map(pairs.into_iter().map(|(key, value)| (key.into(), value)).collect())
    }

    /// What a map has under this key.
    pub fn get(&self, key: &str) -> Option<&Value<'a>> {
        match self {
            Self::Map(pairs) => pairs.iter().find(|(name, _)| name == key).map(|(_, value)| value),
            _ => None,
        }
    }

    /// A count: an integer from 0 on.
    pub fn count(&self) -> Option<u64> {
        match self {
            Self::Integer(number) => u64::try_from(*number).ok(),
            _ => None,
        }
    }

    /// An array, or what NumPy would make one of: a number, a list of numbers, a list of such lists of one length.
    pub fn to_array(&self) -> Option<Cow<'_, Array<'a>>> {
        if let Self::Array(array) = self {
            return Some(Cow::Borrowed(array));
        }
        let (mut shape, mut numbers) = (Vec::new(), Vec::new());
        self.flatten(0, &mut shape, &mut numbers)?;
        let data: Vec<u8> = numbers.iter().flat_map(|number| number.to_le_bytes()).collect();
        Array::new(Dtype::F64, shape, data).ok().map(Cow::Owned)
    }

    fn flatten(&self, depth: usize, shape: &mut Vec<usize>, numbers: &mut Vec<f64>) -> Option<()> {
        let number = match self {
            Self::List(values) => {
                match shape.get(depth) {
                    // a list where a number was before
                    None if !numbers.is_empty() => return None,
                    None => shape.push(values.len()),
                    Some(extent) if *extent != values.len() => return None,
                    Some(_) => {}
                }
                return values.iter().try_for_each(|value| value.flatten(depth + 1, shape, numbers));
            }
            Self::Bool(yes) => f64::from(u8::from(*yes)),
            Self::Integer(number) => *number as f64,
            Self::Float(number) => *number,
            _ => return None,
        };
        (depth == shape.len()).then(|| numbers.push(number))
    }
}

/// What it is, for a message.
impl fmt::Display for Value<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Nil => f.write_str("nothing"),
            Self::Bool(yes) => write!(f, "{yes}"),
            Self::Integer(number) => write!(f, "{number}"),
            Self::Float(number) => write!(f, "{number}"),
            Self::Text(_) => f.write_str("a text"),
            Self::Bytes(bytes) => write!(f, "{} bytes", bytes.len()),
            Self::List(values) => write!(f, "a list of {}", values.len()),
            Self::Map(pairs) => {
                let names: Vec<String> = pairs.iter().take(8).map(|(key, _)| shown(key)).collect();
                write!(f, "a map of {}", if names.is_empty() { "nothing".to_owned() } else { names.join(", ") })
            }
            Self::Array(array) => write!(f, "{} {:?}", array.dtype, array.shape),
        }
    }
}

/// A key of somebody else's message, short and on one line.
pub(crate) fn shown(key: &str) -> String {
    key.chars().take(80).map(|c| if c.is_control() { '?' } else { c }).collect()
}

/// Reads a message.
///
/// # Errors
/// What is no MessagePack, ends too early or goes on after its end; more than 65,536 values or 16 levels; an array whose
/// data is not as long as its shape says, or whose type is not bool, integer or float. The key is named.
pub fn decode(message: &[u8]) -> Result<Value<'_>> {
    let mut reader = Reader { rest: message, values: 0 };
    let value = reader.value(0)?;
    match reader.rest.len() {
        0 => Ok(value),
        more => Err(malformed("its end", format!("{more} more bytes"))),
    }
}

fn malformed(expected: impl Into<String>, found: impl Into<String>) -> ServingError {
    ServingError::message(MESSAGE, expected, found)
}

/// What an error is about where no key is known.
const MESSAGE: &str = "message";

/// The error with the key that it was found under.
fn within(key: &str) -> impl FnOnce(ServingError) -> ServingError + '_ {
    move |error| match error {
        ServingError::Message { key: inner, expected, found } => {
            let key = if inner == MESSAGE { shown(key) } else { format!("{}: {inner}", shown(key)) };
            ServingError::Message { key, expected, found }
        }
        other => other,
    }
}

struct Reader<'a> {
    rest: &'a [u8],
    values: usize,
}

impl<'a> Reader<'a> {
    fn take(&mut self, bytes: usize) -> Result<&'a [u8]> {
        let (taken, rest) = self
            .rest
            .split_at_checked(bytes)
            .ok_or_else(|| malformed(format!("{bytes} more bytes"), format!("{}", self.rest.len())))?;
        self.rest = rest;
        Ok(taken)
    }

    fn fixed<const N: usize>(&mut self) -> Result<[u8; N]> {
        let mut bytes = [0; N];
        bytes.copy_from_slice(self.take(N)?);
        Ok(bytes)
    }

    /// A length of 1, 2 or 4 bytes.
    fn length(&mut self, bytes: usize) -> Result<usize> {
        let taken = self.take(bytes)?;
        Ok(taken.iter().fold(0, |length, byte| length << 8 | usize::from(*byte)))
    }

    fn text(&mut self, bytes: usize) -> Result<Cow<'a, str>> {
        let bytes = self.take(bytes)?;
        let text = std::str::from_utf8(bytes);
        text.map(Cow::Borrowed).map_err(|error| malformed("text in UTF-8", error.to_string()))
    }

    /// Room for so many elements: each takes a byte at least.
    fn elements(&mut self, count: usize) -> Result<usize> {
        self.values = self.values.saturating_add(count);
        if self.values > MOST_VALUES {
            return Err(malformed(format!("at most {MOST_VALUES} values; send arrays as arrays"), "more"));
        }
        match count > self.rest.len() {
            true => Err(malformed(format!("{count} values"), format!("{} bytes", self.rest.len()))),
            false => Ok(count),
        }
    }

    fn list(&mut self, count: usize, depth: usize) -> Result<Value<'a>> {
        let count = self.elements(count)?;
        Ok(Value::List((0..count).map(|_| self.value(depth)).collect::<Result<_>>()?))
    }

    fn map(&mut self, count: usize, depth: usize) -> Result<Value<'a>> {
        let count = self.elements(count.saturating_mul(2))? / 2;
        let mut pairs: Vec<(Cow<'a, str>, Value<'a>)> = Vec::with_capacity(count);
        for _ in 0..count {
            let key = match self.value(depth)? {
                Value::Text(text) => text,
                Value::Bytes(Cow::Borrowed(bytes)) => Cow::Borrowed(
                    std::str::from_utf8(bytes).map_err(|error| malformed("a key in UTF-8", error.to_string()))?,
                ),
                other => return Err(malformed("a text as key", other.to_string())),
            };
            let value = self.value(depth).map_err(within(&key))?;
            pairs.push((key, value));
        }
        let mut seen = BTreeSet::new();
        if let Some((twice, _)) = pairs.iter().find(|(key, _)| !seen.insert(key.as_ref())) {
            return Err(malformed("each key once", format!("{} twice", shown(twice))));
        }
        special(pairs)
    }

    fn value(&mut self, depth: usize) -> Result<Value<'a>> {
        if depth > MOST_DEPTH {
            return Err(malformed(format!("at most {MOST_DEPTH} lists and maps in each other"), "more"));
        }
        let deeper = depth + 1;
        Ok(match Marker::from_u8(self.fixed::<1>()?[0]) {
            Marker::Null => Value::Nil,
            Marker::True => Value::Bool(true),
            Marker::False => Value::Bool(false),
            Marker::FixPos(number) => Value::Integer(number.into()),
            Marker::FixNeg(number) => Value::Integer(number.into()),
            Marker::U8 => Value::Integer(u8::from_be_bytes(self.fixed()?).into()),
            Marker::U16 => Value::Integer(u16::from_be_bytes(self.fixed()?).into()),
            Marker::U32 => Value::Integer(u32::from_be_bytes(self.fixed()?).into()),
            Marker::U64 => Value::Integer(u64::from_be_bytes(self.fixed()?).into()),
            Marker::I8 => Value::Integer(i8::from_be_bytes(self.fixed()?).into()),
            Marker::I16 => Value::Integer(i16::from_be_bytes(self.fixed()?).into()),
            Marker::I32 => Value::Integer(i32::from_be_bytes(self.fixed()?).into()),
            Marker::I64 => Value::Integer(i64::from_be_bytes(self.fixed()?).into()),
            Marker::F32 => Value::Float(f32::from_be_bytes(self.fixed()?).into()),
            Marker::F64 => Value::Float(f64::from_be_bytes(self.fixed()?)),
            Marker::FixStr(bytes) => Value::Text(self.text(bytes.into())?),
            Marker::Str8 => self.length(1).and_then(|bytes| self.text(bytes)).map(Value::Text)?,
            Marker::Str16 => self.length(2).and_then(|bytes| self.text(bytes)).map(Value::Text)?,
            Marker::Str32 => self.length(4).and_then(|bytes| self.text(bytes)).map(Value::Text)?,
            Marker::Bin8 => self.bytes(1)?,
            Marker::Bin16 => self.bytes(2)?,
            Marker::Bin32 => self.bytes(4)?,
            Marker::FixArray(count) => self.list(count.into(), deeper)?,
            Marker::Array16 => self.length(2).and_then(|count| self.list(count, deeper))?,
            Marker::Array32 => self.length(4).and_then(|count| self.list(count, deeper))?,
            Marker::FixMap(count) => self.map(count.into(), deeper)?,
            Marker::Map16 => self.length(2).and_then(|count| self.map(count, deeper))?,
            Marker::Map32 => self.length(4).and_then(|count| self.map(count, deeper))?,
            other => return Err(malformed("plain MessagePack", format!("{other:?}"))),
        })
    }

    fn bytes(&mut self, length: usize) -> Result<Value<'a>> {
        let bytes = self.length(length)?;
        Ok(Value::Bytes(Cow::Borrowed(self.take(bytes)?)))
    }
}

/// A map, or what it stands for: an array or a scalar of NumPy's.
fn special<'a>(pairs: Vec<(Cow<'a, str>, Value<'a>)>) -> Result<Value<'a>> {
    let is = |name: &str| pairs.iter().any(|(key, _)| key == name);
    let (array, scalar) = (is("__ndarray__"), is("__npgeneric__"));
    if !array && !scalar {
        return Ok(Value::Map(pairs));
    }
    let (mut data, mut dtype, mut shape) = (Value::Nil, Value::Nil, Value::Nil);
    for (key, value) in pairs {
        match key.as_ref() {
            "data" => data = value,
            "dtype" => dtype = value,
            "shape" => shape = value,
            _ => {}
        }
    }
    let Value::Text(name) = &dtype else {
        return Err(ServingError::message("dtype", "a text such as <f4", dtype.to_string()));
    };
    if scalar {
        // a text of NumPy's is one: `<U5`
        let plain = matches!(data, Value::Bool(_) | Value::Integer(_) | Value::Float(_) | Value::Text(_));
        return match plain {
            true => Ok(data),
            false => Err(ServingError::message("data", format!("a scalar of type {}", shown(name)), data.to_string())),
        };
    }
    let Some(dtype) = Dtype::parse(name) else {
        return Err(ServingError::message(
            "dtype",
            "bool, int8 to int64, uint8 to uint64 or float16 to float64",
            shown(name),
        ));
    };
    let Value::List(extents) = &shape else {
        return Err(ServingError::message("shape", "a list of integers", shape.to_string()));
    };
    let extent = |value: &Value<'_>| value.count().and_then(|count| usize::try_from(count).ok());
    let extents = extents.iter().map(|value| {
        extent(value).ok_or_else(|| ServingError::message("shape", "integers from 0 on", value.to_string()))
    });
    let shape: Vec<usize> = extents.collect::<Result<_>>()?;
    match data {
        Value::Bytes(data) => Ok(Value::Array(Array::new(dtype, shape, data)?)),
        other => Err(ServingError::message("data", "bytes", other.to_string())),
    }
}

/// Writes a message, as `openpi_client.msgpack_numpy` writes it.
pub fn encode(value: &Value<'_>) -> Vec<u8> {
    let mut message = Vec::with_capacity(256);
    write(&mut message, value);
    message
}

/// Writing to memory does not fail.
const MEMORY: &str = "memory takes what is written";

fn write(to: &mut Vec<u8>, value: &Value<'_>) {
    use rmp::encode as put;
    let length = |length: usize| u32::try_from(length).unwrap_or(u32::MAX);
    match value {
        Value::Nil => put::write_nil(to).expect(MEMORY),
        Value::Bool(yes) => put::write_bool(to, *yes).expect(MEMORY),
        Value::Integer(number) => match (u64::try_from(*number), i64::try_from(*number)) {
            (Ok(number), _) => {
                put::write_uint(to, number).expect(MEMORY);
            }
            (_, Ok(number)) => {
                put::write_sint(to, number).expect(MEMORY);
            }
            _ => put::write_f64(to, *number as f64).expect(MEMORY),
        },
        Value::Float(number) => put::write_f64(to, *number).expect(MEMORY),
        Value::Text(text) => put::write_str(to, text).expect(MEMORY),
        Value::Bytes(bytes) => put::write_bin(to, bytes).expect(MEMORY),
        Value::List(values) => {
            put::write_array_len(to, length(values.len())).expect(MEMORY);
            values.iter().for_each(|value| write(to, value));
        }
        Value::Map(pairs) => {
            put::write_map_len(to, length(pairs.len())).expect(MEMORY);
            for (key, value) in pairs {
                put::write_str(to, key).expect(MEMORY);
                write(to, value);
            }
        }
        Value::Array(array) => {
            put::write_map_len(to, 4).expect(MEMORY);
            put::write_bin(to, b"__ndarray__").expect(MEMORY);
            put::write_bool(to, true).expect(MEMORY);
            put::write_bin(to, b"data").expect(MEMORY);
            put::write_bin(to, &array.data).expect(MEMORY);
            put::write_bin(to, b"dtype").expect(MEMORY);
            put::write_str(to, &array.dtype.text()).expect(MEMORY);
            put::write_bin(to, b"shape").expect(MEMORY);
            put::write_array_len(to, length(array.shape.len())).expect(MEMORY);
            for extent in &array.shape {
                put::write_uint(to, *extent as u64).expect(MEMORY);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use proptest::prelude::*;

    const OPENPI: &[u8] = include_bytes!("../fixtures/openpi.msgpack");

    fn error(message: &[u8]) -> String {
        decode(message).unwrap_err().to_string()
    }

    /// A message as openpi packs `{key: array}`, with one part of the array replaced.
    fn array(part: &str, by: &[u8]) -> Vec<u8> {
        let mut message = b"\x81\xa5image\x84\xc4\x0b__ndarray__\xc3".to_vec();
        for (name, usual) in [("data", &b"\xc4\x04\0\0\x80\x3f"[..]), ("dtype", b"\xa3<f4"), ("shape", b"\x91\x01")] {
            message.extend([0xc4, name.len() as u8]);
            message.extend(name.as_bytes());
            message.extend(if name == part { by } else { usual });
        }
        message
    }

    #[test]
    fn what_openpi_writes_is_read_and_written_byte_for_byte() {
        let message = decode(OPENPI).unwrap();
        assert!(encode(&message) == OPENPI, "other bytes");
        let Some(Value::Map(arrays)) = message.get("arrays") else { panic!("no arrays") };
        assert_eq!(arrays.len(), 21);
        for (dtype, array) in arrays {
            let array = array.to_array().unwrap();
            assert_eq!(array.shape(), [2, 3], "{dtype}");
            let bool = [0.0, 1.0, 1.0, 1.0, 1.0, 1.0];
            let expected = if dtype == "|b1" { bool } else { [0.0, 1.0, 2.0, 3.0, 4.0, 5.0] };
            assert_eq!(array.numbers(), expected, "{dtype}");
        }
        assert_eq!(message.get("empty").unwrap().to_array().unwrap().shape(), [0, 3]);
        assert_eq!(message.get("scalar").unwrap().to_array().unwrap().numbers(), [1.5]);
        assert_eq!(message.get("prompt"), Some(&Value::text("pick up the café")));
        let nested = message.get("nested").unwrap().to_array().unwrap().into_owned();
        assert_eq!((nested.shape(), nested.numbers().as_slice()), (&[2, 2][..], &[0.0, 1.0, 2.0, 3.5][..]));
        let scalars = decode(include_bytes!("../fixtures/scalars.msgpack")).unwrap();
        let expected = [
            ("float", Value::Float(1.5)),
            ("int", Value::Integer(-3)),
            ("bool", Value::Bool(true)),
            ("text", Value::text("lift")),
        ];
        assert_eq!(scalars, Value::map(expected));
    }

    #[test]
    fn what_does_not_fit_is_refused_by_its_key() {
        assert!(decode(&array("", b"")).is_ok());
        for (message, words) in [
            (array("data", b"\xc4\x03\0\0\0"), "image: data: expected the data of float32 [1], found 3 bytes"),
            (array("data", b"\x93\0\0\0"), "image: data: expected bytes, found a list of 3"),
            (array("dtype", b"\xa2|O"), "image: dtype: expected bool, int8 to int64"),
            (array("dtype", b"\xa3<c8"), "found <c8"),
            (array("dtype", b"\xa3|V2"), "found |V2"),
            (array("dtype", b"\xa3<U1"), "found <U1"),
            (array("dtype", b"\xa4<f16"), "found <f16"),
            (array("dtype", b"\xc0"), "image: dtype: expected a text such as <f4, found nothing"),
            (array("shape", b"\x91\xff"), "image: shape: expected integers from 0 on, found -1"),
            // 2^63 * 4 elements
            (array("shape", b"\x92\xcf\x80\0\0\0\0\0\0\0\x04"), "image: data: expected the data of float32"),
            (b"\x81\xa1a\x81\xa1b\xc1".to_vec(), "a: b: expected plain MessagePack, found Reserved"),
            (b"\x81\xa1a\xc7\x01\x05\0".to_vec(), "a: expected plain MessagePack, found Ext8"),
            (b"\x81\x01\x01".to_vec(), "message: expected a text as key, found 1"),
            (b"\x82\xa1a\x01\xa1a\x02".to_vec(), "message: expected each key once, found a twice"),
            (b"\x81\xa1a\xdd\xff\xff\xff\xff".to_vec(), "a: expected at most 65536 values; send arrays as arrays"),
            (b"\x81\xa1a\xdc\x01\0\x01".to_vec(), "a: expected 256 values, found 1 bytes"),
            (b"\x81\xa1a\xdb\xff\xff\xff\xff\x01".to_vec(), "a: expected 4294967295 more bytes, found 1"),
            (b"\x81\xa1a\xa1\xff".to_vec(), "a: expected text in UTF-8"),
            (b"\x01\x02".to_vec(), "message: expected its end, found 1 more bytes"),
            (vec![], "message: expected 1 more bytes, found 0"),
            (vec![0x91; 100_000], "at most 16 lists and maps in each other"),
        ] {
            let error = error(&message);
            assert!(error.contains(words), "{error} / {words}");
        }
    }

    #[test]
    fn images_are_bytes_or_floats_from_0_to_1() {
        let floats = |values: &[f32]| Array::of_f32(vec![values.len()], values).unwrap().pixels();
        // rounded half to even, as NumPy's rint
        assert_eq!(floats(&[0.0, 1.0, 0.5, 1.0005, -0.0005, 2.5 / 255.0]).unwrap(), [0, 255, 128, 255, 0, 2]);
        assert_eq!(floats(&[0.0, 1.5]).unwrap_err(), "float32 with 1.5");
        assert_eq!(floats(&[f32::NAN]).unwrap_err(), "float32 with NaN");
        assert_eq!(
            Array::new(Dtype::parse("<i4").unwrap(), vec![1], vec![0; 4]).unwrap().pixels().unwrap_err(),
            "int32"
        );
    }

    #[test]
    fn ten_thousand_mutated_messages_are_answers_or_errors() {
        let mut state = 1_u64;
        let mut random = |below: usize| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as usize % below
        };
        let mut read = 0;
        for _ in 0..10_000 {
            let mut message = OPENPI.to_vec();
            for _ in 0..1 + random(4) {
                let at = random(message.len());
                match random(4) {
                    0 => message[at] = random(256) as u8,
                    1 => message.truncate(at + 1),
                    2 => message.insert(at, random(256) as u8),
                    _ => drop(message.drain(at..(at + random(20)).min(message.len()))),
                }
                if message.is_empty() {
                    message.push(0);
                }
            }
            match decode(&message) {
                Ok(value) => {
                    read += 1;
                    // what was read can be written and is then the same
                    let again = encode(&value);
                    assert_eq!(encode(&decode(&again).unwrap()), again);
                }
                Err(error) => assert!(error.to_string().len() < 2000, "{error}"),
            }
        }
        assert!((100..9_900).contains(&read), "{read} could be read");
    }

    fn any_value() -> impl Strategy<Value = super::Value<'static>> {
        let leaf = prop_oneof![
            Just(Value::Nil),
            any::<bool>().prop_map(Value::Bool),
            any::<i64>().prop_map(|number| Value::Integer(number.into())),
            any::<u64>().prop_map(|number| Value::Integer(number.into())),
            (-1e300..1e300).prop_map(Value::Float),
            ".{0,40}".prop_map(Value::text),
            prop::collection::vec(any::<u8>(), 0..300).prop_map(|bytes| Value::Bytes(bytes.into())),
            prop::collection::vec(-1e9_f32..1e9, 0..100)
                .prop_map(|numbers| Value::Array(Array::of_f32(vec![numbers.len()], &numbers).unwrap())),
        ];
        leaf.prop_recursive(3, 64, 20, |inner| {
            prop_oneof![
                prop::collection::vec(inner.clone(), 0..20).prop_map(Value::List),
                prop::collection::btree_map("[a-z]{1,5}", inner, 0..20).prop_map(Value::map),
            ]
        })
    }

    proptest! {
        #[test]
        fn what_is_written_is_read(value in any_value()) {
            let message = encode(&value);
            prop_assert_eq!(decode(&message).unwrap(), value);
        }
    }
}
