//! What FFmpeg does where it is there: encodes images as AV1 or H.264, and decodes videos that are not read here.

use crate::error::{DatasetError, Result};
use crate::lerobot::{VideoEncoder, VideoOptions};
use serde_json::{Value, json};
use std::io::{BufWriter, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::sync::OnceLock;
use std::thread::JoinHandle;
use video::{Rate, Sample, VideoError};

/// Names the program.
const VARIABLE: &str = "ACTRM_FFMPEG";

/// Without CDEF, a filter that takes half of the time of decoding: trainings decode an image many times. It costs half a
/// decibel at the same size (84 x 84, crf 20 and 30).
const SVT_PARAMETERS: &str = "enable-cdef=0";

/// An FFmpeg.
#[derive(Debug)]
pub(crate) struct Ffmpeg {
    program: PathBuf,
    version: String,
    /// Its list of encoders.
    encoders: String,
}

/// What FFmpeg encodes with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Library {
    SvtAv1,
    X264,
}

impl Library {
    /// What FFmpeg calls it.
    fn name(self) -> &'static str {
        match self {
            Self::SvtAv1 => "libsvtav1",
            Self::X264 => "libx264",
        }
    }
}

/// An encoder of an FFmpeg.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Chosen {
    ffmpeg: &'static Ffmpeg,
    library: Library,
}

/// The FFmpeg that is there, or why there is none.
pub(crate) fn found() -> Result<&'static Ffmpeg, &'static str> {
    static FOUND: OnceLock<Result<Ffmpeg, String>> = OnceLock::new();
    let found = FOUND.get_or_init(|| {
        let program = std::env::var_os(VARIABLE).unwrap_or_else(|| "ffmpeg".into());
        Ffmpeg::look(Path::new(&program))
    });
    found.as_ref().map_err(String::as_str)
}

/// The encoder of FFmpeg that the options want: `None` is the built-in encoder.
///
/// # Errors
/// [`DatasetError::Ffmpeg`] where one is wanted and there is none that can be used.
pub(crate) fn chosen(encoder: VideoEncoder) -> Result<Option<Chosen>> {
    let of = |library: Library| {
        let ffmpeg = found().map_err(str::to_owned)?;
        match ffmpeg.encoders.split_whitespace().any(|word| word == library.name()) {
            true => Ok(Chosen { ffmpeg, library }),
            false => {
                let (program, version) = (ffmpeg.program.display(), &ffmpeg.version);
                Err(format!("{program}: FFmpeg {version} has no encoder {}", library.name()))
            }
        }
    };
    let needed = |library| of(library).map(Some).map_err(|reason| DatasetError::Ffmpeg { reason });
    match encoder {
        VideoEncoder::Builtin => Ok(None),
        // one that was named is wanted
        VideoEncoder::Auto => match (std::env::var_os(VARIABLE), found()) {
            (Some(_), Err(reason)) => Err(DatasetError::Ffmpeg { reason: reason.to_owned() }),
            _ => Ok(of(Library::SvtAv1).ok()),
        },
        VideoEncoder::SvtAv1 => needed(Library::SvtAv1),
        VideoEncoder::H264 => needed(Library::X264),
    }
}

impl Chosen {
    /// What encodes, as it is recorded.
    pub(crate) fn name(self) -> String {
        let library = match self.library {
            Library::SvtAv1 => "SVT-AV1",
            Library::X264 => "x264",
        };
        format!("{library} by FFmpeg {}", self.ffmpeg.version)
    }

