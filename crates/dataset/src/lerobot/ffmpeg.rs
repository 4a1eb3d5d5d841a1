//! AV1 by SVT-AV1 in FFmpeg, a process for each stretch of images, where FFmpeg is there.

use super::features::{VideoEncoder, VideoOptions};
use crate::error::{DatasetError, Result};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::OnceLock;
use std::thread::JoinHandle;
use video::{Rate, Sample, VideoError};

/// Names the program.
const VARIABLE: &str = "ACTRM_FFMPEG";
const CODEC: &str = "libsvtav1";

/// An FFmpeg that encodes AV1.
#[derive(Debug)]
pub(crate) struct Ffmpeg {
    program: PathBuf,
    version: String,
}

/// The FFmpeg that encodes, if the options want one: `None` is the built-in encoder.
///
/// # Errors
/// [`DatasetError::Ffmpeg`] where one is wanted and there is none that can be used.
pub(crate) fn chosen(encoder: VideoEncoder) -> Result<Option<&'static Ffmpeg>> {
    static FOUND: OnceLock<Result<Ffmpeg, String>> = OnceLock::new();
    let found = || {
        FOUND.get_or_init(|| {
            let program = std::env::var_os(VARIABLE).unwrap_or_else(|| "ffmpeg".into());
            Ffmpeg::look(Path::new(&program))
        })
    };
    match encoder {
        VideoEncoder::Builtin => Ok(None),
        VideoEncoder::Auto => Ok(found().as_ref().ok()),
        VideoEncoder::Ffmpeg => match found() {
            Ok(ffmpeg) => Ok(Some(ffmpeg)),
            Err(reason) => Err(DatasetError::Ffmpeg { reason: reason.clone() }),
        },
    }
}

/// SVT-AV1's quality for a quantizer: its scale has a step for four.
pub(crate) fn crf(options: &VideoOptions) -> u8 {
    options.quantizer.div_ceil(4).clamp(1, 63)
}

/// SVT-AV1's preset for a speed from 0 to 10.
pub(crate) fn preset(options: &VideoOptions) -> u8 {
    options.speed.min(10) + 2
}

impl Ffmpeg {
    /// Looks whether a program is an FFmpeg that can encode.
    fn look(program: &Path) -> Result<Self, String> {
        let name = program.display();
        let ask = |arguments: &[&str]| -> Result<String, String> {
            let output = Command::new(program).args(arguments).stdin(Stdio::null()).output();
            match output {
                Ok(output) if output.status.success() => Ok(String::from_utf8_lossy(&output.stdout).into_owned()),
                Ok(output) => Err(format!("{name}: {} when it was asked {}", output.status, arguments.join(" "))),
                Err(e) if e.kind() == std::io::ErrorKind::NotFound => {
                    Err(format!("{name}: no such program ({VARIABLE} names one that is not on the PATH)"))
                }
                Err(e) => Err(format!("{name}: {e}")),
            }
        };
        let version = ask(&["-version"])?;
        let version = version.strip_prefix("ffmpeg version ").and_then(|rest| rest.split_whitespace().next());
        let version = version.ok_or_else(|| format!("{name}: no FFmpeg"))?.to_owned();
        if !ask(&["-hide_banner", "-h", &format!("encoder={CODEC}")])?.contains(&format!("Encoder {CODEC}")) {
            return Err(format!("{name}: FFmpeg {version} has no encoder {CODEC}"));
        }
        Ok(Self { program: program.to_owned(), version })
    }

    /// What encodes, as it is recorded.
    pub(crate) fn name(&self) -> String {
        format!("SVT-AV1 by FFmpeg {}", self.version)
    }
}

/// Images that are being encoded.
pub(crate) struct Encoding {
    program: &'static Path,
    size: (usize, usize),
    rate: Rate,
    child: Child,
    images: Option<ChildStdin>,
    video: Option<JoinHandle<std::io::Result<Vec<u8>>>>,
    words: Option<JoinHandle<String>>,
    pushed: usize,
}

