//! Pictures of an opened data set: image columns and videos, decoded into bytes in memory.

use super::check::TIME_TOLERANCE;
use super::export::Rows;
use super::images;
use super::info::{Feature, Info, MAX_PIXELS, MAX_SIDE};
use super::open::{Dataset, EpisodeMeta};
use super::read;
use crate::error::{DatasetError, Result};
use crate::source::{VideoFile, VideoInfo};
use arrow_array::builder::BinaryBuilder;
use arrow_array::{Array, ArrayRef, BinaryArray, StringArray, StructArray};
use arrow_schema::DataType;
use rayon::prelude::*;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::ops::Range;
use std::os::unix::fs::FileExt;
use std::path::{Component, Path, PathBuf};
use std::sync::Arc;

/// Pictures that are unpacked from a column at once.
const ROWS: usize = 256;

/// All pictures of one camera, a picture a frame of the data set, in its order.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Pictures {
    /// Rows of a picture.
    pub height: usize,
    /// Pixels in a row.
    pub width: usize,
    /// Picture after picture: rows from the top, pixels from the left, red, green and blue.
    pub data: Vec<u8>,
}

impl Pictures {
    /// Bytes of a picture.
    pub fn picture_bytes(&self) -> usize {
        self.height * self.width * 3
    }

    /// The picture of a frame of the data set.
    pub fn frame(&self, frame: usize) -> &[u8] {
        let size = self.picture_bytes();
        &self.data[frame * size..(frame + 1) * size]
    }
}

/// Bytes of decoded pictures that are on their way to a file at once.
const BLOCK: usize = 64 << 20;
/// Bytes of decoded pictures that are looked at one by one.
const PIECE: usize = 16 << 20;

/// All pictures of one camera in a file of their own: decoded once, read one by one, for those that memory cannot hold.
/// The file has no name any more and goes when nobody uses it.
#[derive(Debug, Clone)]
pub struct PictureFile {
    /// Rows of a picture.
    pub height: usize,
    /// Pixels in a row.
    pub width: usize,
    file: Arc<File>,
    /// The folder that it lies in, for messages.
    folder: PathBuf,
}

impl PictureFile {
    /// Fills `out` with the picture of a frame of the data set, unless it is elsewhere.
    ///
    /// # Errors
    /// A file that cannot be read, a frame beyond its end.
    pub fn read(&self, frame: usize, out: &mut [u8]) -> Result<()> {
        let at = (frame * self.height * self.width * 3) as u64;
        self.file
            .read_exact_at(out, at)
            .map_err(failed(&self.folder, "read decoded images from a temporary file in it"))
    }
}

/// A camera's pictures, wherever they are kept.
#[derive(Debug, Clone)]
pub enum PictureStore {
    /// In memory.
    Memory(Arc<Pictures>),
    /// In a file.
    File(PictureFile),
    /// In the caller's keeping, such as on a GPU: height and width. Windows tell which frames they have and copy no pixels.
    Elsewhere(usize, usize),
}

impl From<Arc<Pictures>> for PictureStore {
    fn from(pictures: Arc<Pictures>) -> Self {
        Self::Memory(pictures)
    }
}

impl From<PictureFile> for PictureStore {
    fn from(pictures: PictureFile) -> Self {
        Self::File(pictures)
    }
}

impl PictureStore {
    /// Height and width of a picture.
    pub fn size(&self) -> (usize, usize) {
        match self {
            Self::Memory(pictures) => (pictures.height, pictures.width),
            Self::File(pictures) => (pictures.height, pictures.width),
            Self::Elsewhere(height, width) => (*height, *width),
        }
    }

    /// Bytes of a picture.
    pub fn picture_bytes(&self) -> usize {
        let (height, width) = self.size();
        height * width * 3
    }

    /// Fills `out` with the picture of a frame of the data set, unless it is elsewhere.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn read(&self, frame: usize, out: &mut [u8]) -> Result<()> {
        match self {
            Self::Memory(pictures) => out.copy_from_slice(pictures.frame(frame)),
            Self::File(pictures) => pictures.read(frame, out)?,
            Self::Elsewhere(..) => {}
        }
        Ok(())
    }
}

