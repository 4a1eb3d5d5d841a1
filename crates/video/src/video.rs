//! A video that can be read: what it says about itself, and its pictures in the order in which they are shown.

use std::collections::BTreeMap;
use std::fs::File;
use std::ops::Range;
use std::path::Path;

use crate::Sample;
use crate::decode::{Decoder, Setup};
use crate::demux::{self, Bytes, Codec, Track};
use crate::error::{Result, VideoError};

/// How far a frame may lie from the time that was asked for, in seconds: LeRobot's.
pub const TOLERANCE: f64 = 1e-4;
/// Pictures that may wait for one that is decoded later and shown earlier: what H.264 allows.
const MAX_WAITING: usize = 16;

/// What a video says about itself.
#[derive(Debug, Clone, PartialEq)]
pub struct Info {
    /// Pixels in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Frames a second, on average.
    pub fps: f64,
    /// Frames.
    pub frames: usize,
    /// What it is encoded with.
    pub codec: Codec,
    /// When each frame is shown, in seconds, ascending.
    pub timestamps: Vec<f64>,
}

impl Info {
    /// What the tables of a file say, whatever it is encoded with: for a decoder of others.
    pub fn of(path: &Path) -> Result<Self> {
        let (name, bytes) = opened(path)?;
        Ok(tables(&name, &bytes)?.1)
    }

    /// Bytes of a picture.
    pub fn picture_bytes(&self) -> usize {
        self.width * self.height * 3
    }

    /// The frame shown at `seconds`, within [`TOLERANCE`].
    pub fn frame_at(&self, seconds: f64) -> Option<usize> {
        let after = self.timestamps.partition_point(|&t| t < seconds);
        let near = [after.checked_sub(1), Some(after)].into_iter().flatten();
        let near = near.filter_map(|i| Some((i, (self.timestamps.get(i)? - seconds).abs())));
        near.filter(|&(_, distance)| distance <= TOLERANCE).min_by(|a, b| a.1.total_cmp(&b.1)).map(|(i, _)| i)
    }
}

/// An opened video file.
#[derive(Debug)]
pub struct Video {
    name: String,
    bytes: Bytes,
    track: Track,
    setup: Setup,
    info: Info,
    /// Sample of each frame.
    order: Vec<u32>,
}

/// One picture.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// Its number, from 0, in the order in which frames are shown.
    pub index: usize,
    /// When it is shown, in seconds.
    pub timestamp: f64,
    /// Rows from the top, pixels from the left, red, green and blue.
    pub rgb: Vec<u8>,
}

impl Video {
    /// Opens a file: reads its tables and its first sample, decodes nothing.
    pub fn open(path: &Path) -> Result<Self> {
        let (name, bytes) = opened(path)?;
        Self::new(name, bytes)
    }

    /// A file that is in memory; `name` stands for it in errors.
    pub fn from_bytes(name: &str, bytes: Vec<u8>) -> Result<Self> {
        Self::new(name.to_owned(), Bytes::Memory(bytes))
    }

    fn new(name: String, bytes: Bytes) -> Result<Self> {
        let (track, info, order) = tables(&name, &bytes)?;
        if let Some(what) = track.unread {
            return Err(VideoError::Unsupported { name, what });
        }
        let mut first = Vec::new();
        read_sample(&name, &bytes, &track, 0, &mut first)?;
        let setup = Setup::of(&name, &track, &first)?;
        Ok(Self { name, bytes, track, setup, info, order })
    }

    /// What it says about itself.
    pub fn info(&self) -> &Info {
        &self.info
    }

