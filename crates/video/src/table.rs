//! Where a track's samples lie and when they are shown: the boxes of `stbl` put together.

use crate::boxes::{Fields, bad_box, child, needed};
use crate::error::{Result, VideoError};

/// Frames of a file that is read: more than a day at 30 a second.
const MAX_FRAMES: u64 = 1 << 22;
/// Bytes of a sample.
const MAX_SAMPLE: u64 = 32 << 20;

/// One sample, in the order in which it is decoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Place {
    /// First byte in the file.
    pub offset: u64,
    /// Bytes.
    pub size: u32,
    /// When it is shown, in ticks of the track, before the edit list.
    pub time: i64,
    /// How long it is shown, in ticks.
    pub ticks: u32,
    /// Whether decoding can begin with it.
    pub key: bool,
}

/// Reads the tables of box `stbl`; `file_bytes` is what no sample may reach beyond.
pub(crate) fn places(name: &str, stbl: &[u8], file_bytes: u64) -> Result<Vec<Place>> {
    let sizes = sizes(name, stbl, file_bytes)?;
    let offsets = offsets(name, stbl, &sizes, file_bytes)?;
    let mut places: Vec<Place> =
        sizes.iter().zip(offsets).map(|(&size, offset)| Place { offset, size, time: 0, ticks: 0, key: true }).collect();
    times(name, stbl, &mut places)?;
    keys(name, stbl, &mut places)?;
    Ok(places)
}

fn cut_short(name: &str, kind: &str) -> impl Fn() -> VideoError {
    move || bad_box(name, kind, "all the entries that it counts", "fewer bytes")
}

/// The fields of a table behind its version, and its count of entries of `width` bytes, which are all there.
fn table<'a>(name: &'a str, kind: &'a str, data: &'a [u8], width: usize) -> Result<(usize, Fields<'a>)> {
    let mut fields = Fields(data);
    let short = cut_short(name, kind);
    fields.version().ok_or_else(&short)?;
    let count = fields.u32().ok_or_else(&short)? as usize;
    if fields.0.len() / width < count {
        return Err(short());
    }
    Ok((count, fields))
}

fn sizes(name: &str, stbl: &[u8], file_bytes: u64) -> Result<Vec<u32>> {
    if child(name, "stbl", stbl, *b"stsz")?.is_none() && child(name, "stbl", stbl, *b"stz2")?.is_some() {
        return Err(VideoError::Unsupported {
            name: name.to_owned(),
            what: "a table of short sizes (stz2)".to_owned(),
        });
    }
    let mut fields = Fields(needed(name, "stbl", stbl, *b"stsz")?);
    let short = cut_short(name, "stsz");
    fields.version().ok_or_else(&short)?;
    let same = fields.u32().ok_or_else(&short)?;
    let count = fields.u32().ok_or_else(&short)?;
    if u64::from(count) > MAX_FRAMES {
        return Err(VideoError::TooLarge {
            name: name.to_owned(),
            object: "frames".to_owned(),
            found: u64::from(count),
            limit: MAX_FRAMES,
        });
    }
    if count == 0 {
        return Err(bad_box(name, "stsz", "one sample or more", "none"));
    }
    let sizes = match same {
        0 => {
            let table = fields.take(4 * count as usize).ok_or_else(&short)?;
            table.chunks_exact(4).map(|b| u32::from_be_bytes([b[0], b[1], b[2], b[3]])).collect()
        }
        // a count without a table costs nothing to state: no more samples than the file has bytes for
        _ if u64::from(same) * u64::from(count) > file_bytes => {
            return Err(VideoError::Truncated {
                name: name.to_owned(),
                object: format!("the last of {count} samples of {same} bytes"),
                expected: u64::from(same) * u64::from(count),
                found: file_bytes,
            });
        }
        _ => vec![same; count as usize],
    };
    if let Some(&large) = sizes.iter().find(|&&s| u64::from(s) > MAX_SAMPLE) {
        return Err(VideoError::TooLarge {
            name: name.to_owned(),
            object: "bytes of a sample".to_owned(),
            found: u64::from(large),
            limit: MAX_SAMPLE,
        });
    }
    Ok(sizes)
}

/// Places of the chunks.
fn chunks(name: &str, stbl: &[u8]) -> Result<Vec<u64>> {
    if let Some(data) = child(name, "stbl", stbl, *b"stco")? {
        let (count, mut fields) = table(name, "stco", data, 4)?;
        let short = cut_short(name, "stco");
        return (0..count).map(|_| fields.u32().map(u64::from).ok_or_else(&short)).collect();
    }
    let Some(data) = child(name, "stbl", stbl, *b"co64")? else {
        return Err(bad_box(name, "stbl", "a box stco or co64 in it", "neither"));
    };
    let (count, mut fields) = table(name, "co64", data, 8)?;
    let short = cut_short(name, "co64");
    (0..count).map(|_| fields.u64().ok_or_else(&short)).collect()
}

