//! Training windows: the observations up to a frame and the `action_horizon` actions that follow it.
//!
//! Window `i` starts at frame `t` of an episode and holds the actions of frames `t .. t + action_horizon`, and of each
//! column of the observation the frames `t - n_obs_steps + 1 ..= t`. Before the episode its first frame is repeated.
//! Past the end of the episode the last action is repeated and flagged in `is_pad`, as LeRobot's
//! `delta_timestamps` and robomimic's padded sequences have it. A window may begin with the actions of so many frames
//! before `t`; before the episode its first action is repeated and flagged. Gathering a batch copies rows out of
//! columns that stay in memory; it allocates nothing once the batch has been used.

use crate::error::Result;
use crate::lerobot::PictureStore;
use arrow_buffer::ScalarBuffer;
use std::ops::Range;

/// Which windows to make.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WindowSpec {
    /// Columns of the observation, in order.
    pub observation: Vec<String>,
    /// Observations in a window, at least one: that of its frame and those before it.
    pub n_obs_steps: usize,
    /// Number of actions in a window, at least one.
    pub action_horizon: usize,
    /// Episodes to take windows from, by episode index; every frame of them starts one window.
    pub episodes: Vec<usize>,
    /// Take the steps that the data marks as mistakes, too. Otherwise what lies between them, or before or after, is as
    /// an episode of its own: no window begins at a mistake, and none asks for the actions from the next one on.
    pub mistakes: bool,
}

/// The stretches of `ranges` in which no frame is marked.
pub(crate) fn unmarked(ranges: &[(usize, usize)], marked: impl Fn(usize) -> bool) -> Vec<(usize, usize)> {
    let mut stretches = Vec::new();
    for &(from, to) in ranges {
        let mut begin = from;
        for frame in (from..to).filter(|&frame| marked(frame)).chain([to]) {
            if begin < frame {
                stretches.push((begin, frame));
            }
            begin = frame + 1;
        }
    }
    stretches
}

/// A resident column: row-major values, `dim` to a frame. Cloning shares the memory.
#[derive(Debug, Clone)]
pub(crate) struct Resident {
    pub data: ScalarBuffer<f32>,
    pub dim: usize,
}

impl Resident {
    fn row(&self, frame: usize) -> &[f32] {
        &self.data[frame * self.dim..(frame + 1) * self.dim]
    }
}

/// Where a window lies, as rows of the columns.
#[derive(Debug, Clone, Copy)]
struct Span {
    /// first frame of the episode
    begin: u32,
    /// the window's frame
    frame: u32,
    /// the frame after the episode's last
    end: u32,
}

/// The windows of some episodes. Owns (shares) the columns, so that it outlives its data set.
#[derive(Debug, Clone)]
pub struct Windows {
    observation: Vec<(String, Resident)>,
    pictures: Vec<(String, PictureStore)>,
    action: Resident,
    n_obs_steps: usize,
    action_horizon: usize,
    past_actions: usize,
    spans: Vec<Span>,
}

/// One batch of windows, row-major. Reuse one value: `gather` resizes it only when the batch size changes.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct WindowBatch {
    /// Number of windows.
    pub n: usize,
    /// Observations in each.
    pub n_obs_steps: usize,
    /// Which of the windows these are: `(n,)`.
    pub indices: Vec<u32>,
    /// By column, in the order asked for: `(n, n_obs_steps, dim)`, oldest first.
    pub observation: Vec<(String, Vec<f32>)>,
    /// By camera, in the order in which they were added: `(n, n_obs_steps, height, width, 3)`, oldest first. Empty where the
    /// pictures are elsewhere.
    pub pictures: Vec<(String, Vec<u8>)>,
    /// Frames of the data set, where pictures are elsewhere: `(n, n_obs_steps)`, oldest first.
    pub frames: Vec<u32>,
    /// `(n, action_horizon, action_dim)`
    pub actions: Vec<f32>,
    /// `(n, action_horizon)`; true where the first or last action of the episode is repeated.
    pub is_pad: Vec<bool>,
}

impl WindowBatch {
    /// Values of a column of the observation.
    pub fn column(&self, name: &str) -> Option<&[f32]> {
        self.observation.iter().find(|(n, _)| n == name).map(|(_, values)| values.as_slice())
    }
}

