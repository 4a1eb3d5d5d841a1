//! A video of a data set: read in this process, or in one of its own where the program has armed that.

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use video::{Frames, Info, TOLERANCE, Video, VideoError};

use super::isolation::{
    self, ARRAY, Ask, BEAT, ERROR, PLAN, Remote, VIDEO_VARIABLE, limit_cpu, limit_self, next_request, send,
};
use super::walk::is_lfs_pointer;
use crate::error::InputError;
use crate::ffmpeg::{self, Decoding, Ffmpeg};

/// Processor time for opening a file.
const OPEN_SECONDS: u64 = 6;
/// Pixels that are decoded in a second, at least; and how often a file may be read from its beginning to its end.
const PIXELS_PER_CPU_SECOND: u64 = 500_000;
const READINGS: u64 = 4;
/// How often a reading process that decodes says that it does.
const BEAT_EVERY: Duration = Duration::from_secs(1);
/// Bytes of pictures in an answer.
const ANSWER: usize = 16 << 20;

/// What a video says about itself.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct VideoInfo {
    /// Pixels in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Frames a second, on average.
    pub fps: f64,
    /// Frames.
    pub frames: usize,
    /// `av1`, `h264`, or another one that FFmpeg decodes.
    pub codec: String,
    /// When each frame is shown, in seconds as the bits of an f64: text would round.
    times: Vec<u64>,
}

impl VideoInfo {
    fn of(info: &video::Info) -> Self {
        Self {
            width: info.width,
            height: info.height,
            fps: info.fps,
            frames: info.frames,
            codec: info.codec.name().to_owned(),
            times: info.timestamps.iter().map(|t| t.to_bits()).collect(),
        }
    }

    /// When a frame is shown, in seconds.
    pub fn seconds(&self, frame: usize) -> Option<f64> {
        self.times.get(frame).map(|&bits| f64::from_bits(bits))
    }

    /// The frame shown at `seconds`, within LeRobot's tolerance of 1e-4 s.
    pub fn frame_at(&self, seconds: f64) -> Option<usize> {
        let after = self.times.partition_point(|&bits| f64::from_bits(bits) < seconds);
        let near = [after.checked_sub(1), Some(after)].into_iter().flatten();
        let near = near.filter_map(|i| Some((i, (self.seconds(i)? - seconds).abs())));
        near.filter(|&(_, distance)| distance <= TOLERANCE).min_by(|a, b| a.1.total_cmp(&b.1)).map(|(i, _)| i)
    }
}

/// An opened video file.
pub struct VideoFile {
    path: PathBuf,
    info: VideoInfo,
    backend: Backend,
}

enum Backend {
    Local(Box<Film>),
    Remote(Remote),
}

#[derive(Debug, Clone, Serialize, Deserialize)]
struct Pictures {
    first: usize,
    count: usize,
}

impl Ask for Pictures {
    fn words(&self) -> String {
        format!("decode frames {} to {}", self.first, self.first + self.count - 1)
    }
}

/// The error with what caused it, so that it crosses from the reading process.
pub(crate) fn plain(path: &Path, error: &VideoError) -> InputError {
    let causes = std::iter::successors(std::error::Error::source(error), |e| e.source());
    match error {
        VideoError::Io { source, .. } if source.kind() == std::io::ErrorKind::NotFound => {
            InputError::NotFound { path: path.to_owned() }
        }
        _ if is_lfs_pointer(path) => InputError::LfsPointer { path: path.to_owned() },
        _ => {
            let text = causes.fold(error.to_string(), |text, cause| format!("{text}: {cause}"));
            InputError::Video { path: path.to_owned(), text }
        }
    }
}

/// A video, and what decodes it.
enum Film {
    Builtin(Video),
    Ffmpeg(PathBuf, Info, &'static Ffmpeg),
}

impl Film {
    fn open(path: &Path) -> Result<Self, InputError> {
        let error = match Video::open(path) {
            Ok(video) => return Ok(Self::Builtin(video)),
            Err(error) => error,
        };
        // the tables are ours whatever decodes the pictures
        match (&error, Info::of(path), ffmpeg::found()) {
            (VideoError::Unsupported { .. }, Ok(info), Ok(ffmpeg)) => Ok(Self::Ffmpeg(path.to_owned(), info, ffmpeg)),
            (VideoError::Unsupported { .. }, Ok(_), Err(reason)) => {
                let text = format!(
                    "{error}. FFmpeg reads it: install `ffmpeg`, or `pip install imageio-ffmpeg` and set ACTRM_FFMPEG to its \
                     program (now: {reason})"
                );
                Err(InputError::Video { path: path.to_owned(), text })
            }
            _ => Err(plain(path, &error)),
        }
    }

    fn info(&self) -> &Info {
        match self {
            Self::Builtin(video) => video.info(),
            Self::Ffmpeg(_, info, _) => info,
        }
    }

    /// Frames of a range, which lies in the file.
    fn range(&self, range: Range<usize>) -> Result<Decoder<'_>, VideoError> {
        match self {
            Self::Builtin(video) => Ok(Decoder::Builtin(video.range(range)?)),
            Self::Ffmpeg(path, info, ffmpeg) => Ok(Decoder::Ffmpeg(ffmpeg.decode(path, info)?, range)),
        }
    }
}

/// Frames, one after the other.
enum Decoder<'v> {
    Builtin(Frames<'v>),
    Ffmpeg(Decoding, Range<usize>),
}

