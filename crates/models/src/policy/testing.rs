//! A policy whose chunks are known beforehand.
#![allow(clippy::unwrap_used)]

use super::{ActionChunk, Observation, Policy};
use nn::Result;

/// Plays back given chunks.
pub(super) struct Tape {
    pub(super) chunks: Vec<Vec<f32>>,
    pub(super) dim: usize,
    pub(super) at: usize,
}

impl Policy for Tape {
    fn predict(&mut self, _: &Observation) -> Result<ActionChunk> {
        let actions = self.chunks[self.at].clone();
        self.at += 1;
        let horizon = actions.len() / self.dim;
        ActionChunk::new(actions, horizon, self.dim)
    }
    fn reset(&mut self, _seed: u64) {
        self.at = 0;
    }
}

pub(super) fn tape(steps: usize, horizon: usize, dim: usize, values: &[f32]) -> Tape {
    let chunks = (0..steps)
        .map(|t| (0..horizon * dim).map(|i| values[(t * 31 + i * 7) % values.len()] + i as f32).collect())
        .collect();
    Tape { chunks, dim, at: 0 }
}
