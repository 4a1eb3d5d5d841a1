//! What can go wrong in a study of robot policies: what its parts refuse.

/// An operation of a study that failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StudyError {
    /// A file, an experiment, a training or an evaluation.
    #[error(transparent)]
    Zoo(#[from] zoo::ZooError),
    /// The demonstrations could not be collected.
    #[error(transparent)]
    Recording(#[from] recording::RecordingError),
    /// One cell of it could not be run.
    #[error("cell {cell}")]
    Cell {
        /// Its name.
        cell: String,
        /// Why.
        source: Box<StudyError>,
    },
    /// A cell was asked for, or a part of names, that the study has not.
    #[error("cell `{cell}`: expected one that `actrm-zoo study STUDY --list` names, or with --only a part of its name")]
    UnknownCell {
        /// What was asked for.
        cell: String,
    },
    /// Cells have results of trainings that are not here, and what is here is not the same.
    #[error(
        "cells {}: their results in {} are of trainings whose weights are not in {}; bring those entries there, or remove \
         these results, so that all of a cell's tests are of one training",
        cells.join(", "), results.display(), zoo.display()
    )]
    OtherTrainings {
        /// Their names.
        cells: Vec<String>,
        /// The folder of results.
        results: std::path::PathBuf,
        /// Where entries are looked for.
        zoo: std::path::PathBuf,
    },
    /// A simulator could not be started.
    #[error(transparent)]
    Rollout(#[from] rollout::RolloutError),
}

impl StudyError {
    /// Says which cell it was.
    pub(super) fn of(self, cell: &super::cells::Cell) -> Self {
        Self::Cell { cell: cell.name(), source: Box::new(self) }
    }
}
