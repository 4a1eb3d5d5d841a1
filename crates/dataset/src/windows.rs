//! Training windows: the observation at a frame and the `action_horizon` actions that follow it.
//!
//! Window `i` starts at frame `t` of an episode and holds the actions of frames `t .. t + action_horizon`.
//! Past the end of the episode the last action is repeated and flagged in `is_pad`, as LeRobot's
//! `delta_timestamps` and robomimic's padded sequences have it. Gathering a batch copies rows out of
//! columns that stay in memory; it allocates nothing once the batch has been used.

use crate::shuffle::SplitMix64;
use arrow::buffer::ScalarBuffer;

/// Which windows to make.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WindowSpec {
    /// Number of actions in a window, at least one.
    pub action_horizon: usize,
    /// Episodes to take windows from, by episode index; every frame of them starts one window.
    pub episodes: Vec<usize>,
}

/// A resident column: row-major values, `dim` to a frame. Cloning shares the memory.
#[derive(Debug, Clone)]
pub(crate) struct Resident {
    pub data: ScalarBuffer<f32>,
    pub dim: usize,
}

impl Resident {
    pub(crate) fn empty() -> Self {
        Self { data: ScalarBuffer::from(Vec::new()), dim: 0 }
    }

    fn row(&self, frame: usize) -> &[f32] {
        &self.data[frame * self.dim..(frame + 1) * self.dim]
    }
}

/// The windows of some episodes. Owns (shares) the columns, so that it outlives its data set.
#[derive(Debug, Clone)]
pub struct Windows {
    state: Resident,
    environment_state: Resident,
    action: Resident,
    action_horizon: usize,
    /// First frame of each window and the end of its episode, as rows of the columns.
    spans: Vec<(u32, u32)>,
}

/// One batch of windows, row-major. Reuse one value: `gather` resizes it only when the batch size changes.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct WindowBatch {
    /// Number of windows.
    pub n: usize,
    /// `(n, state_dim)`
    pub state: Vec<f32>,
    /// `(n, environment_state_dim)`; empty when the data set has no environment state.
    pub environment_state: Vec<f32>,
    /// `(n, action_horizon, action_dim)`
    pub actions: Vec<f32>,
    /// `(n, action_horizon)`; true where the last action of the episode is repeated.
    pub is_pad: Vec<bool>,
}

impl Windows {
    /// `ranges` are the `(from, to)` rows of the chosen episodes, checked by the caller to lie in the columns.
    pub(crate) fn new(
        state: Resident,
        environment_state: Resident,
        action: Resident,
        action_horizon: usize,
        ranges: &[(usize, usize)],
    ) -> Self {
        let total = ranges.iter().map(|(from, to)| to - from).sum();
        let mut spans = Vec::with_capacity(total);
        for &(from, to) in ranges {
            spans.extend((from as u32..to as u32).map(|frame| (frame, to as u32)));
        }
        Self { state, environment_state, action, action_horizon, spans }
    }

    /// Number of windows: one a frame.
    pub fn len(&self) -> usize {
        self.spans.len()
    }

    /// True when the chosen episodes have no frame.
    pub fn is_empty(&self) -> bool {
        self.spans.is_empty()
    }

    /// Actions in a window.
    pub fn action_horizon(&self) -> usize {
        self.action_horizon
    }

    /// Length of `observation.state`.
    pub fn state_dim(&self) -> usize {
        self.state.dim
    }

    /// Length of `observation.environment_state`; zero when there is none.
    pub fn environment_state_dim(&self) -> usize {
        self.environment_state.dim
    }

    /// Length of `action`.
    pub fn action_dim(&self) -> usize {
        self.action.dim
    }

    /// Every window once, in an order that depends on `seed` and `epoch` only.
    pub fn shuffled(&self, seed: u64, epoch: u64) -> Vec<u32> {
        let mut order: Vec<u32> = (0..self.spans.len() as u32).collect();
        SplitMix64::new(seed, epoch).shuffle(&mut order);
        order
    }

