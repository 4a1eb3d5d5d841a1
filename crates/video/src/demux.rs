//! From the bytes of an MP4 file to one video track: its codec, its samples and when they are shown.

use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;

use crate::boxes::{Fields, Kind, bad_box, child, children, name_of, needed};
use crate::error::{Result, VideoError};
use crate::table::{self, Place};

/// Bytes of box `moov`: tables of several million samples.
const MAX_MOOV: u64 = 96 << 20;
/// Boxes outside of others.
const MAX_BOXES: usize = 4096;
/// Pixels in a row and rows.
const MAX_SIDE: u16 = 8192;
/// Pixels of a picture.
pub(crate) const MAX_PIXELS: u64 = 1 << 24;

/// What a video is encoded with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Codec {
    /// AV1.
    Av1,
    /// H.264, also AVC.
    H264,
    /// Another one, by its name in LeRobot, which is not read here.
    Other(&'static str),
}

impl Codec {
    /// As LeRobot's `info.json` names it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Av1 => "av1",
            Self::H264 => "h264",
            Self::Other(name) => name,
        }
    }
}

/// Where the bytes come from: a file, read where it is needed, or memory.
#[derive(Debug)]
pub(crate) enum Bytes {
    File(File, u64),
    Memory(Vec<u8>),
}

impl Bytes {
    pub fn len(&self) -> u64 {
        match self {
            Self::File(_, length) => *length,
            Self::Memory(bytes) => bytes.len() as u64,
        }
    }

    /// Fills `out` from `offset` on; everything up to there must be known to exist.
    pub fn read(&self, name: &str, offset: u64, out: &mut [u8]) -> Result<()> {
        let failed = |source| VideoError::Io { name: name.to_owned(), operation: "read it", source };
        match self {
            Self::File(file, _) => file.read_exact_at(out, offset).map_err(failed),
            Self::Memory(bytes) => {
                let from = usize::try_from(offset).unwrap_or(usize::MAX);
                let part = bytes.get(from..).and_then(|rest| rest.get(..out.len()));
                out.copy_from_slice(part.ok_or_else(|| failed(io::ErrorKind::UnexpectedEof.into()))?);
                Ok(())
            }
        }
    }
}

/// The one video track of a file.
#[derive(Debug)]
pub(crate) struct Track {
    pub codec: Codec,
    pub width: u16,
    pub height: u16,
    /// Ticks in a second.
    pub timescale: u32,
    /// Samples in the order in which they are decoded; times count from the first frame shown.
    pub places: Vec<Place>,
    /// Content of `av1C` or `avcC`.
    pub config: Vec<u8>,
    /// Why its pictures are not read here, as far as the tables say.
    pub unread: Option<String>,
}

/// Finds the track in a file.
pub(crate) fn track(name: &str, bytes: &Bytes) -> Result<Track> {
    let moov = moov(name, bytes)?;
    let unsupported = |what: String| VideoError::Unsupported { name: name.to_owned(), what };
    let mut tracks = Vec::new();
    for found in children(name, "moov", &moov) {
        let (kind, content) = found?;
        match &kind {
            b"mvex" => return Err(unsupported("a fragmented MP4 file (mvex)".to_owned())),
            b"trak" => {
                let mdia = needed(name, "trak", content, *b"mdia")?;
                let hdlr = Fields(needed(name, "mdia", mdia, *b"hdlr")?);
                if hdlr.0.get(8..12) == Some(b"vide") {
                    tracks.push((content, mdia));
                }
            }
            _ => {}
        }
    }
    let &[(trak, mdia)] = tracks.as_slice() else {
        return Err(unsupported(format!("a file with {} video tracks", tracks.len())));
    };
    if child(name, "trak", trak, *b"tkhd")?.is_some_and(turns) {
        return Err(unsupported("a video that is to be turned or mirrored (matrix of box tkhd)".to_owned()));
    }
    let timescale = timescale(name, "mdhd", needed(name, "mdia", mdia, *b"mdhd")?)?;
    let movie = timescale_of_movie(name, &moov)?;
    let stbl = needed(name, "minf", needed(name, "mdia", mdia, *b"minf")?, *b"stbl")?;
    let entry = entry(name, needed(name, "stbl", stbl, *b"stsd")?)?;
    let mut places = table::places(name, stbl, bytes.len())?;
    let edits =
        child(name, "trak", trak, *b"edts")?.map(|edts| child(name, "edts", edts, *b"elst")).transpose()?.flatten();
    shift(name, edits, movie, timescale, &mut places)?;
    let Entry { codec, width, height, config, unread } = entry;
    Ok(Track { codec, width, height, timescale, places, config: config.to_vec(), unread })
}

