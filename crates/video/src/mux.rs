//! An MP4 file of AV1 or H.264 samples, as LeRobot's own are: one track, one chunk, constant rate.

use crate::Sample;
use crate::error::{Result, VideoError};
use crate::sequence;

/// Frames a second as a fraction, and the ticks that a file counts them in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rate {
    /// Frames ...
    pub numerator: u32,
    /// ... in so many seconds.
    pub denominator: u32,
}

impl Rate {
    /// The fraction nearest to `fps` with a small denominator, or 1001; `None` where it would be off by more than one
    /// frame in 10^7.
    pub fn of(fps: f64) -> Option<Self> {
        let fits = |denominator: u32| {
            let numerator = (fps * f64::from(denominator)).round();
            let good =
                (1.0..1e6).contains(&numerator) && (numerator / f64::from(denominator) - fps).abs() <= fps * 1e-7;
            good.then_some(Self { numerator: numerator as u32, denominator })
        };
        (1..=100).chain([1001]).find_map(fits)
    }

    /// Ticks in a second, 10,000 or more as FFmpeg writes them.
    pub fn timescale(self) -> u32 {
        let mut ticks = self.numerator;
        while ticks < 10_000 {
            ticks *= 2;
        }
        ticks
    }

    /// Ticks of a frame.
    pub fn ticks(self) -> u32 {
        self.timescale() / self.numerator * self.denominator
    }

    /// Frames a second.
    pub fn fps(self) -> f64 {
        f64::from(self.numerator) / f64::from(self.denominator)
    }

    /// When frame `index` is shown, in seconds.
    pub fn seconds(self, index: usize) -> f64 {
        index as f64 * f64::from(self.denominator) / f64::from(self.numerator)
    }
}

/// Puts a file together: the samples go where the caller keeps them, [`Muxer::header`] is what stands before them.
#[derive(Debug, Clone)]
pub struct Muxer {
    width: u16,
    height: u16,
    rate: Rate,
    sizes: Vec<u32>,
    keys: Vec<u32>,
    bytes: u64,
    /// Sequence header of the first sample, with which it begins.
    sequence: Vec<u8>,
    /// Parameters of the first sample, where that is H.264.
    parameters: Vec<u8>,
}

impl Muxer {
    /// A file for pictures of one size at one rate.
    pub fn new(width: u16, height: u16, rate: Rate) -> Self {
        Self {
            width,
            height,
            rate,
            sizes: Vec::new(),
            keys: Vec::new(),
            bytes: 0,
            sequence: Vec::new(),
            parameters: Vec::new(),
        }
    }

    /// Takes note of the next sample; its bytes follow those of the one before.
    pub fn push(&mut self, sample: &Sample) -> Result<()> {
        let number = self.sizes.len();
        let refused = |reason: &str| VideoError::Encode {
            width: usize::from(self.width),
            height: usize::from(self.height),
            fps: self.rate.fps(),
            reason: format!("frame {number}: {reason}"),
        };
        if number == 0 {
            self.parameters.clone_from(&sample.parameters);
        } else if !sample.parameters.is_empty() && sample.parameters != self.parameters {
            return Err(refused("its parameters differ from those of the first frame"));
        }
        if number == 0 && self.parameters.is_empty() {
            let units = sequence::units(&sample.bytes).unwrap_or_default();
            let header = units.iter().find(|u| u.kind == sequence::SEQUENCE && sample.key);
            let header = header.ok_or_else(|| refused("a file begins with a key frame that has a sequence header"))?;
            self.sequence = header.whole.to_vec();
        }
        let size = u32::try_from(sample.bytes.len()).ok().ok_or_else(|| refused("more than 4 GiB"))?;
        self.sizes.push(size);
        if sample.key {
            self.keys.push(number as u32 + 1);
        }
        self.bytes += u64::from(size);
        Ok(())
    }

    /// Frames so far.
    pub fn frames(&self) -> usize {
        self.sizes.len()
    }

    /// Bytes of samples so far.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Everything that stands before the samples.
    pub fn header(&self) -> Vec<u8> {
        let ftyp = boxed(b"ftyp", &[b"isom", &512_u32.to_be_bytes(), b"isom", self.codec(), b"iso2", b"mp41"]);
        let large = self.bytes + 16 > u64::from(u32::MAX);
        let mdat = match large {
            false => [&(self.bytes as u32 + 8).to_be_bytes()[..], b"mdat"].concat(),
            true => [&1_u32.to_be_bytes()[..], b"mdat", &(self.bytes + 16).to_be_bytes()].concat(),
        };
        // the place of the samples does not change the length of what stands before them
        let before = ftyp.len() + self.moov(0).len() + mdat.len();
        [ftyp, self.moov(before as u32), mdat].concat()
    }