impl Encoding {
    pub(crate) fn new(
        ffmpeg: &'static Ffmpeg,
        (width, height): (usize, usize),
        rate: Rate,
        options: &VideoOptions,
    ) -> Result<Self> {
        let failed = |reason: String| VideoError::Encode { width, height, fps: rate.fps(), reason };
        video::check_size(width, height).map_err(|reason| failed(reason.to_owned()))?;
        let mut child = Command::new(&ffmpeg.program)
            .args(["-hide_banner", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "yuv420p"])
            .args(["-s", &format!("{width}x{height}"), "-r", &format!("{}/{}", rate.numerator, rate.denominator)])
            .args([
                "-i",
                "-",
                "-c:v",
                CODEC,
                "-preset",
                &preset(options).to_string(),
                "-crf",
                &crf(options).to_string(),
            ])
            // one thread: stretches are encoded side by side
            .args(["-g", &options.key_interval.max(1).to_string(), "-svtav1-params", "lp=1", "-f", "ivf", "-"])
            .env("SVT_LOG", "1")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .map_err(|e| failed(format!("{} cannot be started: {e}", ffmpeg.program.display())))?;
        let (images, video, words) = (child.stdin.take(), child.stdout.take(), child.stderr.take());
        let read = |mut from: std::process::ChildStdout| {
            std::thread::spawn(move || {
                let mut bytes = Vec::new();
                from.read_to_end(&mut bytes).map(|_| bytes)
            })
        };
        let listen = |mut from: std::process::ChildStderr| {
            std::thread::spawn(move || {
                let mut bytes = Vec::new();
                let _ = from.read_to_end(&mut bytes); // what it said until then
                String::from_utf8_lossy(&bytes).trim().lines().next_back().unwrap_or_default().to_owned()
            })
        };
        let (video, words) = (video.map(read), words.map(listen));
        Ok(Self { program: &ffmpeg.program, size: (width, height), rate, child, images, video, words, pushed: 0 })
    }

    fn failed(&self, reason: String) -> DatasetError {
        let (width, height) = self.size;
        let reason = format!("{}: {reason}", self.program.display());
        VideoError::Encode { width, height, fps: self.rate.fps(), reason }.into()
    }

    /// Takes the next image.
    pub(crate) fn push(&mut self, rgb: &[u8]) -> Result<()> {
        let (width, height) = self.size;
        let planes = video::yuv420(rgb, width, height);
        let images = self.images.as_mut();
        let written = images.map_or(Ok(()), |to| planes.iter().try_for_each(|plane| to.write_all(plane)));
        if written.is_err() {
            return Err(self.ended());
        }
        self.pushed += 1;
        Ok(())
    }

    /// Why it is at its end before its work was.
    fn ended(&mut self) -> DatasetError {
        self.images = None;
        let status = match self.child.wait() {
            Ok(status) => status.to_string(),
            Err(e) => e.to_string(),
        };
        let words = self.words.take().and_then(|words| words.join().ok()).filter(|words| !words.is_empty());
        let words = words.map_or(String::new(), |words| format!(": {words}"));
        self.failed(format!("it ended after image {} with {status}{words}", self.pushed))
    }

    /// Ends the stretch; its samples, one an image.
    pub(crate) fn finish(mut self) -> Result<Vec<Sample>> {
        if self.pushed == 0 {
            return Ok(Vec::new());
        }
        self.images = None;
        let bytes = self.video.take().and_then(|video| video.join().ok()).and_then(std::io::Result::ok);
        let (Some(bytes), Ok(true)) = (bytes, self.child.wait().map(|status| status.success())) else {
            return Err(self.ended());
        };
        let samples = frames(&bytes).map(Sample::of_unit).collect::<Option<Vec<_>>>();
        match samples {
            Some(samples) if samples.len() == self.pushed => Ok(samples),
            other => {
                let count = other.map_or(0, |samples| samples.len());
                Err(self.failed(format!("it made {count} frames of {}", self.pushed)))
            }
        }
    }
}

impl Drop for Encoding {
    fn drop(&mut self) {
        // of one that has ended there is nothing to do
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// The frames of an IVF file, as far as they are whole.
fn frames(file: &[u8]) -> impl Iterator<Item = &[u8]> {
    const HEADER: usize = 32;
    let mut rest = file.get(HEADER..).unwrap_or_default();
    std::iter::from_fn(move || {
        let (length, after) = rest.split_first_chunk()?;
        let (frame, after) = after.get(8..)?.split_at_checked(u32::from_le_bytes(*length) as usize)?;
        rest = after;
        Some(frame)
    })
}
