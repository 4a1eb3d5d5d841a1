//! Videos of data sets: MP4 files with AV1 or H.264, 8 bits, 4:2:0, as LeRobotDataset v3.0 keeps them.
//!
//! [`Video`] opens a file and gives its pictures as RGB bytes, the same that LeRobot's readers (torchcodec and PyAV)
//! give, bit for bit; [`Encoder`] makes AV1 of pictures and [`Muxer`] a file of AV1 or H.264 that those readers open. What is
//! not read (other codecs, 10 bits, 4:4:4, fragments, odd heights) is refused by name; [`Info::of`] says what other decoders
//! need to know of it.
//!
//! Files come from anywhere: every length and place in them is checked before it is used, and memory is bounded. The
//! AV1 decoder is a translation from C that may abort the process on a damaged stream, so a program that opens what it
//! did not write runs this in a process of its own.
//!
//! It knows nothing of data sets, tensors or processes, and prints nothing.

mod annexb;
mod av1;
mod boxes;
mod colour;
mod decode;
mod demux;
mod encode;
mod error;
mod h264;
mod mux;
mod sequence;
mod table;
mod video;

pub use colour::from_rgb as yuv420;
pub use demux::Codec;
pub use encode::{EncodeOptions, Encoder, check_size};
pub use error::{Result, VideoError};
pub use mux::{Muxer, Rate};
pub use video::{Frame, Frames, Info, TOLERANCE, Video};

/// One encoded picture: what a sample of a file holds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Sample {
    /// Its bytes.
    pub bytes: Vec<u8>,
    /// Whether it can be decoded without the ones before it.
    pub key: bool,
    /// Of a key frame of H.264 what a decoder has to know, as box `avcC` holds it; samples of AV1 have that in them.
    pub parameters: Vec<u8>,
}

impl Sample {
    /// The sample of a temporal unit of AV1 as an encoder makes it; `None` where the bytes are none.
    pub fn of_unit(data: &[u8]) -> Option<Self> {
        let units = sequence::units(data)?;
        let key = units.iter().any(|unit| unit.kind == sequence::SEQUENCE);
        // MP4 files leave temporal delimiters out
        let kept = units.iter().filter(|unit| unit.kind != sequence::DELIMITER);
        let bytes = kept.flat_map(|unit| unit.whole.iter().copied()).collect();
        Some(Self { bytes, key, parameters: Vec::new() })
    }

    /// The samples of a stream of H.264 (Annex B) with access unit delimiters and without reordering; `None` where the bytes
    /// are no such stream.
    pub fn of_h264_stream(stream: &[u8]) -> Option<Vec<Self>> {
        annexb::samples(stream)
    }

    /// Whether a file of AV1 can begin with it, or go on with it after samples of another encoder.
    pub fn begins(&self) -> bool {
        let units = sequence::units(&self.bytes).unwrap_or_default();
        self.key && units.iter().any(|unit| unit.kind == sequence::SEQUENCE)
    }
}
