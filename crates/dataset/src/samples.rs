//! Samples as LeRobot's `delta_timestamps` ask for them: each column at any frames around the one that is asked for.
//!
//! Sample `i` is the `i`-th frame of the chosen episodes. A column with offsets gives the frames so far from it, one
//! row each; past either end of the episode the nearest frame is repeated and flagged as padding. [`crate::Windows`] are
//! the samples of one kind: actions from the frame on, observations up to it. Values are copied once, from the columns
//! in memory to where the caller wants them.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::error::{DatasetError, Result};
use crate::lerobot::{Dataset, DepthUnit, Feature, Pictures, TIME_TOLERANCE};
use crate::windows::Resident;

/// The most rows of one column in one sample.
const MOST_OFFSETS: usize = 100_000;
/// Beyond so many frames no data set reaches.
const FARTHEST: f64 = 1e12;

/// What samples hold.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct SampleSpec {
    /// Offsets in frames of the rows of a column or of a camera, by name. One that is not named gives the row of the
    /// sample's own frame.
    pub offsets: BTreeMap<String, Vec<i64>>,
    /// Cameras whose pictures belong to a sample.
    pub cameras: Vec<String>,
    /// Depth that belongs to a sample, numbers of shape 1 x height x width.
    pub depth: Vec<String>,
    /// What that is given in.
    pub depth_unit: DepthUnit,
    /// Episodes to take samples from, by episode index.
    pub episodes: Vec<usize>,
}

/// A column or a camera as samples hold it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SampleColumn {
    /// Its name.
    pub name: String,
    /// Extent of one row.
    pub shape: Vec<usize>,
    /// Offsets in frames of its rows; `None` for the one row of the sample's own frame.
    pub offsets: Option<Vec<i64>>,
    /// What its numbers are.
    pub kind: NumberKind,
    consecutive: bool,
}

/// What a column of a LeRobot set states its numbers to be. Samples hold all of them as float32.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NumberKind {
    /// Numbers with a fraction, and images.
    Real,
    /// Whole numbers; beyond 2^24 float32 rounds them.
    Whole,
    /// Truth values.
    Truth,
}

impl NumberKind {
    fn of(feature: Option<&Feature>) -> Self {
        match feature.map_or("", |feature| &feature.dtype) {
            "bool" => Self::Truth,
            dtype if dtype.starts_with("int") || dtype.starts_with("uint") => Self::Whole,
            _ => Self::Real,
        }
    }
}

impl SampleColumn {
    fn new(name: &str, shape: Vec<usize>, offsets: Option<&Vec<i64>>, kind: NumberKind) -> Self {
        let offsets = offsets.cloned();
        let listed = offsets.as_deref().unwrap_or(&[0]);
        let consecutive = listed.windows(2).all(|pair| pair[0].checked_add(1) == Some(pair[1]));
        Self { name: name.to_owned(), shape, offsets, kind, consecutive }
    }

    fn listed(&self) -> &[i64] {
        self.offsets.as_deref().unwrap_or(&[0])
    }

    /// Rows in a sample.
    pub fn rows(&self) -> usize {
        self.listed().len()
    }

    /// Values in a sample.
    pub fn width(&self) -> usize {
        self.rows() * self.shape.iter().product::<usize>()
    }

    /// Copies the rows of a sample out of `from`, whose rows are `width` long, into `out`, which has room for them.
    fn copy<T: Copy>(&self, span: Span, from: &[T], width: usize, out: &mut [T]) {
        let row = |frame: usize| &from[frame * width..(frame + 1) * width];
        if !self.consecutive {
            for (&offset, out) in self.listed().iter().zip(out.chunks_exact_mut(width)) {
                out.copy_from_slice(row(span.at(offset)));
            }
            return;
        }
        // the rows before the episode, those inside it in one piece, and those after it
        let rows = self.rows() as i64;
        let first = span.frame().saturating_add(self.listed().first().copied().unwrap_or(0));
        let before = i64::from(span.begin).saturating_sub(first).clamp(0, rows);
        let inside = i64::from(span.end).saturating_sub(first).clamp(before, rows) - before;
        let (head, rest) = out.split_at_mut(before as usize * width);
        let (middle, tail) = rest.split_at_mut(inside as usize * width);
        head.chunks_exact_mut(width).for_each(|out| out.copy_from_slice(row(span.begin as usize)));
        if inside > 0 {
            let start = (first + before) as usize * width;
            middle.copy_from_slice(&from[start..start + middle.len()]);
        }
        tail.chunks_exact_mut(width).for_each(|out| out.copy_from_slice(row(span.end as usize - 1)));
    }
}

