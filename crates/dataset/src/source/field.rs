//! Byte strings of a fixed width, exactly as they are stored. libhdf5 ends a string at its first zero byte when it converts it,
//! and converts nothing where the type in memory is the file's: so the one in memory has the file's width, known at run time only.
#![allow(unsafe_code)] // a type of the library's is an unsafe trait

use std::cell::Cell;
use std::mem::MaybeUninit;

use hdf5::Container;
use hdf5::types::{H5Type, TypeDescriptor, VarLenAscii};

use super::value::{MAX_FIXED, Part, ValueResult, elements, put};

thread_local! {
    /// Bytes of a string, and whether it is marked UTF-8, in the call that is under way.
    static STRING: Cell<(usize, bool)> = const { Cell::new((1, false)) };
}

/// Room for a string of at most `N` bytes. The library packs the strings: they are one after the other at the front of the fields.
#[repr(transparent)]
struct Field<const N: usize>([MaybeUninit<u8>; N]);

// SAFETY: any bytes are a value, and the type that is described takes no more than `N` of them
unsafe impl<const N: usize> H5Type for Field<N> {
    fn type_descriptor() -> TypeDescriptor {
        let (width, utf8) = STRING.get();
        if utf8 { TypeDescriptor::FixedUnicode(width.min(N)) } else { TypeDescriptor::FixedAscii(width.min(N)) }
    }
}

fn read_fields<const N: usize>(from: &Container, part: Part<'_>, width: usize) -> ValueResult<Vec<u8>> {
    let fields = elements::<Field<N>>(from, part)?;
    // SAFETY: the library has written a string for every field, and `width` is at most `N`
    Ok(unsafe { std::slice::from_raw_parts(fields.as_ptr().cast::<u8>(), fields.len() * width.min(N)) }.to_vec())
}

fn write_fields<const N: usize>(to: &Container, bytes: &[u8], width: usize) -> ValueResult<()> {
    let count = bytes.len() / width;
    let mut packed: Vec<u8> = Vec::with_capacity(count * N);
    packed.extend_from_slice(bytes);
    // SAFETY: there is room for as many fields, which need no initial value and no alignment
    put(to, unsafe { std::slice::from_raw_parts(packed.as_ptr().cast::<Field<N>>(), count) })
}

macro_rules! for_width {
    ($n:expr, $call:ident ( $($arg:expr),* )) => {
        match $n {
            0 => Err("strings of no bytes".to_owned()),
            ..=8 => $call::<8>($($arg),*),
            ..=32 => $call::<32>($($arg),*),
            ..=128 => $call::<128>($($arg),*),
            ..=512 => $call::<512>($($arg),*),
            ..=2048 => $call::<2048>($($arg),*),
            ..=8192 => $call::<8192>($($arg),*),
            ..=32_768 => $call::<32_768>($($arg),*),
            ..=131_072 => $call::<131_072>($($arg),*),
            ..=524_288 => $call::<524_288>($($arg),*),
            ..=2_097_152 => $call::<2_097_152>($($arg),*),
            ..=MAX_FIXED => $call::<MAX_FIXED>($($arg),*),
            n => Err(format!("strings of {n} bytes; {MAX_FIXED} are the most")),
        }
    };
}

/// The strings with all their bytes, one after the other.
pub(super) fn read(from: &Container, part: Part<'_>, width: usize, utf8: bool) -> ValueResult<Vec<u8>> {
    STRING.set((width, utf8));
    for_width!(width, read_fields(from, part, width))
}

/// Writes strings of so many bytes.
pub(super) fn write(to: &Container, bytes: &[u8], width: usize, utf8: bool) -> ValueResult<()> {
    STRING.set((width, utf8));
    for_width!(width, write_fields(to, bytes, width))
}

/// A string of any length that is marked ASCII; Python puts any bytes into one.
pub(super) fn ascii(bytes: &[u8]) -> ValueResult<VarLenAscii> {
    if bytes.contains(&0) {
        return Err("a string with a zero byte inside".to_owned());
    }
    // SAFETY: it has no zero byte and is only written, never taken for text
    Ok(unsafe { VarLenAscii::from_ascii_unchecked(bytes) })
}
