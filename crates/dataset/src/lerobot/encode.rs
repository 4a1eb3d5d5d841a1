//! One row group of the data files: read from the source, turned into Arrow arrays, compressed.

use super::depth;
use super::features::{Column, ImageForm, Mapping, Origin, VideoOptions};
use super::images;
use super::schema::{element, image_fields};
use super::shards::{EncodedGroup, GroupEncoder};
use super::tiff;
use super::values::{Position, Values, episode_values};
use super::videos::Camera;
use super::work::{Part, is_bulk};
use crate::error::{DatasetError, InputError, Result};
use crate::plan::KeyPlan;
use crate::source::{NonFinite, Source};
use crate::stats::FeatureStats;
use crate::tree::{Array, Demo};
use arrow_array::{
    ArrayRef, BinaryArray, BooleanArray, FixedSizeListArray, Float32Array, Float64Array, Int64Array, StringArray,
    StructArray,
};
use arrow_buffer::{OffsetBuffer, ScalarBuffer};
use arrow_schema::DataType;
use sha2::{Digest, Sha256};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;

/// What every thread needs to know.
pub(crate) struct Job<'a> {
    pub path: &'a Path,
    pub source: &'a Source,
    pub mapping: &'a Mapping,
    pub images: ImageForm,
    pub video: Option<&'a VideoOptions>,
    pub nonfinite: NonFinite,
    /// Whether the side folder gets what becomes no column.
    pub lossless: bool,
    pub encoder: &'a GroupEncoder,
    /// Task of each episode.
    pub task_of: &'a [usize],
}

/// Pictures of one column over the rows of a part.
#[derive(Debug, Clone, Default)]
pub(crate) struct PictureSummary {
    /// sha256 of each picture's pixels, as a reader will get them.
    pub digests: Vec<[u8; 32]>,
    /// Each picture as a sample of a video, where they become one.
    pub samples: Vec<video::Sample>,
    /// Histogram of each channel over the sampled pixels of the sampled pictures.
    pub histograms: Vec<[u64; 256]>,
    /// Depth of the sampled pixels of the sampled pictures.
    pub depth: Vec<f32>,
    /// Pictures sampled.
    pub sampled: u64,
    /// Statistics of all that, once nothing more is added.
    pub settled: Option<FeatureStats>,
}

/// What an episode says about itself, once (with its first part) or in pieces (pictures).
pub(crate) struct PartSummary {
    pub part: Part,
    /// Values, statistics and digest of every column without pictures, for the whole episode; with its first
    /// part only.
    pub values: Vec<ColumnSummary>,
    /// Pictures of this part by column index.
    pub pictures: BTreeMap<usize, PictureSummary>,
}

/// Values of a column over an episode and what follows from them.
pub(crate) struct ColumnSummary {
    pub values: Values,
    pub stats: Option<FeatureStats>,
    pub digest: [u8; 32],
}

/// A row group with what its episodes say.
pub(crate) struct GroupOutput {
    pub group: EncodedGroup,
    pub parts: Vec<PartSummary>,
}

/// A part with what was read for it.
pub(crate) struct Loaded {
    pub part: Part,
    /// Everything that is not bulk, whole.
    pub demo: Demo,
    pub values: Vec<Values>,
}

