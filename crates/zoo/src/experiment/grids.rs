//! `[data.grids]`: observation keys that tell something of every cell of a grid; each cell is an entity.
//!
//! ```toml
//! [data.grids.cell]
//! keys = ["maze_walls", "maze_goal", "peg_cell"]
//! rows = 10
//! columns = 10
//! visited = "peg_cell"
//! ```
//!
//! Every key has a number for each cell, row by row. The entities are `cell00` to `cell99`, of group `cell`.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::{DataSection, EntitySection};
use crate::ZooError;

/// The most cells: more tokens than any policy here should have.
const MOST_CELLS: usize = 4096;

/// One grid of `[data.grids]`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GridSection {
    /// Observation keys with one number per cell.
    pub keys: Vec<String>,
    /// Rows of cells.
    pub rows: usize,
    /// Cells per row.
    pub columns: usize,
    /// Whether every cell gets a learned position of its own.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub position: bool,
    /// The key among them that is 1 in the gripper's cell. It gives the cells that a demonstration visits.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub visited: Option<String>,
}

impl GridSection {
    /// How many cells it has.
    pub fn cells(&self) -> usize {
        self.rows.saturating_mul(self.columns)
    }

    /// What a key says of cell number `cell`, as an item of a list of keys.
    pub fn item(key: &str, cell: usize) -> String {
        format!("{key}[{cell}:{}]", cell + 1)
    }

    /// The cells of the grid `name` as entities, in order.
    fn entities(&self, name: &str) -> impl Iterator<Item = (String, EntitySection)> {
        let digits = self.cells().saturating_sub(1).to_string().len();
        (0..self.cells()).map(move |cell| {
            let keys = self.keys.iter().map(|key| Self::item(key, cell)).collect();
            let entity = EntitySection { keys, group: Some(name.to_owned()), position: self.position };
            (format!("{name}{cell:0digits$}"), entity)
        })
    }

    fn check(&self, name: &str) -> Result<(), ZooError> {
        let invalid = |key: &str, expected: &str, found: String| {
            let key = format!("data.grids.{name}.{key}");
            Err(ZooError::InvalidValue { key, expected: expected.to_owned(), found })
        };
        if !(1..=MOST_CELLS).contains(&self.cells()) {
            let found = format!("{} x {}", self.rows, self.columns);
            return invalid("rows", &format!("1 to {MOST_CELLS} cells"), found);
        }
        if self.keys.is_empty() {
            return invalid("keys", "at least one key", "none".to_owned());
        }
        if let Some(key) = self.keys.iter().find(|key| key.contains('[') || key.contains(" - ")) {
            return invalid("keys", "whole keys", format!("`{key}`"));
        }
        match self.visited.as_ref().filter(|key| !self.keys.contains(key)) {
            Some(key) => invalid("visited", &format!("one of {}", self.keys.join(", ")), format!("`{key}`")),
            None => Ok(()),
        }
    }
}

impl DataSection {
    /// Adds the entities that the grids make. A resolved experiment has them already.
    ///
    /// # Errors
    /// A grid that cannot be one, an entity of another kind under a cell's name.
    pub(super) fn with_cells(mut self) -> Result<Self, ZooError> {
        let mut made: BTreeMap<String, EntitySection> = BTreeMap::new();
        for (name, grid) in &self.grids {
            grid.check(name)?;
            made.extend(grid.entities(name));
        }
        for (name, entity) in made {
            if let Some(other) = self.entities.get(&name).filter(|other| **other != entity) {
                return Err(ZooError::InvalidValue {
                    key: format!("data.entities.{name}"),
                    expected: format!("the cell that data.grids makes: {}", entity.keys.join(", ")),
                    found: other.keys.join(", "),
                });
            }
            self.entities.insert(name, entity);
        }
        Ok(self)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::config::Library;
    use crate::experiment::Experiment;

    fn data(grid: GridSection) -> DataSection {
        DataSection { grids: BTreeMap::from([("cell".to_owned(), grid)]), ..DataSection::default() }
    }

    fn grid() -> GridSection {
        let keys = vec!["walls".to_owned(), "peg".to_owned()];
        GridSection { keys, rows: 3, columns: 4, position: true, visited: Some("peg".to_owned()) }
    }

    #[test]
    fn every_cell_is_an_entity_and_its_names_sort_as_the_cells_lie() {
        let with = data(grid()).with_cells().unwrap();
        let names: Vec<&str> = with.entities.keys().map(String::as_str).collect();
        assert_eq!((names.len(), names[0], names[10], names[11]), (12, "cell00", "cell10", "cell11"));
        let last = &with.entities["cell11"];
        assert_eq!(last.keys, ["walls[11:12]", "peg[11:12]"]);
        assert!(last.position && last.group_of("cell11") == "cell");
        // what was resolved is read again as it is
        assert_eq!(with.clone().with_cells().unwrap(), with);
        let mut other = with;
        other.grids.get_mut("cell").unwrap().position = false;
        let error = other.with_cells().unwrap_err().to_string();
        assert!(error.contains("data.entities.cell00"), "{error}");
    }

    #[test]
    fn what_cannot_be_a_grid_is_named() {
        let error = |change: &dyn Fn(&mut GridSection)| {
            let mut grid = grid();
            change(&mut grid);
            data(grid).with_cells().unwrap_err().to_string()
        };
        assert!(error(&|g| g.rows = 0).contains("data.grids.cell.rows"));
        assert!(error(&|g| g.rows = usize::MAX).contains("1 to 4096 cells"));
        assert!(error(&|g| g.keys.clear()).contains("data.grids.cell.keys"));
        assert!(error(&|g| g.keys[0] = "walls[0:12]".to_owned()).contains("`walls[0:12]`"));
        assert!(error(&|g| g.visited = Some("hand".to_owned())).contains("one of walls, peg"));
    }

    #[test]
    fn a_policy_over_a_grid_needs_its_columns_and_what_was_visited() {
        let library = Library::built_in();
        let load = |set: &[&str]| {
            let set: Vec<String> = set.iter().map(|s| (*s).to_owned()).collect();
            Experiment::load(&library, "actrm_tablemaze", &set)
        };
        let experiment = load(&[]).unwrap();
        // a saved experiment is read again as it is
        assert_eq!(Experiment::from_toml("saved", &experiment.to_toml()).unwrap(), experiment);
        let error = |set: &[&str]| load(set).unwrap_err().to_string();
        assert!(error(&["policy.reasoning.grid.columns=5"]).contains("policy.reasoning.grid.columns"));
        assert!(error(&["policy.reasoning.grid.among='hole'"]).contains("policy.reasoning.grid.among"));
        load(&["policy.reasoning.grid.way=0.0"]).unwrap();
    }
}