    /// What it makes, as `info.json` names it.
    pub(crate) fn codec(self) -> &'static str {
        match self.library {
            Library::SvtAv1 => "av1",
            Library::X264 => "h264",
        }
    }

    /// Preset and quality of the library.
    pub(crate) fn settings(self, options: &VideoOptions) -> Value {
        let (preset, crf) = self.preset_and_crf(options);
        match self.library {
            Library::SvtAv1 => {
                json!({"preset": preset.parse::<u8>().unwrap_or(0), "crf": crf, "svtav1-params": SVT_PARAMETERS})
            }
            Library::X264 => json!({"preset": preset, "crf": crf}),
        }
    }

    fn preset_and_crf(self, options: &VideoOptions) -> (String, u8) {
        let speed = options.speed.min(10);
        match self.library {
            // its scale of quality has a step for four of ours
            Library::SvtAv1 => ((speed + 2).to_string(), options.quantizer.div_ceil(4).clamp(1, 63)),
            // and here one for five; of the presets the slowest and the fastest gain nothing
            Library::X264 => {
                let presets = ["veryslow", "slower", "slow", "medium", "fast", "faster"];
                (presets[usize::from(speed) / 2].to_owned(), options.quantizer.div_ceil(5).clamp(1, 51))
            }
        }
    }

    fn arguments(self, options: &VideoOptions) -> Vec<String> {
        let (preset, crf) = self.preset_and_crf(options);
        let (crf, interval) = (crf.to_string(), options.key_interval.max(1).to_string());
        let mut all = vec!["-c:v", self.library.name(), "-preset", &preset, "-crf", &crf, "-g", &interval];
        // one thread: stretches are encoded side by side
        let parameters = format!("lp=1:{SVT_PARAMETERS}");
        let rest: &[&str] = match self.library {
            Library::SvtAv1 => &["-svtav1-params", &parameters, "-f", "ivf", "-"],
            Library::X264 => &["-bf", "0", "-threads", "1", "-x264-params", "aud=1:scenecut=0", "-f", "h264", "-"],
        };
        all.extend(rest);
        all.into_iter().map(str::to_owned).collect()
    }

    fn samples(self, bytes: &[u8]) -> Option<Vec<Sample>> {
        match self.library {
            Library::SvtAv1 => frames(bytes).map(Sample::of_unit).collect(),
            Library::X264 => Sample::of_h264_stream(bytes),
        }
    }
}

impl Ffmpeg {
    /// Looks whether a program is an FFmpeg.
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
        let encoders = ask(&["-hide_banner", "-encoders"])?;
        Ok(Self { program: program.to_owned(), version, encoders })
    }

    /// Decodes a file from its first frame on.
    pub(crate) fn decode(&self, file: &Path, info: &video::Info) -> Result<Decoding, VideoError> {
        let name = file.display().to_string();
        let failed = |source| VideoError::Io { name: name.clone(), operation: "decode it with FFmpeg", source };
        // a path that looks like an option or a protocol is none; nothing but this file is opened
        let mut url = std::ffi::OsString::from("file:");
        url.push(file);
        let mut child = Command::new(&self.program)
            .args(["-hide_banner", "-loglevel", "error", "-nostdin", "-xerror", "-protocol_whitelist", "file"])
            .args(["-threads", "1", "-noautorotate", "-f", "mov", "-i"])
            .arg(url)
            .args(["-map", "0:v:0", "-fps_mode", "passthrough", "-f", "rawvideo", "-pix_fmt", "rgb24", "pipe:1"])
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .map_err(failed)?;
        let (images, words) = (child.stdout.take(), child.stderr.take().map(listen));
        Ok(Decoding { name, child, images, words, next: 0, frames: info.frames })
    }
}

/// A file that FFmpeg decodes, frame by frame.
pub(crate) struct Decoding {
    name: String,
    child: Child,
    images: Option<ChildStdout>,
    words: Option<JoinHandle<String>>,
    next: usize,
    frames: usize,
}

impl Decoding {
    /// The next frame into `out`, which has its size; its number.
    pub(crate) fn next_into(&mut self, out: &mut [u8]) -> Result<usize, VideoError> {
        let frame = self.next;
        let read = self.images.as_mut().map(|images| images.read_exact(out));
        if !matches!(read, Some(Ok(()))) {
            return Err(self.ended());
        }
        self.next += 1;
        if self.next == self.frames {
            // one more would be one too many
            let more = self.images.as_mut().is_some_and(|images| !matches!(images.read(&mut [0]), Ok(0)));
            if more {
                let reason = format!("FFmpeg gives more than {} frames", self.frames);
                return Err(VideoError::Decode { name: self.name.clone(), frame, reason });
            }
        }
        Ok(frame)
    }