impl Job<'_> {
    /// Reads what is small of the demos of a row group.
    pub(crate) fn load(&self, parts: &[Part]) -> Result<Vec<Loaded>> {
        let mut loaded = Vec::with_capacity(parts.len());
        let needed: BTreeSet<String> = self.mapping.columns.iter().flat_map(Column::keys).collect();
        for part in parts {
            let plan = &self.source.plan().demos[part.episode];
            // what cannot be read and no column needs is no key of the plan
            let beside = |k: &KeyPlan| self.lossless && !is_bulk(k, plan.length);
            let small = |key: &str| plan.keys.get(key).is_some_and(|k| needed.contains(key) || beside(k));
            let small = |key: &str| small(key) && !self.is_picture(key);
            let demo = self.source.read_demo_where(part.episode, &small)?;
            let position = Position {
                episode: part.episode,
                first_frame: part.first_frame,
                task_index: self.task_of[part.episode],
                length: part.length,
            };
            let task = plan.task.as_deref().unwrap_or_default();
            let values = episode_values(self.path, self.mapping, &demo, task, position)?;
            if self.nonfinite == NonFinite::Refuse {
                self.mapping.columns.iter().zip(&values).try_for_each(|(c, values)| self.finite(c, values, &demo))?;
            }
            loaded.push(Loaded { part: part.clone(), demo, values });
        }
        Ok(loaded)
    }

    /// Refuses values of a column that are not finite: float32 cannot hold them, or they follow from others.
    fn finite(&self, column: &Column, values: &Values, demo: &Demo) -> Result<()> {
        let Values::F32(values) = values else { return Ok(()) };
        if values.iter().fold(true, |all, v| all & v.is_finite()) {
            return Ok(());
        }
        let of_key = |key: &String| self.source.first_not_finite(&demo.id, key, demo.datasets.get(key)?, 0, true);
        let computed = || {
            let at = values.iter().position(|v| !v.is_finite()).unwrap_or(0);
            InputError::NotFinite {
                path: self.path.to_path_buf(),
                demo: demo.id.clone(),
                key: column.name.clone(),
                step: at / column.dim(),
                dimension: at % column.dim(),
                found: format!("{}, computed from finite numbers", values[at]),
            }
        };
        Err(column.keys().iter().find_map(of_key).unwrap_or_else(computed).into())
    }

    fn is_picture(&self, key: &str) -> bool {
        self.mapping.columns.iter().any(|c| matches!(&c.origin, Origin::Image { key: k, .. } if k == key))
    }

    /// Encodes the data columns of a row group.
    pub(crate) fn encode(&self, loaded: &mut [Loaded]) -> Result<GroupOutput> {
        let mut summaries: Vec<PartSummary> = loaded
            .iter()
            .map(|l| PartSummary { part: l.part.clone(), values: Vec::new(), pictures: BTreeMap::new() })
            .collect();
        let mut arrays: Vec<ArrayRef> = Vec::with_capacity(self.mapping.columns.len());
        for (index, column) in self.mapping.columns.iter().enumerate() {
            match (&column.origin, self.video) {
                (Origin::Image { .. }, None) => {
                    arrays.push(self.pictures(index, Stored::of(column), loaded, &mut summaries)?);
                }
                (Origin::Image { .. }, Some(options)) => {
                    for (l, summary) in loaded.iter().zip(&mut summaries) {
                        let film = self.film(column, options, Stored::of(column), l)?;
                        summary.pictures.insert(index, film);
                    }
                }
                (Origin::Depth { .. }, _) => arrays.push(self.depth(index, column, loaded, &mut summaries)?),
                _ => arrays.push(number_array(column, index, loaded)),
            }
        }
        let failed = |source| DatasetError::Parquet {
            path: self.path.to_path_buf(),
            operation: "encode a row group of it",
            source,
        };
        let group = self.encoder.encode(&arrays).map_err(failed)?;
        for (summary, l) in summaries.iter_mut().zip(loaded) {
            if l.part.begins() {
                let columns = std::mem::take(&mut l.values).into_iter().zip(&self.mapping.columns);
                summary.values = columns
                    .map(|(values, column)| ColumnSummary {
                        stats: values.stats(column.dim()),
                        digest: match &column.origin {
                            Origin::Stored(_) => values.digest_as_read(),
                            _ => values.digest(),
                        },
                        values,
                    })
                    .collect();
            }
        }
        Ok(GroupOutput { group, parts: summaries })
    }

    fn pictures(
        &self,
        index: usize,
        stored: Stored<'_>,
        loaded: &[Loaded],
        summaries: &mut [PartSummary],
    ) -> Result<ArrayRef> {
        let Stored { key, height, width, jpeg } = stored;
        let mut files = Vec::new();
        let mut offsets = vec![0_i32];
        let mut names = Vec::new();
        let extension = if jpeg { "jpg" } else { images::extension(self.images) };
        if !jpeg && self.images == ImageForm::Ppm {
            let frames: usize = loaded.iter().map(|l| l.part.rows.len()).sum();
            files.reserve(frames * images::ppm_bytes(height, width));
        }
        for (l, summary) in loaded.iter().zip(summaries) {
            let sampled = sample(l.part.length);
            let mut pictures = PictureSummary { histograms: vec![[0; 256]; 3], ..PictureSummary::default() };
            self.each_picture(l, stored, &mut |frame, file, pixels| {
                match file {
                    // as it was recorded
                    Some(file) => files.extend_from_slice(file),
                    None => images::encode(self.images, height, width, pixels, &mut files)
                        .map_err(|e| self.bad_picture(l, key, frame, "an image that can be encoded", e.to_string()))?,
                }
                offsets.push(i32::try_from(files.len()).ok().ok_or_else(|| too_large(self.path, key))?);
                names.push(format!("frame-{frame:06}.{extension}"));
                pictures.digests.push(Sha256::digest(pixels).into());
                if sampled.binary_search(&frame).is_ok() {
                    add_to_histograms(&mut pictures, height, width, pixels);
                }
                Ok(())
            })?;
            summary.pictures.insert(index, pictures);
        }
        Ok(picture_array(files, offsets, names))
    }

    /// Depth as LeRobot's recorder stores it, a TIFF file a frame.
    fn depth(
        &self,
        index: usize,
        column: &Column,
        loaded: &[Loaded],
        summaries: &mut [PartSummary],
    ) -> Result<ArrayRef> {
        let Origin::Depth { key, height, width, dtype, kind } = &column.origin else {
            unreachable!("asked of columns of depth alone")
        };
        let (height, width, size) = (*height, *width, height * width * dtype.size().unwrap_or(0));
        let (mut files, mut offsets, mut names, mut pixels) = (Vec::new(), vec![0_i32], Vec::new(), Vec::new());
        for (l, summary) in loaded.iter().zip(summaries) {
            let (rows, sampled) = (l.part.rows.clone(), sample(l.part.length));
            let array = self.source.read_rows(l.part.episode, key, rows.start, rows.len())?;
            if array.bytes.len() != size * rows.len() {
                return Err(self.wrong_shape(l, key, format!("{} x {height} x {width} of depth", rows.len()), &array));
            }
            let mut found = PictureSummary::default();
            for (frame, bytes) in rows.zip(array.bytes.chunks_exact(size)) {
                pixels.clear();
                depth::stored(dtype, bytes, &mut pixels);
                let bad = depth::not_finite(*kind, width, &pixels);
                if let Some(value) = bad.filter(|_| self.nonfinite == NonFinite::Refuse) {
                    let expected = "finite depth (--no-depth keeps it in the side folder alone)";
                    return Err(self.bad_picture(l, key, frame, expected, value));
                }
                tiff::encode(*kind, height, width, &pixels, &mut files);
                offsets.push(i32::try_from(files.len()).ok().ok_or_else(|| too_large(self.path, key))?);
                names.push(format!("frame-{frame:06}.{}", tiff::EXTENSION));
                found.digests.push(Sha256::digest(&pixels).into());
                if sampled.binary_search(&frame).is_ok() {
                    let values: Vec<f32> = kind.values(&pixels).collect();
                    found.add_depth(height, width, &values);
                }
            }
            summary.pictures.insert(index, found);
        }
        Ok(picture_array(files, offsets, names))
    }

    fn wrong_shape(&self, l: &Loaded, key: &str, expected: String, found: &Array) -> DatasetError {
        InputError::WrongShape {
            path: self.path.to_path_buf(),
            demo: l.demo.id.clone(),
            key: key.to_owned(),
            expected,
            found: format!("{} {:?}", found.dtype, found.shape),
        }
        .into()
    }

    fn bad_picture(&self, l: &Loaded, key: &str, frame: usize, expected: &str, found: String) -> DatasetError {
        let (path, object) = (self.path.to_path_buf(), format!("{} {key} frame {frame}", l.demo.id));
        DatasetError::BadDataset { path, object, expected: expected.to_owned(), found }
    }

    /// Calls `take` with every picture of a part: its frame, its file if the source has one, and its pixels.
    fn each_picture(&self, l: &Loaded, stored: Stored<'_>, take: &mut TakePicture<'_>) -> Result<()> {
        let Stored { key, height, width, jpeg } = stored;
        let (size, expected) = (height * width * 3, format!("a JPEG file of {height} x {width}"));
        let mut pixels = Vec::with_capacity(if jpeg { size } else { 0 });
        for rows in self.source.windows(l.part.episode, key, l.part.rows.clone()) {
            let array = self.source.read_rows(l.part.episode, key, rows.start, rows.len())?;
            if jpeg {
                for (frame, bytes) in rows.zip(array.byte_rows().unwrap_or_default()) {
                    let bad = |found| self.bad_picture(l, key, frame, &expected, found);
                    let file = images::jpeg(bytes).ok_or_else(|| bad("other bytes".to_owned()))?;
                    pixels.clear();
                    images::decode(file, height, width, &mut pixels).map_err(bad)?;
                    take(frame, Some(file), &pixels)?;
                }
                continue;
            }
            if array.bytes.len() != size * rows.len() {
                let wanted = format!("{} images of {height} x {width} x 3", rows.len());
                return Err(self.wrong_shape(l, key, wanted, &array));
            }
            for (frame, picture) in rows.zip(array.bytes.chunks_exact(size)) {
                take(frame, None, picture)?;
            }
        }
        Ok(())
    }

    /// Encodes the pictures of a part as video; the statistics are those of the pictures as they were recorded, as
    /// LeRobot's are.
    fn film(&self, column: &Column, options: &VideoOptions, stored: Stored<'_>, l: &Loaded) -> Result<PictureSummary> {
        let sampled = sample(l.part.length);
        let mut summary = PictureSummary { histograms: vec![[0; 256]; 3], ..PictureSummary::default() };
        let mut camera = Camera::new(column, self.mapping.fps, options)?;
        self.each_picture(l, stored, &mut |frame, _, pixels| {
            camera.push(pixels)?;
            if sampled.binary_search(&frame).is_ok() {
                add_to_histograms(&mut summary, stored.height, stored.width, pixels);
            }
            Ok(())
        })?;
        (summary.samples, summary.digests) = camera.finish()?;
        Ok(summary)
    }
}