impl Windows {
    /// `ranges` are the `(from, to)` rows of the chosen episodes, checked by the caller to lie in the columns.
    pub(crate) fn new(
        observation: Vec<(String, Resident)>,
        action: Resident,
        (n_obs_steps, action_horizon): (usize, usize),
        ranges: &[(usize, usize)],
    ) -> Self {
        let total = ranges.iter().map(|(from, to)| to - from).sum();
        let mut spans = Vec::with_capacity(total);
        for &(from, to) in ranges {
            let (begin, end) = (from as u32, to as u32);
            spans.extend((begin..end).map(|frame| Span { begin, frame, end }));
        }
        Self { observation, pictures: Vec::new(), action, n_obs_steps, action_horizon, past_actions: 0, spans }
    }

    /// The same windows whose `action_horizon` actions begin `past_actions` frames before their own.
    #[must_use]
    pub fn with_past_actions(self, past_actions: usize) -> Self {
        Self { past_actions, ..self }
    }

    /// The windows of each episode, in order of time.
    pub fn episodes(&self) -> Vec<Range<u32>> {
        let first = |i: &u32| self.spans[*i as usize].frame == self.spans[*i as usize].begin;
        let count = self.spans.len() as u32;
        let mut begins: Vec<u32> = (0..count).filter(first).collect();
        begins.push(count);
        begins.windows(2).map(|pair| pair[0]..pair[1]).collect()
    }

    /// The windows of the frames that are `wanted`, counted over the whole data set.
    pub fn of_frames(&self, wanted: impl Fn(usize) -> bool) -> Vec<u32> {
        (0..self.spans.len() as u32).filter(|&i| wanted(self.spans[i as usize].frame as usize)).collect()
    }

    /// The same windows with the pictures of a camera of the same data set, which are shared.
    #[must_use]
    pub fn with_pictures(mut self, camera: &str, pictures: impl Into<PictureStore>) -> Self {
        self.pictures.push((camera.to_owned(), pictures.into()));
        self
    }

    /// Cameras with height and width of their pictures, in order.
    pub fn pictures(&self) -> impl Iterator<Item = (&str, (usize, usize))> {
        self.pictures.iter().map(|(name, pictures)| (name.as_str(), pictures.size()))
    }

    /// Number of windows: one a frame.
    pub fn len(&self) -> usize {
        self.spans.len()
    }

    /// True when the chosen episodes have no frame.
    pub fn is_empty(&self) -> bool {
        self.spans.is_empty()
    }

    /// Observations in a window.
    pub fn n_obs_steps(&self) -> usize {
        self.n_obs_steps
    }

    /// Actions in a window.
    pub fn action_horizon(&self) -> usize {
        self.action_horizon
    }

    /// Columns of the observation with their lengths, in order.
    pub fn observation(&self) -> impl Iterator<Item = (&str, usize)> {
        self.observation.iter().map(|(name, column)| (name.as_str(), column.dim))
    }

    /// Length of `action`.
    pub fn action_dim(&self) -> usize {
        self.action.dim
    }

    /// Whether pictures are read from files.
    pub fn reads_files(&self) -> bool {
        self.pictures.iter().any(|(_, pictures)| matches!(pictures, PictureStore::File(_)))
    }

    /// [`Windows::try_gather`] of windows whose pictures are all in memory, if they have any.
    ///
    /// # Panics
    /// When an index is not below [`Windows::len`], or a file of pictures cannot be read.
    pub fn gather(&self, indices: &[u32], batch: &mut WindowBatch) {
        self.try_gather(indices, batch).expect("what is in memory can be read");
    }