    fn ended(&mut self) -> VideoError {
        self.images = None;
        let status = self.child.wait().map_or_else(|e| e.to_string(), |status| status.to_string());
        let words = self.words.take().and_then(|words| words.join().ok()).unwrap_or_default();
        let words = if words.is_empty() { words } else { format!(": {words}") };
        let reason = format!("FFmpeg ended with {status}{words}");
        VideoError::Decode { name: self.name.clone(), frame: self.next, reason }
    }
}

impl Drop for Decoding {
    fn drop(&mut self) {
        end(&mut self.child);
    }
}

/// Ends a process; of one that has ended there is nothing to do.
fn end(child: &mut Child) {
    let _ = child.kill();
    let _ = child.wait();
}

/// The last line that a process says.
fn listen(mut from: std::process::ChildStderr) -> JoinHandle<String> {
    std::thread::spawn(move || {
        let mut bytes = Vec::new();
        let _ = from.read_to_end(&mut bytes); // what it said until then
        String::from_utf8_lossy(&bytes).trim().lines().next_back().unwrap_or_default().to_owned()
    })
}

/// Bytes that a pipe holds.
const PIPE: usize = 1 << 16;

/// Images that are being encoded.
pub(crate) struct Encoding {
    chosen: Chosen,
    size: (usize, usize),
    rate: Rate,
    child: Child,
    images: Option<BufWriter<ChildStdin>>,
    video: Option<JoinHandle<std::io::Result<Vec<u8>>>>,
    words: Option<JoinHandle<String>>,
    pushed: usize,
}

impl Encoding {
    pub(crate) fn new(
        chosen: Chosen,
        (width, height): (usize, usize),
        rate: Rate,
        options: &VideoOptions,
    ) -> Result<Self> {
        let failed = |reason: String| VideoError::Encode { width, height, fps: rate.fps(), reason };
        video::check_size(width, height).map_err(|reason| failed(reason.to_owned()))?;
        let program = &chosen.ffmpeg.program;
        let mut child = Command::new(program)
            .args(["-hide_banner", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "yuv420p"])
            .args(["-s", &format!("{width}x{height}"), "-r", &format!("{}/{}", rate.numerator, rate.denominator)])
            .args(["-i", "-"])
            .args(chosen.arguments(options))
            .env("SVT_LOG", "1")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .map_err(|e| failed(format!("{} cannot be started: {e}", program.display())))?;
        let images = child.stdin.take().map(|to| BufWriter::with_capacity(PIPE, to));
        let (video, words) = (child.stdout.take(), child.stderr.take());
        let read = |mut from: std::process::ChildStdout| {
            std::thread::spawn(move || {
                let mut bytes = Vec::new();
                from.read_to_end(&mut bytes).map(|_| bytes)
            })
        };
        let (video, words) = (video.map(read), words.map(listen));
        Ok(Self { chosen, size: (width, height), rate, child, images, video, words, pushed: 0 })
    }

    fn failed(&self, reason: String) -> DatasetError {
        let (width, height) = self.size;
        let reason = format!("{}: {reason}", self.chosen.ffmpeg.program.display());
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
        if self.images.take().is_some_and(|to| to.into_inner().is_err()) {
            return Err(self.ended());
        }
        let bytes = self.video.take().and_then(|video| video.join().ok()).and_then(std::io::Result::ok);
        let (Some(bytes), Ok(true)) = (bytes, self.child.wait().map(|status| status.success())) else {
            return Err(self.ended());
        };
        match self.chosen.samples(&bytes) {
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
        end(&mut self.child);
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