/// What is done with a picture: its frame, its file if the source has one, its pixels.
type TakePicture<'f> = dyn FnMut(usize, Option<&[u8]>, &[u8]) -> Result<()> + 'f;

/// Where the pictures of a column are, and how large they are.
#[derive(Clone, Copy)]
struct Stored<'a> {
    key: &'a str,
    height: usize,
    width: usize,
    /// as JPEG files
    jpeg: bool,
}

impl<'a> Stored<'a> {
    fn of(column: &'a Column) -> Self {
        match &column.origin {
            &Origin::Image { ref key, height, width, jpeg } => Self { key, height, width, jpeg },
            _ => unreachable!("asked of columns of images alone"),
        }
    }
}

/// Files in a row, each with its end in `offsets` and its name, as a column.
fn picture_array(files: Vec<u8>, offsets: Vec<i32>, names: Vec<String>) -> ArrayRef {
    let offsets = OffsetBuffer::new(ScalarBuffer::from(offsets));
    let bytes = BinaryArray::new(offsets, files.into(), None);
    let columns: Vec<ArrayRef> = vec![Arc::new(bytes), Arc::new(StringArray::from_iter_values(names))];
    Arc::new(StructArray::new(image_fields(), columns, None))
}

fn too_large(path: &Path, key: &str) -> DatasetError {
    InputError::TooLarge {
        path: path.to_path_buf(),
        object: format!("{key} in one row group"),
        bytes: u64::MAX >> 32,
        limit: i32::MAX as u64,
    }
    .into()
}

