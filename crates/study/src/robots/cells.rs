//! What a study runs, in order.

use super::file::Study;

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

/// The cells of a study: row by row, in a row seed by seed, so that a study that is stopped has as many trainings of every
/// arm. A training that stands in several rows is one cell with the tests of all.
pub fn cells(study: &Study) -> Vec<Cell> {
    let mut cells: Vec<Cell> = Vec::new();
    for row in &study.cells {
        for seed in 1..=row.seeds {
            for arm in &row.arms {
                let same = |cell: &&mut Cell| cell.arm == *arm && cell.data == row.data && cell.seed == seed;
                match cells.iter_mut().find(same) {
                    Some(cell) => {
                        let new: Vec<String> = row.tests.iter().filter(|t| !cell.tests.contains(t)).cloned().collect();
                        cell.tests.extend(new);
                    }
                    None => {
                        cells.push(Cell { arm: arm.clone(), data: row.data.clone(), seed, tests: row.tests.clone() })
                    }
                }
            }
        }
    }
    cells
}

#[cfg(test)]
mod tests {
    use super::super::file::CellRow;
    use super::*;
    use std::collections::BTreeMap;

    #[test]
    fn seeds_go_round_the_arms_and_a_training_is_run_once() {
        let row = |arms: &[&str], seeds, tests: &[&str]| CellRow {
            arms: arms.iter().map(|a| (*a).to_owned()).collect(),
            data: "d".to_owned(),
            seeds,
            tests: tests.iter().map(|t| (*t).to_owned()).collect(),
        };
        let study = Study {
            title: String::new(),
            introduction: String::new(),
            results: "r".into(),
            page: "p".into(),
            data: BTreeMap::new(),
            arms: BTreeMap::new(),
            tests: BTreeMap::new(),
            cells: vec![row(&["a", "b"], 2, &["x"]), row(&["b"], 3, &["x", "y"])],
            comparisons: Vec::new(),
        };
        let found: Vec<String> = cells(&study).iter().map(|c| format!("{} {}", c.name(), c.tests.join("+"))).collect();
        let expected = ["a-on-d-seed1 x", "b-on-d-seed1 x+y", "a-on-d-seed2 x", "b-on-d-seed2 x+y", "b-on-d-seed3 x+y"];
        assert_eq!(found, expected);
    }
}