impl Decoder<'_> {
    /// The next frame into `out`; `decoded` is called after every one that had to be decoded for it.
    fn next_into(&mut self, out: &mut [u8], decoded: &mut dyn FnMut()) -> Option<Result<usize, VideoError>> {
        match self {
            Self::Builtin(frames) => frames.next_watched(out, decoded),
            Self::Ffmpeg(decoding, range) => {
                let wanted = range.next()?;
                loop {
                    let frame = decoding.next_into(out);
                    decoded();
                    match frame {
                        Ok(frame) if frame < wanted => {}
                        other => return Some(other),
                    }
                }
            }
        }
    }
}

impl VideoFile {
    /// Opens a file: in a process of its own where the program has called [`isolation::serve_if_child`], in this one
    /// else.
    pub fn open(path: &Path) -> Result<Self, InputError> {
        let (info, backend) = match isolation::armed() {
            true => {
                let (remote, info) = Remote::start(path, VIDEO_VARIABLE)?;
                (info, Backend::Remote(remote))
            }
            false => {
                let film = Film::open(path)?;
                (VideoInfo::of(film.info()), Backend::Local(Box::new(film)))
            }
        };
        Ok(Self { path: path.to_owned(), info, backend })
    }

    /// What it says about itself.
    pub fn info(&self) -> &VideoInfo {
        &self.info
    }

    /// Gives the pictures of `frames` to `take` in order: rows from the top, pixels from the left, red, green, blue.
    pub fn read(&self, frames: Range<usize>, take: &mut dyn FnMut(usize, &[u8])) -> Result<(), InputError> {
        if frames.end > self.info.frames {
            return Err(InputError::NoSuch {
                path: self.path.clone(),
                wanted: format!("frames {} to {}", frames.start, frames.end),
                found: format!("{} frames", self.info.frames),
            });
        }
        let size = self.info.width * self.info.height * 3;
        match &self.backend {
            Backend::Local(film) => {
                let failed = |e: VideoError| plain(&self.path, &e);
                let mut picture = vec![0; size];
                let mut decoded = film.range(frames).map_err(failed)?;
                while let Some(frame) = decoded.next_into(&mut picture, &mut || {}) {
                    take(frame.map_err(failed)?, &picture);
                }
            }
            Backend::Remote(remote) => {
                let step = (ANSWER / size.max(1)).max(1);
                for first in frames.clone().step_by(step) {
                    let request = Pictures { first, count: step.min(frames.end - first) };
                    let (kind, body) = remote.exchange(Some(&request))?;
                    if kind != ARRAY || body.len() != request.count * size {
                        return Err(InputError::ReaderDied {
                            path: self.path.clone(),
                            during: request.words(),
                            how: "gave an answer that makes no sense".to_owned(),
                        });
                    }
                    body.chunks_exact(size).enumerate().for_each(|(i, picture)| take(first + i, picture));
                }
            }
        }
        Ok(())
    }
}

/// The reading process: opens the file, says what it is and decodes what is asked for.
pub(super) fn serve(path: &Path) -> std::io::Result<()> {
    limit_self(OPEN_SECONDS, None)?;
    let mut out = std::io::stdout().lock();
    let _ = rustix::pipe::fcntl_setpipe_size(&out, 1 << 20);
    let film = match Film::open(path) {
        Ok(film) => film,
        Err(error) => return send(&mut out, ERROR, &serde_json::to_vec(&error)?),
    };
    let info = film.info();
    let pixels = (info.width * info.height).max(64 * 64) as u64 * info.frames as u64;
    let seconds = OPEN_SECONDS + READINGS * pixels / PIXELS_PER_CPU_SECOND;
    limit_cpu(seconds, Some(seconds))?;
    send(&mut out, PLAN, &serde_json::to_vec(&VideoInfo::of(info))?)?;
    let size = info.picture_bytes();
    let mut requests = std::io::stdin().lock();
    let mut body = Vec::new();
    // decoding goes on where the last request ended
    let mut going: Option<(usize, Decoder<'_>)> = None;
    while let Some(text) = next_request(&mut requests)? {
        let Pictures { first, count } = serde_json::from_slice(&text)?;
        let mut frames = match going.take() {
            Some((next, frames)) if next == first => Ok(frames),
            _ => film.range(first..info.frames),
        };
        body.resize(count * size, 0);
        let mut filled = Ok(());
        if let Ok(frames) = &mut frames {
            let missing = || VideoError::NoSuchFrame {
                name: path.display().to_string(),
                wanted: format!("frames {first} to {}", first + count),
                found: format!("{} frames", info.frames),
            };
            // a sound file may have its last key frame minutes before what is wanted
            let mut told = Instant::now();
            let mut beat = || {
                if told.elapsed() >= BEAT_EVERY {
                    told = Instant::now();
                    // a parent that has gone is noticed when the answer is sent
                    let _ = send(&mut out, BEAT, &[]);
                }
            };
            filled = body.chunks_exact_mut(size).try_for_each(|picture| {
                frames.next_into(picture, &mut beat).unwrap_or_else(|| Err(missing())).map(|_| ())
            });
        }
        match frames.and_then(|frames| filled.map(|()| frames)) {
            Ok(frames) => {
                going = Some((first + count, frames));
                send(&mut out, ARRAY, &body)?;
            }
            Err(error) => send(&mut out, ERROR, &serde_json::to_vec(&plain(path, &error))?)?,
        }
    }
    Ok(())
}