/// Concatenates the rows of one column over the parts of a row group.
fn number_array(column: &Column, index: usize, loaded: &[Loaded]) -> ArrayRef {
    let dim = column.dim();
    let slices = || loaded.iter().map(|l| (&l.values[index], l.part.rows.start * dim..l.part.rows.end * dim));
    macro_rules! all {
        ($kind:ident) => {{
            let mut all = Vec::with_capacity(slices().map(|(_, range)| range.len()).sum());
            for (values, range) in slices() {
                if let Values::$kind(v) = values {
                    all.extend_from_slice(&v[range]);
                }
            }
            all
        }};
    }
    let (flat, value): (ArrayRef, DataType) = match loaded.first().map(|l| &l.values[index]) {
        Some(Values::I64(_)) => (Arc::new(Int64Array::from(all!(I64))), DataType::Int64),
        Some(Values::F64(_)) => (Arc::new(Float64Array::from(all!(F64))), DataType::Float64),
        Some(Values::Bool(_)) => (Arc::new(BooleanArray::from(all!(Bool))), DataType::Boolean),
        _ => (Arc::new(Float32Array::from(all!(F32))), DataType::Float32),
    };
    match dim {
        1 => flat,
        n => Arc::new(FixedSizeListArray::new(element(value), n as i32, flat, None)),
    }
}