    /// All frames.
    pub fn frames(&self) -> Frames<'_> {
        Frames::new(self, 0..self.order.len())
    }

    /// Frames of a range, from the key frame before it on.
    pub fn range(&self, range: Range<usize>) -> Result<Frames<'_>> {
        if range.start > range.end || range.end > self.order.len() {
            return Err(self.none(format!("frames {} to {}", range.start, range.end)));
        }
        Ok(Frames::new(self, range))
    }

    /// The frame shown at `seconds`, within [`TOLERANCE`].
    pub fn frame_at(&self, seconds: f64) -> Result<Frame> {
        let index = self.info.frame_at(seconds).ok_or_else(|| self.none(format!("frame at {seconds} s")))?;
        let mut frames = self.range(index..index + 1)?;
        frames.next().unwrap_or_else(|| Err(self.none(format!("frame {index}"))))
    }

    /// The samples of a range of frames as they lie in the file, for another file ([`crate::Muxer`]): nothing is decoded.
    ///
    /// # Errors
    /// [`VideoError::Cut`] where they would not be the same pictures elsewhere: the first one needs pictures before it, or
    /// the file is H.264, whose samples may lie in another order than they are shown.
    pub fn samples(&self, range: Range<usize>) -> Result<Vec<Sample>> {
        let cut = |reason: String| VideoError::Cut {
            name: self.name.clone(),
            from: range.start,
            to: range.end.saturating_sub(1),
            reason,
        };
        if range.is_empty() || range.end > self.order.len() {
            return Err(self.none(format!("frames {} to {}", range.start, range.end)));
        }
        if self.info.codec != Codec::Av1 {
            return Err(cut(format!("expected av1, found {}", self.info.codec.name())));
        }
        if self.order[range.clone()].iter().zip(range.clone()).any(|(&sample, frame)| sample as usize != frame) {
            return Err(cut("its samples lie in another order than they are shown".to_owned()));
        }
        if !self.track.places[range.start].key {
            return Err(cut("the first is no key frame".to_owned()));
        }
        let mut samples = Vec::with_capacity(range.len());
        for frame in range {
            let mut bytes = Vec::new();
            read_sample(&self.name, &self.bytes, &self.track, frame, &mut bytes)?;
            samples.push(Sample { bytes, key: self.track.places[frame].key, parameters: Vec::new() });
        }
        Ok(samples)
    }

    fn none(&self, wanted: String) -> VideoError {
        let last = self.info.timestamps.last().copied().unwrap_or(0.0);
        let found = format!("{} frames from {} to {last} s", self.order.len(), self.info.timestamps[0]);
        VideoError::NoSuchFrame { name: self.name.clone(), wanted, found }
    }
}

/// A file with its name for errors.
fn opened(path: &Path) -> Result<(String, Bytes)> {
    let name = path.display().to_string();
    let failed = |operation| {
        let name = name.clone();
        move |source| VideoError::Io { name, operation, source }
    };
    let file = File::open(path).map_err(failed("open it"))?;
    let length = file.metadata().map_err(failed("look at it"))?.len();
    Ok((name, Bytes::File(file, length)))
}

/// What the tables of a file say: its track, all that is known of it, and the sample of each frame.
fn tables(name: &str, bytes: &Bytes) -> Result<(Track, Info, Vec<u32>)> {
    let track = demux::track(name, bytes)?;
    let mut order: Vec<u32> = (0..track.places.len() as u32).collect();
    order.sort_by_key(|&sample| track.places[sample as usize].time);
    let seconds = |ticks: i64| ticks as f64 / f64::from(track.timescale);
    let timestamps: Vec<f64> = order.iter().map(|&s| seconds(track.places[s as usize].time)).collect();
    if let Some(at) = timestamps.windows(2).position(|t| t[0] == t[1]) {
        return Err(VideoError::Malformed {
            name: name.to_owned(),
            object: "box stts".to_owned(),
            expected: "a time of its own for each frame".to_owned(),
            found: format!("{} s for frames {at} and {}", timestamps[at], at + 1),
        });
    }
    let duration = seconds(track.places.iter().map(|p| i64::from(p.ticks)).sum());
    let frames = order.len();
    let fps = if duration > 0.0 { frames as f64 / duration } else { f64::from(track.timescale) };
    let (width, height) = (usize::from(track.width), usize::from(track.height));
    let info = Info { width, height, fps, frames, codec: track.codec, timestamps };
    Ok((track, info, order))
}