    /// The name of the sample entry.
    fn codec(&self) -> &'static [u8; 4] {
        if self.parameters.is_empty() { b"av01" } else { b"avc1" }
    }

    fn moov(&self, samples_at: u32) -> Vec<u8> {
        let frames = self.sizes.len() as u64;
        let ticks = self.rate.ticks();
        let media = frames * u64::from(ticks);
        let movie = (media * 1000).div_ceil(u64::from(self.rate.timescale()));
        let identity: Vec<u8> =
            [0x1_0000, 0, 0, 0, 0x1_0000, 0, 0, 0, 0x4000_0000_u32].iter().flat_map(|n| n.to_be_bytes()).collect();
        let zeros = [0; 24];
        let (w, h) = (u32::from(self.width) << 16, u32::from(self.height) << 16);
        let mvhd = full(
            b"mvhd",
            1,
            0,
            &[
                &zeros[..16],
                &be(1000),
                &movie.to_be_bytes(),
                &be(0x1_0000),
                &[1, 0],
                &zeros[..10],
                &identity,
                &zeros,
                &be(2),
            ],
        );
        let tkhd = full(
            b"tkhd",
            1,
            3,
            &[&zeros[..16], &be(1), &be(0), &movie.to_be_bytes(), &zeros[..16], &identity, &be(w), &be(h)],
        );
        let elst = full(b"elst", 1, 0, &[&be(1), &movie.to_be_bytes(), &zeros[..8], &be(0x1_0000)]);
        // 0x55c4: no language
        let mdhd =
            full(b"mdhd", 1, 0, &[&zeros[..16], &be(self.rate.timescale()), &media.to_be_bytes(), &[0x55, 0xc4, 0, 0]]);
        let hdlr = full(b"hdlr", 0, 0, &[&zeros[..4], b"vide", &zeros[..12], b"VideoHandler\0"]);
        let vmhd = full(b"vmhd", 0, 1, &[&zeros[..8]]);
        let dinf = boxed(b"dinf", &[&full(b"dref", 0, 0, &[&be(1), &full(b"url ", 0, 1, &[])])]);
        let minf = boxed(b"minf", &[&vmhd, &dinf, &self.stbl(samples_at)]);
        let mdia = boxed(b"mdia", &[&mdhd, &hdlr, &minf]);
        let trak = boxed(b"trak", &[&tkhd, &boxed(b"edts", &[&elst]), &mdia]);
        boxed(b"moov", &[&mvhd, &trak])
    }

    fn stbl(&self, samples_at: u32) -> Vec<u8> {
        let zeros = [0; 32];
        // marker and version; main profile, level as the header says; 8 bits, 4:2:0
        let sequence = sequence::units(&self.sequence).unwrap_or_default();
        let level = sequence.first().map_or(0, |u| level(u.content));
        let config = match self.parameters.is_empty() {
            true => boxed(b"av1C", &[&[0x81, level, 0x0c, 0], &self.sequence]),
            false => boxed(b"avcC", &[&self.parameters]),
        };
        let entry = boxed(
            self.codec(),
            &[
                &[0, 0, 0, 0, 0, 0, 0, 1],
                &zeros[..16],
                &self.width.to_be_bytes(),
                &self.height.to_be_bytes(),
                // 72 dots an inch, one picture a sample, no name, 24 bits, no palette
                &be(72 << 16),
                &be(72 << 16),
                &be(0),
                &[0, 1],
                &zeros,
                &[0, 24, 0xff, 0xff],
                &config,
            ],
        );
        let count = self.sizes.len() as u32;
        let list = |numbers: &[u32]| numbers.iter().flat_map(|n| n.to_be_bytes()).collect::<Vec<u8>>();
        boxed(
            b"stbl",
            &[
                &full(b"stsd", 0, 0, &[&be(1), &entry]),
                &full(b"stts", 0, 0, &[&be(1), &be(count), &be(self.rate.ticks())]),
                &full(b"stss", 0, 0, &[&be(self.keys.len() as u32), &list(&self.keys)]),
                &full(b"stsc", 0, 0, &[&be(1), &be(1), &be(count), &be(1)]),
                &full(b"stsz", 0, 0, &[&be(0), &be(count), &list(&self.sizes)]),
                &full(b"stco", 0, 0, &[&be(1), &be(samples_at)]),
            ],
        )
    }
}

/// `seq_profile` and `seq_level_idx` of a header without timing information, which is what is written here.
fn level(content: &[u8]) -> u8 {
    // profile 3 bits, still 1, reduced 1, timing 1, delays 1, points 5, operating point 12, level 5
    let bit = |at: usize| content.get(at / 8).map_or(0, |b| b >> (7 - at % 8) & 1);
    (24..29).fold(0, |level, at| level << 1 | bit(at))
}

fn be(number: u32) -> [u8; 4] {
    number.to_be_bytes()
}

fn boxed(kind: &[u8; 4], parts: &[&[u8]]) -> Vec<u8> {
    let size = 8 + parts.iter().map(|p| p.len()).sum::<usize>();
    let mut out = Vec::with_capacity(size);
    out.extend(be(size as u32));
    out.extend(kind);
    parts.iter().for_each(|part| out.extend_from_slice(part));
    out
}

fn full(kind: &[u8; 4], version: u8, flags: u8, parts: &[&[u8]]) -> Vec<u8> {
    let head = [version, 0, 0, flags];
    let all: Vec<&[u8]> = std::iter::once(&head[..]).chain(parts.iter().copied()).collect();
    boxed(kind, &all)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn rates_are_counted_without_error() {
        for (fps, ticks, timescale) in
            [(20.0, 512, 10_240), (30.0, 512, 15_360), (12.5, 1024, 12_800), (50.0, 256, 12_800)]
        {
            let rate = Rate::of(fps).unwrap();
            assert_eq!((rate.ticks(), rate.timescale(), rate.fps()), (ticks, timescale, fps), "{fps}");
        }
        let ntsc = Rate::of(30_000.0 / 1001.0).unwrap();
        assert_eq!((ntsc.numerator, ntsc.denominator), (30_000, 1001));
        for bad in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e9, std::f64::consts::PI] {
            assert_eq!(Rate::of(bad), None, "{bad}");
        }
    }
}
