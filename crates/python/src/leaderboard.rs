//! The leaderboard of a zoo as rows.

use std::path::{Path, PathBuf};

use audit::{KnownEntries, audit};
use pyo3::exceptions::{PyFileNotFoundError, PyUserWarning};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};
use report::column::Datum;
use report::{COLUMNS, LeaderboardRow, Reading, rank};
use zoo::protocols::Protocols;

use crate::error::{raised, words};
use crate::policy::registry;
use crate::work::unlocked;

/// The ranked results of a zoo: a list of dicts with the columns of `leaderboard.csv`, as `pandas.DataFrame` and
/// `polars.DataFrame` take them. A value that a row does not have is None.
///
/// Results that are not valid (damaged, edited, copied, of a missing entry) are left out and named in a
/// `UserWarning` each, as `actrm-zoo leaderboard` names them.
///
/// Parameters
/// ----------
/// zoo: the zoo's folder; `$ACTRM_ZOO_DIR` or `zoo` unless given.
/// results: the folder of results; `results` in the zoo unless given.
#[pyfunction]
#[pyo3(signature = (zoo=None, *, results=None))]
pub(crate) fn leaderboard<'py>(
    py: Python<'py>,
    zoo: Option<PathBuf>,
    results: Option<PathBuf>,
) -> PyResult<Bound<'py, PyList>> {
    let registry = registry(zoo);
    let there = |word: &str, folder: &Path| match folder.is_dir() {
        true => Ok(()),
        false => {
            Err(PyFileNotFoundError::new_err(format!("{word}: expected a folder, found none: {}", folder.display())))
        }
    };
    there("zoo", registry.folder())?;
    // a zoo without evaluations has no results yet
    let results = match results {
        Some(results) => there("results", &results).map(|()| results)?,
        None => registry.folder().join("results"),
    };
    let (entries, found) = unlocked(py, || {
        let entries = KnownEntries::open(&registry).map_err(raised)?;
        let found = audit(&results, &entries).map_err(raised)?;
        Ok((entries, found))
    })?;
    let bad = entries.bad().map(|(id, error)| format!("entry {id}: {}", words(error)));
    let left_out =
        found.left_out.iter().map(|left| format!("left out: {}: {}", left.folder.display(), words(&left.reason)));
    let warning = py.get_type::<PyUserWarning>();
    for text in bad.chain(left_out) {
        let text = std::ffi::CString::new(text.replace('\0', "\u{fffd}"))?;
        PyErr::warn(py, &warning, &text, 1)?;
    }
    let row = |row: &LeaderboardRow| -> PyResult<Bound<'py, PyDict>> {
        let dict = PyDict::new(py);
        for (column, name) in COLUMNS.iter().filter_map(|column| Some((column, column.csv_name()?))) {
            match column.datum(row) {
                Datum::Text(text) => dict.set_item(name, text)?,
                Datum::Count(count) => dict.set_item(name, count)?,
                Datum::Number(number) => dict.set_item(name, number)?,
                Datum::None => dict.set_item(name, py.None())?,
            }
        }
        Ok(dict)
    };
    let reading = Reading::of(&entries, Protocols::built_in());
    PyList::new(py, rank(&found.standing, &reading).iter().map(row).collect::<PyResult<Vec<_>>>()?)
}
