//! TIFF files of one channel, not compressed: the frames of depth as LeRobot writes them, by Pillow. Written here because
//! they must be the same bytes, and read here because the readers there are reserve what a damaged header asks for.

use super::depth::DepthKind;

/// What the frames of a depth column end in.
pub(crate) const EXTENSION: &str = "tiff";

/// Appends a frame as a TIFF file, byte for byte the one that Pillow writes for LeRobot: little-endian, one strip, not
/// compressed. `pixels` are `height * width` little-endian numbers.
pub(crate) fn encode(kind: DepthKind, height: usize, width: usize, pixels: &[u8], out: &mut Vec<u8>) {
    let (height, width, bytes) = (height as u32, width as u32, pixels.len() as u32);
    let mut entries = vec![
        (tag::WIDTH, LONG, width),
        (tag::HEIGHT, LONG, height),
        (tag::BITS, SHORT, 8 * kind.size() as u32),
        (tag::COMPRESSION, SHORT, NOT_COMPRESSED),
        (tag::PHOTOMETRIC, SHORT, BLACK_IS_ZERO),
        (tag::STRIPS, LONG, 0),
        (tag::ROWS_PER_STRIP, LONG, height),
        (tag::STRIP_BYTES, LONG, bytes),
        (tag::PLANES, SHORT, 1),
    ];
    if kind == DepthKind::F32 {
        entries.push((tag::FORMAT, SHORT, FLOAT));
    }
    // header, number of entries, entries, and a zero for "no other picture"
    let start = (FIRST + 2 + ENTRY * entries.len() + 4) as u32;
    out.extend_from_slice(b"II*\0");
    out.extend_from_slice(&(FIRST as u32).to_le_bytes());
    out.extend_from_slice(&(entries.len() as u16).to_le_bytes());
    for (tag, form, value) in entries {
        let value = if tag == tag::STRIPS { start } else { value };
        out.extend_from_slice(&tag.to_le_bytes());
        out.extend_from_slice(&form.to_le_bytes());
        out.extend_from_slice(&1_u32.to_le_bytes());
        out.extend_from_slice(&value.to_le_bytes());
    }
    out.extend_from_slice(&[0; 4]);
    out.extend_from_slice(pixels);
}

/// Appends the little-endian pixels of a TIFF file that must be `height` x `width` depth; in words what is wrong otherwise.
/// Nothing is allocated for what a file says of itself before that is known to be in it.
pub(crate) fn decode(file: &[u8], height: usize, width: usize, out: &mut Vec<u8>) -> Result<DepthKind, String> {
    let entries = Entries::open(file)?;
    let found = (entries.one(tag::HEIGHT, None)? as usize, entries.one(tag::WIDTH, None)? as usize);
    if found != (height, width) {
        return Err(format!("an image of {} x {} instead of {height} x {width}", found.0, found.1));
    }
    let (channels, photometric) = (entries.one(tag::CHANNELS, Some(1))?, entries.one(tag::PHOTOMETRIC, None)?);
    if (channels, photometric) != (1, BLACK_IS_ZERO) {
        return Err(format!("{channels} channels of photometric kind {photometric} instead of one of depth"));
    }
    let compression = entries.one(tag::COMPRESSION, Some(NOT_COMPRESSED))?;
    if compression != NOT_COMPRESSED {
        return Err(format!("a TIFF file of compression {compression}, where LeRobot has none"));
    }
    let kind = match (entries.one(tag::BITS, None)?, entries.one(tag::FORMAT, Some(UNSIGNED))?) {
        (32, FLOAT) => DepthKind::F32,
        (16, UNSIGNED) => DepthKind::U16,
        (bits, format) => return Err(format!("{bits} bits of format {format} instead of float32 or uint16")),
    };
    let (starts, lengths) = (entries.list(tag::STRIPS, height)?, entries.list(tag::STRIP_BYTES, height)?);
    let (size, from) = (height * width * kind.size(), out.len());
    for (&start, &length) in starts.iter().zip(&lengths) {
        let (start, length) = (start as usize, length as usize);
        let strip = start.checked_add(length).and_then(|end| file.get(start..end));
        let strip = strip.filter(|strip| out.len() - from + strip.len() <= size);
        out.extend_from_slice(strip.ok_or_else(|| {
            format!("a broken TIFF file: {length} bytes of pixels at {start} of {}, {size} in all", file.len())
        })?);
    }
    match out.len() - from {
        bytes if bytes != size || starts.len() != lengths.len() => {
            Err(format!("a broken TIFF file: {bytes} bytes of pixels instead of {size}"))
        }
        _ => {
            if entries.big_endian {
                out[from..].chunks_exact_mut(kind.size()).for_each(<[u8]>::reverse);
            }
            Ok(kind)
        }
    }
}

