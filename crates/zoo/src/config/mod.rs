//! Experiment files: TOML, composed by `extends`, changed by dotted overrides.
//!
//! The experiments of `configs/` are built into the binary; a folder given by the user comes first. A name
//! that starts with `_` is a part that others extend, not an experiment to train.

mod embedded;
mod overrides;
mod value;

use std::path::{Path, PathBuf};

use toml::Table;

use crate::ZooError;

pub use overrides::apply_overrides;
pub use value::{from_value, from_value_as};

/// The name most like `name`, if one is like it: at most a third of its letters differ.
pub fn nearest(name: &str, names: &[String]) -> Option<String> {
    names
        .iter()
        .map(|n| (strsim::damerau_levenshtein(&name.to_lowercase(), &n.to_lowercase()), n))
        .filter(|(distance, n)| *distance <= (name.len().max(n.len()) / 3).max(1))
        .min()
        .map(|(_, n)| n.clone())
}

/// Refuses names that are not the plain name of a file: an experiment's folder of runs is called like it.
///
/// # Errors
/// [`ZooError::ExperimentName`].
pub fn check_experiment_name(name: &str) -> Result<(), ZooError> {
    const LONGEST: usize = 200;
    let refuse = |reason| Err(ZooError::ExperimentName { name: name.to_owned(), reason });
    if name.is_empty() || name == "." || name == ".." || name.contains(['/', '\\', '\0']) {
        return refuse("expected the plain name of a file, without its folder");
    }
    if name.len() > LONGEST {
        return refuse("expected at most 200 bytes");
    }
    Ok(())
}

/// Where experiments come from: a folder, if the user has one, and then those built in.
#[derive(Debug, Clone, Default)]
pub struct Library {
    folder: Option<PathBuf>,
}

impl Library {
    /// The experiments built into the binary.
    pub fn built_in() -> Self {
        Self::default()
    }

    /// Files of `folder` first, then the experiments built in.
    ///
    /// # Errors
    /// When `folder` is not a folder.
    pub fn with_folder(folder: &Path) -> Result<Self, ZooError> {
        std::fs::read_dir(folder).map_err(ZooError::io("open experiment folder", folder))?;
        Ok(Self { folder: Some(folder.to_owned()) })
    }

    /// Names of every experiment that can be trained, sorted.
    ///
    /// # Errors
    /// When the folder cannot be read.
    pub fn names(&self) -> Result<Vec<String>, ZooError> {
        let mut names: Vec<String> = embedded::FILES.iter().map(|(n, _)| (*n).to_owned()).collect();
        if let Some(folder) = &self.folder {
            for item in std::fs::read_dir(folder).map_err(ZooError::io("read folder", folder))? {
                let path = item.map_err(ZooError::io("read folder", folder))?.path();
                let stem = path.file_stem().and_then(|s| s.to_str());
                if let (Some(stem), Some("toml")) = (stem, path.extension().and_then(|e| e.to_str())) {
                    names.push(stem.to_owned());
                }
            }
        }
        names.retain(|n| !n.starts_with('_'));
        names.sort();
        names.dedup();
        Ok(names)
    }

    /// The table of experiment `name` with everything it extends merged beneath it: one experiment, or a list of them, of
    /// which later ones lie over earlier ones.
    ///
    /// Tables merge key by key; anything else is replaced by the extending file.
    ///
    /// # Errors
    /// When a file is unknown, not TOML, or extends itself.
    pub fn resolve(&self, name: &str) -> Result<Table, ZooError> {
        self.resolve_below(name, &mut Vec::new())
    }

    /// The same for an experiment that those of `chain` extend.
    fn resolve_below(&self, name: &str, chain: &mut Vec<String>) -> Result<Table, ZooError> {
        let cycle = chain.iter().any(|seen| seen == name);
        chain.push(name.to_owned());
        if cycle {
            return Err(ZooError::ExtendsCycle { chain: chain.clone() });
        }
        let mut table = self.read(name)?;
        let parents = match table.remove("extends") {
            None => Vec::new(),
            Some(toml::Value::Array(parents)) => parents,
            Some(parent) => vec![parent],
        };
        let mut merged = Table::new();
        for parent in parents {
            let Some(parent) = parent.as_str() else {
                return Err(ZooError::InvalidValue {
                    key: "extends".to_owned(),
                    expected: "the name of an experiment, or a list of names".to_owned(),
                    found: parent.to_string(),
                });
            };
            merge(&mut merged, self.resolve_below(parent, chain)?);
        }
        merge(&mut merged, table);
        chain.pop();
        Ok(merged)
    }