fn failed(path: &Path, operation: &'static str) -> impl FnOnce(std::io::Error) -> DatasetError {
    let path = path.to_path_buf();
    move |source| DatasetError::Io { path, operation, source }
}

/// A file of one camera's videos.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraFile {
    /// Where it lies.
    pub path: PathBuf,
    /// What it says about itself.
    pub info: VideoInfo,
}

impl Dataset {
    /// Names of the features that are colour pictures, in the order of `info.json`.
    pub fn cameras(&self) -> impl Iterator<Item = &str> {
        let colour = self.info().features.0.iter().filter(|(_, f)| f.is_visual() && !f.is_depth());
        colour.map(|(name, _)| name.as_str())
    }

    /// Whether any feature holds pictures, depth among them: what is not in memory.
    pub fn has_pictures(&self) -> bool {
        self.info().features.0.iter().any(|(_, f)| f.is_visual())
    }

    /// Decodes all pictures of a camera into memory, with as many threads as there are cores. The bytes are those that
    /// LeRobot reads; of JPEG pictures, whose decoders may round otherwise, close to them.
    pub fn pictures(&self, name: &str) -> Result<Pictures> {
        let (_, height, width) = self.camera(name)?;
        let mut data = Vec::with_capacity(self.frames() * height * width * 3);
        self.decode(name, 0..self.episodes().len(), BLOCK, &mut |block| {
            data.extend_from_slice(block);
            Ok(())
        })?;
        Ok(Pictures { height, width, data })
    }

    /// The pictures of one episode, as [`Dataset::pictures`] has them.
    ///
    /// # Panics
    /// When there is no such episode.
    pub fn episode_pictures(&self, name: &str, episode: usize) -> Result<Pictures> {
        self.pictures_of(name, episode, &mut |_| true)
    }

    /// The pictures of some frames of an episode, in their order: those that `wanted` says of, numbered from 0. However long
    /// the episode is, some megabytes of the others are in memory.
    ///
    /// # Panics
    /// When there is no such episode.
    pub fn pictures_of(&self, name: &str, episode: usize, wanted: &mut dyn FnMut(usize) -> bool) -> Result<Pictures> {
        let (_, height, width) = self.camera(name)?;
        let (mut data, mut frame) = (Vec::new(), 0);
        self.decode(name, episode..episode + 1, BLOCK, &mut |block| {
            for picture in block.chunks_exact(height * width * 3) {
                if wanted(frame) {
                    data.extend_from_slice(picture);
                }
                frame += 1;
            }
            Ok(())
        })?;
        Ok(Pictures { height, width, data })
    }

    /// Bytes that all pictures of a camera take once they are decoded.
    pub fn decoded_bytes(&self, name: &str) -> Result<u64> {
        let (_, height, width) = self.camera(name)?;
        Ok((self.frames() * height * width * 3) as u64)
    }

    /// Decodes all pictures of a camera into a file in `folder`, some megabytes at a time.
    ///
    /// # Errors
    /// As [`Dataset::pictures`]; a file that cannot be written.
    pub fn picture_file(&self, name: &str, folder: &Path) -> Result<PictureFile> {
        let (_, height, width) = self.camera(name)?;
        let write = "write decoded images to a temporary file in it";
        let file = tempfile::tempfile_in(folder).map_err(failed(folder, "create a temporary file in it"))?;
        let mut out = BufWriter::new(file);
        self.decode(name, 0..self.episodes().len(), BLOCK, &mut |block| {
            out.write_all(block).map_err(failed(folder, write))
        })?;
        let file = out.into_inner().map_err(|error| failed(folder, write)(error.into_error()))?;
        Ok(PictureFile { height, width, file: Arc::new(file), folder: folder.to_path_buf() })
    }

