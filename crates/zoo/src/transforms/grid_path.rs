//! Which cells of a grid a demonstration still visits: `visited` of `[data.grids]`, targets of `policy.reasoning.grid.way`.
//!
//! The key is 1 in the cell of the hand. For each observation the cells are marked that the hand is in now or later in the
//! demonstration: its path to the end, without labels.

use candle_core::Tensor;
use dataset::WindowBatch;
use models::{Batch, ModelError};

use super::slices::Slice;
use super::{Fitted, Source, Transform};
use crate::ZooError;
use crate::experiment::{Experiment, GridSection};

pub(super) struct GridPath;

/// The grid whose path the policy learns, by name, and the key of the hand's cell.
fn path_grid(experiment: &Experiment) -> Option<(&str, &GridSection, &str)> {
    let asked = experiment.policy.grid().filter(|grid| grid.way > 0.0)?;
    let (name, grid) = experiment.data.grids.get_key_value(&asked.among)?;
    Some((name, grid, grid.visited.as_deref()?))
}

impl Transform for GridPath {
    fn name(&self) -> &'static str {
        "grids"
    }

    /// The policy's rows are those of the grid, and the grid has what the policy learns.
    fn check(&self, experiment: &Experiment, _: &[String]) -> Result<(), ZooError> {
        let Some(asked) = experiment.policy.grid() else { return Ok(()) };
        let invalid = |key: &str, expected: String, found: String| {
            Err(ZooError::InvalidValue { key: format!("policy.reasoning.grid.{key}"), expected, found })
        };
        if let Some(grid) = experiment.data.grids.get(&asked.among).filter(|grid| grid.columns != asked.columns) {
            let expected = format!("{}, as data.grids.{}", grid.columns, asked.among);
            return invalid("columns", expected, asked.columns.to_string());
        }
        if asked.way > 0.0 && path_grid(experiment).is_none() {
            let expected = "a grid of data.grids with the key `visited`".to_owned();
            return invalid("among", expected, format!("`{}`", asked.among));
        }
        Ok(())
    }

    fn fit(&self, source: &Source<'_>) -> Result<Option<Box<dyn Fitted>>, ZooError> {
        let Some((name, grid, key)) = path_grid(source.experiment) else { return Ok(None) };
        let cells = grid.cells();
        let items: Vec<String> = (0..cells).map(|cell| GridSection::item(key, cell)).collect();
        let slices = source.slices(self.name())?.alike(&format!("data.grids.{name}.visited"), &items)?;
        let mut visited = vec![0; source.windows.len() * cells];
        let mut batch = WindowBatch::default();
        for episode in source.demonstrations(self.name())? {
            let all: Vec<u32> = episode.clone().collect();
            source.gather(&all, &mut batch)?;
            mark(&slices, &batch, &mut visited[episode.start as usize * cells..][..all.len() * cells]);
        }
        Ok(Some(Box::new(Paths { cells, visited })))
    }
}

/// The path of every window.
#[derive(Debug)]
struct Paths {
    cells: usize,
    /// (windows, cells) of 0 and 1
    visited: Vec<u8>,
}

impl Fitted for Paths {
    /// (n, cells)
    fn targets(&self, windows: &WindowBatch, batch: &mut Batch) -> Result<(), ModelError> {
        batch.visited = Some(self.of(windows)?);
        Ok(())
    }
}

impl Paths {
    fn of(&self, windows: &WindowBatch) -> Result<Tensor, ModelError> {
        let row = |&window: &u32| &self.visited[window as usize * self.cells..][..self.cells];
        let values: Vec<f32> = windows.indices.iter().flat_map(row).map(|&here| f32::from(here)).collect();
        Ok(Tensor::from_vec(values, (windows.n, self.cells), &candle_core::Device::Cpu)?)
    }
}

/// Marks in `visited`, (windows, cells), where the windows of one episode, in order, are now or later.
fn mark(slices: &[Slice], episode: &WindowBatch, visited: &mut [u8]) {
    let (cells, last) = (slices.len(), episode.n_obs_steps - 1);
    let mut later = vec![0; cells];
    for (row, visited) in visited.chunks_exact_mut(cells).enumerate().rev() {
        for (later, slice) in later.iter_mut().zip(slices) {
            if slice.of(episode, row, last).iter().any(|&here| here > 0.5) {
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
        let slice = |from| Slice { feature: "cell".to_owned(), from, width: 1 };
        // the hand is in cells 0, 1, 0, 2; a step before it is told of as well
        let steps = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]];
        let observation = (0..4usize).flat_map(|t| [steps[t.saturating_sub(1)], steps[t]].concat()).collect();
        let observation = vec![("cell".to_owned(), observation)];
        let episode =
            WindowBatch { n: 4, n_obs_steps: 2, observation, indices: vec![0, 1, 2, 3], ..WindowBatch::default() };
        let mut visited = vec![9; 12];
        mark(&[slice(0), slice(1), slice(2)], &episode, &mut visited);
        assert_eq!(visited, [1, 1, 1, 1, 1, 1, 1, 0, 1, 0, 0, 1]);
        let paths = Paths { cells: 3, visited };
        let batch = WindowBatch { n: 2, indices: vec![3, 0], ..WindowBatch::default() };
        assert_eq!(paths.of(&batch).unwrap().to_vec2::<f32>().unwrap(), [[0.0, 0.0, 1.0], [1.0, 1.0, 1.0]]);
    }
}