    fn read(&self, name: &str) -> Result<Table, ZooError> {
        check_experiment_name(name)?;
        let text = match self.folder.as_ref().map(|f| f.join(format!("{name}.toml"))) {
            Some(path) if path.is_file() => std::fs::read_to_string(&path).map_err(ZooError::io("read", path))?,
            _ => match embedded::FILES.iter().find(|(n, _)| *n == name) {
                Some((_, text)) => (*text).to_owned(),
                None => {
                    let available = self.names()?;
                    return Err(ZooError::UnknownExperiment {
                        name: name.to_owned(),
                        nearest: nearest(name, &available),
                        available,
                    });
                }
            },
        };
        toml::from_str(&text)
            .map_err(|source| ZooError::ExperimentSyntax { experiment: name.to_owned(), source: Box::new(source) })
    }
}

/// Lays `above` over `below`.
fn merge(below: &mut Table, above: Table) {
    for (key, value) in above {
        match (below.get_mut(&key), value) {
            (Some(toml::Value::Table(inner)), toml::Value::Table(outer)) => merge(inner, outer),
            (_, value) => {
                below.insert(key, value);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn library(files: &[(&str, &str)]) -> (tempfile::TempDir, Library) {
        let folder = tempfile::tempdir().unwrap();
        for (name, text) in files {
            std::fs::write(folder.path().join(format!("{name}.toml")), text).unwrap();
        }
        let library = Library::with_folder(folder.path()).unwrap();
        (folder, library)
    }

    #[test]
    fn extending_files_win_key_by_key() {
        let (_folder, library) = library(&[
            ("_a", "x = 1\n[train]\nsteps = 10\nlr = 0.1\nkeys = [1, 2]"),
            ("_b", "extends = '_a'\n[train]\nsteps = 20"),
            ("c", "extends = '_b'\ny = 2\n[train]\nkeys = [3]"),
        ]);
        let table = library.resolve("c").unwrap();
        let expected: Table = toml::from_str("x = 1\ny = 2\n[train]\nsteps = 20\nlr = 0.1\nkeys = [3]").unwrap();
        assert_eq!(table, expected);
        let names = library.names().unwrap();
        assert!(names.contains(&"c".to_owned()) && !names.contains(&"_a".to_owned()));
    }

    #[test]
    fn a_name_with_a_folder_is_refused_before_any_file_is_opened() {
        let (folder, library) = library(&[("up", "x = 1"), ("down", "extends = '../up'")]);
        let inner = folder.path().join("inner");
        std::fs::create_dir(&inner).unwrap();
        let below = Library::with_folder(&inner).unwrap();
        for name in ["../up", "/etc/passwd", "", ".."] {
            let error = below.resolve(name).unwrap_err().to_string();
            assert!(error.starts_with(&format!("experiment name `{name}`: expected the plain name")), "{error}");
        }
        assert!(library.resolve("down").unwrap_err().to_string().contains("`../up`"));
        assert!(library.resolve(&"x".repeat(300)).unwrap_err().to_string().ends_with("at most 200 bytes"));
    }

    #[test]
    fn of_several_that_are_extended_the_later_ones_win() {
        let (_folder, library) = library(&[
            ("_base", "x = 1\ny = 1"),
            ("_policy", "extends = '_base'\ny = 2\nz = 2"),
            ("_task", "z = 3"),
            ("e", "extends = ['_policy', '_task']\nw = 4"),
            ("f", "extends = ['_policy', 5]"),
        ]);
        let table = library.resolve("e").unwrap();
        let value = |key: &str| table[key].as_integer().unwrap();
        assert_eq!([value("x"), value("y"), value("z"), value("w")], [1, 2, 3, 4]);
        assert!(library.resolve("f").unwrap_err().to_string().contains("or a list of names, found 5"));
    }

    #[test]
    fn a_file_that_extends_itself_is_named() {
        let (_folder, library) = library(&[("p", "extends = 'q'"), ("q", "extends = 'p'")]);
        assert_eq!(library.resolve("p").unwrap_err().to_string(), "experiment `p` extends itself: p -> q -> p");
    }

    #[test]
    fn an_unknown_experiment_lists_what_there_is() {
        let message = Library::built_in().resolve("act_lfit").unwrap_err().to_string();
        assert!(
            message.starts_with("unknown experiment `act_lfit` (did you mean `act_lift`?); experiments: "),
            "{message}"
        );
    }

    #[test]
    fn every_file_of_configs_is_built_in() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs");
        let mut on_disk: Vec<(String, String)> = std::fs::read_dir(folder)
            .unwrap()
            .map(|item| item.unwrap().path())
            .filter(|path| path.extension().is_some_and(|e| e == "toml"))
            .map(|path| {
                let name = path.file_stem().unwrap().to_str().unwrap().to_owned();
                (name, std::fs::read_to_string(path).unwrap())
            })
            .collect();
        on_disk.sort();
        let built_in: Vec<(String, String)> =
            embedded::FILES.iter().map(|(n, t)| ((*n).to_owned(), (*t).to_owned())).collect();
        assert_eq!(on_disk, built_in);
    }

    #[test]
    fn far_away_names_are_not_suggested() {
        let names = ["steps".to_owned(), "lr".to_owned()];
        assert_eq!(nearest("stpes", &names), Some("steps".to_owned()));
        assert_eq!(nearest("batch_size", &names), None);
    }
}