    /// Copies the windows `indices` into `batch`, in that order.
    ///
    /// # Errors
    /// A file of pictures that cannot be read.
    ///
    /// # Panics
    /// When an index is not below [`Windows::len`].
    pub fn try_gather(&self, indices: &[u32], batch: &mut WindowBatch) -> Result<()> {
        let (n, horizon, width) = (indices.len(), self.action_horizon, self.action.dim);
        (batch.n, batch.n_obs_steps) = (n, self.n_obs_steps);
        batch.indices.clear();
        batch.indices.extend_from_slice(indices);
        let named = batch.observation.iter().map(|(name, _)| name).eq(self.observation.iter().map(|(name, _)| name));
        if !named {
            batch.observation = self.observation.iter().map(|(name, _)| (name.clone(), Vec::new())).collect();
        }
        for ((_, values), (_, column)) in batch.observation.iter_mut().zip(&self.observation) {
            values.resize(n * self.n_obs_steps * column.dim, 0.0);
            let windows = values.chunks_exact_mut((self.n_obs_steps * column.dim).max(1)).zip(indices);
            // most have one observation, and its copy takes less time than a loop over one
            if self.n_obs_steps == 1 {
                windows.for_each(|(row, &index)| {
                    row.copy_from_slice(column.row(self.spans[index as usize].frame as usize))
                });
                continue;
            }
            for (rows, &index) in windows {
                for (row, frame) in rows.chunks_exact_mut(column.dim).zip(self.frames(index)) {
                    row.copy_from_slice(column.row(frame));
                }
            }
        }
        let named = batch.pictures.iter().map(|(name, _)| name).eq(self.pictures.iter().map(|(name, _)| name));
        if !named {
            batch.pictures = self.pictures.iter().map(|(name, _)| (name.clone(), Vec::new())).collect();
        }
        batch.frames.clear();
        if self.pictures.iter().any(|(_, pictures)| matches!(pictures, PictureStore::Elsewhere(..))) {
            batch.frames.extend(indices.iter().flat_map(|&index| self.frames(index)).map(|frame| frame as u32));
        }
        for ((_, values), (_, pictures)) in batch.pictures.iter_mut().zip(&self.pictures) {
            if matches!(pictures, PictureStore::Elsewhere(..)) {
                values.clear();
                continue;
            }
            values.resize(n * self.n_obs_steps * pictures.picture_bytes(), 0);
            let rows = values.chunks_exact_mut(pictures.picture_bytes().max(1));
            for (row, frame) in rows.zip(indices.iter().flat_map(|&index| self.frames(index))) {
                pictures.read(frame, row)?;
            }
        }
        batch.actions.resize(n * horizon * width, 0.0);
        batch.is_pad.resize(n * horizon, false);
        for (i, &index) in indices.iter().enumerate() {
            let Span { begin, frame, end } = self.spans[index as usize];
            let (begin, frame, end) = (begin as usize, frame as usize, end as usize);
            // steps before the episode, and the one after its last
            let before = (begin + self.past_actions).saturating_sub(frame).min(horizon);
            let after = (end + self.past_actions).saturating_sub(frame).min(horizon);
            let actions = &mut batch.actions[i * horizon * width..(i + 1) * horizon * width];
            let (head, tail) = actions.split_at_mut(after * width);
            let (head, own) = head.split_at_mut(before * width);
            let from = frame + before - self.past_actions.min(frame + before);
            own.copy_from_slice(&self.action.data[from * width..from * width + own.len()]);
            // most windows lie within their episode
            if before > 0 {
                head.chunks_exact_mut(width).for_each(|action| action.copy_from_slice(self.action.row(begin)));
            }
            if after < horizon {
                tail.chunks_exact_mut(width).for_each(|action| action.copy_from_slice(self.action.row(end - 1)));
            }
            let flags = &mut batch.is_pad[i * horizon..(i + 1) * horizon];
            flags[..before].fill(true);
            flags[before..after].fill(false);
            flags[after..].fill(true);
        }
        Ok(())
    }

