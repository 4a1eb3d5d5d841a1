//! Videos carried over without being encoded again: a file of which every episode is taken is copied, of another one the
//! samples of its episodes are put into a new file.

use super::super::encode::PictureSummary;
use super::super::info::FILES_PER_FOLDER;
use super::super::open::{Dataset, EpisodeMeta};
use super::super::pictures::{Film, VideoPlace, places};
use super::super::read::refuse_pointer;
use super::super::shards::{HashingFile, WrittenFile, create_parent};
use super::super::videos::{Stretch, rate};
use super::{Advance, Edit};
use crate::error::{DatasetError, Result};
use rayon::prelude::*;
use sha2::{Digest, Sha256};
use std::fs::File;
use std::io::{self, Read, Write};
use std::path::Path;
use video::{Muxer, Sample, Video, VideoError};

/// One camera of the result.
pub(super) struct Copied {
    /// Where each episode's video is.
    pub stretches: Vec<Stretch>,
    /// What each episode's pictures hash to.
    pub pictures: Vec<PictureSummary>,
    pub files: Vec<WrittenFile>,
}

/// Carries over the videos of the feature `name`; a file of the result holds what was in one file of an input.
///
/// # Errors
/// [`VideoError::Cut`] where part of a file is taken whose samples cannot be: H.264, or an episode that does not begin
/// with a key frame.
pub(super) fn copy(edit: &Edit<'_>, name: &str, advance: &mut Advance<'_>) -> Result<Copied> {
    let old = edit.before(name);
    let mut copied = Copied { stretches: Vec::new(), pictures: Vec::new(), files: Vec::new() };
    for (input, taken) in edit.inputs.iter().zip(&edit.taken) {
        let (set, places) = (&input.set, places(&input.set, old)?);
        let (_, height, width) = set.camera(old)?;
        let mut film = Film::new(set.info().fps, (height, width));
        let mut stretches: Vec<Option<Stretch>> = vec![None; places.len()];
        if input.joins {
            join(edit, set, (name, old), &places, &mut film, (&mut stretches, &mut copied.files), advance)?;
        }
        for &episode in taken {
            if stretches[episode].is_some() {
                continue;
            }
            advance(0)?;
            // every episode of the file that this one is in
            let of_file: Vec<usize> = (0..places.len()).filter(|&e| places[e].path == places[episode].path).collect();
            let wanted: Vec<usize> = of_file.iter().copied().filter(|e| taken.binary_search(e).is_ok()).collect();
            // what does not fit its set is not made to look as if it did
            wanted.iter().try_for_each(|&e| film.locate(&set.episodes()[e], &places[e]).map(|_| ()))?;
            let (target, (folder, file)) = Target::next(edit, name, copied.files.len());
            let (written, spans) = match wanted.len() == of_file.len() {
                true => target.whole(&places, &wanted)?,
                false => target.cut(set, old, &places, &wanted)?,
            };
            copied.files.push(written);
            for (episode, (from, to)) in wanted.into_iter().zip(spans) {
                stretches[episode] = Some(Stretch { folder, file, from, to });
            }
        }
        copied.stretches.extend(taken.iter().map(|&e| stretches[e].expect("each episode taken lies in a file")));
        // some at a time, so that the work can be given up
        for some in taken.chunks(AT_ONCE * rayon::current_num_threads()) {
            copied.pictures.extend(digests(edit, set, old, &places, some)?);
            advance(some.iter().map(|&e| set.episodes()[e].length as u64).sum())?;
        }
    }
    Ok(copied)
}

/// Puts the files of episodes that follow each other into one, up to the size at which a file is closed, as LeRobot does. Those
/// whose samples cannot be moved are left for later.
fn join(
    edit: &Edit<'_>,
    set: &Dataset,
    (name, old): (&str, &str),
    places: &[VideoPlace],
    film: &mut Film,
    (stretches, files): (&mut [Option<Stretch>], &mut Vec<WrittenFile>),
    advance: &mut Advance<'_>,
) -> Result<()> {
    let limit = (set.info().video_files_size_in_mb * f64::from(1 << 20)) as u64;
    let bytes = |episode: usize| std::fs::metadata(&places[episode].path).map_or(0, |m| m.len());
    let mut next = 0;
    while next < places.len() {
        advance(0)?;
        let (mut together, mut size) = (Vec::new(), 0);
        while next < places.len()
            && (together.is_empty() || size + bytes(next) < limit)
            && moves(set, &places[next], next)?
        {
            film.locate(&set.episodes()[next], &places[next])?;
            size += bytes(next);
            together.push(next);
            next += 1;
        }
        if together.len() > 1 {
            let (target, (folder, file)) = Target::next(edit, name, files.len());
            let (written, spans) = target.cut(set, old, places, &together)?;
            files.push(written);
            for (episode, (from, to)) in together.iter().copied().zip(spans) {
                stretches[episode] = Some(Stretch { folder, file, from, to });
            }
        } else if together.is_empty() {
            next += 1;
        }
    }
    Ok(())
}

/// Whether the samples of an episode can be moved: they begin with a key frame that says what follows.
fn moves(set: &Dataset, place: &VideoPlace, episode: usize) -> Result<bool> {
    match Source::open(&place.path).and_then(|source| source.samples(&set.episodes()[episode], place)) {
        Ok(samples) => Ok(samples.first().is_some_and(Sample::begins)),
        // whoever reads it as it is says what is wrong with it
        Err(DatasetError::Video(_)) => Ok(false),
        Err(error) => Err(error),
    }
}