    /// Decodes the pictures of some episodes, in order, in blocks of whole pictures: one at least, no more than `limit` bytes
    /// otherwise.
    fn decode(
        &self,
        name: &str,
        episodes: Range<usize>,
        limit: usize,
        sink: &mut dyn FnMut(&[u8]) -> Result<()>,
    ) -> Result<()> {
        let (feature, height, width) = self.camera(name)?;
        if feature.dtype != "video" {
            return self.unpack(name, (height, width), episodes, sink);
        }
        let places = places(self, name)?;
        let (mut from, size) = (episodes.start, height * width * 3);
        let most = (limit / size).max(1);
        while from < episodes.end {
            let (mut to, mut frames) = (from, 0);
            while to < episodes.end && frames + self.episodes()[to].length <= most {
                frames += self.episodes()[to].length;
                to += 1;
            }
            if to > from {
                let mut block = vec![0; frames * size];
                self.film((height, width), &places, from..to, &mut block)?;
                sink(&block)?;
            } else {
                // longer than a block by itself
                let mut film = Film::new(self.info().fps, (height, width));
                film.blocks(&self.episodes()[from], &places[from], most, sink)?;
                to = from + 1;
            }
            from = to;
        }
        Ok(())
    }

    /// The files that a camera's videos lie in, each opened; none for an image column.
    ///
    /// # Errors
    /// No such camera, a file that cannot be opened, depth as video, which is not read.
    pub fn video_files(&self, name: &str) -> Result<Vec<CameraFile>> {
        if self.info().features.get(name).is_some_and(Feature::is_depth) {
            return self.depth_size(name).map(|_| Vec::new());
        }
        let (feature, ..) = self.camera(name)?;
        if feature.dtype != "video" {
            return Ok(Vec::new());
        }
        let mut paths: Vec<PathBuf> = places(self, name)?.into_iter().map(|p| p.path).collect();
        paths.sort();
        paths.dedup();
        let open = |path: PathBuf| {
            read::refuse_pointer(&path)?;
            Ok(CameraFile { info: VideoFile::open(&path)?.info().clone(), path })
        };
        paths.into_iter().map(open).collect()
    }

    /// A feature of colour pictures with its height and width.
    pub(crate) fn camera(&self, name: &str) -> Result<(&Feature, usize, usize)> {
        let found = self.info().features.get(name).filter(|f| f.is_visual() && !f.is_depth());
        let depth = self.info().features.get(name).is_some_and(Feature::is_depth);
        let feature = found.ok_or_else(|| DatasetError::NotInDataset {
            path: self.root().to_path_buf(),
            wanted: format!("camera {name}"),
            found: match (self.cameras().collect::<Vec<_>>().join(", "), depth) {
                (none, false) if none.is_empty() => "no camera".to_owned(),
                (names, false) => names,
                (none, true) if none.is_empty() => "depth of that name, which has no colours".to_owned(),
                (names, true) => format!("depth of that name, which has no colours, and {names}"),
            },
        })?;
        match feature.picture_size() {
            Some((height, width)) => Ok((feature, height, width)),
            None => Err(DatasetError::BadDataset {
                path: self.root().join("meta/info.json"),
                object: name.to_owned(),
                expected: format!(
                    "images of shape [height, width, 3], or [3, height, width] where its names say so, up to {MAX_SIDE} on a side \
                     and {MAX_PIXELS} pixels"
                ),
                found: format!("shape {:?}, names {}", feature.shape, feature.names),
            }),
        }
    }

    /// Videos: episodes lie one after the other in files, so each thread takes a run of episodes.
    fn film(
        &self,
        (height, width): (usize, usize),
        places: &[VideoPlace],
        episodes: Range<usize>,
        data: &mut [u8],
    ) -> Result<()> {
        let size = height * width * 3;
        let mut tasks = Vec::with_capacity(episodes.len());
        let mut rest = data;
        for (episode, place) in self.episodes().iter().zip(places).take(episodes.end).skip(episodes.start) {
            let (mine, after) = rest.split_at_mut(episode.length * size);
            tasks.push((episode, place, mine));
            rest = after;
        }
        let run = tasks.len().div_ceil(rayon::current_num_threads()).max(1);
        tasks.par_chunks_mut(run).try_for_each(|run| {
            let mut film = Film::new(self.info().fps, (height, width));
            run.iter_mut().try_for_each(|(episode, place, out)| film.read(episode, place, 0..episode.length, out))
        })
    }