/// Whether box `tkhd` asks players to turn, mirror or scale the pictures. LeRobot's readers do not agree on what that means.
fn turns(tkhd: &[u8]) -> bool {
    let before = if tkhd.first() == Some(&1) { 52 } else { 40 };
    let Some(matrix) = tkhd.get(before..before + 36) else { return false };
    let number = |i: usize| matrix[4 * i..4 * i + 4].iter().fold(0_u32, |n, &byte| n << 8 | u32::from(byte));
    // a and d on the diagonal, b and c beside it; where the picture is put on a screen is nothing to us
    let linear = [0, 1, 3, 4].map(number);
    linear != [0x0001_0000, 0, 0, 0x0001_0000] && linear != [0; 4]
}

/// The content of box `moov`.
fn moov(name: &str, bytes: &Bytes) -> Result<Vec<u8>> {
    let length = bytes.len();
    let mut at = 0;
    let mut found = None;
    for number in 0.. {
        if length - at < 8 {
            break;
        }
        if number == MAX_BOXES {
            let limit = MAX_BOXES as u64;
            return Err(VideoError::TooLarge {
                name: name.to_owned(),
                object: "boxes".into(),
                found: limit + 1,
                limit,
            });
        }
        let mut head = [0; 16];
        let there = (length - at).min(16) as usize;
        bytes.read(name, at, &mut head[..there])?;
        let mut fields = Fields(&head[..there]);
        let (size, kind) = (fields.u32().map_or(0, u64::from), fields.array().unwrap_or_default());
        let (size, before) = match size {
            0 => (length - at, 8),
            1 => (fields.u64().unwrap_or(0), 16),
            n => (n, 8),
        };
        if number == 0 && &kind != b"ftyp" {
            return Err(not_mp4(name, &head[..there]));
        }
        if size < before {
            let found = format!("{size} bytes at byte {at}");
            return Err(bad_box(name, &name_of(kind), format!("{before} bytes or more"), found));
        }
        let end = at.saturating_add(size);
        if end > length {
            let object = format!("box {}", name_of(kind));
            return Err(VideoError::Truncated { name: name.to_owned(), object, expected: end, found: length });
        }
        match &kind {
            b"moof" | b"styp" | b"sidx" => {
                let what = format!("a fragmented MP4 file ({})", name_of(kind));
                return Err(VideoError::Unsupported { name: name.to_owned(), what });
            }
            b"moov" if found.is_none() => found = Some((at + before, size - before)),
            _ => {}
        }
        at = end;
    }
    if length < 8 {
        let mut head = vec![0; length as usize];
        bytes.read(name, 0, &mut head)?;
        return Err(not_mp4(name, &head));
    }
    let Some((from, size)) = found else {
        return Err(bad_box(name, "moov", "one, which says what the file holds", "none: the file was never finished"));
    };
    if size > MAX_MOOV {
        let object = "bytes of box moov".to_owned();
        return Err(VideoError::TooLarge { name: name.to_owned(), object, found: size, limit: MAX_MOOV });
    }
    let mut content = vec![0; size as usize];
    bytes.read(name, from, &mut content)?;
    Ok(content)
}

fn not_mp4(name: &str, head: &[u8]) -> VideoError {
    let found = match head {
        [] => "an empty file".to_owned(),
        _ => format!("{:02x?}", &head[..head.len().min(8)]),
    };
    VideoError::NotMp4 { name: name.to_owned(), found }
}

fn timescale_of_movie(name: &str, moov: &[u8]) -> Result<u32> {
    timescale(name, "mvhd", needed(name, "moov", moov, *b"mvhd")?)
}

