//! What a study runs, in order.

use super::file::{CellRow, Study};

/// One training, and what it is tested on.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Cell {
    /// The arm.
    pub arm: String,
    /// The demonstrations.
    pub data: String,
    /// The training's seed.
    pub seed: u64,
    /// The tests.
    pub tests: Vec<String>,
    /// The stage of its row.
    pub stage: u8,
}

impl Cell {
    /// Name of its entry and of its run's folder.
    pub fn name(&self) -> String {
        format!("{}-on-{}-seed{}", self.arm, self.data, self.seed)
    }

    /// Name of the file of its result on `test`.
    pub fn file_name(&self, test: &str) -> String {
        format!("{}_{test}.json", self.name())
    }
}

/// The cells of a study: stage by stage, row by row, in a row seed by seed, so that a study that is stopped has as many
/// trainings of every arm. A training that stands in several rows of a stage is one cell with the tests of all; one that
/// stands in a later stage again is another cell of the same name, with further tests.
pub fn cells(study: &Study) -> Vec<Cell> {
    let mut cells: Vec<Cell> = Vec::new();
    let mut rows: Vec<&CellRow> = study.cells.iter().collect();
    rows.sort_by_key(|row| row.stage);
    for row in rows {
        for seed in row.first_seed..=row.seeds {
            for arm in &row.arms {
                let same = |cell: &&mut Cell| {
                    cell.arm == *arm && cell.data == row.data && cell.seed == seed && cell.stage == row.stage
                };
                match cells.iter_mut().find(same) {
                    Some(cell) => {
                        let new: Vec<String> = row.tests.iter().filter(|t| !cell.tests.contains(t)).cloned().collect();
                        cell.tests.extend(new);
                    }
                    None => {
                        let (arm, data, tests) = (arm.clone(), row.data.clone(), row.tests.clone());
                        cells.push(Cell { arm, data, seed, tests, stage: row.stage });
                    }
                }
            }
        }
    }
    cells
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;

    #[test]
    fn seeds_go_round_the_arms_and_a_training_is_run_once() {
        let row = |arms: &[&str], seeds, tests: &[&str]| CellRow {
            arms: arms.iter().map(|a| (*a).to_owned()).collect(),
            data: "d".to_owned(),
            seeds,
            first_seed: 1,
            tests: tests.iter().map(|t| (*t).to_owned()).collect(),
            stage: 1,
        };
        let later = CellRow { stage: 2, first_seed: 2, ..row(&["a"], 3, &["z"]) };
        let study = Study {
            title: String::new(),
            verdict: String::new(),
            introduction: String::new(),
            results: "r".into(),
            page: "p".into(),
            zoo: None,
            data: BTreeMap::new(),
            arms: BTreeMap::new(),
            tests: BTreeMap::new(),
            cells: vec![later, row(&["a", "b"], 2, &["x"]), row(&["b"], 3, &["x", "y"])],
            comparisons: Vec::new(),
        };
        let found: Vec<String> = cells(&study).iter().map(|c| format!("{} {}", c.name(), c.tests.join("+"))).collect();
        let expected = [
            "a-on-d-seed1 x",
            "b-on-d-seed1 x+y",
            "a-on-d-seed2 x",
            "b-on-d-seed2 x+y",
            "b-on-d-seed3 x+y",
            "a-on-d-seed2 z",
            "a-on-d-seed3 z",
        ];
        assert_eq!(found, expected);
    }
}