/// Where a sample lies: an episode, and rows of the columns.
#[derive(Debug, Clone, Copy)]
struct Span {
    episode: u32,
    begin: u32,
    frame: u32,
    end: u32,
}

impl Span {
    fn frame(self) -> i64 {
        i64::from(self.frame)
    }

    /// The frame so far from the sample's, inside the episode.
    fn at(self, offset: i64) -> usize {
        self.frame().saturating_add(offset).clamp(i64::from(self.begin), i64::from(self.end) - 1) as usize
    }

    fn is_padding(self, offset: i64) -> bool {
        !(i64::from(self.begin)..i64::from(self.end)).contains(&self.frame().saturating_add(offset))
    }
}

/// The place of a sample in its data set.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SamplePlace {
    /// Its frame among all frames of the data set.
    pub index: usize,
    /// Its episode.
    pub episode: usize,
    /// Its frame in the episode.
    pub frame: usize,
}

/// The samples of some episodes. Owns (shares) the columns, so that it outlives its data set.
#[derive(Debug, Clone)]
pub struct Samples {
    numbers: Vec<(SampleColumn, Resident)>,
    pictures: Vec<(SampleColumn, Arc<Pictures>)>,
    spans: Vec<Span>,
}

impl Dataset {
    /// Offsets in frames of these times in seconds, as LeRobot reads `delta_timestamps`.
    ///
    /// # Errors
    /// A time that is no frame's, by LeRobot's tolerance.
    pub fn offsets(&self, column: &str, seconds: &[f64]) -> Result<Vec<i64>> {
        let fps = self.info().fps;
        let offset = |&time: &f64| {
            let frames = (time * fps).round();
            if ((frames / fps) - time).abs() <= TIME_TOLERANCE && frames.abs() < FARTHEST {
                return Ok(frames as i64);
            }
            Err(DatasetError::NotInDataset {
                path: self.root().to_path_buf(),
                wanted: format!("frame of {column} at {time} s from another"),
                found: format!("one every 1/{fps} s"),
            })
        };
        seconds.iter().map(offset).collect()
    }

    /// Samples over some episodes: every numeric column, and the pictures and the depth that are asked for.
    ///
    /// # Errors
    /// Episodes, cameras, depth and columns that are not there, by name.
    pub fn samples(&self, spec: &SampleSpec) -> Result<Samples> {
        let refused = |wanted: String, found: String| DatasetError::NotInDataset {
            path: self.root().to_path_buf(),
            wanted,
            found,
        };
        for (name, offsets) in &spec.offsets {
            let seen = || spec.cameras.iter().chain(&spec.depth);
            if self.column(name).is_none() && !seen().any(|camera| camera == name) {
                let names: Vec<&str> = self.column_names().chain(seen().map(String::as_str)).collect();
                return Err(refused(format!("column {name}"), names.join(", ")));
            }
            if offsets.is_empty() || offsets.len() > MOST_OFFSETS {
                let wanted = format!("sample with {} rows of {name}", offsets.len());
                return Err(refused(wanted, format!("1 to {MOST_OFFSETS} to ask for")));
            }
        }
        let ranges = self.ranges(&spec.episodes)?;
        let mut spans = Vec::with_capacity(ranges.iter().map(|(from, to)| to - from).sum());
        for (&episode, &(from, to)) in spec.episodes.iter().zip(&ranges) {
            let (episode, begin, end) = (episode as u32, from as u32, to as u32);
            spans.extend((begin..end).map(|frame| Span { episode, begin, frame, end }));
        }
        let mut numbers = Vec::new();
        for name in self.column_names() {
            let resident = self.required(name)?;
            let feature = self.info().features.get(name);
            let shape = feature.map_or_else(|| vec![resident.dim], |f| f.shape.clone());
            let kind = NumberKind::of(feature);
            numbers.push((SampleColumn::new(name, shape, spec.offsets.get(name), kind), resident));
        }
        for name in &spec.depth {
            let maps = self.depth_of(name, 0..self.episodes().len())?;
            let stored = maps.unit.as_deref();
            let data: Vec<f32> = maps.data.iter().map(|&depth| spec.depth_unit.of(stored, depth)).collect();
            let resident = Resident { data: data.into(), dim: maps.height * maps.width };
            let shape = vec![1, maps.height, maps.width];
            numbers.push((SampleColumn::new(name, shape, spec.offsets.get(name), NumberKind::Real), resident));
        }
        numbers.sort_by(|(one, _), (other, _)| one.name.cmp(&other.name));
        let mut pictures = Vec::new();
        for name in &spec.cameras {
            let seen = self.pictures(name)?;
            let shape = vec![seen.height, seen.width, 3];
            pictures.push((SampleColumn::new(name, shape, spec.offsets.get(name), NumberKind::Real), Arc::new(seen)));
        }
        Ok(Samples { numbers, pictures, spans })
    }
}

