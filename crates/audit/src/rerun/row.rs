//! Which result a row is.

use std::path::{Path, PathBuf};

use zoo::ZooError;
use zoo::entry::EntryId;
use zoo::registry::Registry;
use zoo::results::{EvaluationRecord, RECORD, read_record, result_folders};

/// A result, by its folder, and the entry that it is of.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Row {
    /// The result's folder.
    pub folder: PathBuf,
    /// The entry that its record names.
    pub entry: EntryId,
}

/// The row that `text` means: the folder of a result, by its name in `results` or as a path; or the only result of an entry
/// (`name`, `name@version`, `name@alias`) that is `wanted`.
///
/// # Errors
/// [`ZooError::WhichRow`] where there is not exactly one; an entry that is not in the zoo; a record that cannot be read.
pub fn find_row(
    text: &str,
    registry: &Registry,
    results: &Path,
    wanted: &dyn Fn(&EvaluationRecord) -> bool,
) -> Result<Row, ZooError> {
    let folders = [results.join(text), PathBuf::from(text)];
    if let Some(folder) = folders.into_iter().find(|folder| folder.join(RECORD).is_file()) {
        let entry = read_record(&folder)?.entry;
        return Ok(Row { folder, entry: EntryId { name: entry.name, version: entry.version } });
    }
    let id = registry.resolve(text)?;
    let name = |folder: &PathBuf| folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let mut own = result_folders(results)?;
    own.retain(|folder| name(folder).starts_with(&format!("{id}_")));
    let fits: Vec<&PathBuf> = own.iter().filter(|folder| read_record(folder).is_ok_and(|own| wanted(&own))).collect();
    match fits.as_slice() {
        [folder] => Ok(Row { folder: (*folder).clone(), entry: id }),
        _ => {
            // where none fits, what there is
            let found =
                if fits.is_empty() { own.iter().map(name).collect() } else { fits.into_iter().map(name).collect() };
            Err(ZooError::WhichRow { row: text.to_owned(), results: results.to_owned(), found })
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use results::testing::{finished, sample};
    use zoo::entry::testing::draft as test_draft;

    #[test]
    fn a_row_is_a_folder_or_the_only_result_of_an_entry() {
        let zoo = tempfile::tempdir().unwrap();
        test_draft("lift-act").seal(zoo.path()).unwrap();
        let (registry, results) = (Registry::open(zoo.path()), zoo.path().join("results"));
        let find = |text: &str, count: Option<u64>| {
            find_row(text, &registry, &results, &|record| count.is_none_or(|count| record.seeds.count == count))
        };
        let none = find("lift-act", None).unwrap_err().to_string();
        assert!(none.contains("row `lift-act`: expected one result in") && none.contains("found none"), "{none}");
        let folder = finished(&results, &sample("lift-act", 1, 20)).folder;
        let row = find("lift-act", None).unwrap();
        assert_eq!((&row.folder, row.entry.to_string().as_str()), (&folder, "lift-act@1"));
        let other = finished(&results, &sample("lift-act", 1, 30)).folder;
        let two = find("lift-act@1", None).unwrap_err().to_string();
        for folder in [&folder, &other] {
            let name = folder.file_name().unwrap().to_str().unwrap();
            assert!(two.contains(name), "{two}");
            assert_eq!(&find(name, None).unwrap().folder, folder);
            assert_eq!(&find(folder.to_str().unwrap(), None).unwrap().folder, folder);
        }
        assert_eq!(find("lift-act", Some(30)).unwrap().folder, other);
        let neither = find("lift-act", Some(7)).unwrap_err().to_string();
        assert!(neither.contains("10000-10019") && neither.contains("10000-10029"), "{neither}");
        assert!(find("lift-atc", None).unwrap_err().to_string().contains("did you mean `lift-act`"));
    }
}