/// Where the entries of the first picture are, as Pillow has it.
const FIRST: usize = 8;
/// Bytes of an entry: tag, form, number of values, values or where they are.
const ENTRY: usize = 12;
/// An entry's form: 16-bit numbers.
const SHORT: u16 = 3;
/// An entry's form: 32-bit numbers.
const LONG: u16 = 4;
const NOT_COMPRESSED: u32 = 1;
/// Pictures whose numbers are not turned around: the only ones whose numbers are the distances.
const BLACK_IS_ZERO: u32 = 1;
const UNSIGNED: u32 = 1;
const FLOAT: u32 = 3;

/// What entries say.
mod tag {
    pub(super) const WIDTH: u16 = 256;
    pub(super) const HEIGHT: u16 = 257;
    pub(super) const BITS: u16 = 258;
    pub(super) const COMPRESSION: u16 = 259;
    pub(super) const PHOTOMETRIC: u16 = 262;
    pub(super) const STRIPS: u16 = 273;
    pub(super) const CHANNELS: u16 = 277;
    pub(super) const ROWS_PER_STRIP: u16 = 278;
    pub(super) const STRIP_BYTES: u16 = 279;
    pub(super) const PLANES: u16 = 284;
    pub(super) const FORMAT: u16 = 339;
}

/// What a TIFF file says of its first picture.
struct Entries<'f> {
    file: &'f [u8],
    big_endian: bool,
    first: usize,
    count: usize,
}

impl<'f> Entries<'f> {
    fn open(file: &'f [u8]) -> Result<Self, String> {
        let big_endian = match file {
            [b'I', b'I', b'*', 0, ..] => false,
            [b'M', b'M', 0, b'*', ..] => true,
            _ => return Err("no TIFF file".to_owned()),
        };
        let mut entries = Self { file, big_endian, first: 0, count: 0 };
        let at = entries.number(4, 4)? as usize;
        (entries.first, entries.count) = (at.saturating_add(2), entries.number(at, 2)? as usize);
        Ok(entries)
    }

    /// The number in `size` bytes.
    fn number(&self, at: usize, size: usize) -> Result<u32, String> {
        let bytes = at.checked_add(size).and_then(|end| self.file.get(at..end));
        let bytes = bytes.ok_or_else(|| format!("a broken TIFF file: it ends at {} before {at}", self.file.len()))?;
        let join = |number: u32, byte: &u8| number << 8 | u32::from(*byte);
        Ok(if self.big_endian { bytes.iter().fold(0, join) } else { bytes.iter().rev().fold(0, join) })
    }

    /// The numbers of an entry, `most` of them or fewer; none where there is no such entry.
    fn list(&self, tag: u16, most: usize) -> Result<Vec<u32>, String> {
        for i in 0..self.count {
            let at = self.first.saturating_add(i * ENTRY);
            if self.number(at, 2)? != u32::from(tag) {
                continue;
            }
            let (form, count) = (self.number(at + 2, 2)?, self.number(at + 4, 4)? as usize);
            let size = match form {
                form if form == u32::from(SHORT) => 2,
                form if form == u32::from(LONG) => 4,
                form => return Err(format!("a broken TIFF file: entry {tag} of form {form}")),
            };
            if count > most {
                return Err(format!("a broken TIFF file: {count} values in entry {tag}"));
            }
            let from = if count * size <= 4 { at + 8 } else { self.number(at + 8, 4)? as usize };
            return (0..count).map(|i| self.number(from.saturating_add(i * size), size)).collect();
        }
        Ok(Vec::new())
    }