    /// The frames of a window's observations, oldest first; before an episode there is its first frame.
    fn frames(&self, index: u32) -> impl Iterator<Item = usize> {
        let Span { begin, frame, .. } = self.spans[index as usize];
        let most = self.n_obs_steps - 1;
        (0..=most).map(move |step| frame as usize - (most - step).min((frame - begin) as usize))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::lerobot::Pictures;
    use proptest::prelude::*;
    use std::sync::Arc;

    #[test]
    fn stretches_lie_between_marked_frames() {
        let marks = [0, 3, 4, 9, 12];
        let stretches = unmarked(&[(0, 6), (6, 10), (12, 13), (20, 22)], |frame| marks.contains(&frame));
        assert_eq!(stretches, [(1, 3), (5, 6), (6, 9), (20, 22)]);
        assert_eq!(unmarked(&[(2, 5)], |_| false), [(2, 5)]);
    }

    fn column(rows: usize, dim: usize, salt: f32) -> Resident {
        let data: Vec<f32> = (0..rows * dim).map(|i| i as f32 + salt).collect();
        Resident { data: data.into(), dim }
    }

    /// One window by the definition: index `t - past + k`, clamped to the episode, flagged where clamped.
    fn naive(
        action: &Resident,
        (begin, frame, end): (usize, usize, usize),
        (past, horizon): (usize, usize),
    ) -> (Vec<f32>, Vec<bool>) {
        let mut actions = Vec::new();
        let mut pad = Vec::new();
        for k in 0..horizon as i64 {
            let at = frame as i64 - past as i64 + k;
            let inside = at.clamp(begin as i64, end as i64 - 1);
            actions.extend_from_slice(action.row(inside as usize));
            pad.push(at != inside);
        }
        (actions, pad)
    }

    proptest! {
        #[test]
        fn windows_agree_with_clamped_indexing(
            lengths in prop::collection::vec(1_usize..12, 1..8),
            (horizon, n_obs_steps, past) in (1_usize..20, 1_usize..6, 0_usize..5),
            dims in prop::collection::vec(1_usize..4, 0..4),
            action_dim in 1_usize..4,
            picks in prop::collection::vec(any::<prop::sample::Index>(), 1..40),
        ) {
            let rows: usize = lengths.iter().sum();
            let action = column(rows, action_dim, 0.75);
            let observed: Vec<(String, Resident)> =
                dims.iter().enumerate().map(|(i, &dim)| (format!("c{i}"), column(rows, dim, i as f32 / 8.0))).collect();
            let mut ranges = Vec::new();
            let mut from = 0;
            for (i, &length) in lengths.iter().enumerate() {
                if i % 2 == 0 {
                    ranges.push((from, from + length));
                }
                from += length;
            }
            let frames: Vec<(usize, usize, usize)> =
                ranges.iter().flat_map(|&(a, b)| (a..b).map(move |f| (a, f, b))).collect();
            let windows = Windows::new(observed.clone(), action.clone(), (n_obs_steps, horizon), &ranges);
            let windows = windows.with_past_actions(past);
            prop_assert_eq!(windows.len(), frames.len());
            let episodes = windows.episodes();
            prop_assert_eq!(episodes.iter().map(ExactSizeIterator::len).sum::<usize>(), frames.len());
            for (episode, (from, to)) in episodes.iter().zip(&ranges) {
                prop_assert_eq!((frames[episode.start as usize].1, episode.len()), (*from, to - from));
            }
            let indices: Vec<u32> = picks.iter().map(|p| p.index(frames.len()) as u32).collect();
            // a batch that held something else before must not leak it
            let mut batch = WindowBatch {
                frames: vec![7],
                n: 1,
                n_obs_steps: 9,
                indices: vec![9; 3],
                observation: vec![("c0".to_owned(), vec![9.0; 99])],
                pictures: vec![("old".to_owned(), vec![9; 3])],
                actions: vec![9.0; 7],
                is_pad: vec![true; 200],
            };
            windows.gather(&indices, &mut batch);
            prop_assert_eq!((batch.n, &batch.indices), (indices.len(), &indices));
            let (mut a, mut p) = (vec![], vec![]);
            for &i in &indices {
                let (actions, pad) = naive(&action, frames[i as usize], (past, horizon));
                a.extend(actions);
                p.extend(pad);
            }
            prop_assert_eq!(&batch.actions, &a);
            prop_assert_eq!(&batch.is_pad, &p);
            prop_assert!(batch.pictures.is_empty());
            prop_assert_eq!(batch.observation.len(), observed.len());
            for (name, column) in &observed {
                // step k of T is frame t - (T - 1 - k), clamped to the first of the episode
                let mut seen = Vec::new();
                for &i in &indices {
                    let (begin, frame, _) = frames[i as usize];
                    for k in 0..n_obs_steps {
                        let at = (frame as i64 - (n_obs_steps - 1 - k) as i64).max(begin as i64);
                        seen.extend_from_slice(column.row(at as usize));
                    }
                }
                prop_assert_eq!(batch.column(name).unwrap(), &seen);
            }
        }
    }

    #[test]
    fn pictures_come_with_the_observations_they_were_seen_with() {
        let pictures = Pictures { height: 1, width: 2, data: (0..5 * 6).collect() };
        let windows = Windows::new(vec![("c".into(), column(5, 1, 0.0))], column(5, 1, 0.0), (2, 1), &[(0, 2), (2, 5)])
            .with_pictures("front", Arc::new(pictures.clone()));
        assert_eq!(windows.pictures().collect::<Vec<_>>(), [("front", (1, 2))]);
        let mut batch = WindowBatch::default();
        windows.gather(&[2, 4, 1], &mut batch);
        let (name, bytes) = &batch.pictures[0];
        let frames: Vec<&[u8]> = bytes.chunks_exact(6).collect();
        // before an episode its first frame is repeated
        let expected = [2, 2, 3, 4, 0, 1].map(|frame| pictures.frame(frame));
        assert_eq!((name.as_str(), frames.as_slice()), ("front", &expected[..]));
        assert_eq!(batch.column("c").unwrap(), [2.0, 2.0, 3.0, 4.0, 0.0, 1.0]);
        assert!(batch.frames.is_empty());
        let windows = Windows { pictures: Vec::new(), ..windows }.with_pictures("front", PictureStore::Elsewhere(1, 2));
        windows.gather(&[2, 4, 1], &mut batch);
        assert_eq!((&batch.frames[..], batch.pictures[0].1.len()), (&[2, 2, 3, 4, 0, 1][..], 0));
    }
}