impl Samples {
    /// Number of samples: one a frame.
    pub fn len(&self) -> usize {
        self.spans.len()
    }

    /// True when the chosen episodes have no frame.
    pub fn is_empty(&self) -> bool {
        self.spans.is_empty()
    }

    /// The columns of numbers, depth among them, sorted by name.
    pub fn numbers(&self) -> impl ExactSizeIterator<Item = &SampleColumn> {
        self.numbers.iter().map(|(column, _)| column)
    }

    /// The cameras, in the order asked for; a row is height x width x 3.
    pub fn pictures(&self) -> impl ExactSizeIterator<Item = &SampleColumn> {
        self.pictures.iter().map(|(column, _)| column)
    }

    /// Where a sample lies.
    ///
    /// # Panics
    /// When `sample` is not below [`Samples::len`]; so do the others.
    pub fn place(&self, sample: u32) -> SamplePlace {
        let Span { episode, begin, frame, .. } = self.spans[sample as usize];
        SamplePlace { index: frame as usize, episode: episode as usize, frame: (frame - begin) as usize }
    }

    /// Copies the `column`-th column of numbers of `samples` into `out`: (samples, rows, row…).
    ///
    /// # Panics
    /// When `out` is not as long as that.
    pub fn copy_numbers(&self, column: usize, samples: &[u32], out: &mut [f32]) {
        let (column, resident) = &self.numbers[column];
        self.copy(column, &resident.data, resident.dim, samples, out);
    }

    /// Copies the pictures of the `camera`-th camera of `samples` into `out`: (samples, rows, height, width, 3).
    ///
    /// # Panics
    /// When `out` is not as long as that.
    pub fn copy_pictures(&self, camera: usize, samples: &[u32], out: &mut [u8]) {
        let (column, pictures) = &self.pictures[camera];
        self.copy(column, &pictures.data, pictures.picture_bytes(), samples, out);
    }

    fn copy<T: Copy>(&self, column: &SampleColumn, from: &[T], width: usize, samples: &[u32], out: &mut [T]) {
        let each = column.rows() * width;
        assert_eq!(out.len(), samples.len() * each, "room for {}", column.name);
        if each > 0 {
            for (&sample, out) in samples.iter().zip(out.chunks_exact_mut(each)) {
                column.copy(self.spans[sample as usize], from, width, out);
            }
        }
    }