    /// Image columns: row groups one after the other, their pictures on all threads.
    fn unpack(
        &self,
        name: &str,
        (height, width): (usize, usize),
        episodes: Range<usize>,
        sink: &mut dyn FnMut(&[u8]) -> Result<()>,
    ) -> Result<()> {
        let size = height * width * 3;
        let mut rows = Rows::open(self.root(), "data", Some(name), ROWS)?;
        let before: usize = self.episodes()[..episodes.start].iter().map(|e| e.length).sum();
        rows.skip(before)?;
        let frames: usize = self.episodes()[episodes].iter().map(|e| e.length).sum();
        let mut buffer = vec![0; ROWS.min(frames) * size];
        for from in (0..frames).step_by(ROWS) {
            let block = &mut buffer[..ROWS.min(frames - from) * size];
            let mut files = Vec::new();
            for batch in rows.take(block.len() / size)? {
                files.push(self.files(name, batch.column(0))?);
            }
            let files: Vec<&[u8]> = files.iter().flat_map(|f| f.iter()).flatten().collect();
            let pairs = files.par_iter().zip(block.par_chunks_mut(size)).enumerate();
            pairs.try_for_each(|(i, (file, out))| {
                let mut pixels = Vec::with_capacity(size);
                let decoded = images::decode(file, height, width, &mut pixels);
                decoded.map_err(|found| self.bad(name, &self.episode_frame(before + from + i), found))?;
                out.copy_from_slice(&pixels);
                Ok::<(), DatasetError>(())
            })?;
            sink(block)?;
        }
        Ok(())
    }

    /// The episode that a frame of the data set is of, and which of its frames it is.
    fn episode_frame(&self, frame: usize) -> String {
        let mut before = 0;
        for episode in self.episodes() {
            if frame < before + episode.length {
                return format!("frame {} of episode {}", frame - before, episode.index);
            }
            before += episode.length;
        }
        format!("row {frame}")
    }

    fn bad(&self, name: &str, what: &str, found: String) -> DatasetError {
        DatasetError::BadDataset {
            path: self.root().join("data"),
            object: format!("column {name}, {what}"),
            expected: "PNG, PPM or JPEG images of the size that info.json says".to_owned(),
            found,
        }
    }

    /// Images of a column as files.
    pub(crate) fn files(&self, name: &str, column: &ArrayRef) -> Result<BinaryArray> {
        image_files(self.root(), column).map_err(|found| self.bad(name, "its rows", found))
    }
}

/// Images of a column of the set `root` as encoded files. Where a row has no bytes, its path names a file inside the set.
pub(crate) fn image_files(root: &Path, column: &ArrayRef) -> Result<BinaryArray, String> {
    let fields = column.as_any().downcast_ref::<StructArray>();
    let (bytes, paths) = match fields {
        Some(fields) => (fields.column_by_name("bytes"), fields.column_by_name("path")),
        None => (Some(column), None),
    };
    let binary = |array: &ArrayRef| arrow_cast::cast(array, &DataType::Binary).map_err(|e| e.to_string());
    let files = bytes.map(binary).transpose()?;
    let files = files.as_ref().and_then(|array| array.as_any().downcast_ref::<BinaryArray>());
    if let Some(files) = files.filter(|files| files.null_count() == 0) {
        return Ok(files.clone());
    }
    let paths = paths.map(|array| arrow_cast::cast(array, &DataType::Utf8).map_err(|e| e.to_string())).transpose()?;
    let paths = paths.as_ref().and_then(|array| array.as_any().downcast_ref::<StringArray>());
    let mut all = BinaryBuilder::new();
    for row in 0..column.len() {
        if let Some(file) = files.filter(|files| files.is_valid(row)) {
            all.append_value(file.value(row));
            continue;
        }
        let Some(path) = paths.filter(|paths| paths.is_valid(row)).map(|paths| Path::new(paths.value(row))) else {
            return Err(format!("neither bytes nor a path in row {row}"));
        };
        if !path.components().all(|part| matches!(part, Component::Normal(_) | Component::CurDir)) {
            return Err(format!("no bytes, and the path {} that leads outside the data set", path.display()));
        }
        let file = root.join(path);
        read::refuse_pointer(&file).map_err(|e| e.to_string())?;
        all.append_value(std::fs::read(&file).map_err(|e| format!("no bytes, and {}: {e}", file.display()))?);
    }
    Ok(all.finish())
}

