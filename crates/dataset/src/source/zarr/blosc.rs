//! The container that Blosc 1 writes around a chunk: blocks, each compressed whole or byte by byte of its elements, with the
//! bytes or bits of elements sorted by their place in it. Written after c-blosc's README_CHUNK_FORMAT.

use std::io::Read;

/// Unpacks a chunk, which must be `expected` bytes long.
pub(super) fn decode(chunk: &[u8], expected: usize) -> Result<Vec<u8>, String> {
    let head = chunk.first_chunk::<16>().ok_or("a Blosc chunk of less than 16 bytes")?;
    let number = |at: usize| u32::from_le_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]) as usize;
    let (flags, size, bytes, block) = (head[2], usize::from(head[3]).max(1), number(4), number(8));
    if bytes != expected {
        return Err(format!("a Blosc chunk of {bytes} bytes, expected {expected}"));
    }
    if flags & 2 != 0 {
        let plain = chunk.get(16..16 + bytes).ok_or("a Blosc chunk that is cut off")?;
        return Ok(plain.to_vec());
    }
    if bytes == 0 {
        return Ok(Vec::new());
    }
    if block == 0 {
        return Err("a Blosc chunk of empty blocks".to_owned());
    }
    let starts = chunk.get(16..).and_then(|rest| rest.get(..bytes.div_ceil(block) * 4));
    let (starts, _) = starts.ok_or("a Blosc chunk that is cut off")?.as_chunks::<4>();
    let mut out = Vec::with_capacity(bytes);
    for start in starts {
        let length = block.min(bytes - out.len());
        let splits = match flags & 0x10 == 0 && length == block && size <= 16 && block / size >= 128 {
            true => size,
            false => 1,
        };
        let mut rest = chunk.get(u32::from_le_bytes(*start) as usize..).ok_or("a Blosc block beyond its chunk")?;
        let (part, mut shuffled) = (length / splits, Vec::with_capacity(length));
        for _ in 0..splits {
            let (count, tail) = rest.split_first_chunk::<4>().ok_or("a Blosc block that is cut off")?;
            let (packed, tail) =
                tail.split_at_checked(u32::from_le_bytes(*count) as usize).ok_or("a Blosc block that is cut off")?;
            rest = tail;
            match packed.len() == part {
                true => shuffled.extend_from_slice(packed),
                false => shuffled.extend(unpack(flags >> 5, packed, part)?),
            }
        }
        match flags {
            _ if flags & 1 != 0 && size > 1 => unshuffle(&shuffled, size, &mut out),
            _ if flags & 4 != 0 && length >= size => unshuffle_bits(&shuffled, size, &mut out),
            _ => out.extend_from_slice(&shuffled),
        }
    }
    Ok(out)
}

/// Unpacks what one of Blosc's compressors made, to exactly so many bytes.
fn unpack(codec: u8, packed: &[u8], expected: usize) -> Result<Vec<u8>, String> {
    let out = match codec {
        0 => blosclz(packed, expected)?,
        1 => super::lz4(packed, expected)?,
        2 => {
            let mut out = vec![0; expected];
            let made = snap::raw::Decoder::new().decompress(packed, &mut out).map_err(|e| e.to_string())?;
            out.truncate(made);
            out
        }
        3 => super::inflate(flate2::read::ZlibDecoder::new(packed), expected)?,
        4 => super::zstd(packed, expected)?,
        other => {
            return Err(format!("Blosc's compressor {other}, which is none of blosclz, lz4, snappy, zlib and zstd"));
        }
    };
    match out.len() == expected {
        true => Ok(out),
        false => Err(format!("a Blosc block of {} bytes, expected {expected}", out.len())),
    }
}

/// Blosc's own compressor, which is FastLZ's second level.
fn blosclz(packed: &[u8], expected: usize) -> Result<Vec<u8>, String> {
    const CUT: &str = "a Blosc block that is cut off";
    const FAR: usize = 8191;
    let mut rest = packed;
    let mut next = || {
        let mut byte = [0];
        rest.read_exact(&mut byte).map(|()| usize::from(byte[0])).ok()
    };
    let mut out = Vec::with_capacity(expected);
    let mut control = next().ok_or(CUT)? & 31;
    loop {
        if control >= 32 {
            let (mut length, high) = ((control >> 5) - 1, (control & 31) << 8);
            if length == 6 {
                loop {
                    let more = next().ok_or(CUT)?;
                    length += more;
                    if more != 255 {
                        break;
                    }
                }
            }
            let low = next().ok_or(CUT)?;
            let mut distance = high + low;
            if low == 255 && high == 31 << 8 {
                distance = (next().ok_or(CUT)? << 8) + next().ok_or(CUT)? + FAR;
            }
            let from =
                out.len().checked_sub(distance + 1).ok_or("a Blosc block that refers to before its beginning")?;
            if out.len() + length + 3 > expected {
                return Err("a Blosc block that is longer than it says".to_owned());
            }
            for at in from..from + length + 3 {
                out.push(out[at]);
            }
        } else {
            if out.len() + control + 1 > expected {
                return Err("a Blosc block that is longer than it says".to_owned());
            }
            for _ in 0..=control {
                out.push(next().ok_or(CUT)? as u8);
            }
        }
        match next() {
            Some(following) => control = following,
            None => return Ok(out),
        }
    }
}

/// Bytes sorted by their place in elements of so many bytes, back into elements.
fn unshuffle(sorted: &[u8], size: usize, out: &mut Vec<u8>) {
    let count = sorted.len() / size;
    for element in 0..count {
        out.extend((0..size).map(|place| sorted[place * count + element]));
    }
    out.extend_from_slice(&sorted[count * size..]);
}

/// The same for bits; Blosc leaves elements alone whose number is no multiple of 8.
fn unshuffle_bits(sorted: &[u8], size: usize, out: &mut Vec<u8>) {
    let count = sorted.len() / size;
    if !count.is_multiple_of(8) {
        out.extend_from_slice(sorted);
        return;
    }
    let row = count / 8;
    for eight in 0..row {
        let first = out.len();
        out.resize(first + 8 * size, 0);
        for place in 0..size {
            for bit in 0..8 {
                let bits = sorted[(place * 8 + bit) * row + eight];
                for element in 0..8 {
                    out[first + element * size + place] |= (bits >> element & 1) << bit;
                }
            }
        }
    }
    out.extend_from_slice(&sorted[count * size..]);
}
