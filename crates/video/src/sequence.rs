//! AV1's sequence header and the units (OBUs) of a sample, as far as they say what is in a stream (AV1 bitstream
//! specification, section 5.3 to 5.5).

use crate::demux::refuse_colour;
use crate::error::{Result, VideoError};

/// Unit with a sequence header.
pub(crate) const SEQUENCE: u8 = 1;
/// Unit that stands between temporal units; MP4 files leave it out.
pub(crate) const DELIMITER: u8 = 2;
/// Unit with a list of tiles, for which whole other rules hold.
const TILE_LIST: u8 = 8;

/// What a sequence header says, as far as a reader depends on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Sequence {
    pub width: u32,
    pub height: u32,
    pub profile: u8,
    pub bits: u8,
    pub monochrome: bool,
    /// Chroma has half the columns, half the rows.
    pub subsampled: (bool, bool),
    pub matrix: u16,
    pub full_range: bool,
    /// Several layers of quality or size.
    pub scalable: bool,
}

/// One unit: its type, its header with its content, its content.
pub(crate) struct Unit<'a> {
    pub kind: u8,
    pub whole: &'a [u8],
    pub content: &'a [u8],
}

/// Splits a sample; `None` where a unit reaches beyond its end.
pub(crate) fn units(sample: &[u8]) -> Option<Vec<Unit<'_>>> {
    let mut units = Vec::new();
    let mut rest = sample;
    while let Some(&head) = rest.first() {
        if head & 0x80 != 0 {
            return None;
        }
        let (extended, sized) = (head & 4 != 0, head & 2 != 0);
        let mut before = 1 + usize::from(extended);
        let size = match sized {
            true => {
                let (size, bytes) = leb128(rest.get(before..)?)?;
                before += bytes;
                size
            }
            false => rest.len().checked_sub(before)?,
        };
        let (whole, after) = rest.split_at_checked(before.checked_add(size)?)?;
        units.push(Unit { kind: (head >> 3) & 15, whole, content: &whole[before..] });
        rest = after;
    }
    Some(units)
}

fn leb128(bytes: &[u8]) -> Option<(usize, usize)> {
    let mut value = 0_u64;
    for (i, &byte) in bytes.iter().take(8).enumerate() {
        value |= u64::from(byte & 0x7f) << (7 * i);
        if byte & 0x80 == 0 {
            return Some((usize::try_from(value).ok()?, i + 1));
        }
    }
    None
}

struct Bits<'a> {
    data: &'a [u8],
    at: usize,
}

impl Bits<'_> {
    fn flag(&mut self) -> Option<bool> {
        let byte = self.data.get(self.at / 8)?;
        let bit = byte >> (7 - self.at % 8) & 1;
        self.at += 1;
        Some(bit == 1)
    }

    fn number(&mut self, bits: u32) -> Option<u32> {
        (0..bits).try_fold(0, |value, _| Some(value << 1 | u32::from(self.flag()?)))
    }

    /// `uvlc()`: skipped.
    fn skip_exp_golomb(&mut self) -> Option<()> {
        let mut zeros = 0;
        while !self.flag()? {
            zeros += 1;
        }
        if zeros < 32 {
            self.number(zeros)?;
        }
        Some(())
    }
}

/// Reads the content of a sequence header; `None` where it ends too early or contradicts itself.
pub(crate) fn parse(content: &[u8]) -> Option<Sequence> {
    let mut r = Bits { data: content, at: 0 };
    let profile = r.number(3)? as u8;
    let _still = r.flag()?;
    let reduced = r.flag()?;
    let mut scalable = false;
    if reduced {
        r.number(5)?;
    } else {
        let mut model = None;
        let timing = r.flag()?;
        if timing {
            r.number(32)?;
            r.number(32)?;
            if r.flag()? {
                r.skip_exp_golomb()?;
            }
            if r.flag()? {
                model = Some(r.number(5)? + 1);
                r.number(32)?;
                r.number(10)?;
            }
        }
        let delays = r.flag()?;
        let points = r.number(5)? + 1;
        for _ in 0..points {
            scalable |= r.number(12)? != 0;
            if r.number(5)? > 7 {
                r.flag()?;
            }
            if let Some(bits) = model
                && r.flag()?
            {
                r.number(bits)?;
                r.number(bits)?;
                r.flag()?;
            }
            if delays && r.flag()? {
                r.number(4)?;
            }
        }
    }
    let (width_bits, height_bits) = (r.number(4)? + 1, r.number(4)? + 1);
    let (width, height) = (r.number(width_bits)? + 1, r.number(height_bits)? + 1);
    if !reduced && r.flag()? {
        r.number(7)?;
    }
    r.number(3)?; // blocks of 128, filters of intra prediction
    if !reduced {
        r.number(4)?; // kinds of compound prediction
        let order = r.flag()?;
        if order {
            r.number(2)?;
        }
        let screen = if r.flag()? { 2 } else { r.number(1)? };
        if screen > 0 && !r.flag()? {
            r.flag()?;
        }
        if order {
            r.number(3)?;
        }
    }
    r.number(3)?; // superres, cdef, restoration
    let high = r.flag()?;
    let bits = match (profile, high) {
        (2, true) => {
            if r.flag()? {
                12
            } else {
                10
            }
        }
        (_, true) => 10,
        (_, false) => 8,
    };
    let monochrome = profile != 1 && r.flag()?;
    let (mut primaries, mut transfer, mut matrix) = (2, 2, 2);
    if r.flag()? {
        (primaries, transfer, matrix) = (r.number(8)?, r.number(8)?, r.number(8)?);
    }
    let (full_range, subsampled) = match (monochrome, primaries, transfer, matrix) {
        (true, ..) => (r.flag()?, (true, true)),
        (false, 1, 13, 0) => (true, (false, false)),
        _ => {
            let full = r.flag()?;
            let subsampled = match (profile, bits) {
                (0, _) => (true, true),
                (1, _) => (false, false),
                (_, 12) => {
                    let columns = r.flag()?;
                    (columns, columns && r.flag()?)
                }
                _ => (true, false),
            };
            (full, subsampled)
        }
    };
    let matrix = matrix as u16;
    Some(Sequence { width, height, profile, bits, monochrome, subsampled, matrix, full_range, scalable })
}