/// Where an episode's pictures lie in a camera's files.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct VideoPlace {
    pub path: PathBuf,
    /// Seconds from the file's beginning to the episode's.
    pub from: f64,
    /// Seconds to the episode's end.
    pub to: f64,
}

/// The places of all episodes of one camera.
pub(crate) fn places(dataset: &Dataset, name: &str) -> Result<Vec<VideoPlace>> {
    let (root, info) = (dataset.root(), dataset.info());
    let mut places = Vec::with_capacity(dataset.episodes().len());
    let column = |what: &str| format!("videos/{name}/{what}");
    let names = ["chunk_index", "file_index", "from_timestamp", "to_timestamp"].map(column);
    for path in read::files(root, "meta/episodes")? {
        let (rows, arrays) = read::columns(&path, &names.each_ref().map(String::as_str))?;
        let chunk = read::integers(&path, &names[0], &arrays[0])?;
        let file = read::integers(&path, &names[1], &arrays[1])?;
        let from = read::doubles(&path, &names[2], &arrays[2])?;
        let to = read::doubles(&path, &names[3], &arrays[3])?;
        for row in 0..rows {
            let relative = relative(info, name, chunk[row], file[row]).ok_or_else(|| DatasetError::BadDataset {
                path: root.join("meta/info.json"),
                object: "video_path".to_owned(),
                expected: "a path inside the data set with video_key, chunk_index and file_index".to_owned(),
                found: format!("{:?} for chunk {} and file {}", info.video_path, chunk[row], file[row]),
            })?;
            places.push(VideoPlace { path: root.join(relative), from: from[row], to: to[row] });
        }
    }
    dataset.in_order(places)
}

/// Fills in `video_path`, which is in Python's format language.
pub(super) fn relative(info: &Info, name: &str, chunk: i64, file: i64) -> Option<PathBuf> {
    let (chunk, file) = (u32::try_from(chunk).ok()?, u32::try_from(file).ok()?);
    let text = info.video_path.as_ref()?.replace("{video_key}", name);
    let text =
        text.replace("{chunk_index:03d}", &format!("{chunk:03}")).replace("{file_index:03d}", &format!("{file:03}"));
    let path = Path::new(&text);
    let inside = path.components().all(|c| matches!(c, Component::Normal(_))) && !text.contains('{');
    inside.then(|| path.to_path_buf())
}

/// Reads episodes of one camera, keeping the file open that it read last.
pub(crate) struct Film {
    fps: f64,
    size: (usize, usize),
    open: Option<(PathBuf, VideoFile)>,
}

impl Film {
    pub fn new(fps: f64, size: (usize, usize)) -> Self {
        Self { fps, size, open: None }
    }

    /// Fills `out` with the pictures of some frames of an episode, once each of the episode's is known to be shown when it
    /// should.
    pub fn read(
        &mut self,
        episode: &EpisodeMeta,
        place: &VideoPlace,
        frames: Range<usize>,
        out: &mut [u8],
    ) -> Result<()> {
        let first = self.locate(episode, place)? + frames.start;
        let size = self.size.0 * self.size.1 * 3;
        if let (Some((_, file)), false) = (&self.open, frames.is_empty()) {
            file.read(first..first + frames.len(), &mut |frame, rgb| {
                out[(frame - first) * size..(frame - first + 1) * size].copy_from_slice(rgb);
            })?;
        }
        Ok(())
    }

