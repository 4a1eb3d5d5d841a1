//! One decoder for either codec: a sample in, a picture out.

use crate::av1::Av1;
use crate::demux::{Codec, Track};
use crate::error::{Result, VideoError};
use crate::h264::{self, H264};
use crate::sequence::{self, Sequence};

/// What a decoder has to know before the first sample.
#[derive(Debug)]
pub(crate) enum Setup {
    Av1 { sequence: Sequence, header: Vec<u8> },
    H264 { config: Vec<u8>, width: u16, height: u16 },
}

impl Setup {
    /// From the track and its first sample. Refuses what is not read, by name.
    pub fn of(name: &str, track: &Track, first: &[u8]) -> Result<Self> {
        let (width, height) = (track.width, track.height);
        if track.codec == Codec::H264 {
            h264::check(name, &track.config, width, height)?;
            return Ok(Self::H264 { config: track.config.clone(), width, height });
        }
        // marker and version, profile and level, depth and subsampling, delay; then units
        let units = track.config.get(4..).unwrap_or_default();
        let bad = |expected: &str, found: &str| VideoError::Malformed {
            name: name.to_owned(),
            object: "AV1 sequence header".to_owned(),
            expected: expected.to_owned(),
            found: found.to_owned(),
        };
        // the stream's own, or else that of the configuration
        for units in [first, units] {
            let units = sequence::units(units).ok_or_else(|| bad("whole units", "one that reaches beyond its end"))?;
            if let Some(unit) = units.iter().find(|u| u.kind == sequence::SEQUENCE) {
                let sequence = sequence::parse(unit.content).ok_or_else(|| bad("a whole header", "its beginning"))?;
                sequence.check(name, width, height)?;
                return Ok(Self::Av1 { sequence, header: unit.whole.to_vec() });
            }
        }
        Err(bad("one in the first sample or in box av1C", "none"))
    }

    /// A decoder at the beginning of the stream.
    pub fn decoder(&self) -> Result<Decoder, String> {
        match self {
            Self::Av1 { sequence, header } => Av1::new(*sequence, header.clone()).map(|d| Decoder::Av1(Box::new(d))),
            Self::H264 { config, width, height } => {
                H264::new(config, *width, *height).map(|d| Decoder::H264(Box::new(d)))
            }
        }
    }
}

/// A decoder of one stream.
pub(crate) enum Decoder {
    Av1(Box<Av1>),
    H264(Box<H264>),
}

impl Decoder {
    /// Decodes the next sample into RGB.
    pub fn decode(&mut self, sample: &[u8], key: bool, out: &mut [u8]) -> Result<(), String> {
        match self {
            Self::Av1(decoder) => decoder.decode(sample, key, out),
            Self::H264(decoder) => decoder.decode(sample, out),
        }
    }
}