/// Ticks in a second, of `mvhd` and `mdhd`, which begin alike.
fn timescale(name: &str, kind: &str, data: &[u8]) -> Result<u32> {
    let mut fields = Fields(data);
    let found = fields.version().and_then(|version| {
        fields.take(if version == 1 { 16 } else { 8 })?;
        fields.u32()
    });
    match found {
        Some(ticks) if ticks > 0 => Ok(ticks),
        found => Err(bad_box(name, kind, "ticks in a second", format!("{found:?}"))),
    }
}

/// Names of codecs that are known and not read, for people and in FFmpeg.
const OTHERS: [(&[Kind], &str, &str); 8] = [
    (&[*b"hvc1", *b"hev1", *b"dvh1", *b"dvhe"], "HEVC (H.265)", "hevc"),
    (&[*b"vvc1", *b"vvi1"], "VVC (H.266)", "vvc"),
    (&[*b"vp08", *b"vp09"], "VP8 or VP9", "vp9"),
    (&[*b"mp4v"], "MPEG-4 part 2", "mpeg4"),
    (&[*b"avc2", *b"avc3", *b"avc4"], "H.264 with parameters inside the stream", "h264"),
    (&[*b"mjpa", *b"mjpb", *b"jpeg", *b"mjp2"], "Motion JPEG", "mjpeg"),
    (&[*b"png ", *b"raw "], "images without a video codec", "rawvideo"),
    (&[*b"apcn", *b"apch", *b"apcs", *b"apco", *b"ap4h"], "ProRes", "prores"),
];

/// What a sample entry says.
struct Entry<'a> {
    codec: Codec,
    width: u16,
    height: u16,
    config: &'a [u8],
    /// Why it is not read.
    unread: Option<String>,
}

/// Codec, size and configuration of the one sample entry in box `stsd`.
fn entry<'a>(name: &'a str, stsd: &'a [u8]) -> Result<Entry<'a>> {
    let mut fields = Fields(stsd);
    let count = fields.version().and_then(|_| fields.u32());
    let mut entries = children(name, "stsd", fields.0);
    let (Some(1), Some(first)) = (count, entries.next()) else {
        return Err(bad_box(name, "stsd", "one sample entry", format!("{count:?}")));
    };
    let (kind, content) = first?;
    let kind_name = name_of(kind);
    let (codec, config_kind, mut unread) = match &kind {
        b"av01" => (Codec::Av1, Some(*b"av1C"), None),
        b"avc1" => (Codec::H264, Some(*b"avcC"), None),
        b"encv" => {
            return Err(VideoError::Unsupported { name: name.to_owned(), what: "encrypted video (encv)".to_owned() });
        }
        _ => {
            let known = OTHERS.iter().find(|(kinds, ..)| kinds.contains(&kind));
            let (what, codec) = known.map_or(("a codec unknown here", "unknown"), |(_, what, codec)| (*what, *codec));
            (Codec::Other(codec), None, Some(format!("{what} ({kind_name})")))
        }
    };
    let mut fields = Fields(content);
    // reserved, index of the data reference, then reserved again up to the size
    let size = fields.take(24).and_then(|_| fields.u16()).zip(fields.u16());
    let Some(((width, height), rest)) = size.and_then(|size| {
        Some((size, {
            fields.take(50)?;
            fields.0
        }))
    }) else {
        return Err(bad_box(name, &kind_name, "a visual sample entry", format!("{} bytes", content.len())));
    };
    let pixels = u64::from(width) * u64::from(height);
    if width > MAX_SIDE || height > MAX_SIDE || pixels > MAX_PIXELS {
        let object = format!("pixels of {width} x {height}");
        return Err(VideoError::TooLarge { name: name.to_owned(), object, found: pixels, limit: MAX_PIXELS });
    }
    if width == 0 || height == 0 {
        return Err(bad_box(name, &kind_name, "a size above 0", format!("{width} x {height}")));
    }
    if height % 2 == 1 {
        // LeRobot's readers interpolate the colour of such pictures; a rule that was not measured is not guessed
        unread = unread.or(Some(format!("a video of odd height ({width} x {height})")));
    }
    let Some(config_kind) = config_kind else { return Ok(Entry { codec, width, height, config: &[], unread }) };
    if let Some(colr) = child(name, "av01", rest, *b"colr")? {
        unread = unread.or(colour(colr));
    }
    let kind_name: &'static str = if codec == Codec::Av1 { "av01" } else { "avc1" };
    let config = needed(name, kind_name, rest, config_kind)?;
    Ok(Entry { codec, width, height, config, unread })
}