    /// Copies the windows `indices` into `batch`, in that order.
    ///
    /// # Panics
    /// When an index is not below [`Windows::len`].
    pub fn gather(&self, indices: &[u32], batch: &mut WindowBatch) {
        let (n, horizon, width) = (indices.len(), self.action_horizon, self.action.dim);
        batch.n = n;
        batch.state.resize(n * self.state.dim, 0.0);
        batch.environment_state.resize(n * self.environment_state.dim, 0.0);
        batch.actions.resize(n * horizon * width, 0.0);
        batch.is_pad.resize(n * horizon, false);
        for (i, &index) in indices.iter().enumerate() {
            let (frame, end) = self.spans[index as usize];
            let (frame, end) = (frame as usize, end as usize);
            copy_row(&mut batch.state, i, self.state.row(frame));
            if self.environment_state.dim > 0 {
                copy_row(&mut batch.environment_state, i, self.environment_state.row(frame));
            }
            let real = horizon.min(end - frame);
            let actions = &mut batch.actions[i * horizon * width..(i + 1) * horizon * width];
            let (head, tail) = actions.split_at_mut(real * width);
            head.copy_from_slice(&self.action.data[frame * width..(frame + real) * width]);
            let last = self.action.row(end - 1);
            for repeated in tail.chunks_exact_mut(width) {
                repeated.copy_from_slice(last);
            }
            let flags = &mut batch.is_pad[i * horizon..(i + 1) * horizon];
            flags[..real].fill(false);
            flags[real..].fill(true);
        }
    }
}

fn copy_row(out: &mut [f32], i: usize, row: &[f32]) {
    out[i * row.len()..(i + 1) * row.len()].copy_from_slice(row);
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use proptest::prelude::*;

    fn column(rows: usize, dim: usize, salt: f32) -> Resident {
        let data: Vec<f32> = (0..rows * dim).map(|i| i as f32 + salt).collect();
        Resident { data: data.into(), dim }
    }

    /// One window by the definition: index `t + k`, clamped to the last frame, flagged where clamped.
    fn naive(action: &Resident, frame: usize, end: usize, horizon: usize) -> (Vec<f32>, Vec<bool>) {
        let mut actions = Vec::new();
        let mut pad = Vec::new();
        for k in 0..horizon {
            actions.extend_from_slice(action.row((frame + k).min(end - 1)));
            pad.push(frame + k >= end);
        }
        (actions, pad)
    }

    proptest! {
        #[test]
        fn windows_agree_with_clamped_indexing(
            lengths in prop::collection::vec(1_usize..12, 1..8),
            horizon in 1_usize..20,
            dims in (1_usize..4, 0_usize..4, 1_usize..4),
            picks in prop::collection::vec(any::<prop::sample::Index>(), 1..40),
        ) {
            let rows: usize = lengths.iter().sum();
            let (state, env, action) = (column(rows, dims.0, 0.25), column(rows, dims.1, 0.5), column(rows, dims.2, 0.75));
            let mut ranges = Vec::new();
            let mut from = 0;
            for (i, &length) in lengths.iter().enumerate() {
                if i % 2 == 0 {
                    ranges.push((from, from + length));
                }
                from += length;
            }
            let frames: Vec<(usize, usize)> = ranges.iter().flat_map(|&(a, b)| (a..b).map(move |f| (f, b))).collect();
            let windows = Windows::new(state.clone(), env.clone(), action.clone(), horizon, &ranges);
            prop_assert_eq!(windows.len(), frames.len());
            let indices: Vec<u32> = picks.iter().map(|p| p.index(frames.len()) as u32).collect();
            // a batch that held something else before must not leak it
            let mut batch = WindowBatch { n: 1, state: vec![9.0; 99], environment_state: vec![9.0; 3], actions: vec![9.0; 7], is_pad: vec![true; 200] };
            windows.gather(&indices, &mut batch);
            prop_assert_eq!(batch.n, indices.len());
            let (mut s, mut e, mut a, mut p) = (vec![], vec![], vec![], vec![]);
            for &i in &indices {
                let (frame, end) = frames[i as usize];
                s.extend_from_slice(state.row(frame));
                e.extend_from_slice(env.row(frame));
                let (actions, pad) = naive(&action, frame, end, horizon);
                a.extend(actions);
                p.extend(pad);
            }
            prop_assert_eq!(&batch.state, &s);
            prop_assert_eq!(&batch.environment_state, &e);
            prop_assert_eq!(&batch.actions, &a);
            prop_assert_eq!(&batch.is_pad, &p);
        }
    }

    #[test]
    fn an_epoch_visits_every_window_once_in_its_own_order() {
        let c = column(30, 2, 0.0);
        let windows = Windows::new(c.clone(), Resident::empty(), c, 4, &[(0, 10), (20, 30)]);
        let mut first = windows.shuffled(3, 0);
        assert_eq!(first, windows.shuffled(3, 0));
        assert_ne!(first, windows.shuffled(3, 1));
        first.sort_unstable();
        assert_eq!(first, (0..20).collect::<Vec<u32>>());
    }
}
