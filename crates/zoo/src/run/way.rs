//! Which cells of a grid a demonstration still comes by: `visited` of `[data.grids]`, asked by `policy.reasoning.grid.way`.
//!
//! The key is 1 in the cell where the hand is. Of each observation those cells are marked in which it is now or will be, as
//! the demonstration goes on: its way to the end, which nobody had to label.

use std::path::Path;

use candle_core::Tensor;
use dataset::{Dataset, WindowBatch, Windows};

use crate::ZooError;
use crate::experiment::{Experiment, GridSection};

use super::places::{Place, Places};

/// The way of every window; empty where nobody asks.
#[derive(Debug, Default)]
pub(crate) struct Ways {
    cells: usize,
    /// (windows, cells) of 0 and 1
    visited: Vec<u8>,
}

impl Ways {
    /// Reads them off the windows.
    ///
    /// # Errors
    /// A column whose names do not say which keys it holds; a file of pictures that cannot be read.
    pub fn new(experiment: &Experiment, dataset: &Dataset, windows: &Windows, path: &Path) -> Result<Self, ZooError> {
        let Some((name, grid, key)) = experiment.asked_grid() else { return Ok(Self::default()) };
        let items: Vec<String> = (0..grid.cells()).map(|cell| GridSection::item(key, cell)).collect();
        let setting = format!("data.grids.{name}.visited");
        let places = Places::new(experiment, dataset, path, "data.grids")?.alike(&setting, &items)?;
        let mut visited = vec![0; windows.len() * grid.cells()];
        let mut batch = WindowBatch::default();
        for episode in windows.episodes() {
            let all: Vec<u32> = episode.clone().collect();
            let unreadable = super::data::unreadable(&path.display().to_string());
            windows.try_gather(&all, &mut batch).map_err(unreadable)?;
            let begin = episode.start as usize * grid.cells();
            mark(&places, &batch, &mut visited[begin..begin + all.len() * grid.cells()]);
        }
        Ok(Self { cells: grid.cells(), visited })
    }

    /// Of a batch of windows, (n, cells); `None` where nobody asks.
    ///
    /// # Errors
    /// When a tensor cannot be made.
    pub fn of(&self, windows: &WindowBatch) -> Result<Option<Tensor>, candle_core::Error> {
        if self.cells == 0 {
            return Ok(None);
        }
        let row = |&window: &u32| &self.visited[window as usize * self.cells..][..self.cells];
        let values: Vec<f32> = windows.indices.iter().flat_map(row).map(|&here| f32::from(here)).collect();
        Tensor::from_vec(values, (windows.n, self.cells), &candle_core::Device::Cpu).map(Some)
    }
}

/// Marks in `visited`, (windows, cells), where the windows of one episode, in order, are now or later.
fn mark(places: &[Place], episode: &WindowBatch, visited: &mut [u8]) {
    let (cells, last) = (places.len(), episode.n_obs_steps - 1);
    let mut later = vec![0; cells];
    for (row, visited) in visited.chunks_exact_mut(cells).enumerate().rev() {
        for (later, place) in later.iter_mut().zip(places) {
            if place.of(episode, row, last).iter().any(|&here| here > 0.5) {
                *later = 1;
            }
        }
        visited.copy_from_slice(&later);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_cell_is_marked_until_it_was_left_for_the_last_time() {
        let place = |from| Place { feature: "cell".to_owned(), from, width: 1 };
        // the hand is in cells 0, 1, 0, 2; a step before it is told of as well
        let steps = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]];
        let observation = (0..4usize).flat_map(|t| [steps[t.saturating_sub(1)], steps[t]].concat()).collect();
        let observation = vec![("cell".to_owned(), observation)];
        let episode =
            WindowBatch { n: 4, n_obs_steps: 2, observation, indices: vec![0, 1, 2, 3], ..WindowBatch::default() };
        let mut visited = vec![9; 12];
        mark(&[place(0), place(1), place(2)], &episode, &mut visited);
        assert_eq!(visited, [1, 1, 1, 1, 1, 1, 1, 0, 1, 0, 0, 1]);
        let ways = Ways { cells: 3, visited };
        let batch = WindowBatch { n: 2, indices: vec![3, 0], ..WindowBatch::default() };
        assert_eq!(ways.of(&batch).unwrap().unwrap().to_vec2::<f32>().unwrap(), [[0.0, 0.0, 1.0], [1.0, 1.0, 1.0]]);
        assert!(Ways::default().of(&batch).unwrap().is_none());
    }
}