    /// The one number of an entry, or what it is where there is none.
    fn one(&self, tag: u16, otherwise: Option<u32>) -> Result<u32, String> {
        let found = self.list(tag, 1)?.first().copied().or(otherwise);
        found.ok_or_else(|| format!("a broken TIFF file: no entry {tag}"))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use proptest::prelude::*;

    /// A frame of random depth: all bits of it, where they are a number.
    fn frame(kind: DepthKind, pixels: usize, rng: &mut crate::shuffle::SplitMix64) -> Vec<u8> {
        let mut bytes = Vec::new();
        for _ in 0..pixels {
            let bits = rng.below(1 << 32) as u32;
            match kind {
                DepthKind::U16 => bytes.extend_from_slice(&(bits as u16).to_le_bytes()),
                DepthKind::F32 if f32::from_bits(bits).is_nan() => bytes.extend_from_slice(&1_f32.to_le_bytes()),
                DepthKind::F32 => bytes.extend_from_slice(&bits.to_le_bytes()),
            }
        }
        bytes
    }

    #[test]
    fn files_are_the_ones_that_pillow_writes_for_lerobot() {
        let files: [(&[u8], DepthKind); 2] = [
            (include_bytes!("../../tests/fixtures/depth/metres.tiff"), DepthKind::F32),
            (include_bytes!("../../tests/fixtures/depth/millimetres.tiff"), DepthKind::U16),
        ];
        for (file, kind) in files {
            let (mut pixels, mut again) = (Vec::new(), Vec::new());
            assert_eq!(decode(file, 5, 7, &mut pixels), Ok(kind));
            encode(kind, 5, 7, &pixels, &mut again);
            assert!(again == file, "{kind:?}");
            // the fixture's README says what is in them
            let step = if kind == DepthKind::F32 { 0.1_f32 } else { 100.0 };
            let expected: Vec<f32> = (0..35).map(|i| i as f32 * step).collect();
            assert_eq!(kind.values(&pixels).collect::<Vec<_>>(), expected);
        }
    }

    #[test]
    fn other_files_are_refused_in_words() {
        let told = |file: &[u8]| decode(file, 5, 7, &mut Vec::new()).unwrap_err();
        let good: &[u8] = include_bytes!("../../tests/fixtures/depth/metres.tiff");
        let changed = |at: usize, value: u8| {
            let mut file = good.to_vec();
            file[at] = value;
            told(&file)
        };
        assert_eq!(told(b"\x89PNG"), "no TIFF file");
        assert_eq!(told(b""), "no TIFF file");
        assert!(told(&good[..good.len() - 1]).starts_with("a broken TIFF file: "));
        assert!(told(&good[..20]).starts_with("a broken TIFF file: "));
        // the values of the entries begin at 10, twelve bytes each, eight bytes into them
        let entry = |i: usize, value: u8| changed(10 + ENTRY * i + 8, value);
        assert_eq!(entry(0, 8), "an image of 5 x 8 instead of 5 x 7");
        assert_eq!(entry(2, 64), "64 bits of format 3 instead of float32 or uint16");
        assert_eq!(entry(3, 5), "a TIFF file of compression 5, where LeRobot has none");
        assert_eq!(entry(4, 0), "1 channels of photometric kind 0 instead of one of depth");
        assert_eq!(entry(5, 135), "a broken TIFF file: 140 bytes of pixels at 135 of 274, 140 in all");
        assert_eq!(entry(7, 139), "a broken TIFF file: 139 bytes of pixels instead of 140");
        assert_eq!(entry(9, 1), "32 bits of format 1 instead of float32 or uint16");
        // as many values as four bytes can say
        assert!(changed(10 + ENTRY * 5 + 7, 255).contains("values in entry 273"));
        assert_eq!(changed(10 + ENTRY * 4, 7), "a broken TIFF file: no entry 262");
    }

    #[test]
    fn big_endian_files_of_several_strips_are_read() {
        // rows of two pixels, a strip each, the second before the first
        let mut file = b"MM\0*\0\0\0\x08\0\x08".to_vec();
        let mut entry = |tag: u16, form: u16, count: u32, value: u32| {
            file.extend_from_slice(&tag.to_be_bytes());
            file.extend_from_slice(&form.to_be_bytes());
            file.extend_from_slice(&count.to_be_bytes());
            // a 16-bit value lies at the front of its four bytes
            let value = if form == SHORT { value << 16 } else { value };
            file.extend_from_slice(&value.to_be_bytes());
        };
        let end = 8 + 2 + 8 * 12 + 4;
        entry(tag::WIDTH, SHORT, 1, 2);
        entry(tag::HEIGHT, SHORT, 1, 2);
        entry(tag::BITS, SHORT, 1, 16);
        entry(tag::COMPRESSION, SHORT, 1, 1);
        entry(tag::PHOTOMETRIC, SHORT, 1, 1);
        entry(tag::STRIPS, LONG, 2, end);
        entry(tag::ROWS_PER_STRIP, SHORT, 1, 1);
        entry(tag::STRIP_BYTES, LONG, 2, end + 8);
        file.extend_from_slice(&[0; 4]);
        for number in [end + 20, end + 16, 4, 4] {
            file.extend_from_slice(&number.to_be_bytes());
        }
        for pixel in [30_u16, 40_000, 10, 20] {
            file.extend_from_slice(&pixel.to_be_bytes());
        }
        let mut pixels = Vec::new();
        assert_eq!(decode(&file, 2, 2, &mut pixels), Ok(DepthKind::U16));
        assert_eq!(DepthKind::U16.values(&pixels).collect::<Vec<_>>(), [10.0, 20.0, 30.0, 40_000.0]);
    }

    proptest! {
        #[test]
        fn depth_comes_back_bit_by_bit(height in 1_usize..9, width in 1_usize..9, seed in any::<u64>(), whole in any::<bool>()) {
            let kind = if whole { DepthKind::U16 } else { DepthKind::F32 };
            let pixels = frame(kind, height * width, &mut crate::shuffle::SplitMix64::new(seed, 0));
            let (mut file, mut back) = (Vec::new(), vec![1, 2, 3]);
            encode(kind, height, width, &pixels, &mut file);
            prop_assert_eq!(decode(&file, height, width, &mut back), Ok(kind));
            prop_assert_eq!(&back[3..], &pixels[..]);
            prop_assert!(decode(&file, height + 1, width, &mut Vec::new()).is_err());
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(2000))]
        #[test]
        fn damaged_files_give_a_frame_or_are_refused(seed in any::<u64>(), whole in any::<bool>()) {
            let kind = if whole { DepthKind::U16 } else { DepthKind::F32 };
            let mut rng = crate::shuffle::SplitMix64::new(seed, 0);
            let mut file = Vec::new();
            encode(kind, 18, 26, &frame(kind, 18 * 26, &mut rng), &mut file);
            for _ in 0..1 + rng.below(4) {
                // most of them where a flip matters: header and entries
                let range = if rng.below(4) > 0 { 140 } else { file.len() as u64 };
                let at = rng.below(range) as usize;
                file[at] = rng.below(256) as u8;
            }
            let cut = rng.below(file.len() as u64) as usize;
            let mut out = Vec::new();
            for damaged in [&file[..], &file[..cut]] {
                out.clear();
                match decode(damaged, 18, 26, &mut out) {
                    Ok(kind) => prop_assert_eq!(out.len(), 18 * 26 * kind.size()),
                    Err(found) => prop_assert!(!found.is_empty()),
                }
            }
        }
    }
}