/// Why the colours that box `colr` states are not read.
fn colour(colr: &[u8]) -> Option<String> {
    let mut fields = Fields(colr);
    if !matches!(fields.array().as_ref(), Some(b"nclx" | b"nclc")) {
        return None; // an ICC profile, which video players pass over
    }
    let matrix = fields.take(4).and_then(|_| fields.u16());
    let full = fields.u8().is_some_and(|flags| flags & 0x80 != 0);
    unread_colour(matrix.unwrap_or(2), full)
}

/// Refuses colours that the rule of `colour.rs` does not hold for; `matrix` counts as in H.273.
pub(crate) fn refuse_colour(name: &str, matrix: u16, full_range: bool) -> Result<()> {
    match unread_colour(matrix, full_range) {
        Some(what) => Err(VideoError::Unsupported { name: name.to_owned(), what }),
        None => Ok(()),
    }
}

fn unread_colour(matrix: u16, full_range: bool) -> Option<String> {
    match matrix {
        _ if full_range => Some("full-range colour".to_owned()),
        2 | 5 | 6 => None,
        0 => Some("RGB inside the video (identity matrix)".to_owned()),
        1 => Some("colour matrix BT.709".to_owned()),
        9 | 10 => Some("colour matrix BT.2020".to_owned()),
        n => Some(format!("colour matrix {n}")),
    }
}

/// Moves the times of all samples as the edit list says, so that the first frame shown is at its place.
fn shift(name: &str, edits: Option<&[u8]>, movie: u32, timescale: u32, places: &mut [Place]) -> Result<()> {
    let unsupported = |what: &str| VideoError::Unsupported { name: name.to_owned(), what: what.to_owned() };
    let (mut skipped, mut delay, mut shown) = (0_i64, 0_i64, 0_u64);
    if let Some(data) = edits {
        let mut fields = Fields(data);
        let short = || bad_box(name, "elst", "all the entries that it counts", "fewer bytes");
        let version = fields.version().ok_or_else(short)?;
        let count = fields.u32().ok_or_else(short)?;
        for number in 0..count {
            let (duration, from) = match version {
                1 => (fields.u64().ok_or_else(short)?, fields.u64().ok_or_else(short)? as i64),
                _ => (u64::from(fields.u32().ok_or_else(short)?), i64::from(fields.u32().ok_or_else(short)? as i32)),
            };
            if fields.u32().ok_or_else(short)? != 0x0001_0000 {
                return Err(unsupported("an edit list that changes the speed"));
            }
            match (number, from) {
                (0, -1) if count == 2 => {
                    // nothing is shown for a while
                    let ticks = u128::from(duration) * u128::from(timescale) / u128::from(movie);
                    delay = i64::try_from(ticks).ok().filter(|&t| t < 1 << 56).ok_or_else(short)?;
                }
                (n, from) if n + 1 == count && (0..1 << 56).contains(&from) => {
                    skipped = from;
                    shown = duration;
                }
                _ => return Err(unsupported("an edit list of several pieces")),
            }
        }
    }
    let (mut least, mut end, mut longest) = (i64::MAX, i64::MIN, 0);
    for place in places.iter_mut() {
        place.time = place.time - skipped + delay;
        least = least.min(place.time);
        end = end.max(place.time + i64::from(place.ticks));
        longest = longest.max(place.ticks);
    }
    // the list counts in ticks of the movie, which are coarser than those of the track: a frame is not cut by rounding
    let limit = u128::from(shown) * u128::from(timescale) / u128::from(movie) + u128::from(longest);
    let cut_at_end = shown > 0 && u128::try_from(end - delay).is_ok_and(|end| end > limit);
    if least < 0 || cut_at_end {
        return Err(unsupported("an edit list that cuts frames away"));
    }
    Ok(())
}