impl Sequence {
    /// Refuses what is not read, and a size that is not the file's.
    pub fn check(&self, name: &str, width: u16, height: u16) -> Result<()> {
        let unsupported = |what: String| Err(VideoError::Unsupported { name: name.to_owned(), what });
        if self.bits != 8 {
            return unsupported(format!("AV1 with {} bits", self.bits));
        }
        match (self.monochrome, self.subsampled) {
            (true, _) => return unsupported("AV1 without colour (4:0:0)".to_owned()),
            (_, (false, _)) => return unsupported("AV1 with 4:4:4".to_owned()),
            (_, (true, false)) => return unsupported("AV1 with 4:2:2".to_owned()),
            _ => {}
        }
        if self.scalable {
            return unsupported("AV1 in several layers".to_owned());
        }
        refuse_colour(name, self.matrix, self.full_range)?;
        if (self.width, self.height) != (u32::from(width), u32::from(height)) {
            return Err(VideoError::Malformed {
                name: name.to_owned(),
                object: "AV1 sequence header".to_owned(),
                expected: format!("{width} x {height} pixels, as the sample entry says"),
                found: format!("{} x {}", self.width, self.height),
            });
        }
        Ok(())
    }
}

/// Whether a unit may stand in a sample.
pub(crate) fn allowed(unit: &Unit<'_>) -> bool {
    unit.kind != TILE_LIST
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn the_header_of_a_file_of_lerobot_is_understood() {
        // SVT-AV1's, 84 x 84
        let sample = [0x0a, 0x0a, 0x00, 0x00, 0x00, 0x03, 0x35, 0x3a, 0x60, 0x17, 0xc0, 0x02];
        let units = units(&sample).unwrap();
        assert_eq!((units.len(), units[0].kind, units[0].content.len()), (1, SEQUENCE, 10));
        let sequence = parse(units[0].content).unwrap();
        let expected = Sequence {
            width: 84,
            height: 84,
            profile: 0,
            bits: 8,
            monochrome: false,
            subsampled: (true, true),
            matrix: 2,
            full_range: false,
            scalable: false,
        };
        assert_eq!(sequence, expected);
        sequence.check("f", 84, 84).unwrap();
        assert!(sequence.check("f", 84, 86).unwrap_err().to_string().contains("expected 84 x 86 pixels"));
        for (changed, word) in [
            (Sequence { bits: 10, ..expected }, "10 bits"),
            (Sequence { monochrome: true, ..expected }, "4:0:0"),
            (Sequence { subsampled: (false, false), ..expected }, "4:4:4"),
            (Sequence { subsampled: (true, false), ..expected }, "4:2:2"),
            (Sequence { matrix: 1, ..expected }, "BT.709"),
            (Sequence { full_range: true, ..expected }, "full-range"),
            (Sequence { scalable: true, ..expected }, "layers"),
        ] {
            let text = changed.check("f", 84, 84).unwrap_err().to_string();
            assert!(text.contains(word) && text.contains("is not read"), "{text}");
        }
    }

    #[test]
    fn units_that_reach_beyond_their_sample_are_none() {
        assert!(units(&[0x0a, 0x02, 0]).is_none());
        assert!(units(&[0x0a, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff]).is_none());
        assert!(units(&[0x8a, 0]).is_none());
        assert!(units(&[0x0e]).is_none());
        assert!(units(&[]).unwrap().is_empty());
        // without a size: all that is left
        assert_eq!(units(&[0x30, 1, 2, 3]).unwrap()[0].content, [1, 2, 3]);
        assert!(parse(&[0, 0, 0, 3]).is_none());
    }
}
