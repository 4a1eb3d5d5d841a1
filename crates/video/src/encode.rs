//! Pictures to AV1, by rav1e: as LeRobot's default encoder sets it up (a key frame every second frame, no reordering),
//! on the calling thread, the same bytes for the same pictures.

use rav1e::prelude::{
    ChromaSampling, Config, Context, EncoderConfig, EncoderStatus, FrameType, PixelRange, Rational, SceneDetectionSpeed,
};

use crate::Sample;
use crate::colour;
use crate::error::{Result, VideoError};
use crate::mux::Rate;

/// How pictures are encoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EncodeOptions {
    /// 0 (slow, small) to 10.
    pub speed: u8,
    /// 1 (large, exact) to 255.
    pub quantizer: u8,
    /// Frames from a key frame to the next.
    pub key_interval: u16,
}

impl Default for EncodeOptions {
    fn default() -> Self {
        Self { speed: 10, quantizer: 80, key_interval: 2 }
    }
}

/// Encodes pictures of one size, one after the other.
pub struct Encoder {
    context: Context<u8>,
    width: usize,
    height: usize,
    rate: Rate,
    pushed: usize,
    samples: Vec<Sample>,
}

/// Checks that pictures of this size can become a video, and says why they cannot.
///
/// # Errors
/// An odd height, sides that are not 16 to 8192 pixels.
pub fn check_size(width: usize, height: usize) -> std::result::Result<(), &'static str> {
    if height % 2 == 1 {
        return Err("the height is odd, and readers of 4:2:0 disagree about such images");
    }
    if !(16..=8192).contains(&width) || !(16..=8192).contains(&height) {
        return Err("sides are 16 to 8192 pixels");
    }
    Ok(())
}

impl Encoder {
    /// Starts a stream. The size is as [`check_size`] wants it.
    pub fn new(width: usize, height: usize, rate: Rate, options: &EncodeOptions) -> Result<Self> {
        let refused = |reason: &str| refused(width, height, rate, reason);
        check_size(width, height).map_err(refused)?;
        let mut config = EncoderConfig::with_speed_preset(options.speed.min(10));
        config.width = width;
        config.height = height;
        config.time_base = Rational::new(u64::from(rate.denominator), u64::from(rate.numerator));
        config.chroma_sampling = ChromaSampling::Cs420;
        config.pixel_range = PixelRange::Limited;
        config.set_key_frame_interval(0, u64::from(options.key_interval.max(1)));
        config.low_latency = true;
        config.quantizer = usize::from(options.quantizer.max(1));
        // key frames stand at fixed places anyway
        config.speed_settings.scene_detection_mode = SceneDetectionSpeed::None;
        let context = Config::new().with_encoder_config(config).new_context();
        let context = context.map_err(|e| refused(&e.to_string()))?;
        Ok(Self { context, width, height, rate, pushed: 0, samples: Vec::new() })
    }

    /// Takes the next picture: rows from the top, pixels from the left, red, green and blue.
    pub fn push(&mut self, rgb: &[u8]) -> Result<()> {
        let expected = self.width * self.height * 3;
        if rgb.len() != expected {
            let reason = format!("frame {} has {} bytes instead of {expected}", self.pushed, rgb.len());
            return Err(refused(self.width, self.height, self.rate, &reason));
        }
        let mut frame = self.context.new_frame();
        let columns = self.width.div_ceil(2);
        let planes = colour::from_rgb(rgb, self.width, self.height);
        for ((plane, values), stride) in frame.planes.iter_mut().zip(&planes).zip([self.width, columns, columns]) {
            plane.copy_from_raw_u8(values, stride, 1);
        }
        self.context.send_frame(frame).map_err(|e| self.failed(e))?;
        self.pushed += 1;
        self.receive()
    }

    /// Ends the stream; its samples, one a picture.
    pub fn finish(mut self) -> Result<Vec<Sample>> {
        if self.pushed > 0 {
            self.context.flush();
            self.receive()?;
        }
        match self.samples.len() == self.pushed {
            true => Ok(self.samples),
            false => {
                let reason = format!("the encoder made {} frames of {}", self.samples.len(), self.pushed);
                Err(refused(self.width, self.height, self.rate, &reason))
            }
        }
    }

    fn receive(&mut self) -> Result<()> {
        loop {
            match self.context.receive_packet() {
                Ok(packet) => {
                    if packet.input_frameno != self.samples.len() as u64 {
                        return Err(refused(self.width, self.height, self.rate, "the encoder changed their order"));
                    }
                    let key = packet.frame_type == FrameType::KEY;
                    let sample = Sample::of_unit(&packet.data).expect("the encoder writes whole units");
                    self.samples.push(Sample { key, ..sample });
                }
                Err(EncoderStatus::Encoded) => {}
                Err(EncoderStatus::NeedMoreData | EncoderStatus::LimitReached) => return Ok(()),
                Err(status) => return Err(self.failed(status)),
            }
        }
    }

    fn failed(&self, status: EncoderStatus) -> VideoError {
        refused(self.width, self.height, self.rate, &format!("frame {}: {status}", self.pushed))
    }
}

fn refused(width: usize, height: usize, rate: Rate, reason: &str) -> VideoError {
    VideoError::Encode { width, height, fps: rate.fps(), reason: reason.to_owned() }
}