    /// Gives the pictures of an episode to `sink` in blocks of up to `most`; decoding goes on from one to the next.
    pub fn blocks(
        &mut self,
        episode: &EpisodeMeta,
        place: &VideoPlace,
        most: usize,
        sink: &mut dyn FnMut(&[u8]) -> Result<()>,
    ) -> Result<()> {
        let size = self.size.0 * self.size.1 * 3;
        let mut block = vec![0; most.min(episode.length) * size];
        for from in (0..episode.length).step_by(most) {
            let to = (from + most).min(episode.length);
            let block = &mut block[..(to - from) * size];
            self.read(episode, place, from..to, block)?;
            sink(block)?;
        }
        Ok(())
    }

    /// Gives the pictures of an episode to `take`, one by one.
    pub fn each(&mut self, episode: &EpisodeMeta, place: &VideoPlace, take: &mut dyn FnMut(&[u8])) -> Result<()> {
        let size = self.size.0 * self.size.1 * 3;
        self.blocks(episode, place, (PIECE / size).max(1), &mut |block| {
            block.chunks_exact(size).for_each(&mut *take);
            Ok(())
        })
    }

    /// The file's frame that an episode begins with, once each of the episode's is known to be shown when it should and to
    /// have the set's size. Reads the file's tables, decodes nothing.
    pub fn locate(&mut self, episode: &EpisodeMeta, place: &VideoPlace) -> Result<usize> {
        if self.open.as_ref().is_none_or(|(path, _)| *path != place.path) {
            self.open = None;
            read::refuse_pointer(&place.path)?;
            self.open = Some((place.path.clone(), VideoFile::open(&place.path)?));
        }
        let (_, file) = self.open.as_ref().expect("it was just opened");
        let info = file.info();
        let bad = |object: String, expected: String, found: String| DatasetError::BadDataset {
            path: place.path.clone(),
            object,
            expected,
            found,
        };
        let (height, width) = self.size;
        if (info.height, info.width) != self.size {
            let found = format!("{} x {}", info.height, info.width);
            return Err(bad("images".to_owned(), format!("{height} x {width}, as info.json says"), found));
        }
        if episode.length == 0 {
            return Ok(0);
        }
        let what = |i: usize| format!("frame {i} of episode {}", episode.index);
        let last = info.seconds(info.frames.saturating_sub(1)).unwrap_or(0.0);
        let first = info.frame_at(place.from).ok_or_else(|| {
            let found = format!("{} frames up to {last} s", info.frames);
            bad(what(0), format!("a frame within {TIME_TOLERANCE} s of {} s", place.from), found)
        })?;
        for i in 0..episode.length {
            let due = place.from + i as f64 / self.fps;
            match info.seconds(first + i) {
                Some(shown) if (shown - due).abs() <= TIME_TOLERANCE => {}
                shown => {
                    let found = shown.map_or_else(|| format!("the end after {last} s"), |s| format!("one at {s} s"));
                    return Err(bad(what(i), format!("a frame within {TIME_TOLERANCE} s of {due} s"), found));
                }
            }
        }
        Ok(first)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn blocks_of_any_size_are_the_same_pictures() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/lerobot_video_av1");
        let set = Dataset::open(&root).unwrap();
        let name = "observation.images.agentview";
        let all = set.pictures(name).unwrap();
        // three episodes of 12 frames: shorter than one, one and a half, all
        for most in [1, 5, 12, 18, 100] {
            let (mut data, mut largest) = (Vec::new(), 0);
            let limit = most * all.picture_bytes();
            set.decode(name, 0..3, limit, &mut |block| {
                largest = largest.max(block.len());
                data.extend_from_slice(block);
                Ok(())
            })
            .unwrap();
            assert!(data == all.data && largest <= limit, "{most} at once: {largest} bytes");
        }
    }
}
