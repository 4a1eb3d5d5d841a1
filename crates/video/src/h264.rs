//! H.264 samples to pictures, by `rust_h264`.

use std::panic::{AssertUnwindSafe, catch_unwind};

use rust_h264::decoder::{ChromaFormat, Decoder, Frame};
use rust_h264::nal::{NalUnitType, SpsInfo, parse_avcc, parse_avcc_config, parse_sps_info};

use crate::colour::{self, Planes};
use crate::demux::{MAX_PIXELS, refuse_colour};
use crate::error::{Result, VideoError};

/// A decoder of one stream.
pub(crate) struct H264 {
    decoder: Decoder,
    length_size: usize,
    size: (u32, u32),
    /// What the stream's parameters say; sets that come inside of samples say the same.
    parameters: SpsInfo,
    /// A decoder that failed is not used again.
    broken: bool,
}

fn bad_config(name: &str, expected: impl Into<String>, found: impl Into<String>) -> VideoError {
    crate::boxes::bad_box(name, "avcC", expected, found)
}

/// Refuses what is not read, by its parameters.
pub(crate) fn check(name: &str, config: &[u8], width: u16, height: u16) -> Result<()> {
    let parsed = parse_avcc_config(config).map_err(|e| bad_config(name, "parameters of H.264", e))?;
    if parsed.sps_nals.is_empty() || parsed.pps_nals.is_empty() {
        return Err(bad_config(name, "parameter sets", "none"));
    }
    for nal in &parsed.sps_nals {
        let info = guarded(|| parse_sps_info(nal).map_err(|e| e.to_string()));
        let info = info.map_err(|e| bad_config(name, "a sequence parameter set", e))?;
        check_parameters(name, &info, width, height)?;
    }
    Ok(())
}

fn check_parameters(name: &str, info: &SpsInfo, width: u16, height: u16) -> Result<()> {
    let unsupported = |what: String| Err(VideoError::Unsupported { name: name.to_owned(), what });
    if (info.bit_depth_luma, info.bit_depth_chroma) != (8, 8) {
        return unsupported(format!("H.264 with {} bits", info.bit_depth_luma.max(info.bit_depth_chroma)));
    }
    match info.chroma_format {
        0 => return unsupported("H.264 without colour (4:0:0)".to_owned()),
        1 => {}
        2 => return unsupported("H.264 with 4:2:2".to_owned()),
        _ => return unsupported("H.264 with 4:4:4".to_owned()),
    }
    if !info.progressive {
        return unsupported("interlaced H.264".to_owned());
    }
    refuse_colour(name, u16::from(info.matrix), info.full_range)?;
    let coded = u64::from(info.coded_width) * u64::from(info.coded_height);
    if coded > MAX_PIXELS + (1 << 20) {
        let object = "pixels of a coded frame".to_owned();
        return Err(VideoError::TooLarge { name: name.to_owned(), object, found: coded, limit: MAX_PIXELS });
    }
    if (info.width, info.height) != (u32::from(width), u32::from(height)) {
        return Err(VideoError::Malformed {
            name: name.to_owned(),
            object: "H.264 sequence parameter set".to_owned(),
            expected: format!("{width} x {height} pixels, as the sample entry says"),
            found: format!("{} x {}", info.width, info.height),
        });
    }
    Ok(())
}

/// A panic of the decoder as an error: it is young, and its input comes from anywhere.
fn guarded<T>(work: impl FnOnce() -> Result<T, String>) -> Result<T, String> {
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|_| Err("the decoder gave up".to_owned()))
}

impl H264 {
    /// `config` has passed [`check`].
    pub fn new(config: &[u8], width: u16, height: u16) -> Result<Self, String> {
        let parsed = parse_avcc_config(config)?;
        let mut decoder = Decoder::new();
        for nal in parsed.sps_nals.iter().chain(&parsed.pps_nals) {
            guarded(|| decoder.decode_nal(nal).map(|_| ()).map_err(|e| e.to_string()))?;
        }
        let size = (u32::from(width), u32::from(height));
        let first = parsed.sps_nals.first().ok_or("no parameters")?;
        let parameters = guarded(|| parse_sps_info(first).map_err(|e| e.to_string()))?;
        Ok(Self { decoder, length_size: parsed.length_size, size, parameters, broken: false })
    }

    /// Decodes one sample, which must hold one picture, into `out`.
    pub fn decode(&mut self, sample: &[u8], out: &mut [u8]) -> Result<(), String> {
        if self.broken {
            return Err("the decoder has failed before".to_owned());
        }
        self.broken = true;
        let frame = guarded(|| self.picture(sample))?;
        self.broken = false;
        if (frame.width, frame.height) != self.size {
            return Err(format!("an image of {} x {}", frame.width, frame.height));
        }
        if frame.chroma_format != ChromaFormat::Yuv420 || frame.bit_depth != 8 {
            return Err(format!("an image of {:?} with {} bits", frame.chroma_format, frame.bit_depth));
        }
        let strides = (frame.width as usize, frame.chroma_width() as usize);
        let planes = Planes { y: &frame.y, u: &frame.u, v: &frame.v, strides };
        match colour::to_rgb(&planes, frame.width as usize, frame.height as usize, out) {
            true => Ok(()),
            false => Err("planes that are too small".to_owned()),
        }
    }

    fn picture(&mut self, sample: &[u8]) -> Result<Frame, String> {
        if !lengths_fit(sample, self.length_size) {
            return Err("a unit reaches beyond the sample".to_owned());
        }
        let mut slices = 0;
        for nal in parse_avcc(sample, self.length_size) {
            match nal.nal_unit_type {
                NalUnitType::Sps if parse_sps_info(&nal).ok() != Some(self.parameters) => {
                    return Err("it changes the stream's parameters".to_owned());
                }
                NalUnitType::Slice | NalUnitType::SliceIdr => slices += 1,
                _ => {}
            }
            // the decoder gives a picture when the next one begins: here that would be one too many
            if self.decoder.decode_nal(&nal).map_err(|e| e.to_string())?.is_some() {
                return Err("it holds more than one image".to_owned());
            }
        }
        if slices == 0 {
            return Err("it holds no image".to_owned());
        }
        self.decoder.flush().ok_or_else(|| "it holds no whole image".to_owned())
    }
}

/// Whether the lengths before the units add up to the sample.
fn lengths_fit(mut sample: &[u8], length_size: usize) -> bool {
    while !sample.is_empty() {
        let Some((head, rest)) = sample.split_at_checked(length_size) else { return false };
        let length = head.iter().fold(0_usize, |n, &b| n << 8 | usize::from(b));
        let Some((_, rest)) = rest.split_at_checked(length) else { return false };
        sample = rest;
    }
    true
}