/// Episodes of a thread that are decoded before it is told how far they are.
const AT_ONCE: usize = 8;
/// Bytes that are copied at once.
const COPIED: usize = 1 << 20;

/// Seconds of each episode in a file, from and to.
type Spans = Vec<(f64, f64)>;

/// A file of the result.
struct Target<'a> {
    edit: &'a Edit<'a>,
    relative: String,
}

impl<'a> Target<'a> {
    /// The file after so many others, with its folder and number.
    fn next(edit: &'a Edit<'a>, name: &str, others: usize) -> (Self, (usize, usize)) {
        let (folder, file) = (others / FILES_PER_FOLDER, others % FILES_PER_FOLDER);
        let relative = format!("videos/{name}/chunk-{folder:03}/file-{file:03}.mp4");
        (Self { edit, relative }, (folder, file))
    }

    fn create(&self) -> Result<HashingFile> {
        let path = self.edit.root.join(&self.relative);
        create_parent(&path)?;
        HashingFile::create(&path)
    }

    fn failed(&self) -> impl FnOnce(io::Error) -> DatasetError {
        let path = self.edit.root.join(&self.relative);
        |source| DatasetError::Io { path, operation: "write it", source }
    }

    /// The file of the episodes, byte by byte.
    fn whole(&self, places: &[VideoPlace], episodes: &[usize]) -> Result<(WrittenFile, Spans)> {
        let source = &places[episodes[0]].path;
        let read = |source_error| DatasetError::Io { path: source.clone(), operation: "read it", source: source_error };
        refuse_pointer(source)?;
        let mut from = File::open(source).map_err(read)?;
        let mut to = self.create()?;
        let mut part = vec![0; COPIED];
        loop {
            match from.read(&mut part).map_err(read)? {
                0 => break,
                count => to.write_all(&part[..count]).map_err(self.failed())?,
            }
        }
        let spans = episodes.iter().map(|&e| (places[e].from, places[e].to)).collect();
        Ok((to.written(&self.relative), spans))
    }

    /// The samples of the episodes, one episode after the other.
    fn cut(
        &self,
        set: &Dataset,
        name: &str,
        places: &[VideoPlace],
        episodes: &[usize],
    ) -> Result<(WrittenFile, Spans)> {
        let (_, height, width) = set.camera(name)?;
        let rate = rate(set.info().fps, width, height)?;
        let mut open: Option<(&Path, Source)> = None;
        let mut samples = |episode: usize| {
            let place = &places[episode];
            if open.as_ref().is_none_or(|(path, _)| *path != place.path) {
                open = Some((&place.path, Source::open(&place.path)?));
            }
            let (_, source) = open.as_ref().expect("it was opened above");
            source.samples(&set.episodes()[episode], place)
        };
        let mut muxer = Muxer::new(width as u16, height as u16, rate);
        let mut spans = Spans::new();
        for &episode in episodes {
            let from = muxer.frames();
            samples(episode)?.iter().try_for_each(|s| muxer.push(s))?;
            spans.push((rate.seconds(from), rate.seconds(muxer.frames())));
        }
        let mut to = self.create()?;
        to.write_all(&muxer.header()).map_err(self.failed())?;
        for &episode in episodes {
            for sample in samples(episode)? {
                to.write_all(&sample.bytes).map_err(self.failed())?;
            }
        }
        Ok((to.written(&self.relative), spans))
    }
}

/// A file that is cut. Its tables are read here; only decoding needs a process of its own.
struct Source(Video);

impl Source {
    fn open(path: &Path) -> Result<Self> {
        refuse_pointer(path)?;
        Ok(Self(Video::open(path)?))
    }

    fn samples(&self, episode: &EpisodeMeta, place: &VideoPlace) -> Result<Vec<Sample>> {
        if episode.length == 0 {
            return Ok(Vec::new());
        }
        let first = self.0.info().frame_at(place.from).ok_or_else(|| VideoError::NoSuchFrame {
            name: place.path.display().to_string(),
            wanted: format!("frame at {} s, where episode {} begins", place.from, episode.index),
            found: format!("{} frames", self.0.info().frames),
        })?;
        Ok(self.0.samples(first..first + episode.length)?)
    }
}

/// What the pictures of each episode hash to, where that is part of the fingerprint.
fn digests(
    edit: &Edit<'_>,
    set: &Dataset,
    name: &str,
    places: &[VideoPlace],
    taken: &[usize],
) -> Result<Vec<PictureSummary>> {
    if !edit.digests() {
        return Ok(taken.iter().map(|_| PictureSummary::default()).collect());
    }
    let (_, height, width) = set.camera(name)?;
    // each thread keeps the file open that it reads
    let run = taken.len().div_ceil(rayon::current_num_threads()).max(1);
    let runs: Vec<Result<Vec<PictureSummary>>> = taken
        .par_chunks(run)
        .map(|run| {
            let mut film = Film::new(set.info().fps, (height, width));
            let of_episode = |&episode: &usize| {
                let mut digests = Vec::with_capacity(set.episodes()[episode].length);
                film.each(&set.episodes()[episode], &places[episode], &mut |picture| {
                    digests.push(Sha256::digest(picture).into());
                })?;
                Ok(PictureSummary { digests, ..PictureSummary::default() })
            };
            run.iter().map(of_episode).collect()
        })
        .collect();
    Ok(runs.into_iter().collect::<Result<Vec<_>>>()?.into_iter().flatten().collect())
}