fn read_sample(name: &str, bytes: &Bytes, track: &Track, sample: usize, out: &mut Vec<u8>) -> Result<()> {
    let place = &track.places[sample];
    out.clear();
    out.resize(place.size as usize, 0);
    bytes.read(name, place.offset, out)
}

/// Pictures of a video, one after the other. After an error there are no more.
pub struct Frames<'v> {
    video: &'v Video,
    range: Range<usize>,
    decoder: Option<Decoder>,
    /// The sample that is decoded next.
    sample: usize,
    data: Vec<u8>,
    /// Pictures that are decoded and not yet due, by sample.
    waiting: BTreeMap<usize, Vec<u8>>,
}

impl<'v> Frames<'v> {
    fn new(video: &'v Video, range: Range<usize>) -> Self {
        // decoding begins with the last key frame that is decoded and shown before the first frame wanted: one that is shown
        // after it (of an open group) follows pictures that the wanted one is made of
        let wanted = video.order.get(range.start).map_or(0, |&s| s as usize);
        let (places, due) = (&video.track.places, video.track.places[wanted].time);
        let key = places[..=wanted].iter().rposition(|p| p.key && p.time <= due).unwrap_or(0);
        Self { video, range, decoder: None, sample: key, data: Vec::new(), waiting: BTreeMap::new() }
    }

    /// Writes the next picture into `out`, [`Info::picture_bytes`] long, and says which it is.
    pub fn next_into(&mut self, out: &mut [u8]) -> Option<Result<usize>> {
        self.next_watched(out, &mut || {})
    }

    /// The same; `decoded` is called after every sample that had to be decoded for it, which may be hundreds.
    pub fn next_watched(&mut self, out: &mut [u8], decoded: &mut dyn FnMut()) -> Option<Result<usize>> {
        if self.range.is_empty() {
            return None;
        }
        let index = self.range.start;
        let result = self.advance(index, out, decoded);
        self.range.start = if result.is_ok() { index + 1 } else { self.range.end };
        Some(result.map(|()| index))
    }

    fn advance(&mut self, index: usize, out: &mut [u8], decoded: &mut dyn FnMut()) -> Result<()> {
        let video = self.video;
        let expected = video.info.picture_bytes();
        if out.len() != expected {
            return Err(video.none(format!("image of {} bytes", out.len())));
        }
        let wanted = video.order[index] as usize;
        if let Some(picture) = self.waiting.remove(&wanted) {
            out.copy_from_slice(&picture);
            return Ok(());
        }
        let failed = |frame: usize, reason: String| VideoError::Decode { name: video.name.clone(), frame, reason };
        if self.decoder.is_none() {
            self.decoder = Some(video.setup.decoder().map_err(|e| failed(self.sample, e))?);
        }
        let late = || failed(wanted, format!("it is shown more than {MAX_WAITING} frames before its turn"));
        if wanted < self.sample {
            return Err(late());
        }
        while self.sample <= wanted {
            let sample = self.sample;
            read_sample(&video.name, &video.bytes, &video.track, sample, &mut self.data)?;
            let key = video.track.places[sample].key;
            let decoder = self.decoder.as_mut().expect("it was made above");
            decoder.decode(&self.data, key, out).map_err(|e| failed(sample, e))?;
            self.sample += 1;
            decoded();
            if sample == wanted {
                break;
            }
            // of those before, the ones that are due later wait
            let time = video.track.places[sample].time;
            if time > video.track.places[wanted].time {
                self.waiting.insert(sample, out.to_vec());
                if self.waiting.len() > MAX_WAITING {
                    return Err(late());
                }
            }
        }
        Ok(())
    }
}

impl Iterator for Frames<'_> {
    type Item = Result<Frame>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.range.is_empty() {
            return None;
        }
        let mut rgb = vec![0; self.video.info.picture_bytes()];
        let index = self.next_into(&mut rgb)?;
        Some(index.map(|index| Frame { index, timestamp: self.video.info.timestamps[index], rgb }))
    }
}