/// Frames of an episode whose pictures enter the statistics: LeRobot's choice, `round(linspace(0, n - 1, k))`
/// with `k = min(max(n^0.75, 100), 10000, n)`.
pub(crate) fn sample(length: usize) -> Vec<usize> {
    let wanted = (length as f64).powf(0.75) as usize;
    let count = wanted.clamp(100, 10_000).min(length);
    if count < 2 {
        return (0..count).collect();
    }
    let step = (length - 1) as f64 / (count - 1) as f64;
    (0..count).map(|i| (i as f64 * step).round_ties_even() as usize).collect()
}

/// LeRobot looks at every `k`-th pixel of pictures of 300 or more on a side, so that 150 are left.
fn stride(height: usize, width: usize) -> usize {
    const LARGE: usize = 300;
    const TARGET: usize = 150;
    if height.max(width) < LARGE { 1 } else { (height.max(width) / TARGET).max(1) }
}

/// Counts the pixels of a sampled picture.
pub(crate) fn add_to_histograms(summary: &mut PictureSummary, height: usize, width: usize, pixels: &[u8]) {
    let stride = stride(height, width);
    // neighbours often have the same level: counted in turns, no count waits for the one before it
    let mut turns = [[[0_u32; 256]; 3]; 2];
    for row in pixels.chunks_exact(width * 3).step_by(stride) {
        for (i, pixel) in row.chunks_exact(3).step_by(stride).enumerate() {
            for (counts, &level) in turns[i % 2].iter_mut().zip(pixel) {
                counts[usize::from(level)] += 1;
            }
        }
    }
    let [even, odd] = turns;
    for (histogram, (even, odd)) in summary.histograms.iter_mut().zip(even.iter().zip(&odd)) {
        for (count, (even, odd)) in histogram.iter_mut().zip(even.iter().zip(odd)) {
            *count += u64::from(*even) + u64::from(*odd);
        }
    }
    summary.sampled += 1;
}

impl PictureSummary {
    /// Joins the next part of the same episode.
    pub(crate) fn extend(&mut self, next: Self) {
        self.digests.extend(next.digests);
        self.samples.extend(next.samples);
        self.depth.extend(next.depth);
        self.add_counts(&next.histograms, next.sampled);
    }

    /// Adds pixels counted elsewhere.
    pub(crate) fn add_counts(&mut self, histograms: &[[u64; 256]], sampled: u64) {
        self.histograms.resize(histograms.len(), [0; 256]);
        for (mine, theirs) in self.histograms.iter_mut().zip(histograms) {
            for (a, b) in mine.iter_mut().zip(theirs) {
                *a += b;
            }
        }
        self.sampled += sampled;
    }

    /// Adds a sampled frame of depth.
    pub(crate) fn add_depth(&mut self, height: usize, width: usize, values: &[f32]) {
        let stride = stride(height, width);
        self.sampled += 1;
        for row in values.chunks_exact(width).step_by(stride) {
            self.depth.extend(row.iter().step_by(stride));
        }
    }

    /// Statistics of the sampled pictures: of depth in its unit, of colours from 0 to 1. `None` where none was sampled.
    pub(crate) fn stats(&self) -> Option<FeatureStats> {
        match (&self.settled, self.depth.is_empty()) {
            (Some(settled), _) => Some(settled.clone()),
            (None, false) => Some(FeatureStats { count: self.sampled, ..FeatureStats::of(&self.depth, 1)? }),
            (None, true) if self.sampled > 0 => FeatureStats::of_histograms(&self.histograms, self.sampled),
            (None, true) => None,
        }
    }

    /// Keeps of depth its statistics alone.
    pub(crate) fn settle(&mut self) {
        if !self.depth.is_empty() {
            self.settled = self.stats();
            self.depth = Vec::new();
        }
    }

    /// sha256 over the pictures' digests.
    pub(crate) fn digest(&self) -> [u8; 32] {
        Sha256::digest(self.digests.concat()).into()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn short_episodes_are_sampled_whole_and_long_ones_evenly() {
        assert_eq!(sample(1), [0]);
        assert_eq!(sample(57), (0..57).collect::<Vec<_>>());
        let long = sample(5000);
        assert_eq!(long.len(), 594);
        assert_eq!((long[0], long[593]), (0, 4999));
        assert!(long.is_sorted());
    }
}