    /// Writes for each row of `column` in each of `samples` whether it repeats the frame at an end of the episode
    /// (1) or not (0): (samples, rows).
    ///
    /// # Panics
    /// When `out` is not as long as that.
    pub fn padding(&self, column: &SampleColumn, samples: &[u32], out: &mut [u8]) {
        assert_eq!(out.len(), samples.len() * column.rows(), "room for the flags of {}", column.name);
        for (&sample, flags) in samples.iter().zip(out.chunks_exact_mut(column.rows().max(1))) {
            let span = self.spans[sample as usize];
            for (flag, &offset) in flags.iter_mut().zip(column.listed()) {
                *flag = u8::from(span.is_padding(offset));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::windows::{WindowBatch, Windows};
    use proptest::prelude::*;

    /// Samples of one column of `dim` numbers, over episodes of these lengths, with these offsets.
    fn samples(lengths: &[usize], dim: usize, offsets: Option<Vec<i64>>) -> (Samples, Resident) {
        let rows: usize = lengths.iter().sum();
        let data: Vec<f32> = (0..rows * dim).map(|i| i as f32 + 0.25).collect();
        let resident = Resident { data: data.into(), dim };
        let mut spans = Vec::new();
        let mut begin = 0_u32;
        for (episode, &length) in lengths.iter().enumerate() {
            let end = begin + length as u32;
            spans.extend((begin..end).map(|frame| Span { episode: episode as u32, begin, frame, end }));
            begin = end;
        }
        let column = SampleColumn::new("c", vec![dim], offsets.as_ref(), NumberKind::Real);
        (Samples { numbers: vec![(column, resident.clone())], pictures: Vec::new(), spans }, resident)
    }

    proptest! {
        #[test]
        fn rows_are_the_nearest_frames_of_the_episode(
            lengths in prop::collection::vec(1_usize..9, 1..6),
            dim in 1_usize..4,
            offsets in prop_oneof![
                prop::collection::vec(-12_i64..12, 1..8),
                (-12_i64..12, 1_i64..9).prop_map(|(from, n)| (from..from + n).collect::<Vec<i64>>()),
                Just(vec![i64::MIN, i64::MAX]),
            ],
            picks in prop::collection::vec(any::<prop::sample::Index>(), 1..20),
        ) {
            let (samples, resident) = samples(&lengths, dim, Some(offsets.clone()));
            let chosen: Vec<u32> = picks.iter().map(|p| p.index(samples.len()) as u32).collect();
            let mut out = vec![-1.0; chosen.len() * offsets.len() * dim];
            samples.copy_numbers(0, &chosen, &mut out);
            let mut flags = vec![9; chosen.len() * offsets.len()];
            samples.padding(samples.numbers().next().unwrap(), &chosen, &mut flags);
            let (mut wanted, mut padded) = (Vec::new(), Vec::new());
            for &sample in &chosen {
                let place = samples.place(sample);
                let begin = (place.index - place.frame) as i128;
                let end = begin + lengths[place.episode] as i128;
                for &offset in &offsets {
                    let at = place.index as i128 + i128::from(offset);
                    let near = at.clamp(begin, end - 1) as usize;
                    wanted.extend_from_slice(&resident.data[near * dim..(near + 1) * dim]);
                    padded.push(u8::from(at < begin || at >= end));
                }
            }
            prop_assert_eq!(out, wanted);
            prop_assert_eq!(flags, padded);
        }

        /// What a training reads is what samples with its offsets hold, bit for bit.
        #[test]
        fn windows_are_samples_with_a_training_s_offsets(
            lengths in prop::collection::vec(1_usize..9, 1..6),
            (horizon, steps) in (1_usize..12, 1_usize..5),
            picks in prop::collection::vec(any::<prop::sample::Index>(), 1..20),
        ) {
            let (ahead, resident) = samples(&lengths, 2, Some((0..horizon as i64).collect()));
            let (behind, _) = samples(&lengths, 2, Some((1 - steps as i64..=0).collect()));
            let mut from = 0;
            let ranges: Vec<(usize, usize)> = lengths.iter().map(|n| { from += n; (from - n, from) }).collect();
            let windows = Windows::new(vec![("c".into(), resident.clone())], resident, (steps, horizon), &ranges);
            let chosen: Vec<u32> = picks.iter().map(|p| p.index(windows.len()) as u32).collect();
            let mut batch = WindowBatch::default();
            windows.gather(&chosen, &mut batch);
            let mut actions = vec![0.0; chosen.len() * horizon * 2];
            ahead.copy_numbers(0, &chosen, &mut actions);
            let mut observed = vec![0.0; chosen.len() * steps * 2];
            behind.copy_numbers(0, &chosen, &mut observed);
            let mut flags = vec![0; chosen.len() * horizon];
            ahead.padding(ahead.numbers().next().unwrap(), &chosen, &mut flags);
            prop_assert_eq!(&actions, &batch.actions);
            prop_assert_eq!(&observed[..], batch.column("c").unwrap());
            prop_assert_eq!(flags.iter().map(|&f| f == 1).collect::<Vec<_>>(), batch.is_pad);
        }
    }

    #[test]
    fn without_offsets_a_sample_is_its_frame() {
        let (samples, resident) = samples(&[2, 3], 2, None);
        assert_eq!((samples.len(), samples.is_empty()), (5, false));
        let mut out = [0.0; 4];
        samples.copy_numbers(0, &[4, 2], &mut out);
        assert_eq!(out, [resident.data[8], resident.data[9], resident.data[4], resident.data[5]]);
        assert_eq!(samples.place(3), SamplePlace { index: 3, episode: 1, frame: 1 });
        assert_eq!(samples.numbers().next().unwrap().width(), 2);
    }
}
