//! A record of a TFRecord file: its checksum, and the lists of the `tf.train.Example` that it holds, a protocol buffer.

use std::collections::BTreeMap;

use crate::tree::Dtype;

/// CRC-32C, rotated and shifted, as TFRecord stores it.
pub fn masked_crc(bytes: &[u8]) -> u32 {
    const TABLE: [u32; 256] = {
        let mut table = [0; 256];
        let mut i = 0;
        while i < 256 {
            let (mut crc, mut bit) = (i as u32, 0);
            while bit < 8 {
                crc = if crc & 1 == 1 { crc >> 1 ^ 0x82f6_3b78 } else { crc >> 1 };
                bit += 1;
            }
            table[i] = crc;
            i += 1;
        }
        table
    };
    let crc = !bytes.iter().fold(!0_u32, |crc, &byte| TABLE[usize::from(crc as u8 ^ byte)] ^ crc >> 8);
    crc.rotate_right(15).wrapping_add(0xa282_ead8)
}

/// A field of a message.
enum Field<'a> {
    Number(u64),
    Bytes(&'a [u8]),
    Fixed(u32),
}

/// Why a message cannot be read.
pub const CUT: &str = "a message that is cut off";

fn varint(rest: &mut &[u8]) -> Result<u64, String> {
    let mut number = 0;
    for shift in (0..64).step_by(7) {
        let (&byte, tail) = rest.split_first().ok_or(CUT)?;
        *rest = tail;
        number |= u64::from(byte & 127) << shift;
        if byte < 128 {
            return Ok(number);
        }
    }
    Err("a number of more than 64 bits".to_owned())
}

/// Calls `take` with the number and content of every field of a message.
fn fields<'a>(message: &'a [u8], take: &mut dyn FnMut(u64, Field<'a>) -> Result<(), String>) -> Result<(), String> {
    let mut rest = message;
    while !rest.is_empty() {
        let tag = varint(&mut rest)?;
        let field = match tag & 7 {
            0 => Field::Number(varint(&mut rest)?),
            1 => {
                rest = rest.get(8..).ok_or(CUT)?;
                continue;
            }
            2 => {
                let length = usize::try_from(varint(&mut rest)?).map_err(|e| e.to_string())?;
                let (content, tail) = rest.split_at_checked(length).ok_or(CUT)?;
                rest = tail;
                Field::Bytes(content)
            }
            5 => {
                let (four, tail) = rest.split_first_chunk::<4>().ok_or(CUT)?;
                rest = tail;
                Field::Fixed(u32::from_le_bytes(*four))
            }
            kind => return Err(format!("a field of kind {kind}")),
        };
        take(tag >> 3, field)?;
    }
    Ok(())
}

/// The lists of an example by name: kind (1 bytes, 2 floats, 3 whole numbers, 0 of a list without one) and content.
pub type Lists<'a> = BTreeMap<&'a str, (u64, &'a [u8])>;

/// The lists of a record.
pub fn lists(record: &[u8]) -> Result<Lists<'_>, String> {
    let mut found = Lists::new();
    fields(record, &mut |number, field| match (number, field) {
        (1, Field::Bytes(features)) => fields(features, &mut |number, entry| {
            let (1, Field::Bytes(entry)) = (number, entry) else { return Ok(()) };
            let (mut name, mut list) = ("", (0, &[][..]));
            fields(entry, &mut |number, field| {
                match (number, field) {
                    (1, Field::Bytes(text)) => name = std::str::from_utf8(text).map_err(|e| e.to_string())?,
                    (2, Field::Bytes(feature)) => fields(feature, &mut |kind, field| {
                        if let Field::Bytes(content) = field {
                            list = (kind, content);
                        }
                        Ok(())
                    })?,
                    _ => {}
                }
                Ok(())
            })?;
            found.insert(name, list);
            Ok(())
        }),
        _ => Ok(()),
    })?;
    Ok(found)
}

/// The elements of a list of bytes.
pub fn byte_strings(list: &[u8]) -> Result<Vec<&[u8]>, String> {
    let mut all = Vec::new();
    fields(list, &mut |_, field| {
        if let Field::Bytes(one) = field {
            all.push(one);
        }
        Ok(())
    })?;
    Ok(all)
}

/// Calls `take` with every number of a list, as float or as whole number.
fn numbers(kind: u64, list: &[u8], take: &mut dyn FnMut(f32, i64)) -> Result<(), String> {
    fields(list, &mut |_, field| {
        match (kind, field) {
            (2, Field::Bytes(packed)) => {
                let (values, rest) = packed.as_chunks::<4>();
                values.iter().for_each(|&v| take(f32::from_le_bytes(v), 0));
                if !rest.is_empty() {
                    return Err(CUT.to_owned());
                }
            }
            (2, Field::Fixed(bits)) => take(f32::from_bits(bits), 0),
            (3, Field::Bytes(mut packed)) => {
                while !packed.is_empty() {
                    take(0.0, varint(&mut packed)? as i64);
                }
            }
            (3, Field::Number(number)) => take(0.0, number as i64),
            _ => return Err("a list of numbers that holds something else".to_owned()),
        }
        Ok(())
    })
}

/// Number of elements of a list.
pub fn count(kind: u64, list: &[u8]) -> Result<usize, String> {
    let mut all = 0;
    match kind {
        1 => all = byte_strings(list)?.len(),
        _ => numbers(kind, list, &mut |_, _| all += 1)?,
    }
    Ok(all)
}

/// The numbers of a list in their own type.
pub fn elements(kind: u64, list: &[u8], dtype: &Dtype) -> Result<Vec<u8>, String> {
    let (mut out, mut beyond) = (Vec::new(), None);
    let whole = kind == 3;
    let put = &mut |float: f32, number: i64| {
        let bytes = number.to_le_bytes();
        match dtype {
            Dtype::F32 if whole => out.extend_from_slice(&(number as f32).to_le_bytes()),
            Dtype::F32 => out.extend_from_slice(&float.to_le_bytes()),
            Dtype::F64 if whole => out.extend_from_slice(&(number as f64).to_le_bytes()),
            Dtype::F64 => out.extend_from_slice(&f64::from(float).to_le_bytes()),
            Dtype::Bool => out.push(u8::from(number != 0)),
            other => {
                if !holds(other, number) {
                    beyond.get_or_insert(number);
                }
                out.extend_from_slice(&bytes[..other.size().unwrap_or(8)]);
            }
        }
    };
    if !whole && !matches!(dtype, Dtype::F32 | Dtype::F64) {
        return Err(format!("floats where {dtype} is stated"));
    }
    numbers(kind, list, put)?;
    match beyond {
        Some(number) => Err(format!("the number {number} where {dtype} is stated")),
        None => Ok(out),
    }
}

/// Whether a type has this number; the records have those of uint64 as int64 of the same bits.
fn holds(dtype: &Dtype, number: i64) -> bool {
    match dtype {
        Dtype::U8 => u8::try_from(number).is_ok(),
        Dtype::I8 => i8::try_from(number).is_ok(),
        Dtype::U16 => u16::try_from(number).is_ok(),
        Dtype::I16 => i16::try_from(number).is_ok(),
        Dtype::U32 => u32::try_from(number).is_ok(),
        Dtype::I32 => i32::try_from(number).is_ok(),
        _ => true,
    }
}