fn offsets(name: &str, stbl: &[u8], sizes: &[u32], file_bytes: u64) -> Result<Vec<u64>> {
    let chunks = chunks(name, stbl)?;
    let (count, mut fields) = table(name, "stsc", needed(name, "stbl", stbl, *b"stsc")?, 12)?;
    let short = cut_short(name, "stsc");
    // runs of chunks with equally many samples: each from its first chunk up to the next run's
    let mut runs = Vec::with_capacity(count);
    for _ in 0..count {
        let (first, samples) = (fields.u32().ok_or_else(&short)?, fields.u32().ok_or_else(&short)?);
        let entry = fields.u32().ok_or_else(&short)?;
        let after = runs.last().map_or(1, |&(first, _): &(u64, u32)| first + 1);
        if (runs.is_empty() && first != 1) || u64::from(first) < after || entry != 1 {
            let found = format!("chunk {first} with sample entry {entry}");
            return Err(bad_box(name, "stsc", "runs of chunks from 1 on, of sample entry 1", found));
        }
        runs.push((u64::from(first), samples));
    }
    let mut offsets = Vec::with_capacity(sizes.len());
    let mut run = 0;
    for (chunk, &start) in chunks.iter().enumerate() {
        if runs.get(run + 1).is_some_and(|&(first, _)| first <= chunk as u64 + 1) {
            run += 1;
        }
        let Some(&(_, samples)) = runs.get(run) else { break };
        let mut at = start;
        let left = sizes.len() - offsets.len();
        for _ in 0..(samples as usize).min(left) {
            let number = offsets.len();
            let end = at.saturating_add(u64::from(sizes[number]));
            if end > file_bytes {
                return Err(VideoError::Truncated {
                    name: name.to_owned(),
                    object: format!("sample {number}"),
                    expected: end,
                    found: file_bytes,
                });
            }
            offsets.push(at);
            at = end;
        }
    }
    if offsets.len() != sizes.len() {
        let found = format!("{} in {} chunks", offsets.len(), chunks.len());
        return Err(bad_box(name, "stsc", format!("places of {} samples", sizes.len()), found));
    }
    Ok(offsets)
}

fn times(name: &str, stbl: &[u8], places: &mut [Place]) -> Result<()> {
    let (count, mut fields) = table(name, "stts", needed(name, "stbl", stbl, *b"stts")?, 8)?;
    let short = cut_short(name, "stts");
    let wrong = |kind, found: u64| {
        bad_box(name, kind, format!("times of {} samples", places.len()), format!("times of {found}"))
    };
    let (mut at, mut done) = (0_i64, 0_u64);
    let mut given = Vec::with_capacity(places.len());
    for _ in 0..count {
        let (samples, ticks) = (fields.u32().ok_or_else(&short)?, fields.u32().ok_or_else(&short)?);
        done += u64::from(samples);
        if done > places.len() as u64 {
            return Err(wrong("stts", done));
        }
        for _ in 0..samples {
            given.push((at, ticks));
            at += i64::from(ticks);
        }
    }
    if given.len() != places.len() {
        return Err(wrong("stts", done));
    }
    let mut delays = Vec::new();
    if let Some(data) = child(name, "stbl", stbl, *b"ctts")? {
        let (count, mut fields) = table(name, "ctts", data, 8)?;
        let short = cut_short(name, "ctts");
        for _ in 0..count {
            let (samples, delay) = (fields.u32().ok_or_else(&short)?, fields.u32().ok_or_else(&short)?);
            // from version 1 on they have a sign; writers, and FFmpeg, do not mind the version
            let delay = i64::from(delay as i32);
            if delays.len() as u64 + u64::from(samples) > places.len() as u64 {
                return Err(wrong("ctts", delays.len() as u64 + u64::from(samples)));
            }
            delays.extend(std::iter::repeat_n(delay, samples as usize));
        }
        if delays.len() != places.len() {
            return Err(wrong("ctts", delays.len() as u64));
        }
    }
    for (number, (place, (at, ticks))) in places.iter_mut().zip(given).enumerate() {
        place.time = at + delays.get(number).copied().unwrap_or(0);
        place.ticks = ticks;
    }
    Ok(())
}

fn keys(name: &str, stbl: &[u8], places: &mut [Place]) -> Result<()> {
    let Some(data) = child(name, "stbl", stbl, *b"stss")? else { return Ok(()) };
    let (count, mut fields) = table(name, "stss", data, 4)?;
    let short = cut_short(name, "stss");
    places.iter_mut().for_each(|p| p.key = false);
    let total = places.len();
    for _ in 0..count {
        let number = fields.u32().ok_or_else(&short)? as usize;
        let place = number.checked_sub(1).and_then(|i| places.get_mut(i));
        place.ok_or_else(|| bad_box(name, "stss", format!("samples 1 to {total}"), number.to_string()))?.key = true;
    }
    match places.first().is_some_and(|p| p.key) {
        true => Ok(()),
        false => Err(bad_box(name, "stss", "sample 1, with which decoding begins", "others only")),
    }
}
